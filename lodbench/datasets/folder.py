"""``dataset=folder``: any folder in LoD-Loc's text layout; ``dataset=real_flights``: a flight in it.

::

    ROOT/                       or one such folder per split: ROOT/in_place, ROOT/out_of_place, ...
        GT_pose.txt             name qw qx qy qz tx ty tz, world to camera (or poses.txt)
        GPS_pose.txt            the priors, likewise; several lines of a name are its hypotheses, best first
        intrinsic.txt           name PINHOLE W H fx fy cx cy, and how well they are known where that is not
                                exactly, as standard deviations: sigma_f=0.5% sigma_c=0.35% sigma_k1=0.01
                                (sigma_c percent of the width; any may lack; sigma_by=WORD says whence)
        Query_image/            the photos (optional; or images/)
        masks/                  building masks, 255 = building (optional)
        instances/              labels of single buildings, 0 = none, one value per building (optional)
        classes/                labels of surfaces, 0 = neither, 1 = roof, 2 = wall (optional)
        sequences.txt           name sequence: which photos belong to one flight (optional)
        lens_percent.txt        name percent: standard deviation of a focal length known badly (optional)
        measurements.txt        name east=0.02 range=81.2 ...: deviations of the prior, a laser's range, a
                                height by air pressure; see ``parse_measurements`` (optional)
        reconstruction/         a COLMAP model of the photos, or a folder with one per flight (optional)
        dataset.json            where it came from: city model, reference system; whether it has a truth and
                                priors; the protocol of its results (optional)

Truth and priors may be missing only where ``dataset.json`` says so: a misspelt file is an error.

Every real flight has a map and a frame of its own, so a dataset of them is one: its split has the folder's
name, its photos are one flight, its map is ``city.obj`` beside the poses, ``sparse`` the model that these are
from.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.citymodel.crs import is_same_plane
from lodbench.citymodel.options import ReadOptions
from lodbench.datasets import pose_text
from lodbench.datasets.exchange.colmap import is_colmap, read_colmap
from lodbench.datasets.faults import UNLIKE_RECONSTRUCTION
from lodbench.datasets.inputs import CLASSES_FOLDER, INSTANCES_FOLDER, read_references
from lodbench.datasets.query import Dataset, Entry, notes_of
from lodbench.errors import ConfigError, DatasetError, LodbenchError, nearest_names
from lodbench.findings import Findings
from lodbench.geometry import Camera, CameraSigmas, Pose
from lodbench.geometry.similarity import fit_similarity
from lodbench.photos.files import mask_names
from lodbench.storage import write_text
from lodbench.storage.paths import is_sealed, seal_of

TRUTH_FILE, PRIOR_FILE, CAMERA_FILE = "GT_pose.txt", "GPS_pose.txt", "intrinsic.txt"
SEQUENCE_FILE, LENS_FILE, MEASUREMENTS_FILE = "sequences.txt", "lens_percent.txt", "measurements.txt"
RECONSTRUCTION_FOLDER = "reconstruction"
# What training data calls the same: nothing there was measured on the ground.
RENDERED_TRUTH_FILE, RENDERED_IMAGES = "poses.txt", "images"
_LAYOUT_HINT = (
    f"A dataset folder holds {TRUTH_FILE}, {PRIOR_FILE} and {CAMERA_FILE}, or such folders as splits."
)
ABOUT_FILE = "dataset.json"
_NO_TRUTH_HINT = f'Where true poses are not known, a {ABOUT_FILE} in that folder says so: {{"truth": false}}.'


@dataclass(frozen=True, slots=True)
class FolderParams:
    """Settings of ``dataset=folder``, explained in ``conf/dataset/folder.yaml``."""

    root: str
    city_model: str | None = None
    lod: str | None = None
    crs: str | None = None
    roof_height: str | None = None
    name: str = "folder"
    references: str | None = None
    textured_map: str | None = None
    layers: list[str] = field(default_factory=list)


def open_folder(params: FolderParams) -> Dataset:
    """Returns the dataset of a folder in the text layout.

    Raises:
        DatasetError: The folder, a pose file, the city model or the textured map is missing, a line is
            malformed, or the references are not as ``read_references`` asks.
    """
    root = Path(params.root).expanduser()
    if not root.is_dir():
        raise DatasetError(f"{root} is not a folder.", "Set `dataset.root=FOLDER`.")
    textured = None if params.textured_map is None else Path(params.textured_map).expanduser()
    if textured is not None and not textured.exists():
        raise DatasetError(f"The textured map {textured} does not exist.", "Set `dataset.textured_map=FILE`.")
    references = () if params.references is None else read_references(Path(params.references).expanduser())
    folders = [root] if _is_split(root) else _split_folders(root)
    names = [root.name or "all"] if folders == [root] else [folder.name for folder in folders]
    if folders != [root]:
        _require_words(root, names)
    if params.city_model is None:
        city, city_notes = stated_city(root, folders)
    else:
        city, city_notes = Path(params.city_model).expanduser(), ()
    if city is not None and not city.exists():
        raise DatasetError(f"The city model {city} does not exist.", "Set `city=FILE`.")
    parts = [_read_split(folder, name) for folder, name in zip(folders, names, strict=True)]
    return Dataset(
        name=params.name,
        version="",
        root=root,
        city_model=city,
        lod=params.lod,
        splits=tuple(names),
        entries=tuple(entry for entries, _, _ in parts for entry in entries),
        truth={key: pose for _, truth, _ in parts for key, pose in truth.items()},
        notes=(*city_notes, *(note for _, _, notes in parts for note in notes)),
        city_options=ReadOptions(crs=params.crs, layers=tuple(params.layers)),
        roof_height=params.roof_height,
        city_hint=". ".join([*city_notes, "Set `city=FILE`."]),
        references=references,
        textured_map=textured,
        crs=stated_crs(folders),
        protocol=stated_protocol(folders),
    )


def _require_words(root: Path, splits: Sequence[str]) -> None:
    """Refuses names that poses, stored as lines of words with SPLIT/PHOTO first, could not hold."""
    for name in splits:
        if name.split() != [name] or not name.isprintable():
            kind = "a space" if name.isprintable() else "a space or a control character"
            raise DatasetError(f"The split {name!r} in {root} has {kind} in its name.", "Rename its folder.")


def write_poses(
    folder: Path,
    cameras: Mapping[str, Camera],
    truth: Mapping[str, Pose],
    priors: Mapping[str, Pose],
    *,
    sigmas: Mapping[str, CameraSigmas | None] | None = None,
    truth_file: str = TRUTH_FILE,
    decimals: tuple[int, int] | None = None,
    survives_power_cut: bool = True,
) -> None:
    """Writes the text files of one split, those that have lines.

    Args:
        folder: The split's.
        cameras: By image name.
        truth: True poses by image name, world to camera, coordinates of the city's CRS.
        priors: Rough poses, likewise.
        sigmas: How well the cameras are known, by image name; where nobody says, none or None.
        truth_file: Name of the file of true poses.
        decimals: As for ``format_pose``.
        survives_power_cut: As for ``write_bytes``.
    """
    known = sigmas or {}
    lines = {
        truth_file: [pose_text.format_pose(name, pose, decimals) for name, pose in truth.items()],
        PRIOR_FILE: [pose_text.format_pose(name, pose, decimals) for name, pose in priors.items()],
        CAMERA_FILE: [
            pose_text.format_camera(name, camera, known.get(name)) for name, camera in cameras.items()
        ],
    }
    for name, listed in lines.items():
        if listed:
            write_text(folder / name, pose_text.lines_to_text(listed), survives_power_cut)


def select_splits(dataset: Dataset, wanted: Sequence[str]) -> tuple[str, ...]:
    """Returns the splits to run, in the dataset's order; an empty list means its default ones.

    Raises:
        ConfigError: A name is not a split of the dataset.
    """
    for name in wanted:
        if name not in dataset.splits:
            raise ConfigError(
                f"Dataset {dataset.name} has no split {name!r}.", nearest_names(name, dataset.splits)
            )
    chosen = wanted or dataset.default_splits or dataset.splits
    return tuple(name for name in dataset.splits if name in chosen)


def _split_folders(root: Path) -> list[Path]:
    folders = sorted(child for child in root.iterdir() if _is_split(child))
    if not folders:
        is_of_photos = _first_file(root, [PRIOR_FILE, CAMERA_FILE]) is not None
        raise DatasetError(f"{root} holds no {TRUTH_FILE}.", _NO_TRUTH_HINT if is_of_photos else _LAYOUT_HINT)
    for child in sorted(set(root.iterdir()) - set(folders)):
        if file := _first_file(child, [PRIOR_FILE, CAMERA_FILE]):
            raise DatasetError(
                f"{child} holds {file.name} and no {TRUTH_FILE}: as a split it would be left out.",
                _NO_TRUTH_HINT,
            )
    return folders


def _is_split(folder: Path) -> bool:
    return _truth_file(folder) is not None or (folder / ABOUT_FILE).is_file()


def _read_split(folder: Path, split: str) -> tuple[list[Entry], dict[str, Pose], list[str]]:
    about = read_about(folder)
    has_truth, has_priors = about.get("truth") is not False, about.get("priors") is not False
    truth_file = _truth_file(folder) or folder / TRUTH_FILE
    truth = pose_text.read_poses(truth_file) if has_truth else {}
    priors = pose_text.read_hypotheses(folder / PRIOR_FILE) if has_priors else {}
    known = pose_text.read_known_cameras(folder / CAMERA_FILE)
    cameras = {name: camera for name, (camera, _) in known.items()}
    sigmas = {name: stated for name, (_, stated) in known.items() if stated is not None}
    if has_truth and not truth:
        raise DatasetError(f"{truth_file} holds no poses.", _LAYOUT_HINT)
    names = list(dict.fromkeys([*truth, *priors]))
    notes = [
        f"{split}: {name} has a camera but no pose"
        for name in cameras
        if name not in truth and name not in priors
    ]
    if not has_truth:
        notes.append(f"{split}: there is no truth, so nothing is scored")
    if not has_priors:
        notes.append(f"{split}: there are no priors; prior=uniform draws them around the truth")
    sequences = pose_text.read_words(folder / SEQUENCE_FILE) if (folder / SEQUENCE_FILE).is_file() else {}
    measured = pose_text.read_measurements(file) if (file := folder / MEASUREMENTS_FILE).is_file() else {}
    notes += [f"{split}: {note}" for note in _sequence_notes(sequences, names, measured)]
    lenses = {name: stated.stated_focal_percent for name, stated in sigmas.items()}
    lenses |= pose_text.read_percents(folder / LENS_FILE) if (folder / LENS_FILE).is_file() else {}
    entries = [
        Entry(
            name=name,
            split=split,
            camera=cameras.get(name),
            prior=next(iter(priors.get(name, ())), None),
            image=_first_file(folder / "Query_image", [name])
            or _first_file(folder / RENDERED_IMAGES, [name]),
            mask=_first_file(folder / "masks", mask_names(name)),
            hypotheses=priors.get(name, ()),
            instances=_first_file(folder / INSTANCES_FOLDER, [Path(name).stem + ".png"]),
            classes=_first_file(folder / CLASSES_FOLDER, [Path(name).stem + ".png"]),
            sequence=sequences.get(name, ""),
            lens_percent=lenses.get(name),
            camera_sigmas=sigmas.get(name),
            measured=measured.get(name),
        )
        for name in names
    ]
    entries = with_reconstructions(entries, folder / RECONSTRUCTION_FOLDER)
    tied = sum(entry.reconstructed is not None for entry in entries)
    if (folder / RECONSTRUCTION_FOLDER).is_dir() and tied < len(entries):
        notes.append(
            f"{split}: {RECONSTRUCTION_FOLDER} has {tied} of {len(entries)} photos, under their names"
        )
    several = sum(len(entry.hypotheses) > 1 for entry in entries)
    if several:
        queries = "1 query has" if several == 1 else f"{several} queries have"
        notes.append(f"{split}: {queries} several priors; the first is the prior of each")
    return entries, {f"{split}/{name}": pose for name, pose in truth.items()}, notes


def _sequence_notes(
    sequences: Mapping[str, str], names: Sequence[str], measured: Mapping[str, object]
) -> Iterator[str]:
    """Yields what does not match between photos and what files say of them: flights, measurements."""
    for file, stated in ((SEQUENCE_FILE, sequences), (MEASUREMENTS_FILE, measured)):
        if strange := stated.keys() - set(names):
            yield f"{file} names {min(strange)}, which is no photo here ({len(strange)} such)"
    alone = [name for name in names if name not in sequences]
    if sequences and alone:
        yield f"{SEQUENCE_FILE} does not name {alone[0]} ({len(alone)} such): these are taken for one flight"


def with_reconstructions(entries: list[Entry], folder: Path) -> list[Entry]:
    """Returns entries with their poses in a folder's COLMAP model, or in that of their flight, if any."""
    whole = {found.name: found.pose for found in read_colmap(folder)} if is_colmap(folder) else {}
    by_flight = {
        flight: {found.name: found.pose for found in read_colmap(folder / flight)}
        for flight in {entry.sequence for entry in entries}
        if flight and is_colmap(folder / flight)
    }
    if not whole and not by_flight:
        return entries
    return [
        replace(entry, reconstructed=by_flight.get(entry.sequence, whole).get(entry.name))
        for entry in entries
    ]


