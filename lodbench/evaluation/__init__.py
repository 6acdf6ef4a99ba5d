"""Errors of estimated poses, recalls over a dataset, and their uncertainty."""

from lodbench.evaluation.errors import PoseError, pose_error
from lodbench.evaluation.recall import DEFAULT_THRESHOLDS, SplitSummary, Threshold, summarize

__all__ = ["DEFAULT_THRESHOLDS", "PoseError", "SplitSummary", "Threshold", "pose_error", "summarize"]
