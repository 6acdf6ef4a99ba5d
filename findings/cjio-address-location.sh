#!/bin/sh
# cjio 0.10.1 (subset, vertices_clean, lod_filter): addresses point to vertices that are no longer theirs.
#
# CityJSON 2.0 lets an address have a "location", a MultiPoint with indices of the file's vertices. cjio numbers the vertices anew
# and leaves those indices alone.
# Seen: the entrance of house b is vertex 6 of 7. After "vertices_clean" there are 6 vertices, and the index is still 6: out of
# range. After "subset --id b" there are 3. Exit code 0, no message. Where more vertices are left it is another place.
# Expected: the location is renumbered like the boundaries, and its vertex is kept.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check cjio==0.10.1
venv/bin/python -W ignore - <<'END'
import json, subprocess

vertices = [[0, 0, 0], [1000, 0, 0], [0, 1000, 0], [5000, 0, 0], [6000, 0, 0], [5000, 1000, 0], [5500, -3000, 0]]
house = lambda ring: {"type": "Building", "geometry": [{"type": "MultiSurface", "lod": "0", "boundaries": [[ring]]}]}
entrance = {"street": "Main Street", "location": {"type": "MultiPoint", "lod": "0", "boundaries": [6]}}
city = {
    "type": "CityJSON",
    "version": "2.0",
    "transform": {"scale": [0.001] * 3, "translate": [0, 0, 0]},
    "CityObjects": {"a": house([0, 1, 2]), "b": {**house([3, 4, 5]), "address": [entrance]}},
    "vertices": vertices,
}
json.dump(city, open("a.json", "w"))
for words, left in ((["vertices_clean"], 6), (["lod_filter", "0"], 6), (["subset", "--id", "b"], 3)):
    code = subprocess.run(["venv/bin/cjio", "--suppress_msg", "a.json", *words, "save", "b.json"], stdout=subprocess.DEVNULL).returncode
    found = json.load(open("b.json"))
    index = found["CityObjects"]["b"]["address"][0]["location"]["boundaries"]
    if (code, index, len(found["vertices"])) != (0, [6], left):
        raise SystemExit(f"changed: {words}: exit code {code}, location {index} of {len(found['vertices'])} vertices")
END
