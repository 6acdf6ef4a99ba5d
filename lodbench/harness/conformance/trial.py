"""What plug-ins are tried on, seven blocks and three photos of them; rules of what works on the city."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from lodbench.checks import FAULT, OK, Check, fault_of
from lodbench.citymodel.extrude import scene_of_blocks
from lodbench.citymodel.meshing import mesh_model
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.polygons import finish_model
from lodbench.citymodel.raw import RawCity
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.source import Source, open_sources
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import STOPPED, LodbenchError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.methods.conformance.rules import Violation
from lodbench.methods.conformance.trial import BLOCKS, TRUTHS
from lodbench.rendering import DEPTH, LayerRenderer, open_renderer
from lodbench.rendering.masks import pack_mask

# No multiple of 64 wide: packed rows end within a word.
CAMERA = Camera(310, 230, 231.0, 229.0, 156.5, 113.0)


@dataclass(frozen=True, slots=True, eq=False)
class Tried:
    """A plug-in, and what it is tried on.

    Attributes:
        part: The class or function of its entry point.
        name: Its name.
        config: Its section of the configuration; empty for kinds that have none, None where there is none.
        make: Makes it anew from that, for kinds that are made from parameters.
        folder: An empty folder.
        scene: The blocks.
        dataset: Photos, masks, priors and truth; the scene's frame is the dataset's.
        sample: A file that the user named, for readers of formats.
    """

    part: Any
    name: str
    config: Mapping[str, Any] | None
    make: Callable[[], Any]
    folder: Path
    scene: Scene
    dataset: Dataset
    sample: Path | None

    @property
    def entries(self) -> tuple[Entry, ...]:
        """Returns the queries."""
        return self.dataset.entries

    @property
    def truths(self) -> list[Pose]:
        """Returns the true poses, in the queries' order."""
        return [self.dataset.truth[entry.key] for entry in self.entries]


Rules = Sequence[tuple[str, Callable[[], str]]]


def check_rules(rules: Rules) -> Iterator[Check]:
    """Yields how each rule is kept, up to the first that is not: the others build on it."""
    for title, rule in rules:
        try:
            yield Check("answers", title, OK, rule())
            continue
        except Violation as violation:
            yield Check("answers", title, FAULT, str(violation), violation.hint)
        except STOPPED:
            raise
        except BaseException as error:  # a plug-in may raise anything: that is the finding
            yield fault_of(error, "answers", title)
        return


def require(is_kept: bool | np.bool_, detail: str, hint: str = "") -> None:
    """Raises a violation unless a rule is kept."""
    if not is_kept:
        raise Violation(detail, hint)


def refuses(call: Callable[[], object], what: str) -> str:
    """Returns how something wrong is refused: by lodbench's own kind of error, in a line for people.

    Raises:
        Violation: It is not, or by another error.
    """
    try:
        call()
    except LodbenchError as error:
        return f"{type(error).__name__}: {error.message}"
    except STOPPED:
        raise
    except BaseException as error:  # anything else ends a run with a traceback
        raise Violation(
            f"{what} raises {type(error).__name__}: {error}", "Raise an error of lodbench.errors."
        ) from error
    raise Violation(f"{what} is taken without a word", "Raise an error of lodbench.errors.")


def trial_dataset(folder: Path) -> tuple[Scene, Dataset]:
    """Returns the blocks, and a dataset of three views; photos and masks are written to a folder."""
    scene = scene_of_blocks(BLOCKS)
    painter = cast("LayerRenderer", open_renderer("raster", scene, 1))
    entries, truth = [], {}
    for k, (pitch, roll, yaw, *center) in enumerate(TRUTHS):
        pose = Pose.from_euler(EulerAngles(pitch, roll, yaw), center)
        prior = Pose.from_euler(EulerAngles(pitch, roll, yaw + 3.0), pose.center + np.array([5.0, -4.0, 6.0]))
        photo, mask = folder / f"view_{k}.png", folder / f"mask_{k}.png"
        cv2.imwrite(str(photo), painter.draw(CAMERA, pose).colour[:, :, ::-1])
        cv2.imwrite(str(mask), painter.render(CAMERA, pose).astype(np.uint8) * 255)
        entries.append(Entry(photo.name, "trial", CAMERA, prior, photo, mask, (prior,)))
        truth[entries[-1].key] = pose
    return scene, Dataset("trial", "", folder, None, None, ("trial",), tuple(entries), truth)


# Pixels on the outline may be drawn or not: no more of all than this.
_MOST_DIFFERENT = 0.01


def reader_rules(tried: Tried) -> Rules:
    """Returns the rules of a reader of city models, and of a format."""
    reads = getattr(tried.part, "read", tried.part)

    def garbage() -> str:
        def read(data: bytes) -> object:
            return reads(Source("garbage", lambda: io.BytesIO(data), Path("garbage")), ReadOptions())

        refuses(lambda: read(b"\x00\xff" * 3000), "a file of bytes")
        return refuses(lambda: read(b"neither here nor there\n"), "a file of words")

    def scene() -> str:
        if tried.sample is None:
            return "not tried: name a file with --sample FILE"
        digests = []
        for _ in range(2):
            raw = reads(open_sources(tried.sample)[0], ReadOptions())
            require(isinstance(raw, RawCity), f"it returned {type(raw).__name__}", "Return RawCity.")
            digests.append((mesh := mesh_model(finish_model(raw, ReadOptions()), None)).scene.digest())
        require(digests[0] == digests[1], "another city of the same file")
        low, high = mesh.scene.extent_m
        size = " x ".join(f"{side:.0f}" for side in high - low)
        return f"{mesh.scene.num_buildings} buildings, {size} m, the same again"

    return [("no city", garbage), ("sample", scene)]


