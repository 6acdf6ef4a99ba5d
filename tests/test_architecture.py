"""Layers import one way, heavy packages load late, and what must have one home has one."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LAYERS = [
    "errors",
    "params",
    "plugins",
    "findings",
    "storage",
    "geometry",
    "citymodel",
    "rendering",
    "datasets",
    "execution",
    "synthesis",
    "segmentation",
    "training",
    "methods",
    "evaluation",
    "reporting",
    "harness",
    "bench",
    "cli",
]
MODULES = sorted([*(ROOT / "lodbench").rglob("*.py"), *(ROOT / "baselines").rglob("*.py")])
LATE = {
    "torch",
    "pyrender",
    "open3d",
    "transformers",
    "dask",
    "OpenGL",
    "trimesh",
    "matplotlib",
    "PIL",
    "pyogrio",
    "pyarrow",
    "rasterio",
    "pooch",
    "requests",
    "rerun",
}


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def layer_of(path: Path) -> str | None:
    parts = path.relative_to(ROOT).with_suffix("").parts
    if parts[0] == "baselines":
        return "baselines"
    return parts[1] if parts[1] not in ("__init__", "__main__") else None


def imports(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            yield node.module


def module_level_imports(tree: ast.Module) -> Iterator[str]:
    for node in tree.body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield from imports(ast.Module([node], []))


@pytest.fixture(params=MODULES, ids=name_of)
def module(request: pytest.FixtureRequest) -> tuple[Path, ast.Module]:
    return request.param, ast.parse(request.param.read_text(encoding="utf-8"))


def test_imports_go_down_the_layers(module):
    path, tree = module
    mine = layer_of(path)
    if mine is None or mine == "baselines":
        return
    for name in imports(tree):
        parts = name.split(".")
        if parts[0] == "lodbench" and len(parts) > 1:
            assert parts[1] in LAYERS, f"{name} is no layer"
            assert LAYERS.index(parts[1]) <= LAYERS.index(mine), f"{mine} imports {name}"


def test_nothing_imports_the_baselines(module):
    path, tree = module
    if layer_of(path) != "baselines":
        assert not [name for name in imports(tree) if name.startswith(("lodbench.baselines", "baselines"))]


def test_hydra_stays_in_the_command_line(module):
    path, tree = module
    # Settings become parameters in one place, for callers without a command line too.
    kept_out = {"cli": (), "params": ("hydra",)}.get(str(layer_of(path)), ("hydra", "omegaconf"))
    assert not [name for name in imports(tree) if name.split(".")[0] in kept_out]


def test_heavy_packages_are_imported_where_they_are_used(module):
    path, tree = module
    late = LATE - {"torch"} if path.parent.name == "nets" else LATE
    assert not [name for name in module_level_imports(tree) if name.split(".")[0] in late]


def test_networks_are_imported_where_they_are_used(module):
    # Their modules import torch at the top, so nobody else may import them there.
    path, tree = module
    if path.parent.name != "nets":
        assert not [name for name in module_level_imports(tree) if ".nets" in name]


def test_nothing_prints_unpickles_or_parses_xml_elsewhere(module):
    path, tree = module
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id not in ("print", "eval", "exec"), f"line {node.lineno}"
    for name in imports(tree):
        assert name.split(".")[0] not in ("pickle", "dill", "joblib", "marshal", "shelve"), name
        # Escaping text for writing is no parsing.
        if name.startswith(("lxml", "xml.")) and name != "xml.sax.saxutils":
            assert path.parent.name == "citymodel", name
            assert path.name.startswith(("xml", "gml", "citygml")), name


def test_the_list_of_packages_is_the_tree():
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = set()
    for folder, package in (
        ("lodbench", "lodbench"),
        ("baselines", "lodbench.baselines"),
        ("conf", "lodbench.conf"),
    ):
        for path in [*(ROOT / folder).rglob("*.py"), *(ROOT / folder).rglob("*.yaml")]:
            parts = path.parent.relative_to(ROOT / folder).parts
            found.add(".".join([package, *parts]))
    assert listed == found


def test_entry_points_can_be_loaded():
    from importlib.metadata import entry_points

    groups = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    for group, points in groups.items():
        installed = {point.name: point for point in entry_points(group=group)}
        for name in points:
            assert installed[name].load() is not None


def test_the_public_names_load():
    import lodbench

    for name in lodbench.__all__:
        assert getattr(lodbench, name) is not None
    with pytest.raises(AttributeError):
        lodbench.no_such_name  # noqa: B018
