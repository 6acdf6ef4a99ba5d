"""JSON in city models: one document, or one to a line; strict, and with keys that stand twice told."""

from __future__ import annotations

import gc
import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, BinaryIO

from lodbench.errors import CityModelError

# A feature is one building with its parts; a line of this size is something else.
_MAX_LINE_BYTES = 1 << 28

Json = dict[str, Any]


@contextmanager
def paused_collector() -> Iterator[None]:
    """Keeps Python from looking for cycles: JSON has a million lists and none, and it doubles the time."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def documents_of(stream: BinaryIO, source: str, repeated: list[str]) -> Iterator[Any]:
    """Yields one JSON document per line of a sequence, or the one document that fills the file."""
    first = stream.readline(_MAX_LINE_BYTES)
    try:
        yield _parse(first, source, 1, repeated)
    except CityModelError:
        rest = stream.read()
        if not rest.strip():
            raise
        # Not one document per line: a single one over many lines.
        yield _parse(first + rest, source, None, repeated)
        return
    for number, line in enumerate(iter(lambda: stream.readline(_MAX_LINE_BYTES), b""), start=2):
        if line.strip():
            yield _parse(line, source, number, repeated)


def _parse(data: bytes, source: str, line: int | None, repeated: list[str]) -> Any:
    where = f"{source}, line {line}" if line is not None else source

    def mapping(pairs: list[tuple[str, Any]]) -> Json:
        values = dict(pairs)
        return values if len(values) == len(pairs) else _apart(pairs, repeated)

    try:
        return json.loads(
            data.decode("utf-8-sig"),
            parse_constant=_refuse_constant,
            object_pairs_hook=mapping,
        )
    except RecursionError:
        raise CityModelError(
            f"{where}: the JSON is nested too deeply.",
            "City models nest a dozen levels: do not trust this file.",
        ) from None
    except UnicodeDecodeError as error:
        raise CityModelError(
            f"{where} is not UTF-8 (byte {error.start}).", "CityJSON is UTF-8: convert the file."
        ) from None
    except ValueError as error:
        raise CityModelError(
            f"{where} is not well-formed JSON: {error}.",
            "The file is damaged or cut off: download or export it again.",
        ) from None


def _apart(pairs: list[tuple[str, Any]], repeated: list[str]) -> Json:
    """Returns a JSON object with keys that stand twice; city objects stay apart, the later as ``id~2``."""
    values: Json = {}
    numbers: Counter[str] = Counter()  # how often each was met: the search goes on where it ended
    for key, value in pairs:
        own = key
        if isinstance(value, dict) and "type" in value:
            while own in values:
                numbers[key] += 1
                own = f"{key}~{numbers[key] + 1}"
            if own != key:
                repeated.append(key)
        values[own] = value
    return values


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is no JSON number")
