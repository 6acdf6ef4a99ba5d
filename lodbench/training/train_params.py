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
    """How a network is trained; the defaults are the paper's.

    Attributes:
        data: Training set of ``lodbench generate-training-data``, or a folder of such sets.
        val_data: Set whose views validate; None for the ``val`` views of ``data``, and where it has none,
            every twentieth of its training views, held out.
        city: City model of a dataset of posed photos, where its own ``dataset.json`` names none.
        unlabelled: Folders of photos to learn from besides, labelled by the weights of ``init``.
        negatives: Folders of photos without buildings: learnt as they are, and, with ``augment=strong``, as
            ground and roofs of drawn views.
        traced: Folders of photos with masks traced by hand (``PLACE/photos``, ``PLACE/masks``), to learn
            from besides.
        traced_share: Share of the views of an epoch that they are repeated to.
        out: Folder of checkpoints, curves and weights.
        epochs: Passes over the training views.
        optimizer: ``adamw``, the paper's; or ``muon`` for the kernels of convolutions and AdamW for the rest:
            a small network from scratch learns several times faster.
        lr: Highest learning rate; it falls to ``lr_end`` along half a cosine.
        muon_lr: Highest learning rate of Muon; it falls as ``lr`` does.
        encoder_rate: Share of the learning rates at which an encoder learns that had weights before; 0
            leaves it as it is.
        lr_end: Learning rate at the end.
        warmup: Share of the steps in which it rises to ``lr``.
        weight_decay: Of AdamW.
        batch: Pictures per step, over all devices.
        size: Long side that views are brought to, pixels; 0 leaves them as they are.
        crop: Side of the random square that a step sees; 0 for the whole view, brought to
            ``size`` x ``size`` as the paper does.
        scale: Range of the random scale of a crop.
        augment: ``full`` (light, colour, blur, noise, turns, left for right), ``strong`` (other paints and
            sensors besides, see ``other_appearance``) or ``flips`` (SAM2-UNet's own).
        one_band: Share of pictures that ``full`` turns into those of one band, tones bent or inverted.
        weighting: ``paper``: pixels near outlines weigh up to six times in both losses; ``released``: in
            the IoU loss only, which is what the published code computes.
        precision: ``bfloat16`` for mixed precision; ``auto`` takes it on GPUs that have it.
        device: ``auto``, ``cpu``, ``cuda``, ...
        threads: Threads of torch on a CPU; the result depends on it in the last digits.
        seed: Of weights, order and augmentation.
        val_every: Epochs between validations and checkpoints.
        resume: Whether to go on from the checkpoint in ``out``.
        init: Weights to start from: a file, ``package`` for those in the package, or None for random ones.
        average: Checkpoints of trainings that went out from the same weights: the mean of theirs and this
            one's is what is stored at the end, as averaged.safetensors too.
        tensorboard: Whether to log for TensorBoard as well.

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
        if self.unlabelled and self.init is None:
            raise ConfigError(
                "unlabelled photos need a network that labels them.", "init=FILE.onnx, or package."
            )
        if self.size == self.crop == 0:
            raise ConfigError("size and crop are both 0.", "Views differ in size: set one of them.")
