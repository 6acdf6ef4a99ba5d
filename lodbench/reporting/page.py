"""Templates filled in: self-contained HTML pages (no network, light and dark), and LaTeX."""

from __future__ import annotations

import base64
import re
import urllib.parse
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any, NamedTuple

from lodbench.reporting.aligned_text import count_of, plain_text
from lodbench.reporting.figures import SERIES

if TYPE_CHECKING:
    from jinja2 import Environment

# Nothing is fetched from anywhere: a browser refuses what a page should not even ask for.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
# What figures are drawn in, and the page's names for it.
_INK = {
    "#000000": "ink", "#222222": "ink", "#ffffff": "paper", "#808080": "soft", "#b0b0b0": "line",
    **{colour: f"c{number}" for number, colour in enumerate(SERIES)},
}  # fmt: skip
# LaTeX is full of braces.
_TEX = {
    "block_start_string": "<%", "block_end_string": "%>",
    "variable_start_string": "<<", "variable_end_string": ">>",
}  # fmt: skip


class Picture(NamedTuple):
    """A picture inside a page."""

    content: bytes  # the picture's file
    kind: str  # ``png``, ``jpeg``, ``webp`` or ``svg+xml``
    caption: str  # what stands below, and what is read out
    classes: str = ""  # CSS classes of the figure
    key: str = ""  # of the query it shows, by which a page finds it; "" for none

    @property
    def inline(self) -> Any:
        """Returns a drawing of ``lodbench.reporting.figures`` as part of the page, in the page's colours."""
        text = self.content.decode("utf-8")
        text = text[text.index("<svg") :]
        for colour, variable in _INK.items():
            text = text.replace(colour, f"var(--{variable})")
        # Its style sheet would be the whole page's.
        return markup(re.sub(r"<style[^>]*>.*?</style>|<metadata>.*?</metadata>", "", text, flags=re.DOTALL))

    @property
    def url(self) -> str:
        """Returns the picture as a ``data:`` URL."""
        return f"data:image/{self.kind};base64,{base64.b64encode(self.content).decode('ascii')}"


def rendered(template: str, **values: Any) -> str:
    """Returns a template of ``lodbench/reporting/templates``, filled in.

    In HTML every text is escaped and cleared of control characters.
    """
    return _environment(template.endswith(".html.jinja")).get_template(template).render(**values)


@cache
def _environment(is_html: bool) -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    def plain(value: Any) -> Any:
        return value if isinstance(value, Markup) or not is_html else plain_text(str(value))

    environment = Environment(
        loader=PackageLoader("lodbench.reporting"),
        autoescape=is_html,  # noqa: S701 - LaTeX is escaped by its own rules
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
        finalize=plain,
        **({} if is_html else _TEX),  # type: ignore[arg-type]
    )
    environment.globals |= {"policy": _POLICY, "resource": _resource}
    environment.filters |= {"path": urllib.parse.quote, "count_of": count_of}
    return environment


def _resource(name: str) -> Any:
    from markupsafe import Markup

    return Markup((files("lodbench.reporting") / name).read_text(encoding="utf-8"))  # noqa: S704 - our own


def markup(html: str) -> Any:
    """Returns HTML that a template must not escape again: another template's."""
    from markupsafe import Markup

    return Markup(html)  # noqa: S704 - made by a template


def facts(pairs: Mapping[str, object]) -> Any:
    """Returns names and values as a list in HTML; what has no value is left out."""
    known = {name: value for name, value in pairs.items() if value is not None and value != ""}
    return markup(rendered("facts.html.jinja", pairs=known))
