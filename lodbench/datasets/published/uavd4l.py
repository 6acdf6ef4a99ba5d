"""``dataset=uavd4l``: UAVD4L, photos by two cameras over a textured map; see data_cards/uavd4l.md."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from lodbench.datasets.codes import NO_CAMERA, NO_IMAGE, NO_PRIOR
from lodbench.datasets.pose_text import read_cameras, read_hypotheses, read_poses
from lodbench.datasets.published.own_layout import (
    OwnLayoutParams,
    as_dataset,
    find_parts,
    pose_lines,
    without_lens,
)
from lodbench.datasets.published.spec import Host, Part, PublishedSpec, SplitSpec
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError, DatasetError, require_within
from lodbench.findings import Findings

_SPLITS = {"wide": "w", "zoom": "z"}
_ISSUES = "https://github.com/RingoWRW/UAVD4L/issues"
SPEC = PublishedSpec(
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
class Uavd4lParams(OwnLayoutParams):
    """Settings of UAVD4L, described in ``conf/dataset/uavd4l.yaml``."""

    name: str = SPEC.id
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
    found, home = find_parts(SPEC, params)
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
    city = found.city_model or (textured if textured.exists() else None)
    return replace(
        as_dataset(
            found,
            without_lens(SPEC.id, entries),
            {entry.key: truth[entry.name] for entry in entries},
            findings,
            lod=params.lod,
            photo_crs=SPEC.photo_crs,
            photo_origin=None if params.map_origin is None else tuple(params.map_origin),
            submission=partial(pose_lines, names={}, offset_m=[-value for value in shift]),
        ),
        city_model=city,
        textured_map=textured if textured.exists() else None,
    )
