"""Pictures drawn: textures against an independent projection, looks, props."""

from dataclasses import fields, replace

import cv2
import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.citymodel.textured_map import offset_to_city, read_textured
from lodbench.errors import CityModelError, ConfigError, DatasetError, RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.kernels.looks import SurfaceClass
from lodbench.storage import random_stream
from lodbench.synthesis.camera_paths import GenerateParams
from lodbench.synthesis.generate import _texture_digests, generate_training_data
from lodbench.synthesis.objects import SceneProps, read_props, write_props
from lodbench.synthesis.photo import LookRanges, PhotoRenderer, draw_look, look_ranges
from tests.synthesis.conftest import SMALL, WHOLE
from tests.town import box_obj

CAMERA = Camera(200, 160, 190.0, 190.0, 100.0, 80.0)
POSE = Pose.from_euler(EulerAngles(35.0, 2.0, 20.0), [12.0, -45.0, 95.0])
# A square of ground, 120 m wide, with a picture on it.
SIZE_M, PIXELS = 120.0, 256


def ground_picture():
    """A smooth RGB picture in which every place has a colour of its own."""
    y, x = np.mgrid[0:PIXELS, 0:PIXELS] / (PIXELS - 1.0)
    waves = 0.5 + 0.3 * np.sin(9 * x + 4 * y)
    return (255 * np.stack([0.15 + 0.7 * x, 0.15 + 0.7 * y, waves], axis=2)).astype(np.uint8)


def write_obj(folder, shift=(0.0, 0.0, 0.0)):
    half = SIZE_M / 2
    cv2.imwrite(str(folder / "ground.png"), ground_picture()[:, :, ::-1])
    (folder / "m.mtl").write_text("newmtl ground\nmap_Kd ground.png\n")
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    lines = ["mtllib m.mtl", "usemtl ground"]
    lines += [f"v {x + shift[0]} {y + shift[1]} {shift[2]}" for x, y in corners]
    lines += [f"vt {u} {v}" for u, v in ((0, 0), (1, 0), (1, 1), (0, 1))]
    lines += ["f 1/1 2/2 3/3", "f 1/1 3/3 4/4"]
    path = folder / "mesh.obj"
    path.write_text("\n".join(lines) + "\n")
    return path


def expected_picture():
    """The ground picture seen from POSE, by the homography of the plane z = 0."""
    to_ground = np.array([[SIZE_M / PIXELS, 0, -SIZE_M / 2], [0, -SIZE_M / PIXELS, SIZE_M / 2], [0, 0, 1.0]])
    plane = np.column_stack([POSE.rotation[:, 0], POSE.rotation[:, 1], POSE.translation])
    homography = CAMERA.matrix @ plane @ to_ground
    shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    view = np.linalg.inv(shift) @ homography @ shift
    size = (CAMERA.width, CAMERA.height)
    picture = cv2.warpPerspective(ground_picture(), view, size, flags=cv2.INTER_AREA)
    covered = cv2.warpPerspective(np.ones((PIXELS, PIXELS), np.uint8), view, size, flags=cv2.INTER_NEAREST)
    return picture, cv2.erode(covered, np.ones((7, 7), np.uint8)) > 0


@pytest.fixture(scope="module")
def scene(box_file):
    return open_scene(box_file)


def test_texture_has_the_right_perspective(scene, tmp_path):
    mesh = read_textured(write_obj(tmp_path), "auto")
    renderer = PhotoRenderer(scene, threads=1, textured=mesh)
    look, _ = draw_look(replace(look_ranges("plain"), haze_range_m=(1e6, 1e6)), random_stream(0))
    seen = 255 * np.sqrt(renderer.light(CAMERA, POSE, look))
    expected, covered = expected_picture()
    assert covered.mean() > 0.4
    off = np.abs(seen - expected)[covered]
    assert off.mean() < 1.0
    assert np.percentile(off, 99) < 5.0


