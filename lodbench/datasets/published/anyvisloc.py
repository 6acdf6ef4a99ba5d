"""``dataset=anyvisloc``: AnyVisLoc, drone photos over a 2.5D map; see data_cards/anyvisloc.md.

Its coordinates are x east, y south, z up: a left-handed frame. Here y is negated: east, north, up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.faults import READING_CONTRADICTED, READING_INFERRED
from lodbench.datasets.pose_text import read_json
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.published import own_layout
from lodbench.datasets.published.layout import Host, Part, PublishedSpec, SplitSpec, advice
from lodbench.datasets.published.raster_maps import Raster, RasterMap, kept_maps, kept_pictures, pinhole
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError, LodbenchError, require_within
from lodbench.findings import Findings
from lodbench.geometry import Camera, EulerAngles, Pose, wrap_deg
from lodbench.photos.pictures import read_picture
from lodbench.storage import random_stream

_REPOSITORY = "https://github.com/UAV-AVL/Benchmark"
SPEC = PublishedSpec(
    id="anyvisloc",
    title="AnyVisLoc",
    lod="surface model with orthophoto",
    folder="AnyVisLoc",
    splits=(SplitSpec("scene", ("Scene_01",), ()),),
    hosts=(
        Host(
            "scenes (.npz, maps)",
            _REPOSITORY,
            "OneDrive and Baidu, linked there; not to be passed on",
        ),
    ),
    parts=(
        Part("Scene_*/L??_reference.json", "where the maps lie", media="application/json"),
        Part("Scene_*/L??_????.npz", "photos with their poses", media="application/octet-stream"),
        Part("Scene_*/*_map.png", "orthophotos", media="image/png"),
        Part("Scene_*/*_dsm.npy", "surface models", media="application/octet-stream"),
    ),
    protocol="anyvisloc",
    year="2026",
)
_ARRAYS = {
    "K": own_layout.Array((3, 3)),
    "dist": own_layout.Array((5,)),
    "pose_c2w": own_layout.Array((4, 4)),
    "xyz": own_layout.Array((3,)),
    "euler_deg": own_layout.Array((3,)),
    "image": own_layout.Array((None, None, None), "u"),
    "image_relpath": own_layout.Array((), "U"),
}
_OPTIONAL = ("image", "image_relpath")
_TRACKS = ("yp", "p", "none")
_MAPS = ("aerial", "satellite")
_SOUTH_TO_NORTH = np.diag([1.0, -1.0, 1.0])
# Poses, places and angles that were written from one pose agree to this.
_SAME_M, _SAME_DEG, _NEARLY_ALL = 0.1, 2.0, 0.9
# A heading is known where the picture's up is this level.
_LEVEL = 0.1


@dataclass(frozen=True, slots=True)
class AnyVisLocParams(own_layout.OwnLayoutParams):
    """Settings of AnyVisLoc, described in ``conf/dataset/anyvisloc.yaml``."""

    name: str = SPEC.id
    scene: str | None = None
    map: str = "aerial"
    map_stride: int = 4
    poses: str = own_layout.AUTO
    prior_track: str = "yp"
    prior_range_m: float = 50.0

    def __post_init__(self) -> None:
        require_within("dataset.prior_range_m", self.prior_range_m, 0)
        require_within("dataset.map_stride", self.map_stride, 1)


class _Sample(NamedTuple):
    path: Path
    arrays: dict[str, NDArray[Any]]
    photo: Path | None

    @property
    def centre(self) -> NDArray[np.float64]:
        """Returns the camera's place, east, north, up."""
        return np.asarray(_SOUTH_TO_NORTH @ self.arrays["xyz"].astype(np.float64))

    @property
    def angles(self) -> EulerAngles:
        """Returns pitch from straight down, roll, and yaw counter-clockwise from north."""
        roll, pitch, yaw = (float(value) for value in self.arrays["euler_deg"])
        return EulerAngles(pitch, roll, wrap_deg(-yaw))


def open_anyvisloc(params: AnyVisLocParams) -> Dataset:
    """Returns a scene of AnyVisLoc.

    Raises:
        DatasetError: Parts are missing or malformed, or several scenes are there and none is named.
        ConfigError: A setting is unknown.
    """
    for setting, word, words in (
        ("poses", params.poses, (own_layout.AUTO, "matrix", "euler")),
        ("prior_track", params.prior_track, _TRACKS),
        ("map", params.map, _MAPS),
    ):
        own_layout.require_word(f"dataset.{setting}", word, words)
    inventory, home = own_layout.find_parts(SPEC, params)
    scene = _scene(home, params.scene)
    findings = Findings()
    files = sorted(scene.glob("L??_????.npz"))
    if not files:
        raise DatasetError(f"{scene} holds no L??_????.npz.", advice(inventory))
    samples = [_read(path) for path in files]
    poses = _poses(params.poses, samples, findings)
    pictures = kept_pictures(SPEC.id, files, scene.name, lambda: _pictures(samples))
    city, textured, note = _map(scene, _reference(scene), params.map, params.map_stride)
    entries, truth = [], {}
    for sample, pose in zip(samples, poses, strict=True):
        image = sample.photo or pictures / f"{sample.path.stem}.png"
        name = f"{sample.path.stem}{image.suffix}"
        prior = _prior(params, name, pose)
        hypotheses = () if prior is None else (prior,)
        entry = Entry(name, scene.name, _camera(sample, image), prior, image, None, hypotheses)
        entries.append(entry)
        truth[entry.key] = pose
    dataset = own_layout.as_dataset(
        inventory,
        own_layout.without_lens(SPEC.id, entries),
        truth,
        findings,
        city_model=inventory.city_model or city,
        textured_map=textured,
        lod=params.lod,
        default_splits=(),
    )
    return replace(dataset, notes=(*dataset.notes, *filter(None, [note])))


