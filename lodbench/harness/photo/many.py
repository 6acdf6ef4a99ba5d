"""Many photos over one city: each localised by itself, over processes that open the city once.

What comes out is the same with one process: a table, a map of all, and what failed and why.
"""

from __future__ import annotations

import csv
import itertools
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from lodbench.citymap import CityMap
from lodbench.datasets.exchange.geojson import nowhere_feature, write_geojson
from lodbench.datasets.own import find_mask
from lodbench.errors import DatasetError, LodbenchError, WorkersGone
from lodbench.execution import Progress
from lodbench.execution.processes import Processes, single_threaded_blas
from lodbench.harness.city import open_city
from lodbench.harness.photo.localize import LocalizedPhoto, OpenMap, localize_photo, open_map
from lodbench.harness.photo.prepare import PhotoRequest
from lodbench.harness.tracebacks import kept_when_stopped
from lodbench.photos.files import find_photos, require_photos
from lodbench.photos.map_frame import SURVEY_COLUMNS, survey_row
from lodbench.photos.pose import PoseNotStated
from lodbench.reporting import flight_words, maps, table_heads
from lodbench.reporting.answers import percent_text, rounded_down
from lodbench.segmentation.photo_segmenter import PackagedNetwork
from lodbench.storage import hide_formula, make_folder, write_text
from lodbench.storage.disk import writable

Item = TypeVar("Item")
Result = TypeVar("Result")

# A worker begins within what two photos take: it is started for no fewer than this.
_PHOTOS_PER_WORKER = 4
TABLE_FILE, MAP_FILE, VIEW_FILE = "localized.csv", "localized.geojson", "localized_3d.html"
GEOPACKAGE_FILE = "localized.gpkg"
FLIGHTS_FILE, FINDINGS_FILE = "flights.json", "map_findings.geojson"
COLUMNS = (
    "photo", *SURVEY_COLUMNS, "probability", "trust", "crs", "moved_m", "score", "failure", "flight", "notes",
)  # fmt: skip


