"""What opening a stored scene takes: `python -m experiments.scale.opening FOLDER` does it and says.

Memory is what the process holds when the scene is open, mapped pages that were read included.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from lodbench.bench.throughput import resident_mb
from lodbench.citymodel.scene_file import read_scene
from lodbench.errors import LodbenchError
from lodbench.rendering.silhouette import SilhouetteRenderer


@dataclass(frozen=True, slots=True)
class Opening:
    """What it took to open a scene and its engine.

    Attributes:
        seconds: From the folder's name to an engine that can score.
        cpu_s: The same by the processor's clock, which a busy machine does not slow.
        resident_mb: Memory the process holds then, megabytes; None where the system does not tell.
        before_mb: The same before: Python and the libraries.
    """

    seconds: float
    cpu_s: float
    resident_mb: float | None
    before_mb: float | None


def open_apart(folder: Path) -> Opening:
    """Returns what opening a scene takes in a process of its own.

    Raises:
        LodbenchError: The process failed.
    """
    command = [sys.executable, "-m", "experiments.scale.opening", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True)  # noqa: S603
    if done.returncode != 0:
        raise LodbenchError(f"Opening {folder} in a process of its own failed: {done.stderr.strip()[-300:]}")
    return Opening(**json.loads(done.stdout))


def measure_opening(folder: Path) -> Opening:
    """Returns what opening a scene takes in this process."""
    before = resident_mb()
    started, cpu_started = time.perf_counter(), time.process_time()
    # Held until the memory is read.
    engine = SilhouetteRenderer(read_scene(folder)[0], 1)
    seconds, cpu_s = time.perf_counter() - started, time.process_time() - cpu_started
    after = resident_mb()
    del engine
    return Opening(seconds, cpu_s, after, before)


if __name__ == "__main__":
    sys.stdout.write(json.dumps(asdict(measure_opening(Path(sys.argv[1])))))
