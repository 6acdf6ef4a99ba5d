"""Pictures of surfaces kept by conversions: every corner on the same spot of the same picture."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from lodbench.citymodel import ReadOptions, read_city_model
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.textured_map import read_textured
from lodbench.cli import main

from .schemas import FEATURE, assert_keeps_the_rules, assert_valid

EAST, NORTH = 691000.0, 5335000.0
OPTIONS = ReadOptions(has_details=True, has_textures=True)
WALL = {(0, 0, 0): (0.0, 0.25), (10, 0, 0): (3.5, 0.25), (10, 0, 5): (3.5, 1), (0, 0, 5): (0, 1)}
ROOF = {(0, 0, 5): (0, 0), (10, 0, 5): (1, 0), (10, 9, 5): (1, 1), (0, 9, 5): (0, 1)}
HOLE = {(2, 2, 5): (0.2, 0.2), (2, 4, 5): (0.2, 0.4), (4, 4, 5): (0.4, 0.4), (4, 2, 5): (0.4, 0.2)}
BACK = {(10, 9, 0): (0, 0), (0, 9, 0): (1, 0), (0, 9, 5): (1, 1), (10, 9, 5): (0, 1)}
JPEG = "pictures/wall east.jpg"
Spots = dict[tuple[float, ...], tuple[Any, ...]]


def text_of(corners: dict, shift: float, is_uv: bool = False) -> str:
    rows = [uv if is_uv else np.add(xyz, (EAST + shift, NORTH, 0)) for xyz, uv in corners.items()]
    return " ".join(str(float(value)) for row in [*rows, rows[0]] for value in row)


def polygon(name: str, rings: list[dict], shift: float) -> str:
    sides = "".join(
        f'<gml:{side}><gml:LinearRing gml:id="{name}-{k}"><gml:posList>{text_of(ring, shift)}</gml:posList>'
        f"</gml:LinearRing></gml:{side}>"
        for k, (ring, side) in enumerate(zip(rings, ("exterior", "interior"), strict=False))
    )
    return f'<gml:Polygon gml:id="{name}">{sides}</gml:Polygon>'


def surface(kind: str, shape: str) -> str:
    return (
        f"<bldg:boundedBy><bldg:{kind}><bldg:lod2MultiSurface><gml:MultiSurface><gml:surfaceMember>{shape}"
        f"</gml:surfaceMember></gml:MultiSurface></bldg:lod2MultiSurface></bldg:{kind}></bldg:boundedBy>"
    )


def texture(image: str, name: str, rings: list[dict]) -> str:
    places = "".join(
        f'<app:textureCoordinates ring="#{name}-{k}">{text_of(ring, 0, True)}</app:textureCoordinates>'
        for k, ring in enumerate(rings)
    )
    return (
        f"<app:surfaceDataMember><app:ParameterizedTexture><app:imageURI>{image}</app:imageURI>"
        f'<app:target uri="#{name}"><app:TexCoordList>{places}</app:TexCoordList></app:target>'
        "</app:ParameterizedTexture></app:surfaceDataMember>"
    )


def write_town(folder: Path, colour: int = 200, wall: str = JPEG, shift: float = 0) -> Path:
    """A wall, a roof with a hole, a wall seen from behind, and a ground without a picture; two pictures."""
    (folder / "pictures").mkdir(parents=True)
    Image.new("RGB", (8, 4), (colour, 90, 20)).save(folder / "pictures/wall east.jpg", "JPEG")
    Image.new("RGB", (5, 5), (20, colour, 90)).save(folder / "pictures/roof.tif", "TIFF")
    turned = f'<gml:OrientableSurface orientation="-"><gml:baseSurface>{polygon("back", [BACK], shift)}'
    ground = {(x, y, 0): () for x, y, _ in ROOF}
    walls = surface("WallSurface", polygon("wall", [WALL], shift))
    walls += surface("WallSurface", f"{turned}</gml:baseSurface></gml:OrientableSurface>")
    roof = surface("RoofSurface", polygon("roof", [ROOF, HOLE], shift))
    path = folder / "town.gml"
    path.write_text(
        '<CityModel xmlns="http://www.opengis.net/citygml/2.0" xmlns:gml="http://www.opengis.net/gml" '
        'xmlns:app="http://www.opengis.net/citygml/appearance/2.0" '
        'xmlns:bldg="http://www.opengis.net/citygml/building/2.0"><gml:boundedBy><gml:Envelope '
        'srsName="EPSG:25832" srsDimension="3"/></gml:boundedBy><cityObjectMember>'
        f'<bldg:Building gml:id="b{shift:.0f}">{walls}{roof}'
        f"{surface('GroundSurface', polygon('ground', [ground], shift))}</bldg:Building></cityObjectMember>"
        "<app:appearanceMember><app:Appearance><app:theme>photo</app:theme>"
        f"{texture(wall, 'wall', [WALL])}{texture('pictures/roof.tif', 'roof', [ROOF, HOLE])}"
        f"{texture(wall, 'back', [BACK])}</app:Appearance></app:appearanceMember></CityModel>"
    )
    return path


def spots_of(model: CityModel) -> Spots:
    """Every corner of a surface with a picture, by kind and place: its spot, and the picture's colour."""
    polygons, spots = model.polygons, {}
    assert model.pictures is not None
    assert polygons.picture is not None
    assert polygons.uv is not None
    for n in np.flatnonzero(polygons.picture >= 0):
        picture = Image.open(model.pictures.files[polygons.picture[n]]).convert("RGB").getpixel((1, 1))
        points = slice(*polygons.ring_starts[polygons.polygon_starts[[n, n + 1]]])
        for point, uv in zip(polygons.points[points] + model.origin, polygons.uv[points], strict=True):
            assert isinstance(picture, tuple)
            # A JPEG and what a viewer makes of it differ by rounding.
            key = (int(polygons.kind[n]), *np.round(point - (EAST, NORTH, 0), 3).tolist())
            spots[key] = (*np.round(uv, 5).tolist(), *(round(value / 10) for value in picture))
    return spots


