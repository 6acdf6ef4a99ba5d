"""What must hold of a checkpoint before a library opens it: its weights are safetensors of its own."""

from __future__ import annotations

from pathlib import Path

from lodbench.errors import ConfigError
from lodbench.storage.json_text import parse_json

_CONFIG = "config.json"
# The weights, and where a checkpoint in parts says which file holds what.
_FILE, _INDEX = "model.safetensors", "model.safetensors.index.json"
_FRACTIONS = frozenset({"F64", "F32", "F16", "BF16"})
# Other names are those of tables of positions and counts of batches, which are whole.
_WEIGHTS = (".weight", ".bias")


def require_own_safetensors(folder: Path) -> None:
    """Makes sure that the weights of a folder are safetensors within it, and not quantised.

    Raises:
        ConfigError: The index or config.json names another file, or weights are whole numbers or of 8 bits:
            without the scale that they were quantised by they mean nothing.
    """
    named, parts = _named(folder / _CONFIG), _parts(folder / _INDEX)
    for source, names in ((_CONFIG, named), (_INDEX, parts)):
        for name in names:
            if Path(name).name != name or not name.endswith(".safetensors"):
                raise ConfigError(
                    f"{folder / source} names {ascii(name)[1:-1][:80]}, no safetensors file beside it.",
                    "Fetch the checkpoint again, from somebody you trust.",
                )
    whole_file = [_FILE] if (folder / _FILE).is_file() else []
    for name in named or whole_file or parts:  # as transformers chooses; others may lie beside them
        whole = _whole_numbers(folder / name)
        if whole:
            raise ConfigError(
                f"{folder / name} has {len(whole)} weights of whole numbers or 8 bits: {whole[0]}, ...",
                "Quantised checkpoints are not read: fetch the one in 16 or 32 bits.",
            )


def _named(config: Path) -> list[str]:
    """Returns the file of weights that a configuration names itself, as a list; none where it does not."""
    try:
        named = parse_json(config.read_text(encoding="utf-8")).get("transformers_weights")
    except (OSError, ValueError, AttributeError):
        return []  # whoever loads it says what is wrong
    return [] if named is None else [str(named)]


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
    """Returns a safetensors file's weights that are whole numbers or of 8 bits; of no such file, none."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "np") as stored:
            names = [name for name in stored.keys() if name.endswith(_WEIGHTS)]
            return [name for name in names if stored.get_slice(name).get_dtype() not in _FRACTIONS]
    except (OSError, SafetensorError):
        return []  # whoever loads it says what is wrong
