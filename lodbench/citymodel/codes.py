"""The catalogue of city model findings: one stable code per kind of defect, in groups of hundred.

LB1xx rings and polygons, LB2xx the structure of a file, LB3xx coordinate reference systems and
heights, LB4xx buildings and levels of detail, LB6xx solids, LB7xx surface models (LB5xx are of
datasets). A code never changes its meaning and is never reused; new kinds get the next free number. An
ERROR lost data, a WARNING changed it or doubts it, INFO states what was decided.
"""

from __future__ import annotations

from lodbench.findings import FindingCode, Severity, catalogue_of, graded

_E, _W, _I = graded(Severity.ERROR), graded(Severity.WARNING), graded(Severity.INFO)

RING_TOO_SHORT = _W(101, "A ring has fewer than three distinct points, so no area; it is dropped.")
DUPLICATE_POINTS = _W(102, "A ring repeats a point in a row; the repeats are removed.")
RING_NOT_CLOSED = _W(103, "The last point of a GML ring is not its first; it is closed.")
ZERO_AREA = _W(104, "A polygon has no area (its points lie on a line); it gets no triangles.")
NOT_PLANAR = _W(105, "A corner of a polygon lies 1 cm to 1 m off its mean plane.")
AREA_MISMATCH = _E(106, "The triangles of a polygon do not add up to its area (it crosses itself).")
BAD_COORDINATE = _E(107, "A coordinate is not a finite number; the polygon is dropped.")
BAD_COUNT = _E(108, "A ring's number of coordinates does not fit its dimension; the polygon is dropped.")
DUPLICATE_POLYGON = _W(109, "Duplicate polygon in one building and level; one copy kept.")
RING_2D = _I(110, "A ring has no heights; z is 0.")
FAR_FROM_PLANAR = _E(111, "A corner of a polygon lies over 1 m off its mean plane: its shape is a guess.")
RING_SELF_CONTACT = _W(112, "A ring touches or crosses itself.")
RINGS_INTERSECT = _W(113, "Two rings of a polygon cross.")
RINGS_EQUAL = _W(114, "Two rings of a polygon are the same.")
INTERIOR_SPLIT = _W(115, "The holes of a polygon cut it in two.")
HOLE_OUTSIDE = _W(116, "A hole of a polygon lies outside of its outline.")
HOLES_NESTED = _W(117, "A hole of a polygon lies inside another.")
HOLE_TURNED = _W(118, "A hole has the same orientation as its outline.")
FOLDED = _W(119, "A piece of a polygon is turned from its plane by over 20 degrees, within 1 cm of it.")

UNDECLARED_PREFIX = _W(201, "XML uses a namespace prefix it never declares.")
XLINK_UNRESOLVED = _E(202, "A reference to a geometry has no target in the file.")
XLINK_REMOTE = _E(203, "A reference points to another file or server; it is never fetched.")
XLINK_CYCLE = _W(204, "References form a cycle; it is broken.")
DUPLICATE_ID = _W(205, "Duplicate id; references go to the first object, later ones are renamed.")
GEOMETRY_UNSUPPORTED = _E(206, "A geometry of a kind that is not read.")
GEOMETRY_EMPTY = _I(207, "A geometry property holds no geometry.")
ELEMENT_IGNORED = _I(208, "An element that carries no surface is ignored.")
NOT_A_BUILDING = _I(209, "A city object that is not a building is left out.")
BAD_INDEX = _E(210, "A face names a point that does not exist; it is dropped.")
FILE_SKIPPED = _I(211, "A file among the tiles is not a city model, or has no building.")
FILE_CUT_OFF = _E(212, "A file is shorter than its header says; what was cut is lost.")
SEMANTICS_MISFIT = _W(213, "Semantic labels do not match the surfaces in nesting or number.")
READER_WARNING = _W(214, "A warning of the library that reads the format.")

CRS_MISSING = _W(301, "No coordinate reference system is declared; taken as metres.")
CRS_UNKNOWN = _W(302, "The declared reference system is not known; taken as metres.")
CRS_IMPLAUSIBLE = _W(303, "The coordinates lie outside the area of the declared reference system.")
AXES_SWAPPED = _I(304, "The axis order differs from that of the declared reference system.")
CRS_PROJECTED = _I(305, "Coordinates were projected to a metric reference system.")
CRS_MAPPED = _I(306, "A non-standard CRS name was mapped to its EPSG code.")
CRS_MIXED = _W(307, "One file declares several reference systems; all are transformed to the first.")
AXES_AMBIGUOUS = _W(308, "Either axis order is plausible; one was taken.")
SCALE_OFF = _W(309, "The scale of the declared reference system is off by more than 1e-3 at the data.")
HEIGHTS_ELLIPSOIDAL = _I(310, "Heights are above the ellipsoid, not above the sea; they stay as they are.")
FAR_AWAY = _W(311, "A building lies over 500 km from most others; its coordinates lose precision.")

