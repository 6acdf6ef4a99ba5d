"""Rendering a list of poses to picture files."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.mesh.texture_files import open_textured_map
from lodbench.citymodel.options import ReadOptions
from lodbench.datasets.faults import aspect_fault
from lodbench.datasets.pose_text import (
    format_camera,
    format_pose,
    lines_to_text,
    read_cameras,
    read_poses,
)
from lodbench.errors import ConfigError, DatasetError
from lodbench.execution import Progress
from lodbench.geometry import Camera, Pose
from lodbench.harness.city import far_words, open_city
from lodbench.harness.render_kinds import KINDS, Kind, View, choose_renderer, write_marked
from lodbench.photos.pictures import picture_size
from lodbench.plugins import blaming
from lodbench.rendering import open_renderer
from lodbench.rendering.backends import PyrenderTextured
from lodbench.rendering.projection import require_pinhole
from lodbench.rendering.textured import TexturedRenderer
from lodbench.reporting.overlays import is_readable_picture
from lodbench.storage import make_folder, write_text

# Kinds and renderers that can draw a textured map.
_TEXTURED = (("colour", None), ("colour", "raster"), ("colour", "pyrender"))
# What is written beside views of a textured map, so that they serve as references.
_REFERENCES = ("poses.txt", "intrinsic.txt")
_OTHER_FOLDER = "Name another folder: out=DIR."


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
    """What was drawn.

    Attributes:
        files: What the views share, then the views in the order of the poses; of a textured map the
            views, then their poses and cameras.
        notes: What was met in the city, and how far off cameras are that see none of it.
    """

    files: tuple[Path, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Shot:
    """One view requested.

    Attributes:
        name: Of the image.
        pose: World to camera, in the city's coordinates.
        camera: Pinhole, at the size to draw.
        photo: The photo, or None.
    """

    name: str
    pose: Pose
    camera: Camera
    photo: Path | None


def render_poses(params: RenderParams, options: ReadOptions | None = None) -> Rendered:
    """Draws every pose and returns the files.

    Raises:
        LodbenchError: An input is missing or malformed, a pose has no camera or no photo, the renderer
            cannot draw the kind, the textured map lies elsewhere, or pictures are in the way that are not
            of the kind; nothing is written then.
    """
    _require_heard(params)
    name = choose_renderer(params.kind, None if params.textured_map else params.renderer)
    kind = KINDS[params.kind]
    shots, out = _shots(params), Path(params.out).expanduser()
    _require_room(shots, out, kind)
    if params.textured_map is not None:
        _require_inputs_kept(params, out)
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
        drawn = _draw_textured(textured, shots, city.scene.origin, out)
        return Rendered(drawn, notes + mesh.notes)
    make_folder(out)
    files = kind.prepare(city.scene, out)
    with Progress(f"{params.kind} pictures", len(shots)) as progress:
        for shot in shots:
            pose, path = shot.pose.shifted(-city.scene.origin), out / Path(shot.name).stem
            with blaming("renderers", name, f"draw {shot.name}"):
                files += kind.write(View(renderer, shot.camera, pose, path, shot.photo))
            progress.advance()
    return Rendered(tuple(files), notes)


def _require_heard(params: RenderParams) -> None:
    """Raises ConfigError where the kind or the renderer draws neither photos nor textured maps."""
    if params.textured_map is not None and (params.kind, params.renderer) not in _TEXTURED:
        raise ConfigError(
            "A textured map is drawn by `kind=colour` and `renderer=raster` or pyrender.",
            "Add `kind=colour`.",
        )
    if params.images is not None and params.kind in KINDS and params.kind != "overlay":
        raise ConfigError(f"`images=` is not used by `kind={params.kind}`.", "Add `kind=overlay`.")


def _require_room(shots: list[Shot], out: Path, kind: Kind) -> None:
    """Raises ConfigError where photos would be replaced, or files that are not of the kind drawn."""
    if any(shot.photo is not None and shot.photo.resolve().parent == out.resolve() for shot in shots):
        raise ConfigError(f"{out} holds the photos: pictures drawn would replace them.", _OTHER_FOLDER)
    file = kind.in_the_way(out, [Path(shot.name).stem for shot in shots])
    if file is not None:
        what = "picture" if file.suffix == ".png" else "file"
        raise ConfigError(f"{file} is there already, and is no such {what}.", _OTHER_FOLDER)


def _require_inputs_kept(params: RenderParams, out: Path) -> None:
    """Raises ConfigError where what is written beside views of a textured map would replace the inputs."""
    inputs = {Path(name).expanduser().resolve() for name in (params.poses, params.intrinsics)}
    for name in _REFERENCES:
        if (out / name).resolve() in inputs:
            raise ConfigError(f"{out / name} is read: what is written would replace it.", _OTHER_FOLDER)


def _draw_textured(
    renderer: TexturedRenderer | PyrenderTextured, shots: list[Shot], origin: NDArray[np.float64], out: Path
) -> tuple[Path, ...]:
    """Draws a textured map, and writes poses and cameras beside it: the folder serves as references."""
    make_folder(out)
    files = []
    with Progress("colour pictures", len(shots)) as progress:
        for shot in shots:
            pose, path = shot.pose.shifted(-origin), out / f"{Path(shot.name).stem}.png"
            colour = renderer.colours(shot.camera, pose.rotation[None], pose.center[None])[0]
            write_marked(path, np.ascontiguousarray(colour[:, :, ::-1]), "colour")
            files.append(path)
            progress.advance()
    names = [path.name for path in files]
    poses = [format_pose(name, shot.pose) for name, shot in zip(names, shots, strict=True)]
    cameras = [format_camera(name, shot.camera) for name, shot in zip(names, shots, strict=True)]
    for name, lines in zip(_REFERENCES, (poses, cameras), strict=True):
        write_text(out / name, lines_to_text(lines))
    return *files, *(out / name for name in _REFERENCES)


def _shots(params: RenderParams) -> list[Shot]:
    """Returns what to draw, with all that can be wrong with it found before the city is read."""
    poses, cameras = read_poses(params.poses), read_cameras(params.intrinsics)
    if not poses:
        raise DatasetError(f"{params.poses} has no poses.", "Each line reads: name qw qx qy qz tx ty tz")
    stem, count = Counter(Path(name).stem for name in poses).most_common(1)[0]
    if count > 1:
        raise DatasetError(f"{count} poses would be drawn to {stem}.png.", "Give them different names.")
    return [_shot(params, name, pose, cameras) for name, pose in poses.items()]


def _shot(params: RenderParams, name: str, pose: Pose, cameras: dict[str, Camera]) -> Shot:
    if name not in cameras:
        raise DatasetError(
            f"{name} has no camera in {params.intrinsics}.", "The two files share the image names."
        )
    camera = cameras[name].scaled(*params.size) if params.size else cameras[name]
    require_pinhole(camera)
    photo = Path(params.images).expanduser() / name if params.images else None
    if photo is not None and not is_readable_picture(photo):
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
    return Shot(name, pose, camera, photo)
