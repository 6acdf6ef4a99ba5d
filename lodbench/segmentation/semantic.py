"""``segmenter=semantic``: any Hugging Face semantic segmentation checkpoint, by the names of its classes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from lodbench.errors import ConfigError, nearest_names, require_within
from lodbench.segmentation.probability import check_normalise
from lodbench.segmentation.torch_segmenter import TorchSegmenter
from lodbench.segmentation.weight_files import checkpoint_folder
from lodbench.storage import digest_of, file_digest
from lodbench.storage.json_text import parse_json

_CONFIG = "config.json"
# The weights, and where a checkpoint in parts says which file holds what.
_FILE, _INDEX = "model.safetensors", "model.safetensors.index.json"
_FRACTIONS = frozenset({"F64", "F32", "F16", "BF16"})
# Other names are those of tables of positions and counts of batches, which are whole.
_WEIGHTS = (".weight", ".bias")


def require_own_safetensors(folder: Path) -> None:
    """Makes sure that the weights of a folder are safetensors within it, and not quantised.

    Raises:
        ConfigError: The index or config.json names another file, or weights are whole numbers or of 8 bits:
            without the scale that they were quantised by they mean nothing.
    """
    named, parts = _named(folder / _CONFIG), _parts(folder / _INDEX)
    for source, names in ((_CONFIG, named), (_INDEX, parts)):
        for name in names:
            if Path(name).name != name or not name.endswith(".safetensors"):
                raise ConfigError(
                    f"{folder / source} names {ascii(name)[1:-1][:80]}, no safetensors file beside it.",
                    "Fetch the checkpoint again, from somebody you trust.",
                )
    whole_file = [_FILE] if (folder / _FILE).is_file() else []
    for name in named or whole_file or parts:  # as transformers chooses; others may lie beside them
        whole = _whole_numbers(folder / name)
        if whole:
            raise ConfigError(
                f"{folder / name} has {len(whole)} weights of whole numbers or 8 bits: {whole[0]}, ...",
                "Quantised checkpoints are not read: fetch the one in 16 or 32 bits.",
            )


def _named(config: Path) -> list[str]:
    """Returns the file of weights that a configuration names itself, as a list; none where it does not."""
    try:
        named = parse_json(config.read_text(encoding="utf-8")).get("transformers_weights")
    except (OSError, ValueError, AttributeError):
        return []  # whoever loads it says what is wrong
    return [] if named is None else [str(named)]


def _parts(index: Path) -> list[str]:
    """Returns the files that an index names; none where there is no index."""
    if not index.is_file():
        return []
    try:
        stored = parse_json(index.read_text(encoding="utf-8"))
        return sorted({str(name) for name in stored["weight_map"].values()})
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigError(f"{index} is no index of weights.", "Fetch the checkpoint again.") from error


def _whole_numbers(path: Path) -> list[str]:
    """Returns a safetensors file's weights that are whole numbers or of 8 bits; of no such file, none."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "np") as stored:
            names = [name for name in stored.keys() if name.endswith(_WEIGHTS)]
            return [name for name in names if stored.get_slice(name).get_dtype() not in _FRACTIONS]
    except (OSError, SafetensorError):
        return []  # whoever loads it says what is wrong


# Where a checkpoint says how photos are brought to it.
_PREPROCESSOR = "preprocessor_config.json"


@dataclass(frozen=True, slots=True)
class SemanticParams:
    """Settings of ``segmenter=semantic``.

    Attributes:
        weights: Folder of a checkpoint (``config.json``, safetensors), or the id of a repository
            fetched before.
        classes: Names of the classes that count as building, as the checkpoint spells them.
        name: Name to report.
        size: Long side that photos are brought to, pixels.
        normalise: ``paper`` or ``none``; see ``probability_of``.
        device: ``auto``, ``cpu``, ``cuda``, ...

    Raises:
        ConfigError: A setting is out of range.
    """

    weights: str
    classes: list[str] = field(default_factory=lambda: ["building"])
    name: str = "semantic"
    size: int = 1024
    normalise: str = "none"
    device: str = "auto"

    def __post_init__(self) -> None:
        require_within("segmenter.size", self.size, 32, 4096)
        if not self.classes:
            raise ConfigError("segmenter.classes is empty.", "segmenter.classes='[building,house]'")
        check_normalise(self.normalise)


