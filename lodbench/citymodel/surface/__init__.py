"""Surface models as cities: heights on a grid, the ground below them, and what rises above it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lodbench.citymodel.formats import SURFACE_SUFFIXES

if TYPE_CHECKING:
    from lodbench.citymodel.options import ReadOptions
    from lodbench.citymodel.raw import RawCity
    from lodbench.citymodel.source import Source


class Surface:
    """What rises above the ground of a surface model (a ``CityFormat``)."""

    label = "surface models"
    suffixes = SURFACE_SUFFIXES
    is_tile = False

    @staticmethod
    def identify(head: bytes, suffix: str) -> bool:
        """Tells whether a file is called as these are."""
        return suffix in SURFACE_SUFFIXES

    @staticmethod
    def read(source: Source, options: ReadOptions) -> RawCity:
        """Returns what rises above the ground: of a raster, laser points, a folder of tiles.

        Raises:
            CityModelError: It cannot be read, or the extra is not installed.
        """
        from lodbench.citymodel.surface.reader import read_surface

        return read_surface(source.path, source.name, options)
