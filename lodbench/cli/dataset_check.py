"""`lodbench dataset check NAME|DIR`: what is there, and what is wrong with it."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from lodbench.cli.dataset_card import config_card
from lodbench.cli.flags import in_flags
from lodbench.cli.named_dataset import add_dataset_options, open_named
from lodbench.cli.parser import Parser
from lodbench.findings import Findings, Severity
from lodbench.harness.dataset_check import DatasetReport, SplitReport, check_dataset
from lodbench.reporting.aligned_text import count_of
from lodbench.reporting.safe_text import plain_text

_EPILOG = """\
Exit code: 0 sound, 1 at least one error, 2 the data is missing (the message says what, and where to get it).
The codes are explained in docs/datasets.md.
"""
_EXAMPLES = 3


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code.

    Raises:
        LodbenchError: The dataset is missing or cannot be read.
    """
    parser = Parser(
        "lodbench dataset check",
        "Look at every part of a dataset: files, counts, poses, priors, photos, city model.",
        _EPILOG,
    )
    add_dataset_options(parser)
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="a setting: dataset.NAME of a run"
    )
    parser.add_argument("--headers-only", action="store_true", help="do not decode photos and masks")
    parser.add_argument("--json", action="store_true", help="print plain values instead of text")
    options = parser.parse_args(argv[1:])
    dataset, card = open_named(options, options.set), config_card(options.dataset)
    counts = card.counts if card else {}
    dataset = replace(dataset, city_hint=in_flags(dataset.city_hint))
    report = check_dataset(dataset, with_pixels=not options.headers_only, counts=counts)
    text = json.dumps(_values(report), indent=2) + "\n" if options.json else _text(report)
    sys.stdout.write(text)
    return 1 if report.findings.has_errors() else 0


def _text(report: DatasetReport) -> str:
    dataset = report.dataset
    lines = [f"{dataset.name} in {dataset.root}", f"  city model: {report.city}"]
    for split in report.splits:
        lines += [f"  {split.name}: {line}" for line in _split_lines(split)]
    lines += ["findings", *_finding_lines(report.findings)]
    # Names come from files, indents from here.
    indents = [line[: len(line) - len(line.lstrip(" "))] for line in lines]
    return "".join(f"{indent}{plain_text(line)}\n" for indent, line in zip(indents, lines, strict=True))


def _split_lines(split: SplitReport) -> list[str]:
    whose = "its card says" if split.paper_prior is None else "the paper's tables imply"
    tables = "" if split.expected is None else f" ({whose} {split.expected})"
    lines = [
        f"{count_of(split.queries, 'queries')}, {split.truths} with a true pose{tables}, "
        f"{count_of(split.photos, 'photos')}, {count_of(split.masks, 'masks')}"
    ]
    if split.prior is None:
        there = f"{split.priors} priors; their errors are unknown without true poses"
        lines.append(there if split.priors and not split.truths else "no priors")
    else:
        paper = split.paper_prior
        beside = "" if paper is None else f" (paper: {paper[0]:g} m / {paper[1]:g} deg)"
        medians = f"{split.prior.translation_m:.2f} m / {split.prior.rotation_deg:.2f} deg"
        lines.append(f"priors off by {medians} in the median{beside}")
    if split.height_m is not None and split.off_nadir_deg is not None:
        low, mid, high = split.height_m
        flat, tilted, most = split.off_nadir_deg
        lines.append(
            f"cameras {low:.0f} to {high:.0f} m above the city's lowest point (median {mid:.0f}), "
            f"looking {flat:.0f} to {most:.0f} deg off straight down (median {tilted:.0f})"
        )
    return lines


def _finding_lines(findings: Findings) -> list[str]:
    lines = []
    for name, count in findings.counts().items():
        items = [item for item in findings.items if str(item.code) == name]
        code = items[0].code
        lines.append(f"  {name}, {code.severity.value}, {count} x: {code.meaning}")
        lines += [
            f"    {item.object_id}{f': {item.detail}' if item.detail else ''}" for item in items[:_EXAMPLES]
        ]
        lines += [f"    ... and {count - _EXAMPLES} more (--json lists all)"] if count > _EXAMPLES else []
    return lines or ["  none"]


def _values(report: DatasetReport) -> dict[str, Any]:
    return {
        "dataset": report.dataset.name,
        "root": str(report.dataset.root),
        "city_model": report.city,
        "splits": {
            split.name: {
                "queries": split.queries,
                "expected": split.expected,
                "truths": split.truths,
                "priors": split.priors,
                "photos": split.photos,
                "masks": split.masks,
                "prior_median": None if split.prior is None else list(split.prior),
                "paper_prior_median": None if split.paper_prior is None else list(split.paper_prior),
                "height_m": split.height_m,
                "off_nadir_deg": split.off_nadir_deg,
            }
            for split in report.splits
        },
        "findings": [
            {
                "code": item.code.code,
                "name": item.code.name,
                "severity": item.code.severity.value,
                "object": item.object_id,
                "detail": item.detail,
            }
            for item in report.findings.items
        ],
        "errors": sum(item.code.severity is Severity.ERROR for item in report.findings.items),
    }
