"""What a feature extractor and a matcher are. Pixels are COLMAP's: the first one's centre is (0.5, 0.5)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError, RenderingError
from lodbench.params import to_params
from lodbench.plugins import load_plugin

Floats = NDArray[np.float32]
Image = NDArray[np.uint8]

FEATURES, IMAGES = "features", "images"


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Points of one picture that may be found again in another.

    Raises:
        RenderingError: The arrays are not these, or hold what is not finite or not in the picture.
    """

    keypoints: Floats  # (N, 2) float32, x and y in pixels
    descriptors: Floats  # (N, D) float32; what they are compared by is the matcher's business
    scores: Floats  # (N,) float32, how sure the extractor is of each; higher is better
    size: tuple[int, int]  # width and height of the picture

    def __post_init__(self) -> None:
        count = len(self.keypoints)
        _require(self.keypoints, (count, 2), "keypoints")
        _require(self.descriptors, (count, self.descriptors.shape[-1]), "descriptors")
        _require(self.scores, (count,), "scores")
        if ((self.keypoints < 0) | (self.keypoints > np.array(self.size))).any():
            raise RenderingError(f"keypoints lie outside the picture of {self.size[0]} x {self.size[1]}.")


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Pairs of points, one in each of two pictures.

    Raises:
        RenderingError: The arrays are not these, or hold what is not finite.
    """

    first: Floats  # (M, 2) float32, x and y in the first picture, pixels
    second: Floats  # (M, 2) float32, likewise in the second
    scores: Floats  # (M,) float32, how sure the matcher is of each; higher is better

    def __post_init__(self) -> None:
        count = len(self.first)
        for name, shape in (("first", (count, 2)), ("second", (count, 2)), ("scores", (count,))):
            _require(getattr(self, name), shape, name)


class FeatureExtractor(Protocol):
    """Finds features in a picture; made from its ``params_type``, a frozen dataclass."""

    def extract(self, image: Image) -> Features:
        """Returns the features of an (H, W, 3) uint8 picture, red first; maybe none."""
        ...


class Matcher(Protocol):
    """Finds matches; made from its ``params_type``, a frozen dataclass.

    Attributes:
        takes: ``features``: ``match`` is given the features of both pictures; ``images``: the pictures.
        extractor: Optional: the name of the extractor whose features it is made for.
    """

    takes: str

    def match(self, first: Any, second: Any) -> Matches:
        """Returns the matches of two ``Features``, or of two (H, W, 3) uint8 pictures."""
        ...


def open_extractor(name: str, **settings: Any) -> FeatureExtractor:
    """Returns the feature extractor of a name.

    Raises:
        ConfigError: There is none, it is broken, or a setting is unknown or out of range.
    """
    kind = load_plugin("feature_extractors", name)
    extractor: FeatureExtractor = kind(to_params(settings, kind.params_type, name))
    return extractor


def open_matcher(name: str, **settings: Any) -> Matcher:
    """Returns the matcher of a name.

    Raises:
        ConfigError: There is none, it is broken, or a setting is unknown or out of range.
    """
    kind = load_plugin("matchers", name)
    matcher: Matcher = kind(to_params(settings, kind.params_type, name))
    if matcher.takes not in (FEATURES, IMAGES):
        raise ConfigError(f"Matcher {name!r} takes {matcher.takes!r}.", f"Known: {FEATURES}, {IMAGES}.")
    return matcher


def open_matching(name: str, weights: str | None = None) -> tuple[Matcher, FeatureExtractor | None]:
    """Returns a matcher and the extractor of the features it takes; None for one that takes pictures.

    Args:
        name: The matcher's.
        weights: Its weights, or its extractor's if it has none; ``random`` for both; None for their own.

    Raises:
        ConfigError: As for ``open_matcher``, the matcher names no extractor for its features, or neither
            has weights.
    """
    kind = load_plugin("matchers", name)
    is_learned = "weights" in {field.name for field in fields(kind.params_type)}
    matcher = open_matcher(name, **({"weights": weights} if weights and is_learned else {}))
    if matcher.takes == IMAGES:
        if weights and not is_learned:
            raise ConfigError(f"Matcher {name!r} has no weights.", "Leave weights out.")
        return matcher, None
    extractor = getattr(matcher, "extractor", None)
    if extractor is None:
        raise ConfigError(
            f"Matcher {name!r} says not whose features it takes.", "Take sift_nn, or set its ``extractor``."
        )
    described = load_plugin("feature_extractors", extractor).params_type
    has_weights = "weights" in {field.name for field in fields(described)}
    if weights and not is_learned and not has_weights:
        raise ConfigError(f"Matcher {name!r} has no weights.", "Leave weights out.")
    theirs = has_weights and weights and (weights == "random" or not is_learned)
    return matcher, open_extractor(extractor, **({"weights": weights} if theirs else {}))


def match_images(
    first: Image, second: Image, matcher: Matcher, extractor: FeatureExtractor | None = None
) -> Matches:
    """Returns the matches of two (H, W, 3) uint8 pictures, red first, of any sizes.

    Raises:
        ConfigError: The matcher takes features and there is no extractor.
        RenderingError: A picture is no such array.
    """
    if matcher.takes == IMAGES:
        return matcher.match(check_image(first), check_image(second))
    if extractor is None:
        raise ConfigError("This matcher takes features.", "Name a feature extractor, for example sift.")
    return matcher.match(extractor.extract(first), extractor.extract(second))


def check_image(image: NDArray[Any]) -> Image:
    """Returns a picture as it was given.

    Raises:
        RenderingError: It is not (H, W, 3) uint8, or empty.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise RenderingError(f"A picture is (H, W, 3) uint8, not {image.shape} {image.dtype}.")
    return image


