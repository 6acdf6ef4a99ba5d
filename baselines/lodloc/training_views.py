"""The views a training learns from: photos with true poses, and the map's wireframe from rough ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.cache import open_cached_city
from lodbench.citymodel.options import ReadOptions
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import DatasetError
from lodbench.execution import Progress
from lodbench.geometry import Camera, Pose
from lodbench.segmentation.probability import working_size
from lodbench.storage import random_stream
from lodbench.storage.json_text import parse_json

from .wireframe import visible_points

_MANIFEST = "manifest.json"
MANIFEST_HINT = "lodbench generate-training-data makes such sets."
# A view whose map shows fewer points than this has nothing to align.
LEAST_POINTS = 60


@dataclass(frozen=True, slots=True, eq=False)
class TrainingView:
    """A photo, where it was taken, and what the map shows from places nearby.

    Attributes:
        key: Set, split and name: unique.
        photo: The file.
        camera: Pinhole at the size that the network sees.
        truth: The true pose, scene frame.
        priors: Rough poses.
        wireframes: For each of them (N, 3) float32 points that it sees, less the true centre.
    """

    key: str
    photo: Path
    camera: Camera
    truth: Pose
    priors: tuple[Pose, ...]
    wireframes: tuple[NDArray[np.float32], ...]


@dataclass(frozen=True, slots=True)
class ViewSettings:
    """How views are prepared.

    Attributes:
        size: Long side of photos, pixels.
        lod: Level of detail of the map; derived by the median of roofs where a city has finer ones only.
        priors: Rough poses per view.
        points: At most so many points of a wireframe.
        spacing_m: Between points on an edge.
        seed: Of the rough poses and of the choice of points.
    """

    size: int
    lod: str
    priors: int
    points: int
    spacing_m: float
    seed: int


def find_views(data: Path, settings: ViewSettings, splits: tuple[str, ...]) -> list[TrainingView]:
    """Returns the views of a training set, or of the sets below a folder, by name.

    Raises:
        LodbenchError: There is no set, or one's city cannot be read.
    """
    manifests = sorted(data.rglob(_MANIFEST)) if data.is_dir() else []
    if not manifests:
        raise DatasetError(f"{data} holds no training set.", MANIFEST_HINT)
    views = []
    for manifest in manifests:
        views += _views_of_set(manifest, data, settings, splits)
    return views


def _views_of_set(
    manifest: Path, data: Path, settings: ViewSettings, splits: tuple[str, ...]
) -> list[TrainingView]:
    made = _read_settings(manifest)
    city, folder = Path(made["city"]).expanduser(), manifest.parent
    if not city.exists():
        raise DatasetError(f"The city {city} of the set {folder} is no longer there.", "Make the set again.")
    options = ReadOptions.from_mapping(made["source"])
    # Where the level is in the file, the rule is not asked.
    scene = open_cached_city(city, lod=settings.lod, options=options, roof_height="median").scene
    city_map = CityMap(scene, threads=1)
    dataset = open_folder(FolderParams(str(folder), name=folder.name))
    entries = [entry for entry in dataset.entries if entry.split in splits]
    views = []
    with Progress(f"wireframes of {folder.name}", len(entries)) as progress:
        for entry in entries:
            if entry.camera is not None and entry.image is not None:
                truth = dataset.truth[entry.key].shifted(-scene.origin)
                camera = entry.camera.scaled(
                    *working_size(entry.camera.width, entry.camera.height, settings.size)
                )
                key = (folder.relative_to(data) / entry.key).as_posix()
                view = _prepared(key, entry.image, camera, truth, city_map, settings)
                views += [view] if view.priors else []
            progress.advance()
    return views


def _prepared(
    key: str, photo: Path, camera: Camera, truth: Pose, city_map: CityMap, settings: ViewSettings
) -> TrainingView:
    priors, wireframes = [], []
    for number in range(settings.priors):
        generator = random_stream(settings.seed, "lodloc", "prior", key, number)
        prior = UniformPrior().draw(truth, generator)
        points = visible_points(city_map, camera, prior, settings.spacing_m, settings.points, generator)
        if len(points) >= LEAST_POINTS:
            priors.append(prior)
            wireframes.append((points - truth.center).astype(np.float32))
    return TrainingView(key, photo, camera, truth, tuple(priors), tuple(wireframes))


def _read_settings(manifest: Path) -> dict[str, Any]:
    try:
        about = parse_json(manifest.read_text(encoding="utf-8"))
        settings = about["settings"]
        # Sets of older versions say of the source no more than its reference system.
        return {
            "city": str(settings["city"]),
            "source": dict(about.get("source", {"crs": settings.get("crs")})),
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DatasetError(f"{manifest} is no manifest of a training set.", MANIFEST_HINT) from error
