"""Textured maps of every kind: read alike, and nothing opened that a stranger should not name."""

from __future__ import annotations

import base64
import json
import struct

import cv2
import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, open_scene, read_city_model
from lodbench.citymodel.texture_files import open_textured_map, read_textured
from lodbench.citymodel.texture_pictures import TextureFolder
from lodbench.citymodel.textured_model import textured_model
from lodbench.errors import CityModelError, DatasetError

# A square roof of 20 x 10 m at 7 m, picture of 4 x 2 pixels: red, green, blue, white over black.
CORNERS = np.array([(0.0, 0.0, 7.0), (20.0, 0.0, 7.0), (20.0, 10.0, 7.0), (0.0, 10.0, 7.0)])
UV = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
PICTURE = np.zeros((2, 4, 3), dtype=np.uint8)
PICTURE[0] = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)]
EAST, NORTH = 691000.0, 5335000.0


def write_picture(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), PICTURE[:, :, ::-1])
    return path


def write_obj(folder, picture="roof.png", name="map.obj", shift=(0.0, 0.0, 0.0)):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "map.mtl").write_text(f"newmtl roof\nmap_Kd {picture}\n")
    lines = ["mtllib map.mtl", "usemtl roof"]
    lines += [f"v {x} {y} {z}" for x, y, z in CORNERS + shift]
    lines += [f"vt {u} {v}" for u, v in UV] + ["f 1/1 2/2 3/3", "f 1/1 3/3 4/4"]
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder / name


def write_gltf(folder, uri="roof.png", change=lambda content: None):
    """glTF has y up and (0, 0) at a picture's upper left corner."""
    points = np.stack([CORNERS[:, 0], CORNERS[:, 2], -CORNERS[:, 1]], axis=1).astype("<f4")
    uv = np.stack([UV[:, 0], 1 - UV[:, 1]], axis=1).astype("<f4")
    indices = np.array([0, 1, 2, 0, 2, 3], dtype="<u2")
    blob = points.tobytes() + uv.tobytes() + indices.tobytes()
    views = [(0, 48), (48, 32), (80, 12)]
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}
        ],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": uri}],
        "buffers": [
            {
                "byteLength": len(blob),
                "uri": "data:application/octet-stream;base64," + base64.b64encode(blob).decode(),
            }
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": a, "byteLength": n} for a, n in views],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": 4,
                "type": "VEC3",
                "min": points.min(axis=0).tolist(),
                "max": points.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
    }
    change(content)
    path = folder / "map.gltf"
    path.write_text(json.dumps(content))
    return path


def write_glb(folder, change=lambda content: None):
    path = write_gltf(folder)
    content = json.loads(path.read_text())
    content["images"] = [
        {"uri": "data:image/png;base64," + base64.b64encode((folder / "roof.png").read_bytes()).decode()}
    ]
    change(content)
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    path.unlink()
    path = folder / "map.glb"
    chunk = struct.pack("<II", len(text), 0x4E4F534A) + text
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunk)) + chunk)
    return path


