"""Opening a city model: what kind of file it is, and the reader that fits."""

from __future__ import annotations

from pathlib import Path

from lodbench.citymodel.mesh import mesh_city
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.polygons import finish_model
from lodbench.citymodel.raw import RawCity
from lodbench.citymodel.scene import Scene
from lodbench.errors import CityModelError

_HEAD_BYTES = 4096
_SUPPORTED = "Supported: CityGML (.gml, .xml, .citygml) and Wavefront OBJ (.obj)."


def read_city_model(path: str | Path, *, crs: str | None = None, is_strict: bool = True) -> CityModel:
    """Returns a city model in metres, in a local frame.

    Args:
        path: The file.
        crs: Reference system of its coordinates, instead of the one it declares.
        is_strict: Whether a coordinate that is no finite number is an error; if not, its polygon
            is dropped with a finding.

    Raises:
        CityModelError: The file is missing, unreadable, empty, damaged or of an unknown kind, or
            has no building.
    """
    path = Path(path)
    raw = _read_raw(path, _head_of(path), is_strict)
    return finish_model(raw, crs=crs)


def open_scene(path: str | Path, *, lod: str | None = None, crs: str | None = None) -> Scene:
    """Returns one level of detail of a city file as a scene: ``read_city_model`` and ``mesh_city``.

    Args:
        path: The file.
        lod: Level name (``"1"``), or None for the lowest that has walls.
        crs: Reference system of its coordinates, instead of the one it declares.

    Raises:
        CityModelError: The file cannot be read, or has no building at that level.
    """
    return mesh_city(read_city_model(path, crs=crs), lod)


def _head_of(path: Path) -> bytes:
    """Returns the first bytes of a file.

    Raises:
        CityModelError: There is no such file, or it is a folder, empty or not readable.
    """
    try:
        with path.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
    except FileNotFoundError:
        raise CityModelError(f"There is no city model at {path}.", "Check the path.") from None
    except IsADirectoryError:
        raise CityModelError(f"{path} is a folder, not a city model.", "Name a file in it.") from None
    except OSError as error:
        raise CityModelError(f"{path} cannot be read: {error.strerror}.", "Check its permissions.") from None
    if not head.strip(b"\0 \r\n\t"):
        raise CityModelError(f"{path} is empty.", "Download or export the file again.")
    return head


def _read_raw(path: Path, head: bytes, is_strict: bool) -> RawCity:
    source = str(path)
    text = head.replace(b"\0", b"").lstrip(b"\xef\xbb\xbf\xff\xfe \r\n\t")
    if text.startswith(b"<"):
        from lodbench.citymodel.citygml import read_citygml

        return read_citygml(lambda: path.open("rb"), source, is_strict=is_strict)
    first_words = {line.split(None, 1)[0] for line in text.splitlines() if line.strip()}
    if path.suffix.lower() == ".obj" or first_words & {b"v", b"f", b"o", b"mtllib"}:
        from lodbench.citymodel.obj import read_obj

        with path.open("rb") as stream:
            return read_obj(stream, source)
    raise CityModelError(f"{path} is no city model that lodbench can read.", _SUPPORTED)
