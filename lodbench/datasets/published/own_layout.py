"""What loaders of datasets in layouts of their own share: pose lines, arrays, pictures, and open questions.

A loader is a spec, settings, and a function that makes entries. What a dataset's documentation leaves open,
such as the direction of its poses, is a setting; ``auto`` takes what the data itself decides, and says so.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.faults import READING_CONTRADICTED, READING_INFERRED
from lodbench.datasets.pose_text import LayoutGuard, content, lines_to_text, parse_camera
from lodbench.datasets.published.layout import PublishedSpec, Survey, advice, require_data, survey
from lodbench.datasets.query import Dataset, Entry, notes_of
from lodbench.errors import ConfigError, DatasetError, LodbenchError, nearest_names
from lodbench.findings import Findings
from lodbench.geometry import Camera, CameraSigmas, Pose
from lodbench.geometry.pose import rotation_from_quaternion
from lodbench.photos.camera import pinhole_of, undistorted
from lodbench.photos.pictures import encoded, read_picture
from lodbench.storage import digest_of, make_folder, new_folder, write_bytes
from lodbench.storage.paths import cache_root

Floats = NDArray[np.float64]

AUTO = "auto"
# Directions and camera axes that a rotation may be written in: whether it turns the camera's axes into the
# world's, and whether these are OpenGL's (y up, z back).
READINGS = {
    f"{direction}_{axes}": (direction == "c2w", axes == "opengl")
    for direction in ("c2w", "w2c")
    for axes in ("opencv", "opengl")
}
_FLIP = np.diag([1.0, -1.0, -1.0])
# Pictures are level to about 6 degrees in the median, and nearly all of them upright.
_LEVEL_SINE, _NEARLY_ALL = 0.1, 0.9
# No place on Earth is further from the origin of its reference system, metres.
_MOST_M = 1e8
# More than any sample of these datasets holds.
_MOST_BYTES = 1 << 30


@dataclass(frozen=True, slots=True)
class OwnLayoutParams:
    """Settings that all such datasets have."""

    name: str
    root: str | None = None
    city_model: str | None = None
    lod: str | None = None


class PoseRow(NamedTuple):
    """A line of a pose file: quaternion (w, x, y, z) and three coordinates, as written."""

    quat_wxyz: tuple[float, ...]
    place: tuple[float, ...]


def find_parts(spec: PublishedSpec, params: OwnLayoutParams) -> tuple[Survey, Path]:
    """Returns what is there of a dataset, and the folder that its parts are below.

    Raises:
        DatasetError: Something that is needed is missing; the hint is a screen of text.
    """
    inventory = survey(spec, params.root, params.city_model)
    require_data(inventory)
    return inventory, inventory.home or inventory.root


def as_dataset(
    inventory: Survey, entries: Sequence[Entry], truth: Mapping[str, Pose], findings: Findings, **more: Any
) -> Dataset:
    """Returns a dataset of entries and truth, with what its spec says; ``more`` are fields of ``Dataset``."""
    spec = inventory.spec
    splits = tuple(dict.fromkeys(entry.split for entry in entries))
    tests = {split.name for split in spec.splits if split.is_test}
    fields: dict[str, Any] = {
        "name": spec.id,
        "version": "",
        "root": inventory.root,
        "city_model": inventory.city_model,
        "lod": None,
        "splits": splits,
        "entries": tuple(entries),
        "truth": dict(truth),
        "notes": notes_of(findings),
        "default_splits": tuple(name for name in splits if name in tests),
        "city_hint": advice(inventory),
        "findings": tuple(findings.items),
        "protocol": spec.protocol,
    }
    return Dataset(**(fields | more))


def require_word(setting: str, word: str, words: Iterable[str]) -> None:
    """Refuses a word that a setting does not know.

    Raises:
        ConfigError: It is one.
    """
    if word not in (known := list(words)):
        raise ConfigError(f"{setting}={word} is unknown.", nearest_names(str(word), known))


def read_pose_rows(path: Path) -> dict[str, PoseRow]:
    """Returns lines ``name qw qx qy qz x y z`` by name, parted by white space or commas.

    Raises:
        DatasetError: The file cannot be read or is empty, or a line is something else, repeats a name, or
            holds a quaternion or coordinate that is none.
    """
    rows: dict[str, PoseRow] = {}
    for where, line in content(path):
        with LayoutGuard(where, "name qw qx qy qz x y z"):
            name, *words = [word for word in re.split(r"[,\s]+", line.strip()) if word]
            if len(words) != 7:
                raise ValueError(f"{len(words)} values after the name instead of 7")
            numbers = tuple(map(float, words))
            rotation_from_quaternion(numbers[:4])
            if not all(abs(value) <= _MOST_M for value in numbers[4:]):
                raise ValueError("a coordinate is no place on Earth")
            if name in rows:
                raise ValueError(f"the name {name} occurs twice")
            rows[name] = PoseRow(numbers[:4], numbers[4:])
    if not rows:
        raise DatasetError(f"{path} holds no poses.", "Expected: name qw qx qy qz x y z")
    return rows


def pose_read_as(row: PoseRow, reading: str, *, is_centre: bool = False) -> Pose:
    """Returns the pose that a line means in one of ``READINGS``.

    Args:
        row: The line.
        reading: Direction and axes of its rotation.
        is_centre: Whether its place is the camera's in either direction; else world to camera has a
            translation.
    """
    is_to_world, is_opengl = READINGS[reading]
    written = rotation_from_quaternion(row.quat_wxyz)
    rotation = written.T if is_to_world else written
    place = np.array(row.place)
    centre = place if is_to_world or is_centre else -rotation.T @ place
    return Pose.from_center(_FLIP @ rotation if is_opengl else rotation, centre)


def choose_reading(
    setting: str, wanted: str, readings: Mapping[str, Sequence[Pose]], findings: Findings
) -> str:
    """Returns the reading of poses that makes pictures level and upright, or the one that is requested.

    Args:
        setting: As typed: ``dataset.poses``.
        wanted: Name of a reading, or ``auto``.
        readings: The poses in each of the readings that are possible.
        findings: Receives which was chosen, or that the one requested does not fit.

    Raises:
        ConfigError: There is no such reading.
        DatasetError: ``auto``, and not exactly one fits.
    """
    require_word(setting, wanted, [AUTO, *readings])
    levels = {name: _level_of(poses) for name, poses in readings.items()}
    fitting = [name for name, (sine, share) in levels.items() if sine < _LEVEL_SINE and share > _NEARLY_ALL]
    words = ", ".join(
        f"{name} {np.degrees(np.arcsin(min(1.0, sine))):.0f} deg off level, {share:.0%} upright"
        for name, (sine, share) in levels.items()
    )
    if wanted != AUTO:
        if wanted not in fitting:
            findings.add(READING_CONTRADICTED, setting, words)
        return wanted
    if len(fitting) != 1:
        raise DatasetError(
            f"How poses are to be read is not documented, and the pictures do not decide: {words}.",
            f"Set {setting} to one of {', '.join(readings)}.",
        )
    findings.add(READING_INFERRED, setting, f"{fitting[0]}: {words}")
    return fitting[0]


def _level_of(poses: Sequence[Pose]) -> tuple[float, float]:
    """Returns the sine of the x axis's median tilt, and the share of pictures that are not upside down.

    One is upside down if the sum of its y axis and its view points up: so are pictures straight down, level,
    and tilted up by less than 45 degrees, if y and z are flipped.
    """
    axes = np.array([pose.rotation[:, 2] for pose in poses]).reshape(-1, 3)
    return float(np.median(np.abs(axes[:, 0]))), float((axes[:, 1] + axes[:, 2] < 0).mean())


def pose_lines(
    poses: Mapping[str, Pose | None],
    names: Mapping[str, str],
    reading: str = "w2c_opencv",
    offset_m: Sequence[float] = (0.0, 0.0, 0.0),
    head: str = "",
    *,
    is_centre: bool = False,
) -> str:
    """Returns poses as lines ``name qw qx qy qz x y z``: the inverse of ``pose_read_as``.

    Args:
        poses: By ``Entry.key``, None for no answer.
        names: As files have them, by ``Entry.key``.
        reading: One of ``READINGS``.
        offset_m: Added to the places, metres.
        head: First line, "" for none.
        is_centre: As for ``pose_read_as``.
    """
    is_to_world, is_opengl = READINGS[reading]
    lines = [head] if head else []
    for key, pose in poses.items():
        if pose is None:
            continue
        placed = pose.shifted(offset_m)
        converted = Pose(_FLIP @ placed.rotation, _FLIP @ placed.translation) if is_opengl else placed
        written = Pose(converted.rotation.T, converted.center) if is_to_world else converted
        place = converted.center if is_to_world or is_centre else converted.translation
        numbers = [*written.quat_wxyz, *map(float, place)]
        lines.append(" ".join([names.get(key, key.partition("/")[2]), *map(repr, numbers)]))
    return lines_to_text(lines)


def stated_camera(setting: str, words: str) -> tuple[Camera, CameraSigmas | None]:
    """Returns the camera of the words ``MODEL W H params...``.

    Raises:
        ConfigError: They are none.
    """
    try:
        return parse_camera(words.split())
    except (LodbenchError, ValueError) as error:
        reason = str(error).rstrip(".")
        raise ConfigError(
            f"{setting}={words!r}: {reason}.", "It reads: 'PINHOLE W H fx fy cx cy'."
        ) from error


class Array(NamedTuple):
    """What an array of a sample must be."""

    shape: tuple[int | None, ...]  # its sizes; None for any
    kinds: str = "fiu"  # its kinds of numbers, of NumPy: f, i, u; U for text
    is_finite: bool = True  # whether all of its numbers must be finite


def read_arrays(
    path: Path, wanted: Mapping[str, Array], optional: Iterable[str] = ()
) -> dict[str, NDArray[Any]]:
    """Returns arrays of an ``.npz``; nothing is unpickled.

    Args:
        path: The file.
        wanted: What they must be, by name.
        optional: Those that may lack.

    Raises:
        DatasetError: The file cannot be read or is too large, or an array is missing or something else.
    """
    by_name: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > _MOST_BYTES:
            raise DatasetError(f"{path} holds {size >> 20} MiB: that is no sample.", "Download it again.")
        with np.load(path, allow_pickle=False) as arrays:
            for name in wanted:
                if name in arrays.files:
                    by_name[name] = arrays[name]
    except DatasetError:
        raise
    except Exception as error:  # zipfile and NumPy raise many kinds on damaged files
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise DatasetError(
            f"{path} is no readable .npz: {reason.rstrip('.')}.", "Download it again."
        ) from error
    for name, rule in wanted.items():
        if name in by_name:
            _require_array(path, name, by_name[name], rule)
        elif name not in optional:
            raise DatasetError(f"{path} has no array {name}.", f"Expected: {', '.join(wanted)}.")
    return by_name


def _require_array(path: Path, name: str, array: NDArray[Any], rule: Array) -> None:
    sizes = zip(array.shape, rule.shape, strict=False)
    if array.ndim != len(rule.shape) or any(want is not None and size != want for size, want in sizes):
        wanted = " x ".join("N" if size is None else str(size) for size in rule.shape) or "one value"
        raise DatasetError(f"{path}: {name} is {array.shape}, not {wanted}.")
    if array.dtype.kind not in rule.kinds:
        raise DatasetError(f"{path}: {name} is of type {array.dtype}.")
    if rule.is_finite and array.dtype.kind == "f" and not np.isfinite(array).all():
        raise DatasetError(f"{path}: {name} has values that are not finite.")


def kept_folder(name: str, sources: Iterable[Path], made_with: Any, write: Callable[[Path], None]) -> Path:
    """Returns a folder of the cache that is filled from files first, and anew when these change.

    Args:
        name: Of the dataset.
        sources: The files.
        made_with: What else it follows from, as JSON values.
        write: Fills it.
    """
    stamps = [[str(path), path.stat().st_size, path.stat().st_mtime_ns] for path in sorted(sources)]
    folder = cache_root() / "extracted" / f"{name}-{digest_of([stamps, made_with])[:24]}"
    if not folder.is_dir():
        make_folder(folder.parent)
        with new_folder(folder, survives_power_cut=False) as filling:
            write(filling)
    return folder


def without_lens(name: str, entries: Sequence[Entry]) -> list[Entry]:
    """Returns entries as pinholes have them: photos that a lens distorts are undistorted into the cache.

    Args:
        name: Of the dataset.
        entries: Its queries.

    Raises:
        DatasetError: A photo cannot be decoded or is not of its camera's size, or the lens folds the picture.
    """
    bent = {e.key: (e.image, e.camera) for e in entries if e.image and e.camera and e.camera.distortion}
    if not bent:
        return list(entries)

    def write(folder: Path) -> None:
        for key, (photo, camera) in bent.items():
            picture = read_picture(photo)
            if picture is None or picture.shape[1::-1] != (camera.width, camera.height):
                raise DatasetError(f"{photo} is no picture of {camera.width} x {camera.height}.")
            target = folder / f"{key}.png"
            make_folder(target.parent)
            write_bytes(target, encoded(undistorted(picture, camera, pinhole_of(camera)), ".png"), False)

    cameras = [[key, repr(camera)] for key, (_, camera) in sorted(bent.items())]
    folder = kept_folder(name, (photo for photo, _ in bent.values()), cameras, write)
    return [
        replace(
            entry,
            image=folder / f"{entry.key}.png",
            camera=pinhole_of(bent[entry.key][1]),
            stored=entry.image,
        )
        if entry.key in bent
        else entry
        for entry in entries
    ]
