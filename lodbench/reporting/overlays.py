"""Pictures of queries: the photo, the query mask, and the model's outline at prior, estimate and truth."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import Camera, Pose
from lodbench.photos.pictures import read_picture
from lodbench.rendering import Renderer
from lodbench.storage import write_bytes
from lodbench.storage.disk import writable

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]

# Pictures are drawn at this width, pixels: a screen's half. In pages they are JPEGs of this quality.
_WIDTH, _JPEG_QUALITY = 900, 82
# BGR: distinguished with any colour vision, on dark and on light; bright ones of the hues that maps and
# views in three dimensions have: orange, blue, magenta.
PRIOR_COLOUR, ESTIMATE_COLOUR, TRUTH_COLOUR = (64, 112, 255), (255, 208, 64), (214, 80, 255)
# Of the answer that an estimate is compared with.
SECOND_COLOUR = (64, 232, 255)
_MASK_COLOUR = (80, 190, 240)
_MASK_SHARE = 0.38
_INK, _PAPER = (235, 235, 235), (32, 28, 26)


@dataclass(frozen=True, slots=True, eq=False)
class OverlayInput:
    """What an overlay shows; poses are in the renderer's scene frame, None where there is none."""

    camera: Camera  # intrinsics of the full-size image
    mask: Mask | None  # (H, W) query mask of any size of the same aspect, or None
    image: Path | Picture | None  # the photo, as a file or its pixels, or None
    prior: Pose | None  # where the method started
    estimate: Pose | None  # what it answered
    truth: Pose | None  # where the camera was
    caption: str  # line of text under the picture


def draw_overlay(shown: OverlayInput, renderer: Renderer) -> Picture:
    """Returns the picture, (H, W, 3) BGR, with a caption and a legend below."""
    import cv2

    camera = camera_of_pictures(shown.camera)
    canvas = read_background(shown.image, camera)
    if shown.mask is not None:
        mask = cv2.resize(shown.mask.astype(np.uint8), (camera.width, camera.height)) > 0
        tint = np.array(_MASK_COLOUR, dtype=np.float64)
        canvas[mask] = ((1.0 - _MASK_SHARE) * canvas[mask] + _MASK_SHARE * tint).astype(np.uint8)
    for pose, colour, thickness in (
        (shown.truth, TRUTH_COLOUR, 2),
        (shown.prior, PRIOR_COLOUR, 1),
        (shown.estimate, ESTIMATE_COLOUR, 1),
    ):
        if pose is not None:
            draw_outline(canvas, renderer.render(camera, pose), colour, thickness)
    return np.vstack([canvas, _caption(shown, camera.width)])


def draw_outline(canvas: Picture, mask: Mask, colour: tuple[int, ...], thickness: int) -> None:
    """Draws the outline of an (H, W) mask, holes included, on an (H, W, 3) BGR or (H, W, 4) BGRA picture."""
    import cv2

    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(canvas, outlines, -1, colour, thickness, cv2.LINE_AA)


def camera_of_pictures(camera: Camera) -> Camera:
    """Returns a photo's camera at the size that pictures are drawn in."""
    width = min(_WIDTH, camera.width)
    return camera.scaled_to_width(width)


def outline_layer(masks: Iterable[Mask], colour: tuple[int, int, int], thickness: int) -> bytes:
    """Returns the outlines of (H, W) masks of one size on nothing, a WebP to lay over a photo as large."""
    shapes = list(masks)
    canvas = np.zeros((*shapes[0].shape, 4), dtype=np.uint8)
    # The colour is everywhere, and only how much of it is seen is drawn: smoothed edges are not darker.
    canvas[..., :3] = colour
    for mask in shapes:
        draw_outline(canvas, mask, (*colour, 255), thickness)
    return _layer_bytes(canvas)


def mask_layer(mask: Mask) -> bytes:
    """Returns an (H, W) mask as a WebP that tints a photo it is laid over, of any size."""
    canvas = np.zeros((*mask.shape, 4), dtype=np.uint8)
    canvas[mask] = (*_MASK_COLOUR, round(255 * _MASK_SHARE))
    return _layer_bytes(canvas)


def _layer_bytes(canvas: Picture) -> bytes:
    """Returns a BGRA picture as WebP without a loss, a third of what it takes as PNG."""
    import cv2

    return bytes(cv2.imencode(".webp", canvas, [cv2.IMWRITE_WEBP_QUALITY, 101])[1])


def png_bytes(picture: Picture | NDArray[np.uint16]) -> bytes:
    """Returns a picture, grey or BGR, 8 or 16 bits, as a PNG file."""
    import cv2

    return bytes(cv2.imencode(".png", picture)[1])


def jpeg_bytes(picture: Picture) -> bytes:
    """Returns a BGR picture as a JPEG file for a page: small, its outlines still sharp."""
    import cv2

    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1])


def write_picture(path: Path, picture: Picture | NDArray[np.uint16]) -> None:
    """Writes a picture, grey or BGR, 8 or 16 bits, as PNG, atomically."""
    write_bytes(path, png_bytes(picture))


def is_readable_picture(path: Path) -> bool:
    """Tells whether a file is there and looks like a picture that can be decoded."""
    import cv2

    return path.is_file() and bool(cv2.haveImageReader(str(path)))


def read_background(image: Path | Picture | None, camera: Camera) -> Picture:
    """Returns a photo at the camera's size, (H, W, 3) BGR; plain grey if it is none or unreadable."""
    import cv2

    photo = read_picture(image) if isinstance(image, Path) else image
    if photo is None:
        # A picture must not cost the table: a photo that cannot be read leaves the ground grey.
        return np.full((camera.height, camera.width, 3), 58, dtype=np.uint8)
    resized = cv2.resize(photo, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized, dtype=np.uint8)


def _caption(shown: OverlayInput, width: int) -> Picture:
    """Returns the line of text, and a legend of what is drawn."""
    import cv2

    strip = np.full((48, width, 3), _PAPER, dtype=np.uint8)
    scale = min(0.5, width / 1400)
    font = cv2.FONT_HERSHEY_SIMPLEX
    # OpenCV dies of names that are no text.
    cv2.putText(strip, writable(shown.caption), (8, 18), font, scale, _INK, 1, cv2.LINE_AA)
    x = 8
    for name, colour, drawn in (
        ("query mask", _MASK_COLOUR, shown.mask),
        ("prior", PRIOR_COLOUR, shown.prior),
        ("estimate", ESTIMATE_COLOUR, shown.estimate),
        ("truth", TRUTH_COLOUR, shown.truth),
    ):
        if drawn is None:
            continue
        cv2.line(strip, (x, 35), (x + 20, 35), colour, 4)
        cv2.putText(strip, name, (x + 26, 40), font, scale, _INK, 1, cv2.LINE_AA)
        x += 40 + int(cv2.getTextSize(name, font, scale, 1)[0][0])
    return strip
