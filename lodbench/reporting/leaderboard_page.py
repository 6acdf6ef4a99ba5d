"""The leaderboard as static pages: one per dataset, and an index."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lodbench.reporting.page import definition_list, html_page, section, text
from lodbench.reporting.table_html import format_html
from lodbench.reporting.tables import RecallTable

INDEX = "index.html"
_INTRODUCTION = (
    "<p>Rows of one block share queries, priors, masks, city model, tilt and segmenter, and only measured "
    "rows of one block rank. Rows kept apart say why; rows reported by papers stand as printed and never "
    "rank. A recall counts failed queries as failures.</p>\n"
)


def dataset_page(name: str, tables: Sequence[RecallTable], entry_files: Sequence[str]) -> str:
    """Returns the page of one dataset.

    Args:
        name: The dataset.
        tables: Its blocks.
        entry_files: Paths of the entries' files, relative to the page.
    """
    links = "".join(f'<li><a href="{text(_url(file))}">{text(file)}</a></li>' for file in entry_files)
    files = ("csv", "md", "tex")
    downloads = " ".join(f'<a href="{text(_url(name))}.{kind}">{kind.upper()}</a>' for kind in files)
    entries = f"<details><summary>{len(entry_files)} files</summary><ul>{links}</ul></details>"
    body = (
        f'<nav><a href="{INDEX}">All datasets</a> {downloads}</nav>\n<h1>{text(name)}</h1>\n{_INTRODUCTION}'
        + "".join(map(format_html, tables))
        + section("entries", "Entries", entries)
    )
    return html_page(f"lodbench leaderboard: {name}", body)


def index_page(counts: Mapping[str, Mapping[str, int]]) -> str:
    """Returns the page that leads to the datasets.

    Args:
        counts: Number of entries by source, by dataset.
    """
    items = "".join(
        f'<h2><a href="{text(_url(name))}.html">{text(name)}</a></h2>\n{definition_list(dict(by_source))}'
        for name, by_source in counts.items()
    )
    return html_page("lodbench leaderboard", f"<h1>lodbench leaderboard</h1>\n{_INTRODUCTION}{items}")


def _url(path: str) -> str:
    from urllib.parse import quote

    return quote(path)
