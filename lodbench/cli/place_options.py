"""Options that say where a photo was taken, and with which camera, beside its own metadata."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from lodbench.cli.source_profiles import DATE_HELP, load_profile
from lodbench.datasets.pose_text import parse_camera
from lodbench.datasets.priors import UniformPrior
from lodbench.errors import ConfigError, DatasetError, LodbenchError, require_choice, require_within
from lodbench.geometry import Camera, CameraSigmas
from lodbench.photos.pose import HeightOptions, HeightSource, RoughPlace
from lodbench.storage import can_write

if TYPE_CHECKING:
    from lodbench.methods.registry import ConfiguredMethod


_LOD = "level of detail; finest: each building's best (default: the lowest with walls)"


def add_city_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options that say how to read a city."""
    parser.add_argument("--lod", help=_LOD)
    parser.add_argument("--crs", help="the city's reference system, if its file names none or a wrong one")
    parser.add_argument("--date", metavar="YYYY-MM-DD", help=DATE_HELP)
    parser.add_argument(
        "--source", default="folder", metavar="PROFILE", help="publisher's profile, as in run source=PROFILE"
    )
    parser.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="how to read the city (see lodbench city info --help); may be repeated",
    )


def add_map_options(parser: argparse.ArgumentParser) -> None:
    """Adds the city model, which must be named, and how to read it."""
    parser.add_argument(
        "--city",
        type=Path,
        required=True,
        metavar="FILE",
        help="city model: file, archive, folder of tiles or scene",
    )
    add_city_options(parser)
    parser.add_argument(
        "--roof-height", metavar="RULE", help="derive LoD1 where there is none: median, max, p70 or eave"
    )


def city_settings(wanted: argparse.Namespace) -> dict[str, Any]:
    """Returns what a ``CityRequest`` takes of ``add_map_options``, ``add_height_options`` and ``--out``.

    Raises:
        ConfigError: The profile, an option or the rule of roofs is unknown, or --out cannot be written to.
    """
    if not can_write(wanted.out):
        raise ConfigError(
            f"Nothing can be written to `--out {wanted.out}`.", "Name another folder: `--out DIR`"
        )
    return {**map_settings(wanted), "out": wanted.out, "heights": height_options(wanted)}


def map_settings(wanted: argparse.Namespace) -> dict[str, Any]:
    """Returns the city of ``add_map_options`` and how to read it.

    Raises:
        ConfigError: The profile, an option or the rule of roofs is unknown.
    """
    from lodbench.citymodel.derive import ROOF_HEIGHTS

    profile = load_profile(wanted.source, wanted.option, wanted.crs, wanted.date)
    if wanted.roof_height is not None:
        require_choice("--roof-height", wanted.roof_height, ROOF_HEIGHTS)
    return {
        "city": wanted.city,
        "lod": wanted.lod or profile.lod,
        "options": profile.options,
        "roof_height": wanted.roof_height,
    }


def rough_settings(wanted: argparse.Namespace) -> dict[str, Any]:
    """Returns what a ``RoughRequest`` takes of ``add_rough_pose_options``.

    Raises:
        ConfigError: The camera is none, or the place or its height is given twice, or half of it.
    """
    own = {"--lat": wanted.lat, "--lon": wanted.lon, "--height": wanted.height}
    unused = [name for name, value in own.items() if value is not None] + height_flags(wanted)
    if wanted.center is not None and unused:
        hint = f"`--center` has the height too: leave `{unused[0]}` or `--center` out."
        raise ConfigError(f"`{unused[0]}` is not used with `--center`.", hint)
    if (wanted.lat is None) != (wanted.lon is None):
        one, other = ("--lat", "--lon") if wanted.lon is None else ("--lon", "--lat")
        raise ConfigError(f"`{one}` is half a place.", f"Give `{other}` too, or leave `{one}` out.")
    unused = [flag for flag in height_flags(wanted) if flag != "--height-offset"]
    if wanted.height is not None and unused:
        hint = f"`--height` is in the city's heights already: leave `{unused[0]}` or `--height` out."
        raise ConfigError(f"`{unused[0]}` is not used with `--height`.", hint)
    camera, sigmas = given_camera(wanted.camera)
    return {
        "camera": camera,
        "camera_sigmas": sigmas,
        "given": RoughPlace(wanted.lat, wanted.lon, wanted.height, wanted.heading, wanted.pitch, wanted.roll),
        "center": None if wanted.center is None else tuple(wanted.center),
    }


def add_rough_pose_options(parser: argparse.ArgumentParser, title: str) -> None:
    """Adds the options that say where a photo was taken, roughly, and with which camera."""
    add_camera_option(parser, "COLMAP's camera model and parameters in pixels")
    place = parser.add_argument_group(title)
    add = place.add_argument
    add("--lat", type=float, metavar="DEG", help="latitude, WGS 84")
    add("--lon", type=float, metavar="DEG", help="longitude, WGS 84")
    add(
        "--height",
        type=float,
        metavar="M",
        help="in the city's height system; without the height options below",
    )
    add("--heading", type=float, metavar="DEG", help="clockwise from true north")
    add("--pitch", type=float, metavar="DEG", help="0 at the horizon, -90 straight down")
    add("--roll", type=float, metavar="DEG", help="about the optical axis; > 0: the image's right side dips")
    add(
        "--center",
        type=float,
        nargs=3,
        metavar=("E", "N", "UP"),
        help="position in the city's own coordinates",
    )


def add_start_option(parser: argparse.ArgumentParser) -> None:
    """Adds the option that names rough poses of photos, which takes the place of all others of a place."""
    words = "rough poses by photo name, in the city's coordinates, instead of the options above"
    parser.add_argument("--start", type=Path, metavar="FILE", help=words)


