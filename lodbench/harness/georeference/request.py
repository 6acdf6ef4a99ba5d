"""What is asked when a reconstruction is to be placed in a city, and what is answered."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lodbench.datasets.exchange.posed import FoundPose
from lodbench.geometry.similarity import FittedSimilarity
from lodbench.harness.requests import CityRequest
from lodbench.methods import Method


@dataclass(frozen=True, slots=True, kw_only=True)
class GeoreferenceRequest(CityRequest):
    """A reconstruction, and what is known of where it is.

    Attributes:
        model: Folder of a COLMAP model.
        method: Solves flights.
        images: Folder that the model's names are relative to; None where nothing is read from photos.
        masks: Folder of masks of the photos as stored, or None for the segmenter.
        start: Rough poses in the city's coordinates, in any known format, or a similarity that this command
            wrote; None for what the photos state.
        seed: Of the search.
    """

    model: Path
    method: Method
    images: Path | None = None
    masks: Path | None = None
    start: Path | None = None
    seed: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Georeferenced:
    """A reconstruction, placed.

    Attributes:
        fitted: From the model to the city's coordinates.
        cameras: All of the model's, in the city's coordinates.
        used: Images by whose masks it was placed, and how far, in metres, each was found from where the
            similarity puts it.
        untrusted: Those among ``used`` whose poses are more likely wrong than right, as far as can be told.
        left_out: Name and reason of each image that had no part in it.
        findings: What its photos say besides; see the method.
        start: Where the rough places came from, in words.
        crs: Reference system, or None.
        files: Written, by what they are.
        notes: What the reader should know.
    """

    fitted: FittedSimilarity
    cameras: tuple[FoundPose, ...]
    used: Mapping[str, float]
    untrusted: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...]
    findings: dict[str, Any]
    start: str
    crs: str | None
    files: Mapping[str, Path]
    notes: tuple[str, ...]

    @property
    def is_trusted(self) -> bool:
        """Returns whether most of the images it was placed by are more likely right than wrong."""
        return 2 * len(self.untrusted) < len(self.used)

    def to_json(self) -> dict[str, Any]:
        """Returns plain values for JSON."""
        similarity = self.fitted.similarity
        names = ("east_m", "north_m", "up_m", "about_east_deg", "about_north_deg", "about_up_deg", "scale")
        return {
            "similarity": {
                "scale": similarity.scale,
                "rotation": similarity.rotation.tolist(),
                "translation": similarity.translation.tolist(),
            },
            "sigmas": dict(zip(names, map(float, self.fitted.sigmas), strict=True)),
            "middle": self.fitted.middle.tolist(),
            "crs": self.crs,
            "start": self.start,
            "used": dict(self.used),
            "trusted": self.is_trusted,
            "untrusted": list(self.untrusted),
            "left_out": [list(pair) for pair in self.left_out],
            "files": {name: str(path) for name, path in self.files.items()},
            "notes": list(self.notes),
            "findings": self.findings,
        }
