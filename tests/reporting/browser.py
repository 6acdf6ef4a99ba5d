"""A real headless Chromium for tests of pages."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# WebGL without a graphics card.
_SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
PHONE = {"width": 390, "height": 844}
DESK = {"width": 1280, "height": 900}


@contextmanager
def opened(
    shown: Path | str, size: dict[str, int] = DESK, scheme: str = "light", has_touch: bool = False
) -> Iterator[tuple[Any, list[str]]]:
    """Opens a page from disk without a network, or one that this machine serves.

    Args:
        shown: The page's file, or the address that it is served at.
        size: Of the window.
        scheme: Of its colours.
        has_touch: Whether it is used with fingers.

    Yields:
        The page, and everything it complains about: requests that leave its file or address as well.
    """
    sync_api = pytest.importorskip("playwright.sync_api")
    binary = next(filter(None, map(shutil.which, _NAMES)), None)
    if binary is None:
        pytest.skip("there is no Chromium on this machine (apt-get install chromium)")
    complaints: list[str] = []
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=binary, args=["--no-sandbox", *_SOFTWARE_GL])
        is_file = isinstance(shown, Path)
        address = shown.resolve().as_uri() if isinstance(shown, Path) else shown
        within = ("file:", "data:") if is_file else (address, "blob:", "data:")
        page = browser.new_context(
            viewport=size, color_scheme=scheme, offline=is_file, has_touch=has_touch, is_mobile=has_touch
        ).new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: complaints.extend(_asked(request.url, within)))
        page.goto(address)
        yield page, complaints
        browser.close()


def column_texts(page: Any, table: int, column: int) -> list[str]:
    """Returns the cells of a column of a page's table, top to bottom."""
    rows = page.locator("table").nth(table).locator("tbody tr")
    texts = rows.evaluate_all("(all, c) => all.map(r => r.cells[c].innerText)", column)
    return [str(text).strip() for text in texts]


def press(page: Any, table: int, column: int) -> None:
    """Presses the head of a column."""
    page.locator("table").nth(table).locator("thead tr:last-child th").nth(column).locator("button").click()


def fits(page: Any) -> bool:
    """Tells whether nothing sticks out sideways."""
    return bool(page.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth"))


def _asked(url: str, within: tuple[str, ...]) -> list[str]:
    return [] if url.startswith(within) else [f"asked for {url}"]
