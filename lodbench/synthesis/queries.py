"""Made-up queries, and the one way they become a folder that ``dataset=folder`` reads, written once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.folder import write_poses
from lodbench.datasets.instance_labels import INSTANCES_FOLDER, encoded_labels
from lodbench.geometry import Camera, Pose
from lodbench.photos.pictures import encoded_mask
from lodbench.storage import make_folder, new_folder, write_bytes

Floats = NDArray[np.float64]
Decimals = tuple[int, int] | None  # of quaternions and of metres


class SyntheticQuery(NamedTuple):
    """What is made up for one view, in the scene's local frame."""

    name: str  # of the view; its random streams follow from it
    truth: Pose  # where the view was drawn from
    prior: Pose  # the rough pose
    mask: NDArray[np.bool_]  # (H, W) query mask, as wrong as a network's
    achieved_iou: float  # its IoU with the silhouette at the truth
    photo: bytes | None = None  # JPEG file of the view, or None
    instances: NDArray[np.uint16] | None = None  # (H, W) labels of buildings that fill the mask, or None

    @property
    def file_name(self) -> str:
        """Returns the name of its image in a folder."""
        return self.name if self.photo is not None else f"{self.name}.png"


def written_once(folder: Path, write: Callable[[Path], None]) -> Path:
    """Returns a folder that is filled first if it is not there; it appears whole or not at all."""
    if not folder.is_dir():
        make_folder(folder.parent)
        # Another process that is as quick leaves a folder of the same bytes.
        with new_folder(folder) as building:
            write(building)
    return folder


def write_queries(
    folder: Path, queries: Sequence[SyntheticQuery], camera: Camera, origin: Floats, decimals: Decimals = None
) -> None:
    """Writes all of one split, taken by one camera, in a folder that becomes one once it is full.

    ``origin``, (3,), is that of the scene's frame in the city's CRS. Without ``decimals`` poses have as many
    as restore them.
    """
    make_folder(folder / "masks")
    truth = {query.file_name: query.truth.shifted(origin) for query in queries}
    priors = {query.file_name: query.prior.shifted(origin) for query in queries}
    cameras = dict.fromkeys(truth, camera)
    write_poses(folder, cameras, truth, priors, decimals=decimals, survives_power_cut=False)
    for query in queries:
        name = f"{Path(query.file_name).stem}.png"
        write_bytes(folder / "masks" / name, encoded_mask(query.mask), False)
        if query.instances is not None:
            file = make_folder(folder / INSTANCES_FOLDER) / name
            write_bytes(file, encoded_labels(query.instances), False)
        if query.photo is not None:
            write_bytes(make_folder(folder / "Query_image") / query.name, query.photo, False)
