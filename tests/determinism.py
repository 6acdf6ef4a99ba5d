"""The demo, made and run under other hash seeds, threads, workers, locales, time zones and chunk sizes.

`python -m tests.determinism` compares every byte of the town and of what the runs leave, but for times and
machine facts, with those of an undisturbed run; `python -m tests.determinism NAME ...` takes some variations.
Libraries that take other instructions on another kind of CPU round sums otherwise: such variations have a
tolerance of poses, and are told by how many differ.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lodbench.datasets.pose_text import read_poses
from lodbench.evaluation.pose_errors import pose_error

METHODS = "lodlocv2,contour_alignment,region"
# Times and machine facts stand apart from results: docs/evaluation.md.
APART = {"timings.csv", "provenance.json", "predictions.jsonl", "multirun.yaml"}
DRIVER = """
import json, sys
from importlib import import_module
for name, value in json.loads(sys.argv[1]).items():
    module, _, attribute = name.rpartition(".")
    assert hasattr(import_module(module), attribute), name
    setattr(import_module(module), attribute, value)
from lodbench.cli import main
sys.exit(main(sys.argv[2:]))
"""


@dataclass(frozen=True)
class Variation:
    """What is different, and must make no difference."""

    environment: dict[str, str] = field(default_factory=dict)
    words: tuple[str, ...] = ()
    constants: dict[str, int] = field(default_factory=dict)
    is_other_cpu: bool = False


# The share of poses that may end further apart than so, where two searches part on a tie.
SAME_M, SAME_DEG, MAY_PART = 1e-3, 1e-3, 0.05
CHUNKS = {
    "lodbench.rendering.silhouette._MOST_GROUPS": 1,
    "lodbench.citymodel.triangulate.CHUNK_POLYGONS": 77,
    "lodbench.citymodel.read.CHUNK_POLYGONS": 77,
    "lodbench.citymodel.cleaning._CHUNK_POINTS": 1001,
    "lodbench.citymodel.frame._CHUNK_POINTS": 1001,
    "lodbench.citymodel.scene._CHUNK_TRIANGLES": 999,
    "lodbench.rendering.silhouette._CHUNK_TRIANGLES": 999,
}
LIBRARY_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
VARIATIONS = {
    "hash seed": Variation({"PYTHONHASHSEED": "4711"}),
    "one thread": Variation(dict.fromkeys(LIBRARY_THREADS, "1"), ("executor.threads=1",)),
    "five threads": Variation(dict.fromkeys(LIBRARY_THREADS, "5"), ("executor.threads=5",)),
    "two processes": Variation(words=("executor=process", "executor.workers=2")),
    "three processes of two threads": Variation(
        words=("executor=process", "executor.workers=3", "executor.threads=2")
    ),
    "dask": Variation(words=("executor=dask", "executor.workers=2")),
    "locale and time zone": Variation(
        {"LC_ALL": "tr_TR.UTF-8", "LANG": "de_DE.UTF-8", "TZ": "Pacific/Chatham", "PYTHONUTF8": "0"}
    ),
    "C locale, optimised": Variation({"LC_ALL": "C", "TZ": "America/St_Johns", "PYTHONOPTIMIZE": "1"}),
    "chunk sizes": Variation(constants=CHUNKS),
    # Every library that chooses its instructions at run time, and the compiler, told of a CPU of 2013.
    "a CPU without AVX-512": Variation(
        {
            "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
            "OPENBLAS_CORETYPE": "Haswell",
            "NUMBA_CPU_NAME": "haswell",
            "OPENCV_CPU_DISABLE": "AVX512_SKX,AVX512_COMMON,AVX512_CLX,AVX512_ICL",
        },
        is_other_cpu=True,
    ),
    "all at once": Variation(
        {"PYTHONHASHSEED": "1", "LC_ALL": "C", "TZ": "Asia/Kathmandu", **dict.fromkeys(LIBRARY_THREADS, "3")},
        ("executor=process", "executor.workers=2", "executor.threads=3"),
        CHUNKS,
    ),
}


def bytes_of(variation: Variation, folder: Path, methods: str = METHODS) -> dict[str, bytes]:
    """Returns every file of the demo, made anew, and of the runs of some methods on it."""
    cache, runs = folder / "cache", folder / "runs"
    environment = {**os.environ, "LODBENCH_CACHE": str(cache), **variation.environment}
    words = ["run", "--multirun", f"method={methods}", "dataset=demo", "dataset.num_queries=2", "tilt=prior"]
    words += [f"paths.runs={runs}", *variation.words]
    command = [sys.executable, "-c", DRIVER, json.dumps(variation.constants), *words]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=folder)
    assert done.returncode in (0, 1), done.stderr  # 1: no query was answered
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in APART]
    kept = [path for path in files if "demo" in path.parts or "runs" in path.parts]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in kept}


def differing(found: dict[str, bytes], expected: dict[str, bytes]) -> list[str]:
    """Returns the files that are not the same."""
    return [name for name in sorted(set(found) | set(expected)) if found.get(name) != expected.get(name)]


def parted(found: dict[str, bytes], expected: dict[str, bytes], folder: Path) -> tuple[int, int, float]:
    """Returns how many poses there are, how many ended elsewhere, and how far the others are off, metres."""
    total, apart, furthest_m = 0, 0, 0.0
    for name in sorted(name for name in expected if name.endswith("/poses.txt") and name.startswith("runs/")):
        both = []
        for content in (found[name], expected[name]):
            (folder / "poses.txt").write_bytes(content)
            both.append(read_poses(folder / "poses.txt"))
        assert both[0].keys() == both[1].keys()
        for key, pose in both[0].items():
            error = pose_error(pose, both[1][key])
            is_apart = error.translation_m > SAME_M or error.rotation_deg > SAME_DEG
            total, apart = total + 1, apart + is_apart
            furthest_m = furthest_m if is_apart else max(furthest_m, error.translation_m)
    return total, apart, furthest_m


def compare(names: Sequence[str], methods: str = METHODS) -> int:
    """Prints what each variation changes; returns how many change anything."""
    faults = 0
    with tempfile.TemporaryDirectory() as scratch:
        # Paths are no part of results, so each has a folder of its own.
        (Path(scratch) / "plain").mkdir()
        expected = bytes_of(Variation(), Path(scratch) / "plain", methods)
        assert len(expected) > 20
        for name in names:
            folder = Path(scratch) / name.replace(" ", "_")
            folder.mkdir()
            started = time.monotonic()
            files = bytes_of(VARIATIONS[name], folder, methods)
            found = differing(files, expected)
            is_fault = bool(found)
            words = f"OTHER BYTES in {found}" if found else f"the same bytes of {len(expected)} files"
            if VARIATIONS[name].is_other_cpu:
                total, apart, furthest_m = parted(files, expected, folder)
                is_fault = apart > MAY_PART * total
                words = f"{apart} of {total} poses elsewhere, the others within {furthest_m * 1e6:.3g} um; "
                words += f"other bytes in {len(found)} of {len(expected)} files"
            faults += is_fault
            sys.stdout.write(f"{name}: {words} ({time.monotonic() - started:.0f} s)\n")
            sys.stdout.flush()
    sys.stdout.write(f"{len(names)} variations, {faults} changed something\n")
    return faults


if __name__ == "__main__":
    sys.exit(min(1, compare(sys.argv[1:] or list(VARIATIONS))))
