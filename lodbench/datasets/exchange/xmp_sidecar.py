"""XMP beside photos: where each was taken and how its camera looked, for programs that read photos' metadata.

GPS as EXIF states it, and the gimbal's angles as DJI's drones do; heights are the city's. The photo itself is
never touched.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.sax.saxutils import quoteattr

from lodbench import __version__
from lodbench.geometry import Pose
from lodbench.geometry.angles import dji_from_rotation
from lodbench.photos.map_frame import MapFrame
from lodbench.storage import write_text

_TOOL = "lodbench"
_NAMESPACES = {
    "exif": "http://ns.adobe.com/exif/1.0/",
    "xmp": "http://ns.adobe.com/xap/1.0/",
    "drone-dji": "http://www.dji.com/drone-dji/1.0/",
}


def write_sidecar(photo: Path, pose: Pose, frame: MapFrame) -> Path | None:
    """Writes ``PHOTO.xmp`` beside a photo; None where another program's is there, which is left alone.

    Args:
        photo: The file.
        pose: In the city's coordinates.
        frame: These on Earth.
    """
    path, packet = photo.with_suffix(".xmp"), _packet(pose, frame)
    if path.exists() and _form(path.read_text(encoding="utf-8", errors="replace")) != _form(packet):
        return None
    write_text(path, packet)
    return path


def _form(packet: str) -> str:
    """Returns a packet without its values; one that another program has added to is of another form."""
    return re.sub(r'="[^"]*"', "", packet)


def _packet(pose: Pose, frame: MapFrame) -> str:
    place = frame.place_of(pose)
    east, north, height = (float(v) for v in pose.center)
    yaw, pitch, roll = dji_from_rotation(pose.rotation, frame.convergence_deg(east, north))
    properties = {
        "xmp:CreatorTool": f"{_TOOL} {__version__}",
        "exif:GPSVersionID": "2.3.0.0",
        "exif:GPSMapDatum": "WGS-84",
        "exif:GPSLatitude": _minutes(place.latitude_deg, "NS"),
        "exif:GPSLongitude": _minutes(place.longitude_deg, "EW"),
        "exif:GPSAltitude": f"{round(abs(height) * 1000)}/1000",
        "exif:GPSAltitudeRef": "1" if height < 0 else "0",
        "exif:GPSImgDirection": f"{round(place.heading_deg * 100)}/100",
        "exif:GPSImgDirectionRef": "T",
        "drone-dji:GpsLatitude": f"{place.latitude_deg:+.9f}",
        "drone-dji:GpsLongitude": f"{place.longitude_deg:+.9f}",
        "drone-dji:AbsoluteAltitude": f"{height:+.3f}",
        "drone-dji:GimbalYawDegree": f"{yaw:+.4f}",
        "drone-dji:GimbalPitchDegree": f"{pitch:+.4f}",
        "drone-dji:GimbalRollDegree": f"{roll:+.4f}",
    }
    spaces = "".join(f' xmlns:{name}="{uri}"' for name, uri in _NAMESPACES.items())
    listed = "".join(f"\n   {name}={quoteattr(value)}" for name, value in properties.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        f'  <rdf:Description rdf:about=""{spaces}{listed}/>\n </rdf:RDF>\n</x:xmpmeta>\n<?xpacket end="w"?>\n'
    )


def _minutes(degrees: float, letters: str) -> str:
    """Returns XMP's ``DDD,MM.mmmmmmmk``."""
    # Rounded before it is split: no minutes are 60.
    whole, rest = divmod(round(60.0 * abs(degrees), 7), 60.0)
    return f"{int(whole)},{rest:.7f}{letters[int(degrees < 0)]}"
