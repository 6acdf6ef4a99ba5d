#!/bin/sh
# py3dtiles 12.1.1 (TileSet): reading and writing a tileset drops what it does not know, without a word.
#
# Seen: a 3D Tiles 1.1 tileset read with TileSet.from_dict and written with to_dict is without "schema", "metadata", and the
# tile's "contents" (both of its models), "implicitTiling" (all of its children) and "viewerRequestVolume"; "extras" are kept.
# No error and no warning; what is left draws nothing.
# Expected: unknown properties are kept, or a tileset that needs them is refused, as bounding volumes of kind "region" are.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check py3dtiles==12.1.1
venv/bin/python -W ignore - <<'END'
import json

from py3dtiles.tileset import TileSet

box = {"box": [0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1]}
tile = {
    "boundingVolume": box,
    "viewerRequestVolume": box,
    "geometricError": 1,
    "refine": "ADD",
    "contents": [{"uri": "walls/{level}/{x}/{y}.glb"}, {"uri": "roofs/{level}/{x}/{y}.glb"}],
    "implicitTiling": {"subdivisionScheme": "QUADTREE", "subtreeLevels": 2, "availableLevels": 3, "subtrees": {"uri": "{level}.{x}.{y}.subtree"}},
    "extras": {"kept": True},
}
schema = {"id": "s", "classes": {"city": {"properties": {"name": {"type": "STRING"}}}}}
tileset = {"asset": {"version": "1.1"}, "schema": schema, "metadata": {"class": "city", "properties": {"name": "x"}}, "geometricError": 10, "root": tile}
again = TileSet.from_dict(json.loads(json.dumps(tileset))).to_dict()
lost = sorted(set(tileset) - set(again)), sorted(set(tile) - set(again["root"]))
if lost != (["metadata", "schema"], ["contents", "implicitTiling", "viewerRequestVolume"]):
    raise SystemExit(f"changed: lost {lost}")
END
