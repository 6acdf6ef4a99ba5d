"""What a user can say about a source that the source does not say itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

from lodbench.errors import ConfigError, nearest_names

AxisOrder = Literal["auto", "east_first", "north_first"]
BASES = ("as_given", "ground", "sunk")


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How to read a city; the defaults suit every source that speaks for itself.

    Attributes:
        crs: Reference system of the coordinates, instead of the declared one.
        axis_order: Which of the first two coordinates is the easting or longitude; ``auto`` asks
            the reference system and its area of use.
        is_strict: Whether a bad coordinate is an error, or a finding that drops its polygon.
        origin: What to subtract from the coordinates (east, north, up), metres; None chooses.
        up_axis: Axis that points up in a mesh; ``auto`` is y for glTF and z for the others.
        layer: Layer of a vector file; None takes the only one.
        height_column: Column of building heights above ground, metres; None looks for one.
        storeys_column: Column of storey counts, used where there is no height.
        storey_height_m: Height of one storey.
        ground_column: Column of ground heights, metres; None looks for one.
        ground_m: Ground height where neither column nor terrain gives one.
        terrain: Raster terrain model to take ground heights from.
        default_height_m: Height of footprints without one; None drops them with a finding.
        base: ``as_given``; ``ground`` sets models with a zero base on ``terrain`` or ``ground_m``;
            ``sunk`` raises what lies within ``sunk_m`` of a building's lowest point, for walls that
            the publisher drew into the ground.
        sunk_m: How deep.
    """

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
    default_height_m: float | None = None
    base: Literal["as_given", "ground", "sunk"] = "as_given"
    sunk_m: float = 3.0

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> ReadOptions:
        """Returns options from names and values, as a source profile in YAML gives them.

        Raises:
            ConfigError: A name is unknown, or a value of the wrong type or out of range.

        Example:
            >>> ReadOptions.from_mapping({"base": "sunk", "sunk_m": 3}).sunk_m
            3.0
        """
        known = {item.name: item.default for item in fields(cls)}
        given: dict[str, Any] = {}
        for name, value in values.items():
            if name not in known:
                raise ConfigError(f"A source has no option {name!r}.", nearest_names(name, known))
            if isinstance(known[name], float) and isinstance(value, int) and not isinstance(value, bool):
                value = float(value)
            if known[name] is not None and type(value) is not type(known[name]):
                raise ConfigError(f"The option {name}={value!r} of a source has the wrong type.")
            given[name] = tuple(float(v) for v in value) if name == "origin" and value is not None else value
        return cls(**given)

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            ConfigError: A value is out of range; the message names the key.
        """
        if not 1.0 <= self.storey_height_m <= 20.0:
            raise ConfigError(
                f"storey_height_m={self.storey_height_m} is no height of a storey.", "Usual is 3."
            )
        if self.base not in BASES:
            raise ConfigError(f"base={self.base} is unknown.", f"Known: {', '.join(BASES)}.")
        if self.sunk_m < 0.0:
            raise ConfigError(f"sunk_m={self.sunk_m} is negative.")
