"""`lodbench locate`: pixels, or regions of a mask, of a localised photo on the map or the ground."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.cli.localize import NOT_TRUSTED
from lodbench.cli.options import MapOptions
from lodbench.cli.parser import Parser
from lodbench.errors import ConfigError, require_within
from lodbench.params import flag, parsed, part, word
from lodbench.reporting.aligned_text import format_columns, plain_text
from lodbench.storage.json_text import finite

if TYPE_CHECKING:
    from lodbench.harness.photo.placing import PlacedPhoto

# So much of what a region shows stands in its line; the rest in GeoJSON.
_SHOWN = 2

_ABOUT = """\
Give map coordinates of pixels of a localised photo, or of the white regions of a mask of it, with the 95 %
error ellipse and the surface that was hit.
"""

_EPILOG = """\
The photo's pose, its covariance and its camera are those that lodbench localize wrote to --found. A pixel's
ray meets a roof or a wall of the city model; where it meets none, the ground: a local plane through the bases
of the buildings around, the less certain the farther these are. Pixels count from the upper left corner of
the photo as it is stored (the middle of the first is 0.5 0.5). Where the drone's laser measured a range
(LRFTargetDistance in XMP), it is weighed in for pixels on the surface at the photo's centre.

Written: PHOTO_places.geojson in --found, or --out: points and polygons in WGS 84, with covariance (east,
north, up), ellipse (bearing from true north), height and building. "beside" names what else a pixel near an
edge may show.

Exit code: 3 if the photo's pose is more likely wrong than right; 2 for wrong options or data, a pixel outside
the photo or one that shows the sky; else 0.

examples:
  lodbench localize DJI_0001.JPG --city city.gml
  lodbench locate DJI_0001.JPG --city city.gml --pixel 2100 1480 --pixel 310.5 922
  lodbench locate flight/DJI_0007.JPG --found found --city city.gml --mask damage.png --out damage.geojson
"""


@dataclass(frozen=True, kw_only=True)
class LocateOptions:
    """What the command is given."""

    photo: Path = word("a photo that lodbench localize has placed", metavar="PHOTO")
    map: MapOptions = part(MapOptions)
    found: Path = flag(
        Path("localized"), "folder that lodbench localize wrote (default: localized)", metavar="DIR"
    )
    pixel: tuple[tuple[float, float], ...] = flag(
        (), "column and row, in the photo as stored; may be repeated", type=float, nargs=2, metavar=("U", "V")
    )
    mask: Path | None = flag(None, "mask of the photo: its white regions become polygons", metavar="FILE")
    pixel_sigma: float | None = flag(None, "how well pixels are pointed at (default: 1)", metavar="PX")
    map_sigma: float | None = flag(None, "how far surfaces of the map may be off (default: 0.5)", metavar="M")
    ground_sigma: float | None = flag(
        None, "how well the ground's height is known (default: by the bases)", metavar="M"
    )
    out: Path | None = flag(
        None, "GeoJSON to write (default: PHOTO_places.geojson in --found)", metavar="FILE"
    )
    json: bool = flag(False, "print JSON, for scripts")


OPTIONS = {"locate": LocateOptions}


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    options = parsed(Parser("lodbench locate", _ABOUT, _EPILOG), argv, LocateOptions)
    from lodbench.harness.photo.placing import PlacesRequest, place_photo

    if not options.pixel and options.mask is None:
        raise ConfigError("There is nothing to place.", "Give --pixel U V, or --mask FILE.")
    for name in ("pixel", "map", "ground"):
        require_within(f"--{name}-sigma", getattr(options, f"{name}_sigma"), 0)
    sigmas: dict[str, Any] = {"pixel_sigma_px": options.pixel_sigma, "map_sigma_m": options.map_sigma}
    sigmas = {name: value for name, value in sigmas.items() if value is not None}
    request = PlacesRequest(
        **options.map.settings(),
        photo=options.photo,
        found=options.found,
        pixels=options.pixel,
        mask=options.mask,
        out=options.out,
        ground_sigma_m=options.ground_sigma,
        **sigmas,
    )
    placed = place_photo(request)
    if options.json:
        text = json.dumps(finite(placed.to_json()), indent=2, ensure_ascii=False, allow_nan=False)
    else:
        text = describe(placed)
    sys.stdout.write(text + "\n")
    return 0 if placed.localized.is_trusted else NOT_TRUSTED


def describe(placed: PlacedPhoto) -> str:
    """Returns a line per pixel or region, and notes."""
    from lodbench.harness.photo.placing import earth_of, true_ellipse

    on_earth = placed.frame is not None
    has_regions = any(each.outline is not None for each in placed.features)
    head = ["", *(["latitude", "longitude"] if on_earth else []), "east", "north", "height m", "+-"]
    rows = [[*head, "95 % on the map m", "bearing deg", *(["m2"] if has_regions else []), "shows"]]
    lines = []
    for each in placed.features:
        point, ellipse = each.point, true_ellipse(each.point, placed.frame)
        earth = [f"{value:.7f}" for value in earth_of(point, placed.frame).values()]
        east, north, height = (f"{float(value):.2f}" for value in point.place)
        doubt = ["-", "-", "-"]
        if ellipse is not None and point.covariance is not None:
            doubt = [f"{point.covariance[2, 2] ** 0.5:.2f}", f"{ellipse.major_m:.2f} x {ellipse.minor_m:.2f}"]
            doubt.append(f"{ellipse.bearing_deg:.0f}")
        if has_regions:
            doubt.append("-" if each.outline is None else f"{each.outline.area:.1f}")
        more = f", {len(each.shows) - _SHOWN} more" if len(each.shows) > _SHOWN else ""
        shows = plain_text(", ".join(each.shows[:_SHOWN]) + more)
        rows.append([each.name, *earth, east, north, height, *doubt, shows])
        if point.beside and each.outline is None:
            lines.append(f"{each.name}: near an edge; it may show {plain_text(', '.join(point.beside))}")
        lines += [f"{each.name}: {note}" for note in point.notes]
    lines += ["the place of a region is that of its middle"] if has_regions else []
    lines += [f"note: {note}" for note in placed.notes]
    lines += [] if placed.map is None else [f"map: {placed.map}"]
    return "\n".join([format_columns(rows), *lines])
