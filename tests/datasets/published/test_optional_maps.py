"""Where a published dataset's textured map and posed pictures are looked for."""

from pathlib import Path

import numpy as np
import pytest

from lodbench.datasets.pose_text import format_camera, format_pose, lines_to_text
from lodbench.datasets.published.layout import advice, survey
from lodbench.datasets.published.lodloc import UAVD4L_LODV2, PublishedParams, open_lodloc
from lodbench.errors import DatasetError
from lodbench.geometry import Pose
from tests.town import CAMERA, box_obj


def write(folder: Path, *, extra: bool) -> Path:
    split = folder / "UAVD4L-LoD" / "inTraj"
    (split / "Query_image").mkdir(parents=True)
    (folder / "MODEL").mkdir()
    (folder / "MODEL" / "UAVD4L-LoD1.obj").write_text(box_obj())
    pose = Pose.from_center(np.eye(3), np.array([1.0, 2.0, 100.0]))
    for name in ("GT_pose.txt", "GPS_pose.txt"):
        (split / name).write_text(lines_to_text([format_pose("a.jpg", pose)]))
    (split / "intrinsic.txt").write_text(lines_to_text([format_camera("a.jpg", CAMERA)]))
    if extra:
        references = folder / "UAVD4L-LoD" / "references"
        (references / "images").mkdir(parents=True)
        (references / "images" / "r.jpg").write_bytes(b"")
        (references / "poses.txt").write_text(lines_to_text([format_pose("r.jpg", pose)]))
        (references / "intrinsic.txt").write_text(lines_to_text([format_camera("r.jpg", CAMERA)]))
        (folder / "MODEL" / "textured").mkdir()
    return folder


def test_both_are_found_at_their_places(tmp_path):
    dataset = open_lodloc(PublishedParams("uavd4l_lodv2", str(write(tmp_path, extra=True))))
    assert dataset.textured_map == tmp_path / "MODEL" / "textured"
    assert [reference.name for reference in dataset.references] == ["r.jpg"]


def test_without_them_there_are_none_and_the_advice_says_where_they_belong(tmp_path):
    root = str(write(tmp_path, extra=False))
    dataset = open_lodloc(PublishedParams("uavd4l_lodv2", root))
    assert (dataset.textured_map, dataset.references) == (None, ())
    words = advice(survey(UAVD4L_LODV2, root, None))
    assert "MODEL/textured/" in words
    assert "UAVD4L-LoD/references/" in words


def test_a_map_that_is_named_and_not_there_is_told(tmp_path):
    params = PublishedParams(
        "uavd4l_lodv2", str(write(tmp_path, extra=False)), textured_map=str(tmp_path / "none.glb")
    )
    with pytest.raises(DatasetError, match="does not exist"):
        open_lodloc(params)
