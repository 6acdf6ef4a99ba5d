#!/bin/sh
# cjio 0.10.1 (merge): the first file's building takes the second file's colour.
#
# Two files with the same building at LoD 1.2 (material 0: grey) and at LoD 2.2 (material 0: red).
# Seen: after "merge" both geometries of the building have material 1, red; grey is no longer used. The offset for the second
# file's materials is added to all geometries of a building that both files have, those of the first file included.
# Expected: LoD 1.2 keeps material 0 (grey), LoD 2.2 has material 1 (red).
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check cjio==0.10.1
venv/bin/python -W ignore - <<'END'
import json, subprocess

for name, lod, colour in (("a.json", "1.2", "grey"), ("b.json", "2.2", "red")):
    geometry = {"type": "MultiSurface", "lod": lod, "boundaries": [[[0, 1, 2]]], "material": {"looks": {"value": 0}}}
    city = {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [0.001] * 3, "translate": [0, 0, 0]},
        "appearance": {"materials": [{"name": colour}]},
        "CityObjects": {"h": {"type": "Building", "attributes": {}, "geometry": [geometry]}},
        "vertices": [[0, 0, 0], [1000, 0, 0], [0, 1000, 0]],
    }
    json.dump(city, open(name, "w"))
subprocess.run(["venv/bin/cjio", "--suppress_msg", "a.json", "merge", "b.json", "save", "c.json"], check=True, stdout=subprocess.DEVNULL)
merged = json.load(open("c.json"))
names = [material["name"] for material in merged["appearance"]["materials"]]
seen = {g["lod"]: names[g["material"]["looks"]["value"]] for g in merged["CityObjects"]["h"]["geometry"]}
if seen != {"1.2": "red", "2.2": "red"}:
    raise SystemExit(f"changed: {seen}")
END
