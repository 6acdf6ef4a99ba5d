import json

import cv2
import numpy as np
import pandas as pd
import pytest

from lodbench.bench import silhouettes
from lodbench.bench.silhouettes import (
    HORIZON,
    STEEP,
    SilhouetteOptions,
    make_swarms,
    measure_silhouettes,
    report_silhouettes,
)
from lodbench.citymodel import open_scene
from lodbench.errors import ConfigError, RenderingError
from lodbench.rendering import make_renderer

QUICK = SilhouetteOptions(num_views=2, num_horizon=1, hypotheses=6, threads=(1, 2), peers=(), repeats=1)


class TestSwarms:
    def test_lie_round_their_views(self, city):
        scene = open_scene(city)
        swarms, _ = make_swarms(scene, make_renderer("silhouette", scene, 1), 2, 6, 0)
        assert len(swarms) == 2
        for swarm in swarms:
            assert swarm.rotations.shape == (6, 3, 3)
            assert (np.abs(swarm.centers - swarm.pose.center) <= [10, 10, 30]).all()
            # One tilt: the vertical, in camera axes, is the same for all.
            up = swarm.rotations[:, :, 2] - swarm.pose.rotation[:, 2]
            np.testing.assert_allclose(up, 0.0, atol=1e-12)


class TestMeasure:
    def test_every_thread_count_and_size(self, city):
        steps = []
        report = measure_silhouettes(city, QUICK, lambda *step: steps.append(step))
        rows = report.data.groupby(["name", "size", "views"], sort=False)["us"]
        one, two = "silhouette, 1 thread", "silhouette, 2 threads"
        assert rows.count().to_dict() == {
            (one, "602x448", STEEP): 2,
            (two, "602x448", STEEP): 2,
            (one, "301x224", STEEP): 2,
            (two, "301x224", STEEP): 2,
            (one, "602x448", HORIZON): 1,
            (two, "602x448", HORIZON): 1,
        }
        assert (report.data["us"] > 0).all()
        assert (report.data["different"] == 0).all()
        assert steps == [(n, 5) for n in range(1, 6)]
        scores = {each.figure: each.value for each in report.figures[-2:]}
        assert list(scores) == [
            f"render and {what}, 301x224, silhouette, 1 thread"
            for what in ("colours on either side", "edges along the outline")
        ]
        assert min(scores.values()) > 0
        assert all(name in report.text for name in scores)

    def test_views_are_of_their_kind(self, city):
        scene = open_scene(city)
        engine = make_renderer("silhouette", scene, 1)
        for kind, count, low, high in ((STEEP, 3, 20, 60), (HORIZON, 4, 60, 75)):
            swarms, rejections = make_swarms(scene, engine, count, 6, 0, kind)
            assert len(swarms) == count
            fewer, before = make_swarms(scene, engine, 1, 6, 0, kind)
            np.testing.assert_array_equal(fewer[0].pose.cam_from_world, swarms[0].pose.cam_from_world)
            assert 0 <= before <= rejections
            assert all(low <= swarm.pose.euler.pitch_deg <= high for swarm in swarms)

    def test_a_peer_stands_beside(self, city):
        # The reference shares no code with the engine and needs no library.
        options = SilhouetteOptions(
            num_views=1,
            num_horizon=0,
            hypotheses=3,
            sizes=((64, 48),),
            threads=(1,),
            peers=("reference",),
            peer_hypotheses=1,
        )
        report = measure_silhouettes(city, options)
        figure = report.figures[0]
        assert figure.peer == "reference"
        assert figure.ratio == pytest.approx(figure.peer_value / figure.value)
        assert (report.data["different"] == 0).all()
        assert "x reference" in report.text

    def test_an_absent_peer_is_named_with_the_reason(self, city, monkeypatch):
        def without_peers(name, scene, threads=None):
            if name == "pyrender":
                raise RenderingError("The pyrender back end cannot be imported.")
            return make_renderer(name, scene, threads)

        monkeypatch.setattr(silhouettes, "make_renderer", without_peers)
        report = measure_silhouettes(
            city,
            SilhouetteOptions(
                num_views=1, num_horizon=0, hypotheses=2, threads=(1,), repeats=1, peers=("pyrender",)
            ),
        )
        assert "pyrender is absent: The pyrender back end cannot be imported." in report.text
        figure = report.figures[0]
        assert "cannot be imported" in figure.peer
        assert figure.ratio is None


