"""The city and its cameras: from above, and in three dimensions in a real browser without a network."""

import base64
import gzip
import hashlib
import json
import re
from importlib.resources import files

import numpy as np
import pytest

from lodbench.citymodel.scene import build_scene
from lodbench.reporting import maps as view3d
from lodbench.reporting.maps import Spot, ViewedCamera, draw_map, draw_view3d, photo_jpeg
from lodbench.reporting.page import markup, rendered
from tests.reporting.browser import DESK, PHONE, fits, opened
from tests.town import BOXES, CAMERA, true_poses


@pytest.mark.parametrize(("count", "classes"), [(199, "map"), (200, "map many"), (1000, "map many crowd")])
def test_many_cameras_are_drawn_smaller(count, classes):
    spots = [Spot(f"a/{n}", np.array([n, 0.0]), np.array([n, 5.0]), None) for n in range(count)]
    assert re.match('<div class="([^"]*)"', draw_map(spots, None, None))[1] == classes


@pytest.mark.slow
def test_cameras_grow_as_one_comes_closer(tmp_path):
    places = np.random.default_rng(0).uniform(0, 900, size=(1000, 2))
    drawn = draw_map([Spot(f"a/{n}", None, place, None) for n, place in enumerate(places)], None, None)
    reported = {"differences": [], "is_weak": False, "has_truth": True, "answered": "", "untrusted": ""}
    sections = [("places", "From above", markup(drawn), [])]
    page_file = tmp_path / "page.html"
    page_file.write_text(rendered("run.html.jinja", title="x", protocol="", sections=sections, **reported))
    with opened(page_file) as (page, complaints):
        buttons, seen = page.locator(".map button"), []
        for _ in range(7):
            seen.append(page.locator(".map").get_attribute("class"))
            buttons.first.click()
        buttons.last.click()
        assert list(dict.fromkeys(seen)) == ["map many crowd", "map many", "map"]
        assert page.locator(".map").get_attribute("class") == "map many crowd"
        assert complaints == []


class Blank:
    """Imagery of nothing."""

    name = "dop.tif"

    def within(self, low, high):
        return np.zeros((4, 4, 4), np.uint8)


def test_on_imagery_roofs_have_outlines_without_the_edges_between_their_triangles():
    # A roof of four corners above its floor, a wall between, and a second roof that shares no corner.
    roof = [(0, 0, 9), (10, 0, 9), (10, 6, 9), (0, 6, 9)]
    floor = [(x, y, 0) for x, y, _ in roof]
    vertices = np.array([*roof, *floor, (20, 0, 5), (26, 0, 5), (20, 4, 5)], float)
    triangles = np.array([(0, 1, 2), (0, 2, 3), (4, 6, 5), (4, 7, 6), (0, 4, 5), (8, 9, 10)], np.int32)
    spots = [Spot("a", None, np.array([5.0, 3.0]), None)]
    assert "outline" not in draw_map(spots, vertices, triangles)
    drawn = draw_map(spots, vertices, triangles, imagery=Blank())
    path = re.search(r'id="city-outline" d="([^"]+)"', drawn)[1]
    ends = [tuple(float(number) for number in re.findall(r"-?[\d.]+", line)) for line in path.split("M")[1:]]
    west, south = 5.0 - 40.0, 3.0 - 40.0  # the map's corner; y counts downwards
    found = {frozenset([(a + west, south - b), (c + west, south - d)]) for a, b, c, d in ends}
    corners = [(0, 0), (10, 0), (10, 6), (0, 6)]
    square = {frozenset([corners[k], corners[(k + 1) % 4]]) for k in range(4)}
    other = {frozenset(pair) for pair in (((20, 0), (26, 0)), ((26, 0), (20, 4)), ((20, 4), (20, 0)))}
    assert found == square | other
    assert len(ends) == 7


PHOTO = photo_jpeg(np.full((240, 320, 3), (30, 60, 200), dtype=np.uint8))


@pytest.fixture(scope="module")
def scene():
    points, triangles, owner = [], [], []
    for number, (west, south, east, north, base, top) in enumerate(BOXES):
        first = 8 * number
        points += [
            (x, y, z)
            for z in (base, top)
            for x, y in ((west, south), (east, south), (east, north), (west, north))
        ]
        quads = [(i, (i + 1) % 4, 4 + (i + 1) % 4, 4 + i) for i in range(4)] + [(4, 5, 6, 7)]
        for a, b, c, d in quads:
            triangles += [(first + a, first + b, first + c), (first + a, first + c, first + d)]
            owner += [number, number]
    ids = tuple(f"b{i}" for i in range(len(BOXES)))
    return build_scene(np.array(points, float), np.array(triangles), np.array(owner, np.int32), ids)


