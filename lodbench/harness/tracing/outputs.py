"""What was traced: its file, the page to trace on, and what it becomes: a city model, a benchmark."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from shapely import Polygon, distance, get_coordinates, points

from lodbench import __version__
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.derive import part_blocks
from lodbench.citymodel.extrude import extrude
from lodbench.citymodel.model import CityModel, starts_of
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.polygons import finish_model
from lodbench.citymodel.raw import city_of_columns
from lodbench.citymodel.read import read_city_model
from lodbench.datasets.own import OwnImage, Written, find_photo, named_apart, write_dataset
from lodbench.datasets.pose_text import LayoutGuard, read_json
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import DatasetError
from lodbench.harness.local_page import LocalServer, saved_or_why
from lodbench.harness.tracing.roofs import Traced
from lodbench.harness.tracing.solve import Building, Model, TracedMap
from lodbench.segmentation.masks import read_photo
from lodbench.storage import random_stream, write_text

# Kind -> the fewest points of one.
KINDS = {"roof": 3, "ground": 1, "length": 2}
_LAYOUT = (
    '{"traced": [{"kind": "roof", "name": "A1", "photos": {"a.jpg": [[u, v], ...], "b.jpg": [[u, v], ...]}}]}'
)
# A building of another map is the same where the footprints overlap by so much of their union.
_SAME_IOU = 0.2
Floats = NDArray[np.float64]
# A ray is drawn in the other photo through so many places, between the nearest and the furthest of these
# shares of the model's points, and a little beyond.
_LINE_POINTS, _DEPTH_SHARES, _BEYOND = 30, (0.02, 0.98), 1.3


def read_tracing(path: Path, photos: Collection[str]) -> tuple[Traced, ...]:
    """Returns what a file holds, as the page saves it.

    Raises:
        DatasetError: It cannot be read, names a photo that the model lacks, or something in it is malformed.
    """
    return parse_tracing(read_json(path), str(path), photos)


def is_tracing(path: Path) -> bool:
    """Tells whether a file is a tracing, not a city model that is JSON too."""
    return path.suffix == ".json" and "traced" in read_json(path)


def parse_tracing(values: Mapping[str, Any], where: str, photos: Collection[str]) -> tuple[Traced, ...]:
    """Returns what JSON values hold, see ``read_tracing``.

    Raises:
        DatasetError: Something is malformed; the message names the item.
    """
    with LayoutGuard(where, _LAYOUT):
        listed = values["traced"]
        if not isinstance(listed, list):
            raise ValueError("traced is not a list")
    traced = []
    for number, item in enumerate(listed, start=1):
        with LayoutGuard(f"{where}, item {number}", _LAYOUT):
            traced.append(_parsed(item, photos))
    names = [item.name for item in traced if item.kind == "roof"]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise DatasetError(f"{where}: two roofs are called {twice}.", "Give each building a name of its own.")
    return tuple(traced)


def _parsed(item: Any, photos: Collection[str]) -> Traced:
    if not isinstance(item, dict) or not isinstance(item["photos"], dict):
        raise ValueError("it is no object with photos")
    kind, name = str(item["kind"]), str(item["name"]).strip()
    if kind not in KINDS:
        raise ValueError(f"the kind {kind!r} is none of {', '.join(KINDS)}")
    if not name:
        raise ValueError("it has no name")
    unknown = [photo for photo in item["photos"] if photo not in photos]
    if unknown:
        raise ValueError(f"{name}: the model has no image {unknown[0]!r}")
    pixels = {photo: np.array(points, np.float64) for photo, points in item["photos"].items()}
    shapes = {points.shape for points in pixels.values()}
    if len(pixels) < 2 or len(shapes) != 1 or (shape := shapes.pop())[1:] != (2,):
        counts = " and ".join(str(len(points)) for points in pixels.values())
        raise ValueError(f"{name}: the same corners in two photos are needed, not {counts or 'none'}")
    if shape[0] < KINDS[kind] or (kind == "length" and shape[0] != 2):
        raise ValueError(f"{name}: {shape[0]} points are no {kind}")
    metres = float(item["metres"]) if kind == "length" else None
    if metres is not None and not metres > 0:
        raise ValueError(f"{name}: a length is above 0 m, not {metres:g}")
    return Traced(kind, name, pixels, metres)


def write_tracing(traced: Sequence[Traced], path: Path) -> None:
    """Writes what was traced, to the hundredth of a pixel."""
    listed = [
        {
            "kind": item.kind,
            "name": item.name,
            **({} if item.metres is None else {"metres": item.metres}),
            "photos": {photo: np.round(points, 2).tolist() for photo, points in item.pixels.items()},
        }
        for item in traced
    ]
    lines = ",\n  ".join(json.dumps(item, ensure_ascii=False) for item in listed)
    write_text(path, f'{{"traced": [\n  {lines}\n]}}\n')


def map_of(buildings: Sequence[Building], crs: str | None) -> CityModel:
    """Returns LoD1 prisms, a building each."""
    rings = starts_of(np.array([len(building.roof.corners) for building in buildings]))
    blocks = extrude(
        np.concatenate([building.roof.corners for building in buildings]),
        rings,
        np.arange(len(buildings) + 1),
        np.array([building.ground for building in buildings]),
        np.array([building.roof.height for building in buildings]),
    )
    raw = city_of_columns(
        blocks.columns(blocks.footprint),
        source="traced",
        format="traced",
        srs_names=(crs,),
        building_ids=tuple(building.roof.name for building in buildings),
        lods=("1",),
        axis_orders=("east_first",),
    )
    return finish_model(raw, ReadOptions(crs=crs))


def write_benchmark(solved: TracedMap, model: CityModel, photos: Path, folder: Path, seed: int) -> Written:
    """Writes the photos not used for the map as a dataset in LoD-Loc's layout, the map as ``city.obj``.

    The model's poses become the truth; priors are drawn around it by ``UniformPrior``.

    Raises:
        LodbenchError: The folder is not new, or no photo could be written.
    """
    prior = UniformPrior()
    images = [
        OwnImage(
            image.name,
            image.camera,
            prior.draw(image.pose, random_stream(seed, "trace", image.name, "prior")),
            image.pose,
            find_photo(photos, image.name),
        )
        for image in solved.images
        if image.name in solved.queries and image.camera is not None
    ]
    about = {
        "made_by": f"lodbench {__version__}",
        "from": "lodbench trace",
        "crs": solved.placed.crs,
        "city_model": "city.obj",
        "prior": f"{prior.describe()}, seed {seed}",
    }
    return write_dataset(
        named_apart(images), folder, about, complete=lambda filling: convert_city(model, filling / "city.obj")
    )


class Footprint(NamedTuple):
    """A building of another map: name, plan, and height of its roof, where that is lowest."""

    name: str
    plan: Polygon
    roof: float


def footprints_of(path: Path) -> list[Footprint]:
    """Returns the blocks of a city model, in its own coordinates.

    Raises:
        CityModelError: It cannot be read.
    """
    model = read_city_model(path)
    plans, owner, _, top = part_blocks(model, model.lods[0])
    names = model.building_ids if model.objects is None else model.objects.ids
    footprints = []
    for plan, number in zip(plans, owner.tolist(), strict=True):
        outline = Polygon(get_coordinates(plan.exterior) + model.origin[:2])
        footprints.append(Footprint(names[number], outline, float(top[number] + model.origin[2])))
    return footprints


def compared(buildings: Sequence[Building], others: Sequence[Footprint]) -> list[dict[str, Any]]:
    """Returns how far buildings are from those of another map, those that overlap.

    Args:
        buildings: Of the map.
        others: Of the other map, in the same frame.

    Returns:
        For each building ``name``, ``other``, ``plan_m`` (root mean square distance of the outlines' corners
        to the other outline, both ways), ``height_m`` (its roof above the other's) and ``iou`` of the
        footprints; ``traced_plan_m`` and ``traced_height_m`` before it was snapped. Only ``name`` and
        ``other``, None, where none overlaps.
    """
    rows: list[dict[str, Any]] = []
    for building in buildings:
        plan = building.footprint
        overlaps = [plan.intersection(other.plan).area / plan.union(other.plan).area for other in others]
        best = int(np.argmax(overlaps)) if overlaps else -1
        if best < 0 or overlaps[best] < _SAME_IOU:
            rows.append({"name": building.roof.name, "other": None})
            continue
        name, other, height = others[best]
        rows.append(
            {
                "name": building.roof.name,
                "other": name,
                "plan_m": _apart(plan, other),
                "height_m": building.roof.height - height,
                "iou": float(overlaps[best]),
                "traced_plan_m": _apart(Polygon(building.traced.corners), other),
                "traced_height_m": building.traced.height - height,
            }
        )
    return rows


def _apart(one: Polygon, other: Polygon) -> float:
    gaps = [
        distance(points(get_coordinates(first.exterior)[:-1]), second.exterior)
        for first, second in ((one, other), (other, one))
    ]
    return float(np.sqrt(np.mean(np.concatenate(gaps) ** 2)))


def to_json(solved: TracedMap) -> list[dict[str, Any]]:
    """Returns a row of plain numbers per building, metres and pixels."""
    rows = []
    for building in solved.buildings:
        roof, (plan, up) = building.roof, building.moved
        rows.append(
            {
                "name": roof.name,
                "height_m": roof.height,
                "height_sigma_m": roof.height_sigma,
                "plan_sigma_m": roof.plan_sigma,
                "ground_m": building.ground,
                "ground_sigma_m": building.ground_sigma,
                "residual_px": roof.residual_px,
                "edges_found": roof.matched_share,
                "photos": roof.photos,
                "moved_plan_m": plan,
                "moved_height_m": up,
                "traced_residual_px": building.traced.residual_px,
            }
        )
    return rows


class TraceServer(LocalServer):
    """Serves a model's photos to be traced in; what ``file`` holds is gone on with.

    Raises:
        DatasetError: The file is there, and no tracing of this model.
    """

    def __init__(self, model: Model, file: Path, describe: Callable[[TracedMap], str], port: int = 0) -> None:
        super().__init__(port)
        self.model, self.file, self._describe = model, file, describe
        self.saved = json.loads(file.read_text("utf-8"))["traced"] if file.exists() else []

    def shown(self, address: str) -> tuple[bytes, str] | None:
        """Returns the page or a photo, by its number."""
        names = list(self.model.views)
        if address == "":
            return self._page(names), "text/html; charset=utf-8"
        number = address.removeprefix("photo").removesuffix(".jpg")
        if not number.isdecimal() or int(number) >= len(names):
            return None
        pixels = read_photo(self.model.views[names[int(number)]].photo)
        return cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]))[1].tobytes(), "image/jpeg"

    def done(self, address: str, content: dict[str, Any]) -> dict[str, Any] | None:
        """Saves, solves, draws a ray, or stops."""
        match address:
            case "save":
                return saved_or_why(lambda: self._save(content))
            case "solve":
                outlines: dict[str, Any] = {}
                return saved_or_why(lambda: self._solve(content, outlines)) | {"outlines": outlines}
            case "line":
                return {"line": self._line(content["photo"], content["pixel"], content["other"])}
            case "stop":
                return {"message": "Closed. This page may be left.", "closes": True}
        return None

    def _save(self, content: dict[str, Any]) -> str:
        write_tracing(parse_tracing(content, "the page", self.model.views), self.file)
        self.saved = content["traced"]
        return f"saved: {self.file.name}"

    def _solve(self, content: dict[str, Any], outlines: dict[str, Any]) -> str:
        solved = self.model.solved(parse_tracing(content, "the page", self.model.views))
        back = solved.placed.similarity
        for name, view in self.model.views.items():
            outlines[name] = []
            for building in solved.buildings:
                points = (building.roof.points - back.translation) @ back.rotation / back.scale
                pixels = view.project(points)
                if np.isfinite(pixels).all():
                    outlines[name].append(np.round(pixels, 1).tolist())
        return self._describe(solved)

    def _line(self, photo: str, pixel: Any, other: str) -> list[list[float]]:
        """Returns where another photo shows the ray of a pixel, (N, 2) pixels."""
        view, points = self.model.views[photo], self.model.points
        ray = view.rays(np.array(pixel, np.float64).reshape(1, 2))[0]
        depths = (points - view.pose.center) @ ray
        depths = depths[depths > 0]
        if not len(depths):
            return []
        near, far = np.quantile(depths, _DEPTH_SHARES)
        at = np.geomspace(near / _BEYOND, far * _BEYOND, _LINE_POINTS)
        shown = self.model.views[other].project(view.pose.center + at[:, None] * ray)
        pixels: list[list[float]] = np.round(shown[np.isfinite(shown).all(axis=1)], 1).tolist()
        return pixels

    def _page(self, names: list[str]) -> bytes:
        from jinja2 import Environment

        template = files("lodbench.harness").joinpath("templates/trace.html.jinja")
        environment = Environment(autoescape=True)
        page = environment.from_string(template.read_text(encoding="utf-8"))
        return page.render(file=self.file.name, names=names, traced=self.saved).encode()
