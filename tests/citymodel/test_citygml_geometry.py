"""Geometry of CityGML: notations of rings, surfaces, parts, implicit shapes."""

from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from lodbench.citymodel import mesh_model
from lodbench.citymodel.model import CityModel, SurfaceKind
from lodbench.citymodel.options import ReadOptions
from lodbench.errors import CityModelError

from .gml_text import (
    bounded_by,
    box_area,
    box_city,
    box_rings,
    city,
    codes,
    member,
    model_of,
    multi_surface,
    polygon,
    pos_list,
    solid,
    solid_of,
    surface_members,
)

BOX = box_rings()


class TestGeometry:
    def test_box(self, tmp_path: Path) -> None:
        model = model_of(tmp_path, box_city())
        assert (model.format, model.version, model.lods) == ("CityGML", "2.0", ("1",))
        assert model.building_ids == ("b1",)
        assert model.crs == "EPSG:25832"
        assert model.origin.tolist() == [500000, 5600000, 0]
        mesh = mesh_model(model)
        assert mesh.scene.vertices.shape == (8, 3)
        assert mesh.scene.triangles.shape == (12, 3)
        assert mesh.meshed_m2 == pytest.approx(box_area(), rel=1e-12)
        assert mesh.scene.vertices.min(axis=0).tolist() == [0, 0, 50]

    @pytest.mark.parametrize("version", ["1.0", "2.0"])
    def test_versions(self, tmp_path: Path, version: str) -> None:
        text = city(member(solid_of(BOX)), version=version)
        assert model_of(tmp_path, text).version == version

    @pytest.mark.parametrize(
        "ring",
        [
            "<gml:posList>0 0 0 4 0 0 4 4 0 0 0 0</gml:posList>",
            '<gml:posList srsDimension="3">0 0 0\n4 0 0\t4 4 0 0 0 0 </gml:posList>',
            "".join(f"<gml:pos>{p}</gml:pos>" for p in ("0 0 0", "4 0 0", "4 4 0", "0 0 0")),
            "<gml:coordinates>0,0,0 4,0,0 4,4,0 0,0,0</gml:coordinates>",
            '<gml:coordinates decimal="," cs=" " ts=";">0,0 0 0;4,0 0 0;4 4 0;0 0 0</gml:coordinates>',
            "".join(
                f"<gml:pointProperty><gml:Point><gml:pos>{p}</gml:pos></gml:Point></gml:pointProperty>"
                for p in ("0 0 0", "4 0 0", "4 4 0", "0 0 0")
            ),
        ],
        ids=["posList", "dimension", "pos", "coordinates", "separators", "points"],
    )
    def test_ring_notations(self, tmp_path: Path, ring: str) -> None:
        model = model_of(tmp_path, city(member(multi_surface(surface_members([polygon(ring)])))))
        assert model.polygons.points.tolist() == [[0, 0, 0], [4, 0, 0], [4, 4, 0]]
        assert model.findings.counts().keys() <= {"LB303 CRS_IMPLAUSIBLE"}

    def test_interior_rings(self, tmp_path: Path) -> None:
        hole = [(2.0, 2.0, 5.0), (2.0, 4.0, 5.0), (4.0, 4.0, 5.0), (4.0, 2.0, 5.0)]
        outline = [(0.0, 0.0, 5.0), (9.0, 0.0, 5.0), (9.0, 9.0, 5.0), (0.0, 9.0, 5.0)]
        text = city(member(multi_surface(surface_members([polygon(outline, [hole])]))), srs=None)
        mesh = mesh_model(model_of(tmp_path, text))
        assert mesh.area_m2 == pytest.approx(81 - 4)
        assert mesh.meshed_m2 == pytest.approx(81 - 4)

    def test_surface_kinds_and_openings(self, tmp_path: Path) -> None:
        window = "<bldg:opening><bldg:Window>{}</bldg:Window></bldg:opening>"
        faces = [surface_members([polygon(ring)]) for ring in BOX]
        content = (
            bounded_by("GroundSurface", multi_surface(faces[0], 3))
            + bounded_by("RoofSurface", multi_surface(faces[1], 3))
            + bounded_by(
                "WallSurface", multi_surface(faces[2], 3) + window.format(multi_surface(faces[3], 3))
            )
            + "<bldg:outerBuildingInstallation><bldg:BuildingInstallation><bldg:lod3Geometry>"
            f"<gml:MultiGeometry><gml:geometryMember>{polygon(BOX[4])}</gml:geometryMember>"
            "<gml:geometryMember><gml:LineString><gml:posList>1 2 3 4 5 6</gml:posList></gml:LineString>"
            "</gml:geometryMember></gml:MultiGeometry></bldg:lod3Geometry></bldg:BuildingInstallation>"
            "</bldg:outerBuildingInstallation>"
        )
        model = model_of(tmp_path, city(member(content)))
        kinds = sorted(SurfaceKind(kind).name for kind in model.polygons.kind)
        assert kinds == ["GROUND", "INSTALLATION", "OPENING", "ROOF", "WALL"]
        assert np.diff(model.polygons.ring_starts).tolist() == [4] * 5

    def test_rooms_are_counted_but_not_meshed(self, tmp_path: Path) -> None:
        faces = [surface_members([polygon(ring)]) for ring in BOX]
        room = "<bldg:interiorRoom><bldg:Room>{}</bldg:Room></bldg:interiorRoom>"
        content = bounded_by("WallSurface", multi_surface(faces[2], 4)) + room.format(
            bounded_by("InteriorWallSurface", multi_surface(faces[3], 4))
            + "<bldg:interiorFurniture><bldg:BuildingFurniture><bldg:lod4Geometry><gml:MultiSurface>"
            f"{faces[4]}</gml:MultiSurface></bldg:lod4Geometry></bldg:BuildingFurniture></bldg:interiorFurniture>"
        )
        model = model_of(tmp_path, city(member(content)))
        mesh = mesh_model(model, "3")
        assert model.polygons_read == (3,)
        assert mesh.num_polygons == 1
        assert set(mesh.findings.counts()) == {"LB402 LOD_SUBSTITUTED", "LB404 INTERIOR_SKIPPED"}

    def test_parts_belong_to_their_building(self, tmp_path: Path) -> None:
        name = "bldg:consistsOfBuildingPart"
        part = f"<{name}><bldg:BuildingPart>{{}}</bldg:BuildingPart></{name}>"
        halves = [solid_of(box_rings(x=500000.0 + 20 * i)) for i in range(2)]
        model = model_of(tmp_path, city(member("".join(map(part.format, halves)))))
        assert (len(model.building_ids), model.num_parts, len(model.polygons)) == (1, 2, 12)

    def test_triangles_and_patches(self, tmp_path: Path) -> None:
        ring = "<gml:exterior><gml:LinearRing>{}</gml:LinearRing></gml:exterior>"
        triangle = f"<gml:Triangle>{ring.format(pos_list(BOX[0][:3]))}</gml:Triangle>"
        patch = f"<gml:PolygonPatch>{ring.format(pos_list(BOX[1]))}</gml:PolygonPatch>"
        members = surface_members(
            [
                f"<gml:TriangulatedSurface><gml:trianglePatches>{triangle}</gml:trianglePatches>"
                "</gml:TriangulatedSurface>",
                f"<gml:Surface><gml:patches>{patch}</gml:patches></gml:Surface>",
            ]
        )
        model = model_of(tmp_path, city(member(multi_surface(members))))
        assert np.diff(model.polygons.ring_starts).tolist() == [3, 4]

    def test_ring_of_curves(self, tmp_path: Path) -> None:
        line = "<gml:LineString><gml:posList>{}</gml:posList></gml:LineString>"
        curve = f"<gml:curveMember>{line}</gml:curveMember>"
        ring = curve.format("0 0 0 4 0 0 4 4 0") + curve.format("4 4 0 0 4 0 0 0 0")
        text = f"<gml:Polygon><gml:exterior><gml:Ring>{ring}</gml:Ring></gml:exterior></gml:Polygon>"
        model = model_of(tmp_path, city(member(multi_surface(surface_members([text]))), srs=None))
        assert model.polygons.points.tolist() == [[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]]

    def test_orientation_turns_a_polygon_round(self, tmp_path: Path) -> None:
        base = "<gml:baseSurface>{}</gml:baseSurface>"
        turned = f'<gml:OrientableSurface orientation="-">{base}</gml:OrientableSurface>'
        text = multi_surface(surface_members([polygon(BOX[1])])) + multi_surface(
            surface_members([turned.format(polygon(BOX[1]))]), 3
        )
        model = model_of(tmp_path, city(member(text)))
        first, second = model.polygons.points[:4], model.polygons.points[4:]
        assert {tuple(p) for p in first.tolist()} == {tuple(p) for p in second.tolist()}
        area = [np.cross(r[1] - r[0], r[2] - r[0])[2] for r in (first, second)]
        assert area[0] == -area[1] > 0

    def test_plateau_attribute_that_looks_like_geometry(self, tmp_path: Path) -> None:
        extra = (
            "<uro:lod1HeightType>2</uro:lod1HeightType><uro:lod1Solid>" + polygon(BOX[0]) + "</uro:lod1Solid>"
        )
        text = city(member(extra + solid_of(BOX)))
        assert len(model_of(tmp_path, text).polygons) == 6

    def test_two_dimensional_footprint(self, tmp_path: Path) -> None:
        ring = '<gml:posList srsDimension="2">0 0 6 0 6 6 0 6 0 0 </gml:posList>'
        implied = "<gml:posList>0 0 6 0 6 6 3 7 0 6 0 0</gml:posList>"
        text = surface_members([polygon(ring), polygon(implied)])
        content = f"<bldg:lod0FootPrint><gml:MultiSurface>{text}</gml:MultiSurface></bldg:lod0FootPrint>"
        model = model_of(tmp_path, city(member(content), srs=None))
        assert np.diff(model.polygons.ring_starts).tolist() == [4, 5]
        assert not model.polygons.points[:, 2].any()
        assert codes(model)["LB110"] == 2


