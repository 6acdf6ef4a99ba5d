"""Rules of what works on pictures: feature extractors, matchers, retrievals, pose solvers, segmenters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.inputs import Input, declared_inputs
from lodbench.datasets.query import Entry
from lodbench.errors import QueryFault
from lodbench.geometry import Pose
from lodbench.harness.conformance.trial import CAMERA, Rules, Tried, refuses, require
from lodbench.matching import Features, Matches, check_image
from lodbench.matching.pose_solver import SolvedPose
from lodbench.matching.protocol import FEATURES, IMAGES
from lodbench.plugins import load_plugin
from lodbench.segmentation import (
    MapGuidedInstanceSegmenter,
    MapGuidedSegmenter,
    check_classes,
    check_instances,
    check_mask,
)
from lodbench.segmentation.masks import read_photo
from lodbench.storage import file_digest, random_stream

Floats = NDArray[np.float64]
_COUNT, _OUTLIERS = 300, 0.3
# What makes each kind of masks.
_MEMBERS = {Input.MASK: "segment", Input.INSTANCES: "segment_instances", Input.CLASSES: "segment_classes"}


def _picture(tried: Tried, number: int = 0) -> NDArray[np.uint8]:
    photo = np.asarray(cv2.imread(str(tried.entries[number].image)), np.uint8)
    return np.ascontiguousarray(photo[:, :, ::-1])


def extractor_rules(tried: Tried) -> Rules:
    """Returns the rules of a feature extractor."""

    def features() -> str:
        points = tried.make().extract(_picture(tried))
        require(isinstance(points, Features), f"extract returned {type(points).__name__}", "Return Features.")
        require(len(points.keypoints) > 0, "no feature in a photo of seven blocks")
        require(points.size == (CAMERA.width, CAMERA.height), f"size is {points.size}: width, then height")
        shape = points.descriptors.shape
        return f"{shape[0]}, descriptors of {shape[1]} numbers, all finite and in the picture"

    def same_again() -> str:
        picture = _picture(tried)
        first, again = tried.make().extract(picture), tried.make().extract(picture)
        _require_same(first, again, "keypoints", "descriptors", "scores")
        require(np.array_equal(picture, _picture(tried)), "the picture was written to", "Work on a copy.")
        return "the same picture, the same features to the bit; it is only read"

    def blank() -> str:
        points = tried.make().extract(np.full((48, 64, 3), 128, np.uint8))
        return f"{len(points.keypoints)} features in a grey picture"

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
    keypoints = features.keypoints[features.scores >= sure]
    if not len(keypoints):
        return "not seen: it is sure of nothing in a lone dot"
    off = np.abs(keypoints.mean(axis=0) - [41.5, 31.5]).max()
    reported = f"a dot at (41.5, 31.5) is found {off:.2f} px off"
    require(off < 0.4, reported, "The first pixel's centre is (0.5, 0.5).")
    return reported


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
        matched = tried.make().match(picture, picture)
        require(isinstance(matched, Matches), f"match returned {type(matched).__name__}", "Return Matches.")
        require(len(matched.first) > 0, "no match of a photo with itself")
        far = float(np.median(np.linalg.norm(matched.first - matched.second, axis=1)))
        require(far < 1.0, f"a photo matches itself {far:.1f} px off in the median")
        return f"{len(matched.first)} of a photo with itself, {far:.2f} px off in the median"

    def same_again() -> str:
        first, second = side(_picture(tried, 0)), side(_picture(tried, 1))
        one, other = tried.make().match(first, second), tried.make().match(first, second)
        _require_same(one, other, "first", "second", "scores")
        return f"{len(one.first)} of two photos, the same to the bit"

    def nothing() -> str:
        blank = side(np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8))
        matched = tried.make().match(blank, side(_picture(tried)))
        require(isinstance(matched, Matches), "no Matches", "Return Matches of length 0.")
        return f"{len(matched.first)} matches with a grey picture"

    return [
        ("takes", takes_what),
        ("matches", matches),
        ("same again", same_again),
        ("nothing to see", nothing),
    ]


def retrieval_rules(tried: Tried) -> Rules:
    """Returns the rules of a retrieval."""
    photos = np.stack([read_photo(entry.image) for entry in tried.entries if entry.image is not None])

    def described() -> str:
        given = photos.copy()
        matrix = tried.make().describe(given)
        require(
            isinstance(matrix, np.ndarray) and matrix.dtype == np.float32, "describe returns float32 arrays"
        )
        require(
            matrix.ndim == 2 and len(matrix) == len(photos), f"{len(photos)} pictures give {matrix.shape}"
        )
        lengths = np.linalg.norm(matrix, axis=1)
        require(np.allclose(lengths, 1.0, atol=1e-3), f"descriptors have lengths {lengths.round(3).tolist()}")
        require(np.array_equal(given, photos), "the pictures were written to", "Work on a copy.")
        return f"{matrix.shape[1]} numbers, of length 1"

    def same_again() -> str:
        matrix = tried.make().describe(photos)
        require(np.array_equal(matrix, tried.make().describe(photos)), "another descriptor the second time")
        alone = np.concatenate([tried.make().describe(photo[None]) for photo in photos])
        require(np.allclose(alone, matrix, atol=1e-4), "another descriptor beside other pictures")
        return "made anew, and picture by picture"

    def nearest_is_own() -> str:
        matrix = tried.make().describe(photos)
        darker = tried.make().describe((0.8 * photos).astype(np.uint8))
        nearest = np.argmax(darker @ matrix.T, axis=1)
        require(
            np.array_equal(nearest, np.arange(len(photos))), "a darker picture resembles another one more"
        )
        return "a darker picture resembles itself most"

    return [("describe", described), ("same again", same_again), ("found again", nearest_is_own)]


def solver_rules(tried: Tried) -> Rules:
    """Returns the rules of a pose solver."""

    def exact(outliers: float, limit_m: float) -> str:
        worst = 0.0
        for answer, truth in _solved(tried, outliers):
            if answer is None:
                require(False, "no pose")
                continue
            require(isinstance(answer, SolvedPose), f"solve returned {type(answer).__name__}")
            require(answer.inliers.shape == (_COUNT,), f"inliers are {answer.inliers.shape}, not ({_COUNT},)")
            worst = max(worst, float(np.linalg.norm(answer.pose.center - truth.center)))
        require(worst < limit_m, f"{worst:.2f} m off", "Pixels are COLMAP's, poses cam_from_world.")
        return f"{worst:.3f} m off at worst"

    def same_again() -> str:
        twice = _solved(tried, _OUTLIERS), _solved(tried, _OUTLIERS)
        for (first, _), (again, _) in zip(*twice, strict=True):
            same = first is not None and again is not None
            require(
                same and np.array_equal(first.pose.cam_from_world, again.pose.cam_from_world),  # type: ignore[union-attr]
                "another pose of the same correspondences",
                "Fix the seeds.",
            )
        return "the same correspondences, the same pose to the bit"

    def too_few() -> str:
        require(all(answer is None for answer, _ in _solved(tried, 0.0, count=1)), "a pose of one point")
        return "no pose of one point"

    return [
        ("exact", lambda: exact(0.0, 0.05)),
        ("outliers", lambda: exact(_OUTLIERS, 0.5)),
        ("same again", same_again),
        ("too few", too_few),
    ]


def _solved(tried: Tried, outliers: float, count: int = _COUNT) -> list[tuple[SolvedPose | None, Pose]]:
    """Returns the answer for each true pose, given so many of its correspondences, and that pose."""
    solutions = []
    for number, truth in enumerate(tried.truths):
        points, pixels = _correspondences(truth, outliers, number)
        prior = truth.shifted([8.0, -6.0, 4.0])
        answer = tried.make().solve(points[:count], pixels[:count], CAMERA, prior)
        solutions.append((answer, truth))
    return solutions


def _correspondences(truth: Pose, outliers: float, number: int) -> tuple[Floats, Floats]:
    """Returns points in view of a pose and where they are seen, half a pixel off where some are wrong."""
    stream = random_stream(0, "conformance", "correspondences", number)
    pixels = stream.uniform(size=(_COUNT, 2)) * (CAMERA.width, CAMERA.height)
    depth = stream.uniform(90.0, 150.0, size=_COUNT)
    rays = np.stack(
        [(pixels[:, 0] - CAMERA.cx) / CAMERA.fx, (pixels[:, 1] - CAMERA.cy) / CAMERA.fy, np.ones(_COUNT)], 1
    )
    points = (rays * depth[:, None]) @ truth.rotation + truth.center
    if outliers:
        pixels = pixels + stream.normal(scale=0.5, size=pixels.shape)
        wrong = stream.uniform(size=_COUNT) < outliers
        pixels[wrong] = stream.uniform(size=(int(wrong.sum()), 2)) * (CAMERA.width, CAMERA.height)
    return points, pixels


def segmenter_rules(tried: Tried) -> Rules:
    """Returns the rules of a segmenter."""
    entries = tried.entries
    provides = sorted(declared_inputs(tried.part, "provides", {Input.MASK}))

    def same_again() -> str:
        for kind in provides:
            for first, again in zip(_answers(tried, kind), _answers(tried, kind), strict=True):
                require(np.array_equal(first, again), "another mask of the same photo", "Fix the seeds.")
        return "the same photos, the same masks to the bit"

    def read_only() -> str:
        before = [file_digest(entry.image) for entry in entries if entry.image]
        for kind in provides:
            _answers(tried, kind)
        after = [file_digest(entry.image) for entry in entries if entry.image]
        require(before == after, "a photo was written to")
        return "photos are as they were"

    def nothing_to_see() -> str:
        bare = replace(entries[0], image=None, mask=None)
        answer = _answer(tried, tried.make(), provides[0], bare)
        return f"QueryFault: {answer}" if isinstance(answer, str) else "a mask all the same"

    return [
        ("declared", lambda: _declared(tried.part, provides)),
        ("masks", lambda: _masks(tried, provides)),
        ("same again", same_again),
        ("photos", read_only),
        ("fingerprint", lambda: _fingerprint(tried, provides)),
        ("neither photo nor mask", nothing_to_see),
    ]


def _declared(part: Any, provides: Sequence[Input]) -> str:
    """It has what makes the masks that it declares."""
    require(bool(provides), "provides nothing", "mask, instances, classes or several.")
    for kind in provides:
        require(kind in _MEMBERS, f"provides {kind}, which no segmenter makes", "mask, instances, classes.")
        require(hasattr(part, _MEMBERS[kind]), f"{kind} declared, but there is no {_MEMBERS[kind]}")
    if Input.MAP in declared_inputs(part, "requires"):
        require(hasattr(part, "segment_from"), "map required, but there is no segment_from")
    return f"provides {' and '.join(provides)}"


def _masks(tried: Tried, provides: Sequence[Input]) -> str:
    """Masks are of their type, and of the photo's aspect."""
    answers = [masks for kind in provides for masks in _answers(tried, kind)]
    given = [masks for masks in answers if not isinstance(masks, str)]
    if not given:
        return f"none, each with its reason: {answers[0]}"
    for masks in given:
        if masks.ndim == 3:
            check_instances(masks, CAMERA)
            continue
        if masks.dtype == np.uint8:
            check_classes(masks, CAMERA)
            continue
        require(masks.dtype == np.float32, f"a mask of {masks.dtype}", "Return float32.")
        check_mask(masks, CAMERA)
    return f"{len(given)} of {len(answers)} answers, of their type and the photo's aspect"


