"""What `lodbench bench accuracy` and its kin draw: views, masks as wrong as a network's, and priors."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lodbench.citymodel import Scene
from lodbench.datasets.priors import UniformPrior
from lodbench.errors import ConfigError
from lodbench.synthesis.view_sampling import FINE_SIZE

# The halves of a city's bounding box: tune on one, report on the other.
AREAS = ("west", "east", "south", "north")


@dataclass(frozen=True, slots=True)
class AccuracyOptions:
    """What to measure.

    Attributes:
        num_views: Views over the city.
        mask_iou: IoU of each query mask with the silhouette at the truth.
        tilt_deg: Half width of the prior's error in pitch and in roll, degrees, where tilt=prior.
        range_m: Half width of the prior's error along x, y and z, metres; None for the published ones.
        height_m: The same along z alone; None for ``range_m``.
        seeds: Seeds of views, masks, priors and methods; each draws ``num_views`` views of its own.
        mask_lod: Level of detail that views and masks are drawn from; None for ``map_lod``.
        map_lod: Level of detail that is searched; None for the lowest there is.
        area: The half of the city that views look at the middle of, one of ``AREAS``; None for all of it.
        threads: Threads of the engine; None for one per core. Results do not depend on it.
    """

    num_views: int = 200
    mask_iou: float = 0.88
    tilt_deg: float = 1.0
    range_m: float | None = None
    height_m: float | None = None
    seeds: tuple[int, ...] = (0,)
    mask_lod: str | None = None
    map_lod: str | None = None
    area: str | None = None
    threads: int | None = None

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ConfigError(f"seeds are one or more different numbers, not {list(self.seeds)}.")
        if self.num_views < 1:
            raise ConfigError(f"num_views is at least 1, not {self.num_views}.")
        if not 0 < self.mask_iou <= 1:
            raise ConfigError(f"mask_iou lies in (0, 1], not {self.mask_iou}.")
        if not 0 <= self.tilt_deg <= 30:
            raise ConfigError(f"tilt_deg lies within 0 and 30, not {self.tilt_deg}.")
        if self.area is not None and self.area not in AREAS:
            raise ConfigError(f"area is one of {', '.join(AREAS)}, not {self.area}.")

    def prior(self, tilt: str = "prior") -> UniformPrior:
        """Returns the errors of the priors: the published ones, with this tilt and range.

        Args:
            tilt: ``truth`` for priors whose tilt has no error.
        """
        tilt_deg = self.tilt_deg if tilt == "prior" else 0.0
        prior = UniformPrior(pitch_deg=tilt_deg, roll_deg=tilt_deg)
        if self.range_m is not None:
            prior = replace(prior, x_m=self.range_m, y_m=self.range_m, z_m=self.range_m)
        return prior if self.height_m is None else replace(prior, z_m=self.height_m)

    def area_m(self, scene: Scene) -> tuple[float, float, float, float] | None:
        """Returns the bounds (west, south, east, north) of the area in a scene, metres; None for all."""
        if self.area is None:
            return None
        (west, south), (east, north) = scene.vertices[:, :2].min(axis=0), scene.vertices[:, :2].max(axis=0)
        x, y = 0.5 * (float(west) + float(east)), 0.5 * (float(south) + float(north))
        halves = {
            "west": (west, south, x, north),
            "east": (x, south, east, north),
            "south": (west, south, east, y),
            "north": (west, y, east, north),
        }
        w, s, e, n = halves[self.area]
        return float(w), float(s), float(e), float(n)

    def protocol(self) -> str:
        """Returns in words what is drawn."""
        prior, (width, height) = self.prior(), FINE_SIZE
        return (
            f"masks of {width} x {height} degraded to IoU {self.mask_iou:g}, priors +-{prior.x_m:g}/"
            f"+-{prior.y_m:g}/+-{prior.z_m:g} m and +-{prior.yaw_deg:g} deg yaw, with tilt=prior "
            f"+-{self.tilt_deg:g} deg pitch and roll, {_seeds_in_words(self.seeds)}"
            + (f", {self.area}ern half of the city" if self.area else "")
        )


def _seeds_in_words(seeds: tuple[int, ...]) -> str:
    return f"seed {seeds[0]}" if len(seeds) == 1 else "seeds " + ", ".join(str(seed) for seed in seeds)
