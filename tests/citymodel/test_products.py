"""What is made of a city: derived levels, reports, other formats, the cache."""

import json
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, mesh_city, mesh_model, open_scene, read_city_model
from lodbench.citymodel.cache import open_cached_scene
from lodbench.citymodel.checks.report import check_city, format_report
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.model import SurfaceKind
from lodbench.citymodel.scene import Scene
from lodbench.errors import CityModelError, ConfigError

from .gml_text import (
    bounded_by,
    box_city,
    box_rings,
    city,
    link,
    member,
    multi_surface,
    polygon,
    solid,
    solid_of,
    surface_members,
    write,
)
from .twins import documents

E0, N0 = 500000.0, 5600000.0
GABLE = {
    "GroundSurface": [[(0, 0, 10), (0, 8, 10), (10, 8, 10), (10, 0, 10)]],
    "RoofSurface": [
        [(0, 0, 14), (10, 0, 14), (10, 4, 18), (0, 4, 18)],
        [(0, 4, 18), (10, 4, 18), (10, 8, 14), (0, 8, 14)],
    ],
    "WallSurface": [
        [(0, 0, 10), (10, 0, 10), (10, 0, 14), (0, 0, 14)],
        [(10, 8, 10), (0, 8, 10), (0, 8, 14), (10, 8, 14)],
        [(10, 0, 10), (10, 8, 10), (10, 8, 14), (10, 4, 18), (10, 0, 14)],
        [(0, 8, 10), (0, 0, 10), (0, 0, 14), (0, 4, 18), (0, 8, 14)],
    ],
}


def gable(*, kinds: tuple[str, ...] = tuple(GABLE), is_solid: bool = False) -> str:
    content = ""
    for name in kinds:
        rings = [[(x + E0, y + N0, float(z)) for x, y, z in ring] for ring in GABLE[name]]
        members = surface_members(map(polygon, rings))
        content += members if is_solid else bounded_by(name, multi_surface(members))
    return city(member(solid(content, 2) if is_solid else content))


