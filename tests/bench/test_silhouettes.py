from __future__ import annotations

import json

import numpy as np
import pytest

from lodbench.bench import silhouettes
from lodbench.bench.silhouette_report import SilhouetteReport, Timing
from lodbench.bench.silhouettes import SilhouetteOptions, make_swarms, measure_silhouettes
from lodbench.citymodel import open_scene
from lodbench.errors import ConfigError, RenderingError
from lodbench.rendering import make_renderer

QUICK = SilhouetteOptions(num_views=2, hypotheses=6, threads=(1, 2), peers=(), repeats=1)


class TestSwarms:
    def test_lie_round_their_views(self, city):
        scene = open_scene(city)
        swarms, _ = make_swarms(scene, make_renderer("silhouette", scene, 1), QUICK)
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
        assert [(t.threads, t.size) for t in report.timings] == [
            (1, (602, 448)),
            (2, (602, 448)),
            (1, (301, 224)),
            (2, (301, 224)),
        ]
        assert all(len(t.microseconds) == 2 and min(t.microseconds) > 0 for t in report.timings)
        assert all(t.different == 0 for t in report.timings)
        assert steps == [(1, 4), (2, 4), (3, 4), (4, 4)]

    def test_a_peer_stands_beside(self, city):
        # The reference shares no code with the engine and needs no library.
        options = SilhouetteOptions(
            num_views=1,
            hypotheses=3,
            sizes=((64, 48),),
            threads=(1,),
            peers=("reference",),
            peer_hypotheses=1,
        )
        report = measure_silhouettes(city, options)
        figure = report.figures()[0]
        assert figure.peer == "reference"
        assert figure.ratio == pytest.approx(figure.peer_value / figure.value)
        assert report.peers_at((64, 48))[0].different == 0
        assert "x reference" in report.to_text()

    def test_an_absent_peer_is_named_with_the_reason(self, city, monkeypatch):
        def without_peers(name, scene, threads=None):
            if name == "pyrender":
                raise RenderingError("The pyrender back end cannot be imported.")
            return make_renderer(name, scene, threads)

        monkeypatch.setattr(silhouettes, "make_renderer", without_peers)
        report = measure_silhouettes(
            city, SilhouetteOptions(num_views=1, hypotheses=2, threads=(1,), repeats=1)
        )
        assert "pyrender is absent: The pyrender back end cannot be imported." in report.to_text()
        figure = report.figures()[0]
        assert "cannot be imported" in figure.peer
        assert figure.ratio is None


class TestReport:
    SIZE = (602, 448)
    REPORT = SilhouetteReport(
        "city.obj",
        45774,
        2000,
        4,
        2,
        1.5,
        (
            Timing("silhouette", 1, SIZE, (100.0, 300.0), 0.0),
            Timing("pyrender", None, SIZE, (8000.0, 12000.0), 0.005),
        ),
    )

    def test_the_ratio_is_that_of_the_means(self):
        figure = self.REPORT.figures()[0]
        assert (figure.value, figure.peer_value, figure.ratio) == (200.0, 10000.0, 50.0)
        assert figure.figure == "render and IoU, 602x448, silhouette, 1 thread"

    def test_figures_are_json(self):
        figures = [f.to_json() for f in self.REPORT.figures()]
        json.dumps(figures, allow_nan=False)
        assert {"figure", "value", "unit", "peer", "peer_value", "ratio"} == set(figures[0])
        assert figures[-1] == {
            "figure": "views rejected",
            "value": 4,
            "unit": "",
            "peer": "",
            "peer_value": None,
            "ratio": None,
        }

    def test_text(self):
        text = self.REPORT.to_text()
        assert "50.0" in text
        assert "45,774 triangles" in text
        assert "0.50% of pixels differ" in text
        assert "2 cores, load 1.5" in text


@pytest.mark.parametrize(
    "values", [{"num_views": 0}, {"repeats": 0}, {"sizes": ()}, {"sizes": ((0, 4),)}, {"threads": (0,)}]
)
def test_options_that_make_no_sense(values):
    with pytest.raises(ConfigError, match=next(iter(values))):
        SilhouetteOptions(**values)


def test_thread_counts_are_one_and_all_cores():
    counts = SilhouetteOptions().thread_counts()
    assert counts[0] == 1
    assert list(counts) == sorted(set(counts))
