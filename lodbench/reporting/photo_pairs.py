"""Two runs photo by photo: what a page shows of each photo, as rows, pictures and a map."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from lodbench.evaluation.pose_errors import Apart, PoseError
from lodbench.reporting.answers import percent_text, probability_text
from lodbench.reporting.maps import Spot
from lodbench.reporting.page import Picture, markup, rendered

# What lies over a photo, from below, and whether it is shown at first.
LAYERS = (
    ("mask", False), ("mask_a", False), ("mask_b", False), ("prior", False), ("truth", True), ("a", True),
    ("b", True),
)  # fmt: skip


class Said(NamedTuple):
    """What a run says of a photo.

    Attributes:
        is_answered: Whether it has a pose.
        error: From the truth, (inf, 180) without a pose; None where there is no truth.
        probability: That the pose is within 2 m and 2 degrees; 0 without one; None where nobody says.
        trust: In a word.
        view: Address of the photo in the run's page in three dimensions; "" for none.
    """

    is_answered: bool
    error: PoseError | None
    probability: float | None
    trust: str
    view: str


class PhotoPair(NamedTuple):
    """A photo that two runs, A and B, worked on.

    Attributes:
        key: ``split/query``.
        apart: How far the answer of B lies from that of A; None unless both have one.
        a: What run A says.
        b: What run B says.
        spot: Where the cameras are on the map.
        pictures: The photo, and what lies over it by a name of ``LAYERS``; empty for no picture.
    """

    key: str
    apart: Apart | None
    a: Said
    b: Said
    spot: Spot
    pictures: Mapping[str, Picture]

    @property
    def distance_m(self) -> float:
        """Returns how far the answers lie apart; infinite if one is missing, NaN if both are."""
        if self.apart is not None:
            return self.apart.error.translation_m
        return math.inf if self.a.is_answered or self.b.is_answered else math.nan

    @property
    def caption(self) -> str:
        """Returns what is said below its picture."""
        words = [f"{name}: {_words_of(said)}" for name, said in (("A", self.a), ("B", self.b))]
        if self.apart is not None:
            (metres, degrees), parts = self.apart
            words.insert(
                0,
                f"{metres:.2f} m and {degrees:.2f} deg apart, {parts.horizontal_m:.2f} m in plan, "
                f"B {abs(parts.vertical_m):.2f} m {'higher' if parts.vertical_m >= 0 else 'lower'}",
            )
        return f"{self.key}: {'; '.join(words)}"


class Cell(NamedTuple):
    """A cell of the table: its text, and the number it sorts by; None for a text."""

    text: str
    value: float | None = None


class Column(NamedTuple):
    """A column of the table.

    Attributes:
        name: In the page's script.
        head: What is above it.
        title: What the head means, in full.
        test: What a reader may ask of it: ``least``, ``most`` or ``is``; "" for nothing.
        cell: Returns the cell of a photo.
    """

    name: str
    head: str
    title: str
    test: str
    cell: Callable[[PhotoPair], Cell]


def in_order(pairs: Sequence[PhotoPair]) -> list[PhotoPair]:
    """Returns photos with one answer, then those whose answers lie furthest apart, those with none last."""
    return sorted(pairs, key=lambda pair: (math.isnan(pair.distance_m), -_known(pair.distance_m), pair.key))


def columns_of(pairs: Sequence[PhotoPair]) -> list[Column]:
    """Returns the columns that hold anything."""
    return [
        column
        for column in _COLUMNS
        if column.name == "photo" or any(column.cell(pair).text != "-" for pair in pairs)
    ]


def photo_pairs_section(
    pairs: Sequence[PhotoPair],
    names: tuple[str, str],
    map_html: str,
    notes: Sequence[str],
    tags: Mapping[str, Any],
) -> str:
    """Returns the part of a page that shows two runs photo by photo, as HTML.

    Args:
        pairs: The photos, in the order of the rows.
        names: Of run A and run B.
        map_html: The map (``draw_map``); "" for none.
        notes: What a reader should know of the pictures.
        tags: What the page's script needs of tags: ``of`` names the photos for the browser's memory,
            ``dataset`` and ``version`` are written into the file ``file``, ``tags`` are by key.
    """
    columns = columns_of(pairs)
    called = {"a": f"A {names[0]}", "b": f"B {names[1]}", "mask_a": "mask of A", "mask_b": "mask of B"}
    return rendered(
        "photo_pairs.html.jinja",
        names=names,
        furthest=max((p for p in pairs if p.apart is not None), key=lambda p: p.distance_m, default=None),
        alone=sum(math.isinf(pair.distance_m) for pair in pairs),
        pairs=pairs,
        columns=columns,
        rows=[(pair, [column.cell(pair) for column in columns]) for pair in pairs],
        choices={c.name: sorted({c.cell(pair).text for pair in pairs}) for c in columns if c.test == "is"},
        layers=[
            (name, called.get(name, name), is_shown)
            for name, is_shown in LAYERS
            if any(name in pair.pictures for pair in pairs)
        ],
        order=[name for name, _ in LAYERS],
        has_views=any(pair.a.view or pair.b.view for pair in pairs),
        map=markup(map_html),
        notes=notes,
        tags_file=tags["file"],
        # No text of a file ends the script that it stands in.
        tags=markup(json.dumps(tags, ensure_ascii=True).replace("<", "\\u003c")),
    )


def _known(value: float) -> float:
    return 0.0 if math.isnan(value) else value


def _words_of(said: Said) -> str:
    if not said.is_answered:
        return "no answer"
    words = [] if said.error is None else ["{:.2f} m and {:.2f} deg off".format(*said.error)]
    words += [] if said.probability is None else [f"probability {percent_text(said.probability)}"]
    return ", ".join([*words, *([] if said.trust == "-" else [said.trust])]) or "answered"


def _number(value: float | None, spec: str = ".2f", sorts_by: float | None = None) -> Cell:
    """Returns a number as a cell; "-" where it is not known, "failed" where it is infinite."""
    if value is None or math.isnan(value):
        return Cell("-")
    if math.isinf(value):
        return Cell("failed", value)
    return Cell(format(value, spec), value if sorts_by is None else sorts_by)


def _sure(probability: float | None) -> Cell:
    return Cell("-") if probability is None else Cell(probability_text(probability), probability)


def _apart_cell(part: Callable[[Apart], float], spec: str = ".2f") -> Callable[[PhotoPair], Cell]:
    def cell(pair: PhotoPair) -> Cell:
        if pair.apart is not None:
            return _number(part(pair.apart), spec, abs(part(pair.apart)))
        if not (pair.a.is_answered or pair.b.is_answered):
            return Cell("-")
        # An answer that the other run lacks is no small difference.
        return Cell("only A" if pair.a.is_answered else "only B", math.inf)

    return cell


def _said_columns(name: str) -> list[Column]:
    def said(pair: PhotoPair) -> Said:
        return pair.a if name == "A" else pair.b

    def error(part: int) -> Callable[[PhotoPair], Cell]:
        def cell(pair: PhotoPair) -> Cell:
            found = said(pair).error
            if found is None:
                return Cell("-")
            return Cell("failed", math.inf) if math.isinf(found[0]) else _number(found[part])

        return cell

    key = name.lower()
    return [
        Column(f"error_{key}", f"error {name} m", f"error of {name}, m", "least", error(0)),
        Column(f"turned_{key}", f"error {name} deg", f"error of {name}, deg", "", error(1)),
    ]


def _worse(pair: PhotoPair) -> Cell:
    """Returns how much further B is from the truth than A."""
    if pair.a.error is None or pair.b.error is None:
        return Cell("-")
    # Where both failed neither is worse.
    is_same = pair.a.error[0] == pair.b.error[0]
    return _number(0.0 if is_same else pair.b.error[0] - pair.a.error[0], "+.2f")


_COLUMNS = (
    Column("photo", "photo", "photo", "", lambda pair: Cell(pair.key)),
    Column("apart", "apart m", "answers apart, m", "least", _apart_cell(lambda d: d.error.translation_m)),
    Column("turned", "apart deg", "answers apart, deg", "least", _apart_cell(lambda d: d.error.rotation_deg)),
    Column("plan", "in plan m", "apart in plan, m", "", _apart_cell(lambda d: d.parts.horizontal_m)),
    Column("height", "in height m", "B above A, m", "", _apart_cell(lambda d: d.parts.vertical_m, "+.2f")),
    *_said_columns("A"),
    *_said_columns("B"),
    Column("worse", "B worse by m", "B worse by, m", "least", _worse),
    Column("sure_a", "prob. A", "probability of A", "most", lambda pair: _sure(pair.a.probability)),
    Column("sure_b", "prob. B", "probability of B", "most", lambda pair: _sure(pair.b.probability)),
    Column("trust_a", "trust A", "trust in A", "is", lambda pair: Cell(pair.a.trust)),
    Column("trust_b", "trust B", "trust in B", "is", lambda pair: Cell(pair.b.trust)),
)
