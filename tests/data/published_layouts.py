"""Miniatures of the published datasets over the demo town, in the form the publishers' files have.

Nothing is stored: the town, the views, the masks and every file are made from a seed.
"""

import functools
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lodbench.citymodel import open_scene
from lodbench.citymodel.scene import Scene
from lodbench.datasets.pose_text import format_camera, format_pose, lines_to_text
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.geometry.similarity import SWISS_EPFL_FRAME, enu_from_ecef_rotation
from lodbench.photos.map_frame import MapFrame
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.storage import random_stream
from lodbench.synthesis.views import RGB_CAMERA, ViewSampling, sample_views
from tests.photos.dji_photo import PROPERTIES, exif_of, write_photo, xmp_packet
from tests.town import town_gml

UAVD4L_CAMERA = RGB_CAMERA.scaled(660, 494)
SWISS_CAMERA = Camera(720, 480, 480.0, 480.0, 360.0, 240.0)
# Where the miniature's zero lies in EPSG:4547; the real one is withheld.
ORIGIN = (400_000.0, 3_130_000.0, 0.0)

UAVD4L_NAMES = {
    "inTraj": ["DJI_20231207152043_0001_W.JPG", "DJI_20231207152045_0002_Z.JPG"],
    "outTraj": ["DJI_20231018092903_0016_D.JPG", "DJI_20230513163714_0033_T.JPG"],
}
SWISS_NAMES = {
    "inPlace": [
        "urbanscape-2020-09-17-piloted_00000_DJI_0029_img.jpg",
        "urbanscape-2020-09-17-piloted_00000_DJI_0030_img.jpg",
    ],
    "outPlace": [
        "urbanscape-2020-10-01-piloted_00000_DJI_0101_img.jpg",
        "urbanscape-2020-10-01-piloted_00000_DJI_0102_img.jpg",
    ],
}


@dataclass(frozen=True)
class Town:
    """The demo town in a local frame, and views of it.

    Attributes:
        lod1: Blocks.
        lod2: Roofs.
        views: True poses in the local frame.
    """

    lod1: Scene
    lod2: Scene
    views: tuple[Pose, ...]


@functools.cache
def small_town() -> Town:
    """Returns the town, made once per process."""
    with tempfile.TemporaryDirectory() as folder:
        city = Path(folder) / "town.gml"
        city.write_text(town_gml())
        lod1, lod2 = open_scene(city, lod="1"), open_scene(city, lod="2")
    renderer = SilhouetteRenderer(lod1, threads=1)
    sampling = ViewSampling(seed=5)
    views = sample_views(lod1, renderer, UAVD4L_CAMERA, sampling, 5, "published")
    return Town(lod1, lod2, views.poses)


def sensor_prior(truth: Pose, name: str) -> Pose:
    """Returns a prior as the released files have it: true tilt, heading to a tenth, position by GPS."""
    pitch, roll, yaw = truth.euler
    offset = random_stream(3, name).normal(0.0, 4.0, size=3)
    return Pose.from_euler(EulerAngles(pitch, roll, round(yaw + 0.4, 1)), truth.center + offset)


def obj_text(scene: Scene, turn: NDArray[np.float64] | None = None) -> str:
    """Returns a city as Blender exports it: shared points, texture coordinates, one stray line element."""
    points = scene.vertices.astype(np.float64)
    points = points if turn is None else points @ turn.T
    lines = [
        "# Blender v3.0.1 OBJ File: 'move22.blend'",
        "# www.blender.org",
        "# mtllib move22.mtl",
        "o 1.3LoD",
    ]
    lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points.tolist()]
    lines += ["vt 0.000000 0.000000", "vn 0.0000 0.0000 1.0000", "s off"]
    lines += [f"f {a}/1/1 {b}/1/1 {c}/1/1" for a, b, c in (scene.triangles + 1).tolist()]
    return lines_to_text([*lines, "l 1 2"])


def write_uavd4l(root: Path) -> Path:
    """Writes LoD-Loc's tree of UAVD4L-LoD, photos with DJI's metadata; returns the root."""
    town = small_town()
    home, views = root / "UAVD4L-LoD", iter(town.views)
    for scene, names in UAVD4L_NAMES.items():
        truth = {name: next(views) for name in names}
        priors = {name: sensor_prior(pose, name) for name, pose in truth.items()}
        _write_texts(home / scene, truth, priors, UAVD4L_CAMERA)
        _write_masks(home / scene, truth, UAVD4L_CAMERA)
        (home / scene / "Query_image").mkdir()
        for name, pose in priors.items():
            _write_dji_photo(home / scene / "Query_image" / name, pose)
        _write_json(home / "split" / f"UAV_{scene}_test.json", {"val": {scene: names}})
    pose = next(views)
    name = synthetic_name(pose)
    _write_texts(home / "Synthesis", {name: pose}, {name: pose}, UAVD4L_CAMERA)
    (home / "Synthesis" / "Query_image").mkdir()
    _write_dji_photo(home / "Synthesis" / "Query_image" / name, pose)
    train = {"train": {"Synthesis": [name]}, "val": {"Synthesis": []}}
    _write_json(home / "split" / "UAV_train.json", train)
    (root / "MODEL").mkdir()
    (root / "MODEL" / "UAVD4L-LoD1.obj").write_text(obj_text(town.lod1))
    (root / "MODEL" / "UAVD4L-LoD.obj").write_text(obj_text(town.lod2))
    return root


