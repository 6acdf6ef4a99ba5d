"""`lodbench render`: a city from given poses; `lodbench generate-training-data`: images, masks and poses."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from lodbench.cli.hydra_app import plain, run_hydra, section
from lodbench.cli.parts import profile_of
from lodbench.errors import ConfigError
from lodbench.execution.executor import QUERIES, ExecutorParams
from lodbench.harness.render import RenderParams, render_poses
from lodbench.params import to_params
from lodbench.reporting.aligned_text import already_there
from lodbench.synthesis.photo import LookRanges
from lodbench.synthesis.training_data import GenerateParams
from lodbench.synthesis.training_data.generate import Generated, generate_training_data


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    return run_hydra("render", "render", task, argv)


def task(config: DictConfig) -> None:
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
    sys.stdout.write(report(generate_training_data(params, source.options, executor)))


def with_demo(params: GenerateParams) -> GenerateParams:
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


def params_of(values: dict[str, Any]) -> GenerateParams:
    """Returns the settings of a resolved configuration.

    Raises:
        ConfigError: A name is unknown, or a value of the wrong type or out of range.
    """
    look = to_params(section(values, "look"), LookRanges, "look")
    return replace(
        to_params({key: value for key, value in values.items() if key != "look"}, GenerateParams, ""),
        look=look,
    )


def report(made: Generated) -> str:
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
