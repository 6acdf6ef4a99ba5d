"""Cards of the published datasets: the facts, and the Markdown with a YAML head made from them.

The facts stand here once; the files in ``data_cards/`` are made from them (``lodbench dataset card``).
"""

from __future__ import annotations

import json
from dataclasses import dataclass

from lodbench.datasets.published.specs import SPECS, PublishedSpec, SplitSpec


@dataclass(frozen=True, slots=True)
class Card:
    """What a reader must know before results on a dataset mean anything.

    Attributes:
        spec: Files, splits, counts and sources.
        licence: Under which terms, as far as the publishers state any.
        licence_url: Where they are stated.
        creators: Who made it.
        citation: The paper to cite.
        provenance: Where queries and city model come from.
        truth: How the true poses were found.
        truth_uncertainty: How wrong they may be, and how that is known.
        priors: Where priors come from.
        known_issues: What is wrong or open.
    """

    spec: PublishedSpec
    licence: str
    licence_url: str
    creators: tuple[str, ...]
    citation: str
    provenance: str
    truth: str
    truth_uncertainty: str
    priors: str
    known_issues: tuple[str, ...]


_V1 = (
    "Zhu, Yan, Wang, Zhang, Liu, Zhang: LoD-Loc: Visual Localization using LoD 3D Map with Neural "
    "Wireframe Alignment. NeurIPS 2024."
)
_V2 = (
    "Zhu, Peng, Wang, Tan, Liu, Zhang, Yan: LoD-Loc v2: Aerial Visual Localization over Low "
    "Level-of-Detail City Models using Explicit Silhouette Alignment. ICCV 2025."
)
_LICENCE = (
    "Not stated for the data. The code's repository, which links the download, is under the MIT licence; "
    "that of the download itself is not said"
)
_NUDT = ("Juelin Zhu", "Shen Yan", "Long Wang", "Shengyue Zhang", "Yu Liu", "Maojun Zhang")
_EPFL = ("Qi Yan", "Jianhao Zheng", "Simon Reding", "Shanci Li", "Iordan Doytchinov")
_COUNTS = (
    "The papers do not list all counts. Those given here were solved from the two decimals of the tables' "
    "percentages; 2192 is also in a comment of a later release's code."
)
_TILT = (
    "The priors evaluated in the papers most likely have the true pitch and roll: two records printed in "
    "a later release agree with the truth to 0.001 degrees in tilt, and differ in yaw and position. Report "
    "`tilt=prior` and `tilt=truth` apart."
)
_UAVD4L_TRUTH = (
    "The papers call them accurate pose annotations and describe their making in LoD-Loc's appendix and in "
    "UAVD4L's paper; the files do not say how each was found."
)
_UAVD4L_ISSUES = (
    "Where the local frame lies on Earth is withheld for privacy; photos may still carry GPS in their EXIF "
    "(`lodbench dataset check` counts them).",
    "The released script that reads priors from EXIF writes wrong translations, turns the gimbal's roll "
    "about the wrong axis and leaves grid convergence out. `prior=sensor` does not; the published "
    "GPS_pose.txt was not made by it.",
    "In the one published example the second line of GT_pose.txt repeats the first pose; its 4 x 4 file "
    "is right. lodbench takes the matrix and says so (LB513).",
    _TILT,
    _COUNTS,
)
_SWISS_TRUTH = (
    "CrossLoc's: the accurate geo-tags of its drone photos, as camera-to-world matrices; its paper describes "
    "how they were found."
)
_SWISS_ISSUES = (
    "City and poses may come as earth-centred coordinates less those of an origin near Lausanne: then z is "
    "no vertical. lodbench tells by the walls and by the level of the pictures, turns both to east, north, "
    "up, and says so (LB510).",
    "Priors drawn in that frame err along the Earth's axis, not in height.",
    "The published priors are drawn, not measured, and their script has no seed: none can draw them again.",
    _TILT,
    _COUNTS,
)
_UAVD4L_PRIORS = (
    "What DJI's drones state: GPS position and the gimbal's heading; medians in the papers: 6.48 m / "
    "1.63 degrees in, 11.1 m / 0.92 degrees out of trajectory."
)
_SWISS_PRIORS = (
    "Uniform errors around the truth: +-10 m in x and y, +-30 m in z, +-7.5 degrees in yaw, +-1 degree in "
    "pitch and roll; medians in the papers: 17.6 m / 3.87 degrees in, 17.9 m / 3.94 degrees out of place."
)
_UAVD4L_QUERIES = (
    "Photos of DJI drones (wide, zoom, single and thermal cameras) over one district, undistorted; "
    "synthetic views of the UAVD4L mesh for training."
)
_SWISS_QUERIES = (
    "Photos of CrossLoc's urbanscape flights around Lausanne, 720 x 480; synthetic views for training."
)


