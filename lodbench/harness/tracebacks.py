"""Faults of others' code in one line, with their tracebacks kept; writes on the way out of a fault."""

from __future__ import annotations

import logging
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lodbench.errors import STOPPED, LodbenchError, QueryFault
from lodbench.storage import make_folder, write_text
from lodbench.storage.disk import final_name, writable


def keep_traceback(folder: Path, name: str, error: BaseException) -> Path:
    """Writes where a plug-in's code raised to ``tracebacks`` in a folder of results; returns the file."""
    file = traceback_file(folder, name)
    make_folder(file.parent)
    write_text(file, writable("".join(traceback.format_exception(error))))
    return file


def traceback_file(folder: Path, name: str) -> Path:
    """Returns the file that ``keep_traceback`` writes."""
    safe = "".join(c if c.isalnum() or c in "._-" else "_" for c in name)
    return folder / "tracebacks" / f"{safe}.txt"


def words_of(error: BaseException) -> str:
    """Returns the kind of an exception and what it says."""
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


@contextmanager
def told_as_fault(part: str, folder: Path, name: str) -> Iterator[None]:
    """Makes whatever a plug-in's code raises the fault of one photo, and keeps where it raised.

    Args:
        part: The plug-in, as in "method shake".
        folder: Of the results.
        name: What the traceback's file is called.

    Raises:
        QueryFault: The code raised anything but a fault of lodbench's own.
    """
    try:
        yield
    except (LodbenchError, *STOPPED):
        raise
    except BaseException as error:
        file = keep_traceback(folder, name, error)
        raise QueryFault(f"{part} raised {words_of(error)}", f"See {file}.") from error


_LOG = logging.getLogger(__name__)


@contextmanager
def last_write(to: Path) -> Iterator[None]:
    """Runs the block, which writes; where that fails a warning says so, and nothing is raised.

    It is meant for the way out of an exception, which the caller raises again.
    """
    try:
        yield
    except (OSError, LodbenchError) as fault:
        if isinstance(fault, LodbenchError):
            reason = fault.message.rstrip(".")
        else:
            reason = f"{final_name(fault.filename) or to}: {fault.strerror or fault}"
        _LOG.warning("what was done until then could not be kept: %s", reason)
