"""Footprints with heights from the formats of GIS, through GDAL; and GDAL itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lodbench.citymodel.options import ReadOptions
    from lodbench.citymodel.raw import RawCity
    from lodbench.citymodel.source import Source


class Footprints:
    """Footprints with heights, as blocks (a ``CityFormat``)."""

    label = "footprints with heights"
    suffixes = (".gpkg", ".shp", ".geojson", ".fgb", ".gdb", ".parquet", ".geoparquet", ".pbf", ".osm")
    needs_path = True

    @staticmethod
    def identify(head: bytes, suffix: str) -> bool:
        """Returns whether a file is called as those that GDAL reads."""
        return suffix in Footprints.suffixes

    @staticmethod
    def read(source: Source, options: ReadOptions) -> RawCity:
        """Returns footprints with heights, as blocks.

        Raises:
            CityModelError: The file is none that GDAL reads, or the extra is not installed.
        """
        from lodbench.citymodel.vector.footprints import read_footprints

        return read_footprints(source.vector_path or str(source.path), source.name, options)
