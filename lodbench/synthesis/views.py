"""Seeded views over a city: drone poses that show enough buildings, their photos, and how they are stored.

Photos are in a named look; flights can have COLMAP's reconstruction of theirs.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene, building_boxes
from lodbench.datasets.folder import write_poses
from lodbench.datasets.inputs import INSTANCES_FOLDER, encoded_labels
from lodbench.errors import ConfigError, DatasetError
from lodbench.extras import require
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.geometry.angles import rotation_from_euler
from lodbench.geometry.camera import distort
from lodbench.kernels.looks import CameraResponse, Look
from lodbench.photos.pictures import encoded_mask
from lodbench.rendering.renderer import Renderer
from lodbench.storage import make_folder, new_folder, random_stream, write_bytes
from lodbench.synthesis.photo import PhotoRenderer, draw_look, look_ranges, photo_file
from lodbench.synthesis.surroundings import make_surroundings

# UAVD4L's drone camera; masks and renderings of it are made at FINE_SIZE, coarse ones at half that.
RGB_CAMERA = Camera(width=5280, height=3956, fx=3778.423, fy=3767.392, cx=2663.624, cy=1919.721)
FINE_SIZE = (602, 448)

# The share of buildings is measured on a picture of this width: 0.1 % finer than it matters.
_PREVIEW_WIDTH = 150
# A camera keeps this far from buildings, sideways and above, metres.
_CLEARANCE_M = 15.0
# A view's centre lies this close to the middle of a building (standard deviation), metres.
_TARGET_SPREAD_M = 20.0
# Roll of a camera, and yaw, counter-clockwise from grid north.
_ROLL_DEG, _YAW_DEG = (-1.0, 1.0), (-180.0, 180.0)
_LIMITS = {"camera_height_m": (0.0, 1e5), "pitch_deg": (0.0, 85.0), "building_share": (0.0, 1.0)}
# Give up when fewer than one draw in this many is accepted.
_MAX_DRAWS_PER_VIEW = 200


@dataclass(frozen=True, slots=True)
class ViewSampling:
    """Which views to draw, from any side and almost level; every range is uniform, ends included.

    Raises:
        ConfigError: A range is empty, not finite, or beyond what a view can have.
    """

    # Camera height above the ground at the view's centre, metres.
    camera_height_m: tuple[float, float] = (100.0, 160.0)
    pitch_deg: tuple[float, float] = (20.0, 60.0)  # from nadir, degrees: 0 looks straight down
    building_share: tuple[float, float] = (0.10, 0.80)  # accepted share of building pixels in the picture
    # West, south, east and north bounds of the view centres, local metres, or None for the whole city.
    area_m: tuple[float, float, float, float] | None = None
    seed: int = 0  # seed of the random streams

    def __post_init__(self) -> None:
        for name, (least, most) in _LIMITS.items():
            low, high = getattr(self, name)
            if not least <= low <= high <= most:
                raise ConfigError(
                    f"The views' {name} is ({low}, {high}), not an ascending range "
                    f"within {least:g} to {most:g}."
                )


class SampledViews(NamedTuple):
    """Views drawn over a city."""

    poses: tuple[Pose, ...]  # the accepted views, in order
    rejections: int  # how many draws were thrown away on the way


def sample_views(
    scene: Scene, renderer: Renderer, camera: Camera, sampling: ViewSampling, count: int, *names: str | int
) -> SampledViews:
    """Draws views over a city whose centres hit built-up ground and that show enough buildings.

    View i depends on the seed, the names and i only: asking for more views keeps the first ones.

    Of the camera only the shape of its view matters; ``names`` is a path of random streams, so that two users
    of one seed get different views.

    Raises:
        DatasetError: The area has no building, or hardly any draw is accepted.
    """
    check = ViewCheck(scene, renderer, camera, sampling.building_share)
    targets = check.buildings_in(sampling.area_m)
    if len(targets) == 0:
        raise DatasetError("There is no building to look at in the area of the views.", "Widen area_m.")
    poses: list[Pose] = []
    rejections = 0
    for index in range(count):
        generator = random_stream(sampling.seed, *names, "views", index)
        draws = (
            _draw_view(sampling, check.boxes.bases[targets], generator) for _ in range(_MAX_DRAWS_PER_VIEW)
        )
        pose, rejected = first_accepted(draws, check)
        rejections += rejected
        if pose is None:
            low, high = sampling.building_share
            raise DatasetError(
                f"{_MAX_DRAWS_PER_VIEW} views in a row show less than {low:.0%} or more than {high:.0%} "
                "buildings, or stand among them.",
                "Set `dataset.camera_height_m=[40,80]` to fly lower, or `dataset.building_share=[0.02,0.8]`.",
            )
        poses.append(pose)
    return SampledViews(tuple(poses), rejections)


def first_accepted(poses: Iterable[Pose], check: ViewCheck) -> tuple[Pose | None, int]:
    """Returns the first view that a check accepts, None if there is none, and how many it rejected."""
    rejections = 0
    for pose in poses:
        if check.accepts(pose):
            return pose, rejections
        rejections += 1
    return None, rejections


def target_near(bases: NDArray[np.float64], generator: np.random.Generator) -> NDArray[np.float64]:
    """Returns a place on the ground, (3,), near one of the buildings with these bases, (B, 3) metres."""
    target = bases[int(generator.integers(len(bases)))].copy()
    target[:2] += generator.normal(0.0, _TARGET_SPREAD_M, size=2)
    return np.asarray(target)


def view_of(target: NDArray[np.float64], height_m: float, angles: EulerAngles) -> Pose:
    """Returns the pose whose optical axis meets a ground point, (3,) metres, from a height above it."""
    rotation = rotation_from_euler(angles)
    axis = rotation[2]
    return Pose.from_center(rotation, np.asarray(target) + axis * (height_m / axis[2]))


class ViewCheck:
    """Returns which views of a city will do: clear of buildings, and with enough of them in the picture."""

    def __init__(
        self, scene: Scene, renderer: Renderer, camera: Camera, building_share: tuple[float, float]
    ) -> None:
        self._renderer = renderer
        height = max(1, round(_PREVIEW_WIDTH * camera.height / camera.width))
        self._preview = camera.scaled(_PREVIEW_WIDTH, height)
        self._share = building_share
        self.boxes = building_boxes(scene)

    def buildings_in(self, area_m: tuple[float, float, float, float] | None) -> NDArray[np.int64]:
        """Returns the rows of ``boxes`` with bases within (west, south, east, north), or all of them."""
        x, y, _ = self.boxes.bases.T
        if area_m is None:
            return np.arange(len(x))
        west, south, east, north = area_m
        return np.flatnonzero((x >= west) & (x <= east) & (y >= south) & (y <= north))

    def accepts(self, pose: Pose) -> bool:
        """Returns whether a view is clear of buildings and shows the share of them that is requested."""
        if not self.boxes.are_clear_of(pose.center, _CLEARANCE_M):
            return False
        low, high = self._share
        return bool(low <= self._renderer.render(self._preview, pose).mean() <= high)


def _draw_view(sampling: ViewSampling, ground: NDArray[np.float64], generator: np.random.Generator) -> Pose:
    """Draws one view whose centre lies on the ground near one of the buildings, (B, 3) metres."""
    target = target_near(ground, generator)
    ranges = (sampling.camera_height_m, sampling.pitch_deg, _ROLL_DEG, _YAW_DEG)
    height, *angles = (generator.uniform(*bounds) for bounds in ranges)
    return view_of(target, height, EulerAngles(*angles))


Floats = NDArray[np.float64]
Decimals = tuple[int, int] | None  # of quaternions and of metres


class SyntheticQuery(NamedTuple):
    """What is made up for one view, in the scene's local frame."""

    name: str  # of the view; its random streams follow from it
    truth: Pose  # where the view was drawn from
    prior: Pose  # the rough pose
    mask: NDArray[np.bool_]  # (H, W) query mask, as wrong as a network's
    achieved_iou: float  # its IoU with the silhouette at the truth
    photo: bytes | None = None  # JPEG file of the view, or None
    instances: NDArray[np.uint16] | None = None  # (H, W) labels of buildings that fill the mask, or None

    @property
    def file_name(self) -> str:
        """Returns the name of its image in a folder."""
        return self.name if self.photo is not None else f"{self.name}.png"


