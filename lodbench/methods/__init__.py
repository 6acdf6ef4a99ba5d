"""Methods: from a query and a scene to a pose."""

from lodbench.datasets.inputs import Input
from lodbench.methods.protocol import Estimate, Method, Streams

__all__ = ["Estimate", "Input", "Method", "Streams"]
