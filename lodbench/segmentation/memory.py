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


def require_memory(what: str, needed: float, smaller: str = "a smaller segmenter.encoder") -> None:
    """Makes sure that something fits into memory.

    Args:
        what: Needs it, in the plural: ``The weights of sam2_unet``.
        needed: Bytes.
        smaller: What needs less.

    Raises:
        ConfigError: They do not.
    """
    free = free_bytes()
    if free is not None and needed > free:
        raise ConfigError(
            f"{what} need {needed / _GIB:.1f} GiB of memory, {free / _GIB:.1f} GiB are free.",
            f"Take {smaller}, or a machine with more memory.",
        )
