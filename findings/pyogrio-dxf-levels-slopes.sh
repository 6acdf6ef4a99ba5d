#!/bin/sh
# pyogrio 0.11.1 with GDAL 3.10.3 (DXF): a sloping polygon is written level, at the mean of its heights.
#
# Seen: a roof with eaves at 5 m and ridge at 9 m, written as DXF and read again, is flat at 7 m on all corners (a HATCH, which has one
# elevation). No error, no warning. A line with the same heights keeps them.
# Expected: a 3D face or polyline with the heights it had, or a refusal.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check pyogrio==0.11.1 geopandas==1.1.1 shapely==2.1.1 numpy==2.2.6
venv/bin/python -W ignore - <<'END'
import geopandas
import pyogrio
import shapely

ring = [(0, 0, 5), (4, 0, 5), (4, 4, 9), (0, 4, 9), (0, 0, 5)]


def heights_again(geometry, name):
    pyogrio.write_dataframe(geopandas.GeoDataFrame({"Layer": ["0"]}, geometry=[geometry]), name)
    again = pyogrio.read_dataframe(name).geometry[0]
    return shapely.get_coordinates(again, include_z=True)[:, 2].tolist()


roof, line = heights_again(shapely.Polygon(ring), "roof.dxf"), heights_again(shapely.LineString(ring), "line.dxf")
if roof != [7.0] * 5 or line != [5.0, 5.0, 9.0, 9.0, 5.0]:
    raise SystemExit(f"changed: polygon {roof}, line {line}, GDAL {pyogrio.__gdal_version__}")
END
