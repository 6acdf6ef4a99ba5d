"""Help, completion, hints: settings and flags say what they mean, and what computes little loads little."""

import argparse
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from lodbench.cli.parser import COMMANDS, Parser, load_command, waiting
from lodbench.cli.settings import SETTINGS_COMMANDS, config_text, groups_of, settings_in, settings_of_group
from lodbench.cli.shell import main, usage
from lodbench.errors import ConfigError
from lodbench.plugins import config_files
from tests.citymodel.gml_text import box_city

FLAGGED = [name for name in COMMANDS if name not in SETTINGS_COMMANDS]
GROUPS = {group for name in SETTINGS_COMMANDS for group in groups_of(name)}


@pytest.mark.parametrize("command", SETTINGS_COMMANDS)
def test_every_setting_of_a_command_has_a_meaning(command):
    settings = list(settings_in(config_text(command)))
    assert len(settings) > 3
    assert [setting.key for setting in settings if not setting.meaning] == []


@pytest.mark.parametrize(
    ("key", "folder", "name"),
    sorted({(group.key, group.folder, name) for group in GROUPS for name in config_files(group.folder)}),
)
def test_every_setting_of_a_group_has_a_meaning(key, folder, name):
    settings = settings_of_group(key, folder, name)
    assert [setting.key for setting in settings if not setting.meaning] == []


