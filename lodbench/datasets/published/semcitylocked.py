"""``dataset=semcitylocked``: SemCityLockeD, RTK photos over LoD1 to 3; see data_cards/semcitylocked.md."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from lodbench.citymodel.options import ReadOptions
from lodbench.datasets.codes import NO_CAMERA, READING_INFERRED
from lodbench.datasets.published.own_layout import (
    AUTO,
    OwnLayoutParams,
    as_dataset,
    find_parts,
    require_word,
    without_lens,
)
from lodbench.datasets.published.spec import Host, Part, PublishedSpec, SplitSpec
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError, DatasetError, require_within
from lodbench.findings import Findings
from lodbench.geometry import Pose
from lodbench.photos.camera import camera_from_photo
from lodbench.photos.files import PHOTO_SUFFIXES
from lodbench.photos.metadata import read_photo_metadata

_RECORD = "https://huggingface.co/datasets/DevinEaston/SemCityLockeD"
SPEC = PublishedSpec(
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
class SemCityParams(OwnLayoutParams):
    """Settings of SemCityLockeD, described in ``conf/dataset/semcitylocked.yaml``."""

    name: str = SPEC.id
    level: str = "2"
    up_axis: str = AUTO
    poses: str | None = None
    poses_format: str = AUTO
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
    require_word("dataset.level", params.level, ("1", "2", "3"))
    require_word("dataset.up_axis", params.up_axis, (AUTO, *_UP_AXES))
    found, home = find_parts(SPEC, params)
    findings = Findings()
    city = found.city_model
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
    dataset = as_dataset(
        found,
        without_lens(SPEC.id, entries),
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
    _, found = read_pose_file(Path(params.poses).expanduser(), params.poses_format)
    placed, _ = brought(found, params.crs)
    return {Path(pose.name).stem: pose.pose.shifted(shift) for pose in placed}


def _up_axis(city: Path, params: SemCityParams, findings: Findings) -> Literal["y", "z"]:
    """Returns the axis along which a city is least extended; what the files say of it is not documented.

    Raises:
        DatasetError: It is not clearly less extended along either.
    """
    from lodbench.citymodel.cache import open_cached_scene

    given = params.up_axis
    if given == AUTO:
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
