#!/bin/sh
# cjio 0.10.1 (crs_reproject): projecting to degrees loses every coordinate.
#
# Seen: a box of 10 m in EPSG:25832 after "crs_reproject 4979": exit code 0 and "scale": [0.000000, 0.000000, 0.000000], so all
# eight corners are one point. The scale for degrees, below 0.000001, is written with six decimals, like all numbers of a file.
# Expected: a scale that is written as it is used, and corners about 10 m apart.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check cjio==0.10.1 pyproj==3.7.2
venv/bin/python -W ignore - <<'END'
import json, subprocess

corners = [[x, y, z] for z in (0, 10000) for x, y in ((0, 0), (10000, 0), (10000, 10000), (0, 10000))]
faces = [[[0, 3, 2, 1]], [[4, 5, 6, 7]], [[0, 1, 5, 4]], [[1, 2, 6, 5]], [[2, 3, 7, 6]], [[3, 0, 4, 7]]]
city = {
    "type": "CityJSON",
    "version": "2.0",
    "transform": {"scale": [0.001] * 3, "translate": [500000, 5500000, 100]},
    "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/25832"},
    "CityObjects": {"h": {"type": "Building", "geometry": [{"type": "Solid", "lod": "2", "boundaries": [faces]}]}},
    "vertices": corners,
}
json.dump(city, open("a.json", "w"))
code = subprocess.run(["venv/bin/cjio", "--suppress_msg", "a.json", "crs_reproject", "4979", "save", "b.json"]).returncode
scale = json.load(open("b.json"))["transform"]["scale"] if code == 0 else None
if scale != [0, 0, 0]:
    raise SystemExit(f"changed: exit code {code}, scale {scale}")
END
