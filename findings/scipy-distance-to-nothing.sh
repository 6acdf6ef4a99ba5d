#!/bin/sh
# SciPy 1.17.1 (ndimage.distance_transform_edt): where there is no background, distances are to a pixel outside of the picture.
#
# Seen: for a picture of ones of 3 x 4 pixels the distances are those to row -1, column 0 (1 at the first pixel, 4.24 at the last),
# and return_indices gives (-1, 0), which as an index is the last row. distance_transform_cdt gives -1 for the same picture.
# Expected: inf or -1, or an error: there is nothing to have a distance to. (An empty mask, inverted, is such a picture.)
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check scipy==1.17.1 numpy==2.4.6
venv/bin/python -W ignore - <<'END'
import numpy as np
from scipy import ndimage

distances, nearest = ndimage.distance_transform_edt(np.ones((3, 4)), return_indices=True)
rows, columns = np.indices((3, 4))
other = ndimage.distance_transform_cdt(np.ones((3, 4)))
if not (np.allclose(distances, np.hypot(rows + 1, columns)) and (nearest[0] == -1).all() and (nearest[1] == 0).all() and (other == -1).all()):
    raise SystemExit(f"changed: {distances.tolist()}, {nearest.tolist()}, {other.tolist()}")
END
