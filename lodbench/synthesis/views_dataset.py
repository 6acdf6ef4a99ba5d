"""``dataset=views``: seeded drone views of any city, each with masks as wrong as a network's.

Drawn once and written to the cache in the text layout, so that every command that takes a dataset can run
on a city that has no photos. `lodbench bench accuracy` and its kin are runs of it. With a look each view
has a drawn photo too.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.cache import open_cached_city
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError, DatasetError, require_numbers, require_within
from lodbench.geometry import Camera, Pose
from lodbench.geometry.camera import CALIBRATED, MAKER, UNKNOWN, pixel_rays
from lodbench.params import to_params
from lodbench.photos.measurements import Measurements
from lodbench.photos.xmp import LaserRange
from lodbench.rendering import Renderer, make_renderer
from lodbench.rendering.raster import RasterRenderer
from lodbench.rendering.surfaces import Surfaces
from lodbench.storage import digest_of, random_stream, write_text
from lodbench.storage.paths import cache_root
from lodbench.synthesis.mask_degradation import degrade_mask, degraded_instances
from lodbench.synthesis.views import (
    FINE_SIZE,
    PHOTO_SIZE,
    RGB_CAMERA,
    Photographer,
    SyntheticQuery,
    ViewSampling,
    draw_through_lens,
    sample_views,
    write_queries,
    written_once,
)

# Raised whenever the same settings would draw something else.
VIEWS_VERSION = 1
SPLIT = "views"
# The halves of a city's bounding box: tune on one, report on the other.
AREAS = ("west", "east", "south", "north")
_FACTS_FILE = "drawn.json"
# What a building keeps of its height at least, metres.
_LEAST_RISE_M = 0.5
_WORLD_LIMITS = {"shared_roofs_m": (-50, 50), "hidden_feet_m": (0, 50), "focal": (-0.5, 0.5), "tilt": (0, 30)}
_WORLD_LIMITS |= {"center": (-0.2, 0.2), "k1": (-0.3, 0.3)}
# How well cameras are known, as a dataset states it by where their numbers come from.
CAMERA_SOURCES = {sigmas.source: sigmas for sigmas in (CALIBRATED, MAKER, UNKNOWN)}


@dataclass(frozen=True, slots=True)
class Perturbation:
    """How what is seen differs from the map that is searched and from what is reported, in all views alike.

    Raises:
        ConfigError: A value is not finite or beyond what there is.
    """

    shared_roofs_m: float = 0.0  # every building reaches so much higher than in the map; below 0 less high
    hidden_feet_m: float = 0.0  # so much of the lowest part of every wall is hidden, by hedges or cars
    # The lens is longer than stated by this share of its focal length, in every second view shorter.
    focal: float = 0.0
    tilt: float = 1.0  # pitch and roll of the priors err so many times as far as stated
    center: float = (
        0.0  # the principal point is aside by this share of the width: right, down, left, up in turn
    )
    k1: float = 0.0  # radial distortion that the stated camera does not have

    def __post_init__(self) -> None:
        for name, bounds in _WORLD_LIMITS.items():
            require_within(f"world.{name}", getattr(self, name), *bounds)

    @classmethod
    def parse(cls, text: str) -> Perturbation:
        """Returns the world of ``NAME=VALUE,NAME=VALUE``; the unit ``_m`` may be left out of a name.

        Raises:
            ConfigError: A name is not known or a value is no number.
        """
        known = {field.name.removesuffix("_m"): field.name for field in fields(cls)}
        parts = [part.partition("=") for part in text.split(",") if part]
        values = {known.get(name.strip(), name.strip()): value for name, _, value in parts}
        return to_params(values, cls, "world")

    def describe(self) -> str:
        """Returns in words what is wrong, or "" where nothing is."""
        wrong = [f for f in fields(self) if getattr(self, f.name) != f.default]
        return ", ".join(f"{f.name}={getattr(self, f.name):g}" for f in wrong)

    def perturbed(self, scene: Scene) -> Scene:
        """Returns what is seen of a city: its roofs as high as they are, without the feet that are hidden."""
        if not (self.shared_roofs_m or self.hidden_feet_m):
            return scene
        vertices = np.array(scene.vertices)
        for first, last in pairwise(scene.vertex_starts):
            heights = vertices[first:last, 2]
            if len(heights) == 0 or heights.max() == heights.min():
                continue
            floor, rise = heights.min(), heights.max() - heights.min()
            stretch = max(rise + self.shared_roofs_m, min(rise, _LEAST_RISE_M)) / rise
            raised = floor + stretch * (heights - floor)
            vertices[first:last, 2] = np.maximum(raised, floor + self.hidden_feet_m)
        return replace(scene, vertices=vertices, stored_digest="")

    def lens(self, camera: Camera, view: int) -> Camera:
        """Returns the camera that takes the view of a number, given the one that is stated."""
        stretch = 1.0 + (self.focal if view % 2 == 0 else -self.focal)
        right, down = ((1, 0), (0, 1), (-1, 0), (0, -1))[view % 4]
        aside_px = self.center * camera.width
        return replace(
            camera,
            fx=stretch * camera.fx,
            fy=stretch * camera.fy,
            cx=camera.cx + right * aside_px,
            cy=camera.cy + down * aside_px,
            distortion=(self.k1, 0.0, 0.0, 0.0) if self.k1 else camera.distortion,
        )


@dataclass(frozen=True, slots=True)
class ViewsParams:
    """Settings of ``dataset=views``; described in ``conf/dataset/views.yaml``."""

    city_model: str
    num_views: int = 100
    mask_iou: float = 0.88
    tilt_deg: float = 1.0
    range_m: float | None = None
    height_m: float | None = None
    camera_height_m: tuple[float, float] = (100.0, 160.0)
    building_share: tuple[float, float] = (0.1, 0.8)
    area: str | None = None
    views_seed: int = 0
    look: str | None = None
    lod: str | None = None
    mask_lod: str | None = None
    crs: str | None = None
    roof_height: str | None = None
    name: str = "views"
    layers: list[str] = field(default_factory=list)
    world: Perturbation = field(default_factory=Perturbation)
    camera_source: str = CALIBRATED.source
    rtk_m: float | None = None
    laser_m: float | None = None

    def __post_init__(self) -> None:
        if self.num_views < 1:
            raise ConfigError(f"`dataset.num_views={self.num_views}` is not a number of views.")
        if self.camera_source not in CAMERA_SOURCES:
            known = ", ".join(CAMERA_SOURCES)
            raise ConfigError(f"dataset.camera_source is one of {known}, not {self.camera_source}.")
        require_within("dataset.mask_iou", self.mask_iou, 0, 1, "(]")
        require_within("dataset.tilt_deg", self.tilt_deg, 0, 30)
        require_numbers(self, "dataset", ("range_m", "height_m"), 0)
        require_numbers(self, "dataset", ("rtk_m", "laser_m"), 0, ends="(]")
        if self.area is not None and self.area not in AREAS:
            raise ConfigError(f"dataset.area is one of {', '.join(AREAS)}, not {self.area}.")
        for name, most in (("camera_height_m", 1e5), ("building_share", 1)):
            low, high = getattr(self, name)
            require_within(f"dataset.{name}", low, 0, most)
            require_within(f"dataset.{name}", high, low, most)

    def prior(self, tilt: str = "prior") -> UniformPrior:
        """Returns what is stated of the priors' errors: the published ones, with this tilt and range.

        With a tilt of ``truth`` that has no error.
        """
        tilt_deg = self.tilt_deg if tilt == "prior" else 0.0
        prior = UniformPrior(pitch_deg=tilt_deg, roll_deg=tilt_deg)
        if self.range_m is not None:
            prior = replace(prior, x_m=self.range_m, y_m=self.range_m, z_m=self.range_m)
        return prior if self.height_m is None else replace(prior, z_m=self.height_m)


def draw_queries(scene: Scene, renderer: Renderer, params: ViewsParams) -> tuple[list[SyntheticQuery], int]:
    """Returns the queries of a city, and how many draws of views were rejected.

    Query i depends on the seed, the area and i only: asking for more keeps the first ones.

    Raises:
        DatasetError: No views can be drawn over the city.
    """
    camera = RGB_CAMERA.scaled(*FINE_SIZE)
    seed = params.views_seed
    heights_m, share = params.camera_height_m, params.building_share
    area_m = _area_m(scene, params.area)
    sampling = ViewSampling(heights_m, building_share=share, area_m=area_m, seed=seed)
    views = sample_views(scene, renderer, camera, sampling, params.num_views, "accuracy")
    world, noted = params.world, params.prior()
    perturbed = world.perturbed(scene)
    photographed = renderer if perturbed is scene else make_renderer("silhouette", perturbed, None)
    raster = RasterRenderer(perturbed)
    prior = replace(noted, pitch_deg=world.tilt * noted.pitch_deg, roll_deg=world.tilt * noted.roll_deg)
    queries = []
    for index, truth in enumerate(views.poses):
        name = f"view_{index:04d}"
        lens = world.lens(camera, index)
        clean = draw_through_lens(partial(_silhouette, photographed, truth), lens)
        rough, iou = degrade_mask(clean, params.mask_iou, random_stream(seed, "accuracy", name, "mask"))
        start = prior.draw(truth, random_stream(seed, "accuracy", name, "prior"))
        buildings = draw_through_lens(partial(_instances, raster, truth), lens)
        instances = degraded_instances(buildings, rough, random_stream(seed, "accuracy", name, "instances"))
        queries.append(SyntheticQuery(name, truth, start, rough, iou, instances=instances))
    return queries, views.rejections


def _silhouette(renderer: Renderer, pose: Pose, camera: Camera) -> NDArray[Any]:
    return renderer.render(camera, pose)


def _instances(renderer: RasterRenderer, pose: Pose, camera: Camera) -> NDArray[Any]:
    return np.asarray(renderer.buildings(camera, pose.rotation[None], pose.center[None])[0])


def open_views(params: ViewsParams) -> Dataset:
    """Returns the dataset of seeded views of a city; draws them first if the cache does not hold them.

    Raises:
        LodbenchError: The city cannot be read, no views can be drawn over it, or the look is unknown.
    """
    city = Path(params.city_model).expanduser()
    if not city.exists():
        raise DatasetError(f"The city model {city} does not exist.", "Set `city=FILE`.")
    options = ReadOptions(crs=params.crs, layers=tuple(params.layers))
    lod = params.mask_lod or params.lod
    scene = open_cached_city(city, lod=lod, options=options, roof_height=params.roof_height).scene
    of_the_scene = ("city_model", "lod", "crs", "name", "layers")  # its digest says it
    drawn = {key: value for key, value in asdict(params).items() if key not in of_the_scene}
    for name in ("camera_source", "rtk_m", "laser_m"):  # stated, not drawn
        del drawn[name]
    # Errors that came later: views without them keep their place in the cache.
    drawn["world"] = {
        name: value for name, value in drawn["world"].items() if name not in ("center", "k1") or value
    }
    world = params.world
    # Photos once showed the map's world, whatever was stated.
    shown = ["shown"] if params.look is not None and world.describe() else []
    key = digest_of([VIEWS_VERSION, "instances", drawn, scene.digest(), scene.origin.tolist(), *shown])

    def write(folder: Path) -> None:
        queries, rejections = draw_queries(scene, make_renderer("silhouette", scene, None), params)
        camera = RGB_CAMERA
        if params.look is not None:
            camera = RGB_CAMERA.scaled(*PHOTO_SIZE)
            cameras = [world.lens(camera, index) for index in range(len(queries))]
            photographer = Photographer(world.perturbed(scene), params.look, params.views_seed)
            queries = photographer.views(queries, cameras)
        write_queries(folder / SPLIT, queries, camera, scene.origin)
        write_text(folder / _FACTS_FILE, json.dumps({"rejections": rejections, "mask_lod": scene.lod}))

    root = written_once(cache_root() / "views" / key, write)
    same = {key: getattr(params, key) for key in ("lod", "crs", "roof_height", "name", "layers")}
    folder = open_folder(FolderParams(str(root), str(city), **same))
    if params.rtk_m is not None or params.laser_m is not None:
        folder = _with_measurements(folder, world.perturbed(scene), params)
    look = "" if params.look is None else f", look {params.look}"
    sigmas = CAMERA_SOURCES[params.camera_source]
    if not sigmas.are_zero:
        folder = replace(
            folder, entries=tuple(replace(entry, camera_sigmas=sigmas) for entry in folder.entries)
        )
    return replace(folder, version=f"views {VIEWS_VERSION}{look}, seed {params.views_seed}")


def _with_measurements(dataset: Dataset, perturbed: Scene, params: ViewsParams) -> Dataset:
    """Returns views with what a receiver and a laser measure there, with errors of the stated deviations.

    Priors are where the receiver has them; no range is measured where the photo's centre shows no surface.
    """
    surfaces, entries = Surfaces(perturbed), []
    for entry in dataset.entries:
        truth, prior, camera, measured = dataset.truth[entry.key], entry.prior, entry.camera, Measurements()
        assert prior is not None  # noqa: S101 - all views have one
        assert camera is not None  # noqa: S101 - likewise
        noise = random_stream(params.views_seed, "accuracy", Path(entry.name).stem, "measurements")
        errors = noise.standard_normal(4)
        if params.rtk_m is not None:
            prior = Pose.from_center(prior.rotation, truth.center + params.rtk_m * errors[:3])
            measured = Measurements((*(params.rtk_m,) * 3, None, None, None))
        if params.laser_m is not None:
            local, middle = truth.shifted(-perturbed.origin), 0.5 * np.array([[camera.width, camera.height]])
            ray = pixel_rays(camera, middle).directions @ local.rotation
            way = surfaces.hit(local.center, ray).places[0] - local.center
            range_m = float(np.linalg.norm(way)) + params.laser_m * float(errors[3])
            if range_m > 0:  # NaN where the centre shows no surface
                measured = replace(measured, laser=LaserRange(range_m, stated_sigma_m=params.laser_m))
        entries.append(replace(entry.with_prior(prior, (prior,)), measured=measured))
    return replace(dataset, entries=tuple(entries))


def drawing_facts(dataset: Dataset) -> dict[str, Any]:
    """Returns of a dataset of views how many draws were rejected, and the level of detail of its masks.

    ``rejections`` were draws with too few or too many buildings, or among them.
    """
    facts: dict[str, Any] = json.loads((dataset.root / _FACTS_FILE).read_text(encoding="utf-8"))
    return facts


def _area_m(scene: Scene, area: str | None) -> tuple[float, float, float, float] | None:
    """Returns the bounds (west, south, east, north) of an area in a scene, metres; None for all."""
    if area is None:
        return None
    (west, south), (east, north) = (corner[:2].astype(float).tolist() for corner in scene.extent_m)
    x, y = 0.5 * (west + east), 0.5 * (south + north)
    return {
        "west": (west, south, x, north),
        "east": (x, south, east, north),
        "south": (west, south, east, y),
        "north": (west, y, east, north),
    }[area]
