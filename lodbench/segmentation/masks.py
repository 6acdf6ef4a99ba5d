"""``segmenter=masks``, ``instances``, ``classes``: masks and labels made beforehand, from folders."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.inputs import Input, masks_of_labels, read_classes, read_labels
from lodbench.datasets.own import find_mask
from lodbench.datasets.query import Entry
from lodbench.errors import QueryFault
from lodbench.photos.pictures import decoded, has_too_many_pixels, in_8_bits
from lodbench.storage import digest_of
from lodbench.storage.digest import content_digest, read_content
from lodbench.storage.paths import require_regular

Mask = NDArray[np.bool_]
Ring = NDArray[np.int32]
Corner = tuple[int, int]
# What a mask is.
_WHITE = "A mask is a grey picture, PNG for example: buildings are white, all else is black."
# Every so many pixels are looked at: shares of areas need no more.
_STRIDE = 3


def read_mask(path: str | Path) -> NDArray[np.float32]:
    """Returns an 8 or 16 bit grey image as (H, W) float32 in [0, 1]: white is building.

    Grey may be stored as RGB or RGBA with equal channels and the same alpha everywhere.

    Raises:
        QueryFault: The file is missing, is no image or has too many pixels, its channels differ
            (colours or class labels, an overlay), or its largest value is 1 (labels 0 and 1).
        DatasetError: It is a pipe or a device.
    """
    require_regular(Path(path))
    name = Path(path).name
    try:
        content = read_content(Path(path))
    except OSError as error:
        raise QueryFault(f"mask {name} cannot be read: {error.strerror}", "Check the path.") from error
    if has_too_many_pixels(content):
        raise QueryFault(f"mask {name} has too many pixels", "Scale it down.")
    image = decoded(content, as_stored=True)
    white = {"uint8": 255, "uint16": 65535}.get(str(image.dtype)) if image is not None else None
    if image is None or white is None:
        raise QueryFault(f"mask {name} is not a readable 8 or 16 bit image", _WHITE)
    grey = _grey(image, name)
    if grey.max() == 1:
        raise QueryFault(f"mask {name}: its largest value is 1; {white} means building", _WHITE)
    return np.asarray(grey, dtype=np.float32) / np.float32(white)


def _grey(image: NDArray[Any], name: str) -> NDArray[Any]:
    """Returns the one channel of a decoded image."""
    if image.ndim == 2:
        return image
    colours, alpha = image[:, :, :3], image[:, :, 3:]
    if image.shape[2] == 2:
        colours, alpha = image[:, :, :1], image[:, :, 1:]
    if (colours != colours[:, :, :1]).any():
        raise QueryFault(f"mask {name} is in colour: white means building, in a grey image", _WHITE)
    if (alpha != alpha[:1, :1]).any():
        raise QueryFault(f"mask {name} has an alpha channel that varies: white means building, without alpha")
    return colours[:, :, 0]


class _LabelFiles:
    """Reads labels that a dataset stores for each query, in a folder called as the segmenter."""

    name: str

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Returns the (H, W) float32 mask, 0 or 1: 1 where there is a label.

        Raises:
            QueryFault: There are no labels for this query, or they cannot be read.
        """
        return np.asarray(self._labels(entry) > 0, dtype=np.float32)

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns a digest of the label files' names and contents."""
        return digest_of([[entry.key, content_digest(getattr(entry, self.name))] for entry in entries])

    def _labels(self, entry: Entry) -> NDArray[Any]:
        path: Path | None = getattr(entry, self.name)
        if path is None:
            raise QueryFault(f"no labels in the {self.name} folder")
        return read_classes(path) if self.name == "classes" else read_labels(path)


@dataclass(frozen=True, slots=True)
class ClassFilesParams:
    """Settings of ``segmenter=classes``: none."""

    name: str = "classes"


class ClassFiles(_LabelFiles):
    """Reads each query's labels of roofs and walls from the dataset."""

    params_type = ClassFilesParams
    name = "classes"
    requires = frozenset({Input.CLASSES})
    provides = frozenset({Input.MASK, Input.CLASSES})

    def __init__(self, params: ClassFilesParams) -> None:
        self.params = params

    def segment_classes(self, entry: Entry) -> NDArray[np.uint8]:
        """Returns (H, W) uint8, 1 for roofs, 2 for walls, 0 for all else.

        Raises:
            QueryFault: There are no labels for this query, or they cannot be read.
        """
        return self._labels(entry)


