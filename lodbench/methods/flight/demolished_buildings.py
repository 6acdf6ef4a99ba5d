"""Buildings that stand in the map only, and what findings about the map rest on.

Of each building, how much of what a photo should show of it its mask holds: next to nothing in all photos is
gone. Networks miss small buildings for reasons of their own, so it counts how often this flight's masks miss
other buildings as small as that. Masks of a network err alike in photos that look alike. A building whose
mapped roof lies on the edges of photos from different sides stands as the map has it, whatever masks say; one
that is gone must show by edges that it is: where it stood, two photos have no more edges on its lines than by
chance.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene, building_boxes
from lodbench.datasets.query import Query
from lodbench.estimation.edge_alignment import LensErrors, ModelLines, lines_in_view, project_lines
from lodbench.geometry import Camera, Pose
from lodbench.geometry.pose import pose_from_vector
from lodbench.methods.assessment import FEWEST_POINTS, edge_excess
from lodbench.methods.flight.aligning import EdgePhoto, edge_photo
from lodbench.segmentation import binary_mask

Floats = NDArray[np.float64]

# Photos look at a place from different sides whose directions are so far apart there, degrees.
APART_DEG = 20.0
# A mapped roof stands whose lines lie on edges by this share of them more often than by chance.
_STANDS = 0.2
# One that is gone lies on edges no more often than by chance, but for this share, in so many photos at least.
_GONE_EXCESS, _WITNESSES = 0.1, 2
# Points of lines, pixels apart; those that a wrong height would move by less say nothing of it, pixels.
_SPACING_PX, _MOVED_PX = 3.0, 5.0
# Bases of walls are no evidence, as in the whole flight.
_LOWEST_RISE = 0.2


def apart_deg(place: Floats, centers: Floats) -> float:
    """Returns the largest angle at a place, (3,), between cameras, (N, 3), degrees; 0 for fewer than two."""
    if len(centers) < 2:
        return 0.0
    away = centers - place
    away = away / np.maximum(np.linalg.norm(away, axis=1), 1e-9)[:, None]
    return float(np.degrees(np.arccos(np.clip(away @ away.T, -1.0, 1.0).min())))


def roof_middles(scene: Scene) -> dict[int, Floats]:
    """Returns the middle of each building's box at its top, (3,) scene metres, by row."""
    low, high, building = building_boxes(scene)
    middles = np.column_stack([0.5 * (low + high)[:, :2], high[:, 2]])
    return dict(zip(building.tolist(), middles, strict=True))


def without_contradicted(
    findings: dict[str, Any], queries: Sequence[Query], vectors: Floats, lens: Floats, city_map: CityMap
) -> dict[str, Any]:
    """Returns a flight's findings, as of ``findings_of``, without those that edges of its photos contradict.

    Photos were taken at (P, 6), metres and degrees, with a lens that differs in the order of ``LensErrors``.
    """
    rows = {name: row for row, name in enumerate(city_map.scene.building_ids)}
    doubted = {rows[b["id"]]: float(b["higher_m"]) for b in findings["buildings"] if b["doubt"]}
    gone = {rows[c["id"]]: None for c in findings["changes"] if c["kind"] == "demolished"}
    standing = _standing({**doubted, **gone}, queries, vectors, lens, city_map)
    ids = {city_map.scene.building_ids[row] for row in standing}
    return {
        **findings,
        "buildings": [{**b, "doubt": b["doubt"] and b["id"] not in ids} for b in findings["buildings"]],
        "changes": [c for c in findings["changes"] if c.get("id") not in ids],
    }


