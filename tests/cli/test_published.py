"""`lodbench run` on miniatures of published datasets, and with every segmenter."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.citymodel.textured_map import open_textured_map
from lodbench.cli import main
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.registry import open_dataset
from lodbench.segmentation.protocol import chosen_segmenter
from tests.data.own_layouts import DRONE, write_ortholoc
from tests.data.published_layouts import write_lodlocv2, write_swiss
from tests.town import write_dataset


def summary_of(folder: Path) -> dict:
    (path,) = folder.glob("runs/*/*/*/summary.json")
    return json.loads(path.read_text())


@pytest.mark.slow
def test_a_run_on_the_earth_centred_swiss_files(lodbench, tmp_path):
    root = write_swiss(tmp_path / "Schweiz (neu)", ecef=True)
    done = lodbench("run", "dataset=swiss_epflv2", f"dataset.root={root}", "tilt=truth", "split=in_place")
    assert done.returncode == 0, done.stderr
    assert "2 x LB510 TURNED_TO_ENU" in done.stdout
    summary = summary_of(tmp_path)
    # Exact masks: a frame or a direction mixed up would leave metres or all of it.
    assert summary["splits"]["in_place"]["recall"]["2m-2deg"] == 100.0
    assert list(summary["splits"]) == ["in_place"]


def test_a_run_on_the_colmap_tree_below_the_data_folder(lodbench, tmp_path):
    write_lodlocv2(tmp_path / "data_root")
    words = ("run", "dataset=uavd4l_lodv2", "method=prior_only")
    done = lodbench(*words, LODBENCH_DATA=str(tmp_path / "data_root"))
    assert done.returncode == 0, done.stderr
    splits = summary_of(tmp_path)["splits"]
    assert {name: split["num_queries"] for name, split in splits.items()} == {"in_traj": 2, "out_of_traj": 2}
    again = lodbench(*words, f"paths.data_root={tmp_path / 'data_root'}")
    assert again.returncode == 0
    assert "4 queries were there already" in again.stdout


@pytest.mark.parametrize("name", ["uavd4l_lod", "uavd4l_lodv2", "swiss_epfl", "swiss_epflv2"])
def test_absent_data_is_explained_on_one_screen(lodbench, tmp_path, name):
    done = lodbench("run", f"dataset={name}", LODBENCH_DATA=str(tmp_path / "nothing here"))
    assert done.returncode == 2
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    assert len(lines) <= 24
    assert f"  lodbench dataset check {name}" in lines
    assert not (tmp_path / "runs").exists()


def test_an_absent_city_model_is_explained_too(lodbench, tmp_path):
    root = write_swiss(tmp_path / "data", ecef=False)
    (root / "MODEL" / "swiss_LoD1_final.obj").unlink()
    done = lodbench("run", "dataset=swiss_epflv2", f"dataset.root={root}", "segmenter=masks")
    assert done.returncode == 2
    assert "city model: none of swiss_LoD1_final.obj" in done.stderr


def test_masks_that_are_not_there_stop_before_the_work(lodbench, tmp_path):
    root = write_swiss(tmp_path / "data", ecef=False)
    for folder in root.glob("Swiss-EPFL/*/masks"):
        folder.rename(folder.with_name("elsewhere"))
    done = lodbench("run", "dataset=swiss_epflv2", f"dataset.root={root}", "segmenter=masks")
    assert done.returncode == 2
    assert "segmenter=masks needs masks, and the dataset has none" in done.stderr
    assert not (tmp_path / "runs").exists()


def test_a_download_that_fetches_nothing_is_no_success(lodbench, tmp_path):
    done = lodbench("dataset", "download", "swiss_epfl", "--root", str(tmp_path))
    assert done.returncode == 1
    assert "cannot be downloaded automatically" in done.stdout
    assert "by hand: " in done.stdout


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

    from lodbench.segmentation.torch_segmenter import Sam2UNetSegmenter

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
    assert (
        run(
            (photos, dataset[1]),
            tmp_path / "runs",
            "segmenter=sam2_unet",
            "segmenter.weights=random",
            "segmenter.size=64",
        )
        == 0
    )
    printed = capsys.readouterr().out
    assert "INVALID, excluded from tables: random weights" in printed
    assert "2m-2deg" not in printed
    (folder,) = (path.parent for path in (tmp_path / "runs").rglob("summary.json"))
    assert json.loads((folder / "summary.json").read_text())["invalid"] == "random weights"
    for command in (
        ["compare", str(folder)],
        ["leaderboard", "add", str(folder), "--root", str(tmp_path / "b")],
    ):
        assert main(command) == 2
        assert "random weights" in capsys.readouterr().err


class TestNoneNamed:
    """Masks go before photos, what a dataset says before both; the reason is printed."""

    @pytest.fixture
    def with_masks(self, tmp_path):
        return write_dataset(tmp_path / "data", count=2)

    def config_of(self, out):
        (path,) = out.rglob("config.yaml")
        return OmegaConf.load(path)

    def test_masks_are_taken_where_there_are_any(self, with_masks, tmp_path, capsys):
        root, _ = with_masks
        (root / "masks" / "view_01.png").unlink()
        assert run(with_masks, tmp_path / "runs") == 0
        assert "segmenter=masks: 1 of 2 queries have masks" in capsys.readouterr().out
        assert self.config_of(tmp_path / "runs").segmenter == {"name": "masks"}

    @pytest.mark.slow
    def test_a_network_looks_at_photos_without_masks(self, with_masks, tmp_path, capsys, monkeypatch):
        monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))
        root, _ = with_masks
        # The masks are photos of a kind.
        shutil.rmtree(root / "Query_image", ignore_errors=True)
        (root / "masks").rename(root / "Query_image")
        assert run(with_masks, tmp_path / "runs") == 0
        printed = capsys.readouterr()
        assert "segmenter=efficient_unet: the dataset has photos and no masks" in printed.out
        assert "domain: synthetic" in printed.out
        assert self.config_of(tmp_path / "runs").segmenter.name == "efficient_unet"
        # The same as naming it: the same folder, nothing done twice.
        assert run(with_masks, tmp_path / "runs", "segmenter=efficient_unet") == 0
        assert "2 queries were there already" in capsys.readouterr().out

    def test_a_method_without_masks_is_told_of_no_segmenter(self, with_masks, tmp_path, capsys):
        assert run(with_masks, tmp_path / "runs", "method=prior_only") == 0
        printed = capsys.readouterr().out
        assert "takes another" not in printed
        assert "segmenter=masks" in printed  # the protocol of the table

    def test_a_dataset_may_say_which(self, with_masks):
        params = FolderParams(str(with_masks[0]), str(with_masks[1]))
        dataset = replace(open_folder(params), segmenter="compact")
        assert chosen_segmenter(dataset) == ("compact", "as folder says")

    def test_the_splits_that_are_run_count_alone(self, with_masks):
        dataset = open_folder(FolderParams(str(with_masks[0]), str(with_masks[1])))
        (split,) = dataset.splits
        bare = [replace(entry, split="bare", mask=None, image=entry.mask) for entry in dataset.entries]
        both = replace(
            dataset, splits=(split, "bare"), entries=(*dataset.entries, *bare), default_splits=(split,)
        )
        assert chosen_segmenter(both) == ("masks", "2 of 2 queries have masks made beforehand")
        assert chosen_segmenter(both, splits=("bare",))[0] == "efficient_unet"

    def test_neither_masks_nor_photos_is_a_fault(self, dataset, tmp_path, capsys):
        bare = tmp_path / "bare"
        shutil.copytree(dataset[0], bare)
        shutil.rmtree(bare / "Query_image", ignore_errors=True)
        assert run((bare, dataset[1]), tmp_path / "runs") == 2
        told = capsys.readouterr().err
        assert "None of the 2 queries of folder has a mask or a photo" in told
        assert not (tmp_path / "runs").exists()

    def test_a_basin_chooses_likewise(self, with_masks, tmp_path, capsys):
        root, city = with_masks
        words = [f"dataset.root={root}", f"dataset.city_model={city}", f"paths.runs={tmp_path / 'runs'}"]
        settings = ["ranges=[10]", "yaw_ranges=[]", "maps=false", "limit=1"]
        assert main(["basin", "dataset=folder", *words, *settings]) == 0
        assert "segmenter=masks: 2 of 2 queries" in capsys.readouterr().out


def test_masks_of_another_folder_and_what_verify_reads_again(tmp_path, capsys):
    """Shifted ones: the run must see these, verify must hash these, and the dataset's own must not count."""
    root, city = write_dataset(tmp_path / "town", count=2)
    theirs = tmp_path / "theirs"
    shutil.copytree(root / "masks", theirs)
    for path in theirs.iterdir():
        cv2.imwrite(str(path), np.roll(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), 40, axis=1))
    words = ["segmenter=masks", f"segmenter.folder={theirs}"]
    assert run((root, city), tmp_path / "own", "segmenter=masks", "method.steps=1") == 0
    assert run((root, city), tmp_path / "runs", *words, "method.steps=1") == 0
    assert max(float(row["mask_iou"]) for row in rows_of(tmp_path / "runs")) < 0.95
    assert min(float(row["mask_iou"]) for row in rows_of(tmp_path / "own")) == 1.0
    (folder,) = (path.parent for path in (tmp_path / "runs").rglob("summary.json"))
    assert main(["verify", str(folder)]) == 0, capsys.readouterr()
    capsys.readouterr()
    cv2.imwrite(str(next(iter(sorted(theirs.iterdir())))), np.zeros((240, 320), np.uint8))
    assert main(["verify", str(folder)]) == 1
    assert "masks" in capsys.readouterr().out
    assert run((root, city), tmp_path / "none", "segmenter=masks", f"segmenter.folder={tmp_path}") == 2
    assert "holds no mask of any image" in capsys.readouterr().err