class TestDerivedLevel:
    @pytest.mark.parametrize(("rule", "top"), [("eave", 14), ("median", 16), ("p70", 16.8), ("max", 18)])
    @pytest.mark.parametrize("is_solid", [False, True])
    def test_rules(self, tmp_path: Path, rule: str, top: float, is_solid: bool) -> None:
        path = write(tmp_path / "a.gml", gable(is_solid=is_solid))
        scene = open_scene(path, lod="1", roof_height=rule)
        low, high = scene.extent_m
        assert (low[2], scene.lod) == (10, "1")
        assert high[2] == pytest.approx(top, abs=0.25)
        assert scene.triangles.shape == (12, 3)

    def test_footprint_from_roofs_where_there_is_no_ground(self, tmp_path: Path) -> None:
        path = write(tmp_path / "a.gml", gable(kinds=("RoofSurface", "WallSurface")))
        mesh = mesh_model(read_city_model(path), "1", roof_height="max")
        assert (mesh.scene.extent_m[1] - mesh.scene.extent_m[0]).tolist() == [10, 8, 8]
        assert mesh.findings.counts() == {"LB408 LOD_DERIVED": 1}

    def test_footprints_are_dissolved(self, tmp_path: Path) -> None:
        floors = [[(x, 0, 10), (x, 8, 10), (x + 5, 8, 10), (x + 5, 0, 10)] for x in (0, 5)]
        roof = [[(0, 0, 14), (10, 0, 14), (10, 8, 14), (0, 8, 14)]]
        content = ""
        for name, rings in (("GroundSurface", floors), ("RoofSurface", roof)):
            rings = [[(x + E0, y + N0, float(z)) for x, y, z in ring] for ring in rings]
            content += bounded_by(name, multi_surface(surface_members(map(polygon, rings))))
        model = read_city_model(write(tmp_path / "a.gml", city(member(content))))
        mesh = mesh_model(model, "1", roof_height="max")
        assert mesh.area_m2 == pytest.approx(2 * 80 + 2 * 4 * (10 + 8))
        assert (mesh.lost_m2, mesh.excess_m2) == pytest.approx((0.0, 0.0), abs=1e-9)

    def test_every_part_has_its_height(self, tmp_path: Path) -> None:
        boxes = [box_rings(E0, N0, 10, 10, 6), box_rings(E0 + 10, N0, 10, 10, 20)]
        parts = "".join(
            f'<bldg:consistsOfBuildingPart><bldg:BuildingPart gml:id="p{n}">'
            f"{solid_of(box, 2)}"
            "</bldg:BuildingPart></bldg:consistsOfBuildingPart>"
            for n, box in enumerate(boxes)
        )
        model = read_city_model(write(tmp_path / "a.gml", city(member(parts))))
        mesh = mesh_model(model, "1", roof_height="max")
        assert mesh.area_m2 == pytest.approx(440 + 1000)
        heights = np.unique(mesh.scene.vertices[:, 2]).tolist()
        assert heights == [10, 16, 30]

    def test_a_level_that_is_there_is_taken(self, tmp_path: Path) -> None:
        path = write(tmp_path / "a.gml", box_city())
        assert open_scene(path, lod="1", roof_height="max").digest() == open_scene(path, lod="1").digest()

    def test_only_walls(self, tmp_path: Path) -> None:
        path = write(tmp_path / "a.gml", gable(kinds=("WallSurface",)))
        with pytest.raises(CityModelError, match="No building has a footprint"):
            open_scene(path, lod="1", roof_height="max")

    @pytest.mark.parametrize("kinds", [("WallSurface",), ("WallSurface", "GroundSurface")])
    def test_a_building_without_a_roof_is_told(self, tmp_path: Path, kinds: tuple[str, ...]) -> None:
        walls = gable(kinds=kinds).partition("<core:cityObjectMember>")[2]
        text = gable().replace("</core:CityModel>", "<core:cityObjectMember>" + walls)
        mesh = mesh_model(read_city_model(write(tmp_path / "a.gml", text)), "1", roof_height="max")
        assert {key.split()[0] for key in mesh.findings.counts()} == {"LB401", "LB408", "LB409"}

    def test_without_a_rule_the_hint_names_it(self, tmp_path: Path) -> None:
        path = write(tmp_path / "a.gml", gable())
        with pytest.raises(CityModelError, match="level of detail 1") as caught:
            open_scene(path, lod="1")
        assert "roof_height=" in caught.value.hint
        with pytest.raises(ConfigError, match="roof_height=middle"):
            open_scene(path, lod="1", roof_height="middle")

    def test_a_rule_that_derives_nothing_is_told(self, tmp_path: Path) -> None:
        model = read_city_model(write(tmp_path / "a.gml", gable()))
        for lod in (None, "2", "finest"):
            found = mesh_model(model, lod, roof_height="max").findings.counts()
            assert found == {"LB411 OPTION_UNUSED": 1}
        with pytest.raises(ConfigError, match="roof_height=middle"):
            mesh_model(model, roof_height="middle")

    def test_what_a_notebook_shows_of_a_city_is_short(self, tmp_path: Path) -> None:
        path = write(tmp_path / "a.gml", gable())
        model = read_city_model(path)
        said = f"1 buildings, {len(model.polygons)} polygons, LoD 2, {model.crs}, {path}"
        assert repr(model) == f"CityModel({said})"
        shown = repr(mesh_model(model, roof_height="max"))
        assert "findings=Findings(1 x LB411 OPTION_UNUSED)" in shown
        assert len(shown) < 300

    def test_a_level_may_be_a_number(self, tmp_path: Path) -> None:
        path = write(tmp_path / "a.gml", gable())
        assert open_scene(path, lod=2).lod == "2"  # type: ignore[arg-type]
        with pytest.raises(CityModelError, match="level of detail 3"):
            open_scene(path, lod=3)  # type: ignore[arg-type]

    def test_real_tile_stands_where_it_stood(self, shared_data: Path) -> None:
        path = shared_data / "city/germany_lod2/LoD2_32_280_5657_1_NW.gml"
        model = read_city_model(path)
        fine, coarse = mesh_city(model), mesh_city(model, "1", roof_height="median")
        assert np.allclose(fine.extent_m[0], coarse.extent_m[0], atol=0.01)
        # One wall of the source sticks out of its own house by three metres; a block has no such wall.
        assert np.allclose(fine.extent_m[1][:2], coarse.extent_m[1][:2], atol=3.5)


