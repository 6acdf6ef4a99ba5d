"""What meshes name and how their pictures lie: drawn as it is meant, or refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from lodbench.citymodel.mesh.texture_files import read_textured
from lodbench.errors import DatasetError

from .textured_case import assert_is_the_roof, write_glb, write_gltf, write_obj, write_picture


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
