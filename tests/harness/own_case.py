"""A distorted photo of a real city as a flight of one photo, its mask, and the command that takes them."""

import shutil
from pathlib import Path

from lodbench.cli import main
from lodbench.geometry import Camera
from tests.cli.photo_case import DISTORTION, HEIGHT, PINHOLE, WIDTH, Case, make_case

LENS = Camera(
    WIDTH, HEIGHT, PINHOLE.fx, PINHOLE.fy, PINHOLE.cx, PINHOLE.cy, (*DISTORTION, 0.0, 0.0, 0.0), "FULL_OPENCV"
)


def make_own_case(folder: Path, shared_data: Path) -> Case:
    """Returns a distorted photo of a real city in a folder of its own, its mask in another."""
    case = make_case(folder, shared_data, "nrw", distorted=True)
    (folder / "flight").mkdir()
    (folder / "masks").mkdir()
    shutil.move(case.photo, folder / "flight" / "DJI_0001.JPG")
    shutil.move(case.mask, folder / "masks" / "DJI_0001.png")
    case.photo, case.mask = folder / "flight" / "DJI_0001.JPG", folder / "masks" / "DJI_0001.png"
    return case


def run(capsys, command: str, *words) -> tuple[int, str, str]:
    code = main([*command.split(), *map(str, words)])
    reported = capsys.readouterr()
    return code, reported.out, reported.err


def init(capsys, case: Case, root: Path, *words) -> str:
    code, out, err = run(
        capsys,
        "dataset init",
        root,
        "--images",
        case.photo.parent,
        "--city",
        case.city,
        "--masks",
        case.mask.parent,
        *words,
    )
    assert code == 0, err
    return out
