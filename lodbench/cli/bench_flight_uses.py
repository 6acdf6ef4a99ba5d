"""`lodbench bench georeference` and `lodbench bench tracking`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from lodbench.bench.figures import Report
from lodbench.bench.options import add_options, options_of
from lodbench.bench.reconstructions import Noise, measure_reconstructions
from lodbench.bench.tracking import TrackingOptions, measure_tracking
from lodbench.cli.bench_views import city_file, seeds
from lodbench.cli.segmenters import require_frames_looked_at, segmenter_of
from lodbench.errors import require_within
from lodbench.execution import ProgressCallback
from lodbench.geometry.similarity import FEWEST_POSES
from lodbench.synthesis.camera_paths import FLIGHT_PATHS
from lodbench.synthesis.flights.dataset import FlightsParams


def add_uses(actions: Any) -> None:
    """Adds both."""
    placed = actions.add_parser("georeference", help="reconstructions of seeded flights, placed by masks")
    placed.add_argument("--photos", type=int, default=16, help="of each flight (16)")
    placed.add_argument("--mask-iou", type=float, default=0.88, help="of the degraded masks (0.88)")
    placed.add_argument("--noise-m", type=float, default=0.1, help="of a reconstruction's places (0.1)")
    placed.add_argument("--noise-deg", type=float, default=0.05, help="of its directions (0.05)")
    placed.add_argument("--path", choices=tuple(FLIGHT_PATHS), help="how they fly (each kind)")
    placed.add_argument("--map-lod", help="level of detail to place it in (the lowest)")
    placed.add_argument("--mask-lod", help="that masks are drawn from, or finest (the map's)")
    tracked = actions.add_parser("tracking", help="drawn frames from pixels to poses, and how many a second")
    add_options(tracked, TrackingOptions)
    tracked.add_argument("--segmenter", default="compact", metavar="NAME", help="(compact)")
    for action in (placed, tracked):
        action.add_argument("--city", type=Path, required=True, help="city model")
        action.add_argument("--seeds", type=seeds, default="0", help="comma-separated (0)")


def measure_georeference(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    """Returns how far off reconstructions are placed.

    Raises:
        LodbenchError: An option is out of range, or as ``measure_reconstructions``.
    """
    city_file(options)
    require_within("--photos", options.photos, FEWEST_POSES)
    require_within("--mask-iou", options.mask_iou, 0, 1, "(]")
    require_within("--noise-m", options.noise_m, 0)
    require_within("--noise-deg", options.noise_deg, 0)
    flights = FlightsParams(
        str(options.city),
        num_photos=options.photos,
        path=options.path,
        mask_iou=options.mask_iou,
        lod=options.map_lod,
        mask_lod=options.mask_lod,
    )
    return measure_reconstructions(flights, options.seeds, Noise(options.noise_m, options.noise_deg), steps)


def measure_track(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    """Returns how fast and how well frames are tracked.

    Raises:
        LodbenchError: An option is out of range, or as ``measure_tracking``.
    """
    city_file(options)
    asked = options_of(options, TrackingOptions)
    # The first, which is searched for, does not count.
    require_within("--frames", asked.frames, 2)
    segmenter = segmenter_of(options.segmenter)
    require_frames_looked_at(segmenter, options.segmenter)
    return measure_tracking(options.city, options.seeds, segmenter, asked, steps)
