"""Where a photo shows what a view shows: by a matcher, or, to bound what matchers can do, by the truth."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.geometry import Camera
from lodbench.matching import FeatureExtractor, Matcher, open_matching
from lodbench.matching.protocol import IMAGES
from lodbench.segmentation.masks import read_photo

from .lifting import lift
from .params import RenderAndMatchParams
from .view import View

Floats = NDArray[np.float64]


class Correspondences(NamedTuple):
    """Points of the world and where the photo shows them.

    Attributes:
        points: (N, 3) scene metres.
        pixels: (N, 2) COLMAP pixels of the working size.
        matched: How many there were before those without depth were left out.
    """

    points: Floats
    pixels: Floats
    matched: int


class CorrespondenceFinder(Protocol):
    """Finds correspondences of one photo with views."""

    def with_view(self, view: View) -> Correspondences:
        """Returns those with a view."""
        ...


class Matched:
    """Correspondences by a matcher.

    Args:
        query: Its photo is read.
        camera: Pinhole of the working size.
        matcher: Its name.
        weights: As for ``open_matching``.

    Raises:
        QueryFault: The photo cannot be read.
        ConfigError: The matcher cannot be opened.
    """

    def __init__(self, query: Query, camera: Camera, matcher: str, weights: str | None = None) -> None:
        if query.image is None:
            raise QueryFault("there is no photo")
        self._matcher, self._extractor = opened_matching(matcher, weights)
        self._photo = self._input(resized_photo(read_photo(query.image), camera))

    def with_view(self, view: View) -> Correspondences:
        """Returns the matches with a view whose pixels in it have a depth."""
        matches = self._matcher.match(self._photo, self._input(view.picture))
        return lifted(view, matches.second.astype(np.float64), matches.first.astype(np.float64))

    def _input(self, picture: NDArray[np.uint8]) -> Any:
        if self._matcher.takes == IMAGES:
            return picture
        if self._extractor is None:
            raise QueryFault("the matcher has no feature extractor")
        return self._extractor.extract(picture)


class Oracle:
    """True correspondences with noise and outliers.

    Args:
        query: One whose ``true_pixels`` tells the truth.
        camera: Pinhole of the working size.
        params: How many, how exact, how many wrong.
        generator: Random numbers of this query.

    Raises:
        QueryFault: The query tells no truth.
    """

    def __init__(
        self, query: Query, camera: Camera, params: RenderAndMatchParams, generator: np.random.Generator
    ) -> None:
        if query.true_pixels is None:
            raise QueryFault("there is no true pose to make correspondences from")
        self._true_pixels, self._full, self._camera = query.true_pixels, query.camera, camera
        self._params, self._generator = params, generator

    def with_view(self, view: View) -> Correspondences:
        """Returns true correspondences of random places of a view, some of them spoiled."""
        size = np.array([self._camera.width, self._camera.height], dtype=np.float64)
        draw = self._generator.uniform(size=(8 * self._params.oracle_matches, 2))
        places = draw * (view.camera.width, view.camera.height)
        points, has_depth = lift(view.depth, view.camera, view.pose, places)
        pixels = self._true_pixels(points[has_depth]) * (size / (self._full.width, self._full.height))
        is_seen = ((pixels > 0) & (pixels < size)).all(axis=1)
        count = self._params.oracle_matches
        points, pixels = points[has_depth][is_seen][:count], pixels[is_seen][:count]
        pixels = pixels + self._generator.normal(scale=self._params.oracle_noise_px, size=pixels.shape)
        is_wrong = self._generator.uniform(size=len(pixels)) < self._params.oracle_outliers
        pixels[is_wrong] = self._generator.uniform(size=(int(is_wrong.sum()), 2)) * size
        return Correspondences(points, pixels, len(pixels))


def lifted(view: View, in_view: Floats, in_photo: Floats) -> Correspondences:
    """Returns matched pixels of a view and a photo, those of the view lifted to points of the world."""
    points, has_depth = lift(view.depth, view.camera, view.pose, in_view)
    return Correspondences(points[has_depth], in_photo[has_depth], len(in_view))


def resized_photo(photo: NDArray[np.uint8], camera: Camera) -> NDArray[np.uint8]:
    """Returns an RGB photo at a camera's size, averaged where it is made smaller."""
    import cv2

    if photo.shape[:2] == (camera.height, camera.width):
        return photo
    small = cv2.resize(photo, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


@lru_cache(maxsize=4)
def opened_matching(name: str, weights: str | None) -> tuple[Matcher, FeatureExtractor | None]:
    """Returns a matcher with its extractor, opened once in a process: it may hold a network."""
    return open_matching(name, weights)
