#!/bin/sh
# pycolmap 4.2.1 (GPSTransform.ellipsoid_to_utm): two positions 221 m apart on both sides of the equator come out 10,000 km apart.
#
# All positions get one zone, the first one's, but each its own false northing of the south, and the returned zone does not say
# of which hemisphere: 32 for both.
# Seen: latitudes 0.001 and -0.001 at longitude 9 give northings 110.53 and 9999889.47, zone 32.
# Expected: one false northing for all, as there is one zone for all (110.53 and -110.53), and the hemisphere beside the zone.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check pycolmap==4.2.1 numpy==2.4.6
venv/bin/python -W ignore - <<'END'
import numpy as np
import pycolmap

found, zone = pycolmap.GPSTransform().ellipsoid_to_utm(np.array([[0.001, 9.0, 0.0], [-0.001, 9.0, 0.0]]))
if (found[:, 1].round(2).tolist(), zone) != ([110.53, 9999889.47], 32):
    raise SystemExit(f"changed: {found[:, 1]}, zone {zone}")
END
