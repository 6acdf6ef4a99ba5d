"""Seeded flights over any city, along paths of ``camera_paths``; what drone and map are wrong about."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.cache import OpenCity, open_cached_city, store_city
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import BuildingBoxes, Scene, build_scene, building_boxes
from lodbench.datasets.folder import RECONSTRUCTION_FOLDER, SEQUENCE_FILE, FolderParams, open_folder
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError, DatasetError, nearest_names, require_numbers, require_within
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.rendering import Renderer, make_renderer
from lodbench.storage import digest_of, random_stream, write_text
from lodbench.storage.paths import cache_root
from lodbench.synthesis.camera_paths import FLIGHT_PATHS
from lodbench.synthesis.mask_degradation import degrade_mask
from lodbench.synthesis.views import (
    FINE_SIZE,
    PHOTO_SIZE,
    RGB_CAMERA,
    Photographer,
    SyntheticQuery,
    ViewCheck,
    reconstruct,
    target_near,
    write_queries,
    written_once,
)

# Raised whenever the same settings would draw something else.
FLIGHTS_VERSION = 1
SPLIT, MAP_TRUTH_FILE, _MAP_FOLDER = "flights", "map_truth.json", "map"
# The share of buildings in a photo that is kept, as for ``dataset=views``.
_BUILDING_SHARE = (0.10, 0.80)
# Places tried before a city is said to have none for such a flight.
_MOST_TRIES = 200


@dataclass(frozen=True, slots=True)
class FlightsParams:
    """Settings of ``dataset=flights``; described in its ``conf``; errors are half widths of uniform draws."""

    city_model: str
    num_flights: int = 4
    num_photos: int = 20
    path: str | None = None
    mask_iou: float = 0.88
    shared_m: float = 8.0
    own_m: float = 2.0
    shared_height_m: float = 28.0
    shared_tilt_deg: float = 0.8
    own_tilt_deg: float = 0.3
    shared_yaw_deg: float = 5.0
    own_yaw_deg: float = 2.5
    focal: float = 0.0
    distortion: float = 0.0
    wrong_heights: float = 0.0
    missing: float = 0.0
    extra: float = 0.0
    flights_seed: int = 0
    look: str | None = None
    photo_width: int = PHOTO_SIZE[0]
    reconstruct: bool = False
    lod: str | None = None
    mask_lod: str | None = None
    crs: str | None = None
    roof_height: str | None = None
    name: str = "flights"

    def __post_init__(self) -> None:
        require_numbers(self, "dataset", ("num_flights", "num_photos"), 1)
        if self.path is not None and self.path not in FLIGHT_PATHS:
            raise ConfigError(
                f"dataset.path={self.path} is not known.", nearest_names(self.path, FLIGHT_PATHS)
            )
        require_within("dataset.mask_iou", self.mask_iou, 0, 1, "(]")
        require_within("dataset.focal", self.focal, 0, 0.2)
        require_within("dataset.distortion", self.distortion, -0.3, 0.3)
        if self.reconstruct and self.look is None:
            raise ConfigError("dataset.reconstruct=true needs photos.", "Set `dataset.look=plain`.")
        require_within("dataset.photo_width", self.photo_width, FINE_SIZE[0], RGB_CAMERA.width, "[]")
        if self.look is not None and self.distortion != 0:
            raise ConfigError("dataset.look draws photos without distortion.", "Set `dataset.distortion=0`.")
        errors = ("shared_m", "own_m", "shared_height_m", "shared_tilt_deg", "own_tilt_deg")
        require_numbers(self, "dataset", (*errors, "shared_yaw_deg", "own_yaw_deg"), 0)
        require_numbers(self, "dataset", ("wrong_heights", "missing", "extra"), 0, 0.5)
        if self.wrong_heights + self.missing + self.extra > 1:
            raise ConfigError(
                "Wrong heights, missing and extra buildings are more than all there are.",
                "No building is wrong in two ways: their shares are at most 1 together.",
            )

    def shared(self) -> SensorErrors:
        """Returns what all photos of a flight are wrong about."""
        return SensorErrors(self.shared_m, self.shared_height_m, self.shared_tilt_deg, self.shared_yaw_deg)

    def own(self) -> SensorErrors:
        """Returns what each photo is wrong about by itself."""
        return SensorErrors(self.own_m, self.own_m, self.own_tilt_deg, self.own_yaw_deg)

    def map_errors(self) -> MapErrors:
        """Returns what the map is wrong about."""
        return MapErrors(self.wrong_heights, self.missing, self.extra)


def open_flights(params: FlightsParams) -> Dataset:
    """Returns the dataset of seeded flights; draws them first if the cache does not hold them.

    Raises:
        LodbenchError: The city cannot be read, or no flight can be drawn over it.
    """
    city = Path(params.city_model).expanduser()
    if not city.exists():
        raise DatasetError(f"The city model {city} does not exist.", "Set `city=FILE`.")
    if city.name == _MAP_FOLDER and (city.parent / MAP_TRUTH_FILE).is_file():
        # A run that is opened again names the wrong map it was given: its flights lie around it.
        return _opened(params, city.parent)
    options = ReadOptions(crs=params.crs)
    opened = partial(open_cached_city, city, options=options, roof_height=params.roof_height)
    world = opened(lod=params.mask_lod or params.lod).scene
    left_out = {"city_model", "crs", "name"}
    if not params.map_errors():
        left_out.add("lod")
    if params.look is None:
        left_out.add("photo_width")
    drawn = {key: value for key, value in asdict(params).items() if key not in left_out}
    stated = (
        [] if world.pitched is None or not params.map_errors() else np.flatnonzero(world.pitched).tolist()
    )
    key = digest_of([FLIGHTS_VERSION, drawn, world.digest(), world.origin.tolist(), *stated])

    def write(folder: Path) -> None:
        # A level that the file lacks is said before photos are drawn, not after.
        level = opened(lod=params.lod)
        _draw(params, world, folder)
        if params.map_errors():
            _write_map(params, level, folder)

    return _opened(params, written_once(cache_root() / "flights" / key, write))


def _opened(params: FlightsParams, root: Path) -> Dataset:
    where = str(root / _MAP_FOLDER) if params.map_errors() else str(Path(params.city_model).expanduser())
    lod, rule = (None, None) if params.map_errors() else (params.lod, params.roof_height)
    folder = open_folder(FolderParams(str(root), where, lod, params.crs, rule, params.name))
    return replace(folder, version=f"flights {FLIGHTS_VERSION}, seed {params.flights_seed}")


def _draw(params: FlightsParams, world: Scene, folder: Path) -> None:
    """Writes all flights as one split of a folder."""
    renderer = make_renderer("silhouette", world, None)
    width, height = params.photo_width, round(params.photo_width * PHOTO_SIZE[1] / PHOTO_SIZE[0])
    stated = RGB_CAMERA if params.look is None else RGB_CAMERA.scaled(width, height)
    photographer = None if params.look is None else Photographer(world, params.look, params.flights_seed)
    queries, sequences = [], {}
    for flight in range(params.num_flights):
        name, taken = f"flight_{flight:02d}", draw_flight(params, world, renderer, flight)
        if photographer is not None:
            taken = photographer.flight(taken, drone_errors(params, flight).camera(stated), flight)
        if params.reconstruct:
            reconstruct(taken, stated, folder / SPLIT / RECONSTRUCTION_FOLDER / name)
        queries += taken
        sequences.update({query.file_name: name for query in taken})
    write_queries(folder / SPLIT, queries, stated, world.origin)
    lines = [f"{name} {flight}" for name, flight in sequences.items()]
    write_text(folder / SPLIT / SEQUENCE_FILE, "\n".join(lines) + "\n", False)


def draw_flight(params: FlightsParams, world: Scene, renderer: Renderer, flight: int) -> list[SyntheticQuery]:
    """Returns the photos of one flight in the order they were taken; it depends on seed and number only.

    Raises:
        DatasetError: No place of the city shows enough buildings along such a flight.
    """
    names = (params.flights_seed, "flight", flight)
    lens, camera = drone_errors(params, flight), RGB_CAMERA.scaled(*FINE_SIZE)
    true_camera, distortion, shared = lens.camera(camera), lens.distortion, lens.sensors
    queries = []
    for number, truth in enumerate(_poses(params, world, renderer, camera, flight)):
        name = f"flight_{flight:02d}_{number:04d}"
        clean = _silhouette(renderer, true_camera, truth, distortion)
        rough, iou = degrade_mask(clean, params.mask_iou, random_stream(*names, number, "mask"))
        own = params.own().draw(random_stream(*names, number, "prior"))
        queries.append(SyntheticQuery(name, truth, moved(truth, shared + own), rough, iou))
    return queries


class DroneErrors(NamedTuple):
    """What a flight's drone is wrong about in all photos."""

    sensors: NDArray[np.float64]  # (6,) by which priors are off, metres and degrees
    focal: float  # the focal length over what is stated of it
    distortion: float  # radial distortion k1

    def camera(self, stated: Camera) -> Camera:
        """Returns the pinhole that photos are taken with, of the size of the one that is stated."""
        return replace(stated, fx=stated.fx * self.focal, fy=stated.fy * self.focal)


