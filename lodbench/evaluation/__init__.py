"""Errors of estimated poses, recalls over a dataset, and their uncertainty."""

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.evaluation.errors import PoseError as PoseError
    from lodbench.evaluation.errors import pose_error as pose_error
    from lodbench.evaluation.recall import DEFAULT_THRESHOLDS as DEFAULT_THRESHOLDS
    from lodbench.evaluation.recall import SplitSummary as SplitSummary
    from lodbench.evaluation.recall import Threshold as Threshold
    from lodbench.evaluation.recall import summarize as summarize

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "DEFAULT_THRESHOLDS": "recall",
        "PoseError": "errors",
        "SplitSummary": "recall",
        "Threshold": "recall",
        "pose_error": "errors",
        "summarize": "recall",
    },
)
