"""Well-known binary: the polygons of a vector file, in any of its dialects."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

_POINT, _LINE, _POLYGON, _TRIANGLE = 1, 2, 3, 17
# Multi-polygons, collections, multi-surfaces, polyhedral surfaces and TINs nest other geometries.
_COLLECTIONS = frozenset({6, 7, 12, 15, 16})
_WITHOUT_AREA = frozenset({4, 5})  # multi-points and multi-lines
_Z_FLAG, _M_FLAG, _SRID_FLAG = 0x80000000, 0x40000000, 0x20000000
_MAX_DEPTH = 16
# Footprints draped over the ground by rounding stay footprints.
_LEVEL_TOLERANCE_M = 0.01
# A wall seen from above: less of a square of its outline's length than any footprint.
_THIN = 1e-2


@dataclass(slots=True)
class WkbPolygons:
    """Polygons of many geometries, flat.

    Attributes:
        rings: (n, 3) points of each ring as written; z is 0 where there is none.
        ring_counts: Rings of each polygon.
        owner: Which geometry each polygon belongs to.
        has_z: Whether any geometry has heights.
        ignored: Kinds of geometry met that hold no area.
    """

    rings: list[NDArray[np.float64]] = field(default_factory=list)
    ring_counts: list[int] = field(default_factory=list)
    owner: list[int] = field(default_factory=list)
    has_z: bool = False
    ignored: set[int] = field(default_factory=set)

    def has_uneven_rings(self) -> bool:
        """Returns whether some ring leaves the horizontal: surfaces, or footprints draped over the ground."""
        return any(_is_uneven(ring) for ring in self.rings)

    def has_upright_rings(self) -> bool:
        """Returns whether some ring stands upright: the polygons are surfaces, no footprints."""
        return any(_is_uneven(ring) and _is_thin(ring[:, :2]) for ring in self.rings)

    def add(self, data: bytes, owner: int) -> None:
        """Adds the polygons of one geometry.

        Raises:
            ValueError: The bytes are cut off or malformed.
        """
        try:
            self._geometry(data, 0, owner, 0)
        except struct.error as error:
            raise ValueError(f"the geometry is cut off ({error})") from None

    def _geometry(self, data: bytes, offset: int, owner: int, depth: int) -> int:
        if depth > _MAX_DEPTH:
            raise ValueError("geometries are nested too deeply")
        order = "<" if data[offset : offset + 1] == b"\x01" else ">"
        (code,) = struct.unpack_from(order + "I", data, offset + 1)
        offset += 5
        if code & _SRID_FLAG:
            offset += 4
        iso = code & 0x0FFFFFFF
        has_z = bool(code & _Z_FLAG) or iso // 1000 in (1, 3)
        has_m = bool(code & _M_FLAG) or iso // 1000 in (2, 3)
        kind = iso % 1000
        if kind in (_POLYGON, _TRIANGLE):
            return self._polygon(data, offset, order, 2 + has_z + has_m, has_z, owner)
        if kind in _COLLECTIONS or kind in _WITHOUT_AREA:
            (count,) = struct.unpack_from(order + "I", data, offset)
            offset += 4
            for _ in range(count):
                offset = self._geometry(data, offset, owner, depth + 1)
            return offset
        self.ignored.add(kind)
        if kind not in (_POINT, _LINE):
            return len(data)  # nothing is known of its length
        count = 1
        if kind == _LINE:
            (count,) = struct.unpack_from(order + "I", data, offset)
            offset += 4
        return int(offset + 8 * count * (2 + has_z + has_m))

    def _polygon(self, data: bytes, offset: int, order: str, width: int, has_z: bool, owner: int) -> int:
        (num_rings,) = struct.unpack_from(order + "I", data, offset)
        offset += 4
        for _ in range(num_rings):
            (count,) = struct.unpack_from(order + "I", data, offset)
            offset += 4
            size = count * width
            if offset + 8 * size > len(data):
                raise ValueError("a ring is cut off")
            values = np.frombuffer(data, np.dtype(order + "f8"), size, offset).reshape(count, width)
            offset += 8 * size
            ring = np.zeros((count, 3))
            ring[:, : 2 + has_z] = values[:, : 2 + has_z]
            self.rings.append(ring)
        self.has_z = self.has_z or has_z
        if num_rings:
            self.ring_counts.append(num_rings)
            self.owner.append(owner)
        return offset


def _is_uneven(ring: NDArray[np.float64]) -> bool:
    return len(ring) > 0 and bool(np.ptp(ring[:, 2]) > _LEVEL_TOLERANCE_M)


def _is_thin(ring: NDArray[np.float64]) -> bool:
    """Returns whether a ring has no area as seen from above, in metres or in degrees."""
    x, y = (ring - ring[0]).T
    area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))
    length = float(np.sum(np.hypot(*(np.roll(ring, -1, axis=0) - ring).T)))
    return area <= _THIN * (0.25 * length) ** 2
