"""Basins beside the full grid, pose by pose: does the cheap search of a wide prior end where it does?"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.command import run
from lodbench.bench import Figure, Progress, Report, no_progress
from lodbench.bench.accuracy import Job, of_seeds, protocol_of, sweep
from lodbench.cli.bench_views import DrawnOptions
from lodbench.evaluation import pose_error
from lodbench.evaluation.pose_errors import FAILED
from lodbench.methods.contour_alignment import ContourAlignment
from lodbench.params import flag, part
from lodbench.reporting.aligned_text import count_of, format_columns
from lodbench.synthesis.views_dataset import ViewsParams

if TYPE_CHECKING:
    import pandas as pd

SEARCHES = ("grid", "basins")
# Ends nearer than this are one optimum: a twentieth of what counts as found.
SAME_M, SAME_DEG = 0.1, 0.1


def measure_wide_priors(
    views: ViewsParams, seeds: Sequence[int], progress: Progress = no_progress, threads: int | None = None
) -> Report:
    """Returns where the full grid and the basins end, each followed by the same alignment.

    ``data`` is what ``pairs_of`` returns.

    Raises:
        LodbenchError: The city cannot be read, or no views can be drawn over it.
    """
    methods = {s: ContourAlignment(replace(ContourAlignment().params, search=s)) for s in SEARCHES}
    jobs = [
        Job(method, v, labels={"search": search})
        for v in of_seeds(views, seeds)
        for search, method in methods.items()
    ]
    pairs = pairs_of(sweep(jobs, progress, threads))
    city = f"{Path(views.city_model).name}, {count_of(len(pairs), 'views')}"
    return report_pairs(pairs, f"{city}, {protocol_of(views, seeds)}.")


def pairs_of(queries: pd.DataFrame) -> pd.DataFrame:
    """Returns a row per seed and view of a sweep over both searches.

    Columns are ``seed``, ``view``, ``hypotheses`` and ``error_m`` of each search, the distance between their
    ends (``apart_m``, ``apart_deg``; infinite where one is missing), and ``is_same``: whether they are one
    optimum.
    """
    import pandas as pd

    pairs = []
    for (seed, view), ends in queries.fillna({"hypotheses": 0}).groupby(["seed", "query"]):
        grid, basins = (ends[ends["search"] == search].iloc[0] for search in SEARCHES)
        is_whole = grid["pose"] is not None and basins["pose"] is not None
        apart = pose_error(grid["pose"], basins["pose"]) if is_whole else FAILED
        pairs.append(
            {
                "seed": seed,
                "view": Path(str(view)).stem,
                "hypotheses grid": grid["hypotheses"],
                "hypotheses basins": basins["hypotheses"],
                "error_m grid": grid["translation_error_m"],
                "error_m basins": basins["translation_error_m"],
                "apart_m": apart.translation_m,
                "apart_deg": apart.rotation_deg,
                "is_same": apart.translation_m < SAME_M and apart.rotation_deg < SAME_DEG,
            }
        )
    return pd.DataFrame(pairs)


def report_pairs(pairs: pd.DataFrame, title: str) -> Report:
    """Returns the report of pairs: a line a view, and one that counts them."""
    grid, basins = (float(pairs[f"hypotheses {search}"].mean()) for search in SEARCHES)
    same = int(pairs["is_same"].sum())
    # Views of several seeds have the same names.
    is_seeded = pairs["seed"].nunique() > 1
    rows = [["", "grid", "basins", "ratio", "grid m", "basins m", "apart m", "apart deg", "same"]]
    for _, p in pairs.iterrows():
        counts = [int(p[f"hypotheses {search}"]) for search in SEARCHES]
        errors = [f"{p[f'error_m {search}']:.2f}" for search in SEARCHES]
        apart = [f"{p['apart_m']:.3f}", f"{p['apart_deg']:.3f}", "yes" if p["is_same"] else "no"]
        ratio = f"{counts[0] / max(1, counts[1]):.1f}"
        name = f"seed {p['seed']}, {p['view']}" if is_seeded else p["view"]
        rows.append([name, *map(str, counts), ratio, *errors, *apart])
    figures = [
        Figure("views whose searches end in one optimum", float(same), ""),
        Figure("views", float(len(pairs)), ""),
        Figure("hypotheses of basins", basins, "", "grid", grid, grid / basins if basins else None),
    ]
    counted = f"{same} of {len(pairs)} end within {SAME_M:g} m and {SAME_DEG:g} deg of each other. {title}"
    return Report(f"{format_columns(rows)}\n{counted}", figures, pairs)


@dataclass(frozen=True, kw_only=True)
class Drawn(DrawnOptions):
    """What is drawn."""

    views: int = flag(6, "seeded views (6)", sets=("dataset.num_views",))


@dataclass(frozen=True, kw_only=True)
class WidePriorsOptions:
    """What is measured."""

    city: Path | None = flag(None, "city model; the demo town if not given")
    drawn: Drawn = part(Drawn)


def _measured(given: WidePriorsOptions, steps: Progress) -> Report:
    return measure_wide_priors(given.drawn.over(given.city), given.drawn.each_seed(), steps)


if __name__ == "__main__":
    sys.exit(run("wide_priors", WidePriorsOptions, _measured))
