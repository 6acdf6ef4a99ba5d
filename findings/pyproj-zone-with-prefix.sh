#!/bin/sh
# pyproj 3.7.2 (CRS.utm_zone): the zone has words in it.
#
# EPSG:4647 and EPSG:5652 are UTM zone 32N with the zone's number before the easting, as several German states publish it.
# Seen: utm_zone is "32N WITH PREFIX" for both, "32N" for EPSG:25832. int(zone[:-1]), or building a code of it, fails.
# Expected: "32N", or None; the documentation calls it the UTM zone number, like 31N.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check pyproj==3.7.2
venv/bin/python -W ignore - <<'END'
from pyproj import CRS

zones = [CRS(code).utm_zone for code in (25832, 4647, 5652)]
if zones != ["32N", "32N WITH PREFIX", "32N WITH PREFIX"]:
    raise SystemExit(f"changed: {zones}")
END
