"""Drone photos in layouts of their own: ``dataset=uavd4l | tokyo_lodv3 | semcitylocked``.

UAVD4L has photos by two cameras over a textured map, Tokyo-LoDv3 (of LoD-Loc v3) is in LoD-Loc v2's tree,
SemCityLockeD has RTK photos over LoD1 to 3; see the cards in data_cards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from lodbench.citymodel.options import ReadOptions
from lodbench.datasets.faults import NO_CAMERA, NO_IMAGE, NO_PRIOR, READING_INFERRED
from lodbench.datasets.pose_text import read_cameras, read_hypotheses, read_poses
from lodbench.datasets.published import own_layout
from lodbench.datasets.published.layout import Host, Part, PublishedSpec, SplitSpec
from lodbench.datasets.published.lodloc import PublishedParams, open_published
from lodbench.datasets.query import Dataset, Entry, notes_of
from lodbench.errors import ConfigError, DatasetError, require_within
from lodbench.findings import Findings
from lodbench.geometry import Pose
from lodbench.photos.camera import camera_from_photo
from lodbench.photos.files import PHOTO_SUFFIXES
from lodbench.photos.metadata import read_photo_metadata

_SPLITS = {"wide": "w", "zoom": "z"}
_ISSUES = "https://github.com/RingoWRW/UAVD4L/issues"
UAVD4L = PublishedSpec(
    id="uavd4l",
    title="UAVD4L",
    lod="textured mesh",
    folder="UAVD4L",
    splits=(
        SplitSpec("wide", ("Query/images/W",), ()),
        SplitSpec("zoom", ("Query/images/Z",), (), is_test=False),
    ),
    hosts=(
        Host("photos, poses, intrinsics", "https://github.com/RingoWRW/UAVD4L", "by the form linked there"),
        Host("textured OBJ tiles, surface model", _ISSUES, "links in numbers 12 to 14; some have expired"),
    ),
    parts=(
        Part("Query/poses/gt_pose.txt", "true poses"),
        Part("Query/poses/w_pose.txt", "priors of the wide camera", "wide", False),
        Part("Query/poses/z_pose.txt", "priors of the zoom camera", "zoom", False),
        Part("Query/intrinsics/w_intrinsic.txt", "intrinsics of the wide camera", "wide"),
        Part("Query/intrinsics/z_intrinsic.txt", "intrinsics of the zoom camera", "zoom", False),
        Part("Query/images/W/*", "photos of the wide camera", "wide", media="image/jpeg"),
        Part("Query/images/Z/*", "photos of the zoom camera", "zoom", False, "image/jpeg"),
        Part("Model/*", "textured OBJ tiles", is_needed=False, media="model/obj"),
    ),
    photo_crs="EPSG:4547",
    protocol="uavd4l",
)


@dataclass(frozen=True, slots=True)
class Uavd4lParams(own_layout.OwnLayoutParams):
    """Settings of UAVD4L, described in ``conf/dataset/uavd4l.yaml``."""

    name: str = UAVD4L.id
    textured_map: str | None = None
    map_origin: list[float] | None = None

    def __post_init__(self) -> None:
        require_within("dataset.map_origin", self.map_origin, -math.inf)
        if self.map_origin is not None and len(self.map_origin) != 3:
            raise ConfigError("dataset.map_origin takes three numbers: easting, northing, height.")


def open_uavd4l(params: Uavd4lParams) -> Dataset:
    """Returns UAVD4L, poses less ``map_origin``; its tiles are the textured map, and by default the city.

    Raises:
        DatasetError: Parts are missing or malformed, or the textured map does not exist.
    """
    inventory, home = own_layout.find_parts(UAVD4L, params)
    findings, query = Findings(), home / "Query"
    textured = home / "Model" if params.textured_map is None else Path(params.textured_map).expanduser()
    if not textured.exists() and params.textured_map is not None:
        raise DatasetError(f"The textured map {textured} does not exist.", "Set `dataset.textured_map=FILE`.")
    shift = [-value for value in params.map_origin or (0.0, 0.0, 0.0)]
    truth = {name: pose.shifted(shift) for name, pose in read_poses(query / "poses" / "gt_pose.txt").items()}
    entries = []
    for split, letter in _SPLITS.items():
        file = query / "intrinsics" / f"{letter}_intrinsic.txt"
        cameras = read_cameras(file) if file.is_file() else {}
        file = query / "poses" / f"{letter}_pose.txt"
        priors = read_hypotheses(file) if file.is_file() else {}
        images = {path.name: path for path in sorted((query / "images" / letter.upper()).glob("*"))}
        for name in (name for name in truth if name in images or name in cameras):
            hypotheses = tuple(pose.shifted(shift) for pose in priors.get(name, ()))
            prior = hypotheses[0] if hypotheses else None
            entry = Entry(name, split, cameras.get(name), prior, images.get(name), None, hypotheses)
            entries.append(entry)
            lacks = {NO_CAMERA: entry.camera, NO_PRIOR: entry.prior, NO_IMAGE: entry.image}
            for code, part in lacks.items():
                if part is None:
                    findings.add(code, entry.key)
    if not entries:
        raise DatasetError(f"No true pose of {query} is of a photo or a camera there.", "Names must agree.")
    city = inventory.city_model or (textured if textured.exists() else None)
    return replace(
        own_layout.as_dataset(
            inventory,
            own_layout.without_lens(UAVD4L.id, entries),
            {entry.key: truth[entry.name] for entry in entries},
            findings,
            lod=params.lod,
            photo_crs=UAVD4L.photo_crs,
            photo_origin=None if params.map_origin is None else tuple(params.map_origin),
            submission=partial(own_layout.pose_lines, names={}, offset_m=[-value for value in shift]),
        ),
        city_model=city,
        textured_map=textured if textured.exists() else None,
    )


_FLIP = np.diag([1.0, -1.0, -1.0])
_RELEASES = "https://github.com/pppppsb/LoD-Locv3/releases"
TOKYO_LODV3 = PublishedSpec(
    id="tokyo_lodv3",
    title="Tokyo-LoDv3",
    lod="1",
    folder="UAVD4L-LoD",
    splits=(SplitSpec("japan_07", ("UAVD4L-LoD/Japan_07", "Japan_07"), ("Japan_07_test.json",)),),
    hosts=(
        Host("queries, poses, priors", _RELEASES, "data.zip; all_colmaps beside UAVD4L-LoD in it"),
        Host(
            "city model",
            _RELEASES,
            "model.zip: a .blend; export it from Blender as OBJ, Z up, then city=FILE",
        ),
    ),
    city_files=("Japan_07.obj",),
    unreadable_city_files=("Japan/Japan_07/Tokeyo_Dingmu_viewpoints_topology_clustered.blend",),
    protocol="lodlocv3",
    year="2026",
)


@dataclass(frozen=True, slots=True)
class TokyoParams(PublishedParams):
    """Settings of Tokyo-LoDv3, described in ``conf/dataset/tokyo_lodv3.yaml``."""

    axes: str = own_layout.AUTO


def open_tokyo(params: TokyoParams) -> Dataset:
    """Returns Tokyo-LoDv3; world to camera is documented, the camera's axes are not.

    Raises:
        DatasetError: Parts are missing or malformed, or the pictures do not decide the camera's axes.
        ConfigError: A setting is unknown.
    """
    dataset, findings = open_published(TOKYO_LODV3, params), Findings()
    truth = list(dataset.truth.values())
    readings = {"opencv": truth, "opengl": [_flipped(pose) for pose in truth]}
    axes = own_layout.choose_reading("dataset.axes", params.axes, readings, findings)
    if axes == "opengl":
        entries = tuple(
            replace(
                entry,
                prior=None if entry.prior is None else _flipped(entry.prior),
                hypotheses=tuple(map(_flipped, entry.hypotheses)),
            )
            for entry in dataset.entries
        )
        dataset = replace(
            dataset, entries=entries, truth={key: _flipped(pose) for key, pose in dataset.truth.items()}
        )
    return replace(
        dataset,
        notes=(*dataset.notes, *notes_of(findings)),
        findings=(*dataset.findings, *findings.items),
        submission=partial(own_layout.pose_lines, names={}, reading=f"w2c_{axes}"),
    )


def _flipped(pose: Pose) -> Pose:
    """Returns the pose of a camera whose y and z axes point the other way."""
    return Pose(_FLIP @ pose.rotation, _FLIP @ pose.translation)


_RECORD = "https://huggingface.co/datasets/DevinEaston/SemCityLockeD"
SEMCITYLOCKED = PublishedSpec(
    id="semcitylocked",
    title="SemCityLockeD",
    lod="1-3",
    folder="SemCityLockeD",
    splits=(SplitSpec("flights", ("original_images",), ()),),
    hosts=(Host("photos, LoD1 to LoD3 models", _RECORD, "Hugging Face; CC BY-NC 4.0 by its users' account"),),
    city_files=("LoD_model/*lod2.obj", "LoD_model/*lod1.obj", "LoD_model/*lod3.obj"),
    parts=(
        Part("original_images/*", "photos with DJI's metadata", "flights", media="image/jpeg"),
        Part("LoD_model/*.obj", "city models", is_needed=False, media="model/obj"),
        Part(
            "LoD_model/semantic_obj/*.obj",
            "their roofs, walls and ground",
            is_needed=False,
            media="model/obj",
        ),
    ),
    protocol="semcityloc",
    year="2026",
)
_UP_AXES = {"z": 2, "y": 1}
# A city is so many times as wide as it is high.
_FLAT = 2.0


@dataclass(frozen=True, slots=True)
class SemCityParams(own_layout.OwnLayoutParams):
    """Settings of SemCityLockeD, described in ``conf/dataset/semcitylocked.yaml``."""

    name: str = SEMCITYLOCKED.id
    level: str = "2"
    up_axis: str = own_layout.AUTO
    poses: str | None = None
    poses_format: str = own_layout.AUTO
    crs: str | None = None
    origin: list[float] | None = None

    def __post_init__(self) -> None:
        require_within("dataset.origin", self.origin, -math.inf)
        if self.origin is not None and len(self.origin) != 3:
            raise ConfigError("dataset.origin takes three numbers: easting, northing, height.")


def open_semcitylocked(params: SemCityParams) -> Dataset:
    """Returns SemCityLockeD: photos over a model in a frame of its own, and true poses if a file is named.

    Raises:
        DatasetError: Parts are missing or malformed, or the model's vertical axis is not clear.
        ConfigError: A setting is unknown.
    """
    own_layout.require_word("dataset.level", params.level, ("1", "2", "3"))
    own_layout.require_word("dataset.up_axis", params.up_axis, (own_layout.AUTO, *_UP_AXES))
    inventory, home = own_layout.find_parts(SEMCITYLOCKED, params)
    findings = Findings()
    city = inventory.city_model
    if params.city_model is None and (home / "LoD_model").is_dir():
        city = next(iter(sorted((home / "LoD_model").glob(f"*lod{params.level}.obj"))), None)
    known = _true_poses(params)
    folder = home / "original_images"
    entries = []
    for photo in sorted(path for path in folder.glob("*") if path.suffix.lower() in PHOTO_SUFFIXES):
        entry = Entry(photo.name, "flights", None, None, photo, None)
        try:
            by = camera_from_photo(read_photo_metadata(photo))
        except DatasetError as error:
            findings.add(NO_CAMERA, entry.key, error.message.rstrip("."))
        else:
            entry = replace(
                entry, camera=by.camera, lens_percent=by.lens_percent, camera_sigmas=by.camera_sigmas
            )
        entries.append(entry)
    if not entries:
        raise DatasetError(f"{folder} holds no photos.", "They are JPEG, as the drone stored them.")
    options = ReadOptions() if city is None else ReadOptions(up_axis=_up_axis(city, params, findings))
    dataset = own_layout.as_dataset(
        inventory,
        own_layout.without_lens(SEMCITYLOCKED.id, entries),
        {entry.key: known[Path(entry.name).stem] for entry in entries if Path(entry.name).stem in known},
        findings,
        city_model=city,
        city_options=options,
        lod=params.lod,
        photo_crs=params.crs,
        photo_origin=None if params.origin is None else tuple(params.origin),
    )
    note = "there are no priors; prior=sensor takes the photos' own, with dataset.crs and dataset.origin"
    return replace(dataset, notes=(*dataset.notes, note))


def _true_poses(params: SemCityParams) -> dict[str, Pose]:
    """Returns the poses of a file by the stems of their photos, less ``origin``."""
    from lodbench.datasets.pose_files import brought, read_pose_file

    if params.poses is None:
        return {}
    shift = [-value for value in params.origin or (0.0, 0.0, 0.0)]
    _, poses = read_pose_file(Path(params.poses).expanduser(), params.poses_format)
    placed, _ = brought(poses, params.crs)
    return {Path(pose.name).stem: pose.pose.shifted(shift) for pose in placed}


def _up_axis(city: Path, params: SemCityParams, findings: Findings) -> Literal["y", "z"]:
    """Returns the axis along which a city is least extended; what the files say of it is not documented."""
    from lodbench.citymodel.cache import open_cached_scene

    given = params.up_axis
    if given == own_layout.AUTO:
        low, high = open_cached_scene(city).extent_m
        extents_m = {name: float(high[axis] - low[axis]) for name, axis in _UP_AXES.items()}
        words = " and ".join(f"{extent_m:.0f} m along {name}" for name, extent_m in extents_m.items())
        given = min(extents_m, key=lambda name: extents_m[name])
        if max(extents_m.values()) < _FLAT * extents_m[given]:
            raise DatasetError(
                f"Which axis of {city.name} points up is not documented, and {words} do not decide.",
                "Set `dataset.up_axis=z` or y.",
            )
        findings.add(READING_INFERRED, "dataset.up_axis", f"{given}: the city is {words}")
    return "y" if given == "y" else "z"
