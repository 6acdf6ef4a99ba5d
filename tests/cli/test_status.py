"""`lodbench status`: how far a run is, without touching it."""

import json
import re
from pathlib import Path

import pytest

from lodbench.evaluation.predictions import Prediction
from lodbench.harness.runs.predict import open_predictions
from tests.town import write_dataset

pytestmark = pytest.mark.attack


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> tuple[Path, Path]:
    return write_dataset(tmp_path_factory.mktemp("town"), count=3)


def test_a_run_is_finished_then_torn_then_unreadable(lodbench, tmp_path, data):
    (data[0] / "masks" / "view_02.png").unlink()
    words = ["run", "dataset=folder", f"dataset.root={data[0]}", f"dataset.city_model={data[1]}"]
    done = lodbench(*words, "method.steps=2", "executor.threads=1")
    folder = tmp_path / re.search(r"results:\s+(\S+)", done.stdout)[1]
    said = lodbench("status", str(folder)).stdout
    assert "3 of 3 queries, finished" in said
    assert "1 x no mask in the masks folder" in said
    ledger = folder / "predictions.jsonl"
    torn = ledger.read_bytes().splitlines(keepends=True)[0] + b'{"key": "half'
    ledger.write_bytes(torn)
    said = lodbench("status", str(folder)).stdout
    assert re.search(r"1 of 3 queries, unfinished, about \d+ s of work left", said)
    assert ledger.read_bytes() == torn
    (folder / "plan.json").unlink()
    done = lodbench("status", str(folder))
    assert (done.returncode, "holds no run" in done.stderr) == (2, True)
    for keys in (5, None, [[1]]):
        (folder / "plan.json").write_text(json.dumps({"queries": keys}))
        assert lodbench("status", str(folder)).returncode in (0, 2)


def test_an_answer_of_another_form_is_one_line(lodbench, tmp_path):
    (tmp_path / "plan.json").write_text('{"queries": ["a"]}')
    ledger = open_predictions(tmp_path)
    ledger.record("a", {**Prediction(None, "no mask").to_json(), "failure": [[]]})
    done = lodbench("status", str(tmp_path))
    assert (done.returncode, "a is no prediction" in done.stderr) == (2, True)


def test_a_damaged_run_does_not_hide_those_after_it(lodbench, tmp_path):
    for name, text in (("a", "{"), ("b", '{"queries": ["x"]}')):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "plan.json").write_text(text)
    done = lodbench("status", str(tmp_path / "runs"))
    assert done.returncode == 2
    assert "a holds no run" in done.stderr
    assert "b: 0 of 1 query, unfinished" in done.stdout
