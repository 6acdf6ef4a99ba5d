"""A flight of one's own: pictures with known poses as photos that a drone stores, metadata off as GPS is."""

from pathlib import Path

import cv2
import numpy as np
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from lodbench.datasets.pose_text import read_cameras, read_poses
from lodbench.geometry import Camera, Pose
from lodbench.photos.map_frame import MapFrame
from tests.photos.dji_photo import exif_of, write_photo, xmp_packet

# What GPS, a barometer and a compass are off by: east, north, up in metres, heading in degrees.
OFF_M, OFF_DEG = (6.0, -5.0, 11.0), 3.0


def write_flight(
    views: Path, folder: Path, crs: str, horizontal_crs: str = "", size: tuple[int, int] | None = None
) -> dict[str, Pose]:
    """Writes a drone's photos of training pictures; returns their true poses by name.

    Args:
        views: Folder with ``images``, ``poses.txt`` and ``intrinsic.txt``.
        folder: Receives ``DJI_0001.JPG`` and so on.
        crs: Of the poses, compound.
        horizontal_crs: Its horizontal part; by default what stands before the plus sign.
        size: Of the photos; by default that of the pictures.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cameras, truth = read_cameras(views / "intrinsic.txt"), {}
    for number, (name, pose) in enumerate(read_poses(views / "poses.txt").items(), start=1):
        camera = cameras[name] if size is None else cameras[name].scaled(*size)
        pixels = cv2.imread(str(views / "images" / name))
        photo = folder / f"DJI_{number:04d}.JPG"
        pixels = cv2.resize(pixels, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        write_photo(
            photo, pixels[..., ::-1], exif_of(), xmp_packet(stated(pose, camera, crs, horizontal_crs))
        )
        truth[photo.name] = pose
    return truth


def stated(pose: Pose, camera: Camera, crs: str, horizontal_crs: str = "") -> dict[str, str]:
    """Returns DJI's properties of a pose: where the drone believes to be, and its calibration."""
    east, north, up = pose.center + np.array(OFF_M)
    to_wgs84 = Transformer.from_crs(horizontal_crs or crs.split("+")[0], "EPSG:4326", always_xy=True)
    lon, lat = to_wgs84.transform(east, north)
    # A gimbal turns its body (forward, right, down) by yaw, pitch and roll from north, east, down.
    body_from_camera = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    ned_from_enu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    turn = ned_from_enu @ pose.rotation.T @ body_from_camera.T
    yaw, pitch, roll = Rotation.from_matrix(turn).as_euler("ZYX", degrees=True)
    heading = yaw + MapFrame(crs).convergence_deg(east, north) + OFF_DEG
    numbers = (camera.fx, camera.fy, camera.cx - camera.width / 2, camera.cy - camera.height / 2, *(0.0,) * 5)
    return {
        "GpsLatitude": f"{lat:+.9f}", "GpsLongitude": f"{lon:+.9f}", "AbsoluteAltitude": f"{up:+.3f}",
        "RelativeAltitude": f"{up - 40.0:+.3f}", "GimbalYawDegree": f"{heading:+.4f}",
        "GimbalPitchDegree": f"{pitch:+.4f}", "GimbalRollDegree": f"{roll:+.4f}",
        "DewarpData": f"2023-01-01;{','.join(map(str, numbers))}", "DewarpFlag": "1",
    }  # fmt: skip
