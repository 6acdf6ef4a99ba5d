#!/bin/sh
# rasterio 1.4.3 (merge): a tile whose cells lie half a cell aside is moved onto the first tile's cells, heights unchanged.
#
# Seen: of two surface models at 1 m, one with its grid half a metre further north, the merged one has the heights of one of them moved
# by half a metre: no resampling, no warning. On a plane that rises 2 m a metre to the north this is 1 m of height.
# Expected: values interpolated where the grids differ, or a refusal.
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


def write(name, west, north):
    """A plane whose height is twice the northing of a cell's centre."""
    heights = np.repeat(2 * (north - 0.5 - np.arange(4.0))[:, None], 4, axis=1).astype(np.float32)
    profile = {"driver": "GTiff", "width": 4, "height": 4, "count": 1, "dtype": "float32", "crs": "EPSG:25832", "nodata": -9999}
    with rasterio.open(name, "w", transform=from_origin(west, north, 1, 1), **profile) as tile:
        tile.write(heights, 1)


write("west.tif", 0, 100.0)
write("east.tif", 4, 100.5)
merged, transform = merge(["west.tif", "east.tif"])
rows, columns = np.nonzero(merged[0] != -9999)
northing = transform.f - 0.5 - rows
errors = merged[0][rows, columns] - 2 * northing
by_tile = sorted({(bool(column >= 4), round(float(error), 3)) for column, error in zip(columns, errors)})
if by_tile != [(False, -1.0), (True, 0.0)]:
    raise SystemExit(f"changed: errors by tile {by_tile}")
END
