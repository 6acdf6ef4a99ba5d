"""The catalogue of city model findings: one stable code per kind of defect, in groups of hundred.

LB1xx rings and polygons, LB2xx the structure of a file, LB3xx coordinate reference systems and
heights, LB4xx buildings and levels of detail, LB6xx solids, LB7xx surface models (LB5xx are of
datasets). A code never changes its meaning and is never reused; new kinds get the next free number. An
ERROR lost data, a WARNING changed it or doubts it, INFO states what was decided.
"""

from __future__ import annotations

from lodbench.findings import FindingCode, Severity, catalogue_of

_E, _W, _I = Severity.ERROR, Severity.WARNING, Severity.INFO

RING_TOO_SHORT = FindingCode(
    101, _W, "A ring has fewer than three distinct points, so no area; it is dropped."
)
DUPLICATE_POINTS = FindingCode(102, _W, "A ring repeats a point in a row; the repeats are removed.")
RING_NOT_CLOSED = FindingCode(103, _W, "The last point of a GML ring is not its first; it is closed.")
ZERO_AREA = FindingCode(104, _W, "A polygon has no area (its points lie on a line); it gets no triangles.")
NOT_PLANAR = FindingCode(105, _W, "A corner of a polygon lies 1 cm to 1 m off its mean plane.")
AREA_MISMATCH = FindingCode(
    106, _E, "The triangles of a polygon do not add up to its area (it crosses itself)."
)
BAD_COORDINATE = FindingCode(107, _E, "A coordinate is not a finite number; the polygon is dropped.")
BAD_COUNT = FindingCode(
    108, _E, "A ring's number of coordinates does not fit its dimension; the polygon is dropped."
)
DUPLICATE_POLYGON = FindingCode(109, _W, "Duplicate polygon in one building and level; one copy kept.")
RING_2D = FindingCode(110, _I, "A ring has no heights; z is 0.")
FAR_FROM_PLANAR = FindingCode(
    111, _E, "A corner of a polygon lies over 1 m off its mean plane: its shape is a guess."
)
RING_SELF_CONTACT = FindingCode(112, _W, "A ring touches or crosses itself.")
RINGS_INTERSECT = FindingCode(113, _W, "Two rings of a polygon cross.")
RINGS_EQUAL = FindingCode(114, _W, "Two rings of a polygon are the same.")
INTERIOR_SPLIT = FindingCode(115, _W, "The holes of a polygon cut it in two.")
HOLE_OUTSIDE = FindingCode(116, _W, "A hole of a polygon lies outside of its outline.")
HOLES_NESTED = FindingCode(117, _W, "A hole of a polygon lies inside another.")
HOLE_TURNED = FindingCode(118, _W, "A hole has the same orientation as its outline.")
FOLDED = FindingCode(
    119, _W, "A piece of a polygon is turned from its plane by over 20 degrees, within 1 cm of it."
)

UNDECLARED_PREFIX = FindingCode(201, _W, "XML uses a namespace prefix it never declares.")
XLINK_UNRESOLVED = FindingCode(202, _E, "A reference to a geometry has no target in the file.")
XLINK_REMOTE = FindingCode(203, _E, "A reference points to another file or server; it is never fetched.")
XLINK_CYCLE = FindingCode(204, _W, "References form a cycle; it is broken.")
DUPLICATE_ID = FindingCode(
    205, _W, "Duplicate id; references go to the first object, later ones are renamed."
)
GEOMETRY_UNSUPPORTED = FindingCode(206, _E, "A geometry of a kind that is not read.")
GEOMETRY_EMPTY = FindingCode(207, _I, "A geometry property holds no geometry.")
ELEMENT_IGNORED = FindingCode(208, _I, "An element that carries no surface is ignored.")
NOT_A_BUILDING = FindingCode(209, _I, "A city object that is not a building is left out.")
BAD_INDEX = FindingCode(210, _E, "A face names a point that does not exist; it is dropped.")
FILE_SKIPPED = FindingCode(211, _I, "A file among the tiles is not a city model, or has no building.")
FILE_CUT_OFF = FindingCode(212, _E, "A file is shorter than its header says; what was cut is lost.")
SEMANTICS_MISFIT = FindingCode(213, _W, "Semantic labels do not match the surfaces in nesting or number.")
READER_WARNING = FindingCode(214, _W, "A warning of the library that reads the format.")

CRS_MISSING = FindingCode(301, _W, "No coordinate reference system is declared; taken as metres.")
CRS_UNKNOWN = FindingCode(302, _W, "The declared reference system is not known; taken as metres.")
CRS_IMPLAUSIBLE = FindingCode(
    303, _W, "The coordinates lie outside the area of the declared reference system."
)
AXES_SWAPPED = FindingCode(304, _I, "The axis order differs from that of the declared reference system.")
CRS_PROJECTED = FindingCode(305, _I, "Coordinates were projected to a metric reference system.")
CRS_MAPPED = FindingCode(306, _I, "A non-standard CRS name was mapped to its EPSG code.")
CRS_MIXED = FindingCode(
    307, _W, "One file declares several reference systems; all are transformed to the first."
)
AXES_AMBIGUOUS = FindingCode(308, _W, "Either axis order is plausible; one was taken.")
SCALE_OFF = FindingCode(
    309, _W, "The scale of the declared reference system is off by more than 1e-3 at the data."
)
HEIGHTS_ELLIPSOIDAL = FindingCode(
    310, _I, "Heights are above the ellipsoid, not above the sea; they stay as they are."
)
FAR_AWAY = FindingCode(
    311, _W, "A building lies over 500 km from most others; its coordinates lose precision."
)

