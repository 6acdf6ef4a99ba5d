"""Runs from Python, as a notebook makes and shows them; scores of a grid shared out over workers."""

import importlib.metadata
import linecache
import re
import shutil
import sys
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from types import ModuleType

import numpy as np
import pytest

import lodbench
from lodbench.cli import main
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.errors import ConfigError
from lodbench.geometry import Camera, Pose, rotations_at_yaws
from lodbench.harness import RunSettings, run_method
from lodbench.harness.runs import inputs as module
from lodbench.harness.runs.inputs import code_digest
from lodbench.harness.runs.predict import SharedScorer, score
from lodbench.methods.registry import make_method
from lodbench.plugins import PlugIn
from lodbench.rendering import BoundaryFit, IouFit
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.segmentation.masks import MaskFiles, MasksParams
from tests.harness.scripted import Flying, Scripted, run
from tests.rendering.hostile_scenes import box, scene_of
from tests.site_packages import write_package
from tests.town import BOXES, write_dataset


def test_a_run_from_python_is_one_that_verifies_and_shows_itself(tmp_path, capsys):
    root, city = write_dataset(tmp_path / "town", count=2)
    run = lodbench.run_method("contour_alignment", root, city=city, runs=tmp_path / "runs")
    assert repr(run).startswith("StoredRun(contour_alignment on folder, 2 queries")
    assert run.queries["translation_error_m"].max() < 2.0
    assert "<table" in run._repr_html_()
    # The libraries that name its folder are stated.
    assert run.provenance["scipy"] == importlib.metadata.version("scipy")
    assert "opencv-python-headless" in run.provenance
    (name, picture), *_ = run.overlays.items()
    assert "view_0" in name
    assert picture._repr_png_().startswith(b"\x89PNG")
    assert len(repr(picture)) < 200
    for found in run.predictions.values():
        assert found.mask_png
        assert len(repr(found)) < 800
        assert re.fullmatch(r"Pose\(center=\([-\d., ]+\), pitch=.*, roll=.*, yaw=.* deg\)", repr(found.pose))
    assert main(["verify", str(run.folder)]) == 0, capsys.readouterr().out
    # The same again resumes into the same folder; another setting has another.
    runs = tmp_path / "runs"
    assert lodbench.run_method("contour_alignment", root, city=city, runs=runs).folder == run.folder
    assert lodbench.run_method("prior_only", root, city=city, runs=runs).folder != run.folder


def test_a_run_whose_queries_have_spaces_in_their_names_is_read_back(tmp_path):
    """A dataset of one's own may call them as cameras do, and copies of files: `DSC 1 (2).jpg`."""
    root, city = write_dataset(tmp_path / "town", count=2)
    plain = open_folder(FolderParams(str(root), str(city)))
    names = {entry.key: f"view  {number} (2).png" for number, entry in enumerate(plain.entries)}
    entries = tuple(replace(entry, name=names[entry.key]) for entry in plain.entries)
    truth = {f"{entry.split}/{names[entry.key]}": plain.truth[entry.key] for entry in plain.entries}
    run = lodbench.run_method(
        "prior_only", replace(plain, entries=entries, truth=truth), runs=tmp_path / "runs"
    )
    assert list(run.poses) == list(run.queries.index) == list(truth)
    assert run.queries["translation_error_m"].notna().all()


def test_a_method_named_is_reported_of_the_true_tilt_as_by_the_command(tmp_path):
    """`lodbench run tilt=truth` leaves pitch and roll as they are: so must the same from Python."""
    root, city = write_dataset(tmp_path / "town", count=1)
    run = lodbench.run_method("contour_alignment", root, city=city, tilt="truth", runs=tmp_path / "runs")
    assert run.summary["method"]["params"]["range_tilt_deg"] == 0.0
    assert run.summary["protocol"]["tilt"] == "truth"


def test_settings_that_are_not_kept_are_refused(tmp_path):
    """Runs of two settings would share a folder, and the second would be given the first one's answers."""

    @dataclass(frozen=True)
    class Params:
        off: float = 0.0

    class Forgetful(type(make_method("prior_only"))):
        params_type = Params

        def __init__(self, params=None):
            self.off = (params or Params()).off

    root, city = write_dataset(tmp_path / "town", count=1)
    with pytest.raises(ConfigError, match="does not keep its settings"):
        lodbench.run_method(Forgetful(Params(50.0)), root, city=city, runs=tmp_path / "runs")