@dataclass(frozen=True, slots=True)
class MasksParams:
    """Settings of ``segmenter=masks``.

    Attributes:
        folder: Of masks named as the photos; None for the dataset's own.
    """

    name: str = "masks"
    folder: str | None = None


class MaskFiles:
    """Reads each query's mask from the dataset."""

    params_type = MasksParams
    name = "masks"
    requires = frozenset({Input.MASK})
    provides = frozenset({Input.MASK})

    def __init__(self, params: MasksParams) -> None:
        self.params = params

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Returns the (H, W) float32 probability of building, in [0, 1].

        Raises:
            QueryFault: There is no mask for this query, or it cannot be read.
        """
        mask = self._file(entry)
        if mask is None:
            raise QueryFault(f"no mask in {self.params.folder or 'the masks folder'}")
        return read_mask(mask)

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns a digest of the mask files' names and contents."""
        return digest_of([[entry.key, content_digest(self._file(entry))] for entry in entries])

    def _file(self, entry: Entry) -> Path | None:
        if self.params.folder is None:
            return entry.mask
        return find_mask(Path(self.params.folder).expanduser(), entry.name, entry.image)


@dataclass(frozen=True, slots=True)
class NoMaskParams:
    """Settings of ``segmenter=none``: none."""

    name: str = "none"


class NoMask:
    """Makes no mask."""

    params_type = NoMaskParams
    name = "none"
    requires: frozenset[Input] = frozenset()
    provides: frozenset[Input] = frozenset()

    def __init__(self, params: NoMaskParams) -> None:
        self.params = params

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Never answers.

        Raises:
            QueryFault: Always.
        """
        raise QueryFault("segmenter=none makes no masks")

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns nothing: there is nothing that answers could depend on."""
        return ""


# Masks of buildings are handed over at most this long, pixels: a photo has hundreds.
_LONGER_SIDE = 1024


@dataclass(frozen=True, slots=True)
class InstanceFilesParams:
    """Settings of ``segmenter=instances``: none."""

    name: str = "instances"


class InstanceFiles(_LabelFiles):
    """Reads each query's labels of buildings from the dataset."""

    params_type = InstanceFilesParams
    name = "instances"
    requires = frozenset({Input.INSTANCES})
    provides = frozenset({Input.MASK, Input.INSTANCES})

    def __init__(self, params: InstanceFilesParams) -> None:
        self.params = params

    def segment_instances(self, entry: Entry) -> NDArray[np.bool_]:
        """Returns (N, h, w) bool, at most 1024 pixels on the longer side.

        Raises:
            QueryFault: As for ``segment``, or there are more labels than masks of 1 GB together hold.
        """
        labels = self._labels(entry)
        height, width = labels.shape
        scale = _LONGER_SIDE / max(height, width)
        if scale < 1:
            size = (max(1, round(width * scale)), max(1, round(height * scale)))
            labels = np.asarray(cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST_EXACT), np.uint16)
        return masks_of_labels(labels)