GML = """<?xml version="1.0" encoding="UTF-8"?>
<CityModel xmlns="http://www.opengis.net/citygml/2.0" xmlns:app="http://www.opengis.net/citygml/appearance/2.0"
 xmlns:bldg="http://www.opengis.net/citygml/building/2.0" xmlns:gml="http://www.opengis.net/gml">
<gml:boundedBy><gml:Envelope srsName="EPSG:25832" srsDimension="3"><gml:lowerCorner>0 0 0</gml:lowerCorner>
<gml:upperCorner>1 1 1</gml:upperCorner></gml:Envelope></gml:boundedBy>
<cityObjectMember><bldg:Building gml:id="b"><bldg:lod1MultiSurface><gml:MultiSurface><gml:surfaceMember>
<gml:Polygon><gml:exterior><gml:LinearRing><gml:posList>0 0 0 1 0 0 1 1 0 0 0 0</gml:posList></gml:LinearRing>
</gml:exterior></gml:Polygon></gml:surfaceMember></gml:MultiSurface></bldg:lod1MultiSurface>
<bldg:boundedBy><bldg:RoofSurface gml:id="roof"><bldg:lod2MultiSurface><gml:MultiSurface><gml:surfaceMember>
<gml:Polygon gml:id="poly"><gml:exterior><gml:LinearRing gml:id="ring"><gml:posList>{ring}</gml:posList>
</gml:LinearRing></gml:exterior></gml:Polygon></gml:surfaceMember></gml:MultiSurface></bldg:lod2MultiSurface>
</bldg:RoofSurface></bldg:boundedBy></bldg:Building></cityObjectMember>
<app:appearanceMember><app:Appearance><app:theme>photo</app:theme><app:surfaceDataMember>{texture}
</app:surfaceDataMember></app:Appearance></app:appearanceMember>
</CityModel>
"""
BY_RING = """<app:ParameterizedTexture><app:imageURI>pictures/roof.png</app:imageURI><app:target uri="#poly">
<app:TexCoordList><app:textureCoordinates ring="#ring">0 0 1 0 1 1 0 1 0 0</app:textureCoordinates>
</app:TexCoordList></app:target></app:ParameterizedTexture>"""
BY_RING_OF_VERSION_3 = """<app:ParameterizedTexture><app:imageURI>pictures/roof.png</app:imageURI>
<app:textureParameterization><app:TextureAssociation><app:target>#poly</app:target>
<app:textureParameterization><app:TexCoordList>
<app:textureCoordinates>0 0 1 0 1 1 0 1 0 0</app:textureCoordinates>
<app:ring>#ring</app:ring></app:TexCoordList></app:textureParameterization></app:TextureAssociation>
</app:textureParameterization></app:ParameterizedTexture>"""
BY_MATRIX = f"""<app:ParameterizedTexture><app:imageURI>pictures/roof.png</app:imageURI>
<app:target uri="#poly"><app:TexCoordGen>
<app:worldToTexture>0.05 0 0 {-0.05 * EAST} 0 0.1 0 {-0.1 * NORTH} 0 0 0 1</app:worldToTexture>
</app:TexCoordGen></app:target></app:ParameterizedTexture>"""
# Pixels of 5 x 5 m; the middle of the upper left one.
BY_GROUND = f"""<app:GeoreferencedTexture><app:imageURI>pictures/roof.png</app:imageURI><app:referencePoint>
<gml:Point><gml:pos>{EAST + 2.5} {NORTH + 7.5}</gml:pos></gml:Point></app:referencePoint>
<app:orientation>5 0 0 -5</app:orientation><app:target>#roof</app:target></app:GeoreferencedTexture>"""
BY_WORLD_FILE = """<app:GeoreferencedTexture><app:preferWorldFile>true</app:preferWorldFile>
<app:imageURI>pictures/roof.png</app:imageURI><app:target>#poly</app:target></app:GeoreferencedTexture>"""
KINDS = {
    "ring": BY_RING,
    "version 3": BY_RING_OF_VERSION_3,
    "matrix": BY_MATRIX,
    "ground": BY_GROUND,
    "world file": BY_WORLD_FILE,
}


def write_gml(folder, texture=BY_RING):
    places = CORNERS[[0, 1, 2, 3, 0]] + (EAST, NORTH, 0)
    ring = " ".join(str(number) for number in places.ravel())
    path = folder / "map.gml"
    path.write_text(GML.format(ring=ring, texture=texture))
    write_picture(folder / "pictures" / "roof.png")
    (folder / "pictures" / "roof.pgw").write_text(f"5\n0\n0\n-5\n{EAST + 2.5}\n{NORTH + 7.5}\n")
    return path


def assert_is_the_roof(mesh, shift=(0.0, 0.0, 0.0)):
    """Every corner has the texture coordinates it was written with, and the picture its colours."""
    assert len(mesh.corners) == 2
    for corners, uv in zip(mesh.corners - np.asarray(shift), mesh.uv, strict=True):
        for corner, place in zip(corners, uv, strict=True):
            k = int(np.argmin(np.abs(CORNERS - corner).sum(axis=1)))
            np.testing.assert_allclose(corner, CORNERS[k], atol=1e-6)
            np.testing.assert_allclose(place, UV[k], atol=1e-5)
    assert mesh.picture.tolist() == [0, 0]
    np.testing.assert_array_equal(mesh.pictures[0], PICTURE)


@pytest.mark.parametrize("write", [write_obj, write_gltf, write_glb], ids=["obj", "gltf", "glb"])
def test_meshes_are_read_alike(tmp_path, write):
    write_picture(tmp_path / "roof.png")
    assert_is_the_roof(read_textured(write(tmp_path)))


