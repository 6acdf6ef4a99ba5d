"""``lodbench train``: a network from views to weights that a segmenter loads."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lodbench import __version__
from lodbench.errors import ConfigError
from lodbench.extras import require
from lodbench.segmentation.photo_segmenter import PhotoSegmenter
from lodbench.segmentation.protocol import TrainableSegmenter
from lodbench.storage import digest_of, file_digest, make_folder, write_bytes, write_text
from lodbench.storage.digest import digest_of_code, package_files
from lodbench.storage.json_text import finite, parse_json
from lodbench.training import samples
from lodbench.training.samples import Sample, TrainParams


def write_curves(history: list[dict[str, float]], path: Path) -> None:
    """Writes loss and learning rate per epoch above, the IoUs on validation views below, as PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 6.0), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    epochs = [row["epoch"] for row in history]
    above.plot(epochs, [row["loss"] for row in history], "o-", ms=3, color="#1b6ca8")
    above.set(ylabel="training loss", ylim=(0, None))
    rate = above.twinx()
    rate.plot(epochs, [row["lr"] for row in history], "--", color="#999999")
    rate.set_ylabel("learning rate (dashed)", color="#777777")
    validated = [row for row in history if "mean_iou" in row]
    for key, label, colour in (("mean_iou", "mean per view", "#c8553d"), ("pooled_iou", "pooled", "#588157")):
        below.plot(
            [row["epoch"] for row in validated],
            [row[key] for row in validated],
            "o-",
            ms=3,
            label=label,
            color=colour,
        )
    below.set(xlabel="epoch", ylabel="validation IoU")
    below.grid(alpha=0.3)
    below.legend()
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110, metadata={"Software": None})
    write_bytes(path, content.getvalue())


MANIFEST_FILE = "training.json"
CURVES_FILE = "curves.png"
# Settings that name files and places: what these hold counts, not what they are called.
_IDLE = frozenset(
    (
        "data",
        "val_data",
        "city",
        "unlabelled",
        "negatives",
        "traced",
        "out",
        "resume",
        "tensorboard",
        "device",
        "init",
        "average",
    )
)
# Where the labels of posed photos are kept.
SILHOUETTES = "silhouettes"
# And those of photos that a network labelled.
PSEUDO_LABELS = "pseudo-labels"
NEGATIVES = "negatives"
# What init says for the weights that come with lodbench.
PACKAGE = "package"


@dataclass(frozen=True, slots=True)
class Trained:
    """What came out of a training."""

    weights: Path  # their file
    history: list[dict[str, float]]  # a row per epoch
    validated_on: str  # what the views to validate on are
    views: int  # to train on
    started_at: int  # epochs that were there already
    # IoUs of the mean of several trainings, where that is what is stored; else empty
    averaged: dict[str, float]


def train_network(
    segmenter: TrainableSegmenter, params: TrainParams, tell: Callable[[str], None] = lambda line: None
) -> Trained:
    """Trains a network, or goes on where the same command was stopped.

    The folder ``params.out`` then holds ``checkpoint.pt``, ``curves.png``, ``training.json`` and the
    weights as the segmenter loads them.

    Raises:
        LodbenchError: torch is missing, the data is at fault, or the folder holds another training.
    """
    require("torch", "torch", "lodbench train")
    from lodbench.training.nets.loop import run_training

    params = replace(params, init=_start(segmenter, params.init))
    for path in params.average:
        if not Path(path).expanduser().is_file():
            raise ConfigError(f"There are no weights {path}.", "average=[OUT/checkpoint.pt,...].")
    data, out = Path(params.data).expanduser(), Path(params.out).expanduser()
    make_folder(out)
    train, val, source = _samples(segmenter, params, data, out)
    tell(f"{len(train)} views to train on, {len(val)} to validate on: {source}")
    record = _record(segmenter, params, data, train, val, source)
    started_at: list[int] = []

    def keep(history: list[dict[str, float]]) -> None:
        write_curves(history, out / CURVES_FILE)
        write_text(out / MANIFEST_FILE, _json(record | {"history": history}))
        tell(_epoch_line(history[-1], params.epochs))

    history, weights, averaged = run_training(
        segmenter, params, train, val, record["digest"], keep, started_at
    )
    if not history:  # one of several processes, and not the one that writes
        return Trained(weights, history, source, len(train), started_at[0], averaged)
    # One that was stopped after its last epoch was kept, and before its curves were, has none left to run.
    write_curves(history, out / CURVES_FILE)
    finished = record | {"history": history, "weights": {weights.name: file_digest(weights)}}
    finished |= {"averaged": averaged} if averaged else {}
    write_text(out / MANIFEST_FILE, _json(finished))
    return Trained(weights, history, source, len(train), started_at[0], averaged)


