"""Segmenters by name, with options given as words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lodbench.cli.hydra_app import load_plugin, to_params
from lodbench.cli.sources import option_pairs


def segmenter_of(name: str, words: Sequence[str] = ()) -> Any:
    """Returns a segmenter with some options set, ``key=value`` each.

    Raises:
        LodbenchError: There is none of this name, an option is not one of it, or its weights are missing.
    """
    part = load_plugin("segmenters", name)
    return part(to_params(option_pairs(words), part.params_type, "segmenter"))
