"""LoD-Loc v2 in six degrees of freedom: the grid, then outlines aligned by least squares (docs/adr/0013)."""

from lodbench.methods.contour_alignment.method import ContourAlignment
from lodbench.methods.contour_alignment.params import Params

__all__ = ["ContourAlignment", "Params"]
