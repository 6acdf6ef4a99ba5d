"""Settings as they are typed: quoted, misspelt, of another choice, and composed by Hydra."""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path

import hydra
import pytest

from lodbench.citymodel import open_scene
from lodbench.cli.hydra_app import plain, register_config_sources, single_job
from lodbench.cli.options import option_pairs
from lodbench.cli.run import with_date
from lodbench.cli.settings import Setting, settings_in, settings_of
from lodbench.datasets.pose_text import format_camera, format_pose, lines_to_text
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.params import to_params
from tests.citymodel.gml_text import box_rings, city, member, solid_of, write
from tests.town import write_dataset

from .test_faults import is_clear
from .test_run import STABLE


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--dataset folder --city x.gml", "dataset=folder dataset.city_model=x.gml"),
        ("--city=x.gml root=d", "dataset.city_model=x.gml dataset.root=d"),
        ("-m method=a,b --limit 3", "-m method=a,b limit=3"),
        ("--cfg job seed=1", "--cfg job seed=1"),
        ("--method.steps 3", "method.steps=3"),
    ],
)
def test_flags_are_settings(words, expected):
    assert settings_of("run", words.split()) == expected.split()


def test_of_other_commands_a_city_is_a_setting_of_its_own():
    assert settings_of("render", ["--city", "x.gml"]) == ["city=x.gml"]


@pytest.mark.parametrize(("words", "said"), [("--city", "--city has no value"), ("-x 1", "has no option -x")])
def test_a_flag_that_is_none_is_told(words, said):
    with pytest.raises(ConfigError, match=said):
        settings_of("run", words.split())


def test_a_run_takes_flags_and_tells_the_former_name(lodbench, tmp_path):
    root, city = write_dataset(tmp_path / "town", count=1)
    done = lodbench("run", "--dataset", "folder", "--root", root, "--city", city, "--method", "prior_only")
    assert done.returncode == 0, done.stderr
    assert "now called" not in done.stderr
    done = lodbench(
        "run", "dataset=folder", f"dataset.root={root}", f"dataset.city_model={city}", "method=prior_only"
    )
    assert done.returncode == 0
    assert "dataset.city_model= is now called city=" in done.stderr


@dataclass(frozen=True)
class _Inner:
    ends: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class _Outer:
    names: tuple[str, ...] = ()
    angles: list[float] | None = None
    inner: _Inner = field(default_factory=_Inner)


def test_one_value_stands_for_a_list_of_one_and_a_pair_in_a_group_is_counted():
    made = to_params({"names": 7, "angles": 30}, _Outer, "")
    assert (list(made.names), made.angles) == (["7"], [30.0])
    with pytest.raises(ConfigError, match=r"world\.inner\.ends=\[1\] has 1 value, not 2\."):
        to_params({"inner": {"ends": [1]}}, _Outer, "world")


def test_the_former_flag_of_a_city_works_and_tells_the_new_one(lodbench, tmp_path):
    root, city = write_dataset(tmp_path / "town", count=1)
    words = ["run", "dataset=folder", f"dataset.root={root}", f"city={city}", "method=prior_only"]
    run = lodbench(*words).stdout.split("results:")[1].split()[0]
    done = lodbench("verify", run, "--city-model", str(city))
    assert done.returncode == 0, done.stderr
    assert "--city-model is now called --city" in done.stderr


def test_the_help_says_what_each_setting_means(lodbench):
    text = lodbench("run", "method=region", "--help").stdout
    assert "tilt=prior" in text
    assert "prior: the sensor's pitch and roll" in text
    # Of the file's comments, and where it has none of the parameters' own words.
    assert "method.range_x_m=20.0" in text
    assert "metres" in next(line for line in text.splitlines() if "method.range_x_m=" in line)
    assert "others: auto, cadloc, contour_alignment" in text
    assert ", region" not in text
    for command in ("basin", "evaluate", "render", "train", "generate-training-data"):
        done = lodbench(command, "--help")
        assert done.returncode == 0
        assert "Settings: key=value" in done.stdout


