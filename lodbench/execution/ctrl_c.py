"""Ctrl-C reaches every process of a terminal; the one that was asked is to answer it."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


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
