#!/bin/sh
# GDAL 3.12.4 (in pyogrio 0.13.0, GML): a PolyhedralSurface of GML 3.2 needs an element that GML 3.2 deprecates.
#
# GML 3.2.1 has "patches" for all kinds of surfaces, and keeps "polygonPatches" among its deprecated elements.
# Seen: the same two polygons in gml:Surface with gml:patches are read as a MultiPolygon Z; in gml:PolyhedralSurface with
# gml:patches the whole layer ends in "Missing <polygonPatches> for PolyhedralSurface".
# Expected: "patches" is read in both.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check pyogrio==0.13.0 numpy==2.4.6
venv/bin/python -W ignore - <<'END'
import pathlib

import pyogrio

def ring(numbers):
    return f'<gml:exterior><gml:LinearRing><gml:posList srsDimension="3">{numbers}</gml:posList></gml:LinearRing></gml:exterior>'

patches = "".join(f"<gml:PolygonPatch>{ring(n)}</gml:PolygonPatch>" for n in ("0 0 0 1 0 0 1 1 0 0 0 0", "0 0 0 1 0 0 1 0 5 0 0 0"))
seen = {}
for kind in ("Surface", "PolyhedralSurface"):
    surface = f'<gml:{kind} gml:id="g"><gml:patches>{patches}</gml:patches></gml:{kind}>'
    member = f'<ogr:featureMember><ogr:h gml:id="h.0"><ogr:geom>{surface}</ogr:geom></ogr:h></ogr:featureMember>'
    names = 'xmlns:ogr="http://ogr.maptools.org/" xmlns:gml="http://www.opengis.net/gml/3.2" gml:id="f"'
    pathlib.Path(f"{kind}.gml").write_text(f'<?xml version="1.0"?><ogr:FeatureCollection {names}>{member}</ogr:FeatureCollection>')
    try:
        seen[kind] = pyogrio.raw.read(f"{kind}.gml")[0]["geometry_type"]
    except Exception as error:
        seen[kind] = "polygonPatches" if "Missing <polygonPatches>" in str(error) else repr(error)
if seen != {"Surface": "MultiPolygon Z", "PolyhedralSurface": "polygonPatches"}:
    raise SystemExit(f"changed: {seen}")
END
