"""Segmenters by name: from an entry point and settings to a segmenter."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

from lodbench.datasets.folder import select_splits
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError
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
    stated = fingerprint_of(segmenter, entries)
    is_whole = stated != "" and type(segmenter).__module__.startswith("lodbench.")
    settings = {} if is_whole else _settings(segmenter)
    return digest_of([segmenter.name, settings, stated]) if settings else stated


def _settings(segmenter: Segmenter) -> dict[str, str]:
    """Returns a segmenter's settings as text, less its name and places of weights, which are no content."""
    params: Any = getattr(segmenter, "params", None)
    values = asdict(params) if is_dataclass(params) and not isinstance(params, type) else {}
    return {
        key: repr(value)
        for key, value in values.items()
        if key != "name" and not (key.endswith("weights") and isinstance(value, str | Path | None))
    }


AUTO = "auto"
# Looks at photos that nobody has drawn, where no other segmenter is named.
FOR_PHOTOS = "efficient_unet"


def chosen_segmenter(
    dataset: Dataset, wanted: Collection[Input] = frozenset({Input.MASK}), splits: tuple[str, ...] = ()
) -> tuple[str, str]:
    """Returns the name of the segmenter for a dataset, and the reason in words.

    Masks lie in a dataset because somebody made them for these photos, so they go before a network; unless
    the dataset says otherwise, as the demo does, whose masks are drawn.

    Args:
        dataset: What is to be segmented.
        wanted: What the method looks at of what a segmenter makes.
        splits: That are looked at; the dataset's default ones if none is named.

    Raises:
        DatasetError: Masks are needed, and the splits have neither masks nor photos.
        ConfigError: A split is not one of the dataset.
    """
    requested = select_splits(dataset, splits)
    entries = [entry for entry in dataset.entries if entry.split in requested]
    total = len(entries)
    if Input.INSTANCES in wanted:
        labelled = sum(entry.instances is not None for entry in entries)
        if labelled:
            return "instances", f"{labelled} of {total} queries have labels of single buildings"
        return (
            "compact_instances",
            "the method asks for single buildings, and the dataset has no labels of them",
        )
    if Input.CLASSES in wanted:
        labelled = sum(entry.classes is not None for entry in entries)
        if not labelled:
            raise DatasetError(
                f"The method needs masks of roofs and walls, and {dataset.name} has none.",
                "Name a segmenter that makes them: `segmenter=compact_classes segmenter.weights=FILE`.",
            )
        return "classes", f"{labelled} of {total} queries have labels of roofs and walls"
    if dataset.segmenter is not None:
        return dataset.segmenter, f"as {dataset.name} says"
    masks = sum(entry.mask is not None for entry in entries)
    if masks:
        return "masks", f"{masks} of {total} queries have masks made beforehand"
    if not wanted:
        return "none", "the dataset has no masks, and the method needs none"
    if any(entry.image is not None for entry in entries):
        return FOR_PHOTOS, "the dataset has photos and no masks"
    raise DatasetError(
        f"None of the {total} queries of {dataset.name} has a mask or a photo.",
        "Put building masks (255 = building) in masks, or photos in Query_image, named as in the poses.",
    )
