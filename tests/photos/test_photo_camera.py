"""Cameras of photos: focal lengths as real cameras and programs write them, right and wrong; lenses undone.

Every file is written here. Undistorting: round trips through every lens, OpenCV as the oracle.
"""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.errors import DatasetError
from lodbench.geometry import Camera
from lodbench.geometry.camera import MAKER, UNKNOWN
from lodbench.photos.camera import (
    _ROUNDED_MM,
    _SENSOR_MM,
    NOMINAL_PERCENT,
    camera_from_photo,
    pinhole_of,
    states_focal_length,
    undistorted,
)
from lodbench.photos.metadata import PhotoMetadata, read_photo_metadata
from lodbench.photos.pose import RoughPlace, require_stated
from lodbench.photos.xmp import _PROPERTIES, Dewarp
from tests.geometry.test_camera import MODELS
from tests.photos.dji_photo import PROPERTIES, exif_of, packet_around, write_photo, xmp_packet

GUIDE = Path(__file__).parents[2] / "docs" / "your-own-city.md"
SKYDIO = "https://www.skydio.com/drone-skydio/1.0/"
PIX4D = "http://pix4d.com/camera/1.0/"
INCH, CM, MM = 2, 3, 4


def photo(folder, size, exif: bytes, xmp: bytes | None = None) -> PhotoMetadata:
    pixels = np.zeros((size[1], size[0]), np.uint8)
    return read_photo_metadata(write_photo(folder / "a.jpg", pixels, exif, xmp))


def description(uri: str, body: str, prefix: str = "s") -> bytes:
    return packet_around(f'<rdf:Description rdf:about="" xmlns:{prefix}="{uri}">{body}</rdf:Description>')


def fx_of(stated: PhotoMetadata) -> float:
    return camera_from_photo(stated).camera.fx


def test_the_guide_s_table_has_every_source_and_every_tag():
    """What the code reads, row by row; what the rows say of their use, the tests below hold."""
    _, _, section = GUIDE.read_text().partition("### Where the focal length comes from")
    table = [line for line in section.partition("###")[0].splitlines() if line.startswith("| ")]
    sources = [line.split("|")[1].strip().strip("`") for line in table[1:]]
    read = ["given", "dewarp", "calibrated", "", "", "focal_plane", "sensor", "field_of_view", "35mm"]
    assert sources == read
    text = " ".join(table)
    for properties in _PROPERTIES.values():
        for field in ("calibrated_focal_px", "optical_center_x_px"):
            assert all(name.partition("/")[0] in text for name in properties.get(field, ())[:1])
    assert f"{len(_SENSOR_MM)} of DJI's cameras" in text
    assert f"(24 mm: {math.hypot(NOMINAL_PERCENT, 100 * _ROUNDED_MM / 24):.2f} %)" in text
    (nominal, maker) = (
        f"{known.focal_percent:g} %, {known.center_percent:g} %" for known in (UNKNOWN, MAKER)
    )
    assert maker in table[2]
    assert nominal in table[6]


