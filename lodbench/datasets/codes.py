"""The catalogue of dataset findings, as ``lodbench dataset check`` and the notes of runs name them.

LB50x files and names, LB51x frames and poses, LB52x what the check looks at besides,
LB53x and LB54x parts that contradict each other. An ERROR makes
queries fail or results wrong, a WARNING puts them in doubt, INFO tells what was decided. A code never
changes its meaning and is never reused.
"""

from __future__ import annotations

from lodbench.findings import FindingCode, Severity, catalogue_of

_E, _W, _I = Severity.ERROR, Severity.WARNING, Severity.INFO

FILE_MISSING = FindingCode(500, _E, "A file that a run needs is not there.")
SPLIT_MISSING = FindingCode(501, _W, "The folder of a split is not there; the split is left out.")
NOT_IN_SPLIT = FindingCode(502, _I, "A pose is not listed in the split's file; it is not a query.")
NO_TRUTH = FindingCode(503, _E, "A query has no true pose; it is excluded from recall.")
NO_PRIOR = FindingCode(504, _E, "A query has no prior; it fails.")
NO_CAMERA = FindingCode(505, _E, "A query has no intrinsics; it fails.")
NO_IMAGE = FindingCode(506, _W, "A query has no photo; segmenters that need one fail on it.")
SEVERAL_PRIORS = FindingCode(
    507, _I, "A query has several prior lines; the first is its prior, all are hypotheses."
)
STEM_AMBIGUOUS = FindingCode(
    508, _W, "One per-image file fits the names of two queries, with and without _img."
)
FILE_CHOSEN = FindingCode(509, _I, "Several files could be the priors; the first known one is read.")
TURNED_TO_ENU = FindingCode(510, _I, "Shifted earth-centred coordinates are transformed to east, north, up.")
FRAME_ASSUMED = FindingCode(
    511, _W, "The frame is clear from neither walls nor cameras; east, north, up is assumed."
)
FRAMES_DIFFER = FindingCode(
    512, _W, "City and poses are in different frames; each is transformed separately."
)
POSES_DISAGREE = FindingCode(
    513, _W, "The text file and the per-image file hold different poses; the latter counts."
)
SAME_POSE = FindingCode(514, _W, "Two queries have exactly the same true pose: one is a wrong copy.")
WRONG_DIRECTION = FindingCode(
    515, _E, "Poses see the city only if read as camera to world: they need inverting."
)
CITY_NOT_IN_VIEW = FindingCode(516, _W, "No building of the city model is in view from a true pose.")
BELOW_CITY = FindingCode(517, _W, "A camera lies below the lowest point of the city model.")
NAME_DISAGREES = FindingCode(
    518, _W, "The height or attitude in a synthetic image's name differs from its pose."
)
COUNT_UNEXPECTED = FindingCode(
    520, _W, "The number of queries in a split differs from what the paper's percentages imply."
)
CHECKSUM_DIFFERS = FindingCode(521, _W, "A file is not the published one: its SHA-256 differs.")
IMAGE_SIZE = FindingCode(522, _E, "The size of an image differs from its intrinsics.")
IMAGE_UNREADABLE = FindingCode(523, _E, "An image cannot be read, or has too many pixels to be one.")
GPS_IN_IMAGE = FindingCode(
    524, _W, "A photo carries its GPS position; strip it before you publish the photo."
)
PRIORS_UNLIKE_PAPER = FindingCode(
    525, _W, "The priors' median errors differ from the paper's by more than 10 %."
)
MASK_UNFIT = FindingCode(
    526, _E, "A mask, or labels of buildings, cannot be read, or its aspect ratio is not the photo's."
)
CRS_DIFFERS = FindingCode(527, _E, "Dataset and city model have different reference systems.")
PRIOR_FAR = FindingCode(528, _E, "A prior lies kilometres outside the city model; its query fails.")
KEY_TWICE = FindingCode(529, _E, "Duplicate names of queries in a split; nothing runs on them.")
FIELD_OF_VIEW = FindingCode(530, _E, "A camera's field of view is implausible; its query fails.")
PRINCIPAL_EXCHANGED = FindingCode(531, _E, "A camera's cx and cy are exchanged; its query fails.")
PRINCIPAL_POINT = FindingCode(532, _W, "A camera's principal point is far from the middle of the photo.")
FOCAL_UNLIKE_PHOTO = FindingCode(533, _W, "The focal length in a photo's EXIF differs from its camera's.")
CAMERA_UNLIKE_VIEW = FindingCode(
    534, _E, "A mask or photo fits the city from its true pose only with different intrinsics."
)
MASK_TURNED = FindingCode(
    535, _E, "A mask fits the city from its true pose only mirrored, turned or inverted."
)
MASK_EXCHANGED = FindingCode(
    536, _E, "A mask belongs to another query: it fits the city from that one's true pose."
)
MASK_UNLIKE_CITY = FindingCode(
    537, _W, "A mask fits the city poorly from its true pose: pose, mask or map is wrong."
)
PHOTO_TWICE = FindingCode(538, _E, "Queries with different poses have the same photo.")
PHOTO_EXCHANGED = FindingCode(
    539, _E, "A photo belongs to another query: its edges fit the city from that one's true pose."
)
TRUTH_LIKE_PLAN = FindingCode(
    540,
    _W,
    "True poses are as regular as a flight plan; those of real flights are not.",
)
TRUTH_OFF_GPS = FindingCode(541, _W, "True poses are far from their photos' GPS positions.")
PHOTO_UNLIKE_CITY = FindingCode(542, _W, "Photos show no edges at the city's outlines from the true poses.")
UNLIKE_RECONSTRUCTION = FindingCode(
    543, _W, "A true pose differs from the dataset's reconstruction, or that cannot be read."
)
READING_INFERRED = FindingCode(
    544, _I, "Something that the dataset's documentation does not state was inferred from the data."
)
READING_CONTRADICTED = FindingCode(
    545, _W, "The data contradicts a setting for something that its documentation does not state."
)
HEIGHTS_UNLIKE = FindingCode(
    546, _E, "Cameras are not as high above the city's ground as they can be: another vertical datum."
)

CATALOGUE = catalogue_of(globals())
