"""Plain surfaces taken out of the bytes of CityGML before a parser meets them: most of what a file has.

What is folded is written as nearly all writers do, tag by tag; everything else goes to the parser as it
stands, and so does the whole document where something folded turns out to be at fault (``NotFolded``).
"""

from __future__ import annotations

import re
from functools import lru_cache
from secrets import token_hex
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.gml.names import OUTER_NAMES
from lodbench.citymodel.gml.xml import NotFolded

_SEPARATOR = b";"
# Numbers of all texts of a process up to which no kernel is loaded: Python reads these in 0.2 s, and
# numba takes 0.4 to load.
_FEW_NUMBERS = 1_000_000
# Plain decimals between white space, as ``kernels.scan`` takes them.
_DECIMAL = rb"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?"
_NUMBER = re.compile(_DECIMAL)
_NUMBERS = re.compile(rb"\s*(?:%s(?:\s+|\Z))*" % _DECIMAL)
_num_counted = 0


def parse_rings(texts: list[bytes]) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Returns the numbers of many texts, how many each has, and which texts are not clean.

    A text that holds anything but finite decimals is not clean; its numbers are NaN where they
    could not be read. An empty text has no numbers and is clean.

    Args:
        texts: Numbers separated by white space, one text per ring, in ASCII where they are clean.

    Returns:
        values: (V,) float64, all texts in a row.
        counts: (R,) int64 numbers per text.
        is_bad: (R,) bool.

    Example:
        >>> parse_rings([b"1 2.5", b"3 nan"])[1:]
        (array([2, 2]), array([False,  True]))
    """
    joined = _SEPARATOR.join(texts)
    if not joined.isascii() or joined.count(_SEPARATOR) != len(texts) - 1:
        foreign = [not text.isascii() or _SEPARATOR in text for text in texts]
        clean = [b"?" if is_foreign else text for text, is_foreign in zip(texts, foreign, strict=True)]
        texts, joined = clean, _SEPARATOR.join(clean)
    if is_few(len(joined) // 8):  # a number has seven characters and a blank at least, mostly
        return _parse_few(texts)
    from lodbench.kernels import parse_decimals
    from lodbench.kernels.arguments import POWERS_OF_TEN

    if not texts:
        return np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.bool_)
    data = np.frombuffer(joined, dtype=np.uint8)
    values = np.zeros(len(data) // 2 + 1)
    spans = np.zeros((0, 2), np.int64)
    while True:
        counts = np.zeros(len(texts), np.int64)
        is_bad = np.zeros(len(texts), np.bool_)
        num_values, num_long = parse_decimals(data, POWERS_OF_TEN, values, counts, is_bad, spans)
        if num_long <= len(spans):
            break
        spans = np.zeros((num_long, 2), np.int64)  # rare, so room is made only when there are some
    values = values[:num_values].copy()
    _repair_long(joined, values, counts, is_bad, spans[:num_long])
    return values, counts, is_bad


def is_few(num_numbers: int) -> bool:
    """Counts numbers; returns whether there are so few in all that no kernel is worth its loading."""
    global _num_counted
    _num_counted += num_numbers
    return _num_counted <= _FEW_NUMBERS


def _parse_few(
    texts: list[bytes],
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Returns what ``parse_rings`` does of texts in ASCII, by Python's own ``float``."""
    values: list[float] = []
    counts = np.zeros(len(texts), np.int64)
    is_bad = np.zeros(len(texts), np.bool_)
    for n, data in enumerate(texts):
        words = data.split()
        if _NUMBERS.fullmatch(data):
            numbers = [float(word) for word in words]
            is_bad[n] = not np.isfinite(numbers).all()
        else:
            numbers = [float(word) if _NUMBER.fullmatch(word) else np.nan for word in words]
            is_bad[n] = True
        counts[n] = len(numbers)
        values += numbers
    return np.array(values, np.float64), counts, is_bad


