"""`lodbench track`: frames of a folder and of a video, what is lost, and bad input."""

import csv
import json
import shutil
import socket
import struct
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from pyproj import Transformer

from lodbench.citymodel import open_scene
from lodbench.cli import main
from lodbench.datasets.pose_text import read_poses
from lodbench.datasets.query import Query
from lodbench.errors import DatasetError
from lodbench.evaluation import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.harness.track_frames import Footage as TrackedFootage
from lodbench.methods.protocol import Estimate, Streams
from lodbench.methods.tracking import Tracker
from lodbench.rendering.silhouette import SilhouetteRenderer
from tests.town import CAMERA, box_obj

COUNT = 6
CAMERA_WORDS = ("--camera", "PINHOLE 320 240 230 228 161 118.5")


@dataclass
class Footage:
    """A video and photos of one flight, their masks, and where it went."""

    folder: Path
    truth: list[Pose]

    def words(self, source: str, *more: object) -> list[str]:
        # Rough: metres and degrees off the first pose.
        x, y, z = np.add(self.truth[0].center, (3.0, -4.0, 5.0))
        start = ("--center", x, y, z, "--heading", 43.0, "--pitch", -69.6, "--roll", 0.3)
        city = self.folder / "city.obj"
        return ["track", *map(str, (self.folder / source, "--city", city, *CAMERA_WORDS, *start, *more))]


