#!/bin/sh
# cjio 0.10.1 (export obj, export stl): buildings that are a MultiSolid or a CompositeSolid are left out without a word.
#
# Both are geometry types of CityJSON, for buildings of more than one body.
# Seen: the same tetrahedron as a Solid gives 4 faces in OBJ and in STL; as a MultiSolid or a CompositeSolid it gives none, with
# exit code 0 and no message ("triangulate" of the same program knows both types).
# Expected: 4 faces, or a message that names what was left out.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check cjio==0.10.1 mapbox_earcut==2.1.0 triangle2==20230923
venv/bin/python -W ignore - <<'END'
import json, subprocess

shell = [[[0, 2, 1]], [[0, 1, 3]], [[1, 2, 3]], [[2, 0, 3]]]
counts = {}
for kind, boundaries in (("Solid", [shell]), ("MultiSolid", [[shell]]), ("CompositeSolid", [[shell]])):
    city = {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [0.001] * 3, "translate": [0, 0, 0]},
        "CityObjects": {"h": {"type": "Building", "geometry": [{"type": kind, "lod": "2", "boundaries": boundaries}]}},
        "vertices": [[0, 0, 0], [9000, 0, 0], [0, 9000, 0], [0, 0, 9000]],
    }
    json.dump(city, open("a.json", "w"))
    for ending, word in (("obj", "\nf "), ("stl", "facet normal")):
        done = subprocess.run(["venv/bin/cjio", "a.json", "export", ending, f"out.{ending}"], capture_output=True, text=True)
        said = "warn" in (done.stdout + done.stderr).lower()
        counts[kind, ending] = (done.returncode, said, open(f"out.{ending}").read().count(word))
expected = {(kind, e): (0, False, 4 if kind == "Solid" else 0) for kind in ("Solid", "MultiSolid", "CompositeSolid") for e in ("obj", "stl")}
if counts != expected:
    raise SystemExit(f"changed: {counts}")
END
