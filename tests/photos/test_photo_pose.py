"""From metadata to poses and cameras: against the published prior, pyproj, and geometry done by hand."""

import math
import os
import struct
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod, Transformer, datadir
from pyproj.network import is_network_enabled, set_network_enabled

from lodbench.errors import ConfigError, DatasetError
from lodbench.photos import map_frame
from lodbench.photos.camera import camera_from_photo
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.measurements import datum_note, place_notes
from lodbench.photos.metadata import PhotoMetadata
from lodbench.photos.pose import HeightOptions, RoughPlace, pose_from_photo
from lodbench.photos.xmp import Dewarp

# A drone over western Germany, far from its zone's meridian: the grid is turned by more than 2 degrees.
PHOTO = PhotoMetadata(
    "DJI_0001.JPG", 5472, 3648, latitude_deg=51.0479, longitude_deg=5.8690, altitude_m=203.4,
    relative_altitude_m=80.1, gimbal_yaw_deg=-43.6, gimbal_pitch_deg=-45.3, gimbal_roll_deg=0.3,
)  # fmt: skip
NRW = MapFrame("EPSG:25832+7837")


def ground_direction(frame: MapFrame, photo: PhotoMetadata) -> float:
    """Returns the true bearing, degrees, in which the photo's camera looks, by a geodesic on the ground."""
    pose = pose_from_photo(photo, frame)
    ahead = pose.center + 200 * pose.rotation[2]
    lat, lon = frame.latitude_longitude(*pose.center[:2])
    lat2, lon2 = frame.latitude_longitude(*ahead[:2])
    return Geod(ellps="WGS84").inv(lon, lat, lon2, lat2)[0]


def test_looks_where_the_gimbal_says_by_true_north():
    assert abs(NRW.convergence_deg(*NRW.east_north(51.0479, 5.869))) > 2.0
    assert ground_direction(NRW, PHOTO) == pytest.approx(-43.6, abs=0.02)


@pytest.mark.parametrize("crs", ["EPSG:25832", "EPSG:2056+5728", "EPSG:6677", "EPSG:26918", "EPSG:4547"])
def test_in_every_projection(crs):
    frame = MapFrame(crs)
    area = frame._horizontal.area_of_use
    place = {
        "latitude_deg": area.south * 0.4 + area.north * 0.6,
        "longitude_deg": area.west * 0.3 + area.east * 0.7,
    }
    assert (ground_direction(frame, replace(PHOTO, **place)) + 43.6 + 180) % 360 - 180 == pytest.approx(
        0, abs=0.1
    )


def test_the_position_is_pyproj_s():
    expected = Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True).transform(5.8690, 51.0479)
    np.testing.assert_allclose(pose_from_photo(PHOTO, NRW).center, [*expected, 203.4], atol=1e-6)


def test_the_published_prior_of_the_demo_query():
    # UAVD4L's 0636_D: gimbal (-43.6, -45.3, 0) is the published prior (44.7, 0, 43.6), without convergence.
    frame = MapFrame("EPSG:4547")
    photo = replace(PHOTO, latitude_deg=28.28, longitude_deg=113.0, gimbal_roll_deg=0.0)
    angles = pose_from_photo(photo, frame).euler
    convergence = frame.convergence_deg(*frame.east_north(28.28, 113.0))
    assert convergence == pytest.approx(-0.47, abs=0.02)
    np.testing.assert_allclose(angles, [44.7, 0.0, 43.6 + convergence], atol=1e-9)


def test_the_three_mistakes_of_the_released_script_are_not_made():
    pose = pose_from_photo(replace(PHOTO, gimbal_roll_deg=3.0), NRW)
    # (a) The translation belongs to the rotation: the camera is where GPS says.
    east, north = NRW.east_north(51.0479, 5.869)
    np.testing.assert_allclose(-pose.rotation.T @ pose.translation, [east, north, 203.4], atol=1e-6)
    # (b) The roll turns about the optical axis: where the camera looks does not change with it.
    level = pose_from_photo(replace(PHOTO, gimbal_roll_deg=0.0), NRW)
    np.testing.assert_allclose(pose.rotation[2], level.rotation[2], atol=1e-12)
    cosine = (np.trace(pose.rotation @ level.rotation.T) - 1) / 2
    assert np.degrees(np.arccos(cosine)) == pytest.approx(3.0, abs=1e-6)
    # (c) Grid north is not true north.
    assert -level.euler.yaw_deg == pytest.approx(-43.6 - NRW.convergence_deg(east, north), abs=1e-9)


