"""The trial that a method is put to: a few blocks, queries that look at them, and pictures of the place."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.extrude import scene_of_blocks
from lodbench.citymodel.mesh.textured import TexturedMesh
from lodbench.citymodel.scene import Scene
from lodbench.datasets.inputs import Input, declared_inputs, masks_of_labels
from lodbench.datasets.query import Query, Reference
from lodbench.errors import QueryFault
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.methods.localize import localize_query
from lodbench.methods.protocol import Estimate, Method, Streams, SupportsPrepare, Workspace
from lodbench.rendering import LayerRenderer, open_renderer
from lodbench.storage import random_stream

# West, south, east, north, base, top, metres: nothing repeats, so that every pose is unique.
BLOCKS = (
    (-72.0, -48.0, -40.0, -12.0, 0.0, 16.0),
    (-14.0, -60.0, 10.0, -44.0, 1.0, 33.0),
    (34.0, -38.0, 66.0, -2.0, 0.0, 11.0),
    (-50.0, 8.0, -31.0, 56.0, 0.0, 22.0),
    (-4.0, 2.0, 20.0, 27.0, 2.0, 38.0),
    (38.0, 24.0, 60.0, 70.0, 0.0, 14.0),
    (-76.0, 66.0, -12.0, 82.0, 1.0, 8.0),
)
# Far from zero, as map coordinates are: an answer in another frame than the query's shows at once.
_ORIGIN = np.array([281_000.0, 5_657_000.0, 60.0])
_CAMERA = Camera(320, 240, 231.0, 229.0, 161.5, 118.0)
# Pitch, roll, yaw (degrees) and x, y, z (metres) of the cameras; the priors are off by a fixed step.
TRUTHS = (
    (22.0, 0.4, -70.0, 4.0, 9.0, 121.0),
    (31.0, -0.3, 25.0, -11.0, 3.0, 128.0),
    (26.0, 0.2, 140.0, 8.0, -10.0, 133.0),
)
_REFERENCES = (
    (24.0, 0.0, -60.0, 9.0, 5.0, 124.0),
    (28.0, 0.0, 30.0, -6.0, -2.0, 126.0),
    (25.0, 0.0, 150.0, 3.0, -4.0, 130.0),
)
_PRIOR_OFF = (5.0, -4.0, 6.0)
_PRIOR_OFF_YAW_DEG = 3.0
# Of the textured map: side of a speckled square, metres, and how far the ground reaches.
_SPECKLES_M, _GROUND_M = 25.0, 160.0


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A map, and queries with exact masks.

    Attributes:
        city_map: The map, on one thread.
        queries: Each with a photo.
        truths: Their true poses, scene frame; no method sees them.
        references: Pictures of the place.
        folder: For what methods prepare.
    """

    city_map: CityMap
    queries: tuple[Query, ...]
    truths: tuple[Pose, ...]
    references: tuple[Reference, ...]
    folder: Path

    def prepared(self, method: Method) -> Method:
        """Returns a method that has prepared, if it does."""
        if isinstance(method, SupportsPrepare):
            method.prepare(self.city_map, self.references, Workspace(self.folder / "workspace"))
        return method


@dataclass(frozen=True, slots=True, eq=False)
class TrialAnswers:
    """What a method answered in the trial."""

    trial: Trial
    by_name: dict[str, Estimate | QueryFault] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def estimates(self) -> dict[str, Estimate]:
        """Returns the answers that are one."""
        return {name: found for name, found in self.by_name.items() if isinstance(found, Estimate)}


