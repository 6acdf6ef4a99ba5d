"""The demo's instance labels, made in the cache when first asked for."""

from __future__ import annotations

from functools import cache
from pathlib import Path

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


def instances_of_demo(demo: Dataset, city: Path, seed: int) -> Path:
    """Returns the folder of a demo's labels, ``SPLIT/STEM.png``, made first if it is not there.

    They are the buildings seen at the truth, as wrong as a network's, and fill the demo's masks.

    Args:
        demo: The demo, as opened.
        city: The town as it is, in full detail.
        seed: Of the town.
    """
    folder = demo.root.with_name(f"{demo.root.name}-instances-{_digest()}")
    if not folder.is_dir():
        scene = open_scene(city)
        raster = RasterRenderer(scene)
        # Another process that is as quick leaves a folder of the same bytes.
        with new_folder(folder) as building:
            for entry in demo.entries:
                file = building / entry.split / f"{Path(entry.name).stem}.png"
                make_folder(file.parent)
                write_bytes(file, _labels(demo, entry, scene, raster, seed), False)
    return folder


def _labels(demo: Dataset, entry: Entry, scene: Scene, raster: RasterRenderer, seed: int) -> bytes:
    mask = None if entry.mask is None else read_picture(entry.mask, as_stored=True)
    if mask is None or entry.camera is None:
        raise DatasetError(f"{demo.root} is no whole demo: {entry.key} has no mask.", "Delete the folder.")
    truth = demo.truth[entry.key].shifted(-scene.origin)
    (seen,) = raster.buildings(entry.camera, truth.rotation[None], truth.center[None])
    stream = random_stream(seed, "demo", entry.name, "instances")
    return encoded_labels(degraded_instances(seen, mask > 0, stream))


@cache
def _digest() -> str:
    """Returns a digest of the code that makes them; that of the town is in the demo's own name."""
    sources = [
        Path(__file__),
        *(Path(str(each.__file__)) for each in (instance_degradation, mask_degradation, mask_error_fields)),
    ]
    return digest_of([file_digest(file) for file in sources], length=8)
