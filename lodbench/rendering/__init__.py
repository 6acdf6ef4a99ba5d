"""Renderers: the silhouette engine, its numpy reference, and back ends behind one protocol."""

from lodbench.rendering.protocol import IouCounts, Renderer, Scorer
from lodbench.rendering.registry import RENDERERS, make_renderer

__all__ = ["RENDERERS", "IouCounts", "Renderer", "Scorer", "make_renderer"]
