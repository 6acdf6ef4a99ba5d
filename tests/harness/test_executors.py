"""Runs over processes and over Dask: the files of a serial run, byte for byte, whoever dies."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from pathlib import Path

import pytest

from lodbench.cli import main
from lodbench.errors import LodbenchError
from lodbench.execution.executor import ExecutorParams, spread
from tests.town import write_dataset

SAME = ("config.yaml", "poses.txt", "queries.csv", "summary.json", "priors.txt")


def run(tmp_path: Path, name: str, *more: str) -> dict[str, bytes]:
    words = [f"dataset.root={tmp_path / 'town/data'}", f"dataset.city_model={tmp_path / 'town/city.obj'}"]
    words += ["method.steps=2", "segmenter=masks", f"paths.runs={tmp_path / name}"]
    assert main(["run", "dataset=folder", *words, *more]) == 0
    (folder,) = (tmp_path / name).glob("*/*/*")
    return {file: (folder / file).read_bytes() for file in SAME}


@pytest.fixture(scope="module")
def serial(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes]]:
    folder = tmp_path_factory.mktemp("executors")
    write_dataset(folder / "town", 5)
    return folder, run(folder, "serial")


def test_two_processes(serial) -> None:
    folder, expected = serial
    assert run(folder, "process", "executor=process", "executor.workers=2") == expected


def test_dask(serial) -> None:
    pytest.importorskip("distributed")
    folder, expected = serial
    assert run(folder, "dask", "executor=dask", "executor.workers=2") == expected


def test_a_scheduler_that_is_not_there(serial, capsys, monkeypatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("lodbench.execution.executor._CONNECT_S", 1)
    words = [f"dataset.root={serial[0] / 'town/data'}", f"dataset.city_model={serial[0] / 'town/city.obj'}"]
    more = ["segmenter=masks", f"paths.runs={serial[0] / 'none'}", "executor=dask"]
    assert main(["run", "dataset=folder", *words, *more, "executor.address=tcp://127.0.0.1:9"]) == 2
    assert "scheduler tcp://127.0.0.1:9 does not answer" in capsys.readouterr().err


@dataclass
class Deadly:
    """Kills the process it is prepared in at some items, as often as files can be taken away."""

    folder: Path


_deadly: list[Deadly] = []


def prepare(deadly: Deadly) -> None:
    _deadly[:] = [deadly]


def square_or_die(item: int) -> int:
    lives = _deadly[0].folder / f"{item}"
    if lives.exists():
        lives.unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    return item * item


# A single worker takes all it was given with it.
@pytest.mark.parametrize(("name", "workers"), [("process", 3), ("dask", 3), ("dask", 1)])
def test_what_a_dead_worker_was_at_is_done_again(tmp_path: Path, name: str, workers: int) -> None:
    if name == "dask":
        pytest.importorskip("distributed")
    for item in (3, 11):
        (tmp_path / f"{item}").touch()
    executor = ExecutorParams(name, workers=workers)
    results = sorted(spread(executor, square_or_die, range(20), prepare, (Deadly(tmp_path),)))
    assert results == [item * item for item in range(20)]
    assert not list(tmp_path.iterdir())


def die(item: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return item


def test_workers_that_keep_dying_end_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(LodbenchError, match="keep dying"):
        list(spread(ExecutorParams("process", workers=2), die, range(4), prepare, (Deadly(tmp_path),)))
