"""Basins beside the full grid, pose by pose: does the cheap search of a wide prior end where it does?"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lodbench.bench.accuracy import draw_views, open_scenes, part_of, told_width
from lodbench.bench.accuracy_options import AccuracyOptions
from lodbench.bench.accuracy_report import SPLIT
from lodbench.bench.figures import Figure, Progress, no_progress
from lodbench.evaluation import PoseError, pose_error
from lodbench.evaluation.errors import FAILED
from lodbench.evaluation.predictions import Prediction
from lodbench.evaluation.queries import ERROR
from lodbench.methods.contour_alignment import ContourAlignment
from lodbench.reporting.columns import format_columns

if TYPE_CHECKING:
    import pandas as pd

SEARCHES = ("grid", "basins")
# Ends nearer than this are one optimum: a twentieth of what counts as found.
SAME_M, SAME_DEG = 0.1, 0.1


@dataclass(frozen=True, slots=True)
class SearchPair:
    """What both searches make of one view; an answer that is missing has infinite errors.

    Attributes:
        name: The view.
        hypotheses: Poses rendered, by search.
        errors: Error of each search's pose.
        apart: Distance and angle between the two poses.
    """

    name: str
    hypotheses: dict[str, int]
    errors: dict[str, PoseError]
    apart: PoseError

    @property
    def is_same(self) -> bool:
        """Tells whether both ended in one optimum."""
        return self.apart.translation_m < SAME_M and self.apart.rotation_deg < SAME_DEG

    def ratio(self) -> float:
        """Returns how many times fewer hypotheses the basins took."""
        return self.hypotheses["grid"] / max(1, self.hypotheses["basins"])


@dataclass(frozen=True, slots=True)
class WidePriorReport:
    """Pairs of both searches.

    Attributes:
        title: City and protocol in words.
        pairs: One per view.
    """

    title: str
    pairs: tuple[SearchPair, ...]

    def figures(self) -> list[Figure]:
        """Returns how many views end alike, and the hypotheses of both searches."""
        counts = {s: float(np.mean([p.hypotheses[s] for p in self.pairs])) for s in SEARCHES}
        return [
            Figure("views whose searches end in one optimum", float(sum(p.is_same for p in self.pairs)), ""),
            Figure("views", float(len(self.pairs)), ""),
            Figure(
                "hypotheses of basins",
                counts["basins"],
                "",
                "grid",
                counts["grid"],
                counts["grid"] / counts["basins"] if counts["basins"] else None,
            ),
        ]

    def to_text(self) -> str:
        """Returns a line a view, and one that counts them."""
        rows = [["", "grid", "basins", "ratio", "grid m", "basins m", "apart m", "apart deg", "same"]]
        for p in self.pairs:
            counts = [str(p.hypotheses[search]) for search in SEARCHES]
            errors = [f"{p.errors[search].translation_m:.2f}" for search in SEARCHES]
            apart = [f"{p.apart.translation_m:.3f}", f"{p.apart.rotation_deg:.3f}"]
            rows.append([p.name, *counts, f"{p.ratio():.1f}", *errors, *apart, "yes" if p.is_same else "no"])
        same = sum(p.is_same for p in self.pairs)
        return (
            format_columns(rows) + f"\n{same} of {len(self.pairs)} end within {SAME_M:g} m and {SAME_DEG:g} "
            f"deg of each other. {self.title}"
        )


def measure_wide_priors(
    city: Path, options: AccuracyOptions, progress: Progress = no_progress
) -> WidePriorReport:
    """Returns where the full grid and the basins end, each followed by the same alignment.

    Args:
        city: City model file.
        options: The views, as for accuracy; the sensor's tilt is in their priors.
        progress: Called after each search.

    Raises:
        LodbenchError: The city cannot be read, or no views can be drawn over it.
    """
    scorer, seen = open_scenes(city, options)
    drawn = [draw_views(scorer, seen, options, seed) for seed in options.seeds]
    methods = [
        told_width(ContourAlignment(replace(ContourAlignment().params, search=s)), options.prior())
        for s in SEARCHES
    ]
    pairs: list[SearchPair] = []
    for number, views in enumerate(drawn):
        found = [
            views.find(method, "prior", scorer, part_of(progress, 2 * number + k, 2 * len(drawn)))
            for k, method in enumerate(methods)
        ]
        pairs += [_pair(key, found) for key in found[0][1]]
    title = f"{Path(city).name}, {len(pairs)} views with tilt=prior, {options.protocol()}."
    return WidePriorReport(title, tuple(pairs))


def _pair(key: str, found: list[tuple[pd.DataFrame, dict[str, Prediction]]]) -> SearchPair:
    errors = {s: queries.loc[key, list(ERROR)] for s, (queries, _) in zip(SEARCHES, found, strict=True)}
    answers = {s: predictions[key] for s, (_, predictions) in zip(SEARCHES, found, strict=True)}
    first, second = (answer.pose for answer in answers.values())
    return SearchPair(
        name=key.removeprefix(f"{SPLIT}/"),
        hypotheses={search: answer.hypotheses or 0 for search, answer in answers.items()},
        errors={search: PoseError(*error.astype(float)) for search, error in errors.items()},
        apart=FAILED if first is None or second is None else pose_error(first, second),
    )
