"""Parameters of tracking; docs/adr/0032 says how the defaults were chosen."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lodbench.errors import require_numbers
from lodbench.methods.contour_alignment.params import Params as PhotoParams


@dataclass(frozen=True, slots=True)
class Params:
    """Everything tracking can be told.

    Attributes:
        fine_size: Width and height of masks whose outlines are aligned last, pixels; half of it before.
        steps: Alignment steps on masks of half the size.
        final_steps: And at full size.
        reach_px: How far outlines may lie apart in the first step, pixels of the fine size.
        speed_m: How far a frame may be from where the motion leads, metres per second of time between.
        turn_deg: The same of its angles, degrees per second.
        still_m: The same however short the time is, metres.
        still_deg: Likewise, degrees.
        fit: A frame is lost whose silhouette and mask overlap by less than this share of what the last
            frames did.
        least_iou: And whose overlap is less than this in any case.
        search_m: Full width of the search for a lost camera, metres; half more with each frame that is.
        search_deg: The same of its heading, degrees.
        most_m: The widest search.
    """

    fine_size: tuple[int, int] = (602, 448)
    steps: int = 5
    final_steps: int = 2
    reach_px: float = 24.0
    speed_m: float = 3.0
    turn_deg: float = 15.0
    still_m: float = 0.5
    still_deg: float = 1.0
    fit: float = 0.75
    least_iou: float = 0.4
    search_m: float = 20.0
    search_deg: float = 20.0
    most_m: float = 120.0

    def __post_init__(self) -> None:
        require_numbers(self, "track", self.__slots__[1:], 0, ends="(]")  # all but the size

    def photo(self, seconds: float) -> PhotoParams:
        """Returns the parameters by which a frame is aligned, so many seconds after the last."""
        place = 2.0 * (self.still_m + self.speed_m * seconds)
        turn = 2.0 * (self.still_deg + self.turn_deg * seconds)
        return self._photo(place, turn, min(turn, 4.0))

    def search(self, lost: int) -> PhotoParams:
        """Returns the parameters by which a camera is searched that was lost for so many frames."""
        # Beyond some 1750 frames the power is no number any more.
        place = min(self.search_m * 1.5 ** min(max(0, lost - 1), 100), self.most_m)
        return self._photo(place, self.search_deg, 4.0)

    def _photo(self, place_m: float, turn_deg: float, tilt_deg: float) -> PhotoParams:
        return replace(
            PhotoParams(),
            pitched_lower_m=0.0,
            fine_size=self.fine_size,
            range_x_m=place_m,
            range_y_m=place_m,
            range_z_m=place_m,
            range_yaw_deg=turn_deg,
            range_tilt_deg=tilt_deg,
            reach_px=self.reach_px,
            steps=self.steps,
        )


def half_size(size: tuple[int, int]) -> tuple[int, int]:
    """Returns half a width and height, pixels."""
    return max(8, size[0] // 2), max(8, size[1] // 2)
