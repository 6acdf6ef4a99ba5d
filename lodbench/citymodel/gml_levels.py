"""Levels of detail as CityGML has them: whole ones, of which an object has each once."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.gml_dialect import Dialect
from lodbench.citymodel.model import CityModel

Face = tuple[int, bool]  # a polygon, and whether it is seen from behind


@dataclass(frozen=True, slots=True)
class LevelShapes:
    """What an object has at one whole level: solids, and polygons that are in none of them."""

    level: int
    solids: list[list[list[Face]]]
    loose: list[int]

    @property
    def enclosed(self) -> list[int]:
        """The polygons of the solids, each once."""
        return sorted({face for shells in self.solids for shell in shells for face, _ in shell})


def level_of(name: str, dialect: Dialect) -> int:
    """Returns the whole level that a level of detail is written as."""
    whole = int(name[:1]) if name[:1].isdigit() else 2
    return min(whole, dialect.levels[-1])


def left_out(model: CityModel, levels: list[int], notes: Counter[str]) -> NDArray[np.bool_]:
    """Tells which polygons are left out as their object has finer ones: CityGML has whole levels only."""
    polygons = model.polygons
    own = (polygons.building if polygons.part is None else polygons.part).astype(np.int64)
    # The names of levels ascend, so the finest of a whole level has the largest number.
    slot = own * (max(levels, default=0) + 1) + np.asarray(levels, np.int64)[polygons.lod]
    finest = np.full(int(slot.max(initial=-1)) + 1, -1, np.int64)
    np.maximum.at(finest, slot, polygons.lod)
    is_left_out: NDArray[np.bool_] = polygons.lod != finest[slot]
    for n, (name, level) in enumerate(zip(model.lods, levels, strict=True)):
        count = int((is_left_out & (polygons.lod == n)).sum())
        if count:
            notes[f"LoD{name}, {count} polygons: their objects have a finer LoD at level {level}"] += 1
        if name != str(level) and bool(((polygons.lod == n) & ~is_left_out).any()):
            notes[f"LoD{name or ' unnamed'} written as LoD{level}"] += 1
    return is_left_out
