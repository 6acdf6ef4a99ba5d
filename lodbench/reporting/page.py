"""One self-contained HTML page: style, script and pictures inside, no network, light and dark."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping
from importlib.resources import files

from lodbench.reporting.safe_text import plain_text

# Nothing is fetched from anywhere: a browser refuses what a page should not even ask for.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


def html_page(title: str, body: str) -> str:
    """Returns a whole page.

    Args:
        title: Plain text.
        body: HTML; whatever came from outside must be escaped already (``text``).
    """
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{text(title)}</title>\n<style>\n{_resource('page.css')}</style>\n</head>\n<body>\n"
        f"<main>\n{body}</main>\n<script>\n{_resource('page.js')}</script>\n</body>\n</html>\n"
    )


def text(value: object) -> str:
    """Returns a value as HTML text: escaped, without control characters."""
    return html.escape(plain_text(str(value)))


def picture(content: bytes, kind: str, caption: str, classes: str = "") -> str:
    """Returns a figure whose picture is in the page itself.

    Args:
        content: The picture's file.
        kind: ``png``, ``jpeg`` or ``svg+xml``.
        caption: Plain text; what stands below, and what is read out.
        classes: CSS classes of the figure.
    """
    data = base64.b64encode(content).decode("ascii")
    return (
        f'<figure class="{classes}"><img alt="{text(caption)}" '
        f'src="data:image/{kind};base64,{data}"><figcaption>{text(caption)}</figcaption></figure>\n'
    )


def section(name: str, title: str, body: str) -> str:
    """Returns a section with a heading that can be linked to."""
    return f'<section id="{name}"><h2><a href="#{name}">{text(title)}</a></h2>\n{body}</section>\n'


def definition_list(pairs: Mapping[str, object]) -> str:
    """Returns names and values as a list."""
    items = "".join(
        f"<div><dt>{text(name)}</dt><dd>{text(value)}</dd></div>" for name, value in pairs.items()
    )
    return f'<dl class="facts">{items}</dl>\n'


def _resource(name: str) -> str:
    return (files("lodbench.reporting") / name).read_text(encoding="utf-8")