def _standing(
    claims: Mapping[int, float | None],
    queries: Sequence[Query],
    vectors: Floats,
    lens: Floats,
    city_map: CityMap,
) -> set[int]:
    """Returns the buildings that stand as mapped by the edges of photos, or are not shown to be gone.

    Claims are by row: how much higher than mapped a building is said to be, metres; None for gone.
    """
    if not claims:
        return set()
    excesses: dict[int, list[tuple[int, float, float]]] = {row: [] for row in claims}
    errors, has_edges = LensErrors(*(float(v) for v in lens[:4])), False
    for k, query in enumerate(queries):
        photo = edge_photo(query, city_map)
        if photo is None:
            continue
        has_edges = True
        camera = errors.pinhole(photo.camera)
        lines = lines_in_view(city_map, camera, pose_from_vector(vectors[k]), _SPACING_PX)
        lines = lines.of(lines.relative_heights > _LOWEST_RISE)
        shows = _excess(photo, lines, vectors[k], errors, 0.0) is not None
        for row in np.intersect1d(lines.buildings, list(claims)).tolist():
            own = lines.of(lines.buildings == row)
            pair = _excesses(photo, own, vectors[k], errors, claims[row])
            if pair is None and claims[row] is None and shows and len(own.points) >= FEWEST_POINTS:
                # Not one edge near its lines, in a photo that has edges on others.
                pair = 0.0, 0.0
            if pair is not None:
                excesses[row].append((k, *pair))
    middles = roof_middles(city_map.scene)
    if not has_edges:
        return set()
    return {
        row
        for row, photos in excesses.items()
        if _stands(photos, middles[row], vectors[:, :3]) or (claims[row] is None and not _is_gone(photos))
    }


def _is_gone(photos: Sequence[tuple[int, float, float]]) -> bool:
    """Returns whether several photos have no edges where a building stood."""
    return len(photos) >= _WITNESSES and bool(np.mean([excess for _, excess, _ in photos]) < _GONE_EXCESS)


def _stands(photos: Sequence[tuple[int, float, float]], place: Floats, centers: Floats) -> bool:
    """Returns whether a building stands as mapped, given photos: number, excess as mapped, and as claimed."""
    if not photos:
        return False
    as_mapped, as_claimed = np.mean([photo[1:] for photo in photos], axis=0)
    showing = [k for k, mapped, _ in photos if mapped > _STANDS]
    return bool(as_mapped > max(_STANDS, as_claimed) and apart_deg(place, centers[showing]) >= APART_DEG)


def _excesses(
    photo: EdgePhoto, lines: ModelLines, vector: Floats, errors: LensErrors, higher_m: float | None
) -> tuple[float, float] | None:
    """Returns how much more than by chance a building's lines lie on edges, as mapped and as claimed.

    None where too few of its lines are in view, or such as would not move.
    """
    if higher_m is not None:
        laid = project_lines(lines.points, lines.along, photo.camera, vector, errors)
        lines = lines.of(np.abs(laid.by_place[:, 2] * lines.relative_heights * higher_m) > _MOVED_PX)
    mapped = _excess(photo, lines, vector, errors, 0.0)
    claimed = 0.0 if higher_m is None else _excess(photo, lines, vector, errors, higher_m)
    return None if mapped is None or claimed is None else (mapped, claimed)


def _excess(
    photo: EdgePhoto, lines: ModelLines, vector: Floats, errors: LensErrors, higher_m: float
) -> float | None:
    points = lines.points.copy()
    points[:, 2] += lines.relative_heights * higher_m
    laid = project_lines(points, lines.along, photo.camera, vector, errors)
    inside = ((laid.pixels > 0) & (laid.pixels < (photo.camera.width, photo.camera.height))).all(axis=1)
    parts = {name: getattr(laid, name)[inside] for name in laid.__slots__}
    return edge_excess(photo.edges, replace(laid, **parts))


Mask = NDArray[np.bool_]

# Less of a building than this says nothing, pixels; a mask that holds less of one than this misses it.
_LEAST_PX, _MISSED = 25, 0.3
# How often a mask shows nothing of a building that is gone: not where neighbours or false patches grow over.
_MISSED_IF_GONE = 0.93
# Share of buildings that are gone beforehand, how many photos of a flight are worth one, what is reported.
_GONE, _HEAT, _SURE = 0.03, 2.0, 0.9
_FEWEST_PHOTOS = 3
# Buildings are as large as each other within a factor of two, in steps of this, octaves of pixels.
_SIZE_STEP = 0.25


