"""Draws the picture of docs/architecture.md: `python docs/draw_architecture.py`.

Each row is one layer, or several that belong together. The two columns say which steps of the lists on that
page happen in a layer.
"""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import NamedTuple

OUT = Path(__file__).parent / "images" / "architecture.svg"


class Row(NamedTuple):
    """Layers with what they hold, and the steps of a run and of a photo that happen there."""

    layers: tuple[str, ...]
    holds: str
    run: str = ""
    photo: str = ""


# Top to bottom: each imports from those below it alone. A test compares it with the order of imports.
ROWS = (
    Row(("cli",), "commands: options in, text out", "1, 9", "1, 7"),
    Row(("bench",), "figures that anyone can make again"),
    Row(("harness",), "runs, own photos, flights, exports", "3, 4, 5", "2, 3, 5, 6"),
    Row(("reporting",), "tables, figures, pages from plain data", "9", "6"),
    Row(("evaluation",), "errors, recall, intervals, metrics", "8"),
    Row(("methods",), "from a query to a pose; assessment", "6", "4"),
    Row(("estimation",), "outlines, priors, searches, posteriors", "6", "4"),
    Row(("matching",), "features, matches, poses from them"),
    Row(("training",), "networks trained"),
    Row(("segmentation",), "masks from photos", "4", "2, 5"),
    Row(("citymap",), "the map methods are given; counts poses", "7", "4"),
    Row(("synthesis",), "drawn towns, photos, flights, masks"),
    Row(("execution",), "workers, ledger, progress", "5"),
    Row(("datasets",), "queries, priors, poses of other programs", "2"),
    Row(("rendering",), "silhouettes, and objectives over them", "7", "4"),
    Row(("photos",), "pictures; what photos state: camera, pose", "", "2, 3"),
    Row(("citymodel",), "from any file to a scene", "3", "3"),
    Row(("geometry",), "poses, cameras, lenses, angles"),
    Row(("storage",), "files, digests, random streams"),
    Row(("findings", "plugins", "params", "extras", "lazy_names", "errors"), "what all others use"),
    Row(("kernels",), "all code that numba compiles"),
)

_WIDTH, _TOP, _ROW, _RUN, _PHOTO = 620, 46, 34, 492, 572
_STYLE = """
text{font:15px system-ui,sans-serif;fill:#1f2430}.name{font:600 15px ui-monospace,monospace}
text.small{font-size:13px}.page{fill:#fff}.row{fill:#eef1fa}.step{fill:#3f51b5}.photo{fill:#00796b}
@media(prefers-color-scheme:dark){text{fill:#e3e6ee}.page{fill:#1e2129}.row{fill:#2a2f3d}
.step{fill:#a9b6ff}.photo{fill:#6fd6c4}}
"""


def drawn() -> str:
    """Returns the picture as SVG."""
    height = _TOP + _ROW * len(ROWS) + 40
    size = f'viewBox="0 0 {_WIDTH} {height}" width="{_WIDTH}"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img">',
        "<title>Layers of lodbench, and where the steps of a run and of a photo happen</title>",
        f"<style>{_STYLE}</style>",
        f'<rect class="page" width="{_WIDTH}" height="{height}" rx="8"/>',
        _text(16, 28, "layer", "small"),
        _text(_RUN, 28, "lodbench run", "small step", "middle"),
        _text(_PHOTO, 28, "localize", "small photo", "middle"),
    ]
    for k, row in enumerate(ROWS):
        parts += _row(row, _TOP + k * _ROW)
    parts.append(_text(16, height - 16, "Imports go down only.", "small"))
    return "\n".join([*parts, "</svg>\n"])


def _row(row: Row, top: int) -> list[str]:
    middle, is_many = top + 20, len(row.layers) > 1
    name = ", ".join(row.layers) if is_many else row.layers[0]
    return [
        f'<rect class="row" x="8" y="{top}" width="{_WIDTH - 16}" height="{_ROW - 4}" rx="4"/>',
        _text(16, middle, name, "name small" if is_many else "name"),
        "" if is_many else _text(150, middle, row.holds, "small"),
        _text(_RUN, middle, row.run, "step", "middle"),
        _text(_PHOTO, middle, row.photo, "photo", "middle"),
    ]


def _text(x: int, y: int, text: str, kind: str, anchor: str = "start") -> str:
    return (
        f'<text x="{x}" y="{y}" class="{kind}" text-anchor="{anchor}">{escape(text)}</text>' if text else ""
    )


if __name__ == "__main__":
    OUT.write_text(drawn(), encoding="utf-8")
