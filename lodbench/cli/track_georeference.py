"""Photos that belong together: `lodbench track`, frame by frame; `lodbench georeference`, a COLMAP model."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.cli.localize import NOT_TRUSTED
from lodbench.cli.options import (
    HeightFlags,
    MapOptions,
    PlaceOptions,
    city_settings,
    require_frames_looked_at,
    require_one_mask_source,
    segmenter_of,
)
from lodbench.cli.parser import Parser
from lodbench.errors import ConfigError, DatasetError, require_within
from lodbench.params import flag, parsed, part, word
from lodbench.reporting.aligned_text import plain_text
from lodbench.segmentation.protocol import FOR_PHOTOS

if TYPE_CHECKING:
    from lodbench.harness.georeference import Georeferenced
    from lodbench.harness.track import Track


_TRACK_EPILOG = """\
The first frame is found from a rough pose, as by localize: what the first photo, or DJI's .SRT beside a
video, states, or the options below.
Each next frame starts from where the last motion leads. Where nothing near fits, the camera is lost, and
searched for from there, wider with each frame.

Written to --out: track.csv (a row per frame), track.geojson, poses.txt (name qw qx qy qz tx ty tz, world to
camera); refused where it holds a track of other frames. Masks are named as the photos; those of a video
frame_000000.png, frame_000001.png and so on. Exit code 3: the camera was lost in some frames; 1: in all.

examples:
  lodbench track FLIGHT --city city.gml --masks MASKS
  lodbench track flight.mp4 --city city.gml --camera 'PINHOLE 640 480 460 460 320 240' \\
      --center 281030 5657480 150 --heading 280 --pitch -50 --every 3
"""


@dataclass(frozen=True, kw_only=True)
class TrackOptions:
    """What the command is given."""

    footage: Path = word("what OpenCV reads, or photos in turn", metavar="VIDEO|DIR")
    map: MapOptions = part(MapOptions)
    masks: Path | None = flag(None, "masks of the frames, named as these", metavar="DIR")
    segmenter: str | None = flag(
        None, f"makes masks instead ({FOR_PHOTOS})", metavar="NAME", sets=("segmenter",)
    )
    segmenter_option: tuple[str, ...] = flag((), "may be repeated", metavar="KEY=VALUE")
    every: int = flag(1, "take every Nth frame (1)", metavar="N")
    fps: float | None = flag(None, "frames per second, before what they say", metavar="RATE")
    place: PlaceOptions = part(PlaceOptions, "rough pose of the first frame, before what it says")
    heights: HeightFlags = part(HeightFlags, "heights: from the drone's datum to the city's")
    out: Path = flag(Path("tracked"), "(tracked)", metavar="DIR")
    json: bool = flag(False, "print JSON, for scripts")


def main_track(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    parser = Parser(
        "lodbench track", "Find where each frame of a video, or of photos in turn, was taken.", _TRACK_EPILOG
    )
    options = parsed(parser, argv, TrackOptions)
    from lodbench.datasets.own import require_some_mask
    from lodbench.harness.track import TrackRequest, track
    from lodbench.harness.track_frames import Footage

    if not options.footage.exists():
        raise DatasetError(f"{options.footage} does not exist.", "Check the path.")
    if options.masks is not None and not options.masks.is_dir():
        raise DatasetError(f"{options.masks} is not a folder.", "Name the folder of the frames' masks.")
    require_one_mask_source(options, "--masks")
    require_within("--every", options.every, 1)
    require_within("--fps", options.fps, 0, ends="(]")
    segmenter, footage = (
        None,
        Footage(options.footage, options.every, options.fps, options.masks, options.out),
    )
    if options.masks is not None and options.footage.is_dir():
        photos = footage.photos()
        require_some_mask(options.masks, [photo.name for photo in photos], photos)
    if options.masks is None:
        name = options.segmenter or FOR_PHOTOS
        segmenter = segmenter_of(name, options.segmenter_option)
        require_frames_looked_at(segmenter, name)
    city = city_settings(options.map, options.heights, options.out)
    own: dict[str, Any] = {"footage": footage, "masks": options.masks, "segmenter": segmenter}
    done = track(TrackRequest(**city, **options.place.settings(options.heights), **own))
    sys.stdout.write(_as_json(done) if options.json else describe_track(done))
    if all(frame.pose is None for frame in done.frames):
        return 1
    return 3 if done.lost() else 0


def describe_track(done: Track) -> str:
    """Returns the report."""
    count = len(done.frames)
    tracked = sum(frame.pose is not None for frame in done.frames)
    lines = [f"{count} frames: {tracked} tracked, {count - tracked} lost"]
    for first, last in done.lost():
        reason = f": {plain_text(first.reason)}" if first.reason else ": nothing near fits its mask"
        lines.append(f"lost from {plain_text(first.name)} to {plain_text(last.name)}{reason}")
    if not tracked and not done.frames[0].reason:
        lines.append(
            "the first frame is not found from its rough pose: are city, place, height (--takeoff, "
            "--heights), --heading and --pitch right?"
        )
    each = 1000.0 / max(count - 1, 1)
    seconds = done.seconds
    lines += [
        f"{done.rate:.1f} photos per second from pixels to pose: masks {each * seconds['masks']:.0f} ms "
        f"beside poses {each * seconds['poses']:.0f} ms, {each * done.cpu_s:.0f} ms of processors' time each",
        *(f"note: {plain_text(note)}" for note in done.notes),
        *(() if done.out is None else (f"written: {done.out}",)),
    ]
    return "\n".join(lines) + "\n"


def _as_json(done: Track) -> str:
    frames = [
        {
            "name": frame.name,
            "time_s": frame.time_s,
            "state": frame.state,
            "score": frame.score,
            "reason": frame.reason,
            "center_m": None if frame.pose is None else frame.pose.center.tolist(),
            "quat_wxyz": None if frame.pose is None else list(frame.pose.quat_wxyz),
            "sigma_m": None if frame.sigmas is None else frame.sigmas[0],
            "sigma_deg": None if frame.sigmas is None else frame.sigmas[1],
            "probability": frame.probability,
        }
        for frame in done.frames
    ]
    values = {"frames": frames, "rate": done.rate, "seconds": done.seconds, "cpu_s": done.cpu_s}
    return json.dumps({**values, "notes": list(done.notes)}, indent=2, ensure_ascii=False) + "\n"


_GEOREFERENCE_EPILOG = """\
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
    method: str = flag("flight", "solves flights (flight)", metavar="NAME", sets=("method.inner",))
    sidecars: bool = flag(False, "write PHOTO.xmp beside each of --images, if trusted")
    seed: int = flag(0, "random seed (default: 0)")
    out: Path = flag(Path("georeferenced"), "(georeferenced)", metavar="DIR")
    json: bool = flag(False, "print JSON, for scripts")


