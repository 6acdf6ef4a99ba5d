"""Cities made from a city: some of its buildings, one level, another reference system, LoD1 from LoD2.

LoD1 is the footprint of each building drawn up to one height, by a rule (``derive_lod1``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.cleaning import drop_repeats, frame_origin
from lodbench.citymodel.codes import LOD_DERIVED, LOD_UNDERIVABLE
from lodbench.citymodel.crs import require_crs
from lodbench.citymodel.extrude import extrude, raise_flat
from lodbench.citymodel.frame import require_true_to_scale
from lodbench.citymodel.model import (
    CityModel,
    Polygons,
    SurfaceKind,
    has_lod,
    is_flat,
    outer_parts,
    select_polygons,
    starts_of,
    take_segments,
)
from lodbench.citymodel.triangulate import MAX_CORNERS, newell, polygons_at, triangulate
from lodbench.errors import CityModelError, ConfigError, nearest_names
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


AT_EAVES = "eave"
ROOF_HEIGHTS: dict[str, float] = {"median": 0.5, "max": 1.0, "p70": 0.7, AT_EAVES: 0.0}

# Faces flatter than this against the vertical (cosine) are roofs or floors, the others walls.
_MIN_SLOPE = 0.1
_GRID_M, _MIN_PLAN_M2 = 1e-3, 1e-3
# Middles of the 16 equal parts of a triangle: heights of a roof are spread as its area is.
_SAMPLES = np.array(
    [(i + t, j + t) for t in (1 / 3, 2 / 3) for i in range(4) for j in range(4) if i + j + 2 * t < 4.0]
) / np.array(4.0)


def require_rule(roof_height: str) -> None:
    """Makes sure that a rule is known.

    Raises:
        ConfigError: It is not.
    """
    if roof_height not in ROOF_HEIGHTS:
        raise ConfigError(f"roof_height={roof_height} is unknown.", f"Known: {', '.join(ROOF_HEIGHTS)}.")


def derive_lod1(model: CityModel, roof_height: str, findings: Findings) -> Polygons:
    """Returns block polygons of level 1 for every building of the lowest finer level.

    The footprint is the building's ground surfaces; where it has none, the faces that look down;
    where there are none either, its roofs viewed from above; dissolved, so that no wall stands between
    two of them. Every part of a building is a block of its own, as published LoD1 models have it, unless
    one of them has no roof: then the building is one block. A block stands on its lowest point and reaches
    one height, taken over the area of its roofs: ``max`` the highest point, ``median`` and ``p70`` the
    height that half and 70 % of the roof area stay below, ``eave`` the lowest point of the roofs.
    A building of which there is no more than a footprint or the edge of its roof (LoD0) is a block of the
    height that its source states, whatever the rule.

    Returns:
        Polygons whose ``lod`` is 0: the only level of a model with ``lods=("1",)``.

    Raises:
        ConfigError: The rule is unknown.
        CityModelError: The model has no finer level and no heights, or no building gives a block.
    """
    require_rule(roof_height)
    finer = _finer_level(model)
    origin = f"LoD{finer}" if finer in model.lods else "heights in the source"
    model = raise_flat(model, finer)
    plans, owner, bottom, top, building_of, partly = _blocks(model, finer, ROOF_HEIGHTS[roof_height])
    for building in np.setdiff1d(np.arange(len(model.building_ids)), building_of[owner]):
        findings.add(LOD_UNDERIVABLE, model.building_ids[building], f"from LoD{finer}")
    for building in np.intersect1d(partly, building_of[owner]):
        findings.add(
            LOD_UNDERIVABLE, model.building_ids[building], "a footprint too large to cut is left out"
        )
    if len(owner) == 0:
        raise CityModelError(
            "No building has a footprint and a roof to derive level 1 from.",
            "Take a level that is there: lodbench city info FILE.",
        )
    findings.add(LOD_DERIVED, "", f"from {origin}, roof_height={roof_height}")
    points, ring_starts, polygon_starts = _flat(plans)
    blocks = extrude(points, ring_starts, polygon_starts, bottom[owner], top[owner])
    own = owner[blocks.footprint]
    return Polygons(
        points=blocks.points,
        ring_starts=starts_of(blocks.ring_lengths),
        polygon_starts=starts_of(blocks.ring_counts),
        building=building_of[own].astype(np.int32),
        lod=np.zeros(len(blocks.kind), np.int16),
        kind=blocks.kind,
        part=None if model.polygons.part is None else own.astype(np.int32),
    )


def part_blocks(
    model: CityModel, lod: str
) -> tuple[NDArray[Any], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Returns what every building part fills for certain: from its bottom to the lowest of its roof.

    Returns:
        plans: (N,) shapely polygons, local frame.
        owner: (N,) object each belongs to.
        bottom, top: (O,) heights by object.
    """
    plans, owner, bottom, top, *_ = _blocks(model, lod, ROOF_HEIGHTS[AT_EAVES])
    return plans, owner, bottom, top