class TestTheCodeThatNamesARun:
    @pytest.fixture
    def package(self, tmp_path, monkeypatch):
        folder = tmp_path / "sky_package" / "nets"
        folder.mkdir(parents=True)
        (folder.parent / "__init__.py").write_text("class Method:\n    pass\n")
        (folder / "model.py").write_text("OFF = 1\n")
        monkeypatch.syspath_prepend(tmp_path)
        yield folder
        sys.modules.pop("sky_package", None)

    def test_a_package_counts_with_its_folders(self, package):
        method = importlib.import_module("sky_package").Method()
        before = code_digest(method)
        (package / "model.py").write_text("OFF = 100\n")
        assert code_digest(method) != before

    def test_what_a_package_requires_counts_by_its_version(self, package, tmp_path):
        method = importlib.import_module("sky_package").Method()
        needs = {
            "sky": ("Nets_Of-Sky>=1", "lodbench", "absent"),
            "nets-of-sky": ("deep; extra == 'x'", "deeper"),
            "deep": (),
            "deeper": ("sky",),
        }
        infos = {name: write_package(tmp_path, name, {}) for name in needs}
        (infos["sky"] / "top_level.txt").write_text("sky_package\n")
        alone = code_digest(method)

        def digest_after(changed: str, version: str) -> str:
            for name, words in needs.items():
                lines = [f"Name: {name}", f"Version: {version if name == changed else '1.0'}"]
                lines += [f"Requires-Dist: {word}" for word in words]
                (infos[name] / "METADATA").write_text("\n".join(lines))
            return code_digest(method)

        before = digest_after("sky", "1.0")
        assert before not in (alone, digest_after("nets-of-sky", "1.1"), digest_after("deeper", "1.1"))
        assert before == digest_after("sky", "1.1") == digest_after("deep", "1.1")
        (tmp_path / "deeper.py").write_text("OFF = 1\n")
        (infos["deeper"] / "top_level.txt").write_text("deeper\n")
        (infos["deeper"] / "direct_url.json").write_text('{"dir_info": {"editable": true}, "url": ""}')
        edited = code_digest(method)
        (tmp_path / "deeper.py").write_text("OFF = 2\n")
        again = code_digest(method)
        # As other builders write it: without blanks, and without the packages' names.
        (infos["deeper"] / "top_level.txt").unlink()
        source = tmp_path / "source"
        source.mkdir()
        (source / "more.py").write_text("MORE = 1\n")
        reported = f'{{"url":"{source.as_uri()}","dir_info":{{"editable":true}}}}'
        (infos["deeper"] / "direct_url.json").write_text(reported)
        others = code_digest(method)
        (source / "more.py").write_text("MORE = 2\n")
        assert len({before, edited, again, others, code_digest(method)}) == 5

    def test_a_plugin_that_a_setting_names_counts(self, package, monkeypatch):
        point = EntryPoint("skyline", "sky_package:Method", "lodbench.fits")
        plug_in = PlugIn("fits", "skyline", "sky 1.0", point)
        monkeypatch.setattr(module, "installed", lambda group: (plug_in,) if group == "fits" else ())
        unnamed, before = code_digest(), code_digest(names={"skyline"})
        assert unnamed != before
        (package / "model.py").write_text("OFF = 100\n")
        assert code_digest(names={"skyline"}) != before
        assert code_digest() == unnamed

    def test_what_was_typed_counts_by_its_source_or_is_refused(self, monkeypatch):
        typed = type("Typed", (), {"__module__": "__main__"})
        monkeypatch.delattr(sys.modules["__main__"], "__file__", raising=False)
        with pytest.raises(ConfigError, match="Typed cannot be read"):
            code_digest(typed())

    def test_cells_of_a_notebook_count(self, monkeypatch):
        """Python finds no source of a class that was typed; what it calls may stand in another cell."""
        notebook = ModuleType("__main__")
        monkeypatch.setitem(sys.modules, "__main__", notebook)

        def digest_after(name: str, text: str) -> str:
            monkeypatch.setitem(linecache.cache, name, (len(text), None, text.splitlines(True), name))
            exec(compile(text, name, "exec"), vars(notebook))  # noqa: S102 - as a notebook does
            return code_digest(notebook.Method())

        method = "class Method:\n    far_m = 1\n    def localize(self): return step(self)\n"
        before = digest_after("<cell 1>", method)
        assert digest_after("<cell 2>", method) == before
        stepped = digest_after("<cell 3>", "def step(method): return 0\n")
        assert digest_after("<cell 4>", "def step(method): return 50\n") != stepped
        assert digest_after("<cell 5>", "def step(method): return 0\n") == stepped
        assert digest_after("<cell 6>", method.replace("1", "2")) != stepped


