"""`lodbench localize`: photos in; poses, overlays, a table and a map out. The same from Python."""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from lodbench.cli.localize_text import describe, describe_many
from lodbench.cli.options import (
    HeightFlags,
    MapOptions,
    PlaceOptions,
    PriorOptions,
    city_settings,
    require_one_mask_source,
    segmenter_of,
    setting_pairs,
)
from lodbench.cli.parser import Parser
from lodbench.errors import ConfigError, DatasetError, LodbenchError, Option, Words, nearest_names
from lodbench.execution import Progress
from lodbench.params import add_options, flag, options_of, part, word
from lodbench.photos.pose import START_OF_EACH
from lodbench.segmentation.protocol import FOR_PHOTOS

if TYPE_CHECKING:
    from lodbench.harness.photo.localize import LocalizedPhoto
    from lodbench.harness.photo.many import Answers
    from lodbench.harness.photo.prepare import PhotoRequest
    from lodbench.methods import Method

_LOGGER = logging.getLogger(__name__)

# Exit code where there is a pose, and it is more likely wrong than right.
NOT_TRUSTED = 3
# The methods of one photo, by what there is of it.
_BY_MASK, _BY_PIXELS = "contour_alignment", "auto"
_NO_FLIGHT = "Leave --each-alone and --method out."
_TIES, _LIES = "ties a flight's photos", "lies under the map of a flight's page"
# Options of several photos: what they are for, and what one photo takes instead.
_OF_SEVERAL = (
    ("masks", "is for several photos", "Give `--mask FILE`."),
    ("reconstruction", _TIES, "Give several, or a folder."),
    ("imagery", _LIES, "Give several, or a folder."),
)
# Of the help.
_OPTION = "a setting of it, as in lodbench run --help; may be repeated"

_ABOUT = """\
Find where photos were taken. Writes for each photo its pose, an overlay to check it by, and a map; says how
probable it is that the pose is right.
"""

_EXAMPLES = """\
The rough pose of a photo comes from the photo's metadata (EXIF, and XMP of DJI, Autel, Parrot or Skydio);
options given here take precedence. --start FILE has a rough pose for each photo instead, in the city's
coordinates: lines "name qw qx qy qz tx ty tz" (world to camera), a table of Metashape, or another format that
lodbench reads; or a CSV with the head name,latitude,longitude,height,heading,pitch (degrees, the city's
heights in metres, heading from true north, pitch -90 straight down), such as localized.csv.

Where a photo states how well its position is known (RTK), the search is as wide as that says, unless
--prior-range, --prior-height or --prior-yaw is given; a laser's range to the photo's centre is used.

One photo: without a mask its own pixels are aligned with the map (--method auto, by region); where they leave
the pose open, a network makes a mask, and the more probable of the two poses is taken. The search covers 10 m
around the rough pose, 30 m up and down and 7.5 degrees to either side; --prior-range, --prior-height and
--prior-yaw widen it.

Several photos, or a folder, are taken as flights, separated by camera and by the time in EXIF, and each is
solved as a whole (--method flight). Masks come from --masks, else from a folder named masks in it, else from
a network (efficient_unet), or with --method-option single=region from the photos' own pixels, without a
network. localized.csv, .geojson and .gpkg list all photos; flights.json holds the estimated errors of drone
and map, map_findings.geojson the buildings concerned. --each-alone localises each photo by itself.

Exit code: 3 if a pose is more likely wrong than right, or a photo has none; 1 if none of many photos could be
localised; 2 for wrong options or data; else 0.

examples:
  lodbench localize DJI_0001.JPG --city LoD2_32_280_5657_1_NW.gml
  lodbench localize DJI_0001.JPG --city LoD2_32_280_5657_1_NW.gml --mask DJI_0001_mask.png
  lodbench localize DJI_0001.JPG --city city.gml --mask mask.png --takeoff 61.5
  lodbench localize DJI_0001.JPG --city city.gml --prior-range 100 --prior-yaw 180
  lodbench localize FLIGHT --city city.gml --masks MASKS --out found
  lodbench localize FLIGHT --city city.obj --start rough.txt --camera 'PINHOLE 400 300 290 290 200 150'
  lodbench localize flight1 flight2/*.JPG --city city.gml --each-alone --out found
  lodbench localize photo.jpg --city city.obj --mask mask.png --camera 'PINHOLE 400 300 290 290 200 150' \\
      --center 120 -40 95 --heading 30 --pitch -50
"""
AnyPath = str | PathLike[str]


