"""Processes: items of work handed to them, and what work in one of them is kept from.

Results come back as they are made, in memory that does not grow. Work is kept from threads of BLAS, from
other processes in its folder, and from another working folder.
"""

from __future__ import annotations

import fcntl
import logging
import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, suppress
from functools import cache, wraps
from itertools import islice
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from lodbench.errors import ConfigError, LodbenchError, WorkersGone

Item = TypeVar("Item")
Result = TypeVar("Result")
Arguments = ParamSpec("Arguments")
# Items handed out per worker: one at work, one waiting.
_AHEAD = 2
KEEP_DYING = "Workers keep dying, perhaps for lack of memory, or give no result."
KEEP_DYING_HINT = "Fewer workers need less; `executor.timeout_s=SECONDS` is how long one may take."
# Workers that may die one after the other with no result in between.
_DEATHS = 3
# Fresh processes, not forks of this one: a fork would copy locks that other threads hold. On Linux they fork
# from a server that has imported what they need and holds no lock; elsewhere system libraries forbid it.
_START = "forkserver" if sys.platform == "linux" else "spawn"
# Why this worker cannot work: reported with its first item, as a pool whose workers raise at once is silent.
_cannot_begin: list[LodbenchError] = []
_lock = threading.Lock()
# What the first of the calls under way set aside, and None for each of the others.
_under_way: list[Any] = []
# Read by OpenBLAS when it is loaded; what loads SciPy's.
_THREADS, _SCIPY = "OPENBLAS_NUM_THREADS", "scipy.linalg"
_LOGGER = logging.getLogger(__name__)


@contextmanager
def ctrl_c_for_this_thread() -> Iterator[None]:
    """Keeps Ctrl-C, which reaches every process of a terminal, from workers started here.

    Threads and processes inherit what is blocked, so workers that are started again later do not see it
    either. One that is pressed meanwhile is answered at the end, by this thread. Windows blocks no signals:
    there nothing is kept.

    What starts the first worker of a process calls ``start_tracker`` before.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def start_tracker() -> None:
    """Starts what multiprocessing starts with the first worker: then, it would unblock Ctrl-C.

    Windows has none.
    """
    if hasattr(signal, "pthread_sigmask"):
        resource_tracker.ensure_running()


def expect_workers(modules: tuple[str, ...]) -> None:
    """Lets what workers need be imported once, beside this process, while it does other things.

    Args:
        modules: Of the work; the first call in a process counts.
    """
    start_tracker()
    if _START == "forkserver":
        multiprocessing.set_forkserver_preload(list(modules))
        # While it imports it would answer Ctrl-C with a traceback of its own.
        with ctrl_c_for_this_thread():
            forkserver.ensure_running()


def fan_out(
    work: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int,
    prepare: Callable[..., None],
    prepare_with: tuple[Any, ...],
    timeout_s: float | None = None,
) -> Iterator[Result]:
    """Yields the results of work on items, in the order they come; arguments as for ``Processes``."""
    with closing(Processes(workers, prepare, prepare_with, timeout_s)) as processes:
        yield from processes.map(work, items)


class Processes:
    """Processes that do work, in as many rounds as they are given.

    With one worker the work is done in this process. Otherwise every worker is a fresh process, which ends
    when this one does, however that happens; when one dies, what was at work is done again. They start with
    the first round.

    Args:
        workers: Number of processes.
        prepare: Module-level function, called once in each worker before its first item.
        prepare_with: Its arguments.
        timeout_s: Seconds without any result after which the workers count as hung and are replaced; None
            waits for ever.
    """

    def __init__(
        self,
        workers: int,
        prepare: Callable[..., None],
        prepare_with: tuple[Any, ...],
        timeout_s: float | None = None,
    ) -> None:
        self.count = workers
        self._prepare, self._prepare_with, self._timeout_s = prepare, prepare_with, timeout_s
        self._pool: ProcessPoolExecutor | None = None
        self._others: set[Any] = set()
        self._is_prepared = False

    def map(self, work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Yields the results of work on items, in the order they come.

        Args:
            work: Module-level function of one item.
            items: What to work on; taken as workers become free.

        Raises:
            WorkersGone: Workers cannot begin, or keep dying or hanging.
            Exception: What the work raised; items not yet handed out are left.
        """
        if self.count == 1:
            if not self._is_prepared:
                begin(self._prepare, self._prepare_with)
                self._is_prepared = True
            yield from map(work, items)
            return
        waiting, again, deaths = iter(items), list[Item](), 0
        while True:
            try:
                for result in self._round(work, waiting, again):
                    deaths = 0
                    yield result
                return
            except BrokenProcessPool as error:
                self.close()
                deaths += 1
                if deaths > _DEATHS:
                    raise WorkersGone(KEEP_DYING, KEEP_DYING_HINT) from error

    def close(self) -> None:
        """Ends the workers, when they are done with what they are at."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None

    def _round(
        self, work: Callable[[Item], Result], waiting: Iterator[Item], again: list[Item]
    ) -> Iterator[Result]:
        """Yields results until all items are done or a worker dies; what was at work is in ``again`` then."""
        pool = self._started()
        at_work: dict[Future[Result], Item] = {}
        try:
            while True:
                while len(at_work) < _AHEAD * self.count:
                    again += [] if again else list(islice(waiting, 1))
                    if not again:
                        break
                    # In `again` until it is handed out: a pool that is broken takes nothing.
                    # It starts workers; one that is half started would meet a parent that is gone.
                    with ctrl_c_for_this_thread(), _explaining_what_cannot_be_sent():
                        future = pool.submit(_do, work, again[-1])
                    at_work[future] = again.pop()
                if not at_work:
                    return
                done, _ = wait(at_work, self._timeout_s, return_when=FIRST_COMPLETED)
                if not done:
                    # Nobody knows which of them hangs; what they were at fails now, and is done again.
                    for worker in set(multiprocessing.active_children()) - self._others:
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
            for future in at_work:
                future.cancel()

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            expect_workers((self._prepare.__module__,))
            self._others = set(multiprocessing.active_children())
            begin_with = (self._prepare, self._prepare_with, dict(os.environ))
            context = multiprocessing.get_context(_START)
            self._pool = ProcessPoolExecutor(self.count, context, _begin, begin_with)
        return self._pool


@contextmanager
def _explaining_what_cannot_be_sent() -> Iterator[None]:
    """Says in a line that a plug-in holds what is of one process, as a lock or an open network."""
    try:
        yield
    except (TypeError, AttributeError) as error:
        reason = f"What workers are given cannot go to another process: {error}."
        raise WorkersGone(reason, "`executor=serial` works in one.") from error


def begin(prepare: Callable[..., None], prepare_with: tuple[Any, ...]) -> None:
    """Prepares this process for work.

    Raises:
        ConfigError: A setting is wrong.
        WorkersGone: It cannot be prepared, whatever item it were for.
    """
    try:
        prepare(*prepare_with)
    except ConfigError:
        raise
    except LodbenchError as error:
        raise WorkersGone(f"A worker cannot begin: {error.message.marked}", error.hint) from error
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        reason = f"{type(error).__name__}: {error} ({place.filename}, line {place.lineno})"
        raise WorkersGone(f"A worker cannot begin: {reason}") from error


def _do(work: Callable[[Item], Result], item: Item) -> Result:
    if _cannot_begin:
        raise _cannot_begin[0]
    return work(item)


def _begin(prepare: Callable[..., None], prepare_with: tuple[Any, ...], environment: dict[str, str]) -> None:
    # Ctrl-C reaches every process of a terminal; the parent is the one to answer.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # The server that workers fork from may be older than the settings.
    os.environ.clear()
    os.environ.update(environment)
    try:
        begin(prepare, prepare_with)
    except LodbenchError as error:
        _cannot_begin.append(error)


def _end_with_parent() -> None:
    """Ends this process when its parent is gone: a killed parent cannot tell its workers."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait_for([parent.sentinel])
        os._exit(1)


