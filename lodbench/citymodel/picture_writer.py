"""Pictures of surfaces beside the city that is written: copied under names of our own."""

from __future__ import annotations

import io
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.citymodel.model import CityModel
from lodbench.citymodel.texture_pictures import TextureFolder
from lodbench.errors import DatasetError
from lodbench.storage import make_folder, write_bytes

_SUFFIXES = {"JPEG": ".jpg", "PNG": ".png"}
_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9_-]+")
_MAX_STEM = 40


def write_pictures(model: CityModel, target: Path) -> tuple[dict[int, str], tuple[str, ...]]:
    """Writes the pictures that a city's polygons use into a folder beside a file, before that is written.

    JPEG and PNG are copied byte by byte, other formats saved as PNG, which every target knows. Names are a
    number and what is harmless of the name they had.

    Args:
        model: The city.
        target: The file; the folder is called after it, ``NAME_pictures``.

    Returns:
        names: Where each picture lies, as a link from the file, by number.
        notes: A line for each that cannot be read.

    Raises:
        OSError: The folder cannot be written.
    """
    names: dict[int, str] = {}
    written: dict[Path, str] = {}
    notes: list[str] = []
    picture = model.polygons.picture
    if model.pictures is None or picture is None:
        return names, ()
    folder = target.with_name(f"{target.name.partition('.')[0]}_pictures")
    for number in np.unique(picture[picture >= 0]).tolist():
        path = model.pictures.files[number]
        if path in written:
            names[number] = written[path]
            continue
        try:
            content, suffix = _portable(path)
        except DatasetError as error:
            notes.append(f"picture that is not taken: {error.message}")
            continue
        stem = _NOT_IN_NAMES.sub("_", path.stem)[:_MAX_STEM].strip("_")
        name = "_".join(filter(None, (f"{len(written) + 1:04d}", stem))) + suffix
        make_folder(folder)
        write_bytes(folder / name, content)
        # As a link, in which % begins a code.
        names[number] = written[path] = f"{folder.name}/{name}".replace("%", "%25")
    return names, tuple(notes)


def _portable(path: Path) -> tuple[bytes, str]:
    """Returns a picture as JPEG or PNG, and the ending that it gets.

    Raises:
        DatasetError: It is none, or too large.
    """
    folder = TextureFolder(path.parent, path.parent)
    content = folder.read(path.name)
    kind = folder.kind(path.name)
    if kind in _SUFFIXES:
        return content, _SUFFIXES[kind]
    image: Any = import_module("PIL.Image")
    saved = io.BytesIO()
    image.fromarray(folder.picture(path.name)).save(saved, "PNG")
    return saved.getvalue(), ".png"
