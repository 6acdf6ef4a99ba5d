"""Loaders of own layouts: miniatures, ten damages of each and what is said of them, settings refused."""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lodbench.geometry import Pose
from tests.data import own_layouts as layouts

Damage = Callable[[Path], None]


def replaced(place: str, old: str, new: str, count: int = 1) -> Damage:
    """Returns what changes the text of a file by a pattern."""

    def damage(root: Path) -> None:
        (path,) = sorted(root.glob(place))[:1]
        text = path.read_text()
        changed = re.sub(old, new, text, count=count, flags=re.MULTILINE)
        assert changed != text
        path.write_text(changed)

    return damage


def written(place: str, data: bytes) -> Damage:
    """Returns what gives the first file of a pattern another content."""
    return lambda root: sorted(root.glob(place))[0].write_bytes(data) and None


def cut(place: str, share: float = 0.5) -> Damage:
    """Returns what cuts off the end of a file."""

    def damage(root: Path) -> None:
        path = sorted(root.glob(place))[0]
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])

    return damage


def removed(place: str) -> Damage:
    """Returns what removes the files of a pattern."""

    def damage(root: Path) -> None:
        for path in sorted(root.glob(place)):
            path.unlink()

    return damage


def array(place: str, name: str, change: Callable[[np.ndarray], object]) -> Damage:
    """Returns what changes an array of the first sample; None leaves it out."""

    def damage(root: Path) -> None:
        path = sorted(root.glob(place))[0]
        with np.load(path) as arrays:
            found = dict(arrays)
        changed = change(found.pop(name))
        np.savez(path, **found, **({} if changed is None else {name: changed}))

    return damage


def stated(key: str, value: object, name: str = "aerial") -> Damage:
    """Returns what changes AnyVisLoc's reference; None leaves it out."""

    def damage(root: Path) -> None:
        path = next(root.glob("Scene_01/*.json"))
        known = json.loads(path.read_text())
        known["modes"][name][key] = value
        path.write_text(json.dumps(known))

    return damage


def turned_sideways(place: str) -> Damage:
    """Returns what rotates all quaternions by 90 degrees around the view."""

    def damage(root: Path) -> None:
        path = root / place
        lines = []
        for line in path.read_text().splitlines():
            words = line.split()
            if not line.startswith("#") and len(words) == 8:
                w, x, y, z = (float(v) * 0.5**0.5 for v in words[1:5])
                words[1:5] = [f"{v:.9f}" for v in (w - z, x + y, y - x, z + w)]
            lines.append(" ".join(words))
        layouts.write_lines(path, lines)

    return damage


@dataclass(frozen=True)
class Loader:
    """What is known of a loader: its miniature, the settings it needs, and damages with what is said."""

    write: Callable[[Path], dict[str, Pose]]
    damages: dict[str, tuple[Damage, str]]
    settings: dict[str, object] = field(default_factory=dict)
    bad_settings: dict[str, str] = field(default_factory=dict)


