"""Segmenters by name: from a configuration, from words, or as a dataset has it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from lodbench.cli.source_profiles import option_pairs
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError
from lodbench.segmentation import Segmenter
from lodbench.segmentation.registry import AUTO, FOR_PHOTOS, chosen_segmenter, make_segmenter

# A segmenter and its parameters.
Made = tuple[Segmenter, Any]


def segmenter_of(name: str, words: Sequence[str] = ()) -> Segmenter:
    """Returns a segmenter with some options set, ``key=value`` each.

    Raises:
        LodbenchError: There is none of this name, an option is not one of it, or its weights are missing.
    """
    return make_segmenter(name, option_pairs(words))[0]


def require_frames_looked_at(segmenter: Segmenter, name: str) -> None:
    """Makes sure that a segmenter makes masks of pixels, as frames of a video need it.

    Raises:
        ConfigError: It does not, such as one that reads masks.
    """
    if not hasattr(segmenter, "probability"):
        raise ConfigError(f"`--segmenter {name}` looks at no frames.", f"{FOR_PHOTOS} does.")


def require_one_mask_source(options: argparse.Namespace, *flags: str) -> None:
    """Refuses a segmenter beside masks that are made already: one of the two would be looked at for nothing.

    Args:
        options: With ``segmenter``, and ``segmenter_option`` where the command has it.
        flags: The command's options that name masks.

    Raises:
        ConfigError: Both were given.
    """
    named = [flag for flag in flags if getattr(options, flag.removeprefix("--")) is not None]
    makers = ["--segmenter"] if options.segmenter is not None else []
    makers += ["--segmenter-option"] if getattr(options, "segmenter_option", []) else []
    if named and makers:
        raise ConfigError(
            f"`{makers[0]}` is not used with `{named[0]}`.", f"Leave `{makers[0]}` or `{named[0]}` out."
        )


def named_segmenter(values: Mapping[str, Any]) -> Made | None:
    """Returns the segmenter that a configuration's section names; None for ``auto``.

    Raises:
        LodbenchError: As for ``segmenter_of``.
    """
    return None if values.get("name") == AUTO else make_segmenter(str(values.get("name", "")), values)


def default_segmenter(
    dataset: Dataset, wanted: Collection[Input] = frozenset({Input.MASK}), splits: tuple[str, ...] = ()
) -> Made:
    """Returns the segmenter of a dataset where none is named; prints which and why, if masks are wanted.

    Args:
        dataset: What is to be segmented.
        wanted: What the method looks at of what a segmenter makes.
        splits: That are run; the dataset's default ones if none is named.

    Raises:
        DatasetError: Masks are needed, and the splits have neither masks nor photos.
        ConfigError: A split is not one of the dataset.
    """
    name, reason = chosen_segmenter(dataset, wanted, splits)
    if wanted:
        sys.stdout.write(f"segmenter={name}: {reason}; segmenter=NAME takes another\n")
    return make_segmenter(name)
