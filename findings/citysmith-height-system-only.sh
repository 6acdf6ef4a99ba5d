#!/bin/sh
# citysmith 0.2.0 (convert, CityGML to CityJSON): of a compound system only the heights' part is kept.
#
# srsName "urn:ogc:def:crs,crs:EPSG::25832,crs:EPSG::7837" is UTM zone 32N with DHHN2016 heights, the usual name in German files.
# Seen: "referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/7837", a system of heights without a plane. Exit code 0, no
# message; what reads the file cannot place it.
# Expected: a compound system, or at least EPSG:25832.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check citysmith==0.2.0 lxml==6.1.3
venv/bin/python -W ignore - <<'END'
import json, subprocess

gml = """<?xml version="1.0"?>
<CityModel xmlns="http://www.opengis.net/citygml/2.0" xmlns:bldg="http://www.opengis.net/citygml/building/2.0"
 xmlns:gml="http://www.opengis.net/gml">
<gml:boundedBy><gml:Envelope srsName="urn:ogc:def:crs,crs:EPSG::25832,crs:EPSG::7837" srsDimension="3">
<gml:lowerCorner>566783 5538509 100</gml:lowerCorner><gml:upperCorner>566793 5538519 100</gml:upperCorner>
</gml:Envelope></gml:boundedBy>
<cityObjectMember><bldg:Building gml:id="b"><bldg:lod2MultiSurface><gml:MultiSurface><gml:surfaceMember>
<gml:Polygon gml:id="p"><gml:exterior><gml:LinearRing><gml:posList srsDimension="3">
566783 5538509 100 566793 5538509 100 566793 5538519 100 566783 5538509 100
</gml:posList></gml:LinearRing></gml:exterior></gml:Polygon>
</gml:surfaceMember></gml:MultiSurface></bldg:lod2MultiSurface></bldg:Building></cityObjectMember></CityModel>"""
open("a.gml", "w").write(gml)
code = subprocess.run(["venv/bin/citysmith", "convert", "a.gml", "-o", "a.json"], stdout=subprocess.DEVNULL).returncode
system = json.load(open("a.json"))["metadata"].get("referenceSystem")
if (code, system) != (0, "https://www.opengis.net/def/crs/EPSG/0/7837"):
    raise SystemExit(f"changed: exit code {code}, {system}")
END
