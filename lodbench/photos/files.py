"""Which files of a folder are photos, which were taken on one flight, and which have traced masks."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path, PurePosixPath

from lodbench.errors import DatasetError
from lodbench.photos.metadata import PhotoMetadata
from lodbench.storage import file_digest
from lodbench.storage.json_text import parse_json

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")


def in_pose_lines(name: str) -> str:
    """Returns a name without what lines of poses cannot hold: spaces, and bytes that are no UTF-8."""
    return re.sub(r"[\s\ud800-\udfff]+", "_", name)


def find_photos(folder: Path, masks: Path | None = None, *others: Path | None) -> list[Path]:
    """Returns the photos of a folder and all below it, by name; or the one photo a path names.

    Masks that ``lodbench mask`` put beside them, overlays of ``lodbench localize``, and what macOS keeps of
    photos (``._NAME``), are none.

    Args:
        folder: The folder, or one photo.
        masks: Folder of masks, whose pictures are no photos; or None. If the photos lie in it, too, their
            masks are those that ``lodbench mask`` saved, and a PNG beside a photo in another format.
        others: More such folders, if they are below it: unused masks, results of an earlier command.

    Raises:
        DatasetError: There are none.
    """
    if folder.is_file():
        return [folder]
    pictures = (path for path in folder.rglob("*") if path.suffix.lower() in PHOTO_SUFFIXES)
    # macOS keeps files of its own beside photos that it copies to a card, in the same ending.
    paths = sorted(path for path in pictures if not path.name.startswith("._") and not path.is_dir())
    if not paths:
        raise DatasetError(f"{folder} holds no photos.", f"Looked for {', '.join(PHOTO_SUFFIXES)} files.")
    aside_from = [other.resolve() for other in (masks, *others) if other is not None]
    aside = [other for other in aside_from if not folder.resolve().is_relative_to(other)]
    are_photos = {
        parent: not any(parent.resolve().is_relative_to(other) for other in aside)
        for parent in {path.parent for path in paths}
    }
    photos = [path for path in paths if are_photos[path.parent]]
    made = {path.with_name(mask_name(path.stem)) for path in photos}
    if masks is not None and masks.resolve() not in aside:
        made |= {path.with_suffix(".png") for path in photos if path.suffix.lower() != ".png"}
    return [path for path in photos if path not in made and not _is_overlay(path)]


def _is_overlay(path: Path) -> bool:
    """Tells whether ``lodbench localize`` wrote a picture: with the answer beside it."""
    label = path.name.removesuffix("_overlay.png")
    if label == path.name:
        return False
    try:
        answer = parse_json(path.with_name(f"{label}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    # Others put polygons into a file of that name.
    return isinstance(answer, dict) and "sha256" in answer and "pose" in answer


def mask_names(photo: str) -> tuple[str, ...]:
    """Returns what the mask of a photo of a name may be called in a folder of masks, in the order tried."""
    stem = PurePosixPath(photo).stem
    return photo, f"{stem}.png", mask_name(stem)


def mask_name(stem: str) -> str:
    """Returns what ``lodbench mask`` calls a photo's mask, which it puts beside it."""
    return f"{stem}_mask.png"


def require_photos(photos: Sequence[Path], source: Path) -> None:
    """Makes sure that a folder holds more than masks and results.

    Raises:
        DatasetError: There are no photos.
    """
    if not photos:
        raise DatasetError(
            f"{source} holds no photos outside the folders of masks and results.",
            "Put the masks into a folder of their own.",
        )


def copies_among(
    photos: Sequence[Path], masks: Sequence[Path | None]
) -> tuple[dict[int, str], dict[int, str]]:
    """Returns by row which photo another is a copy of, and why others cannot be read, in words.

    The original is one that has a mask, if any has, of the shortest name: copies are called ``NAME (1)``,
    which comes before ``NAME`` in a folder, and masks go by the name of the original.

    Args:
        photos: The files.
        masks: The mask of each, or None.
    """
    unreadable: dict[int, str] = {}
    same: dict[str, list[int]] = defaultdict(list)
    for row, photo in enumerate(photos):
        try:
            same[file_digest(photo)].append(row)
        except OSError as error:
            unreadable[row] = f"it cannot be read: {error.strerror}"
    copies: dict[int, str] = {}
    for rows in same.values():
        original = min(rows, key=lambda row: (masks[row] is None, len(photos[row].name), row))
        copies |= {
            row: f"it is a copy of {photos[original]}" for row in rows if photos[row] != photos[original]
        }
    return dict(sorted(copies.items())), unreadable


# A drone that took no photo for so long was landed: its gimbal and barometer begin anew.
_LANDED = timedelta(minutes=15)
_CLOCK = "%Y:%m:%d %H:%M:%S"


@dataclass(slots=True)
class Flight:
    """Photos taken with one camera, one after the other."""

    rows: list[int]  # of the photos, in the order of their names
    camera: str  # what took them
    started: datetime | None = None  # when the first was taken, by its clock; None where none says
    ended: datetime | None = None  # when the last was
    # Rows whose clock runs against the order of names; they are where their names put them
    odd_clocks: list[int] = field(default_factory=list)

    def take(self, other: Flight) -> None:
        """Adds a flight that goes on where this one, or in another folder beside it."""
        self.rows += other.rows
        self.odd_clocks += other.odd_clocks
        times = [time for time in (self.started, self.ended, other.started, other.ended) if time is not None]
        self.started, self.ended = min(times), max(times)


