"""What comes from strangers and from full disks ends in one line, and steers no terminal."""

import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from lodbench.cli import main
from lodbench.harness.runs.predict import predict
from lodbench.methods.lodlocv2 import LodLocV2
from tests.town import write_dataset

pytestmark = pytest.mark.attack

ESCAPE = "\x1b]0;owned\x07\x1b[2J"


def run_words(root, city, *more):
    return ["run", "dataset=folder", f"dataset.root={root}", f"dataset.city_model={city}", *more]


def test_a_split_with_a_space_in_its_name_is_refused_before_any_work(lodbench, tmp_path):
    root, city = write_dataset(tmp_path / "town")
    shutil.move(root, tmp_path / "parts" / "in place")
    done = lodbench(*run_words(tmp_path / "parts", city))
    assert done.returncode == 2
    assert "The split 'in place'" in done.stderr
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("name", ["x\x1b[31m", "a\u202eb", "a\nb"])
def test_a_split_that_would_steer_a_terminal_is_refused(lodbench, tmp_path, name):
    root, city = write_dataset(tmp_path / "town")
    shutil.move(root, tmp_path / "parts" / name)
    done = lodbench(*run_words(tmp_path / "parts", city))
    assert done.returncode == 2
    assert "control character" in done.stderr
    assert "\x1b" not in done.stderr


def test_a_split_is_chosen_by_a_name_beyond_ascii(lodbench, tmp_path):
    root, city = write_dataset(tmp_path / "town")
    shutil.move(root, tmp_path / "parts" / "hügel")
    words = run_words(tmp_path / "parts", city, "split=hügel", "method=prior_only", "segmenter=masks")
    assert lodbench(*words).returncode == 0
    assert (
        lodbench("dataset", "check", "folder", "--root", tmp_path / "parts", "--city", city).returncode == 0
    )


def test_a_folder_of_one_split_may_have_a_space_in_its_name(lodbench, tmp_path):
    root, city = write_dataset(tmp_path / "my town")
    done = lodbench(*run_words(root, city, "method=prior_only", "segmenter=masks"))
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "runs").glob("*/*/*")
    assert lodbench("verify", folder).returncode == 0


def test_what_a_job_raises_is_not_blamed_on_the_command_line(lodbench, tmp_path, monkeypatch):
    def broken(*args):
        raise ValueError("a mistake of ours")

    monkeypatch.setattr("lodbench.cli.run.run_config", broken)
    with pytest.raises(ValueError, match="a mistake of ours"):
        lodbench("run", "dataset=demo")


def test_a_full_disk_is_one_line_that_names_the_file(lodbench, tmp_path, monkeypatch):
    root, city = write_dataset(tmp_path / "town")

    def full(self, stream, content, path):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("lodbench.storage.disk.Disk.write", full)
    done = lodbench(*run_words(root, city, "method=prior_only", "segmenter=masks"))
    assert done.returncode == 2
    assert done.stderr.splitlines()[0].startswith("lodbench: ")
    assert "runs/folder/" in done.stderr.splitlines()[0]
    assert "No space left on device" in done.stderr.splitlines()[0]
    assert len(done.stderr.splitlines()) == 2


def test_a_mask_replaced_after_it_was_read_is_noticed_at_the_end(lodbench, tmp_path, monkeypatch):
    root, city = write_dataset(tmp_path / "town")
    masks = sorted((root / "masks").iterdir())
    words = run_words(root, city, "method=lodlocv2", "method.steps=1", "segmenter=masks")
    with monkeypatch.context() as patch:
        real = LodLocV2.localize

        def localize(self, *more):
            masks[0].write_bytes(masks[1].read_bytes())
            return real(self, *more)

        patch.setattr(LodLocV2, "localize", localize)
        done = lodbench(*words)
    assert done.returncode == 2
    assert "The masks changed while the run was going on" in done.stderr
    (folder,) = (tmp_path / "runs").glob("*/lodlocv2/*")
    assert not (folder / "predictions.jsonl").exists()
    assert not (folder / "poses.txt").exists()
    assert lodbench(*words).returncode == 0
    assert len(list((tmp_path / "runs").glob("*/lodlocv2/*/poses.txt"))) == 1


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("which", "executor"),
    [
        ("masks", "serial"),
        ("masks", "process"),
        ("Query_image", "serial"),
        pytest.param("Query_image", "process", marks=pytest.mark.nightly),
    ],
)
def test_a_file_that_is_replaced_during_a_run_and_put_back_leaves_no_answer(
    lodbench, tmp_path, monkeypatch, which, executor
):
    root, city = write_dataset(tmp_path / "town")
    shutil.copytree(root / "masks", root / "Query_image")
    method = ["lodlocv2", "segmenter=masks", "method.steps=1"] if which == "masks" else ["region"]
    words = run_words(root, city, f"method={method[0]}", *method[1:], f"executor={executor}")
    files = sorted((root / which).iterdir())
    held = files[1].read_bytes()
    with monkeypatch.context() as patch:

        def replaced_meanwhile(*more):
            files[1].write_bytes(files[0].read_bytes())
            try:
                return predict(*more)
            finally:
                files[1].write_bytes(held)

        patch.setattr("lodbench.harness.runs.run.predict", replaced_meanwhile)
        done = lodbench(*words)
    assert done.returncode == 2
    assert f"{files[1]} changed while it was in use" in done.stderr
    (folder,) = (tmp_path / "runs").glob("*/*/*")
    stored = folder / "predictions.jsonl"
    assert not stored.exists() or files[1].stem not in stored.read_text()
    assert not (folder / "poses.txt").exists()
    assert lodbench(*words).returncode == 0
    assert (folder / "poses.txt").exists()


