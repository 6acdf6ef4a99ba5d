"""Rendering a list of poses to picture files: the kinds of pictures, and which renderers can draw each."""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.textured_map import open_textured_map
from lodbench.datasets.faults import aspect_fault
from lodbench.datasets.pose_text import format_camera, format_pose, lines_to_text, read_cameras, read_poses
from lodbench.errors import ConfigError, DatasetError, RenderingError, nearest_names
from lodbench.execution import Progress
from lodbench.geometry import Camera, Pose
from lodbench.harness.city import far_words, open_city
from lodbench.photos.pictures import picture_size
from lodbench.plugins import blaming, load_plugin
from lodbench.rendering import (
    DEPTH,
    INSTANCES,
    LAYERS,
    DepthRenderer,
    InstanceRenderer,
    LayerRenderer,
    Renderer,
    open_renderer,
    renderers_with,
)
from lodbench.rendering.backends import PyrenderTextured
from lodbench.rendering.projection import require_pinhole
from lodbench.rendering.raster import TexturedRenderer
from lodbench.reporting import overlays
from lodbench.storage import make_folder, write_bytes, write_text

# Grey or BGR.
Picture = NDArray[np.uint8] | NDArray[np.uint16]
# By which a kind's files are known: the bytes, and where in the file they are.
Mark = tuple[int, bytes]
# A PNG's signature, and the chunk of its size, which is the first of every PNG.
_AFTER_SIZE = 8 + 25
_MOST = int(np.iinfo(np.uint16).max)
_NPY, _INSTANCES, _NAMES = (0, b"\x93NUMPY"), (0, b'{"instances": ['), (0, b'{\n"1": ')
# Kinds and renderers that can draw a textured map.
_TEXTURED = (("colour", None), ("colour", "raster"), ("colour", "pyrender"))
# What is written beside views of a textured map, so that they serve as references.
_REFERENCES = ("poses.txt", "intrinsic.txt")
_OTHER_FOLDER = "Name another folder: out=DIR."


def picture_mark(kind: str) -> Mark:
    """Returns the mark of a kind's pictures: a text among the PNG's own, as masks made by hand have none."""
    chunk = b"tEXt" + f"Software\0lodbench render kind={kind}".encode()
    whole = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return _AFTER_SIZE, whole


def _may_replace(file: Path, mark: Mark) -> bool:
    if not file.exists():
        return True
    start, stated = mark
    with file.open("rb") as stream:
        return stream.read(start + len(stated))[start:] == stated


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One picture to write."""

    name: str  # of the image
    camera: Camera  # pinhole, at the size to draw
    pose: Pose  # world to camera; in the city's coordinates until it is drawn, in the scene's frame
    out: Path  # folder to write
    photo: Path | None  # the photo taken there, or None

    def file(self, suffix: str) -> Path:
        """Returns the file of a suffix; a dot in the picture's name is no suffix."""
        return self.out / f"{Path(self.name).stem}{suffix}"


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of picture."""

    default: str  # the renderer that is taken unless one is requested
    ability: str  # the function of renderers that can draw it
    write: Callable[[Renderer, View], list[Path]]  # draws and writes a view; returns its files
    marks: Mapping[str, Mark]  # what the files it writes of a view say of themselves, by their suffixes
    # Raises a LodbenchError if a scene cannot be drawn so.
    check: Callable[[Scene], None] = lambda _scene: None
    # Writes what all views of a scene share to the folder; returns its files.
    prepare: Callable[[Scene, Path], list[Path]] = lambda _scene, _out: []
    shared: Mapping[str, Mark] = field(default_factory=dict)  # what those say of themselves, by their names

    def in_the_way(self, out: Path, stems: Iterable[str]) -> Path | None:
        """Returns a file that views would replace and that is no earlier one of this kind, or None."""
        files = [(out / name, mark) for name, mark in self.shared.items()]
        files += [(out / (stem + suffix), mark) for stem in stems for suffix, mark in self.marks.items()]
        return next((file for file, mark in files if not _may_replace(file, mark)), None)


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


def _silhouette(renderer: Renderer, view: View) -> Picture:
    return renderer.render(view.camera, view.pose).astype(np.uint8) * 255


def _write_depth(renderer: Renderer, view: View) -> list[Path]:
    depth = cast("DepthRenderer", renderer).depth(view.camera, view.pose)
    content = io.BytesIO()
    np.save(content, depth)
    write_bytes(view.file(".npy"), content.getvalue())
    return [*_write_png(view, depth_in_centimetres(depth), "depth"), view.file(".npy")]


def depth_in_centimetres(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Returns depth in metres as whole centimetres: 0 for nothing, 65535 for 655.35 m and all beyond."""
    return np.rint(np.minimum(depth.astype(np.float64) * 100.0, _MOST)).astype(np.uint16)


def _labels(renderer: Renderer, view: View) -> Picture:
    return (cast("LayerRenderer", renderer).draw(view.camera, view.pose).building + 1).astype(np.uint16)


