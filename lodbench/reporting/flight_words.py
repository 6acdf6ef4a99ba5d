"""What a flight says of drone, camera and map, in sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from lodbench.reporting.aligned_text import count_of

# What constants are called where people read them, in this order.
_CALLED = {
    "east": "positions, to the east", "north": "positions, to the north", "pitch": "gimbal pitch",
    "roll": "gimbal roll", "yaw": "heading, counter-clockwise", "focal length": "focal length",
    "radial distortion k1": "radial distortion k1", "masks too large by": "masks too large by",
    "roofs higher than the map": "heights of the map's roofs",
    "feet of walls higher than the map": "bases of the map's walls",
}  # fmt: skip
# Heights this far off, beyond doubt, are of another zero rather than of a barometer.
_OTHER_ZERO_M, _BEYOND_DOUBT = 8.0, 3.0


def constants_in_words(constants: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Returns a sentence per constant that the photos told, and one that names those they did not.

    Args:
        constants: By name ``value`` (to be added to what sensors or map say), ``sigma``, ``unit``, ``told``.
    """
    height, rows = constants.get("height"), constant_rows(constants)
    lines = [heights_in_words(height)] if height is not None and height["told"] else []
    added = [f"{called} {amount}" for called, amount, is_told in rows if is_told]
    silent = ["heights"] if height is not None and not height["told"] else []
    silent += [called for called, _, is_told in rows if not is_told]
    lines += [f"to be added to what was stated: {'; '.join(added)}"] if added else []
    lines += [f"not told by these photos, and left as stated: {'; '.join(silent)}"] if silent else []
    return lines


def constant_rows(constants: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str, bool]]:
    """Returns each constant but the height: its name, what is to be added, and whether photos told it."""
    order = [name for name in _CALLED if name in constants]
    order += [name for name in constants if name not in _CALLED and name != "height"]
    return [(_CALLED.get(name, name), _amount(constants[name]), constants[name]["told"]) for name in order]


def _amount(constant: Mapping[str, Any], *, signed: bool = True) -> str:
    """Returns ``-0.80 deg +-0.10``."""
    value, sigma, unit = constant["value"], constant["sigma"], constant["unit"]
    if unit == "share":
        value, sigma, unit = 100.0 * value, 100.0 * sigma, "%"
    # As many digits as the sigma's first.
    digits = min(max(-math.floor(math.log10(sigma)), 0), 5) if sigma > 0 else 2
    number = f"{round(value, digits) + 0.0:+.{digits}f}" if signed else f"{abs(value):.{digits}f}"
    return f"{number}{' ' if unit else ''}{unit} +-{sigma:.{digits}f}"


def heights_in_words(constant: Mapping[str, Any]) -> str:
    """Returns by how much heights are stated too high or too low, and what that looks like."""
    value, sigma = constant["value"], constant["sigma"]
    word = "high" if value < 0 else "low"
    amount = _amount(constant, signed=False).replace(" m", f" m too {word}", 1)
    if abs(value) < max(_OTHER_ZERO_M, _BEYOND_DOUBT * sigma):
        return f"heights are stated {amount}"
    asked = "ellipsoid or take-off" if value < 0 else "take-off"
    return f"heights are stated {amount}: {asked}? --heights says what they are above"


def map_in_words(findings: Mapping[str, Any], most: int = 5) -> list[str]:
    """Returns sentences about what the photos contradict in the map, the surest of each kind first.

    Places where the map has no building come apart: of a partial map there are many, and none is wrong.
    """
    rows, count = map_rows(findings), len(findings.get("buildings", []))
    lacking = sum(change["kind"] == "missing" for change in findings.get("changes", []))
    mapped, places = rows[: len(rows) - lacking], rows[len(rows) - lacking :]
    return [
        *_listed(
            f"the photos contradict the map in {_places(mapped)}, of {count} buildings they show:",
            mapped,
            most,
        ),
        *_listed(
            f"in {_places(places)} something stands that the map has not (a building, or containers and the "
            "like; a map may hold a part of all buildings):",
            places,
            most,
        ),
    ]


def _listed(head: str, rows: Sequence[tuple[str, str, str]], most: int) -> list[str]:
    """Returns a head and its rows as lines, nothing for no rows."""
    lines = [f"- {name}: {said}, by {photos}" for name, said, photos in rows[:most]]
    more = [f"- and {len(rows) - most} more"] if len(rows) > most else []
    return [head, *lines, *more] if rows else []


def _places(rows: Sequence[object]) -> str:
    return f"{len(rows)} place{'' if len(rows) == 1 else 's'}"


def _apart(finding: Mapping[str, Any]) -> str:
    """Returns how far apart a finding's photos look from, as words to be added."""
    return f" up to {finding['apart_deg']:.0f} deg apart" if "apart_deg" in finding else ""


def map_rows(findings: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Returns of each contradiction the building, what the photos say, and which do.

    Args:
        findings: ``buildings`` with heights, and ``changes``: buildings gone, and places the map lacks one.
    """
    rows = [
        (
            str(each["id"]),
            f"{abs(each['higher_m']):.1f} m +-{each['sigma_m']:.1f} "
            f"{'higher' if each['higher_m'] > 0 else 'lower'} than in the map",
            count_of(each["photos"], "photos") + _apart(each),
        )
        for each in doubted_buildings(findings.get("buildings", []))
    ]
    for change in findings.get("changes", []):
        listed = ", ".join(change["photos"][:3]) + (", ..." if len(change["photos"]) > 3 else "")
        photos = f"{count_of(len(change['photos']), 'photos')}{_apart(change)} ({listed})"
        if change["kind"] == "gone":
            rows.append((str(change["id"]), f"gone, {100 * change['probability']:.0f} % sure", photos))
        else:
            size = f"{change['area_m2']:.0f} m2 and {change['top_m']:.0f} m high"
            rows.append(("a building that the map lacks", size, photos))
    return rows


def doubted_buildings(buildings: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Returns the buildings in doubt, the surest first."""
    doubted = [each for each in buildings if each["doubt"]]
    return sorted(doubted, key=lambda each: -abs(each["higher_m"]) / max(each["sigma_m"], 1e-9))