class Semantic(TorchSegmenter):
    """The odds of some classes of a semantic network against all its others."""

    params_type = SemanticParams
    is_square = False

    def __init__(self, params: SemanticParams) -> None:
        super().__init__(params)
        hint = "`segmenter.weights=` takes a folder with config.json and safetensors files, or a hub id."
        self._folder = checkpoint_folder(params.weights, hint)

    @cached_property
    def weights_digest(self) -> str:
        """Returns the SHA-256 of the checkpoint's configuration and weights."""
        parts = [self._folder / "config.json", self._folder / _PREPROCESSOR]
        parts += sorted(self._folder.glob("*.safetensors"))
        return digest_of([file_digest(part) for part in parts if part.is_file()], length=64)

    def _init(self) -> str | None:
        return None

    def build(self, init: str | None) -> Any:
        """Returns the network as a module that answers with one logit per pixel.

        Raises:
            ConfigError: The folder holds no such checkpoint or not all of its weights, it has no class of
                these names or no other, or asks for photos that are not made.
        """
        from lodbench.segmentation.nets.sam import OneAgainstRest

        model = self._model()
        labels = {int(index): str(label) for index, label in model.config.id2label.items()}
        for wanted in self.params.classes:
            if wanted not in labels.values():
                raise ConfigError(
                    f"{self._folder.name} has no class {wanted!r}.",
                    nearest_names(wanted, set(labels.values())),
                )
        classes = [index for index, label in labels.items() if label in self.params.classes]
        if len(classes) == len(labels) > 1:
            raise ConfigError(
                "segmenter.classes names all classes of the network: all of a photo would be building.",
                "Leave out what is no building.",
            )
        return OneAgainstRest(model, classes, *_normalisation(self._folder))

    def _model(self) -> Any:
        """Returns the checkpoint's network, every weight of it from the checkpoint."""
        from transformers import AutoModelForSemanticSegmentation
        from transformers.utils import logging

        from lodbench.segmentation.nets.weights import require_finite

        require_own_safetensors(self._folder)
        logging.disable_progress_bar()
        logging.set_verbosity_error()  # what is missing is reported below
        try:
            # A checkpoint that brings code is refused: otherwise the user is prompted to let it run.
            with _offline():
                model, info = AutoModelForSemanticSegmentation.from_pretrained(
                    str(self._folder), local_files_only=True, use_safetensors=True, output_loading_info=True,
                    trust_remote_code=False,
                )  # fmt: skip
        except Exception as error:  # of what kind is up to transformers and to what stands in config.json
            raise ConfigError(
                f"{self._folder} holds no semantic segmentation network: {_first_line(error)}",
                "A folder with config.json and safetensors is wanted.",
            ) from error
        missing = sorted(name for name in info["missing_keys"] if not name.endswith("num_batches_tracked"))
        if missing:
            raise ConfigError(
                f"{self._folder} lacks {len(missing)} weights of the network: {', '.join(missing[:3])}, ...",
                "They would be random. Was only the backbone trained?",
            )
        require_finite(model.state_dict(), str(self._folder))
        return model


@contextmanager
def _offline() -> Iterator[None]:
    """Keeps what is called within from the hub: a configuration may name a backbone that lies there."""
    from huggingface_hub import constants

    before, constants.HF_HUB_OFFLINE = constants.HF_HUB_OFFLINE, True
    try:
        yield
    finally:
        constants.HF_HUB_OFFLINE = before


def _first_line(error: Exception) -> str:
    """Returns the first line of what an error says, or its kind where it says nothing."""
    stated = str(error)
    # Both name settings that nobody can reach from here.
    if "ignore_mismatched_sizes" in stated:
        return "its weights are of other shapes than its config.json says"
    if "trust_remote_code" in stated:
        return "it holds code of its own, which is never run"
    return (stated.strip().splitlines() or [type(error).__name__])[0][:100]


def _normalisation(folder: Path) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Returns mean and deviation, red first, of the photos in [0, 1] that a checkpoint learnt from.

    They are ImageNet's where it does not say.
    """
    from lodbench.segmentation.nets.sam import DEVIATION, MEAN

    path = folder / _PREPROCESSOR
    if not path.is_file():
        return MEAN, DEVIATION
    try:
        stored = parse_json(path.read_text(encoding="utf-8"))
        mean = tuple(float(value) for value in stored.get("image_mean") or MEAN)
        deviation = tuple(float(value) for value in stored.get("image_std") or DEVIATION)
        if len(mean) != 3 or len(deviation) != 3 or min(deviation) <= 0:
            raise ValueError("image_mean and image_std are three numbers each")
        if stored.get("do_flip_channel_order"):
            raise ValueError("photos with blue first are not made")
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise ConfigError(f"{path} cannot be followed: {error}.", "Fetch the checkpoint again.") from error
    return ((0.0,) * 3, (1.0,) * 3) if stored.get("do_normalize") is False else (mean, deviation)
