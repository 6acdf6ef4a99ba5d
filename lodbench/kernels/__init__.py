"""All code that numba compiles, and nothing that calls it: no module here imports another part of lodbench.

``compiled`` has the decorators and the place of what they made. ``arguments`` and ``looks`` say what kernels
are given, and what they mean by a covered pixel; these two load without numba.

Callers import kernels from this package: numba takes a third of a second to load, which a command that
computes nothing, as a finished run given again, does not spend.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

# What is called from elsewhere, by module.
_KERNELS = {
    "decimal_text": "parse_decimals",
    "depth": "draw_band fill_rays resolve_buildings resolve_depth resolve_layers resolve_normals",
    "edges": "measure_distances normal_equations sample_edges split_edges",
    "estimation": "add_products add_votes error_covariance minimise_total_variation whiten",
    "heights": "draw_from_above grow_planes",
    "masks": "code_lengths_saved count_bits count_overlaps dilate distance_sums fill_padded"
    " outline_directions outline_of padded_stride sum_under",
    "photo_edges": "count_along_lines quantise_edges sum_along_lines",
    "projection": "select_buildings visible_buildings",
    "shading": "bake expose light_corners resolve_photo resolve_textured",
    "silhouettes": "draw_instances draw_views score_views",
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
