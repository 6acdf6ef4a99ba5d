"""`lodbench mask`: strokes, the page as a browser asks for it, files in and out."""

import json
import socket
from contextlib import closing
from dataclasses import dataclass
from http.client import HTTPConnection
from threading import Thread
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from PIL import Image

from lodbench.cli import main
from lodbench.errors import DatasetError
from lodbench.harness.local_page import MaskServer
from lodbench.harness.mask import MaskSession
from lodbench.photos.files import find_photos


def houses():
    """Returns an RGB photo of two red houses on grass, and the mask of both."""
    mask = np.zeros((160, 240), bool)
    mask[30:80, 40:100] = True
    mask[90:140, 150:200] = True
    photo = np.where(mask[..., None], (170, 80, 70), (80, 130, 70))
    photo = photo + np.random.default_rng(0).normal(0, 8, photo.shape)
    return np.clip(photo, 0, 255).astype(np.uint8), mask


@dataclass(frozen=True)
class BrightParams:
    name: str = "bright"


class Bright:
    """Takes bright pixels for buildings."""

    name, params_type, requires = "bright", BrightParams, frozenset({"image"})

    def __init__(self, params):
        pass

    def segment(self, entry):
        return (cv2.imread(str(entry.image), 0) >= 100).astype(np.float32)


def drawn_and_stopped(server):
    server.session.stroke(np.array([[10.0, 10.0]]), 3.0, True, True)
    raise KeyboardInterrupt


def iou(first, second):
    return (first & second).sum() / (first | second).sum()


class TestStrokes:
    def test_a_stroke_brings_the_whole_house_and_leaves_the_other_alone(self):
        photo, truth = houses()
        start = truth.copy()
        start[:, :120] = False
        session = MaskSession(photo, start)
        session.stroke(np.array([[55.0, 45.0], [85.0, 65.0]]), 4.0, is_building=True)
        assert iou(session.mask, truth) > 0.97
        assert np.array_equal(session.mask[:, 150:], start[:, 150:])
        assert session.undo()
        assert np.array_equal(session.mask, start)
        assert not session.undo()

    def test_a_stroke_takes_away_what_is_none(self):
        photo, truth = houses()
        start = truth.copy()
        start[100:130, 40:90] = True
        session = MaskSession(photo, start)
        session.stroke(np.array([[50.0, 115.0], [80.0, 115.0]]), 5.0, is_building=False)
        assert iou(session.mask, truth) > 0.97

    def test_an_exact_stroke_changes_what_is_under_it(self):
        photo, truth = houses()
        session = MaskSession(photo, truth)
        session.stroke(np.array([[-900.0, 30.0]]), 3.0, is_building=True)
        assert not session.undo()  # beside the photo it is none
        session.stroke(np.array([[10.0, 10.0]]), 3.0, is_building=True, is_exact=True)
        added = session.mask & ~truth
        assert added.sum() == pytest.approx(np.pi * 9, rel=0.4)
        assert added[10, 10]
        assert not (truth & ~session.mask).any()

    def test_what_strokes_said_stays_said(self):
        photo, truth = houses()
        session = MaskSession(photo, truth)
        session.stroke(np.array([[60.0, 50.0]]), 6.0, is_building=False, is_exact=True)
        session.stroke(np.array([[60.0, 75.0], [90.0, 75.0]]), 3.0, is_building=True)
        assert not session.mask[48:53, 58:63].any()

    def test_undo_keeps_what_strokes_changed_and_not_the_whole_photo(self):
        start = np.zeros((3000, 4000), bool)
        session = MaskSession(np.zeros((3000, 4000, 3), np.uint8), start)
        places = [(100.0, 100.0), (2000.0, 1500.0), (120.0, 110.0)]
        for place in places:
            session.stroke(np.array([place]), 9.0, is_building=True, is_exact=True)
        assert sum(part.nbytes for _, state in session._before for part in state) < start.nbytes // 10
        session.undo()
        assert session.mask.sum() == 2 * (session.mask[:300, :300]).sum()
        assert [session.undo() is not None for _ in places] == [True, True, False]
        assert np.array_equal(session.mask, start)
        assert not session._state.strokes.any()