def test_the_help_shows_them(capsys):
    assert main(["run", "dataset=views", "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    seed = next(line for line in lines if line.startswith("  seed=0"))
    assert "the same seed gives the same numbers" in seed
    assert next(line for line in lines if "dataset.num_views=100" in line).split()[1:]
    # As it is to be typed: the other name goes.
    assert any(line.startswith("  city=???") for line in lines)
    assert not any("dataset.city_model" in line for line in lines)


def test_commands_stand_in_groups_of_the_help():
    blocks = [block.splitlines() for block in usage().split("\n\n")]
    groups = [[line.split()[0] for line in lines[1:]] for lines in blocks if lines[0].endswith(":")][1:]
    assert [name for names in groups for name in names] == list(COMMANDS)
    assert len(groups) > 3


def test_the_help_shows_no_setting_that_the_command_refuses(capsys):
    for executor in ("process", "dask"):
        assert main(["generate-training-data", f"executor={executor}", "--help"]) == 0
        told = capsys.readouterr().out
        assert "executor.timeout_s=" in told
        assert "executor.share=" not in told
    assert main(["run", "executor=process", "--help"]) == 0
    assert "executor.share=queries" in capsys.readouterr().out


def test_no_example_of_train_sets_the_weights_that_it_refuses(lodbench):
    told = lodbench("train", "--help").stdout.splitlines()
    examples = [line for line in told if line.startswith("  lodbench train")]
    assert "segmenter.encoder_weights=" in examples[-1]
    assert not [line for line in examples if "segmenter.weights=" in line]


def test_the_groups_are_those_of_the_configuration():
    kinds = {group.folder for group in GROUPS}
    assert {"method", "dataset", "segmenter", "prior", "source", "executor", "schedule", "training"} <= kinds


class Left(Exception):
    """Left a command once its parser was known."""


def parsers_of(command: str):
    """Returns the parsers of a command and its actions."""
    run = load_command(COMMANDS[command][0])
    module = sys.modules[run.__module__]
    found: list[argparse.ArgumentParser] = []

    def keep(parser):
        found.append(parser)
        raise Left

    waiting.append(keep)
    try:
        for words in [[name] for name in getattr(module, "ACTIONS", {})] or [[]]:
            with pytest.raises(Left):
                run(words)
    finally:
        waiting.remove(keep)
    for parser in found:
        for action in parser._actions:
            found.extend(getattr(action, "_name_parser_map", {}).values())
    return found


@pytest.mark.parametrize("command", FLAGGED)
def test_every_flag_has_a_meaning(command):
    parsers = parsers_of(command)
    assert parsers
    for parser in parsers:
        bare = [
            action.option_strings or action.dest
            for action in parser._actions
            if not action.help and not hasattr(action, "_name_parser_map")
        ]
        assert bare == [], parser.prog


SLIPS = [
    *([name, "--no-such-flag", "3"] for name in COMMANDS),
    *([name, "-x"] for name in COMMANDS),
    *([name, "a", "b", "c", "d"] for name in COMMANDS),
    *([name] for name in COMMANDS if name not in ("run", "basin", "doctor")),
    *(["bench", name, "--seed", "many"] for name in ("silhouettes", "accuracy", "evaluation")),
    ["bench", "silhouete"],
    ["bench", "accuracy", "--area", "nort"],
    ["bench", "accuracy", "--camera-height", "40"],
    ["mask", "a.jpg", "--export", "geo"],
    ["city", "inof", "a"],
    ["leaderboard", "bild"],
    ["compare", "a", "--format", "pdf"],
]


@pytest.mark.parametrize("words", SLIPS, ids=" ".join)
def test_no_slip_is_answered_with_a_wall(capsys, monkeypatch, tmp_path, words):
    monkeypatch.chdir(tmp_path)
    code = main(words)
    out, err = capsys.readouterr()
    assert "usage:" not in err.lower()
    assert "Error executing job" not in out + err
    assert "Traceback" not in err
    if words == ["dataset"]:  # says what there is
        assert code == 2
        return
    assert code == 2, out
    told = [line for line in err.splitlines() if not line.startswith("training ")]
    assert told[0].startswith("lodbench: ")
    assert len(told) <= 2


def test_words_of_a_list_may_stand_on_both_sides_of_a_flag():
    parser = Parser("lodbench try")
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--lod")
    asked = parser.parse_args(["a.gml", "--lod", "2", "b.gml", "c.gml"])
    assert asked.files == [Path("a.gml"), Path("b.gml"), Path("c.gml")]
    with pytest.raises(ConfigError, match="unrecognized arguments: -x"):
        parser.parse_args(["a.gml", "--lod", "2", "b.gml", "-x"])


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("ru", ["run"]),
        ("run meth", ["method="]),
        ("run method=con", ["method=contour_alignment"]),
        ("run method=region method.fine_w", ["method.fine_width="]),
        ("run ci", ["city="]),
        ("generate-training-data look=v", ["look=varied"]),
        ("train schedule=p", ["schedule=paper"]),
        ("localize --cit", ["--city"]),
        ("dataset ch", ["check"]),
        ("dataset check --hea", ["--headers-only"]),
        ("leaderboard bu", ["build"]),
        ("leaderboard add --ma", ["--map"]),
        ("completion z", ["zsh"]),
        ("mask --export co", ["coco"]),
        ("nothing x", []),
        ("run seed=1", []),
    ],
)
def test_the_answers(lodbench, words, expected):
    assert lodbench("__complete", *words.split()).stdout.splitlines() == expected


@pytest.mark.parametrize("words", [["mask"], ["mask", "--mask"], ["localize", "a.jpg", "--city"]])
def test_nothing_stands_before_files(lodbench, words):
    assert lodbench("__complete", *words, "").stdout == ""