def test_aliases_of_aliases_in_a_run_s_configuration_are_refused_at_once(lodbench, tmp_path):
    bomb = "a: &a [x, x, x, x, x, x, x, x]\n"
    for one, two in zip("abcdefg", "bcdefgh", strict=True):
        bomb += f"{two}: &{two} [{', '.join([f'*{one}'] * 8)}]\n"
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text(bomb)
    for name in ("poses.txt", "queries.csv", "summary.json", "provenance.json"):
        (tmp_path / "run" / name).write_text("{}")
    started = time.monotonic()
    done = lodbench("verify", "run")
    assert done.returncode == 2
    assert time.monotonic() - started < 20


@pytest.mark.parametrize("where", ["stdout", "stderr"])
def test_no_terminal_sequence_of_data_reaches_the_terminal(lodbench, tmp_path, where):
    name = f"town{ESCAPE}"
    text = "v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 3\n" if where == "stdout" else "f 1 2\n"
    (tmp_path / f"{name}.obj").write_text(text)
    done = lodbench("city", "info", f"{name}.obj")
    assert "town" in getattr(done, where)
    assert "\x1b" not in done.stdout + done.stderr
    assert "\x07" not in done.stdout + done.stderr


def test_no_line_on_standard_error_steers_a_terminal(capsys, monkeypatch):
    def tell(words):
        sys.stderr.write(f"\r|{ESCAPE}| \u202e1 of 2\n")
        return 0

    monkeypatch.setattr("lodbench.cli.stored_runs.main_status", tell)
    assert main(["status"]) == 0
    assert capsys.readouterr().err == "\r||  1 of 2\n"


def test_warnings_steer_no_terminal_either(capsys, monkeypatch):
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # pytest's: the command line has none
    main(["city", "info", "nowhere.gml"])
    logging.getLogger("lodbench.somewhere").warning("A name: %s", ESCAPE)
    said = capsys.readouterr().err
    assert "A name:" in said
    assert "\x1b" not in said


@pytest.mark.nightly
def test_what_a_killed_make_demo_left_is_swept_up(tmp_path):
    command = [
        sys.executable,
        "-m",
        "lodbench",
        "dataset",
        "make-demo",
        str(tmp_path / "demo"),
        "--num-queries",
        "2",
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    while not (parts := list(tmp_path.glob(".demo.*/*"))) and process.poll() is None:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert parts
    assert main(["dataset", "make-demo", str(tmp_path / "demo"), "--num-queries", "2"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["demo"]


@pytest.mark.parametrize("stated", ["a\0b.obj", "loop/a.obj", "a\ud800.obj", "a" * 5000, "a/" * 5000])
def test_a_city_of_no_possible_name_is_one_line(capsys, tmp_path, stated):
    root, _ = write_dataset(tmp_path / "town", 1)
    (root / "loop").symlink_to("loop")
    (root / "dataset.json").write_text(json.dumps({"city_model": stated}))
    for words in (["run", "dataset=folder", f"dataset.root={root}"], ["dataset", "check", str(root)]):
        assert main([*words]) in (1, 2)
        told = capsys.readouterr()
        assert "Traceback" not in told.err + told.out
        assert "is no name of a file" in told.err + told.out


@pytest.mark.parametrize("crs", [7, ["EPSG:25832"], {}, "no such", "a\0b", "\ud800", "x" * 100_000])
def test_a_reference_system_of_no_possible_name_is_one_line(capsys, tmp_path, crs):
    root, city = write_dataset(tmp_path / "town", 1)
    (root / "dataset.json").write_text(json.dumps({"city_model": str(city), "crs": crs}))
    assert main([*run_words(root, city), "method=prior_only", f"paths.runs={tmp_path / 'runs'}"]) in (0, 2)
    told = capsys.readouterr()
    assert "Traceback" not in told.err
    assert max(map(len, told.err.splitlines()), default=0) < 1000


@pytest.mark.parametrize("stated", ["../pipe.obj", "{}/pipe.obj", "/proc/self/environ", "link/pipe.obj"])
def test_no_city_outside_a_stranger_s_dataset_is_opened(capsys, tmp_path, stated):
    root, city = write_dataset(tmp_path / "town", 2)
    os.mkfifo(root.parent / "pipe.obj")  # whoever opens it waits for ever
    (root / "link").symlink_to(root.parent)
    (root / "dataset.json").write_text(
        json.dumps({"city_model": stated.format(root.parent), "seal": "0" * 64})
    )
    words = ["run", "dataset=folder", f"dataset.root={root}", "method=prior_only", "segmenter=masks"]
    words.append(f"paths.runs={tmp_path / 'runs'}")
    assert main(words) == 2
    assert "There is no city model to localise against" in capsys.readouterr().err
    # Named by the user it is this city that counts, whatever the dataset says.
    assert main([*words, f"dataset.city_model={city}"]) == 0
    assert main(["dataset", "check", str(root)]) == 1
    assert "names a city model outside the dataset" in capsys.readouterr().out


def test_a_city_that_is_a_pipe_or_a_device_is_refused(capsys, tmp_path):
    root, _ = write_dataset(tmp_path / "town", 2)
    os.mkfifo(root / "pipe.obj")
    (root / "dataset.json").write_text(json.dumps({"city_model": "pipe.obj"}))
    assert main(["run", "dataset=folder", f"dataset.root={root}", "method=prior_only"]) == 2
    assert main(["city", "info", "/dev/zero"]) == 2
    assert capsys.readouterr().err.count("is neither a file nor a folder") == 2
