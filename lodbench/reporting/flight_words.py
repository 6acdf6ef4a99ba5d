"""What a flight says of drone, camera and map: in sentences, and as a page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.evaluation.pose_errors import pose_error
from lodbench.geometry import Pose
from lodbench.reporting.aligned_text import count_of
from lodbench.reporting.answers import UNTRUSTED, columns_legend, rounded_down, trust_counts
from lodbench.reporting.maps import Marked, Spot, Underlay, draw_map
from lodbench.reporting.page import Picture, markup, rendered

# Where rough poses are from: the photos' own metadata, or a file, as of a dataset.
PriorSource = Literal["metadata", "poses"]
_GIVEN: dict[PriorSource, str] = {"metadata": "the metadata", "poses": "the given poses"}
_CORRECTED: dict[PriorSource, str] = {"metadata": "the drone's metadata", "poses": "the given poses"}
_MASKS = "masks too large by"
# What constants are called where people read them, in this order.
_CALLED = {
    "east": "positions, to the east", "north": "positions, to the north", "pitch": "gimbal pitch",
    "roll": "gimbal roll", "yaw": "heading, counter-clockwise", "focal length": "focal length",
    "radial distortion k1": "radial distortion k1", _MASKS: "mask edges",
    "roofs higher than the map": "roofs relative to the map",
    "feet of walls higher than the map": "bases of walls relative to the map",
}  # fmt: skip
# These are of masks and map, all others correct the drone's metadata.
_OF_MASKS_AND_MAP = {called for name, called in _CALLED.items() if name == _MASKS or "the map" in name}
# Heights this far off, beyond doubt, are of another zero rather than of a barometer.
_OTHER_ZERO_M, _BEYOND_DOUBT = 8.0, 3.0
# A correction of fewer of its standard deviations is not significant.
_SIGNIFICANT = 2.0
Floats = NDArray[np.float64]
# Of more photos the page shows so many, spread evenly: a picture has 60 kB.
MAX_PICTURES = 240


def constants_in_words(
    constants: Mapping[str, Mapping[str, Any]], source: PriorSource = "metadata"
) -> list[str]:
    """Returns sentences on the constants that the photos determine, and one that names those they do not.

    Args:
        constants: By name ``value`` (to be added to what sensors say), ``sigma``, ``unit``, ``determined``.
        source: What the rough poses are from.
    """
    height, rows = constants.get("height"), constant_rows(constants)
    lines = [heights_in_words(height, source)] if height is not None and height["determined"] else []
    known = [row for row in rows if row[2]]
    drone = [f"{row[0]} {row[1]}" for row in known if row[0] not in _OF_MASKS_AND_MAP]
    others = [f"{row[0]} {row[1]}" for row in known if row[0] in _OF_MASKS_AND_MAP]
    silent = ["heights"] if height is not None and not height["determined"] else []
    silent += [called for called, _, is_known, _ in rows if not is_known]
    lines += [f"corrections to {_CORRECTED[source]}: {'; '.join(drone)}"] if drone else []
    lines += [f"masks and map: {'; '.join(others)}"] if others else []
    lines += [f"not determined by these photos: {'; '.join(silent)}"] if silent else []
    return lines


def constant_rows(constants: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str, bool, str]]:
    """Returns each constant but the height: name, correction, whether photos determine it, and that in words.

    One that they do not determine has no correction. Mask edges of a flight without masks are left out.
    """
    order = [name for name in _CALLED if name in constants]
    order += [name for name in constants if name not in _CALLED and name != "height"]
    rows = []
    for name in order:
        constant = constants[name]
        if name == _MASKS and not constant["determined"] and constant["value"] == 0.0:
            continue
        is_known = constant["determined"]
        amount = _change(name, constant) if is_known else "-"
        rows.append((_CALLED.get(name, name), amount, is_known, _estimated(constant)))
    return rows


def _estimated(constant: Mapping[str, Any]) -> str:
    if not constant["determined"]:
        return f"no: these photos leave {_open_amount(constant)} open"
    is_small = abs(constant["value"]) < _SIGNIFICANT * constant["sigma"]
    return "yes: not significant" if is_small else "yes"


def _change(name: str, constant: Mapping[str, Any]) -> str:
    if name != _MASKS:
        return _amount(constant)
    side = "inside" if constant["value"] < 0 else "outside"
    return f"{_amount(constant, signed=False)} too far {side}"


def _amount(constant: Mapping[str, Any], *, signed: bool = True) -> str:
    """Returns ``-0.80 deg +-0.10``."""
    value, sigma, unit, digits = _scaled(constant)
    number = f"{round(value, digits) + 0.0:+.{digits}f}" if signed else f"{abs(value):.{digits}f}"
    return f"{number}{' ' if unit else ''}{unit} +-{sigma:.{digits}f}"


def _open_amount(constant: Mapping[str, Any]) -> str:
    """Returns ``+-0.10 deg``."""
    _, sigma, unit, digits = _scaled(constant)
    return f"+-{sigma:.{digits}f} {unit}".rstrip()


def _scaled(constant: Mapping[str, Any]) -> tuple[float, float, str, int]:
    """Returns value, sigma and unit, shares in percent, and how many digits are shown."""
    value, sigma, unit = constant["value"], constant["sigma"], constant["unit"]
    if unit == "share":
        value, sigma, unit = 100.0 * value, 100.0 * sigma, "%"
    # As many digits as the sigma's first.
    return value, sigma, unit, min(max(-math.floor(math.log10(sigma)), 0), 5) if sigma > 0 else 2


def heights_in_words(constant: Mapping[str, Any], source: PriorSource = "metadata") -> str:
    """Returns by how much given heights are too high or too low, and the likely cause."""
    if not constant["determined"]:
        return "heights are not determined by these photos"
    value, sigma = constant["value"], constant["sigma"]
    word = "high" if value < 0 else "low"
    amount = _amount(constant, signed=False).replace(" m", f" m too {word}", 1)
    if abs(value) < max(_OTHER_ZERO_M, _BEYOND_DOUBT * sigma):
        return f"heights in {_GIVEN[source]} are {amount}"
    datum = "the ellipsoid or the take-off point" if value < 0 else "the take-off point"
    hint = ". Set their datum with --heights" if source == "metadata" else ""
    return f"heights in {_GIVEN[source]} are {amount}, as if measured from {datum}{hint}"


def map_in_words(findings: Mapping[str, Any], most: int = 5) -> list[str]:
    """Returns sentences on possible errors of the map, the surest of each kind first.

    Places where the map has no building come apart: of a partial map there are many, and none is wrong.
    """
    rows, count = map_rows(findings), len(findings.get("buildings", []))
    lacking = sum(change["kind"] == "unmapped" for change in findings.get("changes", []))
    mapped, places = rows[: len(rows) - lacking], rows[len(rows) - lacking :]
    errors = f"{count_of(len(mapped), 'possible errors')} of the map"
    not_mapped = "buildings, containers or heaps not in the map, which may hold a part of all"
    return [
        *_listed(f"{errors}, {count_of(count, 'buildings')} checked:", mapped, most),
        *_listed(f"{count_of(len(places), 'places')} with {not_mapped}:", places, most),
    ]


def _listed(head: str, rows: Sequence[tuple[str, str, str]], most: int) -> list[str]:
    lines = [f"- {name}: {stated}, from {photos}" for name, stated, photos in rows[:most]]
    more = [f"- and {len(rows) - most} more"] if len(rows) > most else []
    return [head, *lines, *more] if rows else []


def _apart(finding: Mapping[str, Any]) -> str:
    """Returns how far apart a finding's photos look from, as words to be added."""
    return f" up to {finding['apart_deg']:.0f} deg apart" if "apart_deg" in finding else ""


