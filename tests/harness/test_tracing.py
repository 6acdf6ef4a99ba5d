"""Roofs traced in two photos of a drawn flight: triangulated, snapped, placed, compared, written."""

import json
import shutil
import struct
from dataclasses import replace
from http.client import HTTPConnection
from itertools import pairwise
from threading import Thread

import numpy as np
import pytest
from shapely import Polygon

from lodbench.citymodel.read import read_city_model
from lodbench.cli import main
from lodbench.cli.mask_trace import describe_map
from lodbench.datasets.exchange.colmap import read_colmap_points
from lodbench.datasets.pose_text import read_poses
from lodbench.errors import DatasetError
from lodbench.geometry import Camera
from lodbench.harness.tracing.outputs import TraceServer, footprints_of, parse_tracing, read_tracing
from lodbench.harness.tracing.roofs import View
from lodbench.harness.tracing.solve import Model, TraceRequest, ground_height
from tests.tracing_case import CAMERA, poses, roofs, sparse_points, traced_by_hand, write_case


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight")
    write_case(folder)
    return folder


@pytest.fixture(scope="module")
def model(case):
    return Model(request_of(case, start=case / "rough.txt"))


def request_of(case, **settings):
    return TraceRequest(model=case / "sparse" / "0", images=case / "photos", **settings)


def trace(case, out, *words):
    return main(
        [
            "trace",
            str(case / "sparse" / "0"),
            "--images",
            str(case / "photos"),
            "--out",
            str(out),
            *map(str, words),
        ]
    )


@pytest.mark.parametrize("distortion", [(), (-0.2, 0.03, 0.002, -0.001)])
def test_rays_lead_back_to_their_pixels(tmp_path, distortion):
    camera = replace(CAMERA, distortion=distortion)
    view = View("a", camera, poses()["view_03.jpg"], tmp_path)
    pixels = np.array([[10.0, 20.0], [480.0, 360.0], [900.0, 700.0], [30.0, 650.0]])
    assert view.project(view.pose.center + 50.0 * view.rays(pixels)) == pytest.approx(pixels, abs=1e-4)


def test_snapped_roofs_lie_on_the_blocks_that_the_photos_show(model, case):
    solved = model.solved(read_tracing(case / "traced.json", model.views))
    assert len(solved.buildings) == 7
    for building in solved.buildings:
        exact = roofs()[building.roof.name]
        off, before = (
            np.sqrt(np.mean(np.sum((each.corners - exact[:, :2]) ** 2, axis=1)))
            for each in (building.roof, building.traced)
        )
        assert off < min(0.15, before)
        assert building.roof.height == pytest.approx(exact[0, 2], abs=0.15)
        assert abs(building.ground) < 0.2
        assert building.roof.residual_px < 0.5
        assert building.moved[0] == pytest.approx(before, abs=0.2)
    # Corners of 3 px in two photos: what is stated is what tracing errs by.
    ratios = [
        (b.traced.height - roofs()[b.roof.name][0, 2]) / b.traced.height_sigma for b in solved.buildings
    ]
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 2.0


def test_a_known_length_and_the_points_give_scale_and_level(case):
    model = Model(request_of(case))
    solved = model.solved(traced_by_hand(0.0, 0))
    assert "1 known length" in solved.placed.notes[0]
    for building in solved.buildings:
        exact = roofs()[building.roof.name]
        assert building.footprint.area == pytest.approx(Polygon(exact).area, rel=0.01)
        assert building.roof.height - building.ground == pytest.approx(exact[0, 2], abs=0.3)
    # The case's model is tilted by tens of degrees: roofs are level only where it was made upright.
    camera = solved.images[0].pose
    assert camera.rotation[2] @ [0, 0, 1] == pytest.approx(
        poses()["view_00.jpg"].rotation[2] @ [0, 0, 1], abs=0.01
    )


