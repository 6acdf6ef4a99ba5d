"""``dataset=egeniouss``: phone photos at street level; ``dataset=ortholoc``: drone photos, surface models.

See data_cards/egeniouss.md and data_cards/ortholoc.md.
"""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.faults import NO_IMAGE, NO_PRIOR, READING_INFERRED
from lodbench.datasets.pose_text import content, lines_to_text, parse_camera
from lodbench.datasets.published import own_layout, raster_maps
from lodbench.datasets.published.layout import Host, Part, PublishedSpec, SplitSpec, not_all_of
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError, LodbenchError, require_within
from lodbench.findings import Findings
from lodbench.geometry import Camera, CameraSigmas, Pose
from lodbench.photos.files import PHOTO_SUFFIXES

_RECORD = "https://zenodo.org/records/17644019"
EGENIOUSS = PublishedSpec(
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
class EgenioussParams(own_layout.OwnLayoutParams):
    """Settings of egenioussBench, described in ``conf/dataset/egeniouss.yaml``."""

    name: str = EGENIOUSS.id
    poses: str = own_layout.AUTO
    camera: str | None = None
    priors: str = "android"
    height_offset_m: float = 0.0

    def __post_init__(self) -> None:
        require_within("dataset.height_offset_m", self.height_offset_m, -math.inf)


def open_egeniouss(params: EgenioussParams) -> Dataset:
    """Returns egenioussBench, with poses in the coordinates of its city model.

    Raises:
        DatasetError: Parts are missing or malformed, or a setting is missing that the documentation does not
            define.
        ConfigError: A setting is unknown.
    """
    from lodbench.datasets.own import find_photo

    own_layout.require_word("dataset.priors", params.priors, _PRIORS)
    inventory, home = own_layout.find_parts(EGENIOUSS, params)
    findings = Findings()
    queries = home / "query_images"
    true_rows = own_layout.read_pose_rows(queries / "val_gt_poses.txt")
    by_reading = {
        name: [own_layout.pose_read_as(row, name, is_centre=True) for row in true_rows.values()]
        for name in own_layout.READINGS
    }
    reading = own_layout.choose_reading("dataset.poses", params.poses, by_reading, findings)
    camera, sigmas = _phone_camera(params.camera, home / "metadata" / "camera_parameters.txt")
    up = (0.0, 0.0, params.height_offset_m)

    def as_poses(rows: dict[str, own_layout.PoseRow]) -> dict[str, Pose]:
        return {
            name: own_layout.pose_read_as(row, reading, is_centre=True).shifted(up)
            for name, row in rows.items()
        }

    truth: dict[str, Pose] = {}
    written: dict[str, str] = {}
    entries: list[Entry] = []
    for split, file in (("val", "val_android_poses.txt"), ("test", "test_android_poses.csv")):
        folder = queries / split
        photos = sorted(p.name for p in folder.glob("*") if p.suffix.lower() in PHOTO_SUFFIXES)
        poses = as_poses(true_rows) if split == "val" else dict.fromkeys(photos)
        has_priors = params.priors == "android" and (queries / file).is_file()
        rough = as_poses(own_layout.read_pose_rows(queries / file)) if has_priors else {}
        priors = {Path(name).stem: pose for name, pose in rough.items()}
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
    return own_layout.as_dataset(
        inventory,
        own_layout.without_lens(EGENIOUSS.id, entries),
        truth,
        findings,
        lod=params.lod,
        textured_map=mesh if mesh.is_dir() else None,
        submission=partial(
            own_layout.pose_lines,
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


def _phone_camera(stated: str | None, path: Path) -> tuple[Camera, CameraSigmas | None]:
    """Returns the camera of all photos: as set, or of the one line of a file that reads as COLMAP's."""
    if stated is not None:
        return own_layout.stated_camera("dataset.camera", stated)
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


_REPOSITORY = "https://github.com/deepscenario/OrthoLoC"
_SPLITS = ("test_inPlace", "test_outPlace", "val", "train")
ORTHOLOC = PublishedSpec(
    id="ortholoc",
    title="OrthoLoC",
    lod="surface model with orthophoto",
    folder="OrthoLoC",
    splits=tuple(SplitSpec(name, (f"full/{name}",), (), is_test=name.startswith("test")) for name in _SPLITS),
    hosts=(
        Host("samples (.npz)", _REPOSITORY, "a web share of TU Munich, linked there; its size is not stated"),
    ),
    parts=tuple(
        Part(f"full/{name}/*.npz", f"samples of {name}", name, False, "application/octet-stream")
        for name in _SPLITS
    ),
    protocol="ortholoc",
    year="2025",
)
_ARRAYS = {
    "image_query": own_layout.Array((None, None, 3), "u"),
    "intrinsics": own_layout.Array((3, 3)),
    "extrinsics": own_layout.Array((3, 4)),
    "scale": own_layout.Array((2,)),
}
_MAP = {
    "image_dop": own_layout.Array((None, None, 3), "u"),
    "dsm": own_layout.Array((None, None, 3), "f", is_finite=False),
}
_POINTS = own_layout.Array((None, None, 3), "f", is_finite=False)
_FOCALS, _ORIGINS = ("known", "unknown"), {"centre": 0.5, "corner": 0.0}
# Every sample has coordinates of its own: each lies in a cell of a square grid, this far from the next.
_CELL_M, _MOST_SAMPLES = 2000.0, 4096
# Of an unknown focal length: COLMAP's first guess, as a multiple of the longer side, and how good it is.
_FOCAL_GUESS, _FOCAL_PERCENT = 1.2, 30.0
# Samples whose points are projected, every which pixel of them, and how well that must fit, pixels.
_CHECKED, _STEP, _NEAR_PX = 5, 16, 0.25


@dataclass(frozen=True, slots=True)
class OrthoLocParams(own_layout.OwnLayoutParams):
    """Settings of OrthoLoC, described in ``conf/dataset/ortholoc.yaml``."""

    name: str = ORTHOLOC.id
    samples: str = "*"
    focal: str = "known"
    pixel_origin: str = own_layout.AUTO
    map_stride: int = 4

    def __post_init__(self) -> None:
        require_within("dataset.map_stride", self.map_stride, 1)


class _Sample(NamedTuple):
    split: str
    path: Path
    size: tuple[int, int]
    intrinsics: NDArray[Any]
    pose: Pose


def cell_offset(index: int) -> tuple[float, float, float]:
    """Returns where the zero of a dataset's sample of some number lies in the dataset, metres."""
    side = int(np.sqrt(_MOST_SAMPLES))
    return (_CELL_M * (index % side), _CELL_M * (index // side), 0.0)


def open_ortholoc(params: OrthoLocParams) -> Dataset:
    """Returns OrthoLoC: a query per sample, without priors, over the surface models of all of them.

    Raises:
        DatasetError: There are no samples or too many, or one is malformed.
        ConfigError: A setting is unknown.
    """
    own_layout.require_word("dataset.focal", params.focal, _FOCALS)
    own_layout.require_word("dataset.pixel_origin", params.pixel_origin, [own_layout.AUTO, *_ORIGINS])
    inventory, home = own_layout.find_parts(ORTHOLOC, params)
    files = [
        (split, path)
        for split in _SPLITS
        for path in sorted((home / "full" / split).glob("*.npz"))
        if fnmatch.fnmatch(path.stem, params.samples)
    ]
    if not files and not inventory.is_there:
        raise not_all_of(inventory)
    if not files:
        raise DatasetError(
            f"No sample of {inventory.root} is called {params.samples}.", "Set dataset.samples."
        )
    if len(files) > _MOST_SAMPLES:
        raise DatasetError(
            f"{len(files)} samples are more than the {_MOST_SAMPLES} that are opened at a time.",
            "Select some by their names: `dataset.samples='L01_R*'`.",
        )
    findings = Findings()
    samples = [_read(split, path) for split, path in files]
    half = _half_pixel(params.pixel_origin, samples, findings)
    paths = [path for _, path in files]
    pictures = raster_maps.kept_pictures(ORTHOLOC.id, paths, "pictures", lambda: _pictures(samples))
    city, textured, note = raster_maps.kept_maps(
        ORTHOLOC.id, paths, "", params.map_stride, lambda: _maps(paths)
    )
    entries, truth = [], {}
    for index, sample in enumerate(samples):
        camera, sigmas = _camera(sample, half, params.focal)
        name = f"{sample.path.stem}.png"
        image = pictures / sample.split / name
        percent = None if sigmas is None else sigmas.stated_focal_percent
        entry = Entry(
            name, sample.split, camera, None, image, None, lens_percent=percent, camera_sigmas=sigmas
        )
        entries.append(entry)
        truth[entry.key] = sample.pose.shifted(cell_offset(index))
    dataset = own_layout.as_dataset(
        inventory,
        entries,
        truth,
        findings,
        city_model=inventory.city_model or city,
        textured_map=textured,
        lod=params.lod,
        submission=partial(_predictions, [entry.key for entry in entries]),
    )
    priors = "there are no priors; prior=uniform draws them around the truth"
    return replace(dataset, notes=(*dataset.notes, *filter(None, [priors, note])))


def _predictions(keys: Sequence[str], poses: Mapping[str, Pose | None]) -> str:
    """Returns lines as the publishers' benchmark writes them: world to camera, quaternion x, y, z, w."""
    lines = []
    for index, key in enumerate(keys):
        if key not in poses:
            continue
        pose, name = poses[key], Path(key).stem
        if pose is None:
            lines.append(f"{name} None")
            continue
        local = pose.shifted([-value for value in cell_offset(index)])
        w, x, y, z = local.quat_wxyz
        camera = "fx: None fy: None cx: None cy: None"  # methods state poses, no cameras
        lines.append(f"{name} - 0 (best): q: {[x, y, z, w]} t: {local.translation.tolist()} {camera}")
    return lines_to_text(lines)


def _read(split: str, path: Path) -> _Sample:
    arrays = own_layout.read_arrays(path, _ARRAYS)
    try:
        pose = Pose.from_matrix(arrays["extrinsics"])
    except LodbenchError as error:
        raise DatasetError(f"{path}: extrinsics: {error.message}", "Download it again.") from error
    height, width = arrays["image_query"].shape[:2]
    return _Sample(split, path, (width, height), arrays["intrinsics"].astype(np.float64), pose)


def _camera(sample: _Sample, half_px: float, focal: str) -> tuple[Camera, CameraSigmas | None]:
    """Returns a sample's camera, or a guess at it and how good that is where it is not to be known."""
    width, height = sample.size
    camera = raster_maps.pinhole(f"{sample.path}: intrinsics", sample.intrinsics, sample.size, half_px)
    if focal == "known":
        return camera, None
    guess = _FOCAL_GUESS * max(width, height)
    sigmas = CameraSigmas(_FOCAL_PERCENT, 1.0, 0.0, "stated")
    return Camera(width, height, guess, guess, 0.5 * width, 0.5 * height), sigmas


def _half_pixel(reading: str, samples: Sequence[_Sample], findings: Findings) -> float:
    """Returns what to add to principal points: half a pixel if pixels count from their centres.

    A pixel's point, projected, lies on its number in the one case, half a pixel beyond in the other.
    """
    if reading != own_layout.AUTO:
        return _ORIGINS[reading]
    off = []
    for sample in samples[:: max(1, len(samples) // _CHECKED)]:
        width, height = sample.size
        points = own_layout.read_arrays(sample.path, {"point_map": _POINTS})["point_map"]
        if points.shape[:2] != (height, width):
            raise DatasetError(f"{sample.path}: point_map is {points.shape}, its photo {height} x {width}.")
        rows, columns = np.mgrid[0:height:_STEP, 0:width:_STEP]
        local = points[rows, columns].astype(np.float64) @ sample.pose.rotation.T + sample.pose.translation
        with np.errstate(all="ignore"):
            pixels = local @ sample.intrinsics.T
            pixels = pixels[..., :2] / pixels[..., 2:]
        off.append(np.nanmedian(pixels - np.stack([columns, rows], axis=2), axis=(0, 1)))
    offset = np.median(off, axis=0)
    fitting = [n for n, half in _ORIGINS.items() if np.abs(offset - (0.5 - half)).max() < _NEAR_PX]
    if not fitting:
        raise DatasetError(
            f"The point maps of {ORTHOLOC.id} lie {offset[0]:.2f}, {offset[1]:.2f} px off their pixels.",
            "Set `dataset.pixel_origin` to centre or corner: where the first pixel's zero is.",
        )
    findings.add(READING_INFERRED, "dataset.pixel_origin", f"{fitting[0]}, by {len(off)} point maps")
    return _ORIGINS[fitting[0]]


def _pictures(samples: Sequence[_Sample]) -> Iterator[tuple[str, NDArray[Any]]]:
    wanted = {"image_query": _ARRAYS["image_query"]}
    for sample in samples:
        yield f"{sample.split}/{sample.path.stem}", own_layout.read_arrays(sample.path, wanted)["image_query"]


def _maps(paths: Sequence[Path]) -> Iterator[raster_maps.RasterMap]:
    """Yields each sample's map where its cell of the dataset is; its orthophoto covers its surface model."""
    for index, path in enumerate(paths):
        arrays = own_layout.read_arrays(path, _MAP)
        heights = raster_maps.raster_of(arrays["dsm"] + np.array(cell_offset(index)), str(path))
        (rows, columns), (lines, samples) = heights.values.shape, arrays["image_dop"].shape[:2]
        cell = heights.cell[0] * columns / samples, heights.cell[1] * rows / lines
        picture = raster_maps.Raster(arrays["image_dop"][..., ::-1], heights.west, heights.north, cell)
        yield raster_maps.RasterMap(f"{index:04d}_{path.stem}", heights, picture)
