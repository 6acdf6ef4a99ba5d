"""Links of CityGML: counted once, found again, broken, long; surfaces written twice."""

from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import mesh_model
from lodbench.citymodel.gml.links import LinkResolver
from lodbench.citymodel.model import SurfaceKind
from lodbench.citymodel.options import ReadOptions

from .gml_text import (
    bounded_by,
    box_area,
    box_rings,
    city,
    codes,
    link,
    member,
    model_of,
    multi_surface,
    polygon,
    solid,
    solid_of,
    surface_members,
)

BOX = box_rings()


class TestLinks:
    walls = bounded_by("WallSurface", multi_surface(surface_members([polygon(BOX[2], gml_id="w")])))

    @pytest.mark.parametrize("is_forward", [True, False])
    def test_a_linked_polygon_counts_once(self, tmp_path: Path, is_forward: bool) -> None:
        parts = [solid(link("#w") + link("# w ") + link("city.gml#w"), 2), self.walls]
        model = model_of(tmp_path, city(member("".join(parts if is_forward else parts[::-1]))))
        assert len(model.polygons) == 1
        assert model.findings.counts() == {}

    @pytest.mark.parametrize("href", ["#w", "# w ", "urn:uuid:w"])
    def test_a_solid_is_closed_by_what_it_borrows(self, tmp_path: Path, href: str) -> None:
        own = surface_members(map(polygon, [*BOX[:2], *BOX[3:]]))
        text = city(member(solid(own + link(href), 2) + self.walls))
        solids = model_of(tmp_path, text, options=ReadOptions(has_details=True)).solids
        assert solids is not None
        assert [len(shell) for shell in solids.shells_of(0)] == [6]

    def test_a_link_to_another_level_adds_its_polygon_there(self, tmp_path: Path) -> None:
        model = model_of(tmp_path, city(member(solid(link("#w"), 3) + self.walls)))
        assert [model.lods[i] for i in model.polygons.lod] == ["2", "3"]
        assert np.array_equal(*np.split(model.polygons.points, 2))

    def test_a_link_to_a_composite(self, tmp_path: Path) -> None:
        faces = surface_members(map(polygon, BOX[:3]))
        composite = f'<gml:CompositeSurface gml:id="c">{faces}</gml:CompositeSurface>'
        walls = multi_surface(surface_members([composite]))
        model = model_of(tmp_path, city(member(solid(link("#c"), 3) + bounded_by("WallSurface", walls))))
        assert sorted(model.lods[i] for i in model.polygons.lod) == ["2"] * 3 + ["3"] * 3

    def test_a_link_across_members(self, tmp_path: Path) -> None:
        text = city(member(solid(link("#w"), 2)) + member(self.walls, "b2"))
        model = model_of(tmp_path, text)
        assert model.polygons.building.tolist() == [1, 0]
        assert model.findings.counts() == {}

    @pytest.mark.parametrize("is_around", [True, False], ids=["envelope", "geometry"])
    def test_a_link_across_members_keeps_the_system_of_its_target(self, tmp_path, is_around):
        envelope = '<gml:boundedBy><gml:Envelope srsName="EPSG:4326"/></gml:boundedBy>'
        system = ' srsName="EPSG:4326" srsDimension="2"'
        plan = "50.5 9.0 50.6 9.0 50.5 9.1 50.5 9.0"
        flat = polygon(f"<gml:posList>{plan}</gml:posList>", gml_id="w")
        walls = (envelope if is_around else "") + multi_surface(
            surface_members([flat]), attributes="" if is_around else system
        )
        last = member(multi_surface(surface_members([polygon(BOX[0])])), "b3")
        text = city(member(solid(link("#w"), 2), "b1") + member(walls, "b2") + last)
        own, _, borrowed = np.split(model_of(tmp_path, text).polygons.points, [3, -3])
        assert np.array_equal(own, borrowed)

    def test_a_whole_surface_and_a_whole_part(self, tmp_path: Path) -> None:
        wall = (
            f'<bldg:boundedBy><bldg:WallSurface gml:id="ws">{multi_surface(link("#p"))}'
            "</bldg:WallSurface></bldg:boundedBy>"
        )
        face = multi_surface(surface_members([polygon(BOX[3], gml_id="p")]), 3)
        box = solid_of(box_rings(x=500100.0))
        part = (
            f'<core:cityObjectMember><bldg:BuildingPart gml:id="bp">{box}</bldg:BuildingPart>'
            "</core:cityObjectMember>"
        )
        links = '<bldg:boundedBy xlink:href="#ws"/><bldg:consistsOfBuildingPart xlink:href="#bp"/>'
        model = model_of(tmp_path, city(member(links) + member(wall + face, "b2") + part))
        own = model.polygons.building == 0
        assert [model.lods[n] for n in model.polygons.lod[own]] == ["2"] + ["1"] * 6
        assert model.polygons.kind[own][0] == SurfaceKind.WALL
        assert codes(model) == {"LB209": 1}

    @pytest.mark.parametrize("href", ["#nowhere", "#c", "#c2"])
    def test_a_surface_that_is_not_found_is_a_finding(self, tmp_path: Path, href: str) -> None:
        circle = "".join(
            f'<bldg:boundedBy><bldg:WallSurface gml:id="{name}"><bldg:opening xlink:href="#{other}"/>'
            "</bldg:WallSurface></bldg:boundedBy>"
            for name, other in (("c", "c2"), ("c2", "c"))
        )
        text = city(member(f'{self.walls}<bldg:boundedBy xlink:href="{href}"/>') + member(circle, "b2"))
        model = model_of(tmp_path, text)
        found = [item.code.code for item in model.findings.items if item.object_id == "b1"]
        assert len(model.polygons) == 1
        assert set(found) == {"LB202"}

    @pytest.mark.parametrize(
        ("href", "code"),
        [
            ("#nowhere", "LB202"),
            ("http://127.0.0.1/x#w", "LB203"),
            ("../other.gml#w", "LB203"),
            ("", "LB203"),
        ],
    )
    def test_broken_links_are_findings(self, tmp_path: Path, href: str, code: str) -> None:
        model = model_of(tmp_path, city(member(solid(link(href), 2) + self.walls)))
        assert len(model.polygons) == 1
        assert codes(model) == {code: 1}
        assert [item.object_id for item in model.findings.items] == ["b1"]

    def test_cycles_end(self, tmp_path: Path) -> None:
        def composite(name: str, target: str) -> str:
            return (
                f'<gml:surfaceMember><gml:CompositeSurface gml:id="{name}">{link(target)}'
                "</gml:CompositeSurface></gml:surfaceMember>"
            )

        text = multi_surface(composite("a", "#c") + composite("c", "#a")) + self.walls
        model = model_of(tmp_path, city(member(text)))
        assert len(model.polygons) == 1
        assert "LB204" in codes(model)

    def test_duplicate_ids(self, tmp_path: Path) -> None:
        model = model_of(tmp_path, city(member(self.walls + self.walls)))
        assert codes(model) == {"LB109": 1, "LB205": 1}


