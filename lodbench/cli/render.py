"""`lodbench render`: a city drawn from given poses."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace

from omegaconf import DictConfig

from lodbench.cli.hydra_app import plain, run_hydra
from lodbench.cli.source_profiles import profile_of
from lodbench.harness.render.render import RenderParams, render_poses
from lodbench.params import to_params


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