class TestBases:
    def test_sunk_walls_are_cut(self, tmp_path: Path) -> None:
        path = write(tmp_path / "a.gml", gable())
        options = ReadOptions(base="sunk", sunk_m=3.0)
        model = read_city_model(path, options=options)
        assert model.polygons.points[:, 2].min() == 13
        assert model.polygons.points[:, 2].max() == 18
        assert model.findings.counts() == {"LB407 BASE_MOVED": 1}

    def test_zero_base_is_set_on_the_ground(self, tmp_path: Path) -> None:
        path = write(tmp_path / "a.gml", box_city(z=0.0))
        grid = f"ncols 1\nnrows 1\nxllcorner {E0}\nyllcorner {N0}\ncellsize 20\n123.5\n"
        terrain = str(write(tmp_path / "t.asc", grid))
        for options in (
            ReadOptions(base="ground", ground_m=123.5),
            ReadOptions(base="ground", terrain=terrain),
        ):
            assert read_city_model(path, options=options).polygons.points[:, 2].min() == 123.5


class TestReport:
    def test_clean(self, tmp_path: Path) -> None:
        report = check_city(read_city_model(write(tmp_path / "a.gml", box_city())))
        assert not report.has_errors
        assert format_report(report).splitlines()[1:] == [
            "no findings",
            "LoD1: 440.00 m2 in, 440.00 m2 meshed, 0.00 m2 lost",
        ]

    def test_rows_are_sorted_and_carry_buildings(self, tmp_path: Path) -> None:
        bad = polygon("<gml:posList>0 0 0 1 0 NaN 1 1 0 0 0 0</gml:posList>")
        bow = polygon([(E0, N0, 0.0), (E0 + 4, N0 + 4, 0.0), (E0 + 4, N0, 0.0), (E0, N0 + 3, 0.0)])
        text = city(member(multi_surface(surface_members([bad, bow]))) + member("", "b2"))
        model = read_city_model(write(tmp_path / "a.gml", text), options=ReadOptions(is_strict=False))
        report = check_city(model)
        assert report.has_errors
        assert [row.code.code for row in report.rows] == ["LB106", "LB107", "LB112", "LB401", "LB403"]
        assert report.rows[1].objects == ("b1",)
        text = format_report(report)
        assert "LB107  BAD_COORDINATE" in text
        assert "e.g. b1, 0 0 0 1 0 NaN" in text
        parsed = json.loads(json.dumps(report.to_json()))
        assert parsed["findings"][0]["severity"] == "error"
        assert parsed["areas"][0]["lost_m2"] == 0.0


