"""Where work is done: in this process, over processes, or on a Dask cluster; the results are the same."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from itertools import islice
from typing import Any, TypeVar
from uuid import uuid4

from lodbench.errors import ConfigError, LodbenchError
from lodbench.execution.fan_out import fan_out

Item = TypeVar("Item")
Result = TypeVar("Result")

_LOGGER = logging.getLogger(__name__)
SERIAL, PROCESS, DASK = "serial", "process", "dask"
# Items handed to the cluster per thread of it: one at work, one waiting.
_AHEAD = 2
# So often an item is tried again on another worker when the one it was on died.
_RETRIES = 3
# A scheduler that does not answer for so long is not there.
_CONNECT_S = 30


@dataclass(frozen=True, slots=True)
class ExecutorParams:
    """How the work is spread; results do not depend on it.

    Attributes:
        name: ``serial``, ``process`` or ``dask``.
        workers: Processes; None for one per core. Of a scheduler at an address, what it has.
        threads: Threads of the engine in each process, None for the cores divided by the workers.
        address: Dask's scheduler, ``tcp://HOST:8786``, or None for a cluster of its own on this machine.
    """

    name: str = SERIAL
    workers: int | None = None
    threads: int | None = None
    address: str | None = None

    def __post_init__(self) -> None:
        if self.name not in (SERIAL, PROCESS, DASK):
            raise ConfigError(f"There is no executor {self.name!r}.", "Known: dask, process, serial.")
        for name, value in (("threads", self.threads), ("workers", self.workers)):
            if value is not None and value < 1:
                raise ConfigError(f"executor.{name}={value} is not a number of {name}.")

    @property
    def num_workers(self) -> int:
        """Number of processes asked for."""
        return 1 if self.name == SERIAL else self.workers or os.cpu_count() or 1

    @property
    def num_threads(self) -> int | None:
        """Threads of the engine in each process; None for one per core."""
        if self.threads is not None or self.name == SERIAL:
            return self.threads
        return max(1, (os.cpu_count() or 1) // self.num_workers)


def spread(
    executor: ExecutorParams,
    work: Callable[[Item], Result],
    items: Iterable[Item],
    prepare: Callable[..., None],
    prepare_with: tuple[Any, ...],
) -> Iterator[Result]:
    """Yields the results of work on items, in the order they come.

    An item whose worker died is tried again on another one.

    Args:
        executor: Where.
        work: Module-level function of one item.
        items: What to work on; taken as workers become free.
        prepare: Module-level function, called once in each worker before its first item.
        prepare_with: Its arguments.

    Raises:
        LodbenchError: Workers keep dying, or the scheduler is not there.
        Exception: What the work raised.
    """
    if executor.name == DASK:
        return _dask(executor, work, items, prepare, prepare_with)
    return fan_out(work, items, executor.num_workers, prepare, prepare_with)


def _dask(
    executor: ExecutorParams,
    work: Callable[[Item], Result],
    items: Iterable[Item],
    prepare: Callable[..., None],
    prepare_with: tuple[Any, ...],
) -> Iterator[Result]:
    try:
        distributed: Any = import_module("distributed")
    except ModuleNotFoundError as error:
        raise ConfigError(
            "executor=dask needs Dask, which is not installed.", "pip install 'lodbench[cluster]'"
        ) from error
    # Workers in processes of their own, of one thread: the engine has threads itself.
    own = None
    try:
        if executor.address is None:
            own = distributed.LocalCluster(n_workers=executor.num_workers, threads_per_worker=1)
        with distributed.Client(executor.address or own, timeout=_CONNECT_S) as client:
            _LOGGER.warning("Dask's dashboard: %s", client.dashboard_link)
            # One name for all that is prepared alike: a worker does it once, a new one does it again.
            # A task, not scattered data: made again where the worker that held it died.
            token = uuid4().hex
            common = client.submit(
                _together, token, work, prepare, prepare_with, pure=False, retries=_RETRIES
            )
            waiting = iter(items)

            def submit(count: int) -> list[Any]:
                taken = islice(waiting, count)
                return [
                    client.submit(_on_worker, common, item, pure=False, retries=_RETRIES) for item in taken
                ]

            slots = max(1, sum(client.nthreads().values()) or executor.num_workers)
            running = distributed.as_completed(submit(_AHEAD * slots))
            for future in running:
                yield future.result()
                running.update(submit(1))
    except distributed.KilledWorker as error:
        raise LodbenchError(
            "Workers keep dying, perhaps for lack of memory.", "Fewer workers need less."
        ) from error
    except OSError as error:
        if executor.address is None or error.errno is not None:
            raise
        raise LodbenchError(
            f"Dask's scheduler {executor.address} does not answer.", "dask scheduler starts one."
        ) from error
    finally:
        if own is not None:
            own.close()


# Token, work, preparation and its arguments: what all items have in common.
_Common = tuple[str, Callable[[Any], Any], Callable[..., None], tuple[Any, ...]]
# What this worker has prepared, by its token; the latest only, since it may hold a city.
_prepared: list[str] = []


def _together(*common: Any) -> tuple[Any, ...]:
    return common


def _on_worker(common: _Common, item: Any) -> Any:
    token, work, prepare, prepare_with = common
    if _prepared != [token]:
        prepare(*prepare_with)
        _prepared[:] = [token]
    return work(item)