@dataclass(frozen=True, kw_only=True)
class LocalizeOptions:
    """What the command is given."""

    photos: tuple[Path, ...] = word(
        "JPEG, PNG or TIFF as the drone stored them, or folders of these", metavar="PHOTO|DIR"
    )
    map: MapOptions = part(MapOptions)
    mask: Path | None = flag(None, "mask of one photo: buildings white, all else black", metavar="FILE")
    masks: Path | None = flag(None, "masks of many photos, named like the photos", metavar="DIR")
    segmenter: str | None = flag(
        None, f"what makes a mask where needed (default: {FOR_PHOTOS})", metavar="NAME", sets=("segmenter",)
    )
    segmenter_option: tuple[str, ...] = flag((), _OPTION, metavar="KEY=VALUE")
    place: PlaceOptions = part(PlaceOptions, "rough pose (takes precedence over the photo's metadata)")
    start: Path | None = flag(
        None,
        "rough poses by photo name, in the city's coordinates, instead of the options above",
        metavar="FILE",
    )
    prior: PriorOptions = part(PriorOptions, "how far off the rough pose may be (wider takes longer)")
    heights: HeightFlags = part(HeightFlags, "heights: from the drone's datum to the city's")
    method: str | None = flag(
        None,
        "default: flight; for one photo auto, with --mask or --segmenter contour_alignment, with "
        "--method-option region",
        metavar="NAME",
        sets=("method",),
    )
    method_option: tuple[str, ...] = flag((), _OPTION, metavar="KEY=VALUE")
    each_alone: bool = flag(False, "localise each of several photos by itself")
    reconstruction: Path | None = flag(
        None, "of a flight, in any frame: ties its photos together", metavar="COLMAP_MODEL"
    )
    sidecars: bool = flag(False, "write PHOTO.xmp beside each photo whose pose is reliable")
    imagery: Path | None = flag(
        None, "orthophoto (GeoTIFF, JPEG 2000) under the map of a flight's page", metavar="FILE"
    )
    workers: int | None = flag(
        None, "processes that share several photos out (default: one per core)", metavar="N"
    )
    seed: int = flag(0, "random seed (default: 0)")
    out: Path = flag(Path("localized"), "folder of the results (default: localized)", metavar="DIR")
    json: bool = flag(False, "print JSON, for scripts")

    @property
    def is_one(self) -> bool:
        """Returns whether one photo is named, and no folder."""
        return len(self.photos) == 1 and self.photos[0].is_file()

    @property
    def masks_inside(self) -> Path | None:
        """Returns the folder ``masks`` in the one folder that was named; None where there is none."""
        inside = self.photos[0] / "masks"
        return inside if len(self.photos) == 1 and inside.is_dir() else None

    @property
    def masks_used(self) -> Path | None:
        """Returns the folder of masks that counts: a segmenter that was named goes before what lies there."""
        is_segmented = self.segmenter is not None or self.segmenter_option
        return None if is_segmented else self.masks or self.masks_inside

    def given(self, *names: str) -> list[str]:
        """Returns the flags that were given, of some names."""
        return [f"--{name.replace('_', '-')}" for name in names if getattr(self, name)]


def parser() -> Parser:
    """Returns the parser of the command's words."""
    made = Parser("lodbench localize", _ABOUT, _EXAMPLES)
    add_options(made, LocalizeOptions)
    return made


OPTIONS = {"localize": LocalizeOptions}


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    options = options_of(parser().parse_args(argv), LocalizeOptions)
    from lodbench.harness.photo.localize import LocalizedPhoto

    surveys = localized(options)
    if not isinstance(surveys, LocalizedPhoto):
        return _print_many(surveys, options)
    sys.stdout.write((_json(surveys.to_json()) if options.json else describe(surveys)) + "\n")
    return 0 if surveys.is_trusted else NOT_TRUSTED


def localized(options: LocalizeOptions) -> LocalizedPhoto | Answers:
    """Returns the answer to one photo, or to several, and writes all of it but what is printed.

    Args:
        options: Of the command.

    Raises:
        LodbenchError: An option is wrong, the city cannot be read, or the one photo cannot be localised.
    """
    from lodbench.datasets.own import require_some_mask
    from lodbench.harness.photo.localize import open_map
    from lodbench.harness.photo.many import photos_of
    from lodbench.harness.photo.outputs import require_sidecars

    _require_options(options)
    inside, masks = options.masks_inside, options.masks_used
    photos = photos_of(options.photos, options.masks or inside, inside, options.out)
    method = _method(options, masks)
    masks = masks if "mask" in method.requires else None
    if masks is not None:
        require_some_mask(masks, [f"{photo.parent.name}/{photo.name}" for photo in photos], photos)
    request = _with_start(_request(options, photos[0], method, masks), photos, options)
    _warn_of_unused(photos, options)
    if options.sidecars:
        require_sidecars(open_map(request).scene.crs, {photo.parent for photo in photos})
    return _one(request, options) if options.is_one else _several(request, photos, masks, options)


