"""Arrays that grow at their end in one piece of memory."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class GrowingArray:
    """Collects blocks of rows into one array.

    Unlike blocks kept in a list and joined at the end, the rows exist once: large pieces of memory
    grow by moving pages, and freed blocks do not stay behind between others that live on.

    Args:
        dtype: Of the rows.
        row_shape: Shape of one row, ``()`` for plain numbers.

    Example:
        >>> array = GrowingArray(np.int32)
        >>> array.extend(np.array([1, 2]))
        >>> array.extend(np.array([3]))
        >>> array.finish()
        array([1, 2, 3], dtype=int32)
    """

    def __init__(self, dtype: DTypeLike, row_shape: tuple[int, ...] = ()) -> None:
        self._rows: NDArray[Any] = np.zeros((0, *row_shape), dtype)
        self._size = 0

    def extend(self, block: NDArray[Any]) -> None:
        """Appends the rows of a block, cast to the array's type."""
        end = self._size + len(block)
        if end > len(self._rows):
            self._resize(end if self._size == 0 else end + end // 8)
        self._rows[self._size : end] = block
        self._size = end

    def finish(self) -> NDArray[Any]:
        """Returns the rows; the collector is empty afterwards."""
        self._resize(self._size)
        rows, self._rows, self._size = self._rows, self._rows[:0].copy(), 0
        return rows

    def _resize(self, size: int) -> None:
        # Nobody else ever saw the array, so no reference can be left dangling.
        self._rows.resize((size, *self._rows.shape[1:]), refcheck=False)