class TestReport:
    COLUMNS = ("name", "is_peer", "size", "views", "us", "cores", "different")
    ROWS = (
        ("silhouette, 1 thread", False, "602x448", STEEP, 100.0, 0.99, 0.0),
        ("silhouette, 1 thread", False, "602x448", STEEP, 300.0, 0.99, 0.0),
        ("pyrender", True, "602x448", STEEP, 8000.0, 1.9, 0.005),
        ("pyrender", True, "602x448", STEEP, 12000.0, 1.9, 0.005),
        ("silhouette, 1 thread", False, "301x224", STEEP, 60.0, 0.99, 0.0),
        ("silhouette, 1 thread", False, "301x224", STEEP, 100.0, 0.99, 0.0),
        ("silhouette, 1 thread", False, "602x448", HORIZON, 500.0, 0.99, 0.0),
        ("pyrender", True, "602x448", HORIZON, 9000.0, 1.9, 0.01),
    )
    DATA = pd.DataFrame(ROWS, columns=COLUMNS)
    REPORT = report_silhouettes(DATA, {STEEP: 4, HORIZON: 7}, {}, "city.obj, 45,774 triangles", "2 cores")

    def test_the_ratio_is_that_of_the_means(self):
        figure = self.REPORT.figures[0]
        assert (figure.value, figure.peer_value, figure.ratio) == (200.0, 10000.0, 50.0)
        assert figure.figure == "render and IoU, 602x448, silhouette, 1 thread"

    def test_figures_are_json(self):
        figures = [f.to_json() for f in self.REPORT.figures]
        json.dumps(figures, allow_nan=False)
        assert {"figure", "value", "unit", "peer", "peer_value", "ratio"} == set(figures[0])
        rejected = {f["figure"]: f["value"] for f in figures[-2:]}
        assert rejected == {"views rejected, pitch 20 to 60": 4, "views rejected, pitch 60 to 75": 7}
        names = [f["figure"] for f in figures if not f["peer"]]
        assert len(names) == len(set(names))

    def test_views_to_the_horizon_stand_apart(self):
        figure = self.REPORT.figures[2]
        assert figure.figure == "render and IoU, 602x448, pitch 60 to 75, silhouette, 1 thread"
        assert (figure.value, figure.peer_value, figure.ratio) == (500.0, 9000.0, 18.0)

    def test_the_smaller_size_beside_the_larger(self):
        figure = self.REPORT.figures[3]
        assert figure.figure == "render and IoU, 301x224 beside 602x448, silhouette, 1 thread"
        assert (figure.value, figure.peer_value, figure.ratio) == (80.0, 200.0, 2.5)
        assert "301x224 takes 0.40 of the time of 602x448, 2.50x as fast" in self.REPORT.text

    @pytest.mark.slow
    def test_pictures(self, tmp_path):
        self.REPORT.write_pictures(tmp_path / "new")
        for name in ("costs.png", "ratios.png"):
            picture = cv2.imread(str(tmp_path / "new" / name))
            assert picture.shape[0] > 400
            assert picture.shape[1] > 900
            assert 0.02 < (picture < 250).any(axis=2).mean() < 0.5
        alone = report_silhouettes(self.DATA[~self.DATA["is_peer"]], {STEEP: 4, HORIZON: 7}, {})
        assert sorted(alone.draw()) == ["costs.png", "costs.svg"]

    def test_text(self):
        text = self.REPORT.text
        assert "50.0" in text
        assert "45,774 triangles" in text
        assert "0.50% of pixels differ" in text
        assert "2 cores" in text
        assert "2 views of pitch 20 to 60 deg (4 draws rejected)" in text


@pytest.mark.parametrize(
    ("values", "option"),
    [
        ({"num_views": 0}, "views"),
        ({"num_horizon": -1}, "horizon-views"),
        ({"repeats": 0}, "repeats"),
        ({"sizes": ()}, "sizes"),
        ({"sizes": ((0, 4),)}, "sizes"),
        ({"threads": (0,)}, "threads"),
    ],
)
def test_options_that_make_no_sense(values, option):
    with pytest.raises(ConfigError, match=option):
        SilhouetteOptions(**values)


def test_thread_counts_are_one_and_all_cores():
    counts = SilhouetteOptions().thread_counts()
    assert counts[0] == 1
    assert list(counts) == sorted(set(counts))
