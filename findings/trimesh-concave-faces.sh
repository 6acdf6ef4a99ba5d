#!/bin/sh
# trimesh 5.2.0 (load_mesh; OBJ, PLY, OFF): a concave face is cut into a fan, which covers more than the face.
#
# Faces of more than four corners are allowed in all three formats; roofs of city models have them.
# Seen: an arrow of 60 m2, (0, 0) (10, 0) (10, 10) (5, 2) (0, 10), has an area of 90 m2; the same face with its corners counted
# from the third on has 140 m2. Triangles overlap each other and cover ground outside of the face. No warning.
# Expected: 60 m2, whichever corner comes first, as of polygons of its path module, or a note that the face is not convex.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check trimesh==5.2.0 numpy==2.4.6
venv/bin/python -W ignore - <<'END'
import trimesh

corners = [(0, 0), (10, 0), (10, 10), (5, 2), (0, 10)]
lines = "".join(f"{x} {y} 0\n" for x, y in corners)
open("a.obj", "w").write("".join(f"v {x} {y} 0\n" for x, y in corners) + "f 1 2 3 4 5\n")
open("b.obj", "w").write("".join(f"v {x} {y} 0\n" for x, y in corners) + "f 3 4 5 1 2\n")
open("a.off", "w").write("OFF\n5 1 0\n" + lines + "5 0 1 2 3 4\n")
properties = "".join(f"property double {axis}\n" for axis in "xyz")
header = f"ply\nformat ascii 1.0\nelement vertex 5\n{properties}element face 1\nproperty list uchar int vertex_indices\nend_header\n"
open("a.ply", "w").write(header + lines + "5 0 1 2 3 4\n")
areas = {name: round(float(trimesh.load_mesh(name).area), 6) for name in ("a.obj", "b.obj", "a.off", "a.ply")}
if areas != {"a.obj": 90, "b.obj": 140, "a.off": 90, "a.ply": 90}:
    raise SystemExit(f"changed: {areas}")
END