def test_the_public_names_are_there():
    assert issubclass(lodbench.QueryFault, lodbench.LodbenchError)
    assert {"QueryFault", "run_method", "load_run"} <= set(lodbench.__all__)


def test_no_object_prints_its_arrays(tmp_path):
    _, city = write_dataset(tmp_path / "town", count=1)
    scene = lodbench.open_scene(city)
    assert len(repr(scene)) < 200


@pytest.fixture
def half_known(tmp_path):
    """Two splits of one town: `known`, where one of three poses is not, and `hidden`, which has no truth."""
    root, city = write_dataset(tmp_path / "town", count=3)
    both = tmp_path / "both"
    for split in ("known", "hidden"):
        shutil.copytree(root, both / split)
    truth = both / "known" / "GT_pose.txt"
    truth.write_text("".join(truth.read_text().splitlines(keepends=True)[:2]))
    (both / "hidden" / "GT_pose.txt").unlink()
    (both / "hidden" / "dataset.json").write_text('{"truth": false}')
    return both, city


def test_queries_without_a_truth_are_answered_beside_those_that_are_scored(half_known, tmp_path, capsys):
    """A test split whose truth is withheld; a flight's photos of which a few are surveyed."""
    root, city = half_known
    run = lodbench.run_method("lodlocv2", root, city=city, runs=tmp_path / "runs")
    assert set(run.poses) == set(run.queries.index)
    splits = run.summary["splits"]
    assert [splits[name]["num_queries"] for name in ("hidden", "known")] == [0, 2]
    assert [splits[name]["num_failed"] for name in ("hidden", "known")] == [0, 0]
    assert main(["verify", str(run.folder)]) == 0, capsys.readouterr().out


def test_what_takes_the_truth_is_not_asked_of_them_and_counts_as_no_answer(half_known, tmp_path):
    root, city = half_known
    run = lodbench.run_method("lodlocv2", root, city=city, tilt="truth", runs=tmp_path / "runs")
    assert set(run.poses) == {"known/view_00.png", "known/view_01.png"}
    assert run.queries["failure"]["known/view_02.png"].endswith(
        "not asked, for that would take the true pose"
    )
    # The mean is over answers: what was not asked has drawn nothing.
    assert run.summary["splits"]["known"]["hypotheses_per_query"] == run.queries["hypotheses"].max()
    assert run.summary["splits"]["hidden"]["num_failed"] == 3


def test_the_answers_of_a_split_without_a_truth_are_reported(half_known, tmp_path, capsys):
    root, city = half_known
    words = ["dataset=folder", f"dataset.root={root}", f"city={city}", "method=prior_only"]
    assert main(["run", *words, f"paths.runs={tmp_path / 'runs'}"]) == 0
    reported = capsys.readouterr().out
    assert "3 of 3 queries have an answer" in reported
    assert "hidden/view_00.png" in reported


def test_rows_of_other_queries_have_another_protocol(tmp_path):
    """A run of one query and one of two were of one `protocol`: their recalls looked alike."""
    root, city = write_dataset(tmp_path / "town", count=2)
    runs = [
        lodbench.run_method(name, root, city=city, runs=tmp_path / "runs", limit=limit)
        for name, limit in (("prior_only", None), ("prior_only", 1), ("lodlocv2", None))
    ]
    table = lodbench.compare(runs)
    assert lodbench.compare(runs[0]).equals(lodbench.compare(runs[:1]))
    protocols = table[table["method"] != "Prior"].groupby("method")["protocol"].agg(set)
    alone, other = protocols["prior_only"], protocols[protocols.index != "prior_only"].item()
    assert len(alone) == 2
    assert other < alone


