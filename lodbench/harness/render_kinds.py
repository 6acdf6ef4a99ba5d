"""The kinds of pictures `lodbench render` writes, and which renderers can draw each."""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.errors import ConfigError, RenderingError, nearest_names
from lodbench.geometry import Camera, Pose
from lodbench.plugins import load_plugin
from lodbench.rendering import (
    DEPTH,
    INSTANCES,
    LAYERS,
    DepthRenderer,
    InstanceRenderer,
    LayerRenderer,
    Renderer,
    renderers_with,
)
from lodbench.reporting.overlays import ESTIMATE_COLOUR, draw_outline, png_bytes, read_background
from lodbench.storage import write_bytes, write_text

# The bytes, and where in the file they are.
Mark = tuple[int, bytes]
# A PNG's signature, and the chunk of its size, which is the first of every PNG.
_AFTER_SIZE = 8 + 25


def picture_mark(kind: str) -> Mark:
    """Returns the mark of a kind's pictures: a text among the PNG's own, as masks made by hand have none."""
    chunk = b"tEXt" + f"Software\0lodbench render kind={kind}".encode()
    whole = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return _AFTER_SIZE, whole


def write_marked(path: Path, picture: NDArray[np.uint8] | NDArray[np.uint16], kind: str) -> None:
    """Writes a picture, grey or BGR, 8 or 16 bits, as PNG with its kind's mark, atomically."""
    plain, (start, mark) = png_bytes(picture), picture_mark(kind)
    write_bytes(path, plain[:start] + mark + plain[start:])


def may_replace(file: Path, mark: Mark) -> bool:
    """Tells whether a file is absent, or has a mark."""
    if not file.exists():
        return True
    start, said = mark
    with file.open("rb") as stream:
        return stream.read(start + len(said))[start:] == said


# The largest value of a 16-bit PNG.
_MOST = 65535
_NPY, _INSTANCES, _NAMES = (0, b"\x93NUMPY"), (0, b'{"instances": ['), (0, b'{\n"1": ')


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One picture to write.

    Attributes:
        renderer: Can draw the kind, see ``choose_renderer``.
        camera: Pinhole.
        pose: In the scene's frame.
        path: The picture's file, without its suffix.
        photo: The photo taken there, or None.
    """

    renderer: Renderer
    camera: Camera
    pose: Pose
    path: Path
    photo: Path | None

    def file(self, suffix: str) -> Path:
        """Returns the file of a suffix; a dot in the picture's name is no suffix."""
        return self.path.with_name(self.path.name + suffix)


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of picture.

    Attributes:
        default: The renderer that is taken unless one is requested.
        ability: The function of renderers that can draw it.
        write: Draws and writes a view; returns its files.
        check: Raises a LodbenchError if a scene cannot be drawn so.
        prepare: Writes what all views of a scene share to the folder; returns its files.
        marks: What the files it writes of a view say of themselves, by their suffixes.
        shared: What those say that all views share, by their names.
    """

    default: str
    ability: str
    write: Callable[[View], list[Path]]
    check: Callable[[Scene], None] = lambda _scene: None
    prepare: Callable[[Scene, Path], list[Path]] = lambda _scene, _out: []
    marks: Mapping[str, Mark] = field(default_factory=dict)
    shared: Mapping[str, Mark] = field(default_factory=dict)

    def in_the_way(self, out: Path, stems: Iterable[str]) -> Path | None:
        """Returns a file that views would replace and that is no earlier one of this kind, or None."""
        files = [(out / name, mark) for name, mark in self.shared.items()]
        files += [(out / (stem + suffix), mark) for stem in stems for suffix, mark in self.marks.items()]
        return next((file for file, mark in files if not may_replace(file, mark)), None)


def choose_renderer(kind: str, renderer: str | None) -> str:
    """Returns the renderer to draw a kind with.

    Raises:
        ConfigError: The kind or the renderer is unknown, or the renderer cannot draw the kind.
    """
    if kind not in KINDS:
        raise ConfigError(f"kind={kind} is not known.", nearest_names(kind, KINDS))
    if renderer is None:
        return KINDS[kind].default
    if not hasattr(load_plugin("renderers", renderer), KINDS[kind].ability):
        raise ConfigError(
            f"`renderer={renderer}` cannot draw `kind={kind}`.",
            f"Leave `renderer=` out, or take one of: {', '.join(renderers_with(KINDS[kind].ability))}.",
        )
    return renderer


def _write_silhouette(view: View) -> list[Path]:
    mask = view.renderer.render(view.camera, view.pose)
    return _write_png(view, mask.astype(np.uint8) * 255, "silhouette")


def _write_depth(view: View) -> list[Path]:
    depth = cast("DepthRenderer", view.renderer).depth(view.camera, view.pose)
    content = io.BytesIO()
    np.save(content, depth)
    write_bytes(view.file(".npy"), content.getvalue())
    return [*_write_png(view, depth_in_centimetres(depth), "depth"), view.file(".npy")]


def depth_in_centimetres(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Returns depth in metres as whole centimetres: 0 for nothing, 65535 for 655.35 m and all beyond."""
    centimetres = np.rint(np.minimum(depth.astype(np.float64) * 100.0, _MOST))
    return centimetres.astype(np.uint16)


