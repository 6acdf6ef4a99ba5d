"""``method=auto``: what ``lodbench localize`` does with a single photo, as a method."""

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.methods.auto.method import Auto as Auto
    from lodbench.methods.auto.params import Params as Params

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "Auto": "method",
        "Params": "params",
    },
)