@pytest.mark.parametrize("kind", KINDS)
def test_citygml_appearances(tmp_path, kind):
    mesh = read_textured(write_gml(tmp_path, KINDS[kind]))
    assert_is_the_roof(mesh, (EAST, NORTH, 0))
    assert mesh.notes == ()


def test_citygml_without_its_pictures_is_one_line(tmp_path):
    path = write_gml(tmp_path)
    (tmp_path / "pictures" / "roof.png").unlink()
    with pytest.raises(DatasetError, match="has no surface with a picture") as fault:
        read_textured(path)
    assert "picture that is not there: pictures/roof.png" in fault.value.hint


def test_citygml_of_which_a_picture_is_missing_is_noted(tmp_path):
    other = BY_RING.replace("roof.png", "gone.png").replace("#ring", "#other").replace("#poly", "#other-poly")
    text = write_gml(tmp_path, BY_RING + other).read_text()
    wall = "".join(f"{x} {y} {z} " for x, y, z in [(EAST, NORTH, 0), (EAST + 20, NORTH, 0), (EAST, NORTH, 7)])
    extra = (
        '<gml:surfaceMember><gml:Polygon gml:id="other-poly"><gml:exterior><gml:LinearRing gml:id="other">'
        f"<gml:posList>{wall}{EAST} {NORTH} 0 {EAST} {NORTH} 0</gml:posList></gml:LinearRing></gml:exterior>"
        "</gml:Polygon></gml:surfaceMember>"
    )
    at = text.index("</gml:MultiSurface></bldg:lod2MultiSurface>")
    (tmp_path / "map.gml").write_text(text[:at] + extra + text[at:])
    mesh = read_textured(tmp_path / "map.gml")
    assert any("picture that is not there: pictures/gone.png" in note for note in mesh.notes)
    assert (mesh.picture == -1).any()
    assert (mesh.colours[mesh.picture == -1] == 170).all()


def test_citygml_whose_coordinates_do_not_fit_is_noted(tmp_path):
    broken = BY_RING.replace("0 0 1 0 1 1 0 1 0 0", "0 0 1 0 1 1")
    with pytest.raises(DatasetError, match="has no surface with a picture") as fault:
        read_textured(write_gml(tmp_path, broken))
    assert "surface whose places on its picture do not fit its corners" in fault.value.hint


MATERIAL = """</app:surfaceDataMember><app:surfaceDataMember><app:X3DMaterial>
<app:diffuseColor>1 0.5 0</app:diffuseColor><app:target>#wall</app:target></app:X3DMaterial>"""


def face(name, ring):
    places = " ".join(str(value) for x, y, z in [*ring, ring[0]] for value in (EAST + x, NORTH + y, z))
    return (
        f'<gml:surfaceMember><gml:Polygon gml:id="{name}"><gml:exterior><gml:LinearRing><gml:posList>{places}'
        "</gml:posList></gml:LinearRing></gml:exterior></gml:Polygon></gml:surfaceMember>"
    )


def test_a_surface_without_a_picture_has_the_colour_of_its_material(tmp_path):
    path = write_gml(tmp_path, BY_RING + MATERIAL)
    extra = face("wall", [(0, 0, 0), (20, 0, 0), (20, 0, 7)]) + face(
        "bare", [(0, 10, 0), (20, 10, 0), (0, 10, 7)]
    )
    end = "</gml:MultiSurface></bldg:lod2MultiSurface>"
    path.write_text(path.read_text().replace(end, extra + end))
    mesh = read_textured(path)
    found = {
        (*colours[0], n) for colours, n in zip(mesh.colours.tolist(), mesh.picture.tolist(), strict=True)
    }
    assert found == {(255, 128, 0, -1), (170, 170, 170, -1), (170, 170, 170, 0)}
    two = tmp_path / "two"
    for number, shade in enumerate(("1 0.5 0", "0 0 1")):
        (two / str(number)).mkdir(parents=True)
        other = write_gml(two / str(number), BY_RING + MATERIAL.replace("1 0.5 0", shade))
        other.write_text(other.read_text().replace(end, extra + end))
    options = ReadOptions(has_details=True, has_textures=True)
    joined = textured_model(read_city_model([two / "0/map.gml", two / "1/map.gml"], options=options))
    bare = {tuple(colour) for colour in joined.colours[joined.picture < 0][:, 0].tolist()}
    assert bare == {(255, 128, 0), (0, 0, 255), (170, 170, 170)}


