"""Vector files that hold the surfaces of buildings themselves, not footprints to be drawn up."""

from __future__ import annotations

import numpy as np

from lodbench.citymodel.model import SurfaceKind
from lodbench.citymodel.raw import RawCity, starts_of
from lodbench.citymodel.roof_types import pitched_buildings
from lodbench.citymodel.vector_columns import Columns
from lodbench.citymodel.wkb import WkbPolygons


def surfaces_as_read(polygons: WkbPolygons, columns: Columns, source: str, crs: str | None) -> RawCity:
    """Returns polygons with heights as surfaces of level 2, one building per geometry.

    Args:
        polygons: With at least one ring.
        columns: With a row per geometry; those without a polygon are no buildings.
        source: Name of the file.
        crs: Its reference system.
    """
    used, building = np.unique(np.asarray(polygons.owner, np.int64), return_inverse=True)
    count, ids = len(building), columns.ids()
    pitched = pitched_buildings(columns.roof_types(), len(ids))
    return RawCity(
        source=source,
        format="surfaces",
        srs_names=(crs,),
        building_ids=tuple(ids[i] for i in used),
        lods=("2",),
        points=np.concatenate(polygons.rings),
        ring_starts=starts_of(np.asarray([len(ring) for ring in polygons.rings], np.int64)),
        polygon_starts=starts_of(np.asarray(polygons.ring_counts, np.int64)),
        building=building.reshape(-1).astype(np.int32),
        lod=np.zeros(count, np.int16),
        kind=np.full(count, SurfaceKind.UNKNOWN, np.uint8),
        srs=np.zeros(count, np.int16),
        has_closing_points=True,
        axis_orders=("east_first",),
        pitched=None if pitched is None else pitched[used],
    )
