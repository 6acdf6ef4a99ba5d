"""Mutated files for every reader, over all cores: ``python -m tests.fuzz [COUNT] [SEED]``.

Half of the files are cities, half of all other kinds; some are well-formed trees of the wrong shape. A seed
is drawn and printed; with it the same files come again. What raises anything but a ``LodbenchError``, dies,
does not end or takes more memory than a small file is worth is a failure, told with the number of its file.
"""

import faulthandler
import os
import resource
import secrets
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterable, Iterator
from multiprocessing import get_context
from pathlib import Path
from typing import IO, Any

from tests import fuzz_readers, fuzz_trees
from tests.citymodel import test_fuzz as cities

# The files have some kilobytes, the largest 2 MB: what takes longer has found a loop, what takes more a bomb.
LIMIT_S = 60
LIMIT_BYTES = 3 << 30
SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def _watched(numbers: range, at: Any, said: IO[str]) -> Iterator[int]:
    """Yields numbers, says which one is at work, and ends the process where one does not end."""
    for number in numbers:
        at.value = number
        faulthandler.dump_traceback_later(LIMIT_S, exit=True, file=said)
        yield number
    faulthandler.cancel_dump_traceback_later()


def _try_cities(numbers: Iterable[int], seed: int) -> tuple[int, int]:
    return cities.fuzz(numbers, cities.seeds(SHARED_DATA if SHARED_DATA.is_dir() else None), seed)


def _try_sidecars(numbers: Iterable[int], seed: int) -> tuple[int, int]:
    with tempfile.TemporaryDirectory() as scratch:
        return cities.fuzz_sidecars(numbers, Path(scratch), seed)


def _try_others(numbers: Iterable[int], seed: int) -> tuple[int, int]:
    seen = fuzz_readers.fuzz(numbers, seed)
    return seen["read"], seen["refused"]


def _try_trees(numbers: Iterable[int], seed: int) -> tuple[int, int]:
    seen = fuzz_trees.fuzz(numbers, seed)
    return seen["read"], seen["refused"]


KINDS = {
    "cities": _try_cities,
    "sidecars of Shapefiles": _try_sidecars,
    "trees": _try_trees,
    "all other files": _try_others,
}


def _try_share(kind: str, numbers: range, seed: int, at: Any, counts: Any) -> None:
    """Tries some files of a kind; leaves how many were read and refused, and the most memory taken."""
    warnings.simplefilter("ignore")
    # Readers of pictures in C++ talk on standard error for themselves; the tracebacks go to where it was.
    said = os.fdopen(os.dup(2), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    try:
        read, refused = KINDS[kind](_watched(numbers, at, said), seed)
    except BaseException:
        traceback.print_exc(file=said)
        said.flush()
        os._exit(1)
    counts[:] = read, refused, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def fuzz(kind: str, count: int, seed: int) -> bool:
    """Tries files of a kind on all cores and prints the counts; tells whether all was well."""
    started, cores = time.monotonic(), os.cpu_count() or 1
    context = get_context("spawn")
    shares = []
    for first in range(cores):
        at, counts = context.Value("q", -1), context.Array("q", 3)
        numbers = range(first, count, cores)
        process = context.Process(target=_try_share, args=(kind, numbers, seed, at, counts))
        process.start()
        shares.append((process, at, counts))
    is_well = True
    for process, at, counts in shares:
        process.join()
        if process.exitcode or counts[2] > LIMIT_BYTES:
            is_well = False
            words = f"ended with {process.exitcode}" if process.exitcode else f"took {counts[2] / 1e9:.1f} GB"
            sys.stdout.write(f"{kind}: FAILED: seed {seed}, number {at.value}: {words}\n")
    read, refused, most_bytes = (
        f([counts[k] for *_, counts in shares]) for k, f in enumerate((sum, sum, max))
    )
    words = f"{read + refused} files, seed {seed}: {read} read, {refused} refused"
    sys.stdout.write(
        f"{kind}: {words}, at most {most_bytes / 1e6:.0f} MB ({time.monotonic() - started:.0f} s)\n"
    )
    sys.stdout.flush()
    return is_well


if __name__ == "__main__":
    COUNT = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
    SEED = int(sys.argv[2]) if len(sys.argv) > 2 else secrets.randbelow(1 << 31)
    FEW = COUNT // 100
    PARTS = dict(zip(KINDS, (COUNT // 2 - FEW, FEW, 3 * FEW, COUNT // 2 - 3 * FEW), strict=True))
    sys.exit(not all([fuzz(kind, part, SEED) for kind, part in PARTS.items()]))