class TestFocalPlane:
    @pytest.mark.parametrize("unit", [MM, INCH, CM, None])
    def test_a_thermal_camera_s_own_size_where_the_resolution_belongs(self, tmp_path, unit):
        tags = exif_of(make="FLIR", model="Vue", focal_mm=9.0, focal_35mm=None, plane=(10.88, 8.704, unit))
        found = camera_from_photo(photo(tmp_path, (640, 512), tags))
        assert (found.camera.fx, found.camera.fy) == (pytest.approx(9.0 / 0.017), pytest.approx(9.0 / 0.017))
        assert found.source == "focal_plane"

    def test_a_size_that_is_of_no_known_pixel_is_refused(self, tmp_path):
        tags = exif_of(make="DJI", model="XT2", focal_mm=19.0, focal_35mm=None, plane=(3.84, 3.072, MM))
        stated = photo(tmp_path, (640, 512), tags)
        assert not states_focal_length(stated)
        with pytest.raises(DatasetError, match=r"focal plane resolution .* of a sensor of 167 x 167 mm"):
            camera_from_photo(stated)
        with pytest.raises(DatasetError, match=r"its camera's focal length \(its focal plane resolution"):
            require_stated(stated, given=RoughPlace(51.0, 5.0, 100.0, 0.0, -60.0), knows_camera=False)

    def test_photos_as_they_were_and_scaled_by_a_program(self, tmp_path):
        tags = {"make": "Canon", "model": "S100", "focal_mm": 5.2, "focal_35mm": None}
        per_inch = 1600 / 7.6 * 25.4
        whole = exif_of(**tags, size=(1600, 1200), plane=(per_inch, per_inch, INCH))
        assert fx_of(photo(tmp_path, (1600, 1200), whole)) == pytest.approx(5.2 / 7.6 * 1600, rel=1e-5)
        # EXIF says how large it was.
        assert fx_of(photo(tmp_path, (400, 300), whole)) == pytest.approx(5.2 / 7.6 * 400, rel=1e-5)
        scaled = exif_of(**tags, size=(400, 300), plane=(per_inch, per_inch, INCH))
        with pytest.raises(DatasetError, match=r"of a sensor of 1\.9 x 1\.43 mm"):
            camera_from_photo(photo(tmp_path, (400, 300), scaled))

    @pytest.mark.parametrize("dpi", [72.0, 96.0, 300.0])
    def test_a_display_s_resolution_is_passed_over(self, tmp_path, dpi):
        tags = exif_of(make="Skydio", model="2", focal_mm=4.7, focal_35mm=21, plane=(dpi, dpi, INCH))
        found = camera_from_photo(photo(tmp_path, (1014, 760), tags))
        assert found.camera.fx == pytest.approx(21 / math.hypot(36, 24) * math.hypot(1014, 760))
        assert found.source == "35mm"

    def test_pixels_are_square_and_sensors_are_as_published(self, tmp_path):
        tags = {"make": "A", "model": "B", "focal_mm": 8.8, "focal_35mm": 24}
        oblong = exif_of(**tags, plane=(64 / 13.2, 48 / 13.2, MM))
        assert camera_from_photo(photo(tmp_path, (64, 48), oblong)).source == "35mm"
        # Half of the sensor that the model is known to have: scaled by 2, size and all.
        stale = exif_of(model="FC6310R", focal_35mm=None, size=(60, 40), plane=(60 / 6.6, 60 / 6.6, MM))
        found = camera_from_photo(photo(tmp_path, (60, 40), stale))
        assert (found.source, found.camera.fx) == ("sensor", pytest.approx(8.8 / 13.2 * 60))


class TestZoom:
    def zoomed(self, size, focal_mm, equivalent, zoom, make="DJI") -> PhotoMetadata:
        return PhotoMetadata(
            "a.jpg", *size, make, focal_mm=focal_mm, focal_35mm=equivalent, digital_zoom=zoom
        )

    def by_equivalent(self, size, equivalent: float) -> float:
        return equivalent / math.hypot(36, 24) * math.hypot(*size)

    @pytest.mark.parametrize(
        ("size", "focal_mm", "equivalent", "zoom", "factor"),
        [
            # Thermal cameras of 12 um: the equivalent leaves the zoom out, also enlarged; and holds it.
            ((640, 512), 44.5, 196.0, 1.19, 1.19),
            ((640, 512), 12.0, 52.0, 2.0, 2.0),
            ((1280, 1024), 9.1, 40.0, 1.5, 1.5),
            ((640, 512), 13.5, 116.0, 2.0, 1.0),
            # 1/1.3 inch, 6.72 mm, 24 mm.
            ((4032, 3024), 6.72, 24.0, 2.0, 2.0),
            ((4032, 3024), 6.72, 48.0, 2.0, 1.0),
            ((4000, 3000), 4.5, 48.0, 2.0, 1.0),
        ],
    )
    def test_where_the_sensor_tells_the_equivalent_is_with_the_zoom_or_without(
        self, size, focal_mm, equivalent, zoom, factor
    ):
        found = camera_from_photo(self.zoomed(size, focal_mm, equivalent, zoom))
        assert found.camera.fx == pytest.approx(factor * self.by_equivalent(size, equivalent))
        assert found.lens_percent < 2.0

    @pytest.mark.parametrize(("focal_mm", "equivalent", "zoom"), [(None, 48.0, 2.0), (5.0, 70.0, 1.3)])
    def test_where_nothing_tells_the_doubt_holds_both(self, focal_mm, equivalent, zoom):
        size = (4000, 3000)
        found = camera_from_photo(self.zoomed(size, focal_mm, equivalent, zoom))
        without = self.by_equivalent(size, equivalent)
        for reading in (without, zoom * without):
            assert abs(reading / found.camera.fx - 1) <= found.lens_percent / 100
        assert found.camera_sigmas.focal_percent == pytest.approx(found.lens_percent, abs=0.01)

    def test_others_equivalents_hold_the_zoom(self):
        found = camera_from_photo(self.zoomed((4000, 3000), 6.72, 24.0, 2.0, "Autel Robotics"))
        assert found.camera.fx == pytest.approx(self.by_equivalent((4000, 3000), 24.0))

    def test_a_drone_s_second_lens_is_not_behind_the_sensor_of_its_first(self):
        tele = replace(self.zoomed((4000, 3000), 29.9, 162.0, 2.0), model="M3E")
        assert camera_from_photo(tele).source == "35mm"


