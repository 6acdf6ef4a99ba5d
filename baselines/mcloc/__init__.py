"""``method=mcloc``: Monte Carlo render and compare of dense features (Trivigno et al., CVPR 2024)."""

from .method import McLoc
from .params import McLocParams

__all__ = ["McLoc", "McLocParams"]
