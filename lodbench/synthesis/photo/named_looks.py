"""The looks that ``conf/training`` names."""

from __future__ import annotations

from importlib.resources import files

from lodbench.errors import ConfigError, nearest_names
from lodbench.params import read_settings, to_params
from lodbench.synthesis.photo.look import LookRanges


def look_ranges(name: str) -> LookRanges:
    """Returns the ranges of a named look: ``plain``, ``varied``, ``hard``.

    Raises:
        ConfigError: There is no such look.
    """
    folder = files("lodbench.conf") / "training"
    known = {entry.name.removesuffix(".yaml"): entry for entry in folder.iterdir()}
    if name not in known:
        raise ConfigError(f"There is no look {name}.", nearest_names(name, sorted(known)))
    return to_params(read_settings(known[name].read_text(encoding="utf-8")), LookRanges, "look")
