"""Rendering a list of poses to picture files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lodbench.citymodel.options import ReadOptions
from lodbench.datasets.pose_text import read_cameras, read_poses
from lodbench.errors import ConfigError, DatasetError, nearest_names
from lodbench.execution import Progress
from lodbench.harness.city import open_city
from lodbench.rendering import make_renderer
from lodbench.reporting.overlays import write_picture

KINDS = ("silhouette",)


@dataclass(frozen=True, slots=True)
class RenderParams:
    """What to render.

    Attributes:
        city: City model file.
        poses: Pose file, world to camera, in the city's coordinates.
        intrinsics: Camera file, by the same names.
        out: Folder for the pictures.
        kind: ``silhouette``.
        renderer: Name of the renderer.
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
    renderer: str = "silhouette"
    lod: str | None = None
    crs: str | None = None
    roof_height: str | None = None
    size: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class Rendered:
    """What was drawn.

    Attributes:
        files: The pictures, in the order of the poses.
        notes: What was met in the city.
    """

    files: tuple[Path, ...]
    notes: tuple[str, ...]


def render_poses(params: RenderParams, options: ReadOptions | None = None) -> Rendered:
    """Writes one PNG per pose (255 = building) and returns the files.

    Args:
        params: What to render.
        options: How to read the city; ``params.crs`` goes before its ``crs``.

    Raises:
        LodbenchError: An input is missing or malformed, or a pose has no camera; nothing is written then.
    """
    if params.kind not in KINDS:
        raise ConfigError(f"kind={params.kind} is not known.", nearest_names(params.kind, KINDS))
    poses, cameras = read_poses(params.poses), read_cameras(params.intrinsics)
    missing = [name for name in poses if name not in cameras]
    if missing or not poses:
        what = (
            f"{missing[0]} has no camera in {params.intrinsics}"
            if missing
            else f"{params.poses} has no poses"
        )
        raise DatasetError(f"{what}.", "The two files share the image names.")
    options = options or ReadOptions()
    options = options if params.crs is None else replace(options, crs=params.crs)
    city = open_city(Path(params.city).expanduser(), params.lod, options, params.roof_height)
    scene = city.scene
    renderer = make_renderer(params.renderer, scene, 1)
    out = Path(params.out).expanduser()
    out.mkdir(parents=True, exist_ok=True)
    written = []
    with Progress(f"{params.kind}s", len(poses)) as progress:
        for name, pose in poses.items():
            camera = cameras[name].scaled(*params.size) if params.size else cameras[name]
            mask = renderer.render(camera, pose.shifted(-scene.origin))
            path = out / f"{Path(name).stem}.png"
            write_picture(path, mask.astype(np.uint8) * 255)
            written.append(path)
            progress.advance()
    return Rendered(tuple(written), city.notes())
