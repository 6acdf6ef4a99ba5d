"""The card of the demo town: what is made up in it and how, from the numbers that make it."""

from __future__ import annotations

import json

from lodbench.synthesis.demo import DemoParams
from lodbench.synthesis.town.citygml_writer import CRS_NAME
from lodbench.synthesis.town.queries import PRIORS, QUERY_CAMERA, TARGET_IOU
from lodbench.synthesis.town.town import TOWN_VERSION

DEMO = "demo"
_WHERE = {"in_place": "lines of flight over the old town", "out_of_place": "free views of another district"}


def demo_card_markdown() -> str:
    """Returns the card of ``dataset=demo`` as Markdown with a YAML head."""
    params = DemoParams()
    half = params.num_queries // 2
    counts = {"in_place": params.num_queries - half, "out_of_place": half}
    head = {
        "id": DEMO,
        "kind": "dataset",
        "title": "The demo town",
        "publisher": "lodbench",
        "licence": "That of lodbench, Apache-2.0: every byte is made by its code",
        "format": "poses and intrinsics as text, photos as JPEG, masks as PNG, city model as CityGML 2.0",
        "lods": ["1", "2", "3"],
        "crs": CRS_NAME,
        "version": f"town {TOWN_VERSION}",
        "splits": counts,
    }
    yaml = [f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in head.items()]
    rows = [
        f"| {split} | {counts[split]} | {_WHERE[split]} | {PRIORS[split].describe()} | "
        f"{mean:.2f}, +-{spread:.2f} |"
        for split, (mean, spread) in TARGET_IOU.items()
    ]
    table = ["| split | queries | photos | priors | IoU of the masks |", "|---|--:|---|---|---|", *rows]
    paragraphs = [*_ABOUT, "\n".join(table), *_REST]
    return "\n".join(["---", *yaml, "---", ""]) + "\n" + "\n\n".join(paragraphs) + "\n"


_ABOUT = (
    "# The demo town",
    f"Drawn photos of {QUERY_CAMERA.width} x {QUERY_CAMERA.height} pixels with true and rough poses over a "
    "made-up town in three levels of detail. It shows that everything works, and tells methods apart; it "
    "says nothing about how well one does on real photos.",
    "## How to get it",
    "`dataset=demo` makes it on first use and keeps it in the cache; `lodbench dataset make-demo DIR` writes "
    "it to a folder. The same seed gives the same bytes. `dataset=demo_train` is another town, with other "
    "streets, roofs, colours and light, to train on and never to test on.",
    "## Splits",
)
_REST = (
    "## Provenance",
    "A generator draws streets, blocks, houses, landmarks, trees and cars on a hilly ground from one seed. "
    "The photos show the town in LoD3 with its props, sun, haze and noise. The LoD1 and LoD2 map is an older "
    "survey: about 5 % of the buildings are new and not in it, 4 % are gone, up to 8 % were raised since, "
    "and the heights of its LoD1 blocks are off by 0.5 m (sigma).",
    "## True poses",
    "Those the photos were drawn from. Uncertainty: none.",
    "## Priors",
    "Uniform errors around the truth within the half widths above: in place those of the published Swiss "
    "priors, out of place wider, so that a search around the prior is not enough.",
    "## What to know",
    "- The photos are drawn: what a network scores on them is no forecast for photos of a real drone.\n"
    "- `masks/` holds the true silhouette less what trees and cars hide, degraded to the IoU above. "
    "`segmenter=masks` reads them; the tables name the segmenter.\n"
    "- The priors out of place were widened after looking at a method's score, so that methods differ. "
    "Recall out of place is no forecast of the paper's.\n"
    "- Results of two versions of the town do not compare; every row says which it is.",
)
