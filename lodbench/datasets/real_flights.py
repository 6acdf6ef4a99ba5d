"""``dataset=real_flights``: one real flight beside its traced map, each a folder in the text layout.

Every flight has a map and a frame of its own, so a dataset is one of them: its split has the folder's name,
its photos are one flight, and its map is ``city.obj`` beside the poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from lodbench.datasets.folder import TRUTH_FILE, FolderParams, open_folder
from lodbench.datasets.query import Dataset
from lodbench.errors import DatasetError

NAME, CITY_FILE = "real_flights", "city.obj"
# What the head of a board of such flights says.
BOARD_HEAD = (
    "Real photos, a block for each flight. True poses are by structure from motion that knows nothing of the "
    "map; maps are traced in photos and share its scale. How good both are: `lodbench dataset card "
    "real_flights`. Figures do not compare with those of drawn photos."
)


@dataclass(frozen=True, slots=True)
class RealFlightParams:
    """Settings of ``dataset=real_flights``, described in ``conf/dataset/real_flights.yaml``."""

    root: str
    city_model: str | None = None
    name: str = NAME


def open_real_flight(params: RealFlightParams) -> Dataset:
    """Returns the dataset of one flight: photos that no ``sequences.txt`` names otherwise are one sequence.

    Raises:
        DatasetError: The folder holds several flights, or as ``open_folder``.
    """
    root = Path(params.root).expanduser()
    city = params.city_model or city_beside(root)
    if not (root / TRUTH_FILE).is_file() and (flights := sorted(root.glob(f"*/{TRUTH_FILE}"))):
        names = ", ".join(flight.parent.name for flight in flights)
        raise DatasetError(
            f"{root} holds several flights, each over a map of its own: {names}.",
            f"Name one: dataset.root={flights[0].parent}",
        )
    dataset = open_folder(FolderParams(str(root), city, name=params.name))
    entries = tuple(replace(entry, sequence=entry.sequence or entry.split) for entry in dataset.entries)
    return replace(dataset, entries=entries)


def city_beside(root: Path) -> str | None:
    """Returns the ``city.obj`` of a flight's folder, or None if there is none."""
    return str(root / CITY_FILE) if (root / CITY_FILE).is_file() else None
