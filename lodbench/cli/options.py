"""Options that several commands have: the city and how to read it, where a photo was taken, segmenters."""

from __future__ import annotations

import json
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from lodbench.citymodel.options import ReadOptions
from lodbench.cli.settings import read_config
from lodbench.datasets.inputs import Input
from lodbench.datasets.pose_text import parse_camera
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Dataset
from lodbench.errors import (
    ConfigError,
    DatasetError,
    LodbenchError,
    nearest_names,
    require_choice,
    require_within,
)
from lodbench.geometry import Camera, CameraSigmas
from lodbench.params import flag, part
from lodbench.photos.pose import HeightOptions, HeightSource, RoughPlace
from lodbench.plugins import config_files
from lodbench.segmentation import Segmenter
from lodbench.segmentation.protocol import AUTO, FOR_PHOTOS, chosen_segmenter, make_segmenter
from lodbench.storage import can_write

if TYPE_CHECKING:
    from lodbench.methods.registry import ConfiguredMethod

# Settings of reading a city that have no flag of their own.
READ_SETTINGS = tuple(each.name for each in fields(ReadOptions) if each.name not in ("crs", "date"))
DATE_HELP = "leave out buildings whose end date is before it, if the file has end dates (default: today)"
# A segmenter and its parameters.
Made = tuple[Segmenter, Any]
_LOD = "level of detail; finest: each building's best (default: the lowest with walls)"
CAMERA_HELP = (
    ": SIMPLE_PINHOLE W H f cx cy; and how well they are known, if not exactly: sigma_f=1.5%% "
    "sigma_c=0.7%% (of the width) sigma_k1=0.03"
)


@dataclass(frozen=True, slots=True)
class SourceProfile:
    """How to read the files of one publisher; the YAML files are in ``conf/source/``."""

    name: str  # its name, as in ``source=plateau``
    lod: str | None  # level of detail to take unless another is requested
    options: ReadOptions  # how to read


def profile_of(values: Mapping[str, Any], crs: str | None = None) -> SourceProfile:
    """Returns the profile a configuration describes.

    Args:
        values: ``name``, ``lod`` and ``options``.
        crs: A reference system that goes before the profile's.

    Raises:
        ConfigError: A key or option is unknown or of the wrong type.
    """
    for key in values:
        if key not in ("name", "lod", "options"):
            raise ConfigError(f"source.{key} is not a setting.", f"Options are source.options.{key}=VALUE.")
    options = ReadOptions.from_mapping(values.get("options") or {})
    lod = values.get("lod")
    return SourceProfile(
        name=str(values["name"]),
        lod=None if lod is None else str(lod),
        options=options if crs is None else replace(options, crs=crs),
    )


def load_profile(
    name: str, words: Sequence[str] = (), crs: str | None = None, day: str | None = None
) -> SourceProfile:
    """Returns a profile by its name, with options a user added.

    Args:
        name: Name of a file in ``conf/source/``, of lodbench or of an installed plug-in.
        words: Options as ``key=value``; they go before the profile's own.
        crs: A reference system that goes before both.
        day: A date that goes before both.

    Raises:
        ConfigError: There is no such profile, or an option is malformed, unknown or of the wrong type.
    """
    values = read_config("source", name)
    if values is None:
        raise ConfigError(f"There is no source {name!r}.", nearest_names(name, config_files("source")))
    dated = {} if day is None else {"date": day}
    options = {**(values.get("options") or {}), **option_pairs(words), **dated}
    return profile_of({**values, "options": options}, crs)


def option_pairs(words: Sequence[str]) -> dict[str, Any]:
    """Returns the values of options written as ``key=value``.

    Raises:
        ConfigError: One has no value.
    """
    return dict(map(_pair, words))


