"""Cards of the published datasets: prose and facts in ``data_cards/NAME.md``, installed beside lodbench."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from lodbench.datasets.published.catalogue import SPECS
from lodbench.datasets.published.spec import Part, PublishedSpec
from lodbench.errors import DatasetError


@dataclass(frozen=True, slots=True)
class Card:
    """What a reader must know before results on a dataset mean anything."""

    name: str
    head: dict[str, Any]
    text: str

    def section(self, title: str) -> str:
        """Returns the text below a heading, up to the next.

        Raises:
            DatasetError: There is no such heading.
        """
        found = re.search(
            rf"^## {re.escape(title)}\n+(.*?)\s*(?=^## |\Z)", self.text, re.DOTALL | re.MULTILINE
        )
        if found is None:
            raise DatasetError(f"The card of {self.name} has no section {title!r}.")
        return found[1]


def read_card(name: str) -> Card:
    """Returns the card of a published dataset.

    Raises:
        DatasetError: There is none, or its head is not JSON.
    """
    if name not in SPECS:
        raise DatasetError(f"There is no card of {name!r}.")
    text = (files("lodbench.data_cards") / f"{name}.md").read_text(encoding="utf-8")
    try:
        _, head, _ = text.split("---\n", 2)
        pairs = (line.split(": ", 1) for line in head.splitlines())
        return Card(name, {key: json.loads(value) for key, value in pairs}, text)
    except ValueError as error:
        raise DatasetError(f"The head of data_cards/{name}.md cannot be read: {error}.") from error


_CROISSANT = "http://mlcommons.org/croissant/1.0"
_POSE_FIELDS = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")
_WORD = r"(\S+)"
# Terms of Croissant's vocabulary, as the JSON-LD context that it prescribes lists them.
_TERMS = """
arrayShape citeAs column containedIn equivalentProperty extract field fileProperty fileObject fileSet format
includes isArray isLiveDataset jsonPath key md5 parentField path recordSet references regex repeated replace
samplingRate separator source subField transform
"""


def card_croissant(card: Card) -> dict[str, Any]:
    """Returns a card as Croissant 1.0 JSON-LD: what the files are, and how to read poses from them."""
    spec, head = SPECS[card.name], card.head
    sets = [
        ("true-poses", "GT_pose.txt", "True poses, world to camera."),
        ("priors", "GPS_pose.txt", "Rough poses, world to camera."),
    ]
    if spec.parts:
        sets, files = [], [_file_set(_id_of(part), part.place, part.what, part.media) for part in spec.parts]
    else:
        files = [*(_file_set(id_, f"**/{name}", what) for id_, name, what in sets), _image_set()]
    kind = "photos" if spec.parts else "drone photos"
    over = spec.map_words if spec.parts else f"an LoD{spec.lod} city model"
    return {
        "@context": _context(),
        "@type": "sc:Dataset",
        "conformsTo": _CROISSANT,
        "name": spec.id,
        "description": f"{spec.title}: {kind} with poses over {over}. "
        f"{card.section('Provenance')} True poses: {card.section('True poses')}",
        "license": head["licence_url"],
        "usageInfo": head["licence"],
        "url": head["licence_url"],
        "citeAs": head["citation"],
        "creator": [{"@type": "sc:Person", "name": name} for name in head["creators"]],
        "version": "1.0.0",
        "datePublished": spec.year,
        "isLiveDataset": True,
        "distribution": [*_file_objects(spec), *files],
        "recordSet": [_split_records(spec), *(_pose_records(*item) for item in sets)],
    }


def croissant_text(card: Card) -> str:
    """Returns the JSON-LD as the text of a file."""
    return json.dumps(card_croissant(card), indent=2, ensure_ascii=False) + "\n"


def _file_objects(spec: PublishedSpec) -> list[dict[str, Any]]:
    folder = {
        "@type": "cr:FileObject",
        "@id": "download",
        "name": "download",
        "description": "The publishers' folder; it has no checksum, and is fetched by hand.",
        "contentUrl": spec.hosts[0].url,
        "encodingFormat": "application/zip",
    }
    files = [
        {
            "@type": "cr:FileObject",
            "@id": download.path,
            "name": download.path,
            "contentUrl": download.url,
            "contentSize": f"{download.num_bytes} B",
            "encodingFormat": "model/obj",
            "sha256": download.sha256,
        }
        for download in spec.downloads
    ]
    return [folder, *files]


def _id_of(part: Part) -> str:
    return re.sub(r"\W+", "-", part.what)


def _file_set(id_: str, pattern: str, description: str, media: str = "text/plain") -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": f"{id_}-files",
        "name": f"{id_}-files",
        "description": description,
        "containedIn": {"@id": "download"},
        "encodingFormat": media,
        "includes": pattern,
    }


def _image_set() -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": "photos",
        "name": "photos",
        "containedIn": {"@id": "download"},
        "encodingFormat": "image/jpeg",
        "includes": "**/Query_image/*",
    }


def _split_records(spec: PublishedSpec) -> dict[str, Any]:
    rows = [
        {
            "splits/name": split.name,
            "splits/folder": split.folders[0],
            "splits/queries": split.num_queries or 0,
        }
        for split in spec.splits
    ]
    types = {"name": "sc:Text", "folder": "sc:Text", "queries": "sc:Integer"}
    return {
        "@type": "cr:RecordSet",
        "@id": "splits",
        "name": "splits",
        "description": "Splits; queries as the papers' percentages imply, 0 where that is not known.",
        "dataType": "cr:Split",
        "key": {"@id": "splits/name"},
        "field": [_field("splits", name, data_type) for name, data_type in types.items()],
        "data": rows,
    }


def _pose_records(id_: str, name: str, description: str) -> dict[str, Any]:
    fields = []
    for place, field in enumerate(("name", *_POSE_FIELDS)):
        source = {
            "fileSet": {"@id": f"{id_}-files"},
            "extract": {"fileProperty": "lines"},
            "transform": {"regex": r"^" + r"\S+ " * place + _WORD},
        }
        data_type = "sc:Text" if place == 0 else "sc:Float"
        fields.append({**_field(id_, field, data_type), "source": source})
    return {
        "@type": "cr:RecordSet",
        "@id": id_,
        "name": id_,
        "description": f"{description} x_camera = R(q) x_world + t; metres; OpenCV axes.",
        "field": fields,
    }


def _field(record_set: str, name: str, data_type: str) -> dict[str, Any]:
    return {
        "@type": "cr:Field",
        "@id": f"{record_set}/{name}",
        "name": name,
        "dataType": data_type,
    }


def _context() -> dict[str, Any]:
    """Returns the JSON-LD context that Croissant 1.0 prescribes."""
    return {
        "@language": "en",
        "@vocab": "https://schema.org/",
        "cr": "http://mlcommons.org/croissant/",
        "rai": "http://mlcommons.org/croissant/RAI/",
        "sc": "https://schema.org/",
        "dct": "http://purl.org/dc/terms/",
        "conformsTo": "dct:conformsTo",
        "data": {"@id": "cr:data", "@type": "@json"},
        "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
        "examples": {"@id": "cr:examples", "@type": "@json"},
        **{term: f"cr:{term}" for term in _TERMS.split()},
    }
