"""Basins beside the full grid, pose by pose: does the cheap search of a wide prior end where it does?"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lodbench.bench.accuracy import Case, open_scenes, reaching, seeded_cases, streams_of
from lodbench.bench.accuracy_options import AccuracyOptions
from lodbench.bench.figures import Figure, Progress, no_progress
from lodbench.citymap import CityMap
from lodbench.errors import QueryFault
from lodbench.evaluation import PoseError, pose_error
from lodbench.evaluation.errors import FAILED
from lodbench.geometry import Pose
from lodbench.methods.asking import localize_query
from lodbench.methods.contour_alignment import ContourAlignment
from lodbench.methods.protocol import Method
from lodbench.reporting.columns import format_columns

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
    cases = seeded_cases(scorer, seen, options)
    methods = {
        s: reaching(ContourAlignment(replace(ContourAlignment().params, search=s)), options.prior())
        for s in SEARCHES
    }
    pairs: list[SearchPair] = []
    for seed, case in cases:
        found = {}
        for search, method in methods.items():
            found[search] = _search(case, method, scorer, seed)
            progress(2 * len(pairs) + len(found), 2 * len(cases))
        pairs.append(_pair(case, found))
    title = f"{Path(city).name}, {len(cases)} views with tilt=prior, {options.protocol()}."
    return WidePriorReport(title, tuple(pairs))


def _search(case: Case, method: Method, city_map: CityMap, seed: int) -> tuple[Pose | None, int]:
    try:
        estimate = localize_query(method, case.query, city_map, streams_of(seed, case.query.name))
    except QueryFault:
        return None, 0
    return estimate.pose, estimate.hypotheses


def _pair(case: Case, found: dict[str, tuple[Pose | None, int]]) -> SearchPair:
    poses = [pose for pose, _ in found.values()]
    first, second = poses
    return SearchPair(
        name=case.query.name,
        hypotheses={search: count for search, (_, count) in found.items()},
        errors={
            s: FAILED if pose is None else pose_error(pose, case.truth) for s, (pose, _) in found.items()
        },
        apart=FAILED if first is None or second is None else pose_error(first, second),
    )
