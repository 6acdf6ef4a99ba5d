"""Photos of one's own: which are photos, when they were taken, what flights are solved with, what is left."""

import errno
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from shapely.geometry import Polygon, shape

from lodbench.citymodel.scene import build_scene
from lodbench.cli import main
from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.pose_text import FoundPose
from lodbench.errors import DatasetError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.harness.photo.flight_inputs import masks_of, picture_file, poses_in_model, tied_notes
from lodbench.harness.photo.many import photos_of
from lodbench.harness.photo.outputs import building_outline, city_and_marks, contradiction_features
from lodbench.harness.tracebacks import last_write
from lodbench.harness.track_frames import photo_clocks
from lodbench.methods.flight.relative_poses import width_looked_at
from lodbench.photos.camera import pinhole_of
from lodbench.photos.map_frame import MapFrame
from tests.photos.dji_photo import exif_of, write_photo
from tests.town import CAMERA


@pytest.fixture
def flight(tmp_path) -> Path:
    folder = tmp_path / "flight"
    for name in ("a.JPG", "b.JPG", "masks/a.png", "better/a.png", "out/a_overlay.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(name.encode())
    return folder


@pytest.mark.parametrize("relative", [True, False])
def test_masks_and_earlier_results_are_no_photos(flight, monkeypatch, relative):
    monkeypatch.chdir(flight.parent)
    source = Path("flight") if relative else flight
    found = photos_of([source], flight / "better", source / "masks", Path("flight/out"))
    assert [photo.name for photo in found] == ["a.JPG", "b.JPG"]
    # What the shell makes of flight/*, folders among it.
    named = photos_of(sorted(source.iterdir()), flight / "better", flight / "masks", flight / "out")
    assert source / "a.JPG" in named
    assert source / "better" / "a.png" not in named
    # Results beside the photos, or above them, are no reason to leave photos out.
    for out in (flight, flight.parent):
        assert source / "a.JPG" in photos_of([source], flight / "better", flight / "masks", out)


def test_what_macos_keeps_of_photos_is_none(flight):
    (flight / "._a.JPG").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X        ")
    found = photos_of([flight], flight / "masks", flight / "better", flight / "out")
    assert [photo.name for photo in found] == ["a.JPG", "b.JPG"]


def test_a_folder_of_masks_alone_and_one_of_photos_alone_are_refused_in_one_line(capsys, flight):
    (flight / "c" / "masks").mkdir(parents=True)
    (flight / "masks" / "a.png").rename(flight / "c" / "masks" / "c.png")
    with pytest.raises(DatasetError, match="holds no photos outside the folders of masks"):
        photos_of([flight / "c"], flight / "c" / "masks")
    photos = photos_of([flight], flight, flight / "masks", flight / "better")
    assert photos[:2] == [flight / "a.JPG", flight / "b.JPG"]
    assert main(["localize", str(flight), "--city", "city.gml", "--masks", str(flight)]) == 2
    reported = capsys.readouterr().err
    assert f"{flight} holds no mask of any image" in reported
    assert "Traceback" not in reported


def test_a_link_to_nowhere_does_not_lose_the_others(flight):
    gone = flight / "gone.JPG"
    gone.symlink_to(flight / "nowhere.JPG")
    _, reasons = masks_of([gone, flight / "a.JPG"], None)
    assert list(reasons) == [0]
    assert "cannot be read" in reasons[0]


def test_a_folder_that_is_called_as_photos_are_is_none(flight):
    """Some programs name folders after the photo that they are of; a link that leads nowhere is reported."""
    (flight / "c.jpg").mkdir()
    (flight / "c.jpg" / "tile.png").write_bytes(b"")
    (flight / "d.jpg").symlink_to(flight / "nothing.jpg")
    found = photos_of([flight], flight / "masks", flight / "better", flight / "out")
    assert [photo.name for photo in found] == ["a.JPG", "b.JPG", "tile.png", "d.jpg"]


@pytest.mark.parametrize(
    ("clocks", "expected", "said"),
    [
        (["19", "20", "22"], [0, 1, 3], None),
        (["19.5", "19.75", "20"], [0, 0.25, 0.5], None),
        (["19.050", "19.55", "20.05"], [0, 0.5, 1.0], None),
        # Two a second, begun and left in the middle of one.
        (["19", "20", "20", "21", "21", "22"], [0, 0.5, 1.0, 1.5, 2.0, 2.5], "whole seconds"),
        (["19", "19", "20", "20"], [0, 0.5, 1.0, 1.5], "whole seconds"),
        (["19.00", "19.00", "20.00", "20.00"], [0, 0.5, 1.0, 1.5], "whole seconds"),
        (["19", "19", "19"], None, "no clock"),
        (["20", "19", "21"], None, "no clock"),
        (["19", "", "21"], [0, 1, 2], "without a clock, 1,"),
        (["", "19", "", "", "22", ""], [0, 1, 2, 3, 4, 5], "without a clock, 4,"),
        (["19", "", ""], None, "no clock"),
        (["", "", ""], None, "no clock"),
        (["19"], None, None),
    ],
)
def test_photos_have_the_times_that_their_clocks_tell(tmp_path, clocks, expected, said):
    photos = []
    for number, clock in enumerate(clocks):
        second, _, fraction = clock.partition(".")
        taken_at = f"2023:10:18 11:46:{second}" if second else ""
        exif = exif_of(taken_at=taken_at, fraction=fraction)
        photos.append(write_photo(tmp_path / f"{number}.jpg", exif=exif))
    found, notes = photo_clocks(photos)
    assert found == (expected if expected is None else pytest.approx(expected, abs=1e-5))
    assert [said in note for note in notes] == ([True] if said else [])


@pytest.mark.parametrize("fraction", ["x", "-5", "\u0663", " "])
def test_a_fraction_that_is_none_is_absent(tmp_path, fraction):
    photo = write_photo(tmp_path / "a.jpg", exif=exif_of(fraction=fraction))
    other = write_photo(tmp_path / "b.jpg", exif=exif_of(taken_at="2023:10:18 11:46:20"))
    assert photo_clocks([photo, other]) == ([0.0, 1.0], [])


def model_of(folder: Path, *names: str) -> Path:
    """Returns a model whose images stand at x = 1, 2 and so on."""
    poses = [Pose.from_euler(EulerAngles(0, 0, 0), (x + 1.0, 0.0, 0.0)) for x in range(len(names))]
    write_colmap([FoundPose(n, "", pose, CAMERA) for n, pose in zip(names, poses, strict=True)], folder)
    return folder


def places(known: dict[Path, Pose]) -> dict[str, int]:
    return {photo.as_posix(): round(float(pose.center[0])) for photo, pose in known.items()}


@pytest.mark.parametrize(
    ("images", "photos", "expected"),
    [
        (["a.jpg", "b.jpg"], ["x/a.jpg", "x/b.jpg", "x/c.jpg"], {"x/a.jpg": 1, "x/b.jpg": 2}),
        (["card/a.jpg"], ["x/a.jpg"], {"x/a.jpg": 1}),
        # Memory cards begin anew after 999 photos: two folders, each with an a.jpg.
        (["1/a.jpg", "2/a.jpg"], ["x/2/a.jpg", "x/1/a.jpg"], {"x/2/a.jpg": 2, "x/1/a.jpg": 1}),
        (["1/a.jpg", "2/a.jpg", "b.jpg"], ["x/a.jpg", "x/b.jpg"], {"x/b.jpg": 3}),
        (["a.jpg", "b.jpg"], ["1/a.jpg", "2/a.jpg", "1/b.jpg"], {"1/b.jpg": 2}),
        # Programs leave endings out, or write them in other letters; a PNG is another photo.
        (["a", "c/b.jpg", "d.png"], ["x/a.JPG", "x/b.JPG", "x/d.jpg"], {"x/a.JPG": 1, "x/b.JPG": 2}),
        (["1/a", "2/a"], ["x/2/a.jpg", "x/1/a.jpg"], {"x/2/a.jpg": 2, "x/1/a.jpg": 1}),
        (["a", "b"], ["x/a.jpg", "x/a.png", "x/b.jpg"], {"x/b.jpg": 2}),
    ],
)
def test_no_photo_gets_the_pose_of_another_of_its_name(tmp_path, images, photos, expected):
    assert places(poses_in_model(model_of(tmp_path / "model", *images), [*map(Path, photos)])) == expected


def test_a_model_of_other_photos_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="none of these photos"):
        poses_in_model(model_of(tmp_path / "model", "a.jpg"), [Path("b.jpg")])


