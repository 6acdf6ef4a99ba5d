"""Rules of a segmenter: the same for each kind of masks that it says it provides."""

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
from lodbench.harness.conformance.trial import CAMERA, Rules, Tried, require
from lodbench.segmentation import (
    MapGuidedInstanceSegmenter,
    MapGuidedSegmenter,
    check_instances,
    check_mask,
)
from lodbench.storage import file_digest

# What makes each kind of masks.
_MEMBERS = {Input.MASK: "segment", Input.INSTANCES: "segment_instances"}


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
        found = _answer(tried, tried.make(), provides[0], bare)
        return f"QueryFault: {found}" if isinstance(found, str) else "a mask all the same"

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
    require(bool(provides), "provides nothing", "mask, instances or both.")
    for kind in provides:
        require(kind in _MEMBERS, f"provides {kind}, which no segmenter makes", "mask, instances or both.")
        require(hasattr(part, _MEMBERS[kind]), f"{kind} declared, but there is no {_MEMBERS[kind]}")
    if Input.MAP in declared_inputs(part, "requires"):
        require(hasattr(part, "segment_from"), "map required, but there is no segment_from")
    return f"provides {' and '.join(provides)}"


def _masks(tried: Tried, provides: Sequence[Input]) -> str:
    """Masks are of their type, and of the photo's aspect."""
    found = [masks for kind in provides for masks in _answers(tried, kind)]
    given = [masks for masks in found if not isinstance(masks, str)]
    if not given:
        return f"none, each with its reason: {found[0]}"
    for masks in given:
        if masks.ndim == 3:
            check_instances(masks, CAMERA)
            continue
        require(masks.dtype == np.float32, f"a mask of {masks.dtype}", "Return float32.")
        check_mask(masks, CAMERA)
    return f"{len(given)} of {len(found)} answers, of their type and the photo's aspect"


def _answer(tried: Tried, segmenter: Any, kind: Input, entry: Entry) -> NDArray[Any] | str:
    """Returns the masks of a photo, or why there are none."""
    masks: NDArray[Any]
    try:
        if kind == Input.INSTANCES and isinstance(segmenter, MapGuidedInstanceSegmenter):
            pose = entry.prior or tried.truths[0]
            masks = segmenter.segment_instances_from(entry, pose, CityMap(tried.scene))
        elif kind == Input.INSTANCES:
            masks = segmenter.segment_instances(entry)
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
    """Returns the queries with other photos of the same names."""
    folder = tried.folder / "repainted"
    folder.mkdir(exist_ok=True)
    changed = []
    for entry in tried.entries:
        photo = np.asarray(cv2.imread(str(entry.image)), np.uint8)
        cv2.imwrite(str(folder / entry.name), 255 - photo[::-1])
        changed.append(replace(entry, image=folder / entry.name))
    return tuple(changed)
