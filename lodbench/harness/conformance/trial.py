"""What parts and methods are tried on: a few blocks, photos of them, queries; and how rules are looked at."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.extrude import scene_of_blocks
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.textured_map import TexturedMesh
from lodbench.datasets.inputs import Input, declared_inputs, masks_of_labels
from lodbench.datasets.query import Dataset, Entry, Query, Reference
from lodbench.errors import STOPPED, LodbenchError, QueryFault
from lodbench.findings import FAULT, OK, Check, fault_of
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.geometry.similarity import Similarity
from lodbench.methods.localize import localize_flight, localize_query
from lodbench.methods.protocol import Estimate, Method, Streams, SupportsFlights, SupportsPrepare, Workspace
from lodbench.rendering import LayerRenderer, open_renderer
from lodbench.storage import random_stream

# No multiple of 64 wide: packed rows end within a word.
CAMERA = Camera(310, 230, 231.0, 229.0, 156.5, 113.0)
Rules = Sequence[tuple[str, Callable[[], str]]]
# West, south, east, north, base, top, metres: nothing repeats, so that every pose is unique.
_BLOCKS = (
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
_QUERY_CAMERA = Camera(320, 240, 231.0, 229.0, 161.5, 118.0)
# Pitch, roll, yaw (degrees) and x, y, z (metres) of the cameras; the priors are off by a fixed step.
_TRUTHS = (
    (22.0, 0.4, -70.0, 4.0, 9.0, 121.0),
    (31.0, -0.3, 25.0, -11.0, 3.0, 128.0),
    (26.0, 0.2, 140.0, 8.0, -10.0, 133.0),
)
_REFERENCES = (
    (24.0, 0.0, -60.0, 9.0, 5.0, 124.0),
    (28.0, 0.0, 30.0, -6.0, -2.0, 126.0),
    (25.0, 0.0, 150.0, 3.0, -4.0, 130.0),
)
_PRIOR_OFF_M, _PRIOR_OFF_YAW_DEG = np.array([5.0, -4.0, 6.0]), 3.0
# The frame of the queries' reconstruction, for a method that requires one.
_RECONSTRUCTION = Similarity(
    0.04, np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.full(3, 7.0)
)
# Of the textured map: side of a speckled square, metres, and how far the ground reaches.
_SPECKLES_M, _GROUND_M = 25.0, 160.0


class Violation(Exception):
    """A rule is not kept."""

    def __init__(self, detail: str, hint: str = "") -> None:
        super().__init__(detail)
        self.hint = hint


@dataclass(frozen=True, slots=True, eq=False)
class Tried:
    """A plug-in, and what it is tried on."""

    part: Any  # the class or function of its entry point
    name: str  # its name
    # Its section of the configuration; empty for kinds that have none, None where there is none.
    config: Mapping[str, Any] | None
    make: Callable[[], Any]  # makes it anew from that, for kinds that are made from parameters
    folder: Path  # an empty folder
    scene: Scene  # the blocks
    dataset: Dataset  # photos, masks, priors and truth; the scene's frame is the dataset's
    sample: Path | None  # a file that the user named, for readers of formats

    @property
    def entries(self) -> tuple[Entry, ...]:
        """Returns the queries."""
        return self.dataset.entries

    @property
    def truths(self) -> list[Pose]:
        """Returns the true poses, in the queries' order."""
        return [self.dataset.truth[entry.key] for entry in self.entries]


class Rule(NamedTuple):
    """A rule of a protocol."""

    title: str  # what it is called
    check: Callable[[], str]  # returns how it is kept, or raises a violation
    needs: str = ""  # title of a rule without which it says nothing
    on_purpose: str = ""  # what to do where something else was raised on purpose
    ends: bool = False  # whether nothing is to be said of the others where it is violated