class TestImplicitGeometry:
    shape = (
        "<gml:MultiSurface>"
        + surface_members([polygon([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)], gml_id="shape")])
        + "</gml:MultiSurface>"
    )

    def placed(self, shape: str, at: str, matrix: str = "") -> str:
        return (
            "<bldg:outerBuildingInstallation><bldg:BuildingInstallation><bldg:lod3ImplicitRepresentation>"
            f"<core:ImplicitGeometry>{matrix}{shape}<core:referencePoint><gml:Point><gml:pos>{at}</gml:pos>"
            "</gml:Point></core:referencePoint></core:ImplicitGeometry></bldg:lod3ImplicitRepresentation>"
            "</bldg:BuildingInstallation></bldg:outerBuildingInstallation>"
        )

    def test_shape_and_links_to_it(self, tmp_path: Path) -> None:
        turned = "<core:transformationMatrix>0 -2 0 0 2 0 0 0 0 0 2 5 0 0 0 1</core:transformationMatrix>"
        inline = f"<core:relativeGMLGeometry>{self.shape}</core:relativeGMLGeometry>"
        linked = '<core:relativeGMLGeometry xlink:href="#shape"/>'
        content = self.placed(inline, "100 200 3") + self.placed(linked, "300 400 3", turned)
        other = self.placed(linked, "500 600 3")
        text = city(member(content) + member(other, "b2"), srs=None)
        model = model_of(tmp_path, text)
        corners = model.polygons.points.reshape(-1, 3, 3)
        assert corners[0].tolist() == [[100, 200, 3], [101, 200, 3], [100, 201, 3]]
        assert corners[1].tolist() == [[300, 400, 8], [300, 402, 8], [298, 400, 8]]
        assert corners[2].tolist() == [[500, 600, 3], [501, 600, 3], [500, 601, 3]]
        assert set(model.polygons.kind) == {SurfaceKind.INSTALLATION}

    @pytest.mark.parametrize(
        ("shape", "at"),
        [
            ("<core:libraryObject>http://127.0.0.1/tree.3ds</core:libraryObject>", "0 0 0"),
            ("<core:transformationMatrix>1 2 3</core:transformationMatrix>", "0 0 0"),
            ("", "0 x 0"),
        ],
    )
    def test_what_cannot_be_placed_is_a_finding(self, tmp_path: Path, shape: str, at: str) -> None:
        text = city(member(self.placed(shape, at) + solid_of(BOX)))
        assert codes(model_of(tmp_path, text)) == {"LB206": 1}

    def test_metres_are_not_added_to_degrees(self, tmp_path: Path) -> None:
        shape = f"<core:relativeGMLGeometry>{self.shape}</core:relativeGMLGeometry>"
        rings = [[(35.6 + y * 1e-5, 139.7 + x * 1e-5, z) for x, y, z in box_rings()[k]] for k in range(6)]
        rings = [[(a % 1 + 35, b % 1 + 139, z) for a, b, z in ring] for ring in rings]
        own = solid_of(rings)
        model = model_of(tmp_path, city(member(own + self.placed(shape, "35.6 139.7 3")), srs="EPSG:6697"))
        assert codes(model)["LB206"] == 1
        assert np.ptp(model.polygons.points[:, :2], axis=0).max() < 100

    def test_the_point_says_where(self, tmp_path: Path) -> None:
        shape = f"<core:relativeGMLGeometry>{self.shape}</core:relativeGMLGeometry>"
        shape = shape.replace("<gml:MultiSurface>", '<gml:MultiSurface srsName="EPSG:4979">')
        placed = self.placed(shape, "500000 5600000 3").replace(
            "<gml:Point>", '<gml:Point srsName="EPSG:25833">'
        )
        model = model_of(tmp_path, city(member(placed)))
        assert (model.crs, model.origin.tolist()) == ("EPSG:25833", [500000.0, 5600000.0, 0.0])


