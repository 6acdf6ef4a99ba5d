"""The city and its surroundings as one worker holds them: draws what belongs to a view."""

from __future__ import annotations

from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xxhash
from numpy.typing import NDArray

from lodbench.citymodel.mesh.texture_files import read_textured
from lodbench.citymodel.mesh.textured import TexturedMesh
from lodbench.citymodel.scene import Scene
from lodbench.photos.pictures import encoded, encoded_mask
from lodbench.rendering.pyrender_textured import PyrenderTextured
from lodbench.rendering.raster import RasterRenderer
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.storage import digest_of, random_stream, write_bytes
from lodbench.synthesis.objects.scene_props import SceneProps
from lodbench.synthesis.photo import LandCover, PhotoRenderer, draw_look
from lodbench.synthesis.photo.renderer import apply_camera_response, photo_file
from lodbench.synthesis.photo.shading import linear
from lodbench.synthesis.training_data.params import GenerateParams
from lodbench.synthesis.training_data.plan_views import PlannedView

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
    """Tells whether a file is there and not empty."""
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
        "depth": (params.depth, "png"),
    }
    root = folder / view.split
    return [root / kind / f"{view.name}.{ending}" for kind, (wanted, ending) in kinds.items() if wanted]