def synthetic_name(pose: Pose) -> str:
    """Returns the name of a synthetic view: six numbers, each cut to a whole one."""
    east, north, height = pose.center + np.array(ORIGIN)
    pitch, roll, yaw = pose.euler
    return "@".join(str(int(v)) for v in (east, north, height, pitch, yaw, roll)) + ".jpg"


def write_swiss(root: Path, *, ecef: bool, per_image: bool = False) -> Path:
    """Writes LoD-Loc's tree of Swiss-EPFL, either earth-centred minus an origin or east, north, up.

    Args:
        root: Where.
        ecef: Whether city and poses are turned as the authors' script turns them.
        per_image: Whether to write the matrices that their preprocessing derives instead of text files.
    """
    town = small_town()
    rows = enu_from_ecef_rotation(SWISS_EPFL_FRAME.lat_deg, SWISS_EPFL_FRAME.lon_deg)
    turn = rows.T if ecef else np.eye(3)
    home, views = root / "Swiss-EPFL", iter(town.views)
    for scene, names in SWISS_NAMES.items():
        truth = {name: next(views) for name in names}
        priors = {name: UniformPrior().draw(pose, random_stream(0, name)) for name, pose in truth.items()}
        _write_masks(home / scene, truth, SWISS_CAMERA)
        truth, priors = (
            {name: Pose(pose.rotation @ turn.T, pose.translation) for name, pose in poses.items()}
            for poses in (truth, priors)
        )
        (home / scene / "Query_image").mkdir()
        for name in names:
            write_photo(home / scene / "Query_image" / name, np.full((480, 720), 90, np.uint8))
        if per_image:
            _write_matrices(home / scene, truth, priors, SWISS_CAMERA)
        else:
            _write_texts(home / scene, truth, priors, SWISS_CAMERA)
        _write_json(home / "split" / f"Swiss_{scene}_test.json", {"val": {scene: names}})
    (root / "MODEL").mkdir()
    (root / "MODEL" / "Swiss-EPFL-LoD.obj").write_text(obj_text(town.lod2, turn))
    (root / "MODEL" / "swiss_LoD1_final.obj").write_text(obj_text(town.lod1, turn))
    return root


def write_lodlocv2(root: Path) -> Path:
    """Writes LoD-Loc v2's tree: COLMAP models, masks in the photos' place, several priors per query."""
    town = small_town()
    home, scenes = root / "data" / "UAVD4L-LoD", {**UAVD4L_NAMES, "Swiss_in": SWISS_NAMES["inPlace"]}
    for scene, names in scenes.items():
        camera = SWISS_CAMERA if scene == "Swiss_in" else UAVD4L_CAMERA
        views = town.views[2:] if scene == "outTraj" else town.views
        truth = dict(zip(names, views, strict=False))
        _write_masks(home / scene, truth, camera, "query")
        header = ["Visual Landmark Dataset V1", "ImageFile, Camera Position [X Y Z W P Q R]", ""]
        _write(home / scene / "dataset_test.txt", [*header, *(f"query/{name} 0 0 0" for name in names)])
        _write(home / scene / "dataset_train.txt", [*header, "db/400242@3131119@150@44@-65@0.jpg 0 0 0"])
        priors = [
            (f"query/{name}", sensor_prior(pose, name).shifted([east, 0, 0]))
            for name, pose in truth.items()
            for east in (0, 5)
        ]
        prior_file = "inPlace_gps_newAll.txt" if scene == "Swiss_in" else "GPS_pose_new.txt"
        _write(home / scene / prior_file, [format_pose(*prior) for prior in priors])
        colmap = root / "data" / "all_colmaps" / "UAVD4L-LoD" / scene / "colmap_320"
        _write_colmap(colmap, truth, camera)
    model = root / "MODEL" / "move22.obj"
    model.parent.mkdir()
    model.write_text(obj_text(town.lod1))
    (root / "MODEL" / "swiss_LoD1_final.obj").write_text(obj_text(town.lod1))
    return root


