"""Masks in files of programs that draw polygons: LabelMe, COCO and GeoJSON, and back from the first two."""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any
from unicodedata import normalize

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.errors import DatasetError
from lodbench.segmentation.masks import Ring, painted, polygons_of
from lodbench.storage.json_text import parse_json
from lodbench.storage.paths import require_regular

Mask = NDArray[np.bool_]


_LOGGER = logging.getLogger(__name__)

BUILDING, HOLE = "building", "hole"
# Points this far outside are on the photo's edge; polygons of less area, pixels, are none.
_EDGE_PX, _LEAST_PX = 1.0, 1.0
# Labels of other people's files that count as building, in small letters.
_BUILDING_LABELS = (BUILDING, "buildings", "house", "houses", "roof", "roofs")


def labelme_of(mask: Mask, photo: str) -> dict[str, Any]:
    """Returns a mask as LabelMe's JSON values: a polygon per part, one labelled ``hole`` per hole."""
    shapes = []
    # They are painted in this order: a part in another's hole after that hole.
    for polygon in sorted(polygons_of(mask), key=lambda part: -cv2.contourArea(part.outer)):
        for label, ring in ((BUILDING, polygon.outer), *((HOLE, hole) for hole in polygon.holes)):
            points = (ring + 0.5).tolist()
            shape = {"label": label, "points": points, "group_id": None, "shape_type": "polygon", "flags": {}}
            shapes.append(shape)
    height, width = mask.shape
    image = {"imagePath": photo, "imageData": None, "imageHeight": height, "imageWidth": width}
    return {"version": "5.4.1", "flags": {}, "shapes": shapes, **image}


def coco_of(mask: Mask, photo: str) -> dict[str, Any]:
    """Returns a mask as COCO's JSON values, an annotation per part: run lengths where it has holes."""
    height, width = mask.shape
    annotations = []
    for number, polygon in enumerate(polygons_of(mask), start=1):
        (x, y), part = painted(polygon)
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
    image = {"id": 1, "file_name": photo, "width": width, "height": height}
    categories = [{"id": 1, "name": BUILDING}]
    return {"images": [image], "categories": categories, "annotations": annotations}


def geojson_of(mask: Mask, photo: str) -> dict[str, Any]:
    """Returns a mask as GeoJSON in pixels, rows counted down from 0, as QGIS shows a photo without place."""
    features = []
    for polygon in polygons_of(mask):
        rings = [_closed(ring) for ring in (polygon.outer, *polygon.holes) if len(ring) > 2]
        if rings:
            geometry = {"type": "Polygon", "coordinates": rings}
            properties = {"label": BUILDING, "photo": photo}
            features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    return {"type": "FeatureCollection", "features": features}


FORMATS: dict[str, Callable[[Mask, str], dict[str, Any]]] = {
    "labelme": labelme_of,
    "coco": coco_of,
    "geojson": geojson_of,
}


def polygon_text(name: str, mask: Mask, photo: str) -> str:
    """Returns the text of a file of a format, by its name, that holds the mask of a photo of a name."""
    return json.dumps(FORMATS[name](mask, photo), indent=1) + "\n"


def polygon_file(mask: Path, name: str) -> Path:
    """Returns where polygons of a format lie beside a mask; ``.geojson`` is an ending of its own."""
    return mask.with_suffix(".geojson" if name == "geojson" else f".{name}.json")


def read_polygons(path: Path, photo: str, height: int, width: int) -> Mask:
    """Returns the (height, width) mask in a LabelMe or COCO file; of several images, the photo's.

    What is labelled as something else is left out, with a warning, as are polygons without an area in the
    photo; points outside are counted.

    Raises:
        DatasetError: It is neither, is of another photo by its name or size, holds a shape that is no
            polygon, nothing labelled as a building, no building inside the photo, or several images of
            the photo's name.
    """
    require_regular(path)
    try:
        # Some editors begin a file with a byte order mark.
        stored = parse_json(path.read_text(encoding="utf-8-sig"))
        if isinstance(stored, dict) and "shapes" in stored:
            return _from_labelme(stored, path, photo, height, width)
        if isinstance(stored, dict) and "annotations" in stored:
            return _from_coco(stored, path, photo, height, width)
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        hint = "It takes polygons; a mask that is a picture is given with `--mask`."
        raise DatasetError(f"{path.name} is not a JSON file.", hint) from error
    except (KeyError, IndexError, TypeError, ValueError, OverflowError) as error:
        raise DatasetError(f"{path.name} cannot be read: {type(error).__name__} {error}.", _HINT) from error
    raise DatasetError(f"{path.name} is neither LabelMe's JSON nor COCO's.", _HINT)