def _uavd4l(id_: str, model: str, citation: str) -> Card:
    return Card(
        spec=SPECS[id_],
        licence=_LICENCE,
        licence_url="https://github.com/VictorZoo/LoD-Loc",
        creators=_NUDT,
        citation=citation,
        provenance=f"{_UAVD4L_QUERIES} City model: {model}",
        truth=_UAVD4L_TRUTH,
        truth_uncertainty="Not published. On the one public query the model's outlines and image edges agree "
        "to about 0.5 m in x and y; the height is known no better than 2 m there.",
        priors=_UAVD4L_PRIORS,
        known_issues=_UAVD4L_ISSUES,
    )


def _swiss(id_: str, model: str, citation: str) -> Card:
    return Card(
        spec=SPECS[id_],
        licence=_LICENCE,
        licence_url="https://github.com/TOPO-EPFL/CrossLoc-Benchmark-Datasets",
        creators=_EPFL + _NUDT,
        citation=citation,
        provenance=f"{_SWISS_QUERIES} City model: {model}",
        truth=_SWISS_TRUTH,
        truth_uncertainty="Not published for these files.",
        priors=_SWISS_PRIORS,
        known_issues=_SWISS_ISSUES,
    )


CARDS = {
    card.spec.id: card
    for card in (
        _uavd4l("uavd4l_lod", "LoD3, modelled by the authors.", _V1),
        _uavd4l(
            "uavd4l_lodv2",
            "LoD1 blocks, made from the LoD3 model; 31,190 points and about 700 buildings.",
            _V2,
        ),
        _swiss("swiss_epfl", "LoD2, swissBUILDINGS3D of swisstopo.", _V1),
        _swiss("swiss_epflv2", "LoD1, derived from swissBUILDINGS3D.", _V2),
    )
}


def card_markdown(card: Card) -> str:
    """Returns a card as Markdown with a YAML head."""
    spec = card.spec
    head = {
        "id": spec.id,
        "kind": "dataset",
        "title": spec.title,
        "publisher": ", ".join(card.creators),
        "licence": card.licence,
        "format": "poses and intrinsics as text, photos as JPEG and PNG, city model as OBJ",
        "lods": [spec.lod],
        "crs": "local east, north, up in metres"
        + (f"; a shift of {spec.photo_crs}" if spec.photo_crs else ""),
        "splits": {split.name: split.num_queries for split in spec.splits},
        "croissant": f"{spec.id}.croissant.json",
    }
    yaml = [f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in head.items()]
    rows = [_split_row(split) for split in spec.splits]
    body = [
        f"# {spec.title}",
        f"Drone photos with true and rough poses over an LoD{spec.lod} city model. {card.citation}",
        "## How to get it",
        "\n".join(f"- {source.what}: <{source.url}> ({source.how})" for source in spec.sources),
        f"Put it in a folder and look: `lodbench dataset check {spec.id} --root FOLDER`. What goes where: "
        "the same command on an empty folder.",
        "## Splits",
        "\n".join(["| split | folder | queries | priors, median |", "|---|---|--:|---|", *rows]),
        "## Provenance",
        card.provenance,
        "## True poses",
        f"{card.truth} Uncertainty: {card.truth_uncertainty[0].lower()}{card.truth_uncertainty[1:]}",
        "## Priors",
        card.priors,
        "## What to know",
        "\n".join(f"- {issue}" for issue in card.known_issues),
    ]
    return "\n".join(["---", *yaml, "---", ""]) + "\n" + "\n\n".join(body) + "\n"


def _split_row(split: SplitSpec) -> str:
    count = "unknown" if split.num_queries is None else f"{split.num_queries}"
    median = "-"
    if split.prior_median is not None:
        median = f"{split.prior_median[0]:g} m / {split.prior_median[1]:g} deg"
    return f"| {split.name} | `{split.folders[0]}` | {count} | {median} |"
