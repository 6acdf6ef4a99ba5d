"""Fan-out: items of work over processes, with results as they come and memory that does not grow."""

from __future__ import annotations

import multiprocessing
import os
import signal
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
KEEP_DYING = "Workers keep dying, perhaps for lack of memory, or give no result."
KEEP_DYING_HINT = "Fewer workers need less; executor.patience_s=SECONDS is how long one may take."
# Workers that may die one after the other with no result in between.
_DEATHS = 3


def fan_out(
    work: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int,
    prepare: Callable[..., None],
    prepare_with: tuple[Any, ...],
    patience_s: float | None = None,
) -> Iterator[Result]:
    """Yields the results of work on items, in the order they come.

    With one worker the work is done in this process. Otherwise every worker is a fresh process,
    which ends when this one does, however that happens; when one dies, what was at work is done again.

    Args:
        work: Module-level function of one item.
        items: What to work on; taken as workers become free.
        workers: Number of processes.
        prepare: Module-level function, called once in each worker before its first item.
        prepare_with: Its arguments.
        patience_s: Seconds without any result after which the workers count as hung and are replaced; None
            waits for ever.

    Raises:
        LodbenchError: Workers keep dying or hanging.
        Exception: What the work raised; items not yet handed out are left.
    """
    if workers == 1:
        prepare(*prepare_with)
        yield from map(work, items)
        return
    waiting, again, deaths = iter(items), list[Item](), 0
    while True:
        try:
            for result in _over_processes(work, waiting, again, workers, prepare, prepare_with, patience_s):
                deaths = 0
                yield result
            return
        except BrokenProcessPool as error:
            deaths += 1
            if deaths > _DEATHS:
                raise LodbenchError(KEEP_DYING, KEEP_DYING_HINT) from error


def _over_processes(
    work: Callable[[Item], Result],
    waiting: Iterator[Item],
    again: list[Item],
    workers: int,
    prepare: Callable[..., None],
    prepare_with: tuple[Any, ...],
    patience_s: float | None,
) -> Iterator[Result]:
    """Yields results until all items are done or a worker dies; what was at work is in ``again`` then."""
    # Fresh processes, not forks: a fork would copy locks that other threads hold.
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(workers, context, _prepare, (prepare, prepare_with))
    at_work: dict[Future[Result], Item] = {}
    try:
        while True:
            while len(at_work) < _AHEAD * workers:
                again += [] if again else list(islice(waiting, 1))
                if not again:
                    break
                # In `again` until it is handed out: a pool that is broken takes nothing.
                future = pool.submit(work, again[-1])
                at_work[future] = again.pop()
            if not at_work:
                return
            done, _ = wait(at_work, patience_s, return_when=FIRST_COMPLETED)
            if not done:
                # Nobody knows which of them hangs; what they were at fails now, and is done again.
                for worker in set(multiprocessing.active_children()) - others:
                    worker.kill()
            for future in done:
                result = future.result()
                del at_work[future]
                yield result
    except BrokenProcessPool:
        # Nobody knows whose worker it was.
        again += at_work.values()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _prepare(prepare: Callable[..., None], prepare_with: tuple[Any, ...]) -> None:
    # Ctrl-C reaches every process of a terminal; the parent is the one to answer.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    prepare(*prepare_with)


def _end_with_parent() -> None:
    """Ends this process when its parent is gone: a killed parent cannot tell its workers."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait_for([parent.sentinel])
        os._exit(1)
