"""One HTML page of a flight: map with its way before and after, its photos, constants, buildings in doubt."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.evaluation.errors import pose_error
from lodbench.geometry import Pose
from lodbench.reporting.answers import UNTRUSTED, rounded_down, trust_counts
from lodbench.reporting.flight_words import PriorSource, constant_rows, heights_in_words, map_rows
from lodbench.reporting.map_figure import Marked, Spot, Underlay, draw_map
from lodbench.reporting.page import Picture, markup, rendered

Floats = NDArray[np.float64]
# Of more photos the page shows so many, spread evenly: a picture has 60 kB.
MAX_PICTURES = 240


class PhotoOnPage(NamedTuple):
    """A photo of a flight that was placed.

    Attributes:
        spot: On the map.
        moved_m: How far from where the drone said it was.
        turned_deg: Likewise.
        sigma_m: Standard deviation of its place, in space, where the method knows it.
        probability: That it is within 2 m and 2 degrees, where the method knows it.
        score: Of the method.
        why: Why it is not to be trusted fully, and notes; "" for neither.
    """

    spot: Spot
    moved_m: float | None
    turned_deg: float | None
    sigma_m: float | None
    probability: float | None
    score: float | None
    why: str = ""

    @property
    def numbers(self) -> list[tuple[float | None, str]]:
        """Returns the numbers of its row, and their texts."""
        sure = None if self.probability is None else rounded_down(self.probability, 2)
        named = (
            (self.moved_m, ".2f"), (self.turned_deg, ".2f"), (self.sigma_m, ".2f"), (sure, ".2f"),
            (self.score, ".3f"),
        )  # fmt: skip
        return [(value, "-" if value is None else format(value, spec)) for value, spec in named]


def photo_on_page(
    key: str,
    poses: tuple[Pose | None, Pose, Pose | None],
    covariance: Floats | None,
    probability: float | None,
    score: float | None,
    trust: str,
    why: Sequence[str] = (),
) -> PhotoOnPage:
    """Returns a photo for the page.

    Args:
        key: Its name, unique in the flight.
        poses: Prior, estimate and truth, in the city's coordinates; None where there is none.
        covariance: (6, 6) of the estimate's error, where it is known.
        probability: That it is within 2 m and 2 degrees.
        score: Of the method.
        trust: In a word.
        why: It is not to be trusted fully, and notes.
    """
    prior, estimate, _ = poses
    places = [None if pose is None else pose.center[:2] for pose in poses]
    moved = None if prior is None else pose_error(estimate, prior)
    return PhotoOnPage(
        Spot(key, places[0], places[1], places[2], trust, None if covariance is None else covariance[:2, :2]),
        None if moved is None else moved.translation_m,
        None if moved is None else moved.rotation_deg,
        None if covariance is None else float(np.sqrt(np.trace(covariance[:3, :3]))),
        probability,
        score,
        "; ".join(why),
    )


def chosen_for_pictures(keys: Sequence[str]) -> list[str]:
    """Returns the photos whose pictures the page shows: all, or some spread evenly."""
    rows = np.unique(np.linspace(0, len(keys) - 1, min(len(keys), MAX_PICTURES)).round().astype(int))
    return [keys[row] for row in rows]


def flight_page(
    title: str,
    lines: Sequence[str],
    findings: Mapping[str, Any],
    photos: Sequence[PhotoOnPage],
    pictures: Sequence[Picture],
    left_out: Sequence[tuple[str, str]],
    city: tuple[Floats, NDArray[np.int32]] | None,
    marked: Sequence[Marked],
    view: str = "",
    imagery: Underlay | None = None,
    source: PriorSource = "metadata",
) -> str:
    """Returns the page.

    Args:
        title: Of the page.
        lines: Where the photos are from.
        findings: What the flight says besides poses.
        photos: In the order they were taken.
        pictures: Of them, with their keys.
        left_out: Name and reason of photos that have no pose.
        city: (V, 3) vertices and (T, 3) triangles in the city's coordinates, or None.
        marked: What the flight contradicts in the map.
        view: Address of the page in three dimensions from this one; "" for none.
        imagery: What lies under the map.
        source: What the rough poses are from.
    """
    constants = findings.get("constants", {})
    spots = [photo.spot for photo in photos]
    vertices, triangles = (None, None) if city is None else city
    return rendered(
        "flight.html.jinja",
        title=title,
        lines=lines,
        photos=photos,
        pictures=pictures,
        counts=trust_counts(spot.trust for spot in spots),
        doubted=any(spot.trust == UNTRUSTED for spot in spots),
        has_why=any(photo.why for photo in photos),
        lost=findings.get("lost", []),
        reasons=findings.get("reasons", {}),
        left_out=left_out,
        map=markup(
            draw_map(spots, vertices, triangles, marked=marked, is_flight=True, view=view, imagery=imagery)
        ),
        constants=constant_rows(constants),
        heights=heights_in_words(constants["height"], source) if "height" in constants else "",
        notes=findings.get("notes", ()),
        map_rows=map_rows(findings),
    )
