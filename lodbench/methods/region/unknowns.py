"""What a photo leaves open: where in a vector is what, in the order in which an outline tells how it moves.

Pose (metres, degrees), by how many percent the lens is longer than told, then metres: how much higher than in
the map all roofs are and the feet of all walls, and how much farther all eaves stand out. Shorter vectors
begin alike.
"""

from __future__ import annotations

POSE, LENS, ROOFS, FEET, EAVES = slice(0, 6), 6, 7, 8, 9
# Of a pose: pitch and roll.
TILT = slice(3, 5)
# How many numbers a vector has: a pose, a camera, one with roofs, one with all that outlines tell, all.
POSES, CAMERAS, RAISED, OUTLINES, ALL = range(6, 11)
# What a pose alone leaves out.
BESIDE_POSE = ALL - POSES