def mapped_overlap(silhouette: Mask, mask: Mask) -> float:
    """Returns how much more of the mapped buildings than of their surroundings a mask holds.

    Eq. (C15) of docs/methods/contour_alignment.md.

    1 where both agree around the map's buildings, 0 where they do by chance; the surroundings are the pixels
    nearest to the silhouette, as many as it has. Buildings further off, which the map may lack, do not count.
    For masks that err little it is the IoU; an empty silhouette has 0.

    Args:
        silhouette: (H, W) of the map's buildings.
        mask: (H, W) of all buildings of the photo.
    """
    mapped = np.ascontiguousarray(silhouette[::_STRIDE, ::_STRIDE])
    shown = mask[::_STRIDE, ::_STRIDE]
    inside = int(np.count_nonzero(mapped))
    if inside == 0:
        return 0.0
    held = np.count_nonzero(shown & mapped) / inside
    away = cv2.distanceTransform((~mapped).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[~mapped]
    if len(away) == 0:
        return held
    near = away <= np.partition(away, min(inside, len(away)) - 1)[min(inside, len(away)) - 1]
    return held - float(np.mean(shown[~mapped][near]))


def read_photo(path: str | Path) -> NDArray[np.uint8]:
    """Returns an image file as (H, W, 3) uint8 RGB, in the order of its pixels in the file.

    16 bits are brought to 8 over the range in use, grey is repeated, transparent pixels show black.
    A turn that EXIF asks for is not made: the camera and its pose are those of the file's pixels.

    Raises:
        QueryFault: The file is missing or no image, has too many pixels, or neither 8 nor 16 bits.
    """
    name = Path(path).name
    try:
        content = read_content(Path(path))
    except OSError as error:
        raise QueryFault(f"photo {name} cannot be read: {error.strerror}", "Check the path.") from error
    return photo_of(content, name)


def photo_of(content: bytes, name: str) -> NDArray[np.uint8]:
    """Returns the bytes of an image file as `read_photo` does.

    Raises:
        QueryFault: They are no image, have too many pixels, or neither 8 nor 16 bits nor, without alpha,
            floating-point numbers.
    """
    if has_too_many_pixels(content):
        raise QueryFault(f"photo {name} has too many pixels", "Scale it down.")
    image = decoded(content, as_stored=True)
    has_alpha = image is not None and image.shape[2:] in ((2,), (4,))
    # Radiometric thermal photos have 32 bits, floating-point.
    kinds = ("uint8", "uint16") if has_alpha else ("uint8", "uint16", "float32")
    if image is None or str(image.dtype) not in kinds:
        raise QueryFault(f"photo {name} is not a readable 8 or 16 bit image", "Is it a JPEG, PNG or TIFF?")
    return as_rgb(image)


def as_rgb(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Returns a decoded image, (H, W) or (H, W, 1 to 4) in OpenCV's order, as RGB; float32 has no alpha."""
    if image.ndim == 2:
        image = image[:, :, None]
    has_alpha = image.shape[2] in (2, 4)
    colours, alpha = (image[:, :, :-1], image[:, :, -1:]) if has_alpha else (image, None)
    colours = in_8_bits(colours)
    if alpha is not None:
        share = alpha.astype(np.float32) / np.float32(np.iinfo(image.dtype).max)
        colours = (colours * share + 0.5).astype(np.uint8)
    is_grey = colours.shape[2] == 1
    return np.ascontiguousarray(np.repeat(colours, 3, axis=2) if is_grey else colours[:, :, ::-1])


class MaskPolygon(NamedTuple):
    """One connected part of a mask."""

    outer: Ring  # (N, 2) its outermost pixels, column and row, in order
    holes: tuple[Ring, ...]  # the same of each hole in it


def polygons_of(mask: Mask) -> list[MaskPolygon]:
    """Returns a mask's connected parts, largest first; ``mask_of`` gives the same mask to the pixel."""
    parts = sorted(_parts(mask, 8), key=lambda found: -int(found[1].sum()))
    return [_polygon(part, corner) for corner, part in parts]


def mask_of(polygons: list[MaskPolygon], height: int, width: int) -> Mask:
    """Returns the (height, width) mask of polygons within it: all of them, each without its holes."""
    mask = np.zeros((height, width), bool)
    for polygon in polygons:
        (x, y), part = painted(polygon)
        mask[y : y + part.shape[0], x : x + part.shape[1]] |= part
    return mask


def painted(polygon: MaskPolygon) -> tuple[Corner, Mask]:
    """Returns left and top of a polygon's box, and its mask in it."""
    corner, end = polygon.outer.min(axis=0), polygon.outer.max(axis=0) + 1
    canvas = np.zeros((end - corner)[::-1], np.uint8)
    cv2.fillPoly(canvas, [polygon.outer - corner], 1)
    for hole in polygon.holes:
        cv2.fillPoly(canvas, [hole - corner], 0)
    return (int(corner[0]), int(corner[1])), np.asarray(canvas > 0)


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
            surroundings = part[first + y :, x:][: piece.shape[0], : piece.shape[1]]
            for outline in _hole_outlines(piece, surroundings):
                yield np.add(outline, (x, first + y), dtype=np.int32)


def _outline(part: Mask) -> Ring:
    contours, _ = cv2.findContours(part.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return np.asarray(contours[0][:, 0], np.int32)


def _filled(ring: Ring, shape: tuple[int, ...]) -> Mask:
    return cv2.fillPoly(np.zeros(shape, np.uint8), [ring], 1) > 0
