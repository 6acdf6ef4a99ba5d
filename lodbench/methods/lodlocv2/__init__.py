"""LoD-Loc v2: silhouette alignment by a coarse 4D grid and a fine particle filter."""

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.methods.lodlocv2.method import LodLocV2 as LodLocV2
    from lodbench.methods.lodlocv2.method import search as search
    from lodbench.methods.lodlocv2.params import LodLocV2Params as LodLocV2Params

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "LodLocV2": "method",
        "LodLocV2Params": "params",
        "search": "method",
    },
)
