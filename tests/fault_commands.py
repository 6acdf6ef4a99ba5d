"""The commands that write, each as small as it can be, for the disks that fail under them."""

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.pose_text import FoundPose, lines_to_text
from lodbench.harness.tracing.outputs import write_tracing
from lodbench.harness.tracing.roofs import Traced
from tests.flight import stated
from tests.photos.dji_photo import exif_of, write_photo, xmp_packet
from tests.town import BOXES, CAMERA, true_poses, write_dataset

# What differs from one undisturbed run to the next: times, machine facts, and a key drawn once per cache.
TIMED = {"timings.csv", "provenance.json", "predictions.jsonl", "own_runs.key", "multirun.yaml"}
SECONDS = re.compile(rb'("(?:[a-z_]*seconds[a-z_]*|[a-z_]+_s)": )[-+.\de]+')
Words = list[str]
CRS = "EPSG:25832+7837"


@dataclass(frozen=True)
class Command:
    """A command under test.

    Attributes:
        name: For the counts.
        words: What is typed, in a folder.
        before: What is typed there before, undisturbed.
        timed: More files that hold times.
        is_once: Whether it refuses to write over what it wrote.
        remembered: Functions of the package whose result is the same in every trial.
    """

    name: str
    words: Callable[[Path], Words]
    before: tuple[Callable[[Path], Words], ...] = ()
    timed: tuple[str, ...] = ()
    is_once: bool = False
    remembered: tuple[str, ...] = ()

    def is_timed(self, path: Path) -> bool:
        """Tells whether a file differs from run to run."""
        return path.name in TIMED or path.name in self.timed

    def without_times(self, path: Path) -> bytes:
        """Returns a file's content, the seconds in JSON taken out."""
        content = path.read_bytes()
        return SECONDS.sub(rb"\1", content) if path.suffix == ".json" else content


