"""The look of one picture: sun, air, season, surfaces and camera, drawn from seeded ranges."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError, nearest_names
from lodbench.kernels.looks import CameraResponse, Look, Triple
from lodbench.params import read_settings, to_params

Range = tuple[float, float]


def _drawn(low: float, high: float, within: Range = (0.0, 1.5)) -> Any:
    """Returns a field: a range, and the bounds of any other; without them shares, and a little more."""
    return field(default=(low, high), metadata={"within": within})


@dataclass(frozen=True, slots=True)
class LookRanges:
    """From what the look of a picture is drawn: each value uniform between two bounds, ends included.

    ``conf/training/varied.yaml`` says what each is.

    Raises:
        ConfigError: A range is not ascending, or out of bounds.
    """

    sun_elevation_deg: tuple[float, float] = _drawn(20.0, 68.0, (5.0, 90.0))
    sun_azimuth_deg: tuple[float, float] = _drawn(-180.0, 180.0, (-360.0, 360.0))
    sun_share: tuple[float, float] = _drawn(0.25, 0.85)
    sun_warmth: tuple[float, float] = _drawn(-0.1, 0.5, (-1.0, 1.0))
    haze_range_m: tuple[float, float] = _drawn(1200.0, 9000.0, (200.0, 1e6))
    sky_white: tuple[float, float] = _drawn(0.1, 0.9)
    dryness: tuple[float, float] = _drawn(0.0, 0.8)
    texture: tuple[float, float] = _drawn(0.6, 1.3)
    tint_jitter: tuple[float, float] = _drawn(0.02, 0.14)
    dirt: tuple[float, float] = _drawn(0.1, 0.9)
    windows: tuple[float, float] = _drawn(0.7, 1.0)
    window_light: tuple[float, float] = _drawn(0.0, 0.5)
    storey_m: tuple[float, float] = _drawn(2.7, 3.6, (2.0, 6.0))
    window_spacing_m: tuple[float, float] = _drawn(2.0, 3.8, (1.2, 10.0))
    skylights: tuple[float, float] = _drawn(0.0, 0.14)
    roof_units: tuple[float, float] = _drawn(0.0, 0.3)
    exposure: tuple[float, float] = _drawn(0.75, 1.3, (0.2, 4.0))
    contrast: tuple[float, float] = _drawn(0.9, 1.25, (0.3, 3.0))
    saturation: tuple[float, float] = _drawn(0.6, 1.2, (0.0, 3.0))
    white_balance: tuple[float, float] = _drawn(-0.08, 0.08, (-0.5, 0.5))
    vignette: tuple[float, float] = _drawn(0.0, 0.25)
    blur_px: tuple[float, float] = _drawn(0.0, 0.9, (0.0, 10.0))
    noise: tuple[float, float] = _drawn(0.002, 0.025, (0.0, 0.2))
    jpeg_quality: tuple[float, float] = _drawn(78.0, 97.0, (5.0, 100.0))
    repaint: tuple[float, float] = _drawn(0.0, 0.0)

    def __post_init__(self) -> None:
        for each in fields(self):
            (low, high), (least, most) = getattr(self, each.name), each.metadata["within"]
            if not least <= low <= high <= most:
                raise ConfigError(
                    f"look.{each.name} is [{low:g}, {high:g}], not an ascending range within "
                    f"{least:g} to {most:g}."
                )


@cache
def look_ranges(name: str) -> LookRanges:
    """Returns the ranges of a look that ``conf/training`` names: ``plain``, ``varied``, ``hard``.

    Raises:
        ConfigError: There is no such look.
    """
    known = {
        entry.name.removesuffix(".yaml"): entry for entry in (files("lodbench.conf") / "training").iterdir()
    }
    if name not in known:
        raise ConfigError(f"There is no look {name}.", nearest_names(name, sorted(known)))
    return to_params(read_settings(known[name].read_text(encoding="utf-8")), LookRanges, "look")


def draw_look(ranges: LookRanges, generator: np.random.Generator) -> tuple[Look, CameraResponse]:
    """Returns a look drawn from ranges; always as many draws, so that one range changes nothing else."""
    names = [each.name for each in fields(ranges) if each.name != "repaint"]
    drawn = {name: float(generator.uniform(*getattr(ranges, name))) for name in names}
    seeds = generator.integers(1 << 30, size=2)
    # Drawn last, as it came last: looks without it stay what they were.
    drawn["repaint"] = float(generator.uniform(*ranges.repaint))
    elevation, azimuth = math.radians(drawn["sun_elevation_deg"]), math.radians(drawn["sun_azimuth_deg"])
    level = math.cos(elevation)
    sun = np.array([level * math.sin(azimuth), level * math.cos(azimuth), math.sin(elevation)])
    # A low sun is weaker and redder; together with the sky it lights level ground about alike.
    warmth = drawn["sun_warmth"] + 0.5 * max(0.0, 0.45 - math.sin(elevation))
    sun_colour = np.array([1.0 + 0.22 * warmth, 1.0, 1.0 - 0.38 * warmth])
    share, white = drawn["sun_share"], drawn["sky_white"]
    sun_rgb = sun_colour * share * 1.15 / max(0.45, math.sin(elevation))
    brightness = 0.55 + 0.35 * share
    light = Look(
        sun=_triple(sun),
        sun_rgb=_triple(sun_rgb),
        sky_rgb=_sky((1.0, 1.0, 1.0), (0.75, 0.95, 1.3), white, 1.05 - share),
        haze_rgb=_sky((0.92, 0.94, 0.96), (0.66, 0.78, 0.94), white, brightness),
        zenith_rgb=_sky((0.8, 0.84, 0.9), (0.16, 0.33, 0.72), white, brightness),
        haze_per_m=1.0 / drawn["haze_range_m"],
        seed=int(seeds[0]),
        **{name: drawn[name] for name in Look._fields[6:-1]},
    )
    camera = {name: drawn[name] for name in CameraResponse._fields[:-2]}
    quality = round(drawn["jpeg_quality"])
    return light, CameraResponse(**camera, jpeg_quality=quality, seed=int(seeds[1]))


def _sky(overcast: Triple, clear: Triple, white: float, brightness: float) -> Triple:
    """Returns a colour between that of an overcast and of a clear sky."""
    return _triple(brightness * (white * np.array(overcast) + (1.0 - white) * np.array(clear)))


def _triple(values: NDArray[np.float64]) -> Triple:
    # Not an array: the kernel would count references to it at every pixel.
    red, green, blue = values.tolist()
    return red, green, blue