class TestConvert:
    @pytest.mark.parametrize("suffix", ["obj", "ply", "glb"])
    def test_meshes_come_back(self, tmp_path: Path, suffix: str) -> None:
        model = read_city_model(write(tmp_path / "a.gml", documents()["v2.gml"]))
        scene = mesh_city(model)
        target = tmp_path / f"Köln (1).{suffix}"
        convert_city(model, target)
        options = ReadOptions(crs="EPSG:25832", origin=tuple(model.origin.tolist()))  # type: ignore[arg-type]
        again = open_scene(target, options=options)
        assert again.crs == scene.crs
        assert np.array_equal(again.origin, scene.origin)
        assert np.allclose(again.extent_m, scene.extent_m, atol=1e-4)
        assert sorted(np.rint(again.vertices * 1000).tolist()) == sorted(
            np.rint(scene.vertices * 1000).tolist()
        )
        if suffix == "glb":
            assert again.building_ids == scene.building_ids

    def test_cityjson_comes_back(self, tmp_path: Path) -> None:
        model = read_city_model(write(tmp_path / "a.gml", documents()["v3.gml"]))
        convert_city(model, tmp_path / "a.json")
        again = read_city_model(tmp_path / "a.json")
        assert (again.crs, again.lods, again.building_ids) == (model.crs, model.lods, model.building_ids)
        assert np.array_equal(again.polygons.kind, model.polygons.kind)
        assert np.allclose(again.polygons.points, model.polygons.points, atol=6e-4)

    def test_cityjson_keeps_parts_attributes_solids_and_labels(self, tmp_path: Path) -> None:
        box = box_rings(E0, N0)
        labels = ["GroundSurface", "RoofSurface", "WallSurface", "WallSurface", "OuterCeilingSurface", "Door"]
        surfaces = "".join(
            f'<bldg:boundedBy><bldg:{name} gml:id="s{n}">'
            + multi_surface(surface_members([polygon(ring, gml_id=f"g{n}")]))
            + f"</bldg:{name}></bldg:boundedBy>"
            for n, (name, ring) in enumerate(zip(labels, box, strict=True))
        )
        facts = (
            "<bldg:function>1000</bldg:function><bldg:measuredHeight uom='m'>6.5</bldg:measuredHeight>"
            "<gen:stringAttribute xmlns:gen='http://www.opengis.net/citygml/generics/2.0' name='Gemeinde'>"
            "<gen:value>Köln</gen:value></gen:stringAttribute>"
            "<bldg:address><core:Address><core:xalAddress><ThoroughfareName>Am Dom</ThoroughfareName>"
            "</core:xalAddress></core:Address></bldg:address>"
        )
        part = (
            '<bldg:consistsOfBuildingPart><bldg:BuildingPart gml:id="p1">'
            "<bldg:roofType>3100</bldg:roofType>"
            + solid("".join(link(f"#g{n}") for n in range(6)), 2)
            + surfaces
            + "</bldg:BuildingPart></bldg:consistsOfBuildingPart>"
        )
        text = city(member(facts + part), srs="EPSG:25832+5783")
        path = write(tmp_path / "a.gml", text)
        for name in ("a.json", "a.jsonl"):
            model = read_city_model(path, options=ReadOptions(has_details=True))
            assert convert_city(model, tmp_path / name).left_out == ()
            again = read_city_model(tmp_path / name, options=ReadOptions(has_details=True))
            assert again.crs == "EPSG:5555"
            assert again.objects is not None
            assert again.objects.ids == ("b1", "p1")
            assert again.objects.types == ("Building", "BuildingPart")
            assert again.objects.parents.tolist() == [-1, 0]
            assert again.objects.attributes[0] == {
                "function": "1000",
                "measuredHeight": 6.5,
                "Gemeinde": "Köln",
                "address": [{"ThoroughfareName": "Am Dom"}],
            }
            assert again.objects.attributes[1] == {"roofType": "3100"}
            assert again.solids is not None
            assert again.solids.faces.tolist() == [0, 1, 2, 3, 4, 5]
            kinds = [SurfaceKind(kind).name for kind in again.polygons.kind.tolist()]
            assert kinds == ["GROUND", "ROOF", "WALL", "WALL", "CEILING", "DOOR"]
            assert again.findings.counts() == {}

    def test_one_level_of_cityjson(self, tmp_path: Path) -> None:
        model = read_city_model(write(tmp_path / "a.gml", gable()))
        done = convert_city(model, tmp_path / "a.json", lod="1", roof_height="max")
        again = read_city_model(tmp_path / "a.json")
        assert (again.lods, len(again.polygons)) == (("1",), 6)
        assert done.findings.counts() == {"LB408 LOD_DERIVED": 1}

    def test_what_cityjson_cannot_say_is_told(self, tmp_path: Path) -> None:
        text = city(member(solid_of(box_rings())), srs="EPSG:25832+7837")
        model = read_city_model(write(tmp_path / "a.gml", text))
        (line,) = convert_city(model, tmp_path / "a.json").left_out
        assert "EPSG:25832+7837" in line

    @pytest.mark.parametrize("name", ["a.gml", "a.json", "a.jsonl"])
    def test_triangles_that_a_mesh_has_twice_are_told(self, tmp_path: Path, name: str) -> None:
        corners = "v 0 0 0\nv 4 0 0\nv 0 3 0\nv 0 0 2\n"
        path = write(tmp_path / "a.obj", corners + "f 1 2 3\nf 1 2 4\nf 3 2 1\n")
        model = read_city_model(path)
        assert (len(model.polygons), model.findings.counts()) == (3, {})
        done = convert_city(model, tmp_path / name)
        assert (len(done.model.polygons), done.findings.counts()) == (2, {"LB109 DUPLICATE_POLYGON": 1})
        again = read_city_model(tmp_path / name)
        assert (len(again.polygons), again.findings.counts()) == (2, {"LB301 CRS_MISSING": 1})
        as_mesh = convert_city(model, tmp_path / "b.obj")
        assert as_mesh.findings.counts() == {}
        assert len(read_city_model(tmp_path / "b.obj").polygons) == 3

    def test_refusals(self, tmp_path: Path) -> None:
        model = read_city_model(write(tmp_path / "a.gml", box_city()))
        with pytest.raises(CityModelError, match="No format"):
            convert_city(model, tmp_path / "a.dwg")
        with pytest.raises(CityModelError, match="cannot be written"):
            convert_city(model, tmp_path / "nowhere" / "a.obj")
        assert sorted(path.name for path in tmp_path.iterdir()) == ["a.gml"]


