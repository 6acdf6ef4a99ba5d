"""`lodbench train`: a segmentation network, or what a method learns, from rendered views."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, TypeVar, cast

from omegaconf import DictConfig

from lodbench.cli.hydra_app import plain, run_hydra, section
from lodbench.cli.settings import names_method
from lodbench.errors import ConfigError, Words
from lodbench.params import to_params
from lodbench.plugins import blaming, load_plugin
from lodbench.reporting.aligned_text import already_there, plain_text
from lodbench.segmentation.registry import make_segmenter
from lodbench.training.samples import LEAST_SHARE, TrainParams
from lodbench.training.train import Trained, train_network

T = TypeVar("T")


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    if names_method(argv):
        return run_hydra("train", "train-method", train_method, argv)
    return run_hydra("train", "train", task, argv)


def train_method(config: DictConfig) -> None:
    """Trains what the method of one configuration learns."""
    values = plain(config)
    schedule, method = section(values, "schedule"), section(values, "method")
    others = {key: value for key, value in values.items() if key not in ("method", "schedule")}
    name = str(method.get("name", ""))
    part = load_plugin("methods", name)
    if not hasattr(part, "train"):
        raise ConfigError(f"method={name} has nothing to train.", "Trainable: method=lodloc, and segmenters.")
    with blaming("methods", name, "take its settings"):
        is_plain = to_params(method, part.params_type, "method") == part.params_type()
        settings = _settings(schedule, others, part.training_type)
    if not is_plain:
        raise ConfigError(
            "Settings of a method do not apply to its training.", "Its training's settings are schedule.*"
        )
    _tell(f"training {name} on {settings.data} into {settings.out}")
    with blaming("methods", name, "be trained"):
        weights = part.train(settings, _tell)
    sys.stdout.write(f"weights: {weights}\n")


def task(config: DictConfig) -> None:
    """Trains the network of one configuration."""
    values = plain(config)
    settings, schedule = section(values, "segmenter"), section(values, "schedule")
    others = {key: value for key, value in values.items() if key not in ("segmenter", "schedule")}
    if settings.get("weights") is not None:
        raise ConfigError(
            "lodbench train makes weights and reads none from segmenter.weights.",
            "init=FILE goes on from them; segmenter.encoder_weights=FILE starts from an encoder's.",
        )
    params = _settings(schedule, others, TrainParams)
    name = str(settings.get("name", ""))
    if not hasattr(load_plugin("segmenters", name), "build"):
        raise ConfigError(
            f"segmenter={name} has no network to train.",
            "Trainable: compact, compact_instances, compact_classes, efficient_unet, sam2_unet, "
            "sam1_adapter.",
        )
    # Loading torch and the first step take a while: what is going on is said before.
    _tell(f"training {name} on {params.data} into {params.out}")
    segmenter, _ = make_segmenter(name, settings)
    with blaming("segmenters", name, "be trained"):
        trained = train_network(cast("Any", segmenter), params, _tell)
    if trained.history:
        sys.stdout.write(report(trained))


def _settings(schedule: dict[str, Any], others: dict[str, Any], kind: type[T]) -> T:
    """Returns the settings of a training; faults call those of the schedule as they are typed."""
    try:
        return to_params(schedule | others, kind, "")
    except ConfigError as fault:
        name = min((fault.message.partition(mark)[0] for mark in "=: "), key=len)
        if name in schedule:
            fault.message = Words(f"schedule.{fault.message}")
            fault.hint = fault.hint.rewritten(lambda option: f"schedule.{option.words}")
        raise


def _tell(line: str) -> None:
    sys.stderr.write(f"{plain_text(line)}\n")
    sys.stderr.flush()


def report(trained: Trained) -> str:
    """Returns what is said at the end."""
    last = trained.history[-1]
    # Of the weights that are named below, which may be the mean with those of other trainings.
    stored = trained.averaged or last
    iou = f"mean per view {stored['mean_iou']:.4f}, pooled {stored['pooled_iou']:.4f}"
    alone = f" ({last['mean_iou']:.4f} before averaging)" if trained.averaged else ""
    over = f"{iou}{alone}, over {last['views']:.0f} {trained.validated_on}"
    if not last["views"]:
        over = f"none, for no view to validate on has {100 * LEAST_SHARE:.0f} % buildings or more"
    before = already_there(trained.started_at)
    return (
        f"epochs:  {len(trained.history)}{before} over {trained.views} views, last loss {last['loss']:.4f}\n"
        f"val IoU: {over}\n"
        f"weights: {trained.weights}\n"
        f"curves:  {trained.weights.parent / 'curves.png'}\n"
    )