@pytest.mark.parametrize("before", ["<cityObjectMember>", "<app:appearanceMember>"])
def test_what_another_building_borrows_lies_on_no_picture(tmp_path, before):
    path = write_gml(tmp_path)
    borrower = (
        '<cityObjectMember xmlns:xlink="http://www.w3.org/1999/xlink"><bldg:Building gml:id="c">'
        '<bldg:lod2MultiSurface><gml:MultiSurface><gml:surfaceMember xlink:href="#poly"/></gml:MultiSurface>'
        "</bldg:lod2MultiSurface></bldg:Building></cityObjectMember>"
    )
    path.write_text(path.read_text().replace(before, borrower + before, 1))
    mesh = read_textured(path)
    assert set(mesh.picture.tolist()) == {0}
    assert len(np.unique(mesh.corners.reshape(-1, 9), axis=0)) == 2


def test_citygml_without_appearances_or_with_a_doctype_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="has no surface with a picture") as fault:
        read_textured(write_gml(tmp_path, ""))
    assert fault.value.hint == "A textured map needs appearances with pictures."
    path = write_gml(tmp_path)
    path.write_text(path.read_text().replace("?>\n", "?>\n<!DOCTYPE x [<!ENTITY a 'b'>]>\n", 1))
    with pytest.raises(CityModelError, match="DOCTYPE"):
        read_textured(path)


def test_a_folder_of_tiles_is_one_map(tmp_path):
    for number in range(3):
        tile = tmp_path / f"tile_{number}"
        write_obj(tile, "../pictures/roof.png", shift=(30.0 * number, 0, 0))
    write_picture(tmp_path / "pictures" / "roof.png")
    mesh = read_textured(tmp_path)
    assert len(mesh.corners) == 6
    assert len(mesh.pictures) == 3
    assert mesh.corners[..., 0].max() == 80.0
    with pytest.raises(DatasetError, match="holds no textured mesh"):
        read_textured(tmp_path / "pictures")


@pytest.mark.parametrize("name", ["../secret.png", "/etc/passwd", "a/../../secret.png", "..\\secret.png"])
def test_names_that_climb_out_are_refused(tmp_path, name):
    write_picture(tmp_path / "secret.png")
    folder = tmp_path / "map"
    path = write_obj(folder, name)
    with pytest.raises(DatasetError, match="leads out of the folder"):
        read_textured(path)
    write_gltf(folder, name)
    with pytest.raises(DatasetError, match="leads out of the folder"):
        read_textured(folder / "map.gltf")


def test_links_that_lead_out_and_addresses_are_refused(tmp_path):
    write_picture(tmp_path / "secret.png")
    folder = tmp_path / "map"
    path = write_obj(folder, "inside.png")
    (folder / "inside.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(DatasetError, match="leads out of the folder"):
        read_textured(path)
    with pytest.raises(DatasetError, match="leads out"):
        TextureFolder(folder, folder).read("https://example.org/a.png")


def test_a_picture_too_large_is_refused_by_its_header(tmp_path):
    # A PNG of 60,000 x 60,000 pixels by its header, of which nothing is ever decoded.
    content = write_picture(tmp_path / "roof.png").read_bytes()
    head = struct.pack(">II", 60000, 60000)
    (tmp_path / "roof.png").write_bytes(content[:16] + head + content[24:])
    with pytest.raises(DatasetError, match=r"roof\.png"):
        read_textured(write_obj(tmp_path))


def test_what_is_no_picture_is_one_line(tmp_path):
    (tmp_path / "roof.png").write_text("GIF89a no picture")
    with pytest.raises(DatasetError, match="cannot be read as a picture"):
        read_textured(write_obj(tmp_path))


@pytest.mark.parametrize("options", ["-s 1 1 1 ", "-o 0 0 -blendu on ", "-clamp on "])
def test_options_before_a_picture_s_name_are_passed_over(tmp_path, options):
    write_picture(tmp_path / "roof.png")
    assert_is_the_roof(read_textured(write_obj(tmp_path, f"{options}roof.png")))


@pytest.mark.parametrize("options", ["-s 2 2 1 ", "-blendu on -o 0 0.5 ", "-o -0.5 0 "])
def test_options_that_move_a_picture_are_refused(tmp_path, options):
    write_picture(tmp_path / "roof.png")
    with pytest.raises(DatasetError, match=r"map\.mtl: .* moves its picture"):
        read_textured(write_obj(tmp_path, f"{options}roof.png"))


def test_a_material_that_nothing_defines_is_refused(tmp_path):
    write_picture(tmp_path / "roof.png")
    path = write_obj(tmp_path)
    path.write_text(path.read_text().replace("usemtl roof", "usemtl wall"))
    with pytest.raises(DatasetError, match="uses materials that nothing defines: wall"):
        read_textured(path)


@pytest.mark.parametrize(("uri", "words"), [("gone.png", "not there: gone.png"), ("../a.png", "leads out")])
def test_glb_that_names_a_picture_which_cannot_be_had_is_refused(tmp_path, uri, words):
    write_picture(tmp_path / "a.png")
    write_picture(tmp_path / "map" / "roof.png")
    path = write_glb(tmp_path / "map", lambda content: content.update(images=[{"uri": uri}]))
    with pytest.raises(DatasetError, match=words):
        read_textured(path)


@pytest.mark.parametrize(
    ("texture", "words"),
    [
        ({"texCoord": 1}, "second texture coordinates"),
        ({"extensions": {"KHR_texture_transform": {"scale": [2, 2]}}}, "moves its picture"),
    ],
)
@pytest.mark.parametrize("write", [write_gltf, write_glb], ids=["gltf", "glb"])
def test_pictures_that_lie_by_other_coordinates_are_refused(tmp_path, write, texture, words):
    write_picture(tmp_path / "roof.png")

    def change(content):
        content["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"].update(texture)

    with pytest.raises(DatasetError, match=words):
        read_textured(write(tmp_path, change=change))


def test_pictures_of_another_kind_are_refused(tmp_path):
    write_picture(tmp_path / "roof.png")

    def change(content):
        content["textures"] = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]

    with pytest.raises(DatasetError, match="has no PNG, JPEG or WebP"):
        read_textured(write_gltf(tmp_path, change=change))


