"""CityGML 1.0, 2.0 and 3.0: read a city object at a time, and written a building at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lodbench.citymodel.formats import text_of

if TYPE_CHECKING:
    from lodbench.citymodel.options import ReadOptions
    from lodbench.citymodel.raw import RawCity
    from lodbench.citymodel.source import Source


class CityGml:
    """CityGML 1.0 to 3.0 (a ``CityFormat``)."""

    label = "CityGML"
    suffixes = (".gml", ".xml", ".citygml")

    @staticmethod
    def identify(head: bytes, suffix: str) -> bool:
        """Returns whether a file begins as XML does."""
        return text_of(head).startswith(b"<")

    @staticmethod
    def read(source: Source, options: ReadOptions) -> RawCity:
        """Returns the buildings, and what ``options.layers`` names."""
        from lodbench.citymodel.gml.reader import read_citygml
        from lodbench.citymodel.pictures import details_wanted

        return read_citygml(source.open, source.name, **details_wanted(source.path, source.name, options))
