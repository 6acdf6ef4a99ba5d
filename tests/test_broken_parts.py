"""A broken part of another package is told in one line, with its package and place."""

import csv
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.read import parse_city_model
from lodbench.cli import main
from lodbench.cli.training import train_method, train_segmenter
from lodbench.datasets.pose_files import read_pose_file
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Dataset
from lodbench.datasets.registry import dataset_settings, draw_priors, make_priors
from lodbench.errors import ConfigError
from lodbench.harness.results import run_method
from lodbench.methods.localize import weight_files
from lodbench.methods.registry import configure_method
from lodbench.segmentation import notes_of
from lodbench.segmentation.protocol import fingerprint_of, make_segmenter
from tests.site_packages import write_package
from tests.town import write_dataset


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Returns what installs one part, ``kit``, of a package of that name."""
    site = tmp_path / "site"
    monkeypatch.syspath_prepend(site)

    def install(group: str, code: str) -> None:
        monkeypatch.delitem(sys.modules, "kit_parts", raising=False)
        files = {"kit_parts.py": code, "kit_conf/method/kit.yaml": "name: kit\n"}
        points = {group: {"kit": "kit_parts:Part"}, "config_sources": {"kit": "kit_conf"}}
        write_package(site, "kit", points, files)

    return install


@pytest.fixture
def blamed():
    """Returns what checks that something ends in the one line of a fault, and returns the line."""

    def check(kind: str, work, *args, place: str = "kit_parts.py, line ") -> str:
        with pytest.raises(ConfigError) as caught:
            work(*args)
        line = str(caught.value)
        assert line.startswith(f"The {kind} 'kit' of the package kit 1.0 cannot "), line
        assert place in line
        assert "\n" not in line
        return line

    return check


PART = """
from dataclasses import dataclass

@dataclass(frozen=True)
class Params:
    name: str = "kit"

class Part:
    name, params_type, requires = "kit", Params, frozenset()

    def __init__(self, params=None): ...
    def localize(self, query, city_map, streams): ...
"""


@pytest.mark.parametrize("ask", ["params_for_prior", "params_for_true_tilt"])
@pytest.mark.parametrize(("fault", "told"), [("1 / 0", "ZeroDivision"), ("return 7", "int came out instead")])
def test_a_method_that_cannot_be_told_of_priors(package, blamed, ask, fault, told):
    package("methods", f"{PART}    def {ask}(self, prior=None): {fault}")
    made = configure_method({"name": "kit"})
    work = made.for_prior if ask == "params_for_prior" else made.for_tilt
    given = UniformPrior(1.0, 1.0, 1.0) if ask == "params_for_prior" else "truth"
    place = "kit_parts.py, line " if "/" in fault else ""
    assert told in blamed("method", work, given, place=place)


def test_a_method_whose_weights_or_training_fail(package, blamed, capsys, tmp_path):
    code = """
    def weight_files(self): exit("gone")

    @dataclass(frozen=True)
    class training_type:
        data: str = ""
        out: str = ""

    @classmethod
    def train(cls, settings, tell): return {}["gone"]
"""
    package("methods", PART + code)
    assert "SystemExit: gone" in blamed("method", weight_files, configure_method({"name": "kit"}).make())
    config = {"method": {"name": "kit"}, "schedule": {}, "data": "a", "out": str(tmp_path)}
    assert "be trained: KeyError" in blamed("method", train_method, OmegaConf.create(config))


SEGMENTER = """
    def segment(self, entry): ...
    def fingerprint(self, entries): raise SystemExit("no digest")
    def notes(self): return [1 / 0]
"""


def test_a_segmenter_whose_digest_or_notes_fail(package, blamed):
    package("segmenters", PART + SEGMENTER)
    made, _ = make_segmenter("kit")
    assert "SystemExit: no digest" in blamed("segmenter", fingerprint_of, made, ())
    blamed("segmenter", notes_of, made)


def test_a_segmenter_that_cannot_be_made_wherever_it_is_chosen(package, blamed, tmp_path, capsys):
    code = PART.replace("params=None): ...", "params=None): 1 / 0")
    package("segmenters", code + "    def fingerprint(self, entries): ...\n    def build(self, init): ...")
    blamed("segmenter", make_segmenter, "kit")
    config = {"segmenter": {"name": "kit"}, "schedule": {}, "data": "a", "out": str(tmp_path)}
    blamed("segmenter", train_segmenter, OmegaConf.create(config))


def test_a_dataset_that_cannot_be_opened_from_python(package, blamed):
    package("datasets", f"{PART}\ndef Part(params: Params): raise SystemExit")
    assert "SystemExit: no message" in blamed("dataset", run_method, "prior_only", "kit")
    assert dataset_settings("kit") == {"name"}


def test_a_dataset_of_no_known_settings(package, blamed):
    package("datasets", "def Part(params: int): ...")
    blamed("dataset", dataset_settings, "kit", place="TypeError")


PRIOR = """
from dataclasses import dataclass

