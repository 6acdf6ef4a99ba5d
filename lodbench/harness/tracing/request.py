"""What is asked when a map is traced."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from lodbench.datasets.photo_pose import HeightOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class TraceRequest:
    """A reconstruction, and how its frame becomes the map's.

    Attributes:
        model: Folder of a COLMAP model.
        images: Folder that its names are relative to.
        start: Rough poses in the map's coordinates, or a similarity of ``lodbench georeference``; or None.
        crs: The map's reference system; with no ``start``, the photos' own positions place the model in it.
        scale: Metres per unit of the model, or None.
        is_metric: Whether the model is in the map's coordinates already.
        heights: How the drone's heights become the map's.
        queries: Patterns of names of photos that the map must not use, as they are the benchmark's queries;
            empty for every second one that nothing is traced in; None where there is no benchmark.
    """

    model: Path
    images: Path
    start: Path | None = None
    crs: str | None = None
    scale: float | None = None
    is_metric: bool = False
    heights: HeightOptions = field(default_factory=HeightOptions)
    queries: tuple[str, ...] | None = None