class TestLongLinks:
    def test_a_chain_of_thousands(self, tmp_path: Path) -> None:
        count = 5000
        steps = "".join(
            f'<gml:surfaceMember><gml:CompositeSurface gml:id="c{i}">{link(f"#c{i + 1}")}'
            "</gml:CompositeSurface></gml:surfaceMember>"
            for i in range(count)
        )
        end = (
            f'<gml:surfaceMember><gml:CompositeSurface gml:id="c{count}">{surface_members(map(polygon, BOX))}'
        )
        end += "</gml:CompositeSurface></gml:surfaceMember>"
        text = city(member(multi_surface(steps + end)) + member(multi_surface(link("#c0")), "b2"))
        model = model_of(tmp_path, text)
        assert len(model.polygons) == 12
        assert codes(model) == {}

    def test_dangling_links_are_looked_for_once(self, tmp_path, monkeypatch):
        calls = []
        plain = LinkResolver._target_id
        monkeypatch.setattr(LinkResolver, "_target_id", lambda *a: (calls.append(1), plain(*a))[1])
        own = surface_members(map(polygon, BOX))
        text = city(
            "".join(
                member(multi_surface(own + "".join(link(f"#no{i}-{k}") for k in range(5))), f"b{i}")
                for i in range(60)
            )
        )
        assert codes(model_of(tmp_path, text))["LB202"] == 300
        # Once in its member, once for the second pass; the first has the document read as it stands.
        assert len(calls) == 601

    def test_a_wall_that_borrows_the_door_of_a_room(self, tmp_path: Path) -> None:
        door = polygon(
            [
                (500002.0, 5600000.0, 50.0),
                (500003.0, 5600000.0, 50.0),
                (500003.0, 5600000.0, 52.0),
                (500002.0, 5600000.0, 52.0),
            ],
            gml_id="door",
        )
        room = (
            "<bldg:interiorRoom><bldg:Room>"
            + bounded_by("InteriorWallSurface", multi_surface(surface_members([door]), 4))
            + "</bldg:Room></bldg:interiorRoom>"
        )
        wall = bounded_by("WallSurface", multi_surface(surface_members([polygon(BOX[1])]) + link("#door"), 4))
        for content in (room + wall, wall + room):
            mesh = mesh_model(model_of(tmp_path, city(member(content))), "4")
            assert mesh.area_m2 == pytest.approx(102.0)

    def test_a_door_that_two_rooms_share_stays_inside(self, tmp_path: Path) -> None:
        door = multi_surface(surface_members([polygon(BOX[2])]), 4)
        doors = (
            f'<bldg:opening><bldg:Door gml:id="d">{door}</bldg:Door></bldg:opening>',
            '<bldg:opening xlink:href="#d"/>',
        )
        rooms = "".join(
            "<bldg:interiorRoom><bldg:Room>"
            + bounded_by(
                "InteriorWallSurface", multi_surface(surface_members([polygon(BOX[n])]), 4) + opening
            )
            + "</bldg:Room></bldg:interiorRoom>"
            for n, opening in zip((3, 4), doors, strict=True)
        )
        model = model_of(tmp_path, city(member(rooms)))
        assert len(model.polygons) == 3
        assert set(model.polygons.kind) == {SurfaceKind.INTERIOR}

    def test_a_part_that_only_refers_is_followed_to_members_behind_it(self, tmp_path: Path) -> None:
        part = '<bldg:BuildingPart gml:id="bp"><bldg:boundedBy xlink:href="#w"/></bldg:BuildingPart>'
        wall = (
            '<bldg:boundedBy><bldg:WallSurface gml:id="w">'
            + multi_surface(surface_members([polygon(BOX[0])]))
            + "</bldg:WallSurface></bldg:boundedBy>"
        )
        room = '<bldg:interiorRoom><bldg:Room gml:id="r"/></bldg:interiorRoom>'
        refers = '<bldg:consistsOfBuildingPart xlink:href="#bp"/><bldg:interiorRoom xlink:href="#r"/>'
        apart = f"<core:cityObjectMember>{part}</core:cityObjectMember>"
        model = model_of(tmp_path, city(member(refers) + apart + member(wall + room, "b2")))
        assert sorted(model.polygons.building.tolist()) == [0, 1]
        assert "LB202" not in codes(model)


