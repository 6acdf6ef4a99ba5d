"""Rendering a list of poses to picture files."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

from lodbench.citymodel.options import ReadOptions
from lodbench.datasets.pose_text import read_cameras, read_poses
from lodbench.errors import DatasetError
from lodbench.execution import Progress
from lodbench.geometry import Camera, Pose
from lodbench.harness.city import open_city
from lodbench.harness.render.kinds import KINDS, View, choose_renderer
from lodbench.rendering import open_renderer
from lodbench.rendering.projection import require_pinhole
from lodbench.reporting.overlays import is_readable_picture


@dataclass(frozen=True, slots=True)
class RenderParams:
    """What to render.

    Attributes:
        city: City model file.
        poses: Pose file, world to camera, in the city's coordinates.
        intrinsics: Camera file, by the same names.
        out: Folder for the pictures.
        kind: One of ``KINDS``: silhouette, depth, label, colour, overlay, instance.
        renderer: Name of the renderer, or None for the one that suits the kind.
        images: Folder of photos named as the poses, for ``overlay``; None for plain grey.
        lod: Level of detail, or None for the lowest.
        crs: CRS override, or None.
        roof_height: Rule by which an absent level 1 is derived, or None.
        size: Width and height to scale to, or None for the camera's own.
    """

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


@dataclass(frozen=True, slots=True)
class Rendered:
    """What was drawn.

    Attributes:
        files: What was written: what the views share, then the views in the order of the poses.
        notes: What was met in the city.
    """

    files: tuple[Path, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Shot:
    """One view asked for.

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

    Args:
        params: What to render.
        options: How to read the city; ``params.crs`` goes before its ``crs``.

    Raises:
        LodbenchError: An input is missing or malformed, a pose has no camera or no photo, or the renderer
            cannot draw the kind; nothing is written then.
    """
    name, kind = choose_renderer(params.kind, params.renderer), KINDS[params.kind]
    shots = _shots(params)
    options = options or ReadOptions()
    options = options if params.crs is None else replace(options, crs=params.crs)
    city = open_city(Path(params.city).expanduser(), params.lod, options, params.roof_height)
    renderer = open_renderer(name, city.scene)
    kind.check(city.scene)
    out = Path(params.out).expanduser()
    out.mkdir(parents=True, exist_ok=True)
    files = kind.prepare(city.scene, out)
    with Progress(f"{params.kind} pictures", len(shots)) as progress:
        for shot in shots:
            pose, path = shot.pose.shifted(-city.scene.origin), out / Path(shot.name).stem
            files += kind.write(View(renderer, shot.camera, pose, path, shot.photo))
            progress.advance()
    return Rendered(tuple(files), city.notes())


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
            f"{photo} is no picture, or not there.", "images= holds photos named as the poses."
        )
    return Shot(name, pose, camera, photo)
