"""Settings of ``lodbench train``."""

from __future__ import annotations

from dataclasses import dataclass

from lodbench.errors import ConfigError, require_choice, require_within

_CHOICES = {
    "weighting": ("paper", "released"),
    "precision": ("auto", "float32", "bfloat16"),
    "augment": ("full", "flips", "strong"),
    "optimizer": ("adamw", "muon"),
}
_BOUNDS = {
    "epochs": (1, 100_000),
    "lr": (1e-12, 10.0),
    "muon_lr": (1e-12, 10.0),
    "encoder_rate": (0.0, 10.0),
    "lr_end": (0.0, 10.0),
    "warmup": (0.0, 0.9),
    "weight_decay": (0.0, 10.0),
    "batch": (1, 4096),
    "one_band": (0.0, 1.0),
    "traced_share": (0.0, 0.95),
    "size": (0, 8192),
    "crop": (0, 8192),
    "scale": (0.1, 10.0),
    "val_every": (1, 100_000),
    "threads": (1, 1024),
}


@dataclass(frozen=True, slots=True)
class TrainParams:
    """How a network is trained, setting by setting as ``conf/train.yaml`` and ``conf/schedule`` say.

    The defaults are the paper's.

    Raises:
        ConfigError: A value is out of range; the message names it.
    """

    data: str
    val_data: str | None = None
    city: str | None = None
    unlabelled: tuple[str, ...] = ()
    negatives: tuple[str, ...] = ()
    traced: tuple[str, ...] = ()
    traced_share: float = 0.3
    out: str = "training"
    epochs: int = 20
    optimizer: str = "adamw"
    lr: float = 1e-3
    muon_lr: float = 0.02
    encoder_rate: float = 1.0
    lr_end: float = 1e-7
    warmup: float = 0.0
    weight_decay: float = 5e-4
    batch: int = 12
    size: int = 1024
    crop: int = 0
    scale: tuple[float, float] = (1.0, 1.0)
    augment: str = "flips"
    one_band: float = 0.0
    weighting: str = "paper"
    precision: str = "auto"
    device: str = "auto"
    threads: int | None = None
    seed: int = 0
    val_every: int = 1
    resume: bool = True
    init: str | None = None
    average: tuple[str, ...] = ()
    tensorboard: bool = False

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            require_choice(name, getattr(self, name), choices)
        for name, (low, high) in _BOUNDS.items():
            require_within(name, getattr(self, name), low, high)
        if self.scale[0] > self.scale[1]:
            raise ConfigError(
                f"scale=[{self.scale[0]:g},{self.scale[1]:g}] is no ascending range.", "`scale=[LOW,HIGH]`"
            )
        if self.unlabelled and self.init is None:
            raise ConfigError(
                "unlabelled photos need a network that labels them.", "`init=FILE.onnx`, or package."
            )
        if self.size == self.crop == 0:
            raise ConfigError("size and crop are both 0.", "Views differ in size: set one of them.")
