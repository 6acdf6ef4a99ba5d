"""Photos as DJI's drones write them: EXIF by Pillow, and an XMP packet in a segment of its own."""

import io
import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

XMP_HEADER = b"http://ns.adobe.com/xap/1.0/\0"
PROPERTIES = {
    "AbsoluteAltitude": "+203.41",
    "RelativeAltitude": "+80.10",
    "GpsLatitude": "+51.0479012",
    "GpsLongitude": "+5.8690021",
    "GimbalRollDegree": "+0.30",
    "GimbalYawDegree": "-43.60",
    "GimbalPitchDegree": "-45.30",
}


def xmp_packet(properties: dict[str, str], as_elements: bool = False) -> bytes:
    """Returns an XMP packet, properties as attributes (as most drones do) or as elements."""
    namespace = "http://www.dji.com/drone-dji/1.0/"
    if as_elements:
        inside = "".join(f"<drone-dji:{k}>{v}</drone-dji:{k}>" for k, v in properties.items())
        body = f'<rdf:Description rdf:about="" xmlns:drone-dji="{namespace}">{inside}</rdf:Description>'
    else:
        listed = " ".join(f'drone-dji:{k}="{v}"' for k, v in properties.items())
        body = f'<rdf:Description rdf:about="DJI Meta Data" xmlns:drone-dji="{namespace}" {listed}/>'
    return packet_around(body)


def packet_around(body: str) -> bytes:
    """Returns an XMP packet of one or several ``rdf:Description``."""
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        f'<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">{body}</rdf:RDF>\n</x:xmpmeta>\n'
        '<?xpacket end="w"?>'
    ).encode()


def exif_of(
    latitude: float | None = None,
    longitude: float | None = None,
    altitude: float | None = None,
    *,
    make: str = "DJI",
    model: str = "FC6310R",
    focal_mm: float | None = 8.8,
    focal_35mm: int | None = 24,
    size: tuple[int, int] | None = None,
    orientation: int = 1,
    zoom: float | None = None,
    plane: tuple[float, float, int | None] | None = None,
    taken_at: str = "2023:10:18 11:46:19",
    fraction: str = "",
    altitude_ref: int | None = None,
    version: str = "",
) -> bytes:
    """Returns EXIF with the tags DJI writes; ``plane``: resolution along x and y of the focal plane, unit."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = make, model, orientation
    details: dict[int, Any] = {0x9003: taken_at}
    if version:
        details[0x9000] = version.encode()
    if fraction:
        details[0x9291] = fraction
    if focal_mm is not None:
        details[0x920A] = IFDRational(Fraction(focal_mm).limit_denominator(1000))
    if focal_35mm is not None:
        details[0xA405] = focal_35mm
    if zoom is not None:
        details[0xA404] = IFDRational(Fraction(zoom).limit_denominator(1000))
    if plane is not None:
        details |= {0xA20E: _ratio(plane[0]), 0xA20F: _ratio(plane[1])}
        details |= {} if plane[2] is None else {0xA210: plane[2]}
    if size is not None:
        details[0xA002], details[0xA003] = size
    exif._ifds[0x8769] = details
    position: dict[int, Any] = {0: b"\x02\x03\x00\x00"}
    if latitude is not None and longitude is not None:
        position |= {1: "S" if latitude < 0 else "N", 2: _sexagesimal(latitude)}
        position |= {3: "W" if longitude < 0 else "E", 4: _sexagesimal(longitude)}
    if altitude is not None:
        reference = int(altitude < 0) if altitude_ref is None else altitude_ref
        position |= {5: bytes([reference]), 6: IFDRational(round(abs(altitude) * 1000), 1000)}
    exif._ifds[0x8825] = position
    return exif.tobytes()


def write_photo(
    path: Path, pixels: np.ndarray | None = None, exif: bytes = b"", xmp: bytes | None = None
) -> Path:
    """Writes a JPEG of (H, W) or (H, W, 3) pixels with EXIF, and XMP right behind the start marker."""
    stream = io.BytesIO()
    pixels = np.full((48, 64), 120, np.uint8) if pixels is None else pixels
    Image.fromarray(pixels).save(stream, "JPEG", exif=exif, quality=92)
    content = stream.getvalue()
    if xmp is not None:
        segment = XMP_HEADER + xmp
        content = content[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + content[2:]
    path.write_bytes(content)
    return path


def _ratio(number: float) -> IFDRational:
    return IFDRational(Fraction(number).limit_denominator(10000))


def _sexagesimal(degrees: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    degrees = abs(degrees)
    minutes = (degrees % 1) * 60
    seconds = round((minutes % 1) * 60 * 10000)
    return IFDRational(int(degrees)), IFDRational(int(minutes)), IFDRational(seconds, 10000)