def default_workers(request: PhotoRequest, photos: int) -> int:
    """Returns how many processes suit so many photos; others' methods and large networks run in this one."""
    is_own = type(request.method).__module__.startswith("lodbench.")
    if not is_own or not isinstance(request.segmenter, PackagedNetwork | None):
        return 1
    return max(1, min(os.cpu_count() or 1, photos // _PHOTOS_PER_WORKER))


@dataclass(slots=True, eq=False)
class PhotoWorker:
    """What works on photos: the request, and its city from where it is first looked at."""

    request: PhotoRequest  # as for one photo; the photo's own fields count for nothing
    opened: OpenMap | None = None  # the city, where the process has it open; None else
    _city_map: CityMap | None = None

    def place(self) -> OpenMap:
        """Returns the city.

        Raises:
            LodbenchError: It cannot be read.
        """
        self.opened = self.opened or open_map(self.request)
        return self.opened

    @property
    def city_map(self) -> CityMap:
        """Returns the map; beside other workers it is drawn by one thread."""
        self._city_map = self._city_map or CityMap(self.place().scene, threads=self.request.threads)
        return self._city_map


class PhotoWorkers:
    """Processes that work on photos, or this one; use ``photo_workers``."""

    def __init__(self, processes: Processes) -> None:
        self._processes = processes

    def each(
        self,
        label: str,
        work: Callable[[PhotoWorker, Item], Result],
        items: Mapping[int, Item],
        photos: Sequence[Path],
    ) -> Iterator[tuple[int, Result]]:
        """Yields the results of work on photos with their numbers, as they come, beside progress.

        Photos of one name are worked on one after the other: their files are numbered in their order.

        Args:
            label: Of the progress.
            work: Module-level function; what it takes and returns goes from process to process.
            items: By number in ``photos``.
            photos: All of them; those without an item are done.
        """
        batches: dict[object, list[tuple[int, Item]]] = {}
        for number, item in items.items():
            key = number if self._processes.count == 1 else photos[number].stem
            batches.setdefault(key, []).append((number, item))
        with Progress(label, len(photos), done=len(photos) - len(items)) as progress:
            for results in self._processes.map(partial(_work_here, work), batches.values()):
                yield from results
                progress.advance(len(results))


@contextmanager
def photo_workers(request: PhotoRequest, opened: OpenMap | None = None) -> Iterator[PhotoWorkers]:
    """Holds ``request.workers`` processes for the block; one is this process.

    Args:
        request: As for one photo.
        opened: Its city, if it is open here.

    Raises:
        WorkersGone: They keep dying.
    """
    own = opened if request.workers == 1 else None
    try:
        with closing(Processes(request.workers, _begin_here, (request, own))) as processes:
            yield PhotoWorkers(processes)
    except WorkersGone as fault:
        raise WorkersGone(fault.message, "`--workers 1` works in one process, with less memory.") from fault
    finally:
        _here.clear()


# What this process works with; set once, before its first photo.
_here: list[PhotoWorker] = []


def _begin_here(request: PhotoRequest, opened: OpenMap | None) -> None:
    _here[:] = [PhotoWorker(request, opened)]


@single_threaded_blas
def _work_here(
    work: Callable[[PhotoWorker, Item], Result], batch: Sequence[tuple[int, Item]]
) -> list[tuple[int, Result]]:
    return [(number, work(_here[0], item)) for number, item in batch]


@dataclass(frozen=True, slots=True, eq=False)
class FlightAnswer:
    """What became of a flight; ``source`` is what its rough poses are from."""

    name: str
    photos: tuple[Path, ...]
    taken: tuple[str, ...]
    findings: dict[str, Any]
    source: flight_words.PriorSource = "metadata"

    def sentences(self) -> list[str]:
        """Returns what the flight says of drone, camera and map."""
        lines = flight_words.constants_in_words(self.findings.get("constants", {}), self.source)
        lines += flight_words.map_in_words(self.findings)
        lines += self.findings.get("notes", [])
        reasons = self.findings.get("reasons", {})
        for name in self.findings.get("lost", []):
            reason = f": {reasons[name]}" if name in reasons else ""
            lines.append(f"pose from the other photos alone: {name}{reason}")
        return lines

    def to_json(self) -> dict[str, Any]:
        """Returns plain values for JSON."""
        return {
            "flight": self.name,
            "photos": [str(photo) for photo in self.photos],
            "taken": list(self.taken),
            "in_words": self.sentences(),
            **self.findings,
        }


@dataclass(frozen=True, slots=True)
class PhotoAnswer:
    """What became of one of many photos."""

    photo: Path  # the file
    localized: LocalizedPhoto | None  # the answer, or None
    failure: str = ""  # why there is none, or ""
    flight: str = ""  # it was taken on, where that was looked for
    hint: str = ""  # what would help, or ""

    @property
    def trust(self) -> str:
        """Returns how far the answer may be trusted, in a word."""
        return "failed" if self.localized is None else self.localized.trust

    def row(self) -> dict[str, Any]:
        """Returns the row of the table: ``COLUMNS``, None for what is not known."""
        values: dict[str, Any] = dict.fromkeys(COLUMNS)
        # Tables take no name whose bytes are no text.
        texts = {"photo": str(self.photo), "failure": self.failure, "flight": self.flight}
        values |= {name: writable(text) for name, text in texts.items()} | {"trust": self.trust}
        values["flight"] = values["flight"] or None
        if self.localized is not None:
            values |= survey_row(self.localized.pose, self.localized.place, self.localized.covariance)
            values |= {"crs": self.localized.crs, "score": round(self.localized.score, 4)}
            values["notes"] = "; ".join(self.localized.method_notes)
            values["moved_m"] = round(self.localized.moved.translation_m, 3)
            if self.localized.probability is not None:
                values["probability"] = rounded_down(self.localized.probability, 4)
        return values


@dataclass(frozen=True, slots=True)
class Answers:
    """What became of many photos."""

    photos: tuple[PhotoAnswer, ...]
    flights: tuple[FlightAnswer, ...]
    folder: Path
    number: int

    @property
    def table(self) -> Path:
        """Returns the file with a row per photo."""
        return numbered(self.folder / TABLE_FILE, self.number)

    @property
    def localized(self) -> list[LocalizedPhoto]:
        """Returns the photos that have an answer."""
        return [answer.localized for answer in self.photos if answer.localized is not None]

    @property
    def view(self) -> Path:
        """Returns the file that shows them in three dimensions."""
        return numbered(self.folder / VIEW_FILE, self.number)

    @property
    def map(self) -> Path:
        """Returns the file with all cameras on a map."""
        return numbered(self.folder / MAP_FILE, self.number)

    @property
    def geopackage(self) -> Path:
        """Returns the same as a GeoPackage."""
        return numbered(self.folder / GEOPACKAGE_FILE, self.number)

    def page(self, flight: FlightAnswer) -> Path:
        """Returns the page of a flight."""
        return numbered(self.folder / f"{flight.name.replace(' ', '_')}.html", self.number)


def photos_of(paths: Sequence[Path], masks: Path | None = None, *others: Path | None) -> list[Path]:
    """Returns the photos that files and folders name, each once, in that order.

    Args:
        paths: Files, and folders with all below them.
        masks: Folder of masks among them, whose pictures are no photos unless all photos lie in it; or None.
        others: More such folders; see ``find_photos``.

    Raises:
        DatasetError: A path is not there, or a folder holds no photos.
    """
    unique: dict[Path, Path] = {}
    for path in paths:
        if not path.exists():
            raise DatasetError(f"{path} does not exist.", "Check the path.")
        for photo in find_photos(path, masks, *others):
            unique.setdefault(photo.resolve(), photo)
    outside = [
        path for whole, path in unique.items() if masks is None or not whole.is_relative_to(masks.resolve())
    ]
    photos = outside or list(unique.values())
    require_photos(photos, paths[0])
    return photos


def localize_photos(request: PhotoRequest, photos: Sequence[Path], masks: Path | None) -> Answers:
    """Returns what became of each photo, and writes them as table and maps, see ``write_answers``.

    Where it is stopped, they are written of the photos that are done.

    Args:
        request: As for one photo; ``photo`` and ``mask`` are set for each.
        photos: The files.
        masks: Folder of masks named as the photos, or None.
    """
    answers: dict[int, PhotoAnswer] = {}
    items = {
        row: (photo, find_mask(masks, f"{photo.parent.name}/{photo.name}", photo), masks)
        for row, photo in enumerate(photos)
    }

    def keep() -> str:
        if all(answer.localized is None for answer in answers.values()):
            return ""
        left = (PhotoAnswer(photo, None, "stopped before its turn") for photo in photos)
        write_answers(request.out, [answers.get(row) or other for row, other in enumerate(left)])
        return f"{len(answers)} of {len(photos)} photos were done until then"

    keeping = kept_when_stopped(request.out, TABLE_FILE, keep, (KeyboardInterrupt,))
    with keeping, photo_workers(request) as workers:
        for row, answer in workers.each("photos", _answer, items, photos):
            answers[row] = answer
    return write_answers(request.out, [answers[row] for row in items])


def write_answers(
    out: Path, answers: Sequence[PhotoAnswer], flights: Sequence[FlightAnswer] | None = None
) -> Answers:
    """Writes ``localized.csv``, ``.geojson`` and ``.gpkg``, numbered where those of other photos are there.

    So they are where flights were looked for then and are not now (``flights`` None): what is said of these
    would stand beside other answers.
    """
    make_folder(out)
    photos = {writable(hide_formula(str(answer.photo))) for answer in answers}
    number = next(
        n
        for n in itertools.count(1)
        if _is_free(out, n, photos) and (flights is not None or not numbered(out / FLIGHTS_FILE, n).exists())
    )
    written = Answers(tuple(answers), tuple(flights or ()), out, number)
    _write_table(written.table, answers)
    features = _features(answers)
    write_geojson(features, written.map)
    from lodbench.datasets.exchange.geojson import write_geopackage

    write_geopackage(features, written.geopackage)
    return written


def numbered(path: Path, number: int) -> Path:
    """Returns a path with a number at the end of its stem; as it is for 1."""
    return path if number == 1 else path.with_stem(f"{path.stem}_{number}")


def _is_free(out: Path, number: int, photos: set[str]) -> bool:
    """Tells whether files of a number may be written: there are none, or their table is of these photos."""
    table, *others = (
        numbered(out / name, number)
        for name in (TABLE_FILE, MAP_FILE, GEOPACKAGE_FILE, VIEW_FILE, FLIGHTS_FILE, FINDINGS_FILE)
    )
    if not table.exists():
        return not any(other.exists() for other in others)
    try:
        with table.open(encoding="utf-8", newline="") as stream:
            return {row["photo"] for row in csv.DictReader(stream)} == photos
    except (OSError, ValueError, KeyError, csv.Error):
        return False  # a file of somebody else's


def _answer(worker: PhotoWorker, item: tuple[Path, Path | None, Path | None]) -> PhotoAnswer:
    photo, mask, masks = item
    try:
        if masks is not None and mask is None:
            raise DatasetError(f"{masks} holds no mask of it")
        request = replace(worker.request, photo=photo, mask=mask)
        return PhotoAnswer(photo, localize_photo(request, opened=worker.place))
    except LodbenchError as fault:
        return PhotoAnswer(photo, None, fault.message.rstrip("."), hint=hint_for_many(fault))


def hint_for_many(fault: LodbenchError) -> str:
    """Returns what to do about the fault of one of many photos."""
    return fault.hint_for_many if isinstance(fault, PoseNotStated) else fault.hint


def _write_table(path: Path, answers: Sequence[PhotoAnswer]) -> None:
    import pandas as pd

    frame = pd.DataFrame([answer.row() for answer in answers], columns=list(COLUMNS))
    texts = ["photo", "failure", "notes"]
    frame[texts] = frame[texts].fillna("").map(hide_formula)
    write_text(path, str(frame.to_csv(index=False, lineterminator="\n")))


def _features(answers: Sequence[PhotoAnswer]) -> list[dict[str, Any]]:
    features: list[dict[str, Any]] = []
    for answer in answers:
        if answer.localized is None:
            features.append(nowhere_feature({"name": answer.photo.name, "failure": answer.failure}))
        else:
            features += [{**f, "properties": _stated(answer, f)} for f in answer.localized.features]
    return features


def _stated(answer: PhotoAnswer, feature: dict[str, Any]) -> dict[str, Any]:
    """Returns the properties of a feature, with the photo's file: names of photos repeat."""
    extra = {"photo": str(answer.photo)}
    if feature["properties"].get("kind") == "estimate":
        extra["trust"] = answer.trust
    return {**feature["properties"], **extra}


def write_view(
    path: Path,
    request: PhotoRequest,
    photos: Sequence[LocalizedPhoto],
    pages: Mapping[str, str] | None = None,
) -> None:
    """Writes a page of city, photos, rough poses and answers; it leads to ``pages``, addresses by name."""
    city = open_city(request.city, request.lod, request.options, request.roof_height)
    origin = city.scene.origin
    cameras = [
        maps.ViewedCamera(
            key=each.photo,
            facts=_facts(each),
            camera=each.camera,
            prior=each.prior.shifted(-origin),
            estimate=each.pose.shifted(-origin),
            truth=None,
            photo=each.thumbnail if number < maps.MAX_PHOTOS else None,
        )
        for number, each in enumerate(photos)
    ]
    title = f"{len(photos)} photo{'s' if len(photos) > 1 else ''} over {request.city.name}"
    write_text(path, maps.draw_view3d(title, city.scene, cameras, pages))


def _facts(localized: LocalizedPhoto) -> dict[str, str]:
    row = survey_row(localized.pose, localized.place)
    columns = flight_words.place_columns(localized.place is not None)
    x, y, *others = [format(row[name], spec) for _, name, spec in columns]
    place = {", ".join(head for head, _, _ in columns[:2]): f"{x}, {y}", "height m": others[0]}
    facts = {"trust": localized.trust} | place | {"heading, pitch, roll deg": ", ".join(others[1:])}
    if localized.probability is not None:
        facts["sure"] = percent_text(localized.probability)
    moved = f"{localized.moved.translation_m:.2f} m, {localized.moved.rotation_deg:.2f} deg"
    return {**facts, "from the prior": moved, "score": table_heads.finite_text(localized.score, ".3f")}
