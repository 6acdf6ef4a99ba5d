"""Where buildings stand: models with a zero base set on the ground, walls drawn into it cut short."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import BASE_MOVED, GROUND_DEFAULTED, HEIGHT_NO_DATA, OPTION_UNUSED
from lodbench.citymodel.model import TALLEST_M, Polygons
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.raw import RawCity
from lodbench.citymodel.terrain import HIGHEST_M, LOWEST_M, ground_under
from lodbench.findings import Findings

# What formats of footprints alone are read by, and what sets buildings on the ground where that is requested.
_FOOTPRINTS = ("footprints", "surfaces")
_OF_FOOTPRINTS = (
    "layer", "height_column", "storeys_column", "storey_height_m", "ground_column", "default_height_m",
)  # fmt: skip
_OF_GROUND = ("ground_m", "terrain")
# What has its heights in z, whatever is requested.
_UPRIGHT = (*_FOOTPRINTS, "CityGML", "CityJSON", "CityJSONSeq")


def tell_unused(format: str, options: ReadOptions, findings: Findings) -> None:
    """Adds a finding for every option that was given and that a city of this format does not hear."""
    unheard = {}
    if format not in _FOOTPRINTS:
        unheard = {name: f"{name}: it is of footprints" for name in _OF_FOOTPRINTS}
        if options.base != "ground":
            unheard |= {name: f"{name}: base=ground sets buildings on the ground" for name in _OF_GROUND}
    if format in _UPRIGHT:
        unheard["up_axis"] = "up_axis: it is of meshes"
    if not format.startswith("City"):
        unheard["date"] = "date: it is of CityGML and CityJSON"
    usual = ReadOptions()
    for name, why in unheard.items():
        if getattr(options, name) != getattr(usual, name):
            findings.add(OPTION_UNUSED, "", why)


def move_bases(
    polygons: Polygons,
    building_ids: tuple[str, ...],
    label: str | None,
    options: ReadOptions,
    findings: Findings,
) -> None:
    """Moves the bottoms of buildings, in place, as ``options.base`` says.

    ``ground`` adds the terrain height under each building's middle (or ``ground_m``) to all its
    heights: for sources such as Open City Model whose buildings all stand at 0. ``sunk`` lifts
    everything within ``sunk_m`` of a building's lowest point to that height: for sources such as
    swissBUILDINGS3D whose walls reach below the terrain.

    Args:
        polygons: In metres, not yet in the local frame.
        building_ids: For the findings.
        label: Reference system of the points.
        options: What to do.
        findings: Receives what was done, and buildings outside the terrain.
    """
    points = polygons.points
    if options.base == "as_given" or len(points) == 0:
        return
    building = np.repeat(polygons.building, np.diff(polygons.ring_starts[polygons.polygon_starts]))
    count = len(building_ids)
    if options.base == "sunk":
        lowest = np.full(count, np.inf)
        np.minimum.at(lowest, building, points[:, 2])
        points[:, 2] = np.maximum(points[:, 2], lowest[building] + options.sunk_m)
        detail = f"walls cut {options.sunk_m:g} m above their lowest point"
    else:
        heights = np.full(count, options.ground_m)
        if options.terrain is not None and label is not None:
            sizes = np.maximum(np.bincount(building, minlength=count), 1)
            middles = np.stack(
                [np.bincount(building, points[:, k], minlength=count) / sizes for k in (0, 1)], axis=1
            )
            found = ground_under(middles, label, options)
            for b in np.flatnonzero(~np.isfinite(found)):
                findings.add(GROUND_DEFAULTED, building_ids[b], f"ground_m={options.ground_m:g}")
            heights = np.where(np.isfinite(found), found, options.ground_m)
        points[:, 2] += heights[building]
        detail = f"set on {options.terrain or f'{options.ground_m:g} m'}"
    findings.add(BASE_MOVED, "", detail)


Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


def mend_heights(polygons: Polygons, raw: RawCity, label: str | None) -> None:
    """Puts corners at impossible heights on the ground near them, in place; each building is a finding.

    Impossible is what lies below or above all land, and of a building taller than any the end that is further
    from the heights of the others. The ground is the lowest corner of the nearest building without such
    corners, else the lowest other corner of its own. Where all heights are impossible, their unit or zero is
    another: they stay, and so do those of meshes without a reference system.

    Args:
        polygons: In metres, heights above the sea or the ellipsoid, or of a local frame.
        raw: Names of the buildings, and what they are; its findings grow.
        label: Reference system of the points.
    """
    is_mesh = raw.lods == ("",)
    if len(polygons) == 0 or (is_mesh and label is None):
        return
    z = polygons.points[:, 2]
    lowest_m, highest_m = z.min(), z.max()
    if LOWEST_M < lowest_m and highest_m < HIGHEST_M and highest_m - lowest_m <= TALLEST_M:
        return
    point_polygon = np.repeat(
        np.arange(len(polygons)), np.diff(polygons.ring_starts[polygons.polygon_starts])
    )
    building = polygons.building[point_polygon]
    is_off = ~((z > LOWEST_M) & (z < HIGHEST_M))
    if is_off.all():
        return
    if not is_mesh:  # whose pieces may be mountains
        level = building * (int(polygons.lod.max()) + 1) + polygons.lod[point_polygon]
        is_off |= _wrong_ends(z, level, is_off) & _are_buildings(raw)[building]
    if not is_off.any():
        return
    count = len(raw.building_ids)
    lowest = np.full(count, np.inf)
    np.minimum.at(lowest, building[~is_off], z[~is_off])
    is_hurt = np.zeros(count, np.bool_)
    is_hurt[building[is_off]] = True
    ground = _ground_near(polygons.points, building, lowest, is_hurt)
    order = np.flatnonzero(is_off)
    for number, first in zip(*np.unique(building[order], return_index=True), strict=True):
        own, place = z[order[building[order] == number]], polygons.points[order[first]].copy()
        which = f"{own.min():.10g}" if np.ptp(own) == 0 else f"{own.min():.10g} to {own.max():.10g}"
        detail = f"{len(own)} corners at {which} m, put at {ground[number]:.2f} m"
        east, north, up = place.tolist()
        raw.findings.add(HEIGHT_NO_DATA, raw.building_ids[number], detail, place=(east, north, up))
    z[is_off] = ground[building[is_off]]


def _are_buildings(raw: RawCity) -> Flags:
    """Returns which of a city's objects are buildings, and no terrain or bridge."""
    is_building = np.ones(len(raw.building_ids), np.bool_)
    if raw.objects is not None:
        for number in np.flatnonzero(raw.objects.parents < 0).tolist():
            is_building[raw.objects.building[number]] = "Building" in raw.objects.types[number]
    return is_building