@pytest.mark.usefixtures("own_cache")
def test_what_ties_photos_together_names_the_folder_of_a_method_for_flights(dataset, tmp_path, caplog):
    entries = dataset.entries
    east = replace(dataset, entries=tuple(replace(entry, sequence="east") for entry in entries))
    placed = replace(dataset, entries=tuple(replace(e, reconstructed=e.prior) for e in entries))
    done = [run(Flying(), each, tmp_path) for each in (dataset, east, placed)]
    # Those that nothing names are said to be taken for one.
    assert caplog.text.count("taken for one flight each: 3 photos of ") == 2
    assert [each.resumed for each in done] == [0, 0, 0]
    assert len({each.folder for each in done}) == 3
    assert "flights" not in done[0].inputs
    # Photos that are asked one by one are the same however they belong together.
    caplog.clear()
    assert len({run(Scripted(), each, tmp_path).folder for each in (dataset, east, placed)}) == 1
    assert not caplog.text


@pytest.mark.slow
def test_flights_that_changed_since_are_reported_by_verify(tmp_path, capsys):
    root, city = write_dataset(tmp_path / "town", count=2)
    names = [entry.name for entry in open_folder(FolderParams(str(root), str(city))).entries]
    flights = root / "sequences.txt"
    flights.write_text("".join(f"{name} east\n" for name in names))
    done = lodbench.run_method("flight", root, city=city, runs=tmp_path / "runs")
    assert main(["verify", str(done.folder)]) == 0, capsys.readouterr().out
    flights.write_text("".join(f"{name} flight_{name}\n" for name in names))
    assert main(["verify", str(done.folder)]) == 1
    assert "flights" in capsys.readouterr().out


@pytest.mark.usefixtures("own_cache")
def test_masks_of_a_flight_are_held_no_larger_than_methods_need(dataset, tmp_path):
    class Masked(Flying):
        requires = frozenset({"mask"})

        def localize_flight(self, queries, city_map, streams):
            shapes.extend(query.mask.shape for query in queries)
            return super().localize_flight(queries, city_map, streams)

    class Wide(MaskFiles):
        def segment(self, entry):
            return np.ones((1200, 1600), np.float32)

    shapes = []
    method = Masked()
    settings = RunSettings(tmp_path / "runs", {"method": {"name": method.name}}, threads=1)
    run_method(method, dataset, Wide(MasksParams()), settings)
    assert shapes == [(903, 1204)] * 3


CAMERA = Camera(96, 72, 90.0, 90.0, 48.0, 36.0)


class Backwards:
    """Workers in this process, the last of whom is done first."""

    count = 3

    def __init__(self) -> None:
        self.items = 0

    def map(self, work, items):
        items = list(items)
        self.items += len(items)
        return map(work, reversed(items))


def test_large_calls_are_shared_and_small_ones_are_not() -> None:
    blocks = [box((w, s, b), (e - w, n - s, t - b)) for w, s, e, n, b, t in BOXES]
    own, workers = SilhouetteRenderer(scene_of(*blocks), 1), Backwards()
    shared = SharedScorer(own, workers, lambda part: score(own, part), part=16)
    rng = np.random.default_rng(0)
    centers = rng.uniform((-30, -30, 40), (30, 30, 90), (101, 3))
    rotations = rotations_at_yaws(30.0, 0.0, rng.uniform(-180, 180, 101))
    mask = own.render(CAMERA, Pose.from_center(rotations[3], centers[3]))
    assert mask.any()
    found, expected = (each.counts(CAMERA, rotations, centers, mask) for each in (shared, own))
    assert np.array_equal(found.intersection, expected.intersection)
    assert np.array_equal(found.union, expected.union)
    assert len(set(expected.intersection)) > 10
    assert workers.items == 7
    for fit in (IouFit(mask), BoundaryFit(mask)):
        assert np.array_equal(
            shared.fit(CAMERA, rotations, centers, fit), own.fit(CAMERA, rotations, centers, fit)
        )
    assert workers.items == 21
    shared.fit(CAMERA, rotations[:31], centers[:31], fit)
    shared.counts(CAMERA, rotations[:31], centers[:31], mask)
    assert workers.items == 21
    assert shared.threads == own.threads
