"""The demo's textured map and posed pictures, made in the cache when first asked for."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from lodbench.citymodel import open_scene
from lodbench.storage import digest_of, file_digest, make_folder, new_folder
from lodbench.synthesis.survey.textured_map import write_textured_map
from lodbench.synthesis.town.build import CITY_FILE
from lodbench.synthesis.town.looks import look_named
from lodbench.synthesis.town.town import grow_town

MAP_FILE = "textured_map.glb"


def textured_map_of_demo(root: Path, seed: int, look: str) -> Path:
    """Returns the textured map of a demo's town, made first if it is not there: minutes, once.

    Args:
        root: The demo's folder.
        seed: Of its town.
        look: Of its town.
    """
    folder = root.with_name(f"{root.name}-survey-{survey_digest()}")
    if not folder.is_dir():
        town = grow_town(seed, look_named(look))
        make_folder(folder.parent)
        # Another process that is as quick leaves a folder of the same bytes.
        with new_folder(folder) as building:
            write_textured_map(building / MAP_FILE, town, open_scene(root / CITY_FILE, lod="1"))
    return folder / MAP_FILE


@cache
def survey_digest() -> str:
    """Returns a digest of the code that makes them; that of the town is in the demo's own name."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return digest_of([file_digest(file) for file in files], length=8)
