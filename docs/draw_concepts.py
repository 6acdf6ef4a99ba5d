"""Draws the pictures of docs/concepts.md from the built-in town: `python docs/draw_concepts.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lodbench import Camera, EulerAngles, Pose, make_renderer, open_scene
from lodbench.citymap import CityMap
from lodbench.reporting.figures import SERIES, draw_figure
from lodbench.synthesis.demo import DemoParams, open_demo

OUT = Path(__file__).parent / "images"
CAMERA = Camera(480, 360, 380.0, 380.0, 240.0, 180.0)
DEMO = open_demo(DemoParams())
ENTRY = next(entry for entry in DEMO.entries if entry.split == "in_place")
TRUTH = DEMO.truth[ENTRY.key]


def save(name: str, pictures: dict[str, bytes]) -> None:
    """Writes a figure as PNG."""
    (OUT / f"concept-{name}.png").write_bytes(pictures["png"])


def silhouette(lod: str, pose: Pose) -> np.ndarray:
    """Returns (H, W) bool: the town at a level of detail from a pose."""
    scene = open_scene(DEMO.city_model, lod=lod)
    return make_renderer("silhouette", scene).render(CAMERA, pose.shifted(-scene.origin))


def lods(figure: Figure) -> None:
    """Draws the same view at two levels of detail."""
    for axis, lod in zip(figure.subplots(1, 2), ("1", "2"), strict=True):
        scene = open_scene(DEMO.city_model, lod=lod)
        euler = EulerAngles(55.0, 0.0, TRUTH.euler.yaw_deg)
        pose = Pose.from_euler(euler, TRUTH.center - (0.0, 0.0, 40.0)).shifted(-scene.origin)
        normals = CityMap(scene).normals(CAMERA, pose.rotation[None], pose.center[None])[0]
        is_hit = np.isfinite(normals).all(axis=2) & (np.abs(normals).sum(axis=2) > 0)
        light = np.array([-0.45, -0.35, 0.82])
        axis.imshow(
            np.where(is_hit, 0.35 + 0.6 * np.clip(normals @ light, 0, 1), 0.12), cmap="gray", vmin=0, vmax=1
        )
        axis.set(title=f"LoD{lod}")
        axis.set_axis_off()


def frames(figure: Figure) -> None:
    """Draws the world's axes and a camera's."""
    # Drawn in the order of the calls: the houses stand behind.
    axis = figure.add_subplot(projection="3d", computed_zorder=False)
    axis.bar3d([-1.6, 0.4], [2.0, 2.6], [0, 0], [1.2, 1.4], [1.2, 1.0], [1.5, 2.2], color="0.85", zorder=0)
    pose = Pose.from_euler(EulerAngles(50.0, 0.0, -20.0), (2.6, -2.4, 4.2))
    for direction, name, colour in zip(np.eye(3), ("east x", "north y", "up z"), SERIES, strict=False):
        axis.quiver(0, 0, 0, *(2.2 * direction), color=colour)
        axis.text(*(2.5 * direction), name, color=colour)
    for direction, name, colour in zip(pose.rotation, ("right x", "down y", "ahead z"), SERIES, strict=False):
        axis.quiver(*pose.center, *(1.8 * direction), color=colour, linestyle="--")
        axis.text(*(pose.center + 2.0 * direction), name, color=colour)
    corners = np.array(
        [[-0.8, -0.6, 1.4], [0.8, -0.6, 1.4], [0.8, 0.6, 1.4], [-0.8, 0.6, 1.4], [-0.8, -0.6, 1.4]]
    )
    ring = corners @ pose.rotation + pose.center
    axis.plot(*ring.T, color="0.4", linewidth=1)
    for corner in ring[:4]:
        axis.plot(*np.stack([pose.center, corner]).T, color="0.4", linewidth=0.8)
    axis.set(xlim=(-1.6, 3.6), ylim=(-2.6, 3.4), zlim=(0, 4.6))
    axis.set_box_aspect((5.2, 6.0, 4.6), zoom=1.25)
    axis.set_axis_off()
    axis.view_init(18, -55)


def priors(figure: Figure) -> None:
    """Draws where the demo's priors lie about the truth."""
    for axis, split in zip(figure.subplots(1, 2), DEMO.splits, strict=True):
        mine = [entry for entry in DEMO.entries if entry.split == split and entry.prior is not None]
        off = np.array([entry.prior.center - DEMO.truth[entry.key].center for entry in mine if entry.prior])
        axis.scatter(off[:, 0], off[:, 1], c=off[:, 2], cmap="coolwarm", vmin=-30, vmax=30, s=25)
        axis.plot(0, 0, "+", color="0.2", markersize=12)
        reach = 1.15 * float(np.abs(off[:, :2]).max())
        axis.set(
            title=split,
            xlabel="east of the truth, m",
            xlim=(-reach, reach),
            ylim=(-reach, reach),
            aspect="equal",
        )
    figure.axes[0].set_ylabel("north of the truth, m")
    figure.colorbar(figure.axes[0].collections[0], ax=figure.axes, label="above the truth, m")


def tilt(figure: Figure) -> None:
    """Draws the town's outline at the true tilt, and at one that is wrong by a degree."""
    pitch, roll, yaw = TRUTH.euler
    wrong = Pose.from_euler(EulerAngles(pitch + 1.0, roll + 1.0, yaw), TRUTH.center)
    axis: Axes = figure.subplots()
    axis.contour(silhouette("1", TRUTH), [0.5], colors=[SERIES[0]], linewidths=1.2)
    axis.contour(silhouette("1", wrong), [0.5], colors=[SERIES[1]], linewidths=1.2)
    axis.plot([], color=SERIES[0], label="the true tilt")
    axis.plot([], color=SERIES[1], label="pitch and roll 1 degree off")
    axis.set(xlim=(0, CAMERA.width), ylim=(CAMERA.height, 0), aspect="equal", xticks=[], yticks=[])
    figure.legend(loc="outside lower center", ncols=2)


if __name__ == "__main__":
    save("lod", draw_figure(8.4, 3.4, lods))
    save("frames", draw_figure(5.0, 4.2, frames))
    save("priors", draw_figure(8.0, 3.6, priors))
    save("tilt", draw_figure(5.4, 4.4, tilt))