def test_settings_of_a_file_have_their_comments():
    text = "# about\ndefaults:\n  - a: b\nname: x\nwidth: 3 # pixels\npaths:\n  runs: runs # where\n"
    text += "hydra:\n  a: 1\n"
    assert list(settings_in(text)) == [
        Setting("name", "x", ""), Setting("width", "3", "pixels"), Setting("paths.runs", "runs", "where")
    ]  # fmt: skip


def test_status_finds_the_runs_below_a_folder(lodbench, tmp_path):
    root, city = write_dataset(tmp_path / "town", count=1)
    for tilt in ("prior", "truth"):
        lodbench("run", "dataset=folder", f"root={root}", f"city={city}", "method=prior_only", f"tilt={tilt}")
    done = lodbench("status", "runs")
    assert done.returncode == 0
    assert done.stdout.count("1 of 1 query, finished") == 2
    assert lodbench("status", str(root)).returncode == 2


@dataclass(frozen=True)
class OfKinds:
    steps: int = 1
    width_m: float = 1.0
    maps: bool = True
    ranges: list[float] = field(default_factory=list)


@pytest.mark.parametrize(
    ("given", "told", "hint"),
    [
        ({"steps": "a"}, "method.steps is a, not a whole number.", "Write method.steps=2, for instance."),
        ({"steps": 1.5}, "method.steps is 1.5, not a whole number.", "Write method.steps=2, for instance."),
        ({"width_m": "a"}, "method.width_m is a, not a number.", "Write method.width_m=2.5, for instance."),
        ({"maps": "a"}, "method.maps is a, not true or false.", "Write method.maps=true, for instance."),
        (
            {"ranges": [5, "a"]},
            "method.ranges[1] is a, not a number.",
            "Write method.ranges=[2.5], for instance.",
        ),
    ],
)
def test_a_value_of_another_kind_says_which_is_wanted(given, told, hint):
    with pytest.raises(ConfigError) as fault:
        to_params(given, OfKinds, "method")
    assert (fault.value.message, fault.value.hint) == (told, hint)


CAMERA = Camera(320, 240, 300.0, 300.0, 160.0, 120.0)
PLATEAU = "city/plateau/53395404_bldg_6697_op.gml"
NRW = "city/germany_lod2/LoD2_32_280_5657_1_NW.gml"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> tuple[Path, Path]:
    return write_dataset(tmp_path_factory.mktemp("town"), count=1)


def run_words(dataset: tuple[Path, Path], *more: str) -> list[str]:
    return ["run", "dataset=folder", f"dataset.root={dataset[0]}", f"dataset.city_model={dataset[1]}", *more]


def artefacts(root: Path) -> dict[str, bytes]:
    (folder,) = (root / "folder" / "lodlocv2").iterdir()
    return {"folder": folder.name.encode(), **{name: (folder / name).read_bytes() for name in STABLE}}


class TestCache:
    def test_same_bytes_with_and_without(self, lodbench, tmp_path, dataset):
        (tmp_path / "file").write_text("no folder")
        for name, cache in (("new", "own"), ("mapped", "own"), ("none", "file")):
            words = run_words(dataset, f"paths.runs={name}")
            done = lodbench(*words, LODBENCH_CACHE=str(tmp_path / cache))
            assert done.returncode == 0, done.stderr
        assert len(list((tmp_path / "own" / "scenes").iterdir())) == 1
        assert artefacts(tmp_path / "new") == artefacts(tmp_path / "mapped") == artefacts(tmp_path / "none")

    def test_a_second_run_parses_nothing(self, lodbench, tmp_path, shared_data, monkeypatch):
        words = [
            "city=" + str(shared_data / PLATEAU),
            "source=plateau",
            *view_of(shared_data / PLATEAU, tmp_path),
        ]
        cache = {"LODBENCH_CACHE": str(tmp_path / "own")}
        assert lodbench("render", *words, "out=first", **cache).returncode == 0

        def parse(*_: object, **__: object) -> None:
            raise AssertionError("the city was read again")

        monkeypatch.setattr("lodbench.citymodel.read.read_city_model", parse)
        assert lodbench("render", *words, "out=second", **cache).returncode == 0
        first, second = ((tmp_path / name / "view.png").read_bytes() for name in ("first", "second"))
        assert first == second
        with pytest.raises(AssertionError, match="read again"):
            lodbench("render", *words, "out=third", LODBENCH_CACHE=str(tmp_path / "empty"))


