"""Two stored runs photo by photo: differences, both outlines over each photo, and a map of the cameras."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError
from lodbench.evaluation.pose_errors import PoseError
from lodbench.evaluation.queries import ERROR
from lodbench.execution import Progress
from lodbench.geometry import Camera, Pose
from lodbench.harness.runs.compare import answers_apart
from lodbench.harness.runs.gallery import MAX_PICTURES
from lodbench.harness.runs.places import city_of
from lodbench.harness.runs.queries import prior_of
from lodbench.harness.runs.stored import StoredRun
from lodbench.rendering import Renderer, make_renderer
from lodbench.reporting.answers import trust_of
from lodbench.reporting.maps import Spot, draw_map
from lodbench.reporting.overlays import (
    ESTIMATE_COLOUR,
    PRIOR_COLOUR,
    SECOND_COLOUR,
    TRUTH_COLOUR,
    camera_of_pictures,
    jpeg_bytes,
    mask_layer,
    outline_layer,
    read_background,
)
from lodbench.reporting.page import Picture
from lodbench.reporting.photo_pairs import PhotoPair, Said, in_order, photo_pairs_section
from lodbench.storage import digest_of
from lodbench.storage.json_text import parse_json

# Of the outlines of run A, B, prior and truth, pixels: where both answers agree A is still seen below B.
_WIDTHS = {"a": 3, "b": 1, "prior": 1, "truth": 2}
_COLOURS = {"a": ESTIMATE_COLOUR, "b": SECOND_COLOUR, "prior": PRIOR_COLOUR, "truth": TRUTH_COLOUR}
_VIEW = "report_3d.html"


@dataclass(frozen=True, eq=False)
class DrawnRun:
    """A run with the data that its pictures are made of.

    Attributes:
        stored: The run.
        dataset: As it is now.
        tilt: Which prior it had.
    """

    stored: StoredRun
    dataset: Dataset
    tilt: str

    def prior(self, key: str) -> Pose | None:
        """Returns the prior of a query in the dataset's frame, or None."""
        entry = self.entries.get(key)
        return None if entry is None else prior_of(entry, self.dataset, self.tilt)

    @cached_property
    def entries(self) -> dict[str, Entry]:
        """Returns the dataset's queries by key."""
        return {entry.key: entry for entry in self.dataset.entries}


def photo_pairs_of(
    runs: tuple[StoredRun, StoredRun],
    drawn: tuple[DrawnRun, DrawnRun] | None,
    names: tuple[str, str],
    beside: Path,
    tags_file: Path,
    tags: Mapping[str, Sequence[str]],
    why_no_pictures: str = "",
) -> str:
    """Returns the part of the page of two runs that shows them photo by photo, as HTML.

    Args:
        runs: Two runs over the same photos (``why_other_photos``).
        drawn: The same with their data, or None to go without pictures and city.
        names: Of the runs.
        beside: Folder of the page, where links start.
        tags_file: File of the tags beside the page.
        tags: What it holds.
        why_no_pictures: Said where ``drawn`` is None.
    """
    pairs = in_order(_pairs(runs, drawn, beside))
    scenes = None if drawn is None else _scenes(drawn)
    notes: list[str] = []
    if drawn is not None and scenes is not None:
        pairs = _with_pictures(pairs, drawn, scenes)
        notes += _picture_notes(runs, len(pairs))
    else:
        reason = why_no_pictures or "the city model is not where it was"
        notes.append(f"No pictures and no city on the map: {reason.rstrip('.')}.")
    if not any(pair.a.view or pair.b.view for pair in pairs):
        notes.append("After lodbench report RUN of both, rows link to each photo in 3D.")
    city = (None, None) if scenes is None else (scenes[0].vertices + scenes[0].origin, scenes[0].triangles)
    shown = draw_map(
        [pair.spot for pair in pairs], *city, names={"estimate": f"A {names[0]}", "second": f"B {names[1]}"}
    )
    dataset = runs[0].summary["dataset"]
    known = [dataset["name"], dataset["version"], dataset.get("queries"), sorted(pair.key for pair in pairs)]
    kept = {
        "of": digest_of(known), "dataset": dataset["name"], "version": dataset["version"],
        "file": tags_file.name, "tags": dict(tags),
    }  # fmt: skip
    return photo_pairs_section(pairs, names, shown, notes, kept)


