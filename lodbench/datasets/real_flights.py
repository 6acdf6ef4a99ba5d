"""``dataset=real_flights``: one real flight beside its traced map, each a folder in the text layout.

Every flight has a map and a frame of its own, so a dataset is one of them: its split has the folder's name,
its photos are one flight, and its map is ``city.obj`` beside the poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lodbench.datasets.exchange.colmap import is_colmap, read_colmap
from lodbench.datasets.faults import UNLIKE_RECONSTRUCTION
from lodbench.datasets.folder import TRUTH_FILE, FolderParams, open_folder, with_reconstructions
from lodbench.datasets.query import Dataset, notes_of
from lodbench.errors import DatasetError, LodbenchError
from lodbench.findings import Findings
from lodbench.geometry.similarity import fit_similarity

NAME, CITY_FILE, RECONSTRUCTION = "real_flights", "city.obj", "sparse"
# How far rounding moves poses, metres or degrees, and from where on one is another.
_SAME_M, _FAR_M = 0.1, 0.5
# What the head of a board of such flights says.
BOARD_HEAD = (
    "Real photos, a block for each flight. True poses are by structure from motion that knows nothing of the "
    "map; maps are traced in photos and share its scale. How good both are is said by the dataset's card "
    "(lodbench dataset card real_flights). Figures do not compare with those of drawn photos."
)


@dataclass(frozen=True, slots=True)
class RealFlightParams:
    """Settings of ``dataset=real_flights``, described in ``conf/dataset/real_flights.yaml``."""

    root: str
    city_model: str | None = None
    name: str = NAME
    reconstruction: bool = False


def open_real_flight(params: RealFlightParams) -> Dataset:
    """Returns the dataset of one flight: photos that no ``sequences.txt`` names otherwise are one sequence.

    Raises:
        DatasetError: The folder holds several flights, or no reconstruction where methods shall have one,
            or as ``open_folder``.
    """
    root = Path(params.root).expanduser()
    require_one_flight(root)
    city = params.city_model or city_beside(root)
    dataset = open_folder(FolderParams(str(root), city, name=params.name))
    findings = (*dataset.findings, *_beside_reconstruction(root, dataset).items)
    entries = [replace(entry, sequence=entry.sequence or entry.split) for entry in dataset.entries]
    if params.reconstruction:
        if not is_colmap(root / RECONSTRUCTION):
            raise DatasetError(
                f"{root} has no COLMAP model {RECONSTRUCTION}.", "Leave `dataset.reconstruction` out."
            )
        entries = with_reconstructions(entries, root / RECONSTRUCTION)
    return replace(
        dataset,
        entries=tuple(entries),
        findings=findings,
        notes=(*dataset.notes, *notes_of(Findings([*findings]))),
    )


def _beside_reconstruction(root: Path, dataset: Dataset) -> Findings:
    """Returns which true poses are not those of the reconstruction, laid on all of them by a similarity."""
    findings, folder = Findings(), root / RECONSTRUCTION
    if not is_colmap(folder):
        return findings
    try:
        there = {found.name: found.pose for found in read_colmap(folder)}
        known = [(e.key, there[e.name], dataset.truth[e.key]) for e in dataset.entries if e.name in there]
        keys, poses, truth = zip(*known, strict=True) if known else ((), (), ())
        fitted = fit_similarity(poses, truth, np.full((len(keys), 3), _SAME_M), np.full(len(keys), _SAME_M))
    except LodbenchError as error:
        findings.add(UNLIKE_RECONSTRUCTION, RECONSTRUCTION, error.message)
        return findings
    for key, distance_m in zip(keys, fitted.distances_m, strict=True):
        if distance_m > _FAR_M:
            findings.add(UNLIKE_RECONSTRUCTION, key, f"{distance_m:.1f} m")
    return findings


def require_one_flight(root: Path) -> None:
    """Refuses a folder of several flights, each over a map of its own.

    Raises:
        DatasetError: It is one.
    """
    if not (root / TRUTH_FILE).is_file() and (flights := sorted(root.glob(f"*/{TRUTH_FILE}"))):
        names = ", ".join(flight.parent.name for flight in flights)
        raise DatasetError(
            f"{root} holds several flights, each over a map of its own: {names}.",
            f"Name one: `dataset.root={flights[0].parent}`",
        )


def city_beside(root: Path) -> str | None:
    """Returns the ``city.obj`` of a flight's folder, or None if there is none."""
    return str(root / CITY_FILE) if (root / CITY_FILE).is_file() else None
