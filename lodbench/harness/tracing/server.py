"""The page on which roofs are traced, two photos beside each other: served to this machine alone."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.harness.local_page import LocalServer, saved_or_why
from lodbench.harness.tracing.solve import Model, TracedMap
from lodbench.harness.tracing.tracing import parse_tracing, write_tracing
from lodbench.segmentation.photos import read_photo

Floats = NDArray[np.float64]

# A ray is drawn in the other photo through so many places, between the nearest and the furthest of these
# shares of the model's points, and a little beyond.
_LINE_POINTS, _DEPTH_SHARES, _BEYOND = 30, (0.02, 0.98), 1.3


class TraceServer(LocalServer):
    """Serves a model's photos to be traced in.

    Args:
        model: What is traced in.
        file: Where the tracing is kept; what it holds is gone on with.
        describe: Words for what was solved.
        port: To listen at; 0 for any that is free.

    Raises:
        DatasetError: The file is there, and no tracing of this model.
    """

    def __init__(self, model: Model, file: Path, describe: Callable[[TracedMap], str], port: int = 0) -> None:
        super().__init__(port)
        self.model, self.file, self._describe = model, file, describe
        self.saved = json.loads(file.read_text("utf-8"))["traced"] if file.exists() else []

    def shown(self, asked: str) -> tuple[bytes, str] | None:
        """Returns the page or a photo, by its number."""
        names = list(self.model.views)
        if asked == "":
            return self._page(names), "text/html; charset=utf-8"
        number = asked.removeprefix("photo").removesuffix(".jpg")
        if not number.isdecimal() or int(number) >= len(names):
            return None
        pixels = read_photo(self.model.views[names[int(number)]].photo)
        return cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]))[1].tobytes(), "image/jpeg"

    def done(self, asked: str, content: dict[str, Any]) -> dict[str, Any] | None:
        """Saves, solves, draws a ray, or stops."""
        match asked:
            case "save":
                return saved_or_why(lambda: self._save(content))
            case "solve":
                outlines: dict[str, Any] = {}
                return saved_or_why(lambda: self._solve(content, outlines)) | {"outlines": outlines}
            case "line":
                return {"line": self._line(content["photo"], content["pixel"], content["other"])}
            case "stop":
                return {"message": "Closed. This page may be left.", "closes": True}
        return None

    def _save(self, content: dict[str, Any]) -> str:
        write_tracing(parse_tracing(content, "the page", self.model.views), self.file)
        self.saved = content["traced"]
        return f"saved: {self.file.name}"

    def _solve(self, content: dict[str, Any], outlines: dict[str, Any]) -> str:
        solved = self.model.solved(parse_tracing(content, "the page", self.model.views))
        back = solved.placed.similarity
        for name, view in self.model.views.items():
            outlines[name] = []
            for building in solved.buildings:
                points = (building.roof.points - back.translation) @ back.rotation / back.scale
                pixels = view.project(points)
                if np.isfinite(pixels).all():
                    outlines[name].append(np.round(pixels, 1).tolist())
        return self._describe(solved)

    def _line(self, photo: str, pixel: Any, other: str) -> list[list[float]]:
        """Returns where another photo shows the ray of a pixel, (N, 2) pixels."""
        view, points = self.model.views[photo], self.model.points
        ray = view.rays(np.array(pixel, np.float64).reshape(1, 2))[0]
        depths = (points - view.pose.center) @ ray
        depths = depths[depths > 0]
        if not len(depths):
            return []
        near, far = np.quantile(depths, _DEPTH_SHARES)
        at = np.geomspace(near / _BEYOND, far * _BEYOND, _LINE_POINTS)
        shown = self.model.views[other].project(view.pose.center + at[:, None] * ray)
        found: list[list[float]] = np.round(shown[np.isfinite(shown).all(axis=1)], 1).tolist()
        return found

    def _page(self, names: list[str]) -> bytes:
        from jinja2 import Environment

        template = files("lodbench.harness.tracing").joinpath("templates/trace.html.jinja")
        environment = Environment(autoescape=True)
        page = environment.from_string(template.read_text(encoding="utf-8"))
        return page.render(file=self.file.name, names=names, traced=self.saved).encode()
