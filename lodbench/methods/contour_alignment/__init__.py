"""LoD-Loc v2 in six degrees of freedom: the grid, then outlines aligned by least squares (docs/adr/0010)."""

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.methods.contour_alignment.method import ContourAlignment as ContourAlignment
    from lodbench.methods.contour_alignment.params import ContourAlignmentParams as ContourAlignmentParams

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "ContourAlignment": "method",
        "ContourAlignmentParams": "params",
    },
)
