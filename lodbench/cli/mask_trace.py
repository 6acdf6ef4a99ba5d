"""Drawn by hand, on a page of this machine: `lodbench mask`, a photo's mask; `lodbench trace`, a map."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.cli.options import HeightFlags
from lodbench.cli.parser import Parser
from lodbench.errors import ConfigError, DatasetError, require_within
from lodbench.params import flag, parsed, part, word
from lodbench.storage.paths import require_regular

if TYPE_CHECKING:
    from lodbench.harness.mask import MaskSession
    from lodbench.harness.tracing.outputs import Footprint
    from lodbench.harness.tracing.solve import Model, TracedMap


_FORMATS = ("labelme", "coco", "geojson")
_MASK_EPILOG = """\
The page is served to this machine alone. Strokes add to the mask or erase from it; similar
pixels nearby are included.

examples:
  lodbench mask DJI_0001.JPG                                   go on with DJI_0001_mask.png, or begin one
  lodbench mask DJI_0001.JPG --mask other.png --out new.png    start from another
  lodbench mask DJI_0001.JPG --no-page --export labelme        for LabelMe; then bring it back:
  lodbench mask DJI_0001.JPG --no-page --import DJI_0001_mask.labelme.json
  lodbench localize DJI_0001.JPG --city city.gml --mask DJI_0001_mask.png
"""
_TRACE_EPILOG = """\
On the page a roof is outlined in two photos, its corners in the same order. Its corners and its one height
are triangulated, then moved together until its edges lie on line segments in all photos that show it; the
ground is taken from the model's points around it. The result is a map of LoD1 prisms, in any format that
lodbench city convert writes.

Scale and level: a known length traced, or --scale; ground traced, or the plane of the model's points. Or all
of it, and the place: --start, or --crs with photos that state where they were taken, or --metric.

examples:
  lodbench trace sparse/0 --images photos                            trace, save traced.json, write the map
  lodbench trace sparse/0 --images photos --polygons traced.json --compare again.json
  lodbench trace sparse/0 --images photos --polygons traced.json --start rough.txt --benchmark town
