"""``dataset.json``: what the folders of a dataset say of themselves, and the city model that they name."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lodbench.citymodel.crs import is_same_plane
from lodbench.datasets.exchange.posed import read_json
from lodbench.errors import DatasetError
from lodbench.storage.seal import is_sealed, seal_of

ABOUT_FILE = "dataset.json"


def read_about(folder: Path) -> dict[str, Any]:
    """Returns what ``dataset.json`` in a folder says; nothing where there is none."""
    return read_json(folder / ABOUT_FILE) if (folder / ABOUT_FILE).is_file() else {}


def stated_crs(folders: Sequence[Path]) -> str | None:
    """Returns the reference system that ``dataset.json`` of some splits names; None if none does.

    Raises:
        DatasetError: Two of them name different ones: poses of both would be taken for those of one.
    """
    told = {folder: read_about(folder).get("crs") for folder in folders}
    named = {folder: str(crs) for folder, crs in told.items() if crs is not None}
    _require_one(named, "reference systems", "Open them one by one: dataset.root=FOLDER.", is_same_plane)
    return next(iter(named.values()), None)


def stated_protocol(folders: Sequence[Path]) -> str:
    """Returns the protocol that ``dataset.json`` of some splits names for results; LoD-Loc's if none does.

    Raises:
        DatasetError: Two of them name different ones.
    """
    stated = {folder: read_about(folder).get("protocol") for folder in folders}
    named = {folder: str(protocol) for folder, protocol in stated.items() if protocol is not None}
    _require_one(named, "protocols", "Open them one by one: dataset.root=FOLDER.")
    return next(iter(named.values()), "lodloc")


def stated_city(root: Path, folders: Sequence[Path]) -> tuple[Path | None, tuple[str, ...]]:
    """Returns the city model that ``dataset.json`` of some splits names, relative to it, and notes.

    None if it is not there. What a stranger's file names outside the dataset is not so much as looked for.

    Raises:
        DatasetError: What it names cannot be a file's name, or two of them name different ones.
    """
    abouts = {folder: read_about(folder) for folder in folders}
    named = {folder: about["city_model"] for folder, about in abouts.items() if about.get("city_model")}
    named = {folder: stated for folder, stated in named.items() if isinstance(stated, str)}
    paths = {folder: os.path.normpath(folder.absolute() / stated) for folder, stated in named.items()}
    _require_one(paths, "city models", "Open them one by one: dataset.root=FOLDER. Or set city=FILE for all.")
    if not named:
        return None, ()
    folder, stated = next(iter(named.items()))
    about = abouts[folder]
    try:
        return _found_city(root, folder, stated, about)
    except PermissionError as error:
        reason = f"{folder / ABOUT_FILE}: city_model {stated!r:.60} may not be looked at."
        raise DatasetError(reason, "Ask for permission, or set city=FILE.") from error
    except (OSError, ValueError, RuntimeError) as error:  # too long, NUL, half a character; links in a circle
        raise DatasetError(
            f"{folder / ABOUT_FILE}: city_model {stated!r:.60} is no name of a file.",
            "Set city=FILE.",
        ) from error


def _found_city(
    root: Path, folder: Path, stated: str, about: Mapping[str, Any]
) -> tuple[Path | None, tuple[str, ...]]:
    path = Path(os.path.normpath(folder.absolute() / stated))
    if not is_sealed(_sealed_of(stated), about.get("seal")):
        home = Path(os.path.normpath(root.absolute()))
        # In words first: to resolve a path may mount what it leads to.
        if not path.is_relative_to(home) or not path.resolve().is_relative_to(home.resolve()):
            return None, (
                f"{ABOUT_FILE} names a city model outside the dataset, {path}, which is not opened",
            )
    return (path if path.exists() else None), ()


def sealed_about(about: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what ``dataset.json`` is to say, with a seal of this user's on the city model that it names."""
    stated = about.get("city_model")
    return dict(about) if stated is None else {**about, "seal": seal_of(_sealed_of(str(stated)))}


def _sealed_of(stated: str) -> list[str]:
    return ["city model of a dataset", stated]


def _require_one(
    named: Mapping[Path, str], what: str, hint: str, is_same: Callable[[str, str], bool] = str.__eq__
) -> None:
    """Refuses splits that say different things of one kind.

    Raises:
        DatasetError: They do.
    """
    folders = list(named)
    for other in folders[1:]:
        if not is_same(named[folders[0]], named[other]):
            values = " and ".join(f"{named[folder]!r:.200}" for folder in (folders[0], other))
            raise DatasetError(
                f"The splits {folders[0].name} and {other.name} are of different {what}: {values}.", hint
            )
