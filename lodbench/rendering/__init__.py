"""Renderers: the silhouette engine, its numpy reference, and back ends behind one protocol."""

from lodbench.rendering.appearance_bins import AppearanceBins, EdgeBins, appearance_bins, edge_bins
from lodbench.rendering.fit import BoundaryFit, Fit, IouFit, SoftIouFit
from lodbench.rendering.instances import Instances
from lodbench.rendering.layers import Layers
from lodbench.rendering.model_edges import EdgeKind, ViewEdges
from lodbench.rendering.protocol import (
    DepthRenderer,
    InstanceRenderer,
    IouCounts,
    LayerRenderer,
    Renderer,
    Scorer,
)
from lodbench.rendering.region_fit import ContourFit, RegionFit
from lodbench.rendering.registry import (
    DEPTH,
    INSTANCES,
    LAYERS,
    make_renderer,
    open_renderer,
    renderers_with,
)

__all__ = [
    "DEPTH",
    "INSTANCES",
    "LAYERS",
    "AppearanceBins",
    "BoundaryFit",
    "ContourFit",
    "DepthRenderer",
    "EdgeBins",
    "EdgeKind",
    "Fit",
    "InstanceRenderer",
    "Instances",
    "IouCounts",
    "IouFit",
    "LayerRenderer",
    "Layers",
    "RegionFit",
    "Renderer",
    "Scorer",
    "SoftIouFit",
    "ViewEdges",
    "appearance_bins",
    "edge_bins",
    "make_renderer",
    "open_renderer",
    "renderers_with",
]
