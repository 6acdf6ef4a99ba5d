"""``dataset=egeniouss``: egenioussBench, phone photos at street level; see data_cards/egeniouss.md."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from lodbench.datasets.faults import NO_IMAGE, NO_PRIOR
from lodbench.datasets.pose_text import content, parse_camera
from lodbench.datasets.published.layout import Host, Part, PublishedSpec, SplitSpec
from lodbench.datasets.published.own_layout import (
    AUTO,
    READINGS,
    OwnLayoutParams,
    PoseRow,
    as_dataset,
    choose_reading,
    find_parts,
    pose_lines,
    pose_read_as,
    read_pose_rows,
    require_word,
    stated_camera,
    without_lens,
)
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError, LodbenchError, require_within
from lodbench.findings import Findings
from lodbench.geometry import Camera, CameraSigmas, Pose
from lodbench.photos.files import PHOTO_SUFFIXES

_RECORD = "https://zenodo.org/records/17644019"
SPEC = PublishedSpec(
    id="egeniouss",
    title="egenioussBench",
    lod="2",
    folder="egenioussBench",
    splits=(
        SplitSpec("val", ("query_images/val",), (), num_queries=412),
        SplitSpec("test", ("query_images/test",), (), num_queries=42),
    ),
    hosts=(
        Host("photos, poses, LoD2 model, mesh", _RECORD, "Zenodo; its licence and size could not be read"),
        Host("how to submit", "https://github.com/fratopa/egenioussBench", "by e-mail; until November 2026"),
    ),
    city_files=("lod2",),
    parts=(
        Part("query_images/val_gt_poses.txt", "true poses of val", "val"),
        Part("query_images/val/*", "photos of val", "val", media="image/jpeg"),
        Part("query_images/val_android_poses.txt", "the phone's poses of val", "val", False),
        Part("query_images/test/*", "photos of test", "test", False, "image/jpeg"),
        Part("query_images/test_android_poses.csv", "the phone's poses of test", "test", False, "text/csv"),
        Part("metadata/camera_parameters.txt", "camera", is_needed=False),
        Part("mesh/*", "textured mesh", is_needed=False, media="application/octet-stream"),
    ),
    protocol="egeniouss",
    year="2025",
    camera_height_m=(0.5, 4.0),
)
_PRIORS = ("android", "none")
_HEAD = "# IMAGE_NAME qw qx qy qz UTMx UTMy alt"


@dataclass(frozen=True, slots=True)
class EgenioussParams(OwnLayoutParams):
    """Settings of egenioussBench, described in ``conf/dataset/egeniouss.yaml``."""

    name: str = SPEC.id
    poses: str = AUTO
    camera: str | None = None
    priors: str = "android"
    height_offset_m: float = 0.0

    def __post_init__(self) -> None:
        require_within("dataset.height_offset_m", self.height_offset_m, -math.inf)


def open_egeniouss(params: EgenioussParams) -> Dataset:
    """Returns egenioussBench, with poses in the coordinates of its city model.

    Raises:
        DatasetError: Parts are missing or malformed, or what the documentation leaves open is not decided.
        ConfigError: A setting is unknown.
    """
    from lodbench.datasets.own import find_photo

    require_word("dataset.priors", params.priors, _PRIORS)
    found, home = find_parts(SPEC, params)
    findings = Findings()
    queries = home / "query_images"
    true_rows = read_pose_rows(queries / "val_gt_poses.txt")
    by_reading = {
        name: [pose_read_as(row, name, is_centre=True) for row in true_rows.values()] for name in READINGS
    }
    reading = choose_reading("dataset.poses", params.poses, by_reading, findings)
    camera, sigmas = _camera(params.camera, home / "metadata" / "camera_parameters.txt")
    up = (0.0, 0.0, params.height_offset_m)

    def as_poses(rows: dict[str, PoseRow]) -> dict[str, Pose]:
        return {name: pose_read_as(row, reading, is_centre=True).shifted(up) for name, row in rows.items()}

    truth: dict[str, Pose] = {}
    written: dict[str, str] = {}
    entries: list[Entry] = []
    for split, file in (("val", "val_android_poses.txt"), ("test", "test_android_poses.csv")):
        folder = queries / split
        photos = sorted(p.name for p in folder.glob("*") if p.suffix.lower() in PHOTO_SUFFIXES)
        poses = as_poses(true_rows) if split == "val" else dict.fromkeys(photos)
        has_priors = params.priors == "android" and (queries / file).is_file()
        priors = _by_stem(as_poses(read_pose_rows(queries / file)) if has_priors else {})
        for name, pose in poses.items():
            photo = find_photo(folder, name)
            entry = _entry(photo.name if photo else name, split, photo, priors, (camera, sigmas))
            if pose is not None:
                truth[entry.key], written[entry.key] = pose, name
            entries.append(entry)
            for code, is_so in ((NO_IMAGE, photo is None), (NO_PRIOR, entry.prior is None)):
                if is_so:
                    findings.add(code, entry.key)
    mesh = home / "mesh"
    return as_dataset(
        found,
        without_lens(SPEC.id, entries),
        truth,
        findings,
        lod=params.lod,
        textured_map=mesh if mesh.is_dir() else None,
        submission=partial(
            pose_lines,
            names=written,
            reading=reading,
            offset_m=[-value for value in up],
            head=_HEAD,
            is_centre=True,
        ),
    )


def _entry(
    name: str,
    split: str,
    photo: Path | None,
    priors: dict[str, Pose],
    known: tuple[Camera, CameraSigmas | None],
) -> Entry:
    prior = priors.get(Path(name).stem)
    hypotheses = () if prior is None else (prior,)
    return Entry(name, split, known[0], prior, photo, None, hypotheses, camera_sigmas=known[1])


def _by_stem(poses: dict[str, Pose]) -> dict[str, Pose]:
    return {Path(name).stem: pose for name, pose in poses.items()}


def _camera(stated: str | None, path: Path) -> tuple[Camera, CameraSigmas | None]:
    """Returns the camera of all photos: as set, or of the one line of a file that reads as COLMAP's."""
    if stated is not None:
        return stated_camera("dataset.camera", stated)
    for _, line in content(path) if path.is_file() else ():
        try:
            return parse_camera(line.split())
        except (LodbenchError, ValueError):
            continue
    what = (
        "is missing"
        if not path.is_file()
        else "has no line MODEL W H params, and its layout is not documented"
    )
    raise DatasetError(f"{path} {what}.", "State it: `dataset.camera='PINHOLE 960 1280 FX FY CX CY'`.")
