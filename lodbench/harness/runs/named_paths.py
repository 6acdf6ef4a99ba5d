"""The paths that a run folder names: opened again if this user's own run names them, and not otherwise."""

from __future__ import annotations

from pathlib import PurePath
from typing import Any

from lodbench.storage.seal import is_sealed

# Settings of a configuration's sections that hold a path, and are not the dataset's root and city.
_NAMED = {
    "dataset": ("references", "textured_map", "prior_file"),
    "segmenter": ("weights", "encoder_weights"),
}


def named_by(provenance: dict[str, Any], config: dict[str, Any]) -> list[Any]:
    """Returns what a run's seal is of: all paths in its provenance and its configuration."""
    in_config = [_section(config, section).get(key) for section, keys in _NAMED.items() for key in keys]
    return [provenance.get("dataset_root"), provenance.get("city_model"), *in_config]


def is_own(provenance: dict[str, Any], config: dict[str, Any]) -> bool:
    """Tells whether the run was made with this user's cache, so that the paths it names are this user's."""
    return is_sealed(named_by(provenance, config), provenance.get("seal"))


def without_paths(config: dict[str, Any]) -> dict[str, Any]:
    """Returns a configuration that names no path: those it names count as not set."""
    cleared = dict(config)
    for section, keys in _NAMED.items():
        named = {key for key in keys if _is_path(key, _section(config, section).get(key))}
        if named:
            cleared[section] = {**config[section], **dict.fromkeys(named)}
    return cleared


def _is_path(key: str, value: Any) -> bool:
    # A file of priors is looked for in the dataset's folder: as a plain name it stays there.
    return value is not None and not (key == "prior_file" and PurePath(str(value)).name == value)


def _section(config: dict[str, Any], name: str) -> dict[str, Any]:
    section = config.get(name)
    return section if isinstance(section, dict) else {}
