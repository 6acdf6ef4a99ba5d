"""What is trained on: `lodbench render` and `generate-training-data` draw a city; `lodbench train`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar, cast

from omegaconf import DictConfig

from lodbench.cli.hydra_app import plain, run_hydra, section
from lodbench.cli.options import profile_of
from lodbench.cli.settings import names_method
from lodbench.errors import ConfigError, Words
from lodbench.execution.executor import QUERIES, ExecutorParams
from lodbench.harness.render import RenderParams, render_poses
from lodbench.params import to_params
from lodbench.plugins import blaming, load_plugin
from lodbench.reporting.aligned_text import already_there, plain_text
from lodbench.segmentation.protocol import make_segmenter
from lodbench.synthesis import camera_paths, generate, photo
from lodbench.training.samples import LEAST_SHARE, TrainParams
from lodbench.training.train import Trained, train_network

T = TypeVar("T")


def main_render(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    return run_hydra("render", "render", render_task, argv)


def render_task(config: DictConfig) -> None:
    """Renders one configuration."""
    values = plain(config)
    source = profile_of(values.pop("source"))
    params = to_params(values, RenderParams, "")
    rendered = render_poses(params if params.lod else replace(params, lod=source.lod), source.options)
    for note in rendered.notes:
        sys.stdout.write(f"note: {note}\n")
    count = len(rendered.files)
    sys.stdout.write(f"{count} {'file' if count == 1 else 'files'} in {params.out}\n")


def main_generate(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    return run_hydra("generate-training-data", "generate-training-data", generate_task, argv)


def generate_task(config: DictConfig) -> None:
    """Generates the set of one configuration."""
    values = plain(config)
    source = profile_of(values.pop("source"), values.get("crs"))
    executor = to_params(section(values, "executor"), ExecutorParams, "executor")
    if executor.share != QUERIES:
        raise ConfigError(
            f"executor.share={executor.share} is not used: views are spread over the workers, one at a time.",
            "Leave executor.share out.",
        )
    values.pop("executor")
    # Asked before a town is built, which takes half a minute.
    params = with_demo(params_of(values))
    params = params if params.lod else replace(params, lod=source.lod)
    sys.stdout.write(report_generated(generate.generate_training_data(params, source.options, executor)))


def with_demo(params: camera_paths.GenerateParams) -> camera_paths.GenerateParams:
    """Returns settings in which ``city=demo`` is a built-in town, with its own surroundings.

    ``demo`` is the town to train on, ``demo:SEED`` another of its kind, ``demo:test`` the town to test on.

    Raises:
        ConfigError: What follows the colon is neither, or a textured model is to be pictured instead.
    """
    name, _, which = params.city.partition(":")
    if name != "demo" or Path(params.city).exists():
        return params
    from lodbench.synthesis.demo import DemoParams, DemoTrainParams, demo_folder
    from lodbench.synthesis.town.build import CITY_FILE, FINE_CITY_FILE, PROPS_FILE

    if which not in ("", "test") and not which.isdecimal():
        raise ConfigError(f"city={params.city} is not known.", "demo, demo:SEED or demo:test.")
    if params.texture_model is not None:
        raise ConfigError(
            f"texture_model is not used with city={params.city}, which has a look of its own.",
            "Leave texture_model out, or name the city that the model is of.",
        )
    # The town alone is wanted; two queries are the fewest it is built with.
    town = DemoParams(num_queries=2) if which == "test" else DemoTrainParams(num_queries=2)
    root = demo_folder(replace(town, town_seed=int(which)) if which.isdecimal() else town)
    # Its level 1 is a map grown old, to test on; what is there today is in level 2, and finer in 3.
    lod = params.lod or "2"
    city = root / (FINE_CITY_FILE if lod == "3" else CITY_FILE)
    return replace(params, city=str(city), props=params.props or str(root / PROPS_FILE), lod=lod)


def params_of(values: dict[str, Any]) -> camera_paths.GenerateParams:
    """Returns the settings of a resolved configuration.

    Raises:
        ConfigError: A name is unknown, or a value of the wrong type or out of range.
    """
    look = to_params(section(values, "look"), photo.LookRanges, "look")
    return replace(
        to_params(
            {key: value for key, value in values.items() if key != "look"}, camera_paths.GenerateParams, ""
        ),
        look=look,
    )


def report_generated(made: generate.Generated) -> str:
    """Returns what is said at the end."""
    views = ", ".join(f"{count} {split}" for split, count in made.views.items())
    lines = [f"note: {note}" for note in made.notes]
    lines += [f"views: {views}{already_there(made.resumed)}"]
    lines += [f"skipped: {count} {reason}" for reason, count in made.skipped.items()]
    if made.views and not made.views.get("val"):
        lines.append(
            "note: no val views: training holds out every 20th view instead; a larger val_share gives some"
        )
    lines += [f"folder: {made.out}", f"sheet:  {made.out / 'overview.png'}"]
    return "\n".join(lines) + "\n"


def main_train(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    if names_method(argv):
        return run_hydra("train", "train-method", train_method, argv)
    return run_hydra("train", "train", train_segmenter, argv)


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
    _print(f"training {name} on {settings.data} into {settings.out}")
    with blaming("methods", name, "be trained"):
        weights = part.train(settings, _print)
    sys.stdout.write(f"weights: {weights}\n")


def train_segmenter(config: DictConfig) -> None:
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
    _print(f"training {name} on {params.data} into {params.out}")
    segmenter, _ = make_segmenter(name, settings)
    with blaming("segmenters", name, "be trained"):
        trained = train_network(cast("Any", segmenter), params, _print)
    if trained.history:
        sys.stdout.write(report_trained(trained))


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


def _print(line: str) -> None:
    sys.stderr.write(f"{plain_text(line)}\n")
    sys.stderr.flush()


def report_trained(trained: Trained) -> str:
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