def _write(path: Path, lines: list[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(lines_to_text(lines))


def _write_json(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value) + "\n")


def _write_texts(folder: Path, truth: dict[str, Pose], priors: dict[str, Pose], camera: Camera) -> None:
    _write(folder / "GT_pose.txt", [format_pose(*item) for item in truth.items()])
    _write(folder / "GPS_pose.txt", [format_pose(*item) for item in priors.items()])
    _write(folder / "intrinsic.txt", [format_camera(name, camera) for name in truth])


def write_matrix(folder: Path, stem: str, pose: Pose) -> None:
    """Writes one camera-to-world matrix as numpy does by default."""
    folder.mkdir(exist_ok=True)
    np.savetxt(folder / f"{stem}_pose.txt", pose.world_from_cam)


def _write_matrices(folder: Path, truth: dict[str, Pose], priors: dict[str, Pose], camera: Camera) -> None:
    """Writes the folders of the authors' preprocessing; some tools cut names at ``_img``, some do not."""
    for number, name in enumerate(truth):
        stem = name.split(".")[0] if number else name.split("_img")[0]
        write_matrix(folder / "GT_pose", stem, truth[name])
        write_matrix(folder / "GPS_pose", stem, priors[name])
        (folder / "intrinsic").mkdir(exist_ok=True)
        matrix = np.hstack([camera.matrix, np.zeros((3, 1))])
        np.savetxt(folder / "intrinsic" / f"{stem}_intrinsic.txt", matrix)


def _write_masks(folder: Path, truth: dict[str, Pose], camera: Camera, name: str = "masks") -> None:
    (folder / name).mkdir(parents=True)
    renderer = SilhouetteRenderer(small_town().lod1, threads=1)
    for image, pose in truth.items():
        mask = renderer.render(camera, pose).astype(np.uint8) * 255
        path = folder / name / (image if name == "query" else Path(image).stem + ".png")
        path.write_bytes(cv2.imencode(path.suffix, mask)[1].tobytes())


def gimbal_angles(pose: Pose) -> tuple[float, float, float]:
    """Returns yaw from grid north, pitch and roll of a DJI gimbal, degrees: turns in this order."""
    east_north_up = pose.rotation.T
    ned = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]) @ east_north_up
    # A gimbal's body is forward, right, down; a camera right, down, forward.
    yaw, pitch, roll = Rotation.from_matrix(ned[:, [2, 0, 1]]).as_euler("ZYX", degrees=True)
    return float(yaw), float(pitch), float(roll)


def _write_dji_photo(path: Path, pose: Pose) -> None:
    """Writes a photo whose metadata state a pose, in DJI's terms and to DJI's digits."""
    frame = MapFrame("EPSG:4547")
    absolute = pose.shifted(ORIGIN)
    place = frame.place_of(absolute)
    yaw, pitch, roll = gimbal_angles(absolute)
    yaw += frame.convergence_deg(float(absolute.center[0]), float(absolute.center[1]))
    properties = PROPERTIES | {
        "AbsoluteAltitude": f"{place.height_m:+.2f}",
        "GpsLatitude": f"{place.latitude_deg:.9f}",
        "GpsLongitude": f"{place.longitude_deg:.9f}",
        "GimbalRollDegree": f"{roll:+.2f}",
        "GimbalYawDegree": f"{yaw:+.2f}",
        "GimbalPitchDegree": f"{pitch:+.2f}",
    }
    exif = exif_of(place.latitude_deg, place.longitude_deg, place.height_m)
    pixels = np.full((UAVD4L_CAMERA.height, UAVD4L_CAMERA.width), 120, np.uint8)
    write_photo(path, pixels, exif, xmp_packet(properties))


def _write_colmap(folder: Path, truth: dict[str, Pose], camera: Camera) -> None:
    """Writes a COLMAP text model with images of the mapping besides the queries."""
    db = {f"db/4002{k}@3131119@150@44@-65@0.jpg": next(iter(truth.values())) for k in range(9)}
    images = {**{f"query/{name}": pose for name, pose in truth.items()}, **db}
    cameras = [
        "# Camera list with one line of data per camera:",
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
    ]
    cameras += [f"# Number of cameras: {len(images)}"]
    lines = ["# Image list with two lines of data per image:"]
    for number, (name, pose) in enumerate(images.items(), start=1):
        cameras.append(f"{number} {format_camera('x', camera).split(maxsplit=1)[1]}")
        lines += [f"{number} {format_pose('x', pose).split(maxsplit=1)[1]} {number} {name}", ""]
    _write(folder / "cameras.txt", cameras)
    _write(folder / "images.txt", lines)