def test_the_ground_is_below_trees_and_above_mismatches():
    points = np.concatenate([sparse_points(), np.full((3, 3), [0.0, -30.0, -15.0])])
    plan = Polygon(roofs()["block 2"][:, :2])
    height, sigma = ground_height(points, plan, [plan], 30.0)
    assert height == pytest.approx(0.0, abs=0.1)
    assert 0.05 < sigma < 0.5
    with pytest.raises(DatasetError, match="too few"):
        ground_height(points[:20], plan, [plan], 30.0)


def test_points_are_the_same_as_text_and_in_binary(tmp_path, case):
    points = read_colmap_points(case / "sparse" / "0")
    assert len(points) == len(sparse_points())
    records = [
        struct.pack("<Q3d3Bd", k, *point, 0, 0, 0, 0.5) + struct.pack("<Q2i", 1, 1, 2)
        for k, point in enumerate(points.tolist())
    ]
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", len(points)) + b"".join(records))
    assert np.array_equal(read_colmap_points(tmp_path), points)
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", len(points)) + b"".join(records)[:-3])
    with pytest.raises(DatasetError, match="cut off"):
        read_colmap_points(tmp_path)
    assert read_colmap_points(tmp_path / "none").shape == (0, 3)


def test_another_tracing_and_the_known_map_are_compared_with(case, tmp_path, capsys):
    words = ("--polygons", case / "traced.json", "--start", case / "rough.txt", "--json")
    for other in ("again.json", "known.obj"):
        assert trace(case, tmp_path / "map.gml", *words, "--compare", case / other) == 0
        rows = json.loads(capsys.readouterr().out)["compared"]
        assert len(rows) == 7
        for row in rows:
            assert row["plan_m"] < min(0.15, row["traced_plan_m"])
            assert abs(row["height_m"]) < 0.15
            assert row["iou"] > 0.97
    assert len(read_city_model(tmp_path / "map.gml").building_ids) == 7


def test_an_image_of_an_unknown_camera_is_left_out_and_named(case, tmp_path):
    sparse = shutil.copytree(case / "sparse" / "0", tmp_path / "sparse")
    (sparse / "rigs.txt").unlink(missing_ok=True)
    (sparse / "frames.txt").unlink(missing_ok=True)
    with (sparse / "cameras.txt").open("a") as stream:
        stream.write("2 MADE_UP 960 720 800\n")
    images = (sparse / "images.txt").read_text()
    (sparse / "images.txt").write_text(images.replace(" 1 view_11.jpg", " 2 view_11.jpg"))
    model = Model(TraceRequest(model=sparse, images=case / "photos", start=case / "rough.txt"))
    assert len(model.views) == 11
    notes = model.solved(read_tracing(case / "traced.json", model.views)).placed.notes
    assert [note for note in notes if note.startswith("view_11.jpg is left out: ") and "MADE_UP" in note]


def test_the_benchmark_holds_photos_that_the_map_has_not_used(case, tmp_path, capsys):
    words = (
        "--polygons",
        case / "traced.json",
        "--start",
        case / "rough.txt",
        "--benchmark",
        tmp_path / "set",
    )
    assert trace(case, tmp_path / "map.city.json", *words, "--queries", "view_*[02468].jpg") == 0
    truth = read_poses(tmp_path / "set" / "GT_pose.txt")
    assert sorted(truth) == [f"view_{n:02d}.jpg" for n in range(0, 12, 2)]
    priors = read_poses(tmp_path / "set" / "GPS_pose.txt")
    for name, pose in truth.items():
        assert pose.center == pytest.approx(poses()[name].center, abs=1e-3)
        assert (np.abs(priors[name].center - pose.center) <= [10, 10, 30]).all()
        assert not np.allclose(priors[name].center, pose.center, atol=0.01)
        assert (tmp_path / "set" / "Query_image" / name).is_file()
    assert "found in 6 photos" in capsys.readouterr().out
    known = {name: (plan, roof) for name, plan, roof in footprints_of(tmp_path / "set" / "city.obj")}
    assert len(known) == 7
    assert main(["dataset", "check", str(tmp_path / "set")]) == 0