"""


@dataclass(frozen=True, kw_only=True)
class MaskOptions:
    """What `lodbench mask` is given."""

    photo: Path = word("as it is stored", metavar="PHOTO")
    mask: Path | None = flag(None, "start from this mask: white is building", metavar="FILE", either="start")
    polygons: Path | None = flag(
        None, "start from polygons of LabelMe or COCO", "--import", metavar="FILE", either="start"
    )
    segmenter: str | None = flag(
        None,
        "from its mask (efficient_unet, where none is saved)",
        metavar="NAME",
        either="start",
        sets=("segmenter",),
    )
    segmenter_option: tuple[str, ...] = flag((), "may be repeated", metavar="KEY=VALUE")
    out: Path | None = flag(None, "where to save it (PHOTO_mask.png)", metavar="FILE")
    export: tuple[str, ...] = flag((), "polygons beside it; may be repeated", choices=_FORMATS)
    page: bool = flag(True, "save at once, without a page", "--no-page", action="store_false")
    port: int = flag(0, "of the page (any that is free)")


def main_mask(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    parser = Parser(
        "lodbench mask",
        "Correct the mask of a photo's buildings, or hand it to another program.",
        _MASK_EPILOG,
    )
    options = parsed(parser, argv, MaskOptions)
    from lodbench.cli.options import require_one_mask_source, segmenter_of
    from lodbench.harness.mask import Untouched, opened_session, require_untouched, require_unturned, saved
    from lodbench.photos.files import mask_name

    if options.photo.is_dir():
        raise ConfigError(f"{options.photo} is a folder.", "Name a photo: lodbench mask PHOTO")
    require_one_mask_source(options, "--mask", polygons="--import")
    require_within("--port", options.port, 0, 65535)
    out = options.out or options.photo.with_name(mask_name(options.photo.stem))
    _check_out(out, options.photo)
    formats = tuple(dict.fromkeys(options.export))
    untouched = Untouched(out, formats)  # before anything of them is read
    mask = _start(options, out)
    if options.out is None:
        require_untouched(out, options.photo, formats, options.polygons)
    segmenter = None
    if mask is None and options.polygons is None:
        from lodbench.segmentation.photo_segmenter import require_photo_segmenter
        from lodbench.segmentation.protocol import FOR_PHOTOS

        made = segmenter_of(options.segmenter or FOR_PHOTOS, options.segmenter_option)
        segmenter = require_photo_segmenter(made)
    require_unturned(options.photo, formats, options.polygons)
    session = opened_session(options.photo, mask, options.polygons, segmenter)
    if options.polygons is not None and options.out is None and out.exists() and not session.mask.any():
        raise ConfigError(
            f"{options.polygons.name} shows no building, and {out} would be replaced.", _keep_hint(out)
        )

    def save() -> tuple[Path, ...]:
        once_more = "Keep a copy of it if it is needed; saving once more replaces it."
        untouched.require(once_more if options.page else _keep_hint(out))
        try:
            return saved(session.mask, options.photo, out, formats)
        finally:
            untouched.remember()  # of a save that failed half way too: what is there is its own

    if options.page:
        _serve_mask(session, options, out, save)
    else:
        for path in save():
            sys.stdout.write(f"written: {path}\n")
    return 0


def _check_out(out: Path, photo: Path) -> None:
    """Makes sure that a mask can be saved under a name."""
    from lodbench.photos.files import mask_name

    if out.is_dir():
        inside = shlex.quote(str(out / mask_name(photo.stem)))
        raise ConfigError(f"--out {out} is a folder.", f"Name a file: --out {inside}")
    if out.suffix.lower() != ".png":
        png = shlex.quote(str(out.with_suffix(".png")))
        raise ConfigError(f"--out {out} is not a PNG file.", f"Masks are PNG: --out {png}")
    if out.exists() and photo.exists() and out.samefile(photo):
        raise ConfigError("--out is the photo itself.", "Leave it out, or name another file.")


def _start(options: MaskOptions, out: Path) -> Path | None:
    """Returns the mask to start from: what was named, else the one that was saved before."""
    named = options.mask
    # Polygons were written from that mask: what comes back is meant to replace it.
    if options.out is not None or options.polygons is not None or not out.exists():
        return named
    makes_new = options.segmenter is not None or bool(options.segmenter_option)
    if makes_new or (named is not None and named.exists() and not named.samefile(out)):
        raise ConfigError(f"{out} is there, and would be replaced.", _keep_hint(out))
    if named is None:
        sys.stdout.write(f"starts from: {out}, which is there\n")
    return out if named is None else named


def _keep_hint(out: Path) -> str:
    return f"Keep it, and save elsewhere: --out OTHER.png; replace it: --out {shlex.quote(str(out))}"


def _serve_mask(
    session: MaskSession, options: MaskOptions, out: Path, save: Callable[[], tuple[Path, ...]]
) -> None:
    """Serves the page until it is closed, or Ctrl+C, which keeps unsaved strokes beside the mask."""
    from lodbench.harness.local_page import MaskServer
    from lodbench.harness.mask import saved
    from lodbench.harness.tracebacks import last_write

    def saved_words() -> str:
        return "saved: " + ", ".join(path.name for path in save())

    try:
        server = MaskServer(session, options.photo.name, saved_words, options.port)
    except OSError as error:
        raise ConfigError(
            f"--port {options.port} cannot be listened at: {error.strerror}.",
            "Leave it out, or name another.",
        ) from error
    with server:
        sys.stdout.write(
            f"open: {server.address}\nCtrl+C, or Close on the page, ends it; Save keeps the mask.\n"
        )
        sys.stdout.flush()
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            if session.is_changed:
                # No picture by its name: a folder of photos would have one more.
                aside = out.with_name(f"{out.name}.unsaved")
                with last_write(aside):
                    saved(session.mask, options.photo, aside, ())
                    again = shlex.join(["--mask", str(aside), "--out", str(out)])
                    words = f"\nnot saved: strokes since the last Save. Go on with them: {again}\n"
                    sys.stdout.write(words)
            raise


@dataclass(frozen=True, kw_only=True)
class TraceOptions:
    """What the command is given."""

    model: Path = word("folder with cameras, images and points3D", metavar="COLMAP_MODEL")
    images: Path = flag(..., "the model's photos", metavar="DIR")
    polygons: Path | None = flag(None, "what was traced before; without a page", metavar="FILE")
    save: Path = flag(Path("traced.json"), "of the page (traced.json)", metavar="FILE")
    out: Path = flag(Path("map.city.json"), "the map (map.city.json)", metavar="FILE")
    compare: Path | None = flag(None, "another tracing, or a city model in the same frame", metavar="FILE")
    scale: float | None = flag(None, "metres per unit of the model", metavar="METRES")
    start: Path | None = flag(None, "rough poses in the map's frame, or similarity.json", metavar="FILE")
    crs: str | None = flag(
        None,
        "the map's reference system; without --start, photos' GPS places it",
        metavar="CODE",
        sets=("crs",),
    )
    metric: bool = flag(False, "the model is in the map's coordinates already")
    heights: HeightFlags = part(HeightFlags, "heights: from the drone's datum to the city's")
    benchmark: Path | None = flag(None, "write a dataset of photos not used for the map", metavar="DIR")
    queries: tuple[str, ...] = flag(
        (), "those (every second that is not traced)", metavar="PATTERN", nargs="+", action="store"
    )
    seed: int = flag(0, "of the benchmark's priors (default: 0)")
    port: int = flag(0, "of the page (any that is free)")
    json: bool = flag(False, "print JSON, for scripts")


OPTIONS = {"mask": MaskOptions, "trace": TraceOptions}


def main_trace(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    parser = Parser("lodbench trace", "Trace a map of roofs in the photos of a COLMAP model.", _TRACE_EPILOG)
    options = parsed(parser, argv, TraceOptions)
    from lodbench.citymodel.convert import check_target, convert_city
    from lodbench.datasets.own import require_new_folder
    from lodbench.harness.tracing.outputs import compared, map_of, read_tracing, to_json, write_benchmark
    from lodbench.harness.tracing.solve import Model

    _require_given(options)
    check_target(options.out)
    if options.benchmark is not None:
        require_new_folder(options.benchmark)
    model = Model(_request(options))
    others = None if options.compare is None else _others(options.compare, model)
    file = options.polygons or options.save
    if options.polygons is None:
        _serve_tracing(model, file, options.port)
    solved = model.solved(read_tracing(file, model.views))
    city = map_of(solved.buildings, solved.placed.crs)
    convert_city(city, options.out)
    rows = to_json(solved)
    result: dict[str, Any] = {"buildings": rows, "map": str(options.out), "notes": list(solved.placed.notes)}
    lines = [describe_map(solved), f"written: {options.out}"]
    if options.benchmark is not None:
        written = write_benchmark(solved, city, options.images, options.benchmark, options.seed)
        result["queries"] = list(written.names)
        lines.append(f"written: {written.folder}, {len(written.names)} photos not used for the map")
        lines += [f"left out: {name}: {reason}" for name, reason in written.left_out]
    if others is not None and options.compare is not None:
        result["compared"] = compared(solved.buildings, others)
        lines += _comparison(result["compared"], options.compare)
    sys.stdout.write((json.dumps(result, indent=2) if options.json else "\n".join(lines)) + "\n")
    return 0


def describe_map(solved: TracedMap) -> str:
    """Returns a line per building, and notes on where the model lies."""
    lines = []
    for building in solved.buildings:
        roof, (plan, up) = building.roof, building.moved
        lines.append(
            f"{roof.name}: roof {roof.height:.2f} +-{roof.height_sigma:.2f} m, ground "
            f"{building.ground:.2f} +-{building.ground_sigma:.2f} m, corners +-{roof.plan_sigma:.2f} m; "
            f"edges {roof.residual_px:.2f} px off, {100 * roof.matched_share:.0f} % found in "
            f"{roof.photos} photos; snapping moved it {plan:.2f} m in plan, {up:+.2f} m in height"
        )
    return "\n".join([*lines, *(f"note: {note}" for note in solved.placed.notes)])


def _comparison(rows: Sequence[dict[str, Any]], path: Path) -> list[str]:
    lines = [f"compared with {path}:"]
    for row in rows:
        if row["other"] is None:
            lines.append(f"{row['name']}: nothing there")
        else:
            lines.append(
                f"{row['name']}: {row['plan_m']:.2f} m apart in plan, roof {row['height_m']:+.2f} m, "
                f"area IoU {row['iou']:.3f} ({row['other']}); before snapping "
                f"{row['traced_plan_m']:.2f} m and {row['traced_height_m']:+.2f} m"
            )
    return lines


def _others(path: Path, model: Model) -> list[Footprint]:
    """Returns the buildings to compare with: those of another tracing, or of a city model."""
    from lodbench.harness.tracing.outputs import Footprint, footprints_of, is_tracing, read_tracing

    if not is_tracing(path):
        return footprints_of(path)
    solved = model.solved(read_tracing(path, model.views))
    return [Footprint(b.roof.name, b.footprint, b.roof.height) for b in solved.buildings]


def _request(options: TraceOptions) -> Any:
    from lodbench.harness.tracing.solve import TraceRequest

    return TraceRequest(
        model=options.model,
        images=options.images,
        start=options.start,
        crs=options.crs,
        scale=options.scale,
        is_metric=options.metric,
        heights=options.heights.options(),
        queries=None if options.benchmark is None else options.queries,
    )


def _require_given(options: TraceOptions) -> None:
    for folder in (options.model, options.images):
        if not folder.is_dir():
            raise DatasetError(f"{folder} is not a folder.", "Check the path.")
    for file in filter(None, (options.polygons, options.compare, options.start)):
        if not file.exists():
            raise DatasetError(f"{file} does not exist.", "Check the path.")
        require_regular(file)
    require_regular(options.save)
    require_within("--port", options.port, 0, 65535)
    if options.scale is not None and not 0 < options.scale < 1e9:
        raise ConfigError(f"--scale {options.scale:g} is no scale.", "Metres per unit of the model, above 0.")
    placed = [flag for flag in ("start", "scale", "metric") if getattr(options, flag)]
    if options.scale is not None and options.crs is not None:
        placed.append("crs")
    if len(placed) > 1:
        raise ConfigError(
            f"--{placed[0]} and --{placed[1]} both say where the model is.", "Leave one of them out."
        )
    if options.queries and options.benchmark is None:
        raise ConfigError("--queries is not used without --benchmark.", "Give --benchmark DIR.")
    if options.heights.given() and (options.crs is None or placed):
        raise ConfigError(
            f"{options.heights.given()[0]} is about the photos' own heights.", "Give --crs, and no --start."
        )


def _serve_tracing(model: Model, file: Path, port: int) -> None:
    """Serves the page until it is closed, or Ctrl+C."""
    from lodbench.harness.tracing.outputs import TraceServer, read_tracing

    if file.exists():
        read_tracing(file, model.views)
    try:
        server = TraceServer(model, file, describe_map, port)
    except OSError as error:
        hint = "Leave it out, or name another."
        raise ConfigError(f"--port {port} cannot be listened at: {error.strerror}.", hint) from error
    with server:
        sys.stdout.write(f"open: {server.address}\nClose on the page ends it; Save keeps {file}.\n")
        sys.stdout.flush()
        server.serve_forever()
    if not file.exists():
        raise ConfigError("Nothing was saved.", "Save on the page before Close.")
