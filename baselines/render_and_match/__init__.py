"""What ``uavd4l`` and ``cadloc`` share: render views of the map, match the photo, lift, solve, repeat."""

from .params import RenderAndMatchParams
from .pipeline import RenderAndMatch

__all__ = ["RenderAndMatch", "RenderAndMatchParams"]
