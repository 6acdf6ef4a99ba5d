"""``dataset=tokyo_lodv3``: Tokyo-LoDv3 of LoD-Loc v3, in LoD-Loc v2's tree; see data_cards/tokyo_lodv3.md."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lodbench.datasets.published.open import PublishedParams, open_published
from lodbench.datasets.published.own_layout import AUTO, choose_reading, pose_lines
from lodbench.datasets.published.spec import Host, PublishedSpec, SplitSpec
from lodbench.datasets.query import Dataset, notes_of
from lodbench.findings import Findings
from lodbench.geometry import Pose

_FLIP = np.diag([1.0, -1.0, -1.0])
_RELEASES = "https://github.com/pppppsb/LoD-Locv3/releases"
SPEC = PublishedSpec(
    id="tokyo_lodv3",
    title="Tokyo-LoDv3",
    lod="1",
    folder="UAVD4L-LoD",
    splits=(SplitSpec("japan_07", ("UAVD4L-LoD/Japan_07", "Japan_07"), ("Japan_07_test.json",)),),
    hosts=(
        Host("queries, poses, priors", _RELEASES, "data.zip; all_colmaps beside UAVD4L-LoD in it"),
        Host(
            "city model",
            _RELEASES,
            "model.zip: a .blend; export it from Blender as OBJ, Z up, then city=FILE",
        ),
    ),
    city_files=("Japan_07.obj",),
    unreadable_city_files=("Japan/Japan_07/Tokeyo_Dingmu_viewpoints_topology_clustered.blend",),
    protocol="lodlocv3",
    year="2026",
)


@dataclass(frozen=True, slots=True)
class TokyoParams(PublishedParams):
    """Settings of Tokyo-LoDv3, described in ``conf/dataset/tokyo_lodv3.yaml``."""

    axes: str = AUTO


def open_tokyo(params: TokyoParams) -> Dataset:
    """Returns Tokyo-LoDv3; world to camera is documented, the camera's axes are not.

    Raises:
        DatasetError: Parts are missing or malformed, or the pictures do not decide the camera's axes.
        ConfigError: A setting is unknown.
    """
    dataset, findings = open_published(SPEC, params), Findings()
    truth = list(dataset.truth.values())
    readings = {"opencv": truth, "opengl": [_flipped(pose) for pose in truth]}
    axes = choose_reading("dataset.axes", params.axes, readings, findings)
    if axes == "opengl":
        entries = tuple(
            replace(
                entry,
                prior=None if entry.prior is None else _flipped(entry.prior),
                hypotheses=tuple(map(_flipped, entry.hypotheses)),
            )
            for entry in dataset.entries
        )
        dataset = replace(
            dataset, entries=entries, truth={key: _flipped(pose) for key, pose in dataset.truth.items()}
        )
    return replace(
        dataset,
        notes=(*dataset.notes, *notes_of(findings)),
        findings=(*dataset.findings, *findings.items),
        submission=partial(pose_lines, names={}, reading=f"w2c_{axes}"),
    )


def _flipped(pose: Pose) -> Pose:
    """Returns the pose of a camera whose y and z axes point the other way."""
    return Pose(_FLIP @ pose.rotation, _FLIP @ pose.translation)