@given(
    st.floats(-179, 179), st.floats(-89, -5), st.floats(47.5, 54.5), st.floats(6.1, 11.9), st.floats(0, 900)
)
def test_there_and_back(heading, pitch, latitude, longitude, height):
    given_place = RoughPlace(latitude, longitude, height, heading, pitch, 0.0)
    place = NRW.place_of(pose_from_photo(PhotoMetadata("a.jpg", 4, 3), NRW, given=given_place))
    assert place.latitude_deg == pytest.approx(latitude, abs=1e-8)
    assert place.longitude_deg == pytest.approx(longitude, abs=1e-8)
    assert place.height_m == pytest.approx(height, abs=1e-6)
    assert (place.heading_deg - heading + 180) % 360 - 180 == pytest.approx(0, abs=1e-7)
    assert place.pitch_deg == pytest.approx(pitch, abs=1e-7)


@pytest.fixture
def proj_data(tmp_path):
    """A folder that PROJ looks for grids in, and no network; both as before afterwards."""
    before, network = datadir.get_data_dir(), is_network_enabled()
    set_network_enabled(False)
    datadir.set_data_dir(f"{before}{os.pathsep}{tmp_path}")
    map_frame._to_heights.cache_clear()
    yield tmp_path
    map_frame._to_heights.cache_clear()
    datadir.set_data_dir(before)
    set_network_enabled(network)


