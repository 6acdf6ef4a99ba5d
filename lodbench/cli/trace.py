"""`lodbench trace`: a map of roofs outlined in the photos of a COLMAP model, and a benchmark over it."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.cli.parser import Parser
from lodbench.cli.place_options import add_height_options, height_flags, height_options
from lodbench.errors import ConfigError, DatasetError, require_within
from lodbench.storage.paths import require_regular

if TYPE_CHECKING:
    from lodbench.harness.tracing.outputs import Footprint
    from lodbench.harness.tracing.solve import Model, TracedMap

_EPILOG = """\
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


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    options = _parser().parse_args(argv)
    from lodbench.citymodel.convert import check_target, convert_city
    from lodbench.datasets.own import require_new_folder
    from lodbench.harness.tracing.outputs import compared, map_of, to_json, write_benchmark
    from lodbench.harness.tracing.solve import Model
    from lodbench.harness.tracing.tracing import read_tracing

    _require_given(options)
    check_target(options.out)
    if options.benchmark is not None:
        require_new_folder(options.benchmark)
    model = Model(_request(options))
    others = None if options.compare is None else _others(options.compare, model)
    file = options.polygons or options.save
    if options.polygons is None:
        _serve(model, file, options.port)
    solved = model.solved(read_tracing(file, model.views))
    city = map_of(solved.buildings, solved.placed.crs)
    convert_city(city, options.out)
    rows = to_json(solved)
    result: dict[str, Any] = {"buildings": rows, "map": str(options.out), "notes": list(solved.placed.notes)}
    lines = [describe(solved), f"written: {options.out}"]
    if options.benchmark is not None:
        written = write_benchmark(solved, city, options.images, options.benchmark, options.seed)
        result["queries"] = list(written.names)
        lines.append(f"written: {written.folder}, {len(written.names)} photos not used for the map")
        lines += [f"left out: {name}: {reason}" for name, reason in written.left_out]
    if others is not None:
        result["compared"] = compared(solved.buildings, others)
        lines += _comparison(result["compared"], options.compare)
    sys.stdout.write((json.dumps(result, indent=2) if options.json else "\n".join(lines)) + "\n")
    return 0


def describe(solved: TracedMap) -> str:
    """Returns a line per building, and notes on where the model lies."""
    lines = []
    for building in solved.buildings:
        roof, (plan, up) = building.roof, building.moved
        lines.append(
            f"{roof.name}: roof {roof.height:.2f} +-{roof.height_sigma:.2f} m, ground "
            f"{building.ground:.2f} +-{building.ground_sigma:.2f} m, corners +-{roof.plan_sigma:.2f} m; "
            f"edges {roof.residual_px:.2f} px off, {100 * roof.found:.0f} % found in {roof.photos} photos; "
            f"snapping moved it {plan:.2f} m in plan, {up:+.2f} m in height"
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
    from lodbench.harness.tracing.outputs import Footprint, footprints_of
    from lodbench.harness.tracing.tracing import is_tracing, read_tracing

    if not is_tracing(path):
        return footprints_of(path)
    solved = model.solved(read_tracing(path, model.views))
    return [Footprint(b.roof.name, b.footprint, b.roof.height) for b in solved.buildings]


def _request(options: argparse.Namespace) -> Any:
    from lodbench.harness.tracing.tracing import TraceRequest

    return TraceRequest(
        model=options.model,
        images=options.images,
        start=options.start,
        crs=options.crs,
        scale=options.scale,
        is_metric=options.metric,
        heights=height_options(options),
        queries=None if options.benchmark is None else tuple(options.queries),
    )


def _require_given(options: argparse.Namespace) -> None:
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
    if height_flags(options) and (options.crs is None or placed):
        raise ConfigError(
            f"{height_flags(options)[0]} is about the photos' own heights.", "Give --crs, and no --start."
        )


def _serve(model: Model, file: Path, port: int) -> None:
    """Serves the page until it is closed, or Ctrl+C.

    Raises:
        ConfigError: The port cannot be listened at, or nothing was saved.
    """
    from lodbench.harness.tracing.outputs import TraceServer
    from lodbench.harness.tracing.tracing import read_tracing

    if file.exists():
        read_tracing(file, model.views)
    try:
        server = TraceServer(model, file, describe, port)
    except OSError as error:
        hint = "Leave it out, or name another."
        raise ConfigError(f"--port {port} cannot be listened at: {error.strerror}.", hint) from error
    with server:
        sys.stdout.write(f"open: {server.address}\nClose on the page ends it; Save keeps {file}.\n")
        sys.stdout.flush()
        server.serve_forever()
    if not file.exists():
        raise ConfigError("Nothing was saved.", "Save on the page before Close.")


def _parser() -> argparse.ArgumentParser:
    parser = Parser("lodbench trace", "Trace a map of roofs in the photos of a COLMAP model.", _EPILOG)
    add = parser.add_argument
    add("model", type=Path, metavar="COLMAP_MODEL", help="folder with cameras, images and points3D")
    add("--images", type=Path, required=True, metavar="DIR", help="the model's photos")
    add("--polygons", type=Path, metavar="FILE", help="what was traced before; without a page")
    add("--save", type=Path, default=Path("traced.json"), metavar="FILE", help="of the page (traced.json)")
    add("--out", type=Path, default=Path("map.city.json"), metavar="FILE", help="the map (map.city.json)")
    add("--compare", type=Path, metavar="FILE", help="another tracing, or a city model in the same frame")
    add("--scale", type=float, metavar="METRES", help="metres per unit of the model")
    add("--start", type=Path, metavar="FILE", help="rough poses in the map's frame, or similarity.json")
    add("--crs", metavar="CODE", help="the map's reference system; without --start, photos' GPS places it")
    add("--metric", action="store_true", help="the model is in the map's coordinates already")
    add_height_options(parser)
    add("--benchmark", type=Path, metavar="DIR", help="write a dataset of photos not used for the map")
    add("--queries", nargs="+", default=[], metavar="PATTERN", help="those (every second that is not traced)")
    add("--seed", type=int, default=0, help="of the benchmark's priors (default: 0)")
    add("--port", type=int, default=0, help="of the page (any that is free)")
    add("--json", action="store_true", help="print JSON, for scripts")
    return parser
