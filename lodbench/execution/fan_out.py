"""Fan-out: items of work over processes, with results as they come and memory that does not grow."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing.connection import wait as wait_for
from typing import Any, TypeVar

from lodbench.errors import LodbenchError

Item = TypeVar("Item")
Result = TypeVar("Result")

# Items handed out per worker: one at work, one waiting.
_AHEAD = 2


def fan_out(
    work: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int,
    prepare: Callable[..., None],
    prepare_with: tuple[Any, ...],
) -> Iterator[Result]:
    """Yields the results of work on items, in the order they come.

    With one worker the work is done in this process. Otherwise every worker is a fresh process,
    which ends when this one does, however that happens.

    Args:
        work: Module-level function of one item.
        items: What to work on; taken as workers become free.
        workers: Number of processes.
        prepare: Module-level function, called once in each worker before its first item.
        prepare_with: Its arguments.

    Raises:
        LodbenchError: A worker died.
        Exception: What the work raised; items not yet handed out are left.
    """
    if workers == 1:
        prepare(*prepare_with)
        yield from map(work, items)
        return
    waiting = iter(items)
    # Fresh processes, not forks: a fork would copy locks that other threads hold.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, _prepare, (prepare, prepare_with))
    try:
        running: set[Future[Result]] = {pool.submit(work, item) for item in islice(waiting, _AHEAD * workers)}
        while running:
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
                running |= {pool.submit(work, item) for item in islice(waiting, 1)}
    except BrokenProcessPool as error:
        raise LodbenchError(
            "A worker process died, perhaps for lack of memory.", "Fewer workers need less."
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _prepare(prepare: Callable[..., None], prepare_with: tuple[Any, ...]) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    prepare(*prepare_with)


def _end_with_parent() -> None:
    """Ends this process when its parent is gone: a killed parent cannot tell its workers."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait_for([parent.sentinel])
        os._exit(1)
