"""Priors drawn around the truth, where a dataset has no sensor of its own."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import ClassVar

import numpy as np

from lodbench.datasets.query import Dataset
from lodbench.errors import DatasetError, require_numbers
from lodbench.geometry import EulerAngles, Pose
from lodbench.storage import random_stream

_NO_TRUTH_HINT = "Take the photos' own, `prior=sensor`, or those of a file: `prior=file` `prior.path=FILE`."


@dataclass(frozen=True, slots=True)
class UniformPrior:
    """Independent uniform errors around the truth, each within plus or minus its half width.

    The defaults are those of the published Swiss-EPFL priors: 17 m and 3.8 degrees in the median.
    Angles are errors of the datasets' pitch, roll and yaw, not turns about camera axes.

    Attributes:
        x_m: East, metres.
        y_m: North, metres.
        z_m: Up, metres.
        yaw_deg: Yaw, degrees.
        pitch_deg: Pitch, degrees.
        roll_deg: Roll, degrees.

    Raises:
        ConfigError: A half width is negative or not finite.
    """

    name: ClassVar[str] = "uniform"
    x_m: float = 10.0
    y_m: float = 10.0
    z_m: float = 30.0
    yaw_deg: float = 7.5
    pitch_deg: float = 1.0
    roll_deg: float = 1.0

    def __post_init__(self) -> None:
        require_numbers(self, "prior", (field.name for field in fields(self)), 0)

    def apply(self, dataset: Dataset, seed: int) -> Dataset:
        """Returns the dataset with priors drawn around the truth.

        Raises:
            DatasetError: No query has a truth.
        """
        return with_uniform_priors(dataset, self, seed)

    def draw(self, truth: Pose, generator: np.random.Generator) -> Pose:
        """Returns a prior around the truth; always six draws, so a width of 0 changes no other axis."""
        x, y, z, yaw, pitch, roll = generator.uniform(-1.0, 1.0, size=6)
        angles = truth.euler
        wrong = EulerAngles(
            angles.pitch_deg + pitch * self.pitch_deg,
            angles.roll_deg + roll * self.roll_deg,
            angles.yaw_deg + yaw * self.yaw_deg,
        )
        offset = np.array([x * self.x_m, y * self.y_m, z * self.z_m])
        return Pose.from_euler(wrong, truth.center + offset)

    def describe(self) -> str:
        """Returns the half widths in words, as a protocol prints them."""
        return (
            f"uniform around the truth: +-{self.x_m:g}/{self.y_m:g}/{self.z_m:g} m in x/y/z, "
            f"+-{self.yaw_deg:g} deg yaw, +-{self.pitch_deg:g}/{self.roll_deg:g} deg pitch/roll"
        )


def with_uniform_priors(dataset: Dataset, prior: UniformPrior, seed: int) -> Dataset:
    """Returns a dataset whose priors are drawn around the truth, one random stream per query.

    The stream does not know the widths: a wider prior errs in the same direction, only further. A
    query without a truth has none then: its own is no such draw.

    Raises:
        DatasetError: No query has a truth.
    """
    if not any(entry.key in dataset.truth for entry in dataset.entries):
        raise DatasetError(f"{dataset.name} has no true pose to draw priors around.", _NO_TRUTH_HINT)
    entries = []
    for entry in dataset.entries:
        truth = dataset.truth.get(entry.key)
        drawn: tuple[Pose, ...] = ()
        if truth is not None:
            drawn = (prior.draw(truth, random_stream(seed, dataset.name, entry.key, "prior")),)
        entries.append(entry.with_prior(drawn[0] if drawn else None, drawn))
    return replace(dataset, entries=tuple(entries))