def _truth_file(folder: Path) -> Path | None:
    return _first_file(folder, [TRUTH_FILE, RENDERED_TRUTH_FILE])


def _first_file(folder: Path, names: Sequence[str]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_file()), None)


def read_about(folder: Path) -> dict[str, Any]:
    """Returns what ``dataset.json`` in a folder says; nothing where there is none."""
    return pose_text.read_json(folder / ABOUT_FILE) if (folder / ABOUT_FILE).is_file() else {}


def stated_crs(folders: Sequence[Path]) -> str | None:
    """Returns the reference system that ``dataset.json`` of some splits names; None if none does.

    Raises:
        DatasetError: Two of them name different ones: poses of both would be taken for those of one.
    """
    reported = {folder: read_about(folder).get("crs") for folder in folders}
    named = {folder: str(crs) for folder, crs in reported.items() if crs is not None}
    _require_one(named, "reference systems", "Open them one by one: `dataset.root=FOLDER`.", is_same_plane)
    return next(iter(named.values()), None)


def stated_protocol(folders: Sequence[Path]) -> str:
    """Returns the protocol that ``dataset.json`` of some splits names for results; LoD-Loc's if none does.

    Raises:
        DatasetError: Two of them name different ones.
    """
    stated = {folder: read_about(folder).get("protocol") for folder in folders}
    named = {folder: str(protocol) for folder, protocol in stated.items() if protocol is not None}
    _require_one(named, "protocols", "Open them one by one: dataset.root=FOLDER.")
    return next(iter(named.values()), "lodloc")


