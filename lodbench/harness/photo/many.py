"""Many photos over one city: each localised by itself; a table, a map of all, and what failed and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lodbench.datasets.exchange.geojson import nowhere_feature, write_geojson
from lodbench.datasets.own import find_mask, find_photos
from lodbench.errors import DatasetError, LodbenchError
from lodbench.execution import Progress
from lodbench.harness.photo.localize import LocalizedPhoto, PhotoRequest, localize_photo
from lodbench.reporting.answers import trust_word
from lodbench.storage import hide_formula, write_text

TABLE_FILE, MAP_FILE = "localized.csv", "localized.geojson"
COLUMNS = (
    "photo", "latitude_deg", "longitude_deg", "height_m", "heading_deg", "pitch_deg", "roll_deg", "crs",
    "east", "north", "up", "score", "probability", "trust", "moved_m", "failure",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class PhotoAnswer:
    """What became of one of many photos.

    Attributes:
        photo: The file.
        found: The answer, or None.
        failure: Why there is none, or "".
    """

    photo: Path
    found: LocalizedPhoto | None
    failure: str = ""

    @property
    def trust(self) -> str:
        """Returns how far the answer may be trusted, in a word."""
        if self.found is None:
            return "failed"
        if not self.found.is_trusted:
            return "do not trust"
        return "-" if self.found.probability is None else trust_word(self.found.probability)

    def row(self) -> dict[str, Any]:
        """Returns the row of the table: ``COLUMNS``, None for what is not known."""
        values: dict[str, Any] = dict.fromkeys(COLUMNS)
        values |= {"photo": str(self.photo), "trust": self.trust, "failure": self.failure}
        if self.found is not None:
            values |= {} if self.found.place is None else self.found.place._asdict()
            values |= dict(zip(("east", "north", "up"), map(float, self.found.pose.center), strict=True))
            values |= {"crs": self.found.crs, "score": self.found.score}
            values |= {"probability": self.found.probability, "moved_m": self.found.moved.translation_m}
        return values


def photos_of(paths: Sequence[Path], masks: Path | None = None) -> list[Path]:
    """Returns the photos that files and folders name, each once, in that order; masks among them are none.

    Raises:
        DatasetError: A path is not there, or a folder holds no photos.
    """
    found: dict[Path, Path] = {}
    for path in paths:
        if not path.exists():
            raise DatasetError(f"{path} does not exist.", "Check the path.")
        for photo in find_photos(path):
            if masks is None or not photo.is_relative_to(masks):
                found.setdefault(photo.resolve(), photo)
    return list(found.values())


def localize_photos(request: PhotoRequest, photos: Sequence[Path], masks: Path | None) -> list[PhotoAnswer]:
    """Returns what became of each photo, and writes ``localized.csv`` and ``localized.geojson``.

    Args:
        request: As for one photo; ``photo`` and ``mask`` are set for each.
        photos: The files.
        masks: Folder of masks named as the photos, or None.
    """
    answers = []
    with Progress("photos", len(photos)) as progress:
        for photo in photos:
            mask = find_mask(masks, photo.name)
            answers.append(_answer(replace(request, photo=photo, mask=mask), masks))
            progress.advance()
    request.out.mkdir(parents=True, exist_ok=True)
    _write_table(request.out / TABLE_FILE, answers)
    _write_map(request.out / MAP_FILE, answers)
    return answers


def _answer(request: PhotoRequest, masks: Path | None) -> PhotoAnswer:
    try:
        if masks is not None and request.mask is None:
            raise DatasetError(f"{masks} holds no mask of it")
        return PhotoAnswer(request.photo, localize_photo(request))
    except LodbenchError as fault:
        return PhotoAnswer(request.photo, None, fault.message.rstrip("."))


def _write_table(path: Path, answers: Sequence[PhotoAnswer]) -> None:
    import pandas as pd

    frame = pd.DataFrame([answer.row() for answer in answers], columns=list(COLUMNS))
    frame[["photo", "failure"]] = frame[["photo", "failure"]].map(hide_formula)
    write_text(path, str(frame.to_csv(index=False, lineterminator="\n")))


def _write_map(path: Path, answers: Sequence[PhotoAnswer]) -> None:
    features: list[dict[str, Any]] = []
    for answer in answers:
        if answer.found is None:
            features.append(nowhere_feature({"name": answer.photo.name, "failure": answer.failure}))
        else:
            features += [{**f, "properties": _stated(answer, f)} for f in answer.found.features]
    write_geojson(features, path)


def _stated(answer: PhotoAnswer, feature: dict[str, Any]) -> dict[str, Any]:
    """Returns the properties of a feature, with the photo's file: names of photos repeat."""
    extra = {"photo": str(answer.photo)}
    if feature["properties"].get("kind") == "estimate":
        extra["trust"] = answer.trust
    return {**feature["properties"], **extra}
