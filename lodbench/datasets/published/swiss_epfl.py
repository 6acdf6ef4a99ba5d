"""``dataset=swiss_epfl``: CrossLoc's drone photos over an LoD2 model; see data_cards/swiss_epfl.md."""

from __future__ import annotations

from lodbench.datasets.published.open import PublishedParams, open_published
from lodbench.datasets.published.spec import MODEL_WITH_QUERIES, QUERIES, PublishedSpec, SplitSpec
from lodbench.datasets.query import Dataset
from lodbench.geometry.similarity import SWISS_EPFL_FRAME

SPLITS = (
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

SPEC = PublishedSpec(
    id="swiss_epfl",
    title="Swiss-EPFL",
    lod="2",
    folder="Swiss-EPFL",
    splits=SPLITS,
    city_files=("Swiss-EPFL-LoD.obj", "Swiss-EPFL.obj"),
    unreadable_city_files=("Swiss-EPFL.osgb", "Swiss-EPFL-LoD.blend"),
    ecef=SWISS_EPFL_FRAME,
    photo_crs=None,
    hosts=(QUERIES, MODEL_WITH_QUERIES),
)


def open_dataset(params: PublishedParams) -> Dataset:
    """Returns the dataset; see ``open_published``."""
    return open_published(SPEC, params)