def stated_city(root: Path, folders: Sequence[Path]) -> tuple[Path | None, tuple[str, ...]]:
    """Returns the city model that ``dataset.json`` of some splits names, relative to it, and notes.

    None if it is not there. What a stranger's file names outside the dataset is not so much as looked for.

    Raises:
        DatasetError: What it names cannot be a file's name, or two of them name different ones.
    """
    abouts = {folder: read_about(folder) for folder in folders}
    named = {folder: about["city_model"] for folder, about in abouts.items() if about.get("city_model")}
    named = {folder: stated for folder, stated in named.items() if isinstance(stated, str)}
    paths = {folder: os.path.normpath(folder.absolute() / stated) for folder, stated in named.items()}
    _require_one(
        paths, "city models", "Open them one by one: `dataset.root=FOLDER`. Or set `city=FILE` for all."
    )
    if not named:
        return None, ()
    folder, stated = next(iter(named.items()))
    about = abouts[folder]
    try:
        return _named_city(root, folder, stated, about)
    except PermissionError as error:
        reason = f"{folder / ABOUT_FILE}: city_model {stated!r:.60} may not be looked at."
        raise DatasetError(reason, "Ask for permission, or set `city=FILE`.") from error
    except (OSError, ValueError, RuntimeError) as error:  # too long, NUL, half a character; links in a circle
        raise DatasetError(
            f"{folder / ABOUT_FILE}: city_model {stated!r:.60} is no name of a file.",
            "Set `city=FILE`.",
        ) from error


