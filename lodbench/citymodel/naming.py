"""Ids of city objects: every one names one object, whatever the file says."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from lodbench.citymodel.codes import DUPLICATE_ID
from lodbench.citymodel.objects import CityObjects
from lodbench.findings import Findings


def unique_ids(ids: Sequence[str], findings: Findings) -> tuple[str, ...]:
    """Returns ids of which no two are equal: what repeats an earlier one gets ``~2``, ``~3`` and so on.

    An export that merged two buildings of one id would lose one of them.

    Args:
        ids: As the file has them.
        findings: Receives ``DUPLICATE_ID``, once per id that repeats.

    Example:
        >>> unique_ids(["a", "b", "a"], Findings())
        ('a', 'b', 'a~2')
    """
    if len(set(ids)) == len(ids):
        return tuple(ids)
    counts = Counter(ids)
    for name, count in counts.items():
        if count > 1:
            findings.add(DUPLICATE_ID, name, f"names {count} objects; the later get ~2 and so on")
    taken, met, unique = set(ids), Counter[str](), []
    for name in ids:
        met[name] += 1
        own = name
        while met[name] > 1 and own in taken:
            own = f"{name}~{met[name]}"
            met[name] += own in taken
        taken.add(own)
        unique.append(own)
    return tuple(unique)


def unique_objects(objects: CityObjects, building_ids: tuple[str, ...], findings: Findings) -> CityObjects:
    """Returns objects of which no two have one id; buildings are called as ``building_ids`` says."""
    ids = list(objects.ids)
    for n, building in enumerate(objects.building.tolist()):
        if objects.parents[n] < 0:
            ids[n] = building_ids[building]
    return replace(objects, ids=unique_ids(ids, findings))
