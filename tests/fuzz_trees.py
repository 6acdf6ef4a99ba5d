"""Well-formed trees of the wrong shape for every boundary: an answer or a ``LodbenchError``.

Bytes that are mutated seldom get past a parser; these do: JSON, YAML, messages of runners and attributes of
plug-ins whose parts were lost, exchanged, doubled, or replaced by values of other types and sizes.
"""

import io
import json
import shutil
import sys
import tempfile
import time
from base64 import b64encode
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from copy import deepcopy
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import yaml

from lodbench.citymodel import ReadOptions, mesh_model, parse_city_model
from lodbench.cli import main
from lodbench.datasets.folder import ABOUT_FILE, FolderParams, open_folder
from lodbench.datasets.pose_files import read_pose_file
from lodbench.errors import LodbenchError
from lodbench.geometry import Pose
from lodbench.harness.remote.method import RemoteMethod, RunnerParams
from lodbench.harness.remote.process import packed, unpacked
from lodbench.methods.protocol import Estimate
from lodbench.segmentation.polygon_files import FORMATS, read_polygons
from tests import fuzz_readers
from tests.citymodel.twins import documents
from tests.site_packages import write_package
from tests.town import CAMERA, true_poses

# A tree of some kilobytes that takes longer has found a loop, seconds.
LIMIT_S = 20.0
Try = Callable[[Any], object]
_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2, 7, 1 << 31, 1 << 70, -0.5, 1e308, float("nan"), float("-inf"), "", "x",
    "0", "-1", "a/b", "\x00", "\ud800", "x" * 5000, [], [0], [[]], [None], [[0, 1], 2], ["x"], {}, {"x": 0},
    {"": None}, [{}], {"x": {"x": []}},
)  # fmt: skip
# A tree that is nested so deeply that a walk by recursion ends.
_DEPTH = 400


