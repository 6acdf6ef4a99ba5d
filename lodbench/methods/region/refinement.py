"""The pose that the edges of roofs make most probable, where these are surer of the place (docs/adr/0070)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.estimation.edge_alignment import EdgeAlignment, EdgeLikelihood
from lodbench.geometry.pose_vector import vector_from_pose
from lodbench.methods.fits import query_photo
from lodbench.methods.region.params import Params
from lodbench.methods.region.unknowns import TILT

Floats = NDArray[np.float64]

# Edges that are likelier than background by fewer nats may lie there by chance.
_LEAST_EVIDENCE = 10.0
# So many half widths from the prior's tilt, the photo has overruled it (docs/adr/0064).
_OVERRULED = 2.0


def surer_by_edges(
    vector: Floats, covariance: Floats, query: Query, city_map: CityMap, params: Params
) -> EdgeAlignment | None:
    """Returns an answer refined by the edges of roofs, or None where these are no surer of the place.

    Eq. (R24) of docs/methods/region.md.

    Edges have to be likelier there, plainly likelier than background, and leave the smaller variance; the
    answer's tilt must not have overruled the prior's.

    Args:
        vector: (6,) the answer, metres and degrees.
        covariance: (6, 6) of its error.
        query: Whose photo it answers.
        city_map: The map.
        params: For the prior's width and the lens.
    """
    half_widths, prior = np.array(params.half_widths()), vector_from_pose(query.prior)
    if np.any(np.abs(vector - prior)[TILT] > _OVERRULED * half_widths[TILT]):
        return None
    k1 = 0.0 if query.camera_sigmas is None else query.camera_sigmas.k1
    sigmas = np.array([*half_widths / np.sqrt(3.0), 0.01 * params.lens_percent, k1, 0.0, 0.0])
    found = EdgeLikelihood(query_photo(query), query.camera, city_map, prior, sigmas).refined(vector)
    if found is None or found.gain <= 0.0 or found.evidence < _LEAST_EVIDENCE:
        return None
    return found if np.trace(found.covariance[:3, :3]) < np.trace(covariance[:3, :3]) else None
