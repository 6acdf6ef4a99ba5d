"""Whole flights: photos aligned jointly, with what drone and map are wrong about in all (docs/adr/0031)."""

from lodbench.methods.flight.method import FlightMethod
from lodbench.methods.flight.params import Params

__all__ = ["FlightMethod", "Params"]
