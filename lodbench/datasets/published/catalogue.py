"""The published datasets by name: cards, and files with an address.

Cards are prose and facts in ``data_cards/NAME.md``, installed beside lodbench. Downloads are resumed, capped,
checked against their SHA-256, never half there.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from lodbench.datasets.published import anyvisloc
from lodbench.datasets.published.egeniouss_ortholoc import EGENIOUSS, ORTHOLOC
from lodbench.datasets.published.layout import Download, Part, PublishedSpec
from lodbench.datasets.published.lodloc import LODLOC
from lodbench.datasets.published.uavd4l_tokyo_semcity import SEMCITYLOCKED, TOKYO_LODV3, UAVD4L
from lodbench.errors import ConfigError, DatasetError, nearest_names
from lodbench.storage.disk import disk, make_folder

_OTHERS = (TOKYO_LODV3, UAVD4L, EGENIOUSS, ORTHOLOC, anyvisloc.SPEC, SEMCITYLOCKED)
SPECS: dict[str, PublishedSpec] = LODLOC | {spec.id: spec for spec in _OTHERS}


def spec_of(name: str) -> PublishedSpec:
    """Returns the spec of a dataset.

    Raises:
        ConfigError: There is none of that name.
    """
    if name not in SPECS:
        raise ConfigError(f"There is no published dataset {name!r}.", nearest_names(name, SPECS))
    return SPECS[name]


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
        match = re.search(
            rf"^## {re.escape(title)}\n+(.*?)\s*(?=^## |\Z)", self.text, re.DOTALL | re.MULTILINE
        )
        if match is None:
            raise DatasetError(f"The card of {self.name} has no section {title!r}.")
        return match[1]


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


_CHUNK_BYTES = 1 << 16
_TIMEOUT_S = 30
_PARTIAL, _OK = 206, 200


def fetch(
    download: Download, root: Path, progress: Callable[[int, int], None] | None = None
) -> tuple[Path, bool]:
    """Returns where a file is, and whether it was fetched; one that is there and right is left alone.

    An interrupted download goes on where it stopped: its beginning waits beside it, as ``.part``.

    Raises:
        DatasetError: The server cannot be reached, sends more than the file has, or something else; or
            another file stands in its place. Nothing is left under the file's name then.
    """
    try:
        import pooch
    except ImportError as error:
        raise DatasetError(
            "Downloading needs pooch.", "pip install 'lodbench[download]', or put the file there by hand."
        ) from error
    target = root / download.path
    if target.exists():
        if pooch.file_hash(str(target), alg="sha256") == download.sha256:
            return target, False
        raise DatasetError(
            f"{target} is another file than the published one.", "Move it away to fetch that one."
        )
    make_folder(target.parent)
    # pooch keeps the file's name free until the checksum is right.
    pooch.get_logger().setLevel("WARNING")
    try:
        pooch.retrieve(
            download.url,
            known_hash=f"sha256:{download.sha256}",
            fname=target.name,
            path=target.parent,
            downloader=_Resumed(target, download.num_bytes, progress),
        )
    except ValueError as error:  # pooch's word for a wrong checksum
        disk().remove(_partial_of(target))
        raise DatasetError(
            f"{download.url} is not the published file: its SHA-256 differs.",
            "Try again; if it stays so, the publisher changed the file.",
        ) from error
    disk().remove(_partial_of(target))
    return target, True


def _partial_of(target: Path) -> Path:
    return target.with_name(f".{target.name}.part")


class _Resumed:
    """A downloader for pooch that goes on where an earlier attempt stopped, and stops at a size.

    Args:
        target: Where the file will be; what is there of it lies beside.
        num_bytes: Size of the file: no byte more is taken.
        progress: Called with the bytes that are there and their total.
    """

    def __init__(self, target: Path, num_bytes: int, progress: Callable[[int, int], None] | None) -> None:
        self._target, self._num_bytes, self._progress = target, num_bytes, progress

    def __call__(self, url: str, output_file: str, pooch: Any) -> None:
        """Writes the file of an address to ``output_file``."""
        import requests

        partial = _partial_of(self._target)
        try:
            self._append(url, partial)
        except requests.RequestException as error:
            raise DatasetError(
                f"{url} cannot be fetched: {_reason(error)}.", "The same command goes on where it stopped."
            ) from error
        disk().rename(partial, Path(output_file))

    def _append(self, url: str, partial: Path) -> None:
        import requests

        have = partial.stat().st_size if partial.exists() else 0
        if have >= self._num_bytes:
            return
        headers = {"Range": f"bytes={have}-", "Accept-Encoding": "identity"} if have else {}
        with requests.get(url, headers=headers, stream=True, timeout=_TIMEOUT_S) as response:
            response.raise_for_status()
            if response.status_code != _PARTIAL:
                have = 0  # the server sends all of it again
            with partial.open("ab" if have else "wb", buffering=0) as stream:
                for chunk in response.iter_content(_CHUNK_BYTES):
                    have += len(chunk)
                    if have > self._num_bytes:
                        break
                    disk().write(stream, chunk, partial)
                    if self._progress is not None:
                        self._progress(have, self._num_bytes)
        if have > self._num_bytes:
            disk().remove(partial)
            raise DatasetError(
                f"{url} sends more than the {self._num_bytes:,} bytes that the file has.", "Nothing was kept."
            )
        if have < self._num_bytes:
            raise requests.ConnectionError(f"it ended after {have:,} of {self._num_bytes:,} bytes")


def _reason(error: Exception) -> str:
    """Returns what went wrong, without the address that the message names already."""
    response = getattr(error, "response", None)
    if response is not None:
        return f"the server answers {response.status_code} {response.reason}"
    text = str(error)
    return text if text.startswith("it ended") else type(error).__name__
