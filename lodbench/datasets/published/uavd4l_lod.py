"""``dataset=uavd4l_lod``: UAVD4L-LoD, drone photos over an LoD3 model; see data_cards/uavd4l_lod.md."""

from __future__ import annotations

from lodbench.datasets.published.open import PublishedParams, open_published
from lodbench.datasets.published.spec import MODEL_WITH_QUERIES, QUERIES, PublishedSpec, SplitSpec
from lodbench.datasets.query import Dataset

SPLITS = (
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

SPEC = PublishedSpec(
    id="uavd4l_lod",
    title="UAVD4L-LoD",
    lod="3",
    folder="UAVD4L-LoD",
    splits=SPLITS,
    city_files=("UAVD4L-LoD.obj",),
    unreadable_city_files=("UAVD4L-LoD.osgb", "UAVD4L-LoD.blend"),
    ecef=None,
    photo_crs="EPSG:4547",
    hosts=(QUERIES, MODEL_WITH_QUERIES),
)


def open_dataset(params: PublishedParams) -> Dataset:
    """Returns the dataset; see ``open_published``."""
    return open_published(SPEC, params)
