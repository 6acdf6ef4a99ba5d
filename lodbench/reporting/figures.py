"""Figures drawn with matplotlib: one look, PNG and SVG, the same bytes from the same numbers."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Lines of splits, to be cycled through.
LINE_STYLES = ("-", "--", ":", "-.")
# Told apart with any colour vision, and in grey by their order (after Okabe and Ito).
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    # Letters stay text: small files, and a page that can be searched.
    "svg.fonttype": "none",
    # Ids come from this instead of from chance.
    "svg.hashsalt": "lodbench",
    "savefig.facecolor": "white",
    # Names come from anywhere: a pair of dollar signs is no formula.
    "text.parse_math": False,
}


def draw_figure(width_in: float, height_in: float, draw: Callable[[Figure], None]) -> dict[str, bytes]:
    """Returns a figure as ``{"png": ..., "svg": ...}``."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(_STYLE), warnings.catch_warnings():
        # Names of the world's scripts: a box stands for a letter that the font lacks, in the picture only.
        warnings.filterwarnings("ignore", "Glyph", UserWarning)
        # No pyplot: it would choose a window system, and keep every figure.
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        FigureCanvasAgg(figure)
        draw(figure)
        pictures = {}
        for kind, metadata in (("png", {"Software": None}), ("svg", {"Date": None, "Creator": None})):
            stream = io.BytesIO()
            figure.savefig(stream, format=kind, dpi=160, metadata=metadata)
            pictures[kind] = stream.getvalue()
            # Laid out once, for both.
            figure.set_layout_engine("none")
    return pictures
