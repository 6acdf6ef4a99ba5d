#!/bin/sh
# citysmith 0.2.0 (lod): the derived footprint of a building round a courtyard has no courtyard.
#
# Seen: the ground surface is 10 x 10 m with a hole of 4 x 4 m (84 m2); "lod --levels 0" writes an lod0FootPrint of one ring
# without an interior (100 m2). Exit code 0, "LOD0 added/skipped: 1/0".
# Expected: the ring with its interior: 84 m2.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check citysmith==0.2.0 lxml==6.1.3
venv/bin/python -W ignore - <<'END'
import re, subprocess

def ring(points):
    return "<gml:LinearRing><gml:posList>" + " ".join(f"{x} {y} {z}" for x, y, z in [*points, points[0]]) + "</gml:posList></gml:LinearRing>"

def surface(kind, name, outer, inner=None):
    hole = f"<gml:interior>{ring(inner)}</gml:interior>" if inner else ""
    polygon = f'<gml:Polygon gml:id="p{name}"><gml:exterior>{ring(outer)}</gml:exterior>{hole}</gml:Polygon>'
    many = f"<gml:MultiSurface><gml:surfaceMember>{polygon}</gml:surfaceMember></gml:MultiSurface>"
    return f'<bldg:boundedBy><bldg:{kind} gml:id="{name}"><bldg:lod2MultiSurface>{many}</bldg:lod2MultiSurface></bldg:{kind}></bldg:boundedBy>'

def square(low, high, z):
    return [(low, low, z), (high, low, z), (high, high, z), (low, high, z)]

def walls(low, high, name, is_inner):
    a, b = square(low, high, 0), square(low, high, 8)
    sides = [[a[i], a[(i + 1) % 4], b[(i + 1) % 4], b[i]] for i in range(4)]
    return "".join(surface("WallSurface", f"{name}{i}", s[::-1] if is_inner else s) for i, s in enumerate(sides))

parts = surface("GroundSurface", "g", square(0, 10, 0)[::-1], square(3, 7, 0)) + surface("RoofSurface", "r", square(0, 10, 8), square(3, 7, 8)[::-1])
parts += walls(0, 10, "o", False) + walls(3, 7, "i", True)
names = 'xmlns="http://www.opengis.net/citygml/2.0" xmlns:bldg="http://www.opengis.net/citygml/building/2.0" xmlns:gml="http://www.opengis.net/gml"'
open("a.gml", "w").write(f'<CityModel {names}><cityObjectMember><bldg:Building gml:id="b">{parts}</bldg:Building></cityObjectMember></CityModel>')
code = subprocess.run(["venv/bin/citysmith", "lod", "a.gml", "--levels", "0", "-o", "b.gml"], stdout=subprocess.DEVNULL).returncode
found = re.findall(r"<bldg:lod0FootPrint>.*?</bldg:lod0FootPrint>", open("b.gml").read(), re.S)
numbers = [float(word) for text in re.findall(r"posList[^>]*>([^<]*)<", found[0]) for word in text.split()] if found else []
points = [numbers[i : i + 2] for i in range(0, len(numbers), 3)]
area = abs(sum(p[0] * q[1] - q[0] * p[1] for p, q in zip(points, points[1:]))) / 2
if code or len(found) != 1 or "interior" in found[0] or area != 100:
    raise SystemExit(f"changed: exit code {code}, {len(found)} footprints, area {area}")
END