@pytest.fixture(scope="module")
def footage(tmp_path_factory) -> Footage:
    folder = tmp_path_factory.mktemp("footage")
    (folder / "city.obj").write_text(box_obj())
    scene = open_scene(folder / "city.obj")
    renderer = SilhouetteRenderer(scene)
    made = Footage(folder, [])
    for part in ("photos", "masks"):
        (folder / part).mkdir()
    video = cv2.VideoWriter(str(folder / "flight.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 4.0, (320, 240))
    for k in range(COUNT):
        pose = Pose.from_euler(EulerAngles(20.0 + k, 0.4, -40.0 + 2.0 * k), (-15.0 + 2.0 * k, -10.0, 120.0))
        mask = renderer.render(CAMERA, pose).astype(np.uint8) * 255
        pixels = np.repeat((60 + mask // 2)[..., None], 3, axis=2)
        video.write(pixels)
        cv2.imwrite(str(folder / "photos" / f"photo_{k}.png"), pixels)
        for name in (f"photo_{k}", f"frame_{k:06d}"):
            cv2.imwrite(str(folder / "masks" / f"{name}.png"), mask)
        made.truth.append(pose.shifted(scene.origin))
    video.release()
    return made


def rows(out: Path) -> list[dict[str, str]]:
    with (out / "track.csv").open() as stream:
        return list(csv.DictReader(stream))


@pytest.mark.parametrize(("source", "first"), [("photos", "photo_0.png"), ("flight.avi", "frame_000000.png")])
def test_every_frame_has_its_pose(capsys, footage, tmp_path, source, first):
    code = main(footage.words(source, "--masks", footage.folder / "masks", "--fps", 4, "--out", tmp_path))
    told = capsys.readouterr().out
    assert code == 0, told
    assert f"{COUNT} frames: {COUNT} tracked, 0 lost" in told
    assert "photos per second from pixels to pose" in told
    poses = read_poses(tmp_path / "poses.txt")
    assert next(iter(poses)) == first
    for found, true in zip(poses.values(), footage.truth, strict=True):
        assert pose_error(found, true).translation_m < 0.8
    assert [row["state"] for row in rows(tmp_path)] == ["tracked"] * COUNT
    assert float(rows(tmp_path)[-1]["time_s"]) == pytest.approx((COUNT - 1) / 4.0)


def test_a_frame_without_a_mask_is_lost_and_the_next_is_not(capsys, footage, tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    for k in (0, 1, 3, 4, 5):
        name = f"photo_{k}.png"
        (masks / name).write_bytes((footage.folder / "masks" / name).read_bytes())
    code = main(footage.words("photos", "--masks", masks, "--fps", 4, "--out", tmp_path / "out", "--json"))
    assert code == 3
    frames = json.loads(capsys.readouterr().out)["frames"]
    assert [frame["state"] for frame in frames].count("lost") == 1
    assert "holds no mask of it" in frames[2]["reason"]
    assert frames[2]["center_m"] is None
    assert np.linalg.norm(np.array(frames[5]["center_m"]) - footage.truth[5].center) < 0.8


def test_masks_inside_are_no_frames_and_two_comes_before_ten(capsys, footage, tmp_path):
    folder = tmp_path / "photos"
    (folder / "masks").mkdir(parents=True)
    for k, number in enumerate((1, 2, 10)):
        photo, mask = (footage.folder / part / f"photo_{k}.png" for part in ("photos", "masks"))
        (folder / f"my photo {number}.png").write_bytes(photo.read_bytes())
        (folder / "masks" / f"my photo {number}.png").write_bytes(mask.read_bytes())
    words = ("--masks", folder.resolve() / "masks", "--fps", 4, "--out", folder / "out")
    assert main(footage.words(str(folder), *words)) == 0
    assert [row["frame"] for row in rows(folder / "out")] == [f"my photo {n}.png" for n in (1, 2, 10)]
    assert [*read_poses(folder / "out" / "poses.txt")] == [f"my_photo_{n}.png" for n in (1, 2, 10)]


def test_photos_of_one_name_are_told_before_any_work(capsys, footage, tmp_path):
    for part in ("a", "b"):
        (tmp_path / part).mkdir()
        (tmp_path / part / "1.png").write_bytes((footage.folder / "photos" / "photo_0.png").read_bytes())
    masks = ("--masks", footage.folder / "masks", "--out", tmp_path / "out")
    assert main(footage.words(str(tmp_path), *masks)) == 2
    assert "2 photos called 1.png" in capsys.readouterr().err


@pytest.mark.attack
def test_frames_of_a_varying_rate_have_their_own_times(tmp_path):
    path = tmp_path / "phone.mp4"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 4.0, (320, 240))
    for k in range(6):
        video.write(np.full((240, 320, 3), 40 * k, np.uint8))
    video.release()
    content = path.read_bytes()
    # The box stts says how many frames last how long: of six, the last three shall last twice as long.
    at = content.rfind(b"stts")
    _, entries, count, ticks = struct.unpack(">4I", content[at + 4 : at + 20])
    assert (entries, count) == (1, 6)
    table = struct.pack(">6I", 0, 2, 3, ticks, 3, 2 * ticks)
    changed = bytearray(content[: at + 4] + table + content[at + 20 :])
    for box in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts"):
        where = content.rfind(box) - 4
        struct.pack_into(">I", changed, where, struct.unpack_from(">I", content, where)[0] + 8)
    path.write_bytes(changed)
    # The last one is behind the end that other boxes state.
    times = [0.0, 0.25, 0.5, 0.75, 1.25]
    for footage, expected in (
        (TrackedFootage(path), times),
        (TrackedFootage(path, every=2), times[::2]),
        (TrackedFootage(path, rate=2.0), [k / 2.0 for k in range(5)]),
    ):
        assert [shot.time_s for shot in footage.shots()] == pytest.approx(expected, abs=1e-3)


def write_turned(path: Path, frames: list[np.ndarray], clockwise_deg: int) -> None:
    """Writes a video of frames that its header says are to be turned for display."""
    height, width = frames[0].shape[:2]
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 4.0, (width, height))
    for frame in frames:
        video.write(frame)
    video.release()
    content = bytearray(path.read_bytes())
    cos, sin = round(np.cos(np.radians(clockwise_deg))), round(np.sin(np.radians(clockwise_deg)))
    # The matrix a b u c d v x y w of the track's header, 16.16 but the last: x' = a x + c y, y' = b x + d y.
    matrix = (cos << 16, sin << 16, 0, -sin << 16, cos << 16, 0, 0, 0, 1 << 30)
    struct.pack_into(">9i", content, content.find(b"tkhd") + 4 + 40, *matrix)
    path.write_bytes(content)


@pytest.mark.attack
@pytest.mark.parametrize(("clockwise_deg", "turns"), [(90, -1), (180, 2), (270, 1)])
def test_a_turned_video_is_turned_once_as_players_do(tmp_path, clockwise_deg, turns):
    # Dark, but for its upper left and, less so, its upper right corner.
    stored = np.zeros((240, 320, 3), np.uint8)
    stored[:60, :80], stored[:60, -80:] = 250, 120
    write_turned(tmp_path / "a.mp4", [stored] * 2, clockwise_deg)
    footage = TrackedFootage(tmp_path / "a.mp4")
    shown = np.rot90(stored, turns)
    assert footage.video_size() == (shown.shape[1], shown.shape[0])
    shots = [*footage.shots()]
    assert len(shots) == 2
    for shot in shots:
        assert shot.size == footage.video_size()
        assert np.abs(shot.pixels.astype(int) - shown).mean() < 3
    (note,) = footage.notes
    assert f"shown turned by {clockwise_deg} degrees clockwise" in note


@pytest.mark.attack
def test_camera_and_masks_are_of_a_turned_video_s_frames_as_shown(capsys, footage, tmp_path):
    photos = [cv2.imread(str(footage.folder / "photos" / f"photo_{k}.png")) for k in range(COUNT)]
    write_turned(tmp_path / "a.mp4", [np.ascontiguousarray(np.rot90(photo)) for photo in photos], 90)
    words = footage.words(str(tmp_path / "a.mp4"), "--masks", footage.folder / "masks", "--out", tmp_path)
    assert main(words) == 0
    assert "note: the video is stored turned" in capsys.readouterr().out
    for found, true in zip(read_poses(tmp_path / "poses.txt").values(), footage.truth, strict=True):
        assert pose_error(found, true).translation_m < 0.8
    words[words.index("--camera") + 1] = "PINHOLE 240 320 228 230 118.5 161"
    assert main(words) == 2
    told = capsys.readouterr().err
    assert "The camera is of 240 x 320 pixels, a.mp4 has 320 x 240" in told
    assert "hint: Give the intrinsics of the frames as players show them" in told


@pytest.mark.attack
@pytest.mark.parametrize("name", ["v.mp4", "v.m3u8", "v.avi"])
@pytest.mark.parametrize(
    "content",
    [
        "ffconcat version 1.0\nfile {inner}\n",
        "#EXTM3U\n#EXT-X-TARGETDURATION:3\n#EXTINF:3.0,\n{inner}\n#EXT-X-ENDLIST\n",
        "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 18791 RTP/AVP 26\n",
    ],
)
def test_no_file_and_no_address_that_a_video_names_is_opened(footage, tmp_path, name, content):
    shutil.copy(footage.folder / "flight.avi", tmp_path / "inner.avi")
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        address = f"http://127.0.0.1:{server.getsockname()[1]}/inner.avi"
        for inner in ("inner.avi", str(tmp_path / "inner.avi"), address):
            (tmp_path / name).write_text(content.format(inner=inner))
            with pytest.raises(DatasetError, match="no video that OpenCV reads"):
                next(TrackedFootage(tmp_path / name).shots())
        with pytest.raises(BlockingIOError):
            server.accept()


@pytest.mark.attack
def test_a_video_that_is_cut_off_is_told(capsys, footage, tmp_path):
    content = (footage.folder / "flight.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(content[: len(content) * 6 // 10])
    masks = ("--masks", footage.folder / "masks", "--out", tmp_path / "out")
    assert main(footage.words(str(tmp_path / "cut.avi"), *masks)) == 0
    assert f"of the video's {COUNT} frames can be read: it is cut off" in capsys.readouterr().out


def test_every_second_frame_of_a_video(capsys, footage, tmp_path):
    words = footage.words("flight.avi", "--masks", footage.folder / "masks", "--every", 2, "--out", tmp_path)
    assert main(words) == 0
    assert [row["frame"] for row in rows(tmp_path)] == [f"frame_{k:06d}.png" for k in (0, 2, 4)]


def test_a_track_of_other_frames_is_not_written_over_nor_a_good_one_by_one_that_is_lost(
    capsys, footage, tmp_path
):
    masks, out = ("--masks", footage.folder / "masks"), ("--every", 3, "--out", tmp_path)
    assert main(footage.words("flight.avi", *masks, *out)) == 0
    written = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    other = footage.folder / "other.avi"
    other.write_bytes((footage.folder / "flight.avi").read_bytes())
    assert main(footage.words("other.avi", *masks, *out)) == 2
    told = capsys.readouterr().err
    assert "track.csv is not of" in told
    assert "--out OTHER" in told
    # Masks of no building: every frame is lost.
    empty = tmp_path.with_name(f"{tmp_path.name}_empty")
    empty.mkdir()
    for k in range(COUNT):
        cv2.imwrite(str(empty / f"frame_{k:06d}.png"), np.zeros((240, 320), np.uint8))
    assert main(footage.words("flight.avi", "--masks", empty, *out)) == 1
    told = capsys.readouterr().out
    assert "is left as it is" in told
    assert "written:" not in told
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == written
    assert main(footage.words("flight.avi", *masks, *out)) == 0


@pytest.mark.parametrize("source", ["flight.avi", "photos"])
def test_fewer_of_its_frames_do_not_replace_a_track(capsys, footage, tmp_path, source):
    masks, out = ("--masks", footage.folder / "masks"), ("--fps", 4, "--out", tmp_path)
    assert main(footage.words(source, *masks, *out)) == 0
    written = (tmp_path / "track.csv").read_bytes()
    assert main(footage.words(source, *masks, *out, "--every", 2)) == 2
    assert "is not of these frames of" in capsys.readouterr().err
    assert (tmp_path / "track.csv").read_bytes() == written
    assert main(footage.words(source, *masks, *out)) == 0


@pytest.mark.parametrize("source", ["flight.avi", "photos"])
def test_a_camera_of_another_size_is_refused_as_by_localize(capsys, footage, tmp_path, source):
    words = footage.words(source, "--masks", footage.folder / "masks", "--out", tmp_path / "out")
    words[words.index("--camera") + 1] = "PINHOLE 160 120 115 114 80.5 59.25"
    assert main(words) == 2
    assert "The camera is of 160 x 120 pixels" in capsys.readouterr().err
    # So are masks of no frame.
    (tmp_path / "frame_1.png").write_bytes((footage.folder / "masks" / "photo_1.png").read_bytes())
    assert main(footage.words("flight.avi", "--masks", tmp_path, "--out", tmp_path / "out")) == 2
    assert "holds no mask of any image" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_dji_s_subtitles_beside_a_video_state_its_start(capsys, footage, tmp_path):
    video = Path(shutil.copy(footage.folder / "flight.avi", tmp_path / "DJI_0001.avi"))
    x, y, up = np.add(footage.truth[0].center, (3.0, -4.0, 5.0))
    longitude, latitude = Transformer.from_crs("EPSG:32631", "EPSG:4326", always_xy=True).transform(x, y)
    cue = f"[latitude: {latitude:.7f}] [longitude: {longitude:.7f}] [rel_alt: 1.0 abs_alt: {up:.3f}] "
    cue += "[gb_yaw: 43.0 gb_pitch: -69.6 gb_roll: 0.3]"
    video.with_suffix(".SRT").write_text(f"1\n00:00:00,000 --> 00:00:00,033\n{cue}\n\n")
    words = ["track", video, "--city", footage.folder / "city.obj", "--crs", "EPSG:32631", *CAMERA_WORDS]
    words += ["--masks", footage.folder / "masks", "--out", tmp_path / "out"]
    assert main([*map(str, words)]) == 0
    assert "note: what DJI_0001.SRT states of the start was used" in capsys.readouterr().out
    first = read_poses(tmp_path / "out" / "poses.txt")["frame_000000.png"]
    assert pose_error(first, footage.truth[0]).translation_m < 1.0


def test_a_rough_pose_that_is_lacking_is_asked_for_in_words_of_track(capsys, footage, tmp_path):
    words = footage.words("flight.avi", "--masks", footage.folder / "masks", "--out", tmp_path)
    at = words.index("--center")
    assert main([*words[:at], *words[at + 4 :], "--crs", "EPSG:25832"]) == 2
    told = capsys.readouterr().err
    assert "hint: Give --lat and --lon" in told
    assert "localize" not in told


def test_photos_with_masks_are_not_decoded_but_of_the_camera_s_size(capsys, footage, tmp_path, monkeypatch):
    shutil.copytree(footage.folder / "photos", tmp_path / "photos")
    cv2.imwrite(str(tmp_path / "photos" / "photo_3.png"), np.zeros((120, 160, 3), np.uint8))
    monkeypatch.delattr("lodbench.harness.track_frames.read_picture")
    words = footage.words("photos", "--masks", footage.folder / "masks", "--out", tmp_path / "out")
    words[1] = str(tmp_path / "photos")
    assert main(words) == 3
    told = capsys.readouterr().out
    assert "lost from photo_3.png to photo_3.png: it is 160 x 120, not as the camera" in told
    # PNGs have no clock.
    assert "note: no clock to order the photos by: 1 a second is assumed; --fps says how many" in told
    assert main([*words, "--fps", "2"]) == 3
    assert "no clock" not in capsys.readouterr().out


def test_what_was_tracked_until_it_was_stopped_is_written(capsys, caplog, footage, tmp_path, monkeypatch):
    once = Tracker.next
    done: list[str] = []

    def stopped(self: Tracker, query: Query, streams: Streams) -> Estimate:
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(query.name)
        return once(self, query, streams)

    monkeypatch.setattr(Tracker, "next", stopped)
    words = footage.words("photos", "--masks", footage.folder / "masks", "--fps", 4, "--out", tmp_path)
    assert main(words) == 130
    assert [row["frame"] for row in rows(tmp_path)] == done
    assert len(read_poses(tmp_path / "poses.txt")) == 3
    assert f"3 frames were tracked until then: {tmp_path}" in caplog.text
    # A whole track goes before one that was stopped.
    del done[1:]
    assert main(words) == 130
    assert len(rows(tmp_path)) == 3


def test_a_track_that_is_lost_has_the_same_columns_and_says_what_to_look_at(capsys, footage, tmp_path):
    words = ("--masks", footage.folder / "masks", "--fps", 4, "--out")
    assert main(footage.words("photos", *words, tmp_path / "found")) == 0
    assert "rough pose" not in capsys.readouterr().out
    wrong = [*footage.words("photos", *words, tmp_path / "lost")]
    wrong[wrong.index("--center") + 3] = "900"
    assert main(wrong) == 1
    assert "the first frame is not found from its rough pose" in capsys.readouterr().out
    found, lost = rows(tmp_path / "found"), rows(tmp_path / "lost")
    assert list(found[0]) == list(lost[0])
    assert lost[0]["east"] == lost[0]["probability"] == ""