# Of Skydio's sensor of 4:3, as its photos of any shape state it.
WHOLE = {"calibrated_focal_px": 2380.0, "optical_center_x_px": 2029.0, "optical_center_y_px": 1520.3}


class TestCalibration:
    @pytest.mark.parametrize("form", ["resource", "attributes"])
    def test_skydio_s_structures(self, tmp_path, form):
        fields = {"CalibratedFocalLength": (1020.5, 1019.0), "CalibratedOpticalCenter": (322.4, 254.1)}
        body = "".join(
            f'<s:{name} s:X="{x}" s:Y="{y}"/>'
            if form == "attributes"
            else f'<s:{name} rdf:parseType="Resource"><s:X>{x}</s:X><s:Y>{y}</s:Y></s:{name}>'
            for name, (x, y) in fields.items()
        )
        tags = exif_of(make="Skydio", model="X2", focal_mm=None, focal_35mm=None)
        found = camera_from_photo(photo(tmp_path, (640, 512), tags, description(SKYDIO, body)))
        camera = found.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (1020.5, 1019.0, 322.4, 254.1)
        assert (found.source, found.camera_sigmas.focal_percent) == ("calibrated", 0.5)

    def test_an_optical_centre_of_the_whole_sensor(self):
        """Photos of 16:9 are cut out of it, above and below."""
        stated = PhotoMetadata("a.jpg", 4056, 2282, "Skydio", **WHOLE)
        camera = camera_from_photo(stated).camera
        assert (camera.fx, camera.cx) == (2380.0, 2029.0)
        assert camera.cy == pytest.approx(1141.3, abs=1.5)
        # Of 4:3 out of 3:2, left and right.
        wide = {"calibrated_focal_px": 3666.0, "optical_center_x_px": 2736.0, "optical_center_y_px": 1824.0}
        camera = camera_from_photo(PhotoMetadata("a.jpg", 4864, 3648, "DJI", **wide)).camera
        assert (camera.fx, camera.cx, camera.cy) == (3666.0, 2432.0, 1824.0)

    @pytest.mark.parametrize("scale", [0.25, 0.5, 0.7, 2.0])
    @pytest.mark.parametrize("shape", [(4056, 3040), (4056, 2282)])
    def test_the_optical_centre_gives_a_scaled_photo_away(self, scale, shape):
        width, height = (round(scale * side) for side in shape)
        found = camera_from_photo(PhotoMetadata("a.jpg", width, height, "Skydio", **WHOLE))
        assert found.camera.fx == pytest.approx(2380.0 * scale, rel=0.003)
        assert found.camera.cx == pytest.approx(width / 2, rel=0.01)
        assert found.camera.cy == pytest.approx(height / 2, rel=0.01)
        assert found.lens_percent == 1.0

    def test_and_of_dji_s_calibration_of_its_lens(self):
        dewarp = Dewarp("2019", 3666.0, 3660.0, -12.0, 8.0, (-0.26, 0.11, 0.001, -0.002, -0.03))
        center = {"optical_center_x_px": 2736.0, "optical_center_y_px": 1824.0}
        camera = camera_from_photo(PhotoMetadata("a.jpg", 1368, 912, "DJI", dewarp=dewarp, **center)).camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (916.5, 915.0, 681.0, 458.0)
        # Without it the sensor of the model does.
        plain = PhotoMetadata("a.jpg", 1368, 912, "DJI", "FC6310R", focal_mm=8.8, dewarp=dewarp)
        found = camera_from_photo(plain)
        assert (found.source, found.camera.fx) == ("sensor", pytest.approx(912.0))

    def test_a_photo_that_was_turned_has_its_centre_in_the_middle(self):
        turned = PhotoMetadata("a.jpg", 3040, 4056, "Skydio", **WHOLE)
        camera = camera_from_photo(turned).camera
        assert (camera.fx, camera.cx, camera.cy) == (2380.0, 1520.0, 2028.0)

    def test_a_centre_of_no_such_picture_is_not_believed(self):
        stated = PhotoMetadata("a.jpg", 4056, 3040, "Skydio", **{**WHOLE, "optical_center_y_px": 300.0})
        with pytest.raises(DatasetError, match=r"optical centre 2029, 300, which is of no picture"):
            camera_from_photo(stated)
        assert camera_from_photo(replace(stated, focal_35mm=24.0)).source == "35mm"

    def test_a_calibration_whose_centre_is_outside_is_called_so(self):
        dewarp = Dewarp("2019", 3666.0, 3660.0, 5000.0, 8.0, (0.0,) * 5)
        with pytest.raises(DatasetError, match=r"DewarpData\) has the optical centre 7736, 1832, outside of"):
            camera_from_photo(PhotoMetadata("a.jpg", 5472, 3648, "DJI", dewarp=dewarp))


