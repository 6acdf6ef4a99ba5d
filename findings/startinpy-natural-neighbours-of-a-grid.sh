#!/bin/sh
# startinpy 0.12.3 (DT.interpolate, method NNI): of a regular grid, places a whole cell inside of the border have no height.
#
# The documentation promises nan outside of the convex hull only, and an error there with strict=True.
# Seen: for a triangulation of 11 x 11 points at 1 m on a plane, NNI is nan at (0.5, 0.5) and (1.5, 1), which is_inside_convex_hull
# says are inside, and strict=True returns the nan without an error; so it is for two in five of evenly spread places, with
# "precompute" as well. TIN and Laplace give the plane's height at all of them, and so does NNI for scattered points.
# Expected: the plane's height from all three.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check startinpy==0.12.3 numpy==2.4.6
venv/bin/python -W ignore - <<'END'
import numpy as np
import startinpy

def surface(xy):
    made = startinpy.DT()
    made.insert(np.column_stack([xy, xy.sum(axis=1)]))
    return made

grid = surface(np.array([(x, y) for x in range(11) for y in range(11)], dtype=float))
inside = [[0.5, 0.5], [1.5, 1.0]]
places = np.array([(x, y) for x in range(100) for y in range(100)]) / 10 + 0.05
random = np.random.default_rng(1)
scattered, elsewhere = surface(random.random((300, 2)) * 100), random.random((1000, 2)) * 50 + 25

def missing(made, method, where, **options):
    heights = made.interpolate({"method": method, **options}, where, strict=True)
    if not np.allclose(heights[~np.isnan(heights)], np.sum(where, axis=1)[~np.isnan(heights)]):
        raise SystemExit(f"changed: {method}: other heights")
    return int(np.isnan(heights).sum())

found = {
    "inside": all(grid.is_inside_convex_hull(each) for each in inside),
    "NNI, two places": missing(grid, "NNI", inside),
    "NNI": missing(grid, "NNI", places),
    "NNI, precompute": missing(grid, "NNI", places, precompute=True),
    "TIN": missing(grid, "TIN", places),
    "Laplace": missing(grid, "Laplace", places),
    "NNI, scattered": missing(scattered, "NNI", elsewhere),
}
nni = found.pop("NNI")
same = found.pop("NNI, precompute") == nni
if not (same and 3500 < nni < 4500) or list(found.values()) != [True, 2, 0, 0, 0]:
    raise SystemExit(f"changed: of 10000 places {nni} nan, {found}")
END
