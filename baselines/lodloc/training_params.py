"""Settings of ``lodbench train method=lodloc``."""

from __future__ import annotations

from dataclasses import dataclass

from lodbench.errors import require_within

_BOUNDS = {
    "epochs": (1, 100_000),
    "batch": (1, 4096),
    "lr": (1e-12, 10.0),
    "size": (64, 4096),
    "priors": (1, 1000),
    "points": (16, 100_000),
    "poses": (4, 100_000),
    "keep": (0, 10_000_000),
    "threads": (1, 1024),
}


@dataclass(frozen=True, slots=True)
class LodLocTraining:
    """How the heads of the network are trained.

    Attributes:
        data: Set of ``generate-training-data``, or a folder of such sets.
        val_data: Set whose views validate; None for the ``val`` views of ``data``, and where it has none,
            every twentieth of its training views, held out.
        out: Folder of the checkpoint, ``training.json`` and the weights.
        epochs: Passes over the views.
        batch: Views per step.
        lr: Highest learning rate; it falls along half a cosine.
        size: Long side of photos, pixels.
        lod: Level of detail of the map, derived by the median of roofs where a city has finer ones only.
        priors: Rough poses per view, whose wireframes are made once.
        points: Points of a wireframe that a step looks at.
        poses: Poses that the truth is told from, per stage and step.
        keep: At most so many photos' features are kept in memory, 4 MB each at 416 pixels.
        init: ``checkpoint.pt`` of a former training to start from; None for new heads on the trunk of
            segmenter compact.
        threads: Of torch; the last digits depend on it.
        resume: Whether to go on from the checkpoint in ``out``.
        seed: Of all that is drawn by chance.

    Raises:
        ConfigError: A value is out of range; the message names it.
    """

    data: str
    val_data: str | None = None
    out: str = "training"
    epochs: int = 14
    batch: int = 4
    lr: float = 3e-3
    size: int = 416
    lod: str = "1"
    priors: int = 3
    points: int = 400
    poses: int = 256
    keep: int = 1000
    init: str | None = None
    threads: int = 1
    resume: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        for name, (low, high) in _BOUNDS.items():
            require_within(name, getattr(self, name), low, high)
