#!/bin/sh
# OpenCV 5.0.0 (imread, imdecode): a TIFF of orientation 6 is no picture from a file, and turned from memory, whatever is asked for.
#
# Orientation 6 is what cameras write that were held upright. The picture here has 20 rows of 30 columns.
# Seen: imread returns None for it, with an internal error in the log ("original_ptr == real_mat.data"), under every flag, as
# BigTIFF, too; imdecode of the same bytes returns 30 rows of 20 columns, also under IMREAD_UNCHANGED and
# IMREAD_IGNORE_ORIENTATION. Of orientation 3 both return it turned by 180 degrees under those flags.
# Expected: as for JPEG: turned by default, as stored under IMREAD_IGNORE_ORIENTATION and IMREAD_UNCHANGED, the same from both.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check opencv-python-headless==5.0.0.93 tifffile==2026.3.3 numpy==2.3.5
venv/bin/python -W ignore - <<'END'
import cv2
import numpy as np
import tifffile

cv2.utils.logging.setLogLevel(0)
picture = np.arange(20 * 30 * 3, dtype=np.uint16).astype(np.uint8).reshape(20, 30, 3)
flags = (cv2.IMREAD_COLOR, cv2.IMREAD_UNCHANGED, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
for is_big in (False, True):
    for orientation in (3, 6):
        tifffile.imwrite("a.tif", picture, bigtiff=is_big, photometric="rgb", extratags=[(274, 3, 1, orientation, True)])
        for flag in flags:
            read, decoded = cv2.imread("a.tif", flag), cv2.imdecode(np.fromfile("a.tif", np.uint8), flag)
            if orientation == 6:
                seen = read is None and decoded is not None and decoded.shape == (30, 20, 3)
            else:
                seen = all(np.array_equal(p[..., ::-1], picture[::-1, ::-1]) for p in (read, decoded))
            if not seen:
                raise SystemExit(f"changed: BigTIFF {is_big}, orientation {orientation}, flag {flag}")
END