def require_start_alone(wanted: argparse.Namespace) -> None:
    """Refuses --start that is not there, or what else says where photos were taken beside it.

    Raises:
        ConfigError: There is such an option.
        DatasetError: The file is not there.
    """
    if wanted.start is None:
        return
    if not wanted.start.exists():
        raise DatasetError(f"{wanted.start} does not exist.", "Check the path.")
    names = ("lat", "lon", "height", "heading", "pitch", "roll", "center")
    unused = [f"--{name}" for name in names if getattr(wanted, name) is not None] + height_flags(wanted)
    if unused:
        hint = f"`--start` has the whole pose: leave `{unused[0]}` or `--start` out."
        raise ConfigError(f"`{unused[0]}` is not used with `--start`.", hint)


def add_camera_option(parser: argparse.ArgumentParser, words: str) -> None:
    """Adds ``--camera``, as ``given_camera`` reads it."""
    words += ": SIMPLE_PINHOLE W H f cx cy; and how well they are known, if not exactly: sigma_f=1.5%%"
    words += " sigma_c=0.7%% (of the width) sigma_k1=0.03"
    parser.add_argument("--camera", metavar="'MODEL W H ...'", help=words)


def add_prior_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options that say how far off the rough pose may be."""
    group = parser.add_argument_group("how far off the rough pose may be (wider takes longer)")
    add = group.add_argument
    add("--prior-range", type=float, metavar="M", help="+- east and north (default: 10)")
    add("--prior-height", type=float, metavar="M", help="+- up (default: 30)")
    add("--prior-yaw", type=float, metavar="DEG", help="+- heading (default: 7.5; 180: not known)")


def with_prior_width(method: ConfiguredMethod, wanted: argparse.Namespace) -> ConfiguredMethod:
    """Returns a method given how far off the rough pose may be, where that was stated.

    Raises:
        ConfigError: It takes no width of priors.
    """
    from lodbench.methods.protocol import SupportsPriorWidth

    prior = _told_prior(wanted)
    if prior is None:
        return method
    if not isinstance(method.make(), SupportsPriorWidth):
        hint = "Leave `--prior-range`, `--prior-height` and `--prior-yaw` out; or take `--each-alone`."
        raise ConfigError(f"Method {method.kind.name} has no adjustable search range.", hint)
    return method.for_prior(prior)


def _told_prior(wanted: argparse.Namespace) -> UniformPrior | None:
    """Returns how far off the rough pose may be; None where no option of ``add_prior_options`` says.

    Raises:
        ConfigError: A width is negative, or farther than methods search.
    """
    widths = {"x_m": wanted.prior_range, "y_m": wanted.prior_range, "z_m": wanted.prior_height}
    widths["yaw_deg"] = wanted.prior_yaw
    # A grid of 1 km either way takes gigabytes; whoever knows no more has to find the place first.
    for name, most in (("range", 1000), ("height", 1000), ("yaw", 180)):
        require_within(f"--prior-{name}", getattr(wanted, f"prior_{name}"), 0, most)
    given = {name: width for name, width in widths.items() if width is not None}
    return UniformPrior(**given) if given else None


def add_height_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options that say how a drone's heights become the city's."""
    group = parser.add_argument_group("heights: from the drone's datum to the city's")
    group.add_argument(
        "--heights",
        choices=get_args(HeightSource),
        default="auto",
        help="what the photo's altitude is above; auto (default): takeoff with --takeoff, "
        "ellipsoid with RTK or where the photo says so, else sea_level",
    )
    group.add_argument(
        "--takeoff", type=float, metavar="M", help="height of the take-off point, in the city's heights"
    )
    group.add_argument("--geoid", type=float, metavar="M", help="height of the geoid above the ellipsoid")
    group.add_argument(
        "--height-offset", type=float, default=0.0, metavar="M", help="added at the end, to --height too"
    )


def height_flags(wanted: argparse.Namespace) -> list[str]:
    """Returns which of ``add_height_options`` were given; a height that is known leaves nothing to them."""
    given = {
        "--takeoff": wanted.takeoff is not None,
        "--geoid": wanted.geoid is not None,
        "--heights": wanted.heights != "auto",
        "--height-offset": wanted.height_offset != 0,
    }
    return [flag for flag, is_given in given.items() if is_given]


def city_flags(wanted: argparse.Namespace) -> list[str]:
    """Returns which of ``add_city_options`` were given; without a city nobody reads it so."""
    given = {
        "--lod": wanted.lod is not None,
        "--crs": wanted.crs is not None,
        "--source": wanted.source != "folder",
        "--option": bool(wanted.option),
        "--date": wanted.date is not None,
    }
    return [flag for flag, is_given in given.items() if is_given]


def height_options(wanted: argparse.Namespace) -> HeightOptions:
    """Returns what ``add_height_options`` requested."""
    return HeightOptions(wanted.heights, wanted.takeoff, wanted.geoid, wanted.height_offset)


def given_camera(text: str | None) -> tuple[Camera | None, CameraSigmas | None]:
    """Returns the camera of ``MODEL W H PARAMETERS``, and how well it is known, each None where nobody says.

    Raises:
        ConfigError: It is no camera.
    """
    if text is None:
        return None, None
    try:
        return parse_camera(text.split())
    except (LodbenchError, ValueError) as error:
        reason = str(error).rstrip(".")
        raise ConfigError(f"`--camera`: {reason}.", "It reads: PINHOLE W H fx fy cx cy") from error
