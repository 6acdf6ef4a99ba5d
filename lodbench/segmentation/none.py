"""``segmenter=none``: no masks at all, for methods that need none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Entry
from lodbench.errors import QueryFault


@dataclass(frozen=True, slots=True)
class NoMaskParams:
    """Settings of ``segmenter=none``: none."""

    name: str = "none"


class NoMask:
    """Makes no mask."""

    params_type = NoMaskParams
    name = "none"
    requires: frozenset[Input] = frozenset()
    provides: frozenset[Input] = frozenset()

    def __init__(self, params: NoMaskParams) -> None:
        self.params = params

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Never answers.

        Raises:
            QueryFault: Always.
        """
        raise QueryFault("segmenter=none makes no masks")

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns nothing: there is nothing that answers could depend on."""
        return ""
