"""`segmenter=`: oracles made from the truth, random weights kept out of tables, photos that are not there."""

from __future__ import annotations

import csv
import json
import shutil

import pytest

from lodbench.cli import main
from tests.town import write_dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root, city = write_dataset(tmp_path_factory.mktemp("town"), count=2)
    shutil.rmtree(root / "masks")
    return root, city


def run(dataset, out, *words):
    data = [f"dataset.root={dataset[0]}", f"dataset.city_model={dataset[1]}", f"paths.runs={out}"]
    return main(["run", "dataset=folder", *data, "tilt=truth", *words])


def rows_of(out):
    (path,) = out.rglob("queries.csv")
    return list(csv.DictReader(path.open()))


def test_the_oracles_mask_is_the_silhouette(dataset, tmp_path, capsys):
    assert run(dataset, tmp_path, "segmenter=oracle") == 0
    assert "segmenter=oracle" in capsys.readouterr().out
    rows = rows_of(tmp_path)
    assert len(rows) == 2
    # Scored at half the size it was drawn at, so not quite 1.
    assert all(float(row["mask_iou"]) > 0.98 for row in rows)


@pytest.mark.parametrize("iou", [0.9, 0.6])
def test_the_noisy_oracle_is_as_wrong_as_asked(dataset, tmp_path, iou):
    assert run(dataset, tmp_path, "segmenter=noisy_oracle", f"segmenter.iou={iou}") == 0
    assert all(abs(float(row["mask_iou"]) - iou) < 0.02 for row in rows_of(tmp_path))


def test_an_impossible_iou_is_refused(dataset, tmp_path, capsys):
    assert run(dataset, tmp_path, "segmenter=noisy_oracle", "segmenter.iou=1.2") == 2
    assert "segmenter.iou=1.2" in capsys.readouterr().err


def test_a_dataset_without_photos_stops_a_network(dataset, tmp_path, capsys):
    bare = tmp_path / "bare"
    shutil.copytree(dataset[0], bare)
    shutil.rmtree(bare / "Query_image", ignore_errors=True)
    assert run((bare, dataset[1]), tmp_path / "runs", "segmenter=compact") == 2
    assert "the dataset has none" in capsys.readouterr().err


def test_random_weights_enter_no_table(dataset, tmp_path, capsys, monkeypatch):
    torch = pytest.importorskip("torch", reason="torch is not installed (extra [torch])")
    pytest.importorskip("transformers", reason="transformers is not installed (extra [models])")
    import cv2
    import numpy as np

    from lodbench.segmentation.sam2_unet import Sam2UNetSegmenter

    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))
    photos = tmp_path / "data"
    shutil.copytree(dataset[0], photos)
    (photos / "Query_image").mkdir(exist_ok=True)
    for line in (photos / "intrinsic.txt").read_text().splitlines():
        name, _, width, height, *_ = line.split()
        shape = (int(height), int(width), 3)
        cv2.imwrite(
            str(photos / "Query_image" / name), np.random.default_rng(0).integers(0, 255, shape, np.uint8)
        )

    class Stripes(torch.nn.Module):
        def forward(self, pictures):
            return (8 * torch.sin(pictures.sum(dim=1, keepdim=True)) - 4,)

    monkeypatch.setattr(Sam2UNetSegmenter, "build", lambda self, init: Stripes())
    assert run((photos, dataset[1]), tmp_path / "runs", "segmenter=sam2_unet", "segmenter.size=64") == 0
    printed = capsys.readouterr().out
    assert "INVALID, in no table: random weights" in printed
    assert "2m-2deg" not in printed
    (folder,) = (path.parent for path in (tmp_path / "runs").rglob("summary.json"))
    assert json.loads((folder / "summary.json").read_text())["invalid"] == "random weights"
    for command in (
        ["compare", str(folder)],
        ["leaderboard", "add", str(folder), "--root", str(tmp_path / "b")],
    ):
        assert main(command) == 2
        assert "random weights" in capsys.readouterr().err