def setting_pairs(words: Sequence[str]) -> dict[str, Any]:
    """Returns settings written as ``key=value``, those of a group (``settings.single=region``) in a mapping.

    Raises:
        ConfigError: One has no value, or is a group and a value at once.
    """
    settings: dict[str, Any] = {}
    for key, value in option_pairs(words).items():
        *groups, name = key.split(".")
        inner = settings
        for group in groups:
            inner = inner.setdefault(group, {})
            if not isinstance(inner, dict):
                raise ConfigError(f"The option {group!r} has a value of its own.", f"Leave {key!r} out.")
        inner[name] = value
    return settings


def _pair(word: str) -> tuple[str, Any]:
    """Returns the key and value of ``key=value``: a number, list, true, false or null; else text."""
    key, equals, text = word.partition("=")
    if not equals:
        raise ConfigError(f"The option {word!r} has no value.", "Options are key=value.")
    return key, _value(text)


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        # Lists of words need no quotes, as in the settings of a run.
        is_list = text.startswith("[") and text.endswith("]")
        return [_value(part.strip()) for part in text[1:-1].split(",")] if is_list else text


def segmenter_of(name: str, words: Sequence[str] = ()) -> Segmenter:
    """Returns a segmenter with some options set, ``key=value`` each.

    Raises:
        LodbenchError: There is none of this name, an option is not one of it, or its weights are missing.
    """
    return make_segmenter(name, option_pairs(words))[0]


def require_frames_looked_at(segmenter: Segmenter, name: str) -> None:
    """Makes sure that a segmenter makes masks of pixels, as frames of a video need it.

    Raises:
        ConfigError: It does not, such as one that reads masks.
    """
    if not hasattr(segmenter, "probability"):
        raise ConfigError(f"`--segmenter {name}` looks at no frames.", f"{FOR_PHOTOS} does.")


def require_one_mask_source(options: Any, *flags: str, **others: str) -> None:
    """Refuses a segmenter beside masks that are made already: one of the two would be looked at for nothing.

    Args:
        options: With ``segmenter``, and ``segmenter_option`` where the command has it.
        flags: The command's options that name masks.
        others: Likewise, by the fields that they set.

    Raises:
        ConfigError: Both were given.
    """
    sources = {flag.removeprefix("--"): flag for flag in flags} | others
    named = [flag for name, flag in sources.items() if getattr(options, name) is not None]
    makers = ["--segmenter"] if options.segmenter is not None else []
    makers += ["--segmenter-option"] if getattr(options, "segmenter_option", []) else []
    if named and makers:
        raise ConfigError(
            f"`{makers[0]}` is not used with `{named[0]}`.", f"Leave `{makers[0]}` or `{named[0]}` out."
        )


def named_segmenter(values: Mapping[str, Any]) -> Made | None:
    """Returns the segmenter that a configuration's section names; None for ``auto``.

    Raises:
        LodbenchError: As for ``segmenter_of``.
    """
    return None if values.get("name") == AUTO else make_segmenter(str(values.get("name", "")), values)


def default_segmenter(
    dataset: Dataset, wanted: Collection[Input] = frozenset({Input.MASK}), splits: tuple[str, ...] = ()
) -> Made:
    """Returns the segmenter of a dataset where none is named; prints which and why, if masks are wanted.

    Args:
        dataset: What is to be segmented.
        wanted: What the method looks at of what a segmenter makes.
        splits: That are run; the dataset's default ones if none is named.

    Raises:
        DatasetError: Masks are needed, and the splits have neither masks nor photos.
        ConfigError: A split is not one of the dataset.
    """
    name, reason = chosen_segmenter(dataset, wanted, splits)
    if wanted:
        sys.stdout.write(f"segmenter={name}: {reason}; segmenter=NAME takes another\n")
    return make_segmenter(name)


