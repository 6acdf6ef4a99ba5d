"""Renderers: the silhouette engine, its numpy reference, and back ends behind one protocol."""

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.rendering.edges import EdgeKind as EdgeKind
    from lodbench.rendering.edges import ViewEdges as ViewEdges
    from lodbench.rendering.fit import BoundaryFit as BoundaryFit
    from lodbench.rendering.fit import Fit as Fit
    from lodbench.rendering.fit import IouFit as IouFit
    from lodbench.rendering.fit import SemanticIouFit as SemanticIouFit
    from lodbench.rendering.fit import SoftIouFit as SoftIouFit
    from lodbench.rendering.instances import Instances as Instances
    from lodbench.rendering.photo_bins import AppearanceBins as AppearanceBins
    from lodbench.rendering.photo_bins import EdgeBins as EdgeBins
    from lodbench.rendering.photo_bins import appearance_bins as appearance_bins
    from lodbench.rendering.photo_bins import edge_bins as edge_bins
    from lodbench.rendering.protocol import DepthRenderer as DepthRenderer
    from lodbench.rendering.protocol import InstanceRenderer as InstanceRenderer
    from lodbench.rendering.protocol import IouCounts as IouCounts
    from lodbench.rendering.protocol import LayerRenderer as LayerRenderer
    from lodbench.rendering.protocol import Layers as Layers
    from lodbench.rendering.protocol import Renderer as Renderer
    from lodbench.rendering.protocol import Scorer as Scorer
    from lodbench.rendering.region_fit import ContourFit as ContourFit
    from lodbench.rendering.region_fit import RegionFit as RegionFit
    from lodbench.rendering.registry import DEPTH as DEPTH
    from lodbench.rendering.registry import INSTANCES as INSTANCES
    from lodbench.rendering.registry import LAYERS as LAYERS
    from lodbench.rendering.registry import make_renderer as make_renderer
    from lodbench.rendering.registry import open_renderer as open_renderer
    from lodbench.rendering.registry import renderers_with as renderers_with

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "AppearanceBins": "photo_bins",
        "BoundaryFit": "fit",
        "ContourFit": "region_fit",
        "DEPTH": "registry",
        "DepthRenderer": "protocol",
        "EdgeBins": "photo_bins",
        "EdgeKind": "edges",
        "Fit": "fit",
        "INSTANCES": "registry",
        "InstanceRenderer": "protocol",
        "Instances": "instances",
        "IouCounts": "protocol",
        "IouFit": "fit",
        "LAYERS": "registry",
        "LayerRenderer": "protocol",
        "Layers": "protocol",
        "RegionFit": "region_fit",
        "Renderer": "protocol",
        "Scorer": "protocol",
        "SemanticIouFit": "fit",
        "SoftIouFit": "fit",
        "ViewEdges": "edges",
        "appearance_bins": "photo_bins",
        "edge_bins": "photo_bins",
        "make_renderer": "registry",
        "open_renderer": "registry",
        "renderers_with": "registry",
    },
)
