"""What a city model holds, in numbers: the data behind ``lodbench city info``."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from lodbench.citymodel.meshing import NothingToMesh, mesh_model
from lodbench.citymodel.model import CityModel
from lodbench.findings import Findings


def city_info(model: CityModel) -> dict[str, Any]:
    """Returns a summary made of plain values, ready for JSON.

    Returns:
        ``format, version, crs, center_lat_lon`` (degrees, or None without a reference system),
        ``buildings, parts, objects`` (of opted-in layers, type to count), ``pitched_roofs`` (buildings that
        the source tells to have one), ``extent_m`` (x, y, z lengths), ``lods``: level name to
        ``polygons`` (as in the file), ``triangles``, ``area_m2`` (of the polygons), ``meshed_m2`` and
        ``lost_m2``; and ``findings``: code and name to count, meshing included; ``finding_objects``: to
        how many buildings they were met in.
    """
    points = model.polygons.points
    types = Counter(
        "Building" if own else name for name, own in zip(model.types(), model.is_building(), strict=True)
    )
    extent = np.ptp(points, axis=0) if len(points) else np.zeros(3)
    findings = Findings(list(model.findings.items))
    lods: dict[str, dict[str, float]] = {}
    for name, num_read in zip(model.lods, model.polygons_read, strict=True):
        row: dict[str, float] = {"polygons": num_read, "triangles": 0, "area_m2": 0.0}
        try:
            mesh = mesh_model(model, name, stands_in=False)
        except NothingToMesh as nothing:
            findings.items += nothing.findings.items
            row["lost_m2"] = row["area_m2"] = round(nothing.area_m2, 3)
        else:
            findings.items += mesh.findings.items
            row["triangles"] = len(mesh.scene.triangles)
            row["area_m2"] = round(mesh.area_m2, 3)
            row["meshed_m2"] = round(mesh.meshed_m2, 3)
            row["lost_m2"] = round(mesh.lost_m2, 3)
        lods[name] = row
    return {
        "format": model.format,
        "version": model.version,
        "crs": model.crs,
        "center_lat_lon": _center_lat_lon(model),
        "buildings": types["Building"],
        "parts": model.num_parts,
        "objects": {name: count for name, count in sorted(types.items()) if name != "Building"},
        "pitched_roofs": 0 if model.pitched is None else int(model.pitched.sum()),
        "extent_m": [round(float(length), 3) for length in extent],
        "lods": lods,
        "findings": findings.counts(),
        "finding_objects": findings.objects(),
    }


def _center_lat_lon(model: CityModel) -> list[float] | None:
    """Returns where on Earth the middle of the city is, to a decimetre: the quickest test of a place."""
    points = model.polygons.points
    if model.crs is None or len(points) == 0:
        return None
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    x, y = 0.5 * (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) + model.origin[:2]
    try:
        lon, lat = Transformer.from_crs(model.crs, "EPSG:4326", always_xy=True).transform(x, y)
    except ProjError:
        return None
    return [round(lat, 6), round(lon, 6)] if np.isfinite([lat, lon]).all() else None
