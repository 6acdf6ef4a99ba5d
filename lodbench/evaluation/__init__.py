"""Errors of estimated poses, recalls over a dataset, and their uncertainty."""

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.evaluation.pose_errors import DEFAULT_THRESHOLDS as DEFAULT_THRESHOLDS
    from lodbench.evaluation.pose_errors import PoseError as PoseError
    from lodbench.evaluation.pose_errors import SplitSummary as SplitSummary
    from lodbench.evaluation.pose_errors import Threshold as Threshold
    from lodbench.evaluation.pose_errors import pose_error as pose_error
    from lodbench.evaluation.pose_errors import summarize as summarize

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "DEFAULT_THRESHOLDS": "pose_errors",
        "PoseError": "pose_errors",
        "SplitSummary": "pose_errors",
        "Threshold": "pose_errors",
        "pose_error": "pose_errors",
        "summarize": "pose_errors",
    },
)
