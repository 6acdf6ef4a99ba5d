#!/bin/sh
# numba 0.68.1 with NumPy 2.4.6: the same line has other numbers inside of a compiled function.
#
# Since NumPy 2 a Python number takes the type of the array or NumPy number beside it; numba keeps the rules of before.
# Seen: for a uint64 x = 2**63 + 4, "x | 1" is 9223372036854775813 in NumPy and -9223372036854775803 compiled. For a uint64 array,
# "a + 1" is uint64 in NumPy and float64 compiled, where 2**63 + 5 becomes -2**63. For uint8 255, "a + 1" is 0 in NumPy and 256
# compiled. So bit masks that are right in a test without numba are wrong with it.
# Expected: the types of the NumPy that is installed.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check numba==0.68.1 numpy==2.4.6
venv/bin/python -W ignore - <<'END'
import numba
import numpy as np

add, mark = numba.njit(lambda a: a + 1), numba.njit(lambda x: x | 1)
wide, narrow, bits = np.array([2**63 + 5], np.uint64), np.array([255], np.uint8), np.uint64(2**63 + 4)
plain = [int(bits | 1), str((wide + 1).dtype), int((wide + 1)[0]), int((narrow + 1)[0])]
compiled = [int(mark(bits)), str(add(wide).dtype), int(add(wide)[0]), int(add(narrow)[0])]
if plain != [2**63 + 5, "uint64", 2**63 + 6, 0] or compiled != [-(2**63) + 5, "float64", -(2**63), 256]:
    raise SystemExit(f"changed: NumPy {plain}, compiled {compiled}")
END
