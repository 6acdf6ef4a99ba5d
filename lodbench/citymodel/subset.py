"""Parts of a city: some of its buildings, one level of detail, another reference system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.cleaning import drop_repeats, frame_origin
from lodbench.citymodel.crs import require_crs
from lodbench.citymodel.derive import derive_lod1
from lodbench.citymodel.frame import require_true_to_scale
from lodbench.citymodel.model import CityModel, has_lod, select_polygons, take_segments
from lodbench.citymodel.triangulate import polygons_at
from lodbench.errors import CityModelError, nearest_names
from lodbench.findings import Findings


def keep_level(model: CityModel, lod: str, roof_height: str | None, findings: Findings) -> CityModel:
    """Returns a city with one level of detail only, derived where it is absent and a rule is given.

    Raises:
        CityModelError: The level is absent.
    """
    if roof_height is not None and not has_lod(model.lods, lod) and lod.lower().removeprefix("lod") == "1":
        blocks = derive_lod1(model, roof_height, findings)
        return replace(
            model, lods=("1",), polygons=blocks, polygons_read=(len(blocks),), solids=None, polygon_ids=()
        )
    _, is_chosen = polygons_at(model, lod, findings)
    kept = np.flatnonzero(is_chosen)
    used = np.unique(model.polygons.lod[kept])
    rank = np.zeros(len(model.lods), np.int16)
    rank[used] = np.arange(len(used))
    model = _keep_polygons(model, kept)
    return replace(
        model,
        polygons=replace(model.polygons, lod=rank[model.polygons.lod]),
        lods=tuple(model.lods[n] for n in used),
        polygons_read=tuple(model.polygons_read[n] for n in used),
    )


def drop_repeats_of_mesh(model: CityModel, findings: Findings) -> CityModel:
    """Returns a city as CityGML and CityJSON have it: no polygon twice in a building at a level.

    A mesh keeps such polygons when it is read, since its triangles are all it has. Other cities lost them
    there, and are returned as they are.
    """
    if model.lods != ("",):
        return model
    _, _, kept = drop_repeats(model.polygons, model.building_ids, findings)
    return model if len(kept) == len(model.polygons) else _keep_polygons(model, kept)


def choose_buildings(
    model: CityModel,
    *,
    ids: Sequence[str] = (),
    bbox: tuple[float, float, float, float] | None = None,
    where: Sequence[tuple[str, str]] = (),
) -> CityModel:
    """Returns a city with the buildings that fulfil all conditions.

    Args:
        model: The city; read with ``ReadOptions(has_details=True)`` where attributes are requested.
        ids: Ids to keep, all where empty.
        bbox: West, south, east, north in the model's reference system: buildings whose middle lies inside.
        where: Attributes and their values as text; the building or one of its parts has them.

    Raises:
        CityModelError: An id is not there, or no building is left.
    """
    is_kept = np.ones(len(model.building_ids), np.bool_)
    hint = "See what there is: lodbench city info FILE."
    if ids:
        number = {name: n for n, name in enumerate(model.building_ids)}
        for name in ids:
            if name not in number:
                raise CityModelError(
                    f"There is no building {name!r}.", nearest_names(name, list(number)[:10_000])
                )
        is_kept &= np.isin(np.arange(len(is_kept)), [number[name] for name in ids])
    if bbox is not None:
        low, high = footprint_boxes(model)
        middle = 0.5 * (low + high) + model.origin[:2]
        is_inside = np.all((middle >= bbox[:2]) & (middle <= bbox[2:]), axis=1)
        is_kept &= is_inside
        if not is_inside.any():
            hint = _where_it_is(model) or hint
    for key, value in where:
        is_kept &= _having(model, key, value)
    if not is_kept.any():
        raise CityModelError("No building fulfils the conditions.", hint)
    return model if is_kept.all() else keep_buildings(model, is_kept)


def _where_it_is(model: CityModel) -> str:
    """Returns the rectangle that a city's buildings lie in, in words; none without an outline."""
    low, high = footprint_boxes(model)
    is_there = np.isfinite(low).all(axis=1)
    if not is_there.any():
        return ""
    west, south = low[is_there].min(axis=0) + model.origin[:2]
    east, north = high[is_there].max(axis=0) + model.origin[:2]
    system = model.crs or "coordinates of its own, without a reference system"
    digits = 6 if max(abs(east), abs(north)) <= 360 else 0
    box = " ".join(f"{side:.{digits}f}" for side in (west, south, east, north))
    return f"The city's buildings lie in {box}, in {system}."


def require_same_heights(model: CityModel, crs: str) -> None:
    """Makes sure that a system to project to asks for no other heights: they stay as they are.

    Raises:
        CityModelError: It does, or is unknown.
    """
    target, own = require_crs(crs), None if model.crs is None else require_crs(model.crs).vertical_code
    if own is not None and target.metric_vertical_code not in (None, own):
        plane = target.horizontal.to_epsg()
        raise CityModelError(
            f"Heights stay as they are, and those of {model.crs} are not those of {crs}.",
            f"Name the plane alone: `--to-crs EPSG:{plane}`." if plane else "Name the plane alone.",
        )


