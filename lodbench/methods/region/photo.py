"""A query's photo as the stages of the method look at it: each view of it is made once."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import Camera
from lodbench.methods.region.evidence import PhotoFit
from lodbench.methods.region.params import Params, working_size
from lodbench.rendering.edge_levels import Levels, directed_edge_levels

View = TypeVar("View")


class Photo:
    """A photo in some sizes: what parts its regions, and its edges after some blurs.

    With several threads what is usually asked for is prepared beside the search.

    Args:
        pixels: As of ``read_picture``.
        camera: The photo's.
        params: The method's.
        threads: To work on.
        blurs_px: That will be asked for, pixels of the width at which lines are laid.
    """

    def __init__(
        self,
        pixels: NDArray[np.uint8],
        camera: Camera,
        params: Params,
        threads: int = 1,
        blurs_px: tuple[float, ...] = (),
    ) -> None:
        self._pixels, self._camera, self._params = pixels, camera, params
        self._pool, self._begun = ThreadPoolExecutor(threads), dict[tuple[Any, ...], Future[Any]]()
        if threads > 1:
            self._begin(self._make_fit, params.coarse_width, True)
            self._begin(self._make_fit, params.fine_width, False)
            for blur_px in blurs_px if params.lines_weight > 0 else ():
                self._begin(self._make_levels, params.lines_width, blur_px)

    def fit(self, width: int, is_coarse: bool) -> PhotoFit:
        """Returns the fit of silhouettes so wide, pixels; see ``PhotoFit``."""
        return self._begin(self._make_fit, width, is_coarse).result()

    def levels(self, blur_px: float, width: int | None = None) -> Levels:
        """Returns how strongly the photo changes, (H, W, 12) as of ``directed_edge_levels``.

        Args:
            blur_px: Of the photo, pixels of the width.
            width: Pixels; None for that at which lines are laid.
        """
        return self._begin(self._make_levels, width or self._params.lines_width, blur_px).result()

    def _begin(self, make: Callable[..., View], *what: Any) -> Future[View]:
        # Only the query's own thread asks. By name: a bound method would keep the photo from being let go.
        key = (make.__name__, *what)
        if key not in self._begun:
            self._begun[key] = self._pool.submit(make, *what)
        return self._begun[key]

    def _make_fit(self, width: int, is_coarse: bool) -> PhotoFit:
        return PhotoFit(self._pixels, working_size(self._camera, width), self._params, is_coarse)

    def _make_levels(self, width: int, blur_px: float) -> Levels:
        return directed_edge_levels(self._pixels, working_size(self._camera, width), blur_px)