def test_photos_that_a_model_lacks_are_reported(tmp_path):
    photos = [Path(f"x/{name}.jpg") for name in "abcd"]
    known = poses_in_model(model_of(tmp_path / "model", "a.jpg", "b.jpg", "d.jpg"), photos)
    assert tied_notes(Path("sparse"), photos, known) == ["3 of these photos are in sparse, under their names"]
    (few,) = tied_notes(Path("sparse"), photos[:3], known)
    assert few == "2 of these photos are in sparse, under their names: too few to tie the photos together"
    assert tied_notes(Path("sparse"), photos[:2], known) == tied_notes(None, photos, {}) == []


def test_a_copy_of_the_same_name_leaves_the_mask_to_the_original(tmp_path):
    photos = [tmp_path / folder / "a.jpg" for folder in ("card", "backup", "other")]
    for photo, content in zip(photos, (b"one", b"one", b"two"), strict=True):
        photo.parent.mkdir()
        photo.write_bytes(content)
    (tmp_path / "masks").mkdir()
    mask = tmp_path / "masks" / "a.png"
    mask.touch()
    found, reasons = masks_of(photos[:2], mask.parent)
    assert found[0] == mask
    assert reasons == {1: f"it is a copy of {photos[0]}"}
    # Of two photos it is of neither.
    _, reasons = masks_of(photos, mask.parent)
    assert [row for row in reasons if "may be of" in reasons[row]] == [0, 2]


