#!/bin/sh
# Pillow 13.0.0 (Image.open): BigTIFF is read in one byte order only.
#
# Seen: the same picture as TIFF in both byte orders and as little-endian BigTIFF ("II", 43) opens; as big-endian BigTIFF
# ("MM", 43) it raises UnidentifiedImageError. The same file is read by tifffile, which wrote it.
# Expected: all four, as of classic TIFF, or an error that names the byte order.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check pillow==13.0.0 tifffile==2026.3.3 numpy==2.3.5
venv/bin/python -W ignore - <<'END'
import numpy as np
import tifffile
from PIL import Image, UnidentifiedImageError

picture, seen = np.arange(12, dtype=np.uint8).reshape(3, 4), {}
for order in "<>":
    for is_big in (False, True):
        tifffile.imwrite("a.tif", picture, byteorder=order, bigtiff=is_big)
        assert np.array_equal(tifffile.imread("a.tif"), picture)
        try:
            with Image.open("a.tif") as image:
                seen[order, is_big] = np.array_equal(np.asarray(image), picture)
        except UnidentifiedImageError:
            seen[order, is_big] = None
if seen != {("<", False): True, ("<", True): True, (">", False): True, (">", True): None}:
    raise SystemExit(f"changed: {seen}")
END
