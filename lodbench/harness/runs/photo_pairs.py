"""Two stored runs photo by photo: differences, both outlines over each photo, and a map of the cameras.

First what a page shows of each photo, from plain data; then how it is made of the runs; tags at the end.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError
from lodbench.evaluation.metrics import ERROR
from lodbench.evaluation.pose_errors import Apart, PoseError
from lodbench.execution import Progress
from lodbench.geometry import Camera, Pose
from lodbench.harness.runs.compare import answers_apart, link_to
from lodbench.harness.runs.gallery import MAX_PICTURES
from lodbench.harness.runs.places import city_of
from lodbench.harness.runs.queries import prior_of
from lodbench.harness.runs.stored import StoredRun
from lodbench.rendering import Renderer, make_renderer
from lodbench.reporting import overlays
from lodbench.reporting.answers import percent_text, probability_text, trust_label
from lodbench.reporting.maps import Spot, draw_map
from lodbench.reporting.page import Picture, markup, rendered
from lodbench.storage import digest_of
from lodbench.storage.json_text import parse_json

# What lies over a photo, from below, and whether it is shown at first.
LAYERS = (
    ("mask", False), ("mask_a", False), ("mask_b", False), ("prior", False), ("truth", True), ("a", True),
    ("b", True),
)  # fmt: skip
# Of the outlines of run A, B, prior and truth, pixels: where both answers agree A is still seen below B.
_WIDTHS = {"a": 3, "b": 1, "prior": 1, "truth": 2}
_COLOURS = {
    "a": overlays.ESTIMATE_COLOUR,
    "b": overlays.SECOND_COLOUR,
    "prior": overlays.PRIOR_COLOUR,
    "truth": overlays.TRUTH_COLOUR,
}
_VIEW = "report_3d.html"
_ENDING = ".tags.json"
_HINT = "Export it from the page again, or move it away."


class Answer(NamedTuple):
    """What a run answers to a photo."""

    is_answered: bool  # whether there is a pose
    error: PoseError | None  # from the truth, (inf, 180) without a pose; None where there is no truth
    probability: float | None  # of a pose within 2 m and 2 degrees; 0 without one; None where nobody says
    trust: str  # in a word
    view: str  # address of the photo in the run's page in three dimensions; "" for none


class PhotoPair(NamedTuple):
    """A photo that two runs, A and B, worked on."""

    key: str  # ``split/query``
    apart: Apart | None  # how far the answer of B lies from that of A; None unless both have one
    a: Answer
    b: Answer
    spot: Spot  # where the cameras are on the map
    pictures: Mapping[str, Picture]  # the photo, what lies over it by a name of ``LAYERS``; empty for none

    @property
    def distance_m(self) -> float:
        """Returns how far the answers lie apart; infinite if one is missing, NaN if both are."""
        if self.apart is not None:
            return self.apart.error.translation_m
        return math.inf if self.a.is_answered or self.b.is_answered else math.nan

    @property
    def caption(self) -> str:
        """Returns what stands below its picture."""
        words = [f"{name}: {_words_of(answer)}" for name, answer in (("A", self.a), ("B", self.b))]
        if self.apart is not None:
            (metres, degrees), parts = self.apart
            words.insert(
                0,
                f"{metres:.2f} m and {degrees:.2f} deg apart, {parts.horizontal_m:.2f} m in plan, "
                f"B {abs(parts.vertical_m):.2f} m {'higher' if parts.vertical_m >= 0 else 'lower'}",
            )
        return f"{self.key}: {'; '.join(words)}"


class Cell(NamedTuple):
    """A cell of the table: its text, and the number it sorts by; None for a text."""

    text: str
    value: float | None = None


class Column(NamedTuple):
    """A column of the table."""

    name: str  # in the page's script
    head: str  # what is above it
    title: str  # what the head means, in full
    test: str  # what a reader may filter it by: ``least``, ``most`` or ``is``; "" for nothing
    cell: Callable[[PhotoPair], Cell]  # returns the cell of a photo


def in_order(pairs: Sequence[PhotoPair]) -> list[PhotoPair]:
    """Returns photos with one answer, then those whose answers lie furthest apart, those with none last."""
    return sorted(
        pairs,
        key=lambda pair: (
            math.isnan(pair.distance_m),
            -np.nan_to_num(pair.distance_m, posinf=math.inf),
            pair.key,
        ),
    )


def columns_of(pairs: Sequence[PhotoPair]) -> list[Column]:
    """Returns the columns that hold anything."""
    return [
        column
        for column in _COLUMNS
        if column.name == "photo" or any(column.cell(pair).text != "-" for pair in pairs)
    ]


def photo_pairs_section(
    pairs: Sequence[PhotoPair],
    names: tuple[str, str],
    map_html: str,
    notes: Sequence[str],
    tags: Mapping[str, Any],
) -> str:
    """Returns the part of a page that shows two runs photo by photo, as HTML.

    Args:
        pairs: The photos, in the order of the rows.
        names: Of run A and run B.
        map_html: The map (``draw_map``); "" for none.
        notes: What a reader should know of the pictures.
        tags: What the page's script needs of tags: ``of`` names the photos for the browser's memory,
            ``dataset`` and ``version`` are written into the file ``file``, ``tags`` are by key.
    """
    columns = columns_of(pairs)
    called = {"a": f"A {names[0]}", "b": f"B {names[1]}", "mask_a": "mask of A", "mask_b": "mask of B"}
    return rendered(
        "photo_pairs.html.jinja",
        names=names,
        furthest=max((p for p in pairs if p.apart is not None), key=lambda p: p.distance_m, default=None),
        alone=sum(math.isinf(pair.distance_m) for pair in pairs),
        pairs=pairs,
        columns=columns,
        rows=[(pair, [column.cell(pair) for column in columns]) for pair in pairs],
        choices={c.name: sorted({c.cell(pair).text for pair in pairs}) for c in columns if c.test == "is"},
        layers=[
            (name, called.get(name, name), is_shown)
            for name, is_shown in LAYERS
            if any(name in pair.pictures for pair in pairs)
        ],
        order=[name for name, _ in LAYERS],
        has_views=any(pair.a.view or pair.b.view for pair in pairs),
        map=markup(map_html),
        notes=notes,
        tags_file=tags["file"],
        # No text of a file ends the script that it stands in.
        tags=markup(json.dumps(tags, ensure_ascii=True).replace("<", "\\u003c")),
    )


def _words_of(answer: Answer) -> str:
    if not answer.is_answered:
        return "no answer"
    words = [] if answer.error is None else ["{:.2f} m and {:.2f} deg off".format(*answer.error)]
    words += [] if answer.probability is None else [f"probability {percent_text(answer.probability)}"]
    return ", ".join([*words, *([] if answer.trust == "-" else [answer.trust])]) or "answered"


def _number(value: float | None, spec: str = ".2f", sorts_by: float | None = None) -> Cell:
    """Returns a number as a cell; "-" where it is not known, "failed" where it is infinite."""
    if value is None or math.isnan(value):
        return Cell("-")
    if math.isinf(value):
        return Cell("failed", value)
    return Cell(format(value, spec), value if sorts_by is None else sorts_by)


def _sure(probability: float | None) -> Cell:
    return Cell("-") if probability is None else Cell(probability_text(probability), probability)


def _apart_cell(part: Callable[[Apart], float], spec: str = ".2f") -> Callable[[PhotoPair], Cell]:
    def cell(pair: PhotoPair) -> Cell:
        if pair.apart is not None:
            return _number(part(pair.apart), spec, abs(part(pair.apart)))
        if not (pair.a.is_answered or pair.b.is_answered):
            return Cell("-")
        # An answer that the other run lacks is no small difference.
        return Cell("only A" if pair.a.is_answered else "only B", math.inf)

    return cell


def _answer_columns(name: str) -> list[Column]:
    def answer(pair: PhotoPair) -> Answer:
        return pair.a if name == "A" else pair.b

    def error(part: int) -> Callable[[PhotoPair], Cell]:
        def cell(pair: PhotoPair) -> Cell:
            found = answer(pair).error
            if found is None:
                return Cell("-")
            return Cell("failed", math.inf) if math.isinf(found[0]) else _number(found[part])

        return cell

    key = name.lower()
    return [
        Column(f"error_{key}", f"error {name} m", f"error of {name}, m", "least", error(0)),
        Column(f"turned_{key}", f"error {name} deg", f"error of {name}, deg", "", error(1)),
    ]


def _worse(pair: PhotoPair) -> Cell:
    """Returns how much further B is from the truth than A."""
    if pair.a.error is None or pair.b.error is None:
        return Cell("-")
    # Where both failed neither is worse.
    is_same = pair.a.error[0] == pair.b.error[0]
    return _number(0.0 if is_same else pair.b.error[0] - pair.a.error[0], "+.2f")


_COLUMNS = (
    Column("photo", "photo", "photo", "", lambda pair: Cell(pair.key)),
    Column("apart", "apart m", "answers apart, m", "least", _apart_cell(lambda d: d.error.translation_m)),
    Column("turned", "apart deg", "answers apart, deg", "least", _apart_cell(lambda d: d.error.rotation_deg)),
    Column("plan", "in plan m", "apart in plan, m", "", _apart_cell(lambda d: d.parts.horizontal_m)),
    Column("height", "in height m", "B above A, m", "", _apart_cell(lambda d: d.parts.vertical_m, "+.2f")),
    *_answer_columns("A"),
    *_answer_columns("B"),
    Column("worse", "B worse by m", "B worse by, m", "least", _worse),
    Column("sure_a", "prob. A", "probability of A", "most", lambda pair: _sure(pair.a.probability)),
    Column("sure_b", "prob. B", "probability of B", "most", lambda pair: _sure(pair.b.probability)),
    Column("trust_a", "trust A", "trust in A", "is", lambda pair: Cell(pair.a.trust)),
    Column("trust_b", "trust B", "trust in B", "is", lambda pair: Cell(pair.b.trust)),
)


@dataclass(frozen=True, eq=False)
class DrawnRun:
    """A run with the data that its pictures are made of."""

    stored: StoredRun  # the run
    dataset: Dataset  # as it is now
    tilt: str  # which prior it had

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
        why_no_pictures: Reported where ``drawn`` is None.
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
    differences = answers_apart(first, second)
    truth = {} if drawn is None else drawn[0].dataset.truth
    keys = dict.fromkeys(str(key) for run in runs for key in run.queries.index)
    views = [quote(link_to(run.folder / _VIEW, beside)) for run in runs]
    answers = [_answers(run, view) for run, view in zip(runs, views, strict=True)]
    return [
        PhotoPair(
            key,
            differences.get(key),
            answers[0].get(key, _NOT_ASKED),
            answers[1].get(key, _NOT_ASKED),
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


_NOT_ASKED = Answer(False, None, None, "not asked", "")


def _answers(run: StoredRun, view: str) -> dict[str, Answer]:
    """Returns what a run says of each photo, by key."""
    answers, predictions = {}, run.predictions
    errors = run.queries[list(ERROR)].to_numpy()
    has_probability = run.queries["probability"].notna().any()
    for key, (metres, degrees) in zip(map(str, run.queries.index), errors, strict=True):
        found = predictions[key]
        # A query without an answer has probability 0 wherever probabilities are counted.
        is_lost = found.pose is None and has_probability
        answers[key] = Answer(
            found.pose is not None,
            None if math.isnan(metres) else PoseError(float(metres), float(degrees)),
            0.0 if is_lost else found.probability,
            trust_label(found),
            f"{view}#{quote(key)}" if view else "",
        )
    return answers


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
    pictured = []
    with Progress("pictures", min(len(pairs), MAX_PICTURES)) as progress:
        for number, pair in enumerate(pairs):
            entry = entries.get(pair.key)
            # A camera that cannot be drawn is that query's fault already.
            if number < MAX_PICTURES and entry is not None and entry.camera and not entry.camera.distortion:
                pair = pair._replace(
                    pictures=_pictures(pair, drawn, (first, second), entry.image, entry.camera)
                )
            pictured.append(pair)
            if number < MAX_PICTURES:
                progress.advance()
    return pictured


def _pictures(
    pair: PhotoPair,
    drawn: tuple[DrawnRun, DrawnRun],
    renderers: tuple[Renderer, Renderer],
    image: Path | None,
    full: Camera,
) -> dict[str, Picture]:
    """Returns a photo, and transparent pictures of its size, or shape, to lay over it, by name."""
    camera, key = overlays.camera_of_pictures(full), pair.key
    first, second = drawn
    priors = [pose for pose in (first.prior(key), second.prior(key)) if pose is not None]
    truth = first.dataset.truth.get(key)
    outlines = {
        "prior": [(renderers[0], pose) for pose in priors],
        "truth": [] if truth is None else [(renderers[0], truth)],
        "a": [(renderers[0], pose) for pose in [first.stored.poses.get(key)] if pose is not None],
        "b": [(renderers[1], pose) for pose in [second.stored.poses.get(key)] if pose is not None],
    }
    pictures = {
        "photo": Picture(overlays.jpeg_bytes(overlays.read_background(image, camera)), "jpeg", pair.caption)
    }
    pictures |= {name: Picture(layer, "webp", "") for name, layer in _masks(drawn, key).items()}
    for name, posed in outlines.items():
        masks = [
            renderer.render(camera, pose.shifted(-np.asarray(renderer.scene.origin)))
            for renderer, pose in posed
        ]
        if masks:
            pictures[name] = Picture(overlays.outline_layer(masks, _COLOURS[name], _WIDTHS[name]), "webp", "")
    return pictures


def _masks(drawn: tuple[DrawnRun, DrawnRun], key: str) -> dict[str, bytes]:
    found = [run.stored.predictions.get(key) for run in drawn]
    first, second = (None if each is None or not each.mask_png else each.mask for each in found)
    if first is not None and second is not None and np.array_equal(first, second):
        return {"mask": overlays.mask_layer(first)}
    masks = {"mask_a": first, "mask_b": second}
    return {name: overlays.mask_layer(mask) for name, mask in masks.items() if mask is not None}


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
