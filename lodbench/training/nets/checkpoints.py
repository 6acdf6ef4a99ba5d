"""Checkpoints: everything a training goes on from, whole or not at all; nothing is unpickled."""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Any

import torch

from lodbench.errors import ConfigError
from lodbench.segmentation.nets.weights import read_torch_file
from lodbench.storage import write_bytes

CHECKPOINT_FILE = "checkpoint.pt"


def save_checkpoint(state: dict[str, Any], folder: Path) -> None:
    """Writes the checkpoint of a folder in place of the one there; equal states give the same bytes."""
    content = io.BytesIO()
    torch.save(_rebuilt(state), content)
    write_bytes(folder / CHECKPOINT_FILE, content.getvalue())


def _rebuilt(value: Any) -> Any:
    """Returns a value whose containers are its own and whose equal strings are one.

    The file tells one object met twice from two that are equal, and a state that was read back has
    other objects than one that was never stored.
    """
    if isinstance(value, dict):
        return {_rebuilt(key): _rebuilt(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_rebuilt(item) for item in value)
    return sys.intern(value) if isinstance(value, str) else value


def load_checkpoint(folder: Path, identity: str) -> dict[str, Any] | None:
    """Returns the checkpoint of a folder, or None where there is none.

    Raises:
        ConfigError: It cannot be read, or belongs to other settings, views or code.
    """
    path = folder / CHECKPOINT_FILE
    if not path.exists():
        return None
    try:
        state: dict[str, Any] = read_torch_file(path)
        found = state["identity"]
    except Exception as error:
        raise ConfigError(
            f"{path} is no checkpoint of lodbench train.", "Name another `out=FOLDER`."
        ) from error
    if found != identity:
        raise ConfigError(
            f"{folder} holds the training of other settings, other views or other code.",
            "Name another `out=FOLDER`, or set `resume=false` to start anew there.",
        )
    return state