class TestSurfacesWrittenTwice:
    def test_inline_in_solid_and_walls(self, tmp_path: Path) -> None:
        turned = [[*ring[2:], *ring[:2]] for ring in BOX]
        walls = bounded_by("WallSurface", multi_surface(surface_members(map(polygon, turned))))
        model = model_of(tmp_path, city(member(solid_of(BOX, 2) + walls)))
        assert codes(model) == {"LB109": 6}
        assert set(model.polygons.kind) == {SurfaceKind.WALL}
        assert mesh_model(model).meshed_m2 == pytest.approx(box_area())

    def test_walls_that_parts_share_stay(self, tmp_path: Path) -> None:
        wall = bounded_by("WallSurface", multi_surface(surface_members([polygon(BOX[2])])))
        parts = "".join(
            f'<bldg:consistsOfBuildingPart><bldg:BuildingPart gml:id="p{n}">{wall}</bldg:BuildingPart>'
            "</bldg:consistsOfBuildingPart>"
            for n in (1, 2)
        )
        model = model_of(tmp_path, city(member(parts + solid(surface_members([polygon(BOX[0])]), 2))))
        assert len(model.polygons) == 3
        assert model.findings.counts() == {}
        assert model.objects is not None
        assert model.objects.types == ("Building", "BuildingPart", "BuildingPart")
        assert model.polygons.part is not None
        assert sorted(model.polygons.part.tolist()) == [0, 1, 2]

    def test_walls_that_stand_twice_in_a_part(self, tmp_path: Path) -> None:
        wall = bounded_by("WallSurface", multi_surface(surface_members([polygon(BOX[2])])))
        turned = bounded_by("WallSurface", multi_surface(surface_members([polygon(BOX[2][::-1])])))
        model = model_of(tmp_path, city(member(wall + turned)))
        assert len(model.polygons) == 1
        assert codes(model) == {"LB109": 1}

    def test_other_buildings_and_levels_are_apart(self, tmp_path: Path) -> None:
        wall = bounded_by("WallSurface", multi_surface(surface_members([polygon(BOX[2])])))
        lone = solid(surface_members([polygon(BOX[2])]), 1)
        text = city(member(wall + lone) + member(solid(surface_members([polygon(BOX[2])]), 2), "b2"))
        assert len(model_of(tmp_path, text).polygons) == 3
