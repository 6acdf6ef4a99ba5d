"""One grammar and one vocabulary: --key value is key=value, city is city, and a slip is named."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from lodbench.cli.setting_help import Setting, settings_in, settings_of
from lodbench.errors import ConfigError
from lodbench.params import to_params
from tests.town import write_dataset


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


@pytest.mark.parametrize(
    ("words", "said", "hint"),
    [
        ("localize --citty x a.jpg", "no option --citty", "--city"),
        ("localize a.jpg", "required: --city", "--help"),
        ("compare", "required: RUN", "--help"),
        ("leaderboard", "required: add|build", "--help"),
        ("check-method", "required: NAME.", "--help"),
        ("check-plugin", "required: KIND, NAME.", "--help"),
        ("completion", "required: bash|zsh.", "--help"),
        (
            "generate-training-data city=x executor.share=hypotheses",
            "is not used: views are",
            "Leave executor",
        ),
        ("bench", "required: silhouettes|accuracy|", "--help"),
        ("compare --columns paper a b", "required: RUN", "Arguments go before options."),
        ("run --multirn seed=0,1", "has no option --multirn", "Did you mean --multirun?"),
        ("run dataset=demo seed=0,1", "seed=0,1 has several values", "Add --multirun for a run of each"),
        ("leaderboard add x --mapp y", "no option --mapp", "--map"),
        ("run --datset folder", "datset is not a setting", "dataset"),
        ("run root=town", "dataset.root is not a setting of dataset=demo", "It is one of dataset=folder, "),
        ("run --root town", "dataset.root is not a setting of dataset=demo", "It is one of --dataset folder"),
        ("run layers=[roads]", "layers is not a setting", "dataset.layers is one of dataset=folder, "),
        ("run dataset=folder --layers roads", "layers is not a setting", "Did you mean dataset.layers?"),
        ("run nothing.foo=3", "nothing.foo is not a setting", "Known: dataset, "),
        ("run prior=uniform prior.foo=3", "prior.foo is not a setting", "x_m"),
        ("run runner=subprocess runner.foo=3", "runner.foo is not a setting", "python"),
        ("generate-training-data city=x size=[128]", "size=[128] has 1 value, not 2", "size=[VALUE,VALUE]"),
        ("generate-training-data --city x --size 9", "--size 9 has 1 value, not 2", "--size [VALUE,VALUE]"),
        ("generate-training-data city=x look.noise=[0.01]", "look.noise=[0.01] has 1", "look.noise=[VALUE"),
        ("generate-training-data city=x sampling=priors poses=p prior_m=[1,2]", "prior_m=[1,2] has 2", "[V"),
        ("render city=x poses=p intrinsics=i out=o size=[1,2,3]", "size=[1,2,3] has 3", "size=[VALUE,VALUE]"),
        ("train data=x schedule.scale=[1]", "schedule.scale=[1] has 1 value", "schedule.scale=[VALUE,VALUE]"),
        ("train data=x schedule.scale=[2,1]", "schedule.scale=[2,1] is no asc", "schedule.scale=[LOW,HIGH]"),
    ],
)
def test_a_slip_is_one_line_and_a_hint(lodbench, words, said, hint):
    done = lodbench(*words.split())
    assert done.returncode == 2
    assert said in done.stderr
    assert hint in done.stderr.splitlines()[1]
    assert len(done.stderr.splitlines()) == 2


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
