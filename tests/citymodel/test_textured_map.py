"""Textured maps of every kind: read alike, and nothing opened that a stranger should not name."""

import struct

import numpy as np
import pytest
import trimesh
from PIL import Image

from lodbench.citymodel import ReadOptions, open_scene, read_city_model
from lodbench.citymodel.textured_map import open_textured_map, read_textured, textured_model
from lodbench.citymodel.textures import TextureFolder
from lodbench.errors import CityModelError, DatasetError

from .textured_case import (
    BY_RING,
    EAST,
    KINDS,
    NORTH,
    assert_is_the_roof,
    write_glb,
    write_gltf,
    write_gml,
    write_obj,
    write_picture,
)


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


@pytest.mark.parametrize("kind", ["ground", "world file"])
def test_a_picture_of_the_ground_that_is_not_there_is_noted(tmp_path, kind):
    path = write_gml(tmp_path, KINDS[kind])
    (tmp_path / "pictures" / "roof.png").unlink()
    with pytest.raises(DatasetError, match="has no surface with a picture") as fault:
        read_textured(path)
    assert "picture that is not there: pictures/roof.png" in fault.value.hint
    assert "surface whose picture is not there" in fault.value.hint


def test_a_matrix_that_leads_nowhere_is_noted(tmp_path):
    nowhere = KINDS["matrix"].replace("0 0 0 1</app", "0 0 0 0</app")
    with pytest.raises(DatasetError, match="has no surface with a picture") as fault:
        read_textured(write_gml(tmp_path, nowhere))
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


def test_a_colour_that_is_no_number_is_none(tmp_path):
    path = write_gml(tmp_path, BY_RING + MATERIAL.replace("1 0.5 0", "nan 0.5 0"))
    end = "</gml:MultiSurface></bldg:lod2MultiSurface>"
    path.write_text(path.read_text().replace(end, face("wall", [(0, 0, 0), (20, 0, 0), (20, 0, 7)]) + end))
    mesh = read_textured(path)
    assert mesh.colours[mesh.picture < 0].tolist() == [[[170] * 3] * 3]


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
        (tile / "._map.obj").write_bytes(b"\0\5\x16\7 of macOS")
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


@pytest.mark.parametrize("is_chunk", [False, True])
def test_a_damaged_picture_within_a_gltf_is_one_line(tmp_path, is_chunk):
    """trimesh leaves it out, and the surface was grey."""
    write_picture(tmp_path / "roof.png")
    path = tmp_path / "map.glb"
    if is_chunk:
        image = Image.open(tmp_path / "roof.png")
        material = trimesh.visual.material.PBRMaterial(name="roof", baseColorTexture=image)
        visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1]], material=material)
        mesh = trimesh.Trimesh([[0, 0, 0], [9, 0, 0], [9, 9, 0]], [[0, 1, 2]], visual=visual, process=False)
        path.write_bytes(mesh.export(file_type="glb"))
        assert len(read_textured(path).pictures) == 1
        path.write_bytes(path.read_bytes().replace(b"\x89PNG", b"\x89P?G"))
    else:
        (tmp_path / "roof.png").write_bytes(b"\x89P?G")
        path = write_glb(tmp_path)
    with pytest.raises(DatasetError, match=r"map\.glb: picture 0' cannot be read as a picture\."):
        read_textured(path)


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
