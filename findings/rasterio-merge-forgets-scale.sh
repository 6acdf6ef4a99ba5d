#!/bin/sh
# rasterio 1.4.3 (merge): tiles whose heights are stored as integers with scale and offset are merged into a file without them.
#
# Seen: two tiles of centimetres (int16, scale 0.01, offset 100, unit "metre"), merged with dst_path, give a file of the raw integers with
# scale 1, offset 0 and no unit: 112.34 m has become 1234 m. No warning.
# Expected: scale, offset and unit of the tiles, which all have the same, in the file; or values in metres; or a refusal.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check rasterio==1.4.3 numpy==2.2.6
venv/bin/python -W ignore - <<'END'
import numpy as np
import rasterio
from rasterio.merge import merge
from rasterio.transform import from_origin

for name, west in (("a.tif", 0), ("b.tif", 2)):
    profile = {"driver": "GTiff", "width": 2, "height": 2, "count": 1, "dtype": "int16", "crs": "EPSG:25832"}
    with rasterio.open(name, "w", transform=from_origin(west, 2, 1, 1), **profile) as tile:
        tile.write(np.full((1, 2, 2), 1234, np.int16))
        tile.scales, tile.offsets, tile.units = (0.01,), (100.0,), ("metre",)
merge(["a.tif", "b.tif"], dst_path="both.tif")
with rasterio.open("both.tif") as both:
    seen = both.read(1)[0].tolist(), both.scales, both.offsets, both.units
if seen != ([1234] * 4, (1.0,), (0.0,), (None,)):
    raise SystemExit(f"changed: {seen}")
END
