"""``method=lodlocv3``: LoD-Loc v2's search, ranked by how single buildings fit (LoD-Loc v3, CVPR 2026)."""

from .method import LodLocV3
from .params import LodLocV3Params

__all__ = ["LodLocV3", "LodLocV3Params"]
