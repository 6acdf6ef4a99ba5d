"""Raw GNSS fixes as priors: CSV and GPX, each with its deviation, and what of them is damaged."""

import math

import numpy as np
import pytest

from lodbench.datasets.exchange.lines import Fix, read_fixes
from lodbench.datasets.prior_sources import SensorPrior
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.measurements import FRAME_M
from tests.photos.dji_photo import PROPERTIES, exif_of, write_photo, xmp_packet

CRS = "EPSG:25832"
CSV = (
    "name,latitude,longitude,height,sigma_east,sigma_north,sigma_up\n"
    "a.jpg,51.0479,9.0690,210.5,2.5,3.5,6.0\n"
    "b.jpg,51.0480,9.0691,,,,\n"
)
GPX = """<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1" version="1.1">
<wpt lat="51.0479" lon="9.0690"><ele>210.5</ele><name>a.jpg</name></wpt>
<trk><trkseg><trkpt lat="51.0480" lon="9.0691"><name>b.jpg</name></trkpt></trkseg></trk></gpx>"""
LOOK = Pose.from_euler(EulerAngles(40.0, 2.0, 15.0), (1.0, 2.0, 3.0))


def written(folder, text, name="fixes.csv"):
    path = folder / name
    path.write_text(text)
    return path


def dataset_of(folder, image=None) -> Dataset:
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    entries = tuple(Entry(f"{letter}.jpg", "all", camera, LOOK, image, None, (LOOK,)) for letter in "abc")
    return Dataset(
        "d", "", folder, None, None, ("all",), entries, {}, photo_crs=CRS, photo_origin=(0.0, 0.0, 0.0)
    )


def test_both_files_say_the_same(tmp_path):
    by_table = read_fixes(written(tmp_path, CSV))
    by_points = read_fixes(written(tmp_path, GPX, "fixes.GPX"))
    assert by_table["a.jpg"] == Fix(51.0479, 9.069, 210.5, (2.5, 3.5, 6.0))
    assert by_table["b.jpg"] == by_points["b.jpg"] == Fix(51.048, 9.0691, None, (None,) * 3)
    assert by_points["a.jpg"][:3] == by_table["a.jpg"][:3]


def test_the_prior_is_the_fix_with_its_own_deviation_and_the_angles_of_before(tmp_path):
    prior = SensorPrior(fixes=str(written(tmp_path, CSV)), fix_sigma_m=4.0)
    found = prior.apply(dataset_of(tmp_path), 0)
    first, second, third = found.entries
    east, north = MapFrame(CRS).east_north(51.0479, 9.069)
    np.testing.assert_allclose(first.prior.center, [east, north, 210.5], atol=1e-6)
    np.testing.assert_allclose(first.prior.rotation, LOOK.rotation, atol=1e-12)
    expected = [math.hypot(sigma, FRAME_M) for sigma in (2.5, 3.5, 6.0)]
    np.testing.assert_allclose(first.measured.sigmas[:3], expected)
    # Without a photo nobody says how high the second was; the third has no fix.
    assert (second.prior, third.prior) == (None, None)
    assert any("no fix of c.jpg" in item.detail for item in found.findings)
    assert "raw fixes" in prior.describe()


def test_a_photo_adds_its_angles_and_a_height_that_a_fix_lacks(tmp_path):
    photo = write_photo(tmp_path / "p.jpg", exif=exif_of(), xmp=xmp_packet(PROPERTIES))
    prior = SensorPrior(fixes=str(written(tmp_path, CSV)), fix_sigma_m=4.0)
    second = prior.apply(dataset_of(tmp_path, photo), 0).entries[1]
    assert second.prior.center[2] == pytest.approx(203.41)
    sigma = math.hypot(4.0, FRAME_M)
    assert second.measured.sigmas[:3] == pytest.approx((sigma, sigma, None))
    assert not np.allclose(second.prior.rotation, LOOK.rotation, atol=0.1)
    assert second.measured.takeoff_height_m == 80.1


@pytest.mark.parametrize(
    ("text", "name", "said"),
    [
        ("name,latitude\n", "f.csv", "one column longitude"),
        ("name,latitude,longitude\n", "f.csv", "holds no fixes"),
        (CSV + "a.jpg,51,9,1,,,\n", "f.csv", "the name a.jpg occurs twice"),
        (CSV + "c.jpg,99,9,1,,,\n", "f.csv", "latitude 99 is not within"),
        (CSV + "c.jpg,51,9,nan,,,\n", "f.csv", "height nan is not within"),
        (CSV + "c.jpg,51,9,1,-2,,\n", "f.csv", "sigma_east -2 is not within"),
        (CSV + "c.jpg,51,,1,,,\n", "f.csv", "latitude or longitude is missing"),
        (CSV + ",51,9,1,,,\n", "f.csv", "name is missing"),
        (GPX.replace("<name>b.jpg</name>", ""), "f.gpx", "name is missing"),
        (GPX[:-20], "f.gpx", "f.gpx"),
        ('<!DOCTYPE gpx [<!ENTITY a "b">]>' + GPX[21:], "f.gpx", "DOCTYPE"),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path, text, name, said):
    with pytest.raises(DatasetError) as fault:
        read_fixes(written(tmp_path, text, name))
    assert said in str(fault.value)
    assert "\n" not in str(fault.value)


def test_a_deviation_of_nothing_is_a_fault():
    with pytest.raises(ConfigError, match="fix_sigma_m"):
        SensorPrior(fix_sigma_m=0.0)
