"""What must hold of a checkpoint before a library opens it: its weights are safetensors of its own."""

from __future__ import annotations

from pathlib import Path

from lodbench.errors import ConfigError
from lodbench.storage.json_text import parse_json

# Where a checkpoint in parts says which file holds what.
_INDEX = "model.safetensors.index.json"
_FRACTIONS = frozenset({"F64", "F32", "F16", "BF16"})
# Other names are those of tables of positions and counts of batches, which are whole.
_WEIGHTS = (".weight", ".bias")


def require_own_safetensors(folder: Path) -> None:
    """Makes sure that the weights of a folder are safetensors within it, and not quantised.

    Raises:
        ConfigError: The index names another file, or weights are whole numbers: without the scale that they
            were quantised by they mean nothing.
    """
    for name in _parts(folder / _INDEX):
        if Path(name).name != name or not name.endswith(".safetensors"):
            raise ConfigError(
                f"{folder / _INDEX} names {ascii(name)[1:-1][:80]}, no safetensors file beside it.",
                "Fetch the checkpoint again, from somebody you trust.",
            )
    for path in sorted(folder.glob("*.safetensors")):
        whole = _whole_numbers(path)
        if whole:
            raise ConfigError(
                f"{path} has {len(whole)} weights of whole numbers, the first is {whole[0]}.",
                "Quantised checkpoints are not read: fetch the one in 16 or 32 bits.",
            )


def _parts(index: Path) -> list[str]:
    """Returns the files that an index names; none where there is no index.

    Raises:
        ConfigError: It is none.
    """
    if not index.is_file():
        return []
    try:
        stored = parse_json(index.read_text(encoding="utf-8"))
        return sorted({str(name) for name in stored["weight_map"].values()})
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigError(f"{index} is no index of weights.", "Fetch the checkpoint again.") from error


def _whole_numbers(path: Path) -> list[str]:
    """Returns the names of a safetensors file's weights that are whole numbers; of no such file, none."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "np") as stored:
            names = [name for name in stored.keys() if name.endswith(_WEIGHTS)]
            return [name for name in names if stored.get_slice(name).get_dtype() not in _FRACTIONS]
    except (OSError, SafetensorError):
        return []  # whoever loads it says what is wrong
