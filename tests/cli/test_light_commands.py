"""Commands that compute little load little: what takes long to import is imported where it is used."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.citymodel.gml_text import box_city

# What takes a tenth of a second and more, or reads files of its own.
HEAVY = (
    "numba", "scipy", "pandas", "cv2", "hydra", "omegaconf", "matplotlib", "shapely", "torch", "pyarrow",
    "jinja2", "trimesh", "lodbench.kernels.compiled",
)  # fmt: skip
COMMANDS = {
    "--help": ("--help",),
    "run --help": ("run", "--help"),
    "run method=region --help": ("run", "method=region", "--help"),
    "run method=auto --help": ("run", "method=auto", "--help"),
    "train --help": ("train", "--help"),
    "dataset list": ("dataset", "list"),
    "dataset card": ("dataset", "card", "demo"),
    "doctor --help": ("doctor", "--help"),
    "city info": ("city", "info", "tile.gml"),
}
PACKAGES = (
    "lodbench", "lodbench.cli", "lodbench.geometry", "lodbench.citymodel", "lodbench.citymodel.cache",
    "lodbench.rendering", "lodbench.citymap", "lodbench.methods", "lodbench.methods.region",
    "lodbench.evaluation", "lodbench.execution", "lodbench.storage", "lodbench.harness",
    "lodbench.harness.doctor", "lodbench.datasets.published.catalogue",
)  # fmt: skip
PROBE = """
import sys
{code}
print("loaded:", [name for name in {heavy} if name in sys.modules], file=sys.stderr)
"""


def loaded(code: str, folder: Path) -> str:
    """Returns what some code says, and which of the heavy packages it loaded."""
    command = [sys.executable, "-c", PROBE.format(code=code, heavy=HEAVY)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stderr.strip().splitlines()[-1]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_light_command_loads_nothing_heavy(command, tmp_path):
    (tmp_path / "tile.gml").write_text(box_city())
    code = (
        f"from lodbench.cli import main\ntry:\n    code = main({COMMANDS[command]!r})\n"
        "except SystemExit as end:\n    code = end.code\nassert code == 0"
    )
    assert loaded(code, tmp_path) == "loaded: []"


def test_the_help_of_localize_loads_no_compiler(tmp_path):
    code = (
        "from lodbench.cli import main\ntry:\n    main(['localize', '--help'])\nexcept SystemExit:\n    pass"
    )
    assert loaded(code, tmp_path) == "loaded: ['scipy']"


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_loads_nothing_heavy(package, tmp_path):
    assert loaded(f"import {package}", tmp_path) == "loaded: []"


def test_the_command_line_loads_no_arrays_before_a_command_is_chosen(tmp_path):
    assert loaded("import lodbench.cli\nassert 'numpy' not in sys.modules", tmp_path) == "loaded: []"
