"""What the demo has on demand: its textured map and its instance labels, kept in the cache beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType

from lodbench.citymodel import open_scene
from lodbench.citymodel.scene import Scene
from lodbench.datasets.instance_labels import encoded_labels
from lodbench.datasets.pictures import read_picture
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError
from lodbench.rendering.raster import RasterRenderer
from lodbench.storage import digest_of, file_digest, make_folder, new_folder, random_stream, write_bytes
from lodbench.synthesis import instance_degradation, mask_degradation, mask_error_fields
from lodbench.synthesis.instance_degradation import degraded_instances
from lodbench.synthesis.survey import baking, charts, textured_map, town_then
from lodbench.synthesis.survey.textured_map import write_textured_map
from lodbench.synthesis.town.build import CITY_FILE
from lodbench.synthesis.town.looks import look_named
from lodbench.synthesis.town.town import grow_town

MAP_FILE = "textured_map.glb"
# The code that each follows from; that of the town is in the demo's own name.
MAP_CODE = (baking, charts, textured_map, town_then)
LABEL_CODE = (instance_degradation, mask_degradation, mask_error_fields)


def textured_map_of_demo(root: Path, seed: int, look: str) -> Path:
    """Returns the textured map of a demo's town, made first if it is not there: minutes, once.

    Args:
        root: The demo's folder.
        seed: Of its town.
        look: Of its town.
    """

    def write(folder: Path) -> None:
        scene = open_scene(root / CITY_FILE, lod="1")
        write_textured_map(folder / MAP_FILE, grow_town(seed, look_named(look)), scene)

    return _kept_beside(root, "survey", MAP_CODE, write) / MAP_FILE


def instances_of_demo(demo: Dataset, city: Path, seed: int) -> Path:
    """Returns the folder of a demo's labels, ``SPLIT/STEM.png``, made first if it is not there.

    They are the buildings seen at the truth, as wrong as a network's, and fill the demo's masks.
    """

    def write(folder: Path) -> None:
        scene = open_scene(city)
        raster = RasterRenderer(scene)
        for entry in demo.entries:
            file = folder / entry.split / f"{Path(entry.name).stem}.png"
            make_folder(file.parent)
            write_bytes(file, _labels(demo, entry, scene, raster, seed), False)

    return _kept_beside(demo.root, "instances", LABEL_CODE, write)


def _labels(demo: Dataset, entry: Entry, scene: Scene, raster: RasterRenderer, seed: int) -> bytes:
    mask = None if entry.mask is None else read_picture(entry.mask, as_stored=True)
    if mask is None or entry.camera is None:
        raise DatasetError(f"{demo.root} is no whole demo: {entry.key} has no mask.", "Delete the folder.")
    truth = demo.truth[entry.key].shifted(-scene.origin)
    (seen,) = raster.buildings(entry.camera, truth.rotation[None], truth.center[None])
    stream = random_stream(seed, "demo", entry.name, "instances")
    return encoded_labels(degraded_instances(seen, mask > 0, stream))


def _kept_beside(root: Path, kind: str, code: Sequence[ModuleType], write: Callable[[Path], None]) -> Path:
    """Returns a folder beside a demo's, written first if it is not there; its name holds a digest of code."""
    folder = root.with_name(f"{root.name}-{kind}-{code_digest(code)}")
    if not folder.is_dir():
        make_folder(folder.parent)
        # Another process that is as quick leaves a folder of the same bytes.
        with new_folder(folder) as building:
            write(building)
    return folder


def code_digest(code: Sequence[ModuleType]) -> str:
    """Returns a digest of modules and of this one, which calls them."""
    files = [Path(__file__), *(Path(str(module.__file__)) for module in code)]
    return digest_of([file_digest(file) for file in files], length=8)
