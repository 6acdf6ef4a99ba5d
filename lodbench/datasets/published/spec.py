"""What can be said of a published dataset: folders, file names in the order they are tried, counts.

Of LoD-Loc's datasets two trees are in use. LoD-Loc's: ``UAVD4L-LoD/inTraj/{Query_image/, GT_pose.txt,
GPS_pose.txt, intrinsic.txt}``, ``UAVD4L-LoD/split/*.json``, ``MODEL/*.obj``. LoD-Loc v2's:
``data/UAVD4L-LoD/inTraj/{query/, dataset_test.txt}``, ``data/all_colmaps/UAVD4L-LoD/inTraj/colmap_320/
{cameras,images}.txt``; the Swiss scenes lie there beside the others. A dataset in a layout of its own lists
its ``parts`` instead.
"""

from __future__ import annotations

from dataclasses import dataclass

from lodbench.geometry.similarity import ShiftedEcef

TRUTH_FILES = ("GT_pose.txt",)
PRIOR_FILES = ("GPS_pose.txt", "GPS_pose_new.txt", "GPS_pose_new_all.txt")
CAMERA_FILES = ("intrinsic.txt",)
IMAGE_FOLDERS = ("Query_image", "query")
MASK_FOLDERS = ("masks", "Mask")
MODEL_FOLDERS = ("MODEL", "model", "")
# Not published with the queries: beside the city model, and beside the splits.
TEXTURED_NAMES = ("textured", "textured.glb", "textured.obj")
REFERENCE_FOLDER = "references"

# Where a folder of datasets may begin below the root: as unpacked, or as either release's code has it.
PREFIXES = ("", "dataset/", "data/")


@dataclass(frozen=True, slots=True)
class SplitSpec:
    """One split.

    Attributes:
        name: Name in tables.
        folders: Where its files lie below the root, in the order tried.
        split_files: Names of its split JSON, in the order tried.
        prior_files: Further names of the file of priors.
        num_queries: Queries of the paper's tables, solved from their percentages; None where unknown.
        prior_median: The paper's median error of the priors, metres and degrees.
        is_test: Whether it is run where no split is named.
    """

    name: str
    folders: tuple[str, ...]
    split_files: tuple[str, ...]
    prior_files: tuple[str, ...] = ()
    num_queries: int | None = None
    prior_median: tuple[float, float] | None = None
    is_test: bool = True


@dataclass(frozen=True, slots=True)
class Host:
    """Where publishers host a part."""

    what: str
    url: str
    how: str


@dataclass(frozen=True, slots=True)
class Download:
    """A file with an address that does not change."""

    url: str
    path: str
    sha256: str
    num_bytes: int


@dataclass(frozen=True, slots=True)
class Part:
    """A file, or files, of a dataset in a layout of its own.

    Attributes:
        place: Below the dataset's folder, as a pattern: ``query_images/val/*``.
        what: In words.
        split: The split that cannot be read without it; "" for none in particular.
        is_needed: Whether queries cannot be made without it.
        media: Its MIME type.
    """

    place: str
    what: str
    split: str = ""
    is_needed: bool = True
    media: str = "text/plain"


@dataclass(frozen=True, slots=True)
class PublishedSpec:
    """One dataset: queries over one city model.

    Attributes:
        id: Name on the command line.
        title: Name in the papers.
        lod: Level of detail of the city model, for people: the files do not say; or what else the map is.
        folder: The folder of the download.
        splits: In the order of the papers' tables.
        hosts: Where to get it.
        city_files: Names of the city model, in the order tried; patterns where there are ``parts``.
        unreadable_city_files: Names of it in formats that are not read.
        ecef: The frame its files may come in besides east, north, up.
        photo_crs: CRS of which the local frame is a shift, to place photos by their GPS.
        downloads: What can be fetched by itself.
        parts: Files of a layout of its own; empty for LoD-Loc's.
        protocol: Name of its bins and metrics, of ``lodbench.evaluation.protocols``.
        year: Of its publication.
        camera_height_m: Between which heights above the ground its cameras are; None where not stated.
    """

    id: str
    title: str
    lod: str
    folder: str
    splits: tuple[SplitSpec, ...]
    hosts: tuple[Host, ...]
    city_files: tuple[str, ...] = ()
    unreadable_city_files: tuple[str, ...] = ()
    ecef: ShiftedEcef | None = None
    photo_crs: str | None = None
    downloads: tuple[Download, ...] = ()
    parts: tuple[Part, ...] = ()
    protocol: str = "lodloc"
    year: str = "2024"
    camera_height_m: tuple[float, float] | None = None

    @property
    def map_words(self) -> str:
        """Returns what the map is: ``LoD2``, or ``surface model with orthophoto``."""
        return f"LoD{self.lod}" if self.lod[:1].isdigit() else self.lod


# LoD-Loc's download, of which all four are part.
_LODLOC_FILES = "https://pan.baidu.com/s/1Ue37i0OQpS2jzo-fQ3o4bA?pwd=xxdv"
QUERIES = Host(
    "queries, poses, priors, intrinsics, splits",
    _LODLOC_FILES,
    "code xxdv; linked from https://github.com/VictorZoo/LoD-Loc",
)
MODEL_WITH_QUERIES = Host("city model", _LODLOC_FILES, "folder MODEL of the same download")
