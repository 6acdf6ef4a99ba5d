"""Whole commands of two builds in turns; whole runs in three ways, their bytes compared."""

import json
import sys
from pathlib import Path

import pytest

from lodbench.bench import commands
from lodbench.bench.commands import (
    Build,
    Cost,
    Row,
    StartupOptions,
    WorkerOptions,
    measure_startup,
    measure_workers,
)
from lodbench.cli import main
from lodbench.errors import ConfigError, LodbenchError

ROOT = Path(__file__).parents[2]


@pytest.fixture
def asked(monkeypatch):
    """The commands asked of each build, in order; the fastest take 1 s of this build, 3 s of the other."""
    words_of = []

    def run(self, words, environment=None):
        words_of.append((self.name, words[0], environment))
        once_more = sum(each[:2] == (self.name, words[0]) for each in words_of)
        if self.name == "beside" and words[0] == "doctor":
            raise LodbenchError("beside: lodbench doctor: no such command")
        slow = 10.0 if environment or once_more == 1 else 1.0 + 0.5 * (once_more == 2)
        return Cost(slow * (3.0 if self.name == "beside" else 1.0), slow, 100.0)

    whole = [("--help", ["--help"]), ("doctor", ["doctor"]), ("localize PHOTO --city", ["localize", "P"])]
    monkeypatch.setattr(Build, "run", run)
    monkeypatch.setattr(commands, "_commands", lambda options, scratch: iter(whole))
    return words_of


def test_the_least_of_each_counts_and_builds_take_turns(asked, tmp_path):
    (tmp_path / "lodbench").mkdir()
    done = []
    options = StartupOptions(repeats=2, beside_path=str(tmp_path), is_cold=True)
    report = measure_startup(options, lambda n, total: done.append((n, total)))
    assert [name for name, *_ in asked[:6]] == ["this build", "beside"] * 3
    assert done[-1] == (18, 18)
    figures = {each.figure: each for each in report.figures}
    assert figures["--help: CPU"].value == 1.0
    assert figures["--help: CPU"].ratio == 3.0
    assert (figures["--help: peak memory"].value, figures["--help: peak memory"].unit) == (100.0, "MiB")
    assert figures["doctor: CPU"].peer_value is None
    assert "no such command" in figures["doctor: CPU"].peer
    assert figures["localize, cold: CPU"].value == 10.0
    empty = [environment["NUMBA_CACHE_DIR"] for *_, environment in asked if environment]
    assert len(set(empty)) == 2
    assert "3.0x" in report.text
    assert "fails" in report.text


def test_without_another_build_there_is_no_peer(asked):
    report = measure_startup(StartupOptions(repeats=1))
    assert {name for name, *_ in asked} == {"this build"}
    assert all(each.peer == "" and each.ratio is None for each in report.figures)
    assert "beside" not in report.text


def test_a_command_of_this_build_that_fails_ends_it(monkeypatch):
    def run(self, words, environment=None):
        raise LodbenchError("this build: lodbench --help: broken")

    monkeypatch.setattr(Build, "run", run)
    monkeypatch.setattr(commands, "_commands", lambda options, scratch: iter([("--help", ["--help"])]))
    with pytest.raises(LodbenchError, match="broken"):
        measure_startup(StartupOptions(repeats=1))


def test_a_process_is_measured_with_what_it_starts(tmp_path):
    build = Build("own", Path(sys.executable), str(ROOT), tmp_path)
    cost = build.run(["--help"])
    assert 0 < cost.cpu_s < 60
    assert cost.wall_s > 0
    # That of the process alone, not of this one, which holds far more.
    assert 5 < cost.peak_mib < 60
    with pytest.raises(LodbenchError, match="own: lodbench nothing: There is no command"):
        build.run(["nothing"])


def test_another_build_is_the_one_of_its_folder(tmp_path):
    package = tmp_path / "other" / "lodbench"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "__main__.py").write_text("import sys; sys.exit('the other one')")
    row = Row("--help", ["--help"])
    row.measure(Build("beside", Path(sys.executable), str(package.parent), tmp_path))
    assert row.faults["beside"].endswith("the other one")


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"repeats": 0}, "repeats is at least 1"),
        ({"photo": __file__}, "localised in a city"),
        ({"beside": "no/such/python"}, "no/such/python does not exist"),
        ({"beside_path": str(ROOT / "docs")}, "There is no lodbench in"),
    ],
)
def test_wrong_settings_are_refused(settings, told):
    with pytest.raises(ConfigError, match=told):
        StartupOptions(**settings)


@pytest.mark.slow
def test_the_command_tells_all_rows(capsys):
    assert main(["bench", "startup", "--repeats", "1", "--json"]) == 0
    figures = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    names = [each["figure"] for each in figures]
    assert len(names) == len(set(names)) == 3 * 7
    assert all(each["value"] > 0 for each in figures)


@pytest.mark.slow
def test_three_ways_to_run(capsys) -> None:
    asked = ["--queries", "9", "--method", "prior_only", "--repeats", "1", "--json"]
    assert main(["bench", "workers", *asked]) == 0
    figures = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(figures) == 4
    assert all(each["value"] > 0 for each in figures if "whole" in each["figure"])
    assert figures[0]["ratio"] == pytest.approx(figures[0]["peer_value"] / figures[0]["value"])


def fake_run(monkeypatch, content) -> None:
    """Replaces commands by ones that write results and take no time."""

    def seconds(*command):
        from pathlib import Path

        folder = Path(command[-1].partition("=")[2]) / "demo" / "lodlocv2" / "0"
        again = folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        for name in ("poses.txt", "queries.csv", "summary.json"):
            (folder / name).write_text(content(command))
        whole_s = 5.0 if "executor=process" in command else 8.0 if "executor.threads=2" in command else 9.0
        return 1.0 if again else whole_s

    monkeypatch.setattr(commands, "seconds_of_command", seconds)


def test_the_queries_are_the_command_less_what_it_takes_when_all_is_there(monkeypatch) -> None:
    fake_run(monkeypatch, lambda command: "same")
    report = measure_workers(WorkerOptions(2))
    ratios = {each.figure: each.ratio for each in report.figures}
    assert ratios["2 workers of 1 thread, the whole command, beside serial, 1 thread"] == 9 / 5
    assert ratios["2 workers of 1 thread, its queries, beside serial, 1 thread"] == 8 / 4
    assert ratios["2 workers of 1 thread, its queries, beside serial, 2 threads"] == 7 / 4
    assert "2.00x" in report.text


def test_other_bytes_are_a_fault(monkeypatch) -> None:
    fake_run(monkeypatch, lambda command: "other" if "executor=process" in command else "same")
    with pytest.raises(LodbenchError, match="other bytes"):
        measure_workers(WorkerOptions(2))


def test_one_worker_is_none() -> None:
    with pytest.raises(ConfigError, match="workers at least 2"):
        WorkerOptions(workers=1)