def written_once(folder: Path, write: Callable[[Path], None]) -> Path:
    """Returns a folder that is filled first if it is not there; it appears whole or not at all."""
    if not folder.is_dir():
        make_folder(folder.parent)
        # Another process that is as quick leaves a folder of the same bytes.
        with new_folder(folder) as building:
            write(building)
    return folder


def write_queries(
    folder: Path, queries: Sequence[SyntheticQuery], camera: Camera, origin: Floats, decimals: Decimals = None
) -> None:
    """Writes all of one split, taken by one camera, in a folder that becomes one once it is full.

    ``origin``, (3,), is that of the scene's frame in the city's CRS. Without ``decimals`` poses have as many
    as restore them.
    """
    make_folder(folder / "masks")
    truth = {query.file_name: query.truth.shifted(origin) for query in queries}
    priors = {query.file_name: query.prior.shifted(origin) for query in queries}
    cameras = dict.fromkeys(truth, camera)
    write_poses(folder, cameras, truth, priors, decimals=decimals, survives_power_cut=False)
    for query in queries:
        name = f"{Path(query.file_name).stem}.png"
        write_bytes(folder / "masks" / name, encoded_mask(query.mask), False)
        if query.instances is not None:
            file = make_folder(folder / INSTANCES_FOLDER) / name
            write_bytes(file, encoded_labels(query.instances), False)
        if query.photo is not None:
            write_bytes(make_folder(folder / "Query_image") / query.name, query.photo, False)


# What photos are drawn at, pixels.
PHOTO_SIZE = (1204, 902)


