"""What an image's header says: its size, and whether it carries a GPS position; no pixel is decoded."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

from lodbench.errors import DatasetError

# Ten times a drone's largest picture. More is a mistake, or made to fill the memory.
MAX_PIXELS = 500_000_000
_FORMATS = ("JPEG", "MPO", "PNG", "TIFF", "BMP")
_GPS_IFD = 0x8825


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """What a header states.

    Attributes:
        width: Pixels.
        height: Pixels.
        has_gps: Whether the EXIF block holds a position.
    """

    width: int
    height: int
    has_gps: bool

    @property
    def is_huge(self) -> bool:
        """Whether decoding it is not safe."""
        return self.width * self.height > MAX_PIXELS


def read_image_header(path: Path) -> ImageHeader:
    """Returns what the header of an image states, whatever the size it claims.

    Raises:
        DatasetError: The file cannot be read, or is no image of a known format.
    """
    from PIL import Image

    limit = Image.MAX_IMAGE_PIXELS
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # Pillow refuses large pictures when it opens them; here only their size is asked for.
            Image.MAX_IMAGE_PIXELS = None
            with Image.open(path, formats=_FORMATS) as image:
                width, height = image.size
                gps = image.getexif().get_ifd(_GPS_IFD)
    except OSError as error:
        reason = error.strerror or "it is no JPEG, PNG, TIFF or BMP image"
        raise DatasetError(f"{path} cannot be read: {reason}.") from error
    except Exception as error:  # Pillow lets the errors of its parsers through
        raise DatasetError(f"{path} cannot be read: its header is damaged.") from error
    finally:
        Image.MAX_IMAGE_PIXELS = limit
    # Tags 1 to 4 are the latitude and longitude; version and datum alone give nobody away.
    return ImageHeader(width, height, any(tag in gps for tag in (1, 2, 3, 4)))
