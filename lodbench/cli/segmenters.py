"""Segmenters by name: from a configuration, from words, or as a dataset has it."""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from lodbench.cli.source_profiles import option_pairs
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Dataset
from lodbench.params import to_params
from lodbench.plugins import blaming, load_plugin
from lodbench.segmentation import Segmenter
from lodbench.segmentation.choice import AUTO, chosen_segmenter

# A segmenter and its parameters.
Made = tuple[Segmenter, Any]


def segmenter_of(name: str, words: Sequence[str] = ()) -> Segmenter:
    """Returns a segmenter with some options set, ``key=value`` each.

    Raises:
        LodbenchError: There is none of this name, an option is not one of it, or its weights are missing.
    """
    return _made({"name": name}, option_pairs(words))[0]


def named_segmenter(values: Mapping[str, Any]) -> Made | None:
    """Returns the segmenter that a configuration's section names; None for ``auto``.

    Raises:
        LodbenchError: As for ``segmenter_of``.
    """
    return None if values.get("name") == AUTO else _made(values, values)


def default_segmenter(dataset: Dataset, wanted: Collection[Input] = frozenset({Input.MASK})) -> Made:
    """Returns the segmenter of a dataset where none is named; prints which and why, if masks are wanted.

    Raises:
        DatasetError: Masks are needed, and the dataset has neither masks nor photos.
    """
    name, reason = chosen_segmenter(dataset, wanted)
    if wanted:
        sys.stdout.write(f"segmenter={name}: {reason}; segmenter=NAME takes another\n")
    return _made({"name": name}, {})


def _made(values: Mapping[str, Any], settings: Mapping[str, Any]) -> Made:
    name = str(values.get("name", ""))
    part = load_plugin("segmenters", name)
    with blaming("segmenters", name, "be made"):
        params = to_params(dict(settings), part.params_type, "segmenter")
        return part(params), params
