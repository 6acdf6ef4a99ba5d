"""The message on a photo that fits nowhere because its height has another datum than the city's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Pose
from lodbench.harness.city import HEIGHT_HINT, height_above_m
from lodbench.methods.fits import NothingFits


@contextmanager
def telling_of_depth(prior: Pose, scene: Scene) -> Iterator[None]:
    """Adds to the fault of a photo that nothing fits that its rough pose lies below the whole city.

    Rough heights are off by tens of metres, so such a prior is no fault of its own.
    """
    try:
        yield
    except NothingFits as fault:
        height = height_above_m(prior, scene)
        if height >= 0:
            raise
        words = (
            f"{fault.message.rstrip('.')}; its rough place is {-height:.0f} m below the city's lowest point"
        )
        raise NothingFits(words, HEIGHT_HINT) from fault