def test_colours_of_corners_are_kept(scene, tmp_path):
    lines = ["ply", "format ascii 1.0", "element vertex 3"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    lines += ["-500 -500 0 200 100 50", "500 -500 0 200 100 50", "0 800 0 200 100 50", "3 0 1 2"]
    path = tmp_path / "mesh.ply"
    path.write_text("\n".join(lines) + "\n")
    renderer = PhotoRenderer(scene, threads=1, textured=read_textured(path, "auto"))
    look, _ = draw_look(replace(look_ranges("plain"), haze_range_m=(1e6, 1e6)), random_stream(0))
    middle = 255 * np.sqrt(renderer.light(CAMERA, POSE, look)[80, 100])
    np.testing.assert_allclose(middle, [200, 100, 50], atol=1.0)


def test_missing_textures_are_listed(tmp_path):
    path = write_obj(tmp_path)
    (tmp_path / "ground.png").unlink()
    with pytest.raises(DatasetError, match=r"not there: ground\.png"):
        read_textured(path, "auto")
    (tmp_path / "m.mtl").unlink()
    with pytest.raises(DatasetError, match=r"not there: m\.mtl"):
        read_textured(path, "auto")


@pytest.mark.parametrize("content", ["", "v 1 2 3\n", "f 1 2 3\n"])
def test_a_broken_mesh_is_one_line(tmp_path, content):
    path = tmp_path / "mesh.obj"
    path.write_text(content)
    with pytest.raises(CityModelError, match=r"has no triangles|cannot be read as OBJ"):
        read_textured(path, "auto")


def test_the_frame_of_a_mesh_is_found_and_said(scene, tmp_path):
    far = replace(scene, origin=np.array([500000.0, 5000000.0, 0.0]))
    mesh = read_textured(write_obj(tmp_path, (500000.0, 5000000.0, 0.0)), "auto")
    offset, note = offset_to_city(mesh, far, "mesh.obj")
    np.testing.assert_array_equal(offset, -far.origin)
    assert "the city's coordinates" in note
    local = read_textured(write_obj(tmp_path), "auto")
    offset, note = offset_to_city(local, far, "mesh.obj")
    np.testing.assert_array_equal(offset, 0.0)
    assert "local coordinates" in note
    with pytest.raises(DatasetError, match="not where the city is"):
        offset_to_city(read_textured(write_obj(tmp_path, (3000.0, 0.0, 0.0)), "auto"), far, "mesh.obj")


@pytest.mark.slow
def test_pyrender_and_the_raster_agree(box_file, tmp_path):
    pytest.importorskip("pyrender")
    looks = replace(look_ranges("plain"), haze_range_m=(1e6, 1e6), noise=(0.0, 0.0), blur_px=(0.0, 0.0))
    pictures = []
    for renderer in ("raster", "pyrender"):
        params = GenerateParams(
            str(box_file),
            str(tmp_path / renderer),
            texture_model=str(write_obj(tmp_path)),
            renderer=renderer,
            format="png",
            limit=1,
            look=looks,
            **SMALL,
            **WHOLE,
        )
        try:
            made = generate_training_data(params)
        except RenderingError as error:
            pytest.skip(str(error))
        pictures.append(cv2.imread(str(next((made.out / "train" / "images").iterdir()))).astype(float))
        assert "local" in made.notes[0] or "city" in made.notes[0]
    off = np.abs(pictures[0] - pictures[1]).max(axis=2)
    assert np.median(off) <= 2.0
    assert (off > 12).mean() < 0.05


def test_a_changed_texture_makes_another_set(tmp_path):
    path = write_obj(tmp_path)
    before = _texture_digests(path)
    assert set(before) == {"mesh.obj", "m.mtl", "ground.png"}
    cv2.imwrite(str(tmp_path / "ground.png"), np.zeros((PIXELS, PIXELS, 3), np.uint8))
    after = _texture_digests(path)
    assert [name for name in before if before[name] != after[name]] == ["ground.png"]
    assert _texture_digests(tmp_path) == after


CAMERA_LOOKS = Camera(64, 64, 64.0, 64.0, 32.0, 32.0)
_SIDE, _COUNT = 20.0, 16


@pytest.fixture(scope="module")
def roofs(tmp_path_factory):
    """A renderer of sixteen flat roofs side by side, all magenta, and a pose above their middle."""
    path = tmp_path_factory.mktemp("boxes") / "city.obj"
    path.write_text(box_obj())
    scene = open_scene(path)
    corners, triangles, objects = [], [], []
    for k in range(_COUNT):
        x, y = _SIDE * (k % 4 - 2), _SIDE * (k // 4 - 2)
        first = len(corners)
        corners += [(x, y, 50), (x + _SIDE, y, 50), (x + _SIDE, y + _SIDE, 50), (x, y + _SIDE, 50)]
        triangles += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
        objects += [k, k]
    props = SceneProps(
        vertices=np.array(corners, np.float32),
        triangles=np.array(triangles, np.int32),
        surface=np.full(2 * _COUNT, SurfaceClass.ROOF_FLAT, np.uint8),
        objects=np.array(objects, np.int32),
        tint=np.full((2 * _COUNT, 3), (200, 10, 200), np.uint8),
        num_buildings=_COUNT,
        origin=scene.origin,
    )
    return PhotoRenderer(scene, props), Pose.from_euler(EulerAngles(0.0, 0.0, 0.0), [0.0, 0.0, 110.0])


def share_magenta(roofs, look):
    """Returns the share of pixels that keep the roofs' own colour."""
    renderer, pose = roofs
    red, green, blue = np.moveaxis(renderer.light(CAMERA_LOOKS, pose, look).astype(np.float64), 2, 0)
    return float(((red > 3 * green) & (blue > 3 * green)).mean())


@pytest.mark.parametrize(("repaint", "least", "most"), [(0.0, 0.95, 1.0), (0.5, 0.2, 0.8), (1.0, 0.0, 0.05)])
def test_a_share_of_objects_is_painted_anew(roofs, repaint, least, most):
    ranges = replace(look_ranges("plain"), repaint=(repaint, repaint))
    shares = [share_magenta(roofs, draw_look(ranges, np.random.default_rng(k))[0]) for k in range(4)]
    assert least <= np.mean(shares) <= most


def test_painting_anew_changes_nothing_else_of_a_look():
    plain, camera = draw_look(LookRanges(), np.random.default_rng(3))
    painted, same_camera = draw_look(LookRanges(repaint=(0.2, 0.9)), np.random.default_rng(3))
    assert 0.2 <= painted.repaint <= 0.9
    assert painted._replace(repaint=0.0) == plain
    assert same_camera == camera


def test_a_range_out_of_bounds_is_named():
    with pytest.raises(ConfigError, match=r"look\.repaint"):
        LookRanges(repaint=(0.5, 2.0))


def props_of(surfaces, origin=(0.0, 0.0, 0.0)):
    count = len(surfaces)
    return SceneProps(
        vertices=np.arange(9 * count, dtype=np.float32).reshape(-1, 3),
        triangles=np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        surface=np.array(surfaces, dtype=np.uint8),
        objects=np.arange(count, dtype=np.int32),
        tint=np.full((count, 3), 100, dtype=np.uint8),
        num_buildings=1,
        origin=np.array(origin),
    )


def test_ground_comes_first_then_buildings_then_what_stands_before_them():
    assert SurfaceClass.WATER.is_ground
    assert not SurfaceClass.WINDOW.is_ground
    of_buildings = [kind for kind in SurfaceClass if SurfaceClass.WALL <= kind < SurfaceClass.TRUNK]
    assert SurfaceClass.CHIMNEY in of_buildings
    assert not {SurfaceClass.FOLIAGE, SurfaceClass.CAR_BODY, SurfaceClass.WATER} & set(of_buildings)


def test_a_part_keeps_only_the_vertices_it_uses():
    props = props_of([SurfaceClass.ROAD, SurfaceClass.WALL, SurfaceClass.FOLIAGE])
    assert props.has_buildings
    is_wall = props.surface == SurfaceClass.WALL
    wall = props.part(is_wall)
    assert len(wall) == 1
    assert len(wall.vertices) == 3
    np.testing.assert_array_equal(wall.vertices[wall.triangles[0]], props.vertices[props.triangles[1]])
    assert not props.part(~is_wall).has_buildings


def test_props_stay_where_they_are_in_another_frame():
    far = props_of([SurfaceClass.WALL], origin=(1000.0, 0.0, 5.0))
    here = far.in_frame(np.zeros(3))
    np.testing.assert_array_equal(here.vertices, far.vertices + np.array([1000.0, 0.0, 5.0]))
    np.testing.assert_array_equal(here.in_frame(far.origin).vertices, far.vertices)


def test_a_file_gives_back_what_was_written_and_is_stable(tmp_path):
    props = props_of([SurfaceClass.CAR_BODY, SurfaceClass.GRASS])
    write_props(props, tmp_path / "a.npz")
    write_props(props, tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    again = read_props(tmp_path / "a.npz")
    for field in fields(SceneProps):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(props, field.name))


@pytest.mark.parametrize("content", [None, b"", b"no zip", b"PK\x03\x04 cut short"])
def test_a_damaged_file_is_named(tmp_path, content):
    path = tmp_path / "props.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RenderingError, match=r"props\.npz") as told:
        read_props(path)
    assert "pickle" not in told.value.message
    assert "props=FILE" in told.value.hint
