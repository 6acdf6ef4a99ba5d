"""What a user can say about a source that the source does not say itself."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import date
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from lodbench.errors import ConfigError, nearest_names, require_within

AxisOrder = Literal["auto", "east_first", "north_first"]


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How to read a city; the defaults suit every source that speaks for itself.

    Attributes:
        reader: Entry point under ``lodbench.city_readers`` to read the file with; None tells by its content.
        crs: Reference system of the coordinates, instead of the declared one.
        axis_order: Which of the first two coordinates is the easting or longitude; ``auto`` asks
            the reference system, its area of use, and which way the walls of houses face.
        is_strict: Whether a bad coordinate is an error, or a finding that drops its polygon.
        origin: What to subtract from the coordinates (east, north, up), metres; None chooses.
        up_axis: Axis that points up in a mesh; ``auto`` is y for glTF and z for the others.
        layer: Layer of a vector file; None takes the first that has geometries, and tells of others.
        height_column: Column of building heights above ground, metres, or feet where the reference system is
            in feet; None looks for one.
        storeys_column: Column of storey counts, used where there is no height.
        storey_height_m: Height of one storey.
        ground_column: Column of ground heights, in the unit of ``height_column``; None looks for one where
            there is no ``terrain``.
        ground_m: Ground height where neither column nor terrain gives one.
        terrain: Raster terrain model to take ground heights from, in the unit that its band or system names.
        surface: Surface model (raster, laser points, a folder of tiles) to take the heights of footprints
            from; columns count where it shows no roof.
        orthophoto: Of a surface model's place: what of it is green is no roof, and it is the texture.
        default_height_m: Height of footprints without one; None drops them with a finding.
        base: ``as_given``; ``ground`` sets models with a zero base on ``terrain`` or ``ground_m``;
            ``sunk`` raises what lies within ``sunk_m`` of a building's lowest point, for walls that
            the publisher drew into the ground.
        sunk_m: How deep.
        ecef_origin: Latitude and longitude, degrees, of the origin of coordinates that are
            earth-centred minus its own: they are turned to east, north, up there. None for others.
        has_details: Whether attributes, solids and the ids of polygons are kept, as ``city check`` and
            ``city convert`` need them; reading takes longer.
        has_textures: Whether pictures of surfaces are kept too, as ``city convert --textures`` writes them;
            with ``has_details``.
        layers: What to read besides buildings: ``bridges``, ``vegetation`` and so on, see ``LAYERS``.
        date: Day on which objects must stand whose end is stated, ``YYYY-MM-DD``; None for today.
    """

    reader: str | None = None
    crs: str | None = None
    axis_order: AxisOrder = "auto"
    is_strict: bool = True
    origin: tuple[float, float, float] | None = None
    up_axis: Literal["auto", "y", "z"] = "auto"
    layer: str | None = None
    height_column: str | None = None
    storeys_column: str | None = None
    storey_height_m: float = 3.0
    ground_column: str | None = None
    ground_m: float = 0.0
    terrain: str | None = None
    surface: str | None = None
    orthophoto: str | None = None
    default_height_m: float | None = None
    base: Literal["as_given", "ground", "sunk"] = "as_given"
    sunk_m: float = 3.0
    ecef_origin: tuple[float, float] | None = None
    has_details: bool = False
    has_textures: bool = False
    layers: tuple[str, ...] = ()
    date: str | None = None

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> ReadOptions:
        """Returns options from names and values, as a source profile in YAML gives them.

        Raises:
            ConfigError: A name is unknown, or a value of the wrong type or out of range.

        Example:
            >>> ReadOptions.from_mapping({"base": "sunk", "sunk_m": 3}).sunk_m
            3.0
        """
        hints = get_type_hints(cls)
        for name in values:
            if name not in hints:
                raise ConfigError(f"A source has no option {name!r}.", nearest_names(name, hints))
        return cls(**{name: _fitting(name, value, hints[name]) for name, value in values.items()})

    def __post_init__(self) -> None:
        """Checks words and ranges.

        Raises:
            ConfigError: A value is unknown or out of range; the message names the key.
        """
        for name, words in _WORDS.items():
            word = getattr(self, name)
            if word not in words:
                raise ConfigError(f"{name}={word} is unknown.", nearest_names(str(word), words))
        if not 1.0 <= self.storey_height_m <= 20.0:
            raise ConfigError(
                f"storey_height_m={self.storey_height_m} is no height of a storey.", "Usual is 3."
            )
        if self.date is not None and not _is_day(self.date):
            raise ConfigError(f"date={self.date} is not a date.", "It reads YYYY-MM-DD: `date=2015-06-30`")
        object.__setattr__(self, "layers", require_layers(self.layers))
        require_within("sunk_m", self.sunk_m, 0)
        for name in ("origin", "ground_m", "default_height_m", "ecef_origin"):
            require_within(name, getattr(self, name), -math.inf)


def _is_day(text: str) -> bool:
    try:
        return date.fromisoformat(text).isoformat() == text
    except ValueError:
        return False