@dataclass(frozen=True, kw_only=True)
class ReadingOptions:
    """How to read a city."""

    lod: str | None = flag(None, _LOD, sets=("lod", "dataset.lod"))
    crs: str | None = flag(
        None,
        "the city's reference system, if its file names none or a wrong one",
        sets=("crs", "dataset.crs"),
    )
    date: str | None = flag(None, DATE_HELP, metavar="YYYY-MM-DD", sets=("date",))
    source: str = flag("folder", "publisher's profile, as in run source=PROFILE", metavar="PROFILE")
    option: tuple[str, ...] = flag(
        (),
        "how to read the city (see lodbench city info --help); may be repeated",
        metavar="KEY=VALUE",
        sets=READ_SETTINGS,
    )

    def profile(self) -> SourceProfile:
        """Returns the profile, with what was given besides.

        Raises:
            ConfigError: It, or an option, is unknown.
        """
        return load_profile(self.source, self.option, self.crs, self.date)

    def given(self) -> list[str]:
        """Returns the flags that were given: without a city nobody reads it so."""
        return [f"--{each.name}" for each in fields(self) if getattr(self, each.name) != each.default]


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """The city model, and how to read it."""

    city: Path = flag(
        ..., "city model: file, archive, folder of tiles or scene", metavar="FILE", sets=("city",)
    )
    reading: ReadingOptions = part(ReadingOptions)
    roof_height: str | None = flag(
        None,
        "derive LoD1 where there is none: median, max, p70 or eave",
        metavar="RULE",
        sets=("roof_height",),
    )

    def settings(self) -> dict[str, Any]:
        """Returns what requests take of it.

        Raises:
            ConfigError: The profile, an option or the rule of roofs is unknown.
        """
        from lodbench.citymodel.derive import ROOF_HEIGHTS

        profile = self.reading.profile()
        if self.roof_height is not None:
            require_choice("--roof-height", self.roof_height, ROOF_HEIGHTS)
        lod = self.reading.lod or profile.lod
        return {"city": self.city, "lod": lod, "options": profile.options, "roof_height": self.roof_height}


@dataclass(frozen=True, kw_only=True)
class HeightFlags:
    """How a drone's heights become the city's."""

    heights: str = flag(
        "auto",
        "what the photo's altitude is above; auto (default): takeoff with --takeoff, "
        "ellipsoid with RTK or where the photo says so, else sea_level",
        choices=get_args(HeightSource),
    )
    takeoff: float | None = flag(None, "height of the take-off point, in the city's heights", metavar="M")
    geoid: float | None = flag(None, "height of the geoid above the ellipsoid", metavar="M")
    height_offset: float = flag(0.0, "added at the end, to --height too", metavar="M")

    def given(self) -> list[str]:
        """Returns the flags that were given; a height that is known leaves nothing to them."""
        order = ("takeoff", "geoid", "heights", "height_offset")
        defaults = {each.name: each.default for each in fields(self)}
        return [f"--{n.replace('_', '-')}" for n in order if getattr(self, n) != defaults[n]]

    def options(self) -> HeightOptions:
        """Returns what was requested."""
        return HeightOptions(self.heights, self.takeoff, self.geoid, self.height_offset)  # type: ignore[arg-type]


