"""Where work is done: in this process, over processes, on a Dask cluster, by the same code."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol, TypeVar

from lodbench.errors import ConfigError, LodbenchError, require_choice, require_within
from lodbench.execution.fan_out import Processes
from lodbench.storage.digest import digest_of_code, package_files

Item = TypeVar("Item")
Result = TypeVar("Result")

SERIAL, PROCESS, DASK = "serial", "process", "dask"
QUERIES, HYPOTHESES = "queries", "hypotheses"


@dataclass(frozen=True, slots=True)
class ExecutorParams:
    """How the work is spread, as ``conf/executor`` says; results do not depend on it.

    Attributes:
        workers: Processes; None for one per core. Of a scheduler at an address, what it has.
    """

    name: str = SERIAL
    workers: int | None = None
    threads: int | None = None
    address: str | None = None
    timeout_s: float = 3600.0
    share: str = QUERIES

    def __post_init__(self) -> None:
        if self.name not in (SERIAL, PROCESS, DASK):
            raise ConfigError(f"There is no executor {self.name!r}.", "Known: dask, process, serial.")
        require_choice("executor.share", self.share, (HYPOTHESES, QUERIES))
        for name, value in (("threads", self.threads), ("workers", self.workers)):
            if value is not None and value < 1:
                raise ConfigError(f"executor.{name}={value} is not a number of {name}.")
        # The operating system waits no longer at a time.
        require_within("executor.timeout_s", self.timeout_s, 0, 1e6, "(]")

    @property
    def num_workers(self) -> int:
        """Number of processes requested."""
        return 1 if self.name == SERIAL else self.workers or os.cpu_count() or 1

    @property
    def num_threads(self) -> int | None:
        """Threads of the engine in each process; None for one per core."""
        if self.threads is not None or self.name == SERIAL:
            return self.threads
        return max(1, (os.cpu_count() or 1) // self.num_workers)


class Workers(Protocol):
    """Those who do work, in as many rounds as they are given.

    Attributes:
        count: How many work at a time.
    """

    count: int

    def map(self, work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Yields the results of a module-level function on items, in the order they come.

        An item whose worker died is tried again on another one.

        Raises:
            WorkersGone: Workers cannot begin, keep dying, or the scheduler is gone.
            Exception: What the work raised.
        """
        ...


@contextmanager
def open_workers(
    executor: ExecutorParams, prepare: Callable[..., None], prepare_with: tuple[Any, ...]
) -> Iterator[Workers]:
    """Opens the workers of an executor for some rounds of work; ``serial`` is this process.

    Raises:
        WorkersGone: The scheduler is not there.
    """
    if executor.name == DASK:
        from lodbench.execution.cluster import dask_workers

        settings = executor.address, executor.num_workers, executor.timeout_s
        with dask_workers(*settings, prepare, prepare_with) as cluster:
            yield cluster
        return
    with closing(Processes(executor.num_workers, prepare, prepare_with, executor.timeout_s)) as processes:
        yield processes


def spread(
    executor: ExecutorParams,
    work: Callable[[Item], Result],
    items: Iterable[Item],
    prepare: Callable[..., None],
    prepare_with: tuple[Any, ...],
) -> Iterator[Result]:
    """Yields the results of one round of work; see ``open_workers`` and ``Workers.map``."""
    with open_workers(executor, prepare, prepare_with) as workers:
        yield from workers.map(work, items)


# Folders whose code no answer depends on: what is left counts, and so does a folder that is yet to come.
_IDLE = frozenset(("bench", "cli", "evaluation", "reporting", "training"))
# Those of `baselines/`, which need not lie where the package does.
_BASELINES = "lodbench.baselines"
# What computes an answer. Those of extras need not be there.
LIBRARIES = (
    "numpy", "numba", "opencv-python-headless", "scipy",
    "torch", "transformers", "kornia", "romatch", "poselib", "pycolmap", "pyrender", "open3d",
)  # fmt: skip


@cache
def own_digest() -> str:
    """Returns a digest of lodbench's own code and of the libraries that compute, as installed here."""
    package = Path(__file__).parents[1]
    files = [
        file for file in sorted(package.rglob("*.py")) if file.relative_to(package).parts[0] not in _IDLE
    ]
    return digest_of_code(dict.fromkeys((*files, *package_files(_BASELINES))), LIBRARIES)


def require_code_version(code: str) -> None:
    """Makes sure that a worker's code and libraries are those of the command.

    Args:
        code: The command's ``own_digest``; "" where its workers have no others.

    Raises:
        LodbenchError: They are not.
    """
    if code and code != own_digest():
        raise LodbenchError(
            "its code of lodbench, or a version of its libraries, is not the command's.",
            "Install the same on all machines: `lodbench doctor` lists versions.",
        )