def drone_errors(params: FlightsParams, flight: int) -> DroneErrors:
    """Returns what the drone of a flight is wrong about; it depends on seed and number only."""
    generator = random_stream(params.flights_seed, "flight", flight, "errors")
    shared = params.shared().draw(generator)
    focal = 1.0 + params.focal * float(generator.uniform(-1.0, 1.0))
    return DroneErrors(shared, focal, params.distortion * float(generator.uniform(-1.0, 1.0)))


def _poses(
    params: FlightsParams, world: Scene, renderer: Renderer, camera: Camera, flight: int
) -> list[Pose]:
    kind = params.path or list(FLIGHT_PATHS)[flight % len(FLIGHT_PATHS)]
    fly, wanted = FLIGHT_PATHS[kind], params.num_photos
    check = ViewCheck(world, renderer, camera, _BUILDING_SHARE)
    generator = random_stream(params.flights_seed, "flight", flight, "path")
    for _ in range(_MOST_TRIES):
        target = target_near(check.boxes.bases, generator)
        accepted = [pose for pose in fly(target, generator, wanted) if check.accepts(pose)]
        if len(accepted) >= wanted:
            first = (len(accepted) - wanted) // 2
            return accepted[first : first + wanted]
    raise DatasetError(
        f"No {kind} flight of {wanted} photos that all show buildings was found.",
        "Set `dataset.path=orbit`, or fewer `dataset.num_photos`.",
    )


