"""CityJSON and CityJSONSeq, read and written."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lodbench.citymodel.formats import text_of

if TYPE_CHECKING:
    from lodbench.citymodel.options import ReadOptions
    from lodbench.citymodel.raw import RawCity
    from lodbench.citymodel.source import Source


class CityJson:
    """CityJSON and CityJSONSeq (a ``CityFormat``)."""

    label = "CityJSON"
    suffixes = (".json", ".jsonl")

    @staticmethod
    def identify(head: bytes, suffix: str) -> bool:
        """Returns whether a file begins as JSON does."""
        return text_of(head).startswith((b"{", b"["))

    @staticmethod
    def read(source: Source, options: ReadOptions) -> RawCity:
        """Returns the buildings, and what ``options.layers`` names."""
        from lodbench.citymodel.cityjson.reader import read_cityjson
        from lodbench.citymodel.pictures import details_wanted

        return read_cityjson(source.open, source.name, **details_wanted(source.path, source.name, options))
