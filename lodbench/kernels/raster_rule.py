"""The raster rule: what "this pixel is covered" means, to the bit, in engine and reference alike.

1. A vertex goes to camera axes in float64: ``d = v - center``, then each row of the rotation as
   ``(r0 * dx + r1 * dy) + r2 * dz``. No matrix product, whose result may depend on the BLAS.
2. A triangle with a corner nearer than ``NEAR_M`` or outside the guard band is clipped against
   the five planes (near, left, right, top, bottom), in that order, and fanned from its first
   corner. Each remaining piece is a triangle of its own.
3. A corner is projected as ``u = (fx * x) * (1 / z) + cx`` and snapped: ``floor(u * 256 + 0.5)``.
4. Pixel (column i, row j) has its centre at ``(256 i + 128, 256 j + 128)``. An edge meets column i
   if one end is at or left of the column's centre and the other right of it (half-open). A pixel
   is inside a triangle if an odd number of edges meet its column at or above its centre.
5. The silhouette is the union of all triangles: front or back, open mesh or closed.
"""

from __future__ import annotations

# Sub-pixel steps per pixel, per axis.
SUBPIXELS = 256

# Triangles are cut at this distance in front of the camera, metres.
NEAR_M = 0.1

# Corners further than this from the image origin, in pixels, are clipped away: with it every
# product of two snapped coordinates stays below 2**53 and is exact in float64.
GUARD_PX = 8192.0
