"""What comes from outside does not lead out of a folder, hang, or write where it only reads."""

import json
import logging
import os
from dataclasses import dataclass, replace

import numpy as np
import pytest

from lodbench.cli import main
from lodbench.cli.verify import read_config
from lodbench.datasets.pose_files import read_pose_file
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry import Camera, Pose
from lodbench.harness.conformance.methods import right_name
from lodbench.harness.conformance.trial import Violation
from lodbench.harness.remote.method import About
from lodbench.harness.remote.process import MalformedMessage
from lodbench.methods.registry import ConfiguredMethod
from lodbench.photos.camera import camera_from_photo
from lodbench.photos.metadata import PhotoMetadata
from lodbench.photos.xmp import Dewarp
from lodbench.plugins import blaming
from lodbench.segmentation.masks import read_mask
from lodbench.segmentation.polygon_files import read_polygons
from lodbench.storage.paths import path_name

pytestmark = pytest.mark.attack

OUTSIDE = [
    "../../../X",
    "..",
    ".",
    "",
    "/X",
    "a/b",
    "a\\b",
    ".hidden",
    "-o",
    "a\nb",
    "a\0",
    "x" * 201,
    None,
    7,
]


@dataclass(frozen=True)
class Params:
    name: str = "fine"


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_name_cannot_lead_out_of_a_folder(name):
    class Method:
        params_type = Params

        def __init__(self, params: Params) -> None:
            self.params = params

    Method.name = name
    with pytest.raises(ConfigError, match="cannot name a folder"):
        path_name("method", name)
    with pytest.raises(ConfigError, match="cannot name a folder"):
        ConfiguredMethod(Method, Params()).make()
    with pytest.raises(Violation):
        right_name(Method, name)


@pytest.mark.parametrize("name", ["lodlocv2", "my-method_2", "v1.0+x", "Straße"])
def test_plain_names_stay(name):
    assert path_name("method", name) == name


ABOUT = {
    "name": "x", "requires": ["mask"], "params": {}, "trial_params": None, "answers_flights": False,
    "prepares": False, "weights": [], "code": ["a"],
}  # fmt: skip


def test_only_a_whole_description_of_a_method_is_one():
    assert About.of(ABOUT).name == "x"
    wrong = [None, [1, 2], "x", {}, {"name": "x"}, {**ABOUT, "more": 1}]
    wrong += [{**ABOUT, name: value} for name in ABOUT for value in (7, "text", [None]) if name != "name"]
    wrong += [{**ABOUT, "name": None}, {**ABOUT, "requires": "mask"}]
    for said in wrong:
        with pytest.raises(MalformedMessage, match="wrote no description of the method"):
            About.of(said)


def test_masks_are_shown_to_methods_read_only():
    mask, instances = np.zeros((3, 4), np.float32), np.zeros((2, 3, 4), bool)
    pose = Pose.from_center(np.eye(3), (0.0, 0.0, 0.0))
    query = Query("a", "b", Camera(4, 3, 2.0, 2.0, 2.0, 1.5), pose, mask, instances=instances)
    for shown in (query, replace(query, name="c")):
        with pytest.raises(ValueError, match="read-only"):
            shown.mask[0, 0] = 1
        with pytest.raises(ValueError, match="read-only"):
            shown.instances[0] = True
    mask[0, 0] = 1  # its owner's still
    assert query.mask[0, 0] == 1


class OwnEnd(BaseException):
    """Of a plug-in that does not derive its faults from Exception."""


def test_a_plug_ins_own_base_exception_is_its_fault_and_ctrl_c_is_not():
    with pytest.raises(ConfigError, match="cannot be made: OwnEnd: no more"):
        with blaming("methods", "somebodys", "be made"):
            raise OwnEnd("no more")
    with pytest.raises(KeyboardInterrupt):
        with blaming("methods", "somebodys", "be made"):
            raise KeyboardInterrupt


@pytest.mark.parametrize("text", ["[" * 5000 + "]" * 5000, "{a: " * 3000 + "1" + "}" * 3000])
def test_a_configuration_of_many_brackets_is_refused(tmp_path, text):
    (tmp_path / "config.yaml").write_text(f"dataset: {text}\nmethod: x\ntilt: prior\n")
    with pytest.raises(DatasetError, match="is not a readable configuration"):
        read_config(tmp_path)


def test_a_setting_of_many_brackets_is_one_line(capsys):
    deep = "[" * 5000 + "]" * 5000
    assert main(["run", "dataset=folder", f"method.x={deep}"]) == 2
    assert "nested too deeply" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["v.mp4", "v.mov"])
