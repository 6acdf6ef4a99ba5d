"""``dataset=views``: seeded drone views of any city, each with a mask as wrong as a network's.

The same views, masks and priors as `lodbench bench accuracy` draws, written once to the cache in the
text layout, so that every command that takes a dataset can run on a city that has no photos.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from lodbench.citymodel.cache import open_cached_city
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.priors import UniformPrior
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError, DatasetError
from lodbench.rendering import Renderer, make_renderer
from lodbench.storage import digest_of, make_folder, new_folder, random_stream
from lodbench.storage.paths import cache_root
from lodbench.synthesis.mask_degradation import degrade_mask
from lodbench.synthesis.mask_degradation import mask_iou as iou_of
from lodbench.synthesis.queries import SyntheticQuery, write_queries
from lodbench.synthesis.view_sampling import FINE_SIZE, RGB_CAMERA, ViewSampling, sample_views

# Raised whenever the same settings would draw something else.
VIEWS_VERSION = 1
SPLIT = "views"


@dataclass(frozen=True, slots=True)
class ViewsParams:
    """Settings of ``dataset=views``.

    Attributes:
        city_model: City model: a file, an archive, or a folder of tiles.
        num_views: Views over the city; asking for more keeps the first ones.
        mask_iou: IoU of each query mask with the silhouette at the truth.
        tilt_deg: Half width of the priors' error in pitch and in roll, degrees.
        views_seed: Seed of views, masks and priors.
        lod: Level of detail to localise against; None for the lowest.
        mask_lod: Level of detail that views and masks are drawn from; None for ``lod``.
        crs: CRS of the city model, where its file says none or a wrong one.
        roof_height: Rule by which an absent level 1 is derived: median, max, p70 or eave.
        name: Name to report.
        layers: What to see besides buildings, see ``LAYERS``.
    """

    city_model: str
    num_views: int = 100
    mask_iou: float = 0.88
    tilt_deg: float = 1.0
    views_seed: int = 0
    lod: str | None = None
    mask_lod: str | None = None
    crs: str | None = None
    roof_height: str | None = None
    name: str = "views"
    layers: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.num_views < 1:
            raise ConfigError(f"dataset.num_views={self.num_views} is not a number of views.")
        if not 0 < self.mask_iou <= 1:
            raise ConfigError(f"dataset.mask_iou lies in (0, 1], not {self.mask_iou}.")
        if not 0 <= self.tilt_deg <= 30:
            raise ConfigError(f"dataset.tilt_deg lies within 0 and 30, not {self.tilt_deg}.")

    def prior(self) -> UniformPrior:
        """Returns the errors of the priors: the published ones, with this tilt."""
        return UniformPrior(pitch_deg=self.tilt_deg, roll_deg=self.tilt_deg)


def draw_queries(
    scene: Scene,
    renderer: Renderer,
    num_views: int,
    mask_iou: float,
    prior: UniformPrior,
    seed: int,
    area_m: tuple[float, float, float, float] | None = None,
) -> tuple[list[SyntheticQuery], int]:
    """Returns the queries of a city, and how many draws of views were rejected.

    Query i depends on the seed, the area and i only: asking for more keeps the first ones.

    Args:
        scene: What masks are drawn from.
        renderer: Renders it.
        num_views: How many.
        mask_iou: IoU of each mask with the silhouette at the truth.
        prior: Errors of the priors.
        seed: Seed of views, masks and priors.
        area_m: West, south, east and north bounds of what the views look at, scene metres; None for all.

    Raises:
        DatasetError: No views can be drawn over the city.
    """
    camera = RGB_CAMERA.scaled(*FINE_SIZE)
    views = sample_views(
        scene, renderer, camera, ViewSampling(seed=seed, area_m=area_m), num_views, "accuracy"
    )
    queries = []
    for index, truth in enumerate(views.poses):
        name = f"view_{index:04d}"
        clean = renderer.render(camera, truth)
        rough, _ = degrade_mask(clean, mask_iou, random_stream(seed, "accuracy", name, "mask"))
        start = prior.draw(truth, random_stream(seed, "accuracy", name, "prior"))
        queries.append(SyntheticQuery(name, truth, start, rough, iou_of(rough, clean)))
    return queries, views.rejections


def open_views(params: ViewsParams) -> Dataset:
    """Returns the dataset of seeded views of a city; draws them first if the cache does not hold them.

    Raises:
        LodbenchError: The city cannot be read, or no views can be drawn over it.
    """
    city = Path(params.city_model).expanduser()
    if not city.exists():
        raise DatasetError(f"The city model {city} does not exist.", "Set dataset.city_model=FILE.")
    options = ReadOptions(crs=params.crs, layers=tuple(params.layers))
    lod = params.mask_lod or params.lod
    scene = open_cached_city(city, lod=lod, options=options, roof_height=params.roof_height).scene
    of_the_scene = ("city_model", "lod", "crs", "name", "layers")  # its digest says it
    drawn = {key: value for key, value in asdict(params).items() if key not in of_the_scene}
    key = digest_of([VIEWS_VERSION, drawn, scene.digest(), scene.origin.tolist()])
    root = cache_root() / "views" / key
    if not root.is_dir():
        make_folder(root.parent)
        renderer = make_renderer("silhouette", scene, None)
        queries, _ = draw_queries(
            scene, renderer, params.num_views, params.mask_iou, params.prior(), params.views_seed
        )
        with new_folder(root) as building:
            write_queries(building / SPLIT, queries, RGB_CAMERA, scene.origin)
    same = {key: getattr(params, key) for key in ("lod", "crs", "roof_height", "name", "layers")}
    folder = open_folder(FolderParams(str(root), str(city), **same))
    return replace(folder, version=f"views {VIEWS_VERSION}, seed {params.views_seed}")