def _named_city(
    root: Path, folder: Path, stated: str, about: Mapping[str, Any]
) -> tuple[Path | None, tuple[str, ...]]:
    path = Path(os.path.normpath(folder.absolute() / stated))
    if not is_sealed(_sealed_of(stated), about.get("seal")):
        home = Path(os.path.normpath(root.absolute()))
        # In words first: to resolve a path may mount what it leads to.
        if not path.is_relative_to(home) or not path.resolve().is_relative_to(home.resolve()):
            return None, (
                f"{ABOUT_FILE} names a city model outside the dataset, {path}, which is not opened",
            )
    return (path if path.exists() else None), ()


def sealed_about(about: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what ``dataset.json`` is to say, with a seal of this user's on the city model that it names."""
    stated = about.get("city_model")
    return dict(about) if stated is None else {**about, "seal": seal_of(_sealed_of(str(stated)))}


def _sealed_of(stated: str) -> list[str]:
    return ["city model of a dataset", stated]


def _require_one(
    named: Mapping[Path, str], what: str, hint: str, is_same: Callable[[str, str], bool] = str.__eq__
) -> None:
    """Refuses splits that say different things of one kind."""
    folders = list(named)
    for other in folders[1:]:
        if not is_same(named[folders[0]], named[other]):
            values = " and ".join(f"{named[folder]!r:.200}" for folder in (folders[0], other))
            raise DatasetError(
                f"The splits {folders[0].name} and {other.name} are of different {what}: {values}.", hint
            )


REAL_FLIGHTS, CITY_FILE, SPARSE_FOLDER = "real_flights", "city.obj", "sparse"
# How far rounding moves poses, metres or degrees, and from where on one is another.
_SAME_M, _FAR_M = 0.1, 0.5
# What the head of a board of such flights says.
BOARD_HEAD = (
    "Real photos, a block for each flight. True poses are by structure from motion that knows nothing of the "
    "map; maps are traced in photos and share its scale. How good both are is said by the dataset's card "
    "(lodbench dataset card real_flights). Figures do not compare with those of drawn photos."
)


@dataclass(frozen=True, slots=True)
class RealFlightParams:
    """Settings of ``dataset=real_flights``, described in ``conf/dataset/real_flights.yaml``."""

    root: str
    city_model: str | None = None
    name: str = REAL_FLIGHTS
    reconstruction: bool = False


def open_real_flight(params: RealFlightParams) -> Dataset:
    """Returns the dataset of one flight: photos that no ``sequences.txt`` names otherwise are one sequence.

    Raises:
        DatasetError: The folder holds several flights, or no reconstruction where methods shall have one,
            or as ``open_folder``.
    """
    root = Path(params.root).expanduser()
    require_one_flight(root)
    city = params.city_model or city_beside(root)
    dataset = open_folder(FolderParams(str(root), city, name=params.name))
    findings = (*dataset.findings, *_beside_reconstruction(root, dataset).items)
    entries = [replace(entry, sequence=entry.sequence or entry.split) for entry in dataset.entries]
    if params.reconstruction:
        if not is_colmap(root / SPARSE_FOLDER):
            raise DatasetError(
                f"{root} has no COLMAP model {SPARSE_FOLDER}.", "Leave `dataset.reconstruction` out."
            )
        entries = with_reconstructions(entries, root / SPARSE_FOLDER)
    return replace(
        dataset,
        entries=tuple(entries),
        findings=findings,
        notes=(*dataset.notes, *notes_of(Findings([*findings]))),
    )


def _beside_reconstruction(root: Path, dataset: Dataset) -> Findings:
    """Returns which true poses are not those of the reconstruction, laid on all of them by a similarity."""
    findings, folder = Findings(), root / SPARSE_FOLDER
    if not is_colmap(folder):
        return findings
    try:
        there = {image.name: image.pose for image in read_colmap(folder)}
        known = [(e.key, there[e.name], dataset.truth[e.key]) for e in dataset.entries if e.name in there]
        keys, poses, truth = zip(*known, strict=True) if known else ((), (), ())
        fitted = fit_similarity(poses, truth, np.full((len(keys), 3), _SAME_M), np.full(len(keys), _SAME_M))
    except LodbenchError as error:
        findings.add(UNLIKE_RECONSTRUCTION, SPARSE_FOLDER, error.message)
        return findings
    for key, distance_m in zip(keys, fitted.distances_m, strict=True):
        if distance_m > _FAR_M:
            findings.add(UNLIKE_RECONSTRUCTION, key, f"{distance_m:.1f} m")
    return findings


def require_one_flight(root: Path) -> None:
    """Refuses a folder of several flights, each over a map of its own.

    Raises:
        DatasetError: It is one.
    """
    if not (root / TRUTH_FILE).is_file() and (flights := sorted(root.glob(f"*/{TRUTH_FILE}"))):
        names = ", ".join(flight.parent.name for flight in flights)
        raise DatasetError(
            f"{root} holds several flights, each over a map of its own: {names}.",
            f"Name one: `dataset.root={flights[0].parent}`",
        )


def city_beside(root: Path) -> str | None:
    """Returns the ``city.obj`` of a flight's folder, or None if there is none."""
    return str(root / CITY_FILE) if (root / CITY_FILE).is_file() else None
