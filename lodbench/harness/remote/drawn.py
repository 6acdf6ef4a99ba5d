"""What may be drawn for a child, and how large it is."""

from __future__ import annotations

from lodbench.geometry import Camera

# Bytes of one pixel. Edges and single buildings take what there is to see, seldom as much as this.
_PIXEL_BYTES = {
    "render": 1,
    "instances": 1,
    "buildings": 4,
    "depth": 4,
    "surface_depth": 4,
    "normals": 12,
    "colour": 3,
    "edges": 4,
}
# Of a pose's counts: two integers.
_COUNTS_BYTES = 16
KINDS = frozenset({"silhouettes", "counts", *_PIXEL_BYTES})


def drawn_bytes(kind: str, camera: Camera, views: int) -> int:
    """Returns the bytes of so many views of a kind of ``KINDS``, 0 for others."""
    if kind == "counts":
        return views * _COUNTS_BYTES
    if kind == "silhouettes":
        return views * camera.height * -(-camera.width // 64) * 8
    return views * camera.height * camera.width * _PIXEL_BYTES.get(kind, 0)