def mutate_tree(tree: Any, rng: np.random.Generator) -> Any:
    """Returns a copy with one to three parts of another shape."""
    holder, limit = [deepcopy(tree)], sys.getrecursionlimit()
    # What is nested deeply may be copied by the next change; readers keep the usual limit.
    sys.setrecursionlimit(20 * _DEPTH)
    try:
        for _ in range(int(rng.integers(1, 4))):
            places = list(_places(holder))
            within, key = places[int(rng.integers(0, len(places)))]
            _change(within, key, places, rng)
    finally:
        sys.setrecursionlimit(limit)
    return holder[0]


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yields every container and key of a tree."""
    for key in list(value) if isinstance(value, dict) else range(len(value)):
        yield value, key
        if isinstance(value[key], dict | list):
            yield from _places(value[key])


def _change(within: Any, key: Any, places: list[tuple[Any, Any]], rng: np.random.Generator) -> None:
    kind, value = int(rng.integers(0, 9)), within[key]
    other, other_key = places[int(rng.integers(0, len(places)))]
    if kind == 0 and len(places) > 1 and within is not places[0][0]:
        del within[key]
    elif kind == 1 and isinstance(within, dict):
        within[f"{key}s"] = within.pop(key)
    elif kind == 2:  # of another place: of another type or size, and whole in itself
        within[key] = deepcopy(other[other_key])
    elif kind == 3:
        within[key] = [value]
    elif kind == 4 and isinstance(value, list):
        value[:] = value[: len(value) // 2] if rng.random() < 0.5 else value + deepcopy(value)
    elif kind == 5 and isinstance(value, dict):
        within[key] = list(value.items()) if rng.random() < 0.5 else list(value.values())
    elif kind == 6 and isinstance(value, bool | int | float | str):
        within[key] = str(value) if isinstance(value, int | float) else len(str(value))
    elif kind == 7 and rng.random() < 0.1:
        for _ in range(_DEPTH):
            value = [value]
        within[key] = value
    else:
        within[key] = deepcopy(_VALUES[int(rng.integers(0, len(_VALUES)))])


def boundaries(folder: Path) -> list[tuple[str, Any, Try]]:
    """Returns name, a tree that is right, and what takes one; files lie in a folder."""
    return [*_stored(folder), *_cities(), *_polygons(folder), *_runners(), *_plug_ins(folder)]


def _stored(folder: Path) -> Iterator[tuple[str, Any, Try]]:
    """Yields what lodbench writes as JSON and YAML, each read as the mutated bytes are, and datasets."""
    found = fuzz_readers.targets(folder)
    for name, file, read in found:
        if file.suffix in (".json", ".yaml"):
            yield name, yaml.safe_load(file.read_text()), _written(file, lambda _, read=read: read())
    root, city = folder / "town" / "data", folder / "town" / "city.obj"
    about = {
        "city_model": "../city.obj",
        "crs": "EPSG:25832+7837",
        "truth": True,
        "priors": True,
        "seal": "x",
    }
    check, params = ("dataset", "check", str(root), "--city", str(city)), FolderParams(str(root))
    yield "dataset.json", about, _written(root / ABOUT_FILE, lambda _: open_folder(params))
    yield "dataset check", about, _written(root / ABOUT_FILE, lambda _: _command(*check))


def _written(file: Path, read: Callable[[Path], object]) -> Try:
    """Returns what writes a tree as JSON, which YAML holds, reads it, and leaves the file as it was."""

    def try_(tree: Any) -> object:
        before = file.read_bytes() if file.exists() else None
        try:
            file.write_bytes(json.dumps(tree).encode("utf-8", "surrogatepass"))
            return read(file)
        finally:
            file.unlink() if before is None else file.write_bytes(before)

    return try_


def _command(*words: str) -> None:
    """Gives a command; raises ``LodbenchError`` where it ends with a line."""
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()) as said:
        try:
            code = main(words)
        except SystemExit as leaving:
            code = leaving.code if isinstance(leaving.code, int) else 1
    assert "Traceback" not in said.getvalue(), said.getvalue()
    if code:
        raise LodbenchError(said.getvalue())


def _cities() -> Iterator[tuple[str, Any, Try]]:
    """Yields CityJSON and a glTF file with its numbers in it."""

    def parsed(name: str) -> Try:
        def try_(tree: Any) -> None:
            text = json.dumps(tree).encode("utf-8", "surrogatepass")
            model = parse_city_model(text, name, ReadOptions(has_details=True))
            for lod in model.lods:
                mesh_model(model, lod)

        return try_

    for name, text in documents().items():
        if name.endswith(".city.json"):
            yield name, json.loads(text), parsed(name)
    corners = np.array([[0, 0, 0], [9, 0, 0], [9, 5, 0], [0, 5, 4]], np.float32).tobytes()
    data = corners + np.array([0, 1, 2, 0, 2, 3], np.uint16).tobytes()
    gltf = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1], "translation": [1, 2, 3]}, {"mesh": 0, "rotation": [0, 0, 0, 1]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 4}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR", "byteOffset": 0},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 12},
        ],
        "buffers": [
            {
                "byteLength": len(data),
                "uri": "data:application/octet-stream;base64," + b64encode(data).decode(),
            }
        ],
    }
    yield "glTF", gltf, parsed("a.gltf")


def _polygons(folder: Path) -> Iterator[tuple[str, Any, Try]]:
    """Yields a mask with a hole in every format that is read."""
    mask = np.zeros((40, 60), bool)
    mask[5:30, 8:40] = True
    mask[10:20, 14:30] = False
    mask[33:, 50:] = True
    for name in ("labelme", "coco"):
        tree = json.loads(json.dumps(FORMATS[name](mask, "p.jpg")))
        file = folder / f"p.{name}.json"
        yield name, tree, _written(file, lambda path: read_polygons(path, "p.jpg", 40, 60))
    frames = {"fl_x": 50.0, "fl_y": 50.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    frame = {"file_path": "images/a.jpg", "transform_matrix": np.eye(4).tolist(), **frames}
    tree = {
        "camera_model": "OPENCV",
        "k1": 0.0,
        **frames,
        "frames": [frame, {**frame, "file_path": "images/b.jpg"}],
    }
    file = folder / "transforms.json"
    yield ("transforms.json", tree, _written(file, lambda path: list(read_pose_file(path, "nerfstudio"))))


MADE = {
    "name": "kit",
    "requires": ["mask"],
    "params": {"name": "kit", "steps": 3},
    "trial_params": None,
    "answers_flights": False,
    "prepares": False,
    "weights": [],
    "code": ["digest", "3.11", "2.0"],
}


class _Told:
    """Stands for the child process of a runner: says one thing to whatever it is asked."""

    said: Any = None

    def __init__(self, *_: Any) -> None: ...

    def call(self, *_: Any) -> Any:
        return self.said

    def close(self) -> None: ...


def _runners() -> Iterator[tuple[str, Any, Try]]:
    """Yields the heads of messages, and what a child says of the method that it made."""
    pose = next(iter(true_poses(1).values()))
    whole = packed({"done": Estimate(pose, 0.5, trace={"a": (1.0,)}, alternatives=(pose,)), "more": [CAMERA]})
    length = int.from_bytes(whole[:8], "little")

    def message(tree: Any) -> None:
        head = json.dumps(tree).encode("utf-8", "surrogatepass")
        unpacked(
            io.BytesIO(len(head).to_bytes(8, "little") + head + whole[8 + length :] + bytes(1 << 16)).read
        )

    yield "message of a runner", json.loads(whole[8 : 8 + length]), message

    def made(tree: Any) -> None:
        said = tree if isinstance(tree, dict) else {"done": tree}
        with patch("lodbench.harness.remote.process.Child", type("Told", (_Told,), {"said": said})):
            method = RemoteMethod({"name": "kit"}, RunnerParams("subprocess", "python"))
            method.close()

    yield "runner's method", {"done": MADE}, made


_PARTS = """from dataclasses import dataclass
@dataclass(frozen=True)
class Params:
    name: str = "kit"
    steps: int = 3
