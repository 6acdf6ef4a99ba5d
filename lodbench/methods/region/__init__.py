"""Region-based localisation: the photo's own statistics inside and outside the map's silhouette."""

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.methods.region.method import Region as Region
    from lodbench.methods.region.params import RegionParams as RegionParams

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "RegionParams": "params",
        "Region": "method",
    },
)