def test_undistorted_copies_are_as_wide_as_features_are_looked_for_in(tmp_path):
    camera = Camera(2400, 600, 2000.0, 2000.0, 1200.0, 300.0, (-0.05, 0.0, 0.0, 0.0))
    cv2.imwrite(str(tmp_path / "a.jpg"), np.zeros((600, 2400, 3), np.uint8))
    request = SimpleNamespace(photo=tmp_path / "a.jpg")
    photo = SimpleNamespace(camera=camera, pinhole=pinhole_of(camera), request=request)
    copy = picture_file(photo, tmp_path / "1.jpg")
    assert cv2.imread(str(copy)).shape[1] == width_looked_at(10) == 2048


@pytest.mark.parametrize("has_masks", [True, False])
def test_the_original_of_a_numbered_copy_is_the_photo_that_masks_are_named_by(tmp_path, has_masks):
    """The copy comes first in a folder: it was kept, without a mask, and the photo was left out."""
    photos = [tmp_path / "DJI_0001 (1).JPG", tmp_path / "DJI_0001.JPG"]
    for photo in photos:
        photo.write_bytes(b"one")
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "DJI_0001.png").touch()
    _, reasons = masks_of(photos, tmp_path / "masks" if has_masks else None)
    assert reasons == {0: f"it is a copy of {photos[1]}"}


def test_a_copy_that_has_the_mask_is_kept(tmp_path):
    photos = [tmp_path / "a.JPG", tmp_path / "mapped_a.JPG"]
    for photo in photos:
        photo.write_bytes(b"one")
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "mapped_a.png").touch()
    assert masks_of(photos, tmp_path / "masks")[1] == {0: f"it is a copy of {photos[1]}"}


