"""Levels of detail where the parts and installations of a building have different ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from lodbench.citymodel import mesh_model
from lodbench.citymodel.meshing import CityMesh

from .gml_text import box_area, box_rings, city, member, polygon, solid, surface_members
from .models import model_of

AREA = box_area()


def box(k: int, lod: int) -> str:
    return solid(surface_members(map(polygon, box_rings(x=500000.0 + 40 * k))), lod)


def part(name: str, content: str) -> str:
    inner = f'<bldg:BuildingPart gml:id="{name}">{content}</bldg:BuildingPart>'
    return f"<bldg:consistsOfBuildingPart>{inner}</bldg:consistsOfBuildingPart>"


def chimney(k: int, lod: int) -> str:
    shape = box(k, lod).replace(f"lod{lod}Solid", f"lod{lod}Geometry")
    inner = f'<bldg:BuildingInstallation gml:id="chimney">{shape}</bldg:BuildingInstallation>'
    return f"<bldg:outerBuildingInstallation>{inner}</bldg:outerBuildingInstallation>"


@pytest.mark.parametrize(
    ("content", "lod", "boxes", "absent"),
    [
        (box(0, 2) + chimney(1, 3), "finest", 2, []),
        (box(0, 2) + chimney(1, 3), "coarsest", 1, []),
        (box(0, 1) + box(0, 2) + chimney(1, 2), "coarsest", 1, []),
        (box(0, 1) + box(0, 2) + chimney(1, 2), "finest", 2, []),
        (chimney(1, 2) + chimney(2, 3), "finest", 2, []),
        (part("p", box(0, 1) + box(0, 2)) + part("q", box(1, 1)), "finest", 2, []),
        (part("p", box(0, 1) + box(0, 2)) + part("q", box(1, 1)), "2", 1, ["q"]),
        (part("p", box(0, 1) + box(0, 2)) + part("q", box(1, 2)), "coarsest", 2, []),
        # The building's own block stands for its parts, and they for it.
        (box(0, 1) + part("p", box(0, 2)) + part("q", box(1, 2)), "finest", 2, []),
        (box(0, 1) + part("p", box(0, 2)) + part("q", box(1, 2)), "coarsest", 1, []),
        (box(0, 1) + part("p", box(0, 2)) + part("q", box(1, 2)), "1", 1, []),
    ],
)
def test_what_is_meshed(tmp_path: Path, content: str, lod: str, boxes: int, absent: list[str]) -> None:
    mesh: CityMesh = mesh_model(model_of(tmp_path, city(member(content))), lod)
    assert mesh.meshed_m2 == pytest.approx(boxes * AREA)
    assert [item.object_id for item in mesh.findings.items] == absent