class Part:
    name, params_type, requires = "kit", Params, frozenset({"mask"})
    def __init__(self, params): ...
    def localize(self, query, city_map, streams): return self.answer(query)
"""


def _plug_ins(folder: Path) -> Iterator[tuple[str, Any, Try]]:
    """Yields attributes and answers of a method of another package."""
    site = folder / "site"
    points = {"methods": {"kit": "kit_trees:Part"}, "config_sources": {"kit": "kit_trees_conf"}}
    files = {"kit_trees.py": _PARTS, "kit_trees_conf/method/kit.yaml": "name: kit\nsteps: 3\n"}
    write_package(site, "kit-trees", points, files)
    root, runs = folder / "town" / "data", folder / "plugged"
    words = [
        "run",
        "dataset=folder",
        f"dataset.root={root}",
        f"city={folder / 'town' / 'city.obj'}",
        "method=kit",
    ]
    words += ["segmenter=masks", "limit=1", f"paths.runs={runs}"]
    estimate = {
        "score": 0.5,
        "hypotheses": 1,
        "seconds": {"a": 0.1},
        "trace": {"a": [1.0]},
        "covariance": None,
    }
    estimate |= {"probability": 0.5, "alternatives": [], "alternative_probabilities": [], "notes": ["n"]}
    pose = {"rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 100.0]}
    tree = {"attributes": {"name": "kit", "requires": ["mask"]}, "answer": {"pose": pose, **estimate}}

    def try_(tree: Any) -> None:
        with _attributes(site, tree):
            try:
                _command(*words)
            finally:
                shutil.rmtree(runs, ignore_errors=True)

    yield "plug-in", tree, try_


@contextmanager
def _attributes(site: Path, tree: Any) -> Iterator[None]:
    """Gives the class of the package the attributes and the answer of a tree, as far as it has them."""
    stated = tree if isinstance(tree, dict) else {"attributes": tree}
    attributes, answer = stated.get("attributes"), stated.get("answer")

    def answered(_: Any, query: Any) -> Any:
        if not isinstance(answer, dict):
            return answer
        pose, more = answer.get("pose"), {key: value for key, value in answer.items() if key != "pose"}
        if isinstance(pose, dict):
            pose = Pose(**{key: np.array(value) for key, value in pose.items()})
        return Estimate(query.prior if pose is None else pose, **more)

    given = dict(attributes) if isinstance(attributes, dict) else {"requires": attributes}
    if isinstance(given.get("requires"), list) and all(isinstance(word, str) for word in given["requires"]):
        given["requires"] = frozenset(given["requires"])
    with patch.object(sys, "path", [str(site), *sys.path]):
        import kit_trees

        with patch.object(kit_trees, "Part", type("Part", (kit_trees.Part,), {**given, "answer": answered})):
            yield


def fuzz(numbers: Iterable[int], seed: int, without: Collection[str] = ()) -> Counter[str]:
    """Tries trees of all boundaries but some in turn; returns how many were read and how many refused.

    Raises:
        AssertionError: Something else came out, or it took too long; the message has boundary and number.
    """
    seen: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as scratch:
        found = [each for each in boundaries(Path(scratch)) if each[0] not in without]
        for _, tree, try_ in found:
            try_(tree)
        for number in numbers:
            name, tree, try_ = found[number % len(found)]
            changed, started = mutate_tree(tree, np.random.default_rng([seed, number])), time.process_time()
            try:
                with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                    try_(changed)
                seen["read"] += 1
            except LodbenchError:
                seen["refused"] += 1
            except Exception as error:
                told = f"{name}, number {number}: {type(error).__name__}: {error}"
                raise AssertionError(f"{told}\n{str(changed)[:2000]}") from error
            assert time.process_time() - started < LIMIT_S, f"{name}, number {number} takes too long"
    return seen