_HINT = "LabelMe has shapes, COCO has images, categories and annotations."


def _from_labelme(stored: dict[str, Any], path: Path, photo: str, height: int, width: int) -> Mask:
    named = str(stored.get("imagePath") or photo)
    if not _means(named, photo):
        raise _other_photo(path, named, photo, "imagePath")
    _check_size(path, int(stored["imageWidth"]), int(stored["imageHeight"]), width, height)
    labels = [str(shape["label"]) for shape in stored["shapes"]]
    kinds = [label for label in labels if not _is_one_of(label, (HOLE,))]
    _check_labels(kinds, kinds, path)
    canvas = _Canvas(np.zeros((height, width), np.uint8))
    for shape, label in zip(stored["shapes"], labels, strict=True):
        is_hole, kind = _is_one_of(label, (HOLE,)), shape.get("shape_type", "polygon")
        if not is_hole and not _is_one_of(label):
            continue
        if kind not in ("polygon", "rectangle"):
            raise DatasetError(f"{path.name} holds a {kind}.", "Only polygons and rectangles are read.")
        points = np.array(shape["points"], np.float64).reshape(-1, 2)
        if kind == "rectangle" and len(points) == 2:
            (x, y), (right, down) = points
            points = np.array([[x, y], [right, y], [right, down], [x, down]])
        canvas.paint(points, 0 if is_hole else 1)
    return canvas.mask(len(labels), path)


def _from_coco(stored: dict[str, Any], path: Path, photo: str, height: int, width: int) -> Mask:
    image = _image_of(stored["images"], path, photo)
    _check_size(path, int(image["width"]), int(image["height"]), width, height)
    names = {str(c["id"]): str(c["name"]) for c in stored["categories"]}
    # Some programs write one id as a number and as text.
    wanted = [a for a in stored["annotations"] if str(a["image_id"]) == str(image["id"])]
    if stored["annotations"] and not wanted and len(stored["images"]) == 1:
        raise DatasetError(f"{path.name} has annotations, none of them of its image {image['id']}.", _HINT)
    labels = [names[str(annotation["category_id"])] for annotation in wanted]
    _check_labels(names.values(), labels, path)
    canvas = _Canvas(np.zeros((height, width), np.uint8))
    for annotation, label in zip(wanted, labels, strict=True):
        if not _is_one_of(label):
            continue
        segmentation = annotation.get("segmentation")
        if not segmentation:
            raise DatasetError(
                f"{path.name}: a {label} has no outline.", "Boxes are no masks: export polygons."
            )
        if isinstance(segmentation, dict):
            canvas.pixels[_from_runs(segmentation, path, height, width)] = 1
            continue
        for ring in segmentation:
            canvas.paint(np.array(ring, np.float64).reshape(-1, 2), 1)
    return canvas.mask(len(labels), path)


def _image_of(images: list[dict[str, Any]], path: Path, photo: str) -> dict[str, Any]:
    """Returns the image of a photo's name; the only one where its name differs in the ending alone."""
    matches = [image for image in images if _name_of(str(image["file_name"])) == _name_of(photo)]
    if len(matches) > 1:
        names = " and ".join(str(image["file_name"]) for image in matches[:2])
        raise DatasetError(
            f"{path.name} has {len(matches)} images called {photo}: {names}.", "Export the one alone."
        )
    if not matches and len(images) != 1:
        raise DatasetError(f"{path.name} has {len(images)} images, none of them {photo}.")
    if not matches and not _means(str(images[0]["file_name"]), photo):
        raise _other_photo(path, str(images[0]["file_name"]), photo, "file_name")
    return (matches or images)[0]


def _means(named: str, photo: str) -> bool:
    """Returns whether a file names a photo: in whatever folder, format and case of letters."""
    return PurePosixPath(_name_of(named)).stem.lower() == PurePosixPath(_name_of(photo)).stem.lower()


def _name_of(path: str) -> str:
    """Returns the last name of a path of either kind of system; letters of macOS are two characters."""
    return normalize("NFC", PureWindowsPath(path).name)


def _other_photo(path: Path, named: str, photo: str, key: str) -> DatasetError:
    return DatasetError(
        f"{path.name} is of {PureWindowsPath(named).name}, not of {photo}.",
        f"If it is the same photo, change {key} in it to {photo}.",
    )