def _write_label(view: View) -> list[Path]:
    building = cast("LayerRenderer", view.renderer).draw(view.camera, view.pose).building
    return _write_png(view, (building + 1).astype(np.uint16), "label")


def _check_labels(scene: Scene) -> None:
    if scene.num_buildings > _MOST:
        raise RenderingError(
            f"The city has {scene.num_buildings} buildings; a label picture holds at most {_MOST}.",
            "Cut the city into tiles, or take RasterRenderer.draw(...).building from Python.",
        )


def _write_label_names(scene: Scene, out: Path) -> list[Path]:
    names = {str(number): name for number, name in enumerate(scene.building_ids, start=1)}
    path = out / "labels.json"
    write_text(path, json.dumps(names, indent=0, ensure_ascii=False) + "\n")
    return [path]


def _write_colour(view: View) -> list[Path]:
    colour = cast("LayerRenderer", view.renderer).draw(view.camera, view.pose).colour
    return _write_png(view, np.ascontiguousarray(colour[:, :, ::-1]), "colour")


def _write_instances(view: View) -> list[Path]:
    """Writes every building's silhouette, hidden or not, as run lengths in the form of COCO."""
    instances = cast("InstanceRenderer", view.renderer).instances(view.camera, view.pose)
    names, found = view.renderer.scene.building_ids, []
    for building, mask in instances.masks():
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        box = [columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1]
        found.append(
            {
                "building": names[building],
                "area": int(mask.sum()),
                "bbox": [int(side) for side in box],
                "segmentation": {"size": list(mask.shape), "counts": column_runs(mask)},
            }
        )
    path = view.file(".json")
    write_text(path, json.dumps({"instances": found}, ensure_ascii=False) + "\n")
    return [path]


def column_runs(mask: NDArray[np.bool_]) -> list[int]:
    """Returns lengths of runs of unset and set pixels in turn, unset first, down the columns (COCO's RLE)."""
    pixels = mask.T.ravel()
    turns = np.flatnonzero(pixels[1:] != pixels[:-1]) + 1
    runs = np.diff([0, *turns, len(pixels)]).tolist()
    return [0, *runs] if pixels[0] else runs


def _write_overlay(view: View) -> list[Path]:
    canvas = read_background(view.photo, view.camera)
    draw_outline(canvas, view.renderer.render(view.camera, view.pose), ESTIMATE_COLOUR, 1)
    return _write_png(view, canvas, "overlay")


def _write_png(view: View, picture: NDArray[np.uint8] | NDArray[np.uint16], kind: str) -> list[Path]:
    path = view.file(".png")
    write_marked(path, picture, kind)
    return [path]


KINDS = {
    "silhouette": Kind("silhouette", "render", _write_silhouette, marks={".png": picture_mark("silhouette")}),
    "depth": Kind("raster", DEPTH, _write_depth, marks={".png": picture_mark("depth"), ".npy": _NPY}),
    "label": Kind(
        "raster", LAYERS, _write_label, _check_labels, _write_label_names,
        {".png": picture_mark("label")}, {"labels.json": _NAMES},
    ),
    "colour": Kind("raster", LAYERS, _write_colour, marks={".png": picture_mark("colour")}),
    "overlay": Kind("silhouette", "render", _write_overlay, marks={".png": picture_mark("overlay")}),
    "instance": Kind("silhouette", INSTANCES, _write_instances, marks={".json": _INSTANCES}),
}  # fmt: skip