def view_of(city: Path, folder: Path, lod: str | None = None) -> list[str]:
    """Writes a view straight down on the middle of a city; returns the words that name it."""
    scene = open_scene(city, lod=lod)
    low, high = scene.extent_m
    center = 0.5 * (low + high) + scene.origin
    center[2] = high[2] + 300.0
    pose = Pose.from_euler(EulerAngles(0.0, 0.0, 0.0), center)
    (folder / "poses.txt").write_text(lines_to_text([format_pose("view.png", pose)]))
    (folder / "cameras.txt").write_text(lines_to_text([format_camera("view.png", CAMERA)]))
    return [f"poses={folder / 'poses.txt'}", f"intrinsics={folder / 'cameras.txt'}"]


class TestSource:
    def test_a_converted_city_gives_the_same_poses(self, lodbench, tmp_path, dataset):
        poses = []
        for suffix in ("obj", "json", "scene"):
            target = tmp_path / f"city.{suffix}"
            done = lodbench("city", "convert", str(dataset[1]), str(target))
            assert done.returncode == 0, done.stderr
            words = run_words((dataset[0], target), f"paths.runs={suffix}")
            done = lodbench(*words)
            assert done.returncode == 0, done.stderr
            poses.append(artefacts(tmp_path / suffix)["poses.txt"])
        assert poses[0] == poses[1] == poses[2]

    def test_findings_are_notes_of_the_run(self, lodbench, tmp_path, dataset):
        text = dataset[1].read_text() + "v 0 0 0\nv 1 0 0\nv 2 0 0\nf -3 -2 -1\n"
        (tmp_path / "city.obj").write_text(text)
        for _ in range(2):  # read, then from the cache
            done = lodbench(*run_words((dataset[0], tmp_path / "city.obj")))
            assert "note: city model: " in done.stdout
            assert "1 x LB104 ZERO_AREA" in done.stdout

    def test_options_need_not_stand_in_the_profile(self, lodbench, tmp_path, dataset):
        terrain = tmp_path / "Gelände, neu (1).asc"
        terrain.write_text("ncols 1\nnrows 1\nxllcorner -5000\nyllcorner -5000\ncellsize 10000\n0\n")
        words = run_words(dataset, "method=prior_only", f"source.options.terrain={terrain}")
        done = lodbench(*words, "source.options.base=sunk", "source.options.sunk_m=0")
        assert done.returncode == 0, done.stderr
        (folder,) = (tmp_path / "runs" / "folder" / "prior_only").iterdir()
        config = (folder / "config.yaml").read_text()
        assert "base: sunk" in config
        assert str(tmp_path) not in config  # content names inputs, paths do not

    def test_the_same_houses_elsewhere_are_another_run(self, lodbench, tmp_path, dataset):
        for east in (0, 7):
            words = run_words(dataset, "method=prior_only", f"source.options.origin=[{east},0,0]")
            assert lodbench(*words).returncode == 0
        assert len(list((tmp_path / "runs" / "folder" / "prior_only").iterdir())) == 2

    def test_levels_are_derived_for_pictures(self, lodbench, tmp_path, shared_data):
        city = shared_data / NRW
        words = [f"city={city}", "source=adv_lod1", *view_of(city, tmp_path)]
        is_clear(lodbench("render", *words, "out=o"), "level of detail 1")
        assert not (tmp_path / "o").exists()
        done = lodbench("render", *words, "out=o", "roof_height=max")
        assert done.returncode == 0, done.stderr
        assert "LB408 LOD_DERIVED" in done.stdout
        assert (tmp_path / "o" / "view.png").is_file()

    def test_a_folder_of_tiles_is_a_city_model(self, lodbench, tmp_path, shared_data):
        (tmp_path / "tiles").mkdir()
        for name in ("plateau/64412288_bldg_6697_op.gml", "plateau/64413325_bldg_6697_op.gml"):
            data = (shared_data / "city" / name).read_bytes()
            (tmp_path / "tiles" / Path(name).name).write_bytes(data)
        done = lodbench("city", "info", "tiles", "--json", "--source", "plateau")
        assert json.loads(done.stdout)["buildings"] == 35


