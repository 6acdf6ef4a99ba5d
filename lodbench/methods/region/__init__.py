"""Region-based localisation: the photo's own statistics inside and outside the map's silhouette."""

from lodbench.methods.region.method import Region
from lodbench.methods.region.params import Params

__all__ = ["Params", "Region"]
