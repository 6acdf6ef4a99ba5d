"""``method=auto``: what ``lodbench localize`` does with a single photo, as a method."""

from lodbench.methods.auto.method import Auto
from lodbench.methods.auto.params import Params

__all__ = ["Auto", "Params"]
