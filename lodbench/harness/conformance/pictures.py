"""Rules of what finds the same in two pictures: feature extractors, matchers."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.harness.conformance.trial import CAMERA, Rules, Tried, refuses, require
from lodbench.matching import Features, Matches, check_image
from lodbench.matching.protocol import FEATURES, IMAGES
from lodbench.plugins import load_plugin


def _picture(tried: Tried, number: int = 0) -> NDArray[np.uint8]:
    photo = np.asarray(cv2.imread(str(tried.entries[number].image)), np.uint8)
    return np.ascontiguousarray(photo[:, :, ::-1])


def extractor_rules(tried: Tried) -> Rules:
    """Returns the rules of a feature extractor."""

    def features() -> str:
        found = tried.make().extract(_picture(tried))
        require(isinstance(found, Features), f"extract returned {type(found).__name__}", "Return Features.")
        require(len(found.keypoints) > 0, "no feature in a photo of seven blocks")
        require(found.size == (CAMERA.width, CAMERA.height), f"size is {found.size}: width, then height")
        shape = found.descriptors.shape
        return f"{shape[0]}, descriptors of {shape[1]} numbers, all finite and in the picture"

    def same_again() -> str:
        picture = _picture(tried)
        first, again = tried.make().extract(picture), tried.make().extract(picture)
        _require_same(first, again, "keypoints", "descriptors", "scores")
        require(np.array_equal(picture, _picture(tried)), "the picture was written to", "Work on a copy.")
        return "the same picture, the same features to the bit; it is only read"

    def blank() -> str:
        found = tried.make().extract(np.full((48, 64, 3), 128, np.uint8))
        return f"{len(found.keypoints)} features in a grey picture"

    return [
        ("features", features),
        ("same again", same_again),
        ("pixels", lambda: _dot_s_place(tried)),
        ("nothing to see", blank),
        (
            "no picture",
            lambda: refuses(lambda: tried.make().extract(np.zeros((9, 9))), "a (9, 9) float array"),
        ),
    ]


def _require_same(one: object, other: object, *names: str) -> None:
    for name in names:
        same = np.array_equal(getattr(one, name), getattr(other, name))
        require(same, f"other {name}", "Fix the seeds.")


def _dot_s_place(tried: Tried) -> str:
    # A dot whose centre is known: (41.5, 31.5) where the first pixel's centre is (0.5, 0.5).
    rows, columns = np.mgrid[0:62, 0:82] + 0.5
    dot = 230.0 * np.exp(-((columns - 41.5) ** 2 + (rows - 31.5) ** 2) / 18.0) + 10
    picture = np.repeat(dot.astype(np.uint8)[:, :, None], 3, axis=2)
    features = tried.make().extract(picture)
    # A detector of corners is not sure of anything in a dot.
    sure = 0.1 * float(tried.make().extract(_picture(tried)).scores.max())
    found = features.keypoints[features.scores >= sure]
    if not len(found):
        return "not seen: it is sure of nothing in a lone dot"
    off = np.abs(found.mean(axis=0) - [41.5, 31.5]).max()
    told = f"a dot at (41.5, 31.5) is found {off:.2f} px off"
    require(off < 0.4, told, "The first pixel's centre is (0.5, 0.5).")
    return told


def matcher_rules(tried: Tried) -> Rules:
    """Returns the rules of a matcher."""
    takes = getattr(tried.part, "takes", None)

    def side(picture: NDArray[np.uint8]) -> Any:
        if takes == IMAGES:
            return check_image(picture)
        kind = load_plugin("feature_extractors", getattr(tried.part, "extractor", "sift"))
        return kind(kind.params_type()).extract(picture)

    def takes_what() -> str:
        hint = f"Set takes = {FEATURES!r} or {IMAGES!r}."
        require(takes in (FEATURES, IMAGES), f"takes is {takes!r}", hint)
        return f"{takes}"

    def matches() -> str:
        picture = side(_picture(tried))
        found = tried.make().match(picture, picture)
        require(isinstance(found, Matches), f"match returned {type(found).__name__}", "Return Matches.")
        require(len(found.first) > 0, "no match of a photo with itself")
        far = float(np.median(np.linalg.norm(found.first - found.second, axis=1)))
        require(far < 1.0, f"a photo matches itself {far:.1f} px off in the median")
        return f"{len(found.first)} of a photo with itself, {far:.2f} px off in the median"

    def same_again() -> str:
        first, second = side(_picture(tried, 0)), side(_picture(tried, 1))
        one, other = tried.make().match(first, second), tried.make().match(first, second)
        _require_same(one, other, "first", "second", "scores")
        return f"{len(one.first)} of two photos, the same to the bit"

    def nothing() -> str:
        blank = side(np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8))
        found = tried.make().match(blank, side(_picture(tried)))
        require(isinstance(found, Matches), "no Matches", "Return Matches of length 0.")
        return f"{len(found.first)} matches with a grey picture"

    return [
        ("takes", takes_what),
        ("matches", matches),
        ("same again", same_again),
        ("nothing to see", nothing),
    ]
