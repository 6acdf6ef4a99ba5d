"""What the edges of a photo say of its pose, and of what all photos share: a block of the least squares.

The model's lines are laid over the photo, and each point of them is compared with the edges across it. Unlike
a mask that is cut with the map's help, edges do not depend on where the search began (docs/adr/0014,
point 10).
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.estimation.edge_alignment import PhotoEdges
from lodbench.estimation.model_lines import LensErrors, ModelLines, lines_in_view, project_lines
from lodbench.geometry import Camera
from lodbench.geometry.pose import pose_from_vector
from lodbench.methods.flight.photo_terms import Fit, PhotoTerms, Residuals, RoofParts, summed_up
from lodbench.photos.pictures import read_picture

Floats = NDArray[np.float64]

# Edges are looked at in photos so wide, pixels; points of lines are so far apart, farther in a dense city.
_WIDTH, _SPACING_PX, _MOST_POINTS = 1200, 4.0, 1000
# Standard deviations of how far edges lie from the model's lines, per scale of the masks' robust kernel, and
# in the last steps, pixels; how far is looked, deviations.
_SIGMA_PER_REACH, _SIGMA_PX, _SIGMAS = 0.4, 1.2, 3.0
# Errors of a line go together over this length, and those of a roof, pixels.
_LENGTHS_PX = (80.0, 120.0)
# Standard deviation of where each building stands, east and north, metres; see ``summed_up``.
_VIEW_PLACE_M = 0.3
_NOISE_PX, _BORDER_PX, _LEAST_WEIGHT, _FEWEST_POINTS = (0.7, 12.0), 3.0, 1e-6, 12
# Where walls end says nothing: hedges, cars and slopes hide it, and of a map the ground errs most.
# On two real flights the bases of walls show 1 to 2.5 m above the map's (docs/adr/0012, point 6).
_LOWEST_RISE = 0.2
# Matrices of points in the last steps; one leads there.
_MOST_SUBSETS = 4


class EdgePhoto(NamedTuple):
    """A photo whose edges are compared with lines.

    Attributes:
        edges: Of the photo.
        camera: As declared, of the size of the edges.
        city_map: Whose lines.
    """

    edges: PhotoEdges
    camera: Camera
    city_map: CityMap


def edge_photo(query: Query, city_map: CityMap) -> EdgePhoto | None:
    """Returns a query's photo; None for one that cannot be read."""
    picture = None if query.image is None else read_picture(query.image)
    if picture is None:
        return None
    camera = query.camera.scaled_to_width(min(_WIDTH, query.camera.width))
    return EdgePhoto(PhotoEdges(picture, (camera.width, camera.height)), camera, city_map)


def edge_terms(
    photos: Sequence[EdgePhoto | None],
    vectors: Floats,
    lens: Floats,
    roofs: RoofParts,
    reach_px: float | None,
    trust: tuple[float, float],
    threads: Executor | None,
) -> list[PhotoTerms | None]:
    """Returns what photos' edges say at their poses; None for one that shows too few lines or is None.

    Arguments as of ``flight_terms``; edges narrow with the scale of the masks' robust kernel, None in the
    last steps.
    """
    spread = map if threads is None else threads.map
    errors = LensErrors(*(float(v) for v in lens[:4]))

    def look(k: int) -> ModelLines | None:
        photo = photos[k]
        if photo is None:
            return None
        camera = errors.pinhole(photo.camera)
        lines = lines_in_view(photo.city_map, camera, pose_from_vector(vectors[k]), _SPACING_PX)
        lines = lines.of(lines.relative_heights > _LOWEST_RISE)
        few = -(-len(lines) // _MOST_POINTS)
        return lines.of(np.arange(len(lines)) % few == 0) if few > 1 else lines

    shown = list(spread(look, range(len(photos))))
    # In the order of photos.
    parts = [
        None if each is None else roofs.tops_and_feet(each.buildings, each.points[:, :2]) for each in shown
    ]

    def terms(k: int) -> PhotoTerms | None:
        photo, lines, numbers = photos[k], shown[k], parts[k]
        if photo is None or lines is None or numbers is None or len(lines) < _FEWEST_POINTS:
            return None
        return _terms(photo, lines, vectors[k], errors, numbers, roofs, reach_px, trust)

    return list(spread(terms, range(len(photos))))


def _terms(
    photo: EdgePhoto,
    lines: ModelLines,
    vector: Floats,
    errors: LensErrors,
    numbers: tuple[NDArray[np.int64], NDArray[np.int64]],
    roofs: RoofParts,
    reach_px: float | None,
    trust: tuple[float, float],
) -> PhotoTerms | None:
    """Returns what one photo's edges say, given the numbers of the parts of roofs and feet of its points."""
    sigma_px = _SIGMA_PX if reach_px is None else max(_SIGMA_PER_REACH * reach_px, _SIGMA_PX)
    tops, feet = numbers
    # Lines are of roofs as drawn: they are laid where the heights found so far have them.
    points = lines.points.copy()
    lifted_m = roofs.heights_m[tops] - roofs.drawn_m[lines.buildings]
    points[:, 2] += lines.relative_heights * lifted_m + (1.0 - lines.relative_heights) * roofs.heights_m[feet]
    laid = project_lines(points, lines.along, photo.camera, vector, errors)
    size = np.array([photo.camera.width, photo.camera.height])
    inside = ((laid.pixels > _BORDER_PX) & (laid.pixels < size - _BORDER_PX)).all(axis=1)
    if np.count_nonzero(inside) < _FEWEST_POINTS:
        return None
    pixels, normals = laid.pixels[inside], laid.normals[inside]
    candidates = photo.edges.across(pixels, normals, _SIGMAS * sigma_px)
    distances, chances = candidates.expected(len(pixels), sigma_px)
    rises, up = lines.relative_heights[inside], laid.by_place[inside, 2]
    camera, none = laid.by_camera[inside], np.zeros(len(pixels))
    slopes = np.column_stack([camera[:, :6], none, up * rises, up * (1.0 - rises), camera[:, 6:], none])
    seen = Residuals(pixels, -distances, slopes, chances, lines.buildings[inside], lines.points[inside, :2])
    near = distances[chances > 0.5]
    found_px = 1.4826 * float(np.median(np.abs(near))) if len(near) else _NOISE_PX[1]
    noise_px = float(np.clip(found_px, *_NOISE_PX))
    return summed_up(
        seen,
        lines.buildings[inside],
        (tops[inside], feet[inside]),
        Fit(*[float(chances.mean())] * 2),
        (noise_px, np.maximum(chances, _LEAST_WEIGHT)),
        _LENGTHS_PX,
        _MOST_SUBSETS if reach_px is None else 1,
        trust,
        _VIEW_PLACE_M,
    )