def reproject(model: CityModel, crs: str) -> CityModel:
    """Returns a city in another metric reference system; heights stay as they are.

    Its findings say if it lies outside the area of that system, or where metres are off by a thousandth.

    Args:
        model: With a reference system.
        crs: Name of the other one, projected, in metres to the east and north.

    Raises:
        CityModelError: Either system is unknown, the other is not in metres, or its metres are off by more
            than a hundredth at the city, or points cannot be projected.
    """
    from pyproj import Transformer

    target = require_crs(crs)
    if model.crs is None:
        raise CityModelError(f"{model.source} names no reference system.", "Name it: `crs=EPSG:25832`.")
    if not target.is_metric:
        raise CityModelError(
            f"{crs} is not in metres to the east and north.", "Name a projected system, such as EPSG:25832."
        )
    source = require_crs(model.crs)
    transformer = Transformer.from_crs(source.horizontal, target.horizontal, always_xy=True)
    points = model.polygons.points + model.origin
    points[:, 0], points[:, 1] = transformer.transform(points[:, 0], points[:, 1])
    if not np.isfinite(points).all():
        raise CityModelError(f"Some coordinates cannot be projected to {crs}.", "Does it cover the city?")
    findings = Findings(list(model.findings.items))
    if len(points):
        require_true_to_scale(target, np.median(points[:, :2], axis=0), findings)
    origin = frame_origin(points)
    label = target.metric_label  # heights are in metres, whatever unit the name has
    if target.vertical_code is None and source.vertical_code is not None:
        label = f"{label}+{source.vertical_code}"
    polygons = replace(model.polygons, points=points - origin)
    return replace(model, crs=label, origin=origin, polygons=polygons, findings=findings)


def footprint_boxes(model: CityModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns (B, 2) lower and upper corners of all buildings; infinite where one has no polygon."""
    polygons = model.polygons
    owner = np.repeat(polygons.building, np.diff(polygons.ring_starts[polygons.polygon_starts]))
    low = np.full((len(model.building_ids), 2), np.inf)
    high = -low
    np.minimum.at(low, owner, polygons.points[:, :2])
    np.maximum.at(high, owner, polygons.points[:, :2])
    is_empty = ~np.isfinite(low)
    low[is_empty], high[is_empty] = np.inf, np.inf
    return low, high


def _having(model: CityModel, key: str, value: str) -> NDArray[np.bool_]:
    is_met = np.zeros(len(model.building_ids), np.bool_)
    objects = model.objects
    if objects is None or not objects.attributes:
        raise CityModelError(f"{model.source} has no attributes.", "Choose by id or by a bounding box.")
    names: set[str] = set()
    for building, attributes in zip(objects.building.tolist(), objects.attributes, strict=True):
        names |= attributes.keys()
        is_met[building] |= key in attributes and str(attributes[key]) == value
    if key not in names:
        raise CityModelError(f"No building has an attribute {key!r}.", nearest_names(key, names))
    return is_met


def keep_buildings(model: CityModel, is_kept: NDArray[np.bool_]) -> CityModel:
    """Returns a city with some buildings, numbered anew."""
    rank = np.cumsum(is_kept) - 1
    model = _keep_polygons(model, np.flatnonzero(is_kept[model.polygons.building]))
    polygons, objects, solids = model.polygons, model.objects, model.solids
    part = polygons.part
    if objects is not None:
        is_own = is_kept[objects.building]
        place = np.append(np.cumsum(is_own) - 1, -1)
        chosen = np.flatnonzero(is_own)
        if solids is not None:
            kept = np.flatnonzero(is_own[solids.part])
            shells, shell_starts = take_segments(solids.shell_starts, kept)
            faces, face_starts = take_segments(solids.face_starts, shells)
            solids = replace(
                solids,
                part=place[solids.part[kept]].astype(np.int32),
                composite=solids.composite[kept],
                shell_starts=shell_starts,
                face_starts=face_starts,
                faces=solids.faces[faces],
                is_flipped=solids.is_flipped[faces],
            )
        part = None if part is None else place[part].astype(np.int32)
        objects = replace(
            objects,
            ids=tuple(objects.ids[n] for n in chosen),
            types=tuple(objects.types[n] for n in chosen),
            parents=place[objects.parents[chosen]].astype(np.int32),
            building=rank[objects.building[chosen]].astype(np.int32),
            attributes=tuple(objects.attributes[n] for n in chosen) if objects.attributes else (),
        )
    num_parts = model.num_parts if objects is None else objects.types.count("BuildingPart")
    return replace(
        model,
        building_ids=tuple(name for name, is_own in zip(model.building_ids, is_kept, strict=True) if is_own),
        num_parts=num_parts,
        objects=objects,
        solids=solids,
        pitched=None if model.pitched is None else model.pitched[is_kept],
        measured_m=None if model.measured_m is None else model.measured_m[is_kept],
        polygons=replace(polygons, building=rank[polygons.building].astype(np.int32), part=part),
    )


def _keep_polygons(model: CityModel, kept: NDArray[np.int64]) -> CityModel:
    """Returns a city with some of its polygons; faces of solids that are gone become -1."""
    place = np.full(len(model.polygons) + 1, -1, np.int64)
    place[kept] = np.arange(len(kept))
    solids = model.solids
    return replace(
        model,
        polygons=select_polygons(model.polygons, kept),
        solids=None if solids is None else replace(solids, faces=place[solids.faces]),
        polygon_ids=tuple(model.polygon_ids[n] for n in kept.tolist()) if model.polygon_ids else (),
    )