@pytest.mark.parametrize(
    ("item", "message"),
    [
        ({"kind": "tower"}, "the kind 'tower' is none of"),
        ({"name": " "}, "it has no name"),
        ({"photos": {"view_01.jpg": [[1, 2]] * 3}}, "the same corners in two photos"),
        ({"photos": {"view_01.jpg": [[1, 2]] * 3, "view_02.jpg": [[1, 2]] * 4}}, "not 3 and 4"),
        ({"photos": {"view_01.jpg": [[1, 2]] * 2, "view_02.jpg": [[1, 2]] * 2}}, "2 points are no roof"),
        ({"photos": {"view_01.jpg": [[1, 2]] * 3, "x.jpg": [[1, 2]] * 3}}, "no image 'x.jpg'"),
        ({"photos": []}, "no object with photos"),
        (
            {"kind": "length", "metres": 0, "photos": {f"view_0{k}.jpg": [[1, 2]] * 2 for k in (1, 2)}},
            "above 0 m",
        ),
    ],
)
def test_a_malformed_tracing_is_refused_by_item(item, message):
    good = {
        "kind": "roof",
        "name": "A",
        "photos": {f"view_0{k}.jpg": [[1, 2], [3, 4], [5, 1]] for k in (1, 2)},
    }
    assert len(parse_tracing({"traced": [good]}, "t.json", poses())) == 1
    with pytest.raises(DatasetError, match=f"t.json, item 2: .*{message}"):
        parse_tracing({"traced": [good, {**good, "name": "B", **item}]}, "t.json", poses())
    with pytest.raises(DatasetError, match="two roofs are called A"):
        parse_tracing({"traced": [good, good]}, "t.json", poses())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--polygons", "{}/none.json"), "none.json does not exist"),
        (("--polygons", "{}/traced.json", "--scale", "-1"), "--scale -1 is no scale"),
        (("--polygons", "{}/traced.json", "--scale", "2", "--metric"), "both say where the model is"),
        (("--polygons", "{}/traced.json", "--queries", "a*"), "not used without --benchmark"),
        (("--polygons", "{}/traced.json", "--takeoff", "3"), "--takeoff is about the photos' own heights"),
        (("--polygons", "{}/traced.json", "--benchmark", "{}/set", "--queries", "view_01*"), "is traced in"),
        (("--polygons", "{}/traced.json", "--benchmark", "{}/set", "--queries", "x*"), "fits no photo"),
        (("--polygons", "{}/roofs.json"), "Nothing says how large the model is"),
        (("--polygons", "{}/rough.txt"), "rough.txt"),
    ],
)
def test_wrong_words_are_refused_in_one_line(case, tmp_path, capsys, words, message):
    roofs_alone = json.loads((case / "traced.json").read_text())
    roofs_alone["traced"] = [item for item in roofs_alone["traced"] if item["kind"] == "roof"]
    (case / "roofs.json").write_text(json.dumps(roofs_alone))
    assert trace(case, tmp_path / "map.obj", *(word.format(case) for word in words)) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "map.obj").exists()


def test_corners_in_another_order_cross(model):
    (roof, _) = traced_by_hand(0.0, 0, ("block 3",))
    mixed = replace(roof, pixels={name: points[[0, 2, 1, 3]] for name, points in roof.pixels.items()})
    with pytest.raises(DatasetError, match="crosses itself"):
        model.solved([mixed])


