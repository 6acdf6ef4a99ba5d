"""Source profiles: what is known of a publisher's files, and how a user adds to it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from lodbench.citymodel.options import ReadOptions
from lodbench.cli.configs import config_files, read_config
from lodbench.errors import ConfigError, nearest_names

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
