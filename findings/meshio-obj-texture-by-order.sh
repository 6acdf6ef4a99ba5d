#!/bin/sh
# meshio 5.3.5 (OBJ): the n-th texture coordinate is given to the n-th vertex, whatever the faces say.
#
# Seen: a triangle "f 1/3 2/2 3/1" comes back with the coordinates of its first and last corner exchanged, without a warning; with as
# many "vt" as "v" lines nothing is noticed. With fewer or more (a seam, a shared corner: the usual case) reading ends in a ValueError.
# Expected: vertex v of a face "v/vt" has the coordinate vt that the face names, as the format says.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check meshio==5.3.5 numpy==2.2.6
cat > exchanged.obj <<'END'
v 0 0 0
v 1 0 0
v 1 1 0
vt 0.1 0
vt 0.2 0
vt 0.3 0
f 1/3 2/2 3/1
END
cat > shared.obj <<'END'
v 0 0 0
v 1 0 0
v 1 1 0
vt 0.1 0
vt 0.2 0
f 1/1 2/2 3/1
END
venv/bin/python - <<'END'
import meshio

u = meshio.read("exchanged.obj").point_data["obj:vt"][:, 0].tolist()
if u != [0.1, 0.2, 0.3]:
    raise SystemExit(f"changed: vertices 1 to 3 have {u}; the face says 0.3, 0.2, 0.1")
try:
    meshio.read("shared.obj")
except ValueError as error:
    if "obj:vt" not in str(error):
        raise SystemExit(f"changed: {error}")
else:
    raise SystemExit("changed: two texture coordinates for three vertices are read")
END
