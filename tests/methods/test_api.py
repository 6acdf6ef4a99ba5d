from __future__ import annotations

import numpy as np
import pytest

import lodbench
from lodbench.errors import ConfigError, LodbenchError, QueryFault
from lodbench.evaluation import pose_error
from lodbench.methods.lodlocv2 import LodLocV2, LodLocV2Params
from lodbench.photos.pictures import encoded
from tests.town import CAMERA, prior_of

QUICK = LodLocV2(LodLocV2Params(steps=12, coarse_size=(160, 120), fine_size=(320, 240)))


class TestLocalize:
    @pytest.mark.parametrize("kind", [bool, np.uint8, np.float64])
    def test_any_kind_of_mask_in_0_to_1(self, scene, queries, truths, kind):
        mask = queries[0].building_probability.astype(kind)
        prior = prior_of(truths[0]).shifted(scene.origin)
        found = lodbench.localize(scene, CAMERA, prior, mask, method=QUICK, threads=1)
        assert pose_error(found.pose, truths[0].shifted(scene.origin)).translation_m < 1

    @pytest.mark.parametrize(
        ("change", "reason"),
        [
            (lambda mask: mask[:, : len(mask)], "another aspect"),
            (lambda mask: (mask * 255).astype(np.uint8), "from 0 to 255 instead of probabilities"),
            (lambda mask: np.dstack([mask] * 3), "instead of \\(height, width\\)"),
            (lambda mask: mask[:0], "empty"),
            (lambda mask: mask * np.nan, "not finite"),
        ],
        ids=["square", "bytes", "channels", "empty", "nan"],
    )
    def test_other_masks_are_refused(self, scene, queries, truths, change, reason):
        with pytest.raises(QueryFault, match=reason):
            lodbench.localize(
                scene, CAMERA, prior_of(truths[0]), change(queries[0].building_probability), method=QUICK
            )

    def test_a_photo_by_its_path_as_text_and_a_method_by_its_name(self, scene, truths, tmp_path):
        photo = tmp_path / "a.png"
        photo.write_bytes(encoded(np.full((120, 160, 3), 200, np.uint8), ".png"))
        camera, prior = CAMERA.scaled(160, 120), prior_of(truths[0]).shifted(scene.origin)
        found = lodbench.localize(scene, camera, prior, image=str(photo), method="prior_only")
        assert pose_error(found.pose, prior).translation_m < 1e-6
        # It is opened: one shade all over is no city.
        with pytest.raises(QueryFault, match="one colour everywhere"):
            lodbench.localize(scene, camera, prior, image=str(photo), method="region")
        with pytest.raises(ConfigError, match="method"):
            lodbench.localize(scene, camera, prior, image=photo, method="regions")
        with pytest.raises(lodbench.LodbenchError, match=r"'city\.gml' is not a scene"):
            lodbench.localize("city.gml", camera, prior)  # type: ignore[arg-type]

    def test_a_prior_that_is_no_pose_is_refused(self, scene, queries):
        prior = lodbench.Pose(2.0 * np.eye(3), np.zeros(3))
        with pytest.raises(LodbenchError, match="no rotation"):
            lodbench.localize(scene, CAMERA, prior, queries[0].building_probability, method=QUICK)
