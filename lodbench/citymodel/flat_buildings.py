"""Buildings with a footprint and a known height: reported if drawn flat, extruded if level 1 is derived."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import STAYS_FLAT
from lodbench.citymodel.extrude import extrude
from lodbench.citymodel.model import CityModel, Polygons, SurfaceKind
from lodbench.citymodel.raw import starts_of
from lodbench.citymodel.selection import select_polygons
from lodbench.findings import Findings

FLAT = "0"  # what names of levels without walls begin with


def is_flat(model: CityModel) -> NDArray[np.bool_]:
    """Tells which buildings have a known height, and outlines at level 0 alone; (B,)."""
    if model.measured_m is None:
        return np.zeros(len(model.building_ids), np.bool_)
    polygons = model.polygons
    has_walls, has_outline = np.zeros((2, len(model.building_ids)), np.bool_)
    at_level_0 = np.array([name.startswith(FLAT) for name in model.lods], np.bool_)[polygons.lod]
    has_outline[polygons.building[at_level_0]] = True
    has_walls[polygons.building[~at_level_0 & (polygons.kind != SurfaceKind.INTERIOR)]] = True
    return has_outline & ~has_walls & np.isfinite(model.measured_m)


def tell_flat(model: CityModel, findings: Findings) -> None:
    """Adds a finding for each building that is drawn flat though its height is known."""
    if model.measured_m is not None:
        for n in np.flatnonzero(is_flat(model)).tolist():
            detail = f"{model.measured_m[n]:g} m high; as a block with lod=1 and roof_height=max"
            findings.add(STAYS_FLAT, model.building_ids[n], detail)


def raise_flat(model: CityModel, level: str) -> CityModel:
    """Returns a city whose flat buildings with a height have blocks of that height too, at a level.

    They stand on the lowest point of their footprint, or end at the edge of their roof where there is no
    more than that.

    Args:
        model: The city.
        level: One of its levels, or a new one.
    """
    flat = is_flat(model)
    if model.measured_m is None or not flat.any():
        return model
    own = select_polygons(model.polygons, np.flatnonzero(flat[model.polygons.building]))
    is_edge = own.kind == SurfaceKind.ROOF
    has_footprint = np.zeros(len(flat), np.bool_)
    has_footprint[own.building[~is_edge]] = True
    chosen = np.flatnonzero(~is_edge | ~has_footprint[own.building])
    own, is_edge = select_polygons(own, chosen), is_edge[chosen]
    point_building = np.repeat(own.building, np.diff(own.ring_starts[own.polygon_starts]))
    low, high = np.full(len(flat), np.inf), np.full(len(flat), -np.inf)
    np.minimum.at(low, point_building, own.points[:, 2])
    np.maximum.at(high, point_building, own.points[:, 2])
    height_m = model.measured_m[own.building]
    bottom = np.where(is_edge, high[own.building] - height_m, low[own.building])
    blocks = extrude(own.points[:, :2], own.ring_starts, own.polygon_starts, bottom, bottom + height_m)
    lods = model.lods if level in model.lods else (*model.lods, level)
    raised = Polygons(
        blocks.points,
        starts_of(blocks.ring_lengths),
        starts_of(blocks.ring_counts),
        own.building[blocks.footprint],
        np.full(len(blocks.kind), lods.index(level), np.int16),
        blocks.kind,
        None if own.part is None else own.part[blocks.footprint],
    )
    return replace(model, lods=lods, polygons=_both(model.polygons, raised))


def _both(first: Polygons, second: Polygons) -> Polygons:
    """Returns the polygons of both, without pictures."""
    return Polygons(
        np.concatenate([first.points, second.points]),
        np.append(first.ring_starts, second.ring_starts[1:] + first.ring_starts[-1]),
        np.append(first.polygon_starts, second.polygon_starts[1:] + first.polygon_starts[-1]),
        np.append(first.building, second.building),
        np.append(first.lod, second.lod),
        np.append(first.kind, second.kind),
        None if first.part is None or second.part is None else np.append(first.part, second.part),
    )