def _silhouette(renderer: Renderer, camera: Camera, pose: Pose, distortion: float) -> NDArray[np.bool_]:
    """Returns (H, W) what a lens with a radial distortion (k1) shows of the city."""
    if distortion == 0.0:
        return renderer.render(camera, pose)
    margin = round(0.15 * camera.width)
    wide = camera.with_margins(margin, margin)
    clean = renderer.render(wide, pose)
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels, lens = np.stack([u.ravel(), v.ravel()], axis=1), np.array([distortion, 0.0, 0.0, 0.0])
    straight = cv2.undistortPoints(pixels[:, None], camera.matrix, lens, P=camera.matrix)[:, 0]
    columns = np.clip(np.floor(straight[:, 0]).astype(int) + margin, 0, wide.width - 1)
    rows = np.clip(np.floor(straight[:, 1]).astype(int) + margin, 0, wide.height - 1)
    return np.asarray(clean[rows, columns].reshape(camera.height, camera.width))


def _write_map(params: FlightsParams, level: OpenCity, folder: Path) -> None:
    generator = random_stream(params.flights_seed, "flights", "map")
    wrong, changed = change_map(level.scene, params.map_errors(), generator)
    store_city(replace(level, scene=wrong), folder / _MAP_FOLDER, survives_power_cut=False)
    write_text(folder / MAP_TRUTH_FILE, json.dumps(changed, indent=1, sort_keys=True) + "\n", False)


Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SensorErrors:
    """Half widths of uniform errors, either a flight's or a photo's own."""

    horizontal_m: float  # east and north, metres
    height_m: float  # up, metres
    tilt_deg: float  # pitch and roll, degrees
    yaw_deg: float  # yaw, degrees

    def draw(self, generator: np.random.Generator) -> Floats:
        """Returns (6,) errors of x, y, z (metres), pitch, roll and yaw (degrees)."""
        place = (self.horizontal_m, self.horizontal_m, self.height_m)
        widths = np.array([*place, self.tilt_deg, self.tilt_deg, self.yaw_deg])
        return np.asarray(generator.uniform(-1.0, 1.0, size=6) * widths)


def moved(pose: Pose, error: Floats) -> Pose:
    """Returns a pose whose centre and angles are off by (6,) metres and degrees."""
    angles = np.array(pose.euler) + error[3:]
    return Pose.from_euler(EulerAngles(*map(float, angles)), pose.center + error[:3])


