"""``lodbench train method=lodloc``: from views to the weights that the method loads."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lodbench import __version__
from lodbench.errors import ConfigError, DatasetError
from lodbench.extras import require
from lodbench.storage import digest_of, file_digest, make_folder, write_text
from lodbench.storage.digest import file_check
from lodbench.storage.json_text import parse_json
from lodbench.training.samples import require_unseen

from .training_params import LodLocTraining
from .training_views import MANIFEST_HINT, TrainingView, ViewSettings, find_views

WEIGHTS_FILE = "lodloc.onnx"
_MANIFEST_FILE = "training.json"
_HELD_OUT = 20
_SPACING_M = 1.0
# More than a step looks at, so that no two steps see the same ones.
_SURPLUS = 4


def train_heads(settings: LodLocTraining, tell: Callable[[str], None] = lambda line: None) -> Path:
    """Trains, or goes on where the same command was stopped; returns the file of the weights.

    The folder ``settings.out`` then holds ``checkpoint.pt``, ``training.json`` and ``lodloc.onnx``.

    Args:
        settings: How.
        tell: Called with a line at a time: what is trained on, and each epoch as it ends.

    Raises:
        LodbenchError: torch is missing, the data is at fault, or the folder holds another training.
    """
    require("torch", "torch", "lodbench train method=lodloc")
    from lodbench.segmentation.nets.unets import STRIDE
    from lodbench.segmentation.nets.weights import write_onnx

    from .nets.loop import train
    from .nets.net import WireframeNet
    from .nets.packed_onnx import pack_onnx

    if settings.init is not None and not Path(settings.init).expanduser().is_file():
        raise ConfigError(
            f"There are no weights {settings.init}.", "init=OUT/checkpoint.pt of a former training."
        )
    views, held_out, source = _split(settings)
    tell(f"{len(views)} views to train on, {len(held_out)} to validate on: {source}")
    out = Path(settings.out).expanduser()
    make_folder(out)
    record = _record(settings, views, held_out, source)
    weights = out / WEIGHTS_FILE

    def keep(net: WireframeNet, history: list[dict[str, float]]) -> None:
        write_onnx(net, weights, STRIDE)
        pack_onnx(weights)
        done = record | {"history": history, "weights": {weights.name: file_digest(weights)}}
        write_text(out / _MANIFEST_FILE, json.dumps(done, indent=1, sort_keys=True) + "\n")
        last = {name: value for name, value in history[-1].items() if name not in ("epoch", "lr")}
        losses = ", ".join(f"{name} {value:.3f}" for name, value in last.items())
        tell(f"epoch {len(history)} of {settings.epochs}: {losses}")

    train(settings, views, held_out, record["digest"], keep)
    return weights


def _split(settings: LodLocTraining) -> tuple[list[TrainingView], list[TrainingView], str]:
    """Returns the views to train on, those to validate on, and what the latter are.

    Raises:
        DatasetError: There are none of one kind.
    """
    prepared = ViewSettings(
        settings.size, settings.lod, settings.priors, _SURPLUS * settings.points, _SPACING_M, settings.seed
    )
    data = Path(settings.data).expanduser()
    train = find_views(data, prepared, ("train",))
    if settings.val_data is not None:
        other = Path(settings.val_data).expanduser()
        val, source = find_views(other, prepared, ("train", "val", "test")), f"views of {other.name}"
        require_unseen([view.photo for view in train], [view.photo for view in val])
    else:
        val, source = find_views(data, prepared, ("val",)), "val views, of regions of their own"
        if not val:
            val, train = train[::_HELD_OUT], [view for k, view in enumerate(train) if k % _HELD_OUT]
            source = f"every {_HELD_OUT}th training view, held out: of the same regions"
    if not train or not val:
        kind = "train on" if not train else "validate on"
        raise DatasetError(f"{data} has no views to {kind}.", "lodbench generate-training-data makes some.")
    return train, val, source


def _record(
    settings: LodLocTraining, views: list[TrainingView], held_out: list[TrainingView], source: str
) -> dict[str, Any]:
    """Returns what the training follows from; its digest names it."""
    idle = ("data", "val_data", "out", "resume", "init", "keep")
    identity = {
        "method": "lodloc",
        "settings": {name: value for name, value in asdict(settings).items() if name not in idle},
        "init": file_digest(Path(settings.init).expanduser()) if settings.init else None,
        "views": _content(views),
        "held out": _content(held_out),
    }
    return identity | {
        "digest": digest_of(identity),
        "domain": "synthetic",
        "counts": {"train": len(views), "val": len(held_out), "validated_on": source},
        "sets": _sets(Path(settings.data).expanduser()),
        "versions": {"lodbench": __version__, "torch": version("torch")},
    }


def _content(views: list[TrainingView]) -> str:
    """Returns a digest of photos, true poses and what the map shows: another city shows something else."""
    shown = [[hashlib.sha256(points.tobytes()).hexdigest() for points in view.wireframes] for view in views]
    return digest_of(
        [
            [view.key, file_check(view.photo), view.truth.cam_from_world.tolist(), points]
            for view, points in zip(views, shown, strict=True)
        ]
    )


def _sets(data: Path) -> dict[str, Any]:
    """Returns digests and settings of the training sets below a folder, without the machine's paths."""
    sets = {}
    for path in sorted(data.rglob("manifest.json")):
        try:
            manifest = parse_json(path.read_text(encoding="utf-8"))
            settings = {k: value for k, value in manifest["settings"].items() if k not in ("city", "props")}
            summary = {key: manifest[key] for key in ("digest", "inputs", "views")}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise DatasetError(f"{path} is no manifest of a training set.", MANIFEST_HINT) from error
        sets[path.parent.relative_to(data).as_posix()] = summary | {"settings": settings}
    return sets