def make_trial(folder: Path, method: object) -> Trial:
    """Returns the trial of a method; its pictures are written to a folder.

    A query has a mask only for a method that requires one; so has the map its textures, which photos then
    show in another light.
    """
    scene = scene_of_blocks(BLOCKS, _ORIGIN)
    requires = declared_inputs(method, "requires", {Input.MASK})
    is_textured = Input.TEXTURED_MAP in requires
    city_map = CityMap(scene, threads=1, textured=_speckled(scene) if is_textured else None)
    painter = cast("LayerRenderer", open_renderer("raster", scene, 1))
    has_mask = Input.MASK in requires

    def picture(name: str, pose: Pose) -> Path:
        if is_textured:
            seen = city_map.colour(_CAMERA, pose.rotation[None], pose.center[None])[0]
            seen = (0.7 * seen + 12).astype(np.uint8)
        else:
            seen = painter.draw(_CAMERA, pose).colour
        cv2.imwrite(str(folder / name), seen[:, :, ::-1])
        return folder / name

    queries, truths = [], []
    for k, (pitch, roll, yaw, *center) in enumerate(TRUTHS):
        truth = Pose.from_euler(EulerAngles(pitch, roll, yaw), center)
        angles = EulerAngles(pitch, roll, yaw + _PRIOR_OFF_YAW_DEG)
        prior = Pose.from_euler(angles, truth.center + np.array(_PRIOR_OFF))
        photo = picture(f"view_{k}.png", truth)
        mask = _silhouette(city_map, truth) if has_mask else None
        instances = _instances(city_map, truth) if Input.INSTANCES in requires else None
        query = Query(photo.name, "trial", _CAMERA, prior, mask, photo, (prior,), instances=instances)
        if Input.CLASSES in requires:
            (classes,) = city_map.classes(_CAMERA, truth.rotation[None], truth.center[None])
            query = replace(query, classes=classes)
        if Input.MASK_ON_DEMAND in requires:
            query = replace(query, segment=partial(_silhouette, city_map, truth))
        if Input.TRUE_PIXELS in requires:
            query = replace(query, true_pixels=partial(_pixels, truth))
        queries.append(query)
        truths.append(truth)
    references = []
    for k, (pitch, roll, yaw, *center) in enumerate(_REFERENCES):
        pose = Pose.from_euler(EulerAngles(pitch, roll, yaw), center)
        name = f"reference_{k}.png"
        references.append(Reference(name, picture(name, pose), _CAMERA, pose))
    return Trial(city_map, tuple(queries), tuple(truths), tuple(references), folder)


def _silhouette(city_map: CityMap, pose: Pose, _guide: Pose | None = None) -> NDArray[np.float32]:
    """Returns the (H, W) mask that the truth has."""
    return np.asarray(city_map.render(_CAMERA, pose), dtype=np.float32)


def _instances(city_map: CityMap, pose: Pose) -> NDArray[np.bool_]:
    """Returns the (N, H, W) masks of what is seen of each block."""
    (seen,) = city_map.buildings(_CAMERA, pose.rotation[None], pose.center[None])
    return masks_of_labels(seen + 1)


def _pixels(pose: Pose, points: NDArray[np.float64]) -> NDArray[np.float64]:
    return _CAMERA.project((points - pose.center) @ pose.rotation.T)


def _speckled(scene: Scene) -> TexturedMesh:
    """Returns the blocks and level ground with a picture of speckles on all of them."""
    far = _GROUND_M
    a, b, c, d = (-far, -far, 0.0), (far, -far, 0.0), (far, far, 0.0), (-far, far, 0.0)
    ground = np.array([(a, b, c), (a, c, d)])
    corners = np.concatenate([scene.vertices[scene.triangles].astype(np.float64), ground])
    noise = random_stream(0, "trial", "speckles").normal(size=(256, 256, 3))
    speckles = cv2.GaussianBlur(noise, (0, 0), 2.2)
    picture = np.clip(128 + 450 * speckles, 0, 255).astype(np.uint8)
    uv = np.stack([corners @ (1.0, 0.2, 0.3), corners @ (0.1, 1.0, -0.9)], axis=-1) / _SPECKLES_M
    count = len(corners)
    blank = np.zeros((count, 3, 3), np.uint8)
    return TexturedMesh(corners, uv, np.zeros(count, np.int32), blank, (picture,))


def streams_of(query: Query, seed: int = 0) -> Streams:
    """Returns the random streams of a query, made anew."""
    return partial(random_stream, seed, "trial", query.name)


def ask(method: Method, trial: Trial, query: Query, seed: int = 0) -> Estimate | QueryFault:
    """Returns a method's answer to a query, from streams and a mask made anew.

    Raises:
        Exception: Whatever the method raises that is no ``QueryFault``.
    """
    mask = None if query.building_probability is None else query.building_probability.copy()
    query = replace(query, building_probability=mask)
    try:
        return localize_query(method, query, trial.city_map, streams_of(query, seed))
    except QueryFault as fault:
        return fault
