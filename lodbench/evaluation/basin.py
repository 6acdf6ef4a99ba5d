"""Convergence basins: how far off a prior may be before a method no longer finds the pose.

The protocol is fixed, so that basins of two methods compare: priors uniform around the truth, a search
as wide as the prior's error (twice its half width) at the method's own stride, every pose of the grid
kept, one random stream per query. The paper gives the ranges and the stride and leaves the rest open
(its Table 3); the orientation twin of that table is in an appendix that is not published.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import ConfigError, require_within

TRANSLATION, ORIENTATION = "translation", "orientation"
_UNITS = {TRANSLATION: "m", ORIENTATION: "deg"}
# What stays as it is while the other part of the prior is widened: the published priors.
_BASE = UniformPrior()


@dataclass(frozen=True, slots=True)
class BasinStep:
    """One row of a basin table.

    Attributes:
        kind: ``translation`` or ``orientation``.
        half_width: Half width of the prior's error: along x, y and z in metres, or of yaw in degrees.
        limit: At most this many queries per split, or None.
    """

    kind: str
    half_width: float
    limit: int | None

    @property
    def unit(self) -> str:
        """Returns ``m`` or ``deg``."""
        return _UNITS[self.kind]

    @property
    def label(self) -> str:
        """Returns ``Delta 30 m``."""
        return f"Delta {self.half_width:g} {self.unit}"

    def prior(self) -> UniformPrior:
        """Returns the priors of this row."""
        if self.kind == TRANSLATION:
            return replace(_BASE, x_m=self.half_width, y_m=self.half_width, z_m=self.half_width)
        return replace(_BASE, yaw_deg=self.half_width)


def basin_steps(
    ranges_m: Sequence[float], yaw_ranges_deg: Sequence[float], limits: Sequence[int | None]
) -> tuple[BasinStep, ...]:
    """Returns the rows of both tables, cheapest first within each.

    Args:
        ranges_m: Half widths of the translation table.
        yaw_ranges_deg: Half widths of the orientation table.
        limits: Queries per split by translation range; one for all, or as many as ranges.

    Raises:
        ConfigError: A range is not a positive number within reason, or occurs twice; or the limits
            are not as many as the ranges.
    """
    require_within("ranges", ranges_m, 0, 1e4, "(]")
    require_within("yaw_ranges", yaw_ranges_deg, 0, 180, "(]")
    for kind, widths in ((TRANSLATION, ranges_m), (ORIENTATION, yaw_ranges_deg)):
        if len(set(widths)) < len(widths):
            raise ConfigError(f"A {kind} range occurs twice: {list(widths)}.")
    if not ranges_m and not yaw_ranges_deg:
        raise ConfigError("There is no range to run.", "Set `ranges='[30,50,100,200]'`.")
    if len(limits) not in (1, len(ranges_m)):
        raise ConfigError(f"{len(limits)} limits are not one per range: there are {len(ranges_m)} ranges.")
    each = list(limits) * len(ranges_m) if len(limits) == 1 else list(limits)
    far = [
        BasinStep(TRANSLATION, *pair) for pair in sorted(zip(ranges_m, each, strict=True), key=lambda p: p[0])
    ]
    fewest = min((n for n in limits if n is not None), default=None) if len(limits) == 1 else None
    return (*far, *(BasinStep(ORIENTATION, width, fewest) for width in sorted(yaw_ranges_deg)))


def protocol_lines(tilt: str, seed: int, is_told: bool) -> list[str]:
    """Returns the protocol in words, as it is printed with every basin.

    ``is_told`` is whether the method searches as far as priors are off, not as far as it is set.
    """
    tilts = {
        "truth": "the true pitch and roll (an oracle, as the paper's tables most likely have)",
        "prior": f"pitch and roll +-{_BASE.pitch_deg:g} deg",
    }
    search = (
        "2 x Delta wide on each axis, ends included, at the method's stride; no pose is dropped, "
        "not even one below a roof or the ground"
    )
    return [
        "priors: uniform around the truth, +-Delta in x, y and z, +-"
        f"{_BASE.yaw_deg:g} deg in yaw (translation table); +-Delta in yaw, "
        f"+-{_BASE.x_m:g}/{_BASE.y_m:g}/{_BASE.z_m:g} m in x/y/z (orientation table)",
        f"tilt={tilt}: {tilts.get(tilt, tilt)}",
        f"search: {search if is_told else 'as the method is set, whatever Delta: it takes no width'}",
        f"random numbers: one stream per query, seed {seed}; a wider prior errs the same way, only further",
    ]