def map_rows(findings: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Returns of each possible error the building, what the photos show, and which photos.

    Args:
        findings: ``buildings`` with heights, and ``changes``: demolished and unmapped buildings.
    """
    rows = [
        (
            str(each["id"]),
            f"{abs(each['higher_m']):.1f} m +-{each['sigma_m']:.1f} "
            f"{'higher' if each['higher_m'] > 0 else 'lower'} than in the map",
            count_of(each["photos"], "photos") + _apart(each),
        )
        for each in doubted_buildings(findings.get("buildings", []))
    ]
    for change in findings.get("changes", []):
        listed = ", ".join(change["photos"][:3]) + (", ..." if len(change["photos"]) > 3 else "")
        photos = f"{count_of(len(change['photos']), 'photos')}{_apart(change)} ({listed})"
        if change["kind"] == "demolished":
            rows.append(
                (str(change["id"]), f"probably demolished ({100 * change['probability']:.0f} %)", photos)
            )
        else:
            rows.append(("not in the map", f"{change['area_m2']:.0f} m2, {_height(change)}", photos))
    return rows


def _height(place: Mapping[str, Any]) -> str:
    """Returns how high something is that the map lacks, and how well that is known."""
    if place["height_m"] is not None:
        return f"{place['height_m']:.1f} m +-{place['sigma_m']:.1f} high"
    at_most = "" if place["at_most_m"] is None else f", below {place['at_most_m']:.0f} m"
    return f"height not determined{at_most}"


def doubted_buildings(buildings: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Returns the buildings in doubt, the surest first."""
    doubted = [each for each in buildings if each["doubt"]]
    return sorted(doubted, key=lambda each: -abs(each["higher_m"]) / max(each["sigma_m"], 1e-9))


class PhotoOnPage(NamedTuple):
    """A photo of a flight that was placed."""

    spot: Spot  # on the map
    moved_m: float | None  # how far from where the drone said it was
    turned_deg: float | None  # likewise
    sigma_m: float | None  # standard deviation of its place, in space, where the method knows it
    probability: float | None  # that it is within 2 m and 2 degrees, where the method knows it
    score: float | None  # of the method
    surveyed: Mapping[str, float | None]  # its place and where it looks: ``survey_row``
    why: str = ""  # why it is not to be trusted fully, and notes; "" for neither

    def numbers(self, has_earth: bool) -> list[tuple[float | None, str]]:
        """Returns the numbers of its row, and their texts."""
        sure = None if self.probability is None else rounded_down(self.probability, 2)
        named = [(self.surveyed[name], spec) for _, name, spec in place_columns(has_earth)]
        named += [
            (self.moved_m, ".2f"), (self.turned_deg, ".2f"), (self.sigma_m, ".2f"), (sure, ".2f"),
            (self.score, ".3f"),
        ]  # fmt: skip
        return [(value, "-" if value is None else format(value, spec)) for value, spec in named]


def place_columns(has_earth: bool) -> list[tuple[str, str, str]]:
    """Returns heads of where photos are and look, in a table, with name and format in ``survey_row``."""
    first = [("easting m", "easting_m", ".2f"), ("northing m", "northing_m", ".2f")]
    if has_earth:
        first = [("latitude", "latitude_deg", ".7f"), ("longitude", "longitude_deg", ".7f")]
    angles = [(f"{name} deg", f"{name}_deg", "z.2f") for name in ("heading", "pitch", "roll")]
    return [*first, ("height m", "height_m", "z.2f"), *angles]


def photo_on_page(
    key: str,
    poses: tuple[Pose | None, Pose, Pose | None],
    covariance: Floats | None,
    probability: float | None,
    score: float | None,
    trust: str,
    surveyed: Mapping[str, float | None],
    why: Sequence[str] = (),
) -> PhotoOnPage:
    """Returns a photo for the page.

    Args:
        key: Its name, unique in the flight.
        poses: Prior, estimate and truth, in the city's coordinates; None where there is none.
        covariance: (6, 6) of the estimate's error, where it is known.
        probability: That it is within 2 m and 2 degrees.
        score: Of the method.
        trust: In a word.
        surveyed: Of the estimate: ``survey_row``.
        why: It is not to be trusted fully, and notes.
    """
    prior, estimate, _ = poses
    places = [None if pose is None else pose.center[:2] for pose in poses]
    moved = None if prior is None else pose_error(estimate, prior)
    return PhotoOnPage(
        Spot(key, places[0], places[1], places[2], trust, None if covariance is None else covariance[:2, :2]),
        None if moved is None else moved.translation_m,
        None if moved is None else moved.rotation_deg,
        None if covariance is None else float(np.sqrt(np.trace(covariance[:3, :3]))),
        probability,
        score,
        surveyed,
        "; ".join(why),
    )


def chosen_for_pictures(keys: Sequence[str]) -> list[str]:
    """Returns the photos whose pictures the page shows: all, or some spread evenly."""
    rows = np.unique(np.linspace(0, len(keys) - 1, min(len(keys), MAX_PICTURES)).round().astype(int))
    return [keys[row] for row in rows]


def flight_page(
    title: str,
    lines: Sequence[str],
    findings: Mapping[str, Any],
    photos: Sequence[PhotoOnPage],
    pictures: Sequence[Picture],
    left_out: Sequence[tuple[str, str]],
    city: tuple[Floats, NDArray[np.int32]] | None,
    marked: Sequence[Marked],
    view: str = "",
    imagery: Underlay | None = None,
    source: PriorSource = "metadata",
) -> str:
    """Returns the page.

    Args:
        title: Of the page.
        lines: Where the photos are from.
        findings: What the flight says besides poses.
        photos: In the order they were taken.
        pictures: Of them, with their keys.
        left_out: Name and reason of photos that have no pose.
        city: (V, 3) vertices and (T, 3) triangles in the city's coordinates, or None.
        marked: What the flight contradicts in the map.
        view: Address of the page in three dimensions from this one; "" for none.
        imagery: What lies under the map.
        source: What the rough poses are from.
    """
    constants = findings.get("constants", {})
    spots = [photo.spot for photo in photos]
    has_earth = any(photo.surveyed["latitude_deg"] is not None for photo in photos)
    vertices, triangles = (None, None) if city is None else city
    return rendered(
        "flight.html.jinja",
        title=title,
        lines=lines,
        photos=photos,
        legend=columns_legend(
            any(photo.probability is not None for photo in photos), any(p.score is not None for p in photos)
        ),
        has_earth=has_earth,
        place_heads=tuple(head for head, _, _ in place_columns(has_earth)),
        pictures=pictures,
        counts=trust_counts(spot.trust for spot in spots),
        doubted=any(spot.trust == UNTRUSTED for spot in spots),
        has_why=any(photo.why for photo in photos),
        lost=findings.get("lost", []),
        reasons=findings.get("reasons", {}),
        left_out=left_out,
        map=markup(
            draw_map(spots, vertices, triangles, marked=marked, is_flight=True, view=view, imagery=imagery)
        ),
        constants=constant_rows(constants),
        heights=heights_in_words(constants["height"], source) if "height" in constants else "",
        notes=findings.get("notes", ()),
        map_rows=map_rows(findings),
    )
