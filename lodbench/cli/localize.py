"""`lodbench localize`: one photo in; where it was taken, an overlay and a map out."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lodbench.cli.place_options import add_city_options, add_height_options, given_camera, height_options
from lodbench.cli.segmenters import segmenter_of
from lodbench.cli.sources import load_profile
from lodbench.errors import ConfigError
from lodbench.reporting.answers import trust_word

if TYPE_CHECKING:
    from lodbench.harness.photo.localize import LocalizedPhoto

# Exit code where there is a pose, and it is more likely wrong than right.
NOT_TRUSTED = 3

_EXAMPLES = """\
The rough pose comes from the photo (EXIF and DJI's XMP); what is given here goes before it. Without a mask
or a segmenter the photo's own pixels are aligned with the map (--method region). Exit code 3: there is a
pose, and it is more likely wrong than right.

examples:
  lodbench localize DJI_0001.JPG --city LoD2_32_280_5657_1_NW.gml
  lodbench localize DJI_0001.JPG --city LoD2_32_280_5657_1_NW.gml --mask DJI_0001_mask.png
  lodbench localize DJI_0001.JPG --city city.gml --mask mask.png --takeoff 61.5
  lodbench localize photo.jpg --city city.obj --mask mask.png --camera 'PINHOLE 400 300 290 290 200 150' \\
      --center 120 -40 95 --heading 30 --pitch -50
"""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    asked = _parser().parse_args(argv)
    from lodbench.methods.registry import make_method

    is_masked = asked.mask is not None or asked.segmenter is not None
    method = make_method(asked.method or ("contour_alignment" if is_masked else "region"))
    if is_masked and "mask" not in method.requires:
        flag = "--segmenter" if asked.mask is None else "--mask"
        hint = f"Leave {flag} out, or take --method contour_alignment."
        raise ConfigError(f"Method {method.name} looks at no mask.", hint)
    segmenter = None
    if asked.mask is None and "mask" in method.requires:
        segmenter = segmenter_of(asked.segmenter or "compact", asked.segmenter_option)
    from lodbench.datasets.photo_pose import RoughPlace
    from lodbench.harness.photo.localize import PhotoRequest, localize_photo

    profile = load_profile(asked.source, asked.option, asked.crs)
    found = localize_photo(
        PhotoRequest(
            photo=asked.photo,
            city=asked.city,
            out=asked.out,
            mask=asked.mask,
            segmenter=segmenter,
            camera=given_camera(asked.camera),
            given=RoughPlace(asked.lat, asked.lon, asked.height, asked.heading, asked.pitch, asked.roll),
            center=None if asked.center is None else tuple(asked.center),
            heights=height_options(asked),
            lod=asked.lod or profile.lod,
            options=profile.options,
            roof_height=asked.roof_height,
            method=method,
            seed=asked.seed,
        )
    )
    text = json.dumps(found.to_json(), indent=2, ensure_ascii=False) if asked.json else describe(found)
    sys.stdout.write(text + "\n")
    return 0 if found.is_trusted else NOT_TRUSTED


def describe(found: LocalizedPhoto) -> str:
    """Returns what a reader is told."""
    x, y, z = (float(v) for v in found.pose.center)
    pitch, roll, yaw = found.pose.euler
    rows = [
        ("local", f"{x:.2f} {y:.2f} {z:.2f} m in {found.crs or 'the frame of the city model'}"),
        ("", f"pitch {pitch:.2f}  roll {roll:.2f}  yaw {yaw:.2f} deg (0 looks down; yaw from grid north)"),
        ("prior", f"{found.moved.translation_m:.2f} m and {found.moved.rotation_deg:.2f} deg away"),
        ("score", f"{found.score:.3f}  (LoD {found.lod or 'unnamed'}; camera: {found.camera_source})"),
        *_trust_rows(found),
        ("overlay", str(found.overlay)),
    ]
    if found.geojson is not None:
        rows.append(("map", str(found.geojson)))
    place = found.place
    if place is not None:
        rows = [
            ("latitude", f"{place.latitude_deg:.7f}"),
            ("longitude", f"{place.longitude_deg:.7f}"),
            ("height", f"{place.height_m:.2f} m, in the city's heights"),
            ("heading", f"{place.heading_deg:.2f} deg from true north, pitch {place.pitch_deg:.2f}"),
            *rows,
        ]
    lines = [found.photo, *(f"  {name:<9}  {text}" for name, text in rows)]
    return "\n".join([*lines, *(f"  note: {note}" for note in found.notes)])


def _trust_rows(found: LocalizedPhoto) -> list[tuple[str, str]]:
    """Returns how sure the method is, and the next best pose."""
    rows = []
    if found.probability is None:
        rows.append(("sure", "this method does not say"))
    else:
        percent = f"{100 * found.probability:.0f} % within 2 m and 2 deg"
        rows.append(("sure", f"{percent}: {trust_word(found.probability)}"))
    if found.sigmas is not None:
        x, y, z, pitch, roll, yaw = found.sigmas
        rows.append(
            ("sigmas", f"{x:.2f} {y:.2f} {z:.2f} m; pitch {pitch:.2f}  roll {roll:.2f}  yaw {yaw:.2f} deg")
        )
    if found.alternatives:
        away = found.alternatives[0].center - found.pose.center
        x, y, z = (float(v) for v in away)
        rows.append(("or", f"{x:+.1f} {y:+.1f} {z:+.1f} m from there, which fits less well"))
    return rows


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "lodbench localize",
        description="Find where a photo was taken.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("photo", type=Path, metavar="PHOTO", help="JPEG, PNG or TIFF, as the drone stored it")
    parser.add_argument("--city", type=Path, required=True, metavar="FILE", help="city model")
    add_city_options(parser)
    parser.add_argument(
        "--roof-height", metavar="RULE", help="derive an absent LoD1: median, max, p70 or eave"
    )
    parser.add_argument("--mask", type=Path, metavar="FILE", help="the photo's buildings in white")
    parser.add_argument(
        "--segmenter", metavar="NAME", help="makes the mask, for methods that want one (compact)"
    )
    parser.add_argument(
        "--segmenter-option", action="append", default=[], metavar="KEY=VALUE", help="may be repeated"
    )
    place = parser.add_argument_group("rough pose, before what the photo says")
    place.add_argument("--lat", type=float, metavar="DEG", help="latitude, WGS 84")
    place.add_argument("--lon", type=float, metavar="DEG", help="longitude, WGS 84")
    place.add_argument("--height", type=float, metavar="M", help="in the city's heights")
    place.add_argument("--heading", type=float, metavar="DEG", help="clockwise from true north")
    place.add_argument("--pitch", type=float, metavar="DEG", help="0 at the horizon, -90 straight down")
    place.add_argument("--roll", type=float, metavar="DEG", help="about the optical axis")
    place.add_argument(
        "--center", type=float, nargs=3, metavar=("E", "N", "UP"), help="in the city's own coordinates"
    )
    add_height_options(parser)
    parser.add_argument("--camera", metavar="'MODEL W H ...'", help="COLMAP's camera model and parameters")
    parser.add_argument(
        "--method", metavar="NAME", help="region; with --mask or --segmenter contour_alignment"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("localized"), metavar="DIR", help="(localized)")
    parser.add_argument("--json", action="store_true", help="for machines")
    return parser