@dataclass(frozen=True)
class Part:
    name = "kit"
    fault: str = ""

    def apply(self, dataset, seed):
        return [entry.gone for entry in [1]] if self.fault == "apply" else None if self.fault else dataset

    def describe(self):
        return 1 / 0
"""


NOTHING = Dataset("nothing", "", Path(), None, None, (), (), {})


@pytest.mark.parametrize(
    ("fault", "told"), [("apply", "AttributeError"), ("none", "NoneType"), ("", "division")]
)
def test_priors_that_cannot_be_drawn_or_described(package, blamed, fault, told):
    package("priors", PRIOR)
    place = "" if fault == "none" else "kit_parts.py, line "
    priors = make_priors("kit", {"fault": fault})
    assert told in blamed("prior", draw_priors, NOTHING, "kit", priors, 0, place=place)


@pytest.mark.parametrize("fault", ["1 / 0", "exit()", "return [7]", "return None"])
def test_a_pose_format_that_fails(package, blamed, tmp_path, fault):
    file = tmp_path / "file.kit"
    file.write_text("anything")
    place = "" if fault.startswith("return") else "kit_parts.py, line "
    package("pose_formats", f"def Part(path): {fault}")
    assert f"read {file}: " in blamed("pose-format", read_pose_file, file, "kit", place=place)


@pytest.mark.parametrize("fault", ["1 / 0", "exit()", "return [7]"])
def test_a_city_reader_that_fails(package, blamed, fault):
    package("city_readers", f"def Part(source, options): {fault}")
    place = "" if fault.startswith("return") else "kit_parts.py, line "
    blamed("city-reader", parse_city_model, b"anything", "a city", ReadOptions(reader="kit"), place=place)


RENDERER = """
import numpy as np

class Part:
    name = "kit"

    def __init__(self, scene, threads=None):
        self.scene, self.asked = scene, 0

    def render(self, camera, pose):
        self.asked += 1
        {fault}
        return np.zeros((camera.height, camera.width), dtype=bool)
"""


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("town"), count=2)


def run_with(town, tmp_path, *words: str) -> tuple[int, list[dict[str, str]]]:
    """Returns the exit code of a run, and its rows."""
    root, city = town
    data = ["dataset=folder", f"dataset.root={root}", f"dataset.city_model={city}", "method.steps=1"]
    code = main(["run", *data, f"paths.runs={tmp_path}", *words])
    tables = list(tmp_path.rglob("queries.csv"))
    return code, [row for table in tables for row in csv.DictReader(table.open())]


@pytest.mark.parametrize("fault", ["1 / 0", "exit()", "return np.zeros((3, 3))"])
def test_a_renderer_that_never_draws_ends_a_run_at_once(package, capsys, town, tmp_path, fault):
    package("renderers", RENDERER.format(fault=fault))
    assert run_with(town, tmp_path, "renderer=kit")[0] == 2
    told = capsys.readouterr().err
    assert "The renderer 'kit' of the package kit 1.0 cannot draw: " in told
    assert "Traceback" not in told


def test_a_renderer_that_fails_at_times_fails_the_queries_and_is_blamed_for_pictures(
    package, capsys, town, tmp_path
):
    package("renderers", RENDERER.format(fault="if self.asked > 1: raise KeyError('tile')"))
    assert run_with(town, tmp_path, "renderer=kit")[0] == 2
    told = capsys.readouterr().err
    assert "The renderer 'kit' of the package kit 1.0 cannot draw what was found: KeyError" in told
    assert "KeyError" in next(tmp_path.rglob("predictions.jsonl")).read_text()
    assert next(tmp_path.rglob("tracebacks")).is_dir()


def test_a_renderer_that_cannot_draw_pictures(package, capsys, town, tmp_path):
    root, city = town
    views = [f"poses={root / 'GT_pose.txt'}", f"intrinsics={root / 'intrinsic.txt'}"]
    package("renderers", RENDERER.format(fault="raise RuntimeError"))
    assert main(["render", f"city={city}", *views, f"out={tmp_path / 'out'}", "renderer=kit"]) == 2
    assert "cannot draw view_00.png: RuntimeError: no message" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("return 0.5", "TypeError: Part gave float64 () for"),
        ("return np.array(['high'] * len(words))", "TypeError: Part gave <U4"),
        ("return np.zeros((len(words), 2))", "TypeError: Part gave float64 ("),
    ],
)
def test_a_fit_that_fails_or_gives_no_numbers_is_the_queries_failure(package, town, tmp_path, fault, told):
    package(
        "fits",
        f"""
import numpy as np

class Part:
    def __init__(self, probability):
        self.size = probability.shape[::-1]

    def __call__(self, words):
        {fault}
""",
    )
    _, rows = run_with(town, tmp_path, "method=lodlocv2", "method.fit=kit")
    assert [row["failure"][: len(told)] for row in rows] == [told] * 2