@dataclass(slots=True)
class _Canvas:
    """A photo's pixels that polygons are painted on, and what of them was lost."""

    pixels: NDArray[np.uint8]  # (H, W), 1 where a building is
    polygons: int = 0  # how many were painted, or should have been
    lost: int = 0  # how many of them have no area in the photo: they vanish
    points: int = 0  # how many corners they have
    outside: int = 0  # how many of these lie outside the photo, by more than a line's width
    high: tuple[float, float] = (0.0, 0.0)  # largest x and y of a corner

    def paint(self, points: NDArray[np.float64], value: int) -> None:
        """Paints a polygon; its points, (N, 2), count from the first pixel's corner."""
        if not np.isfinite(points).all() or np.abs(points).max(initial=0) > 1e6:
            raise ValueError("a point that is no pixel")
        size = np.array(self.pixels.shape[::-1])
        is_outside = ((points < -_EDGE_PX) | (points > size + _EDGE_PX)).any(axis=1)
        inside = np.clip(points, 0, size).astype(np.float32)
        self.polygons += 1
        self.points += len(points)
        self.outside += int(is_outside.sum())
        x, y = np.max(points, axis=0, initial=0.0)
        self.high = max(self.high[0], float(x)), max(self.high[1], float(y))
        # The hull, as a ring that crosses itself may have no area by the formula.
        if len(points) < 3 or cv2.contourArea(cv2.convexHull(inside)) < _LEAST_PX:
            self.lost += 1
        else:
            cv2.fillPoly(self.pixels, [np.rint((points - 0.5) * 16).astype(np.int32)], value, shift=4)

    def mask(self, num_shapes: int, path: Path) -> Mask:
        """Returns what was painted; warns of points outside the photo, and of polygons that vanish.

        Raises:
            DatasetError: There are shapes, and nothing of them lies in the photo.
        """
        if num_shapes and not self.pixels.any():
            raise DatasetError(f"{path.name} has no building inside the photo{self._lost()}.", self._hint())
        if self.outside or self.lost:
            _LOGGER.warning("%s%s. %s", path.name, self._lost(), self._hint())
        return np.asarray(self.pixels > 0)

    def _lost(self) -> str:
        """Returns in words what was lost of the polygons."""
        notes = []
        if self.outside:
            notes.append(f"{self.outside} of {self.points} points lie outside the photo")
        if self.lost:
            notes.append(f"{self.lost} of {self.polygons} polygons without an area in it are left out")
        return f": {'; '.join(notes)}" if notes else ""

    def _hint(self) -> str:
        """Returns what may be wrong with the points."""
        (x, y), (height, width) = self.high, self.pixels.shape
        if self.polygons and max(x, y) <= 1:
            return "Are they fractions of the photo? Points are pixels, x to the right, y down."
        if self.outside and x <= height + _EDGE_PX and y <= width + _EDGE_PX:
            return "Are x and y exchanged? Points are pixels, x to the right, y down."
        return "Draw on the photo itself."


def _is_one_of(label: str, names: Collection[str] = _BUILDING_LABELS) -> bool:
    return label.strip().lower() in names


def _check_labels(known: Collection[str], used: Collection[str], path: Path) -> None:
    """Warns of shapes whose labels are no building's."""
    if known and not any(map(_is_one_of, known)):
        raise DatasetError(
            f"{path.name} shows no building: its labels are {', '.join(sorted(set(known)))}.",
            f"What counts is labelled as one of {', '.join(_BUILDING_LABELS)}.",
        )
    others = Counter(label for label in used if not _is_one_of(label))
    if others:
        stated = ", ".join(f"{label} ({count})" for label, count in sorted(others.items()))
        _LOGGER.warning("%s: left out, for they are no buildings: %s.", path.name, stated)


def _check_size(path: Path, width: int, height: int, photo_width: int, photo_height: int) -> None:
    if (width, height) != (photo_width, photo_height):
        raise DatasetError(
            f"{path.name} is of a photo of {width} x {height}, this one has {photo_width} x {photo_height}.",
            "Draw on the photo as it is stored.",
        )


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
    # Numbers of any size: a sum of 64 bits may wrap around to that of the photo.
    lengths = [int(length) for length in counts]
    is_of_photo = list(segmentation.get("size", [height, width])) == [height, width]
    if not is_of_photo or sum(lengths) != height * width or min(lengths) < 0:
        raise ValueError("run lengths that do not fill the photo")
    values = np.arange(len(lengths)) % 2 == 1
    return np.repeat(values, lengths).reshape(width, height).T


def _closed(ring: Ring) -> list[list[float]]:
    points = np.vstack([ring, ring[:1]]) + 0.5
    return [[float(x), -float(y)] for x, y in points]
