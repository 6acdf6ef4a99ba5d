"""Typesets the ```` ```math ```` blocks of pages as SVG while the site is built: no script, nothing fetched.

GitHub shows the same blocks by itself. A hook of mkdocs (mkdocs.yml), by matplotlib's mathtext, which knows
a part of LaTeX: https://matplotlib.org/stable/users/explain/text/mathtext.html.
"""

from __future__ import annotations

import html
import re
from functools import cache
from typing import Any

from matplotlib.font_manager import FontProperties
from matplotlib.path import Path
from matplotlib.textpath import TextPath

BLOCK = re.compile(r"^```math\n(.*?)\n```$", re.DOTALL | re.MULTILINE)
TAG = re.compile(r"\s*\\tag\{(\w+)\}")

# What mathtext sets smaller, or wider apart, than GitHub does.
_BETTER = {r"\frac": r"\dfrac", r"^\top": r"^{\mathsf{T}}", "^*": r"^{\ast}", r"\sum": r"\,\sum"}
# Of a page's text, pixels; space around an equation.
_SIZE_PX, _MARGIN_PX = 19, 2
_COMMANDS = {Path.MOVETO: "M", Path.LINETO: "L", Path.CURVE3: "Q", Path.CURVE4: "C", Path.CLOSEPOLY: "Z"}
_STYLE = "display:flex;align-items:center;justify-content:space-between;gap:1em;margin:1em 0"
_SCROLLS = "min-width:0;overflow-x:auto;overflow-y:hidden"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Returns a page with its equations drawn."""
    return BLOCK.sub(lambda block: drawn(block[1]), markdown)


@cache
def drawn(latex: str) -> str:
    """Returns an equation as HTML, in the colour of the text around it; its tag is its number and its anchor.

    Raises:
        ValueError: It is no equation that mathtext understands.
    """
    tag, said = TAG.search(latex), " ".join(TAG.sub("", latex).split())
    text = said
    for plain, better in _BETTER.items():
        text = text.replace(plain, better)
    path = TextPath((0, 0), f"${text}$", _SIZE_PX, prop=FontProperties(math_fontfamily="stix"))
    (left, bottom), (right, top) = path.get_extents().get_points()
    box = (left - _MARGIN_PX, -top - _MARGIN_PX, right - left + 2 * _MARGIN_PX, top - bottom + 2 * _MARGIN_PX)
    number = "" if tag is None else f"<span>({tag[1]})</span>"
    anchor = "" if tag is None else f' id="{tag[1].lower()}"'
    picture = (
        f'<svg style="max-width:none" role="img" fill="currentColor" aria-label="{html.escape(said)}" '
        f'width="{box[2]:.0f}" height="{box[3]:.0f}" viewBox="{" ".join(f"{side:.1f}" for side in box)}">'
        f'<path d="{_outline(path)}"/></svg>'
    )
    return f'<div{anchor} style="{_STYLE}"><div style="{_SCROLLS}">{picture}</div>{number}</div>'


def _outline(path: Path) -> str:
    """Returns a path as SVG writes it: y down."""
    words = []
    for points, code in path.iter_segments(simplify=False, curves=True):
        signed = [f"{-value if k % 2 else value:.1f}" for k, value in enumerate(points)]
        words.append(_COMMANDS[code] + " ".join([] if code == Path.CLOSEPOLY else signed))
    return "".join(words)
