"""``dataset=demo`` and ``dataset=demo_train``: built on first use, then read like any folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Dataset
from lodbench.storage.paths import cache_root


@dataclass(frozen=True, slots=True)
class DemoParams:
    """Settings of ``dataset=demo``, the town to test on; told in ``conf/dataset/demo.yaml``."""

    name: str = "demo"
    num_queries: int = 40
    town_seed: int = 0
    look: str = "test"
    lod: str | None = "1"


@dataclass(frozen=True, slots=True)
class DemoTrainParams(DemoParams):
    """Settings of ``dataset=demo_train``, another town with other streets, roofs and colours to train on."""

    name: str = "demo_train"
    town_seed: int = 1
    look: str = "train"


def open_demo(params: DemoParams) -> Dataset:
    """Returns the demo dataset; builds it first if the cache does not hold it yet.

    Raises:
        DatasetError: Fewer than two queries are asked for, the look is unknown, or the cache holds
            something else.
    """
    from lodbench.synthesis.town.build import CITY_FILE, FINE_CITY_FILE
    from lodbench.synthesis.town.town import TOWN_VERSION

    root = demo_folder(params)
    is_fine = params.lod is not None and params.lod.lower().removeprefix("lod").startswith("3")
    city = root / (FINE_CITY_FILE if is_fine else CITY_FILE)
    folder = open_folder(FolderParams(str(root), str(city), lod=params.lod, name=params.name))
    look = "" if params.look == "test" else f", look {params.look}"
    on_demand: dict[str, Callable[[], Path]] = {
        Input.TEXTURED_MAP: partial(_textured_map, root, params),
        Input.INSTANCES: partial(_instances, folder, root / FINE_CITY_FILE, params),
    }
    # From pixels: its masks are drawn from the truth, as wrong as a network's, to compare with.
    version = f"town {TOWN_VERSION}{look}, seed {params.town_seed}"
    return replace(folder, version=version, segmenter="compact", on_demand=on_demand)


def open_demo_train(params: DemoTrainParams) -> Dataset:
    """Returns the demo's town to train on; see ``open_demo``."""
    return open_demo(params)


def _textured_map(root: Path, params: DemoParams) -> Path:
    from lodbench.synthesis.demo_assets import textured_map_of_demo

    return textured_map_of_demo(root, params.town_seed, params.look)


def _instances(demo: Dataset, city: Path, params: DemoParams) -> Path:
    from lodbench.synthesis.demo_assets import instances_of_demo

    return instances_of_demo(demo, city, params.town_seed)


def demo_folder(params: DemoParams) -> Path:
    """Returns the folder of a demo in the cache, built if it is not there yet.

    Its name holds everything it follows from: the version, the parameters, and a digest of the code
    that makes it, so that a changed generator never meets an old folder.
    """
    from lodbench.synthesis.town.build import build_demo, generator_digest
    from lodbench.synthesis.town.town import TOWN_VERSION

    name = (
        f"town-{TOWN_VERSION}-{params.look}-seed-{params.town_seed}-queries-{params.num_queries}"
        f"-{generator_digest()}"
    )
    return build_demo(
        cache_root() / "demo" / name,
        num_queries=params.num_queries,
        seed=params.town_seed,
        look=params.look,
    )