@pytest.mark.parametrize(
    ("fault", "reported"),
    [
        (
            OSError(errno.ENOSPC, "No space left on device", "/data/.a.csv.12345678.lodbench.part"),
            "a.csv: No space",
        ),
        (OSError(errno.ENOSPC, "No space left on device"), "out: No space left on device"),
        (DatasetError("out is a file.", "Choose another."), "out is a file"),
    ],
)
def test_a_write_that_fails_on_the_way_out_does_not_hide_why_the_work_ended(fault, reported, caplog):
    def work():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            with last_write(Path("out")):
                raise fault from None
            raise

    with pytest.raises(KeyboardInterrupt):
        work()
    assert "what was done until then could not be kept" in caplog.text
    assert reported in caplog.text


# A ring of flat roof, 20 m x 20 m with a court of 8 m x 8 m, as four rectangles; and a wall of it.
_RECTANGLES = ((0, 0, 20, 6), (0, 14, 20, 20), (0, 6, 6, 14), (14, 6, 20, 14))
ORIGIN = np.array([500_000.0, 5_600_000.0, 100.0])


@pytest.fixture
def scene():
    points, triangles = [], []
    for x, y, x2, y2 in _RECTANGLES:
        start = len(points)
        points += [(x, y, 9.0), (x2, y, 9.0), (x2, y2, 9.0), (x, y2, 9.0)]
        triangles += [(start, start + 1, start + 2), (start, start + 2, start + 3)]
    points += [(0, 0, 0.0), (20, 0, 0.0), (20, 0, 9.0)]
    triangles.append((len(points) - 3, len(points) - 2, len(points) - 1))
    owners = np.zeros(len(triangles), dtype=np.int64)
    return build_scene(
        np.array(points, float),
        np.array(triangles),
        owners,
        ("court",),
        lod="1",
        crs="EPSG:25832",
        origin=ORIGIN,
    )


def test_an_outline_has_its_court_as_a_hole(scene):
    ((outer, hole),) = building_outline(scene, 0)
    assert Polygon(outer, [hole]).area == pytest.approx(400.0 - 64.0)
    assert Polygon(outer).exterior.is_ccw
    assert outer.min(axis=0) == pytest.approx(ORIGIN[:2])


def test_what_is_contradicted_is_reported_and_lies_where_it_stands(scene):
    frame = MapFrame("EPSG:25832")
    doubted = {"id": "court", "higher_m": 2.0, "sigma_m": 0.3, "photos": 3, "doubt": True}
    right = {"buildings": [{**doubted, "doubt": False}]}
    assert contradiction_features(scene, frame, right, "flight 1") == []
    ring = [
        [500_030.0, 5_600_000.0],
        [500_040.0, 5_600_000.0],
        [500_040.0, 5_600_010.0],
        [500_030.0, 5_600_000.0],
    ]
    lacking = {"kind": "unmapped", "outline": [ring], "area_m2": 50.0, "photos": ["p"]}
    lacking |= {"height_m": None, "sigma_m": None, "at_most_m": 8.0}
    gone = {"kind": "demolished", "id": "court", "probability": 0.9, "photos": ["p"]}
    findings = {"buildings": [doubted], "changes": [gone, lacking]}
    features = contradiction_features(scene, frame, findings, "flight 1")
    assert [each["properties"]["kind"] for each in features] == ["height", "demolished", "unmapped"]
    assert {each["properties"]["flight"] for each in features} == {"flight 1"}
    places = [shape(each["geometry"]).centroid for each in features]
    found = [frame.east_north(place.y, place.x) for place in places]
    assert found[0] == pytest.approx((500_010.0, 5_600_010.0), abs=0.01)
    assert found[1] == pytest.approx(found[0])
    assert found[2] == pytest.approx((500_036.67, 5_600_003.33), abs=0.01)
    _, marks = city_and_marks(scene, findings)
    assert [mark.title.split(":")[0] for mark in marks] == ["court", "court", "not in the map"]


def test_a_building_that_this_map_has_not_is_reported_without_an_outline(scene):
    gone = {"kind": "demolished", "id": "of another map", "probability": 0.95, "photos": ["a", "b", "c"]}
    _, (mark,) = city_and_marks(scene, {"changes": [gone]})
    assert "of another map: probably demolished (95 %)" in mark.title
    assert list(mark.rings) == []
