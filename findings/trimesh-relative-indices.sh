#!/bin/sh
# trimesh 5.2.0 (load_mesh, OBJ): negative indices count from the file's end, not from the face's line.
#
# In OBJ, -1 is the last vertex before the line that names it; programs that write one object after the other use it.
# Seen: three vertices at x = 0 to 1 and "f -3 -2 -1", then three at x = 5 to 6 and "f -3 -2 -1": both faces are the second
# triangle (bounds in x: 5 to 6); the first is lost. No warning.
# Expected: two triangles, bounds in x from 0 to 6.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check trimesh==5.2.0 numpy==2.4.6
venv/bin/python -W ignore - <<'END'
import trimesh

first = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
second = "v 5 0 0\nv 6 0 0\nv 5 1 0\n"
found = {}
for name, one, other in (("positive", "f 1 2 3\n", "f 4 5 6\n"), ("negative", "f -3 -2 -1\n", "f -3 -2 -1\n")):
    open("a.obj", "w").write(first + one + second + other)
    found[name] = trimesh.load_mesh("a.obj").bounds[:, 0].tolist()
if found != {"positive": [0, 6], "negative": [5, 6]}:
    raise SystemExit(f"changed: {found}")
END