class TestHeights:
    def height(self, options: HeightOptions | None = None, **changes) -> float:
        return float(pose_from_photo(replace(PHOTO, **changes), NRW, options).center[2])

    def test_sea_level_is_taken_as_it_stands(self):
        assert self.height() == pytest.approx(203.4)

    def test_above_the_take_off_point(self):
        assert self.height(HeightOptions(takeoff_m=61.5)) == pytest.approx(141.6)

    def test_an_offset_comes_on_top(self):
        assert self.height(HeightOptions(takeoff_m=61.5, offset_m=-2.5)) == pytest.approx(139.1)
        given_height = RoughPlace(height_m=160.0)
        pose = pose_from_photo(PHOTO, NRW, HeightOptions(offset_m=30.0), given_height)
        assert pose.center[2] == pytest.approx(190.0)

    def test_above_the_ellipsoid_with_a_given_geoid(self):
        assert self.height(HeightOptions("ellipsoid", geoid_m=46.2)) == pytest.approx(157.2)
        # An RTK solution is above the ellipsoid without being told.
        assert self.height(HeightOptions(geoid_m=46.2), has_rtk=True) == pytest.approx(157.2)
        assert self.height(HeightOptions(geoid_m=46.2)) == pytest.approx(203.4)
        (note,) = place_notes(NRW, [PHOTO], HeightOptions(geoid_m=46.2))
        assert note.startswith("--geoid was not used: ")
        assert "--heights ellipsoid uses it" in note
        mixed = place_notes(NRW, [PHOTO, replace(PHOTO, has_rtk=True)], HeightOptions(geoid_m=46.2))
        assert mixed[0].startswith("--geoid was not used for 1 of 2 photos: ")
        assert place_notes(NRW, [replace(PHOTO, has_rtk=True)], HeightOptions(geoid_m=46.2)) == ()
        assert place_notes(NRW, [PHOTO], HeightOptions()) == ()

    def test_a_fix_lost_on_the_way_is_reported_for_it_steps_by_46_metres(self):
        photos = [PHOTO, *[replace(PHOTO, has_rtk=True)] * 3]
        (note,) = place_notes(NRW, iter(photos))
        assert "1 of 4 photos have no RTK solution" in note
        for told in (HeightOptions("ellipsoid"), HeightOptions(takeoff_m=60.0)):
            assert place_notes(NRW, photos, told) == ()

    def test_an_rtk_receiver_without_corrections_is_reported(self):
        photos = [PHOTO, replace(PHOTO, is_single_point=True)]
        (note,) = place_notes(NRW, photos)
        assert "1 of 2 photos" in note
        assert "--heights says which" in note
        for told in (HeightOptions("ellipsoid"), HeightOptions("sea_level"), HeightOptions(takeoff_m=60.0)):
            assert place_notes(NRW, photos, told) == ()

    def test_without_a_geoid_model_it_is_an_error_and_no_silent_46_metres(self, proj_data):
        with pytest.raises(DatasetError, match="geoid model") as fault:
            self.height(HeightOptions("ellipsoid"))
        assert "--geoid" in fault.value.hint
        with pytest.raises(DatasetError, match="names no heights"):
            pose_from_photo(PHOTO, MapFrame("EPSG:25832"), HeightOptions("ellipsoid"))

    def test_a_city_s_heights_in_feet_are_read_in_metres_and_so_are_a_drone_s(self, monkeypatch):
        in_feet = SimpleNamespace(transform=lambda x, y, z, errcheck: (x, y, z / (1200 / 3937)))
        frame = MapFrame("EPSG:26918+6360")
        east, north = frame.east_north(40.7, -74.0)
        monkeypatch.setattr(map_frame, "_to_heights", lambda crs: in_feet)
        assert frame.height_from_ellipsoid(40.7, -74.0, 120.0) == pytest.approx(120.0)
        assert frame.east_north(40.7, -74.0) == (east, north)

    def test_with_proj_s_own_geoid_model(self, proj_data):
        # A world of one undulation, 47.25 m, under the name by which PROJ knows EGM96.
        rows, columns = 3, 4
        head = struct.pack(">ddddii", -90.0, -180.0, 90.0, 90.0, rows, columns)
        (proj_data / "egm96_15.gtx").write_bytes(head + struct.pack(">f", 47.25) * (rows * columns))
        frame = MapFrame("EPSG:32632+5773")
        height = pose_from_photo(PHOTO, frame, HeightOptions("ellipsoid")).center[2]
        assert height == pytest.approx(203.4 - 47.25, abs=1e-3)

    def test_frames_of_one_system_share_what_proj_found(self):
        assert MapFrame("EPSG:25832")._to_map is MapFrame("EPSG:25832+7837")._to_map

    @pytest.mark.parametrize(("source", "match"), [("barometer", "barometer"), ("takeoff", "take-off")])
    def test_options_are_checked(self, source, match):
        with pytest.raises(ConfigError, match=match):
            HeightOptions(source)


@pytest.mark.parametrize(
    ("absent", "match"),
    [
        ("latitude_deg", "where it was taken"),
        ("gimbal_yaw_deg", "looked"),
        ("gimbal_pitch_deg", "looked"),
        ("altitude_m", "how high"),
    ],
)
def test_what_is_missing_is_said(absent, match):
    with pytest.raises(DatasetError, match=match) as fault:
        pose_from_photo(replace(PHOTO, **{absent: None}), NRW)
    assert "--" in fault.value.hint


def test_a_coarse_datum_shift_is_reported():
    assert datum_note(NRW) is None
    assert "EPSG:31466" in (datum_note(MapFrame("EPSG:31466")) or "")


