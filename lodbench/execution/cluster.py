"""Work over a Dask cluster: Dask owns the transport and the workers, lodbench what is handed out and kept."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from importlib import import_module
from itertools import islice
from typing import Any, TypeVar
from uuid import uuid4

from lodbench.errors import ConfigError, LodbenchError
from lodbench.execution.executor import ExecutorParams
from lodbench.execution.fan_out import KEEP_DYING, KEEP_DYING_HINT

Item = TypeVar("Item")
Result = TypeVar("Result")

_LOGGER = logging.getLogger(__name__)
# Items handed to the cluster per thread of it: one at work, one waiting.
_AHEAD = 2
# So often an item is tried again on another worker when the one it was on died or hung.
_RETRIES = 3
# A scheduler that does not answer for so long is not there, seconds.
_CONNECT_S = 30


def over_dask(
    executor: ExecutorParams,
    work: Callable[[Item], Result],
    items: Iterable[Item],
    prepare: Callable[..., None],
    prepare_with: tuple[Any, ...],
) -> Iterator[Result]:
    """Yields results as ``spread`` does, from the cluster at an address or one of its own on this machine.

    Raises:
        ConfigError: Dask is not installed.
        LodbenchError: Workers keep dying or hanging, the scheduler is not there, or goes away.
        Exception: What the work raised.
    """
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
            common = client.submit(
                _together, uuid4().hex, work, prepare, prepare_with, pure=False, retries=_RETRIES
            )
            slots = max(1, sum(client.nthreads().values()) or executor.num_workers)
            yield from _results(client, common, iter(items), _AHEAD * slots, executor.patience_s)
    except distributed.KilledWorker as error:
        raise LodbenchError(KEEP_DYING, KEEP_DYING_HINT) from error
    except CancelledError as error:
        raise LodbenchError(
            f"Dask's scheduler {executor.address or 'on this machine'} is gone.",
            "Start it again and give the same command: what was done is kept.",
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


def _results(
    client: Any, common: Any, waiting: Iterator[Any], ahead: int, patience_s: float
) -> Iterator[Any]:
    """Yields results as they come; items are handed out as others come back."""
    distributed: Any = import_module("distributed")

    def submit(count: int) -> set[Any]:
        taken = islice(waiting, count)
        return {client.submit(_on_worker, common, item, pure=False, retries=_RETRIES) for item in taken}

    running, hung = submit(ahead), 0
    while running:
        try:
            done, running = distributed.wait(running, patience_s, "FIRST_COMPLETED")
        except TimeoutError as error:
            hung += 1
            if hung > _RETRIES:
                raise LodbenchError(KEEP_DYING, KEEP_DYING_HINT) from error
            # What they were at is done again.
            client.restart_workers([name for name, keys in client.processing().items() if keys])
            continue
        for future in done:
            yield future.result()
            hung = 0
        running |= submit(len(done))


# What this worker has prepared, by its token; the latest only, since it may hold a city.
_prepared: list[str] = []


def _together(*common: Any) -> tuple[Any, ...]:
    return common


def _on_worker(
    common: tuple[str, Callable[[Any], Any], Callable[..., None], tuple[Any, ...]], item: Any
) -> Any:
    token, work, prepare, prepare_with = common
    if _prepared != [token]:
        prepare(*prepare_with)
        _prepared[:] = [token]
    return work(item)
