"""Where work is done: in this process, over processes, on a Dask cluster, by the same code.

Dask owns the transport and its workers, lodbench what is handed out and kept.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, Protocol, TypeVar
from uuid import uuid4

from lodbench.errors import ConfigError, LodbenchError, WorkersGone, require_choice, require_within
from lodbench.execution import processes
from lodbench.extras import require
from lodbench.storage.digest import own_digest

Item = TypeVar("Item")
Result = TypeVar("Result")

SERIAL, PROCESS, DASK = "serial", "process", "dask"
QUERIES, HYPOTHESES = "queries", "hypotheses"
_LOGGER = logging.getLogger(__name__)
# Items handed to the cluster per worker of it: one at work, one waiting.
_AHEAD = 2
# So often an item is tried again on another worker when the one it was on died or hung.
_RETRIES = 3
# A scheduler that does not answer for so long is not there, seconds.
_CONNECT_S = 30
# A cluster of our own gives up workers that do not come back for so long after they died, seconds: Dask's 15
# are fewer than a start takes on a busy machine. So often it is required to put others in their place.
_LOST_S, _REPLACE_S = 120, 30
# What this worker has prepared, by its token; the latest only, since it may hold a city.
_prepared: list[str] = []
# A worker of several threads does one item at a time all the same: they would share a method and a map, which
# counts the poses that it draws.
_one_at_a_time = threading.Lock()


@dataclass(frozen=True, slots=True)
class ExecutorParams:
    """How the work is spread, as ``conf/executor`` says; results do not depend on it."""

    name: str = SERIAL
    workers: int | None = None  # processes; None for one per core; of a scheduler at an address, what it has
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
    """Those who do work, in as many rounds as they are given."""

    count: int  # how many work at a time

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
        settings = executor.address, executor.num_workers, executor.timeout_s
        with dask_workers(*settings, prepare, prepare_with) as cluster:
            yield cluster
        return
    with closing(
        processes.Processes(executor.num_workers, prepare, prepare_with, executor.timeout_s)
    ) as pool:
        yield pool


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


class DaskWorkers:
    """Workers of a cluster, as ``Processes`` are of this machine.

    Args:
        client: Dask's.
        address: The scheduler's, for messages.
        prepare: Module-level function, called once in each worker before its first item.
        prepare_with: Its arguments.
        workers: How many are requested, where none has come yet.
        timeout_s: Seconds without any result after which the workers count as hung.
        own: The cluster, where it is one of this process: workers that are lost are replaced.
    """

    def __init__(
        self,
        client: Any,
        address: str,
        prepare: Callable[..., None],
        prepare_with: tuple[Any, ...],
        workers: int,
        timeout_s: float,
        own: Any = None,
    ) -> None:
        self._client, self._address, self._timeout_s, self._own = client, address, timeout_s, own
        threads = client.nthreads().values()
        self.count = len(threads) or max(1, workers)
        self._has_warned = False
        if own is None and not threads:
            self._warn_of_no_worker()
        if max(threads, default=1) > 1:
            _LOGGER.warning("Dask's workers have several threads, of which one works: --nthreads 1 is better")
        # One name for all that is prepared alike: a worker does it once, a new one does it again.
        # A task, not scattered data: made again where the worker that held it died. As bytes: workers hand it
        # to each other, and what one of them works with, such as a network it has loaded, cannot be sent.
        dumps = import_module("distributed.protocol.pickle").dumps
        self._common = client.submit(
            _together, uuid4().hex, dumps((Path.cwd(), prepare, prepare_with)), pure=False, retries=_RETRIES
        )

    def map(self, work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Yields results as ``Processes.map`` does.

        Raises:
            WorkersGone: Workers cannot begin, keep dying or hanging, or the scheduler goes away.
            Exception: What the work raised.
        """
        with _one_line_for(self._address):
            yield from self._results(work, iter(items))

    def _results(self, work: Callable[[Item], Result], waiting: Iterator[Item]) -> Iterator[Result]:
        """Yields results as they come; items are handed out as others come back."""

        def submit(count: int) -> set[Any]:
            return {
                self._client.submit(_on_worker, self._common, work, item, pure=False, retries=_RETRIES)
                for item in islice(waiting, count)
            }

        running, hung = submit(_AHEAD * self.count), 0
        while running:
            try:
                done, running = self._wait(running)
            except TimeoutError as error:
                hung += 1
                if hung > _RETRIES:
                    raise WorkersGone(processes.KEEP_DYING, processes.KEEP_DYING_HINT) from error
                # What they were at is done again.
                names = [name for name, keys in self._client.processing().items() if keys]
                self._client.restart_workers(names)
                continue
            for future in done:
                yield self._result(future)
                hung = 0
            running |= submit(len(done))

    def _result(self, future: Any) -> Any:
        """Returns the result of what is done.

        The worker that holds it may die before it has handed it over: then one that replaces it does the work
        again, and is waited for as long as any.
        """
        until = time.monotonic() + self._timeout_s
        while True:
            try:
                return future.result(_REPLACE_S)
            except TimeoutError as error:
                if future.status == "error":  # what the work itself raised
                    raise
                if time.monotonic() >= until:
                    raise WorkersGone(processes.KEEP_DYING, processes.KEEP_DYING_HINT) from error
            self._replace()

    def _replace(self) -> None:
        """Starts workers in place of those that are gone, as many as there were, where they are ours."""
        if self._own is not None:
            self._own.scale(len(self._own.worker_spec))

    def _warn_of_no_worker(self) -> None:
        if not self._has_warned:
            reported = "%s has no worker: `dask worker %s --nthreads 1` starts one"
            _LOGGER.warning(reported, self._address, self._address)
        self._has_warned = True

    def _has_workers(self) -> bool:
        """Tells whether somebody is at work; a scheduler that does not answer is not said to have nobody."""
        try:
            is_there = bool(self._client.nthreads())
        except OSError:  # if it is gone, waiting for results tells
            return True
        if is_there:
            self._has_warned = False
        else:
            self._warn_of_no_worker()
        return is_there

    def _wait(self, running: set[Any]) -> Any:
        """Returns futures that are done, and those that are not."""
        wait: Any = import_module("distributed").wait
        until = time.monotonic() + self._timeout_s
        while True:
            try:
                left_s = max(0.0, until - time.monotonic())
                return wait(running, min(left_s, _REPLACE_S), "FIRST_COMPLETED")
            except TimeoutError:
                if self._own is None and not self._has_workers():
                    # Nobody is at work who could hang: workers may wait in a queue of their own, for days.
                    until = time.monotonic() + self._timeout_s
                elif time.monotonic() >= until:
                    raise
            self._replace()