def same(first: Scene, second: Scene) -> bool:
    return (
        first.digest() == second.digest()
        and first.building_ids == second.building_ids
        and (first.lod, first.crs) == (second.lod, second.crs)
        and np.array_equal(first.origin, second.origin)
    )


class TestCache:
    @pytest.fixture(autouse=True)
    def _own_cache(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))

    def test_second_time_is_mapped(self, tmp_path: Path) -> None:
        path = write(tmp_path / "a.gml", box_city())
        first, second = open_cached_scene(path), open_cached_scene(path)
        assert same(first, second)
        assert isinstance(second.vertices, np.memmap)
        copy = write(tmp_path / "copy.gml", box_city())
        assert isinstance(open_cached_scene(copy).vertices, np.memmap)

    def test_key_follows_content_and_options(self, tmp_path: Path) -> None:
        path = write(tmp_path / "a.gml", gable())
        heights = {open_cached_scene(path, lod="1", roof_height=r).extent_m[1][2] for r in ("eave", "max")}
        assert heights == {14, 18}
        sunk = open_cached_scene(path, options=ReadOptions(base="sunk"))
        assert sunk.extent_m[0][2] == 13
        write(path, box_city())
        assert open_cached_scene(path).lod == "1"

    def test_damaged_entry_is_made_anew(self, tmp_path: Path) -> None:
        path = write(tmp_path / "a.gml", box_city())
        open_cached_scene(path)
        for file in (tmp_path / "cache").rglob("vertices.npy"):
            file.write_bytes(b"")
        assert open_cached_scene(path).num_buildings == 1

    @pytest.mark.parametrize("name", ["vertices", "triangles", "vertex_starts", "triangle_starts"])
    def test_one_flipped_bit_is_made_anew_and_said(self, tmp_path: Path, caplog, name: str) -> None:
        path = write(tmp_path / "a.gml", box_city())
        digest = open_cached_scene(path).digest()
        (file,) = (tmp_path / "cache").rglob(f"{name}.npy")
        whole = file.read_bytes()
        file.write_bytes(whole[:-2] + bytes([whole[-2] ^ 1]) + whole[-1:])
        assert open_cached_scene(path).digest() == digest
        assert file.read_bytes() == whole
        assert f"damaged: {name}.npy is not the file that was written. It is made anew." in caplog.text

    def test_beyond_its_size_the_oldest_goes(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = write(tmp_path / "a.gml", gable())
        first = open_cached_scene(path)
        monkeypatch.setenv("LODBENCH_CACHE_GB", "0")
        second = open_cached_scene(path, lod="1", roof_height="max")
        assert len(list((tmp_path / "cache/scenes").iterdir())) == 1
        assert open_cached_scene(path, lod="1", roof_height="max").digest() == second.digest()
        # What is mapped stays readable, and a scene that is gone is made anew.
        assert open_cached_scene(path).digest() == first.digest()

    def test_unwritable_cache_is_no_fault(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("LODBENCH_CACHE", str(write(tmp_path / "file", "x")))
        assert open_cached_scene(write(tmp_path / "a.gml", box_city())).num_buildings == 1
