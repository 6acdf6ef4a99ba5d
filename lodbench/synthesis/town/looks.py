"""How a town looks: what ``looks.yaml`` says of the two there are."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import NamedTuple

from lodbench.errors import DatasetError, nearest_names
from lodbench.params import read_settings, to_params
from lodbench.synthesis.objects.mesh_builder import palette
from lodbench.synthesis.photo import LookRanges
from lodbench.synthesis.town.shapes import Points


class TownLook(NamedTuple):
    """What two towns differ in besides chance; ``looks.yaml`` says what each is."""

    name: str
    rings: float
    relief: float
    half_hipped: float
    shed: float
    trees: float
    broadleaf: float
    walls: Points  # colours, (N, 3) RGB from 0 to 255, as the next five
    tiles: Points
    flat_roofs: Points
    grass: Points
    road: Points
    water: Points
    days: LookRanges


@cache
def look_named(name: str) -> TownLook:
    """Returns a look.

    Raises:
        DatasetError: There is none of that name.
    """
    looks = read_settings((files("lodbench.synthesis.town") / "looks.yaml").read_text(encoding="utf-8"))
    if name not in looks:
        raise DatasetError(f"The demo town has no look {name!r}.", nearest_names(name, looks))
    told = dict(looks[name])
    days = to_params(told.pop("days"), LookRanges, "days")
    colours = {key: palette(value) for key, value in told.items() if isinstance(value, str)}
    return TownLook(name=name, days=days, **told | colours)