def split_flights(photos: Sequence[tuple[Path, PhotoMetadata]]) -> list[Flight]:
    """Returns the flights of some photos, by the first photo of each.

    Photos of a folder and a camera are one flight unless quarter of an hour passes between two whose names
    follow each other. A clock that runs against the order of names is not believed. Flights of one camera
    that go on in another folder, as memory cards have it after 999 photos, are one.
    """
    groups: dict[tuple[Path, tuple[object, ...]], list[int]] = {}
    for row, (path, stated) in enumerate(photos):
        camera = stated.make, stated.model, stated.width, stated.height
        lens = stated.focal_mm, stated.focal_35mm, stated.digital_zoom
        groups.setdefault((path.parent, (*camera, *lens)), []).append(row)
    by_camera: dict[tuple[object, ...], list[Flight]] = {}
    for (_, key), rows in groups.items():
        rows.sort(key=lambda row: natural_key(photos[row][0].name))
        by_camera.setdefault(key, []).extend(_split_folder(rows, [stated for _, stated in photos]))
    flights = [flight for camera_flights in by_camera.values() for flight in _joined(camera_flights)]
    return sorted(flights, key=lambda flight: min(flight.rows))


def _split_folder(rows: Sequence[int], stated: Sequence[PhotoMetadata]) -> list[Flight]:
    """Returns the flights of photos of one folder and camera, in the order of names."""
    times = [_taken_at(stated[row]) for row in rows]
    believed = _rising(times)
    first = stated[rows[0]]
    camera = " ".join(filter(None, [first.model or first.make, f"{first.width} x {first.height}"]))
    flights = [Flight([], camera)]
    for place, (row, time) in enumerate(zip(rows, times, strict=True)):
        flight = flights[-1]
        if time is not None and place in believed:
            if flight.ended is not None and time - flight.ended > _LANDED:
                flight = Flight([], camera)
                flights.append(flight)
            flight.started, flight.ended = flight.started or time, time
        elif time is not None:
            flight.odd_clocks.append(row)
        flight.rows.append(row)
    return flights


def _joined(flights: list[Flight]) -> list[Flight]:
    """Returns flights of one camera, those that go on in another folder as one."""
    joined: list[Flight] = []
    for flight in sorted(flights, key=lambda flight: flight.started or datetime.max):
        last = joined[-1] if joined else None
        if (
            last is not None
            and last.ended is not None
            and flight.started is not None
            # Two drones of one kind that are in the air at once are two flights.
            and timedelta() <= flight.started - last.ended <= _LANDED
        ):
            last.take(flight)
        else:
            joined.append(flight)
    return joined


def _rising(times: Sequence[datetime | None]) -> set[int]:
    """Returns the places of a longest subsequence of times that never falls; None is never in it."""
    ends: list[datetime] = []
    places: list[int] = []
    before: dict[int, int | None] = {}
    for place, time in enumerate(times):
        if time is None:
            continue
        length = bisect_right(ends, time)
        before[place] = places[length - 1] if length else None
        ends[length : length + 1] = [time]
        places[length : length + 1] = [place]
    subsequence: set[int] = set()
    last = places[-1] if places else None
    while last is not None:
        subsequence.add(last)
        last = before[last]
    return subsequence


def _taken_at(stated: PhotoMetadata) -> datetime | None:
    try:
        return datetime.strptime(stated.taken_at, _CLOCK)
    except ValueError:
        return None


def natural_key(name: str) -> list[tuple[int, str]]:
    """Returns a key that sorts IMG_2 before IMG_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


_ENDINGS = (".jpg", ".jpeg", ".png", ".tif", ".tiff")


def traced_photos(folder: Path) -> list[tuple[Path, Path]]:
    """Returns the photos of a folder and their masks, by place and name.

    Args:
        folder: Holds a folder per place with ``photos``, and ``masks`` (PNG, 255 = building, grey = not
            known) of their names; or a folder ``labelled`` of these.

    Raises:
        DatasetError: There are no photos, two of one name, or one has no mask.
    """
    root = folder / "labelled" if (folder / "labelled").is_dir() else folder
    photos = sorted(path for path in root.glob("*/photos/*") if path.suffix.lower() in _ENDINGS)
    if not photos:
        hint = "Put them in PLACE/photos, and their masks in PLACE/masks."
        if (root / "photos").is_dir():
            hint = f"It is one place: name the folder that holds it, {root.parent}."
        raise DatasetError(f"{folder} holds no photos.", hint)
    masks = Counter(map(traced_mask, photos))
    for photo in photos:
        if masks[traced_mask(photo)] > 1:
            raise DatasetError(f"{photo} and another photo share a name: their masks would be one.")
    pairs = [(photo, traced_mask(photo)) for photo in photos]
    for photo, mask in pairs:
        if not mask.is_file():
            raise DatasetError(f"{photo} has no mask.", f"Trace one as {mask}: 255 = building.")
    return pairs


def traced_mask(photo: Path) -> Path:
    """Returns the file of a photo's mask."""
    return photo.parent.parent / "masks" / f"{photo.stem}.png"
