"""Frames of a video one after the other: each starts from the last pose and motion (docs/adr/0032)."""

from lodbench.methods.tracking.params import Params
from lodbench.methods.tracking.tracker import Frame, Tracked, Tracker

__all__ = ["Frame", "Params", "Tracked", "Tracker"]
