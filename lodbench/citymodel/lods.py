"""Levels of detail: which one is meant, and which polygons it takes."""

from __future__ import annotations

from collections.abc import Sequence

from lodbench.citymodel.codes import LOD_SUBSTITUTED
from lodbench.errors import CityModelError
from lodbench.findings import Findings


def choose_lod(present: Sequence[str], wanted: str | None, findings: Findings) -> str:
    """Returns the name of the level to mesh, one for the whole file.

    Without a wish it is the lowest level that has walls: 1 if present, else 2, else 3; footprints
    (LoD0) only where there is nothing else. A whole number stands for its refinements: "1" takes
    "1.2" before "1.3", because the coarser of two is the closer to a plain LoD1. "3" also takes
    the outer shell of a LoD4. A source without levels ("") serves every wish.

    Args:
        present: Level names of the file.
        wanted: The level asked for, or None.
        findings: Receives ``LOD_SUBSTITUTED`` where the name taken is not the name asked for.

    Raises:
        CityModelError: The level is absent; the message names those that are there.

    Example:
        >>> choose_lod(["0", "1.2", "1.3", "2.2"], "1", Findings())
        '1.2'
    """
    names = sorted(present)
    if not names:
        raise CityModelError(
            "The city model has no geometry at any level of detail.", "Is it the building tile of the city?"
        )
    if wanted is None:
        return next((name for name in names if not name.startswith("0")), names[0])
    wanted = _plain(wanted)
    if wanted in names:
        return wanted
    candidates = _candidates(names, wanted)
    if not candidates:
        hint = f"Ask for lod={names[-1]}."
        if wanted == "1" and names[-1] >= "2":
            hint = f"Ask for lod={names[-1]}, or derive it: roof_height=median (or max, p70, eave)."
        raise CityModelError(
            f"No building has a level of detail {wanted}; the file has: {', '.join(names)}.", hint
        )
    findings.add(LOD_SUBSTITUTED, "", f"{wanted} asked for, {candidates[0] or 'unnamed level'} taken")
    return candidates[0]


def has_lod(present: Sequence[str], wanted: str) -> bool:
    """Tells whether ``choose_lod`` would find a level.

    Example:
        >>> has_lod(["0", "2.2"], "2"), has_lod(["0", "2.2"], "1")
        (True, False)
    """
    return bool(_candidates(sorted(present), _plain(wanted)))


def _plain(wanted: str) -> str:
    return wanted.strip().lower().removeprefix("lod")


def _candidates(names: list[str], wanted: str) -> list[str]:
    found = [name for name in names if name.partition(".")[0] == wanted or name in (wanted, "")]
    if wanted == "3" and "4" in names:
        found.append("4")
    return found
