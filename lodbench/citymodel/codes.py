"""The catalogue of city model findings: one stable code per kind of defect, in groups of hundred.

LB1xx rings and polygons, LB2xx the structure of a file, LB3xx coordinate reference systems and
heights, LB4xx buildings and levels of detail, LB6xx solids (LB5xx are of datasets). A code never
changes its meaning and is never reused; new kinds get the next free number. An ERROR lost data, a
WARNING changed it or doubts it, INFO tells what was decided.
"""

from __future__ import annotations

from lodbench.findings import FindingCode, Severity

_CATALOGUE: dict[str, FindingCode] = {}


def _code(number: int, name: str, severity: Severity, meaning: str) -> FindingCode:
    code = FindingCode(f"LB{number}", name, severity, meaning)
    _CATALOGUE[code.code] = code
    return code


_E, _W, _I = Severity.ERROR, Severity.WARNING, Severity.INFO

RING_TOO_SHORT = _code(
    101, "RING_TOO_SHORT", _W, "A ring has fewer than three distinct points, so no area; it is dropped."
)
DUPLICATE_POINTS = _code(
    102, "DUPLICATE_POINTS", _W, "A ring repeats a point in a row; the repeats are removed."
)
RING_NOT_CLOSED = _code(
    103, "RING_NOT_CLOSED", _W, "The last point of a GML ring is not its first; it is closed."
)
ZERO_AREA = _code(
    104, "ZERO_AREA", _W, "A polygon has no area (its points lie on a line); it gets no triangles."
)
NOT_PLANAR = _code(105, "NOT_PLANAR", _W, "A corner of a polygon lies 1 cm to 1 m off its mean plane.")
AREA_MISMATCH = _code(
    106, "AREA_MISMATCH", _E, "The triangles of a polygon do not add up to its area (it crosses itself)."
)
BAD_COORDINATE = _code(
    107, "BAD_COORDINATE", _E, "A coordinate is not a finite number; the polygon is dropped."
)
BAD_COUNT = _code(
    108, "BAD_COUNT", _E, "A ring's number of coordinates does not fit its dimension; the polygon is dropped."
)
DUPLICATE_POLYGON = _code(
    109, "DUPLICATE_POLYGON", _W, "A polygon stands twice in one building at one level; one is kept."
)
RING_2D = _code(110, "RING_2D", _I, "A ring has no heights; z is 0.")
FAR_FROM_PLANAR = _code(
    111,
    "FAR_FROM_PLANAR",
    _E,
    "A corner of a polygon lies over 1 m off its mean plane: its shape is a guess.",
)
RING_SELF_CONTACT = _code(112, "RING_SELF_CONTACT", _W, "A ring touches or crosses itself.")
RINGS_INTERSECT = _code(113, "RINGS_INTERSECT", _W, "Two rings of a polygon cross.")
RINGS_EQUAL = _code(114, "RINGS_EQUAL", _W, "Two rings of a polygon are the same.")
INTERIOR_SPLIT = _code(115, "INTERIOR_SPLIT", _W, "The holes of a polygon cut it in two.")
HOLE_OUTSIDE = _code(116, "HOLE_OUTSIDE", _W, "A hole of a polygon lies outside of its outline.")
HOLES_NESTED = _code(117, "HOLES_NESTED", _W, "A hole of a polygon lies inside another.")
HOLE_TURNED = _code(118, "HOLE_TURNED", _W, "A hole runs the same way round as its outline.")
FOLDED = _code(
    119, "FOLDED", _W, "A piece of a polygon is turned from its plane by over 20 degrees, within 1 cm of it."
)

