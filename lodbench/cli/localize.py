"""`lodbench localize`: photos in; where they were taken, overlays, a table and a map out."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lodbench.cli.parser import Parser
from lodbench.cli.place_options import add_city_options, add_height_options, given_camera, height_options
from lodbench.cli.segmenters import segmenter_of
from lodbench.cli.sources import load_profile
from lodbench.errors import ConfigError
from lodbench.reporting.answers import trust_word
from lodbench.reporting.columns import format_columns
from lodbench.reporting.safe_text import plain_text

if TYPE_CHECKING:
    from lodbench.harness.photo.localize import LocalizedPhoto
    from lodbench.harness.photo.many import PhotoAnswer

# Exit code where there is a pose, and it is more likely wrong than right.
NOT_TRUSTED = 3

_EXAMPLES = """\
The rough pose comes from the photo (EXIF and DJI's XMP); what is given here goes before it. Without a mask
or a segmenter the photo's own pixels are aligned with the map (--method region). Of several photos, or a
folder, localized.csv and localized.geojson have all. Exit code 3: there is a pose, and it is more likely
wrong than right; 1: of many photos none could be localised.

examples:
  lodbench localize DJI_0001.JPG --city LoD2_32_280_5657_1_NW.gml
  lodbench localize DJI_0001.JPG --city LoD2_32_280_5657_1_NW.gml --mask DJI_0001_mask.png
  lodbench localize DJI_0001.JPG --city city.gml --mask mask.png --takeoff 61.5
  lodbench localize flight1 flight2/*.JPG --city city.gml --out flight
  lodbench localize photo.jpg --city city.obj --mask mask.png --camera 'PINHOLE 400 300 290 290 200 150' \\
      --center 120 -40 95 --heading 30 --pitch -50
"""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    asked = _parser().parse_args(argv)
    from lodbench.harness.photo.many import localize_photos, photos_of
    from lodbench.methods.registry import make_method

    photos = photos_of(asked.photos, asked.masks)
    is_one = len(asked.photos) == 1 and asked.photos[0].is_file()
    _require_options(asked, is_one)
    is_masked = asked.mask is not None or asked.masks is not None or asked.segmenter is not None
    method = make_method(asked.method or ("contour_alignment" if is_masked else "region"))
    if is_masked and "mask" not in method.requires:
        flag = next(
            f"--{name}" for name in ("mask", "masks", "segmenter") if getattr(asked, name) is not None
        )
        hint = f"Leave {flag} out, or take --method contour_alignment."
        raise ConfigError(f"Method {method.name} looks at no mask.", hint)
    segmenter = None
    if asked.mask is None and asked.masks is None and "mask" in method.requires:
        segmenter = segmenter_of(asked.segmenter or "compact", asked.segmenter_option)
    from lodbench.datasets.photo_pose import RoughPlace
    from lodbench.harness.photo.localize import PhotoRequest, localize_photo

    profile = load_profile(asked.source, asked.option, asked.crs)
    request = PhotoRequest(
        photo=photos[0],
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
    if not is_one:
        return _tell_many(localize_photos(request, photos, asked.masks), asked)
    found = localize_photo(request)
    text = json.dumps(found.to_json(), indent=2, ensure_ascii=False) if asked.json else describe(found)
    sys.stdout.write(text + "\n")
    return 0 if found.is_trusted else NOT_TRUSTED


def _require_options(asked: argparse.Namespace, is_one: bool) -> None:
    """Refuses what would be meant for one photo and applied to many, and the other way round.

    Raises:
        ConfigError: There is such an option.
    """
    own = [f"--{name}" for name in ("mask", "lat", "lon", "center") if getattr(asked, name) is not None]
    if own and not is_one:
        hint = (
            "--masks DIR has a mask for each." if own[0] == "--mask" else "Give one photo, or leave it out."
        )
        raise ConfigError(f"{own[0]} is of one photo, and there are several.", hint)
    if asked.masks is not None and is_one:
        raise ConfigError("--masks is for several photos.", "Give --mask FILE.")
    if asked.masks is not None and not asked.masks.is_dir():
        raise ConfigError(f"--masks {asked.masks} is no folder.", "Name the folder of the photos' masks.")


def _tell_many(answers: Sequence[PhotoAnswer], asked: argparse.Namespace) -> int:
    """Prints what became of many photos; returns the exit code."""
    from lodbench.harness.photo.many import MAP_FILE, TABLE_FILE

    if asked.json:
        values = [
            {"photo": str(answer.photo), "failure": answer.failure}
            if answer.found is None
            else {**answer.found.to_json(), "photo": str(answer.photo)}
            for answer in answers
        ]
        sys.stdout.write(json.dumps(values, indent=2, ensure_ascii=False) + "\n")
    else:
        sys.stdout.write(describe_many(answers))
        sys.stdout.write(f"table:    {asked.out / TABLE_FILE}\nmap:      {asked.out / MAP_FILE}\n")
    if all(answer.found is None for answer in answers):
        return 1
    return (
        0 if all(answer.found is not None and answer.found.is_trusted for answer in answers) else NOT_TRUSTED
    )


def describe_many(answers: Sequence[PhotoAnswer]) -> str:
    """Returns a line per photo, what failed and why, and how many are to be trusted."""
    rows = [["", "latitude", "longitude", "height m", "heading deg", "pitch deg", "moved m", "sure", "trust"]]
    for answer in answers:
        row = answer.row()
        cells = [
            *((name, ".7f") for name in ("latitude_deg", "longitude_deg")),
            *((name, ".2f") for name in ("height_m", "heading_deg", "pitch_deg", "moved_m", "probability")),
        ]
        texts = ["-" if row[name] is None else format(row[name], spec) for name, spec in cells]
        rows.append([plain_text(str(answer.photo)), *texts, answer.trust])
    lines = [format_columns(rows), ""]
    lines += [
        f"failed: {plain_text(str(a.photo))}: {plain_text(a.failure)}" for a in answers if a.found is None
    ]
    shared = [set(answer.found.notes) for answer in answers if answer.found is not None]
    lines += [f"note: {note}" for note in sorted(set.intersection(*shared))] if shared else []
    good = sum(answer.found is not None and answer.found.is_trusted for answer in answers)
    failed = sum(answer.found is None for answer in answers)
    doubted = len(answers) - good - failed
    lines.append(f"{len(answers)} photos: {good} found, {doubted} not to be trusted, {failed} failed")
    if doubted:
        lines.append(
            "Look at the overlays of those not to be trusted; a mask of each (--masks DIR) helps most."
        )
    return "\n".join(lines) + "\n"


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
    parser = Parser(
        "lodbench localize",
        description="Find where a photo, or each of many, was taken.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "photos",
        type=Path,
        nargs="+",
        metavar="PHOTO|DIR",
        help="JPEG, PNG or TIFF, as the drone stored them",
    )
    parser.add_argument("--city", type=Path, required=True, metavar="FILE", help="city model")
    add_city_options(parser)
    parser.add_argument(
        "--roof-height", metavar="RULE", help="derive an absent LoD1: median, max, p70 or eave"
    )
    parser.add_argument("--mask", type=Path, metavar="FILE", help="the photo's buildings in white")
    parser.add_argument("--masks", type=Path, metavar="DIR", help="masks of many photos, named as these")
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
