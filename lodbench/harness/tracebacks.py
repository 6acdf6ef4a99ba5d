"""Faults of others' code in one line, with tracebacks kept; flights answered; writes on the way out."""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from lodbench.errors import STOPPED, ConfigError, InputChanged, LodbenchError, QueryFault, WorkersGone
from lodbench.storage import make_folder, write_text
from lodbench.storage.disk import final_name, writable

if TYPE_CHECKING:
    from lodbench.citymap import CityMap
    from lodbench.datasets.query import Query
    from lodbench.methods.protocol import Estimate, FlightEstimate, Streams, SupportsFlights
_LOG = logging.getLogger(__name__)


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
def reported_as_fault(part: str, folder: Path, name: str) -> Iterator[None]:
    """Makes whatever the code of a plug-in, ``part``, raises the fault of one photo; keeps where it raised.

    Raises:
        QueryFault: The code raised anything but a fault of lodbench's own.
    """
    try:
        yield
    except (LodbenchError, *STOPPED):
        raise
    except BaseException as error:
        file = keep_traceback(folder, name, error)
        words = f"{part} raised {words_of(error)}" if part else words_of(error)
        raise QueryFault(words, f"See {file}.") from error


def answered_flight(
    method: SupportsFlights,
    queries: Sequence[Query],
    city_map: CityMap,
    streams: Sequence[Streams],
    folder: Path,
    name: str,
    part: str = "",
    alone: Sequence[Estimate | QueryFault] | None = None,
) -> FlightEstimate:
    """Returns a method's answers to the photos of a flight; what it raises is the fault of each of them.

    Raises:
        LodbenchError: What ends a command, and is no fault of a photo.
    """
    # Who has a flight has loaded these; others who report faults do without.
    from lodbench.methods.localize import localize_flight
    from lodbench.methods.protocol import FlightEstimate

    try:
        with reported_as_fault(part, folder, name):
            return localize_flight(method, queries, city_map, streams, alone)
    except (ConfigError, InputChanged, WorkersGone):
        raise
    except LodbenchError as fault:
        return FlightEstimate([QueryFault(fault.message, fault.hint)] * len(queries))


@contextmanager
def kept_when_stopped(
    out: Path, table: str, write: Callable[[], str], stops: tuple[type[BaseException], ...]
) -> Iterator[None]:
    """Writes what is done when the block is stopped; an earlier table in the folder goes before.

    ``write`` returns what to say of it, "" where nothing was worth writing.
    """
    try:
        yield
    except stops:
        if not (out / table).exists():
            with last_write(out):
                if note := write():
                    _LOG.warning("%s: %s", note, out)
        raise


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
