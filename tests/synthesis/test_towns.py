"""Built-in towns: names, caching, and the survey years before the photos."""

import ast
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lodbench
from lodbench.cli import main
from lodbench.cli.training import with_demo
from lodbench.datasets.inputs import Input, inputs_of, with_inputs
from lodbench.datasets.query import Dataset
from lodbench.synthesis import demo
from lodbench.synthesis import surveys as baking
from lodbench.synthesis.camera_paths import GenerateParams
from lodbench.synthesis.demo import LABEL_CODE, MAP_CODE, DemoParams, open_demo
from lodbench.synthesis.surveys import baked, corner_light, lay_out_faces, lay_out_ground
from lodbench.synthesis.town import build
from lodbench.synthesis.town.build import DEMO_CODE, code_digest


@pytest.fixture
def asked(monkeypatch, tmp_path):
    """Collects which towns are wanted instead of building them."""
    towns = []

    def folder(params):
        towns.append((params.look, params.town_seed))
        return tmp_path

    monkeypatch.setattr(demo, "demo_folder", folder)
    return towns


@pytest.mark.parametrize(
    ("city", "lod", "town", "file", "level"),
    [
        ("demo", None, ("train", 1), "town.gml", "2"),
        ("demo:7", None, ("train", 7), "town.gml", "2"),
        ("demo:7", "3", ("train", 7), "town_lod3.gml", "3"),
        ("demo:test", "3", ("test", 0), "town_lod3.gml", "3"),
    ],
)
def test_towns_are_named_by_seed(asked, tmp_path, city, lod, town, file, level):
    params = with_demo(GenerateParams(city=city, out="set", lod=lod))
    assert asked == [town]
    assert (params.city, params.lod) == (str(tmp_path / file), level)
    assert params.props == str(tmp_path / "props.npz")


def test_another_city_stays_as_it_is(asked):
    params = GenerateParams(city="demolition.gml", out="set")
    assert with_demo(params) == params
    assert not asked


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("sheet=0", "sheet=0 is not within 16 to 2048"),
        ("texture_model=mesh.obj", "texture_model is not used with city=demo,"),
    ],
)
def test_no_town_is_built_for_settings_that_are_wrong(asked, tmp_path, capsys, word, told):
    assert main(["generate-training-data", "city=demo", f"out={tmp_path / 'o'}", word]) == 2
    assert told in capsys.readouterr().err
    assert not asked


def test_an_unknown_town_is_named(tmp_path, capsys):
    assert main(["generate-training-data", "city=demo:old", f"out={tmp_path / 'o'}"]) == 2
    message = capsys.readouterr().err
    assert "demo:old" in message
    assert "demo:SEED" in message


PACKAGE = Path(lodbench.__file__).parent


def files_of(*patterns: str) -> set[Path]:
    return {file for pattern in patterns for file in PACKAGE.glob(pattern)}


def imported_by(file: Path) -> set[Path]:
    nodes = ast.walk(ast.parse(file.read_text()))
    names = {node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module}
    # What a z-buffer is, and how functions are compiled, says nothing of a picture.
    plain = {f"lodbench.kernels.{name}" for name in ("arguments", "compiled")}
    of = ("lodbench.synthesis.", "lodbench.kernels.")
    own = [name.split(".")[1:] for name in names - plain if name.startswith(of)]
    return {file for file in (PACKAGE.joinpath(*name).with_suffix(".py") for name in own) if file.exists()}


@pytest.mark.parametrize("code", [DEMO_CODE, (*DEMO_CODE, *MAP_CODE), (*DEMO_CODE, *LABEL_CODE)])
def test_a_change_of_any_code_that_draws_it_gives_it_another_name(monkeypatch, code):
    assert all(map(files_of, code))  # no pattern names a file that moved
    # The module of the dataset calls what makes either.
    python = {file for file in files_of(*code) if file.suffix == ".py" and file.name != "demo.py"}
    assert set().union(*map(imported_by, python)) <= python
    digests = {code_digest.__wrapped__(*code)}
    for changed in files_of(*code):
        monkeypatch.setattr(build, "file_digest", lambda file, changed=changed: f"{file} {file == changed}")
        digests.add(code_digest.__wrapped__(*code))
    assert len(digests) == 1 + len(files_of(*code))


@given(
    st.lists(st.tuples(st.integers(5, 300), st.integers(5, 200)).map(np.array), min_size=1, max_size=40).map(
        np.array
    )
)
def test_packed_rectangles_do_not_overlap_and_fit(sides):
    places, height = baking._packed(sides)
    sheet = np.zeros((height, baking._ATLAS_WIDTH), np.int8)
    for (x, y), (width, tall) in zip(places, sides, strict=True):
        assert x + width <= baking._ATLAS_WIDTH
        sheet[y : y + tall, x : x + width] += 1
    assert sheet.max() == 1
    assert sheet.sum() == sides.prod(axis=1).sum()