class TestPage:
    @pytest.fixture
    def server(self, model, tmp_path):
        with TraceServer(model, tmp_path / "traced.json", describe_map) as server:
            thread = Thread(target=server.serve_forever)
            thread.start()
            yield server
            server.shutdown()
            thread.join()

    def asked(self, server, what, content=None, token=None):
        connection = HTTPConnection("127.0.0.1", server.server_address[1], timeout=60)
        method, body = ("GET", None) if content is None else ("POST", json.dumps(content))
        connection.request(method, f"/{token or server.token}/{what}", body)
        answer = connection.getresponse()
        return answer.status, answer.read()

    def test_shows_traces_saves_and_solves(self, server, case):
        status, page = self.asked(server, "")
        assert status == 200
        assert b"view_11.jpg" in page
        assert self.asked(server, "photo3.jpg")[1][:2] == b"\xff\xd8"
        assert self.asked(server, "photo99.jpg")[0] == 404
        assert self.asked(server, "", token="x")[0]  # noqa: S106 == 404
        tracing = json.loads((case / "traced.json").read_text())
        answer = json.loads(self.asked(server, "save", tracing)[1])
        assert answer == {"message": "saved: traced.json", "saved": True}
        assert len(read_tracing(server.file, poses())) == len(tracing["traced"])
        tracing["traced"] = tracing["traced"][:1]
        answer = json.loads(self.asked(server, "solve", tracing)[1])
        assert answer["message"].startswith("block 1: roof 1")
        view = poses()["view_05.jpg"]
        exact = CAMERA.project(roofs()["block 1"] @ view.rotation.T + view.translation)
        assert np.array(answer["outlines"]["view_05.jpg"][0]) == pytest.approx(exact, abs=1.0)
        refused = json.loads(self.asked(server, "save", {"traced": [{"kind": "roof"}]})[1])
        assert refused["message"].startswith("NOT saved: the page, item 1")

    def test_a_ray_passes_through_the_place_in_the_other_photo(self, server):
        corner = roofs()["block 5"][:1]
        here, there = (
            CAMERA.project(corner @ pose.rotation.T + pose.translation)[0]
            for pose in (poses()["view_01.jpg"], poses()["view_04.jpg"])
        )
        content = {"photo": "view_01.jpg", "pixel": here.tolist(), "other": "view_04.jpg"}
        line = np.array(json.loads(self.asked(server, "line", content)[1])["line"])
        away = [
            np.linalg.norm(a + np.clip((there - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1) * (b - a) - there)
            for a, b in pairwise(line)
        ]
        assert min(away) < 0.5
        assert self.asked(server, "line", {"photo": "none"})[0] == 400


def test_a_real_roof_comes_nearer_to_the_given_map(shared_data):
    flight = shared_data / "real_flights" / "ochota"
    if not flight.is_dir():
        pytest.skip("the real flights are not beside this checkout (../shared/data/real_flights)")
    request = TraceRequest(
        model=flight / "sparse", images=flight / "Query_image", start=flight / "GT_pose.txt"
    )
    model = Model(request)
    known = {name: (plan, roof) for name, plan, roof in footprints_of(flight / "city.obj")}
    plan, height = known["component-10"]
    corners = np.column_stack([np.array(plan.exterior.coords)[:-1], np.full(4, height)])
    placed = {name: pose for name, pose in read_poses(flight / "GT_pose.txt").items()}
    generator, pixels = np.random.default_rng(1), {}
    for name in ("img_3013.jpg", "img_3033.jpg"):
        camera: Camera = model.views[name].camera
        exact = camera.project(corners @ placed[name].rotation.T + placed[name].translation)
        pixels[name] = exact + generator.normal(0, 4, exact.shape)
    values = {"kind": "roof", "name": "V1", "photos": {name: each.tolist() for name, each in pixels.items()}}
    (building,) = model.solved(parse_tracing({"traced": [values]}, "", model.views)).buildings
    assert building.roof.height == pytest.approx(height, abs=0.6)
    assert np.sqrt(np.mean(np.sum((building.roof.corners - corners[:, :2]) ** 2, axis=1))) < 0.8
    assert building.ground == pytest.approx(0.42, abs=0.4)
    assert building.roof.matched_share > 0.9
