"""The documentation site builds from what is here, every page of it, and its pages ask for nothing."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import lodbench

# Every one looks at pages that are built for them.
pytestmark = pytest.mark.slow

pytest.importorskip("mkdocs")
ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return folder


def test_every_page_is_there_and_the_api_has_its_docstrings(site):
    for page in (ROOT / "docs").rglob("*.md"):
        assert (site / page.relative_to(ROOT / "docs")).with_suffix(".html").is_file(), page
    api = (site / "api.html").read_text()
    for name in ("localize", "open_scene", "run_method", "StoredRun", "Estimate", "QueryFault"):
        assert f">{name}<" in api or f'title="{name}' in api, name
    assert "cam_from_world" in api


def test_the_api_page_names_all_that_the_package_offers():
    named = re.findall(r"^::: ([\w.]+)$", (ROOT / "docs/api.md").read_text(), re.MULTILINE)
    for name in lodbench.__all__[1:]:
        home = getattr(lodbench, name).__module__
        assert {home, f"{home}.{name}"} & set(named), name


def test_no_page_asks_for_anything_from_elsewhere(site):
    asked = re.compile(r'<(?:script|link|img)[^>]+(?:src|href)="(https?://[^"]+)"')
    for page in site.rglob("*.html"):
        links = [link for link in asked.findall(page.read_text()) if "canonical" not in link]
        assert links == [], page


def test_every_picture_that_a_page_shows_is_there(site):
    for page in (ROOT / "docs").rglob("*.md"):
        for target in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text()):
            assert (page.parent / target).is_file(), (page, target)


def test_the_navigation_names_every_guide():
    text = (ROOT / "mkdocs.yml").read_text()
    for page in [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs/stories").glob("*.md")]:
        assert page.relative_to(ROOT / "docs").as_posix() in text
