"""What is known of the published datasets: folders, file names in the order they are tried, counts.

Two trees are in use. LoD-Loc's: ``UAVD4L-LoD/inTraj/{Query_image/, GT_pose.txt, GPS_pose.txt,
intrinsic.txt}``, ``UAVD4L-LoD/split/*.json``, ``MODEL/*.obj``. LoD-Loc v2's: ``data/UAVD4L-LoD/inTraj/
{query/, dataset_test.txt}``, ``data/all_colmaps/UAVD4L-LoD/inTraj/colmap_320/{cameras,images}.txt``; the
Swiss scenes lie there beside the others.
"""

from __future__ import annotations

from dataclasses import dataclass

from lodbench.errors import ConfigError, nearest_names
from lodbench.geometry.frames import SWISS_EPFL_FRAME, ShiftedEcef

TRUTH_FILES = ("GT_pose.txt",)
PRIOR_FILES = ("GPS_pose.txt", "GPS_pose_new.txt", "GPS_pose_new_all.txt")
CAMERA_FILES = ("intrinsic.txt",)
IMAGE_FOLDERS = ("Query_image", "query")
MASK_FOLDERS = ("masks", "Mask")
MODEL_FOLDERS = ("MODEL", "model", "")

# Where a folder of datasets may begin below the root: as unpacked, or as either release's code has it.
PREFIXES = ("", "dataset/", "data/")

_LODLOC_FILES = "https://pan.baidu.com/s/1Ue37i0OQpS2jzo-fQ3o4bA?pwd=xxdv"


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
class Source:
    """Where publishers host a part.

    Attributes:
        what: What it is.
        url: Address for people.
        how: What to do there.
    """

    what: str
    url: str
    how: str


@dataclass(frozen=True, slots=True)
class Download:
    """A file with an address that does not change.

    Attributes:
        url: Its address.
        path: Where it goes below the root.
        sha256: Of its content.
        num_bytes: Its size.
    """

    url: str
    path: str
    sha256: str
    num_bytes: int


@dataclass(frozen=True, slots=True)
class PublishedSpec:
    """One dataset: queries over one city model.

    Attributes:
        id: Name on the command line.
        title: Name in the papers.
        lod: Level of detail of the city model, for people: the files do not say.
        folder: The folder of the download.
        splits: In the order of the papers' tables.
        city_files: Names of the city model, in the order tried.
        unreadable_city_files: Names of it in formats that are not read.
        ecef: The frame its files may come in besides east, north, up.
        photo_crs: CRS of which the local frame is a shift, to place photos by their GPS.
        sources: Where to get it.
        downloads: What can be fetched by itself.
    """

    id: str
    title: str
    lod: str
    folder: str
    splits: tuple[SplitSpec, ...]
    city_files: tuple[str, ...]
    unreadable_city_files: tuple[str, ...]
    ecef: ShiftedEcef | None
    photo_crs: str | None
    sources: tuple[Source, ...]
    downloads: tuple[Download, ...] = ()