class Photographer:
    """Draws photos of one city in a look of ``conf/training``; a photo depends on seed and names only.

    Raises:
        ConfigError: There is no such look.
    """

    def __init__(self, scene: Scene, look: str, seed: int) -> None:
        self._ranges, self._seed = look_ranges(look), seed
        props, land = make_surroundings(scene, seed)
        self._renderer = PhotoRenderer(scene, props, land.cover)

    def views(self, queries: Sequence[SyntheticQuery], cameras: Sequence[Camera]) -> list[SyntheticQuery]:
        """Returns queries (scene frame) with photos, each in its own light; names become those of JPEGs.

        Args:
            queries: What is photographed.
            cameras: What takes each.
        """
        return [
            self._taken(query, camera, *self._look("views", "look", query.name))
            for query, camera in zip(queries, cameras, strict=True)
        ]

    def flight(self, queries: Sequence[SyntheticQuery], camera: Camera, number: int) -> list[SyntheticQuery]:
        """Returns a flight's queries with photos: one sun, exposures apart; else as ``views``."""
        light, _ = self._look("flight", number, "look")
        return [self._taken(query, camera, light, self._look("look", query.name)[1]) for query in queries]

    def _look(self, *stream: str | int) -> tuple[Look, CameraResponse]:
        return draw_look(self._ranges, random_stream(self._seed, *stream))

    def _taken(
        self, query: SyntheticQuery, camera: Camera, look: Look, response: CameraResponse
    ) -> SyntheticQuery:
        photo = draw_through_lens(
            lambda pinhole: self._renderer.photo(pinhole, query.truth, look, response), camera
        )
        return query._replace(name=f"{query.name}.jpg", photo=photo_file(photo, ".jpg", response))


def reconstruct(queries: Sequence[SyntheticQuery], camera: Camera, folder: Path) -> None:
    """Writes COLMAP's reconstruction of a flight's photos, its own frame and focal length.

    Photos that COLMAP does not register are not in it.

    Raises:
        ConfigError: pycolmap is not installed.
        DatasetError: COLMAP finds no model.
    """
    pycolmap = require("pycolmap", "pnp", "dataset.reconstruct=true")
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    with tempfile.TemporaryDirectory() as made:
        photos, database = make_folder(Path(made) / "photos"), Path(made) / "database.db"
        for query in queries:
            (photos / query.name).write_bytes(query.photo or b"")
        reader = pycolmap.ImageReaderOptions(
            camera_model="PINHOLE",
            camera_params=",".join(map(str, (camera.fx, camera.fy, camera.cx, camera.cy))),
        )
        pycolmap.set_random_seed(0)
        pycolmap.extract_features(
            database, photos, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader
        )
        pycolmap.match_exhaustive(database)
        models = pycolmap.incremental_mapping(database, photos, made)
        if not models:
            raise DatasetError(f"COLMAP finds no model of {queries[0].name} and the photos with it.")
        largest = max(models.values(), key=lambda model: model.num_reg_images())
        make_folder(folder)
        largest.write_text(folder)


# Each iteration leaves |k1| r^2 of the error, below 0.2 for lenses of drones.
_ITERATIONS = 30


def draw_through_lens(draw: Callable[[Camera], NDArray[Any]], lens: Camera) -> NDArray[Any]:
    """Returns (H, W, ...) what a lens shows of what ``draw`` returns for a pinhole.

    Drawn with as short a focal length as the lens's corners need. Labels and masks keep their values (nearest
    pixel), photos are interpolated linearly.

    Args:
        draw: Returns the picture of a pinhole, of its size; booleans, integers, or (H, W, 3) of a photo.
        lens: With or without distortion; without, its picture is returned as drawn.
    """
    if not lens.distortion:
        return draw(lens)
    columns, rows = np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5
    lens_x, lens_y = np.meshgrid((columns - lens.cx) / lens.fx, (rows - lens.cy) / lens.fy)
    ray_x, ray_y = _undistort(lens, lens_x, lens_y)
    axes = ((ray_x, lens_x), (ray_y, lens_y))
    reach = max(1.0, *(float(np.abs(ray).max() / np.abs(distorted).max()) for ray, distorted in axes))
    pinhole = replace(lens.without_distortion(), fx=lens.fx / reach, fy=lens.fy / reach)
    picture = draw(pinhole)
    x, y = pinhole.fx * ray_x + pinhole.cx, pinhole.fy * ray_y + pinhole.cy
    if picture.ndim == 2:
        row, column = np.clip(y.astype(int), 0, lens.height - 1), np.clip(x.astype(int), 0, lens.width - 1)
        return np.asarray(picture[row, column])
    import cv2

    # OpenCV counts from pixel centres, COLMAP from corners.
    at = (x - 0.5).astype(np.float32), (y - 0.5).astype(np.float32)
    return np.asarray(cv2.remap(picture, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _undistort(lens: Camera, lens_x: NDArray[Any], lens_y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Returns the pinhole's normalised coordinates of the lens's, by fixed-point iteration."""
    x, y = lens_x, lens_y
    for _ in range(_ITERATIONS):
        distorted_x, distorted_y = distort(lens.lens, lens.distortion, x, y)
        x, y = x + lens_x - distorted_x, y + lens_y - distorted_y
    return x, y