def _scene(home: Path, name: str | None) -> Path:
    names = sorted(path.parent.name for path in home.glob("Scene_*/L??_reference.json"))
    if name is None and len(names) == 1:
        return home / names[0]
    if name not in names:
        several = f"{home} holds several scenes, each in a frame of its own"
        what = f"There is no {name}" if name else several
        raise DatasetError(f"{what}: {', '.join(names)}.", f"Name one: `dataset.scene={names[0]}`")
    return home / name


def _read(path: Path) -> _Sample:
    arrays = own_layout.read_arrays(path, _ARRAYS, _OPTIONAL)
    if arrays.get("image", np.empty(0)).size:
        if arrays["image"].shape[2] not in (3, 4):
            raise DatasetError(f"{path}: image is {arrays['image'].shape}, not in colour.")
        return _Sample(path, arrays, None)
    named = str(arrays.get("image_relpath", ""))
    photo = _inside(path.parent, named)
    if photo is None:
        raise DatasetError(f"{path} has no image, and its image_relpath {named[:80]!r} is no file beside it.")
    return _Sample(path, arrays, photo)


def _camera(sample: _Sample, image: Path) -> Camera:
    """Returns the camera of a sample, OpenCV's pixels: their centres are at whole numbers."""
    picture = sample.arrays.get("image", np.empty(0))
    size = picture.shape[1::-1] if picture.size else None
    if size is None:
        read = read_picture(image)
        if read is None:
            raise DatasetError(f"{image} cannot be read as a picture.")
        size = read.shape[1::-1]
    lens = (*sample.arrays["dist"].astype(float).tolist(), 0.0, 0.0, 0.0)
    return pinhole(f"{sample.path}: K", sample.arrays["K"], size, 0.5, lens)


def _poses(reading: str, samples: Sequence[_Sample], findings: Findings) -> list[Pose]:
    """Returns true poses, from the matrices where these agree with place and angles."""
    matrices = [_of_matrix(sample) for sample in samples]
    agree = [
        pose is not None and _agrees(sample, pose) for sample, pose in zip(samples, matrices, strict=True)
    ]
    words = f"matrix, place and angles agree in {sum(agree)} of {len(samples)}"
    by_angles = [Pose.from_euler(sample.angles, sample.centre) for sample in samples]
    is_fitting = sum(agree) >= _NEARLY_ALL * len(samples)
    if reading == "euler":
        return by_angles
    if is_fitting:
        findings.add(READING_INFERRED, "dataset.poses", words)
    elif reading == own_layout.AUTO:
        raise DatasetError(
            f"The frame of pose_c2w is not documented, and the data does not decide: {words}.",
            "Set `dataset.poses=euler` (place and angles) or matrix.",
        )
    else:
        findings.add(READING_CONTRADICTED, "dataset.poses", words)
    return [pose or other for pose, other in zip(matrices, by_angles, strict=True)]


def _of_matrix(sample: _Sample) -> Pose | None:
    """Returns the pose of ``pose_c2w``; None if it holds no rotation.

    A determinant of -1 is of a camera in the left-handed frame, +1 of one in east, north, up.
    """
    rotation = sample.arrays["pose_c2w"].astype(np.float64)[:3, :3]
    turned = _SOUTH_TO_NORTH @ rotation if np.linalg.det(rotation) < 0 else rotation
    try:
        return Pose.from_center(turned.T, sample.centre)
    except LodbenchError:
        return None


def _agrees(sample: _Sample, pose: Pose) -> bool:
    """Tells whether a matrix's place, heading and angle off straight down are those stated beside it."""
    place = sample.arrays["pose_c2w"].astype(np.float64)[:3, 3]
    stated = sample.arrays["xyz"].astype(np.float64)
    is_there = min(np.abs(place - stated).max(), np.abs(place - sample.centre).max()) < _SAME_M
    up, view = -pose.rotation[1], pose.rotation[2]
    heading = math.degrees(math.atan2(up[0], up[1]))
    is_level = math.hypot(up[0], up[1]) > _LEVEL
    turn_deg = abs(wrap_deg(heading + sample.angles.yaw_deg)) if is_level else 0.0
    off_nadir = math.degrees(math.acos(max(-1.0, min(1.0, -view[2]))))
    tilt_deg = abs(off_nadir - abs(sample.angles.pitch_deg))
    return is_there and turn_deg < _SAME_DEG and tilt_deg < _SAME_DEG


