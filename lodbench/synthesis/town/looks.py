"""How a town looks: two made-up places that share no street, no roof mix, no colour range and no weather.

A network trained on one town must not have seen the other. Seeds alone would leave them alike.
"""

from __future__ import annotations

from dataclasses import dataclass

from lodbench.errors import DatasetError, nearest_names
from lodbench.synthesis.objects.mesh_builder import palette
from lodbench.synthesis.photo import LookRanges
from lodbench.synthesis.town.shapes import Points


@dataclass(frozen=True, slots=True, eq=False)
class TownLook:
    """What two towns differ in besides chance."""

    name: str  # ``test`` or ``train``
    rings: float  # how strongly streets lean towards rings and spokes around the market: 0 to 1
    relief: float  # height of the hills against usual ones
    half_hipped: float  # share of plain gabled houses that get such a roof instead
    shed: float  # likewise
    trees: float  # density of trees against usual
    broadleaf: float  # share of trees that are no conifers
    walls: Points  # colours to draw from, (N, 3) RGB in white light, as the next three
    tiles: Points
    flat_roofs: Points
    grass: Points
    road: Points  # colour, (1, 3)
    water: Points  # likewise
    days: LookRanges  # sun, air and season of the flights over it


TEST = TownLook(
    name="test",
    rings=1.0,
    relief=1.0,
    half_hipped=0.14,
    shed=0.05,
    trees=1.0,
    broadleaf=0.85,
    walls=palette("e2d8c4 ece6da d6be96 cdae8c c4c4be dcc8b2"),
    tiles=palette("9c523c 8a4a3a ac6246 78463a 605c5e"),
    flat_roofs=palette("92908a 787672 a8a49c 687064"),
    grass=palette("60763e 6e7e46 546c3a 7a8050"),
    road=palette("707072"),
    water=palette("465c5c"),
    days=LookRanges(
        sun_elevation_deg=(30.0, 58.0),
        sun_share=(0.45, 0.8),
        haze_range_m=(2500.0, 8000.0),
        dryness=(0.1, 0.5),
    ),
)
TRAIN = TownLook(
    name="train",
    rings=0.15,
    relief=0.6,
    half_hipped=0.04,
    shed=0.16,
    trees=1.3,
    broadleaf=0.55,
    walls=palette("965442 a86650 e8e8e6 bab0a6 7c7068 ceced4"),
    tiles=palette("54545a 42444a 686260 7a5446 5c4c44"),
    flat_roofs=palette("5c5e62 babab8 847e76 4a4c4e"),
    grass=palette("767a42 68703c 868454 5c7446"),
    road=palette("58585c"),
    water=palette("546250"),
    days=LookRanges(
        sun_elevation_deg=(18.0, 45.0),
        sun_share=(0.2, 0.7),
        haze_range_m=(1200.0, 5000.0),
        dryness=(0.3, 0.8),
    ),
)
_LOOKS = {look.name: look for look in (TEST, TRAIN)}


def look_named(name: str) -> TownLook:
    """Returns a look.

    Raises:
        DatasetError: There is none of that name.
    """
    if name not in _LOOKS:
        raise DatasetError(f"The demo town has no look {name!r}.", nearest_names(name, _LOOKS))
    return _LOOKS[name]