def prepare_inputs(folder: Path) -> Path:
    """Writes a town of boxes with two queries, masks, photos, a drone's too, and views to train on."""
    root, _ = write_dataset(folder / "town", 2)
    truth = true_poses(2)
    (root / "Query_image").mkdir()
    for mask in sorted((root / "masks").iterdir()):
        photo = np.repeat(cv2.imread(str(mask))[:, :, :1] // 2 + 60, 3, axis=2)
        cv2.imwrite(str(root / "Query_image" / mask.name), photo)
        pose = truth[mask.name]
        stem = f"DJI_{mask.stem[-2:]}"
        (folder / "flight").mkdir(exist_ok=True)
        (folder / "flight_masks").mkdir(exist_ok=True)
        packet = xmp_packet(stated(pose, CAMERA, CRS))
        write_photo(folder / "flight" / f"{stem}.JPG", photo[..., 0], exif_of(), packet)
        shutil.copy(mask, folder / "flight_masks" / f"{stem}.png")
    write_dataset(folder / "three", 3)
    write_colmap(
        [FoundPose(name, "", pose, CAMERA) for name, pose in true_poses(3).items()], folder / "model"
    )
    _prepare_tracing(folder)
    for split, count in (("train", 3), ("val", 1)):
        for kind in ("images", "masks"):
            (folder / "views" / split / kind).mkdir(parents=True)
        for number in range(count):
            mask = np.zeros((64, 64), np.uint8)
            mask[10 : 40 + number, 12:50] = 255
            cv2.imwrite(str(folder / "views" / split / "masks" / f"{number}.png"), mask)
            picture = np.repeat(mask[:, :, None] // 2 + 20, 3, axis=2)
            cv2.imwrite(str(folder / "views" / split / "images" / f"{number}.png"), picture)
    return folder


def _prepare_tracing(folder: Path) -> None:
    """Writes a model with points of level ground, and a roof traced in two of its photos, the masks."""
    poses = true_poses(3)
    write_colmap([FoundPose(name, "", pose, CAMERA) for name, pose in poses.items()], folder / "traced")
    places = [(x, y) for x in range(-90, 91, 5) for y in range(-90, 91, 5)]
    lines = (f"{number} {x} {y} 0 0 0 0 0.5" for number, (x, y) in enumerate(places, start=1))
    (folder / "traced" / "points3D.txt").write_text(lines_to_text(lines))
    west, south, east, north, _, top = BOXES[4]
    roof = np.array([(west, south, top), (east, south, top), (east, north, top), (west, north, top)], float)
    pixels = {
        name: CAMERA.project(roof @ poses[name].rotation.T + poses[name].translation)
        for name in ("view_00.png", "view_01.png")
    }
    write_tracing([Traced("roof", "A", pixels)], folder / "traced.json")


def _data(folder: Path) -> Words:
    town = folder / "town"
    words = [f"dataset.root={town / 'data'}", f"dataset.city_model={town / 'city.obj'}"]
    return ["dataset=folder", *words, f"paths.runs={folder / 'runs'}"]


def _run(folder: Path) -> Words:
    return ["run", *_data(folder), "method=prior_only", "segmenter=masks", "executor.threads=1"]


def _found(folder: Path) -> Path:
    (run,) = (folder / "runs").glob("*/*/*/summary.json")
    return run.parent


def _of_run(*words: str) -> Callable[[Path], Words]:
    """Returns a command about the one run in a folder; ``{}`` stands for the folder."""
    return lambda folder: [
        str(_found(folder)) if word == "RUN" else word.replace("{}", str(folder)) for word in words
    ]


def _in(*words: str) -> Callable[[Path], Words]:
    return lambda folder: [word.replace("{}", str(folder)) for word in words]


def _search(folder: Path) -> Words:
    method = ["method=lodlocv2", "method.steps=1"]
    return ["run", *_data(folder), *method, "segmenter=compact", "executor.threads=1"]


def _basin(folder: Path) -> Words:
    options = ["ranges=[5,10]", "yaw_ranges=[]", "limit=1"]
    return ["basin", *_data(folder), "method=prior_only", "segmenter=masks", "executor.threads=1", *options]


def _convert(ending: str) -> Callable[[Path], Words]:
    return _in("city", "convert", "{}/town/city.obj", f"{{}}/town.{ending}")


GENERATE = _in(
    "generate-training-data",
    "city={}/town/city.obj",
    "out={}/set",
    "pitch=[40]",
    "height=[90]",
    "yaw=[0,180]",
    "size=[96,80]",
    "spacing_m=60",
    "labels=true",
    "depth=true",
    "workers=1",
    "val_share=0",
    "test_share=0",
)
TRAIN = _in(
    "train",
    "data={}/views",
    "out={}/net",
    "schedule.epochs=2",
    "schedule.batch=2",
    "schedule.crop=64",
    "schedule.val_every=1",
    "threads=1",
    "device=cpu",
)
IMPORT = _in(
    "dataset",
    "import",
    "lines",
    "{}/town/data/GT_pose.txt",
    "{}/own",
    "--city",
    "{}/town/city.obj",
    "--cameras",
    "{}/town/data/intrinsic.txt",
    "--images",
    "{}/town/data/Query_image",
)
RENDER = _in(
    "render",
    "city={}/town/city.obj",
    "poses={}/town/data/GT_pose.txt",
    "intrinsics={}/town/data/intrinsic.txt",
    "out={}/drawn",
    "kind=silhouette",
)
# Where the first photo's prior is, as a person would type it.
ABOUT = (
    *("--city", "{}/town/city.obj", "--center", "8", "5.5", "126", "--heading", "67", "--pitch", "-70"),
    *("--camera", "PINHOLE 320 240 230 228 161 118.5"),
)
PHOTO, MASK = "{}/town/data/Query_image/view_00.png", "{}/town/data/masks/view_00.png"
PLACED = ("--city", "{}/town/city.obj", "--crs", CRS)
ONE_STEP = ("--method", "lodlocv2", "--method-option", "steps=1")
START = ("--start", "{}/three/data/GPS_pose.txt")
TRACK = _in(
    "track",
    "{}/town/data/Query_image",
    "--masks",
    "{}/town/data/masks",
    *ABOUT,
    "--every",
    "2",
    "--out",
    "{}/track",
)
LOCALIZE = _in("localize", PHOTO, "--mask", MASK, *ABOUT, "--crs", CRS, *ONE_STEP, "--out", "{}/found")
LOCALIZE_START = _in(
    *("localize", PHOTO, "--mask", MASK, *ABOUT[:2], *ABOUT[-2:], *ONE_STEP, "--out", "{}/found"),
    *("--start", "{}/town/data/GPS_pose.txt"),
)
LOCATE = _in("locate", PHOTO, *PLACED, "--found", "{}/found", "--pixel", "160", "120")
TRACE = _in(
    *("trace", "{}/traced", "--images", "{}/three/data/masks", "--polygons", "{}/traced.json", "--metric"),
    *("--out", "{}/traced.city.json", "--benchmark", "{}/benchmark", "--queries", "view_02.png"),
)
EXPORTS = [word for kind in ("labelme", "coco", "geojson") for word in ("--export", kind)]

COMMANDS = [
    Command("run", _run),
    Command("run, masks made from photos", _search),
    Command("basin", _basin),
    Command("evaluate", lambda f: ["evaluate", *_data(f), f"poses={f / 'town/data/GPS_pose.txt'}"]),
    Command("report", _of_run("report", "RUN"), (_run,), timed=("report.html",)),
    Command("leaderboard add", _of_run("leaderboard", "add", "RUN", "--root", "{}/board"), (_run,)),
    Command(
        "leaderboard build",
        _in("leaderboard", "build", "--root", "{}/board"),
        (_run, _of_run("leaderboard", "add", "RUN", "--root", "{}/board")),
    ),
    *(
        Command(f"export {name}", _of_run("export", "RUN", "--format", name), (_run,))
        for name in ("colmap", "kapture", "tum", "nerfstudio", "csv", "parquet")
    ),
    Command("export geojson", _of_run("export", "RUN", "--format", "geojson", "--crs", CRS), (_run,)),
    *(
        Command(f"city convert to {name}", _convert(name))
        for name in ("scene", "obj", "ply", "glb", "city.json", "gml")
    ),
    Command("city convert over a scene", _convert("scene"), (_convert("scene"),)),
    Command("render", RENDER),
    Command("localize", _in("localize", PHOTO, "--mask", MASK, *ABOUT, *ONE_STEP, "--out", "{}/found")),
    Command("localize from rough poses", LOCALIZE_START),
    Command("locate", LOCATE, (LOCALIZE,)),
    Command(
        "localize a flight",
        _in("localize", "{}/flight", "--masks", "{}/flight_masks", *PLACED, "--out", "{}/found"),
        remembered=("lodbench.harness.photo.flights._solve",),
    ),
    Command(
        "dataset init",
        _in("dataset", "init", "{}/own", "--images", "{}/flight", *PLACED),
        timed=("dataset.json",),
        is_once=True,
    ),
    Command(
        "georeference",
        _in("georeference", "{}/model", "--masks", "{}/three/data/masks", *PLACED, *START, "--out", "{}/geo"),
        remembered=("lodbench.harness.georeference._solved",),
    ),
    Command("track", TRACK),
    Command("trace", TRACE, timed=("dataset.json",), is_once=True),
    Command("mask", _in("mask", PHOTO, "--mask", MASK, "--no-page", "--out", "{}/mask.png", *EXPORTS)),
    Command(
        "run, many poses drawn",
        lambda f: ["run", *_data(f), "method=mcloc", "method.steps=1", "executor.threads=1"],
    ),
    Command("compare, a page", _of_run("compare", "RUN", "--format", "html", "--out", "{}/c.html"), (_run,)),
    Command("compare, a picture", _of_run("compare", "RUN", "--budget", "{}/budget"), (_run,)),
    Command(
        "city check",
        _in("city", "check", "{}/town/city.obj", "--crs", "EPSG:25832", "--geojson", "{}/f.geojson"),
    ),
    Command("dataset card", _in("dataset", "card", "demo", "--out", "{}/cards")),
    Command(
        "bench, a picture",
        _in("bench", "segmentation", "--data", "{}/views", "--segmenter", "compact", "--pictures", "{}/p"),
    ),
    # The seal in dataset.json is of the cache's key.
    Command("dataset import", IMPORT, timed=("dataset.json",), is_once=True),
    Command(
        "dataset prior", _in("dataset", "prior", "{}/town/data", "--kind", "uniform", "--out", "{}/p.txt")
    ),
    Command(
        "dataset make-demo",
        _in("dataset", "make-demo", "{}/demo", "--num-queries", "2"),
        remembered=tuple(
            f"lodbench.synthesis.town.build.{name}"
            for name in (
                "grow_town",
                "demo_props",
                "citygml_text",
                "relief_text",
                "ascii_grid_text",
                "open_scene",
                "make_splits",
            )
        ),
    ),
    Command(
        "generate-training-data",
        GENERATE,
        remembered=("lodbench.synthesis.generate.make_surroundings",),
    ),
    Command("train", TRAIN),
]