def _pairs(
    runs: tuple[StoredRun, StoredRun], drawn: tuple[DrawnRun, DrawnRun] | None, beside: Path
) -> list[PhotoPair]:
    first, second = runs
    found = answers_apart(first, second)
    truth = {} if drawn is None else drawn[0].dataset.truth
    keys = dict.fromkeys(str(key) for run in runs for key in run.queries.index)
    views = [_view_of(run, beside) for run in runs]
    said = [_said(run, view) for run, view in zip(runs, views, strict=True)]
    return [
        PhotoPair(
            key,
            found.get(key),
            said[0].get(key, _NOT_ASKED),
            said[1].get(key, _NOT_ASKED),
            Spot(
                key,
                None,
                _place(first.poses.get(key)),
                _place(truth.get(key)),
                second=_place(second.poses.get(key)),
            ),
            {},
        )
        for key in keys
    ]


_NOT_ASKED = Said(False, None, None, "not asked", "")


def _said(run: StoredRun, view: str) -> dict[str, Said]:
    """Returns what a run says of each photo, by key."""
    said, predictions = {}, run.predictions
    errors = run.queries[list(ERROR)].to_numpy()
    has_probability = run.queries["probability"].notna().any()
    for key, (metres, degrees) in zip(map(str, run.queries.index), errors, strict=True):
        found = predictions[key]
        # A query without an answer has probability 0 wherever probabilities are counted.
        is_lost = found.pose is None and has_probability
        said[key] = Said(
            found.pose is not None,
            None if math.isnan(metres) else PoseError(float(metres), float(degrees)),
            0.0 if is_lost else found.probability,
            trust_of(found),
            f"{view}#{quote(key)}" if view else "",
        )
    return said


def _view_of(run: StoredRun, beside: Path) -> str:
    """Returns the address of a run's page in three dimensions from a folder; "" where it has none."""
    page = run.folder / _VIEW
    if not page.is_file():
        return ""
    return quote(Path(os.path.relpath(page.resolve(), beside.resolve())).as_posix())


def _place(pose: Pose | None) -> NDArray[np.float64] | None:
    return None if pose is None else pose.center[:2]


def _scenes(drawn: tuple[DrawnRun, DrawnRun]) -> tuple[Scene, Scene] | None:
    """Returns each run's city, one object where it is one; None where either is not there."""
    first, second = (run.dataset for run in drawn)
    settings = [(d.city_model, d.lod, d.city_options, d.roof_height) for d in (first, second)]
    scene = city_of(first)
    other = scene if settings[0] == settings[1] else city_of(second)
    return None if scene is None or other is None else (scene, other)


def _picture_notes(runs: tuple[StoredRun, StoredRun], count: int) -> list[str]:
    notes = []
    cities = {run.summary["dataset"].get("scene") for run in runs}
    if len(cities - {None}) > 1:
        notes.append(
            "The runs used different city models: the outlines of A and B are each of its own, all else "
            "is of A's."
        )
    photos = {run.summary["dataset"].get("images") for run in runs}
    if len(photos - {None}) > 1:
        notes.append("The runs used different photos: those of A are shown.")
    if count > MAX_PICTURES:
        notes.append(f"Pictures of {MAX_PICTURES} of {count} photos: those whose answers lie furthest apart.")
    return notes


def _with_pictures(
    pairs: Sequence[PhotoPair], drawn: tuple[DrawnRun, DrawnRun], scenes: tuple[Scene, Scene]
) -> list[PhotoPair]:
    entries = drawn[0].entries
    first = make_renderer("silhouette", scenes[0])
    second = first if scenes[0] is scenes[1] else make_renderer("silhouette", scenes[1])
    found = []
    with Progress("pictures", min(len(pairs), MAX_PICTURES)) as progress:
        for number, pair in enumerate(pairs):
            entry = entries.get(pair.key)
            # A camera that cannot be drawn is that query's fault already.
            if number < MAX_PICTURES and entry is not None and entry.camera and not entry.camera.distortion:
                pair = pair._replace(
                    pictures=_pictures(pair, drawn, (first, second), entry.image, entry.camera)
                )
            found.append(pair)
            if number < MAX_PICTURES:
                progress.advance()
    return found


