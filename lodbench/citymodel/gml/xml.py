"""The one place where XML is parsed: streamed, bounded, and closed to everything but the file itself.

A document type declaration is refused outright, so there are no entities, no external files and no
network. One member of the city is in memory at a time.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, Protocol, cast

from lxml import etree

from lodbench.citymodel.codes import UNDECLARED_PREFIX
from lodbench.errors import CityModelError
from lodbench.findings import Findings

Element = etree._Element

_CHUNK_BYTES = 1 << 16
# One city object of this size would need about 1.3 GB as a tree; real ones stay below 50 MB.
_MAX_MEMBER_BYTES = 1 << 28
# Everything XML allows before the root element, up to a DOCTYPE. NUL bytes are removed before the
# match, so that UTF-16 cannot hide it.
_PROLOG_DOCTYPE = re.compile(
    rb"\A(?:\xef\xbb\xbf|\xff\xfe|\xfe\xff)?(?:\s|<\?.*?\?>|<!--.*?-->)*<!DOCTYPE", re.DOTALL
)
# What libxml2 says of a text of single bytes that calls itself UTF-16 depends on where the text breaks.
_WIDE_LABEL = re.compile(
    rb"\A(?:\xef\xbb\xbf)?<\?xml[^>]*encoding=[\"'](?:utf-?(?:16|32)|ucs)", re.IGNORECASE
)
_NAMESPACE_ERRORS = frozenset({"NS_ERR_UNDEFINED_NAMESPACE"})


@lru_cache(maxsize=1024)  # a file has some dozen tags, and asks a thousand times a second
def local_name(tag: str) -> str:
    """Returns a tag without its namespace.

    Example:
        >>> local_name("{http://www.opengis.net/gml}Polygon")
        'Polygon'
    """
    return tag.rpartition("}")[2]


def namespace_of(tag: str) -> str:
    """Returns the namespace of a tag, or "" where it has none.

    Example:
        >>> namespace_of("{http://www.opengis.net/gml}Polygon")
        'http://www.opengis.net/gml'
    """
    return tag[1:].partition("}")[0] if tag.startswith("{") else ""


class NotFolded(CityModelError):
    """A document has to be read as it stands."""


class Folder(Protocol):
    """Writes a document shorter before it is parsed; under ``count`` keys it holds what it took out."""

    count: int

    def feed(self, chunk: bytes) -> bytes:
        """Returns what of the document is to be parsed next; an empty chunk ends it."""

    def forget(self, last: int) -> None:
        """Drops what is held under the first keys.

        Raises:
            NotFolded: It may hold faults of XML.
        """


class XmlMembers:
    """Iterates over the members of a document, each as a tree that is freed when the next is requested.

    A member is an element with one of the given local names that is a child of the root, or of a
    ``CityModel`` below it. Memory does not grow with the file.

    Args:
        stream: The document's bytes.
        source: Its name, for messages.
        member_names: Local names of member elements.
        findings: Receives ``UNDECLARED_PREFIX`` where a prefix is not declared; every other fault
            of the XML is an error.
        folding: What to send the bytes through; None for nothing. It holds what it took out of a member
            until the next one is requested.

    Attributes:
        root: The root element, known once the first member is out or the iteration has ended.
    """

    def __init__(
        self,
        stream: BinaryIO,
        source: str,
        member_names: tuple[str, ...],
        findings: Findings,
        *,
        folding: Folder | None = None,
    ) -> None:
        self._folding = folding
        self.root: Element | None = None
        self._stream = stream
        self._source = source
        self._findings = findings
        self._offset = 0
        self._logged = self._num_ended = 0
        self._is_mislabelled = False
        self._parser = etree.XMLPullParser(
            events=("end",),
            tag=tuple("{*}" + name for name in member_names),
            resolve_entities=False,
            no_network=True,
            load_dtd=False,
            dtd_validation=False,
            attribute_defaults=False,
            remove_comments=True,
            remove_pis=True,
            collect_ids=False,
            # Without it a single text of 10 MB is an error. The depth limit it raises is 2048, the
            # entity limits stay, and _MAX_MEMBER_BYTES bounds what is held.
            huge_tree=True,
        )

    def __iter__(self) -> Iterator[Element]:
        """Yields the members.

        Raises:
            CityModelError: The XML is malformed, cut off, holds a DOCTYPE, or a member is too large.
            NotFolded: The same, with a ``folding``.
        """
        pending = 0  # bytes since a member has ended
        while chunk := self._stream.read(_CHUNK_BYTES):
            if self._offset == 0 and _PROLOG_DOCTYPE.match(chunk.replace(b"\0", b"")):
                raise self._doctype_error()
            if self._offset == 0:
                self._is_mislabelled = _WIDE_LABEL.match(chunk) is not None
            self._offset += len(chunk)
            before = self._num_ended
            yield from self._members(chunk)
            pending = 0 if self._num_ended > before else pending + len(chunk)
            if pending > _MAX_MEMBER_BYTES:
                raise CityModelError(
                    f"{self._source}: one element of the XML is larger than {_MAX_MEMBER_BYTES >> 20} MiB "
                    f"(near byte {self._offset}).",
                    "Is it a city model? Its members are single buildings.",
                )
        if self._folding is not None:
            yield from self._members(b"")
        self._close()
        if self._folding is not None:
            self._folding.forget(self._folding.count)

    def _members(self, chunk: bytes) -> Iterator[Element]:
        """Yields the members that end in a chunk."""
        folding, num_before = self._folding, 0
        if folding is not None:
            num_before = folding.count
            chunk = folding.feed(chunk)
        if chunk:
            self._feed(chunk)
        has_ended = False
        for _, element in self._parser.read_events():
            self._num_ended += 1
            if isinstance(element, Element) and self._is_member(element):
                has_ended = True
                yield element
                _release(element)
        if folding is not None and has_ended:  # what is still open began in this chunk
            folding.forget(num_before)

    def _is_member(self, element: Element) -> bool:
        if self.root is None:
            self._set_root(element.getroottree().getroot())
        parent = element.getparent()
        return parent is not None and (parent is self.root or local_name(parent.tag) == "CityModel")

    def _set_root(self, root: Element) -> None:
        # The prolog check above sees one chunk; this one sees any DOCTYPE at all.
        if root.getroottree().docinfo.internalDTD is not None:
            raise self._doctype_error()
        self.root = root

    def _feed(self, chunk: bytes) -> None:
        try:
            self._parser.feed(chunk)
        except etree.XMLSyntaxError as error:
            raise self._syntax_error(error) from None
        # Some faults stop the parser without an exception, and the next feed would start it anew.
        log = self._parser.feed_error_log
        for index in range(self._logged, len(log)):
            entry = cast("etree._LogEntry", log[index])
            if entry.level >= etree.ErrorLevels.FATAL:
                raise self._fault(entry.line, entry.message)
        self._logged = len(log)

    def _close(self) -> None:
        if self._offset == 0:
            raise CityModelError(f"{self._source} is empty.", "Download or export the file again.")
        try:
            root = self._parser.close()
        except etree.XMLSyntaxError as error:
            slips, faults = self._sort_log()
            if faults or self.root is None or self._folding is not None:
                raise self._syntax_error(error) from None
            for line, message in slips:
                self._findings.add(UNDECLARED_PREFIX, "", f"line {line}: {message}")
            return
        if self.root is None:
            self._set_root(root)

    def _sort_log(self) -> tuple[list[tuple[int, str]], list[tuple[int, str]]]:
        """Returns line and message of undeclared prefixes, and those of all other faults."""
        slips: list[tuple[int, str]] = []
        faults: list[tuple[int, str]] = []
        # The parser's own log: the one on an exception can hold entries of other documents.
        for entry in cast("Iterable[etree._LogEntry]", self._parser.feed_error_log):
            kind = slips if entry.type_name in _NAMESPACE_ERRORS else faults
            kind.append((entry.line, entry.message))
        return slips, faults

    def _doctype_error(self) -> CityModelError:
        return CityModelError(
            f"{self._source}: the XML has a DOCTYPE declaration, which is refused.",
            "City models need none: remove the declaration and any entity it defines.",
        )

    def _syntax_error(self, error: etree.XMLSyntaxError) -> CityModelError:
        # The last entry that is no mere namespace slip is the one that stopped the parser.
        _, faults = self._sort_log()
        line, message = faults[-1] if faults else (error.lineno or 0, str(error.msg))
        return self._fault(line, message)

    def _fault(self, line: int, message: str) -> CityModelError:
        if self._folding is not None:
            return NotFolded(f"{self._source} is not well-formed XML: {message.strip()}.")
        where = f"line {line}, before byte {self._offset}"
        hint = "The file is damaged or cut off: download or export it again."
        if self._is_mislabelled or "encoding" in message.lower():
            hint = "The bytes are not in the encoding the first line of the file names."
        elif message.startswith("Entity '"):
            hint = "City models need no entities."
        return CityModelError(f"{self._source} is not well-formed XML ({where}): {message.strip()}.", hint)


def parse_document(path: Path) -> Element:
    """Returns the root of a whole document in memory, for the comparison with reading it in a stream.

    Raises:
        CityModelError: The file cannot be read, is not well-formed, or has a DOCTYPE.
    """
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, dtd_validation=False, huge_tree=True
    )
    try:
        tree = etree.parse(str(path), parser)
    except (OSError, etree.XMLSyntaxError) as error:
        raise CityModelError(f"{path} cannot be parsed as a whole: {error}.") from None
    if tree.docinfo.internalDTD is not None:
        raise CityModelError(f"{path}: the XML has a DOCTYPE declaration, which is refused.")
    return tree.getroot()


def _release(element: Element) -> None:
    """Frees a member and everything before it."""
    parent = element.getparent()
    element.clear()
    if parent is not None:
        while element.getprevious() is not None:
            del parent[0]


XLINK_HREF = "{http://www.w3.org/1999/xlink}href"


# By their names, in UCUM and in EPSG; without a unit a length is in metres.
_METRES_PER_UNIT = (
    dict.fromkeys(("", "m", "metre", "metres", "meter", "meters", "9001"), 1.0)
    | {"mm": 1e-3, "cm": 1e-2, "dm": 1e-1, "km": 1e3}
    | dict.fromkeys(("ft", "foot", "feet", "[ft_i]", "ft_i", "9002"), 0.3048)
    | dict.fromkeys(("us-ft", "ftus", "[ft_us]", "ft_us", "9003"), 1200.0 / 3937.0)
)

_DECIMALS = re.compile(r"\s*(?:[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?(?:\s+|\Z))*")

MAX_DEPTH = 8


def numbers_in(element: Element) -> list[str]:
    """Returns the decimals that are all of an element's text; nothing where there is anything else."""
    text = element.text or ""
    return text.split() if _DECIMALS.fullmatch(text) else []