def test_a_video_that_is_a_pipe_is_not_waited_for(tmp_path, capsys, name):
    from tests.town import box_obj

    (tmp_path / "city.obj").write_text(box_obj())
    os.mkfifo(tmp_path / name)
    words = ["--camera", "PINHOLE 160 120 125 125 80 60", "--center", "0", "0", "100", "--heading", "0"]
    city = str(tmp_path / "city.obj")
    assert main(["track", str(tmp_path / name), "--city", city, *words, "--pitch", "-60"]) == 2
    assert "is no regular file" in capsys.readouterr().err


def test_poses_polygons_and_masks_that_are_pipes_are_not_waited_for(tmp_path, capsys):
    os.mkfifo(tmp_path / "x.json")
    words = [str(tmp_path), "--images", str(tmp_path)]
    for flag in ("--polygons", "--compare", "--start", "--save"):
        assert main(["trace", *words, flag, str(tmp_path / "x.json")]) == 2
        assert "is no regular file" in capsys.readouterr().err
    with pytest.raises(DatasetError, match="is no regular file"):
        read_mask(tmp_path / "x.json")
    with pytest.raises(DatasetError, match="is no regular file"):
        read_polygons(tmp_path / "x.json", "P.jpg", 4, 4)
    with pytest.raises(DatasetError, match="is no regular file"):
        read_pose_file(tmp_path / "x.json", "auto")


def test_dewarp_data_with_a_centre_outside_is_refused_for_that():
    dewarp = Dewarp("2021-01-01", 3666.0, 3666.0, 5000.0, 0.0, (0.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(DatasetError, match=r"DewarpData\) has the optical centre 7640, 1978, outside of"):
        camera_from_photo(PhotoMetadata("p.jpg", 5280, 3956, dewarp=dewarp))
    near = replace(dewarp, cx=12.0)
    assert camera_from_photo(PhotoMetadata("p.jpg", 5280, 3956, dewarp=near)).camera.cx == 2652.0


SQUARE = [[600.0, 50.0], [780.0, 50.0], [780.0, 350.0], [600.0, 350.0]]
SWAPPED = [[y, x] for x, y in SQUARE]
CROSSED = [SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]]


def labelme(tmp_path, *polygons):
    shapes = [{"label": "building", "shape_type": "polygon", "points": points} for points in polygons]
    file = tmp_path / "p.json"
    size = {"imagePath": "P.jpg", "imageWidth": 800, "imageHeight": 400}
    file.write_text(json.dumps({"shapes": shapes, **size}))
    return file


def coco(tmp_path, *polygons):
    rings = [[number for point in points for number in point] for points in polygons]
    file = tmp_path / "c.json"
    image = {"id": 1, "file_name": "P.jpg", "width": 800, "height": 400}
    found = [{"image_id": 1, "category_id": 1, "segmentation": [ring]} for ring in rings]
    annotations = {"images": [image], "categories": [{"id": 1, "name": "building"}], "annotations": found}
    file.write_text(json.dumps(annotations))
    return file


@pytest.mark.parametrize("write", [labelme, coco])
@pytest.mark.parametrize(
    ("polygons", "words"),
    [
        (
            [[[x / 800, y / 400] for x, y in SQUARE]],
            "1 of 1 polygons without an area .*fractions of the photo",
        ),
        ([SWAPPED], "4 of 4 points lie outside the photo; 1 of 1 polygons .*x and y exchanged"),
        ([SQUARE[:2]], "1 of 1 polygons without an area"),
        ([[[0, 0], [50, 50], [100, 100]]], "1 of 1 polygons without an area"),
        ([SQUARE, SQUARE[:2]], "1 of 2 polygons without an area"),
        ([SQUARE, SWAPPED], "4 of 8 points lie outside the photo; 1 of 2 polygons"),
        ([SQUARE, [[700, 300], [900, 300], [900, 500]]], "2 of 7 points lie outside the photo"),
        ([SQUARE], ""),
        ([CROSSED], ""),
        ([[[-0.5, 0], [800.6, 0], [800, 400.9]]], ""),
    ],
)
def test_polygons_that_are_lost_are_counted(tmp_path, caplog, write, polygons, words):
    import re

    with caplog.at_level(logging.WARNING):
        try:
            mask = read_polygons(write(tmp_path, *polygons), "P.jpg", 400, 800)
            text = caplog.text
        except DatasetError as error:
            mask, text = None, f"{error.message} {error.hint}"
    assert re.search(words, text) if words else not text
    if SQUARE in polygons:
        assert mask[60:340, 610:770].all()
