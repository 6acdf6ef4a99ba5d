"""The package of docs/plugins.md: built, installed on its own, used whole, and broken part by part."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

from tests.town import BOXES, write_dataset

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"```\w+\n(?:# |<!-- )(pyproject\.toml|skyline/[\w./]+)(?: -->)?\n(.*?)```", re.DOTALL)

# Runs commands in forks of a process that has imported lodbench: [[argv, ...], ...] to [[code, output], ...].
DRIVER = """
import json, os, sys, tempfile, traceback
import lodbench.cli.run, lodbench.cli.dataset, lodbench.harness.conformance

def call(words):
    with tempfile.TemporaryFile("w+") as told:
        child = os.fork()
        if child == 0:
            os.dup2(told.fileno(), 1), os.dup2(told.fileno(), 2)
            code = 70
            try:
                code = lodbench.cli.main(words)
            except SystemExit as end:
                code = end.code
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush(), sys.stderr.flush()
                os._exit(code)
        _, status = os.waitpid(child, 0)
        told.seek(0)
        return [os.waitstatus_to_exitcode(status), told.read()]

json.dump([call(words) for words in json.load(sys.stdin)], sys.stdout)
"""


class Environment:
    """A virtual environment with lodbench, what it needs, and the package."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.python = folder / "env" / "bin" / "python"
        source = folder / "source"
        for path, text in BLOCK.findall((ROOT / "docs" / "plugins.md").read_text()):
            (source / path).parent.mkdir(parents=True, exist_ok=True)
            (source / path).write_text(text)
        (source / "skyline" / "__init__.py").write_text("")
        venv.create(folder / "env", with_pip=False)
        # What is installed here, lodbench's checkout too: nothing is fetched.
        (self.site / "here.pth").write_text(
            f"import site; site.addsitedir({sysconfig.get_paths()['purelib']!r})\n"
        )
        install = [sys.executable, "-m", "pip", "--python", str(self.python), "install", "-q", "--no-index"]
        self._run([*install, "--no-deps", "--no-build-isolation", str(source)])
        self.package = self.site / "skyline"
        assert self.package.is_dir()
        root, self.city = write_dataset(folder / "town")
        self.root = root.rename(folder / "alps")  # the name of its one split
        shutil.copytree(self.root / "masks", self.root / "Query_image")  # as good as photos here
        self.blocks = folder / "town.blocks"
        self.blocks.write_text("".join(f"b{k},{','.join(map(str, box))}\n" for k, box in enumerate(BOXES)))
        (folder / "poses.xyz").write_text("view_00.png,1,2,120,25,0,-70\n")

    @property
    def site(self) -> Path:
        (site,) = (self.folder / "env").glob("lib/python*/site-packages")
        return site

    def _run(self, words: list[str], given: str = "") -> str:
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "LODBENCH", "COV_"))}
        kept["LODBENCH_CACHE"] = str(self.folder / "cache")
        done = subprocess.run(
            words, cwd=self.folder, env=kept, input=given, capture_output=True, text=True, timeout=900
        )
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
        return done.stdout

    def call(self, *commands: list[str]) -> list[tuple[int, str]]:
        told = self._run([str(self.python), "-c", DRIVER], json.dumps(commands))
        return [(code, text) for code, text in json.loads(told)]

    @property
    def data(self) -> list[str]:
        return [f"dataset.root={self.root}", f"dataset.city_model={self.city}"]

    @property
    def run(self) -> list[str]:
        return [
            "run",
            "dataset=alps",
            f"dataset.root={self.root}",
            f"dataset.city_model={self.city}",
            "limit=1",
        ]


@pytest.fixture(scope="module")
def env(tmp_path_factory) -> Environment:
    return Environment(tmp_path_factory.mktemp("outside"))


