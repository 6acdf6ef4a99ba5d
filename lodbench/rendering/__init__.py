"""Renderers: the silhouette engine, its numpy reference, and back ends behind one protocol."""

from lodbench.rendering.fit import BoundaryFit, Fit, IouFit, SoftIouFit
from lodbench.rendering.instances import Instances
from lodbench.rendering.layers import Layers
from lodbench.rendering.protocol import (
    DepthRenderer,
    InstanceRenderer,
    IouCounts,
    LayerRenderer,
    Renderer,
    Scorer,
)
from lodbench.rendering.registry import (
    DEPTH_RENDERERS,
    INSTANCE_RENDERERS,
    LAYER_RENDERERS,
    RENDERERS,
    make_renderer,
    open_renderer,
    require_renderer,
)

__all__ = [
    "DEPTH_RENDERERS",
    "INSTANCE_RENDERERS",
    "LAYER_RENDERERS",
    "RENDERERS",
    "BoundaryFit",
    "DepthRenderer",
    "Fit",
    "InstanceRenderer",
    "Instances",
    "IouCounts",
    "IouFit",
    "LayerRenderer",
    "Layers",
    "Renderer",
    "Scorer",
    "SoftIouFit",
    "make_renderer",
    "open_renderer",
    "require_renderer",
]