def renderer_rules(tried: Tried) -> Rules:
    """Returns the rules of a renderer."""
    renderer = _Once(lambda: tried.part(tried.scene, 1))

    def same_again() -> str:
        before = tried.scene.vertices.copy(), tried.scene.triangles.copy()
        fresh = tried.part(tried.scene, 2)
        for pose in tried.truths:
            same = np.array_equal(fresh.render(CAMERA, pose), renderer().render(CAMERA, pose))
            require(same, "another silhouette from two threads, or in another order")
        unchanged = np.array_equal(before[0], tried.scene.vertices) & np.array_equal(
            before[1], tried.scene.triangles
        )
        require(unchanged, "the scene was written to", "Work on a copy.")
        return "made anew and with two threads, the same to the bit; the scene is only read"

    def away() -> str:
        far = Pose.from_center(tried.truths[0].rotation, np.array([9e4, 9e4, 120.0]))
        require(not renderer().render(CAMERA, far).any(), "a silhouette where no building is in view")
        return "nothing is drawn where no building is in view"

    def not_finite() -> str:
        broken = Pose(tried.truths[0].rotation, np.array([0.0, np.nan, 0.0]))
        return refuses(lambda: renderer().render(CAMERA, broken), "a pose that is not finite")

    return [
        ("silhouettes", lambda: _silhouettes(tried, renderer())),
        ("same again", same_again),
        ("nothing in view", away),
        ("depth", lambda: _depth(tried, renderer()) if hasattr(tried.part, DEPTH) else "not offered"),
        ("no pose", not_finite),
    ]


def _silhouettes(tried: Tried, renderer: Any) -> str:
    reference, worst = open_renderer("reference", tried.scene, 1), 0.0
    for pose in tried.truths:
        drawn = renderer.render(CAMERA, pose)
        size = (CAMERA.height, CAMERA.width)
        require(
            drawn.shape == size and drawn.dtype == np.bool_, f"{drawn.shape} {drawn.dtype}", "(H, W) bool"
        )
        worst = max(worst, float(np.mean(drawn != reference.render(CAMERA, pose))))
    require(worst <= _MOST_DIFFERENT, f"{100 * worst:.2f} % of the pixels are not the reference's")
    return f"(H, W) bool; {100 * worst:.2f} % of the pixels at most are not the reference's"


def _depth(tried: Tried, renderer: Any) -> str:
    pose = tried.truths[0]
    found, mask = renderer.depth(CAMERA, pose), renderer.render(CAMERA, pose)
    require(found.shape == mask.shape and found.dtype == np.float32, f"{found.shape} {found.dtype}")
    differing = float(np.mean((found > 0) != mask))
    require(
        differing <= _MOST_DIFFERENT, f"{100 * differing:.1f} % of the pixels: depth here, silhouette not"
    )
    return f"{found[found > 0].min():.1f} to {found.max():.1f} m, 0 beside the buildings"


class _Once:
    """Makes something when it is first requested, and keeps it."""

    def __init__(self, make: Any) -> None:
        self._make, self._made = make, None

    def __call__(self) -> Any:
        if self._made is None:
            self._made = self._make()
        return self._made


def fit_rules(tried: Tried) -> Rules:
    """Returns the rules of a fit."""
    engine = open_renderer("silhouette", tried.scene, 1)
    mask = engine.render(CAMERA, tried.truths[0])
    moved = [tried.truths[0].shifted([step, -step, 0.0]) for step in (0.0, 3.0, 15.0, 60.0, 9e4)]
    words = np.stack([pack_mask(engine.render(CAMERA, pose)) for pose in moved])
    probability = mask.astype(np.float32)
    size = (CAMERA.width, CAMERA.height)
    # A fit of photos gets one in which buildings are lighter than the ground.
    photo = np.random.default_rng(0).integers(40, 120, (*mask.shape, 3)).astype(np.uint8)
    photo[mask] += 100
    given = (photo, size) if getattr(tried.part, "input", Input.MASK) == Input.IMAGE else (probability,)
    before_given = given[0].copy()

    def values() -> str:
        fit = tried.part(*given)
        require(tuple(fit.size) == size, f"size is {fit.size}: width, then height")
        found = np.asarray(fit(words))
        require(
            found.shape == (5,) and found.dtype == np.float64, f"{found.shape} {found.dtype}", "(N,) float64"
        )
        require(np.isfinite(found).all() and found.min() >= 0 and found.max() <= 1, f"{found}: not in [0, 1]")
        require(found[0] >= found.max(), f"the mask itself fits {found[0]:.3f}, another {found.max():.3f}")
        require(found[-1] == 0, f"nothing fits {found[-1]:.3f}", "Nothing in common is 0.")
        return (
            f"{found[0]:.3f} at the truth, "
            + ", ".join(f"{value:.3f}" for value in found[1:])
            + " further off"
        )

    def alone() -> str:
        fit, before = tried.part(*given), words.copy()
        batch, single = fit(words), [fit(words[k : k + 1])[0] for k in range(5)]
        require(np.array_equal(batch, single), "other values one by one than together", "Count in integers.")
        require(np.array_equal(batch, tried.part(*given)(words)), "other values when made anew")
        require(np.array_equal(before, words), "the words were written to", "Work on a copy.")
        require(np.array_equal(given[0], before_given), "its query was written to", "Work on a copy.")
        return "one by one, together and made anew, the same to the bit; what it is given is only read"

    return [("values", values), ("same again", alone)]
