"""``dataset=demo`` and ``dataset=demo_train``: built on first use, then read like any folder.

What methods may ask for besides, a textured map and instance labels, is made on demand and kept beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from lodbench.citymodel import open_scene
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Dataset
from lodbench.errors import DatasetError
from lodbench.photos.pictures import read_picture
from lodbench.storage import make_folder, random_stream, write_bytes
from lodbench.storage.paths import cache_root
from lodbench.synthesis.town.build import CITY_FILE, DEMO_CODE, FINE_CITY_FILE, build_demo, code_digest
from lodbench.synthesis.town.town import TOWN_VERSION, grow_town
from lodbench.synthesis.views import written_once

MAP_FILE = "textured_map.glb"
# The code that each follows from; that of the town is in the demo's own name.
MAP_CODE = ("synthesis/demo.py", "synthesis/surveys.py", "kernels/heights.py")
LABEL_CODE = ("synthesis/demo.py", "synthesis/mask_*.py")


@dataclass(frozen=True, slots=True)
class DemoParams:
    """Settings of ``dataset=demo``, the town to test on; described in ``conf/dataset/demo.yaml``."""

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
        DatasetError: Fewer than two queries are requested, the look is unknown, or the cache holds
            something else.
    """
    root = demo_folder(params)
    is_fine = params.lod is not None and params.lod.lower().removeprefix("lod").startswith("3")
    city = root / (FINE_CITY_FILE if is_fine else CITY_FILE)
    folder = open_folder(FolderParams(str(root), str(city), lod=params.lod, name=params.name))
    look = "" if params.look == "test" else f", look {params.look}"
    on_demand: dict[str, Callable[[], Path]] = {
        Input.TEXTURED_MAP: partial(textured_map_of_demo, root, params.town_seed, params.look),
        Input.INSTANCES: partial(instances_of_demo, folder, root / FINE_CITY_FILE, params.town_seed),
    }
    # From pixels: its masks are drawn from the truth, as wrong as a network's, to compare with.
    version = f"town {TOWN_VERSION}{look}, seed {params.town_seed}"
    return replace(folder, version=version, segmenter="compact", on_demand=on_demand)


def open_demo_train(params: DemoTrainParams) -> Dataset:
    """Returns the demo's town to train on; see ``open_demo``."""
    return open_demo(params)


def demo_folder(params: DemoParams) -> Path:
    """Returns the folder of a demo in the cache, built if it is not there yet.

    Its name holds everything it follows from: the version, the parameters, and a digest of the code
    that makes it, so that a changed generator never meets an old folder.
    """
    made_of = f"{params.look}-seed-{params.town_seed}-queries-{params.num_queries}-{code_digest(*DEMO_CODE)}"
    root = cache_root() / "demo" / f"town-{TOWN_VERSION}-{made_of}"
    return build_demo(root, num_queries=params.num_queries, seed=params.town_seed, look=params.look)


def textured_map_of_demo(root: Path, seed: int, look: str) -> Path:
    """Returns the textured map of a demo's town, made first if it is not there: minutes, once."""

    def write(folder: Path) -> None:
        from lodbench.synthesis.surveys import write_textured_map

        scene = open_scene(root / CITY_FILE, lod="1")
        write_textured_map(folder / MAP_FILE, grow_town(seed, look), scene)

    return written_once(_beside(root, "survey", MAP_CODE), write) / MAP_FILE


def instances_of_demo(demo: Dataset, city: Path, seed: int) -> Path:
    """Returns the folder of a demo's labels, ``SPLIT/STEM.png``, made first if it is not there.

    They are the buildings in view at the true pose, as wrong as a network's, and fill the demo's masks.

    Raises:
        DatasetError: A mask of the demo is missing.
    """

    def write(folder: Path) -> None:
        from lodbench.datasets.inputs import encoded_labels
        from lodbench.rendering.raster import RasterRenderer
        from lodbench.synthesis.mask_degradation import degraded_instances

        scene = open_scene(city)
        raster = RasterRenderer(scene)
        for entry in demo.entries:
            mask = None if entry.mask is None else read_picture(entry.mask, as_stored=True)
            if mask is None or entry.camera is None:
                reason = f"{demo.root} is no whole demo: {entry.key} has no mask."
                raise DatasetError(reason, "Delete the folder.")
            truth = demo.truth[entry.key].shifted(-scene.origin)
            (clean,) = raster.buildings(entry.camera, truth.rotation[None], truth.center[None])
            labels = degraded_instances(clean, mask > 0, random_stream(seed, "demo", entry.name, "instances"))
            file = make_folder(folder / entry.split) / f"{Path(entry.name).stem}.png"
            write_bytes(file, encoded_labels(labels), False)

    return written_once(_beside(demo.root, "instances", LABEL_CODE), write)


def _beside(root: Path, kind: str, code: tuple[str, ...]) -> Path:
    """Returns a folder beside a demo's; its name holds a digest of code."""
    return root.with_name(f"{root.name}-{kind}-{code_digest(*code)}")
