"""Results of the main commands before and after a change of the code.

`python -m tests.golden record DIR` runs them and keeps every file that they write; `python -m tests.golden
compare DIR` runs them again and names what differs; further words choose cases by their names. Results are
kept on the machine that made them: another kind of CPU rounds sums otherwise. Times, versions and paths are
left out. Real cities and flights lie beside the checkout, in `../shared/data`; without them their cases are
skipped, and said so.
"""

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from lodbench.datasets.pose_text import read_poses
from lodbench.geometry.angles import heading_from_yaw

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
CITY = DATA / "city"
# Times and machine facts stand apart from results (docs/evaluation.md); hashes of code change with it.
APART = {"timings.csv", "provenance.json", "predictions.jsonl", "multirun.yaml"}
CHANGING = (
    re.compile(rb'"(\w*seconds|elapsed_s|code|version|created|date|started|finished)": [^,}\n]+'),
    re.compile(rb"lodbench \d+\.\d+\.\d+\S*"),
    re.compile(rb"\d+(\.\d+)? m?s\b"),
    re.compile(rb"\b([0-9a-f]{12}|[0-9a-f]{8})\b"),  # digests of settings and code
)
DIGEST = re.compile(r"\b([0-9a-f]{12}|[0-9a-f]{8})\b")
CONVERSIONS = {
    "germany_lod2/LoD2_32_280_5657_1_NW.gml": ".city.json",
    "plateau/51311568_bldg_6697_op.gml": ".glb",
    "3dbag/tile_901_trimmed.jsonl": ".gml",
    "netherlands_other/3-20-DELFSHAVEN.city.json": ".obj",
    "switzerland/zurich-lod2-citygml1.xml": ".ply",
    "lod3_reference/fzk_haus_lod3_v2.gml": ".city.jsonl",
}


@dataclass(frozen=True)
class Case:
    """One command, run in a folder of its own.

    Attributes:
        words: What follows ``lodbench``.
        needs: File or folder without which it is skipped.
    """

    words: tuple[str, ...]
    needs: Path = ROOT


def localize_words(photo: Path, prior_folder: Path, city: Path, *more: str) -> tuple[str, ...]:
    """Returns the words that localise one photo of a dataset from its prior and its camera."""
    pose = read_poses(prior_folder / "GPS_pose.txt")[photo.name]
    lines = (prior_folder / "intrinsic.txt").read_text().splitlines()
    camera = next(line.split(maxsplit=1)[1] for line in lines if line.startswith(photo.name))
    numbers = [f"{value:.3f}" for value in pose.center]
    turned = pose.euler
    return (
        *("localize", str(photo), "--city", str(city), "--camera", camera, "--center", *numbers),
        *(
            "--heading",
            f"{heading_from_yaw(turned.yaw_deg) % 360:.2f}",
            "--pitch",
            f"{turned.pitch_deg - 90:.2f}",
        ),
        *("--json", *more),
    )


def localize_cases() -> Iterator[tuple[str, Case]]:
    """Yields single photos over three real cities, two of them with a mask."""
    for flight in ("boruszyn", "ochota"):
        folder = DATA / "real_flights" / flight
        for photo in sorted((folder / "Query_image").glob("*.jpg"))[:4]:
            words = localize_words(photo, folder, folder / "city.obj", "--prior-height", "15")
            yield f"localize {flight} {photo.stem}", Case(words, folder)
    folder = DATA / "uavd4l" / "demo"
    for photo in (folder / "Query_image").glob("*.png"):
        city, mask = DATA / "uavd4l" / "UAVD4L-LoD1.obj", next((folder / "masks").rglob("*.png"))
        yield "localize thermal", Case(localize_words(photo, folder, city), folder)
        by_mask = localize_words(photo, folder, city, "--mask", str(mask))
        yield "localize thermal by mask", Case(by_mask, folder)


