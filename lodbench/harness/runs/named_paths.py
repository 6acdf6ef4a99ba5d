"""The paths that a run folder names: opened again if this user's own run names them, and not otherwise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import PurePath
from typing import Any

from lodbench.harness.runs.code_digest import words_in
from lodbench.plugins import installed
from lodbench.storage.seal import is_sealed

# Settings of a configuration's sections that hold a path, and are not the dataset's root and city.
_NAMED = {
    "dataset": ("references", "textured_map", "prior_file"),
    "segmenter": ("weights", "encoder_weights"),
}
# More of them, sealed where they are set: seals of older versions stay good. No run writes the last two.
_NAMED_LATER = {"segmenter": ("mask_weights", "folder"), "prior": ("path",), "source.options": ("terrain",)}
# Sections that may be of a plug-in: which of its settings are paths only its author knows.
_GROUPS = {"dataset": "datasets", "segmenter": "segmenters", "prior": "priors"}


def named_by(provenance: dict[str, Any], config: dict[str, Any]) -> list[Any]:
    """Returns what a run's seal is of: all paths in its provenance and its configuration."""
    in_config = [_section(config, section).get(key) for section, keys in _NAMED.items() for key in keys]
    later = [_section(config, section).get(key) for section, key in _later(config)]
    return [provenance.get("dataset_root"), provenance.get("city_model"), *in_config, *later]


def is_own(provenance: dict[str, Any], config: dict[str, Any]) -> bool:
    """Tells whether the run was made with this user's cache, so that the paths it names are this user's."""
    return is_sealed(named_by(provenance, config), provenance.get("seal"))


def without_paths(config: dict[str, Any]) -> dict[str, Any]:
    """Returns a configuration that names no path: those it names count as not set."""
    places = [(section, key) for section, keys in _NAMED.items() for key in keys]
    named = [(section, key) for section, key in places if _is_path(key, _section(config, section).get(key))]
    for section, key in (*named, *_later(config)):
        config = _unset(config, [*section.split("."), key])
    return config


def _later(config: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yields sections and keys that are set and hold a path, of those that older seals are not of."""
    for section, keys in _NAMED_LATER.items():
        values = _section(config, section)
        yield from ((section, key) for key in keys if values.get(key) is not None)
    for section, group in _GROUPS.items():
        values = _section(config, section)
        if not any(part.is_ours and part.name == values.get("name") for part in installed(group)):
            known = (*_NAMED.get(section, ()), *_NAMED_LATER.get(section, ()))
            yield from ((section, key) for key in values if key not in known and _has_path(values[key]))


def _has_path(value: Any) -> bool:
    return any(PurePath(word).name != word or word.startswith("~") for word in words_in(value))


def _is_path(key: str, value: Any) -> bool:
    # A file of priors is looked for in the dataset's folder: as a plain name it stays there.
    return value is not None and not (key == "prior_file" and PurePath(str(value)).name == value)


def _section(config: dict[str, Any], name: str) -> dict[str, Any]:
    section: Any = config
    for key in name.split("."):
        section = section.get(key) if isinstance(section, dict) else None
    return section if isinstance(section, dict) else {}


def _unset(values: dict[str, Any], place: Sequence[str]) -> dict[str, Any]:
    first, *rest = place
    return {**values, first: _unset(values[first], rest) if rest else None}