class TestCamera:
    def test_dewarp_data_is_the_best(self):
        dewarp = Dewarp("2019", 3666.0, 3660.0, -12.5, 8.5, (-0.26, 0.11, 0.001, -0.002, -0.03))
        found = camera_from_photo(replace(PHOTO, dewarp=dewarp, calibrated_focal_px=3600.0, focal_mm=8.8))
        assert found.source == "dewarp"
        assert (found.camera.fx, found.camera.cx, found.camera.cy) == (3666.0, 2723.5, 1832.5)
        assert found.camera.lens == "FULL_OPENCV"
        assert found.camera.distortion == (-0.26, 0.11, 0.001, -0.002, -0.03, 0, 0, 0)
        straight = camera_from_photo(replace(PHOTO, dewarp=dewarp, is_dewarped=True)).camera
        assert straight.distortion == ()
        assert straight.fx == 3666.0

    def test_pixels_belong_to_the_size_when_taken(self):
        small = replace(
            PHOTO, width=1368, height=912, size_when_taken=(5472, 3648), calibrated_focal_px=3666.0
        )
        assert camera_from_photo(small).camera.fx == pytest.approx(3666.0 / 4)
        turned = replace(PHOTO, width=3648, height=5472, size_when_taken=(5472, 3648), focal_35mm=24.0)
        assert camera_from_photo(turned).camera.height == 5472

    def test_a_photo_cropped_since_is_not_seen_by_the_whole_lens(self):
        cropped = replace(PHOTO, width=1368, height=700, size_when_taken=(5472, 3648), focal_35mm=24.0)
        with pytest.raises(
            DatasetError, match="cropped since it was taken: 5472 x 3648 then, 1368 x 700 now"
        ) as fault:
            camera_from_photo(cropped)
        assert "--camera 'SIMPLE_PINHOLE 1368 700 FOCAL_PX 684 350'" in fault.value.hint

    @pytest.mark.parametrize(
        "numbers",
        [
            {"dewarp": Dewarp("2019", 3666.0, 3660.0, -12.5, 8.5, (-0.26, 0.11, 0.001, -0.002, -0.03))},
            {"calibrated_focal_px": 3666.0},
            {"focal_mm": 8.8, "pixel_mm": (0.0024, 0.0024)},
        ],
    )
    def test_a_program_that_scaled_a_photo_and_changed_its_exif_is_reported(self, numbers):
        whole = replace(PHOTO, focal_35mm=24.0, **numbers)
        assert camera_from_photo(whole).camera.fx == pytest.approx(3666.0, abs=1.0)
        with pytest.raises(DatasetError, match=r"not of 1368 x 912 pixels, .* scaled since") as fault:
            camera_from_photo(replace(whole, width=1368, height=912, size_when_taken=(1368, 912)))
        assert "--camera 'SIMPLE_PINHOLE 1368 912" in fault.value.hint

    def test_a_second_lens_is_not_seen_with_the_first_one_s_sensor(self):
        # Mavic 3 Enterprise: both cameras are called M3E.
        tele = replace(PHOTO, width=4000, height=3000, model="M3E", focal_mm=29.9, focal_35mm=162.0)
        found = camera_from_photo(tele)
        assert (found.source, found.camera.fx) == ("35mm", pytest.approx(162 / 43.2666 * 5000, rel=1e-4))
        wide = replace(tele, width=5280, height=3956, focal_mm=12.29, focal_35mm=24.0)
        assert camera_from_photo(wide).source == "sensor"

    def test_how_well_a_focal_length_is_known_depends_on_where_it_is_from(self):
        """Calibrated: as methods take it. Nominal: a percent; a whole millimetre of 24: 1.2 more."""
        known = [
            replace(PHOTO, calibrated_focal_px=3666.0, focal_35mm=24.0),
            replace(PHOTO, model="FC6310R", focal_mm=8.8),
            replace(PHOTO, focal_35mm=24.0),
            replace(PHOTO, focal_35mm=162.0),
        ]
        percents = [camera_from_photo(photo).lens_percent for photo in known]
        assert percents == [None, 1.0, pytest.approx(1.564, abs=1e-3), pytest.approx(1.016, abs=1e-3)]

    def test_from_millimetres(self):
        table = camera_from_photo(replace(PHOTO, model="FC6310R", focal_mm=8.8))
        assert (table.source, table.camera.fx) == ("sensor", pytest.approx(8.8 / 13.2 * 5472))
        plane = camera_from_photo(replace(PHOTO, focal_mm=8.8, pixel_mm=(0.0024, 0.0025)))
        assert (plane.camera.fx, plane.camera.fy) == (
            pytest.approx(8.8 / 0.0024),
            pytest.approx(8.8 / 0.0025),
        )
        rounded = camera_from_photo(replace(PHOTO, focal_35mm=24.0))
        assert (rounded.source, rounded.camera.fx) == (
            "35mm",
            pytest.approx(24 / 43.2666 * 6576.56, rel=1e-4),
        )
        # A 3:2 sensor has the shape of the 35 mm frame, so widths give the same.
        assert rounded.camera.fx == pytest.approx(24 / 36 * 5472, rel=1e-9)

    @pytest.mark.parametrize(
        ("model", "focal_mm", "size", "whole"),
        [
            ("FC6310", 8.8, (4864, 3648), (5472, 3648)),  # 4:3 and 16:9 of a sensor of 3:2
            ("FC6310", 8.8, (5472, 3078), (5472, 3648)),
            ("FC220", 4.73, (4000, 2250), (4000, 3000)),  # 16:9 and 3:2 of 4:3
            ("L2D-20C", 12.29, (5280, 2970), (5280, 3956)),
            ("FC6310", 8.8, (3648, 4864), (3648, 5472)),
        ],
    )
    def test_a_photo_of_another_shape_than_the_sensor_s_shows_a_part_of_it(
        self, model, focal_mm, size, whole
    ):
        part, all_of_it = (
            camera_from_photo(replace(PHOTO, width=w, height=h, model=model, focal_mm=focal_mm))
            for w, h in (size, whole)
        )
        assert part.source == "sensor"
        assert part.camera.fx == pytest.approx(all_of_it.camera.fx, rel=2e-3)

    @pytest.mark.parametrize("size", [(4000, 2250), (2250, 4000)])
    def test_dji_s_equivalent_is_of_the_whole_sensor_in_wide_photos_too(self, size):
        # Mavic Air 2: 84 degrees across the diagonal of 4000 x 3000 pixels of 1.6 micrometres behind 4.5 mm.
        whole = replace(PHOTO, make="DJI", model="FC3170", width=4000, height=3000, focal_35mm=24.0)
        wide = replace(whole, width=size[0], height=size[1])
        focal = camera_from_photo(whole).camera.fx
        assert focal == pytest.approx(2500 / math.tan(math.radians(42)), rel=2e-3)
        assert camera_from_photo(wide).camera.fx == pytest.approx(focal, rel=1e-9)
        # Others keep to the definition: the diagonal of the photo.
        other = camera_from_photo(replace(wide, make="Sony")).camera.fx
        assert other == pytest.approx(24 / 43.2666 * math.hypot(*size), rel=1e-4)

    def test_a_digital_zoom_multiplies_exifs_focal_length_alone(self):
        zoomed = replace(PHOTO, model="FC6310R", focal_mm=8.8, digital_zoom=2.0)
        assert camera_from_photo(zoomed).camera.fx == pytest.approx(2 * 8.8 / 13.2 * 5472)
        plane = camera_from_photo(replace(zoomed, pixel_mm=(0.0024, 0.0025))).camera
        assert (plane.fx, plane.fy) == (pytest.approx(2 * 8.8 / 0.0024), pytest.approx(2 * 8.8 / 0.0025))
        # The equivalent is that of the photo, and DJI's numbers are of the picture without the zoom.
        assert camera_from_photo(replace(PHOTO, focal_35mm=48.0, digital_zoom=2.0)).camera.fx == (
            pytest.approx(48 / 36 * 5472)
        )
        dewarp = Dewarp("2019", 3666.0, 3660.0, -12.5, 8.5, (-0.26, 0.11, 0.001, -0.002, -0.03))
        known = {"dewarp": dewarp, "calibrated_focal_px": 3600.0, "optical_center_x_px": 2000.0}
        found = camera_from_photo(replace(zoomed, **known))
        assert (found.source, found.camera.cx, found.camera.distortion) == ("sensor", 5472 / 2, ())
        with pytest.raises(DatasetError, match="focal length"):
            camera_from_photo(replace(PHOTO, dewarp=dewarp, digital_zoom=2.0))

    def test_nothing_or_nonsense(self):
        with pytest.raises(DatasetError, match="focal length"):
            camera_from_photo(PHOTO)
        with pytest.raises(DatasetError, match="no photo does"):
            camera_from_photo(replace(PHOTO, calibrated_focal_px=3.0))


@pytest.mark.parametrize(("crs", "unit"), [("EPSG:2263", "US survey foot"), ("EPSG:4326", "degrees")])
def test_a_map_that_does_not_count_in_metres_is_refused(crs, unit):
    with pytest.raises(DatasetError, match=unit):
        MapFrame(crs)
