"""Masks as polygons, for programs that draw them: LabelMe, COCO and GeoJSON, and back from the first two."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.errors import DatasetError
from lodbench.storage import write_text
from lodbench.storage.json_text import parse_json

Mask = NDArray[np.bool_]
Ring = NDArray[np.int32]

BUILDING, HOLE = "building", "hole"
# Labels of other people's files that count as building, in small letters.
_BUILDING_LABELS = (BUILDING, "buildings", "house", "roof")


class MaskPolygon(NamedTuple):
    """One connected part of a mask.

    Attributes:
        outer: (N, 2) its outermost pixels, column and row, in order.
        holes: The same of each hole in it.
    """

    outer: Ring
    holes: tuple[Ring, ...]


def polygons_of(mask: Mask) -> list[MaskPolygon]:
    """Returns a mask's connected parts, largest first; ``mask_of`` gives the same mask to the pixel."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    order = sorted(range(1, count), key=lambda label: -int(stats[label, cv2.CC_STAT_AREA]))
    return [_polygon(np.asarray(labels == label)) for label in order]


def mask_of(polygons: list[MaskPolygon], height: int, width: int) -> Mask:
    """Returns the (height, width) mask of polygons, painted in order: each, then its holes taken out."""
    canvas = np.zeros((height, width), np.uint8)
    for polygon in polygons:
        cv2.fillPoly(canvas, [polygon.outer], 1)
        for hole in polygon.holes:
            cv2.fillPoly(canvas, [hole], 0)
    return np.asarray(canvas > 0)


def write_labelme(mask: Mask, photo: Path, path: Path) -> None:
    """Writes a mask as LabelMe's JSON: a polygon per part, one labelled ``hole`` per hole."""
    shapes = []
    for polygon in polygons_of(mask):
        for label, ring in ((BUILDING, polygon.outer), *((HOLE, hole) for hole in polygon.holes)):
            points = (ring + 0.5).tolist()
            shape = {"label": label, "points": points, "group_id": None, "shape_type": "polygon", "flags": {}}
            shapes.append(shape)
    height, width = mask.shape
    image = {"imagePath": photo.name, "imageData": None, "imageHeight": height, "imageWidth": width}
    _write({"version": "5.4.1", "flags": {}, "shapes": shapes, **image}, path)


def write_coco(mask: Mask, photo: Path, path: Path) -> None:
    """Writes a mask as COCO's JSON, an annotation per part: run lengths where it has holes."""
    height, width = mask.shape
    annotations = []
    for number, polygon in enumerate(polygons_of(mask), start=1):
        part = mask_of([polygon], height, width)
        rows, columns = np.nonzero(part)
        x, y = int(columns.min()), int(rows.min())
        outline: Any = [(polygon.outer + 0.5).ravel().tolist()]
        annotations.append(
            {
                "id": number,
                "image_id": 1,
                "category_id": 1,
                "area": int(part.sum()),
                "bbox": [x, y, int(columns.max()) - x + 1, int(rows.max()) - y + 1],
                "iscrowd": int(bool(polygon.holes)),
                "segmentation": {"size": [height, width], "counts": _runs(part)}
                if polygon.holes
                else outline,
            }
        )
    image = {"id": 1, "file_name": photo.name, "width": width, "height": height}
    categories = [{"id": 1, "name": BUILDING}]
    _write({"images": [image], "categories": categories, "annotations": annotations}, path)


def write_geojson(mask: Mask, photo: Path, path: Path) -> None:
    """Writes a mask as GeoJSON in pixels, rows counted down from 0, as QGIS shows a photo without a place."""
    features = []
    for polygon in polygons_of(mask):
        rings = [_closed(ring) for ring in (polygon.outer, *polygon.holes) if len(ring) > 2]
        if rings:
            geometry = {"type": "Polygon", "coordinates": rings}
            properties = {"label": BUILDING, "photo": photo.name}
            features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    _write({"type": "FeatureCollection", "features": features}, path)


WRITERS: dict[str, Callable[[Mask, Path, Path], None]] = {
    "labelme": write_labelme,
    "coco": write_coco,
    "geojson": write_geojson,
}


def polygon_file(mask: Path, name: str) -> Path:
    """Returns where polygons of a format lie beside a mask; ``.geojson`` is an ending of its own."""
    return mask.with_suffix(".geojson" if name == "geojson" else f".{name}.json")


def read_polygons(path: Path, photo: str, height: int, width: int) -> Mask:
    """Returns the (height, width) mask in a LabelMe or COCO file; of several images, the photo's.

    Raises:
        DatasetError: It is neither, is of another photo's size, or holds a shape that is no polygon.
    """
    try:
        stored = parse_json(path.read_text(encoding="utf-8"))
        if isinstance(stored, dict) and "shapes" in stored:
            return _from_labelme(stored, path, height, width)
        if isinstance(stored, dict) and "annotations" in stored:
            return _from_coco(stored, path, photo, height, width)
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        hint = "It takes polygons; a mask that is a picture is given with --mask."
        raise DatasetError(f"{path.name} is no JSON file.", hint) from error
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise DatasetError(f"{path.name} cannot be read: {type(error).__name__} {error}.", _HINT) from error
    raise DatasetError(f"{path.name} is neither LabelMe's JSON nor COCO's.", _HINT)