def _answer(tried: Tried, segmenter: Any, kind: Input, entry: Entry) -> NDArray[Any] | str:
    masks: NDArray[Any]
    try:
        if kind == Input.INSTANCES and isinstance(segmenter, MapGuidedInstanceSegmenter):
            pose = entry.prior or tried.truths[0]
            masks = segmenter.segment_instances_from(entry, pose, CityMap(tried.scene))
        elif kind == Input.INSTANCES:
            masks = segmenter.segment_instances(entry)
        elif kind == Input.CLASSES:
            masks = segmenter.segment_classes(entry)
        elif isinstance(segmenter, MapGuidedSegmenter):
            masks = segmenter.segment_from(entry, entry.prior or tried.truths[0], CityMap(tried.scene))
        else:
            masks = segmenter.segment(entry)
    except QueryFault as fault:
        return fault.message
    return masks


def _answers(tried: Tried, kind: Input, entries: tuple[Entry, ...] = ()) -> list[NDArray[Any] | str]:
    segmenter = tried.make()
    return [_answer(tried, segmenter, kind, entry) for entry in entries or tried.entries]


def _fingerprint(tried: Tried, provides: Sequence[Input]) -> str:
    """A fingerprint is the same for the same photos, and another where the masks are."""
    entries, changed = tried.entries, _repainted(tried)
    first, again = tried.make().fingerprint(entries), tried.make().fingerprint(entries)
    require(isinstance(first, str), f"fingerprint returned {type(first).__name__}", "Return text.")
    require(first == again, "another fingerprint of the same queries")
    pairs = [
        pair
        for kind in provides
        for pair in zip(_answers(tried, kind), _answers(tried, kind, changed), strict=True)
    ]
    if all(np.array_equal(a, b) for a, b in pairs):
        return "the same again; these photos do not matter to it"
    require(
        tried.make().fingerprint(changed) != first,
        "other photos give other masks and the same fingerprint, so a run would not be made anew",
        "Take the photos' content in: lodbench.storage.file_digest(entry.image).",
    )
    return "the same again, and another where photos give other masks"


def _repainted(tried: Tried) -> tuple[Entry, ...]:
    folder = tried.folder / "repainted"
    folder.mkdir(exist_ok=True)
    changed = []
    for entry in tried.entries:
        photo = np.asarray(cv2.imread(str(entry.image)), np.uint8)
        cv2.imwrite(str(folder / entry.name), 255 - photo[::-1])
        changed.append(replace(entry, image=folder / entry.name))
    return tuple(changed)