@pytest.fixture(scope="module")
def cameras():
    found = []
    for number, (name, truth) in enumerate(true_poses(4).items()):
        estimate = None if number == 3 else truth.shifted(np.array([0.5, 0.2, 0.1]))
        facts = {"error": "" if estimate is None else "0.55 m, 0.00 deg", "trust": "</script><b>good"}
        prior = truth.shifted(np.array([8.0, -6.0, 4.0]))
        found.append(ViewedCamera(name, facts, CAMERA, prior, estimate, truth, PHOTO))
    return found


def document(page: str):
    packed = re.search(r'id="document">([^<]+)<', page)[1]
    return json.loads(gzip.decompress(base64.b64decode(packed)))


def numbers(text: str):
    return np.cumsum(np.frombuffer(base64.b64decode(text), "<i4"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "scheme"), [(DESK, "light"), pytest.param(PHONE, "dark", marks=pytest.mark.slow)]
)
def test_cameras_are_chosen_looked_through_hidden_and_filtered(tmp_path, scene, cameras, size, scheme):
    path = tmp_path / "view.html"
    path.write_text(draw_view3d("some run", scene, cameras))
    with opened(path, size, scheme) as (page, complaints):
        page.wait_for_selector(".state:empty", state="attached")
        assert page.locator(".list li").count() == 4
        assert fits(page)
        page.locator(".list button").nth(1).click()
        about = page.inner_text(".about")
        assert "view_01.png" in about
        assert "0.55 m, 0.00 deg" in about
        # What a file says is text and no part of the page.
        assert "</script><b>good" in about
        page.locator(".through").click()
        assert page.inner_text(".through") == "Back"
        # The photo lies where the camera looks: its red fills the middle of the view.
        page.locator(".opacity").fill("1")
        page.wait_for_timeout(300)
        red, green, blue = middle_colour(page)
        assert red > 150
        assert max(green, blue) < 100
        page.keyboard.press("Escape")
        assert page.inner_text(".through") == "Through the camera"
        page.locator(".filter").fill("view_02")
        assert page.locator(".list li:visible").count() == 1
        assert "1 of 4" in page.inner_text(".tools")
        for box in page.locator(".legend input").all():
            box.uncheck()
        # Software drawing is slow, and Chromium says so.
        assert [line for line in complaints if "GPU stall" not in line] == []


def middle_colour(page):
    pixels = stage_pixels(page)
    return pixels[pixels.shape[0] // 2, pixels.shape[1] // 2, ::-1].tolist()


@pytest.mark.slow
def test_pointing_at_a_camera_names_it_and_pressing_chooses_it(tmp_path, scene, cameras):
    path = tmp_path / "view.html"
    path.write_text(draw_view3d("some run", scene, cameras[:1]))
    with opened(path) as (page, _):
        page.wait_for_selector(".state:empty", state="attached")
        page.goto(f"{path.as_uri()}#view_00.png")
        page.reload()
        page.wait_for_selector(".list .current")
        page.wait_for_timeout(300)
        # A camera that a link names lies in the middle of the view.
        box = page.locator("canvas").bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2 + 8)
        assert "view_00.png (" in page.inner_text(".tip")


@pytest.mark.slow
@pytest.mark.parametrize("size", [DESK, PHONE])
@pytest.mark.parametrize("count", [1, 4])
def test_the_first_view_holds_all_cameras_and_buildings_near_them_below_the_buttons(
    tmp_path, scene, cameras, size, count
):
    path = tmp_path / "view.html"
    path.write_text(
        draw_view3d("some run", scene, cameras[:count], {"The run": "r.html", "flight": "f.html"})
    )
    with opened(path, size) as (page, _):
        page.wait_for_selector(".state:empty", state="attached")
        assert page.inner_text("aside p") == "The run, flight"
        for box in page.locator('[data-kind="photo"]').all():
            box.uncheck()
        page.wait_for_timeout(400)
        pixels = stage_pixels(page)
        bar = page.locator(".buttons").bounding_box()
        pixels[: int(bar["y"] + bar["height"]), : int(bar["x"] + bar["width"])] = 255
        # Cameras are the only thing in colour; buildings are darker than the grid.
        is_camera = np.ptp(pixels.astype(int), axis=2) > 90
        is_building = (pixels.max(axis=2) < 150) & ~is_camera
        for shown in (is_camera, is_building):
            rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
            assert rows[0] >= bar["y"] + bar["height"]
            assert rows[-1] < 0.98 * len(pixels)
            assert columns[0] > 0.02 * pixels.shape[1]
            assert columns[-1] < 0.98 * pixels.shape[1]
        # And it is no dot in the distance.
        rows, columns = np.nonzero(is_camera | is_building)
        assert max(np.ptp(rows) / len(pixels), np.ptp(columns) / pixels.shape[1]) > 0.6