def expected(colour: int = 200) -> Spots:
    spots: Spots = {}
    for kind, rings, picture in ((1, [WALL, BACK], (colour, 90, 20)), (2, [ROOF, HOLE], (20, colour, 90))):
        tens = tuple(round(value / 10) for value in picture)
        spots |= {(kind, *map(float, xyz)): (*uv, *tens) for ring in rings for xyz, uv in ring.items()}
    return spots


def convert(source: Path, target: Path, *more: str) -> Path:
    target.parent.mkdir(exist_ok=True)
    assert main(["city", "convert", str(source), str(target), "--textures", *more]) == 0
    return target


def test_read(tmp_path: Path) -> None:
    assert spots_of(read_city_model(write_town(tmp_path), options=OPTIONS)) == expected()


@pytest.mark.parametrize(
    ("ending", "more"),
    [(".city.json", ()), (".city.jsonl", ()), (".gml", ()), (".gml", ("--citygml", "3.0"))],
)
def test_there_and_back(ending: str, more: tuple[str, ...], tmp_path: Path) -> None:
    target = convert(write_town(tmp_path), tmp_path / f"out/a{ending}", *more)
    (tmp_path / "pictures/roof.tif").unlink()  # what was written needs nothing of the source
    assert spots_of(read_city_model(target, options=OPTIONS)) == expected()
    names = sorted(path.name for path in (target.parent / "a_pictures").iterdir())
    assert names == ["0001_wall_east.jpg", "0002_roof.png"]
    copied = (target.parent / "a_pictures/0001_wall_east.jpg").read_bytes()
    assert copied == (tmp_path / "pictures/wall east.jpg").read_bytes()


@pytest.mark.parametrize("ending", [".city.json", ".gml"])
def test_names_of_files_that_mean_something_in_xml_or_in_links(ending: str, tmp_path: Path) -> None:
    target = convert(write_town(tmp_path), tmp_path / f"out/a&b <50%20>{ending}")
    assert spots_of(read_city_model(target, options=OPTIONS)) == expected()


def test_files_of_one_stem_keep_their_own_pictures(tmp_path: Path) -> None:
    sources = {"a.gml": write_town(tmp_path / "light", 200), "a.city.json": write_town(tmp_path / "dark", 60)}
    targets = [convert(source, tmp_path / "out" / name) for name, source in sources.items()]
    for target, colour in zip(targets, (200, 60), strict=True):
        assert spots_of(read_city_model(target, options=OPTIONS)) == expected(colour)


def test_a_long_way_round(tmp_path: Path) -> None:
    path = write_town(tmp_path)
    for n, ending in enumerate((".city.json", ".gml", ".city.jsonl", ".xml", ".city.json")):
        path = convert(path, tmp_path / f"{n}/town{ending}", *(("--citygml", "3.0") if n == 1 else ()))
    assert spots_of(read_city_model(path, options=OPTIONS)) == expected()