class TestXmp:
    def test_fields_of_view(self, tmp_path):
        tags = exif_of(make="Other", model="", focal_mm=None, focal_35mm=None)
        body = "<s:PictureHFOV>60.0</s:PictureHFOV><s:PictureVFOV>46.826</s:PictureVFOV>"
        found = camera_from_photo(photo(tmp_path, (640, 480), tags, description("http://any/", body)))
        assert found.source == "field_of_view"
        assert found.camera.fx == pytest.approx(320 / math.tan(math.radians(30)))
        assert found.camera.fy == pytest.approx(found.camera.fx, rel=1e-3)
        assert found.camera_sigmas.focal_percent == 1.5
        words = body.replace("60.0", "60.0 deg")
        assert (
            camera_from_photo(photo(tmp_path, (640, 480), tags, description("http://any/", words))) == found
        )
        wrong = body.replace("46.8", "80.8")
        with pytest.raises(DatasetError, match="focal length"):
            camera_from_photo(photo(tmp_path, (640, 480), tags, description("http://any/", wrong)))

    def test_fractions(self, tmp_path):
        tags = exif_of(make="M", model="", focal_mm=None, focal_35mm=None, plane=(640 / 4.8, 640 / 4.8, MM))
        body = "<s:PerspectiveFocalLength>542/100</s:PerspectiveFocalLength>"
        body += "<s:PerspectiveFocalLengthUnits>mm</s:PerspectiveFocalLengthUnits>"
        stated = photo(tmp_path, (640, 480), tags, description(PIX4D, body))
        assert fx_of(stated) == pytest.approx(5.42 / 4.8 * 640)
        in_pixels = body.replace(">mm<", ">pixels<").replace("542/100", "1445/2")
        assert fx_of(photo(tmp_path, (640, 480), tags, description(PIX4D, in_pixels))) == 722.5

    @pytest.mark.parametrize("name", ["FocalLengthIn35mmFilm", "FocalLength"])
    def test_exif_that_only_xmp_repeats(self, tmp_path, name):
        exif = {
            "GPSLatitude": "48,8.3580N", "GPSLongitude": "0,11,34W", "GPSAltitude": "6001/10",
            "GPSAltitudeRef": "0", name: "88/10" if name == "FocalLength" else "24",
        }  # fmt: skip
        body = "".join(f"<e:{key}>{value}</e:{key}>" for key, value in exif.items())
        packet = packet_around(
            '<rdf:Description rdf:about="" xmlns:e="http://ns.adobe.com/exif/1.0/" '
            f'xmlns:t="http://ns.adobe.com/tiff/1.0/" t:Make="DJI" t:Model="FC6310R">{body}</rdf:Description>'
        )
        stated = photo(tmp_path, (60, 40), b"", packet)
        assert (stated.latitude_deg, stated.longitude_deg) == (
            pytest.approx(48.1393),
            pytest.approx(-(11 / 60 + 34 / 3600)),
        )
        assert (stated.altitude_m, stated.model) == (600.1, "FC6310R")
        decimal = photo(tmp_path, (60, 40), b"", packet.replace(b"0,11,34W", b"-0.1927778"))
        assert (decimal.longitude_deg, decimal.latitude_deg) == (-0.1927778, pytest.approx(48.1393))
        assert camera_from_photo(stated).source == ("sensor" if name == "FocalLength" else "35mm")
        # EXIF goes first.
        tags = exif_of(51.0, 5.0, 100.0, focal_35mm=35, model="X", focal_mm=None)
        both = photo(tmp_path, (60, 40), tags, packet)
        assert (both.latitude_deg, both.altitude_m, both.model) == (pytest.approx(51.0), 100.0, "X")

    @pytest.mark.parametrize("projection", ["equirectangular", "cylindrical", None])
    def test_a_panorama_is_no_photo_of_a_pinhole(self, tmp_path, projection):
        uri = "http://ns.google.com/photos/1.0/panorama/"
        stated = "" if projection is None else f"<s:ProjectionType>{projection}</s:ProjectionType>"
        body = f"{stated}<s:FullPanoWidthPixels>80</s:FullPanoWidthPixels>"
        packet = xmp_packet(PROPERTIES).replace(
            b"</rdf:RDF>", f'<rdf:Description xmlns:s="{uri}">{body}</rdf:Description></rdf:RDF>'.encode()
        )
        sphere = photo(tmp_path, (80, 40), exif_of(), packet)
        for use in (camera_from_photo, require_stated):
            with pytest.raises(DatasetError, match=rf"a\.jpg is a panorama \({projection or 'equirect'}"):
                use(sphere)
        assert (
            read_photo_metadata(write_photo(tmp_path / "b.jpg", xmp=xmp_packet(PROPERTIES))).projection == ""
        )

    @pytest.mark.parametrize("before", [b"xml:XMP=", b"\0\0XMP\0", b"junk < junk "])
    @pytest.mark.parametrize("after", [b"", b"\0\0\0", b" trailing"])
    def test_a_packet_among_other_bytes(self, tmp_path, before, after):
        packet = before + xmp_packet(PROPERTIES) + after
        stated = read_photo_metadata(write_photo(tmp_path / "a.jpg", xmp=packet))
        assert (stated.xmp_fault, stated.gimbal_yaw_deg) == ("", -43.6)

    def test_a_prefix_that_nothing_declares(self, tmp_path):
        packet = xmp_packet(PROPERTIES).replace(b' xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"', b"")
        stated = read_photo_metadata(write_photo(tmp_path / "a.jpg", xmp=packet))
        assert (stated.xmp_fault, stated.gimbal_pitch_deg) == ("", -45.3)


