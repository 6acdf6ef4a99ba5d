"""Mutated files for the readers other than those of cities: an answer or a ``LodbenchError``, and soon.

``make fuzz`` tries 100,000 over all readers; the tests try a slice.
"""

import io
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
from PIL import Image

from lodbench.citymodel import open_scene
from lodbench.citymodel.scene_file import read_scene, write_scene
from lodbench.cli import main
from lodbench.cli.verify import read_config
from lodbench.datasets.pose_files import read_pose_file
from lodbench.datasets.pose_text import read_cameras, read_hypotheses, read_poses
from lodbench.errors import ConfigError, LodbenchError
from lodbench.execution import Ledger
from lodbench.harness.runs.stored import read_run, read_status
from lodbench.photos.metadata import read_photo_metadata
from lodbench.reporting.leaderboard import read_entries
from lodbench.segmentation.masks import read_mask
from lodbench.segmentation.onnx_file import onnx_fault
from tests.citymodel.test_fuzz import mutate
from tests.segmentation.test_onnx_check import small_network
from tests.town import write_dataset

# A mutated file of some kilobytes that takes longer has found a loop, seconds.
LIMIT_S = 20.0
XMP = b"""<x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description drone-dji:GimbalPitchDegree="-45.0" drone-dji:RelativeAltitude="+80.1"/>
</rdf:RDF></x:xmpmeta>"""


def targets(folder: Path) -> list[tuple[str, Path, Callable[[], object]]]:
    """Returns name, file to mutate and reader; the files are made by lodbench itself."""
    root, city = write_dataset(folder / "town", 2)
    words = [
        "dataset=folder",
        f"dataset.root={root}",
        f"dataset.city_model={city}",
        f"paths.runs={folder / 'runs'}",
    ]
    with redirect_stdout(io.StringIO()):
        assert main(["run", *words, "method=prior_only", "segmenter=masks"]) == 0
        (run,) = (folder / "runs").glob("*/*/*")
        assert main(["leaderboard", "add", str(run), "--root", str(folder / "board")]) == 0
        for name in ("colmap", "kapture", "tum", "nerfstudio", "csv"):
            out = folder / ("table" if name == "csv" else name)
            assert main(["export", str(run), "--format", name, "--out", str(out)]) == 0
    write_scene(open_scene(city), folder / "a.scene")
    photo = folder / "photo.jpg"
    exif = Image.Exif()
    exif[0x010F] = "DJI"
    exif.get_ifd(0x8825).update({1: "N", 2: (47.0, 22.0, 1.5), 3: "E", 4: (8.0, 32.0, 2.5), 6: 500.0})
    exif.get_ifd(0x8769).update({0x920A: 8.8, 0xA405: 24})
    Image.new("RGB", (64, 48)).save(photo, exif=exif, xmp=XMP)
    mask = sorted((root / "masks").iterdir())[0]
    entry = next((folder / "board").rglob("*.json"))
    network = folder / "network.onnx"
    network.write_bytes(small_network().SerializeToString())
    found = [
        ("poses", root / "GT_pose.txt", lambda: read_poses(root / "GT_pose.txt")),
        ("priors", root / "GPS_pose.txt", lambda: read_hypotheses(root / "GPS_pose.txt")),
        ("cameras", root / "intrinsic.txt", lambda: read_cameras(root / "intrinsic.txt")),
        ("photo header", photo, lambda: read_photo_metadata(photo)),
        ("mask", mask, lambda: read_mask(mask)),
        ("leaderboard entry", entry, lambda: read_entries(folder / "board")),
        ("ledger", run / "predictions.jsonl", lambda: Ledger(run / "predictions.jsonl", read_only=True)),
        ("status", run / "predictions.jsonl", lambda: read_status(run)),
        ("run configuration", run / "config.yaml", lambda: read_config(run)),
        ("network", network, lambda: _read_network(network)),
    ]
    for name in ("poses.txt", "queries.csv", "summary.json", "provenance.json"):
        found.append((f"run {name}", run / name, lambda: read_run(run)))
        found.append((f"verify {name}", run / name, lambda: main(["verify", str(run)])))
    for name in ("scene.json", "vertices.npy", "triangles.npy"):
        found.append((f"scene {name}", folder / "a.scene" / name, lambda: read_scene(folder / "a.scene")))
    for name in ("colmap", "kapture", "tum", "nerfstudio", "table"):
        place = folder / name
        for file in sorted(place.rglob("*") if place.is_dir() else [place]):
            if file.is_file():
                reader = lambda place=place, name=name: read_pose_file(place, name)  # noqa: E731
                found.append((f"{name} {file.name}", file, reader))
    return found


def _read_network(file: Path) -> None:
    """Reads what stands before OpenCV's reader, which is tried in a process of its own: 0.3 s each."""
    if fault := onnx_fault(file.read_bytes()):
        raise ConfigError(fault)


def fuzz(numbers: Iterable[int], seed: int) -> Counter[str]:
    """Tries mutated files of all kinds in turn; returns how many were read and how many refused.

    Raises:
        AssertionError: A reader raised something else, or took too long; the message has kind and number.
    """
    seen: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as scratch:
        found = [(name, file, file.read_bytes(), read) for name, file, read in targets(Path(scratch))]
        for number in numbers:
            name, file, whole, read = found[number % len(found)]
            file.write_bytes(mutate(whole, np.random.default_rng([seed, number])))
            started = time.process_time()
            try:
                with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                    read()
                seen["read"] += 1
            except LodbenchError:
                seen["refused"] += 1
            except Exception as error:
                raise AssertionError(f"{name}, number {number}: {type(error).__name__}: {error}") from error
            assert time.process_time() - started < LIMIT_S, f"{name}, number {number} takes too long"
            file.write_bytes(whole)
    return seen
