"""The catalogue of dataset findings, as ``lodbench dataset check`` and the notes of runs name them.

LB50x files and names, LB51x frames and poses, LB52x what the check looks at besides,
LB53x and LB54x parts that contradict each other. An ERROR makes
queries fail or results wrong, a WARNING puts them in doubt, INFO states what was decided. A code never
changes its meaning and is never reused.
"""

from __future__ import annotations

from lodbench.findings import Severity, catalogue_of, graded

_E, _W, _I = graded(Severity.ERROR), graded(Severity.WARNING), graded(Severity.INFO)

FILE_MISSING = _E(500, "A file that a run needs is not there.")
SPLIT_MISSING = _W(501, "The folder of a split is not there; the split is left out.")
NOT_IN_SPLIT = _I(502, "A pose is not listed in the split's file; it is not a query.")
NO_TRUTH = _E(503, "A query has no true pose; it is excluded from recall.")
NO_PRIOR = _E(504, "A query has no prior; it fails.")
NO_CAMERA = _E(505, "A query has no intrinsics; it fails.")
NO_IMAGE = _W(506, "A query has no photo; segmenters that need one fail on it.")
SEVERAL_PRIORS = _I(507, "A query has several prior lines; the first is its prior, all are hypotheses.")
STEM_AMBIGUOUS = _W(508, "One per-image file fits the names of two queries, with and without _img.")
FILE_CHOSEN = _I(509, "Several files could be the priors; the first known one is read.")
TURNED_TO_ENU = _I(510, "Shifted earth-centred coordinates are transformed to east, north, up.")
FRAME_ASSUMED = _W(511, "The frame is clear from neither walls nor cameras; east, north, up is assumed.")
FRAMES_DIFFER = _W(512, "City and poses are in different frames; each is transformed separately.")
POSES_DISAGREE = _W(513, "The text file and the per-image file hold different poses; the latter counts.")
SAME_POSE = _W(514, "Two queries have exactly the same true pose: one is a wrong copy.")
WRONG_DIRECTION = _E(515, "Poses see the city only if read as camera to world: they need inverting.")
CITY_NOT_IN_VIEW = _W(516, "No building of the city model is in view from a true pose.")
BELOW_CITY = _W(517, "A camera lies below the lowest point of the city model.")
NAME_DISAGREES = _W(518, "The height or attitude in a synthetic image's name differs from its pose.")
COUNT_UNEXPECTED = _W(
    520, "The number of queries in a split differs from what the paper's percentages imply."
)
CHECKSUM_DIFFERS = _W(521, "A file is not the published one: its SHA-256 differs.")
IMAGE_SIZE = _E(522, "The size of an image differs from its intrinsics.")
IMAGE_UNREADABLE = _E(523, "An image cannot be read, or has too many pixels to be one.")
GPS_IN_IMAGE = _W(524, "A photo carries its GPS position; strip it before you publish the photo.")
PRIORS_UNLIKE_PAPER = _W(525, "The priors' median errors differ from the paper's by more than 10 %.")
MASK_UNFIT = _E(
    526, "A mask, or labels of buildings, cannot be read, or its aspect ratio is not the photo's."
)
CRS_DIFFERS = _E(527, "Dataset and city model have different reference systems.")
PRIOR_FAR = _E(528, "A prior lies kilometres outside the city model; its query fails.")
KEY_TWICE = _E(529, "Duplicate names of queries in a split; nothing runs on them.")
FIELD_OF_VIEW = _E(530, "A camera's field of view is implausible; its query fails.")
PRINCIPAL_EXCHANGED = _E(531, "A camera's cx and cy are exchanged; its query fails.")
PRINCIPAL_POINT = _W(532, "A camera's principal point is far from the middle of the photo.")
FOCAL_UNLIKE_PHOTO = _W(533, "The focal length in a photo's EXIF differs from its camera's.")
CAMERA_UNLIKE_VIEW = _E(
    534, "A mask or photo fits the city from its true pose only with different intrinsics."
)
MASK_TURNED = _E(535, "A mask fits the city from its true pose only mirrored, turned or inverted.")
MASK_EXCHANGED = _E(536, "A mask belongs to another query: it fits the city from that one's true pose.")
MASK_UNLIKE_CITY = _W(537, "A mask fits the city poorly from its true pose: pose, mask or map is wrong.")
PHOTO_TWICE = _E(538, "Queries with different poses have the same photo.")
PHOTO_EXCHANGED = _E(
    539, "A photo belongs to another query: its edges fit the city from that one's true pose."
)
TRUTH_LIKE_PLAN = _W(540, "True poses are as regular as a flight plan; those of real flights are not.")
TRUTH_OFF_GPS = _W(541, "True poses are far from their photos' GPS positions.")
PHOTO_UNLIKE_CITY = _W(542, "Photos show no edges at the city's outlines from the true poses.")
UNLIKE_RECONSTRUCTION = _W(
    543, "A true pose differs from the dataset's reconstruction, or that cannot be read."
)
READING_INFERRED = _I(
    544, "Something that the dataset's documentation does not state was inferred from the data."
)
READING_CONTRADICTED = _W(
    545, "The data contradicts a setting for something that its documentation does not state."
)
HEIGHTS_UNLIKE = _E(
    546, "Cameras are not as high above the city's ground as they can be: another vertical datum."
)

CATALOGUE = catalogue_of(globals())
