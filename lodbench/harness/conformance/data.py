"""Rules of what brings queries, of what is made of runs, and of what reads and draws the city."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import fields, is_dataclass, replace
from functools import cache
from inspect import signature
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.citymodel.formats import Source
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.polygons import finish_model
from lodbench.citymodel.raw import RawCity
from lodbench.citymodel.read import mesh_model
from lodbench.citymodel.source import open_sources
from lodbench.datasets.inputs import Input
from lodbench.datasets.pose_text import FoundPose
from lodbench.datasets.prior_sources import prior_digest
from lodbench.datasets.query import Dataset
from lodbench.errors import LodbenchError
from lodbench.evaluation.metrics import ERROR, PARTS, is_taken, queries_frame
from lodbench.evaluation.pose_errors import FAILED, FAILED_PARTS
from lodbench.evaluation.predictions import Prediction, evaluate
from lodbench.geometry import Pose
from lodbench.harness.conformance.trial import CAMERA, Rules, Tried, refuses, require
from lodbench.harness.export import CITY, CRS, DATASET, Export, ExportFormat, export_run, wanted_by
from lodbench.harness.runs.stored import StoredRun
from lodbench.params import to_params
from lodbench.rendering import DEPTH, open_renderer
from lodbench.rendering.masks import pack_mask

# Where the blocks could stand.
_CRS = "EPSG:25832"
# Pixels on the outline may be drawn or not: no more of all than this.
_MOST_DIFFERENT = 0.01


def dataset_rules(tried: Tried) -> Rules:
    """Returns the rules of a dataset."""

    def parameters() -> str:
        taken = list(signature(tried.part, eval_str=True).parameters.values())
        hint = "def open_it(params: Params) -> Dataset, Params a frozen dataclass"
        require(len(taken) == 1 and is_dataclass(taken[0].annotation), "it takes no parameters' class", hint)
        kind: Any = taken[0].annotation
        require(kind.__dataclass_params__.frozen, f"{kind.__name__} is not frozen", hint)
        names = {field.name for field in fields(kind)}
        require("name" in names, f"{kind.__name__} has no field name", f"Add name: str = {tried.name!r}.")
        unknown = sorted(set(tried.config or {}) - names)
        require(not unknown, f"the configuration has no use for {', '.join(unknown)}")
        return f"{kind.__name__}, frozen, fields: {len(names)}"

    def opened() -> Dataset:
        (taken,) = signature(tried.part, eval_str=True).parameters.values()
        dataset: Dataset = tried.part(
            to_params(tried.config or {"name": tried.name}, taken.annotation, "dataset")
        )
        return dataset

    def content() -> str:
        try:
            dataset = opened()
        except LodbenchError as error:
            return f"not here, and it says so: {error.message}"
        require(isinstance(dataset, Dataset), f"it returned {type(dataset).__name__}", "Return a Dataset.")
        require(dataset.name == tried.name, f"its name is {dataset.name!r}: runs are stored under that")
        _require_sound(dataset)
        require(prior_digest(opened().entries) == prior_digest(dataset.entries), "opened twice, other priors")
        summary = f"{len(dataset.entries)} queries in {', '.join(dataset.splits)}"
        return f"{summary}; poses sound, files there, the same again"

    return [("parameters", parameters), ("content", content)]


def _require_sound(dataset: Dataset) -> None:
    """Raises what ``require`` does where queries, truths, splits and files do not belong together."""
    keys = [entry.key for entry in dataset.entries]
    require(len(keys) > 0 and len(set(keys)) == len(keys), "no query, or one twice")
    strays = sorted(set(dataset.truth) - set(keys))
    require(not strays, f"a truth of {strays[:1]}, which is not a query")
    splits = {entry.split for entry in dataset.entries}
    require(
        splits <= set(dataset.splits), f"queries of {sorted(splits - set(dataset.splits))}: no such split"
    )
    for entry in dataset.entries:
        for path in (entry.image, entry.mask):
            require(path is None or path.is_file(), f"{entry.key}: {path} is not there")
        for pose in (entry.prior, dataset.truth.get(entry.key)):
            _require_pose(pose, entry.key)


def prior_rules(tried: Tried) -> Rules:
    """Returns the rules of a source of priors."""

    def apply(dataset: Dataset, seed: int = 0) -> Dataset:
        redrawn: Dataset = tried.make().apply(dataset, seed)
        return redrawn

    def priors() -> str:
        words = tried.make().describe()
        require(isinstance(words, str) and bool(words), "describe says nothing", "Tables print it.")
        try:
            redrawn = apply(tried.dataset)
        except LodbenchError as error:
            return f"none for these photos, and it says so: {error.message}"
        keys = [entry.key for entry in redrawn.entries]
        require(keys == [entry.key for entry in tried.entries], "other queries, or in another order")
        require(redrawn.truth == tried.dataset.truth, "the truth was changed")
        for entry in redrawn.entries:
            _require_pose(entry.prior, entry.key)
        first = prior_digest(redrawn.entries)
        require(
            prior_digest(apply(tried.dataset).entries) == first,
            "the same seed, other priors",
            "Use the seed.",
        )
        turned = apply(replace(tried.dataset, entries=tried.entries[::-1]))
        same = prior_digest(turned.entries[::-1]) == first
        require(
            same, "other priors in another order of work", "lodbench.storage.random_stream(seed, entry.key)"
        )
        return f"{words}; the same again and in any order"

    return [("priors", priors)]


def pose_format_rules(tried: Tried) -> Rules:
    """Returns the rules of a reader of pose files."""

    def garbage() -> str:
        path = tried.folder / "garbage"
        path.write_bytes(b"neither here nor there\n")
        return refuses(lambda: list(tried.part(path)), "a file of noise")

    def sample() -> str:
        if tried.sample is None:
            return "not tried: name a file with --sample FILE"
        poses = list(tried.part(tried.sample))
        require(len(poses) > 0, "it holds no poses")
        for each in poses:
            require(isinstance(each, FoundPose), f"it yields {type(each).__name__}", "Yield FoundPose.")
            _require_pose(each.pose, each.name)
        return f"{len(poses)} poses, world to camera by their word"

    return [("no poses", garbage), ("sample", sample)]


def metric_rules(tried: Tried) -> Rules:
    """Returns the rules of a metric."""
    row = {"query": "a", "split": "a", "failure": "", "hypotheses": 10, "mask_iou": 0.8, "probability": 0.7}
    right = {**dict(zip(ERROR, (1.0, 0.2), strict=True)), **dict(zip(PARTS, (0.6, 0.8, 0.1), strict=False))}
    failed = {**dict(zip(ERROR, FAILED, strict=True)), **dict(zip(PARTS, FAILED_PARTS, strict=False))}
    rows = [{**row, **right}, {**row, "query": "b", **right}, {"query": "c", "split": "a", **failed}]
    rows[2] |= {"failure": "no mask", "hypotheses": 0}

    def numbers() -> str:
        queries = queries_frame(rows)
        before = queries.copy(deep=True)
        stated = {str(name): float(value) for name, value in tried.part(queries).items()}
        require(len(stated) > 0, "no number", "Return a mapping from names to numbers.")
        taken = [*filter(is_taken, stated)]
        require(
            not taken, f"{' and '.join(taken)}: a name of lodbench's own", "Give the number another name."
        )
        require(queries.equals(before), "the queries were written to", "Work on a copy.")
        again = {str(name): float(value) for name, value in tried.part(queries_frame(rows)).items()}
        require(repr(stated) == repr(again), "other numbers of the same queries")
        return f"{', '.join(stated)}; the same again, the queries only read"

    return [("numbers", numbers)]


def command_rules(tried: Tried) -> Rules:
    """Returns the rules of a command: a function of its words that has a help and refuses other options."""

    def answer(*words: str) -> tuple[int, str]:
        with redirect_stdout(StringIO()) as printed:
            try:
                code = tried.part(list(words))
            except SystemExit as ended:  # as argparse ends behind its help
                code = ended.code
        return int(code or 0), printed.getvalue()

    def helps() -> str:
        code, text = answer("--help")
        require(code == 0 and bool(text.strip()), "--help prints nothing", "Print what the command does.")
        return f"--help: {text.strip().splitlines()[0]}"

    def wrong() -> str:
        return refuses(lambda: tried.part(["--no-such-option"]), "--no-such-option")

    return [("help", helps), ("a wrong option", wrong)]


def _require_pose(pose: Pose | None, where: str) -> None:
    if pose is not None:
        require(np.isfinite(pose.cam_from_world).all(), f"{where}: a pose is not finite")
        Pose.from_matrix(pose.cam_from_world)


def export_rules(tried: Tried) -> Rules:
    """Returns the rules of an export format."""

    def declared() -> str:
        form: ExportFormat = tried.part()
        unknown = sorted(wanted_by(form) - {DATASET, CITY, CRS})
        require(not unknown, f"requires {', '.join(unknown)}", f"Of {DATASET}, {CITY} and {CRS}.")
        require(Path(form.file_name).name == form.file_name, f"file_name {form.file_name!r} is no name")
        return f"{form.file_name}; requires {', '.join(form.requires) or 'nothing'}"

    def written() -> str:
        form, run = tried.part(), _run_of(tried)
        export = Export(
            run,
            tried.dataset if DATASET in form.requires else None,
            tried.scene if CITY in form.requires else None,
            _CRS if CRS in wanted_by(form) else None,
        )
        before = run.queries.copy(deep=True)
        contents = []
        for name in ("first", "second"):
            path = tried.folder / name / form.file_name
            done = export_run(export, form, path)
            require(path.exists(), f"nothing was written to {path.name}", "Write to the path that is given.")
            contents.append(dict(_contents(path)))
        require(run.queries.equals(before), "the queries were written to", "Work on a copy.")
        require(contents[0] == contents[1], "the same run, other bytes", "Leave out times and random ids.")
        return f"{done.count} poses of {len(run.queries)} queries, the same bytes again"

    return [("declared", declared), ("written", written)]


def _run_of(tried: Tried) -> StoredRun:
    """Returns a run that found all photos but the last."""
    dataset, entries = tried.dataset, tried.entries
    answered = {entry.key: Prediction(dataset.truth[entry.key]) for entry in entries[:-1]}
    predictions = {**answered, entries[-1].key: Prediction(None, "no mask")}
    queries = evaluate(entries, predictions, dataset.truth, {entry.key: entry.prior for entry in entries})
    poses = {key: prediction.pose for key, prediction in answered.items() if prediction.pose is not None}
    summary = {"method": {"name": "trial", "variant": ""}, "dataset": {"name": dataset.name}}
    return StoredRun(tried.folder / "run", summary, {}, queries, poses, (), {})


def _contents(path: Path) -> Iterator[tuple[str, bytes]]:
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if file.is_file():
            yield str(file.relative_to(path)), file.read_bytes()


def reader_rules(tried: Tried) -> Rules:
    """Returns the rules of a reader of city models, and of a format."""
    reads = getattr(tried.part, "read", tried.part)

    def garbage() -> str:
        def read(data: bytes) -> object:
            return reads(Source("garbage", lambda: io.BytesIO(data), Path("garbage")), ReadOptions())

        refuses(lambda: read(b"\x00\xff" * 3000), "a file of bytes")
        return refuses(lambda: read(b"neither here nor there\n"), "a file of words")

    def scene() -> str:
        if tried.sample is None:
            return "not tried: name a file with --sample FILE"
        digests = []
        for _ in range(2):
            raw = reads(open_sources(tried.sample)[0], ReadOptions())
            require(isinstance(raw, RawCity), f"it returned {type(raw).__name__}", "Return RawCity.")
            digests.append((mesh := mesh_model(finish_model(raw, ReadOptions()), None)).scene.digest())
        require(digests[0] == digests[1], "another city of the same file")
        low, high = mesh.scene.extent_m
        size = " x ".join(f"{side:.0f}" for side in high - low)
        return f"{mesh.scene.num_buildings} buildings, {size} m, the same again"

    return [("no city", garbage), ("sample", scene)]


def renderer_rules(tried: Tried) -> Rules:
    """Returns the rules of a renderer."""
    renderer = cache(lambda: tried.part(tried.scene, 1))

    def same_again() -> str:
        before = tried.scene.vertices.copy(), tried.scene.triangles.copy()
        fresh = tried.part(tried.scene, 2)
        for pose in tried.truths:
            same = np.array_equal(fresh.render(CAMERA, pose), renderer().render(CAMERA, pose))
            require(same, "another silhouette from two threads, or in another order")
        unchanged = np.array_equal(before[0], tried.scene.vertices) & np.array_equal(
            before[1], tried.scene.triangles
        )
        require(unchanged, "the scene was written to", "Work on a copy.")
        return "made anew and with two threads, the same to the bit; the scene is only read"

    def away() -> str:
        far = Pose.from_center(tried.truths[0].rotation, np.array([9e4, 9e4, 120.0]))
        require(not renderer().render(CAMERA, far).any(), "a silhouette where no building is in view")
        return "nothing is drawn where no building is in view"

    def not_finite() -> str:
        broken = Pose(tried.truths[0].rotation, np.array([0.0, np.nan, 0.0]))
        return refuses(lambda: renderer().render(CAMERA, broken), "a pose that is not finite")

    return [
        ("silhouettes", lambda: _silhouettes(tried, renderer())),
        ("same again", same_again),
        ("nothing in view", away),
        ("depth", lambda: _depth(tried, renderer()) if hasattr(tried.part, DEPTH) else "not offered"),
        ("no pose", not_finite),
    ]


def _silhouettes(tried: Tried, renderer: Any) -> str:
    reference, worst = open_renderer("reference", tried.scene, 1), 0.0
    for pose in tried.truths:
        drawn = renderer.render(CAMERA, pose)
        size = (CAMERA.height, CAMERA.width)
        require(
            drawn.shape == size and drawn.dtype == np.bool_, f"{drawn.shape} {drawn.dtype}", "(H, W) bool"
        )
        worst = max(worst, float(np.mean(drawn != reference.render(CAMERA, pose))))
    require(worst <= _MOST_DIFFERENT, f"{100 * worst:.2f} % of the pixels are not the reference's")
    return f"(H, W) bool; {100 * worst:.2f} % of the pixels at most are not the reference's"


def _depth(tried: Tried, renderer: Any) -> str:
    pose = tried.truths[0]
    depth, mask = renderer.depth(CAMERA, pose), renderer.render(CAMERA, pose)
    require(depth.shape == mask.shape and depth.dtype == np.float32, f"{depth.shape} {depth.dtype}")
    differing = float(np.mean((depth > 0) != mask))
    require(
        differing <= _MOST_DIFFERENT, f"{100 * differing:.1f} % of the pixels: depth here, silhouette not"
    )
    return f"{depth[depth > 0].min():.1f} to {depth.max():.1f} m, 0 beside the buildings"


def fit_rules(tried: Tried) -> Rules:
    """Returns the rules of a fit."""
    engine = open_renderer("silhouette", tried.scene, 1)
    mask = engine.render(CAMERA, tried.truths[0])
    moved = [tried.truths[0].shifted([step, -step, 0.0]) for step in (0.0, 3.0, 15.0, 60.0, 9e4)]
    words = np.stack([pack_mask(engine.render(CAMERA, pose)) for pose in moved])
    probability = mask.astype(np.float32)
    size = (CAMERA.width, CAMERA.height)
    # A fit of photos gets one in which buildings are lighter than the ground.
    photo = np.random.default_rng(0).integers(40, 120, (*mask.shape, 3)).astype(np.uint8)
    photo[mask] += 100
    given = (photo, size) if getattr(tried.part, "input", Input.MASK) == Input.IMAGE else (probability,)
    before_given = given[0].copy()

    def values() -> str:
        fit = tried.part(*given)
        require(tuple(fit.size) == size, f"size is {fit.size}: width, then height")
        fits = np.asarray(fit(words))
        require(fits.shape == (5,) and fits.dtype == np.float64, f"{fits.shape} {fits.dtype}", "(N,) float64")
        require(np.isfinite(fits).all() and fits.min() >= 0 and fits.max() <= 1, f"{fits}: not in [0, 1]")
        require(fits[0] >= fits.max(), f"the mask itself fits {fits[0]:.3f}, another {fits.max():.3f}")
        require(fits[-1] == 0, f"nothing fits {fits[-1]:.3f}", "Nothing in common is 0.")
        return (
            f"{fits[0]:.3f} at the truth, " + ", ".join(f"{value:.3f}" for value in fits[1:]) + " further off"
        )

    def alone() -> str:
        fit, before = tried.part(*given), words.copy()
        batch, single = fit(words), [fit(words[k : k + 1])[0] for k in range(5)]
        require(np.array_equal(batch, single), "other values one by one than together", "Count in integers.")
        require(np.array_equal(batch, tried.part(*given)(words)), "other values when made anew")
        require(np.array_equal(before, words), "the words were written to", "Work on a copy.")
        require(np.array_equal(given[0], before_given), "its query was written to", "Work on a copy.")
        return "one by one, together and made anew, the same to the bit; what it is given is only read"

    return [("values", values), ("same again", alone)]
