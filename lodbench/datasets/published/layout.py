"""What can be said of a published dataset, where its parts lie, and what to tell a person who lacks some.

Of LoD-Loc's datasets two trees are in use. LoD-Loc's: ``UAVD4L-LoD/inTraj/{Query_image/, GT_pose.txt,
GPS_pose.txt, intrinsic.txt}``, ``UAVD4L-LoD/split/*.json``, ``MODEL/*.obj``. LoD-Loc v2's:
``data/UAVD4L-LoD/inTraj/{query/, dataset_test.txt}``, ``data/all_colmaps/UAVD4L-LoD/inTraj/colmap_320/
{cameras,images}.txt``; the Swiss scenes lie there beside the others. A dataset in a layout of its own lists
its ``parts`` instead.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from lodbench.errors import DatasetError
from lodbench.geometry.similarity import ShiftedEcef
from lodbench.storage.paths import data_root

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
    """One split."""

    name: str  # name in tables
    folders: tuple[str, ...]  # where its files lie below the root, in the order tried
    split_files: tuple[str, ...]  # names of its split JSON, in the order tried
    prior_files: tuple[str, ...] = ()  # further names of the file of priors
    # Queries of the paper's tables, solved from their percentages; None where unknown
    num_queries: int | None = None
    # The paper's median error of the priors, metres and degrees
    prior_median: tuple[float, float] | None = None
    is_test: bool = True  # whether it is run where no split is named


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
    """A file, or files, of a dataset in a layout of its own."""

    place: str  # below the dataset's folder, as a pattern: ``query_images/val/*``
    what: str  # in words
    split: str = ""  # the split that cannot be read without it; "" for none in particular
    is_needed: bool = True  # whether queries cannot be made without it
    media: str = "text/plain"  # its MIME type


@dataclass(frozen=True, slots=True)
class PublishedSpec:
    """One dataset: queries over one city model."""

    id: str  # name on the command line
    title: str  # name in the papers
    lod: str  # level of detail of the city model, for people: the files do not say; or what else the map is
    folder: str  # the folder of the download
    splits: tuple[SplitSpec, ...]  # in the order of the papers' tables
    hosts: tuple[Host, ...]  # where to get it
    # Names of the city model, in the order tried; patterns where there are ``parts``
    city_files: tuple[str, ...] = ()
    unreadable_city_files: tuple[str, ...] = ()  # names of it in formats that are not read
    ecef: ShiftedEcef | None = None  # the frame its files may come in besides east, north, up
    photo_crs: str | None = None  # CRS of which the local frame is a shift, to place photos by their GPS
    downloads: tuple[Download, ...] = ()  # what can be fetched by itself
    parts: tuple[Part, ...] = ()  # files of a layout of its own; empty for LoD-Loc's
    protocol: str = "lodloc"  # name of its bins and metrics, of ``lodbench.evaluation.metrics``
    year: str = "2024"  # of its publication
    # Between which heights above the ground its cameras are; None where not stated
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


@dataclass(frozen=True, slots=True)
class SplitFiles:
    """The parts of one split; what is not there is None."""

    spec: SplitSpec  # the split
    folder: Path  # its folder
    truth: Path | None  # true poses: a text file, a folder of 4 x 4 matrices, or COLMAP's ``images.txt``
    truth_folder: Path | None  # the folder of 4 x 4 matrices, where both are there
    priors: Path | None  # the priors, likewise
    other_priors: tuple[Path, ...]  # files that could be the priors too
    cameras: Path | None  # intrinsics: a text file, a folder of 3 x 4 matrices, or COLMAP's ``cameras.txt``
    images: Path | None  # the photos
    names: Path | None  # what lists the queries: a split JSON or ``dataset_test.txt``

    @property
    def is_complete(self) -> bool:
        """Whether poses can be scored and queries made."""
        return self.truth is not None and self.cameras is not None


@dataclass(frozen=True, slots=True)
class Survey:
    """What is there of a dataset: None for what is not."""

    spec: PublishedSpec
    root: Path
    splits: tuple[SplitFiles, ...]
    city_model: Path | None
    unreadable_city: Path | None  # A city model in a format that is not read
    textured_map: Path | None = None
    references: Path | None = None
    home: Path | None = None  # folder that the ``parts`` of the dataset are below, where it has some
    lacking: tuple[Part, ...] = ()  # those of them that are not there

    @property
    def is_there(self) -> bool:
        """Tells whether anything of the dataset is there."""
        return bool(self.splits or self.city_model or len(self.lacking) < len(self.spec.parts))

    def num_bytes(self) -> int:
        """Returns the size of the files that are there."""
        home = self.home or self.root
        files = {path for split in self.splits for path in split.folder.rglob("*") if path.is_file()}
        files |= {path for part in self.spec.parts for path in home.glob(part.place) if path.is_file()}
        if self.city_model is not None and self.city_model.is_file():
            files.add(self.city_model)
        return sum(path.stat().st_size for path in files)

    def missing(self) -> list[str]:
        """Returns what a run needs and is not there: one line each."""
        by_split = {files.spec.name: files for files in self.splits}
        lines = []
        for split in self.spec.splits:
            files = by_split.get(split.name)
            if files is None and split.is_test and not self.spec.parts:
                lines.append(f"split {split.name}: no folder {split.folders[0]}")
            if files is not None:
                wanted = {TRUTH_FILES[0]: files.truth, CAMERA_FILES[0]: files.cameras}
                if split.is_test:
                    wanted[PRIOR_FILES[0]] = files.priors
                lines += [f"split {split.name}: no {name}" for name, path in wanted.items() if path is None]
        is_empty = self.spec.parts and not self.is_there
        lines += [f"{part.what}: no {part.place}" for part in self.lacking if part.is_needed or is_empty]
        if self.city_model is None and self.spec.city_files:
            also = f"; {self.unreadable_city.name} is not read" if self.unreadable_city else ""
            lines.append(f"city model: none of {', '.join(self.spec.city_files)}{also}")
        return lines


def survey(spec: PublishedSpec, root: str | None, city: str | None, prior_file: str | None = None) -> Survey:
    """Returns what is there of a dataset.

    Args:
        spec: The dataset.
        root: Where to look; None for the user's data folder.
        city: The city model; None to look for it.
        prior_file: Name of the file or folder of priors; None for the first known one.
    """
    base = data_root() if root is None else Path(root).expanduser()
    if spec.parts:
        return _survey_parts(spec, base, city)
    splits = tuple(
        files for split in spec.splits if (files := _find_split(base, split, prior_file)) is not None
    )
    folders = list(dict.fromkeys([base, *(parent for s in splits for parent in list(s.folder.parents)[:3])]))
    places = [folder / name for folder in folders for name in (*MODEL_FOLDERS, spec.folder)]
    given = None if city is None else Path(city).expanduser()
    return Survey(
        spec,
        base,
        splits,
        _first(place / name for name in spec.city_files for place in places) if given is None else given,
        _first(place / name for name in spec.unreadable_city_files for place in places),
        _first(
            folder / name / file
            for name in MODEL_FOLDERS[:2]
            for file in TEXTURED_NAMES
            for folder in folders
        ),
        _first(folder / name for name in (f"{spec.folder}/{REFERENCE_FOLDER}",) for folder in folders),
    )


def _survey_parts(spec: PublishedSpec, base: Path, city: str | None) -> Survey:
    """Returns what is there of a dataset that lists its parts."""
    homes = [base, *(base / prefix / spec.folder for prefix in PREFIXES)]
    lacking = {
        home: tuple(part for part in spec.parts if next(home.glob(part.place), None) is None)
        for home in homes
    }
    home = min(homes, key=lambda folder: len(lacking[folder]))
    cities = sorted(path for name in spec.city_files for path in home.glob(name))
    return Survey(
        spec,
        base,
        (),
        (cities[0] if cities else None) if city is None else Path(city).expanduser(),
        _first(path for name in spec.unreadable_city_files for path in sorted(home.glob(name))),
        home=home,
        lacking=lacking[home],
    )


def require_data(inventory: Survey) -> None:
    """Makes sure that there are queries.

    Raises:
        DatasetError: No test split is there, one lacks its poses or cameras, or the city model that
            was named does not exist. The hint is a screen of text: what is missing, the expected tree,
            where to get it, what to do next.
    """
    if inventory.city_model is not None and not inventory.city_model.exists():
        raise DatasetError(f"The city model {inventory.city_model} does not exist.", "Set `city=FILE`.")
    if inventory.spec.parts:
        is_whole = not any(part.is_needed for part in inventory.lacking)
    else:
        has_test = any(files.spec.is_test for files in inventory.splits)
        is_whole = has_test and all(files.is_complete for files in inventory.splits)
    if not is_whole:
        raise not_all_of(inventory)


def not_all_of(inventory: Survey) -> DatasetError:
    """Returns the error that parts of a dataset are missing, with the screen of text that says what to do."""
    return DatasetError(
        f"{inventory.spec.id}: not all of {inventory.spec.title} is in {inventory.root}.", advice(inventory)
    )


def advice(inventory: Survey) -> str:
    """Returns what to do about missing parts, for a screen of 24 lines."""
    spec, where = inventory.spec, "" if inventory.root == data_root() else f" --root {inventory.root}"
    lines = [
        "missing:",
        *(f"  {line}" for line in inventory.missing()[:6]),
        f"expected, in {inventory.root} or dataset.root=DIR:",
        *(_parts_of(spec) if spec.parts else _tree_of(spec)),
        "get it:",
        *(f"  {host.what}: {host.url}\n    {host.how}" for host in spec.hosts),
        "check it:",
        f"  lodbench dataset check {spec.id}{where}",
    ]
    return "\n".join(lines)


def _parts_of(spec: PublishedSpec) -> list[str]:
    width = max(len(part.place) for part in spec.parts)
    optional = {True: "", False: " (if there)"}
    return [f"  {part.place.ljust(width)}  {part.what}{optional[part.is_needed]}" for part in spec.parts]


def _tree_of(spec: PublishedSpec) -> list[str]:
    tests = [split for split in spec.splits if split.is_test]
    parts = ", ".join((TRUTH_FILES[0], PRIOR_FILES[0], CAMERA_FILES[0]))
    lists = ", ".join(split.split_files[0] for split in tests)
    return [
        f"  {tests[0].folders[0]}/{{{parts}, {IMAGE_FOLDERS[0]}/, masks/}}",
        *(f"  {split.folders[0]}/{{the same}}" for split in tests[1:]),
        f"  {spec.folder}/split/{{{lists}}}   (else all poses are queries)",
        f"  {MODEL_FOLDERS[0]}/{spec.city_files[0]}   (or city=FILE)",
        f"  {MODEL_FOLDERS[0]}/{TEXTURED_NAMES[0]}/, {spec.folder}/{REFERENCE_FOLDER}/   (if required)",
        "  masks/ is not published: building masks (255 = building) by any network, named as the photos",
    ]


def _find_split(base: Path, spec: SplitSpec, prior_file: str | None) -> SplitFiles | None:
    places = (base / prefix / name for name in spec.folders for prefix in PREFIXES)
    folder = next((place for place in places if place.is_dir()), None)
    if folder is None:
        return None
    # Where LoD-Loc v2's code keeps the COLMAP model of a scene.
    colmap = folder.parent.parent / "all_colmaps" / folder.parent.name / folder.name / "colmap_320"
    names = (prior_file,) if prior_file is not None else (*PRIOR_FILES, *spec.prior_files)
    priors = [folder / name for name in names if (folder / name).exists()]
    lists = [folder.parent / "split" / name for name in spec.split_files]
    return SplitFiles(
        spec=spec,
        folder=folder,
        truth=_first([*(folder / n for n in TRUTH_FILES), folder / "GT_pose", colmap / "images.txt"]),
        truth_folder=_first([folder / "GT_pose"]),
        priors=_first([*priors, *([] if prior_file else [folder / "GPS_pose"])]),
        other_priors=tuple(priors[1:]),
        cameras=_first([*(folder / n for n in CAMERA_FILES), folder / "intrinsic", colmap / "cameras.txt"]),
        images=_first(folder / name for name in IMAGE_FOLDERS),
        names=_first([*lists, *([folder / "dataset_test.txt"] if spec.is_test else [])]),
    )


def _first(paths: Iterable[Path]) -> Path | None:
    return next((path for path in paths if path.exists()), None)
