"""Cities as scene folders: written with what was met on the way, and opened as they were made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.citymodel.crs import is_same_plane, require_crs
from lodbench.citymodel.lifespans import Period, date_in, period_of
from lodbench.citymodel.options import ReadOptions, made_with
from lodbench.citymodel.scale import is_true_to_scale
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.scene_file import read_scene, write_scene
from lodbench.errors import CityModelError
from lodbench.findings import Findings

# Mercator of the whole world: what is read in it now is projected anew, away from the equator.
_WORLD = "EPSG:3857"


@dataclass(frozen=True, slots=True)
class OpenCity:
    """A scene, and what was met on the way to it; the same whether it was read or came from the cache.

    Attributes:
        scene: The triangles.
        findings: Code and name to count, of reading and of meshing.
        area_m2: Newell area of the polygons meshed.
        lost_m2: Area no triangle covers.
        period: As of ``CityModel``.
    """

    scene: Scene
    findings: dict[str, int]
    area_m2: float
    lost_m2: float
    period: Period | None = None

    def notes(self) -> tuple[str, ...]:
        """Returns what a reader of results must know of the city: its findings, and any area lost."""
        counts = ", ".join(f"{count} x {name}" for name, count in self.findings.items())
        lines = [f"city model: {counts} (see lodbench city check)"] if counts else []
        if self.period is not None:
            lines.append(f"city model: as it stood on {date_in(self.period)}; some of it ends or ended")
        if self.lost_m2 > 0.005:
            lines.append(f"city model: {self.lost_m2:.2f} of {self.area_m2:.2f} m2 could not be meshed")
        return tuple(lines)


def store_city(
    city: OpenCity,
    folder: Path,
    survives_power_cut: bool = True,
    made: Mapping[str, Any] | None = None,
) -> None:
    """Writes a city as a scene folder that remembers its findings, and how it was made; see ``write_scene``.

    Args:
        city: The city.
        folder: Where.
        survives_power_cut: As for ``write_scene``.
        made: As of ``made_with``; None for a scene that does not say.

    Raises:
        OSError: As for ``write_scene``.
    """
    low, high = (corner + city.scene.origin for corner in city.scene.extent_m)
    extra = {
        "findings": city.findings,
        "area_m2": city.area_m2,
        "lost_m2": city.lost_m2,
        "extent": [low.tolist(), high.tolist()],
        "triangles": len(city.scene.triangles),
    } | ({} if made is None else {"made_with": dict(made)})
    if city.period is not None:
        extra["period"] = list(city.period)
    write_scene(city.scene, folder, extra, survives_power_cut)


def open_scene_folder(
    folder: Path, lod: str | None, options: ReadOptions, roof_height: str | None
) -> OpenCity:
    """Returns a scene that was converted: what was asked for then stays.

    Raises:
        CityModelError: It is damaged, of another level of detail or reference system than asked for, made
            with other options, or was written when Mercator of the whole world was taken as metres.
    """
    city, made = _load_told(folder)
    again, crs = "Convert the file it was made from again", options.crs
    if made is not None:
        _require_made_so(folder, made, made_with(options, roof_height))
    if lod is not None and lod != city.scene.lod:
        raise CityModelError(
            f"{folder} holds level of detail {city.scene.lod or 'none'}, not {lod}.", f"{again}."
        )
    own = city.scene.crs
    # Degrees and feet of the file were projected when the scene was made, to a system of another name.
    is_other = crs is not None and require_crs(crs).is_metric and (own is None or not is_same_plane(own, crs))
    if is_other:
        raise CityModelError(
            f"{folder} is in {own or 'no reference system that is known'}, not in {crs}.",
            f"{again}, with `crs={crs}`.",
        )
    if own is not None and own.startswith(_WORLD) and not _is_true_to_scale(city.scene, own):
        raise CityModelError(f"{folder} is in {own}, whose metres are no metres there.", f"{again}.")
    return city


def _require_made_so(folder: Path, made: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """Makes sure that a scene was made with all that is asked for now (``made_with``).

    Raises:
        CityModelError: It was not, and is what it is.
    """
    for name, value in asked.items():
        # A level that was there needed no rule.
        if value != made.get(name, value if name == "roof_height" else None):
            how = f"with {name}={_text(made[name])}" if name in made else f"without {name}"
            raise CityModelError(
                f"{folder} is a scene made {how}: {name}={_text(value)} would change nothing now.",
                f"Leave {name} out, or convert the file it was made from again.",
            )


def _text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def _is_true_to_scale(scene: Scene, crs: str) -> bool:
    middle = scene.origin[:2] + np.mean(scene.extent_m, axis=0)[:2]
    return is_true_to_scale(require_crs(crs), middle, Findings())


def load_city(folder: Path) -> OpenCity:
    """Returns the city of a scene folder.

    Raises:
        CityModelError: It is damaged.
    """
    return _load_told(folder)[0]


def _load_told(folder: Path) -> tuple[OpenCity, dict[str, Any] | None]:
    """Returns a stored city, and how it was made (``made_with``): None where it does not say."""
    scene, extra = read_scene(folder)
    try:
        findings = {str(name): int(count) for name, count in extra["findings"].items()}
        period = period_of(extra.get("period"))
        city = OpenCity(scene, findings, float(extra["area_m2"]), float(extra["lost_m2"]), period)
        return city, None if "made_with" not in extra else dict(extra["made_with"])
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise CityModelError(f"The scene in {folder} is damaged ({error}).", "Delete the folder.") from None