OPTIONS = {"track": TrackOptions, "georeference": GeoreferenceOptions}


def main_georeference(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    parser = Parser(
        "lodbench georeference",
        "Place a COLMAP model in a city by the outlines of its buildings.",
        _GEOREFERENCE_EPILOG,
    )
    given = parsed(parser, argv, GeoreferenceOptions)
    from lodbench.datasets.own import find_photo, shared_files
    from lodbench.harness.city import open_city
    from lodbench.harness.georeference import GeoreferenceRequest, georeference
    from lodbench.harness.photo.outputs import require_sidecars, write_sidecars
    from lodbench.methods.georeference import Georeference, GeoreferenceParams

    _require_given(given)
    method = Georeference(GeoreferenceParams(inner=given.method))
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
    text = (
        json.dumps(placed.to_json(), indent=2, ensure_ascii=False) if given.json else describe_model(placed)
    )
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


def describe_model(placed: Georeferenced) -> str:
    """Returns the report."""
    import numpy as np

    east, north, up = placed.placement["middle"]
    *sigmas, share = placed.placement["sigmas"].values()
    away = float(np.median(list(placed.used.values())))
    rows = [
        ("cameras", f"{len(placed.cameras)}, placed by the masks of {len(placed.used)}"),
        ("start", placed.start),
        ("scale", f"{placed.placement['similarity']['scale']:.6g} m per unit, +-{100 * share:.2f} %"),
        ("middle", f"{east:.2f} {north:.2f} {up:.2f} m in {placed.crs or 'the frame of the city model'}"),
        ("sigmas", f"{_three(sigmas[:3])} m; {_three(sigmas[3:])} deg about east, north and up"),
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