def _check_labels(scene: Scene) -> None:
    if scene.num_buildings > _MOST:
        raise RenderingError(
            f"The city has {scene.num_buildings} buildings; a label picture holds at most {_MOST}.",
            "Cut the city into tiles, or take RasterRenderer.draw(...).building from Python.",
        )


def _write_label_names(scene: Scene, out: Path) -> list[Path]:
    names = {str(number): name for number, name in enumerate(scene.building_ids, start=1)}
    write_text(out / "labels.json", json.dumps(names, indent=0, ensure_ascii=False) + "\n")
    return [out / "labels.json"]


def _colour(renderer: Renderer, view: View) -> Picture:
    colour = cast("LayerRenderer", renderer).draw(view.camera, view.pose).colour
    return np.ascontiguousarray(colour[:, :, ::-1])


def _write_instances(renderer: Renderer, view: View) -> list[Path]:
    """Writes every building's silhouette, hidden or not, as run lengths in the form of COCO."""
    instances = cast("InstanceRenderer", renderer).instances(view.camera, view.pose)
    names, records = renderer.scene.building_ids, []
    for building, mask in instances.masks():
        records.append(
            {
                "building": names[building],
                "area": int(mask.sum()),
                "bbox": list(cv2.boundingRect(mask.astype(np.uint8))),
                "segmentation": {"size": list(mask.shape), "counts": column_runs(mask)},
            }
        )
    write_text(view.file(".json"), json.dumps({"instances": records}, ensure_ascii=False) + "\n")
    return [view.file(".json")]


def column_runs(mask: NDArray[np.bool_]) -> list[int]:
    """Returns lengths of runs of unset and set pixels in turn, unset first, down the columns (COCO's RLE)."""
    pixels = mask.T.ravel()
    turns = np.flatnonzero(pixels[1:] != pixels[:-1]) + 1
    runs = np.diff([0, *turns, len(pixels)]).tolist()
    return [0, *runs] if pixels[0] else runs


def _overlay(renderer: Renderer, view: View) -> Picture:
    canvas = overlays.read_background(view.photo, view.camera)
    overlays.draw_outline(canvas, renderer.render(view.camera, view.pose), overlays.ESTIMATE_COLOUR, 1)
    return canvas


def _write_png(view: View, picture: Picture, kind: str) -> list[Path]:
    """Writes a picture of a view with its kind's mark, atomically."""
    plain, (start, mark) = overlays.png_bytes(picture), picture_mark(kind)
    write_bytes(view.file(".png"), plain[:start] + mark + plain[start:])
    return [view.file(".png")]


def _picture_kind(
    name: str, default: str, ability: str, draw: Callable[[Renderer, View], Picture], *shared: Any
) -> Kind:
    """Returns a kind whose views are a marked PNG each."""
    return Kind(
        default,
        ability,
        lambda renderer, view: _write_png(view, draw(renderer, view), name),
        {".png": picture_mark(name)},
        *shared,
    )


KINDS = {
    "silhouette": _picture_kind("silhouette", "silhouette", "render", _silhouette),
    "depth": Kind("raster", DEPTH, _write_depth, {".png": picture_mark("depth"), ".npy": _NPY}),
    "label": _picture_kind(
        "label", "raster", LAYERS, _labels, _check_labels, _write_label_names, {"labels.json": _NAMES}
    ),
    "colour": _picture_kind("colour", "raster", LAYERS, _colour),
    "overlay": _picture_kind("overlay", "silhouette", "render", _overlay),
    "instance": Kind("silhouette", INSTANCES, _write_instances, {".json": _INSTANCES}),
}


@dataclass(frozen=True, slots=True)
class RenderParams:
    """What to render, as ``conf/render.yaml`` says."""

    city: str
    poses: str
    intrinsics: str
    out: str
    kind: str = "silhouette"
    renderer: str | None = None
    images: str | None = None
    lod: str | None = None
    crs: str | None = None
    roof_height: str | None = None
    size: tuple[int, int] | None = None
    textured_map: str | None = None
    layers: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Rendered:
    """What was drawn."""

    # What the views share, then the views in the order of the poses; of a textured map the views, then
    # their poses and cameras.
    files: tuple[Path, ...]
    notes: tuple[str, ...]  # what was met in the city, and how far off cameras are that see none of it


def render_poses(params: RenderParams, options: ReadOptions | None = None) -> Rendered:
    """Draws every pose and returns the files.

    Raises:
        LodbenchError: An input is missing or malformed, a pose has no camera or no photo, the renderer
            cannot draw the kind, the textured map lies elsewhere, or pictures are in the way that are not
            of the kind; nothing is written then.
    """
    _require_used(params)
    name = choose_renderer(params.kind, None if params.textured_map else params.renderer)
    kind, shots, out = KINDS[params.kind], _shots(params), Path(params.out).expanduser()
    _require_room(params, shots, out)
    options = options or ReadOptions()
    options = options if params.crs is None else replace(options, crs=params.crs)
    options = replace(options, layers=tuple(params.layers)) if params.layers else options
    city = open_city(Path(params.city).expanduser(), params.lod, options, params.roof_height)
    renderer = open_renderer(name, city.scene)
    kind.check(city.scene)
    far = far_words([shot.pose for shot in shots], city.scene)
    notes = (*([] if far is None else [f"the cameras are {far[0]}. {far[1]}"]), *city.notes())
    if params.textured_map is not None:
        mesh = open_textured_map(Path(params.textured_map).expanduser(), city.scene, options=options)
        textured = PyrenderTextured(mesh) if params.renderer == "pyrender" else TexturedRenderer(mesh)
        return Rendered(_draw_textured(textured, shots, city.scene.origin, out), notes + mesh.notes)
    make_folder(out)
    files = kind.prepare(city.scene, out)
    with Progress(f"{params.kind} pictures", len(shots)) as progress:
        for shot in shots:
            with blaming("renderers", name, f"draw {shot.name}"):
                files += kind.write(renderer, replace(shot, pose=shot.pose.shifted(-city.scene.origin)))
            progress.advance()
    return Rendered(tuple(files), notes)


