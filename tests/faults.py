"""A disk that fails or dies at its n-th operation, under whole commands, which are then given again.

`python -m tests.faults` tries every n of every command and prints the counts; the tests try a slice.
"""

from __future__ import annotations

import contextlib
import errno
import io
import itertools
import os
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from lodbench.cli import main
from lodbench.storage.disk import Disk, another_disk
from tests.town import write_dataset

KINDS = ("kill", "full", "failing", "short")
# What differs from one undisturbed run to the next: times, and the answers with theirs.
TIMED = {"timings.csv", "provenance.json", "predictions.jsonl"}


class FaultyDisk(Disk):
    """Does as the disk does until its n-th operation."""

    def __init__(self, place: int, kind: str) -> None:
        self.place, self.kind, self.done = place, kind, 0

    def _reaches(self, path: Path) -> bool:
        self.done += 1
        if self.done != self.place:
            return False
        if self.kind == "kill":
            os._exit(137)
        if self.kind != "short":
            code = errno.ENOSPC if self.kind == "full" else errno.EIO
            raise OSError(code, os.strerror(code), str(path))
        return True

    def write(self, stream, content, path):
        if self._reaches(path):
            super().write(stream, memoryview(content).cast("B")[: len(content) // 2], path)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        super().write(stream, content, path)

    def sync(self, stream, path):
        self._reaches(path)
        super().sync(stream, path)

    def sync_folder(self, folder):
        self._reaches(folder)
        super().sync_folder(folder)

    def rename(self, source, target):
        self._reaches(target)
        super().rename(source, target)

    def swap(self, one, other):
        self._reaches(other)
        return super().swap(one, other)

    def make_folder(self, folder):
        self._reaches(folder)
        super().make_folder(folder)

    def remove(self, path):
        self._reaches(path)
        super().remove(path)


@dataclass(frozen=True)
class Command:
    """A command under test: its words, given in a folder that `before` has filled."""

    name: str
    words: Callable[[Path], list[str]]
    before: Callable[[Path], None] = lambda folder: None


def _data(folder: Path) -> list[str]:
    town = folder / "town"
    words = [f"dataset.root={town / 'data'}", f"dataset.city_model={town / 'city.obj'}"]
    return ["dataset=folder", *words, f"paths.runs={folder / 'runs'}"]


def _run(folder: Path) -> list[str]:
    return ["run", *_data(folder), "method=prior_only", "segmenter=masks"]


def _evaluate(folder: Path) -> list[str]:
    return ["evaluate", *_data(folder), f"poses={folder / 'town/data/GPS_pose.txt'}"]


def _convert(folder: Path) -> list[str]:
    return ["city", "convert", str(folder / "town/city.obj"), str(folder / "town.scene")]


def _once(words: Callable[[Path], list[str]]) -> Callable[[Path], None]:
    return lambda folder: quietly(words(folder))[1] and None


COMMANDS = [
    Command("run", _run),
    Command("evaluate", _evaluate),
    Command("city convert", _convert),
    Command("city convert, over a scene", _convert, _once(_convert)),
]


def quietly(words: list[str]) -> tuple[int, str]:
    """Runs a command; returns its exit code and what it wrote to standard error."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(words)
    return code, err.getvalue()


def contents(folder: Path) -> dict[str, bytes]:
    """Returns every file below a folder that is the same from run to run."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in TIMED)
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def apart(work: Callable[[], int]) -> int:
    """Returns the exit code of work done in a fork of this process."""
    child = os.fork()
    if child == 0:
        code = 99
        with contextlib.suppress(BaseException):
            code = work()
        os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def disturbed(command: Command, town: Path, places: Iterator[int]) -> Iterator[tuple[str, int]]:
    """Yields kind and place of every fault tried: the command ends as it should, and then goes right.

    Every command runs in a fork of this process, which has computed nothing and so has no threads.
    """
    with tempfile.TemporaryDirectory() as scratch:
        # The same path each time: results name it.
        folder = Path(scratch) / "work"

        def fresh() -> None:
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(town, folder / "town")
            assert apart(lambda: (command.before(folder), 0)[1]) == 0

        fresh()
        assert apart(lambda: quietly(command.words(folder))[0]) == 0
        expected = contents(folder)
        for place in places:
            for kind in KINDS:
                fresh()

                def faulty(kind: str = kind, place: int = place) -> int:
                    disk = FaultyDisk(place, kind)
                    with another_disk(disk):
                        code, said = quietly(command.words(folder))
                    if disk.done < place:
                        return 77
                    is_clear = code == 0 or (
                        code == 2 and said.startswith("lodbench: ") and said.count("\n") <= 2
                    )
                    return 0 if is_clear else 78

                code = apart(faulty)
                if code == 77:
                    return
                assert code == (137 if kind == "kill" else 0), (command.name, kind, place, code)
                assert apart(lambda: quietly(command.words(folder))[0]) == 0, (command.name, kind, place)
                found = contents(folder)
                assert found == expected, (command.name, kind, place, sorted(set(found) ^ set(expected)))
                yield kind, place


def try_all(step: int) -> None:
    """Prints, for each command, how many faults of each kind it survived; every `step`-th place is tried."""
    total = 0
    with tempfile.TemporaryDirectory() as scratch:
        os.environ["LODBENCH_CACHE"] = str(Path(scratch) / "cache")
        assert apart(lambda: bool(write_dataset(Path(scratch) / "town", 2)) - 1) == 0
        for command in COMMANDS:
            tried = Counter(
                kind for kind, _ in disturbed(command, Path(scratch) / "town", itertools.count(1, step))
            )
            total += tried.total()
            sys.stdout.write(f"{command.name}: {dict(tried)}: nothing lost\n")
            sys.stdout.flush()
    sys.stdout.write(f"{total} faults, none that lost or changed anything\n")


if __name__ == "__main__":
    try_all(int(sys.argv[1]) if len(sys.argv) > 1 else 1)
