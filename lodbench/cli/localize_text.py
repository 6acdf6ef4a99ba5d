"""What `lodbench localize` prints."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

from lodbench.geometry.angles import look_from_rotation
from lodbench.photos.map_frame import survey_sigmas
from lodbench.reporting import aligned_text, flight_words, table_heads
from lodbench.reporting.answers import percent_text, probability_text, trust_counts, trust_word

if TYPE_CHECKING:
    from lodbench.harness.photo.localize import LocalizedPhoto
    from lodbench.harness.photo.many import Answers, PhotoAnswer

# Lines about single answers that are not to be trusted: more stand in the table.
_MOST_DOUBTS = 10
# Photos named on a line about all that failed alike; the table has every one.
_MOST_NAMED = 3


def describe_many(answers: Answers, has_masks: bool) -> str:
    """Returns what flights say, a line per photo, what failed and why, and how many are to be trusted.

    Args:
        answers: Of the photos.
        has_masks: Whether masks were given, which may be mended.
    """
    lines = [] if not answers.flights else [*_flight_lines(answers), ""]
    lines += [_photo_table(answers), ""]
    lines += _failure_lines(answers)
    lines += [f"hint: {hint}" for hint in dict.fromkeys(filter(None, (a.hint for a in answers.photos)))]
    shared = [set(localized.notes) for localized in answers.localized]
    lines += [f"note: {note}" for note in sorted(set.intersection(*shared))] if shared else []
    lines += _doubt_lines(answers)
    doubted = sum(not localized.is_trusted for localized in answers.localized)
    counts = trust_counts(answer.trust for answer in answers.photos)
    lines.append(f"{aligned_text.count_of(len(answers.photos), 'photos')}: {counts}")
    if doubted:
        helps = (
            "correct their masks (lodbench mask PHOTO)" if has_masks else "add a mask for each (--masks DIR)"
        )
        # Flights look as far as they must.
        farther = (
            ""
            if answers.flights
            else "; widen the search if the rough pose may be far off (--prior-range, --prior-yaw)"
        )
        lines.append(
            f"Check the overlays of poses that are not to be trusted. What helps most: {helps}{farther}."
        )
    files = [("table", answers.table), ("map", answers.map), ("", answers.geopackage)]
    files += [("page", answers.page(flight)) for flight in answers.flights]
    files += [("in 3D", answers.view)] if answers.localized else []
    return "\n".join([*lines, *(f"{name + ':' if name else '':<9} {path}" for name, path in files)]) + "\n"


def _photo_table(answers: Answers) -> str:
    """Returns a line per photo: its place on Earth, or in the city's coordinates where that is not known."""
    is_local = bool(answers.localized) and all(localized.place is None for localized in answers.localized)
    columns = [*flight_words.place_columns(not is_local), ("moved m", "moved_m", "z.2f")]
    rows = [["", *(head for head, _, _ in columns), "sure", "trust"]]
    for answer in answers.photos:
        row = answer.row()
        texts = ["-" if row[name] is None else format(row[name], spec) for _, name, spec in columns]
        sure = "-" if row["probability"] is None else probability_text(row["probability"])
        rows.append([aligned_text.plain_text(str(answer.photo)), *texts, sure, answer.trust])
    return aligned_text.format_columns(rows)


def _failure_lines(answers: Answers) -> list[str]:
    """Returns why photos have no pose: a line per reason, with the photos that have it alike."""
    alike: dict[str, list[PhotoAnswer]] = defaultdict(list)
    for answer in answers.photos:
        if answer.localized is None:
            alike[answer.failure.replace(answer.photo.name, "the photo")].append(answer)
    lines = []
    for reason, failed in alike.items():
        names = ", ".join(str(answer.photo) for answer in failed[:_MOST_NAMED])
        if len(failed) == 1:
            words = f"{names}: {failed[0].failure}"
        else:
            more = ", ..." if len(failed) > _MOST_NAMED else ""
            words = f"{aligned_text.count_of(len(failed), 'photos')} ({names}{more}): {reason}"
        lines.append(f"failed: {aligned_text.plain_text(words)}")
    return lines