def test_lists_of_words_in_options_need_no_quotes():
    words = ["classes=[building, my house]", "scales=[0.5,1]", 'names=["a,b"]', "none=[]", "text=[a"]
    assert option_pairs(words) == {
        "classes": ["building", "my house"],
        "scales": [0.5, 1],
        "names": ["a,b"],
        "none": [],
        "text": "[a",
    }


@pytest.mark.parametrize("end", ["2015-06-30", None])
def test_a_run_writes_down_a_date_at_which_its_city_stood_if_any_building_ends(tmp_path, end):
    """On any later day it reads the same city; without ends nothing of it depends on the day."""
    box = solid_of(box_rings())
    over = f"<core:terminationDate>{end}</core:terminationDate>" if end else ""
    path = write(tmp_path / "a.gml", city(member(over + box, "old") + member(box, "new")))
    source = {"name": "folder", "options": {"is_strict": True}}
    given = Dataset("own", "1", tmp_path, path, None, (), (), {})
    dataset, dated = with_date(given, source)
    assert dated["options"] == {"is_strict": True} | ({"date": end} if end else {})
    assert dataset.city_options.date == end
    assert with_date(dataset, dated) == (dataset, dated)
    if end is None:
        assert (dataset is given, dated is source) == (True, True)


def test_date_is_an_option_of_every_command_that_reads_a_city(lodbench, tmp_path):
    box = solid_of(box_rings())
    over = "<core:terminationDate>2015-06-30</core:terminationDate>"
    path = write(tmp_path / "a.gml", city(member(over + box, "old") + member(box, "new")))
    counts = [
        json.loads(lodbench("city", "info", str(path), "--json", *more).stdout)["buildings"]
        for more in ((), ("--date", "2015-06-29"), ("--option", "date=2015-06-29"))
    ]
    assert counts == [1, 2, 2]
    done = lodbench("city", "info", str(path), "--date", "29.6.2015")
    assert (done.returncode, "--date 2015-06-30" in done.stderr) == (2, True)
    for command in ("localize", "georeference", "track"):
        assert "--date" in lodbench(command, "--help").stdout


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["method=region", "dataset=views", "dataset.city_model=a.obj", "seed=3", "split=[a,b]"],
        ["+note=${hydra:runtime.choices.method}", "++source.options.q=1", "tilt=truth"],
    ],
    ids=["as it stands", "choices", "what Hydra knows"],
)
def test_it_is_that_of_hydra_s_own_entry(monkeypatch, words):
    register_config_sources()
    expected = []
    monkeypatch.setattr(sys, "argv", ["lodbench run", *words])
    entry = hydra.main(config_path="pkg://lodbench.conf", config_name="run", version_base="1.3")
    entry(lambda config: expected.append(plain(config)))()
    assert plain(single_job("run", words)) == expected[0]
    assert not words or plain(single_job("run", [])) != expected[0]
