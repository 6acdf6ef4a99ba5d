"""Renderers: the silhouette engine, its numpy reference, and back ends behind one protocol."""

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.rendering.edges import EdgeKind as EdgeKind
    from lodbench.rendering.edges import ViewEdges as ViewEdges
    from lodbench.rendering.fit import BoundaryFit as BoundaryFit
    from lodbench.rendering.fit import ContourFit as ContourFit
    from lodbench.rendering.fit import Fit as Fit
    from lodbench.rendering.fit import IouFit as IouFit
    from lodbench.rendering.fit import RegionFit as RegionFit
    from lodbench.rendering.fit import SemanticIouFit as SemanticIouFit
    from lodbench.rendering.fit import SoftIouFit as SoftIouFit
    from lodbench.rendering.masks import Instances as Instances
    from lodbench.rendering.photo_bins import AppearanceBins as AppearanceBins
    from lodbench.rendering.photo_bins import EdgeBins as EdgeBins
    from lodbench.rendering.photo_bins import appearance_bins as appearance_bins
    from lodbench.rendering.photo_bins import edge_bins as edge_bins
    from lodbench.rendering.renderer import DEPTH as DEPTH
    from lodbench.rendering.renderer import INSTANCES as INSTANCES
    from lodbench.rendering.renderer import LAYERS as LAYERS
    from lodbench.rendering.renderer import DepthRenderer as DepthRenderer
    from lodbench.rendering.renderer import InstanceRenderer as InstanceRenderer
    from lodbench.rendering.renderer import IouCounts as IouCounts
    from lodbench.rendering.renderer import LayerRenderer as LayerRenderer
    from lodbench.rendering.renderer import Layers as Layers
    from lodbench.rendering.renderer import Renderer as Renderer
    from lodbench.rendering.renderer import Scorer as Scorer
    from lodbench.rendering.renderer import make_renderer as make_renderer
    from lodbench.rendering.renderer import open_renderer as open_renderer
    from lodbench.rendering.renderer import renderers_with as renderers_with

_HOMES = {
    "edges": "EdgeKind ViewEdges",
    "fit": "BoundaryFit ContourFit Fit IouFit RegionFit SemanticIouFit SoftIouFit",
    "masks": "Instances",
    "photo_bins": "AppearanceBins EdgeBins appearance_bins edge_bins",
    "renderer": "DEPTH INSTANCES LAYERS DepthRenderer InstanceRenderer IouCounts LayerRenderer Layers"
    " Renderer Scorer make_renderer open_renderer renderers_with",
}
__all__, __getattr__, __dir__ = lazy_names(
    __name__, {name: home for home, names in _HOMES.items() for name in names.split()}
)