@dataclass(frozen=True, kw_only=True)
class PlaceOptions:
    """Where a photo was taken, roughly, and with which camera."""

    camera: str | None = flag(
        None,
        f"COLMAP's camera model and parameters in pixels{CAMERA_HELP}",
        metavar="'MODEL W H ...'",
        apart=True,
    )
    lat: float | None = flag(None, "latitude, WGS 84", metavar="DEG")
    lon: float | None = flag(None, "longitude, WGS 84", metavar="DEG")
    height: float | None = flag(
        None, "in the city's height system; without the height options below", metavar="M"
    )
    heading: float | None = flag(None, "clockwise from true north", metavar="DEG")
    pitch: float | None = flag(None, "0 at the horizon, -90 straight down", metavar="DEG")
    roll: float | None = flag(None, "about the optical axis; > 0: the image's right side dips", metavar="DEG")
    center: tuple[float, float, float] | None = flag(
        None, "position in the city's own coordinates", metavar=("E", "N", "UP")
    )

    def given(self, *names: str) -> list[str]:
        """Returns the flags that were given, of some names."""
        return [f"--{name}" for name in names if getattr(self, name) is not None]

    def settings(self, heights: HeightFlags) -> dict[str, Any]:
        """Returns what a ``RoughRequest`` takes of it.

        Raises:
            ConfigError: The camera is none, or the place or its height is given twice, or half of it.
        """
        unused = self.given("lat", "lon", "height") + heights.given()
        if self.center is not None and unused:
            hint = f"`--center` has the height too: leave `{unused[0]}` or `--center` out."
            raise ConfigError(f"`{unused[0]}` is not used with `--center`.", hint)
        if (self.lat is None) != (self.lon is None):
            one, other = ("--lat", "--lon") if self.lon is None else ("--lon", "--lat")
            raise ConfigError(f"`{one}` is half a place.", f"Give `{other}` too, or leave `{one}` out.")
        unused = [flag for flag in heights.given() if flag != "--height-offset"]
        if self.height is not None and unused:
            hint = f"`--height` is in the city's heights already: leave `{unused[0]}` or `--height` out."
            raise ConfigError(f"`{unused[0]}` is not used with `--height`.", hint)
        camera, sigmas = given_camera(self.camera)
        place = RoughPlace(self.lat, self.lon, self.height, self.heading, self.pitch, self.roll)
        return {"camera": camera, "camera_sigmas": sigmas, "given": place, "center": self.center}

    def require_no_pose(self, start: Path, heights: HeightFlags) -> None:
        """Refuses a file of rough poses that is not there, or what else says where photos were taken.

        Raises:
            ConfigError: There is such an option.
            DatasetError: The file is not there.
        """
        if not start.exists():
            raise DatasetError(f"{start} does not exist.", "Check the path.")
        names = ("lat", "lon", "height", "heading", "pitch", "roll", "center")
        if unused := self.given(*names) + heights.given():
            hint = f"`--start` has the whole pose: leave `{unused[0]}` or `--start` out."
            raise ConfigError(f"`{unused[0]}` is not used with `--start`.", hint)


@dataclass(frozen=True, kw_only=True)
class PriorOptions:
    """How far off the rough pose may be."""

    prior_range: float | None = flag(None, "+- east and north (default: 10)", metavar="M")
    prior_height: float | None = flag(None, "+- up (default: 30)", metavar="M")
    prior_yaw: float | None = flag(None, "+- heading (default: 7.5; 180: not known)", metavar="DEG")

    @property
    def is_given(self) -> bool:
        """Returns whether any of them was given."""
        return any(width is not None for width in (self.prior_range, self.prior_height, self.prior_yaw))

    def applied_to(self, method: ConfiguredMethod) -> ConfiguredMethod:
        """Returns a method given how far off the rough pose may be, where that was stated.

        Raises:
            ConfigError: It takes no width of priors, or one is negative, or farther than methods search.
        """
        from lodbench.methods.protocol import SupportsPriorWidth

        # A grid of 1 km either way takes gigabytes; whoever knows no more has to find the place first.
        for name, most in (("range", 1000), ("height", 1000), ("yaw", 180)):
            require_within(f"--prior-{name}", getattr(self, f"prior_{name}"), 0, most)
        widths = {"x_m": self.prior_range, "y_m": self.prior_range, "z_m": self.prior_height}
        widths |= {"yaw_deg": self.prior_yaw}
        given = {name: width for name, width in widths.items() if width is not None}
        if not given:
            return method
        if not isinstance(method.make(), SupportsPriorWidth):
            hint = "Leave `--prior-range`, `--prior-height` and `--prior-yaw` out; or take `--each-alone`."
            raise ConfigError(f"Method {method.kind.name} has no adjustable search range.", hint)
        return method.for_prior(UniformPrior(**given))


def city_settings(city: MapOptions, heights: HeightFlags, out: Path) -> dict[str, Any]:
    """Returns what a ``CityRequest`` takes of a command's options.

    Raises:
        ConfigError: As ``MapOptions.settings``, or --out cannot be written to.
    """
    if not can_write(out):
        raise ConfigError(f"Nothing can be written to `--out {out}`.", "Name another folder: `--out DIR`")
    return {**city.settings(), "out": out, "heights": heights.options()}


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