class TestPage:
    @pytest.fixture
    def server(self):
        photo, truth = houses()
        kept = []
        with MaskServer(
            MaskSession(photo, truth), "<b>.jpg", lambda: kept.append(1) or "saved: mask.png"
        ) as server:
            thread = Thread(target=server.serve_forever)
            thread.start()
            server.kept = kept
            yield server
            server.shutdown()
            thread.join()

    def ask(self, server, method, what, body=None, host=None, token=None):
        """Returns status and body of one request."""
        port = server.server_address[1]
        with closing(HTTPConnection("127.0.0.1", port, timeout=20)) as connection:
            headers = {"Host": host or f"127.0.0.1:{port}"}
            path = f"/{server.token if token is None else token}/{what}"
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            return answer.status, answer.read()

    def test_the_page_shows_photo_and_mask(self, server):
        status, page = self.ask(server, "GET", "")
        assert status == 200
        assert b"&lt;b&gt;.jpg" in page
        assert b"<b>.jpg" not in page
        assert b"width = 240, height = 160" in page
        photo = cv2.imdecode(
            np.frombuffer(self.ask(server, "GET", "photo.jpg")[1], np.uint8), cv2.IMREAD_COLOR
        )
        assert photo[50, 60, 2] > photo[50, 60, 1]
        mask = cv2.imdecode(
            np.frombuffer(self.ask(server, "GET", "mask.png")[1], np.uint8), cv2.IMREAD_GRAYSCALE
        )
        assert np.array_equal(mask > 127, server.session.mask)

    def test_strokes_undo_save_and_close(self, server):
        before = server.session.mask
        stroke = {"points": [[10, 10], [14, 12]], "radius": 3, "building": True, "exact": True}
        status, told = self.ask(server, "POST", "stroke", json.dumps(stroke))
        assert status == 200
        assert json.loads(told)["share"] > before.mean()
        assert json.loads(self.ask(server, "POST", "undo")[1])["can_redo"] is True
        assert np.array_equal(server.session.mask, before)
        assert json.loads(self.ask(server, "POST", "save", "{}")[1]) == {
            "message": "saved: mask.png",
            "saved": True,
        }
        assert server.kept == [1]
        assert self.ask(server, "POST", "stop", "{}")[0] == 200

    def test_strokes_that_were_not_saved_keep_the_page_open_until_somebody_is_sure(self, server):
        stroke = {"points": [[10, 10], [14, 12]], "radius": 3, "building": True, "exact": True}
        assert self.ask(server, "POST", "stroke", json.dumps(stroke))[0] == 200
        # A page that was loaded again knows of no strokes.
        told = json.loads(self.ask(server, "POST", "stop", "{}")[1])
        assert told["closes"] is False
        assert "NOT closed" in told["message"]
        assert self.ask(server, "GET", "mask.png")[0] == 200
        assert json.loads(self.ask(server, "POST", "stop", '{"sure": true}')[1])["closes"] is True

    def test_what_was_saved_closes_unasked(self, server):
        stroke = {"points": [[10, 10]], "radius": 3, "building": True}
        self.ask(server, "POST", "stroke", json.dumps(stroke))
        self.ask(server, "POST", "save", "{}")
        assert json.loads(self.ask(server, "POST", "stop", "{}")[1])["closes"] is True

    def test_a_browser_that_leaves_is_no_fault(self, server, capsys):
        try:
            raise BrokenPipeError
        except BrokenPipeError:
            server.handle_error(None, ("127.0.0.1", 1))
        assert capsys.readouterr().err == ""

    @pytest.mark.parametrize(
        ("fault", "said"),
        [
            (OSError(28, "No space left on device", "mask.png"), "mask.png: No space left on device"),
            (
                DatasetError("mask.png is another program's.", "Copy it."),
                "mask.png is another program's. Copy it.",
            ),
        ],
    )
    def test_a_save_that_fails_is_told_on_the_page_and_the_mask_stays(self, server, capsys, fault, said):
        server.save, before = Mock(side_effect=fault), server.session.mask
        status, told = self.ask(server, "POST", "save", "{}")
        assert (status, json.loads(told)) == (200, {"message": f"NOT saved: {said}", "saved": False})
        assert np.array_equal(server.session.mask, before)
        assert "Traceback" not in capsys.readouterr().err

    def test_others_are_kept_out(self, server):
        for options in ({"token": "guess"}, {"token": ""}, {"host": "evil.example:80"}):
            assert self.ask(server, "GET", "mask.png", **options)[0] == 404
            assert self.ask(server, "POST", "save", "{}", **options)[0] == 404
        assert server.kept == []
        assert server.server_address[0] == "127.0.0.1"
        # A host without a port is this machine.
        assert self.ask(server, "GET", "mask.png", host="127.0.0.1")[0] == 200

    @pytest.mark.parametrize(
        "body", ["{", "[]", "{}", '{"points": [["a", 1]], "radius": 1, "building": true}',
                 '{"points": [[1, 1]], "radius": 1e9, "building": true}',
                 '{"points": [[1, 1]], "radius": 1' + "0" * 400 + ', "building": true}']
    )  # fmt: skip
    def test_broken_strokes_are_refused(self, server, body):
        assert self.ask(server, "POST", "stroke", body)[0] == 400
        assert not server.session.undo()
        assert self.ask(server, "POST", "stop", "[]")[0] == 400


