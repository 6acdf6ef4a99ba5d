#!/bin/sh
# Hydra 1.3.8 with OmegaConf 2.3.1: a value means one thing in a file and another on the command line.
#
# Seen, "a: VALUE" in a YAML file that OmegaConf loads, against a=VALUE given to Hydra:
#   010    8       '010'        1:30  90      '1:30'      0x10  16    '0x10'
#   yes    True    'yes'        off   False   'off'
#   -.5    '-.5'   -0.5         nan   'nan'   nan         .inf  inf   '.inf'
# So moving a setting from a file to the command line changes tiles' names, times and limits.
# Expected: the same value from both, or an error in one.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check hydra-core==1.3.8 omegaconf==2.3.1
venv/bin/python -W ignore - <<'END'
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

parser = OverridesParser.create()
stated = {
    "010": "8 '010'",
    "1:30": "90 '1:30'",
    "0x10": "16 '0x10'",
    "yes": "True 'yes'",
    "off": "False 'off'",
    "-.5": "'-.5' -0.5",
    "nan": "'nan' nan",
    ".inf": "inf '.inf'",
}
for words, both in stated.items():
    seen = f"{OmegaConf.create(f'a: {words}').a!r} {parser.parse_override(f'a={words}').value()!r}"
    if seen != both:
        raise SystemExit(f"changed: {words}: {seen}")
END
