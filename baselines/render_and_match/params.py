"""Settings of methods that match a photo with rendered views."""

from __future__ import annotations

from dataclasses import dataclass

from lodbench.errors import require_numbers, require_within
from lodbench.plugins import find_plugin

ORACLE = "oracle"


@dataclass(frozen=True, slots=True)
class RenderAndMatchParams:
    """Settings of ``method=uavd4l`` and ``method=cadloc``.

    Attributes:
        name: Name to report.
        matcher: Entry point under ``lodbench.matchers``; or ``oracle``: true correspondences with noise and
            outliers, to bound what any matcher can bring. It needs the truth, and is told in every table.
        weights: Of the matcher, or its extractor: a file, or a folder or hub id fetched before; ``random``
            for random ones, whose rows count for nothing; None for their own.
        pnp: Entry point under ``lodbench.pose_solvers``.
        retrieval: Entry point under ``lodbench.retrievals``: the first round's views are looked up over an
            area; None for views around the prior.
        area_m: How far from the prior they are looked up, in x and y; None for the whole city.
        spacing_m: How far they are apart.
        views: Views rendered in the first round: the prior's, then others beside it; or those looked up.
        spread_m: How far beside it.
        rounds: Rounds of rendering and solving, each from the pose of the last; one view from the second on.
        width: Of the photo as it is matched, pixels; at most its own.
        canvas: Size of a view against the photo's, in each direction: what the prior's error moves out of the
            picture is still in the view.
        threshold_px: A match this far off at most speaks for a pose; pixels at ``width``; None for what suits
            method and matcher, 8 where that was not measured.
        min_inliers: Fewer matches than this are no answer.
        oracle_matches: Correspondences of ``matcher=oracle`` in a view.
        oracle_noise_px: Standard deviation of their error, pixels at ``width``.
        oracle_outliers: Share of them that are wrong.

    Raises:
        ConfigError: A name is unknown, or a value out of range.
    """

    name: str = "uavd4l"
    matcher: str = "sift_nn"
    weights: str | None = None
    pnp: str = "opencv"
    retrieval: str | None = None
    area_m: float | None = 200.0
    spacing_m: float = 40.0
    views: int = 1
    spread_m: float = 20.0
    rounds: int = 2
    width: int = 1204
    canvas: float = 1.3
    threshold_px: float | None = None
    min_inliers: int = 12
    oracle_matches: int = 1000
    oracle_noise_px: float = 1.0
    oracle_outliers: float = 0.3

    def __post_init__(self) -> None:
        if self.matcher != ORACLE:
            find_plugin("matchers", self.matcher)
        find_plugin("pose_solvers", self.pnp)
        if self.retrieval is not None:
            find_plugin("retrievals", self.retrieval)
        require_numbers(self, "method", ("views", "rounds", "oracle_matches"), 1)
        require_within("method.min_inliers", self.min_inliers, 4)
        require_within("method.width", self.width, 64, 8192)
        require_within("method.canvas", self.canvas, 1, 4)
        require_numbers(self, "method", ("area_m", "spread_m", "oracle_noise_px"), 0)
        require_numbers(self, "method", ("spacing_m", "threshold_px"), 0, ends="(]")
        require_within("method.oracle_outliers", self.oracle_outliers, 0, 1, "[)")