class TestRings:
    def ring_model(self, tmp_path: Path, ring: str, **options: object) -> CityModel:
        good = polygon([(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (3.0, 3.0, 0.0)])
        text = city(member(multi_surface(surface_members([good, polygon(ring)])), "Haus-ä"), srs=None)
        return model_of(tmp_path, text, **options)

    @pytest.mark.parametrize(
        ("numbers", "expected", "num_polygons"),
        [
            ("0 0 0 1 0 0 1 1 0", {"LB103": 1}, 2),
            ("0 0 0 1 0 0 1 0 0 1 1 0 0 0 0", {"LB102": 1}, 2),
            ("0 0 0 1 0 0 0 0 0", {"LB101": 1}, 1),
            ("0 0 0 0 0 0", {"LB101": 1, "LB102": 1}, 1),
            ("", {"LB101": 1}, 1),
        ],
    )
    def test_cleaning(self, tmp_path, numbers, expected, num_polygons):
        model = self.ring_model(tmp_path, f"<gml:posList>{numbers}</gml:posList>")
        found = codes(model)
        assert found.pop("LB301") == 1
        found.pop("LB102", None) if "LB102" not in expected else None
        assert found == expected
        assert len(model.polygons) == num_polygons

    @pytest.mark.parametrize(
        ("numbers", "message", "code"),
        [
            ("0 0 0 1 0 NaN 1 1 0 0 0 0", "finite", "LB107"),
            ("0 0 0 1 0 inf 1 1 0 0 0 0", "finite", "LB107"),
            ("0 0 0 1 0 1e400 1 1 0 0 0 0", "finite", "LB107"),
            ("0 0 0 1 0 abc 1 1 0 0 0 0", "finite", "LB107"),
            ("0 0 0 1 0 0 1 1 0 0 0", "11 numbers", "LB108"),
        ],
    )
    def test_bad_coordinates(self, tmp_path: Path, numbers: str, message: str, code: str) -> None:
        ring = f"<gml:posList>{numbers}</gml:posList>"
        with pytest.raises(CityModelError, match=f"Haus-ä.*{message}") as caught:
            self.ring_model(tmp_path, ring)
        assert caught.value.hint
        model = self.ring_model(tmp_path, ring, options=ReadOptions(is_strict=False))
        assert codes(model)[code] == 1
        assert len(model.polygons) == 1


class TestWhereSystemsAreDeclared:
    """A reference system counts wherever GML allows it, for what is below."""

    RINGS = (BOX, [[(x + 4e3, y, z) for x, y, z in ring] for ring in BOX])

    @pytest.mark.parametrize("place", ["Solid", "CompositeSurface", "Polygon", "LinearRing", "posList"])
    def test_inside_of_a_geometry(self, tmp_path: Path, place: str) -> None:
        declared, plain = (solid(surface_members(polygon(r) for r in rings)) for rings in self.RINGS)
        declared = declared.replace(f"<gml:{place}>", f'<gml:{place} srsName="EPSG:25833">')
        alone = model_of(tmp_path, city(member(declared), srs=None))
        assert (alone.crs, codes(alone)) == ("EPSG:25833", {})
        model = model_of(tmp_path, city(member(plain, "b1") + member(declared, "b2")))
        points = model.polygons.points + model.origin
        zone_33 = Transformer.from_crs(25833, 25832, always_xy=True).transform(500000.0, 5600000.0)
        assert points[:, 0].max() - zone_33[0] < 15
        assert codes(model)["LB307"] == 1

    def test_beside_others_without(self, tmp_path: Path) -> None:
        rings = (surface_members(polygon(r) for r in self.RINGS[0][k : k + 1]) for k in (0, 1))
        first, second = (f"<gml:CompositeSurface>{r}</gml:CompositeSurface>" for r in rings)
        first = first.replace("<gml:CompositeSurface>", '<gml:CompositeSurface srsName="EPSG:25833">')
        text = multi_surface(surface_members([first, second]))
        model = model_of(tmp_path, city(member(text)))
        assert np.ptp(model.polygons.points[:, 0]) > 4e5  # only one of the two is in the other zone

    @pytest.mark.parametrize("holder", ["", "wfs:member"])
    def test_city_model_inside_of_an_answer(self, tmp_path: Path, holder: str) -> None:
        inner = city(member(solid(surface_members(polygon(r) for r in BOX)))).partition("\n")[2]
        if holder:
            inner = f"<{holder}>{inner}</{holder}>"
        wfs = 'xmlns:wfs="http://www.opengis.net/wfs/2.0"'
        model = model_of(tmp_path, f"<wfs:FeatureCollection {wfs}>{inner}</wfs:FeatureCollection>")
        assert (model.crs, codes(model)) == ("EPSG:25832", {})