def single_threaded_blas(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Returns a function that runs with BLAS on one thread; what was set before is set again after it.

    The libraries' thread counts are the process's: threads that call at the same time share them, and the
    last one to leave restores. SciPy brings a BLAS of its own: one that is loaded meanwhile keeps one thread.
    """

    @wraps(function)
    def limited(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with _lock:
            _under_way.append(None if _under_way else (_take_control(_limit), os.environ.get(_THREADS)))
            os.environ[_THREADS] = "1"
        try:
            return function(*args, **kwargs)
        finally:
            with _lock:
                if len(_under_way) == 1:
                    limits, threads = _under_way[0]
                    _take_control(limits.restore_original_limits)
                    os.environ.pop(_THREADS)
                    os.environ |= {} if threads is None else {_THREADS: threads}
                # The first stays until the last has left.
                _under_way.pop()

    return limited


def _limit() -> Any:
    return _libraries(_SCIPY in sys.modules).limit(limits=1, user_api="blas")


def _take_control(change: Callable[[], Result]) -> Result:
    """Returns what a change of limits returns, made by this thread whoever made the last one."""
    from threadpoolctl import OpenBLASController

    # Newer versions of threadpoolctl let one thread change limits alone; here the last to leave restores.
    give_up = getattr(OpenBLASController, "clear_controlling_thread", None)
    if give_up is None:
        return change()
    give_up(force=True)
    try:
        return change()
    finally:
        give_up(force=True)


@cache
def _libraries(_has_scipy: bool) -> Any:
    """Returns the libraries that are loaded; looked for once without SciPy and once with it."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


@contextmanager
def only_one_in(folder: Path) -> Iterator[None]:
    """Holds a folder for this process; waits, and says so, while another has it.

    The lock is the system's and ends with the process, however that happens; no file is left. Where the file
    system knows no locks there is none.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _LOGGER.warning("Another process is at work in %s: waiting for it.", folder)
            fcntl.flock(handle, fcntl.LOCK_EX)
        except OSError:
            pass
        yield
    finally:
        os.close(handle)


@contextmanager
def staying_here() -> Iterator[None]:
    """Returns to the working folder after the block, whatever it did; decorates functions too."""
    try:
        here = Path.cwd()
    except FileNotFoundError:  # it was removed: no relative path leads anywhere
        yield
        return
    try:
        yield
    finally:
        with suppress(OSError):
            os.chdir(here)