GT, SAMPLE = "egenioussBench/query_images/val_gt_poses.txt", "full/test_inPlace/*.npz"
POSES, COLMAP = "Query/poses/gt_pose.txt", "data/all_colmaps/UAVD4L-LoD/Japan_07/colmap_320"
OBJECT = np.array([{"a": 1}], dtype=object)
LOADERS = {
    "egeniouss": Loader(
        layouts.write_egeniouss,
        {
            "six numbers": (replaced(GT, r" \S+$", "", 3), "line 3: 6 values after the name"),
            "no number": (replaced(GT, r" \S+$", " north", 3), "line 3: could not convert"),
            "not finite": (replaced(GT, r"(IMG.*) \S+$", r"\1 nan"), "no place on Earth"),
            "no unit quaternion": (replaced(GT, r"(IMG\S+) \S+", r"\1 3"), "quaternion has length"),
            "name twice": (replaced(GT, "IMG_20240001", "IMG_20240000"), "occurs twice"),
            "empty": (written(GT, b"# nothing\n"), "holds no poses"),
            "binary": (written(GT, b"\xff\xfe\x00\x81"), "not a text file"),
            "sideways": (turned_sideways(GT), "is not documented, and the pictures do not decide"),
            "camera": (written("*/metadata/*.txt", b"fx = 110\n"), "has no line MODEL W H params"),
            "phone's head": (
                written("*/query_images/val_android*", b"name,lat,lon,alt\n"),
                "line 1: 3 values after the name",
            ),
            "far away": (replaced(GT, r"(IMG.*) \S+$", r"\1 1e9"), "no place on Earth"),
        },
        bad_settings={
            "poses=c2w": "dataset.poses=c2w is unknown",
            "priors=gps": "dataset.priors=gps is unknown",
            "camera=PINHOLE 96": "dataset.camera='PINHOLE 96': too few values",
            "height_offset_m=.nan": "dataset.height_offset_m",
            "zone=32": "takes no zone",
        },
    ),
    "ortholoc": Loader(
        layouts.write_ortholoc,
        {
            "no archive": (written(SAMPLE, b"nothing"), "is no readable .npz"),
            "cut off": (cut(SAMPLE), "is no readable .npz"),
            "pickled": (array(SAMPLE, "extrinsics", lambda a: OBJECT), "is no readable .npz: Object arrays"),
            "lacking": (array(SAMPLE, "extrinsics", lambda a: None), "has no array extrinsics"),
            "no rotation": (array(SAMPLE, "extrinsics", lambda a: 2 * a), "holds no rotation"),
            "not finite": (array(SAMPLE, "extrinsics", lambda a: a * np.nan), "not finite"),
            "skew": (array(SAMPLE, "intrinsics", lambda a: a + np.eye(3, k=1)), "no pinhole without skew"),
            "negative focal length": (
                array(SAMPLE, "intrinsics", lambda a: a * [[-1, 1, 1]]),
                "intrinsics: ",
            ),
            "grey": (
                array(SAMPLE, "image_query", lambda a: a[..., 0]),
                "image_query is (120, 160), not N x N x 3",
            ),
            "of floats": (array(SAMPLE, "image_query", lambda a: a / 255), "image_query is of type float64"),
            "points of another size": (
                array(SAMPLE, "point_map", lambda a: a[:50]),
                "point_map is (50, 160, 3)",
            ),
            "points elsewhere": (
                lambda root: (
                    [
                        array(f"full/*/*{k:04d}.npz", "point_map", lambda a: np.roll(a, 3, axis=1))(root)
                        for k in range(3)
                    ]
                    and None
                ),
                "px off their pixels",
            ),
            "holes only": (array(SAMPLE, "dsm", lambda a: a * np.nan), "dsm holds no height"),
        },
        bad_settings={
            "samples=L99*": "is called L99*",
            "focal=guess": "dataset.focal=guess is unknown",
            "pixel_origin=left": "dataset.pixel_origin=left is unknown",
            "map_stride=0": "dataset.map_stride",
        },
    ),
    "anyvisloc": Loader(
        layouts.write_anyvisloc,
        {
            "cut off": (cut("Scene_01/*.npz"), "is no readable .npz"),
            "pickled": (array("Scene_01/*.npz", "K", lambda a: OBJECT), "is no readable .npz: Object arrays"),
            "lacking": (array("Scene_01/*.npz", "K", lambda a: None), "has no array K"),
            "not finite": (
                array("Scene_01/*.npz", "xyz", lambda a: a * np.inf),
                "xyz has values that are not finite",
            ),
            "angles elsewhere": (array("Scene_01/*.npz", "euler_deg", lambda a: a + 40), "agree in 2 of 3"),
            "photo outside": (
                array("Scene_01/*3.npz", "image_relpath", lambda a: np.array("../../etc/passwd")),
                "is no file beside it",
            ),
            "no JSON": (written("Scene_01/*.json", b"{"), "L01_reference.json"),
            "no modes": (written("Scene_01/*.json", b"{}"), "has no modes"),
            "no resolution": (stated("map_resolution", None), "map_resolution is no pair of numbers"),
            "resolution of zero": (stated("dsm_resolution", [0, 1]), "is not above 0"),
            "map outside": (stated("dsm_path", "/etc/passwd"), "is no file beside it"),
            "map damaged": (written("Scene_01/aerial_map.png", b"PNG"), "cannot be read as a picture"),
            "heights cut off": (cut("Scene_01/aerial_dsm.npy"), "is no surface model"),
        },
        bad_settings={
            "scene=Scene_99": "There is no Scene_99",
            "prior_track=yaw": "dataset.prior_track=yaw is unknown",
            "map=drone": "dataset.map=drone is unknown",
            "prior_range_m=-1": "dataset.prior_range_m",
        },
    ),
    "semcitylocked": Loader(
        layouts.write_semcitylocked,
        {
            "no faces": (replaced("*/LoD_model/*lod2.obj", "^f .*$", "", 0), "TUM_CC_lod2.obj"),
            "no OBJ": (written("*/LoD_model/*lod2.obj", b"\x00\x01"), "TUM_CC_lod2.obj"),
            "no number": (replaced("*/LoD_model/*lod2.obj", r"^v \S+", "v west"), "TUM_CC_lod2.obj"),
            "as high as wide": (
                replaced("*/LoD_model/*lod2.obj", r"^(v.*) 18$", r"\1 120", 4),
                "points up is not documented",
            ),
            "photo cut off": (cut("*/original_images/*", 0.93), "is no picture of 160 x 120"),
            "poses of six numbers": (replaced("poses.txt", r" \S+$", ""), "line 1"),
            "poses not finite": (replaced("poses.txt", r"(DJI.*) \S+$", r"\1 nan"), "line 1"),
            "no unit quaternion": (replaced("poses.txt", r"(DJI\S+) \S+", r"\1 3"), "quaternion has length"),
            "no poses": (written("poses.txt", b"\n"), "holds no poses"),
            "binary poses": (written("poses.txt", b"\xff\xfe\x81"), "poses.txt"),
        },
        {"poses": "ROOT/poses.txt", "poses_format": "lines"},
        {
            "level=4": "dataset.level=4 is unknown",
            "up_axis=x": "dataset.up_axis=x is unknown",
            "origin=[1,2]": "takes three numbers",
            "poses_format=pickle": "format=pickle is not known",
        },
    ),
    "tokyo_lodv3": Loader(
        layouts.write_tokyo,
        {
            "line cut off": (replaced(f"{COLMAP}/images.txt", r"^1 (\S+) .*$", r"1 \1"), "images.txt"),
            "not finite": (replaced(f"{COLMAP}/images.txt", r"^1 \S+", "1 nan"), "images.txt"),
            "no unit quaternion": (replaced(f"{COLMAP}/images.txt", r"^1 \S+", "1 5"), "images.txt"),
            "camera without a number": (
                replaced(f"{COLMAP}/cameras.txt", r"^1 (.*) \S+$", r"1 \1"),
                "cameras.txt",
            ),
            "no priors": (written("data/UAVD4L-LoD/*/GPS*.txt", b"# none\n"), "GPS_pose_new_all.txt"),
            "no queries": (written("data/UAVD4L-LoD/Japan_07/dataset_test.txt", b""), "lists no query"),
            "query twice": (
                replaced("data/UAVD4L-LoD/Japan_07/dataset_test.txt", "DJI_0001", "DJI_0000"),
                "lists DJI_0000_W.JPG twice",
            ),
            "prior of six numbers": (
                replaced("data/UAVD4L-LoD/*/GPS*.txt", r" \S+$", ""),
                "GPS_pose_new_all.txt",
            ),
            "prior not finite": (
                replaced("data/UAVD4L-LoD/*/GPS*.txt", r" \S+$", " inf"),
                "GPS_pose_new_all.txt",
            ),
            "binary priors": (written("data/UAVD4L-LoD/*/GPS*.txt", b"\xff\xfe\x81"), "GPS_pose_new_all.txt"),
        },
        {"city_model": "ROOT/city.obj"},
        {"axes=blender": "dataset.axes=blender is unknown", "prior_file=GPS.txt": "is in no split"},
    ),
    "uavd4l": Loader(
        layouts.write_uavd4l,
        {
            "six numbers": (replaced(POSES, r" \S+$", ""), "line 1: 6 values"),
            "not finite": (replaced(POSES, r" \S+$", " nan"), "line 1"),
            "no unit quaternion": (replaced(POSES, r"(DJI\S+) \S+", r"\1 3"), "quaternion has length"),
            "name twice": (replaced(POSES, "DJI_202201", "DJI_202200"), "occurs twice"),
            "empty": (written(POSES, b""), "No true pose"),
            "binary": (written(POSES, b"\xff\xfe\x81"), "no UTF-8 text"),
            "other names": (replaced(POSES, "DJI", "IMG", 0), "No true pose"),
            "unknown camera": (replaced("Query/intrinsics/w*", "PINHOLE", "LENS"), "w_intrinsic.txt, line 1"),
            "negative focal length": (
                replaced("Query/intrinsics/w*", " 140.0", " -140.0"),
                "w_intrinsic.txt, line 1",
            ),
            "prior of six numbers": (replaced("Query/poses/w*", r" \S+$", ""), "w_pose.txt, line 1"),
            "tile without faces": (replaced("Model/*.obj", "^f .*$", "", 0), "tile_0_0.obj"),
        },
        bad_settings={"map_origin=[1,2]": "takes three numbers", "textured_map=nowhere": "does not exist"},
    ),
}