# Options that name files, whose content counts and not where they lie.
PATH_OPTIONS = ("terrain", "surface", "orthophoto")
_SHAPING = {field.name for field in fields(ReadOptions)} - {"crs", "is_strict", "has_details", "has_textures"}


def changed_options(options: ReadOptions) -> dict[str, Any]:
    """Returns the options that are not their defaults, as ``ReadOptions.from_mapping`` takes them back."""
    default = asdict(ReadOptions())
    return {name: value for name, value in asdict(options).items() if value != default[name]}


def made_with(options: ReadOptions, roof_height: str | None) -> dict[str, Any]:
    """Returns what shapes a scene beside its file, as JSON values by name: a scene remembers it.

    The reference system is the scene's own; of other files (``PATH_OPTIONS``) their names must do.
    """
    stated: dict[str, Any] = {
        name: value for name, value in changed_options(options).items() if name in _SHAPING
    }
    stated = {name: list(value) if isinstance(value, tuple) else value for name, value in stated.items()}
    stated |= {name: Path(stated[name]).name for name in PATH_OPTIONS if name in stated}
    return stated if roof_height is None else stated | {"roof_height": roof_height}


def _fitting(name: str, value: Any, hint: Any) -> Any:
    """Returns a value as the type its option has: whole numbers become what is requested."""
    kinds = [kind for kind in get_args(hint) if kind is not NoneType] or [hint]
    if get_origin(hint) is Literal:
        return value  # the options check their words themselves
    if value is None and NoneType in get_args(hint):
        return None
    if name == "layers":
        return tuple(map(str, value)) if isinstance(value, list | tuple) else tuple(str(value).split(","))
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if float in kinds and is_number and math.isfinite(value):
        return float(value)
    if str in kinds and (isinstance(value, str) or is_number):
        return str(value)  # a column may be called 2020
    if hint is bool and isinstance(value, bool):
        return value
    numbers = _NUMBERS.get(name, ())
    if numbers and isinstance(value, list | tuple) and len(value) == len(numbers):
        return tuple(_fitting(name, number, float) for number in value)
    wanted = f"{len(numbers)} numbers: {', '.join(numbers)}" if numbers else _TYPE_NAMES[kinds[0]]
    raise ConfigError(f"The option {name}={value!r} of a source has the wrong type.", f"It takes {wanted}.")


_NUMBERS = {"origin": ("east", "north", "up"), "ecef_origin": ("latitude", "longitude")}
_TYPE_NAMES = {float: "a number", str: "text", bool: "true or false"}
_WORDS = {
    name: get_args(hint) for name, hint in get_type_hints(ReadOptions).items() if get_origin(hint) is Literal
}


# The objects of each layer, by their names in CityGML and CityJSON. Installations hang on what they belong
# to and come with it; rooms are the inside of what is read anyway.
LAYERS: dict[str, tuple[str, ...]] = {
    "bridges": ("Bridge",),
    "tunnels": ("Tunnel",),
    "constructions": ("OtherConstruction",),
    "vegetation": ("SolitaryVegetationObject", "PlantCover"),
    "furniture": ("CityFurniture",),
    "relief": ("ReliefFeature", "TINRelief"),
    "roads": ("Road", "Railway", "Square", "Track", "Waterway", "TransportSquare", "TransportationComplex"),
    "water": ("WaterBody",),
    "land_use": ("LandUse",),
    "generic": ("GenericCityObject", "GenericOccupiedSpace"),
    "interiors": (),
}
INTERIORS = "interiors"
# Folders of PLATEAU's deliveries, one per layer.
FOLDERS = {
    "bridges": ("brid",),
    "tunnels": ("tun",),
    "constructions": ("cons",),
    "vegetation": ("veg",),
    "furniture": ("frn",),
    "relief": ("dem",),
    "roads": ("tran", "rwy", "trk", "squr", "wwy"),
    "water": ("wtr",),
    "land_use": ("luse",),
    "generic": ("gen",),
    "interiors": (),
}


def require_layers(names: Sequence[str]) -> tuple[str, ...]:
    """Returns the names of layers, each once.

    Raises:
        ConfigError: One is unknown.
    """
    for name in names:
        if name not in LAYERS:
            raise ConfigError(f"There is no layer {name!r}.", nearest_names(name, LAYERS))
    return tuple(dict.fromkeys(names))


def types_of(layers: Sequence[str]) -> frozenset[str]:
    """Returns the names of the objects to read: buildings, and those of some layers.

    Example:
        >>> sorted(types_of(["bridges"]))
        ['Bridge', 'Building']
    """
    return frozenset(["Building", *(name for layer in layers for name in LAYERS[layer])])


def folders_of(layers: Sequence[str]) -> frozenset[str]:
    """Returns the names of the folders that hold them, where a delivery has a folder for each kind."""
    return frozenset(["bldg", *(name for layer in layers for name in FOLDERS[layer])])


# What a mesh is called, by the ending of its file.
MESH_FORMATS = {".ply": "PLY", ".stl": "STL", ".glb": "glTF", ".gltf": "glTF"}

# Rasters and laser points, read from a path; in a folder where nothing else is a city.
SURFACE_SUFFIXES = (".tif", ".tiff", ".asc", ".laz", ".las")
