"""The map as it is to be expected where its source tells of pitched roofs (docs/adr/0067)."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np

from lodbench.citymap import CityMap
from lodbench.citymap.corrected_map import corrected_map
from lodbench.citymodel.pitched_blocks import pitched_blocks

# Of every map once; None where it stays as it is, since a map that holds itself is never freed.
_EXPECTED: WeakKeyDictionary[CityMap, dict[float, CityMap | None]] = WeakKeyDictionary()


def expected_map(city_map: CityMap, pitched_lower_m: float) -> CityMap:
    """Returns the map with blocks of pitched roofs so much lower; made once.

    Args:
        city_map: The map.
        pitched_lower_m: How much lower than in the map such blocks are, metres.
    """
    if pitched_lower_m == 0 or city_map.scene.pitched is None:
        return city_map
    known = _EXPECTED.setdefault(city_map, {})
    if pitched_lower_m not in known:
        heights_m = np.where(pitched_blocks(city_map.scene), -pitched_lower_m, 0.0)
        drawn, _ = corrected_map(city_map, heights_m, least_m=0.0)
        known[pitched_lower_m] = None if drawn is city_map else drawn
    return known[pitched_lower_m] or city_map