def metres_of(element: Element) -> float | None:
    """Returns the metres per unit that a measure declares, None where its unit is no known length."""
    return _metres_per(element.get("uom", "m"))


@lru_cache(maxsize=256)
def _metres_per(uom: str) -> float | None:
    unit = uom.strip().lower()
    # What divides is no length; names of authorities are URNs and addresses.
    name = unit if "/" in unit and "://" not in unit else re.split("[:#/]", unit)[-1]
    return _METRES_PER_UNIT.get(name)


def put_value(values: dict[str, Any], name: str, value: Any) -> None:
    """Adds a value; a name met again becomes a list."""
    if name not in values:
        values[name] = value
    elif isinstance(values[name], list):
        values[name].append(value)
    else:
        values[name] = [values[name], value]


def value_of(element: Element, depth: int) -> Any:
    """Returns an element's text, a measure in metres, or a mapping of what is in it, ``MAX_DEPTH`` deep."""
    if len(element) == 0:
        text = (element.text or "").strip() or str(element.get(XLINK_HREF) or "")
        return _number(text, metres_of(element) or 1.0) if element.get("uom") is not None else text
    if depth >= MAX_DEPTH:
        return None
    values: dict[str, Any] = {}
    for child in element.iterchildren("*"):
        value = value_of(child, depth + 1)
        if value not in (None, "", {}):
            put_value(values, local_name(child.tag), value)
    return values


def _number(text: str, scale: float) -> Any:
    try:
        return float(text) * scale
    except ValueError:
        return text