class TestCommand:
    @pytest.fixture
    def photo(self, tmp_path):
        pixels, mask = houses()
        cv2.imwrite(str(tmp_path / "photo.png"), pixels[..., ::-1])
        cv2.imwrite(str(tmp_path / "traced.png"), mask.astype(np.uint8) * 255)
        return tmp_path / "photo.png"

    def test_out_to_labelme_and_back(self, photo, capsys):
        folder = photo.parent
        given = ["mask", str(photo), "--mask", str(folder / "traced.png"), "--no-page"]
        assert main([*given, "--export", "labelme", "--export", "geojson"]) == 0
        names = ["photo_mask.png", "photo_mask.labelme.json", "photo_mask.geojson"]
        assert capsys.readouterr().out == "".join(f"written: {folder / name}\n" for name in names)
        assert all((folder / name).is_file() for name in names)
        polygons = folder / "photo_mask.labelme.json"
        again = folder / "again" / "mask.png"
        assert main(["mask", str(photo), "--import", str(polygons), "--no-page", "--out", str(again)]) == 0
        assert np.array_equal(cv2.imread(str(again), 0) > 0, houses()[1])

    def test_it_starts_from_the_network(self, photo):
        assert main(["mask", str(photo), "--no-page"]) == 0
        assert cv2.imread(str(photo.parent / "photo_mask.png"), 0).shape == (160, 240)

    def test_a_mask_that_is_there_is_gone_on_with(self, photo, capsys):
        saved = photo.parent / "photo_mask.png"
        cv2.imwrite(str(saved), houses()[1].astype(np.uint8) * 255)
        assert main(["mask", str(photo), "--no-page", "--export", "labelme"]) == 0
        assert f"starts from: {saved}, which is there" in capsys.readouterr().out
        assert np.array_equal(cv2.imread(str(saved), 0) > 0, houses()[1])

    @pytest.mark.parametrize("words", [["--segmenter", "bright"], ["--segmenter-option", "a=1"], ["--mask"]])
    def test_a_mask_that_is_there_is_not_replaced(self, photo, capsys, words):
        saved = photo.parent / "photo_mask.png"
        cv2.imwrite(str(saved), np.eye(160, 240, dtype=np.uint8) * 255)
        before = saved.read_bytes()
        words = [*words, str(photo.parent / "traced.png")] if words == ["--mask"] else words
        assert main(["mask", str(photo), "--no-page", *words]) == 2
        assert "--out OTHER.png" in capsys.readouterr().err
        assert saved.read_bytes() == before

    @pytest.mark.parametrize("name", ["labelme", "coco", "geojson"])
    def test_polygons_that_another_program_changed_are_not_replaced(self, photo, capsys, name):
        cv2.imwrite(str(photo.parent / "photo_mask.png"), houses()[1].astype(np.uint8) * 255)
        export = ["mask", str(photo), "--no-page", "--export", name]
        assert main(export) == main(export) == 0
        (polygons,) = photo.parent.glob("photo_mask.*json")
        drawn = polygons.read_text().replace("40.5", "41.5")
        polygons.write_text(drawn)
        assert main(export) == 2
        assert f"{polygons} is not as it was exported" in capsys.readouterr().err
        assert polygons.read_text() == drawn
        if name != "geojson":
            assert main([*export, "--import", str(polygons)]) == 0

    def test_an_empty_import_replaces_no_mask(self, photo, capsys):
        saved = photo.parent / "photo_mask.png"
        cv2.imwrite(str(saved), houses()[1].astype(np.uint8) * 255)
        before, polygons = saved.read_bytes(), photo.parent / "drawn.json"
        polygons.write_text('{"shapes": [], "imageWidth": 240, "imageHeight": 160}')
        words = ["mask", str(photo), "--no-page", "--import", str(polygons)]
        assert main(words) == 2
        assert f"--out {saved}" in capsys.readouterr().err
        assert saved.read_bytes() == before
        assert main([*words, "--out", str(saved)]) == 0
        assert not cv2.imread(str(saved), 0).any()

    def test_polygons_of_a_photo_that_others_turn_are_refused(self, photo, capsys):
        turned = photo.with_suffix(".jpg")
        exif = Image.Exif()
        exif[0x0112] = 3
        Image.open(photo).save(turned, exif=exif)
        polygons = photo.parent / "drawn.json"
        polygons.write_text('{"shapes": [], "imageWidth": 240, "imageHeight": 160}')
        traced = ["--mask", str(photo.parent / "traced.png")]
        for words in (["--import", str(polygons)], [*traced, "--export", "labelme"]):
            assert main(["mask", str(turned), "--no-page", *words]) == 2
            assert "EXIF orientation 3" in capsys.readouterr().err
        assert main(["mask", str(turned), "--no-page", *traced, "--export", "geojson"]) == 0
        # A format without that tag is turned by nobody.
        Image.open(photo).save(photo.with_suffix(".bmp"))
        plain = ["mask", str(photo.with_suffix(".bmp")), "--no-page", "--out", str(photo.parent / "b.png")]
        assert main([*plain, *traced, "--export", "labelme"]) == 0

    def test_it_starts_from_a_plug_in_that_looks_at_photos(self, photo, monkeypatch):
        monkeypatch.setattr("lodbench.segmentation.protocol.load_plugin", lambda group, name: Bright)
        assert main(["mask", str(photo), "--segmenter", "bright", "--no-page"]) == 0
        found = cv2.imread(str(photo.parent / "photo_mask.png"), 0) > 0
        assert np.array_equal(found, cv2.imread(str(photo), 0) >= 100)

    def test_a_network_without_weights_makes_no_mask(self, photo, capsys):
        pytest.importorskip("torch")
        pytest.importorskip("transformers")
        assert main(["mask", str(photo), "--segmenter", "sam2_unet", "--no-page"]) == 2
        assert "comes without weights" in capsys.readouterr().err
        assert not (photo.parent / "photo_mask.png").exists()

    def test_a_port_that_is_taken_is_told(self, photo, capsys):
        with closing(socket.socket()) as taken:
            taken.bind(("127.0.0.1", 0))
            taken.listen()
            port = str(taken.getsockname()[1])
            given = ["mask", str(photo), "--mask", str(photo.parent / "traced.png"), "--port", port]
            assert main(given) == 2
        told = capsys.readouterr().err
        assert f"--port {port} cannot be listened at: Address already in use." in told

    def test_strokes_that_ctrl_c_would_lose_are_kept_aside(self, photo, capsys, monkeypatch):
        monkeypatch.setattr(MaskServer, "serve_forever", drawn_and_stopped)
        folder = photo.parent
        assert main(["mask", str(photo), "--mask", str(folder / "traced.png")]) == 130
        aside = folder / "photo_mask.png.unsaved"
        assert f"--mask {aside} --out {folder / 'photo_mask.png'}" in capsys.readouterr().out
        assert find_photos(folder) == [photo, folder / "traced.png"]
        again = ["--mask", str(aside), "--out", str(folder / "photo_mask.png"), "--no-page"]
        assert main(["mask", str(photo), *again]) == 0
        assert cv2.imread(str(folder / "photo_mask.png"), cv2.IMREAD_GRAYSCALE)[10, 10] == 255

    @pytest.mark.parametrize("name", ["photo_mask.png", "photo_mask.labelme.json"])
    def test_what_another_program_wrote_while_the_page_was_open_is_not_replaced_unasked(
        self, photo, monkeypatch, name
    ):
        told = []

        def save(server):
            try:
                told.append(server.save())
            except DatasetError as fault:
                told.append(fault.message)

        def used(server):
            save(server)
            (photo.parent / name).write_bytes(b"by hand")
            save(server)
            assert (photo.parent / name).read_bytes() == b"by hand"
            save(server)

        monkeypatch.setattr(MaskServer, "serve_forever", used)
        given = ["mask", str(photo), "--mask", str(photo.parent / "traced.png"), "--export", "labelme"]
        assert main(given) == 0
        assert told[0] == told[2] == "saved: photo_mask.png, photo_mask.labelme.json"
        assert told[1] == f"{name} was written by another program since it was read or saved here."
        assert (photo.parent / name).read_bytes() != b"by hand"

    def test_what_another_program_wrote_meanwhile_is_not_replaced_without_a_page(
        self, photo, monkeypatch, capsys
    ):
        def opened(*given):
            (photo.parent / "photo_mask.png").write_bytes(b"by hand")
            return MaskSession(*given)

        monkeypatch.setattr("lodbench.harness.mask.MaskSession", opened)
        assert main(["mask", str(photo), "--mask", str(photo.parent / "traced.png"), "--no-page"]) == 2
        told = capsys.readouterr().err
        assert "photo_mask.png was written by another program" in told
        assert "--out OTHER.png" in told
        assert "saving once more" not in told
        assert (photo.parent / "photo_mask.png").read_bytes() == b"by hand"

    def test_strokes_that_cannot_be_kept_aside_do_not_hide_ctrl_c(self, photo, caplog, monkeypatch):
        monkeypatch.setattr(MaskServer, "serve_forever", drawn_and_stopped)
        (photo.parent / "photo_mask.png.unsaved").mkdir()
        assert main(["mask", str(photo), "--mask", str(photo.parent / "traced.png")]) == 130
        assert "photo_mask.png.unsaved: Is a directory" in caplog.text