LENSES = [name for name in MODELS if "PINHOLE" not in name]
DJI = Camera(
    1368, 912, 916.5, 915.0, 680.9, 458.1, (-0.2651, 0.1123, 0.0002, -0.0004, -0.0331, 0, 0, 0), "FULL_OPENCV"
)


def scene_picture(camera: Camera) -> np.ndarray:
    """Returns a smooth pattern on the plane z = 1 as a camera of any lens sees it, by inverting the lens.

    Independent of the code under test: rays come from a dense table of projected points.
    """
    x, y = np.meshgrid(np.linspace(-2, 2, 121), np.linspace(-2, 2, 121))
    points = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    pixels = camera.project(points)
    from scipy.interpolate import CloughTocher2DInterpolator

    near = (
        np.isfinite(pixels).all(axis=1)
        & (
            np.abs(pixels - [camera.width / 2, camera.height / 2]) < [camera.width * 0.6, camera.height * 0.6]
        ).all(1)
        & (np.hypot(*points[:, :2].T) < 1.6)
    )
    inverse = CloughTocher2DInterpolator(pixels[near], points[near, :2])
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = inverse(np.stack([u.ravel(), v.ravel()], axis=1))
    return pattern(rays).reshape(camera.height, camera.width)


def pattern(rays: np.ndarray) -> np.ndarray:
    return (0.5 + 0.25 * np.sin(9 * rays[:, 0]) + 0.25 * np.cos(7 * rays[:, 1] + 2)).astype(np.float32)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE", "FOV", "THIN_PRISM_FISHEYE", "DIVISION"])
