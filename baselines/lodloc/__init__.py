"""``method=lodloc``: LoD-Loc (v1), neural wireframe alignment (Zhu et al., NeurIPS 2024)."""

from .method import LodLoc
from .params import LodLocParams

__all__ = ["LodLoc", "LodLocParams"]