def check_rules(rules: Iterable[Rule], section: str = "answers") -> Iterator[Check]:
    """Yields how each rule is kept, but for those that need one that is not."""
    broken = set()
    for rule in rules:
        if rule.needs in broken:
            continue
        try:
            check = Check(section, rule.title, OK, rule.check())
        except Violation as violation:
            check = Check(section, rule.title, FAULT, str(violation), violation.hint)
        except STOPPED:
            raise
        except BaseException as error:  # a plug-in may raise anything: that is the finding
            check = fault_of(error, section, rule.title, rule.on_purpose)
        yield check
        if check.status != OK:
            if rule.ends:
                return
            broken.add(rule.title)


def check_in_order(rules: Rules) -> Iterator[Check]:
    """Yields how each rule is kept, up to the first that is not: the others build on it."""
    return check_rules(Rule(*rule, ends=True) for rule in rules)


def require(is_kept: bool | np.bool_, detail: str, hint: str = "") -> None:
    """Raises a violation unless a rule is kept."""
    if not is_kept:
        raise Violation(detail, hint)


def refuses(call: Callable[[], object], what: str) -> str:
    """Returns how something wrong is refused: by lodbench's own kind of error, in a line for people.

    Raises:
        Violation: It is not, or by another error.
    """
    try:
        call()
    except LodbenchError as error:
        return f"{type(error).__name__}: {error.message}"
    except STOPPED:
        raise
    except BaseException as error:  # anything else ends a run with a traceback
        raise Violation(
            f"{what} raises {type(error).__name__}: {error}", "Raise an error of lodbench.errors."
        ) from error
    raise Violation(f"{what} is taken without a word", "Raise an error of lodbench.errors.")


