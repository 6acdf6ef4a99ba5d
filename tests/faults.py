"""A disk that fails or dies at its n-th operation, under whole commands, which are then given again.

`python -m tests.faults` tries every n of every command, in as many processes as there are cores, and
prints the counts; the tests try a slice.
"""

import contextlib
import copy
import errno
import faulthandler
import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path

import cv2
from hydra._internal.config_loader_impl import ConfigLoaderImpl

from lodbench.cli import main
from lodbench.storage.disk import Disk, _swept, another_disk
from tests.fault_commands import COMMANDS, Command, prepare_inputs

MEMORY = Path("/dev/shm")  # noqa: S108
KINDS = ("kill", "full", "failing", "short")
# Exit codes of a fork that tells how a disturbed command ended.
KILLED, AS_IT_SHOULD, DONE, NOT_REACHED, UNCLEAR = 137, 0, 76, 77, 78


class FaultyDisk(Disk):
    """Does as the disk does until its n-th operation; without a place it only counts.

    Attributes:
        done: Names of the operations so far.
    """

    def __init__(self, place: int = -1, kind: str = "") -> None:
        self.place, self.kind, self.done = place, kind, list[str]()

    def _reaches(self, path: Path, name: str) -> bool:
        self.done.append(name)
        if len(self.done) != self.place:
            return False
        if self.kind == "kill":
            os._exit(KILLED)
        if self.kind != "short":
            code = errno.ENOSPC if self.kind == "full" else errno.EIO
            raise OSError(code, os.strerror(code), str(path))
        return True

    def write(self, stream, content, path):
        if self._reaches(path, "write"):
            super().write(stream, memoryview(content).cast("B")[: len(content) // 2], path)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        super().write(stream, content, path)

    def sync(self, stream, path):
        self._reaches(path, "sync")
        super().sync(stream, path)

    def sync_folder(self, folder):
        self._reaches(folder, "sync_folder")
        super().sync_folder(folder)

    def rename(self, source, target):
        self._reaches(target, "rename")
        super().rename(source, target)

    def swap(self, one, other):
        self._reaches(other, "swap")
        return super().swap(one, other)

    def make_folder(self, folder):
        self._reaches(folder, "make_folder")
        super().make_folder(folder)

    def remove(self, path):
        self._reaches(path, "remove")
        super().remove(path)


def quietly(words: Sequence[str]) -> tuple[int, str]:
    """Runs a command; returns its exit code and what it wrote to standard error."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except SystemExit as leaving:
            code = leaving.code if isinstance(leaving.code, int) else 1
    return code, err.getvalue()


# A fork has none of its parent's threads, and may wait for what they held: there are to be none, of OpenBLAS,
# of OpenMP, of Arrow's allocator, and of OpenCV.
NO_THREADS = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "JE_ARROW_MALLOC_CONF": "background_thread:false",
}
# A fork that waits for ever all the same ends, and says where.
_TIMEOUT_S = 300


def apart(work: Callable[[], int]) -> int:
    """Returns the exit code of work done in a fork of this process, which has no threads."""
    child = os.fork()
    if child == 0:
        faulthandler.dump_traceback_later(_TIMEOUT_S, exit=True, file=2)
        code = 99
        try:
            code = work()
        except BaseException as error:
            os.write(2, f"{type(error).__name__}: {error}\n".encode())
        os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


class Stage:
    """A folder that every trial of a command finds as the first did; results name its path.

    Args:
        command: The command under test.
        scratch: Where the folder is made.
        inputs: The town, and what else commands start from.
    """

    def __init__(self, command: Command, scratch: Path, inputs: Path) -> None:
        cv2.setNumThreads(1)
        self.command, self.folder = command, scratch / "work"
        self._inputs = scratch / "inputs"
        os.environ["LODBENCH_CACHE"] = str(self.folder / "cache")
        shutil.rmtree(self._inputs, ignore_errors=True)
        shutil.copytree(inputs, self._inputs)
        self.renew()
        for words in command.before:
            code, said = quietly(words(self.folder))
            assert code == 0, said
        shutil.rmtree(self._inputs)
        shutil.copytree(self.folder, self._inputs)
        for name in command.remembered:
            _remember(name)
        # Twice in this process, so that all is imported and compiled in every fork of it.
        self.operations = self._undisturbed()
        self.expected = self.contents()
        assert self._undisturbed() == self.operations
        assert self.differing() == []

    def renew(self) -> None:
        """Makes the folder as it was before the first trial."""
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(self._inputs, self.folder)

    def contents(self) -> dict[str, bytes]:
        """Returns every file of the folder that is the same from run to run; left-overs too."""
        files = [path for path in sorted(self.folder.rglob("*")) if path.is_file()]
        return {
            path.relative_to(self.folder).as_posix(): self.command.without_times(path)
            for path in files
            if not self.command.is_timed(path)
        }

    def differing(self) -> list[str]:
        """Returns the files that are not those of an undisturbed run."""
        found = self.contents()
        names = sorted(set(found) | set(self.expected))
        return [name for name in names if found.get(name) != self.expected.get(name)]

    def again(self) -> int:
        """Gives the command in the folder as it is; returns the exit code."""
        _swept.clear()
        code, said = quietly(self.command.words(self.folder))
        if code:
            os.write(2, said.encode())
        return code

    def disturbed(self, place: int, kind: str) -> int:
        """Gives the command on a disk that fails; tells whether it ended as it should."""
        disk = FaultyDisk(place, kind)
        _swept.clear()
        with another_disk(disk):
            code, said = quietly(self.command.words(self.folder))
        if len(disk.done) < place:
            return NOT_REACHED
        line = next((line for line in said.splitlines() if line.startswith("lodbench: ")), "")
        is_clear = code == 0 or (code == 2 and bool(line))
        if is_clear and "Traceback" not in said:
            return DONE if code == 0 else AS_IT_SHOULD
        os.write(2, f"exit code {code}\n{said}".encode())
        return UNCLEAR

    def _undisturbed(self) -> list[str]:
        self.renew()
        disk = FaultyDisk()
        _swept.clear()
        with another_disk(disk):
            code, said = quietly(self.command.words(self.folder))
        assert code == 0, (self.command.name, said)
        return disk.done


def _remember(name: str) -> None:
    """Lets a function compute once for what it is told by name: writing is under test, not computing."""
    module, _, function = name.rpartition(".")
    real = getattr(import_module(module), function)
    results: dict[str, object] = {}

    def remembered(*args: object, **named: object) -> object:
        if repr(named) not in results:
            results[repr(named)] = real(*args, **named)
        return results[repr(named)]

    setattr(import_module(module), function, remembered)


def remember_configurations() -> None:
    """Lets this process compose the configuration of a command line once for all its forks, with no disk."""
    compose, home, kept = ConfigLoaderImpl.load_configuration, os.getpid(), dict[str, object]()

    def composed(self: ConfigLoaderImpl, *args: object, **named: object) -> object:
        words = repr((args, named))
        if os.getpid() != home and words in kept:
            return kept.pop(words)
        found = compose(self, *args, **named)
        if os.getpid() == home:
            kept[words] = copy.deepcopy(found)
        return found

    ConfigLoaderImpl.load_configuration = composed


def try_faults(stage: Stage, places: Sequence[int], kinds: Sequence[str] = KINDS) -> Iterator[str]:
    """Yields the kind of every fault tried, once it lost nothing.

    Args:
        stage: The command in its folder.
        places: Numbers of the operations to disturb, from 1.
        kinds: Kinds of faults; half a write only where the operation is one.

    Raises:
        AssertionError: The command did not end as it should, or gives other bytes when given again.
    """
    for place in places:
        for kind in kinds:
            if kind == "short" and stage.operations[place - 1] != "write":
                continue
            where = (stage.command.name, kind, place, stage.operations[place - 1])
            stage.renew()
            code = apart(lambda place=place, kind=kind: stage.disturbed(place, kind))
            assert code in ((KILLED,) if kind == "kill" else (AS_IT_SHOULD, DONE)), (*where, code)
            # What refuses to write over its work may be killed when all of it is there.
            is_over = stage.command.is_once and (code == DONE or not stage.differing())
            assert is_over or apart(stage.again) == 0, where
            # A cache that could not be written is only slower, where the command was done without it.
            is_slower = is_over or code == DONE
            differing = [name for name in stage.differing() if not (is_slower and name.startswith("cache/"))]
            assert not differing, (*where, differing)
            yield kind


def try_all(names: Sequence[str], step: int) -> int:
    """Prints, for each command, how many faults of each kind it survived; returns how many failed."""
    total, faults = 0, 0
    remember_configurations()
    # In memory where there is such a folder: no real disk is under test, and none is waited for.
    with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as scratch:
        inputs = prepare_inputs(Path(scratch) / "town")
        for command in COMMANDS:
            if names and command.name not in names:
                continue
            started, tried = time.monotonic(), Counter[str]()
            try:
                stage = Stage(command, Path(scratch), inputs)
                tried.update(try_faults(stage, range(1, len(stage.operations) + 1, step)))
                words = (
                    f"{len(stage.operations)} operations, {tried.total()} faults {dict(tried)}: nothing lost"
                )
            except AssertionError as error:
                words, faults = f"{dict(tried)}, then FAILED: {error}", faults + 1
            total += tried.total()
            sys.stdout.write(f"{command.name}: {words} ({time.monotonic() - started:.0f} s)\n")
            sys.stdout.flush()
    sys.stdout.write(f"{total} faults survived, {faults} commands failed\n")
    return faults


def try_all_in_parallel(step: int, count: int) -> int:
    """Does as ``try_all`` for every command, in some processes; returns how many commands failed."""
    count = min(count, len(COMMANDS))

    def share(first: int) -> str:
        names = [command.name for command in COMMANDS[first::count]]
        words = [sys.executable, "-m", "tests.faults", str(step), *names]
        with subprocess.Popen(
            words, stdout=subprocess.PIPE, text=True, env=os.environ | NO_THREADS
        ) as process:
            lines = [
                line for line in process.stdout or () if sys.stdout.write(line) and not sys.stdout.flush()
            ]
        return lines[-1] if lines else "0 faults survived, 1 commands failed"

    with ThreadPoolExecutor(count) as pool:
        sums = [re.findall(r"\d+", last) for last in pool.map(share, range(count))]
    total, failed = (sum(map(int, numbers)) for numbers in zip(*sums, strict=True))
    sys.stdout.write(f"in all {total} faults survived, {failed} commands failed\n")
    return failed


if __name__ == "__main__":
    STEP = int(sys.argv[1]) if len(sys.argv) > 1 and sys.argv[1].isdigit() else 1
    NAMES = [word for word in sys.argv[1:] if not word.isdigit()]
    if NAMES and not NO_THREADS.items() <= os.environ.items():
        again = [sys.executable, "-m", "tests.faults", *sys.argv[1:]]
        sys.exit(subprocess.run(again, env=os.environ | NO_THREADS).returncode)
    sys.exit(min(1, try_all(NAMES, STEP) if NAMES else try_all_in_parallel(STEP, os.cpu_count() or 1)))