def _prior(params: AnyVisLocParams, name: str, truth: Pose) -> Pose | None:
    """Returns a prior of a track: pitch, height and, with ``yp``, yaw are the true ones, roll is 0.

    East and north are drawn within ``prior_range_m`` of the truth, with ``p`` yaw from the whole circle:
    one draw for each photo.
    """
    if params.prior_track == "none":
        return None
    pitch, _, yaw = truth.euler
    level = Pose.from_euler(EulerAngles(pitch, 0.0, yaw), truth.center)
    width = params.prior_range_m
    turn = 180.0 if params.prior_track == "p" else 0.0
    drawn = UniformPrior(width, width, 0.0, turn, 0.0, 0.0)
    return drawn.draw(level, random_stream(0, SPEC.id, params.scene or "", name, "prior"))


def _pictures(samples: Sequence[_Sample]) -> Iterator[tuple[str, NDArray[Any]]]:
    return ((each.path.stem, each.arrays["image"]) for each in samples if each.photo is None)


def _reference(scene: Path) -> tuple[Path, dict[str, Any]]:
    file = sorted(scene.glob("L??_reference.json"))[0]
    modes = read_json(file).get("modes")
    if not isinstance(modes, dict):
        raise DatasetError(f"{file} has no modes.", "Expected: modes.aerial.map_path and so on.")
    return file, modes


def _map(
    scene: Path, reference: tuple[Path, dict[str, Any]], name: str, stride: int
) -> tuple[Path, Path, str]:
    """Returns city, textured map and note of a map, see ``kept_maps``."""
    file, modes = reference
    stated = modes.get(name)
    if not isinstance(stated, dict):
        raise DatasetError(f"{file} has no map {name}.", f"It has: {', '.join(map(str, modes))}.")
    picture_file, dsm_file = (_file(file, stated, key) for key in ("map_path", "dsm_path"))
    picture_step, dsm_step = (_pair(file, stated, key) for key in ("map_resolution", "dsm_resolution"))
    origin = _pair(file, stated, "map_origin_local", (0.0, 0.0))
    # The surface model's origin is relative to the orthophoto's.
    dsm_origin = origin + _pair(file, stated, "dsm_origin_local", (0.0, 0.0))
    if min(*picture_step, *dsm_step) <= 0:
        raise DatasetError(f"{file}: a resolution of {name} is not above 0.")

    def maps() -> Iterator[RasterMap]:
        picture = read_picture(picture_file)
        if picture is None:
            raise DatasetError(f"{picture_file} cannot be read as a picture.")
        surface = Raster(_heights(dsm_file), dsm_origin[0], -dsm_origin[1], tuple(dsm_step.tolist()))
        yield RasterMap(name, surface, Raster(picture, origin[0], -origin[1], tuple(picture_step.tolist())))

    return kept_maps(SPEC.id, [file, picture_file, dsm_file], [scene.name, name], stride, maps)


def _file(reference: Path, stated: dict[str, Any], key: str) -> Path:
    named = stated.get(key)
    path = _inside(reference.parent, named)
    if path is None:
        raise DatasetError(f"{reference}: {key} {str(named)[:80]!r} is no file beside it.")
    return path


def _inside(folder: Path, named: object) -> Path | None:
    """Returns the file of a name, which is a stranger's: never one outside of a folder."""
    from lodbench.datasets.own import find_inside

    return find_inside(folder, named) if isinstance(named, str) and named else None


def _pair(
    reference: Path, stated: dict[str, Any], key: str, default: tuple[float, float] | None = None
) -> NDArray[np.float64]:
    try:
        pair = np.array(stated.get(key, default), dtype=np.float64)
    except (TypeError, ValueError):
        pair = np.empty(0)
    if pair.shape != (2,) or not np.isfinite(pair).all():
        raise DatasetError(f"{reference}: {key} is no pair of numbers.", "Expected: [x, y], metres.")
    return pair


def _heights(path: Path) -> NDArray[Any]:
    try:
        heights = np.load(path, mmap_mode="r", allow_pickle=False)
        plane = heights[..., 0] if heights.ndim == 3 else heights
        if plane.ndim != 2 or plane.dtype.kind not in "fiu" or min(plane.shape) < 2:
            raise ValueError(f"it is {heights.shape} of {heights.dtype}")
    except (OSError, ValueError, EOFError) as error:
        reason = str(error).splitlines()[0].rstrip(".")[:120]
        raise DatasetError(f"{path} is no surface model: {reason}.", "Download it again.") from error
    return np.asarray(plane)
