"""Miniatures of datasets in layouts of their own, written to the letter of their documentation.

Each writer returns the true poses by key, in the coordinates that the loader answers in.
"""

import json
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from lodbench.citymodel import open_scene
from lodbench.datasets.pose_text import format_camera, format_pose, lines_to_text
from lodbench.datasets.published.egeniouss_ortholoc import cell_offset
from lodbench.geometry import Camera, EulerAngles, Pose
from tests.photos.dji_photo import PROPERTIES, exif_of, write_photo, xmp_packet
from tests.town import BOXES, box_obj, town_gml, true_poses

FLIP = np.diag([1.0, -1.0, -1.0])
PHONE = Camera(96, 128, 110.0, 110.0, 48.0, 64.0)
DRONE = Camera(160, 120, 140.0, 140.0, 80.5, 60.5)


def picture(seed: int, camera: Camera) -> np.ndarray:
    """Returns a plain of one colour, BGR: it has no edges that could contradict a pose."""
    return np.full((camera.height, camera.width, 3), (40 + 9 * seed, 90, 140 - 7 * seed), np.uint8)


def write_picture(path: Path, seed: int, camera: Camera) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix, picture(seed, camera))[1].tobytes())


def write_lines(path: Path, lines: list[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(lines_to_text(lines))


def quaternion(rotation: np.ndarray) -> list[float]:
    """Returns (w, x, y, z) by SciPy: independent of the code that reads it."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return [w, x, y, z]


def egeniouss_line(name: str, pose: Pose, reading: str = "c2w_opencv") -> str:
    """Returns ``IMAGE_NAME qw qx qy qz UTMx UTMy alt``."""
    direction, axes = reading.split("_")
    world_from_cam = pose.rotation.T @ (FLIP if axes == "opengl" else np.eye(3))
    written = world_from_cam if direction == "c2w" else world_from_cam.T
    return " ".join([name, *(f"{v:.9f}" for v in (*quaternion(written), *pose.center))])


def write_egeniouss(root: Path, reading: str = "c2w_opencv") -> dict[str, Pose]:
    """Writes egenioussBench: README's tree, Pix4D's camera, CityGML LoD2."""
    home = root / "egenioussBench"
    (home / "lod2").mkdir(parents=True)
    (home / "lod2" / "braunschweig.gml").write_text(town_gml())
    scene = open_scene(home / "lod2" / "braunschweig.gml", lod="2")
    middle = scene.origin + 0.5 * np.sum(scene.extent_m, axis=0)
    corners = scene.vertices + scene.origin
    ground = corners[np.hypot(*(corners[:, :2] - middle[:2]).T) < 40][:, 2].min()
    truth, rows, phone = {}, [], []
    for k in range(5):
        name = f"IMG_2024{k:04d}.jpg"
        centre = [middle[0] + 7 * k, middle[1] - 5 * k, ground + 1.6]
        pose = Pose.from_euler(EulerAngles(85.0 + 3 * k, 0.8 - 0.3 * k, 20.0 + 67 * k), centre)
        truth[f"val/{name}"] = pose
        rows.append(egeniouss_line(name, pose, reading))
        phone.append(egeniouss_line(name, pose.shifted([2.0, -3.0, 1.0]), reading))
        write_picture(home / "query_images" / "val" / name, k, PHONE)
    head = ["# Ground truth poses for validation images", "# IMAGE_NAME qw qx qy qz UTMx UTMy alt"]
    write_lines(home / "query_images" / "val_gt_poses.txt", [*head, *rows])
    write_lines(home / "query_images" / "val_android_poses.txt", [head[1], *phone])
    write_picture(home / "query_images" / "test" / "IMG_20249000.jpg", 9, PHONE)
    row = egeniouss_line("IMG_20249000.jpg", truth["val/IMG_20240000.jpg"], reading)
    write_lines(home / "query_images" / "test_android_poses.csv", [row.replace(" ", ",")])
    write_lines(home / "metadata" / "camera_parameters.txt", ["# Pixel 8", format_camera("x", PHONE)[2:]])
    return truth


def write_ortholoc(
    root: Path, half_px: float = 0.5, count: int = 3, camera: Camera = DRONE
) -> dict[str, Pose]:
    """Writes OrthoLoC: npz samples; pixels count from their centres if ``half_px`` is a half."""
    truth = {}
    for k, pose in enumerate(list(true_poses(count).values())):
        folder = root / "full" / ("test_inPlace" if k < count - 1 else "test_outPlace")
        folder.mkdir(parents=True, exist_ok=True)
        name = f"L01_{'R' if k else 'xDOP'}{k:04d}"
        np.savez(folder / f"{name}.npz", **ortholoc_arrays(name, pose, half_px, k, camera))
    stems = [
        (p.parent.name, p.stem)
        for s in ("test_inPlace", "test_outPlace")
        for p in sorted((root / "full" / s).glob("*.npz"))
    ]
    for index, (split, stem) in enumerate(stems):
        pose = list(true_poses(count).values())[int(stem[-4:])]
        truth[f"{split}/{stem}.png"] = pose.shifted(cell_offset(index))
    return truth


def ortholoc_arrays(
    name: str, pose: Pose, half_px: float, seed: int, camera: Camera = DRONE
) -> dict[str, np.ndarray]:
    """Returns the arrays of a sample: flat ground at 2 m with the houses of ``BOXES``, seen by a pinhole."""
    step, cells = 2.0, 100
    east, north = np.meshgrid(
        (np.arange(cells) - cells / 2 + 0.5) * step, (cells / 2 - np.arange(cells) - 0.5) * step
    )
    heights = np.full(east.shape, 2.0)
    for west, south, right, up, _, top in BOXES:
        heights[(east > west) & (east < right) & (north > south) & (north < up)] = top
    dsm = np.stack([east, north, heights], axis=2).astype(np.float32)
    dsm[:3, :3] = np.nan
    intrinsics = np.array(
        [[camera.fx, 0, camera.cx - half_px], [0, camera.fy, camera.cy - half_px], [0, 0, 1.0]]
    )
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    zero = 0.5 - half_px
    rays = (
        np.stack(
            [
                (columns + zero - intrinsics[0, 2]) / camera.fx,
                (rows + zero - intrinsics[1, 2]) / camera.fy,
                np.ones(rows.shape),
            ],
            axis=2,
        )
        @ pose.rotation
    )
    points = pose.center + rays * ((2.0 - pose.center[2]) / rays[..., 2:])
    return {
        "sample_id": np.array(name),
        "image_query": picture(seed, camera)[..., ::-1],
        "image_dop": np.random.default_rng(seed).integers(0, 256, (100, 100, 3), dtype=np.uint8),
        "dsm": dsm,
        "point_map": points.astype(np.float32),
        "keypoints": np.zeros((4, 3), np.float32),
        "vertices": np.zeros((3, 3), np.float32),
        "faces": np.zeros((1, 3), np.int32),
        "extrinsics": pose.cam_from_world[:3],
        "extrinsics_refined": pose.cam_from_world[:3],
        "intrinsics": intrinsics,
        "scale": np.array([step, step]),
    }


def write_anyvisloc(root: Path, frame: str = "left", dist: tuple[float, ...] = (0.0,) * 5) -> dict[str, Pose]:
    """Writes a scene of AnyVisLoc; ``frame``: whether ``pose_c2w`` is of the ``left``-handed world."""
    home = root / "Scene_01"
    home.mkdir(parents=True)
    south = np.diag([1.0, -1.0, 1.0])
    truth = {}
    for k, pose in enumerate(true_poses(3).values()):
        pitch, roll, yaw = pose.euler
        matrix = np.eye(4)
        matrix[:3, :3] = south @ pose.rotation.T if frame == "left" else pose.rotation.T
        matrix[:3, 3] = south @ pose.center if frame == "left" else pose.center
        stem = f"L01_{k + 1:04d}"
        arrays = {
            "image": picture(k, DRONE)[..., ::-1],
            "image_relpath": np.array(""),
            "K": np.array([[DRONE.fx, 0, DRONE.cx - 0.5], [0, DRONE.fy, DRONE.cy - 0.5], [0, 0, 1.0]]),
            "dist": np.array(dist),
            "uav_downsample": np.array(0.2),
            "original_size": np.array([600, 800]),
            "image_size": np.array([DRONE.height, DRONE.width]),
            "pose_c2w": matrix,
            "pose_w2c": np.linalg.inv(matrix),
            "xyz": south @ pose.center,
            "euler_deg": np.array([roll, pitch, -yaw]),
            "sample_id": np.array(stem),
            "scene_id": np.array(1),
        }
        name = f"{stem}.png"
        if k == 2:  # a photo beside its arrays
            write_picture(home / "images" / "photo.png", k, DRONE)
            arrays |= {"image": np.empty((0, 0, 3), np.uint8), "image_relpath": np.array("images/photo.png")}
        np.savez(home / f"{stem}.npz", **arrays)
        truth[f"Scene_01/{name}"] = pose
    modes = {}
    for mode in ("aerial", "satellite"):
        cv2.imwrite(str(home / f"{mode}_map.png"), np.random.default_rng(1).integers(0, 256, (150, 200, 3)))
        heights = np.full((60, 80), 3.0, np.float32)
        heights[20:30, 30:50] = 21.0
        np.save(home / f"{mode}_dsm.npy", heights)
        modes[mode] = {
            "map_path": f"{mode}_map.png", "dsm_path": f"{mode}_dsm.npy", "map_resolution": [1.5, 1.6],
            "dsm_resolution": [3.0, 4.0], "map_origin_local": [-120.0, -110.0],
            "dsm_origin_local": [10.0, -5.0],
        }  # fmt: skip
    (home / "L01_reference.json").write_text(json.dumps({"modes": modes}))
    return truth


def write_semcitylocked(root: Path, up: str = "z") -> dict[str, Pose]:
    """Writes SemCityLockeD: DJI photos, an OBJ per level, and a file of poses beside that the user names."""
    photos = root / "SemCityLockeD" / "original_images"
    photos.mkdir(parents=True)
    truth, lines = {}, []
    for k, pose in enumerate(true_poses(3).values()):
        name = f"DJI_2024121708434{k}_003{k}_D.JPG"
        properties = PROPERTIES | {
            "CalibratedFocalLength": "140.0", "CalibratedOpticalCenterX": "80.0",
            "CalibratedOpticalCenterY": "60.0",
            "DewarpData": "2024-01-01;140,140,0.5,0.5,-0.05,0.01,0,0,0",
        }  # fmt: skip
        pixels = cv2.cvtColor(picture(k, DRONE), cv2.COLOR_BGR2GRAY)
        write_photo(photos / name, pixels, exif=exif_of(), xmp=xmp_packet(properties))
        truth[f"flights/{name}"] = pose
        lines.append(format_pose(name, pose))
    write_lines(root / "poses.txt", lines)
    models = root / "SemCityLockeD" / "LoD_model"
    (models / "semantic_obj").mkdir(parents=True)
    for level in (1, 2, 3):
        text = box_obj()
        if up == "y":  # x, z, -y
            rows = [line.split() for line in text.splitlines()]
            text = lines_to_text(
                f"v {r[1]} {r[3]} {-float(r[2])}" if r[0] == "v" else " ".join(r) for r in rows
            )
        (models / f"TUM_CC_lod{level}.obj").write_text(text)
    (models / "semantic_obj" / "TUM_CC_lod2_RoofSurface.obj").write_text(box_obj())
    return truth


def write_tokyo(root: Path, axes: str = "opencv") -> dict[str, Pose]:
    """Writes Tokyo-LoDv3: LoD-Loc v2's tree, one scene."""
    home = root / "data" / "UAVD4L-LoD" / "Japan_07"
    poses = {f"DJI_{k:04d}_W.JPG": pose for k, pose in enumerate(true_poses(3).values())}
    flip = FLIP if axes == "opengl" else np.eye(3)
    written = {name: Pose(flip @ pose.rotation, flip @ pose.translation) for name, pose in poses.items()}
    for k, name in enumerate(poses):
        write_picture(home / "query" / name, k, DRONE)
    priors = [
        format_pose(f"query/{n}", p.shifted([4.0, east, 0])) for n, p in written.items() for east in (3, -6)
    ]
    write_lines(home / "GPS_pose_new_all.txt", priors)
    head = ["Visual Landmark Dataset V1", "ImageFile, Camera Position [X Y Z W P Q R]", ""]
    write_lines(home / "dataset_test.txt", [*head, *(f"query/{name} 0 0 0 0 0 0 0" for name in poses)])
    colmap = root / "data" / "all_colmaps" / "UAVD4L-LoD" / "Japan_07" / "colmap_320"
    cameras = [f"{k} {format_camera('x', DRONE)[2:]}" for k in range(1, len(poses) + 1)]
    write_lines(colmap / "cameras.txt", ["# Camera list", *cameras])
    images = []
    for k, (name, pose) in enumerate(written.items(), start=1):
        images += [f"{k} {format_pose('x', pose)[2:]} {k} query/{name}", ""]
    write_lines(colmap / "images.txt", ["# Image list", *images])
    (root / "city.obj").write_text(box_obj())
    return {f"japan_07/{name}": pose for name, pose in poses.items()}


def write_uavd4l(root: Path, origin: tuple[float, ...] = (0.0, 0.0, 0.0)) -> dict[str, Pose]:
    """Writes UAVD4L: the README's tree; poses lie at ``origin`` more than the tiles."""
    query = root / "Query"
    poses = list(true_poses(4).values())
    names = [f"DJI_20220{k}_{'W' if k < 3 else 'Z'}.JPG" for k in range(4)]
    for k, name in enumerate(names):
        write_picture(query / "images" / name[-5] / name, k, DRONE)
    far = [pose.shifted(origin) for pose in poses]
    write_lines(
        query / "poses" / "gt_pose.txt", [format_pose(*pair) for pair in zip(names, far, strict=True)]
    )
    for letter in "wz":
        mine = [
            (n, p.shifted([3.0, 1.0, -4.0]))
            for n, p in zip(names, far, strict=True)
            if n[-5] == letter.upper()
        ]
        write_lines(query / "poses" / f"{letter}_pose.txt", [format_pose(*pair) for pair in mine])
        lines = [format_camera(name, DRONE) for name, _ in mine]
        write_lines(query / "intrinsics" / f"{letter}_intrinsic.txt", lines)
    (root / "Model").mkdir()
    text = box_obj().splitlines()
    faces = [
        " ".join(w if i == 0 else f"{w}/1" for i, w in enumerate(line.split()))
        for line in text
        if line[0] == "f"
    ]
    points = [line for line in text if line[0] == "v"]
    write_lines(
        root / "Model" / "tile_0_0.obj", ["mtllib tile.mtl", *points, "vt 0.5 0.5", "usemtl m", *faces]
    )
    (root / "Model" / "tile.mtl").write_text("newmtl m\nmap_Kd tile.png\n")
    write_picture(root / "Model" / "tile.png", 5, DRONE)
    splits = ["wide"] * 3 + ["zoom"]
    return {f"{s}/{n}": p for s, n, p in zip(splits, names, poses, strict=True)}
