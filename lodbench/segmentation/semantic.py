"""``segmenter=semantic``: any Hugging Face semantic segmentation checkpoint, by the names of its classes."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from lodbench.errors import ConfigError, nearest_names, require_within
from lodbench.segmentation.probability import check_normalise
from lodbench.segmentation.torch_segmenter import TorchSegmenter, hub_folder, is_hub_id
from lodbench.storage import digest_of, file_digest


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
        path = Path(params.weights).expanduser()
        if not path.is_dir() and (path.exists() or not is_hub_id(params.weights)):
            raise ConfigError(
                f"{path} is no folder." if path.exists() else f"There is no folder {path}.",
                "segmenter.weights= takes a folder with config.json and safetensors files, or a hub id.",
            )
        self._folder = path if path.is_dir() else hub_folder(params.weights)

    @cached_property
    def weights_digest(self) -> str:
        """Returns the SHA-256 of the checkpoint's configuration and weights."""
        parts = [self._folder / "config.json", *sorted(self._folder.glob("*.safetensors"))]
        return digest_of([file_digest(part) for part in parts if part.is_file()], length=64)

    def _init(self) -> str | None:
        return None

    def build(self, init: str | None) -> Any:
        """Returns the network as a module that answers with one logit per pixel.

        Raises:
            ConfigError: The folder holds no such checkpoint, or it has no class of these names.
        """
        from transformers import AutoModelForSemanticSegmentation

        from lodbench.segmentation.nets.semantic import OneAgainstRest

        try:
            model = AutoModelForSemanticSegmentation.from_pretrained(
                str(self._folder), local_files_only=True, use_safetensors=True
            )
        except (OSError, ValueError, KeyError, RuntimeError) as error:
            raise ConfigError(
                f"{self._folder} holds no semantic segmentation network: {str(error).splitlines()[0][:100]}",
                "A folder with config.json and safetensors is wanted.",
            ) from error
        names = {str(label): int(index) for index, label in model.config.id2label.items()}
        for wanted in self.params.classes:
            if wanted not in names:
                raise ConfigError(
                    f"{self._folder.name} has no class {wanted!r}.", nearest_names(wanted, list(names))
                )
        return OneAgainstRest(model, [names[wanted] for wanted in self.params.classes])
