"""The map that methods are handed: all that can be asked of a city, batched over poses and counted."""

from lodbench.citymap.city_map import CityMap
from lodbench.citymap.usage import MapUsage

__all__ = ["CityMap", "MapUsage"]
