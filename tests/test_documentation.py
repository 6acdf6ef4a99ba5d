"""What pages say of the code is so: equations it cites, settings, names, layers, and where things are."""

import importlib.util
import re
from collections import Counter
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

from lodbench.methods.contour_alignment.likelihood import TRACKS
from lodbench.plugins import load_plugin
from tests.test_architecture import LAYERS

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((ROOT / "docs/methods").glob("*.md"))
# Eq. (R4) of docs/methods/region.md; Eqs. (C6), (C7) of ...: wherever the line breaks.
CITED = re.compile(r"Eqs?\.\s+((?:\(\w+\)(?:,\s+)?)+)\s+of\s+docs/methods/(\w+)\.md")
NUMBER = re.compile(r"\(([A-Z]\d+)\)")


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / f"docs/{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def equations() -> ModuleType:
    return script("equations")


def numbered(module: ModuleType) -> list[tuple[str, str]]:
    """Returns page and number of each equation."""
    texts = {page.stem: page.read_text("utf-8") for page in PAGES}
    return [
        (stem, tag)
        for stem, text in texts.items()
        for block in module.BLOCK.findall(text)
        for tag in module.TAG.findall(block)
    ]


def cited() -> set[tuple[str, str]]:
    found = set()
    for path in (ROOT / "lodbench").rglob("*.py"):
        for numbers, page in CITED.findall(path.read_text("utf-8")):
            found |= {(page, number) for number in NUMBER.findall(numbers)}
    return found


def test_code_cites_every_equation_and_no_other(equations):
    there = numbered(equations)
    assert len(there) > 70
    assert {number: many for number, many in Counter(there).items() if many > 1} == {}
    assert set(there) - cited() == set()
    assert cited() - set(there) == set()


def test_numbers_run_from_1_in_the_order_of_the_page(equations):
    for page in PAGES:
        tags = [tag for stem, tag in numbered(equations) if stem == page.stem]
        assert tags == [f"{tags[0][0]}{k}" for k in range(1, len(tags) + 1)]


def test_text_names_no_equation_that_is_not_there(equations):
    there = {tag for _, tag in numbered(equations)}
    for page in PAGES:
        text = equations.BLOCK.sub("", page.read_text("utf-8"))
        assert set(re.findall(r"\(([MLCRF]\d+)\)", text)) <= there, page


def test_equations_are_drawn_with_their_number_and_without_a_script(equations):
    for page in PAGES:
        text = page.read_text("utf-8")
        count = len(equations.BLOCK.findall(text))
        assert count == text.count("```math")
        drawn = equations.on_page_markdown(text)
        assert "```math" not in drawn
        assert "<script" not in drawn
        assert drawn.count("<svg") == count
        for tag in (tag for stem, tag in numbered(equations) if stem == page.stem):
            assert drawn.count(f'<div id="{tag.lower()}"') == 1
            assert f"<span>({tag})</span>" in drawn


@pytest.mark.parametrize("method", ["contour_alignment", "flight", "lodlocv2", "region"])
def test_tables_have_the_settings_there_are_and_their_defaults(method):
    """Rows of "Priors and settings" name a setting or several in backquotes, and their defaults in order."""
    page = ROOT / f"docs/methods/{method}.md"
    defaults = {each.name: each.default for each in fields(load_plugin("methods", method).params_type)}
    stated: dict[str, str] = {}
    for line in (
        page.read_text("utf-8").partition("ettings\n\n| symbol")[2].partition("\n## ")[0].splitlines()
    ):
        cells = [cell.strip() for cell in line.split("|")]
        names = re.findall(r"`(\w+)`", cells[2]) if len(cells) > 4 else []
        values = [value.strip() for value in cells[3].split(",")] if names else []
        # One default for all that a row names, or one for each.
        stated |= dict(zip(names, values if len(values) == len(names) else values * len(names), strict=True))
    assert stated.keys() <= defaults.keys()
    for name, value in stated.items():
        assert value.strip("`") == shown(defaults[name]), name
    # All that are searched or weighed by, but for sizes and names that the page's text has.
    assert defaults.keys() - stated.keys() <= NOT_IN_TABLES[page.stem]