def _pictures(
    pair: PhotoPair,
    drawn: tuple[DrawnRun, DrawnRun],
    renderers: tuple[Renderer, Renderer],
    image: Path | None,
    full: Camera,
) -> dict[str, Picture]:
    """Returns a photo, and transparent pictures of its size, or shape, to lay over it, by name."""
    camera, key = camera_of_pictures(full), pair.key
    first, second = drawn
    priors = [pose for pose in (first.prior(key), second.prior(key)) if pose is not None]
    truth = first.dataset.truth.get(key)
    outlines = {
        "prior": [(renderers[0], pose) for pose in priors],
        "truth": [] if truth is None else [(renderers[0], truth)],
        "a": [(renderers[0], pose) for pose in [first.stored.poses.get(key)] if pose is not None],
        "b": [(renderers[1], pose) for pose in [second.stored.poses.get(key)] if pose is not None],
    }
    found = {"photo": Picture(jpeg_bytes(read_background(image, camera)), "jpeg", pair.caption)}
    found |= {name: Picture(layer, "webp", "") for name, layer in _masks(drawn, key).items()}
    for name, posed in outlines.items():
        masks = [
            renderer.render(camera, pose.shifted(-np.asarray(renderer.scene.origin)))
            for renderer, pose in posed
        ]
        if masks:
            found[name] = Picture(outline_layer(masks, _COLOURS[name], _WIDTHS[name]), "webp", "")
    return found


def _masks(drawn: tuple[DrawnRun, DrawnRun], key: str) -> dict[str, bytes]:
    said = [run.stored.predictions.get(key) for run in drawn]
    stored = [None if each is None or not each.mask_png else each for each in said]
    if stored[0] and stored[1] and stored[0].mask_png == stored[1].mask_png:
        return {"mask": _tinted(stored[0].mask)}
    return {name: _tinted(each.mask) for name, each in zip(("mask_a", "mask_b"), stored, strict=True) if each}


def _tinted(mask: NDArray[np.bool_] | None) -> bytes:
    assert mask is not None  # noqa: S101 - the caller has looked
    return mask_layer(mask)


_ENDING = ".tags.json"
_HINT = "Export it from the page again, or move it away."


def tags_file_of(page: Path | None) -> Path:
    """Returns the file of a page's tags, which is beside it; of a page without a name a relative one."""
    return Path(f"compared{_ENDING}") if page is None else page.with_name(f"{page.stem}{_ENDING}")


def read_tags(file: Path, dataset: Mapping[str, Any]) -> dict[str, list[str]]:
    """Returns tags by ``split/query``; none where there is no file.

    Args:
        file: As the page exports it.
        dataset: Name and version of the dataset that the page shows.

    Raises:
        DatasetError: The file cannot be read, holds no tags, or those of another dataset.
    """
    if not file.exists():
        return {}
    try:
        content = parse_json(file.read_bytes())
    except (OSError, ValueError) as error:
        raise DatasetError(f"{file} cannot be read: {error}.", _HINT) from error
    tags = content.get("tags") if isinstance(content, dict) else None
    if not isinstance(tags, dict) or not all(
        isinstance(words, list) and all(isinstance(word, str) for word in words) for words in tags.values()
    ):
        raise DatasetError(f"{file} holds no tags by photo.", _HINT)
    of, shown = (
        f"{each.get('dataset', each.get('name'))} {each.get('version')}".strip()
        for each in (content, dataset)
    )
    if of != shown:
        raise DatasetError(
            f"{file} holds tags of the dataset {of}, and the runs are of {shown}.",
            "Write the page under another name with `--out`, or move the file away.",
        )
    return tags
