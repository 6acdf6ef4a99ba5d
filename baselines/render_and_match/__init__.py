"""What ``uavd4l`` and ``cadloc`` share: render views of the map, match the photo, lift, solve, repeat."""

from .correspondences import resized_photo
from .params import ORACLE, RenderAndMatchParams
from .pipeline import RenderAndMatch
from .view import shaded_views

__all__ = ["ORACLE", "RenderAndMatch", "RenderAndMatchParams", "resized_photo", "shaded_views"]
