#!/usr/bin/env bash
# Builds a wheel, into dist/, that brings kernels compiled for common processors: the first `localize` of who installs
# it compiles nothing. They serve the Python, the numba and the code they were made with; others compile as before.
# Levels that this machine does not have are left out, as what is compiled is run. A few minutes of one core.
# Usage, in a checkout: recipes/wheel.sh [PYTHON], the one of an environment with this checkout.
set -euo pipefail
python=${1:-.venv/bin/python}
into=lodbench/kernels/compiled
scratch=$(mktemp -d)
trap 'rm -rf "$scratch" "$into" "build/lib/$into"' EXIT # setuptools would put it into the next wheel as well
rm -rf "$into"
levels=$("$python" -c "
from llvmlite.binding import get_host_cpu_features
from lodbench.kernels.compiled import LEVELS
has = {name for name, is_there in get_host_cpu_features().items() if is_there}
print(*(level for level, needs in LEVELS.items() if needs <= has))")
for level in $levels; do
    export NUMBA_CPU_NAME=$level NUMBA_CPU_FEATURES= NUMBA_CACHE_DIR=$scratch/$level
    "$python" -m lodbench run --multirun dataset=demo limit=1 tilt=prior \
        method=region,contour_alignment,lodlocv2 paths.runs="$scratch/runs-$level"
    mkdir -p "$scratch/compiled/$level"
    find "$NUMBA_CACHE_DIR" -path '*/kernels_*' -name '*.nb[ic]' -exec cp -t "$scratch/compiled/$level" {} +
    (cd "$scratch/compiled/$level" && sha256sum -- *.nb[ic] | tr -d '*' >../digests && mv ../digests digests.txt)
done
mv "$scratch/compiled" "$into" # only now: while there are some, they are used
"$python" -m pip wheel --quiet --no-deps --wheel-dir dist .
