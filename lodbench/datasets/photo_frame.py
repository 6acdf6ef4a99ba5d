"""The frame that photos' places are brought to in a dataset, and what ``prior=sensor`` calls its settings."""

from __future__ import annotations

import re

from lodbench.citymodel.cache import open_cached_scene
from lodbench.datasets.map_frame import MapFrame
from lodbench.datasets.query import Dataset
from lodbench.errors import DatasetError


def photo_frame(dataset: Dataset) -> tuple[MapFrame, tuple[float, ...]]:
    """Returns the map frame of a dataset, and where its zero lies in it (east, north, up, metres).

    Raises:
        DatasetError: Nobody knows where it lies on Earth.
    """
    if dataset.photo_crs is not None:
        if dataset.photo_origin is None:
            raise DatasetError(
                f"Where {dataset.name} lies on Earth is withheld by its publishers.",
                f"Set dataset.origin='[EAST,NORTH,HEIGHT]' in {dataset.photo_crs}, or use prior=file.",
            )
        return MapFrame(dataset.photo_crs), dataset.photo_origin
    crs = None
    if dataset.city_model is not None:
        crs = open_cached_scene(
            dataset.city_model, lod=dataset.lod, options=dataset.city_options, roof_height=dataset.roof_height
        ).crs
    if crs is None:
        raise DatasetError(
            f"Where {dataset.name} lies on Earth is not known: its city model names no reference system.",
            "Set dataset.crs=EPSG:CODE, or use prior=file.",
        )
    return MapFrame(crs), (0.0, 0.0, 0.0)


def in_settings(text: str) -> str:
    """Returns what is said of heights, told in flags, with the settings of ``prior=sensor``.

    Example:
        >>> in_settings("Leave --takeoff or --heights sea_level out.")
        'Leave prior.takeoff_m or prior.heights=sea_level out.'
    """
    named = re.sub(r"(?<![\w.])(--heights |heights=)(?=\w)", "prior.heights=", text)
    for flag, name in (("--takeoff", "takeoff_m"), ("--geoid", "geoid_m"), ("--height-offset", "offset_m")):
        named = named.replace(flag, f"prior.{name}")
    return re.sub(r"(prior\.\w+) METRES", r"\1=METRES", named)