@pytest.mark.slow
def test_the_eye_is_as_near_as_all_points_allow(tmp_path, scene, cameras):
    path = tmp_path / "view.html"
    path.write_text(draw_view3d("some run", scene, cameras))
    points = np.random.default_rng(0).normal(0, (200.0, 20.0, 5.0), (50, 3)).tolist()
    seen = """([points, aspect, bar]) => {
      const eye = new THREE.PerspectiveCamera(45, aspect, 0.1, 1e5);
      eye.up.set(0, 0, 1); eye.position.set(-1, -2, 1); eye.lookAt(0, 0, 0);
      const at = points.map((p) => new THREE.Vector3(...p));
      const fitted = fittingEye(at, eye.quaternion, aspect, 45, bar);
      eye.position.copy(fitted.position); eye.updateMatrixWorld(); eye.updateProjectionMatrix();
      return [...at, fitted.target].map((p) => p.clone().project(eye)).map((p) => [p.x, p.y]); }"""
    with opened(path) as (page, _):
        page.wait_for_selector(".state:empty", state="attached")
        for aspect, bar in ((1.5, 0.05), (0.7, 0.2)):
            *at, target = page.evaluate(seen, [points, aspect, bar])
            x, y = np.transpose(at)
            assert max(abs(x)) <= 0.9201
            assert -0.9201 <= min(y)
            assert max(y) <= 0.9201 - 2 * bar
            # Points that spread sideways fill the width, and the middle is looked at.
            assert (min(x), max(x)) == pytest.approx((-0.92, 0.92), abs=1e-3)
            assert target == pytest.approx([0.0, 0.0], abs=1e-6)


def stage_pixels(page):
    import cv2

    picture = page.locator(".stage").screenshot()
    return cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)


def test_corners_keep_their_place_and_the_surplus_of_a_city_is_left_out_and_said(scene, cameras, monkeypatch):
    page = draw_view3d("run", scene, cameras)
    assert "nearest to the cameras" not in page
    city = document(page)["city"]
    centers = [pose.center for c in cameras for pose in (c.prior, c.estimate, c.truth) if pose is not None]
    steps = np.frombuffer(base64.b64decode(city["corners"]), "<i4").reshape(3, -1)
    corners = np.cumsum(steps, axis=1).T * city["step_m"] + np.round(np.mean(centers, axis=0))
    found = corners[numbers(city["triangles"])].reshape(-1, 3, 3)
    expected = scene.vertices[scene.triangles]
    np.testing.assert_allclose(found, expected, atol=0.0051)
    monkeypatch.setattr(view3d, "MAX_TRIANGLES", 20)
    page = draw_view3d("run", scene, cameras)
    assert f"The 20 of {len(scene.triangles)} triangles nearest to the cameras are shown." in page
    assert len(numbers(document(page)["city"]["triangles"])) == 60


def test_rays_are_the_camera_s_and_the_page_is_the_same_each_time(scene, cameras):
    first = document(draw_view3d("run", scene, cameras))["cameras"][0]["truth"]
    pose = cameras[0].truth
    for ray, pixel in zip(
        np.reshape(first["rays"], (4, 3)), [(0, 0), (320, 0), (320, 240), (0, 240)], strict=True
    ):
        x, y, z = pose.rotation @ ray
        np.testing.assert_allclose(
            (CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy), pixel, atol=1e-2
        )
    assert draw_view3d("run", scene, cameras) == draw_view3d("run", scene, cameras)
    assert draw_view3d("run", scene, []) == ""


def test_three_js_is_the_file_that_its_note_tells_of_and_has_its_licence():
    vendor = files("lodbench.reporting") / "vendor"
    digest = hashlib.sha256((vendor / "three.min.js").read_bytes()).hexdigest()
    assert f"SHA256: `{digest}`" in (vendor / "README.md").read_text()
    assert "MIT License" in (vendor / "three.LICENSE").read_text()
