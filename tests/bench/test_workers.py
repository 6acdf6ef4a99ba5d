"""`lodbench bench workers`: whole runs in three ways, their bytes compared."""

import json

import pytest

from lodbench.bench import evaluation
from lodbench.bench.evaluation import WorkerOptions, measure_workers
from lodbench.cli import main
from lodbench.errors import ConfigError, LodbenchError


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

    def seconds(command):
        from pathlib import Path

        folder = Path(command[-1].partition("=")[2]) / "demo" / "lodlocv2" / "0"
        again = folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        for name in ("poses.txt", "queries.csv", "summary.json"):
            (folder / name).write_text(content(command))
        whole_s = 5.0 if "executor=process" in command else 8.0 if "executor.threads=2" in command else 9.0
        return 1.0 if again else whole_s

    monkeypatch.setattr(evaluation, "_seconds", seconds)


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
