"""What is measured of tracking and joint solves, on the tests' town."""

import numpy as np
import pytest

from lodbench.bench.flights import _roofs_shown
from lodbench.bench.tracking import TrackingOptions, measure_joint_solves, measure_tracking
from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError
from lodbench.geometry import EulerAngles
from lodbench.methods.flight import FlightMethod, FlightParams
from lodbench.methods.protocol import FlightEstimate
from lodbench.synthesis.flights import FlightsParams
from lodbench.synthesis.views import view_of
from tests.town import CAMERA, box_obj


@pytest.fixture
def city(tmp_path):
    path = tmp_path / "city.obj"
    path.write_text(box_obj())
    return path


def test_frames_are_counted_whether_found_or_lost(city):
    class Blind:
        def probability(self, photo):
            assert photo.shape == (120, 160, 3)
            return np.zeros((120, 160), np.float32)

    report = measure_tracking(city, [0], Blind(), TrackingOptions(frames=3, size=(160, 120), look="plain"))
    values = {(figure.figure, figure.unit): figure.value for figure in report.figures}
    assert values["frames lost", ""] == 3
    assert values["frames within 2 m and 2 deg", "%"] == 0.0
    assert values["photos per second from pixels to pose", "1/s"] > 0


def test_joint_solves_have_one_thread_for_linear_algebra_as_runs_have(city):
    from threadpoolctl import threadpool_info

    class Asked:
        def solve_jointly(self, queries, alone, city_map):
            pools = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
            assert set(pools) == {1}
            return FlightEstimate(list(alone))

    flights = FlightsParams(str(city), num_photos=3, path="orbit", mask_iou=0.97)
    measure_joint_solves(flights, [3], Asked(), traces_memory=False)


def test_joint_solves_are_timed_by_their_number_of_photos(city):
    flights = FlightsParams(str(city), path="orbit", mask_iou=0.97)
    method = FlightMethod(FlightParams(steps=2, restarts=0))
    report = measure_joint_solves(flights, [3, 6], method, traces_memory=True)
    values = {figure.figure: figure.value for figure in report.figures}
    assert values["joint solve of 6 photos"] > 0
    assert values["memory, 6 photos"] > values["memory, 3 photos"] > 0
    assert np.isfinite(values["growth of time, power of the number"])
    rows = [line.split() for line in report.text.splitlines()[1:3]]
    assert [row[0] for row in rows] == ["3", "6"]
    # The flight is found, not only timed.
    assert all(float(row[-1]) < 2.0 for row in rows)
    with pytest.raises(ConfigError, match="ascend"):
        measure_joint_solves(flights, [6, 3], method, traces_memory=False)


def test_a_roof_in_front_of_a_taller_wall_and_one_that_a_single_photo_shows_are_not_told(tmp_path):
    path = tmp_path / "city.obj"
    # A low house before a slab, seen from the south, and one that stands free.
    path.write_text(box_obj([(-30, 10, 30, 20, 0, 40), (-5, -2, 5, 6, 0, 6), (45, -5, 55, 5, 0, 8)]))
    scene = open_scene(path)
    target = scene.vertices.astype(float).mean(axis=0)
    poses = [view_of(target, 90.0, EulerAngles(55.0, 0.0, yaw_deg)) for yaw_deg in (-4.0, 4.0)]
    mask = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    queries = [Query(f"q{k}", "all", CAMERA, pose, mask) for k, pose in enumerate(poses)]
    slab, _, free = scene.building_ids
    city_map = CityMap(scene, threads=1)
    assert _roofs_shown(queries, poses, city_map) == {slab, free}
    assert _roofs_shown(queries[:1], poses[:1], city_map) == set()