# Photos are compared at this width, pixels.
_VIEW_WIDTH = 301


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A photo of a flight, where it was found to be taken."""

    name: str  # of the photo
    camera: Camera  # the lens it was found to have, of the working size
    pose: Pose  # scene frame
    mask: NDArray[np.bool_]  # (H, W) what it shows of buildings


def views_of(queries: Sequence[Query], poses: Sequence[Pose], focal: float) -> list[View]:
    """Returns photos at their poses, to be compared with the map, their focal length so much longer."""
    views = []
    for query, pose in zip(queries, poses, strict=True):
        whole = query.camera
        small = whole.scaled_to_width(_VIEW_WIDTH)
        camera = LensErrors(focal).pinhole(small)
        views.append(View(query.name, camera, pose, binary_mask(query.mask, small.width, small.height)))
    return views


def demolished_buildings(views: Sequence[View], city_map: CityMap) -> list[dict[str, Any]]:
    """Returns the map's buildings that photos do not show, the surest first.

    Eq. (F23) of docs/methods/flight.md. Each with ``id``, ``probability``, the ``photos`` that should show it
    and do not, and ``apart_deg`` between the directions that they look from: photos from one side err alike.
    """
    per_view = [shares_held(view, city_map) for view in views]
    rows = [(building, k, pixels, held) for k, one in enumerate(per_view) for building, pixels, held in one]
    if not rows:
        return []
    building, photo, pixels, held = (np.array(column) for column in zip(*rows, strict=True))
    missed, size = held < _MISSED, np.round(np.log2(pixels) / _SIZE_STEP).astype(np.int64)
    shares = {step: _shares_missed(building, missed, size, step) for step in np.unique(size).tolist()}
    centers, places = np.array([view.pose.center for view in views]), roof_middles(city_map.scene)
    changes = []
    for each in np.unique(building):
        mine = building == each
        apart = apart_deg(places[int(each)], centers[photo[missed & mine]])
        if np.count_nonzero(missed & mine) < _FEWEST_PHOTOS or apart < APART_DEG:
            continue
        # Other buildings about as large, each counted once however many photos show it.
        odds = 0.0
        for (step, is_missed), times in Counter(zip(size[mine], missed[mine], strict=True)).items():
            names, of_names = shares[int(step)]
            rate = _rate(of_names[names != each])
            gone, there = (_MISSED_IF_GONE, rate) if is_missed else (1.0 - _MISSED_IF_GONE, 1.0 - rate)
            odds += times * np.log(gone / there)
        odds = odds / _HEAT + np.log(_GONE / (1.0 - _GONE))
        probability = float(1.0 / (1.0 + np.exp(-odds)))
        if probability > _SURE:
            photos = [views[k].name for k in photo[mine & missed]]
            name = city_map.scene.building_ids[each]
            changes.append(
                {
                    "kind": "demolished",
                    "id": name,
                    "probability": probability,
                    "photos": photos,
                    "apart_deg": apart,
                }
            )
    return sorted(changes, key=lambda change: -change["probability"])


def shares_held(view: View, city_map: CityMap) -> list[tuple[int, int, float]]:
    """Returns of each building in view its row, the pixels only it covers, and which share the mask holds."""
    (instances,) = city_map.instances(view.camera, view.pose.rotation[None], view.pose.center[None])
    covers = np.zeros(view.mask.shape, dtype=np.int32)
    crops = [instances.crop(k) for k in range(len(instances))]
    for shape, top, left in crops:
        covers[top : top + shape.shape[0], left : left + shape.shape[1]] += shape
    shares = []
    for row, (shape, top, left) in zip(instances.buildings, crops, strict=True):
        window = slice(top, top + shape.shape[0]), slice(left, left + shape.shape[1])
        alone = shape & (covers[window] == 1)
        count = int(np.count_nonzero(alone))
        if count >= _LEAST_PX:
            shares.append((int(row), count, float(np.count_nonzero(alone & view.mask[window])) / count))
    return shares


def _shares_missed(
    building: NDArray[np.int64], missed: Mask, size: NDArray[np.int64], step: int
) -> tuple[NDArray[np.int64], Floats]:
    """Returns the buildings seen about as large, and in which share of these photos each is missed."""
    like = np.abs(size - step) < 1.0 / _SIZE_STEP
    names, index, counts = np.unique(building[like], return_inverse=True, return_counts=True)
    return names, np.bincount(index, weights=missed[like], minlength=len(names)) / counts


def _rate(shares: Floats) -> float:
    """Returns how often masks miss buildings, given each one's share of photos; never 0 or 1."""
    if len(shares) == 0:
        return 0.2
    # Those that no photo shows may be gone themselves.
    standing = shares[shares < _MISSED_IF_GONE - 0.05] if (shares < 0.5).any() else shares
    return float((0.2 + standing.sum()) / (1.0 + len(standing)))
