"""Poses for photogrammetry programs: reference text of Metashape, Pix4D and OpenDroneMap; XMP beside photos.

The three text formats turn a picture's axes (x right, y up, z backwards) into east, north, up, and are the
identity for a camera that looks straight down with north on top:

- Metashape's reference pane: yaw (clockwise from north), pitch (0 straight down, 90 ahead), roll;
  ``Rz(-yaw) Rx(pitch) Ry(roll)``, as its ``Utils.ypr2mat`` says.
- Pix4D's calibrated external camera parameters and ODM's ``geo.txt``: omega, phi, kappa;
  ``Rx(omega) Ry(phi) Rz(kappa)``, right-handed.

Angles are taken against the axes of the coordinates: grid north, not true north.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench import __version__
from lodbench.citymodel.crs import KnownCrs, require_crs, resolve_crs
from lodbench.datasets import pose_text
from lodbench.errors import DatasetError, LodbenchError
from lodbench.geometry import Pose
from lodbench.geometry.angles import dji_from_rotation
from lodbench.photos.map_frame import MapFrame
from lodbench.storage import write_text

_PIX4D_HEAD = "imageName X Y Z Omega Phi Kappa"
_METASHAPE_SYSTEM = "#CoordinateSystem:"
_METASHAPE_HEAD = ("#Label", "X/Easting", "Y/Northing", "Z/Altitude", "Yaw", "Pitch", "Roll")
# What is read, by the heads of the source values; the estimated ones are called x_est, yaw_est, ...
_METASHAPE_COLUMNS = {
    "x": "x/easting", "y": "y/northing", "z": "z/altitude", "yaw": "yaw", "pitch": "pitch", "roll": "roll",
}  # fmt: skip
_PROJECTED_HINT = "Export it in the city's own, projected reference system."
# A picture's axes in those of a camera: y and z are turned round.
_PHOTO_AXES = np.diag([1.0, -1.0, -1.0])


def read_metashape(path: Path) -> Iterator[pose_text.FoundPose]:
    """Yields the cameras of an exported reference file, estimated values before those of the source.

    Raises:
        DatasetError: It has no head with labels, coordinates and angles, is in degrees, or a line is
            malformed.
    """
    columns: dict[str, int] = {}
    crs: str | None = None
    for number, line in enumerate(pose_text.read_text(path).splitlines(), start=1):
        where = f"{path}, line {number}"
        if line.startswith("#Label"):
            columns = _metashape_columns(where, line)
        elif line.startswith(_METASHAPE_SYSTEM):
            # A chunk without one has local coordinates there, and its WKT means no place on Earth.
            known = resolve_crs(line.removeprefix(_METASHAPE_SYSTEM))
            crs = None if known is None else _plane_label(known)
        elif line.startswith(("#Markers", "#Scalebars")):
            return
        elif line.strip() and not line.startswith("#"):
            with pose_text.LayoutGuard(where, ",".join(_METASHAPE_HEAD)):
                if not columns:
                    raise LodbenchError("no line #Label,... stands before it")
                cells = next(csv.reader([line]))
                if len(cells) <= max(columns.values()):
                    raise LodbenchError(f"{len(cells)} values are too few")
                # A camera that could not be aligned has no angles.
                if any(not cells[at].strip() for at in columns.values()):
                    continue
                *place, yaw, pitch, roll = (float(cells[columns[name]]) for name in _METASHAPE_COLUMNS)
                pose = _pose(_rotation_of_ypr(yaw, pitch, roll), place)
            yield pose_text.FoundPose(cells[columns["label"]], where, pose, crs=crs)


def _metashape_columns(where: str, line: str) -> dict[str, int]:
    """Returns where label, x, y, z and yaw, pitch, roll stand."""
    heads = [head.strip().lower() for head in next(csv.reader([line.removeprefix("#")]))]
    with pose_text.LayoutGuard(where, ",".join(_METASHAPE_HEAD)):
        if any("longitude" in head for head in heads):
            raise DatasetError(f"{where}: the coordinates are in degrees.", _PROJECTED_HINT)
        columns = {"label": heads.index("label")}
        for name, source in _METASHAPE_COLUMNS.items():
            estimate = f"{name}_est"
            columns[name] = heads.index(estimate if estimate in heads else source)
    return columns


def read_pix4d(path: Path) -> Iterator[pose_text.FoundPose]:
    """Yields the images of ``..._calibrated_external_camera_parameters.txt``.

    Raises:
        DatasetError: Its head does not end in omega, phi and kappa, or a line is malformed.
    """
    first, _, rest = pose_text.read_text(path).lstrip().partition("\n")
    # Other files of Pix4D's have yaw, pitch and roll there, or no head at all.
    if [word.lower() for word in re.split(r"[,\s]+", first.strip("# \r"))[-3:]] != ["omega", "phi", "kappa"]:
        raise DatasetError(
            f"{path}, line 1: there are no omega, phi and kappa.",
            f"Take ..._calibrated_external_camera_parameters.txt: {_PIX4D_HEAD}",
        )
    for number, line in enumerate(rest.splitlines(), start=2):
        where = f"{path}, line {number}"
        if line.strip():
            with pose_text.LayoutGuard(where, _PIX4D_HEAD):
                # From the right: a name may hold spaces.
                yield _of_omega_phi_kappa(where, line.replace(",", " ").rsplit(maxsplit=6))


def read_odm(path: Path) -> Iterator[pose_text.FoundPose]:
    """Yields the images of ODM's ``geo.txt`` that have angles.

    Raises:
        DatasetError: The first line names no projected reference system, or a line is malformed or has no
            angles.
    """
    lines = pose_text.content(path)
    where, head = next(lines, (str(path), ""))
    crs = _odm_crs(where, head.strip())
    for place, line in lines:
        with pose_text.LayoutGuard(place, "image_name geo_x geo_y geo_z omega phi kappa"):
            yield _of_omega_phi_kappa(place, line.split())._replace(crs=crs)


def write_metashape(images: Sequence[pose_text.FoundPose], path: Path, crs: str | None = None) -> None:
    """Writes a reference file for *Import Reference*: delimiter comma, columns in order.

    Raises:
        DatasetError: A name has a comma, or occurs twice.
    """
    pose_text.require_plain_names([image.name for image in images], ',\r\n"', "Metashape's reference text")
    lines = [*_coordinate_system(crs), ",".join(_METASHAPE_HEAD)]
    for image in images:
        minus_yaw, pitch, roll = _angles(image.pose, "ZXY")
        values = [*map(float, image.pose.center), -minus_yaw % 360.0, pitch, roll]
        lines.append(",".join([image.name, *map(repr, values)]))
    write_text(path, pose_text.lines_to_text(lines))


def _coordinate_system(crs: str | None) -> list[str]:
    """Returns the line that names a reference system to Metashape, none where its WKT has no words for it."""
    from pyproj.exceptions import CRSError

    try:
        wkt = None if crs is None else require_crs(crs).horizontal.to_wkt("WKT1_GDAL")
    except CRSError:  # town grids of Colombia, Michigan's, the modified Krovak
        wkt = None
    return [] if wkt is None else [f"{_METASHAPE_SYSTEM} {wkt}"]


def write_pix4d(images: Sequence[pose_text.FoundPose], path: Path) -> None:
    """Writes ``imageName X Y Z Omega Phi Kappa``.

    Raises:
        DatasetError: A name has a space, or occurs twice.
    """
    pose_text.require_plain_names([image.name for image in images], ", \t\r\n", "Pix4D's parameters")
    write_text(path, pose_text.lines_to_text([_PIX4D_HEAD, *map(_with_omega_phi_kappa, images)]))


def write_odm(images: Sequence[pose_text.FoundPose], path: Path, crs: str | None) -> None:
    """Writes ``geo.txt`` for ``--geo``, its first line the reference system.

    Raises:
        DatasetError: The system is not known, a name has a space, or occurs twice.
    """
    if crs is None:
        raise DatasetError("ODM's geo.txt names a reference system, and that of the poses is not known.",
                           "Name it with `--crs`.")  # fmt: skip
    pose_text.require_plain_names([image.name for image in images], " \t\r\n", "ODM's geo.txt")
    plane = require_crs(crs).horizontal
    head = f"EPSG:{plane.to_epsg()}" if plane.to_epsg() else plane.to_proj4()
    write_text(path, pose_text.lines_to_text([head, *map(_with_omega_phi_kappa, images)]))


def looks_like(path: Path) -> str | None:
    """Returns which of the three formats a text file's first line is of: its name, or None."""
    first = pose_text.read_text(path).lstrip().split("\n", 1)[0].strip()
    tests: Mapping[str, Callable[[str], object]] = {
        "metashape": lambda line: re.match(r"#\s*(CoordinateSystem|Cameras|Label,)", line),
        "pix4d": lambda line: re.match(r"#?\s*imagename[\s,]", line, re.IGNORECASE),
        "odm": lambda line: re.match(r"EPSG:\d+$|\+proj|WGS84 UTM ", line, re.IGNORECASE),
    }
    return next((name for name, test in tests.items() if test(first)), None)


