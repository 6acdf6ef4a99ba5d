"""Options that say where a photo was taken, and with which camera, beside its own metadata."""

from __future__ import annotations

import argparse
from typing import get_args

from lodbench.datasets.photo_pose import HeightOptions, HeightSource
from lodbench.datasets.pose_text import parse_camera
from lodbench.errors import ConfigError, LodbenchError
from lodbench.geometry import Camera


def add_city_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options that say how to read a city."""
    parser.add_argument("--lod", help="level of detail, or finest: each building's own (lowest with walls)")
    parser.add_argument("--crs", help="CRS of the city, where its file says none or a wrong one")
    parser.add_argument(
        "--source", default="folder", metavar="PROFILE", help="publisher, as in run source=PROFILE"
    )
    parser.add_argument(
        "--option", action="append", default=[], metavar="KEY=VALUE", help="as in city info: layers=bridges"
    )


def add_rough_pose_options(parser: argparse.ArgumentParser, title: str) -> None:
    """Adds the options that say where a photo was taken, roughly."""
    place = parser.add_argument_group(title)
    place.add_argument("--lat", type=float, metavar="DEG", help="latitude, WGS 84")
    place.add_argument("--lon", type=float, metavar="DEG", help="longitude, WGS 84")
    place.add_argument("--height", type=float, metavar="M", help="in the city's heights")
    place.add_argument("--heading", type=float, metavar="DEG", help="clockwise from true north")
    place.add_argument("--pitch", type=float, metavar="DEG", help="0 at the horizon, -90 straight down")
    place.add_argument("--roll", type=float, metavar="DEG", help="about the optical axis")
    place.add_argument(
        "--center", type=float, nargs=3, metavar=("E", "N", "UP"), help="in the city's own coordinates"
    )


def add_height_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options that say how a drone's heights become the city's."""
    group = parser.add_argument_group("heights: from the drone's to the city's")
    group.add_argument(
        "--heights",
        choices=get_args(HeightSource),
        default="auto",
        help="what the altitude is above; auto: takeoff with --takeoff, ellipsoid with RTK, else sea_level",
    )
    group.add_argument("--takeoff", type=float, metavar="M", help="height of the take-off point in the city")
    group.add_argument("--geoid", type=float, metavar="M", help="height of the geoid above the ellipsoid")
    group.add_argument("--height-offset", type=float, default=0.0, metavar="M", help="added in the end")


def height_options(asked: argparse.Namespace) -> HeightOptions:
    """Returns what ``add_height_options`` asked for."""
    return HeightOptions(asked.heights, asked.takeoff, asked.geoid, asked.height_offset)


def given_camera(text: str | None) -> Camera | None:
    """Returns the camera of ``MODEL W H PARAMETERS``.

    Raises:
        ConfigError: It is no camera.
    """
    if text is None:
        return None
    try:
        return parse_camera(text.split())
    except (LodbenchError, ValueError) as error:
        reason = str(error).rstrip(".")
        raise ConfigError(f"--camera: {reason}.", "It reads: PINHOLE W H fx fy cx cy") from error
