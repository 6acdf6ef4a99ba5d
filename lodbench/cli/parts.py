"""Parts by name: profiles of how a publisher writes files, and segmenters; and options that a user adds."""

from __future__ import annotations

import json
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from lodbench.citymodel.options import ReadOptions
from lodbench.cli.settings import read_config
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError, nearest_names
from lodbench.plugins import config_files
from lodbench.segmentation import Segmenter
from lodbench.segmentation.protocol import AUTO, FOR_PHOTOS, chosen_segmenter, make_segmenter

# Settings of reading a city that have no flag of their own.
READ_SETTINGS = tuple(each.name for each in fields(ReadOptions) if each.name not in ("crs", "date"))
DATE_HELP = "leave out buildings whose end date is before it, if the file has end dates (default: today)"


@dataclass(frozen=True, slots=True)
class SourceProfile:
    """How to read the files of one publisher; the YAML files are in ``conf/source/``.

    Attributes:
        name: Its name, as in ``source=plateau``.
        lod: Level of detail to take unless another is requested.
        options: How to read.
    """

    name: str
    lod: str | None
    options: ReadOptions


def profile_of(values: Mapping[str, Any], crs: str | None = None) -> SourceProfile:
    """Returns the profile a configuration describes.

    Args:
        values: ``name``, ``lod`` and ``options``.
        crs: A reference system that goes before the profile's.

    Raises:
        ConfigError: A key or option is unknown or of the wrong type.
    """
    for key in values:
        if key not in ("name", "lod", "options"):
            raise ConfigError(f"source.{key} is not a setting.", f"Options are source.options.{key}=VALUE.")
    options = ReadOptions.from_mapping(values.get("options") or {})
    lod = values.get("lod")
    return SourceProfile(
        name=str(values["name"]),
        lod=None if lod is None else str(lod),
        options=options if crs is None else replace(options, crs=crs),
    )


def load_profile(
    name: str, words: Sequence[str] = (), crs: str | None = None, day: str | None = None
) -> SourceProfile:
    """Returns a profile by its name, with options a user added.

    Args:
        name: Name of a file in ``conf/source/``, of lodbench or of an installed plug-in.
        words: Options as ``key=value``; they go before the profile's own.
        crs: A reference system that goes before both.
        day: A date that goes before both.

    Raises:
        ConfigError: There is no such profile, or an option is malformed, unknown or of the wrong type.
    """
    values = read_config("source", name)
    if values is None:
        raise ConfigError(f"There is no source {name!r}.", nearest_names(name, config_files("source")))
    dated = {} if day is None else {"date": day}
    options = {**(values.get("options") or {}), **option_pairs(words), **dated}
    return profile_of({**values, "options": options}, crs)


def option_pairs(words: Sequence[str]) -> dict[str, Any]:
    """Returns the values of options written as ``key=value``.

    Raises:
        ConfigError: One has no value.
    """
    return dict(map(_pair, words))


def _pair(word: str) -> tuple[str, Any]:
    """Returns the key and value of ``key=value``: a number, list, true, false or null; else text."""
    key, equals, text = word.partition("=")
    if not equals:
        raise ConfigError(f"The option {word!r} has no value.", "Options are key=value.")
    return key, _value(text)


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        # Lists of words need no quotes, as in the settings of a run.
        is_list = text.startswith("[") and text.endswith("]")
        return [_value(part.strip()) for part in text[1:-1].split(",")] if is_list else text


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


def require_one_mask_source(options: Any, *flags: str, **others: str) -> None:
    """Refuses a segmenter beside masks that are made already: one of the two would be looked at for nothing.

    Args:
        options: With ``segmenter``, and ``segmenter_option`` where the command has it.
        flags: The command's options that name masks.
        others: Likewise, by the fields that they set.

    Raises:
        ConfigError: Both were given.
    """
    sources = {flag.removeprefix("--"): flag for flag in flags} | others
    named = [flag for name, flag in sources.items() if getattr(options, name) is not None]
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
