"""The views that networks are measured on: of a built-in town, made on first use, kept in the cache."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from lodbench.errors import ConfigError, nearest_names
from lodbench.storage import digest_of, file_digest
from lodbench.storage.paths import cache_root
from lodbench.synthesis.demo import DemoParams, DemoTrainParams, demo_folder
from lodbench.synthesis.town.build import FINE_CITY_FILE, PROPS_FILE
from lodbench.synthesis.training_data import generate
from lodbench.synthesis.training_data.generate import generate_training_data
from lodbench.synthesis.training_data.params import GenerateParams

TOWNS: dict[str, DemoParams] = {"test": DemoParams(), "train": DemoTrainParams()}
# Draws per view that is kept; what else a view must show is in ``_settings``.
_DRAWS = 2.5
_SEED = 7


class TownSets(NamedTuple):
    """Two training sets of the same views."""

    data: Path
    visible: Path


def town_sets(town: str, num_views: int, workers: int | None = None) -> TownSets:
    """Returns views of a town with masks, and the visible parts of these masks.

    Args:
        town: ``test``, whose look no training has seen, or ``train``.
        num_views: So many views, fewer where not so many show buildings.
        workers: Processes; None for one per core.

    Raises:
        LodbenchError: There is no such town, the number is none, or the cache cannot be written.
    """
    if town not in TOWNS:
        raise ConfigError(f"There is no town {town}.", nearest_names(town, TOWNS))
    if num_views < 1:
        raise ConfigError(f"views={num_views} is not a number of views.")
    root = demo_folder(TOWNS[town])
    folder = cache_root() / "bench" / f"{town}-town-{num_views}-views-{_digest(root)}"
    params = _settings(root, folder / f"{town}-town", num_views, workers)
    visible = replace(params, out=str(folder / "visible"), occluders_in_mask=True, images=False)
    for wanted in (params, visible):
        generate_training_data(wanted)
    return TownSets(Path(params.out), Path(visible.out))


def _settings(root: Path, out: Path, num_views: int, workers: int | None) -> GenerateParams:
    return GenerateParams(
        city=str(root / FINE_CITY_FILE),
        out=str(out),
        lod="3",
        props=str(root / PROPS_FILE),
        sampling="random",
        pitch=[20.0, 30.0, 40.0, 50.0, 60.0],
        height=[70.0, 90.0, 110.0, 130.0, 150.0],
        count=round(_DRAWS * num_views),
        limit=num_views,
        size=(512, 384),
        fov_deg=70.0,
        min_buildings=0.05,
        val_share=0.0,
        test_share=0.0,
        workers=workers,
        seed=_SEED,
    )


def _digest(root: Path) -> str:
    """Returns a digest of the town and of the code that pictures it: other code, other pictures."""
    code = sorted(Path(generate.__file__).parents[1].rglob("*.py"))
    return digest_of([root.name, [file_digest(file) for file in code]], length=8)