def _one(request: PhotoRequest, options: LocalizeOptions) -> LocalizedPhoto:
    """Returns the answer to one photo, and writes it."""
    from lodbench.harness.photo.localize import STEPS, localize_photo
    from lodbench.harness.photo.many import write_view

    with Progress(request.photo.name, STEPS, unit="steps") as progress:
        answer = localize_photo(request, progress.advance)
    write_view(answer.view, request, [answer])
    _write_sidecars([(request.photo, answer)], options)
    return answer


def _several(
    request: PhotoRequest, photos: Sequence[Path], masks: Path | None, options: LocalizeOptions
) -> Answers:
    """Returns the answers to several photos, as flights or each alone, and writes them."""
    from lodbench.citymodel.surface.orthophoto import open_imagery
    from lodbench.harness.photo.flights import localize_flights
    from lodbench.harness.photo.localize import open_map
    from lodbench.harness.photo.many import default_workers, localize_photos, write_view
    from lodbench.methods.protocol import SupportsFlights

    # A script that calls this must not be run again by each worker: those of the command line are none.
    is_command = Path(sys.argv[0]).stem in ("lodbench", "__main__")
    suited = default_workers(request, len(photos)) if is_command else 1
    request = replace(request, workers=options.workers or suited)
    if isinstance(request.method, SupportsFlights) and not options.each_alone:
        imagery = None if options.imagery is None else open_imagery(options.imagery, open_map(request).scene)
        answers = localize_flights(request, photos, masks, options.reconstruction, imagery)
    elif options.imagery is not None:
        raise ConfigError(f"`--imagery` {_LIES}.", _NO_FLIGHT)
    elif options.reconstruction is not None:
        raise ConfigError(f"`--reconstruction` {_TIES}.", _NO_FLIGHT)
    else:
        answers = localize_photos(request, photos, masks)
    if answers.localized:
        pages = {flight.name: answers.page(flight).name for flight in answers.flights}
        write_view(answers.view, request, answers.localized, pages)
    _write_sidecars(
        [(each.photo, each.localized) for each in answers.photos if each.localized is not None], options
    )
    return answers


def _warn_of_unused(photos: Sequence[Path], options: LocalizeOptions) -> None:
    """Warns of what photos have and nobody uses."""
    from lodbench.harness.photo.flight_inputs import heading_note, saved_masks_note

    has_choice = options.mask is not None or options.segmenter is not None or options.masks_used is not None
    notes = (None if has_choice else saved_masks_note(photos), heading_note(photos, options.place.heading))
    for note in filter(None, notes):
        _LOGGER.warning("%s", note)


def _write_sidecars(answers: Sequence[tuple[Path, LocalizedPhoto]], options: LocalizeOptions) -> None:
    """Writes XMP beside the photos whose poses are to be trusted, if that was requested."""
    from lodbench.harness.photo.outputs import write_sidecars

    trusted = [(photo, answer.pose) for photo, answer in answers if answer.is_trusted]
    if options.sidecars and answers:
        sys.stderr.write(f"lodbench: sidecars: {write_sidecars(trusted, answers[0][1].crs)}\n")


def _method(options: LocalizeOptions, masks: Path | None) -> Method:
    """Returns the method that was requested, or the one for what was given."""
    from lodbench.methods.registry import configure_method

    named = options.given("mask", "masks", "segmenter", "segmenter_option")
    # Settings without a method are those of the one by pixels, which looks at no mask.
    by_pixels = "region" if options.method_option else _BY_PIXELS
    alone = _BY_MASK if named or masks is not None else by_pixels
    name = options.method or (alone if options.is_one or options.each_alone else "flight")
    configured = configure_method({**setting_pairs(options.method_option), "name": name})
    method = options.prior.applied_to(configured).make()
    if "reconstruction" in method.requires and options.reconstruction is None:
        hint = "Give several photos, or a folder, and `--reconstruction COLMAP_MODEL`."
        raise ConfigError(f"Method {method.name} needs a reconstruction of the flight.", hint)
    takes_mask = "mask" in method.requires
    makes_mask = "mask_on_demand" in method.requires and not (options.mask or options.masks)
    if named and not takes_mask and not makes_mask:
        hint = f"Leave `{named[0]}` out, or take `--method {_BY_MASK}`."
        raise ConfigError(f"Method {method.name} looks at no mask.", hint)
    return method


