"""What a city model holds besides buildings, as layers that a scene takes in when it is asked to."""

from __future__ import annotations

from collections.abc import Sequence

from lodbench.errors import ConfigError, nearest_names

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
