"""``dataset=swiss_epflv2``: the queries of Swiss-EPFL over an LoD1 model, which is not released."""

from __future__ import annotations

from dataclasses import replace

from lodbench.datasets.published.open import PublishedParams, open_published
from lodbench.datasets.published.spec import QUERIES, Host
from lodbench.datasets.published.swiss_epfl import SPEC as SWISS_EPFL
from lodbench.datasets.query import Dataset

NOT_RELEASED = Host(
    "city model",
    "https://github.com/VictorZoo/LoD-Loc-v2/issues/2",
    "not released as of 2025-12-06: ask there",
)

SPEC = replace(
    SWISS_EPFL,
    id="swiss_epflv2",
    title="Swiss-EPFLv2",
    lod="1",
    city_files=("swiss_LoD1_final.obj", "Swiss-EPFL-LoD1.obj", "Swiss-EPFLv2.obj"),
    unreadable_city_files=("swiss_LoD1_final.osgb",),
    hosts=(QUERIES, NOT_RELEASED),
    year="2025",
)


def open_dataset(params: PublishedParams) -> Dataset:
    """Returns the dataset; see ``open_published``."""
    return open_published(SPEC, params)
