"""A photo's views are each made once, on however many threads, and are those of who makes them."""

from __future__ import annotations

import gc
import time
import weakref
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from lodbench.errors import QueryFault
from lodbench.methods.fits import query_photo
from lodbench.methods.region import RegionParams
from lodbench.methods.region import evidence as photo_module
from lodbench.methods.region.evidence import Photo
from lodbench.rendering.photo_bins import directed_edge_levels
from lodbench.storage import random_stream
from tests.town import CAMERA

PARAMS = RegionParams(coarse_width=60, fine_width=100, lines_width=160)


@pytest.fixture
def pixels():
    noise = random_stream(0, "photo").integers(0, 256, (CAMERA.height, CAMERA.width, 3))
    return noise.astype(np.uint8)


@pytest.mark.parametrize("threads", [1, 2])
def test_each_view_is_made_once(pixels, threads, monkeypatch):
    made = []

    def counted(picture, size, blur_px):
        made.append((size[0], blur_px))
        return directed_edge_levels(picture, size, blur_px)

    monkeypatch.setattr(photo_module, "directed_edge_levels", counted)
    photo = Photo(pixels, CAMERA, PARAMS, threads, blurs_px=(2.0, 1.0))
    for blur_px in (1.0, 2.0, 1.0):
        expected = directed_edge_levels(pixels, (160, round(160 * CAMERA.height / CAMERA.width)), blur_px)
        np.testing.assert_array_equal(photo.levels(blur_px), expected)
    assert photo.levels(1.0, 40).shape[1] == 40
    assert sorted(made) == [(40, 1.0), (160, 1.0), (160, 2.0)]
    assert photo.fit(100, is_coarse=False) is photo.fit(100, is_coarse=False)
    assert photo.fit(100, is_coarse=True).edge_weight == PARAMS.coarse_edge_weight


def test_what_goes_wrong_meanwhile_is_said_when_asked(pixels, monkeypatch):
    def broken(*_):
        raise ValueError("no edges today")

    monkeypatch.setattr(photo_module, "directed_edge_levels", broken)
    photo = Photo(pixels, CAMERA, PARAMS, 2, blurs_px=(1.0,))
    assert photo.fit(100, is_coarse=False).size[0] == 100
    with pytest.raises(ValueError, match="no edges today"):
        photo.levels(1.0)


def test_a_photo_is_let_go_at_once(pixels):
    """Its levels are megabytes, and its threads wait: no cycle may keep them until a collection."""
    gc.disable()
    try:
        photo = Photo(pixels, CAMERA, PARAMS, 2, blurs_px=(1.0,))
        photo.levels(1.0)
        photo.fit(100, is_coarse=False)
        # The last of what was begun may be in its thread's hands for a moment yet.
        left, until = weakref.ref(photo), time.monotonic() + 20.0
        del photo
        while left() is not None and time.monotonic() < until:
            time.sleep(0.01)
        assert left() is None
    finally:
        gc.enable()


def test_a_photo_of_one_colour_is_told_as_that(tmp_path):
    """Not as a prior that is far from the city."""
    path = tmp_path / "blank.png"
    query = SimpleNamespace(image=path)
    blank = np.full((65, 97, 3), 90, np.uint8)
    assert cv2.imwrite(str(path), blank)
    with pytest.raises(QueryFault, match=r"blank\.png has one colour everywhere"):
        query_photo(query)
    # Between the pixels that are looked at first.
    blank[33, 33] = 91
    assert cv2.imwrite(str(path), blank)
    assert (query_photo(query) == blank).all()
