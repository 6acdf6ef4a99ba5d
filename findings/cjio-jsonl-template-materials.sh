#!/bin/sh
# cjio 0.10.1 (export jsonl, subset): materials of geometry templates are dropped, references to them are kept.
#
# Seen: a tree that is an instance of a template with material 0 ("leaf"). The first line of "export jsonl" has the template,
# whose material is still 0, and no "appearance"; the line of the tree has an empty one. "subset" does the same: the index
# points into a list that is not there. Exit code 0, no message.
# Expected: the material goes with the template that uses it.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check cjio==0.10.1
venv/bin/python -W ignore - <<'END'
import json, subprocess

instance = {"type": "GeometryInstance", "template": 0, "boundaries": [0], "transformationMatrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
template = {"type": "MultiSurface", "lod": "1", "boundaries": [[[0, 1, 2]]], "material": {"looks": {"value": 0}}}
city = {
    "type": "CityJSON",
    "version": "2.0",
    "transform": {"scale": [0.001] * 3, "translate": [0, 0, 0]},
    "appearance": {"materials": [{"name": "leaf"}]},
    "geometry-templates": {"templates": [template], "vertices-templates": [[0, 0, 0], [1, 0, 0], [0, 0, 1]]},
    "CityObjects": {"tree": {"type": "SolitaryVegetationObject", "geometry": [instance]}},
    "vertices": [[0, 0, 0]],
}
json.dump(city, open("a.json", "w"))
for words in (["export", "jsonl", "b.jsonl"], ["subset", "--id", "tree", "save", "c.json"]):
    subprocess.run(["venv/bin/cjio", "--suppress_msg", "a.json", *words], check=True, stdout=subprocess.DEVNULL)
first, tree = map(json.loads, open("b.jsonl"))
part = json.load(open("c.json"))
for name, file, looks in (("jsonl", first, (first.get("appearance"), tree.get("appearance"))), ("subset", part, (None, part.get("appearance")))):
    value = file["geometry-templates"]["templates"][0].get("material")
    if value != {"looks": {"value": 0}} or looks != (None, {}):
        raise SystemExit(f"changed: {name}: template {value}, appearance {looks}")
END