def _samples(
    segmenter: TrainableSegmenter, params: TrainParams, data: Path, out: Path
) -> tuple[list[Sample], list[Sample], str]:
    """Returns the views to train on, those to validate on, and what the latter are."""
    learns = getattr(segmenter, "learns", samples.MASKS)
    if learns != samples.MASKS:
        _require_labels(segmenter, params, data, learns)
    if samples.is_posed(data):
        learnt, held_out = samples.posed_samples(data, out / SILHOUETTES, params.city), []
    else:
        learnt, held_out = (samples.find_samples(data, split, learns) for split in ("train", "val"))
    val_data = Path(params.val_data).expanduser() if params.val_data else None
    train, val, source = samples.split_samples(learnt, held_out, val_data, learns)
    if params.unlabelled:
        train = train + _pseudo_labelled(segmenter, params, out)
    size = segmenter.params.size
    if params.negatives:
        train = train + samples.ground_samples(size, _folders(params.negatives), out / NEGATIVES)
    if params.traced:
        photos = samples.traced_samples(size, _folders(params.traced))
        train = train + samples.repeated(photos, params.traced_share, len(train))
    return train, val, source


def _folders(names: Sequence[str]) -> list[Path]:
    return [Path(name).expanduser() for name in names]


def _require_labels(segmenter: TrainableSegmenter, params: TrainParams, data: Path, learns: str) -> None:
    """Makes sure that all a network learns from says which building, or what surface, is where."""
    masked = {"unlabelled": params.unlabelled, "negatives": params.negatives, "traced": params.traced}
    named = next(
        (name for name, folders in masked.items() if folders), "data" if samples.is_posed(data) else None
    )
    if named:
        raise ConfigError(
            f"{segmenter.params.name} learns {learns}, and {named} has masks of buildings only.",
            f"`data=FOLDER` of generate-training-data `{samples.SETTINGS[learns]}=true`.",
        )


def _pseudo_labelled(segmenter: TrainableSegmenter, params: TrainParams, out: Path) -> list[Sample]:
    """Returns the photos of ``unlabelled`` as views, labelled by the weights of ``init``."""
    settings = segmenter.params
    if not isinstance(segmenter, PhotoSegmenter) or not str(params.init).endswith(".onnx"):
        raise ConfigError("Only networks in ONNX files label photos.", "`init=FILE.onnx`, or `init=package`.")
    teacher = type(segmenter)(replace(settings, weights=params.init))
    return samples.pseudo_samples(teacher, _folders(params.unlabelled), out / PSEUDO_LABELS)


def _epoch_line(row: dict[str, float], epochs: int) -> str:
    iou = f", val IoU {row['mean_iou']:.3f}" if row.get("views") else ""
    return f"epoch {row['epoch']:.0f} of {epochs}: loss {row['loss']:.4f}{iou}"


def _start(segmenter: TrainableSegmenter, init: str | None) -> str | None:
    """Returns the file of the weights to start from."""
    if init != PACKAGE:
        if init is not None and not Path(init).expanduser().is_file():
            raise ConfigError(f"There are no weights {init}.", f"`init=FILE`, or `init={PACKAGE}`.")
        return init
    packaged = segmenter.packaged_weights()
    if packaged is None:
        raise ConfigError("The package holds no weights of this segmenter.", "`init=FILE` names others.")
    return str(packaged)


def _record(
    segmenter: TrainableSegmenter,
    params: TrainParams,
    data: Path,
    train: list[Sample],
    val: list[Sample],
    source: str,
) -> dict[str, Any]:
    """Returns what the training follows from; its digest names it."""
    settings = {key: value for key, value in asdict(params).items() if key not in _IDLE}
    init = file_digest(Path(params.init).expanduser()) if params.init else None
    identity = {
        "segmenter": asdict(segmenter.params),
        **_code_of(segmenter),
        "settings": settings | {"scale": list(params.scale)},
        "init": init,
        "average": [file_digest(Path(path).expanduser()) for path in params.average],
        "train": samples.samples_digest(train),
        "val": samples.samples_digest(val),
    }
    return identity | {
        "digest": digest_of(identity),
        "domain": ("posed photos" if samples.is_posed(data) else "synthetic")
        + (" and traced photos" if params.traced else ""),
        "views": {"train": len(train), "val": len(val), "validated_on": source},
        "sets": _sets(data),
        "versions": {"lodbench": __version__, "torch": version("torch"), "numpy": version("numpy")},
    }


def _code_of(segmenter: TrainableSegmenter) -> dict[str, str]:
    """Returns a digest of the package that builds a plug-in's network.

    Nothing of lodbench's own: a training of those goes on under another version, which its record names.
    """
    package = type(segmenter).__module__.partition(".")[0]
    return {} if package == "lodbench" else {"code": digest_of_code(package_files(package), ())}


def _sets(data: Path) -> dict[str, Any]:
    """Returns the manifests' digests and settings of the training sets below a folder."""
    sets = {}
    for path in sorted(data.rglob("manifest.json")):
        try:
            manifest = parse_json(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            continue
        if not isinstance(manifest, dict):
            continue
        name = path.parent.relative_to(data).as_posix()
        sets[name] = {key: manifest.get(key) for key in ("digest", "views", "state", "versions")}
    return sets


def _json(record: dict[str, Any]) -> str:
    return json.dumps(finite(record), indent=1, sort_keys=True, allow_nan=False) + "\n"
