"""`lodbench bench silhouettes|accuracy`: measure speed and accuracy on this machine."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from lodbench.bench import (
    AccuracyOptions,
    AccuracyReport,
    SilhouetteOptions,
    SilhouetteReport,
    measure_accuracy,
    measure_silhouettes,
)
from lodbench.execution import Progress


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    options = _parser().parse_args(argv)
    city = options.city or _demo_town()
    with _Steps(f"bench {options.what}") as steps:
        report = MEASURES[options.what](city, options, steps)
    if options.json:
        for figure in report.figures():
            sys.stdout.write(json.dumps(figure.to_json()) + "\n")
    else:
        sys.stdout.write(report.to_text() + "\n")
    return 0


def _silhouettes(city: Path, options: argparse.Namespace, steps: _Steps) -> SilhouetteReport:
    peers = tuple(options.peers.split(",")) if options.peers else ()
    asked = SilhouetteOptions(
        num_views=options.views, hypotheses=options.hypotheses, peers=peers, seed=options.seed
    )
    return measure_silhouettes(city, asked, steps)


def _accuracy(city: Path, options: argparse.Namespace, steps: _Steps) -> AccuracyReport:
    asked = AccuracyOptions(
        num_views=options.views, mask_iou=options.mask_iou, tilt_deg=options.tilt_deg, seed=options.seed
    )
    return measure_accuracy(city, asked, steps)


MEASURES: dict[str, Callable[..., SilhouetteReport | AccuracyReport]] = {
    "silhouettes": _silhouettes,
    "accuracy": _accuracy,
}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("lodbench bench", description="Measure speed and accuracy.")
    actions = parser.add_subparsers(dest="what", required=True)
    speed = actions.add_parser("silhouettes", help="time per hypothesis, beside other renderers")
    speed.add_argument("--views", type=int, default=20, help="seeded views (20)")
    speed.add_argument("--hypotheses", type=int, default=2000, help="around each view (2000)")
    speed.add_argument("--peers", default="pyrender", help="renderers to stand beside, comma-separated")
    accuracy = actions.add_parser("accuracy", help="recall of LoD-Loc v2 on synthetic views of a real model")
    accuracy.add_argument("--views", type=int, default=200, help="seeded views (200)")
    accuracy.add_argument("--mask-iou", type=float, default=0.88, help="of the roughened masks (0.88)")
    accuracy.add_argument("--tilt-deg", type=float, default=1.0, help="prior's tilt error, +- (1.0)")
    for action in (speed, accuracy):
        action.add_argument("--city", type=Path, help="city model; the demo town if not given")
        action.add_argument("--seed", type=int, default=0)
        action.add_argument("--json", action="store_true", help="one figure per line, for machines")
    return parser


def _demo_town() -> Path:
    from lodbench.datasets.demo.open import DemoParams, open_demo

    return open_demo(DemoParams()).city_model


class _Steps:
    """Draws progress for a measurement that reports how many steps of how many it has done."""

    def __init__(self, label: str) -> None:
        self._label = label
        self._progress: Progress | None = None

    def __enter__(self) -> _Steps:
        return self

    def __exit__(self, *_: object) -> None:
        if self._progress is not None:
            self._progress.__exit__(None, None, None)

    def __call__(self, done: int, total: int) -> None:
        if self._progress is None:
            self._progress = Progress(self._label, total)
        self._progress.advance()
