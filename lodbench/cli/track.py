"""`lodbench track`: a video or a folder of photos over a city, frame by frame."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.cli.parser import Parser
from lodbench.cli.parts import require_frames_looked_at, require_one_mask_source, segmenter_of
from lodbench.cli.place_options import HeightFlags, MapOptions, PlaceOptions, city_settings
from lodbench.errors import DatasetError, require_within
from lodbench.params import flag, parsed, part, word
from lodbench.reporting.aligned_text import plain_text
from lodbench.segmentation.registry import FOR_PHOTOS

if TYPE_CHECKING:
    from lodbench.harness.track import Track

_EPILOG = """\
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


OPTIONS = {"": TrackOptions}


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    parser = Parser(
        "lodbench track", "Find where each frame of a video, or of photos in turn, was taken.", _EPILOG
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
    sys.stdout.write(_as_json(done) if options.json else describe(done))
    if all(frame.pose is None for frame in done.frames):
        return 1
    return 3 if done.lost() else 0


def describe(done: Track) -> str:
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
