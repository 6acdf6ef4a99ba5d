"""`lodbench localize` from Python: the same options, files and answers."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import Any, cast

from lodbench.cli.localize import LocalizeOptions, localized, parser
from lodbench.errors import ConfigError, LodbenchError, Option, Words, nearest_names
from lodbench.harness.photo.localize import LocalizedPhoto
from lodbench.harness.photo.many import Answers
from lodbench.params import options_of

AnyPath = str | PathLike[str]


def localize_photo(photo: AnyPath, city: AnyPath, **options: Any) -> LocalizedPhoto:
    """Returns where a photo was taken, by its EXIF and XMP; writes the files of `lodbench localize`.

    Args:
        photo: JPEG, PNG or TIFF as the drone stored it.
        city: City model: file, archive, folder of tiles or scene.
        options: Those of the command, with underscores: ``out="found"`` (folder of the results, by default
            ``localized``), ``mask``, ``method``, ``takeoff=61.5``, ``center=(e, n, up)``,
            ``camera="PINHOLE 400 300 290 290 200 150"``, ``option={"axis_order": "east_first"}``.

    Raises:
        ConfigError: There is no such option, its value is wrong, or the photo is a folder.
        LodbenchError: The photo, its metadata, mask or camera, or the city is missing or not fit.

    Example::

        found = localize_photo("DJI_0001.JPG", "city.gml", takeoff=61.5)
        print(found.place.latitude_deg, found.place.heading_deg, found.trust)
    """
    if Path(photo).is_dir():
        raise ConfigError(f"{fspath(photo)} is a folder.", "lodbench.localize_flight takes folders.")
    return cast("LocalizedPhoto", _localized([photo], city, options))


def localize_flight(photos: AnyPath | Sequence[AnyPath], city: AnyPath, **options: Any) -> Answers:
    """Returns where the photos of flights were taken, each flight solved as a whole, and writes all of it.

    Args:
        photos: A folder, or files and folders.
        city: As of ``localize_photo``.
        options: Likewise: ``masks``, ``reconstruction``, ``out``, ``each_alone=True``.

    Returns:
        An answer per photo (``photos``: the answer or why there is none), flights, and the files written.

    Raises:
        ConfigError: There is no such option, its value is wrong, or there is but one photo.
        LodbenchError: The city cannot be read, or there are no photos.
    """
    several = [photos] if isinstance(photos, str | PathLike) else list(photos)
    if len(several) == 1 and Path(several[0]).is_file():
        raise ConfigError(f"{fspath(several[0])} is one photo.", "lodbench.localize_photo takes it.")
    return cast("Answers", _localized(several, city, options))


def _localized(
    photos: Sequence[AnyPath], city: AnyPath, options: Mapping[str, Any]
) -> LocalizedPhoto | Answers:
    command = parser()
    known = {each.dest: each for each in command._actions if each.option_strings}
    try:
        typed = command.parse_args(_typed(photos, city, options, known))
        return localized(options_of(typed, LocalizeOptions))
    except LodbenchError as error:
        flags = {each.option_strings[-1]: each for each in known.values()}
        error.message = as_arguments(error.message, flags)
        error.hint = as_arguments(error.hint, flags)
        raise


def _typed(
    photos: Sequence[AnyPath],
    city: AnyPath,
    options: Mapping[str, Any],
    known: Mapping[str, argparse.Action],
) -> list[str]:
    """Returns the command's words for these arguments."""
    words: list[str] = []
    for name, value in {"city": city, **options}.items():
        if name not in known or name in ("help", "json"):
            raise ConfigError(f"localize has no option {name}.", nearest_names(name, known))
        words += _words(known[name].option_strings[-1], value, known[name])
    return [*words, "--", *(fspath(photo) for photo in photos)]


def as_arguments(text: Words, flags: Mapping[str, argparse.Action]) -> Words:
    """Returns a message of the command with its flags as arguments of the functions here.

    Example:
        >>> command = parser()
        >>> flags = {each.option_strings[-1]: each for each in command._actions if each.option_strings}
        >>> as_arguments(Words("Give `--lat`, `--center EAST NORTH UP` and `--camera 'PINHOLE 4 3'`."), flags)
        "Give lat, center=(EAST, NORTH, UP) and camera='PINHOLE 4 3'."
        >>> as_arguments(Words("lodbench localize takes `--heights ellipsoid`."), flags)
        "this function takes heights='ellipsoid'."
    """

    def argument(option: Option) -> str:
        action = flags.get(f"--{option.name.replace('_', '-')}")
        if action is None:
            return option.words
        if action.choices and option.value in action.choices:
            return f"{action.dest}={option.value!r}"
        several = isinstance(action.nargs, int) and action.nargs > 1 and " " in option.value
        value = f"({', '.join(option.value.split())})" if several else option.value
        return f"{action.dest}={value}" if value else action.dest

    return Words(text.marked.replace("lodbench localize takes", "this function takes")).rewritten(argument)


def _words(flag: str, value: Any, action: argparse.Action) -> list[str]:
    """Returns an option as it is typed; none for None and False."""
    if value is None or value is False:
        return []
    if value is True:
        return [flag]
    if isinstance(value, Mapping):
        return [word for key, each in value.items() for word in (flag, f"{key}={each}")]
    if isinstance(action.nargs, int) and action.nargs > 1:
        return [flag, *map(str, value)]
    return [f"{flag}={value}"]
