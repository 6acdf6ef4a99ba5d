"""How a town looks: two made-up places that share no street, no roof mix and no colour range.

A network trained on one town must not have seen the other. Seeds alone would leave them alike.
"""

from __future__ import annotations

from dataclasses import dataclass

from lodbench.errors import DatasetError, nearest_names

Colour = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class TownLook:
    """What two towns differ in besides chance.

    Attributes:
        name: ``test`` or ``train``.
        rings: How strongly streets lean towards rings and spokes around the market: 0 to 1.
        relief: Height of the hills against usual ones.
        half_hipped, shed: Shares of plain gabled houses that get such a roof instead.
        trees: Density of trees against usual.
        broadleaf: Share of trees that are no conifers.
        walls, tiles, flat_roofs, grass: Colours to draw from, RGB in white light.
        road, water: Colours, likewise.
    """

    name: str
    rings: float
    relief: float
    half_hipped: float
    shed: float
    trees: float
    broadleaf: float
    walls: tuple[Colour, ...]
    tiles: tuple[Colour, ...]
    flat_roofs: tuple[Colour, ...]
    grass: tuple[Colour, ...]
    road: Colour
    water: Colour


TEST = TownLook(
    name="test",
    rings=1.0,
    relief=1.0,
    half_hipped=0.14,
    shed=0.05,
    trees=1.0,
    broadleaf=0.85,
    walls=(
        (226, 216, 196),
        (236, 230, 218),
        (214, 190, 150),
        (205, 174, 140),
        (196, 196, 190),
        (220, 200, 178),
    ),
    tiles=((156, 82, 60), (138, 74, 58), (172, 98, 70), (120, 70, 58), (96, 92, 94)),
    flat_roofs=((146, 144, 138), (120, 118, 114), (168, 164, 156), (104, 112, 100)),
    grass=((96, 118, 62), (110, 126, 70), (84, 108, 58), (122, 128, 80)),
    road=(112, 112, 114),
    water=(70, 92, 92),
)
TRAIN = TownLook(
    name="train",
    rings=0.15,
    relief=0.6,
    half_hipped=0.04,
    shed=0.16,
    trees=1.3,
    broadleaf=0.55,
    walls=((150, 84, 66), (168, 102, 80), (232, 232, 230), (186, 176, 166), (124, 112, 104), (206, 206, 212)),
    tiles=((84, 84, 90), (66, 68, 74), (104, 98, 96), (122, 84, 70), (92, 76, 68)),
    flat_roofs=((92, 94, 98), (186, 186, 184), (132, 126, 118), (74, 76, 78)),
    grass=((118, 122, 66), (104, 112, 60), (134, 132, 84), (92, 116, 70)),
    road=(88, 88, 92),
    water=(84, 98, 80),
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
