#!/bin/sh
# pyogrio 0.13.0: a file of which one layer has solids cannot even be listed.
#
# GDAL reads a gml:Solid as a PolyhedralSurface (type 1015), and a triangulated surface as a TIN (1016).
# Seen: a GML file with a layer of points and one of solids: list_layers, and read_info of the solids' layer, raise
# "GeometryError: Geometry type is not supported: 1015"; so nobody learns the name of the layer of points, which read by its
# name is fine.
# Expected: the list of layers, with that type as it is or as unknown; an error only where such geometry is read.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check pyogrio==0.13.0 numpy==2.4.6
venv/bin/python -W ignore - <<'END'
import pathlib

import pyogrio

points = '<gml:Point gml:id="p"><gml:pos srsDimension="3">1 2 3</gml:pos></gml:Point>'
ring = '<gml:exterior><gml:LinearRing><gml:posList srsDimension="3">0 0 0 1 0 0 1 1 0 0 0 0</gml:posList></gml:LinearRing></gml:exterior>'
member = f'<gml:surfaceMember><gml:Polygon gml:id="q">{ring}</gml:Polygon></gml:surfaceMember>'
solid = f'<gml:Solid gml:id="s"><gml:exterior><gml:Shell gml:id="t">{member}</gml:Shell></gml:exterior></gml:Solid>'
layers = "".join(
    f'<ogr:featureMember><ogr:{name} gml:id="{name}.0"><ogr:geom>{geometry}</ogr:geom></ogr:{name}></ogr:featureMember>'
    for name, geometry in (("trees", points), ("houses", solid))
)
names = 'xmlns:ogr="http://ogr.maptools.org/" xmlns:gml="http://www.opengis.net/gml/3.2" gml:id="f"'
pathlib.Path("a.gml").write_text(f'<?xml version="1.0"?><ogr:FeatureCollection {names}>{layers}</ogr:FeatureCollection>')
seen = []
for call in (pyogrio.list_layers, lambda path: pyogrio.read_info(path, layer="houses"), lambda path: pyogrio.raw.read(path, layer="trees")):
    try:
        call("a.gml")
        seen.append("read")
    except Exception as error:
        seen.append(str(error))
if seen != ["Geometry type is not supported: 1015"] * 2 + ["read"]:
    raise SystemExit(f"changed: {seen}")
END