def _repair_long(
    joined: bytes,
    values: NDArray[np.float64],
    counts: NDArray[np.int64],
    is_bad: NDArray[np.bool_],
    spans: NDArray[np.int64],
) -> None:
    """Reads the rare numbers with more digits or exponent than the fast path takes, in place."""
    if len(spans) == 0:
        return
    ends = np.cumsum(counts)
    for index, offset in spans.tolist():
        token = joined[offset : offset + 400].split(_SEPARATOR)[0].split(maxsplit=1)[0]
        values[index] = float(token)
        if not np.isfinite(values[index]):
            is_bad[np.searchsorted(ends, index, side="right")] = True


class FoldedRings(NamedTuple):
    """Rings that are a polygon each, as text; either all declare three dimensions or none declares any."""

    texts: list[bytes]
    is_solid: bool


class FoldedSurface(NamedTuple):
    """A surface of a building: its name (``WallSurface``), level, and the id and rings of its polygons."""

    name: str
    lod: str
    polygon_id: str
    rings: FoldedRings


# Attribute of a folded boundary.
FOLDED = "folded"
# Names of encodings where every byte of "<" begins a tag.
_SINGLE_BYTES = (b"utf-8", b"us-ascii", b"iso-8859", b"windows-125")
_ENCODING = re.compile(rb"""encoding\s*=\s*["']([^"']*)""")
_FIRST_MEMBER = re.compile(rb"<((?:\w++:)?)surfaceMember>\s*+<\1Polygon\b")
_NAMES = "|".join(sorted(OUTER_NAMES)).encode()
_FIRST_BOUNDARY = re.compile(rb"<((?:\w++:)?)boundedBy>\s*+<\1(?:%b)\b" % _NAMES)
# Comments and the like, and white space that is none in XML.
_NOT_AMONG = (b"<!", b"<?", b"\v", b"\f")
_OF_NUMBERS = b"+-.0123456789eE \t\r\n"
_MAX_HELD_BYTES = 1 << 20


def _id_of(gml: bytes) -> bytes:
    """Returns the pattern of an attribute ``gml:id`` that may be there; without a prefix there is none."""
    return rb"(?:\s++%bid=\"[-\w.:]++\")?" % gml if gml else b""


def _plain_member(gml: bytes) -> bytes:
    """Returns the pattern of a polygon of one ring; groups: its id, whether its ring is 3D, its numbers."""
    tags = (b"surfaceMember", b"Polygon", b"exterior", b"LinearRing", b"posList")
    own_id = _id_of(gml)
    inside = {
        b"Polygon": b"(%b)" % own_id,
        b"LinearRing": own_id,
        b"posList": rb"((?:\s++srsDimension=\"3\")?)",
    }
    begin = rb"\s*+".join(b"<%b%b%b>" % (gml, tag, inside.get(tag, b"")) for tag in tags)
    end = rb"\s*+".join(b"</%b%b>" % (gml, tag) for tag in reversed(tags))
    return begin + b"([^<]*+)" + end


@lru_cache(maxsize=16)
def _plain_members(gml: bytes) -> re.Pattern[bytes]:
    return re.compile(_plain_member(gml))


@lru_cache(maxsize=16)
def _plain_boundaries(city: bytes, gml: bytes) -> re.Pattern[bytes]:
    """Returns the pattern of what bounds a building and has one plain polygon.

    Groups: its name, one that is of no use, its level, and those of the polygon.
    """
    return re.compile(
        (
            rb"<%(c)bboundedBy>\s*+<%(c)b(%(n)b)%(i)b>\s*+"
            rb"(?:<((?:\w++:)?)creationDate>[-\w.:+]*+</\2creationDate>\s*+)?"
            rb"<%(c)blod([0-4])MultiSurface>\s*+<%(g)bMultiSurface%(i)b>\s*+%(m)b\s*+"
            rb"</%(g)bMultiSurface>\s*+</%(c)blod\3MultiSurface>\s*+</%(c)b\1>\s*+</%(c)bboundedBy>"
        )
        % {b"c": city, b"g": gml, b"n": _NAMES, b"i": _id_of(gml), b"m": _plain_member(gml)}
    )