LOD_ABSENT = _W(401, "A building, or a part of one, has no geometry at the requested level of detail.")
LOD_SUBSTITUTED = _I(402, "The requested level is absent; a subdivision of it (1.2 for 1) is used.")
BUILDING_EMPTY = _W(403, "A building has no polygon at any level of detail.")
HEIGHT_MISSING = _E(405, "A footprint has no height between 0 and 1000 m; it is dropped.")
HEIGHT_DEFAULTED = _W(406, "A footprint has no height between 0 and 1000 m; the default is used.")
BASE_MOVED = _I(407, "Building bases were moved, as requested.")
LOD_DERIVED = _I(408, "Level 1 was derived from a finer level.")
LOD_UNDERIVABLE = _W(409, "A building has no footprint to derive level 1 from.")
GROUND_DEFAULTED = _W(410, "No column or terrain gives the ground; ground_m is used.")
OPTION_UNUSED = _W(411, "An option has no effect on this format.")
NOT_STANDING = _I(412, "A building, or a part of one, does not exist at the reference date; it is left out.")
CREATED_LATER = _I(413, "An object, or the record of it, was created after the reference date; it is kept.")
STAYS_FLAT = _W(
    414, "A building has a height, but no more than a footprint: it is flat unless level 1 is derived."
)
HEIGHT_NO_DATA = _E(415, "A corner has a no-data height, such as -9999; it is moved to the ground nearby.")
UNDERGROUND = _I(416, "A footprint lies below the ground; it is left out.")
INTERIOR_SKIPPED = _I(404, "Rooms, storeys and furniture are left out of the mesh.")

SHELL_TOO_FEW_FACES = _W(601, "A shell of a solid has fewer than four faces.")
SHELL_NOT_CLOSED = _W(602, "A shell has edges with only one face: it is not watertight.")
NON_MANIFOLD_EDGE = _W(603, "A shell has edges that three faces or more share.")
NON_MANIFOLD_VERTEX = _W(604, "A shell touches itself in a point.")
SHELL_IN_PIECES = _W(605, "The faces of a shell are not connected.")
FACE_TURNED = _W(606, "A face of a shell is oriented opposite to its neighbour.")
SHELL_INSIDE_OUT = _W(607, "All faces of a shell have the wrong orientation.")
PARTS_OVERLAP = _W(608, "Two parts of a building overlap.")
SHELL_SELF_INTERSECTION = _W(609, "An edge of a shell passes through a face of it.")
SHELLS_INTERSECT = _W(610, "Two shells of a solid intersect.")
SHELLS_EQUAL = _W(611, "Two shells of a solid have the same corners.")
SHELL_OUTSIDE = _W(612, "A hole of a solid lies outside of it.")
SOLIDS_INTERSECT = _W(613, "Two solids of an object intersect.")
SOLIDS_EQUAL = _W(614, "Two solids of an object have the same corners.")
INTERIOR_DISCONNECTED = _W(615, "The holes of a solid divide its interior.")
SOLIDS_DISCONNECTED = _W(616, "The solids of a composite solid do not all share faces with each other.")

SURFACE_NO_DATA = _W(701, "Cells of a surface model have no height; nothing is drawn there.")
SURFACE_NO_DATUM = _I(702, "A surface model names no system of its heights; they are taken as they are.")
SURFACE_GROUND_ESTIMATED = _I(
    703, "No terrain model is given; the ground is estimated from the surface model."
)
SURFACE_OFFSET = _W(704, "Surface and terrain model have no ground in common: their zero heights may differ.")
SURFACE_STEP = _W(705, "Heights of a surface model jump along a border between its tiles.")
SURFACE_COARSE = _W(706, "Heights of a surface model are written in coarse steps.")
SURFACE_PLANTS = _I(707, "What rises above the ground and is no roof is taken as vegetation; it is left out.")
SURFACE_SIMPLIFIED = _I(708, "A surface model is drawn in plane pieces, within a tolerance.")
SURFACE_NO_ROOF = _W(709, "A surface model shows no roof over a footprint; attributes count instead.")

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