def _doubt_lines(answers: Answers) -> list[str]:
    """Returns what the method says of answers that are not to be trusted: why they may be wrong."""
    doubted = [
        (a.photo, a.localized)
        for a in answers.photos
        if a.localized is not None and not a.localized.is_trusted
    ]
    lines = [
        aligned_text.plain_text(f"{photo}: {note}")
        for photo, answer in doubted
        for note in answer.method_notes
    ]
    more = len(lines) - _MOST_DOUBTS
    return lines if more <= 0 else [*lines[:_MOST_DOUBTS], f"and {more} more such notes in the table"]


def _flight_lines(answers: Answers) -> list[str]:
    """Returns what each flight was taken with, and what it says of drone and map."""
    lines = []
    for flight in answers.flights:
        first, *more = map(aligned_text.plain_text, (*flight.taken, *flight.sentences()))
        lines += [f"{flight.name}: {first}", *(f"  {line}" for line in more)]
    return lines


def describe(localized: LocalizedPhoto) -> str:
    """Returns the report."""
    x, y, z = (float(v) for v in localized.pose.center)
    lens = (
        "" if localized.lens_percent is None else f", its focal length good to {localized.lens_percent:.1f} %"
    )
    rows = [
        *_place_rows(localized),
        ("local", f"{x:.2f} {y:.2f} {z:.2f} m in {localized.crs or 'the frame of the city model'}"),
        ("prior", f"{localized.moved.translation_m:.2f} m and {localized.moved.rotation_deg:.2f} deg away"),
        *_trust_rows(localized),
        ("with", f"LoD {localized.lod or 'unnamed'} of the map; camera: {localized.camera_source}{lens}"),
        ("overlay", str(localized.overlay)),
        ("in 3D", str(localized.view)),
    ]
    if localized.geojson is not None:
        rows.append(("map", str(localized.geojson)))
    lines = [localized.photo, *(f"  {name:<9}  {text}" for name, text in rows)]
    return "\n".join([*lines, *(f"  note: {note}" for note in localized.notes)])


def _place_rows(localized: LocalizedPhoto) -> list[tuple[str, str]]:
    """Returns where on Earth the camera is, if anybody knows, and where it looks."""
    place = localized.place
    if place is None:
        return [("heading", _look_words(*look_from_rotation(localized.pose.rotation), "grid"))]
    return [
        ("latitude", f"{place.latitude_deg:.7f}"),
        ("longitude", f"{place.longitude_deg:.7f}"),
        ("height", f"{place.height_m:.2f} m, in the city's heights"),
        ("heading", _look_words(place.heading_deg, place.pitch_deg, place.roll_deg, "true")),
    ]


def _look_words(heading_deg: float, pitch_deg: float, roll_deg: float, north: str) -> str:
    # A heading just west of north would be printed as 360.
    heading = round(heading_deg, 2) % 360.0
    return f"{heading:.2f} deg clockwise from {north} north, pitch {pitch_deg:z.2f}, roll {roll_deg:z.2f}"


def _trust_rows(localized: LocalizedPhoto) -> list[tuple[str, str]]:
    """Returns how sure the method is, and the next best pose."""
    rows = []
    if localized.probability is None:
        rows.append(("sure", "this method does not say"))
        rows.append(
            (
                "score",
                f"{table_heads.finite_text(localized.score, '.3f')}, the method's own measure: "
                "higher is better",
            )
        )
    else:
        percent = f"{percent_text(localized.probability)} within 2 m and 2 deg"
        rows.append(("sure", f"{percent}: {trust_word(localized.probability)}"))
    if localized.covariance is not None:
        x, y, z, *turns = survey_sigmas(localized.pose, localized.covariance)
        heading, pitch, roll = (f"{turn:.2f}" for turn in turns)
        place = f"{x:.2f} {y:.2f} {z:.2f} m"
        rows.append(("sigmas", f"{place}; heading {heading}  pitch {pitch}  roll {roll} deg"))
    if localized.alternatives:
        away = localized.alternatives[0].center - localized.pose.center
        x, y, z = (float(v) for v in away)
        how = "(worse fit)"
        if localized.alternative_probabilities:
            how = f"({percent_text(localized.alternative_probabilities[0])})"
        rows.append(("2nd best", f"{x:+.1f} {y:+.1f} {z:+.1f} m from there {how}"))
    return rows
