"""Masks as polygons, for programs that draw them: LabelMe, COCO and GeoJSON, and back from the first two."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
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
Corner = tuple[int, int]

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
    parts = sorted(_parts(mask, 8), key=lambda found: -int(found[1].sum()))
    return [_polygon(part, corner) for corner, part in parts]


def mask_of(polygons: list[MaskPolygon], height: int, width: int) -> Mask:
    """Returns the (height, width) mask of polygons within it: all of them, each without its holes."""
    mask = np.zeros((height, width), bool)
    for polygon in polygons:
        (x, y), part = _painted(polygon)
        mask[y : y + part.shape[0], x : x + part.shape[1]] |= part
    return mask


def write_labelme(mask: Mask, photo: Path, path: Path) -> None:
    """Writes a mask as LabelMe's JSON: a polygon per part, one labelled ``hole`` per hole."""
    shapes = []
    # They are painted in this order: a part in another's hole after that hole.
    for polygon in sorted(polygons_of(mask), key=lambda part: -cv2.contourArea(part.outer)):
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
        (x, y), part = _painted(polygon)
        outline: Any = [(polygon.outer + 0.5).ravel().tolist()]
        annotations.append(
            {
                "id": number,
                "image_id": 1,
                "category_id": 1,
                "area": int(part.sum()),
                "bbox": [x, y, part.shape[1], part.shape[0]],
                "iscrowd": int(bool(polygon.holes)),
                "segmentation": {"size": [height, width], "counts": _runs(part, x, y, height, width)}
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
    canvas = np.zeros((height, width), np.uint8)
    for annotation in stored["annotations"]:
        if annotation["image_id"] != image["id"] or annotation["category_id"] not in buildings:
            continue
        segmentation = annotation["segmentation"]
        if isinstance(segmentation, dict):
            canvas[_from_runs(segmentation, path, height, width)] = 1
            continue
        for ring in segmentation:
            _paint(canvas, np.array(ring, np.float64).reshape(-1, 2), 1)
    return np.asarray(canvas > 0)


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


def _parts(mask: Mask, connectivity: int) -> Iterator[tuple[Corner, Mask]]:
    """Yields left and top of the box of each connected part, and the part in it."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        mask.astype(np.uint8), connectivity=connectivity
    )
    for label in range(1, count):
        x, y, width, height = (int(value) for value in stats[label, :4])
        yield (x, y), np.asarray(labels[y : y + height, x : x + width] == label)


def _polygon(part: Mask, corner: Corner) -> MaskPolygon:
    outer = _outline(part)
    holes = [
        ring + place
        for place, hole in _parts(_filled(outer, part.shape) & ~part, 4)
        for ring in _hole_outlines(hole, part[place[1] :, place[0] :][: hole.shape[0], : hole.shape[1]])
    ]
    return MaskPolygon(outer + corner, tuple(np.asarray(hole + corner, np.int32) for hole in holes))


def _hole_outlines(hole: Mask, part: Mask) -> Iterator[Ring]:
    """Yields outlines that hold a hole and nothing of the (H, W) part around it.

    A hole may close round some of the part but for a corner, which an outline cuts: it is parted there.
    """
    ring = _outline(hole)
    rows = np.flatnonzero((_filled(ring, hole.shape) & part).any(axis=1))
    if not len(rows):
        yield ring
        return
    for first, last in ((0, rows[0]), (rows[0], len(hole))):
        for (x, y), piece in _parts(hole[first:last], 4):
            around = part[first + y :, x:][: piece.shape[0], : piece.shape[1]]
            for found in _hole_outlines(piece, around):
                yield np.add(found, (x, first + y), dtype=np.int32)


def _outline(part: Mask) -> Ring:
    contours, _ = cv2.findContours(part.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return np.asarray(contours[0][:, 0], np.int32)


def _filled(ring: Ring, shape: tuple[int, ...]) -> Mask:
    return cv2.fillPoly(np.zeros(shape, np.uint8), [ring], 1) > 0


def _painted(polygon: MaskPolygon) -> tuple[Corner, Mask]:
    """Returns left and top of a polygon's box, and its mask in it."""
    corner, end = polygon.outer.min(axis=0), polygon.outer.max(axis=0) + 1
    canvas = np.zeros((end - corner)[::-1], np.uint8)
    cv2.fillPoly(canvas, [polygon.outer - corner], 1)
    for hole in polygon.holes:
        cv2.fillPoly(canvas, [hole - corner], 0)
    return (int(corner[0]), int(corner[1])), np.asarray(canvas > 0)


def _runs(part: Mask, x: int, y: int, height: int, width: int) -> list[int]:
    """Returns COCO's uncompressed run lengths of a part at a place: column by column, zeros first."""
    columns, rows = np.nonzero(part.T)
    places = (columns + x) * height + rows + y
    is_first = np.diff(places, prepend=-2) > 1
    is_last = np.append(is_first[1:], True)
    ends = np.column_stack([places[is_first], places[is_last] + 1]).ravel()
    ends = ends[:-1] if ends[-1] == height * width else ends
    return [int(length) for length in np.diff(ends, prepend=0, append=height * width)]


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