def cases() -> dict[str, Case]:
    """Returns all commands by name."""
    demo = ("dataset=demo", "dataset.num_queries=4", "paths.runs=runs")
    methods = "method=lodlocv2,contour_alignment,region"
    town = DATA / "uavd4l" / "UAVD4L-LoD1.obj"
    drawn = ("dataset=flights", f"city={town}", "dataset.num_flights=1", "dataset.num_photos=5")
    found = {
        "demo": Case(("run", "--multirun", methods, "tilt=prior", *demo)),
        "baselines": Case(("run", "--multirun", "method=lodloc,lodlocv3,uavd4l,mcloc", *demo)),
        "basin": Case(("basin", "method=contour_alignment", "ranges=[30]", "yaw_ranges=[30]", *demo)),
        "flight": Case(("run", "method=flight", *drawn, "paths.runs=runs"), town),
        "training data": Case(("generate-training-data", "city=demo", "limit=6", "executor=serial")),
    }
    for name, ending in CONVERSIONS.items():
        path = CITY / name
        found[f"convert {path.name}"] = Case(("city", "convert", str(path), "-o", f"city{ending}"), path)
        found[f"check {path.name}"] = Case(("city", "check", str(path), "--json"), path)
    return found | (dict(localize_cases()) if DATA.is_dir() else {})


def run_case(case: Case, folder: Path) -> dict[str, bytes]:
    """Returns what a command printed and wrote, by name of file, without what changes from run to run."""
    work = folder / "work"
    work.mkdir(parents=True)
    environment = {**os.environ, "LODBENCH_CACHE": str(folder.parent / "cache"), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "lodbench", *case.words]
    done = subprocess.run(command, cwd=work, env=environment, capture_output=True)
    found: dict[str, list[bytes]] = {}
    files = {"exit code": str(done.returncode).encode()}
    if "--json" in case.words:
        files["printed"] = done.stdout
    if done.returncode not in (0, 1, 3):
        files["complaint"] = done.stderr[-2000:]
    for path in sorted(work.rglob("*")):
        if path.is_file() and path.name not in APART:
            name = DIGEST.sub("DIGEST", path.relative_to(work).as_posix())
            found.setdefault(name, []).append(without_changing(path.read_bytes(), folder))
    # Several runs of one method have one name here: in the order of their contents.
    written = {name: b"\n".join(sorted(contents)) for name, contents in found.items()}
    return {name: without_changing(content, folder) for name, content in files.items()} | written


def without_changing(content: bytes, folder: Path) -> bytes:
    """Returns a file's bytes without times, versions and the folder that it was made in."""
    content = content.replace(str(folder.parent).encode(), b"FOLDER").replace(str(DATA).encode(), b"DATA")
    if b"\0" in content[:4096]:
        return content
    for pattern in CHANGING:
        content = pattern.sub(b"", content)
    return content


def record(keep: Path, names: Sequence[str]) -> int:
    """Runs cases, and keeps their files; returns how many could not be run."""
    skipped = 0
    for name, files in results(names):
        skipped += files is None
        for file, content in (files or {}).items():
            place = keep / name.replace(" ", "_") / file
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(content)
        say(f"{name}: " + ("skipped, no data" if files is None else f"{len(files)} files"))
    return skipped


def compare(keep: Path, names: Sequence[str]) -> int:
    """Runs cases again, and prints what differs from what is kept; returns how many do."""
    faults = 0
    for name, files in results(names):
        kept_folder = keep / name.replace(" ", "_")
        kept = {
            path.relative_to(kept_folder).as_posix(): path.read_bytes()
            for path in sorted(kept_folder.rglob("*"))
            if path.is_file()
        }
        other = sorted(key for key in {*kept, *(files or {})} if kept.get(key) != (files or {}).get(key))
        faults += bool(other) or not kept
        say(f"{name}: " + (f"DIFFERS in {', '.join(other[:8])}" if other else f"same, {len(kept)} files"))
    say(f"{faults} differ")
    return faults


def results(names: Sequence[str]) -> Iterator[tuple[str, dict[str, bytes] | None]]:
    """Yields the files of each case whose name starts with one of some words; None where it has no data."""
    with tempfile.TemporaryDirectory() as scratch:
        for name, case in cases().items():
            if names and not name.startswith(tuple(names)):
                continue
            if not case.needs.exists():
                yield name, None
                continue
            yield name, run_case(case, Path(scratch) / name.replace(" ", "_"))


def say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    action, place, *chosen = sys.argv[1:]
    sys.exit(min(1, {"record": record, "compare": compare}[action](Path(place), chosen)))