def _wrong_ends(z: Floats, group: NDArray[np.integer], is_off: Flags) -> Flags:
    """Returns which heights are the wrong end of a building, a group, that is taller than any.

    Without another one to compare with it is the lower end: the ground is more often lost than the roof.
    """
    numbers, place = np.unique(group, return_inverse=True)
    low, high = np.full(len(numbers), np.inf), np.full(len(numbers), -np.inf)
    np.minimum.at(low, place[~is_off], z[~is_off])
    np.maximum.at(high, place[~is_off], z[~is_off])
    is_tall = high - low > TALLEST_M
    is_sound = ~is_tall[place] & ~is_off
    middle = float(np.median(z[is_sound])) if is_sound.any() else np.inf
    is_low_end = np.abs(low - middle) >= np.abs(high - middle) if is_sound.any() else is_tall
    half = 0.5 * (low + np.where(is_tall, high, low))
    is_wrong: Flags = is_tall[place] & np.where(is_low_end[place], z < half[place], z > half[place])
    return is_wrong


def _ground_near(points: Floats, building: NDArray[np.integer], lowest: Floats, is_hurt: Flags) -> Floats:
    """Returns (B,) the lowest corner of each building; of the hurt ones that of the nearest that is sound."""
    from scipy.spatial import cKDTree

    sizes = np.maximum(np.bincount(building, minlength=len(lowest)), 1)
    middles = np.stack(
        [np.bincount(building, points[:, k], minlength=len(lowest)) / sizes for k in (0, 1)], axis=1
    )
    ground = np.where(np.isfinite(lowest), lowest, 0.0)
    sound = np.flatnonzero(~is_hurt & np.isfinite(lowest))
    hurt = np.flatnonzero(is_hurt)
    if len(sound):
        ground[hurt] = lowest[sound[cKDTree(middles[sound]).query(middles[hurt])[1]]]
    elif np.isfinite(lowest).any():
        ground[hurt] = np.where(np.isfinite(lowest[hurt]), lowest[hurt], lowest.min())
    return ground
