"""LoD-Loc's datasets, ``dataset=uavd4l_lod | uavd4l_lodv2 | swiss_epfl | swiss_epflv2``, in east, north, up.

See the cards in data_cards. Those of LoD-Loc v2 have the same queries over LoD1 blocks.

Which frame a published dataset comes in, by what stands upright in it. The Swiss city model was once
turned into earth-centred coordinates, minus those of an origin; whether a download still is, its files do
not say. Walls do: their normals are level in the frame that has the true vertical. Cameras do too: a gimbal
keeps the picture's x axis level.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.options import ReadOptions
from lodbench.datasets.faults import FRAME_ASSUMED, FRAMES_DIFFER, SPLIT_MISSING, TURNED_TO_ENU
from lodbench.datasets.published import layout
from lodbench.datasets.query import Dataset, Reference, notes_of
from lodbench.errors import ConfigError, DatasetError, nearest_names, require_within
from lodbench.findings import Findings
from lodbench.geometry import Pose
from lodbench.geometry.similarity import SWISS_EPFL_FRAME, ShiftedEcef, enu_from_ecef_rotation

if TYPE_CHECKING:
    from lodbench.citymodel.scene import Scene
    from lodbench.datasets.published.read import SplitContent


ENU, SHIFTED_ECEF = "enu", "shifted_ecef"

# A wall leans by no more than this: 2 degrees.
_WALL_SINE = 0.035
# Walls are at least this share of a city's area, and this many times what another frame shows.
_LEAST_WALLS, _CLEARLY_MORE = 0.15, 3.0
# The x axis of a gimbal's picture is level to about 6 degrees.
_LEVEL_SINE = 0.1


def frame_of_city(scene: Scene, ecef: ShiftedEcef) -> str | None:
    """Returns ``enu`` or ``shifted_ecef`` by the walls of a city, or None if they do not tell."""
    corners = scene.vertices.astype(np.float64)[scene.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    shares = {
        name: float(area[np.abs(normals @ up) < _WALL_SINE * area].sum() / area.sum())
        for name, up in _verticals(ecef).items()
    }
    best, other = sorted(shares, key=lambda name: -shares[name])
    is_clear = shares[best] >= _LEAST_WALLS and shares[best] > _CLEARLY_MORE * shares[other]
    return best if is_clear else None


def frame_of_poses(poses: Iterable[Pose], ecef: ShiftedEcef) -> str | None:
    """Returns ``enu`` or ``shifted_ecef`` by the level of the pictures, or None if it does not tell."""
    sideways = np.array([pose.rotation[0] for pose in poses])
    if len(sideways) == 0:
        return None
    tilt = {name: float(np.median(np.abs(sideways @ up))) for name, up in _verticals(ecef).items()}
    best, other = sorted(tilt, key=lambda name: tilt[name])
    return best if tilt[best] < _LEVEL_SINE and tilt[other] > _LEVEL_SINE else None


def _verticals(ecef: ShiftedEcef) -> dict[str, NDArray[np.float64]]:
    """Returns the direction of up in each frame."""
    return {
        ENU: np.array([0.0, 0.0, 1.0]),
        SHIFTED_ECEF: enu_from_ecef_rotation(ecef.lat_deg, ecef.lon_deg)[2],
    }


_FRAMES = ("auto", ENU, SHIFTED_ECEF)


@dataclass(frozen=True, slots=True)
class PublishedParams:
    """Settings of a published dataset, explained in ``conf/dataset/uavd4l_lod.yaml``."""

    name: str
    root: str | None = None
    city_model: str | None = None
    frame: str = "auto"
    prior_file: str | None = None
    origin: list[float] | None = None
    textured_map: str | None = None
    references: str | None = None

    def __post_init__(self) -> None:
        require_within("dataset.origin", self.origin, -math.inf)


def open_published(spec: layout.PublishedSpec, params: PublishedParams) -> Dataset:
    """Returns a published dataset in east, north, up; its city model may be missing.

    Raises:
        DatasetError: Parts are missing (the hint says which, and where to get them), or malformed.
        ConfigError: The frame is unknown, the origin no place, or the file of priors is nowhere.
    """
    from lodbench.datasets.inputs import read_references
    from lodbench.datasets.published.read import read_split

    if params.frame not in _FRAMES:
        raise ConfigError(f"dataset.frame={params.frame} is unknown.", nearest_names(params.frame, _FRAMES))
    if params.origin is not None and len(params.origin) != 3:
        raise ConfigError("dataset.origin takes three numbers: easting, northing, height.")
    inventory = layout.survey(spec, params.root, params.city_model, params.prior_file)
    layout.require_data(inventory)
    _require_prior_file(params, inventory)
    findings = Findings()
    _note_missing_splits(spec, inventory, findings)
    complete = [files for files in inventory.splits if files.is_complete]
    contents = [read_split(files, findings) for files in complete]
    options = ReadOptions()
    textured = (
        inventory.textured_map if params.textured_map is None else Path(params.textured_map).expanduser()
    )
    if textured is not None and not textured.exists():
        raise DatasetError(f"The textured map {textured} does not exist.", "Set `dataset.textured_map=FILE`.")
    folder = inventory.references if params.references is None else Path(params.references).expanduser()
    references = () if folder is None else read_references(folder)
    if spec.ecef is not None:
        contents, references, options = _to_enu(
            (contents, references), inventory, params.frame, spec.ecef, findings
        )
    return Dataset(
        name=spec.id,
        version="",
        root=inventory.root,
        city_model=inventory.city_model,
        city_hint=layout.advice(inventory),
        lod=None,
        splits=tuple(files.spec.name for files in complete),
        entries=tuple(entry for content in contents for entry in content.entries),
        truth={key: pose for content in contents for key, pose in content.truth.items()},
        notes=notes_of(findings),
        city_options=options,
        default_splits=tuple(files.spec.name for files in complete if files.spec.is_test),
        findings=tuple(findings.items),
        references=references,
        textured_map=textured,
        photo_crs=spec.photo_crs,
        photo_origin=None if params.origin is None else tuple(params.origin),
        protocol=spec.protocol,
    )


def _require_prior_file(params: PublishedParams, inventory: layout.Survey) -> None:
    """Makes sure that a file of priors that was named is in a split."""
    if params.prior_file is None or any(files.priors is not None for files in inventory.splits):
        return
    there = {
        path.name for files in inventory.splits for path in files.folder.iterdir() if path != files.truth
    }
    raise ConfigError(
        f"dataset.prior_file={params.prior_file} is in no split of {inventory.root}.",
        nearest_names(params.prior_file, there),
    )


def _note_missing_splits(spec: layout.PublishedSpec, inventory: layout.Survey, findings: Findings) -> None:
    for split in spec.splits:
        if split.is_test and split.name not in {files.spec.name for files in inventory.splits}:
            findings.add(SPLIT_MISSING, split.name, f"no folder {split.folders[0]}")


def _to_enu(
    posed: tuple[list[SplitContent], tuple[Reference, ...]],
    inventory: layout.Survey,
    frame: str,
    ecef: ShiftedEcef,
    findings: Findings,
) -> tuple[list[SplitContent], tuple[Reference, ...], ReadOptions]:
    """Returns splits and references in east, north, up, and how to read the city; says what was turned."""
    contents, references = posed
    poses = [pose for content in contents for pose in content.truth.values()]
    city = _city_frame(inventory.city_model, ecef) if frame == "auto" else frame
    cameras = frame_of_poses(poses, ecef) if frame == "auto" else frame
    if city is None and cameras is None:
        findings.add(FRAME_ASSUMED, inventory.spec.id)
    elif None not in (city, cameras) and city != cameras:
        findings.add(FRAMES_DIFFER, inventory.spec.id, f"city {city}, poses {cameras}")
    city, cameras = city or cameras or ENU, cameras or city or ENU
    options = ReadOptions()
    if city == SHIFTED_ECEF:
        reported = "as configured" if frame != "auto" else "by its walls"
        findings.add(TURNED_TO_ENU, "city model", reported)
        options = ReadOptions(ecef_origin=(ecef.lat_deg, ecef.lon_deg))
    if cameras == SHIFTED_ECEF:
        findings.add(
            TURNED_TO_ENU, "poses", "as configured" if frame != "auto" else "by the level of the pictures"
        )
        contents = [_turned(content, ecef) for content in contents]
        references = tuple(replace(r, pose=ecef.pose_to_enu(r.pose)) for r in references)
    return contents, references, options


def _city_frame(city: Path | None, ecef: ShiftedEcef) -> str | None:
    from lodbench.citymodel.cache import open_cached_scene

    return None if city is None else frame_of_city(open_cached_scene(city), ecef)


def _turned(content: SplitContent, ecef: ShiftedEcef) -> SplitContent:
    def turn(pose: Pose | None) -> Pose | None:
        return None if pose is None else ecef.pose_to_enu(pose)

    entries = tuple(
        replace(e, prior=turn(e.prior), hypotheses=tuple(map(ecef.pose_to_enu, e.hypotheses)))
        for e in content.entries
    )
    truth = {key: ecef.pose_to_enu(pose) for key, pose in content.truth.items()}
    return replace(content, entries=entries, truth=truth)


_UAVD4L_SPLITS = (
    layout.SplitSpec(
        "in_traj",
        ("UAVD4L-LoD/inTraj", "UAVD4L-LoDv2/inTraj", "inTraj"),
        ("UAV_inTraj_test.json",),
        num_queries=1604,
        prior_median=(6.48, 1.63),
    ),
    layout.SplitSpec(
        "out_of_traj",
        ("UAVD4L-LoD/outTraj", "UAVD4L-LoDv2/outTraj", "outTraj"),
        ("UAV_outTraj_test.json",),
        num_queries=2192,
        prior_median=(11.1, 0.92),
    ),
    layout.SplitSpec(
        "synthetic",
        ("UAVD4L-LoD/Synthesis", "UAVD4L-LoDv2/Synthesis", "Synthesis"),
        ("UAV_train.json", "UAV_train_sample.json"),
        is_test=False,
    ),
)

UAVD4L_LOD = layout.PublishedSpec(
    id="uavd4l_lod",
    title="UAVD4L-LoD",
    lod="3",
    folder="UAVD4L-LoD",
    splits=_UAVD4L_SPLITS,
    city_files=("UAVD4L-LoD.obj",),
    unreadable_city_files=("UAVD4L-LoD.osgb", "UAVD4L-LoD.blend"),
    photo_crs="EPSG:4547",
    hosts=(layout.QUERIES, layout.MODEL_WITH_QUERIES),
)


_LOD1 = layout.Download(
    url="https://raw.githubusercontent.com/VictorZoo/LoD-Loc-v2/"
    "10bfcf89decbb8134395898ddaa763a6a4dad1f2/UAVD4L-LoD1.obj",
    path="MODEL/UAVD4L-LoD1.obj",
    sha256="f045255d3689f9cb4fd4f2dac67ffad6bea585f5a1d9e7a5628fb069d5d4ec83",
    num_bytes=3_151_818,
)

UAVD4L_LODV2 = replace(
    UAVD4L_LOD,
    id="uavd4l_lodv2",
    title="UAVD4L-LoDv2",
    lod="1",
    city_files=("UAVD4L-LoD1.obj", "move22.obj", "UAVD4L-LoDv2.obj"),
    unreadable_city_files=("move22.osgb", "move22.blend"),
    hosts=(
        layout.QUERIES,
        layout.Host("city model", _LOD1.url, "or: lodbench dataset download uavd4l_lodv2"),
    ),
    downloads=(_LOD1,),
    year="2025",
)


_SWISS_SPLITS = (
    layout.SplitSpec(
        "in_place",
        ("Swiss-EPFL/inPlace", "Swiss-EPFLv2/inPlace", "UAVD4L-LoD/Swiss_in", "inPlace", "Swiss_in"),
        ("Swiss_inPlace_test.json",),
        prior_files=("inPlace_gps_newAll.txt",),
        num_queries=712,
        prior_median=(17.6, 3.87),
    ),
    layout.SplitSpec(
        "out_of_place",
        ("Swiss-EPFL/outPlace", "Swiss-EPFLv2/outPlace", "UAVD4L-LoD/Swiss_out", "outPlace", "Swiss_out"),
        ("Swiss_outPlace_test.json",),
        prior_files=("outPlace_gps_newAll.txt",),
        num_queries=379,
        prior_median=(17.9, 3.94),
    ),
    layout.SplitSpec(
        "synthetic",
        ("Swiss-EPFL/Synthesis", "Swiss-EPFLv2/Synthesis", "Synthesis"),
        ("Swiss_train.json", "train.json"),
        is_test=False,
    ),
)

SWISS_EPFL = layout.PublishedSpec(
    id="swiss_epfl",
    title="Swiss-EPFL",
    lod="2",
    folder="Swiss-EPFL",
    splits=_SWISS_SPLITS,
    city_files=("Swiss-EPFL-LoD.obj", "Swiss-EPFL.obj"),
    unreadable_city_files=("Swiss-EPFL.osgb", "Swiss-EPFL-LoD.blend"),
    ecef=SWISS_EPFL_FRAME,
    hosts=(layout.QUERIES, layout.MODEL_WITH_QUERIES),
)


_NOT_RELEASED = layout.Host(
    "city model",
    "https://github.com/VictorZoo/LoD-Loc-v2/issues/2",
    "not released as of 2025-12-06: ask there",
)

SWISS_EPFLV2 = replace(
    SWISS_EPFL,
    id="swiss_epflv2",
    title="Swiss-EPFLv2",
    lod="1",
    city_files=("swiss_LoD1_final.obj", "Swiss-EPFL-LoD1.obj", "Swiss-EPFLv2.obj"),
    unreadable_city_files=("swiss_LoD1_final.osgb",),
    hosts=(layout.QUERIES, _NOT_RELEASED),
    year="2025",
)

LODLOC = {spec.id: spec for spec in (UAVD4L_LOD, UAVD4L_LODV2, SWISS_EPFL, SWISS_EPFLV2)}


def open_lodloc(params: PublishedParams) -> Dataset:
    """Returns the one of LoD-Loc's datasets that the parameters name; see ``open_published``."""
    return open_published(LODLOC[params.name], params)
