import warnings

import pytest
from PIL import Image

from lodbench.datasets.query import Dataset, Entry
from lodbench.findings import Findings
from lodbench.geometry import Camera
from lodbench.harness.photo.check import check_photos


@pytest.mark.parametrize(
    ("size", "problem"),
    [
        # Between Pillow's warning, from 89 megapixels on, and its error, from 179 on.
        ((12288, 8192), None),
        ((20000, 10000), "too many pixels"),
    ],
)
def test_a_large_photo_is_read_in_silence_and_a_bomb_is_a_finding(tmp_path, size, problem):
    photo = tmp_path / "a.png"
    Image.new("1", size).save(photo)
    entry = Entry("a.png", "data", None, None, photo, None)
    findings = Findings()
    with warnings.catch_warnings(action="error"):
        check_photos(Dataset("own", "", tmp_path, None, None, ("data",), (entry,), {}), True, findings)
    details = [item.detail for item in findings.items]
    assert len(details) == (problem is not None)
    assert all(str(problem) in detail for detail in details)


@pytest.mark.attack
def test_no_program_is_started_for_what_a_photo_is_by_its_content(tmp_path, monkeypatch):
    """Pillow hands PostScript to Ghostscript, whatever the file is called."""
    (tmp_path / "gs").write_text(f"#!/bin/sh\ntouch {tmp_path}/started\n")
    (tmp_path / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    photo = tmp_path / "a.png"
    photo.write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\n%%EndComments\nshowpage\n%%EOF\n")
    findings = Findings()
    entry = Entry("a.png", "data", Camera(64, 48, 50.0, 50.0, 32.0, 24.0), None, photo, photo)
    check_photos(Dataset("own", "", tmp_path, None, None, ("data",), (entry,), {}), True, findings)
    assert {item.code.name for item in findings.items} >= {"IMAGE_UNREADABLE"}
    assert not (tmp_path / "started").exists()


def test_masks_that_a_run_would_refuse_are_findings(tmp_path):
    camera = Camera(60, 40, 50.0, 50.0, 30.0, 20.0)
    of_labels, colours = tmp_path / "labels.png", tmp_path / "colours.png"
    Image.new("L", (60, 40), 1).save(of_labels)
    Image.new("RGB", (60, 40), (200, 10, 10)).save(colours)
    entry = Entry("a.png", "data", camera, None, None, of_labels, instances=colours)
    for with_pixels, said in ((True, ["largest value is 1", "is not a grey image"]), (False, [])):
        findings = Findings()
        check_photos(Dataset("own", "", tmp_path, None, None, ("data",), (entry,), {}), with_pixels, findings)
        details = [item.detail for item in findings.items]
        assert all(words in detail for words, detail in zip(said, details, strict=True))
