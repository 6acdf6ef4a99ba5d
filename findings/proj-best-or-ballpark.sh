#!/bin/sh
# pyproj 3.7.2 with PROJ 9.5.1 (Transformer.from_crs, only_best=True): without the geoid's grid a height passes unchanged.
#
# only_best is documented to raise an error where the best transformation known to PROJ cannot be used.
# Seen, with the grids of the wheel (none) and no network: from EPSG:7415 (RD and NAP heights) and from EPSG:25832+7837 to
# EPSG:4979, 100 m stay 100 m, though ellipsoidal heights there are more than 40 m higher; with only_best=True as without it.
# allow_ballpark=False raises an error, at once.
# Expected: only_best=True raises, as the operation with the grid is the best one, which TransformerGroup says, too.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check pyproj==3.7.2
venv/bin/python -W ignore - <<'END'
import os

os.environ["PROJ_NETWORK"] = "OFF"
from pyproj import Transformer
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup

for system, x, y in (("EPSG:7415", 155000, 463000), ("EPSG:25832+7837", 566783, 5538509)):
    found = [Transformer.from_crs(system, "EPSG:4979", always_xy=True, only_best=best).transform(x, y, 100.0, errcheck=True)[2] for best in (None, True)]
    try:
        Transformer.from_crs(system, "EPSG:4979", always_xy=True, allow_ballpark=False)
        refused = False
    except ProjError:
        refused = True
    is_best = TransformerGroup(system, "EPSG:4979", always_xy=True).best_available
    if (found, refused, is_best) != ([100.0, 100.0], True, False):
        raise SystemExit(f"changed: {system}: {found}, refused {refused}, best available {is_best}")
END
