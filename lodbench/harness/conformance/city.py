"""Rules of what works on the city: readers, renderers, fits."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.citymodel.meshing import mesh_model
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.polygons import finish_model
from lodbench.citymodel.raw import RawCity
from lodbench.citymodel.source import Source, open_sources
from lodbench.datasets.inputs import Input
from lodbench.geometry import Pose
from lodbench.harness.conformance.trial import CAMERA, Rules, Tried, refuses, require
from lodbench.rendering import DEPTH, open_renderer
from lodbench.rendering.bits import pack_mask

# Pixels on the outline may be drawn or not: no more of all than this.
_MOST_DIFFERENT = 0.01


def reader_rules(tried: Tried) -> Rules:
    """Returns the rules of a reader of city models."""

    def garbage() -> str:
        def read(data: bytes) -> object:
            return tried.part(Source("garbage", lambda: io.BytesIO(data), Path("garbage")), ReadOptions())

        refuses(lambda: read(b"\x00\xff" * 3000), "a file of bytes")
        return refuses(lambda: read(b"neither here nor there\n"), "a file of words")

    def scene() -> str:
        if tried.sample is None:
            return "not tried: name a file with --sample FILE"
        digests = []
        for _ in range(2):
            raw = tried.part(open_sources(tried.sample)[0], ReadOptions())
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
    """Makes something when it is first asked for, and keeps it."""

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