def in_shell(shell: str, script: str) -> list[str]:
    if shutil.which(shell) is None:
        pytest.skip(f"there is no {shell} on this machine")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        [shell, "-c", script], capture_output=True, text=True, timeout=120, env={**os.environ, "PATH": path}
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("lodbench local", ["localize"]),
        # Bash parts words at "=": what is offered is what stands behind it.
        ("lodbench run method=con", ["contour_alignment"]),
        ("lodbench run meth", ["method="]),
    ],
)
def test_in_bash(line, expected):
    script = f"""
        source <(lodbench completion bash)
        COMP_LINE={line!r} COMP_POINT={len(line)}
        _lodbench
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    assert in_shell("bash", script) == expected


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("lodbench local", ["localize"]),
        ("lodbench run method=con", ["method=contour_alignment"]),
        ("lodbench run meth", ["method="]),
    ],
)
def test_in_zsh(words, expected):
    # Outside of its editor zsh completes nothing: what the function offers is printed instead.
    script = f"""
        autoload -U compinit && compinit -D -u 2>/dev/null
        source <(lodbench completion zsh)
        compadd() {{ while [[ $1 != -- ]]; do shift; done; shift; print -l -- "$@" }}
        words=({words}) CURRENT={len(words.split())}
        _lodbench
    """
    assert in_shell("zsh", script) == expected


OUT = "Leave prior.takeoff_m or prior.heights=sea_level out; prior.heights=takeoff uses prior.takeoff_m."


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("prior.takeoff_m=60 prior.heights=sea_level", OUT),
        ("prior.heights=barometer", "prior.heights=barometer is unknown"),
    ],
)
def test_a_hint_has_the_syntax_that_was_typed(capsys, words, told):
    assert main(["run", "dataset=demo", "prior=sensor", *words.split()]) == 2
    assert told in capsys.readouterr().err


# What takes a tenth of a second and more, or reads files of its own.
HEAVY = (
    "numba", "scipy", "pandas", "cv2", "hydra", "omegaconf", "matplotlib", "shapely", "torch", "pyarrow",
    "jinja2", "trimesh", "lodbench.kernels.compiled",
)  # fmt: skip
LIGHT = {
    "--help": ("--help",),
    "run --help": ("run", "--help"),
    "run method=region --help": ("run", "method=region", "--help"),
    "run method=auto --help": ("run", "method=auto", "--help"),
    "train --help": ("train", "--help"),
    "dataset list": ("dataset", "list"),
    "dataset card": ("dataset", "card", "demo"),
    "doctor --help": ("doctor", "--help"),
    "city info": ("city", "info", "tile.gml"),
}
PACKAGES = (
    "lodbench", "lodbench.cli", "lodbench.geometry", "lodbench.citymodel", "lodbench.citymodel.cache",
    "lodbench.rendering", "lodbench.citymap", "lodbench.methods", "lodbench.methods.region",
    "lodbench.evaluation", "lodbench.execution", "lodbench.storage", "lodbench.harness",
    "lodbench.harness.doctor", "lodbench.datasets.published.catalogue",
)  # fmt: skip
PROBE = """
import sys
{code}
print("loaded:", [name for name in {heavy} if name in sys.modules], file=sys.stderr)
"""


def loaded(code: str, folder: Path) -> str:
    """Returns what some code says, and which of the heavy packages it loaded."""
    command = [sys.executable, "-c", PROBE.format(code=code, heavy=HEAVY)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stderr.strip().splitlines()[-1]


@pytest.mark.parametrize("command", LIGHT)
def test_a_light_command_loads_nothing_heavy(command, tmp_path):
    (tmp_path / "tile.gml").write_text(box_city())
    code = (
        f"from lodbench.cli import main\ntry:\n    code = main({LIGHT[command]!r})\n"
        "except SystemExit as end:\n    code = end.code\nassert code == 0"
    )
    assert loaded(code, tmp_path) == "loaded: []"


def test_the_help_of_localize_loads_no_compiler(tmp_path):
    code = (
        "from lodbench.cli import main\ntry:\n    main(['localize', '--help'])\nexcept SystemExit:\n    pass"
    )
    assert loaded(code, tmp_path) == "loaded: ['scipy']"


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_loads_nothing_heavy(package, tmp_path):
    assert loaded(f"import {package}", tmp_path) == "loaded: []"


def test_the_command_line_loads_no_arrays_before_a_command_is_chosen(tmp_path):
    assert loaded("import lodbench.cli\nassert 'numpy' not in sys.modules", tmp_path) == "loaded: []"
