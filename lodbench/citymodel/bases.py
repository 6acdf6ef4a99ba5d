"""Where buildings stand: models with a zero base set on the ground, walls drawn into it cut short."""

from __future__ import annotations

import numpy as np

from lodbench.citymodel.codes import BASE_MOVED, GROUND_DEFAULTED, OPTION_UNUSED
from lodbench.citymodel.model import Polygons
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.terrain import ground_under
from lodbench.findings import Findings

# What formats of footprints alone are read by, and what sets buildings on the ground where that is asked for.
_FOOTPRINTS = ("footprints", "surfaces")
_OF_FOOTPRINTS = (
    "layer", "height_column", "storeys_column", "storey_height_m", "ground_column", "default_height_m",
)  # fmt: skip
_OF_GROUND = ("ground_m", "terrain")
# What has its heights in z, whatever is asked for.
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
    """Moves the bottoms of buildings, in place, as ``options.base`` asks.

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
