#!/bin/sh
# trimesh 5.2.0 (load_mesh, glTF): triangle fans are read as nothing.
#
# A primitive of glTF 2.0 is of triangles (mode 4), a strip (5) or a fan (6) of them.
# Seen: a square of 1 m2 is read as 2 triangles from modes 4 and 5; as a fan it is a mesh without vertices and faces, without an
# error.
# Expected: 2 triangles and 1 m2, or an error that names the mode.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check trimesh==5.2.0 numpy==2.4.6
venv/bin/python -W ignore - <<'END'
import base64, json, struct

import trimesh

positions = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]
found = {}
for mode, indices in ((4, [0, 1, 2, 1, 3, 2]), (5, [0, 1, 2, 3]), (6, [0, 1, 3, 2])):
    data = b"".join(struct.pack("<3f", *p) for p in positions) + struct.pack(f"<{len(indices)}H", *indices)
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 2 * len(indices)}]
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
        {"bufferView": 1, "componentType": 5123, "count": len(indices), "type": "SCALAR"},
    ]
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    gltf = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": mode}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data), "uri": uri}],
    }
    json.dump(gltf, open("a.gltf", "w"))
    mesh = trimesh.load_mesh("a.gltf")
    found[mode] = (len(mesh.faces), round(float(mesh.area), 6))
if found != {4: (2, 1), 5: (2, 1), 6: (0, 0)}:
    raise SystemExit(f"changed: {found}")
END
