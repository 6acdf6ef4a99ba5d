"""The stories of docs/stories, told by their own commands, as a reader would type them."""

import csv
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

from lodbench.cli import main
from lodbench.photos.map_frame import MapFrame
from tests.flight import write_flight
from tests.tracing_case import write_case

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
FILE = re.compile(r"```\w+\n# ([\w./]+)\n(.*?)```", re.DOTALL)
COMMANDS = re.compile(r"```sh\n(.*?)```", re.DOTALL)


def tell(story: str, folder: Path, binaries: Path | None = None, less: dict[str, str] | None = None) -> str:
    """Writes a story's files and runs its commands until the first fault; returns what they said.

    Args:
        story: Its name.
        folder: Where.
        binaries: Of the environment; those of the one that runs this.
        less: Words of its commands, each by one that asks for less of the same.
    """
    text = (ROOT / "docs" / "stories" / f"{story}.md").read_text()
    for word, other in (less or {}).items():
        assert word in text
        text = text.replace(word, other)
    for name, content in FILE.findall(text):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)
    script = "set -euo pipefail\n" + "".join(COMMANDS.findall(text))
    path = f"{binaries or Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "COV_"))}
    done = subprocess.run(
        ["bash", "-c", script],
        cwd=folder,
        env={**kept, "PATH": path},
        capture_output=True,
        text=True,
        timeout=1200,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


@pytest.mark.nightly
def test_a_flight_of_one_s_own(tmp_path, shared_data):
    city = shared_data / "city/germany_lod2/LoD2_32_280_5657_1_NW.gml"
    shutil.copy(city, tmp_path / "city.gml")
    views = tmp_path / "views"
    words = ["size=[768,768]", "limit=6", "val_share=0", "test_share=0", "pitch=[30]", "height=[80]"]
    assert main(["generate-training-data", f"city={city}", f"out={views}", "min_buildings=0.12", *words]) == 0
    truth = write_flight(views / "train", tmp_path / "flight", "EPSG:25832+7837")
    (tmp_path / "masks").mkdir()
    for name, mask in zip(truth, sorted((views / "train" / "masks").iterdir()), strict=True):
        shutil.copy(mask, tmp_path / "masks" / f"{Path(name).stem}.png")
    said = tell("flight", tmp_path)
    assert "6 photos: 6 good" in said
    frame = MapFrame("EPSG:25832+7837")
    with (tmp_path / "found-by-masks" / "localized.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    for row, (name, pose) in zip(rows, truth.items(), strict=True):
        assert row["photo"] == f"flight/{name}"
        east, north = frame.east_north(float(row["latitude_deg"]), float(row["longitude_deg"]))
        off = ((east - pose.center[0]) ** 2 + (north - pose.center[1]) ** 2) ** 0.5
        assert off < 2.0 or row["trust"] == "do not trust"
    assert sum(row["trust"] == "good" for row in rows) >= 4
    for name in ("compared.html", "flight.csv", "flight.geojson", "flight.gpkg", "metashape.txt", "geo.txt"):
        assert (tmp_path / name).stat().st_size > 100
    assert (tmp_path / "geo.txt").read_text().startswith("EPSG:25832")


@pytest.fixture
def environment(tmp_path: Path) -> Path:
    """The binaries of an environment of its own, whose pip installs without fetching anything."""
    folder = tmp_path / "env"
    venv.create(folder, with_pip=False)
    (site,) = folder.glob("lib/python*/site-packages")
    # What is installed here, lodbench's checkout too.
    paths = {sysconfig.get_paths()["purelib"], *(p for p in sys.path if p.endswith("site-packages"))}
    (site / "here.pth").write_text(
        "".join(f"import site; site.addsitedir({path!r})\n" for path in sorted(paths))
    )
    pip = f'exec "{sys.executable}" -m pip --python "{folder / "bin" / "python"}"'
    shims = {
        "pip": f'{pip} "$1" -q --no-index --no-deps --no-build-isolation "${{@:2}}"',
        "lodbench": f'exec "{folder / "bin" / "python"}" -m lodbench "$@"',
    }
    for name, line in shims.items():
        (folder / "bin" / name).write_text(f"#!/bin/bash\n{line}\n")
        (folder / "bin" / name).chmod(0o755)
    return folder / "bin"


def test_a_new_method(tmp_path, environment):
    said = tell("method", tmp_path, environment, {"dataset=demo": "dataset=demo dataset.num_queries=9"})
    assert "finished" in said
    assert "shake tries=1024" in (tmp_path / "compared.html").read_text()
    assert "tabular" in (tmp_path / "table.tex").read_text()
    assert "shake" in (tmp_path / "board" / "demo.html").read_text()
    assert "1. contour" in (tmp_path / "board" / "demo.md").read_text()


@pytest.mark.nightly
def test_a_new_network(tmp_path, shared_data):
    shutil.copy(shared_data / "city/plateau/53395404_bldg_6697_op.gml", tmp_path / "city.gml")
    said = tell("network", tmp_path, less={"schedule.epochs=3": "schedule.epochs=1"})
    assert "val IoU" in said
    assert (tmp_path / "net" / "compact.onnx").is_file()


def test_a_benchmark_from_a_real_flight(tmp_path):
    write_case(tmp_path)
    said = tell("real-benchmark", tmp_path)
    assert "block 5: roof 40." in said
    assert "written: town, 6 photos not used for the map" in said
    assert said.count("area IoU 0.9") + said.count("area IoU 1.0") >= 20
    assert (tmp_path / "town" / "city.obj").is_file()