def wall(west, east, base, top):
    """Two triangles of a wall that looks south."""
    a, b, c, d = (west, 0, base), (east, 0, base), (east, 0, top), (west, 0, top)
    return np.array([[a, b, c], [a, c, d]], float)


def test_faces_keep_their_shape_and_small_ones_are_left_out():
    corners = np.concatenate([wall(0, 12, 2, 8), wall(20, 21, 0, 1), wall(30, 37, 1, 5)])
    layout = lay_out_faces(corners, np.arange(6), np.repeat([0, 1, 2], 2))
    assert layout.triangle.tolist() == [0, 1, 4, 5]
    for triangle, texels in zip(layout.triangle, layout.texels, strict=True):
        for i, j in ((0, 1), (1, 2), (2, 0)):
            metres = np.linalg.norm(corners[triangle, i] - corners[triangle, j])
            assert np.linalg.norm(texels[i] - texels[j]) * layout.texel_m == pytest.approx(metres)


def test_ground_lies_as_a_map_does_and_what_hangs_over_is_left_out():
    corners = np.array(
        [[(10, 10, 3), (40, 10, 3), (10, 40, 5)], [(80, 80, 0), (120, 80, 0), (80, 90, 0)]], float
    )
    layout = lay_out_ground(corners, np.arange(2), (0.0, 0.0, 100.0))
    assert layout.triangle.tolist() == [0]
    # North is up: the northern corner has the smallest row.
    assert layout.texels[0, 2, 1] < layout.texels[0, 0, 1] == layout.texels[0, 1, 1]
    assert (layout.texels[0, 1, 0] - layout.texels[0, 0, 0]) * layout.texel_m == pytest.approx(30.0)


def shading_of(corners, surface):
    from lodbench.synthesis.objects import SceneProps
    from lodbench.synthesis.photo import make_skin, plain_shading
    from lodbench.synthesis.surveys import survey_look

    count = len(corners)
    props = SceneProps(
        corners.reshape(-1, 3).astype(np.float32),
        np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        np.full(count, surface, np.uint8),
        np.zeros(count, np.int32),
        np.full((count, 3), (200, 120, 80), np.uint8),
        1,
        np.zeros(3),
    )
    look, _ = survey_look(0)
    return plain_shading(make_skin(props), look)


@pytest.mark.slow
def test_a_picture_shows_at_a_place_what_the_place_looks_like():
    from lodbench.kernels.looks import SurfaceClass

    corners = wall(0, 12, 2, 8)
    shading = shading_of(corners, SurfaceClass.WALL)
    layout = lay_out_faces(corners, np.arange(2), np.zeros(2, int))
    light = baked(layout, corners, shading)
    corner = corner_light(np.arange(2), corners, shading)
    # The wall is 60 x 30 texels, painted up to two further.
    assert 60 * 30 <= (light > 0).all(axis=2).sum() <= 64 * 34
    for texels, seen in zip(layout.texels.reshape(-1, 2), corner.reshape(-1, 3), strict=True):
        column, row = np.clip(texels.astype(int), 0, (light.shape[1] - 1, light.shape[0] - 1))
        assert light[row, column] == pytest.approx(seen, rel=0.5)


def test_what_is_made_on_demand_is_made_for_who_asks_only(tmp_path):
    asked = []

    def make():
        asked.append(1)
        return tmp_path / "map.glb"

    dataset = Dataset("d", "", tmp_path, None, None, (), (), {}, on_demand={Input.TEXTURED_MAP: make})
    assert Input.TEXTURED_MAP in inputs_of(dataset, ())
    assert with_inputs(dataset, {Input.MASK}).textured_map is None
    assert not asked
    assert with_inputs(dataset, {Input.TEXTURED_MAP}).textured_map == tmp_path / "map.glb"


@pytest.mark.nightly
def test_the_map_is_the_town_as_it_was_the_same_each_time(tmp_path, monkeypatch):
    from lodbench.citymap import CityMap
    from lodbench.citymodel import open_scene
    from lodbench.citymodel.textured_map import open_textured_map
    from lodbench.synthesis.surveys import write_textured_map
    from tests.town import town_of

    dataset = open_demo(DemoParams(num_queries=9))
    town = town_of(0)
    scene = open_scene(dataset.city_model, lod="1")
    first, again = tmp_path / "a.glb", tmp_path / "b.glb"
    write_textured_map(first, town, scene)
    write_textured_map(again, town, scene)
    assert first.read_bytes() == again.read_bytes()
    entry = dataset.entries[5]
    pose = dataset.truth[entry.key].shifted(-scene.origin)
    camera = entry.camera.scaled(301, 224)
    city_map = CityMap(scene, textured=open_textured_map(first, scene))
    depth = city_map.surface_depth(camera, pose.rotation[None], pose.center[None])[0]
    plain = city_map.depth(camera, pose.rotation[None], pose.center[None])[0]
    both = (depth > 0) & (plain > 0)
    # Blocks end between eaves and ridge: most surfaces are within a storey of the model's.
    assert np.median(np.abs(depth - plain)[both]) < 3.0
    assert (depth > 0).mean() > 0.95