# By how much heights are changed, metres, and how high a building stays at least.
_CHANGE_M, _LOWEST_M = (1.5, 5.0), 2.5
# How far from its original a building that is too many is put, metres, and how often a place is looked for.
_AWAY_M, _TRIES = (25.0, 80.0), 50


@dataclass(frozen=True, slots=True)
class MapErrors:
    """Which share of the map's buildings is wrong; no building is wrong in two ways."""

    heights: float = 0.0  # share whose height is changed by 1.5 to 5 m
    missing: float = 0.0  # share that the map lacks
    extra: float = 0.0  # share that the map has twice, once where there is nothing

    def __bool__(self) -> bool:
        return self.heights + self.missing + self.extra > 0


def change_map(
    scene: Scene, errors: MapErrors, generator: np.random.Generator
) -> tuple[Scene, dict[str, Any]]:
    """Returns a scene that is wrong, and how.

    Returns:
        The scene; and ``heights`` (metres that a building is higher in the map than it was, by id),
        ``missing`` and ``extra`` (ids).
    """
    boxes = building_boxes(scene)
    order = boxes.building[generator.permutation(len(boxes.building))]
    counts = [round(share * len(order)) for share in (errors.heights, errors.missing, errors.extra)]
    other_height, gone, twice = np.split(order, np.cumsum(counts))[:3]
    vertices = scene.vertices.astype(np.float64)
    heights = {}
    for building in other_height:
        part = slice(scene.vertex_starts[building], scene.vertex_starts[building + 1])
        heights[scene.building_ids[building]] = _raise(vertices[part], generator)
    ids, missing = scene.building_ids, set(gone.tolist())
    kept = [(ids[b], b, np.zeros(3)) for b in range(scene.num_buildings) if b not in missing]
    places = [(b, _free_place(boxes, b, generator)) for b in twice.tolist()]
    extra = [(f"{ids[b]}-extra", b, shift) for b, shift in places if shift is not None]
    stated = {"missing": sorted(ids[b] for b in missing), "extra": sorted(name for name, *_ in extra)}
    return _assembled(scene, vertices, [*kept, *extra]), {"heights": heights, **stated}


def _raise(points: NDArray[np.float64], generator: np.random.Generator) -> float:
    """Makes a building's points, (V, 3), higher or lower in place; returns by how many metres."""
    floor = points[:, 2].min()
    rise = points[:, 2].max() - floor
    change = float(generator.uniform(*_CHANGE_M)) * (1.0 if generator.random() < 0.5 else -1.0)
    change = -change if rise + change < _LOWEST_M else change
    points[:, 2] = floor + (points[:, 2] - floor) * (1.0 + change / max(rise, 1e-6))
    return change


def _free_place(
    boxes: BuildingBoxes, building: int, generator: np.random.Generator
) -> NDArray[np.float64] | None:
    """Returns (3,) metres to a place nearby where a building stands on no other; None if none is found."""
    row = int(np.flatnonzero(boxes.building == building)[0])
    for _ in range(_TRIES):
        angle, away = generator.uniform(0.0, 2.0 * np.pi), generator.uniform(*_AWAY_M)
        shift = np.array([away * np.cos(angle), away * np.sin(angle), 0.0])
        low, high = boxes.low[row] + shift, boxes.high[row] + shift
        overlaps = (boxes.low[:, :2] < high[:2]).all(axis=1) & (boxes.high[:, :2] > low[:2]).all(axis=1)
        if not overlaps.any():
            return shift
    return None


def _assembled(
    scene: Scene, vertices: NDArray[np.float64], parts: list[tuple[str, int, NDArray[np.float64]]]
) -> Scene:
    corners, owners = [], []
    for number, (_, building, shift) in enumerate(parts):
        faces = scene.triangles[scene.triangle_starts[building] : scene.triangle_starts[building + 1]]
        corners.append(vertices[faces].reshape(-1, 3) + shift)
        owners.append(np.full(len(faces), number))
    points = np.concatenate(corners)
    return build_scene(
        points,
        np.arange(len(points)).reshape(-1, 3),
        np.concatenate(owners),
        tuple(name for name, _, _ in parts),
        lod=scene.lod,
        crs=scene.crs,
        origin=scene.origin,
        pitched=None if scene.pitched is None else scene.pitched[[building for _, building, _ in parts]],
    )
