"""What the README shows must run."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from lodbench.datasets.pose_text import read_cameras, read_poses
from lodbench.evaluation import pose_error
from lodbench.synthesis.town.build import build_demo

ROOT = Path(__file__).resolve().parents[1]


def test_ten_lines_go_from_a_city_a_mask_and_a_prior_to_a_pose(tmp_path, monkeypatch):
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    assert len([line for line in code.splitlines() if line.strip() and not line.startswith("import")]) <= 10

    demo = build_demo(tmp_path / "demo", num_queries=2)
    split = demo / "in_place"
    ((name, truth),) = read_poses(split / "GT_pose.txt").items()
    camera, prior = read_cameras(split / "intrinsic.txt")[name], read_poses(split / "GPS_pose.txt")[name]
    prior = prior.with_tilt_of(truth)
    (tmp_path / "city.gml").write_bytes((demo / "town.gml").read_bytes())
    mask = (split / "masks" / name).with_suffix(".png")
    (tmp_path / "mask.png").write_bytes(mask.read_bytes())

    # The README's numbers are of another place; put this query's in their stead, line by line.
    values = f"width={camera.width}, height={camera.height}, fx={camera.fx}, fy={camera.fy}, "
    code, cameras = re.subn(r"Camera\(.*\)", f"Camera({values}cx={camera.cx}, cy={camera.cy})", code)
    pitch, roll, yaw = prior.euler
    angles = f"EulerAngles(pitch_deg={pitch}, roll_deg={roll}, yaw_deg={yaw})"
    code, eulers = re.subn(r"EulerAngles\(.*\)  #", f"{angles}  #", code)
    code, centers = re.subn(r"center=\(.*\)\)  #", f"center={tuple(prior.center.tolist())})  #", code)
    assert (cameras, eulers, centers) == (1, 1, 1)

    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), names)  # noqa: S102 - our own README
    error = pose_error(names["estimate"].pose, truth)
    assert pose_error(prior, truth).translation_m > 3
    assert error.translation_m < 2
    assert error.rotation_deg < 2
    assert np.isfinite(names["estimate"].score)