def _require_used(params: RenderParams) -> None:
    """Raises ConfigError where the kind or the renderer draws neither photos nor textured maps."""
    if params.textured_map is not None and (params.kind, params.renderer) not in _TEXTURED:
        raise ConfigError(
            "A textured map is drawn by `kind=colour` and `renderer=raster` or pyrender.",
            "Add `kind=colour`.",
        )
    if params.images is not None and params.kind in KINDS and params.kind != "overlay":
        raise ConfigError(f"`images=` is not used by `kind={params.kind}`.", "Add `kind=overlay`.")


def _require_room(params: RenderParams, shots: list[View], out: Path) -> None:
    """Raises ConfigError where photos, inputs or files that are not of the kind drawn would be replaced."""
    if any(shot.photo is not None and shot.photo.resolve().parent == out.resolve() for shot in shots):
        raise ConfigError(f"{out} holds the photos: pictures drawn would replace them.", _OTHER_FOLDER)
    file = KINDS[params.kind].in_the_way(out, [Path(shot.name).stem for shot in shots])
    if file is not None:
        what = "picture" if file.suffix == ".png" else "file"
        raise ConfigError(f"{file} is there already, and is no such {what}.", _OTHER_FOLDER)
    inputs = {Path(name).expanduser().resolve() for name in (params.poses, params.intrinsics)}
    for name in _REFERENCES if params.textured_map is not None else ():
        if (out / name).resolve() in inputs:
            raise ConfigError(f"{out / name} is read: what is written would replace it.", _OTHER_FOLDER)


def _draw_textured(
    renderer: TexturedRenderer | PyrenderTextured, shots: list[View], origin: NDArray[np.float64], out: Path
) -> tuple[Path, ...]:
    """Draws a textured map, and writes poses and cameras beside it: the folder serves as references."""
    make_folder(out)
    files: list[Path] = []
    with Progress("colour pictures", len(shots)) as progress:
        for shot in shots:
            pose = shot.pose.shifted(-origin)
            colour = renderer.colours(shot.camera, pose.rotation[None], pose.center[None])[0]
            files += _write_png(shot, np.ascontiguousarray(colour[:, :, ::-1]), "colour")
            progress.advance()
    poses = [format_pose(path.name, shot.pose) for path, shot in zip(files, shots, strict=True)]
    cameras = [format_camera(path.name, shot.camera) for path, shot in zip(files, shots, strict=True)]
    for name, lines in zip(_REFERENCES, (poses, cameras), strict=True):
        write_text(out / name, lines_to_text(lines))
    return *files, *(out / name for name in _REFERENCES)


def _shots(params: RenderParams) -> list[View]:
    """Returns what to draw, with all that can be wrong with it found before the city is read."""
    poses, cameras = read_poses(params.poses), read_cameras(params.intrinsics)
    if not poses:
        raise DatasetError(f"{params.poses} has no poses.", "Each line reads: name qw qx qy qz tx ty tz")
    stem, count = Counter(Path(name).stem for name in poses).most_common(1)[0]
    if count > 1:
        raise DatasetError(f"{count} poses would be drawn to {stem}.png.", "Give them different names.")
    return [_shot(params, name, pose, cameras) for name, pose in poses.items()]


def _shot(params: RenderParams, name: str, pose: Pose, cameras: dict[str, Camera]) -> View:
    if name not in cameras:
        raise DatasetError(
            f"{name} has no camera in {params.intrinsics}.", "The two files share the image names."
        )
    camera = cameras[name].scaled(*params.size) if params.size else cameras[name]
    require_pinhole(camera)
    photo = Path(params.images).expanduser() / name if params.images else None
    if photo is not None and not overlays.is_readable_picture(photo):
        raise DatasetError(
            f"{photo} is not a picture, or not there.", "images= holds photos named as the poses."
        )
    size = None if photo is None else picture_size(photo)
    own = cameras[name].width, cameras[name].height
    if size is not None and aspect_fault(size, own):
        raise DatasetError(
            f"{photo} is {size[0]} x {size[1]}, its camera {own[0]} x {own[1]}: another aspect.",
            "images= holds the photos that the intrinsics are of, of any size.",
        )
    return View(name, camera, pose, Path(params.out).expanduser(), photo)
