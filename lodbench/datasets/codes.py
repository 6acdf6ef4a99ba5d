"""The catalogue of dataset findings, as ``lodbench dataset check`` and the notes of runs name them.

LB50x files and names, LB51x frames and poses, LB52x what the check looks at besides. An ERROR makes
queries fail or results wrong, a WARNING puts them in doubt, INFO tells what was decided. A code never
changes its meaning and is never reused.
"""

from __future__ import annotations

from lodbench.findings import FindingCode, Severity

CATALOGUE: dict[str, FindingCode] = {}


def _code(number: int, name: str, severity: Severity, meaning: str) -> FindingCode:
    code = FindingCode(f"LB{number}", name, severity, meaning)
    CATALOGUE[code.code] = code
    return code


_E, _W, _I = Severity.ERROR, Severity.WARNING, Severity.INFO

FILE_MISSING = _code(500, "FILE_MISSING", _E, "A file that a run needs is not there.")
SPLIT_MISSING = _code(501, "SPLIT_MISSING", _W, "The folder of a split is not there; the split is left out.")
NOT_IN_SPLIT = _code(502, "NOT_IN_SPLIT", _I, "A pose is not listed in the split's file; it is no query.")
NO_TRUTH = _code(503, "NO_TRUTH", _E, "A query has no true pose; it is in no denominator.")
NO_PRIOR = _code(504, "NO_PRIOR", _E, "A query has no prior; it fails.")
NO_CAMERA = _code(505, "NO_CAMERA", _E, "A query has no intrinsics; it fails.")
NO_IMAGE = _code(506, "NO_IMAGE", _W, "A query has no photo; segmenters that need one fail on it.")
SEVERAL_PRIORS = _code(
    507, "SEVERAL_PRIORS", _I, "A query has several prior lines; the first is its prior, all are hypotheses."
)
STEM_AMBIGUOUS = _code(
    508, "STEM_AMBIGUOUS", _W, "One per-image file fits the names of two queries, with and without _img."
)
FILE_CHOSEN = _code(509, "FILE_CHOSEN", _I, "Several files could be the priors; the first known one is read.")
TURNED_TO_ENU = _code(
    510, "TURNED_TO_ENU", _I, "Shifted earth-centred coordinates are turned to east, north, up."
)
FRAME_ASSUMED = _code(
    511, "FRAME_ASSUMED", _W, "Neither walls nor cameras tell the frame; east, north, up is assumed."
)
FRAMES_DIFFER = _code(
    512, "FRAMES_DIFFER", _W, "City and poses come in different frames; each is turned on its own."
)
POSES_DISAGREE = _code(
    513, "POSES_DISAGREE", _W, "The text file and the per-image file hold different poses; the latter counts."
)
SAME_POSE = _code(514, "SAME_POSE", _W, "Two queries have exactly the same true pose: one is a wrong copy.")
WRONG_DIRECTION = _code(
    515, "WRONG_DIRECTION", _E, "Poses see the city only if read camera to world: they are the wrong way."
)
CITY_NOT_IN_VIEW = _code(516, "CITY_NOT_IN_VIEW", _W, "A true pose sees no building of the city model.")
BELOW_CITY = _code(517, "BELOW_CITY", _W, "A camera lies below the lowest point of the city model.")
NAME_DISAGREES = _code(
    518, "NAME_DISAGREES", _W, "A synthetic image's name states another height or attitude than its pose."
)
COUNT_UNEXPECTED = _code(
    520, "COUNT_UNEXPECTED", _W, "A split has another number of queries than the paper's percentages imply."
)
CHECKSUM_DIFFERS = _code(521, "CHECKSUM_DIFFERS", _W, "A file is not the published one: its SHA-256 differs.")
IMAGE_SIZE = _code(522, "IMAGE_SIZE", _E, "An image has another size than its intrinsics.")
IMAGE_UNREADABLE = _code(
    523, "IMAGE_UNREADABLE", _E, "An image cannot be read, or has too many pixels to be one."
)
GPS_IN_IMAGE = _code(
    524, "GPS_IN_IMAGE", _W, "A photo carries its GPS position; strip it before you publish the photo."
)
PRIORS_UNLIKE_PAPER = _code(
    525, "PRIORS_UNLIKE_PAPER", _W, "The priors' median errors differ from the paper's by more than 10 %."
)
MASK_UNFIT = _code(526, "MASK_UNFIT", _E, "A mask cannot be read, or has another aspect than its photo.")
CRS_DIFFERS = _code(
    527, "CRS_DIFFERS", _E, "The dataset states another reference system than its city model has."
)
PRIOR_FAR = _code(528, "PRIOR_FAR", _E, "A prior lies kilometres outside the city model; its query fails.")
