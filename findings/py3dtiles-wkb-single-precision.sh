#!/bin/sh
# py3dtiles 12.1.1 (TriangleSoup.from_wkb_multipolygon): houses in UTM coordinates move by up to 0.25 m, and more than 256 corners fail.
#
# WKB has doubles; they are read into 32 bits before anything is subtracted, and corners are numbered with 8 bits.
# Seen: a roof of 0.3 x 0.5 m at northing 5538509.456 is read at 5538509.5, 0.31 m wide. 85 triangles of three corners each have
# indices; 86 raise "OverflowError: Python integer 256 out of bounds for uint8".
# Expected: doubles until the offset is known, and indices wide enough for any building.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check py3dtiles==12.1.1
venv/bin/python -W ignore - <<'END'
import struct

from py3dtiles.tilers.b3dm.wkb_utils import TriangleSoup


def soup(rings):
    polygons = [struct.pack("<BIII", 1, 1003, 1, len(r)) + b"".join(struct.pack("<3d", *p) for p in r) for r in rings]
    return TriangleSoup.from_wkb_multipolygon(struct.pack("<BII", 1, 1006, len(polygons)) + b"".join(polygons))


def triangles(count):
    return soup([[(3 * i, 0, 0), (3 * i + 1, 0, 0), (3 * i, 1, 0), (3 * i, 0, 0)] for i in range(count)])


x, y = 566783.123, 5538509.456
read = soup([[(x, y, 0), (x + 0.3, y, 0), (x + 0.3, y + 0.5, 0), (x, y + 0.5, 0), (x, y, 0)]]).vertices
spans = [float(read[:, 0].min()), float(read[:, 0].max()), float(read[:, 1].min())]
many = triangles(85).triangle_indices.max()
try:
    triangles(86).triangle_indices
    error = "none"
except OverflowError as overflow:
    error = str(overflow)
if (spans, many, error) != ([566783.125, 566783.4375, 5538509.5], 254, "Python integer 256 out of bounds for uint8"):
    raise SystemExit(f"changed: {spans}, {many}, {error}")
END