def test_a_distorted_picture_becomes_the_pinhole_s(model):
    camera = Camera.from_colmap(model, 640, 512, MODELS[model]).scaled(160, 128)
    pinhole = pinhole_of(camera)
    found = undistorted(scene_picture(camera), camera, pinhole)
    u, v = np.meshgrid(np.arange(160) + 0.5, np.arange(128) + 0.5)
    rays = np.stack([(u - pinhole.cx).ravel() / pinhole.fx, (v - pinhole.cy).ravel() / pinhole.fy], axis=1)
    expected = pattern(rays).reshape(128, 160)
    # Linear interpolation of this pattern is good to a few thousandths; the rim is repeated.
    assert np.nanmax(np.abs(found - expected)[2:-2, 2:-2]) < 0.006


@pytest.mark.parametrize("model", LENSES)
def test_every_pixel_of_the_pinhole_is_in_the_photo(model):
    camera = Camera.from_colmap(model, 640, 512, MODELS[model])
    pinhole = pinhole_of(camera)
    assert pinhole.distortion == ()
    assert (pinhole.width, pinhole.height, pinhole.cx, pinhole.cy) == (640, 512, camera.cx, camera.cy)
    assert pinhole.fx / pinhole.fy == pytest.approx(camera.fx / camera.fy)
    u, v = np.meshgrid(np.arange(640) + 0.5, np.arange(512) + 0.5)
    rays = np.stack([(u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy, np.ones_like(u)], axis=2)
    pixels = camera.project(rays.reshape(-1, 3))
    assert pixels.min() >= -1e-6
    assert (pixels <= [640 + 1e-6, 512 + 1e-6]).all()
    # And a wider one would not do, unless the limit was met.
    edge = np.abs(pixels - [[0, 0]]).min(0).min(), np.abs(pixels - [[640, 512]]).min()
    assert min(edge) < 1.0 or pinhole.fx == pytest.approx(0.6 * camera.fx)


def test_dji_s_calibration_as_opencv_undoes_it():
    picture = np.random.default_rng(0).integers(0, 256, (912, 1368, 3), dtype=np.uint8)
    picture = cv2.GaussianBlur(picture, (0, 0), 5)
    pinhole = pinhole_of(DJI)
    # OpenCV counts pixels from their centres: both principal points lie half a pixel less.
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    maps = cv2.initUndistortRectifyMap(
        DJI.matrix - half, np.array(DJI.distortion), None, pinhole.matrix - half, (1368, 912), cv2.CV_32FC1
    )
    expected = cv2.remap(picture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    found = undistorted(picture, DJI, pinhole)
    assert np.abs(found.astype(int) - expected).max() <= 1
    assert found.dtype == np.uint8


def test_a_mask_of_another_size_is_undistorted_alike():
    pinhole = pinhole_of(DJI)
    mask = np.zeros((912, 1368), np.float32)
    cv2.circle(mask, (1150, 700), 120, 1.0, -1)
    whole = undistorted(mask, DJI, pinhole)
    half = undistorted(cv2.resize(mask, (684, 456), interpolation=cv2.INTER_AREA), DJI, pinhole)
    shrunk = cv2.resize(whole, (684, 456), interpolation=cv2.INTER_AREA)
    assert np.abs(half - shrunk).mean() < 0.002
    assert ((half >= 0.5) != (shrunk >= 0.5)).sum() < 40


def test_a_pinhole_comes_back_as_it_is():
    camera = DJI.without_distortion()
    assert pinhole_of(camera) is camera


def test_parameters_of_no_lens_are_refused():
    with pytest.raises(DatasetError, match="cannot be undone"):
        pinhole_of(Camera(640, 480, 500.0, 500.0, 320.0, 240.0, (-90.0, 0.0, 0.0, 0.0)))
