"""``segmenter=auto``: which segmenter a run takes where none is named, and why."""

from __future__ import annotations

from collections.abc import Collection

from lodbench.datasets.folder import select_splits
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Dataset
from lodbench.errors import DatasetError

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
    asked = select_splits(dataset, splits)
    entries = [entry for entry in dataset.entries if entry.split in asked]
    total = len(entries)
    if Input.INSTANCES in wanted:
        labelled = sum(entry.instances is not None for entry in entries)
        if labelled:
            return "instances", f"{labelled} of {total} queries have labels of single buildings"
        return (
            "compact_instances",
            "the method asks for single buildings, and the dataset has no labels of them",
        )
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