def _is_single_bytes(head: bytes) -> bool:
    """Returns whether a document's first bytes name an encoding where every "<" begins a tag, or none."""
    declaration, end, _ = head[:256].partition(b"?>")
    encoding = _ENCODING.search(declaration)
    is_known = encoding is None or encoding[1].lower().startswith(_SINGLE_BYTES)
    return b"\0" not in head and (b"<?" not in declaration or (bool(end) and is_known))


class Folding:
    """Writes a document shorter as its bytes pass by.

    ``<surfaceMember><Polygon gml:id="a"><exterior><LinearRing><posList>1 2 3 ...`` becomes
    ``<Polygon gml:id="a">KEY</Polygon>``; one element stands for a row of members without ids. If nothing
    but such a polygon is in a wall or roof, a row of these becomes ``<boundedBy gml:folded="KEY"/>``.

    Args:
        is_on: Whether it does; else it lets all pass.

    Attributes:
        rings: For each key of a polygon, which no document holds, what it stands for.
        surfaces: The same for each key of a boundary.
        has_folded, has_boundaries: Whether anything was folded, and among it boundaries.
        has_links: Whether XLinks may have passed by besides those of members of surfaces.
        count: Keys given so far.
    """

    def __init__(self, *, is_on: bool = True) -> None:
        self.rings: dict[str, FoldedRings] = {}
        self.surfaces: dict[str, list[FoldedSurface]] = {}
        self.has_folded, self.has_boundaries, self.has_links = False, False, not is_on
        self.count = 0
        self._mark = token_hex(8)
        self._is_on: bool | None = None if is_on else False
        self._unread: set[str] = (
            set()
        )  # keys that nobody has requested, who would find fault with the numbers
        self._gml: bytes | None = None
        self._city: bytes | None = None
        self._held = self._tail = b""

    def feed(self, chunk: bytes) -> bytes:
        """Returns what came since and is whole by now, folded; an empty chunk ends the document."""
        if self._is_on is None:
            self._is_on = _is_single_bytes(chunk)
            self.has_links = not self._is_on
        if not self._is_on:
            return chunk
        data, self._held = self._held + chunk, b""
        if self._gml is None:
            first = _FIRST_MEMBER.search(data)
            self._gml = None if first is None else first[1]
        whole = self._whole(data) if chunk else len(data)
        if len(data) - whole < _MAX_HELD_BYTES:
            data, self._held = data[:whole], data[whole:]
        folded = data if self._gml is None else self._fold(data, self._gml)
        self.has_links = self.has_links or (self._tail + folded).count(b"href") > folded.count(
            b"surfaceMember xlink:href="
        )
        self._tail = folded[-3:]
        return folded

    def _whole(self, data: bytes) -> int:
        """Returns the length without a tag, a member or a boundary that has not ended yet."""
        size = data.rfind(b"<")
        size = len(data) if size < 0 or data.find(b">", size) >= 0 else size
        for prefix, name in ((self._gml, b"surfaceMember"), (self._city, b"boundedBy")):
            if prefix is not None:
                first = data.rfind(b"<%b%b>" % (prefix, name))
                if first >= 0 and data.find(b"</%b%b>" % (prefix, name), first) < 0:
                    size = min(size, first)
        return size

    def _fold(self, data: bytes, gml: bytes) -> bytes:
        # Comments and the like may hold anything; they are dropped, but none must end in what is folded.
        start = data.find(b"<%bsurfaceMember>" % gml)
        if start < 0 or any(sign[-1:] in data and data.find(sign, start) >= 0 for sign in _NOT_AMONG):
            return data
        if self._city is None and b"boundedBy>" in data:
            first = _FIRST_BOUNDARY.search(data)
            self._city = None if first is None else first[1]
        folded = data
        if self._city is not None:
            parts = _plain_boundaries(self._city, gml).split(folded)
            if b">" in b"".join(parts[6::7]):
                return data
            folded = self._fold_boundaries(parts, self._city, gml)
        parts = _plain_members(gml).split(folded)
        if b">" in b"".join(parts[3::4]):
            return data
        return self._fold_members(parts, gml)

    def _fold_boundaries(self, parts: list[bytes], city: bytes, gml: bytes) -> bytes:
        """Returns a piece of the document; ``parts`` are what stands around boundaries, and their groups."""
        pieces, row = [parts[0]], []
        for n in range(1, len(parts), 7):
            name, _, lod, attribute, dimension, numbers, rest = parts[n : n + 7]
            polygon_id = attribute.decode().partition('"')[2][:-1]
            rings = FoldedRings([numbers], bool(dimension))
            row.append(FoldedSurface(name.decode(), lod.decode(), polygon_id, rings))
            if n + 7 == len(parts) or (rest and not rest.isspace()):
                key = self._next_key()
                self.surfaces[key], row = row, []
                self.has_boundaries = True
                pieces += (b'<%bboundedBy %b%b="%b"/>' % (city, gml, FOLDED.encode(), key.encode()), rest)
        return b"".join(pieces)

    def _fold_members(self, parts: list[bytes], gml: bytes) -> bytes:
        """Returns a piece of the document; ``parts`` are what stands around members, and their groups."""
        ids, dimensions, numbers, rests = (parts[n::4] for n in range(1, 5))
        ends = list(range(1, len(rests) + 1))
        if not any(ids) and len(set(dimensions)) == 1:  # then a row of them is one element
            ends = [n for n in ends if n == len(rests) or b"<" in rests[n - 1]]
        pieces, first = [parts[0]], 0
        tag = b"%bPolygon" % gml
        for end in ends:
            key = self._next_key()
            self.rings[key] = FoldedRings(numbers[first:end], bool(dimensions[first]))
            pieces += (b"<%b%b>%b</%b>" % (tag, ids[first], key.encode(), tag), rests[end - 1])
            first = end
        return b"".join(pieces)

    def _next_key(self) -> str:
        self.count += 1
        self.has_folded = True
        key = f"{self._mark}{self.count}"
        self._unread.add(key)
        return key

    def rings_at(self, text: str | None) -> FoldedRings | None:
        """Returns what a polygon of some text stands for, None where it is what it is.

        Raises:
            NotFolded: It is forgotten.
        """
        text = text or ""
        rings = self.rings.get(text)
        self._look_up(text, rings is not None)
        return rings

    def surfaces_at(self, value: str) -> list[FoldedSurface] | None:
        """Returns what a boundary with an attribute of some value stands for; else as ``rings_at``."""
        surfaces = self.surfaces.get(value)
        self._look_up(value, surfaces is not None)
        return surfaces

    def _look_up(self, key: str, is_there: bool) -> None:
        if is_there:
            self._unread.discard(key)
        elif key.startswith(self._mark):
            raise NotFolded("A member goes on behind others that it holds.")

    def forget(self, last: int) -> None:
        """Drops the keys up to a number.

        Raises:
            NotFolded: Nobody has looked at what stood there, and it is more than numbers.
        """
        for kept in (self.rings, self.surfaces):
            for key in [key for key in kept if int(key[len(self._mark) :]) <= last]:
                folded = kept.pop(key)
                if key in self._unread:
                    self._unread.remove(key)
                    rows = [folded] if isinstance(folded, FoldedRings) else [each.rings for each in folded]
                    if b"".join(text for rings in rows for text in rings.texts).translate(None, _OF_NUMBERS):
                        raise NotFolded("What no building has is no list of numbers.")
