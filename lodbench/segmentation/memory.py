"""Whether a network fits into memory, before it is built and the system ends the process without a word."""

from __future__ import annotations

from pathlib import Path

from lodbench.errors import ConfigError

_MEMINFO = Path("/proc/meminfo")
_GIB = float(1 << 30)


def free_bytes() -> int | None:
    """Returns the memory that can be had without swapping; None where the system does not say."""
    try:
        for line in _MEMINFO.read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return 1024 * int(line.split()[1])
    except (OSError, ValueError, IndexError):
        return None
    return None


def require_memory(name: str, needed: int) -> None:
    """Makes sure that a network's weights fit into memory.

    Args:
        name: Of the segmenter.
        needed: Bytes.

    Raises:
        ConfigError: They do not.
    """
    free = free_bytes()
    if free is not None and needed > free:
        raise ConfigError(
            f"The weights of {name} need {needed / _GIB:.1f} GiB of memory, {free / _GIB:.1f} GiB are free.",
            "Take a smaller segmenter.encoder, or a machine with more memory.",
        )