_HINT = "LabelMe has shapes, COCO has images, categories and annotations."


def _from_labelme(stored: dict[str, Any], path: Path, height: int, width: int) -> Mask:
    _check_size(path, int(stored["imageWidth"]), int(stored["imageHeight"]), width, height)
    canvas = np.zeros((height, width), np.uint8)
    for shape in stored["shapes"]:
        label, kind = str(shape["label"]).lower(), shape.get("shape_type", "polygon")
        if label != HOLE and label not in _BUILDING_LABELS:
            continue
        if kind not in ("polygon", "rectangle"):
            raise DatasetError(f"{path.name} holds a {kind}.", "Only polygons and rectangles are read.")
        points = np.array(shape["points"], np.float64).reshape(-1, 2)
        if kind == "rectangle":
            (x, y), (right, down) = points
            points = np.array([[x, y], [right, y], [right, down], [x, down]])
        _paint(canvas, points, 0 if label == HOLE else 1)
    return np.asarray(canvas > 0)


def _from_coco(stored: dict[str, Any], path: Path, photo: str, height: int, width: int) -> Mask:
    images = stored["images"]
    found = [image for image in images if Path(str(image["file_name"])).name == photo]
    if not found and len(images) != 1:
        raise DatasetError(f"{path.name} has {len(images)} images, none of them {photo}.")
    image = (found or images)[0]
    _check_size(path, int(image["width"]), int(image["height"]), width, height)
    buildings = {c["id"] for c in stored["categories"] if str(c["name"]).lower() in _BUILDING_LABELS}
    mask = np.zeros((height, width), bool)
    for annotation in stored["annotations"]:
        if annotation["image_id"] != image["id"] or annotation["category_id"] not in buildings:
            continue
        segmentation = annotation["segmentation"]
        if isinstance(segmentation, dict):
            mask |= _from_runs(segmentation, path, height, width)
            continue
        for ring in segmentation:
            canvas = np.zeros((height, width), np.uint8)
            _paint(canvas, np.array(ring, np.float64).reshape(-1, 2), 1)
            mask |= canvas > 0
    return mask


def _check_size(path: Path, width: int, height: int, photo_width: int, photo_height: int) -> None:
    if (width, height) != (photo_width, photo_height):
        raise DatasetError(
            f"{path.name} is of a photo of {width} x {height}, this one has {photo_width} x {photo_height}.",
            "Draw on the photo as it is stored.",
        )


def _paint(canvas: NDArray[np.uint8], points: NDArray[np.float64], value: int) -> None:
    """Paints a polygon; its points count from the first pixel's corner."""
    if not np.isfinite(points).all() or np.abs(points).max(initial=0) > 1e6:
        raise ValueError("a point that is no pixel")
    cv2.fillPoly(canvas, [np.rint((points - 0.5) * 16).astype(np.int32)], value, shift=4)


def _polygon(part: Mask) -> MaskPolygon:
    outer = _outline(part)
    filled = np.zeros(part.shape, np.uint8)
    cv2.fillPoly(filled, [outer], 1)
    count, labels = cv2.connectedComponents(((filled > 0) & ~part).astype(np.uint8), connectivity=4)
    return MaskPolygon(outer, tuple(_outline(np.asarray(labels == label)) for label in range(1, count)))


def _outline(part: Mask) -> Ring:
    contours, _ = cv2.findContours(part.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return np.asarray(contours[0][:, 0], np.int32)


def _runs(part: Mask) -> list[int]:
    """Returns COCO's uncompressed run lengths: column by column, zeros first."""
    flat = part.T.ravel()
    changes = np.flatnonzero(np.diff(np.concatenate([[False], flat])))
    return [int(length) for length in np.diff(np.concatenate([[0], changes, [flat.size]]))]


def _from_runs(segmentation: dict[str, Any], path: Path, height: int, width: int) -> Mask:
    counts = segmentation["counts"]
    if isinstance(counts, str):
        raise DatasetError(f"{path.name} holds compressed run lengths.", "Export polygons instead.")
    lengths = np.array(counts, np.int64)
    if lengths.sum() != height * width or (lengths < 0).any():
        raise ValueError("run lengths that do not fill the photo")
    values = np.arange(len(lengths)) % 2 == 1
    return np.repeat(values, lengths).reshape(width, height).T


def _closed(ring: Ring) -> list[list[float]]:
    points = np.vstack([ring, ring[:1]]) + 0.5
    return [[float(x), -float(y)] for x, y in points]


def _write(content: dict[str, Any], path: Path) -> None:
    write_text(path, json.dumps(content, indent=1) + "\n")
