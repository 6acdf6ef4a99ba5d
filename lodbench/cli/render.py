"""`lodbench render`: a city's silhouettes from given poses."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from omegaconf import DictConfig

from lodbench.cli.hydra_app import plain, run_hydra, to_params
from lodbench.harness.render import RenderParams, render_poses


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    return run_hydra("render", "render", task, argv)


def task(config: DictConfig) -> None:
    """Renders one configuration."""
    params = to_params(plain(config), RenderParams, "render")
    written = render_poses(params)
    sys.stdout.write(f"{len(written)} pictures in {params.out}\n")
