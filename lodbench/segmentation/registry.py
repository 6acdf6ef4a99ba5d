"""Segmenters by name: from an entry point and settings to a segmenter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lodbench.datasets.query import Entry
from lodbench.params import to_params
from lodbench.plugins import blaming, load_plugin, of_kind
from lodbench.segmentation.protocol import Segmenter


def make_segmenter(name: str, settings: Mapping[str, Any] | None = None) -> tuple[Segmenter, Any]:
    """Returns the segmenter of a name, and its parameters; what is not set keeps its default.

    Raises:
        LodbenchError: There is no such segmenter, a setting is wrong, or it cannot be made.
    """
    part = load_plugin("segmenters", name)
    with blaming("segmenters", name, "be made"):
        params = to_params(settings or {}, part.params_type, "segmenter")
        return part(params), params


def fingerprint_of(segmenter: Segmenter, entries: tuple[Entry, ...]) -> str:
    """Returns a digest of all that a segmenter's answers to some queries depend on.

    Raises:
        LodbenchError: It has none.
    """
    with blaming("segmenters", segmenter.name, "tell its fingerprint"):
        return of_kind(segmenter.fingerprint(entries), str)