def _of_omega_phi_kappa(where: str, words: Sequence[str]) -> pose_text.FoundPose:
    from scipy.spatial.transform import Rotation

    if len(words) < 7:
        raise LodbenchError(f"{len(words)} values are too few: there are no angles")
    x, y, z, *angles = (float(word) for word in words[1:7])
    turn = Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()
    return pose_text.FoundPose(words[0], where, _pose(turn, (x, y, z)))


def _with_omega_phi_kappa(image: pose_text.FoundPose) -> str:
    values = [*map(float, image.pose.center), *_angles(image.pose, "XYZ")]
    return " ".join([image.name, *map(repr, values)])


def _rotation_of_ypr(yaw_deg: float, pitch_deg: float, roll_deg: float) -> NDArray[np.float64]:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("ZXY", [-yaw_deg, pitch_deg, roll_deg], degrees=True)
    return np.asarray(turn.as_matrix())


def _angles(pose: Pose, axes: str) -> list[float]:
    """Returns the angles in degrees about a picture's axes, in turn, that take it from level to its pose."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(pose.rotation.T @ _PHOTO_AXES)
    return [float(angle) for angle in turn.as_euler(axes, degrees=True)]


def _pose(world_from_photo: NDArray[np.float64], center: Sequence[float]) -> Pose:
    if not (np.isfinite(world_from_photo).all() and np.isfinite(center).all()):
        raise LodbenchError("a value is not finite")
    return Pose.from_center((world_from_photo @ _PHOTO_AXES).T, center)


def _odm_crs(where: str, head: str) -> str:
    """Returns the reference system that ODM's first line names."""
    zone = re.fullmatch(r"WGS84 UTM (\d{1,2})([NS])", head, re.IGNORECASE)
    name = head if zone is None else f"EPSG:{326 if zone[2] in 'Nn' else 327}{int(zone[1]):02d}"
    known = resolve_crs(name)
    if known is None:
        raise DatasetError(f"{where}: {head!r} names no reference system.", "ODM wants one there.")
    if not known.horizontal.is_projected:
        raise DatasetError(f"{where}: {head} has degrees.", _PROJECTED_HINT)
    return _plane_label(known)


def _plane_label(known: KnownCrs) -> str:
    """Returns the short name of a system's plane; its own where that has none. Heights stay as they are."""
    code = known.horizontal.to_epsg()
    return known.label if code is None else f"EPSG:{code}"


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
    # It brings clients of the network along.
    from xml.sax.saxutils import quoteattr

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