LOD_ABSENT = FindingCode(
    401, _W, "A building, or a part of one, has no geometry at the requested level of detail."
)
LOD_SUBSTITUTED = FindingCode(
    402, _I, "The requested level is absent; a subdivision of it (1.2 for 1) is used."
)
BUILDING_EMPTY = FindingCode(403, _W, "A building has no polygon at any level of detail.")
HEIGHT_MISSING = FindingCode(405, _E, "A footprint has no height between 0 and 1000 m; it is dropped.")
HEIGHT_DEFAULTED = FindingCode(
    406, _W, "A footprint has no height between 0 and 1000 m; the default is used."
)
BASE_MOVED = FindingCode(407, _I, "Building bases were moved, as requested.")
LOD_DERIVED = FindingCode(408, _I, "Level 1 was derived from a finer level.")
LOD_UNDERIVABLE = FindingCode(409, _W, "A building has no footprint to derive level 1 from.")
GROUND_DEFAULTED = FindingCode(410, _W, "No column or terrain gives the ground; ground_m is used.")
OPTION_UNUSED = FindingCode(411, _W, "An option has no effect on this format.")
NOT_STANDING = FindingCode(
    412, _I, "A building, or a part of one, does not exist at the reference date; it is left out."
)
CREATED_LATER = FindingCode(
    413, _I, "An object, or the record of it, was created after the reference date; it is kept."
)
STAYS_FLAT = FindingCode(
    414, _W, "A building has a height, but no more than a footprint: it is flat unless level 1 is derived."
)
HEIGHT_NO_DATA = FindingCode(
    415,
    _E,
    "A corner has a no-data height, such as -9999; it is moved to the ground nearby.",
)
UNDERGROUND = FindingCode(416, _I, "A footprint lies below the ground; it is left out.")
INTERIOR_SKIPPED = FindingCode(404, _I, "Rooms, storeys and furniture are left out of the mesh.")

SHELL_TOO_FEW_FACES = FindingCode(601, _W, "A shell of a solid has fewer than four faces.")
SHELL_NOT_CLOSED = FindingCode(602, _W, "A shell has edges with only one face: it is not watertight.")
NON_MANIFOLD_EDGE = FindingCode(603, _W, "A shell has edges that three faces or more share.")
NON_MANIFOLD_VERTEX = FindingCode(604, _W, "A shell touches itself in a point.")
SHELL_IN_PIECES = FindingCode(605, _W, "The faces of a shell are not connected.")
FACE_TURNED = FindingCode(606, _W, "A face of a shell is oriented opposite to its neighbour.")
SHELL_INSIDE_OUT = FindingCode(607, _W, "All faces of a shell have the wrong orientation.")
PARTS_OVERLAP = FindingCode(608, _W, "Two parts of a building overlap.")
SHELL_SELF_INTERSECTION = FindingCode(609, _W, "An edge of a shell passes through a face of it.")
SHELLS_INTERSECT = FindingCode(610, _W, "Two shells of a solid intersect.")
SHELLS_EQUAL = FindingCode(611, _W, "Two shells of a solid have the same corners.")
SHELL_OUTSIDE = FindingCode(612, _W, "A hole of a solid lies outside of it.")
SOLIDS_INTERSECT = FindingCode(613, _W, "Two solids of an object intersect.")
SOLIDS_EQUAL = FindingCode(614, _W, "Two solids of an object have the same corners.")
INTERIOR_DISCONNECTED = FindingCode(615, _W, "The holes of a solid divide its interior.")
SOLIDS_DISCONNECTED = FindingCode(
    616, _W, "The solids of a composite solid do not all share faces with each other."
)

SURFACE_NO_DATA = FindingCode(701, _W, "Cells of a surface model have no height; nothing is drawn there.")
SURFACE_NO_DATUM = FindingCode(
    702, _I, "A surface model names no system of its heights; they are taken as they are."
)
SURFACE_GROUND_ESTIMATED = FindingCode(
    703, _I, "No terrain model is given; the ground is estimated from the surface model."
)
SURFACE_OFFSET = FindingCode(
    704, _W, "Surface and terrain model have no ground in common: their zero heights may differ."
)
SURFACE_STEP = FindingCode(705, _W, "Heights of a surface model jump along a border between its tiles.")
SURFACE_COARSE = FindingCode(706, _W, "Heights of a surface model are written in coarse steps.")
SURFACE_PLANTS = FindingCode(
    707, _I, "What rises above the ground and is no roof is taken as vegetation; it is left out."
)
SURFACE_SIMPLIFIED = FindingCode(708, _I, "A surface model is drawn in plane pieces, within a tolerance.")
SURFACE_NO_ROOF = FindingCode(
    709, _W, "A surface model shows no roof over a footprint; attributes count instead."
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

_CATALOGUE = catalogue_of(globals())


def finding_catalogue() -> tuple[FindingCode, ...]:
    """Returns every code, in order.

    Example:
        >>> str(finding_catalogue()[0])
        'LB101 RING_TOO_SHORT'
    """
    return tuple(_CATALOGUE.values())