def _blocks(
    model: CityModel, lod: str, share: float
) -> tuple[
    NDArray[Any],
    NDArray[np.int64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.int64],
    NDArray[np.int32],
]:
    """Returns plans, the block of each; bottom, top, building of every block; buildings that lack a plan."""
    source = _outside(model, lod)
    normals, areas = newell(source)
    slope = normals[:, 2] / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)
    block, building_of = _block_of(model, source, slope)
    count = len(building_of)
    bottom = np.full(count, np.inf)
    np.minimum.at(bottom, np.repeat(block, _point_counts(source)), source.points[:, 2])
    top = _roof_heights(source, block, slope, count, share)
    chosen = _footprints(source, block, slope, areas, count)
    chosen = chosen[np.isfinite(top)[block[chosen]]]
    is_cut = _point_counts(source)[chosen] <= MAX_CORNERS
    partly = np.unique(source.building[chosen[~is_cut]])
    chosen = chosen[is_cut]
    plans, owner = _dissolve(select_polygons(source, chosen), block[chosen])
    return plans, owner, bottom, top, building_of, partly


def _block_of(
    model: CityModel, polygons: Polygons, slope: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the block each polygon goes into, and the building of each block."""
    objects = model.objects
    if polygons.part is None or objects is None:
        return polygons.building.astype(np.int64), np.arange(len(model.building_ids))
    block = outer_parts(objects)[polygons.part].astype(np.int64)
    count = len(objects)
    has_roof = np.bincount(block[_are_roofs(polygons, block, slope, count)], minlength=count) > 0
    is_roofless = np.bincount(block, minlength=count).astype(bool) & ~has_roof
    is_whole = np.zeros(len(model.building_ids), np.bool_)
    is_whole[objects.building[is_roofless]] = True
    root = np.zeros(len(model.building_ids), np.int64)
    is_root = objects.parents < 0
    root[objects.building[is_root]] = np.flatnonzero(is_root)
    return np.where(is_whole[polygons.building], root[polygons.building], block), objects.building.astype(
        np.int64
    )


def _are_roofs(
    polygons: Polygons, block: NDArray[np.int64], slope: NDArray[np.float64], count: int
) -> NDArray[np.bool_]:
    """Returns which polygons are roofs: by their kind, and in blocks without such those that look up."""
    is_roof = polygons.kind == SurfaceKind.ROOF
    has_roof = np.bincount(block[is_roof], minlength=count) > 0
    result: NDArray[np.bool_] = is_roof | (~has_roof[block] & (slope > _MIN_SLOPE))
    return result


def _dissolve(plans: Polygons, block: NDArray[np.int64]) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Returns the plan of each block without inner edges, as shapely polygons, and the block of each.

    Points are rounded to a millimetre, so that edges meet that were drawn twice.
    """
    import shapely

    ends = np.cumsum(np.diff(plans.ring_starts))
    closed = np.insert(plans.points[:, :2], ends, plans.points[plans.ring_starts[:-1], :2], axis=0)
    ring = np.repeat(np.arange(len(ends)), np.diff(plans.ring_starts) + 1)
    rings = shapely.linearrings(closed, indices=ring)
    polygon = np.repeat(np.arange(len(plans)), np.diff(plans.polygon_starts))
    shapes = shapely.make_valid(shapely.polygons(rings, indices=polygon))
    shapes = shapely.set_precision(shapes, _GRID_M)
    order = np.argsort(block, kind="stable")
    cuts = np.flatnonzero(np.diff(block[order])) + 1
    groups = np.split(order, cuts) if len(order) else []
    merged = [shapely.union_all(shapes[group], grid_size=_GRID_M) for group in groups]
    owners = np.asarray([block[group[0]] for group in groups], np.int64)
    shapes, index = shapely.get_parts(np.asarray(merged, object), return_index=True)
    is_area = (shapely.get_type_id(shapes) == shapely.GeometryType.POLYGON) & (
        shapely.area(shapes) > _MIN_PLAN_M2
    )
    return shapes[is_area], owners[index[is_area]]


def _flat(plans: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Returns shapely polygons as points (P, 2), ring and polygon starts; rings are not closed."""
    import shapely

    _, points, (ring_starts, polygon_starts) = shapely.to_ragged_array(plans, include_z=False)
    is_last = np.zeros(len(points), np.bool_)
    is_last[ring_starts[1:] - 1] = True
    starts = np.asarray(ring_starts, np.int64) - np.arange(len(ring_starts))
    return points[~is_last], starts, np.asarray(polygon_starts, np.int64)


def _finer_level(model: CityModel) -> str:
    """Returns the lowest level above 1; without one, "2" if heights of flat buildings are known."""
    finer = [name for name in model.lods if name and name[0] in "234"]
    if not finer and is_flat(model).any():
        return "2"
    if not finer:
        raise CityModelError(
            "There is no level of detail 2 or finer to derive level 1 from.",
            "See the levels there are: lodbench city info FILE.",
        )
    return finer[0]


def _outside(model: CityModel, lod: str) -> Polygons:
    """Returns the outer polygons of a level."""
    at_level = model.polygons.lod == model.lods.index(lod)
    is_outside = model.polygons.kind != SurfaceKind.INTERIOR
    return select_polygons(model.polygons, np.flatnonzero(at_level & is_outside))


def _point_counts(polygons: Polygons) -> NDArray[np.int64]:
    return np.diff(polygons.ring_starts[polygons.polygon_starts])


def _roof_heights(
    polygons: Polygons, block: NDArray[np.int64], slope: NDArray[np.float64], count: int, share: float
) -> NDArray[np.float64]:
    """Returns (count,) the height below which a share of each block's roof area lies, or NaN."""
    chosen = np.flatnonzero(_are_roofs(polygons, block, slope, count))
    roofs = select_polygons(polygons, chosen)
    mesh = triangulate(roofs, ("",) * (int(roofs.building.max(initial=-1)) + 1), Findings())
    building = block[chosen][mesh.polygon]
    corners = roofs.points[mesh.triangles]
    vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if share in (0.0, 1.0):
        heights, weights, owner = (
            corners[..., 2].reshape(-1),
            np.ones(corners.size // 3),
            np.repeat(building, 3),
        )
    else:
        z = corners[..., 2]
        spread = z[:, :1] + (z[:, 1:] - z[:, :1]) @ _SAMPLES.T
        heights, owner = spread.reshape(-1), np.repeat(building, len(_SAMPLES))
        weights = np.repeat(np.abs(vectors[:, 2]), len(_SAMPLES))
    order = np.lexsort((heights, owner))
    heights, weights, owner = heights[order], weights[order], owner[order]
    bounds = np.searchsorted(owner, np.arange(count + 1))
    result = np.full(count, np.nan)
    for b in np.flatnonzero(np.diff(bounds)):
        part = slice(bounds[b], bounds[b + 1])
        total = np.cumsum(weights[part])
        # Each sample stands at the middle of its share of the area.
        result[b] = np.interp(share * total[-1], total - 0.5 * weights[part], heights[part])
    return result


def _footprints(
    polygons: Polygons,
    block: NDArray[np.int64],
    slope: NDArray[np.float64],
    areas: NDArray[np.float64],
    count: int,
) -> NDArray[np.int64]:
    """Returns the polygons that make each block's footprint, by the best source it has."""
    is_open = np.ones(count, np.bool_)
    chosen = np.zeros(len(polygons), np.bool_)
    has_plan_area = (np.abs(slope) > _MIN_SLOPE) & (areas > 0)
    for is_candidate in (
        polygons.kind == SurfaceKind.GROUND,
        (slope < -_MIN_SLOPE) & (polygons.kind == SurfaceKind.UNKNOWN),
        (polygons.kind == SurfaceKind.ROOF) | (slope > _MIN_SLOPE),
    ):
        fits = is_candidate & has_plan_area & is_open[block]
        chosen |= fits
        is_open[block[fits]] = False
    return np.flatnonzero(chosen)
