"""How well a camera's numbers are known, by where they come from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from lodbench.errors import LodbenchError, nearest_names

# Words of text files and ``--camera``: what follows "=", by the field's name; two in percent.
_WORDS = {"sigma_f": "focal_percent", "sigma_c": "center_percent", "sigma_k1": "k1", "sigma_by": "source"}
_PERCENTS = ("sigma_f", "sigma_c")
STATED: Final = "stated"
# Further off, a number says nothing; tilt, distortion and place would take up any of them.
_MOST = {"sigma_f": 100.0, "sigma_c": 100.0, "sigma_k1": 10.0}


@dataclass(frozen=True, slots=True)
class CameraSigmas:
    """Standard deviations of a camera's numbers.

    Attributes:
        focal_percent: Of the focal length, percent of it.
        center_percent: Of the principal point along each axis, percent of the image's width.
        k1: Of the first coefficient of radial distortion, normalised image coordinates.
        source: Where the numbers come from, a word: ``calibration``; of a photo, the ``source`` of its
            ``PhotoCamera``; ``stated`` where a person gave the deviations themselves.
    """

    focal_percent: float
    center_percent: float
    k1: float
    source: str

    @property
    def are_zero(self) -> bool:
        """Tells whether nothing is in doubt."""
        return not (self.focal_percent or self.center_percent or self.k1)

    @property
    def stated_focal_percent(self) -> float | None:
        """Returns the deviation of a focal length that a person stated, percent; else None."""
        return self.focal_percent if self.source == STATED and self.focal_percent else None

    def words(self) -> list[str]:
        """Returns it in words of a text file; none where nothing is in doubt."""
        if self.are_zero:
            return []
        return [
            f"{word}={getattr(self, name)}{'%' if word in _PERCENTS else ''}"
            for word, name in _WORDS.items()
            if (word, self.source) != ("sigma_by", STATED)
        ]


# A calibration, or a camera that a person gave in full.
CALIBRATED: Final = CameraSigmas(0.0, 0.0, 0.0, "calibration")
# The maker's calibrated focal length, optical centre or distortion, in pixels.
MAKER: Final = CameraSigmas(0.5, 0.35, 0.01, "maker")
# Only a focal length in millimetres, or as the equivalent of a 35 mm camera.
UNKNOWN: Final = CameraSigmas(1.5, 0.7, 0.03, "nominal")


def split_sigmas(words: Sequence[str]) -> tuple[list[str], CameraSigmas | None]:
    """Returns a camera's words, and the deviations that ``sigma_f=0.5% sigma_c=0.35% sigma_k1=0.01`` state.

    Any may be left out, and is 0 then; None where all are. ``sigma_by=WORD`` says where they come from.

    Raises:
        LodbenchError: A word is unknown, given twice or before the camera's own, or a number is none, or not
            within 0 to 100 % (``k1``: 10).
    """
    first = next((at for at, word in enumerate(words) if "=" in word), len(words))
    given: dict[str, str] = {}
    for word in words[first:]:
        name, _, text = word.partition("=")
        if name not in _WORDS:
            raise LodbenchError(f"{word!r} is no deviation of a camera", nearest_names(name, _WORDS))
        if not text or name in given:
            raise LodbenchError(f"{name} {'is given twice' if name in given else 'has no value'}")
        given[name] = text
    focal, center, k1 = (_number(name, given.get(name, "0")) for name in _MOST)
    sigmas = CameraSigmas(focal, center, k1, given.get("sigma_by", STATED))
    return list(words[:first]), sigmas if given else None


def _number(name: str, text: str) -> float:
    unit = "%" if name in _PERCENTS else ""
    try:
        number = float(text.removesuffix(unit))
    except ValueError:
        number = -1.0
    if not 0 <= number <= _MOST[name]:
        raise LodbenchError(f"{name}={text} is not within 0 to {_MOST[name]:g}{unit}")
    return number
