"""`python -m lodbench.rendering.gl_trial`: draws a triangle on GL, and says why not if it cannot."""

from __future__ import annotations

import sys

import numpy as np

from lodbench.citymodel.scene import build_scene
from lodbench.errors import RenderingError
from lodbench.geometry import Camera, Pose
from lodbench.rendering.gl_guard import trust_driver
from lodbench.rendering.pyrender_backend import PyrenderRenderer


def main() -> None:
    """Draws a triangle and looks at it.

    Raises:
        RenderingError: It cannot be drawn, or does not show.
    """
    # This is the trial: it must not ask for one.
    trust_driver()
    corners = np.array([[-4.0, -4.0, 5.0], [4.0, -4.0, 5.0], [0.0, 4.0, 5.0]])
    scene = build_scene(corners, np.array([[0, 1, 2]]), np.zeros(1, dtype=np.int32), ("triangle",))
    drawn = PyrenderRenderer(scene).render(Camera(16, 16, 8.0, 8.0, 8.0, 8.0), Pose(np.eye(3), np.zeros(3)))
    if not drawn.any() or drawn.all():
        raise RenderingError("a triangle does not show as one")


if __name__ == "__main__":
    try:
        main()
    except RenderingError as error:
        sys.exit(error.message)
