"""Whole flights: photos aligned jointly, with what drone and map are wrong about in all (docs/adr/0014)."""

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.methods.flight.method import FlightMethod as FlightMethod
    from lodbench.methods.flight.params import FlightParams as FlightParams

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "FlightMethod": "method",
        "FlightParams": "params",
    },
)
