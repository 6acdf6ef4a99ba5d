"""What is written when work is stopped, or has failed: its own fault must not hide why the work ended."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lodbench.errors import LodbenchError
from lodbench.storage.atomic import final_name

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
