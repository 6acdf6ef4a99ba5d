"""Which views are taken: those that show buildings, from free air, of one region only."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xxhash
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene, building_boxes
from lodbench.citymodel.textured_map import TexturedMesh, read_textured
from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry import Pose
from lodbench.kernels.looks import LandCover
from lodbench.photos.pictures import encoded, encoded_mask
from lodbench.rendering.backends import PyrenderTextured
from lodbench.rendering.raster import RasterRenderer
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.storage import digest_of, random_stream, write_bytes
from lodbench.synthesis.camera_paths import CAMERA_PATHS, MOST_VIEWS, GenerateParams, SurveyArea
from lodbench.synthesis.land_cover import Ground
from lodbench.synthesis.objects import SceneProps
from lodbench.synthesis.photo import PhotoRenderer, apply_camera_response, draw_look, linear, photo_file

SPLITS = ("train", "val", "test")
# Views are checked on pictures this wide: a building of three pixels there has some 40 in full size.
_PREVIEW_WIDTH = 256
_CLEARANCE_M = 2.0

NO_BUILDINGS, IN_BUILDING = "too few buildings in view", "inside a building"
BELOW_GROUND, TWO_REGIONS = "below the ground", "two regions in view"


@dataclass(frozen=True, slots=True, eq=False)
class PlannedView:
    """One view to write."""

    split: str  # ``train``, ``val`` or ``test``
    name: str  # of its files, without ending
    pose: Pose  # in the scene's frame

    @property
    def key(self) -> str:
        """Returns ``split/name``, unique within a set."""
        return f"{self.split}/{self.name}"


class ViewPlan(NamedTuple):
    """What will be written."""

    views: tuple[PlannedView, ...]
    skipped: dict[str, int]
    candidates: int


def regions_of(bases: NDArray[np.float64], val_share: float, test_share: float) -> NDArray[np.int64]:
    """Returns the region of each building, 0 train, 1 validation, 2 test.

    The city is cut across its longer side into three strips that hold these shares of its buildings.
    """
    span = np.ptp(bases[:, :2], axis=0)
    along = bases[:, int(span[1] > span[0])]
    cuts = np.quantile(along, [1.0 - val_share - test_share, 1.0 - test_share])
    region = (along > cuts[0]).astype(np.int64) + (along > cuts[1])
    # A quantile of all buildings is the last one: a share of 0 leaves nobody beyond it.
    return region if val_share > 0 else np.where(region == 1, 0, region)


def plan_views(
    params: GenerateParams, scene: Scene, ground: Ground, progress: Callable[[], None] = lambda: None
) -> ViewPlan:
    """Returns the views to write; with a limit, a random choice of them.

    Raises:
        ConfigError: There are too many views to choose from.
        DatasetError: No view is left, or the file of poses cannot be read or is empty.
    """
    view_filter = _ViewFilter(params, scene, ground)
    place = SurveyArea(view_filter.boxes.bases, ground, scene.origin)
    poses = list(islice(CAMERA_PATHS[params.sampling](params, place), MOST_VIEWS + 1))
    if len(poses) > MOST_VIEWS:
        raise ConfigError(
            f"There are more than {MOST_VIEWS} views to choose from.",
            "A smaller `count=`, a larger `spacing_m=`, or fewer heights, pitches and poses make fewer.",
        )
    order = np.arange(len(poses))
    if params.limit is not None:
        order = random_stream(params.seed, "training", "choice").permutation(len(poses))
    taken: dict[int, str] = {}
    skipped: Counter[str] = Counter()
    for index in order.tolist():
        split = view_filter.split_or_reason(poses[index])
        if split in SPLITS:
            taken[index] = split
        else:
            skipped[split] += 1
        progress()
        if len(taken) == params.limit:
            break
    if not taken:
        counts = ", ".join(f"{count} {reason}" for reason, count in sorted(skipped.items()))
        raise DatasetError(
            f"None of {len(poses)} views can be taken: {counts or 'there is none'}.",
            "Other heights and pitches, a smaller min_buildings, or `val_share=0` `test_share=0` may help.",
        )
    names, used = [], Counter[str]()
    for index in sorted(taken):
        name = _name(params, scene, index, poses[index])
        used[name] += 1
        names.append(name if used[name] == 1 else f"{name}-{used[name]}")
    views = [PlannedView(taken[k], name, poses[k]) for k, name in zip(sorted(taken), names, strict=True)]
    return ViewPlan(tuple(views), dict(sorted(skipped.items())), len(poses))


class _ViewFilter:
    """Says which views are taken, of which split; its pictures are small."""

    def __init__(self, params: GenerateParams, scene: Scene, ground: Ground) -> None:
        self._params, self._ground, self.boxes = params, ground, building_boxes(scene)
        camera = params.camera
        width = min(_PREVIEW_WIDTH, camera.width)
        self._camera = camera.scaled_to_width(width)
        self._raster = RasterRenderer(scene, threads=1)
        self._region = np.zeros(scene.num_buildings, dtype=np.int64)
        self._region[self.boxes.building] = regions_of(self.boxes.bases, params.val_share, params.test_share)

    def split_or_reason(self, pose: Pose) -> str:
        """Returns the split of a view, or why it is not taken."""
        center = pose.center[None]
        if center[0, 2] < self._ground.at(center)[0] + _CLEARANCE_M:
            return BELOW_GROUND
        if not self.boxes.are_clear_of(pose.center, _CLEARANCE_M):
            return IN_BUILDING
        building = self._raster.draw(self._camera, pose).building
        shares = np.bincount(self._region[building[building >= 0]], minlength=len(SPLITS)) / building.size
        if self._params.min_buildings == 0 and not shares.any():
            nearest = np.linalg.norm(self.boxes.bases[:, :2] - pose.center[:2], axis=1).argmin()
            return SPLITS[self._region[self.boxes.building[nearest]]]
        if shares.sum() < max(self._params.min_buildings, 1.0 / building.size):
            return NO_BUILDINGS
        most = int(shares.argmax())
        return TWO_REGIONS if shares.sum() - shares[most] > self._params.overlap else SPLITS[most]


def _name(params: GenerateParams, scene: Scene, index: int, pose: Pose) -> str:
    """Returns a name for a pose: its number, or X@Y@Z@PITCH@YAW@ROLL in whole metres and degrees."""
    if params.naming == "index":
        return f"{index:06d}"
    pitch, roll, yaw = pose.euler
    # Cut, not rounded, as UAVD4L's are; a tiny negative zero is no angle.
    numbers = [*(pose.center + scene.origin), pitch, yaw, roll]
    return "@".join(str(int(value + 1e-6 * np.sign(value))) for value in numbers)


# What 16 bits hold: centimetres of depth, and buildings, for 0 is none.
_MOST = 65535
MOST_LABELS = _MOST


class PictureParts(NamedTuple):
    """What a worker draws from."""

    scene: Scene  # the city of the masks
    picture_scene: Scene  # the city as pictures show it, in the same frame
    props: SceneProps | None  # its surroundings
    cover: LandCover | None  # its land cover, or None where props say all
    # (3,) what brings the textured mesh into the scene's frame, or None without one.
    texture_offset: NDArray[np.float64] | None = None

    def cities_digest(self) -> str:
        """Returns a digest of the city as it was read, for masks and for pictures."""
        scenes = (self.scene, self.picture_scene)
        return digest_of([[scene.digest(), scene.origin.tolist()] for scene in scenes])

    def digest(self) -> str:
        """Returns a digest of every array; of a textured mesh only where it lies."""
        state = xxhash.xxh3_128(self.cities_digest().encode())
        for part in (self.props and asdict(self.props), self.cover and self.cover._asdict()):
            for name, value in (part or {}).items():
                array = np.ascontiguousarray(value)
                state.update(f"{name}{array.dtype}{array.shape}".encode() + array.tobytes())
        state.update(b"" if self.texture_offset is None else self.texture_offset.tobytes())
        return state.hexdigest()


class ViewWriter:
    """Draws and writes the files of views; a renderer is made when the first file needs it."""

    def __init__(self, params: GenerateParams, parts: PictureParts) -> None:
        self._params, self._parts, self._camera = params, parts, params.camera
        self._silhouette = SilhouetteRenderer(parts.scene, threads=1)

    def write(self, view: PlannedView, folder: Path) -> None:
        """Writes the files of a view that are not there yet, each whole or not at all.

        Raises:
            DatasetError: The textured mesh cannot be read.
            OSError: The disk is full, or the folder cannot be written.
        """
        for path in files_of(self._params, view, folder):
            if not is_written(path):
                # Thousands of small files: an empty one, which a power cut may leave, is made again.
                content = getattr(self, f"_{path.parent.name}")(view)
                write_bytes(path, content, survives_power_cut=False)

    def _images(self, view: PlannedView) -> bytes:
        # The seed and the name decide the look, nothing else.
        stream = random_stream(self._params.seed, "training", "look", view.key)
        look, response = draw_look(self._params.look, stream)
        if self._params.renderer == "pyrender" and self._mesh is not None:
            # No sun and no haze, which textures have already.
            sky = np.sqrt(np.clip(look.haze_rgb, 0.0, 1.0))
            drawn = self._by_opengl.picture(self._camera, view.pose, sky)
            picture = apply_camera_response(linear(drawn).astype(np.float32), response)
        else:
            picture = self._photos.photo(self._camera, view.pose, look, response)
        return photo_file(picture, f".{self._params.format}", response)

    def _masks(self, view: PlannedView) -> bytes:
        mask = self._silhouette.render(self._camera, view.pose)
        if self._params.occluders_in_mask:
            mask &= ~self._photos.occluders(self._camera, view.pose)
        return encoded_mask(mask, bilevel=True)

    def _labels(self, view: PlannedView) -> bytes:
        building = self._raster.draw(self._camera, view.pose).building
        return encoded((building + 1).astype(np.uint16), ".png")

    def _classes(self, view: PlannedView) -> bytes:
        pose = view.pose
        (classes,) = self._raster.classes(self._camera, pose.rotation[None], pose.center[None])
        if self._params.occluders_in_mask:
            classes[self._photos.occluders(self._camera, pose)] = 0
        return encoded(classes, ".png")

    def _depth(self, view: PlannedView) -> bytes:
        depth = self._photos.depth(self._camera, view.pose).astype(np.float64)
        return encoded(np.rint(np.minimum(depth * 100.0, _MOST)).astype(np.uint16), ".png")

    @cached_property
    def _raster(self) -> RasterRenderer:
        return RasterRenderer(self._parts.scene, threads=1)

    @cached_property
    def _mesh(self) -> TexturedMesh | None:
        model, offset = self._params.texture_model, self._parts.texture_offset
        if model is None or offset is None:
            return None
        return read_textured(Path(model).expanduser(), self._params.texture_up).shifted(offset)

    @cached_property
    def _photos(self) -> PhotoRenderer:
        parts = self._parts
        return PhotoRenderer(parts.picture_scene, parts.props, parts.cover, 1, self._mesh)

    @cached_property
    def _by_opengl(self) -> PyrenderTextured:
        assert self._mesh is not None  # noqa: S101
        return PyrenderTextured(self._mesh)


def is_written(path: Path) -> bool:
    """Returns whether a file is there and not empty."""
    try:
        return path.stat().st_size > 0
    except FileNotFoundError:
        return False


def files_of(params: GenerateParams, view: PlannedView, folder: Path) -> list[Path]:
    """Returns the files of a view."""
    kinds = {
        "images": (params.images, params.format),
        "masks": (True, "png"),
        "labels": (params.labels, "png"),
        "classes": (params.classes, "png"),
        "depth": (params.depth, "png"),
    }
    root = folder / view.split
    return [root / kind / f"{view.name}.{ending}" for kind, (wanted, ending) in kinds.items() if wanted]