def test_the_table_of_worlds_is_that_of_the_code():
    text = (ROOT / "docs/methods/contour_alignment.md").read_text("utf-8")
    rows = re.findall(
        r"^\| ([a-z, ]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| (\S+) ± (\S+) \| (\S+) ± (\S+) \|$",
        text,
        re.M,
    )
    worlds = {world.name: world for track, _ in TRACKS for world in track}
    assert [name for name, *_ in rows] == list(worlds)
    for name, *numbers in rows:
        world = worlds[name]
        assert world.roof_m == world.part_m
        stated = world.odds, world.roof_m, world.base_m, *world.roofs_m, *world.bases_m
        assert tuple(map(float, numbers)) == stated, name


# Sizes of pictures, names, and what the text says.
NOT_IN_TABLES = {
    "contour_alignment": {"name", "coarse_size", "fine_size", "search", "spacing_px"},
    "flight": {"name", "relative_poses"},
    "lodlocv2": {"name"},
    "region": {"name", "coarse_width", "fine_width", "edge_blur_px"},
}


def shown(default: object) -> str:
    """Returns a default as the tables have it."""
    if isinstance(default, bool):
        return "on" if default else "off"
    if isinstance(default, tuple):
        return " x ".join(map(str, default))
    return f"{default:g}" if isinstance(default, float) else str(default)


def test_names_that_the_glossary_explains_are_in_the_code():
    table = (ROOT / "docs/concepts.md").read_text("utf-8").partition("### Names in code and settings")[2]
    names = [
        name
        for row in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)
        for name in re.findall(r"`(\w+)`", row)
    ]
    code = "\n".join(path.read_text("utf-8") for path in (ROOT / "lodbench").rglob("*.py"))
    known = set(re.findall(r"\w+", code))
    assert len(names) > 30
    assert [name for name in names if name not in known] == []
    assert len(set(names)) == len(names)


def test_the_glossary_is_in_the_order_of_the_alphabet():
    text = (ROOT / "docs/concepts.md").read_text("utf-8").partition("## Glossary")[2].partition("### ")[0]
    terms = [row.strip("`").lower() for row in re.findall(r"^\| (.*?) \|", text, re.MULTILINE)[1:]]
    assert len(terms) > 50
    assert terms == sorted(terms, key=lambda term: re.sub(r"[^a-z0-9]+", " ", term))


def test_the_picture_of_the_layers_is_that_of_the_layers():
    drawing = script("draw_architecture")
    shown = [layer for row in drawing.ROWS for layer in row.layers]
    assert shown[::-1] == LAYERS
    assert drawing.OUT.read_text("utf-8") == drawing.drawn()


def test_the_steps_in_the_picture_are_those_of_the_lists():
    text = (ROOT / "docs/architecture.md").read_text("utf-8")
    drawing = script("draw_architecture")
    for title, column in (("lodbench run", "run"), ("lodbench localize", "photo")):
        steps = re.findall(
            r"^(\d+)\. ", text.partition(f"through `{title}`")[2].partition("\n## ")[0], re.MULTILINE
        )
        numbered = {number for row in drawing.ROWS for number in re.findall(r"\d+", getattr(row, column))}
        assert numbered == set(steps)


def test_what_pages_import_is_there():
    """In code and in entry points of pages: names move, and a reader's copy must run."""
    found = 0
    for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        text = page.read_text("utf-8")
        names = re.findall(r"^from (lodbench[\w.]*) import ([\w, ]+)$", text, re.MULTILINE)
        names += re.findall(r'"(lodbench(?:\.\w+)+):(\w+)"', text)
        for module, imported in names:
            for name in imported.replace(" ", "").split(","):
                assert hasattr(import_module(module), name), (page.name, module, name)
                found += 1
    assert found > 20


@pytest.mark.parametrize("page", ["docs/architecture.md", *(f"docs/methods/{page.name}" for page in PAGES)])
def test_files_and_names_that_a_page_points_to_are_there(page):
    text = (ROOT / page).read_text("utf-8")
    paths = re.findall(r"`((?:lodbench|conf|docs|baselines|tests)/[\w./]*)`", text)
    assert paths
    assert [path for path in paths if not (ROOT / path).exists()] == []
    for name, path in re.findall(r"`(_?[A-Z][A-Z_]+)`, `(lodbench/[\w/]+\.py)`", text):
        assert re.search(rf"^{name}\b", (ROOT / path).read_text("utf-8"), re.MULTILINE), (name, path)
