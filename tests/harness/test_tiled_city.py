"""Many tiles as one scene: the city as read at once, wherever it is made and however often it is killed."""

import os
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, mesh_model, read_city_model
from lodbench.citymodel.scene_file import read_scene, scene_info
from lodbench.errors import CityModelError
from lodbench.execution.executor import ExecutorParams
from lodbench.harness.city import compile_tiles
from tests.citymodel.gml_text import box_rings, city, member, solid_of, write


def tile(n: int, lod: int = 1) -> str:
    """Two boxes of a row of tiles; their ids name their tile."""
    boxes = (solid_of(box_rings(500000.0 + 100 * n + 20 * k), lod) for k in range(2))
    return city("".join(member(box, f"t{n}-{k}") for k, box in enumerate(boxes)))


@pytest.fixture
def tiles(tmp_path: Path) -> Path:
    folder = tmp_path / "tiles"
    folder.mkdir()
    for n in range(12):
        write(folder / f"{n:02d}.gml", tile(n))
    write(folder / "roads.gml", city("<core:cityObjectMember><x/></core:cityObjectMember>"))
    return folder


def assert_is(folder: Path, tiles: Path, lod: str | None = None) -> None:
    """The scene in a folder is that of all tiles read at once, corners to the last bit but one of float32."""
    whole = mesh_model(read_city_model(tiles), lod).scene
    scene, _ = read_scene(folder)
    assert (scene.building_ids, scene.lod, scene.crs) == (whole.building_ids, whole.lod, whole.crs)
    assert scene.origin.tolist() == whole.origin.tolist()
    for name in ("triangles", "vertex_starts", "triangle_starts"):
        np.testing.assert_array_equal(getattr(scene, name), getattr(whole, name))
    np.testing.assert_array_max_ulp(np.asarray(scene.vertices), whole.vertices, maxulp=1)


@pytest.mark.parametrize(
    "executor",
    [
        ExecutorParams(),
        ExecutorParams("process", 2),
        pytest.param(ExecutorParams("dask", 2), marks=pytest.mark.slow),
    ],
    ids=["serial", "process", "dask"],
)
def test_as_read_at_once(tiles: Path, tmp_path: Path, executor: ExecutorParams) -> None:
    if executor.name == "dask":
        pytest.importorskip("distributed", reason="it comes with the extra [cluster]")
    steps: list[tuple[int, int]] = []
    compile_tiles(tiles, tmp_path / "a.scene", executor=executor, progress=lambda *step: steps.append(step))
    assert_is(tmp_path / "a.scene", tiles)
    assert steps[-1] == (13, 13)
    assert not (tmp_path / "a.scene.parts").exists()
    reported = scene_info(tmp_path / "a.scene")
    assert (reported["buildings"], reported["tiles"], reported["triangles"]) == (24, 13, 24 * 12)
    assert reported["extent_m"] == [1130.0, 10.0, 6.0]
    assert reported["findings"]["LB211 FILE_SKIPPED"] == 1


def test_an_archive(tiles: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "city.zip", "w") as archive:
        for file in sorted(tiles.iterdir()):
            archive.write(file, file.name)
    compile_tiles(tmp_path / "city.zip", tmp_path / "a.scene")
    assert_is(tmp_path / "a.scene", tiles)


def test_one_level_for_all_tiles(tiles: Path, tmp_path: Path) -> None:
    write(tiles / "03.gml", tile(3, lod=2))
    compile_tiles(tiles, tmp_path / "a.scene")
    assert_is(tmp_path / "a.scene", tiles)  # level 1, which tile 3 has nothing of
    compile_tiles(tiles, tmp_path / "b.scene", lod="finest")
    assert_is(tmp_path / "b.scene", tiles, "finest")
    with pytest.raises(CityModelError, match="level of detail 3"):
        compile_tiles(tiles, tmp_path / "c.scene", lod="3")


def test_tiles_of_several_systems_go_to_the_first(tiles: Path, tmp_path: Path) -> None:
    text = tile(5).replace("EPSG:25832", "EPSG:25833")
    write(tiles / "05.gml", text)
    compile_tiles(tiles, tmp_path / "a.scene", options=ReadOptions(is_strict=False))
    assert scene_info(tmp_path / "a.scene")["findings"]["LB307 CRS_MIXED"] == 1


def test_one_id_in_two_tiles(tiles: Path, tmp_path: Path) -> None:
    write(tiles / "04.gml", tile(4).replace("t4-0", "t3-0"))
    compile_tiles(tiles, tmp_path / "a.scene")
    scene, _ = read_scene(tmp_path / "a.scene")
    assert "t3-0~2" in scene.building_ids
    assert scene_info(tmp_path / "a.scene")["findings"]["LB205 DUPLICATE_ID"] == 1


_KILLED = """
import sys, time
from pathlib import Path
from lodbench.harness import city
meshed = city._mesh_tile
def slowly(job, source):
    time.sleep(0.05)
    return meshed(job, source)
city._mesh_tile = slowly
city.compile_tiles(Path(sys.argv[1]), Path(sys.argv[2]))
"""


def test_a_kill_loses_the_tile_at_work_only(tiles: Path, tmp_path: Path) -> None:
    target = tmp_path / "a.scene"
    parts = tmp_path / "a.scene.parts"
    words = [sys.executable, "-c", _KILLED, str(tiles), str(target)]
    process = subprocess.Popen(words)  # this interpreter, with a script of ours
    limit = time.monotonic() + 60
    while len(list(parts.glob("*/*/scene.json"))) < 4 and time.monotonic() < limit:
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert not target.exists()
    made = {path: path.stat().st_mtime_ns for path in parts.glob("*/*/scene.json")}
    assert 4 <= len(made) < 14
    stopped = CityModelError("stop")

    def stop(done: int, total: int) -> None:
        if done == total:
            raise stopped

    with pytest.raises(CityModelError, match="stop"):
        compile_tiles(tiles, target, progress=stop)
    assert {path: path.stat().st_mtime_ns for path in made} == made  # found again, not made again
    write(tiles / "02.gml", tile(2).replace("t2-1", "new"))
    compile_tiles(tiles, target)
    assert_is(target, tiles)  # a tile that changed since is read again
