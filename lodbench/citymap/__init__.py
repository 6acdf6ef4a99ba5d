"""The map that methods are handed: all that can be asked of a city, batched over poses and counted."""

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.citymap.city_map import CityMap as CityMap
    from lodbench.citymap.city_map import MapUsage as MapUsage

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "CityMap": "city_map",
        "MapUsage": "city_map",
    },
)
