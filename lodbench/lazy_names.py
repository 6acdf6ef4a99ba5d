"""Names of a package that are loaded when first used, so that importing it costs nothing."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_names(
    package: str, homes: Mapping[str, str]
) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """Returns what a package assigns to ``__all__``, ``__getattr__`` and ``__dir__``.

    No name may be a module's of the package too: importing that module would hide it.

    Args:
        package: Its ``__name__``.
        homes: Public names, and the module that defines each, relative to the package: ``.other.module``
            is one of the package above.
    """

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        attribute = getattr(import_module(f".{homes[name]}", package), name)
        setattr(sys.modules[package], name, attribute)  # found at once from now on
        return attribute

    names = sorted(homes)
    return names, load, lambda: names
