"""``dataset=demo``: built into the cache on first use, then read like any folder."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.query import Dataset
from lodbench.storage.paths import cache_root


@dataclass(frozen=True, slots=True)
class DemoParams:
    """Settings of ``dataset=demo``.

    Attributes:
        name: Name to report.
        num_queries: Queries over both splits.
        town_seed: Seed of the town, its queries, priors and masks.
        lod: Level of detail to localise against: "1" or "2".
    """

    name: str = "demo"
    num_queries: int = 40
    town_seed: int = 0
    lod: str | None = "1"


def open_demo(params: DemoParams) -> Dataset:
    """Returns the demo dataset; builds it first if the cache does not hold it yet.

    Raises:
        DatasetError: Fewer than two queries are asked for, or the cache holds something else.
    """
    from lodbench.datasets.demo.build import CITY_FILE, build_demo
    from lodbench.datasets.demo.town import TOWN_VERSION

    name = f"town-{TOWN_VERSION}-seed-{params.town_seed}-queries-{params.num_queries}"
    root = build_demo(cache_root() / "demo" / name, num_queries=params.num_queries, seed=params.town_seed)
    folder = open_folder(FolderParams(str(root), str(root / CITY_FILE), lod=params.lod, name=params.name))
    return replace(folder, version=f"town {TOWN_VERSION}, seed {params.town_seed}")
