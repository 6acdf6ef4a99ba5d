#!/bin/sh
# pyproj 3.7.2 (CRS): two systems that are equal, one with an area of use and one without.
#
# "EPSG:25832+5783" and "EPSG:5555" are both ETRS89 / UTM zone 32N with DHHN92 heights.
# Seen: they compare equal, and to_epsg() of the first is 5555; but area_of_use of the first is None and that of the second is
# Germany's. Likewise "EPSG:28992+5709" and "EPSG:7415". Each of the two parts has an area, too.
# Expected: the area of the system that to_epsg() names, or of the part in the plane.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check pyproj==3.7.2
venv/bin/python -W ignore - <<'END'
from pyproj import CRS

for words, code in (("EPSG:25832+5783", 5555), ("EPSG:28992+5709", 7415)):
    one, other = CRS(words), CRS(code)
    seen = (one == other, one.to_epsg(), one.area_of_use, other.area_of_use is None, [part.area_of_use is None for part in one.sub_crs_list])
    if seen != (True, code, None, False, [False, False]):
        raise SystemExit(f"changed: {words}: {seen}")
END
