"""The silhouette figures as data and as text."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lodbench.bench.figures import Figure
from lodbench.reporting.columns import format_columns

# Kinds of views, named by their pitch from nadir.
STEEP = "pitch 20 to 60"
HORIZON = "pitch 60 to 75"


@dataclass(frozen=True, slots=True)
class Timing:
    """One renderer on one kind of views at one size.

    Attributes:
        renderer: Its name.
        threads: The engine's threads; None for a peer, which uses as many as it likes.
        size: Width and height of the mask, pixels.
        views: ``STEEP`` or ``HORIZON``.
        microseconds: Per hypothesis, rendering and IoU together, one number per view.
        cores: Cores the process kept busy: its CPU time over wall time.
        different: Share of pixels that differ from the engine's picture of the views themselves.
    """

    renderer: str
    threads: int | None
    size: tuple[int, int]
    views: str
    microseconds: tuple[float, ...]
    cores: float
    different: float

    @property
    def mean(self) -> float:
        """Returns microseconds per hypothesis over all views."""
        return float(np.mean(self.microseconds))

    @property
    def size_text(self) -> str:
        """Returns ``602x448``, with the kind of views unless they are the usual ones."""
        size = f"{self.size[0]}x{self.size[1]}"
        return size if self.views == STEEP else f"{size}, {self.views}"

    @property
    def name(self) -> str:
        """Returns the renderer and its threads in words."""
        if self.threads is None:
            return self.renderer
        return f"{self.renderer}, {self.threads} thread{'s' if self.threads > 1 else ''}"

    def times_faster(self, peer: Timing) -> tuple[float, ...]:
        """Returns how many times faster than a peer this is, one number per view."""
        return tuple(b / a for a, b in zip(self.microseconds, peer.microseconds, strict=True))


@dataclass(frozen=True, slots=True)
class SilhouetteReport:
    """Timings of the engine and its peers on the same views.

    Attributes:
        city: File name of the city model.
        num_triangles: Triangles of the scene.
        hypotheses: The engine's hypotheses per view.
        peer_hypotheses: A peer's: the first of them.
        rejections: By kind of views, draws of a view thrown away: too few or too many buildings, or
            among them.
        cores: Cores of the machine.
        load: What else the machine was doing: its load average before the start, None if unknown.
        timings: One per kind of views, size, renderer and thread count.
        absent: Peers that could not run, and why.
    """

    city: str
    num_triangles: int
    hypotheses: int
    peer_hypotheses: int
    rejections: dict[str, int]
    cores: int
    load: float | None
    timings: tuple[Timing, ...]
    absent: dict[str, str] = field(default_factory=dict)

    @property
    def ours(self) -> list[Timing]:
        """Returns the engine's timings."""
        return [timing for timing in self.timings if timing.threads is not None]

    def peers_of(self, timing: Timing) -> list[Timing]:
        """Returns the peers' timings at the same size on the same views."""
        asked = timing.size, timing.views
        return [t for t in self.timings if t.threads is None and (t.size, t.views) == asked]

    def size_ratios(self) -> list[tuple[Timing, Timing]]:
        """Returns pairs of the engine's timings: at the first size, and at each other on the same views."""
        firsts = {(t.threads, t.views): t for t in reversed(self.ours) if t.size == self.timings[0].size}
        pairs = [(firsts[t.threads, t.views], t) for t in self.ours]
        return [(first, other) for first, other in pairs if other.size != first.size]

    def figures(self) -> list[Figure]:
        """Returns the engine's time beside each peer's; an absent peer is named with the reason."""
        figures = []
        for timing in self.ours:
            title = f"render and IoU, {timing.size_text}, {timing.name}"
            peers = self.peers_of(timing)
            figures += [
                Figure(title, timing.mean, "us", peer.renderer, peer.mean, peer.mean / timing.mean)
                for peer in peers
            ]
            missing = [Figure(title, timing.mean, "us", f"{n} ({why})") for n, why in self.absent.items()]
            figures += missing if peers or missing else [Figure(title, timing.mean, "us")]
        figures += [
            Figure(
                f"render and IoU, {b.size_text} beside {a.size_text}, {b.name}",
                b.mean, "us", a.size_text, a.mean, a.mean / b.mean,
            )
            for a, b in self.size_ratios()
        ]  # fmt: skip
        figures += [
            Figure(f"cores kept busy, {t.size_text}, {t.name}", t.cores, "cores") for t in self.timings
        ]
        figures += [
            Figure(f"pixels unlike {t.renderer}, {t.size_text}", t.different * 100, "%")
            for t in self.timings
            if t.threads is None
        ]
        figures += [Figure(f"views rejected, {kind}", count, "") for kind, count in self.rejections.items()]
        return figures

    def to_text(self) -> str:
        """Returns the report as a table with a line of small print."""
        peer_names = list(dict.fromkeys(t.renderer for t in self.timings if t.threads is None))
        rows = [
            ["render and IoU", "size", "us/hypothesis", "fastest view", "slowest view", "cores busy"]
            + [f"x {name}" for name in peer_names]
        ]
        for timing in self.timings:
            spread = (timing.mean, min(timing.microseconds), max(timing.microseconds))
            faster = {peer.renderer: f"{peer.mean / timing.mean:.1f}" for peer in self.peers_of(timing)}
            ratios = [faster.get(name, "") for name in peer_names]
            cells = [*(f"{value:.1f}" for value in spread), f"{timing.cores:.2f}", *ratios]
            rows.append([timing.name, timing.size_text, *cells])
        return "\n".join([format_columns(rows), *self._small_print()])

    def _small_print(self) -> list[str]:
        load = "unknown" if self.load is None else f"{self.load:.1f}"
        lines = [
            f"{b.name}: {b.size_text} takes {b.mean / a.mean:.2f} of the time of {a.size_text}, "
            f"{a.mean / b.mean:.2f}x as fast."
            for a, b in self.size_ratios()
        ]
        views = {t.views: len(t.microseconds) for t in self.timings}
        counts = [
            f"{n} views of {kind} deg ({self.rejections[kind]} draws rejected)" for kind, n in views.items()
        ]
        lines += [
            f"{self.city}, {self.num_triangles:,} triangles; {', '.join(counts)}.",
            f"{self.hypotheses:,} hypotheses around each view, peers the first {self.peer_hypotheses}; "
            "best pass per view.",
            f"{self.cores} cores, load {load} before the start: a busy machine slows renderers unequally.",
        ]
        lines += [
            f"{t.renderer} at {t.size_text}: {t.different:.2%} of pixels differ from the engine's."
            for t in self.timings
            if t.threads is None
        ]
        return lines + [f"{name} is absent: {reason}" for name, reason in self.absent.items()]
