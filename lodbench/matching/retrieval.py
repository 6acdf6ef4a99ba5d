"""What describes a whole picture, so that views of a place can be looked up."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lodbench.params import to_params
from lodbench.plugins import load_plugin

Descriptors = NDArray[np.float32]


class Retrieval(Protocol):
    """Describes pictures; an entry point under ``lodbench.retrievals``."""

    def describe(self, pictures: NDArray[np.uint8]) -> Descriptors:
        """Returns (N, D) descriptors, of length 1 or 0, of (N, H, W, 3) RGB pictures of one size.

        Near descriptors are of pictures that look alike.
        """
        ...


def open_retrieval(name: str, **settings: Any) -> Retrieval:
    """Returns the retrieval of a name.

    Raises:
        ConfigError: There is none, it is broken, its library or weights are absent, or a setting is wrong.
    """
    kind = load_plugin("retrievals", name)
    retrieval: Retrieval = kind(to_params(settings, kind.params_type, name))
    return retrieval