# Kind, name, the module it is in, and further words for its check.
PARTS = [
    ("method", "halfway", "method"),
    ("segmenter", "bright", "segmenter"),
    ("feature-extractor", "corners", "matching"),
    ("matcher", "shift", "matching"),
    ("dataset", "alps", "dataset"),
    ("prior", "north", "prior"),
    ("pose-format", "xyz", "poses"),
    ("export-format", "table", "export"),
    ("city-reader", "blocks", "city"),
    ("renderer", "painter", "renderer"),
    ("fit", "area", "fit"),
]


def test_each_part_keeps_to_its_protocol(env):
    samples = {"xyz": env.folder / "poses.xyz", "blocks": env.blocks}
    commands = [
        ["check-plugin", kind, name, *(["--sample", str(samples[name])] if name in samples else [])]
        for kind, name, _ in (
            *PARTS,
            ("metric", "worst", "metric"),
            ("command", "horizon", "command"),
            ("pose-solver", "plain", "solver"),
            ("retrieval", "thumbnail", "retrieval"),
        )
    ]
    for words, (code, told) in zip(commands, env.call(*commands), strict=True):
        assert code == 0, (words, told)
        assert "skyline 1.0" in told
        assert "conforms to the protocol" in told
    wanted = ["check-plugin", "segmenter", "bright", "segmenter.threshold=1"]
    (tried, wrong) = env.call(wanted, [*wanted, "method.threshold=1"])
    assert (tried[0], wrong[0]) == (0, 2)
    assert "method.threshold=1 is not a setting of a segmenter" in wrong[1]
    assert "Write segmenter.KEY=VALUE." in wrong[1]
    ((code, told),) = env.call(["check-plugin", "source", "cantons"])
    assert (code, "reader blocks" in told) == (0, True), told


def test_each_part_is_used_by_the_commands(env):
    views = [f"poses={env.root / 'GT_pose.txt'}", f"intrinsics={env.root / 'intrinsic.txt'}", "out=drawn"]
    evaluated = [
        "poses=poses.xyz",
        "format=xyz",
        f"dataset.root={env.root}",
        f"dataset.city_model={env.city}",
    ]
    commands = {
        "method": [*env.run, "method=halfway", "method.up_m=3", "segmenter=masks"],
        "segmenter": [*env.run, "method=halfway", "segmenter=bright", "segmenter.threshold=1"],
        "prior": [*env.run, "method=halfway", "segmenter=masks", "prior=north", "prior.by_m=8"],
        "renderer": ["render", f"city={env.city}", *views, "renderer=painter"],
        "fit": [*env.run, "segmenter=masks", "method=lodlocv2", "method.fit=area", "method.steps=1"],
        "source": ["city", "info", str(env.blocks), "--source", "cantons"],
        "source of a run": [
            "run", "dataset=folder", f"dataset.root={env.root}", f"dataset.city_model={env.blocks}",
            "source=cantons", "method=halfway", "segmenter=masks", "limit=1",
        ],
        "poses": ["evaluate", "dataset=folder", *evaluated],
        "list": ["dataset", "list"],
        "card": ["dataset", "card", "alps"],
        "check": ["dataset", "check", "alps", "--root", str(env.root), "--city", str(env.city)],
        "help": ["run", "--help"],
        "command": ["horizon", str(env.city)],
        "doctor": ["doctor"],
        "thorough doctor": ["doctor", "--thorough"],
    }  # fmt: skip
    told = dict(zip(commands, env.call(*commands.values()), strict=True))
    for what, (code, text) in told.items():
        assert code == 0, (what, text)
    text = {what: words for what, (_, words) in told.items()}
    assert "halfway" in text["method"]
    assert "8 m north of the truth" in text["prior"]
    assert text["command"].endswith(" m\n")
    assert len(list((env.folder / "drawn").glob("*.png"))) == 3
    assert "lodlocv2" in text["fit"]
    assert "buildings" in text["source"]
    assert "7" in text["source"]
    assert "alps          Three views of the Alps (package skyline 1.0)" in text["list"]
    assert text["card"].startswith("---\nid: alps\n")
    assert "3 with a true pose (its card says 3)" in text["check"]
    for name in ("halfway", "bright", "alps", "north", "cantons"):
        assert name in text["help"], name
    for kind, name, _ in PARTS:
        assert f"{kind} {name}" in text["doctor"]
        assert f"{kind} {name}" in text["thorough doctor"]


