#!/bin/sh
# rasterio 1.4.3 (fill.fillnodata): the array that is handed over is filled too, with a mask beside it as with a masked array.
#
# Seen: after filled = fillnodata(heights, mask=known) the caller's heights hold the interpolated values as well, so that filled - heights
# is zero everywhere, and what was measured can no longer be separated from what was filled in by the array alone.
# Expected: the result is returned (as the documentation says) and the input stays as it was.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check rasterio==1.4.3 numpy==2.2.6
venv/bin/python -W ignore - <<'END'
import numpy as np
from rasterio.fill import fillnodata

heights = np.array([[1, 0, 3]], np.float32)
known = heights != 0
filled = fillnodata(heights, mask=known)
if filled.tolist() != [[1, 2, 3]] or heights.tolist() != [[1, 2, 3]]:
    raise SystemExit(f"changed: result {filled.tolist()}, input {heights.tolist()}")
END