_UAVD4L_SPLITS = (
    SplitSpec(
        "in_traj",
        ("UAVD4L-LoD/inTraj", "UAVD4L-LoDv2/inTraj", "inTraj"),
        ("UAV_inTraj_test.json",),
        num_queries=1604,
        prior_median=(6.48, 1.63),
    ),
    SplitSpec(
        "out_of_traj",
        ("UAVD4L-LoD/outTraj", "UAVD4L-LoDv2/outTraj", "outTraj"),
        ("UAV_outTraj_test.json",),
        num_queries=2192,
        prior_median=(11.1, 0.92),
    ),
    SplitSpec(
        "synthetic",
        ("UAVD4L-LoD/Synthesis", "UAVD4L-LoDv2/Synthesis", "Synthesis"),
        ("UAV_train.json", "UAV_train_sample.json"),
        is_test=False,
    ),
)
_SWISS_SPLITS = (
    SplitSpec(
        "in_place",
        ("Swiss-EPFL/inPlace", "Swiss-EPFLv2/inPlace", "UAVD4L-LoD/Swiss_in", "inPlace", "Swiss_in"),
        ("Swiss_inPlace_test.json",),
        prior_files=("inPlace_gps_newAll.txt",),
        num_queries=712,
        prior_median=(17.6, 3.87),
    ),
    SplitSpec(
        "out_of_place",
        ("Swiss-EPFL/outPlace", "Swiss-EPFLv2/outPlace", "UAVD4L-LoD/Swiss_out", "outPlace", "Swiss_out"),
        ("Swiss_outPlace_test.json",),
        prior_files=("outPlace_gps_newAll.txt",),
        num_queries=379,
        prior_median=(17.9, 3.94),
    ),
    SplitSpec(
        "synthetic",
        ("Swiss-EPFL/Synthesis", "Swiss-EPFLv2/Synthesis", "Synthesis"),
        ("Swiss_train.json", "train.json"),
        is_test=False,
    ),
)
_QUERIES = Source(
    "queries, poses, priors, intrinsics, splits",
    _LODLOC_FILES,
    "code xxdv; linked from https://github.com/VictorZoo/LoD-Loc",
)
_LOD1 = Download(
    url="https://raw.githubusercontent.com/VictorZoo/LoD-Loc-v2/"
    "10bfcf89decbb8134395898ddaa763a6a4dad1f2/UAVD4L-LoD1.obj",
    path="MODEL/UAVD4L-LoD1.obj",
    sha256="f045255d3689f9cb4fd4f2dac67ffad6bea585f5a1d9e7a5628fb069d5d4ec83",
    num_bytes=3_151_818,
)
_MODEL_WITH_QUERIES = Source("city model", _LODLOC_FILES, "folder MODEL of the same download")
_NOT_RELEASED = Source(
    "city model",
    "https://github.com/VictorZoo/LoD-Loc-v2/issues/2",
    "not released as of 2025-12-06: ask there",
)

SPECS = {
    spec.id: spec
    for spec in (
        PublishedSpec(
            id="uavd4l_lod",
            title="UAVD4L-LoD",
            lod="3",
            folder="UAVD4L-LoD",
            splits=_UAVD4L_SPLITS,
            city_files=("UAVD4L-LoD.obj",),
            unreadable_city_files=("UAVD4L-LoD.osgb", "UAVD4L-LoD.blend"),
            ecef=None,
            photo_crs="EPSG:4547",
            sources=(_QUERIES, _MODEL_WITH_QUERIES),
        ),
        PublishedSpec(
            id="uavd4l_lodv2",
            title="UAVD4L-LoDv2",
            lod="1",
            folder="UAVD4L-LoD",
            splits=_UAVD4L_SPLITS,
            city_files=("UAVD4L-LoD1.obj", "move22.obj", "UAVD4L-LoDv2.obj"),
            unreadable_city_files=("move22.osgb", "move22.blend"),
            ecef=None,
            photo_crs="EPSG:4547",
            sources=(
                _QUERIES,
                Source("city model", _LOD1.url, "or: lodbench dataset download uavd4l_lodv2"),
            ),
            downloads=(_LOD1,),
        ),
        PublishedSpec(
            id="swiss_epfl",
            title="Swiss-EPFL",
            lod="2",
            folder="Swiss-EPFL",
            splits=_SWISS_SPLITS,
            city_files=("Swiss-EPFL-LoD.obj", "Swiss-EPFL.obj"),
            unreadable_city_files=("Swiss-EPFL.osgb", "Swiss-EPFL-LoD.blend"),
            ecef=SWISS_EPFL_FRAME,
            photo_crs=None,
            sources=(_QUERIES, _MODEL_WITH_QUERIES),
        ),
        PublishedSpec(
            id="swiss_epflv2",
            title="Swiss-EPFLv2",
            lod="1",
            folder="Swiss-EPFL",
            splits=_SWISS_SPLITS,
            city_files=("swiss_LoD1_final.obj", "Swiss-EPFL-LoD1.obj", "Swiss-EPFLv2.obj"),
            unreadable_city_files=("swiss_LoD1_final.osgb",),
            ecef=SWISS_EPFL_FRAME,
            photo_crs=None,
            sources=(_QUERIES, _NOT_RELEASED),
        ),
    )
}


def spec_of(name: str) -> PublishedSpec:
    """Returns the spec of a dataset.

    Raises:
        ConfigError: There is none of that name.
    """
    if name not in SPECS:
        raise ConfigError(f"There is no published dataset {name!r}.", nearest_names(name, SPECS))
    return SPECS[name]
