"""A photo of a real city at a known pose, with mask and metadata as a drone's; what localize says of it."""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from lodbench.citymodel import open_scene
from lodbench.cli.localize import main
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.photos.map_frame import MapFrame
from lodbench.rendering import make_renderer
from tests.photos.dji_photo import exif_of, write_photo, xmp_packet

WIDTH, HEIGHT = 684, 456
DISTORTION = (-0.2651, 0.1123, 0.0002, -0.0004, -0.0331)
PINHOLE = Camera(WIDTH, HEIGHT, 460.0, 459.0, 340.0, 230.0)
# Real files and a view of each: where to look, how high above the lowest roof, angles.
CITIES = {
    "nrw": ("germany_lod2/LoD2_32_280_5657_1_NW.gml", "EPSG:25832+7837", 110.0, (32.0, 0.6, 40.0)),
    "plateau": ("plateau/53395404_bldg_6697_op.gml", "EPSG:6677+6695", 130.0, (28.0, -0.5, -70.0)),
    "3dbag": ("3dbag/3dbag_v210908_fd2cee53_5907_subset.json", "EPSG:7415", 120.0, (35.0, 0.4, 160.0)),
}

_PLANE = {"EPSG:7415": "EPSG:28992"}


@dataclass
class Case:
    """A photo, its mask, and the truth behind them."""

    photo: Path
    mask: Path
    city: Path
    truth: Pose
    frame: MapFrame


def lens_of_pixels() -> tuple[np.ndarray, np.ndarray]:
    """Returns the pinhole's pixels that the lens's pixels show: Brown's formula undone by iteration."""
    k1, k2, p1, p2, k3 = DISTORTION
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    seen_x, seen_y = (u - PINHOLE.cx) / PINHOLE.fx, (v - PINHOLE.cy) / PINHOLE.fy
    x, y = seen_x, seen_y
    for _ in range(60):
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x, y = (
            (seen_x - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial,
            (seen_y - 2 * p2 * x * y - p1 * (r2 + 2 * y * y)) / radial,
        )
    return x, y


@cache
def view_of(city: Path, name: str, distorted: bool) -> tuple[Pose, np.ndarray]:
    """Returns the true pose of a city's photo in the city's coordinates, and the mask that its lens makes."""
    scene = open_scene(city)
    _, crs, above_m, angles = CITIES[name]
    assert scene.crs == crs
    middle = np.median(scene.vertices.astype(float), axis=0)
    pitch, _, yaw = angles
    back = np.tan(np.radians(pitch)) * above_m
    center = middle + np.array([np.sin(np.radians(yaw)) * back, -np.cos(np.radians(yaw)) * back, above_m])
    local = Pose.from_euler(EulerAngles(*angles), center)
    # Wider than the photo, so that the lens's corners have something to show.
    wide = Camera(3 * WIDTH, 3 * HEIGHT, 2 * 460.0, 2 * 459.0, 1.5 * WIDTH, 1.5 * HEIGHT)
    mask = make_renderer("silhouette", scene).render(wide, local).astype(np.uint8) * 255
    if distorted:
        x, y = lens_of_pixels()
    else:
        u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
        x, y = (u - PINHOLE.cx) / PINHOLE.fx, (v - PINHOLE.cy) / PINHOLE.fy
    at = [(wide.fx * x + wide.cx - 0.5).astype(np.float32), (wide.fy * y + wide.cy - 0.5).astype(np.float32)]
    return local.shifted(scene.origin), cv2.remap(mask, *at, cv2.INTER_LINEAR)


def make_case(
    folder: Path, shared_data: Path, name: str, *, distorted: bool = False, tilt_deg: float = 0.0
) -> Case:
    """Writes a photo over a real city, its metadata off by what GPS, a barometer and a compass are."""
    file, crs, *_ = CITIES[name]
    truth, mask = view_of(shared_data / "city" / file, name, distorted)
    folder.mkdir(exist_ok=True)
    cv2.imwrite(str(folder / "mask.png"), mask)
    photo = write_photo(
        folder / "DJI_0001.JPG",
        (90 + mask // 3).astype(np.uint8),
        exif_of(model="FC6310R"),
        xmp_packet(stated(truth, crs, distorted, tilt_deg)),
    )
    return Case(photo, folder / "mask.png", shared_data / "city" / file, truth, MapFrame(crs))


def stated(truth: Pose, crs: str, distorted: bool, tilt_deg: float) -> dict[str, str]:
    """Returns DJI's properties of a pose 8 m beside the truth, 11 m above it and 3 degrees turned."""
    east, north, up = truth.center + np.array([6.0, -5.0, 11.0])
    lon, lat = Transformer.from_crs(
        _PLANE.get(crs, crs.split("+")[0]), "EPSG:4326", always_xy=True
    ).transform(east, north)
    # A gimbal turns its body (forward, right, down) by yaw, pitch and roll from north, east, down.
    body_from_camera = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    ned_from_enu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    turn = ned_from_enu @ truth.rotation.T @ body_from_camera.T
    yaw, pitch, roll = Rotation.from_matrix(turn).as_euler("ZYX", degrees=True)
    heading = yaw + MapFrame(crs).convergence_deg(east, north) + 3.0
    values = {
        "GpsLatitude": f"{lat:+.9f}", "GpsLongitude": f"{lon:+.9f}", "AbsoluteAltitude": f"{up:+.3f}",
        "GimbalYawDegree": f"{heading:+.4f}", "GimbalPitchDegree": f"{pitch + tilt_deg:+.4f}",
        "GimbalRollDegree": f"{roll:+.4f}",
    }  # fmt: skip
    numbers = ",".join(
        str(v) for v in (PINHOLE.fx, PINHOLE.fy, PINHOLE.cx - WIDTH / 2, PINHOLE.cy - HEIGHT / 2, *DISTORTION)
    )
    return {**values, "DewarpData": f"2023-01-01;{numbers}", "DewarpFlag": "0" if distorted else "1"}


def localize(capsys, case: Case, out: Path, *words: str, code: int = 0) -> dict:
    assert main([str(case.photo), "--city", str(case.city), "--out", str(out), "--json", *words]) == code
    return json.loads(capsys.readouterr().out)


def pose_of(values: dict) -> Pose:
    return Pose.from_quaternion(values["quat_wxyz"], values["translation_m"])
