"""What only the finer level of detail shows: annexes, dormers, and boxes on flat roofs.

Each cuts into one face of a body and closes the gap again, so the solid stays closed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodbench.citymodel.model import SurfaceKind
from lodbench.synthesis.town.extrusion import Body
from lodbench.synthesis.town.shapes import Points, edge_directions, left_of

# Openings keep this far from the edges of the face they cut.
_MARGIN_M = 0.4


@dataclass(frozen=True, slots=True)
class Annex:
    """A flat-roofed extension before a wall, lower than its eaves.

    Attributes:
        side: ``outer``, ``inner``, ``first`` or ``last``.
        wing: The wing the wall belongs to.
        start_m: Distance of its left edge from the wall's left end, seen from outside.
        length_m: Its length along the wall.
        depth_m: How far it stands out.
        height_m: Height above the base.
    """

    side: str
    wing: int
    start_m: float
    length_m: float
    depth_m: float
    height_m: float

    def plan(self, body: Body) -> Points:
        """Returns its plan, (4, 2), counter-clockwise, the wall's edge first, from right to left."""
        wall = body.walls[self.side, self.wing]
        start = wall.left + wall.along * self.start_m
        end, out = start + wall.along * self.length_m, -left_of(wall.along) * self.depth_m
        return np.stack([end, start, start + out, end + out])

    def add_to(self, body: Body) -> None:
        """Adds the annex to a body."""
        builder, wall, ring = body.builder, body.walls[self.side, self.wing], self.plan(body)
        low, high = (builder.points(ring, body.base_m + up) for up in (0.0, self.height_m))
        left, right = wall.feet
        builder.detour(wall.face, left, right, [low[1], high[1], high[0], low[0]])
        builder.detour(body.ground, right, left, [low[0], low[3], low[2], low[1]])
        builder.face(SurfaceKind.ROOF, high)
        for k in range(1, 4):
            m = (k + 1) % 4
            builder.face(SurfaceKind.WALL, [low[k], low[m], high[m], high[k]])


@dataclass(frozen=True, slots=True)
class RoofBox:
    """A box that rises out of a roof face: a dormer on a slope, a lift house on a flat roof.

    Attributes:
        wing: The wing of the roof face.
        slope: Which face across the profile, counted from the outer side.
        start_m: Distance from the left end of the face's lower edge.
        width_m: Size along the lower edge.
        up_m: Plan distance of its front from the lower edge.
        depth_m: Plan size away from the lower edge.
        rise_m: Height over the roof at its back: 0 for a dormer whose roof runs level into the slope.
    """

    wing: int
    slope: int
    start_m: float
    width_m: float
    up_m: float
    depth_m: float
    rise_m: float = 0.0

    @property
    def is_dormer(self) -> bool:
        """Whether it sits in a slope: only level of detail 3 shows it."""
        return self.rise_m == 0.0

    def fits(self, body: Body) -> bool:
        """Returns whether it lies within its roof face, a margin from every edge."""
        face = self._corners(body)
        left = left_of(edge_directions(face[:, :2]))
        distance = np.einsum("kc,kmc->km", left, self._plan(face)[None] - face[:, None, :2])
        return bool(distance.min() >= _MARGIN_M)

    def add_to(self, body: Body) -> None:
        """Adds the box to a body."""
        builder, face = body.builder, self._corners(body)
        plan = self._plan(face)
        foot = [builder.point(x, y, z) for (x, y), z in zip(plan, _heights(face, plan), strict=True)]
        roof_m = float(_heights(face, plan[2:3])[0]) + self.rise_m
        # Without a rise the roof's back edge lies in the slope, and its points are the hole's.
        top = [builder.point(x, y, roof_m) for x, y in plan[:2]]
        top += foot[2:] if self.rise_m == 0 else [builder.point(x, y, roof_m) for x, y in plan[2:]]
        builder.add_hole(body.slopes[self.wing, self.slope], foot[::-1])
        builder.face(SurfaceKind.ROOF, top)
        for k in range(4):
            m = (k + 1) % 4
            if foot[k] != top[k] or foot[m] != top[m]:
                wall = builder.face(SurfaceKind.WALL, [foot[k], foot[m], top[m], top[k]])
                if k == 0:
                    body.dormers.append(wall)

    def _corners(self, body: Body) -> Points:
        """Returns the corners of the roof face, (N, 3), the lower edge first."""
        corners = body.builder.corners(body.slopes[self.wing, self.slope])
        pairs = corners[:, 2] + np.roll(corners[:, 2], -1)
        return np.roll(corners, -int(np.argmin(np.round(pairs, 3))), axis=0)

    def _plan(self, face: Points) -> Points:
        """Returns the plan, (4, 2), counter-clockwise from the front left corner."""
        origin, along = face[0, :2], face[1, :2] - face[0, :2]
        along = along / np.linalg.norm(along)
        u = np.array([0.0, self.width_m, self.width_m, 0.0]) + self.start_m
        v = np.array([0.0, 0.0, self.depth_m, self.depth_m]) + self.up_m
        return np.asarray(origin + u[:, None] * along + v[:, None] * left_of(along))


def _heights(face: Points, plan: Points) -> Points:
    """Returns heights, (N,), of the plane of a face, (M, 3), at plan positions, (N, 2)."""
    normal = np.cross(face[1] - face[0], face[2] - face[0])
    return np.asarray(face[0, 2] - (plan - face[0, :2]) @ normal[:2] / normal[2])


Detail = Annex | RoofBox
