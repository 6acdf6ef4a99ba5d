"""All code that numba compiles, and nothing that calls it: no module here imports another part of lodbench.

``compiled`` has the decorators, ``cache`` the place of what they made. ``arguments`` and ``looks`` say what
kernels are given, ``raster_rule`` what they mean by a covered pixel; these three load without numba.

Callers import kernels from this package: numba takes a third of a second to load, which a command that
computes nothing, as a finished run given again, does not spend.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

# What is called from elsewhere, by module.
_KERNELS = {
    "decimal_text": "scan",
    "depth": "draw_band fill_rays resolve_buildings resolve_depth resolve_layers resolve_normals",
    "edges": "building_sums cut_and_test measure_distances sample_edges",
    "estimation": "add_products add_votes error_covariance least_total whiten",
    "heights": "draw_from_above grow_planes",
    "masks": "code_lengths_saved count_bits count_overlaps distance_sums fill_padded grow outline_of"
    " outline_sides padded_stride sum_under",
    "photo_edges": "count_along_lines looked_up sum_along_lines",
    "projection": "select_buildings visible_buildings",
    "shading": "bake expose light_corners resolve_photo",
    "silhouettes": "draw_instances draw_views score_views",
    "textures": "resolve_textured",
}
HOMES = {name: module for module, names in _KERNELS.items() for name in names.split()}


class Kernel:
    """A kernel whose module is loaded by its first call."""

    def __init__(self, module: str, name: str) -> None:
        self._module, self._name, self._function = module, name, None

    def __call__(self, *arguments: Any) -> Any:
        """Returns what the kernel returns."""
        function = self._function or self._loaded()
        return function(*arguments)

    def _loaded(self) -> Any:
        self._function = getattr(import_module(f"lodbench.kernels.{self._module}"), self._name)
        return self._function


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return globals().setdefault(name, Kernel(HOMES[name], name))
