import numpy as np
import pytest

from lodbench.citymodel.scene import build_scene
from lodbench.errors import ConfigError, RenderingError
from lodbench.harness.render import KINDS, choose_renderer, column_runs, depth_in_centimetres


def test_depth_is_rounded_and_bounded():
    depth = np.array([[0.0, 0.1, 12.344, 12.346, 655.34, 655.36, 9000.0]], dtype=np.float32)
    assert depth_in_centimetres(depth).tolist() == [[0, 10, 1234, 1235, 65534, 65535, 65535]]


def test_each_kind_has_a_renderer_of_the_base_install():
    for kind in KINDS:
        assert choose_renderer(kind, None) in ("silhouette", "raster")
    for kind, able in (("depth", "open3d, pyrender, raster"), ("label", "raster")):
        with pytest.raises(ConfigError, match=f"cannot draw kind={kind}") as caught:
            choose_renderer(kind, "reference")
        assert caught.value.hint.endswith(f"one of: {able}.")


def test_more_buildings_than_a_label_holds_are_refused():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    names = tuple(map(str, range(65_536)))
    scene = build_scene(corners, np.array([[0, 1, 2]]), np.zeros(1, dtype=np.int32), names)
    with pytest.raises(RenderingError, match="65536"):
        KINDS["label"].check(scene)


def test_runs_go_down_the_columns_and_begin_with_what_is_unset():
    mask = np.array([[False, True, True], [False, False, True]])
    assert column_runs(mask) == [2, 1, 1, 2]
    assert column_runs(~mask) == [0, 2, 1, 1, 2]
    assert column_runs(np.zeros((4, 5), dtype=bool)) == [20]
    assert column_runs(np.ones((4, 5), dtype=bool)) == [0, 20]