UNDECLARED_PREFIX = _code(201, "UNDECLARED_PREFIX", _W, "XML uses a namespace prefix it never declares.")
XLINK_UNRESOLVED = _code(202, "XLINK_UNRESOLVED", _E, "A reference to a geometry has no target in the file.")
XLINK_REMOTE = _code(
    203, "XLINK_REMOTE", _E, "A reference points to another file or server; it is never fetched."
)
XLINK_CYCLE = _code(204, "XLINK_CYCLE", _W, "References go round in a circle; the circle is cut.")
DUPLICATE_ID = _code(
    205, "DUPLICATE_ID", _W, "One id names two objects; references go to the first, later ones are renamed."
)
GEOMETRY_UNSUPPORTED = _code(206, "GEOMETRY_UNSUPPORTED", _E, "A geometry of a kind that is not read.")
GEOMETRY_EMPTY = _code(207, "GEOMETRY_EMPTY", _I, "A geometry property holds no geometry.")
ELEMENT_IGNORED = _code(208, "ELEMENT_IGNORED", _I, "An element that carries no surface is ignored.")
NOT_A_BUILDING = _code(209, "NOT_A_BUILDING", _I, "A city object that is no building is left out.")
BAD_INDEX = _code(210, "BAD_INDEX", _E, "A face names a point that does not exist; it is dropped.")
FILE_SKIPPED = _code(211, "FILE_SKIPPED", _I, "A file among the tiles is no city model, or has no building.")
FILE_CUT_OFF = _code(212, "FILE_CUT_OFF", _E, "A file is shorter than its header says; what was cut is lost.")
SEMANTICS_MISFIT = _code(
    213,
    "SEMANTICS_MISFIT",
    _W,
    "Labels of surfaces are nested otherwise than the surfaces, or their number differs.",
)
READER_WARNING = _code(214, "READER_WARNING", _W, "The library that reads the format warns.")

CRS_MISSING = _code(301, "CRS_MISSING", _W, "No coordinate reference system is declared; taken as metres.")
CRS_UNKNOWN = _code(302, "CRS_UNKNOWN", _W, "The declared reference system is not known; taken as metres.")
CRS_IMPLAUSIBLE = _code(
    303, "CRS_IMPLAUSIBLE", _W, "The coordinates lie outside the area of the declared reference system."
)
AXES_SWAPPED = _code(
    304, "AXES_SWAPPED", _I, "The axes stand in another order than the reference system declares."
)
CRS_PROJECTED = _code(305, "CRS_PROJECTED", _I, "Coordinates were projected to a metric reference system.")
CRS_MAPPED = _code(306, "CRS_MAPPED", _I, "The declared name was read as another, by lodbench's own map.")
CRS_MIXED = _code(307, "CRS_MIXED", _W, "One file declares several reference systems; all go to the first.")
AXES_AMBIGUOUS = _code(308, "AXES_AMBIGUOUS", _W, "Either axis order is plausible; one was taken.")
SCALE_OFF = _code(
    309,
    "SCALE_OFF",
    _W,
    "A metre of the declared reference system is off by more than 1e-3 at the data.",
)
HEIGHTS_ELLIPSOIDAL = _code(
    310,
    "HEIGHTS_ELLIPSOIDAL",
    _I,
    "Heights are above the ellipsoid, not above the sea; they stay as they are.",
)

LOD_ABSENT = _code(401, "LOD_ABSENT", _W, "A building has nothing at the level of detail asked for.")
LOD_SUBSTITUTED = _code(
    402, "LOD_SUBSTITUTED", _I, "The level asked for is absent; a finer name of it is used."
)
BUILDING_EMPTY = _code(403, "BUILDING_EMPTY", _W, "A building has no polygon at any level of detail.")
HEIGHT_MISSING = _code(405, "HEIGHT_MISSING", _E, "A footprint has no height above 0; it is dropped.")
HEIGHT_DEFAULTED = _code(
    406, "HEIGHT_DEFAULTED", _W, "A footprint has no height above 0; the default is used."
)
BASE_MOVED = _code(407, "BASE_MOVED", _I, "The bottoms of buildings were moved, as asked.")
LOD_DERIVED = _code(408, "LOD_DERIVED", _I, "Level 1 was derived from a finer level.")
LOD_UNDERIVABLE = _code(409, "LOD_UNDERIVABLE", _W, "A building has no footprint to derive level 1 from.")
GROUND_DEFAULTED = _code(
    410, "GROUND_DEFAULTED", _W, "No column or terrain gives the ground; ground_m is used."
)
INTERIOR_SKIPPED = _code(404, "INTERIOR_SKIPPED", _I, "Rooms and furniture are left out of the mesh.")