def test_a_transform_that_moves_nothing_is_none(tmp_path):
    write_picture(tmp_path / "roof.png")
    same = {"KHR_texture_transform": {"offset": [0.0, 0.0], "scale": [1.0, 1.0]}}

    def change(content):
        content["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] = same

    assert_is_the_roof(read_textured(write_gltf(tmp_path, change=change)))


def test_a_material_s_colour_multiplies_the_light_of_its_picture(tmp_path):
    write_picture(tmp_path / "roof.png")

    def change(content):
        content["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [1.0, 0.5, 0.0, 1.0]

    (picture,) = read_textured(write_gltf(tmp_path, change=change)).pictures[:1]
    # Half of the light of white is 188 in sRGB.
    assert picture[0].tolist() == [[255, 0, 0], [0, 188, 0], [0, 0, 0], [255, 188, 0]]


def test_grey_of_16_bits_keeps_its_shade(tmp_path):
    assert cv2.imwrite(str(tmp_path / "roof.png"), np.full((2, 4), 30000, dtype=np.uint16))
    (picture,) = read_textured(write_obj(tmp_path)).pictures[:1]
    assert np.unique(picture).tolist() == [117]
    assert cv2.imwrite(str(tmp_path / "roof.tif"), np.full((2, 4), 0.5, dtype=np.float32))
    with pytest.raises(DatasetError, match="pixels of 32 bits"):
        read_textured(write_obj(tmp_path, "roof.tif"))


def test_a_map_is_set_over_its_city(tmp_path):
    write_picture(tmp_path / "roof.png")
    city = tmp_path / "city.obj"
    boxes = [f"v {x} {y} {z}" for x in (0, 20) for y in (0, 10) for z in (0, 7)]
    faces = ["f 1 3 7 5", "f 2 6 8 4", "f 1 5 6 2", "f 3 4 8 7", "f 1 2 4 3", "f 5 7 8 6"]
    city.write_text("\n".join([*boxes, *faces]) + "\n")
    scene = open_scene(city)
    mesh = open_textured_map(write_obj(tmp_path), scene)
    np.testing.assert_allclose(mesh.corners.reshape(-1, 3).min(axis=0) + scene.origin, [0, 0, 7], atol=1e-6)
    assert "overlap" in mesh.notes[0]
    with pytest.raises(DatasetError, match="not where the city is") as told:
        open_textured_map(write_obj(tmp_path, shift=(500.0, 0, 0)), scene)
    assert "texture_up" not in told.value.hint  # a setting of training data alone
