"""Through how many files a city's opening and a photo's localisation run: whose functions are called."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass

from experiments.command import run
from lodbench.bench import Figure, Progress, Report, no_progress
from lodbench.errors import LodbenchError
from lodbench.params import flag
from lodbench.reporting.aligned_text import format_columns
from lodbench.synthesis.demo import DemoParams, open_demo

# Prints how many files have functions that are called, and how many are loaded.
_TRACE = """
import json, sys, threading
called = set()
def note(frame, event, argument):
    if event == "call" and frame.f_code.co_flags & 1 and frame.f_code.co_name != "<module>":
        called.add(frame.f_code.co_filename)
words = json.loads(sys.argv[1])
import lodbench
from lodbench.cli import main
threading.setprofile(note)
sys.setprofile(note)
lodbench.open_scene(words[0]) if len(words) == 1 else main(words)
sys.setprofile(None)
loaded = [m.__file__ for m in list(sys.modules.values()) if getattr(m, "__name__", "").startswith("lodbench")]
home = lodbench.__file__.removesuffix("__init__.py")
print("\\n" + json.dumps([len([f for f in files if f and f.startswith(home)]) for files in (called, loaded)]))
"""


@dataclass(frozen=True, slots=True)
class FilesRunOptions:
    """What is opened."""

    city: str | None = flag(None, "city model (the demo town)", metavar="FILE")


def measure_files(options: FilesRunOptions | None = None, progress: Progress = no_progress) -> Report:
    """Returns the numbers of files, of a city and of a photo of the demo."""
    options = options or FilesRunOptions()
    demo = open_demo(DemoParams())
    split = demo.root / "in_place"
    photo = sorted((split / "Query_image").iterdir())[0]
    camera = (split / "intrinsic.txt").read_text().splitlines()[0].split(maxsplit=1)[1]
    with tempfile.TemporaryDirectory() as out:
        words = ["localize", str(photo), "--city", str(demo.city_model), "--camera", camera]
        words += ["--start", str(split / "GPS_pose.txt"), "--out", out]
        ways = {"open_scene": [options.city or str(demo.city_model)], "localize PHOTO": words}
        rows, figures = [["what", "files run", "files loaded"]], list[Figure]()
        for number, (what, given) in enumerate(ways.items()):
            called, loaded = _traced(given)
            rows.append([what, str(called), str(loaded)])
            figures.append(Figure(f"{what}: files whose functions are called", called, ""))
            progress(number + 1, len(ways))
    return Report(format_columns(rows), figures)


def _traced(words: list[str]) -> tuple[int, int]:
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", _TRACE, json.dumps(words)], capture_output=True, text=True
    )
    if done.returncode:
        raise LodbenchError((done.stderr.strip().splitlines() or ["no message"])[-1])
    called, loaded = json.loads(done.stdout.splitlines()[-1])
    return called, loaded


sys.exit(run("files_run", FilesRunOptions, measure_files))
