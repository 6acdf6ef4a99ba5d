#!/bin/sh
# pycolmap 4.2.1 (Reconstruction, text model): poses in images.txt do not count where frames.txt is there.
#
# COLMAP 4 writes rigs.txt and frames.txt beside images.txt, and each holds the pose.
# Seen: an image at x = 1; then only images.txt is changed to x = 7, as programs do that know COLMAP's former three files. COLMAP
# reads x = 1, without a warning that the two differ; without rigs.txt and frames.txt it reads x = 7.
# Expected: the file that was written last, or a warning that the two contradict each other.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check pycolmap==4.2.1 numpy==2.4.6
venv/bin/python -W ignore - <<'END'
import pathlib

import numpy as np
import pycolmap

model = pycolmap.Reconstruction()
model.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(1, "PINHOLE", 100.0, 64, 48))
pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 0, 0, 1.0])), np.array([-1.0, 0, 0]))
model.add_image_with_trivial_frame(pycolmap.Image(name="a.jpg", camera_id=1, image_id=1), pose)
place = pathlib.Path("model")
place.mkdir()
model.write_text(place)
images = place / "images.txt"
text = images.read_text()
images.write_text(text.replace(" -1 0 0 1 a.jpg", " -7 0 0 1 a.jpg"))
with_frames = pycolmap.Reconstruction(place).image(1).projection_center()[0]
for name in ("rigs.txt", "frames.txt"):
    (place / name).unlink()
without = pycolmap.Reconstruction(place).image(1).projection_center()[0]
if (with_frames, without) != (1, 7):
    raise SystemExit(f"changed: {with_frames} with frames.txt, {without} without")
END
