"""Localised photos in three dimensions, over their city."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from lodbench.harness.city import open_city
from lodbench.harness.photo.request import LocalizedPhoto, PhotoRequest
from lodbench.reporting.answers import percent_text
from lodbench.reporting.table_columns import finite_text
from lodbench.reporting.view3d import MAX_PHOTOS, ViewedCamera, draw_view3d
from lodbench.storage import write_text


def write_view(
    path: Path,
    request: PhotoRequest,
    found: Sequence[LocalizedPhoto],
    pages: Mapping[str, str] | None = None,
) -> None:
    """Writes a page of city, photos, rough and found poses.

    Args:
        path: The page.
        request: What was asked: its city.
        found: The answers, one at least.
        pages: Addresses of the pages that it leads to, by what they are called.
    """
    city = open_city(request.city, request.lod, request.options, request.roof_height)
    origin = city.scene.origin
    cameras = [
        ViewedCamera(
            key=each.photo,
            facts=_facts(each),
            camera=each.camera,
            prior=each.prior.shifted(-origin),
            estimate=each.pose.shifted(-origin),
            truth=None,
            photo=each.thumbnail if number < MAX_PHOTOS else None,
        )
        for number, each in enumerate(found)
    ]
    title = f"{len(found)} photo{'s' if len(found) > 1 else ''} over {request.city.name}"
    write_text(path, draw_view3d(title, city.scene, cameras, pages))


def _facts(found: LocalizedPhoto) -> dict[str, str]:
    """Returns what is told of a photo, by name."""
    facts = {"trust": found.trust}
    if found.probability is not None:
        facts["sure"] = percent_text(found.probability)
    moved = f"{found.moved.translation_m:.2f} m, {found.moved.rotation_deg:.2f} deg"
    return {**facts, "from the prior": moved, "score": finite_text(found.score, ".3f")}
