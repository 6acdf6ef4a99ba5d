"""Packages that are no part of the base install: there, or one line that says how to get them."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from lodbench.errors import ConfigError

_FOR_CPUS = "; for CPUs see docs/segmentation.md."


def require(package: str, extra: str, needed_by: str) -> Any:
    """Returns a package, imported.

    Args:
        package: Its import name.
        extra: The extra of lodbench that brings it.
        needed_by: What needs it, for the message.

    Raises:
        ConfigError: It is not installed, or it breaks on import.
    """
    try:
        return import_module(package)
    except RuntimeError as error:
        if package != "torchvision":
            raise
        # Its operators were built for another torch.
        raise ConfigError(
            f"{needed_by} needs {package}, which does not work beside this torch ({error}).",
            "Both from one place, for CPUs: "
            "pip install torch torchvision --index-url https://download.pytorch.org/whl/cpu",
        ) from error
    except ImportError as error:
        raise ConfigError(
            f"{needed_by} needs {package}, which is not installed ({error}).",
            f"pip install 'lodbench[{extra}]'{_FOR_CPUS if package.startswith('torch') else ''}",
        ) from error
