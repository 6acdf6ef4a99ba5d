"""JSON in city models: one document, or one to a line; strict, and with keys that stand twice reported."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.crs import epsg_codes
from lodbench.citymodel.scene import Scene
from lodbench.errors import CityModelError

# A feature is one building with its parts; a line of this size is something else.
_MAX_LINE_BYTES = 1 << 28

Json = dict[str, Any]


def documents_of(stream: BinaryIO, source: str, repeated: list[str]) -> Iterator[Any]:
    """Yields one JSON document per line of a sequence, or the one document that fills the file."""
    first = stream.readline(_MAX_LINE_BYTES)
    try:
        yield _parse(first, source, 1, repeated)
    except CityModelError:
        rest = stream.read()
        if not rest.strip():
            raise
        # Not one document per line: a single one over many lines.
        yield _parse(first + rest, source, None, repeated)
        return
    for number, line in enumerate(iter(lambda: stream.readline(_MAX_LINE_BYTES), b""), start=2):
        if line.strip():
            yield _parse(line, source, number, repeated)


def _parse(data: bytes, source: str, line: int | None, repeated: list[str]) -> Any:
    where = f"{source}, line {line}" if line is not None else source

    def mapping(pairs: list[tuple[str, Any]]) -> Json:
        values = dict(pairs)
        return values if len(values) == len(pairs) else _apart(pairs, repeated)

    try:
        return json.loads(
            data.decode("utf-8-sig"), parse_constant=_refuse_constant, object_pairs_hook=mapping
        )
    except RecursionError:
        raise CityModelError(
            f"{where}: the JSON is nested too deeply.",
            "City models nest a dozen levels: do not trust this file.",
        ) from None
    except UnicodeDecodeError as error:
        raise CityModelError(
            f"{where} is not UTF-8 (byte {error.start}).", "CityJSON is UTF-8: convert the file."
        ) from None
    except ValueError as error:
        raise CityModelError(
            f"{where} is not well-formed JSON: {error}.",
            "The file is damaged or cut off: download or export it again.",
        ) from None


def _apart(pairs: list[tuple[str, Any]], repeated: list[str]) -> Json:
    """Returns a JSON object with keys that stand twice; city objects stay apart, the later as ``id~2``."""
    values: Json = {}
    numbers: Counter[str] = Counter()  # how often each was met: the search goes on where it ended
    for key, value in pairs:
        own = key
        if isinstance(value, dict) and "type" in value:
            while own in values:
                numbers[key] += 1
                own = f"{key}~{numbers[key] + 1}"
            if own != key:
                repeated.append(key)
        values[own] = value
    return values


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is no JSON number")


# Attributes that CityJSON takes a single text for.
ONE_TEXT = ("class", "function", "usage")


def listed(value: Any) -> list[Any]:
    """Returns a list as it is, and anything else as a list of one."""
    return value if isinstance(value, list) else [value]


def list_or_empty(value: Any) -> list[Any]:
    """Returns a list as it is, and an empty one for anything else."""
    return value if isinstance(value, list) else []


def fitting(key: str, value: Any) -> Any:
    """Returns an attribute of the type that CityJSON requires, where it asks for one and it can be."""
    if key in ONE_TEXT:
        return ", ".join(map(str, listed(value)))
    if key.startswith("storeyHeights") and isinstance(value, int | float):
        return [value]
    if key.startswith("storeys") and str(value).isdigit():
        return int(value)
    return value


def points_of(values: Any) -> NDArray[np.float64]:
    """Returns (N, 3) coordinates.

    Raises:
        ValueError: They are no points of three numbers each; the message says which.
        TypeError, OverflowError: One is nothing that numpy takes for a number.
    """
    numbers = np.asarray(values)
    if numbers.size and numbers.dtype.kind not in "iuf":
        raise ValueError("one is no number")  # numpy would take "1" for 1
    if numbers.size and (numbers.ndim != 2 or numbers.shape[1] != 3):
        raise ValueError("one has no three coordinates")
    return numbers.astype(np.float64).reshape(-1, 3)


def declared_system(metadata: Any, source: str) -> str | None:
    """Returns the name of the reference system in the metadata of a file, or None.

    Raises:
        CityModelError: It is no text.

    Example:
        >>> declared_system({"crs": {"epsg": 25832}}, "city.json")
        'EPSG:25832'
    """
    if isinstance(metadata, list):  # against the schema, and published all the same
        names = (declared_system(one, source) for one in metadata if isinstance(one, dict))
        return next(filter(None, names), None)
    if not isinstance(metadata, dict):
        return None
    crs = metadata.get("crs")
    # 0.9 and 1.0 files write the EPSG code alone, too.
    name = metadata.get("referenceSystem") or (crs.get("epsg") if isinstance(crs, dict) else crs)
    if isinstance(name, int):
        return f"EPSG:{name}"
    if not isinstance(name, str | None):
        raise CityModelError(
            f"{source} has a reference system that is no text: {str(name)[:60]}.",
            "Write it as https://www.opengis.net/def/crs/EPSG/0/25832, or name it with `crs=EPSG:...`",
        )
    return name


def reference_system(crs: str | None) -> tuple[str | None, str]:
    """Returns the name in CityJSON's form, which has one code, and what of the system it cannot say.

    Example:
        >>> reference_system("EPSG:7415")
        ('https://www.opengis.net/def/crs/EPSG/0/7415', '')
    """
    if crs is None:
        return None, ""
    codes = epsg_codes(crs)
    if len(codes) == 1:
        return _url(codes[0]), ""
    if not codes:
        return None, f"reference system {crs}, which has no EPSG code"
    left_out = f"vertical reference system of {crs}: CityJSON names one EPSG code, and the two have none"
    return _url(codes[0]), left_out


def _url(code: int) -> str:
    return f"https://www.opengis.net/def/crs/EPSG/0/{code}"


_EARTH_M = (6.2e6, 6.5e6)  # how far from the middle of the Earth its places are


HINT = (
    "Its tiles are meshes of their own (.b3dm, .glb): convert them to one .glb or .obj, or take the CityGML "
    "or CityJSON they were made from."
)


def is_tileset(document: Any) -> bool:
    """Returns whether a JSON document is the index of 3D Tiles."""
    return isinstance(document, dict) and {"asset", "root", "geometricError"} <= document.keys()


def place_of_tileset(document: dict[str, Any]) -> str:
    """Returns where the root of a tileset lies, in words; "" where it says no place.

    Example:
        >>> place_of_tileset({"root": {"boundingVolume": {"region": [0.2, 0.8, 0.2, 0.8, 0, 9]}}})
        'at latitude 45.83662, longitude 11.45916'
    """
    try:
        longitude, latitude = _degrees(document["root"])
    except (KeyError, TypeError, ValueError, IndexError):
        return ""
    return f"at latitude {latitude:.5f}, longitude {longitude:.5f}"


def _degrees(root: dict[str, Any]) -> tuple[float, float]:
    """Returns longitude and latitude of the middle of a tile."""
    from pyproj import Transformer

    volume = root["boundingVolume"]
    if "region" in volume:  # west, south, east, north in radians
        west, south, east, north = np.degrees(np.asarray(volume["region"][:4], np.float64)).tolist()
        return 0.5 * (west + east), 0.5 * (south + north)
    middle = np.asarray((volume.get("box") or volume["sphere"])[:3], np.float64)
    matrix = np.asarray(root.get("transform", np.eye(4)), np.float64).reshape(4, 4)  # column by column
    place = np.append(middle, 1.0) @ matrix[:, :3]
    if not _EARTH_M[0] < np.linalg.norm(place) < _EARTH_M[1]:
        raise ValueError("no place on Earth")
    degrees = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*place)
    return float(degrees[0]), float(degrees[1])


_NO_NAME = "unknown"

_ORIGIN, _CRS = "origin ", "crs "

_KEY = "lodbench"


@dataclass(frozen=True, slots=True)
class MeshFrame:
    """Place of a mesh."""

    origin: NDArray[np.float64]  # (3,) what was subtracted from the coordinates
    crs: str | None  # their reference system, or None where it was unknown

    @classmethod
    def of_scene(cls, scene: Scene) -> MeshFrame:
        """Returns the frame of a scene."""
        return cls(scene.origin, scene.crs)

    def comments(self) -> list[str]:
        """Returns two lines of text, as they stand in the comments of OBJ and PLY."""
        return [_ORIGIN + " ".join(map(repr, self.origin.tolist())), _CRS + (self.crs or _NO_NAME)]

    def extras(self) -> dict[str, Any]:
        """Returns plain values, as they stand in the extras of a glTF scene."""
        return {_KEY: {"origin": self.origin.tolist(), "crs": self.crs}}


def frame_of_comments(comments: list[str]) -> MeshFrame | None:
    """Returns the frame that two comments in a row tell, or None where they are anybody's.

    Example:
        >>> frame_of_comments(["origin 5.0 6.0 0.0", "crs EPSG:25832"]).crs
        'EPSG:25832'
        >>> frame_of_comments(["made by hand"]) is None
        True
    """
    for first, second in pairwise(comments):
        if first.startswith(_ORIGIN) and second.startswith(_CRS):
            name = second.removeprefix(_CRS).strip()
            return _frame(first.removeprefix(_ORIGIN).split(), None if name == _NO_NAME else name)
    return None


def frame_of_extras(metadata: Any) -> MeshFrame | None:
    """Returns the frame in the extras of a glTF scene, or None."""
    values = metadata.get(_KEY) if isinstance(metadata, dict) else None
    if not isinstance(values, dict) or not isinstance(values.get("crs"), str | None):
        return None
    return _frame(values.get("origin"), values.get("crs"))


def _frame(origin: Any, crs: str | None) -> MeshFrame | None:
    try:
        values = np.asarray(origin, np.float64).reshape(3)
    except (TypeError, ValueError):
        return None
    return MeshFrame(values, crs) if np.isfinite(values).all() else None