def test_unknown_names_are_told_with_those_of_plug_ins(env):
    commands = [
        ["run", "method=halfwy"], ["run", "dataset=alp"], ["run", "renderer=pointer"], ["run", "prior=nort"],
        ["city", "info", str(env.blocks), "--source", "canton"], ["dataset", "check", "alp"],
        ["dataset", "card", "alp"],
    ]  # fmt: skip
    names = ["halfway", "alps", "painter", "north", "cantons", "alps", "alps"]
    for words, name, (code, told) in zip(commands, names, env.call(*commands), strict=True):
        assert (code, name in told) == (2, True), (words, told)


# A command that chooses the part, by module.
def choices(env: Environment) -> dict[str, list[str]]:
    return {
        "method": [*env.run, "method=halfway", "segmenter=masks"],
        "segmenter": [*env.run, "method=halfway", "segmenter=bright"],
        "matching": ["check-plugin", "matcher", "shift"],
        "dataset": [*env.run, "method=halfway"],
        "prior": [*env.run, "method=halfway", "prior=north"],
        "poses": ["evaluate", "dataset=folder", *env.data, "poses=poses.xyz", "format=xyz"],
        "export": ["check-plugin", "export-format", "table"],
        "city": ["city", "info", str(env.blocks), "--source", "cantons"],
        "renderer": [*env.run, "method=halfway", "segmenter=masks", "renderer=painter"],
        "fit": [*env.run, "method=lodlocv2", "method.fit=area"],
    }


@pytest.mark.parametrize("module", sorted({module for _, _, module in PARTS}))
def test_a_broken_part_harms_only_who_chooses_it(env, module):
    file = env.package / f"{module}.py"
    sound = file.read_text()
    try:
        file.write_text("raise RuntimeError('broken on purpose')\n")
        (code, told), *rest = env.call(
            choices(env)[module], ["dataset", "list"], ["check-plugin", "prior", "file"]
        )
    finally:
        file.write_text(sound)
    assert code == (1 if module in ("matching", "export") else 2), told
    assert f"of the package skyline 1.0 is broken: skyline.{module}:" in told
    assert "RuntimeError: broken on purpose" in told
    assert "Traceback" not in told
    for fine, said in rest:
        assert fine == 0, said


def test_with_all_parts_and_the_configuration_broken_the_rest_works(env):
    (info,) = env.site.glob("skyline-*.dist-info")
    points, yaml = info / "entry_points.txt", env.package / "conf" / "method" / "halfway.yaml"
    files = [points, yaml, *(env.package / f"{module}.py" for _, _, module in PARTS)]
    sound = {file: file.read_text() for file in files}
    ours = ["run", "dataset=folder", *env.data, "method=prior_only", "limit=1"]
    try:
        for file in files[2:]:
            file.write_text("raise RuntimeError('broken on purpose')\n")
        yaml.write_text("name: [halfway\n")
        (lost, told), (code, said), (_, doctor) = env.call(
            [*env.run, "method=halfway"], ours, ["doctor", "--thorough"]
        )
        assert (lost, code) == (2, 0), told + said
        assert "Traceback" not in told
        assert doctor.count("broken on purpose") == len(PARTS)
        points.write_text(sound[points].replace("skyline.conf", "skyline.gone"))
        (lost, told), (code, said) = env.call([*env.run, "method=halfway"], ours)
        assert (lost, code) == (2, 0), told + said
    finally:
        for file, text in sound.items():
            file.write_text(text)