def trial_dataset(folder: Path) -> tuple[Scene, Dataset]:
    """Returns the blocks, and a dataset of three views; photos and masks are written to a folder."""
    scene = scene_of_blocks(_BLOCKS)
    painter = cast("LayerRenderer", open_renderer("raster", scene, 1))
    entries, truth = [], {}
    for k, (pose, prior) in enumerate(_truths_and_priors()):
        photo, mask = folder / f"view_{k}.png", folder / f"mask_{k}.png"
        cv2.imwrite(str(photo), painter.draw(CAMERA, pose).colour[:, :, ::-1])
        cv2.imwrite(str(mask), painter.render(CAMERA, pose).astype(np.uint8) * 255)
        entries.append(Entry(photo.name, "trial", CAMERA, prior, photo, mask, (prior,)))
        truth[entries[-1].key] = pose
    return scene, Dataset("trial", "", folder, None, None, ("trial",), tuple(entries), truth)


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A map, and queries with exact masks."""

    city_map: CityMap  # the map, on one thread
    queries: tuple[Query, ...]  # each with a photo
    truths: tuple[Pose, ...]  # their true poses, scene frame; no method sees them
    references: tuple[Reference, ...]  # pictures of the place
    folder: Path  # for what methods prepare

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
        return {name: answer for name, answer in self.by_name.items() if isinstance(answer, Estimate)}


def make_trial(folder: Path, method: object) -> Trial:
    """Returns the trial of a method; its pictures are written to a folder.

    A query has a mask only for a method that requires one; so has the map its textures, which photos then
    show in another light.
    """
    scene = scene_of_blocks(_BLOCKS, _ORIGIN)
    requires = declared_inputs(method, "requires", {Input.MASK})
    is_textured = Input.TEXTURED_MAP in requires
    city_map = CityMap(scene, threads=1, textured=_speckled(scene) if is_textured else None)
    painter = cast("LayerRenderer", open_renderer("raster", scene, 1))
    has_mask = Input.MASK in requires

    def picture(name: str, pose: Pose) -> Path:
        if is_textured:
            colour = city_map.colour(_QUERY_CAMERA, pose.rotation[None], pose.center[None])[0]
            colour = (0.7 * colour + 12).astype(np.uint8)
        else:
            colour = painter.draw(_QUERY_CAMERA, pose).colour
        cv2.imwrite(str(folder / name), colour[:, :, ::-1])
        return folder / name

    queries, truths = [], []
    for k, (truth, prior) in enumerate(_truths_and_priors()):
        photo = picture(f"view_{k}.png", truth)
        mask = _silhouette(city_map, truth) if has_mask else None
        instances = _instances(city_map, truth) if Input.INSTANCES in requires else None
        query = Query(photo.name, "trial", _QUERY_CAMERA, prior, mask, photo, (prior,), instances=instances)
        if Input.CLASSES in requires:
            (classes,) = city_map.classes(_QUERY_CAMERA, truth.rotation[None], truth.center[None])
            query = replace(query, classes=classes)
        if Input.MASK_ON_DEMAND in requires:
            query = replace(query, segment=partial(_silhouette, city_map, truth))
        if Input.RECONSTRUCTION in requires:
            query = replace(query, sequence="trial", reconstructed=_RECONSTRUCTION.pose(truth))
        if Input.TRUE_PIXELS in requires:
            query = replace(query, true_pixels=partial(_pixels, truth))
        queries.append(query)
        truths.append(truth)
    references = []
    for k, (pitch, roll, yaw, *center) in enumerate(_REFERENCES):
        pose = Pose.from_euler(EulerAngles(pitch, roll, yaw), center)
        name = f"reference_{k}.png"
        references.append(Reference(name, picture(name, pose), _QUERY_CAMERA, pose))
    return Trial(city_map, tuple(queries), tuple(truths), tuple(references), folder)


def _truths_and_priors() -> Iterator[tuple[Pose, Pose]]:
    for pitch, roll, yaw, *center in _TRUTHS:
        truth = Pose.from_euler(EulerAngles(pitch, roll, yaw), center)
        angles = EulerAngles(pitch, roll, yaw + _PRIOR_OFF_YAW_DEG)
        yield truth, Pose.from_euler(angles, truth.center + _PRIOR_OFF_M)


def _silhouette(city_map: CityMap, pose: Pose, _guide: Pose | None = None) -> NDArray[np.float32]:
    return np.asarray(city_map.render(_QUERY_CAMERA, pose), dtype=np.float32)


def _instances(city_map: CityMap, pose: Pose) -> NDArray[np.bool_]:
    (visible,) = city_map.buildings(_QUERY_CAMERA, pose.rotation[None], pose.center[None])
    return masks_of_labels(visible + 1)


def _pixels(pose: Pose, points: NDArray[np.float64]) -> NDArray[np.float64]:
    return _QUERY_CAMERA.project((points - pose.center) @ pose.rotation.T)


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

    One that requires a reconstruction is given the others of the trial with it: their flight.

    Raises:
        Exception: Whatever the method raises that is no ``QueryFault``.
    """
    mask = None if query.building_probability is None else query.building_probability.copy()
    query = replace(query, building_probability=mask)
    if query.reconstructed is not None and isinstance(method, SupportsFlights):
        flight = [query if each.name == query.name else each for each in trial.queries]
        streams = [streams_of(each, seed) for each in flight]
        found = localize_flight(method, flight, trial.city_map, streams).estimates
        return found[flight.index(query)]
    try:
        return localize_query(method, query, trial.city_map, streams_of(query, seed))
    except QueryFault as fault:
        return fault


class Killed(Exception):
    """Stands for the end of a process in the middle of a part."""


class WatchedWorkspace(Workspace):
    """A workspace that notes which parts were requested, and which were made.

    Its process ends within the part of number ``ends_at``, counted from 0, if that is given.
    """

    def __init__(self, folder: Path, ends_at: int | None = None) -> None:
        super().__init__(folder)
        self._ends_at = ends_at
        self.requested: list[str] = []
        self.made: list[str] = []

    def part(self, name: str, make: Callable[[Path], None]) -> Path:
        """Returns a part, and notes it; does not come back from the last one."""

        def half(path: Path) -> None:
            make(path)
            raise Killed

        is_last = self._ends_at is not None and len(self.requested) >= self._ends_at
        self.requested.append(name)
        if not (self.folder / name).exists():
            self.made.append(name)
        return super().part(name, half if is_last else make)