def _request(options: LocalizeOptions, photo: Path, method: Method, masks: Path | None) -> PhotoRequest:
    from lodbench.harness.photo.prepare import PhotoRequest

    segmenter = None
    if options.mask is None and masks is None and {"mask", "mask_on_demand"} & set(method.requires):
        segmenter = segmenter_of(options.segmenter or FOR_PHOTOS, options.segmenter_option)
    own: dict[str, Any] = {"photo": photo, "mask": options.mask, "method": method, "seed": options.seed}
    own |= {"segmenter": segmenter, "has_prior_range": options.prior.is_given}
    city = city_settings(options.map, options.heights, options.out)
    return PhotoRequest(**city, **options.place.settings(options.heights), **own)


def _with_start(request: PhotoRequest, photos: Sequence[Path], options: LocalizeOptions) -> PhotoRequest:
    """Returns a request with the rough poses that --start names, if it does."""
    if options.start is None:
        return request
    from lodbench.harness.photo.flight_inputs import read_rough_poses
    from lodbench.harness.photo.localize import open_map

    return replace(request, start=read_rough_poses(options.start, photos, open_map(request).scene.crs))


def _require_options(options: LocalizeOptions) -> None:
    """Refuses a city where photos are meant, and what is meant for one photo and given for many, and back."""
    from lodbench.citymodel.source import is_city_file

    require_one_mask_source(options, "--mask", "--masks")
    cities = [photo for photo in options.photos if is_city_file(photo)]
    if cities:
        hint = "The photos come first, the city model after `--city`."
        raise ConfigError(f"{cities[0]} is a city model by its name, not a photo.", hint)
    absent = [photo for photo in options.photos if not photo.exists()]
    if absent:
        raise DatasetError(f"The photo {absent[0]} does not exist.", "Check the path.")
    if options.start is not None:
        options.place.require_no_pose(options.start, options.heights)
    own = [*options.given("mask"), *options.place.given("lat", "lon", "center")]
    if own and not options.is_one:
        hint = "Use `--masks DIR` for several." if own[0] == "--mask" else f"For several: {START_OF_EACH}."
        raise ConfigError(f"`{own[0]}` works with one photo.", hint)
    for name, why, hint in _OF_SEVERAL if options.is_one else ():
        if getattr(options, name) is not None:
            raise ConfigError(f"`--{name}` {why}.", hint)
    if options.workers is not None and options.workers < 1:
        raise ConfigError(f"`--workers {options.workers}` is not a number of processes.")
    if options.masks is not None and not options.masks.is_dir():
        raise ConfigError(
            f"`--masks {options.masks}` is not a folder.", "Name the folder of the photos' masks."
        )


def _print_many(answers: Answers, options: LocalizeOptions) -> int:
    """Prints what became of many photos; returns the exit code."""
    if options.json:
        values = [
            {
                **({"failure": answer.failure} if answer.localized is None else answer.localized.to_json()),
                "photo": str(answer.photo),
                "flight": answer.flight or None,
            }
            for answer in answers.photos
        ]
        sys.stdout.write(_json(values) + "\n")
    else:
        sys.stdout.write(describe_many(answers, has_masks=options.masks_used is not None))
    if all(answer.localized is None for answer in answers.photos):
        return 1
    is_well = all(answer.localized is not None and answer.localized.is_trusted for answer in answers.photos)
    return 0 if is_well else NOT_TRUSTED


def _json(values: Any) -> str:
    return json.dumps(values, indent=2, ensure_ascii=False, allow_nan=False)