def _require(array: NDArray[Any], shape: tuple[int, ...], name: str) -> None:
    if array.shape != shape or array.dtype != np.float32:
        raise RenderingError(f"{name} are {array.shape} {array.dtype} instead of {shape} float32.")
    if not np.isfinite(array).all():
        raise RenderingError(f"{name} are not all finite.")


Descriptors = NDArray[np.float32]


class Retrieval(Protocol):
    """Describes pictures; an entry point under ``lodbench.retrievals``."""

    def describe(self, pictures: NDArray[np.uint8]) -> Descriptors:
        """Returns (N, D) descriptors, of length 1 or 0, of (N, H, W, 3) RGB pictures of one size.

        Near descriptors are of pictures that look alike.
        """
        ...


def open_retrieval(name: str, **settings: Any) -> Retrieval:
    """Returns the retrieval of a name.

    Raises:
        ConfigError: There is none, it is broken, its library or weights are absent, or a setting is wrong.
    """
    kind = load_plugin("retrievals", name)
    retrieval: Retrieval = kind(to_params(settings, kind.params_type, name))
    return retrieval


@dataclass(frozen=True, slots=True, eq=False)
class PicturePair:
    """Two pictures made smaller by one factor and filled up, below and on the right, to one size."""

    pictures: Floats  # (2, H, W, 3) float32 RGB in [0, 1]
    factors: Floats  # (2, 2) x and y of each picture's size against the original's
    sizes: Floats  # (2, 2) width and height of the originals, pixels

    def original(self, places: NDArray[np.generic], number: int) -> tuple[Floats, NDArray[np.bool_]]:
        """Returns where places of one of the pictures are in its original, and which of them are in it.

        Args:
            places: (N, 2) with the first pixel's centre at (0, 0), as networks count.
            number: 0 or 1.

        Returns:
            (N, 2) COLMAP pixels, and (N,).
        """
        uv = ((np.asarray(places, np.float32) + np.float32(0.5)) / self.factors[number]).astype(np.float32)
        return uv, np.asarray(((uv >= 0) & (uv <= self.sizes[number])).all(axis=1))


def make_pair(first: Image, second: Image, longest_px: int, cell_px: int) -> PicturePair:
    """Returns two pictures, (H, W, 3) uint8 of any sizes, ready for a network.

    The longest side of both is at most ``longest_px``; sides are multiples of ``cell_px``.

    Raises:
        RenderingError: A picture is no such array.
    """
    import cv2

    images = [check_image(first), check_image(second)]
    scale = min(1.0, longest_px / max(max(image.shape[:2]) for image in images))
    small = []
    for image in images:
        height, width = (max(1, round(side * scale)) for side in image.shape[:2])
        resized = image if scale == 1.0 else cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        small.append(np.asarray(resized))
    tall, wide = (-(-max(image.shape[k] for image in small) // cell_px) * cell_px for k in (0, 1))
    pair = [
        np.pad(image, ((0, tall - image.shape[0]), (0, wide - image.shape[1]), (0, 0)), mode="edge")
        for image in small
    ]
    sizes = np.array([image.shape[1::-1] for image in images], np.float32)
    shrunk = np.array([image.shape[1::-1] for image in small], np.float32)
    return PicturePair(np.stack(pair).astype(np.float32) / np.float32(255), shrunk / sizes, sizes)
