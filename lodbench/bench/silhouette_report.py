"""The silhouette figures as data and as text."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lodbench.bench.figures import Figure
from lodbench.reporting.columns import format_columns


@dataclass(frozen=True, slots=True)
class Timing:
    """One renderer at one size.

    Attributes:
        renderer: Its name.
        threads: The engine's threads; None for a peer, which uses as many as it likes.
        size: Width and height of the mask, pixels.
        microseconds: Per hypothesis, rendering and IoU together, one number per view.
        different: Share of pixels that differ from the engine's picture of the views themselves.
    """

    renderer: str
    threads: int | None
    size: tuple[int, int]
    microseconds: tuple[float, ...]
    different: float

    @property
    def mean(self) -> float:
        """Returns microseconds per hypothesis over all views."""
        return float(np.mean(self.microseconds))

    @property
    def size_text(self) -> str:
        """Returns ``602x448``."""
        return f"{self.size[0]}x{self.size[1]}"

    @property
    def name(self) -> str:
        """Returns the renderer and its threads in words."""
        if self.threads is None:
            return self.renderer
        return f"{self.renderer}, {self.threads} thread{'s' if self.threads > 1 else ''}"


@dataclass(frozen=True, slots=True)
class SilhouetteReport:
    """Timings of the engine and its peers on the same views.

    Attributes:
        city: File name of the city model.
        num_triangles: Triangles of the scene.
        hypotheses: The engine's hypotheses per view.
        rejections: Draws of a view thrown away: too few or too many buildings, or among them.
        cores: Cores of the machine.
        load: What else the machine was doing: its load average before the start, None if unknown.
        timings: One per renderer, thread count and size.
        absent: Peers that could not run, and why.
    """

    city: str
    num_triangles: int
    hypotheses: int
    rejections: int
    cores: int
    load: float | None
    timings: tuple[Timing, ...]
    absent: dict[str, str] = field(default_factory=dict)

    @property
    def ours(self) -> list[Timing]:
        """Returns the engine's timings."""
        return [timing for timing in self.timings if timing.threads is not None]

    def peers_at(self, size: tuple[int, int]) -> list[Timing]:
        """Returns the peers' timings at a size."""
        return [t for t in self.timings if t.threads is None and t.size == size]

    def figures(self) -> list[Figure]:
        """Returns the engine's time beside each peer's; an absent peer is named with the reason."""
        figures = []
        for timing in self.ours:
            title = f"render and IoU, {timing.size_text}, {timing.name}"
            peers = self.peers_at(timing.size)
            figures += [
                Figure(title, timing.mean, "us", peer.renderer, peer.mean, peer.mean / timing.mean)
                for peer in peers
            ]
            missing = [Figure(title, timing.mean, "us", f"{n} ({why})") for n, why in self.absent.items()]
            figures += missing if peers or missing else [Figure(title, timing.mean, "us")]
        figures += [
            Figure(f"pixels unlike {t.renderer}, {t.size_text}", t.different * 100, "%")
            for t in self.timings
            if t.threads is None
        ]
        return [*figures, Figure("views rejected", self.rejections, "")]

    def to_text(self) -> str:
        """Returns the report as a table with a line of small print."""
        peer_names = list(dict.fromkeys(t.renderer for t in self.timings if t.threads is None))
        rows = [
            ["render and IoU", "size", "us/hypothesis", "fastest view", "slowest view"]
            + [f"x {name}" for name in peer_names]
        ]
        for timing in self.timings:
            spread = (timing.mean, min(timing.microseconds), max(timing.microseconds))
            ratios = [f"{peer.mean / timing.mean:.1f}" for peer in self.peers_at(timing.size)]
            rows.append([timing.name, timing.size_text, *(f"{value:.1f}" for value in spread), *ratios])
        return "\n".join([format_columns(rows), *self._small_print()])

    def _small_print(self) -> list[str]:
        num_views = len(self.timings[0].microseconds)
        load = "unknown" if self.load is None else f"{self.load:.1f}"
        lines = [
            f"{self.city}, {self.num_triangles:,} triangles, {num_views} views ({self.rejections} draws "
            f"rejected), {self.hypotheses:,} hypotheses around each; best pass per view.",
            f"{self.cores} cores, load {load} before the start: a busy machine slows renderers unequally.",
        ]
        lines += [
            f"{t.renderer} at {t.size_text}: {t.different:.2%} of pixels differ from the engine's."
            for t in self.timings
            if t.threads is None
        ]
        return lines + [f"{name} is absent: {reason}" for name, reason in self.absent.items()]
