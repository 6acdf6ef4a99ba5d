"""`lodbench georeference`: a COLMAP model into a city's coordinates, without ground control points."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lodbench.cli.localize import NOT_TRUSTED
from lodbench.cli.parser import Parser
from lodbench.cli.parts import require_one_mask_source, segmenter_of
from lodbench.cli.place_options import HeightFlags, MapOptions, city_settings
from lodbench.errors import ConfigError, DatasetError
from lodbench.params import flag, parsed, part, word
from lodbench.reporting.aligned_text import plain_text
from lodbench.segmentation.registry import FOR_PHOTOS

if TYPE_CHECKING:
    from lodbench.harness.georeference import Georeferenced

_EPILOG = """\
The model is a similarity away from the city. It starts where the photos say they were taken (--images, EXIF
and XMP), or where --start says: rough poses in the city's coordinates in any known format, or
similarity.json of an earlier run. From there the outlines of buildings in all masks place it (--method
flight).

Written to --out: colmap/ (the model, its points and tracks, moved), metashape_reference.txt,
calibrated_external_camera_parameters.txt (Pix4D), geo.txt (ODM), cameras.geojson with heights and footprints,
map_findings.geojson (buildings whose height the photos contradict), similarity.json;
refused where it holds those of another model. Exit code 3: it is more likely wrong than right.

examples:
  lodbench georeference sparse/0 --city city.gml --images PHOTOS --masks MASKS
  lodbench georeference sparse/0 --city city.gml --start rough.txt --masks MASKS --out placed
"""


@dataclass(frozen=True, kw_only=True)
class GeoreferenceOptions:
    """What the command is given."""

    model: Path = word("folder with cameras and images", metavar="COLMAP_MODEL")
    map: MapOptions = part(MapOptions)
    images: Path | None = flag(None, "the model's photos, as the drone stored them", metavar="DIR")
    masks: Path | None = flag(None, "masks of the photos, named as these", metavar="DIR")
    segmenter: str | None = flag(
        None, f"makes masks instead ({FOR_PHOTOS})", metavar="NAME", sets=("segmenter",)
    )
    start: Path | None = flag(None, "rough poses, or similarity.json", metavar="FILE")
    heights: HeightFlags = part(HeightFlags, "heights: from the drone's datum to the city's")
    method: str = flag("flight", "solves flights (flight)", metavar="NAME", sets=("method",))
    sidecars: bool = flag(False, "write PHOTO.xmp beside each of --images, if trusted")
    seed: int = flag(0, "random seed (default: 0)")
    out: Path = flag(Path("georeferenced"), "(georeferenced)", metavar="DIR")
    json: bool = flag(False, "print JSON, for scripts")


OPTIONS = {"": GeoreferenceOptions}


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    parser = Parser(
        "lodbench georeference", "Place a COLMAP model in a city by the outlines of its buildings.", _EPILOG
    )
    given = parsed(parser, argv, GeoreferenceOptions)
    from lodbench.datasets.own import find_photo, shared_files
    from lodbench.harness.city import open_city
    from lodbench.harness.georeference import GeoreferenceRequest, georeference
    from lodbench.harness.photo.outputs import require_sidecars, write_sidecars
    from lodbench.methods.protocol import SupportsFlights
    from lodbench.methods.registry import make_method

    _require_given(given)
    method = make_method(given.method)
    if not isinstance(method, SupportsFlights):
        raise ConfigError(f"--method {given.method} solves no flights.", "Leave --method out.")
    request = GeoreferenceRequest(
        **city_settings(given.map, given.heights, given.out),
        model=given.model,
        method=method,
        images=given.images,
        masks=given.masks,
        segmenter=None if given.masks is not None else segmenter_of(given.segmenter or FOR_PHOTOS),
        start=given.start,
        seed=given.seed,
    )
    photos = given.images if given.sidecars else None
    if photos is not None:
        city = open_city(request.city, request.lod, request.options, request.roof_height)
        require_sidecars(city.scene.crs, [photos])
    placed = georeference(request)
    text = json.dumps(placed.to_json(), indent=2, ensure_ascii=False) if given.json else describe(placed)
    sys.stdout.write(text + "\n")
    if photos is not None:
        files = [(find_photo(photos, camera.name), camera.pose) for camera in placed.cameras]
        shared = shared_files(file for file, _ in files)
        own = [(file, pose) for file, pose in files if file is not None and file not in shared]
        line = write_sidecars(own if placed.is_trusted else [], placed.crs)
        sys.stderr.write(f"lodbench: sidecars: {line}\n")
    return 0 if placed.is_trusted else NOT_TRUSTED


def _require_given(given: GeoreferenceOptions) -> None:
    for name in ("model", "images", "masks"):
        folder = getattr(given, name)
        if folder is not None and not folder.is_dir():
            hint = "Name the folder that holds it." if folder.is_file() else "Check the path."
            raise DatasetError(f"{folder} is not a folder.", hint)
    if given.start is not None and not given.start.exists():
        raise DatasetError(f"{given.start} does not exist.", "Check the path.")
    if given.masks is None and given.images is None:
        raise ConfigError("There is nothing to place the model by.", "Give --masks DIR, or --images DIR.")
    unused = given.heights.given()
    if given.start is not None and unused:
        hint = f"--start has the heights: leave {unused[0]} or --start out."
        raise ConfigError(f"{unused[0]} is not used with --start.", hint)
    require_one_mask_source(given, "--masks")
    if given.sidecars and given.images is None:
        raise ConfigError("--sidecars are written beside photos.", "Name their folder with --images.")


def describe(placed: Georeferenced) -> str:
    """Returns the report."""
    import numpy as np

    fitted = placed.fitted
    east, north, up = (float(v) for v in fitted.middle)
    shift, turn, share = fitted.sigmas[:3], fitted.sigmas[3:6], float(fitted.sigmas[6])
    away = float(np.median(list(placed.used.values())))
    rows = [
        ("cameras", f"{len(placed.cameras)}, placed by the masks of {len(placed.used)}"),
        ("start", placed.start),
        ("scale", f"{fitted.similarity.scale:.6g} m per unit, +-{100 * share:.2f} %"),
        ("middle", f"{east:.2f} {north:.2f} {up:.2f} m in {placed.crs or 'the frame of the city model'}"),
        ("sigmas", f"{_three(shift)} m; {_three(turn)} deg about east, north and up"),
        ("photos", f"{away:.2f} m in the median from where the model has them{_doubted(placed)}"),
        *((name, str(path)) for name, path in placed.files.items()),
    ]
    lines = [f"{name:<13} {plain_text(text)}" for name, text in rows]
    lines += [f"left out: {plain_text(name)}: {plain_text(reason)}" for name, reason in placed.left_out]
    lines += [f"note: {plain_text(note)}" for note in placed.notes]
    if not placed.is_trusted:
        lines.append(
            "unreliable: most photos' outlines fit the map poorly in this place. What helps: masks "
            "that show the buildings (lodbench mask PHOTO), a better --start, the right city"
        )
    return "\n".join(lines)


def _doubted(placed: Georeferenced) -> str:
    count = len(placed.untrusted)
    return f"; {count} of {len(placed.used)} are unreliable" if count else ""


def _three(numbers: Iterable[float]) -> str:
    return " ".join(f"{number:.2f}" for number in numbers)
