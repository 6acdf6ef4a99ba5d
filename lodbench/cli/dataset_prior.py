"""`lodbench dataset prior NAME|DIR --kind uniform --out FILE`: priors as a file, made once and for all."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lodbench.cli.named_dataset import add_dataset_options, open_named
from lodbench.cli.parser import Parser
from lodbench.datasets.prior_sources import is_prior_text, prior_digest, prior_text
from lodbench.datasets.registry import draw_priors, make_priors
from lodbench.errors import ConfigError, DatasetError, LodbenchError
from lodbench.harness.dataset_check import prior_errors_in_words
from lodbench.plugins import plugin_names
from lodbench.storage import write_text

_EPILOG = """\
The file has lines `split/name qw qx qy qz tx ty tz`, world to camera. Run on it with
  lodbench run prior=file prior.path=FILE ...
Settings are those of `lodbench run prior=KIND prior.KEY=VALUE`:
  uniform  x_m y_m z_m yaw_deg pitch_deg roll_deg   half widths
  basin    range_m yaw_deg tilt_deg                 half widths
  sensor   heights takeoff_m geoid_m offset_m       how the photos' heights become the city's
"""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code.

    Raises:
        LodbenchError: The dataset or a setting is wrong, or the priors cannot be had.
    """
    parser = Parser("lodbench dataset prior", "Write a dataset's priors to a file.", _EPILOG)
    add_dataset_options(parser)
    parser.add_argument(
        "--kind",
        default="uniform",
        metavar="KIND",
        help=f"where they come from: {', '.join(plugin_names('priors'))}",
    )
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting")
    parser.add_argument("--seed", type=int, default=0, help="random seed (default: 0)")
    parser.add_argument("--out", type=Path, metavar="FILE", required=True, help="the file to write")
    options = parser.parse_args(argv[1:])
    if options.out.is_dir():
        raise ConfigError(f"{options.out} is a folder.", "Name a file.")
    if options.out.exists() and not is_prior_text(options.out):
        raise ConfigError(
            f"{options.out} is there already, and no file of this command.", "Name another file: --out FILE."
        )
    with _in_own_words():
        settings = dict(map(_pair, options.set))
        priors = make_priors(options.kind, settings)
        dataset = draw_priors(open_named(options), options.kind, priors, options.seed)
    made = sum(entry.prior is not None for entry in dataset.entries)
    if not made:
        raise DatasetError(
            f"No query of {options.dataset} has a prior of --kind {options.kind}: nothing is written.",
            "Another kind draws them around the truth, or reads them from the photos; see --help.",
        )
    write_text(options.out, prior_text(dataset.entries, priors.describe(), options.seed))
    lines = [f"{options.out}: {made} of {len(dataset.entries)} queries, {priors.describe()}"]
    lines += [f"digest {prior_digest(dataset.entries)}"]
    lines += [f"{split}: {words}" for split, words in prior_errors_in_words(dataset).items()]
    lines += [f"note: {_own_words(note)}" for note in dataset.notes]
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


@contextmanager
def _in_own_words() -> Iterator[None]:
    """Turns what faults say of the settings of a run into this command's words."""
    try:
        yield
    except LodbenchError as fault:
        fault.message, fault.hint = _own_words(fault.message), _own_words(fault.hint)
        raise


def _own_words(text: str) -> str:
    return re.sub(r"\bprior\.(?=\w)", "--set ", text).replace("prior=", "--kind ")


def _pair(word: str) -> tuple[str, Any]:
    key, equals, value = word.partition("=")
    if not equals:
        raise ConfigError(f"--set {word} has no value.", "Settings are KEY=VALUE.")
    return key, value
