"""``dataset=ortholoc``: OrthoLoC, drone photos each with a surface model; see data_cards/ortholoc.md."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.faults import READING_INFERRED
from lodbench.datasets.pose_text import lines_to_text
from lodbench.datasets.published.layout import Host, Part, PublishedSpec, SplitSpec, not_all_of
from lodbench.datasets.published.own_layout import (
    AUTO,
    Array,
    OwnLayoutParams,
    as_dataset,
    find_parts,
    read_arrays,
    require_word,
)
from lodbench.datasets.published.raster_maps import (
    Raster,
    RasterMap,
    kept_maps,
    kept_pictures,
    pinhole,
    raster_of,
)
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError, LodbenchError, require_within
from lodbench.findings import Findings
from lodbench.geometry import Camera, CameraSigmas, Pose

_REPOSITORY = "https://github.com/deepscenario/OrthoLoC"
_SPLITS = ("test_inPlace", "test_outPlace", "val", "train")
SPEC = PublishedSpec(
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
    "image_query": Array((None, None, 3), "u"),
    "intrinsics": Array((3, 3)),
    "extrinsics": Array((3, 4)),
    "scale": Array((2,)),
}
_MAP = {
    "image_dop": Array((None, None, 3), "u"),
    "dsm": Array((None, None, 3), "f", is_finite=False),
}
_POINTS = Array((None, None, 3), "f", is_finite=False)
_FOCALS, _ORIGINS = ("known", "unknown"), {"centre": 0.5, "corner": 0.0}
# Every sample has coordinates of its own: each lies in a cell of a square grid, this far from the next.
_CELL_M, _MOST_SAMPLES = 2000.0, 4096
# Of an unknown focal length: COLMAP's first guess, as a multiple of the longer side, and how good it is.
_FOCAL_GUESS, _FOCAL_PERCENT = 1.2, 30.0
# Samples whose points are projected, every which pixel of them, and how well that must fit, pixels.
_CHECKED, _STEP, _NEAR_PX = 5, 16, 0.25


@dataclass(frozen=True, slots=True)
class OrthoLocParams(OwnLayoutParams):
    """Settings of OrthoLoC, described in ``conf/dataset/ortholoc.yaml``."""

    name: str = SPEC.id
    samples: str = "*"
    focal: str = "known"
    pixel_origin: str = AUTO
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
    require_word("dataset.focal", params.focal, _FOCALS)
    require_word("dataset.pixel_origin", params.pixel_origin, [AUTO, *_ORIGINS])
    found, home = find_parts(SPEC, params)
    files = [
        (split, path)
        for split in _SPLITS
        for path in sorted((home / "full" / split).glob("*.npz"))
        if fnmatch.fnmatch(path.stem, params.samples)
    ]
    if not files and not found.is_there:
        raise not_all_of(found)
    if not files:
        raise DatasetError(f"No sample of {found.root} is called {params.samples}.", "Set dataset.samples.")
    if len(files) > _MOST_SAMPLES:
        raise DatasetError(
            f"{len(files)} samples are more than the {_MOST_SAMPLES} that are opened at a time.",
            "Select some by their names: `dataset.samples='L01_R*'`.",
        )
    findings = Findings()
    samples = [_read(split, path) for split, path in files]
    half = _half_pixel(params.pixel_origin, samples, findings)
    paths = [path for _, path in files]
    pictures = kept_pictures(SPEC.id, paths, "pictures", lambda: _pictures(samples))
    city, textured, note = kept_maps(SPEC.id, paths, "", params.map_stride, lambda: _maps(paths))
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
    dataset = as_dataset(
        found,
        entries,
        truth,
        findings,
        city_model=found.city_model or city,
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
    arrays = read_arrays(path, _ARRAYS)
    try:
        pose = Pose.from_matrix(arrays["extrinsics"])
    except LodbenchError as error:
        raise DatasetError(f"{path}: extrinsics: {error.message}", "Download it again.") from error
    height, width = arrays["image_query"].shape[:2]
    return _Sample(split, path, (width, height), arrays["intrinsics"].astype(np.float64), pose)


def _camera(sample: _Sample, half_px: float, focal: str) -> tuple[Camera, CameraSigmas | None]:
    """Returns a sample's camera, or a guess at it and how good that is where it is not to be known."""
    width, height = sample.size
    camera = pinhole(f"{sample.path}: intrinsics", sample.intrinsics, sample.size, half_px)
    if focal == "known":
        return camera, None
    guess = _FOCAL_GUESS * max(width, height)
    sigmas = CameraSigmas(_FOCAL_PERCENT, 1.0, 0.0, "stated")
    return Camera(width, height, guess, guess, 0.5 * width, 0.5 * height), sigmas


def _half_pixel(reading: str, samples: Sequence[_Sample], findings: Findings) -> float:
    """Returns what to add to principal points: half a pixel if pixels count from their centres.

    A pixel's point, projected, lies on its number in the one case, half a pixel beyond in the other.
    """
    if reading != AUTO:
        return _ORIGINS[reading]
    off = []
    for sample in samples[:: max(1, len(samples) // _CHECKED)]:
        width, height = sample.size
        points = read_arrays(sample.path, {"point_map": _POINTS})["point_map"]
        if points.shape[:2] != (height, width):
            raise DatasetError(f"{sample.path}: point_map is {points.shape}, its photo {height} x {width}.")
        rows, columns = np.mgrid[0:height:_STEP, 0:width:_STEP]
        seen = points[rows, columns].astype(np.float64) @ sample.pose.rotation.T + sample.pose.translation
        with np.errstate(all="ignore"):
            pixels = seen @ sample.intrinsics.T
            pixels = pixels[..., :2] / pixels[..., 2:]
        off.append(np.nanmedian(pixels - np.stack([columns, rows], axis=2), axis=(0, 1)))
    offset = np.median(off, axis=0)
    fitting = [n for n, half in _ORIGINS.items() if np.abs(offset - (0.5 - half)).max() < _NEAR_PX]
    if not fitting:
        raise DatasetError(
            f"The point maps of {SPEC.id} lie {offset[0]:.2f}, {offset[1]:.2f} px off their pixels.",
            "Set `dataset.pixel_origin` to centre or corner: where the first pixel's zero is.",
        )
    findings.add(READING_INFERRED, "dataset.pixel_origin", f"{fitting[0]}, by {len(off)} point maps")
    return _ORIGINS[fitting[0]]


def _pictures(samples: Sequence[_Sample]) -> Iterator[tuple[str, NDArray[Any]]]:
    wanted = {"image_query": _ARRAYS["image_query"]}
    for sample in samples:
        yield f"{sample.split}/{sample.path.stem}", read_arrays(sample.path, wanted)["image_query"]


def _maps(paths: Sequence[Path]) -> Iterator[RasterMap]:
    """Yields each sample's map where its cell of the dataset is; its orthophoto covers its surface model."""
    for index, path in enumerate(paths):
        arrays = read_arrays(path, _MAP)
        heights = raster_of(arrays["dsm"] + np.array(cell_offset(index)), str(path))
        (rows, columns), (lines, samples) = heights.values.shape, arrays["image_dop"].shape[:2]
        cell = heights.cell[0] * columns / samples, heights.cell[1] * rows / lines
        picture = Raster(arrays["image_dop"][..., ::-1], heights.west, heights.north, cell)
        yield RasterMap(f"{index:04d}_{path.stem}", heights, picture)
