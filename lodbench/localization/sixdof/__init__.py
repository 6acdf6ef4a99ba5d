"""LoD-Loc v2 in six degrees of freedom: the grid, then outlines aligned by least squares (docs/adr/0013)."""

from lodbench.localization.sixdof.method import SixDof
from lodbench.localization.sixdof.params import Params

__all__ = ["Params", "SixDof"]
