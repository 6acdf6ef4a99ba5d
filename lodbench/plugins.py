"""Plug-ins of any kind, by their entry points."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any

from lodbench.errors import ConfigError, nearest_names


def find_plugin(group: str, name: str) -> EntryPoint:
    """Returns a plug-in's entry point, not loaded.

    Args:
        group: The kind in the plural, as in ``lodbench.methods``.
        name: The plug-in's.

    Raises:
        ConfigError: No installed package offers it.
    """
    points = {point.name: point for point in entry_points(group=f"lodbench.{group}")}
    if name not in points:
        raise ConfigError(f"There is no {group.rstrip('s')} {name!r}.", nearest_names(name, points))
    return points[name]


def load_plugin(group: str, name: str) -> Any:
    """Returns what a plug-in's entry point names.

    Raises:
        ConfigError: No installed package offers it, or importing it fails.
    """
    point = find_plugin(group, name)
    try:
        return point.load()
    except Exception as error:  # a plug-in's own modules may raise anything
        raise ConfigError(
            f"{group.rstrip('s')} {name!r} does not load: {point.value}: {type(error).__name__}: {error}",
            "Mend or remove the package that offers it.",
        ) from error
