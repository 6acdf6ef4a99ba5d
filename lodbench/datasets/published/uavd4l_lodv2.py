"""``dataset=uavd4l_lodv2``: the queries of UAVD4L-LoD over LoD1 blocks, whose file has an address."""

from __future__ import annotations

from dataclasses import replace

from lodbench.datasets.published.open import PublishedParams, open_published
from lodbench.datasets.published.spec import QUERIES, Download, Host
from lodbench.datasets.published.uavd4l_lod import SPEC as UAVD4L_LOD
from lodbench.datasets.query import Dataset

LOD1 = Download(
    url="https://raw.githubusercontent.com/VictorZoo/LoD-Loc-v2/"
    "10bfcf89decbb8134395898ddaa763a6a4dad1f2/UAVD4L-LoD1.obj",
    path="MODEL/UAVD4L-LoD1.obj",
    sha256="f045255d3689f9cb4fd4f2dac67ffad6bea585f5a1d9e7a5628fb069d5d4ec83",
    num_bytes=3_151_818,
)

SPEC = replace(
    UAVD4L_LOD,
    id="uavd4l_lodv2",
    title="UAVD4L-LoDv2",
    lod="1",
    city_files=("UAVD4L-LoD1.obj", "move22.obj", "UAVD4L-LoDv2.obj"),
    unreadable_city_files=("move22.osgb", "move22.blend"),
    hosts=(QUERIES, Host("city model", LOD1.url, "or: lodbench dataset download uavd4l_lodv2")),
    downloads=(LOD1,),
    year="2025",
)


def open_dataset(params: PublishedParams) -> Dataset:
    """Returns the dataset; see ``open_published``."""
    return open_published(SPEC, params)
