"""LoD-Loc v2: silhouette alignment by a coarse 4D grid and a fine particle filter."""

from lodbench.methods.lodlocv2.method import LodLocV2, Particles, PoseScorer, Scoring, search
from lodbench.methods.lodlocv2.params import Params

__all__ = ["LodLocV2", "Params", "Particles", "PoseScorer", "Scoring", "search"]
