"""Segmenters by name: from an entry point and settings to a segmenter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

from lodbench.datasets.query import Entry
from lodbench.params import to_params
from lodbench.plugins import blaming, load_plugin, of_kind
from lodbench.segmentation.protocol import Segmenter
from lodbench.storage import digest_of


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


def masks_digest(segmenter: Segmenter, entries: tuple[Entry, ...]) -> str:
    """Returns a digest of what a segmenter's masks of some queries are made from: fingerprint and settings.

    The fingerprints of lodbench's own segmenters, where they say anything, are of the settings already.

    Raises:
        LodbenchError: It has no fingerprint.
    """
    told = fingerprint_of(segmenter, entries)
    is_whole = told != "" and type(segmenter).__module__.startswith("lodbench.")
    settings = {} if is_whole else _settings(segmenter)
    return digest_of([segmenter.name, settings, told]) if settings else told


def _settings(segmenter: Segmenter) -> dict[str, str]:
    """Returns a segmenter's settings as text, less its name and places of weights, which are no content."""
    params: Any = getattr(segmenter, "params", None)
    values = asdict(params) if is_dataclass(params) and not isinstance(params, type) else {}
    return {
        key: repr(value)
        for key, value in values.items()
        if key != "name" and not (key.endswith("weights") and isinstance(value, str | Path | None))
    }
