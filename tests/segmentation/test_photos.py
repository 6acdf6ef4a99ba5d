"""Any image file becomes 8 bit RGB, at any size; the network's size follows the photo's aspect."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from lodbench.errors import QueryFault
from lodbench.photos.metadata import read_photo_metadata
from lodbench.photos.pictures import picture_size, read_picture
from lodbench.segmentation.masks import as_rgb, read_photo
from lodbench.segmentation.probability import padded_photo, resized_photo, working_size


def written(path, image):
    assert cv2.imwrite(str(path), image)
    return path


def test_colours_come_in_rgb(tmp_path):
    blue = np.zeros((4, 6, 3), np.uint8)
    blue[..., 0] = 200
    assert read_photo(written(tmp_path / "blue.png", blue))[0, 0].tolist() == [0, 0, 200]


def test_grey_and_16_bits_fill_three_channels(tmp_path):
    grey = np.array([[1000, 3000], [2000, 1000]], np.uint16)
    photo = read_photo(written(tmp_path / "thermal.png", grey))
    assert photo.shape == (2, 2, 3)
    assert photo[..., 0].tolist() == [[0, 255], [128, 0]]
    assert (photo == photo[..., :1]).all()


def test_degrees_of_a_radiometric_photo_fill_the_range(tmp_path, capfd):
    degrees = np.array([[20.5, np.nan], [21.0, 21.5]], np.float32)
    Image.fromarray(degrees).save(tmp_path / "thermal.tif")
    assert read_photo(tmp_path / "thermal.tif")[..., 0].tolist() == [[0, 0], [128, 255]]
    assert read_picture(tmp_path / "thermal.tif")[..., 2].tolist() == [[0, 0], [128, 255]]
    # Four such channels are no photo, for any reader.
    assert cv2.imwrite(str(tmp_path / "four.tif"), np.ones((4, 4, 4), np.float32))
    assert read_picture(tmp_path / "four.tif") is None
    (tmp_path / "cut.tif").write_bytes((tmp_path / "thermal.tif").read_bytes()[:-8])
    assert read_picture(tmp_path / "cut.tif") is None
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("kind", "scale", "strays"),
    [(np.uint16, 1, (0, 65535)), (np.float32, 0.04, (-9999, 3e4)), (np.float32, 0.04, (-3.4e38, 900.0))],
)
def test_dead_pixels_and_those_without_a_number_leave_the_rest_its_contrast(tmp_path, kind, scale, strays):
    whole = (np.linspace(7000, 7600, 80 * 60).reshape(60, 80) * scale).astype(kind)
    photo = read_photo(written(tmp_path / "whole.tif", whole)).astype(int)
    assert (photo.min(), photo.max()) == (0, 255)
    whole[20, 30], whole[40, 50] = strays
    damaged = read_photo(written(tmp_path / "damaged.tif", whole)).astype(int)
    assert damaged[20, 30, 0] == 0
    assert damaged[40, 50, 0] == 255
    inner = np.delete(np.arange(60), (20, 40))
    assert np.ptp(damaged[inner]) >= 50


def test_a_border_without_numbers_is_black(tmp_path):
    degrees = np.tile(np.linspace(12.0, 30.0, 80, dtype=np.float32), (60, 1))
    bordered = np.pad(degrees, 10, constant_values=-9999)
    found = read_photo(written(tmp_path / "bordered.tif", bordered))
    assert (found[10:-10, 10:-10] == read_photo(written(tmp_path / "inside.tif", degrees))).all()
    assert not found[:10].any()


def jpeg(picture: np.ndarray, mode: str, **how: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(picture).convert(mode).save(stream, "JPEG", **how)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("mode", "how"),
    [
        ("RGB", {}),
        ("RGB", {"subsampling": 0, "quality": 98}),
        ("RGB", {"progressive": True, "subsampling": 1}),
        ("RGB", {"restart_marker_rows": 1}),
        ("L", {}),
        ("CMYK", {}),
    ],
)
def test_jpegs_have_the_pixels_that_opencv_decodes(tmp_path, mode, how):
    picture = cv2.resize(np.random.default_rng(0).integers(0, 256, (15, 20, 3), np.uint8), (157, 119))
    content = jpeg(picture, mode, **how)
    (tmp_path / "a.jpg").write_bytes(content)
    coded = np.frombuffer(content, np.uint8)
    assert (read_picture(tmp_path / "a.jpg") == cv2.imdecode(coded, cv2.IMREAD_COLOR)).all()
    stored = read_picture(tmp_path / "a.jpg", as_stored=True)
    expected = cv2.imdecode(coded, cv2.IMREAD_UNCHANGED)
    assert stored.shape == expected.shape
    assert (stored == expected).all()


@pytest.mark.attack
def test_a_damaged_jpeg_is_read_as_by_opencv_or_refused_and_nothing_reaches_the_terminal(tmp_path, capfd):
    random = np.random.default_rng(0)
    picture = cv2.resize(random.integers(0, 256, (15, 20, 3), np.uint8), (160, 120))
    whole, read, said = jpeg(picture, "RGB"), 0, 0
    for _ in range(200):
        content = bytearray(whole)
        for at in random.integers(20, len(whole), 3):
            content[at] = random.integers(256)
        (tmp_path / "a.jpg").write_bytes(content)
        found = read_picture(tmp_path / "a.jpg")
        assert capfd.readouterr().err == ""
        other = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        said += "JPEG" in capfd.readouterr().err
        if found is not None:
            read += 1
            assert (found == other).all()
    assert read > 100
    # What OpenCV would have said, so that this tests something.
    assert said > 50
    (tmp_path / "a.jpg").write_bytes(whole[: len(whole) // 2])
    assert read_picture(tmp_path / "a.jpg") is None


def test_transparent_pixels_are_black(tmp_path):
    image = np.full((2, 2, 4), 255, np.uint8)
    image[0, 0, 3] = 0
    photo = read_photo(written(tmp_path / "alpha.png", image))
    assert photo[0, 0].tolist() == [0, 0, 0]
    assert photo[1, 1].tolist() == [255, 255, 255]


def test_alpha_of_16_bits_is_no_brightness(tmp_path):
    image = np.full((2, 2, 4), 1000, np.uint16)
    image[0, 0, :3] = 3000
    image[..., 3] = 65535
    photo = read_photo(written(tmp_path / "alpha16.png", image))
    assert photo[..., 0].tolist() == [[255, 0], [0, 0]]


def test_inks_become_light(tmp_path):
    # Cyan, magenta, yellow, black: full cyan is no red.
    inks = np.zeros((16, 16, 4), np.uint8)
    inks[..., 0] = 255
    Image.fromarray(inks, mode="CMYK").save(tmp_path / "inks.jpg", quality=95)
    red, green, blue = read_photo(tmp_path / "inks.jpg")[8, 8].tolist()
    assert red < 40
    assert min(green, blue) > 215


@pytest.mark.parametrize("ending", ["jpg", "tif", "png"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_turn_by_exif_is_not_made(tmp_path, orientation, ending):
    image = Image.fromarray(np.tile(np.arange(0, 240, 10, dtype=np.uint8), (16, 1)))
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / f"turned.{ending}"
    image.save(path, exif=exif, quality=100)
    photo, stated = read_photo(path), read_photo_metadata(path)
    assert photo.shape == (16, 24, 3)
    assert int(photo[8, 20, 0]) > int(photo[8, 2, 0]) + 100
    assert picture_size(path) == (stated.width, stated.height) == (24, 16)
    assert stated.orientation == orientation


@pytest.mark.parametrize("kind", ["u1", "<u2", ">u2"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_tiff_s_pixels_are_as_stored(tmp_path, orientation, kind):
    pixels = np.random.default_rng(0).integers(0, 255, (16, 24)).astype(kind)
    Image.fromarray(pixels).save(tmp_path / "a.tif", tiffinfo={0x0112: orientation})
    assert (tmp_path / "a.tif").read_bytes()[:2] == (b"MM" if kind == ">u2" else b"II")
    assert np.array_equal(read_picture(tmp_path / "a.tif", as_stored=True), pixels)


@pytest.mark.parametrize("kind", ["<u1", "<u2", ">u2"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_bigtiff_s_pixels_are_as_stored(tmp_path, orientation, kind):
    pixels = np.random.default_rng(0).integers(0, 255, (16, 24)).astype(kind)
    order, bits = kind[0], 8 * pixels.itemsize
    values = {256: 24, 257: 16, 258: bits, 259: 1, 262: 1, 273: 16, 274: orientation, 277: 1, 278: 16}
    values[279] = pixels.nbytes
    entries = b"".join(struct.pack(f"{order}HHQH6x", tag, 3, 1, value) for tag, value in values.items())
    header = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}HHHQ", 43, 8, 0, 16 + pixels.nbytes)
    directory = struct.pack(f"{order}Q", len(values)) + entries + bytes(8)
    (tmp_path / "a.tif").write_bytes(header + pixels.tobytes() + directory)
    assert np.array_equal(read_picture(tmp_path / "a.tif", as_stored=True), pixels)
    if order == "<":  # Pillow takes the others for no picture
        stated = read_photo_metadata(tmp_path / "a.tif")
        assert (stated.width, stated.height, stated.orientation) == (24, 16, orientation)


def test_nothing_but_our_own_line_reaches_the_terminal(tmp_path, capfd):
    pixels = np.random.default_rng(0).integers(0, 255, (64, 96, 3)).astype(np.uint8)
    whole = tmp_path / "profile.png"
    Image.fromarray(pixels).save(whole, icc_profile=b"none" * 50)
    assert np.array_equal(read_picture(whole), pixels[..., ::-1])
    content = whole.read_bytes()
    middle = content[: len(content) // 2]
    for name, damaged in (("cut.png", middle), ("crc.png", middle + b"\0" + content[len(middle) + 1 :])):
        (tmp_path / name).write_bytes(damaged)
        assert read_picture(tmp_path / name) is None
    # A damaged comment is none of the pixels.
    (tmp_path / "text.png").write_bytes(content.replace(b"none", b"nine", 1))
    assert np.array_equal(read_picture(tmp_path / "text.png"), pixels[..., ::-1])
    assert capfd.readouterr() == ("", "")


def test_a_photo_too_large_to_decode_is_refused(tmp_path):
    whole = written(tmp_path / "bomb.png", np.zeros((2, 2), np.uint8)).read_bytes()
    header = b"IHDR" + struct.pack(">II", 1_000_000, 1_000_000) + whole[24:29]
    (tmp_path / "bomb.png").write_bytes(
        whole[:12] + header + struct.pack(">I", zlib.crc32(header)) + whole[33:]
    )
    with pytest.raises(QueryFault, match=r"bomb\.png has too many pixels"):
        read_photo(tmp_path / "bomb.png")


def test_one_pixel_is_a_photo(tmp_path):
    photo = read_photo(written(tmp_path / "line.png", np.full((300, 1), 7, np.uint8)))
    assert photo.shape == (300, 1, 3)
    assert working_size(1, 300, 512) == (2, 512)
    assert padded_photo(resized_photo(photo, 2, 512), 32).shape == (512, 32, 3)


def test_a_constant_16_bit_picture_is_no_division_by_zero():
    assert as_rgb(np.full((3, 3), 500, np.uint16)).max() == 0


@pytest.mark.parametrize("content", [b"", b"no image", b"\x89PNG\r\n\x1a\n"])
def test_what_is_no_image_is_a_fault_of_its_query(tmp_path, content):
    path = tmp_path / "broken.png"
    path.write_bytes(content)
    with pytest.raises(QueryFault, match=r"broken\.png"):
        read_photo(path)
    with pytest.raises(QueryFault, match="cannot be read"):
        read_photo(tmp_path / "missing.png")


def test_the_long_side_is_the_working_size():
    assert working_size(5280, 3956, 512) == (512, 384)
    assert working_size(300, 400, 512) == (384, 512)


def test_padding_repeats_the_edge():
    photo = np.arange(30, dtype=np.uint8).reshape(2, 5, 3)
    padded = padded_photo(photo, 4)
    assert padded.shape == (4, 8, 3)
    assert (padded[:2, :5] == photo).all()
    assert (padded[3, 7] == photo[1, 4]).all()