SHELL_TOO_FEW_FACES = _code(601, "SHELL_TOO_FEW_FACES", _W, "A shell of a solid has fewer than four faces.")
SHELL_NOT_CLOSED = _code(602, "SHELL_NOT_CLOSED", _W, "A shell has edges that only one face has: it leaks.")
NON_MANIFOLD_EDGE = _code(603, "NON_MANIFOLD_EDGE", _W, "A shell has edges that three faces or more share.")
NON_MANIFOLD_VERTEX = _code(604, "NON_MANIFOLD_VERTEX", _W, "A shell touches itself in a point.")
SHELL_IN_PIECES = _code(605, "SHELL_IN_PIECES", _W, "The faces of a shell do not hang together.")
FACE_TURNED = _code(606, "FACE_TURNED", _W, "A face of a shell looks the other way than its neighbour.")
SHELL_INSIDE_OUT = _code(607, "SHELL_INSIDE_OUT", _W, "The faces of a shell all look the wrong way.")
PARTS_OVERLAP = _code(608, "PARTS_OVERLAP", _W, "Two parts of a building overlap.")
SHELL_SELF_INTERSECTION = _code(
    609, "SHELL_SELF_INTERSECTION", _W, "An edge of a shell passes through a face of it."
)
SHELLS_INTERSECT = _code(610, "SHELLS_INTERSECT", _W, "Two shells of a solid cut each other.")
SHELLS_EQUAL = _code(611, "SHELLS_EQUAL", _W, "Two shells of a solid have the same corners.")
SHELL_OUTSIDE = _code(612, "SHELL_OUTSIDE", _W, "A hole of a solid lies outside of it.")
SOLIDS_INTERSECT = _code(613, "SOLIDS_INTERSECT", _W, "Two solids of an object cut each other.")
SOLIDS_EQUAL = _code(614, "SOLIDS_EQUAL", _W, "Two solids of an object have the same corners.")
INTERIOR_DISCONNECTED = _code(615, "INTERIOR_DISCONNECTED", _W, "The holes of a solid cut its inside in two.")
SOLIDS_DISCONNECTED = _code(
    616, "SOLIDS_DISCONNECTED", _W, "The solids of a composite solid do not all share faces with each other."
)

# The published error codes of val3dity, the usual validator of 3D city models, for what it reports too.
VAL3DITY: dict[FindingCode, str] = {
    RING_TOO_SHORT: "101",
    DUPLICATE_POINTS: "102",
    RING_NOT_CLOSED: "103",
    ZERO_AREA: "104",
    AREA_MISMATCH: "104",
    RING_SELF_CONTACT: "104",
    RINGS_INTERSECT: "201",
    RINGS_EQUAL: "202",
    NOT_PLANAR: "203",
    FAR_FROM_PLANAR: "203",
    FOLDED: "204",
    INTERIOR_SPLIT: "205",
    HOLE_OUTSIDE: "206",
    HOLES_NESTED: "207",
    HOLE_TURNED: "208",
    SHELL_TOO_FEW_FACES: "301",
    SHELL_NOT_CLOSED: "302",
    NON_MANIFOLD_VERTEX: "303",
    NON_MANIFOLD_EDGE: "303",
    SHELL_IN_PIECES: "305",
    SHELL_SELF_INTERSECTION: "306",
    FACE_TURNED: "307",
    SHELLS_INTERSECT: "401",
    SHELLS_EQUAL: "402",
    SHELL_OUTSIDE: "403",
    INTERIOR_DISCONNECTED: "404",
    SHELL_INSIDE_OUT: "405",
    SOLIDS_INTERSECT: "501",
    SOLIDS_EQUAL: "502",
    SOLIDS_DISCONNECTED: "503",
    PARTS_OVERLAP: "601",
    BUILDING_EMPTY: "902",
}


def finding_catalogue() -> tuple[FindingCode, ...]:
    """Returns every code, in order.

    Example:
        >>> str(finding_catalogue()[0])
        'LB101 RING_TOO_SHORT'
    """
    return tuple(_CATALOGUE[code] for code in sorted(_CATALOGUE))