@pytest.mark.parametrize("more", [(), ("--citygml", "3.0")])
def test_the_reader_of_textured_maps_agrees(more: tuple[str, ...], tmp_path: Path) -> None:
    source = write_town(tmp_path)
    first, again = read_textured(source), read_textured(convert(source, tmp_path / "out/a.gml", *more))
    rows = [np.concatenate([m.corners.reshape(-1, 3), m.uv.reshape(-1, 2)], axis=1) for m in (first, again)]
    rows = [np.unique(np.round(part, 3), axis=0) for part in rows]
    np.testing.assert_array_equal(rows[0], rows[1])


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_meshes_of_cityjson(ending: str, tmp_path: Path) -> None:
    source = convert(write_town(tmp_path), tmp_path / "json/a.city.json")
    target = convert(source, tmp_path / f"mesh/a{ending}")
    mesh = read_textured(target)
    assert sorted({tuple(p[1, 1].astype(int) // 15) for p in mesh.pictures}) == [(1, 13, 6), (13, 6, 1)]
    shift = mesh.corners.reshape(-1, 3).min(axis=0)
    found = {(*np.round(c - shift, 3), *np.round(uv, 4)) for c, uv in
             zip(mesh.corners[mesh.picture >= 0].reshape(-1, 3), mesh.uv[mesh.picture >= 0].reshape(-1, 2),
                 strict=True)}  # fmt: skip
    assert found == {(*map(float, xyz), *uv) for ring in (WALL, ROOF, HOLE, BACK) for xyz, uv in ring.items()}


def test_valid_by_the_official_schemas_of_citygml(tmp_path: Path) -> None:
    schema = pytest.importorskip("citysmith.schema", reason="it brings the official schemas")
    report = schema.validate_schema(str(convert(write_town(tmp_path), tmp_path / "out/a.gml")))
    assert report.valid, report.messages[:3]


@pytest.mark.parametrize("ending", [".city.json", ".city.jsonl"])
def test_the_rules_of_cityjson(ending: str, tmp_path: Path) -> None:
    target = convert(write_town(tmp_path), tmp_path / f"out/a{ending}")
    documents = [json.loads(line) for line in target.read_text().splitlines()]
    textured = documents[-1]
    assert {texture["type"] for texture in textured["appearance"]["textures"]} == {"PNG", "JPG"}
    assert_keeps_the_rules(textured, *([FEATURE] if ending.endswith("l") else []))
    for document in documents:
        assert_valid(document)


def test_merged_cities_keep_their_own_pictures_of_one_name(tmp_path: Path) -> None:
    sources = [write_town(tmp_path / "a", 200), write_town(tmp_path / "b", 100, shift=500)]
    target = tmp_path / "both.city.json"
    assert main(["city", "convert", *map(str, sources), "-o", str(target), "--textures"]) == 0
    spots = spots_of(read_city_model(target, options=OPTIONS))
    assert {spot: value for spot, value in spots.items() if spot[1] < 100} == expected(200)
    moved = {(kind, x - 500, y, z): value for (kind, x, y, z), value in spots.items() if x > 100}
    assert moved == expected(100)


def test_tiles_and_subsets_carry_their_own_pictures(tmp_path: Path) -> None:
    sources = [write_town(tmp_path / "a", 200), write_town(tmp_path / "b", 100, shift=500)]
    target = tmp_path / "tiles/town.gml"
    assert (
        main(["city", "convert", *map(str, sources), "-o", str(target), "--textures", "--tiles", "250"]) == 0
    )
    folders = sorted(path.name for path in target.parent.iterdir() if path.is_dir())
    assert folders == ["town_691000_5335000_pictures", "town_691500_5335000_pictures"]
    tile = read_city_model(target.parent / "town_691000_5335000.gml", options=OPTIONS)
    assert spots_of(tile) == expected(200)
    assert all(len(list((target.parent / name).iterdir())) == 2 for name in folders)


def test_names_that_lead_out_are_not_followed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Image.new("RGB", (2, 2)).save(tmp_path / "secret.jpg")
    for n, name in enumerate(("../secret.jpg", str(tmp_path / "secret.jpg"), "..%2Fsecret.jpg",
                              "http://example.org/a.jpg", "pictures/none.jpg", "town.gml")):  # fmt: skip
        source = write_town(tmp_path / f"in{n}", wall=name)
        target = tmp_path / f"out{n}/a.city.json"
        capsys.readouterr()
        convert(source, target, "--json")
        left_out = json.loads(capsys.readouterr().out)["left_out"]
        assert any(name.split("/")[-1] in line for line in left_out), left_out
        assert any("2 x surface whose picture is not there" in line for line in left_out)
        assert [path.name for path in (target.parent / "a_pictures").iterdir()] == ["0001_roof.png"]
        kept = spots_of(read_city_model(target, options=OPTIONS))
        assert kept == {spot: value for spot, value in expected().items() if spot[0] == 2}


def test_names_in_cityjson_are_held_likewise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = convert(write_town(tmp_path), tmp_path / "json/a.city.json")
    document = json.loads(path.read_text())
    document["appearance"]["textures"][0]["image"] = "../pictures/wall east.jpg"
    shape = document["CityObjects"]["b0"]["geometry"][0]
    shape["texture"]["infrared"] = shape["texture"]["pictures"]
    document["appearance"]["materials"] = [{"name": "red"}]
    path.write_text(json.dumps(document))
    capsys.readouterr()
    convert(path, tmp_path / "out/a.gml", "--json")
    left_out = "\n".join(json.loads(capsys.readouterr().out)["left_out"])
    for words in ("leads out of the folder", "theme of pictures besides 'pictures'", "list of materials"):
        assert words in left_out


@pytest.mark.parametrize(
    "values",
    [
        None,
        [],
        [[[0, 1]]],
        [[[0, 99999]] for _ in range(4)],
        [[["a"]]] * 4,
        "x",
        [[[99, 0]]] * 4,
        [[{"a": 1}]] * 4,
    ],
)
def test_textures_that_do_not_fit_are_told(values, tmp_path, capsys):
    path = convert(write_town(tmp_path), tmp_path / "json/a.city.json")
    document = json.loads(path.read_text())
    for shape in document["CityObjects"]["b0"]["geometry"]:
        shape["texture"] = {"pictures": {"values": values}}
    path.write_text(json.dumps(document))
    capsys.readouterr()
    convert(path, tmp_path / "out/a.gml", "--json")
    assert json.loads(capsys.readouterr().out)["left_out"] or values == [[["a"]]] * 4


@pytest.mark.parametrize("is_sequence", [False, True])
def test_templates_of_cityjson_have_pictures(is_sequence: bool, tmp_path: Path) -> None:
    town = convert(write_town(tmp_path / "a"), tmp_path / "a" / "town.city.json")
    whole = json.loads(town.read_text())
    templates = []
    for item in whole["CityObjects"].values():
        for number, shape in enumerate(item.get("geometry", ())):
            place = {"boundaries": [0], "transformationMatrix": np.eye(4).ravel().tolist()}
            item["geometry"][number] = {"type": "GeometryInstance", "template": len(templates), **place}
            templates.append(shape)
    local = (np.array(whole["vertices"]) * whole["transform"]["scale"]).tolist()
    whole["geometry-templates"] = {"templates": templates, "vertices-templates": local}
    whole["vertices"] = [[0, 0, 0]]
    documents = [whole]
    if is_sequence:
        feature = {key: whole[key] for key in ("CityObjects", "vertices")}
        ids = {"type": "CityJSONFeature", "id": next(iter(whole["CityObjects"]))}
        documents = [{**whole, "CityObjects": {}, "vertices": []}, {**ids, **feature}]
    path = town.with_name("templates.city.jsonl" if is_sequence else "templates.city.json")
    path.write_text("\n".join(map(json.dumps, documents)))
    assert spots_of(read_city_model(path, options=OPTIONS)) == expected()


def wraps(path: Path) -> dict[int, str]:
    """Returns how the picture of each kind of surface goes on beyond its edges."""
    model = read_city_model(path, options=OPTIONS)
    assert model.pictures is not None
    assert model.polygons.picture is not None
    pairs = zip(model.polygons.kind.tolist(), model.polygons.picture.tolist(), strict=True)
    return {kind: model.pictures.wraps[number] for kind, number in pairs if number >= 0}


@pytest.mark.parametrize(
    ("ending", "more"),
    [(".city.json", ()), (".city.jsonl", ()), (".gml", ()), (".gml", ("--citygml", "3.0"))],
)
def test_how_pictures_go_on_beyond_their_edges_is_kept(ending, more, tmp_path, capsys):
    """One picture may repeat on one surface and end on another: then it has one file and two entries."""
    source = write_town(tmp_path)
    text, one = source.read_text(), f"<app:imageURI>{JPEG}</app:imageURI>"
    first, second = (one + f"<app:wrapMode>{mode}</app:wrapMode>" for mode in ("wrap", "clamp"))
    text = text.replace(one, first, 1)
    text = text.replace(f'{one}<app:target uri="#back"', f'{second}<app:target uri="#back"')
    odd = "roof.tif</app:imageURI><app:wrapMode>odd</app:wrapMode>"
    source.write_text(text.replace("roof.tif</app:imageURI>", odd))
    target = convert(source, tmp_path / f"out/a{ending}", *more)
    assert "left out: wrapMode 'odd' of a picture" in capsys.readouterr().out
    assert spots_of(read_city_model(target, options=OPTIONS)) == expected()
    written = target.read_text()
    assert (written.count("clamp"), written.count("odd")) == (1, 0)
    assert wraps(target)[2] == ""
    assert set(read_city_model(target, options=OPTIONS).pictures.wraps) == {"wrap", "clamp", ""}  # type: ignore[union-attr]
    assert len(list((target.parent / "a_pictures").iterdir())) == 2


def test_meshes_tell_that_their_pictures_repeat(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_town(tmp_path)
    source.write_text(
        source.read_text().replace("</app:imageURI>", "</app:imageURI><app:wrapMode>clamp</app:wrapMode>")
    )
    convert(source, tmp_path / "out/a.glb")
    assert "wrapMode of pictures, which repeat here" in capsys.readouterr().out