def show_map(root: Path, is_plain: bool) -> None:
    """Draws in OrthoLoC's samples what their photos would show: the orthophoto, or a lawn with the tower."""
    dataset = open_dataset({"name": "ortholoc", "root": str(root)})
    scene = open_scene(dataset.city_model)
    city_map = CityMap(scene, textured=open_textured_map(dataset.textured_map, scene))
    for entry in dataset.entries:
        pose = dataset.truth[entry.key].shifted(-scene.origin)
        (shown,) = city_map.colour(entry.camera, pose.rotation[None], pose.center[None])
        if is_plain:
            lawn = np.random.default_rng(0).normal((50, 90, 60), 4, shown.shape).astype(np.uint8)
            tower = city_map.render(entry.camera, pose)[..., None]
            shown = np.where(tower, np.array([190, 90, 70], np.uint8), lawn)
        path = next(root.glob(f"full/{entry.split}/{Path(entry.name).stem}.npz"))
        with np.load(path) as arrays:
            changed = dict(arrays)
        np.savez(path, **{**changed, "image_query": shown})


@pytest.mark.parametrize(
    ("words", "is_found"),
    [("method=region", True), ("method=region dataset.focal=unknown", False), ("method=uavd4l", True)],
)
def test_methods_run_over_a_surface_model_with_its_orthophoto(
    lodbench, tmp_path, monkeypatch, words, is_found
):
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))
    write_ortholoc(tmp_path / "data", camera=DRONE.scaled(640, 480))
    show_map(tmp_path / "data", is_plain="region" in words)
    told = ["run", "dataset=ortholoc", f"dataset.root={tmp_path / 'data'}", "prior=uniform", *words.split()]
    done = lodbench(*told, LODBENCH_CACHE=str(tmp_path / "cache"))
    assert done.returncode == 0, done.stderr
    splits = summary_of(tmp_path)["splits"]
    assert {name: split["num_queries"] for name, split in splits.items()} == {
        "test_inPlace": 2,
        "test_outPlace": 1,
    }
    failed = {name: split["num_failed"] for name, split in splits.items()}
    assert failed == {"test_inPlace": 0, "test_outPlace": 0}
    if is_found:
        assert splits["test_inPlace"]["median_translation_m"] < 2.0
