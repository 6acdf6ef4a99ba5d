"""Pitched roofs, by the words and codes under which sources describe roofs."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Attributes that name the kind of a roof: of CityGML and CityJSON, 3DBAG, OpenStreetMap, and ALKIS.
ATTRIBUTES = ("roofType", "b3_dak_type", "dak_type", "roof:shape", "roof_shape", "dachform")
# Of the surveying authorities of Germany (2100 to 3800) and of SIG 3D (1010 to 1100, 1120): single pitches,
# gables, hips, mansards, tents, cones, saw teeth, mixed forms. Flat, arched, combined and other ones are not.
_CODES = frozenset(
    {"2100", "2200", "3100", "3200", "3300", "3400", "3500", "3600", "3800", "5000"}
    | {"1010", "1020", "1030", "1040", "1050", "1060", "1070", "1080", "1100", "1120"}
)  # fmt: skip
# Four digits at the end: of the code itself, or of an address or a name, ".../roofType.xml#3100".
_CODE = re.compile(r"(?<!\d)(\d{4})(?:\.0)?\s*$")
# Parts of words, in lower case; what says that there is no pitch goes before.
_WORDS = (
    "slanted", "pitch", "gable", "hipped", "gambrel", "mansard", "pyramid", "skillion", "saltbox", "pavilion",
    "cone", "conical", "sawtooth", "sattel", "walm", "pultd", "zeltd", "kegeld", "sheddach", "zadeldak",
    "schilddak", "lessenaar", "tentdak",
)  # fmt: skip
_LEVEL_WORDS = ("flat", "unpitched", "not pitched")


def is_pitched(roof_type: str) -> bool:
    """Returns whether a word or code says that a roof is pitched; of unknown ones nothing is known.

    Example:
        >>> is_pitched("3100"), is_pitched("SATTELDACH"), is_pitched("multiple horizontal")
        (True, True, False)
    """
    words = roof_type.lower()
    code = _CODE.search(words)
    if code is not None:
        return code[1] in _CODES
    return any(word in words for word in _WORDS) and not any(word in words for word in _LEVEL_WORDS)


def roof_type_of(attributes: Mapping[str, Any]) -> str:
    """Returns the word or code under which an object's attributes describe its roof, or ""."""
    return next(filter(None, (word_of(attributes.get(name)) for name in ATTRIBUTES)), "")


def word_of(value: object) -> str:
    """Returns a value as a word or code, "" where it is none; codes may be numbers with a decimal point."""
    if isinstance(value, float):
        return str(int(value)) if value.is_integer() else ""
    return str(value).strip() if isinstance(value, str | int) and not isinstance(value, bool) else ""


def pitched_buildings(stated: Iterable[tuple[int, str]], count: int) -> NDArray[np.bool_] | None:
    """Returns (B,) which buildings have pitched roofs: at least half of what is stated of them says so.

    None where no building has.

    Args:
        stated: Buildings and words or codes; of those with parts, of each.
        count: Number of buildings, B.
    """
    balance, is_any = np.zeros(count, np.int64), np.zeros(count, np.bool_)
    for building, roof_type in stated:
        has_pitch = is_pitched(roof_type)
        balance[building] += 1 if has_pitch else -1
        is_any[building] |= has_pitch
    is_any &= balance >= 0
    return is_any if is_any.any() else None