@contextmanager
def dask_workers(
    address: str | None,
    workers: int,
    timeout_s: float,
    prepare: Callable[..., None],
    prepare_with: tuple[Any, ...],
) -> Iterator[DaskWorkers]:
    """Opens the cluster at an address, or one of its own on this machine.

    Raises:
        ConfigError: Dask is not installed, or the address is none.
        WorkersGone: The scheduler is not there.
    """
    distributed = require("distributed", "cluster", "executor=dask")
    own = None
    try:
        if address is None:
            own = _own_cluster(distributed, workers)
        else:
            # Of a scheduler that goes it logs tracebacks beside the one line that says so.
            for name in ("distributed", "distributed.client", "distributed.core"):
                logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            client = distributed.Client(address or own, timeout=_CONNECT_S)
        except (TypeError, ValueError) as error:
            if address is None:
                raise
            raise ConfigError(
                f"executor.address={address} is no address of a Dask scheduler: {error}.",
                "It looks like tcp://HOST:8786; `dask scheduler` prints its own.",
            ) from error
        except OSError as error:
            if address is None or error.errno is not None:
                raise
            raise WorkersGone(
                f"Dask's scheduler {address} does not answer.", "dask scheduler starts one."
            ) from error
        with client:
            _LOGGER.warning("Dask's dashboard: %s", client.dashboard_link)
            name = address or "on this machine"
            with import_module("dask.config").set({"distributed.deploy.lost-worker-timeout": f"{_LOST_S}s"}):
                yield DaskWorkers(client, name, prepare, prepare_with, workers, timeout_s, own)
    finally:
        if own is not None:
            own.close()


def _own_cluster(distributed: Any, workers: int) -> Any:
    """Returns a cluster of processes of one thread (the engine has threads itself) on this machine."""
    processes.start_tracker()
    with processes.ctrl_c_for_this_thread():
        return distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            # The dashboard can be seen from this machine alone.
            dashboard_address="127.0.0.1:8787",
            # Workers that die are reported in lines of ours; a stopped run would print dozens.
            silence_logs=logging.ERROR,
        )


@contextmanager
def _one_line_for(address: str) -> Iterator[None]:
    """Turns what Dask raises where its workers or its scheduler fail into errors of one line."""
    distributed: Any = import_module("distributed")
    try:
        yield
    except distributed.KilledWorker as error:
        raise WorkersGone(processes.KEEP_DYING, processes.KEEP_DYING_HINT) from error
    except (CancelledError, distributed.comm.CommClosedError) as error:
        raise WorkersGone(
            f"Dask's scheduler {address} is gone.",
            "Start it again and give the same command: what was done is kept.",
        ) from error


def _together(token: str, preparation: bytes) -> tuple[str, bytes]:
    return token, preparation


def _on_worker(common: tuple[str, bytes], work: Callable[[Any], Any], item: Any) -> Any:
    token, preparation = common
    with _one_at_a_time:
        if _prepared != [token]:
            folder, *prepared = import_module("distributed.protocol.pickle").loads(preparation)
            # Paths that the user typed are relative to the command's folder, not to where the worker began.
            with suppress(OSError):
                os.chdir(folder)
            processes.begin(*prepared)
            _prepared[:] = [token]
        return work(item)