def localize_photo(photo: AnyPath, city: AnyPath, **options: Any) -> LocalizedPhoto:
    """Returns where a photo was taken, by its EXIF and XMP; writes the files of `lodbench localize`.

    Args:
        photo: JPEG, PNG or TIFF as the drone stored it.
        city: City model: file, archive, folder of tiles or scene.
        options: Those of the command, with underscores: ``out="found"`` (folder of the results, by default
            ``localized``), ``mask``, ``method``, ``takeoff=61.5``, ``center=(e, n, up)``,
            ``camera="PINHOLE 400 300 290 290 200 150"``, ``option={"axis_order": "east_first"}``.

    Raises:
        ConfigError: There is no such option, its value is wrong, or the photo is a folder.
        LodbenchError: The photo, its metadata, mask or camera, or the city is missing or not fit.

    Example::

        found = localize_photo("DJI_0001.JPG", "city.gml", takeoff=61.5)
        print(found.place.latitude_deg, found.place.heading_deg, found.trust)
    """
    if Path(photo).is_dir():
        raise ConfigError(f"{fspath(photo)} is a folder.", "lodbench.localize_flight takes folders.")
    return cast("LocalizedPhoto", _localized([photo], city, options))


def localize_flight(photos: AnyPath | Sequence[AnyPath], city: AnyPath, **options: Any) -> Answers:
    """Returns where the photos of flights were taken, each flight solved as a whole, and writes all of it.

    Args:
        photos: A folder, or files and folders.
        city: As of ``localize_photo``.
        options: Likewise: ``masks``, ``reconstruction``, ``out``, ``each_alone=True``.

    Returns:
        An answer per photo (``photos``: the answer or why there is none), flights, and the files written.

    Raises:
        ConfigError: There is no such option, its value is wrong, or there is but one photo.
        LodbenchError: The city cannot be read, or there are no photos.
    """
    several = [photos] if isinstance(photos, str | PathLike) else list(photos)
    if len(several) == 1 and Path(several[0]).is_file():
        raise ConfigError(f"{fspath(several[0])} is one photo.", "lodbench.localize_photo takes it.")
    return cast("Answers", _localized(several, city, options))


def _localized(
    photos: Sequence[AnyPath], city: AnyPath, options: Mapping[str, Any]
) -> LocalizedPhoto | Answers:
    command = parser()
    known = {each.dest: each for each in command._actions if each.option_strings}
    try:
        typed = command.parse_args(_typed(photos, city, options, known))
        return localized(options_of(typed, LocalizeOptions))
    except LodbenchError as error:
        flags = {each.option_strings[-1]: each for each in known.values()}
        error.message = as_arguments(error.message, flags)
        error.hint = as_arguments(error.hint, flags)
        raise


def _typed(
    photos: Sequence[AnyPath], city: AnyPath, options: Mapping[str, Any], known: Mapping[str, argparse.Action]
) -> list[str]:
    """Returns the command's words for these arguments."""
    words: list[str] = []
    for name, value in {"city": city, **options}.items():
        if name not in known or name in ("help", "json"):
            raise ConfigError(f"localize has no option {name}.", nearest_names(name, known))
        words += _words(known[name].option_strings[-1], value, known[name])
    return [*words, "--", *(fspath(photo) for photo in photos)]


def as_arguments(text: Words, flags: Mapping[str, argparse.Action]) -> Words:
    """Returns a message of the command with its flags as arguments of the functions here.

    Example:
        >>> command = parser()
        >>> flags = {each.option_strings[-1]: each for each in command._actions if each.option_strings}
        >>> as_arguments(Words("Give `--lat`, `--center EAST NORTH UP` and `--camera 'PINHOLE 4 3'`."), flags)
        "Give lat, center=(EAST, NORTH, UP) and camera='PINHOLE 4 3'."
        >>> as_arguments(Words("lodbench localize takes `--heights ellipsoid`."), flags)
        "this function takes heights='ellipsoid'."
    """

    def argument(option: Option) -> str:
        action = flags.get(f"--{option.name.replace('_', '-')}")
        if action is None:
            return option.words
        if action.choices and option.value in action.choices:
            return f"{action.dest}={option.value!r}"
        several = isinstance(action.nargs, int) and action.nargs > 1 and " " in option.value
        value = f"({', '.join(option.value.split())})" if several else option.value
        return f"{action.dest}={value}" if value else action.dest

    return Words(text.marked.replace("lodbench localize takes", "this function takes")).rewritten(argument)


def _words(flag: str, value: Any, action: argparse.Action) -> list[str]:
    """Returns an option as it is typed; none for None and False."""
    if value is None or value is False:
        return []
    if value is True:
        return [flag]
    if isinstance(value, Mapping):
        return [word for key, each in value.items() for word in (flag, f"{key}={each}")]
    if isinstance(action.nargs, int) and action.nargs > 1:
        return [flag, *map(str, value)]
    return [f"{flag}={value}"]
