"""What plug-ins are tried on: seven blocks, and three photos of them with masks and priors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from lodbench.checks import FAULT, OK, Check, fault_of
from lodbench.citymodel.blocks import scene_of_blocks
from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import STOPPED, LodbenchError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.methods.conformance.rules import Violation
from lodbench.methods.conformance.trial import BLOCKS, TRUTHS
from lodbench.rendering import LayerRenderer, open_renderer

# No multiple of 64 wide: packed rows end within a word.
CAMERA = Camera(310, 230, 231.0, 229.0, 156.5, 113.0)


@dataclass(frozen=True, slots=True, eq=False)
class Tried:
    """A plug-in, and what it is tried on.

    Attributes:
        part: The class or function of its entry point.
        name: Its name.
        config: Its section of the configuration; empty for kinds that have none, None where there is none.
        make: Makes it anew from that, for kinds that are made from parameters.
        folder: An empty folder.
        scene: The blocks.
        dataset: Photos, masks, priors and truth; the scene's frame is the dataset's.
        sample: A file that the user named, for readers of formats.
    """

    part: Any
    name: str
    config: Mapping[str, Any] | None
    make: Callable[[], Any]
    folder: Path
    scene: Scene
    dataset: Dataset
    sample: Path | None

    @property
    def entries(self) -> tuple[Entry, ...]:
        """Returns the queries."""
        return self.dataset.entries

    @property
    def truths(self) -> list[Pose]:
        """Returns the true poses, in the queries' order."""
        return [self.dataset.truth[entry.key] for entry in self.entries]


Rules = Sequence[tuple[str, Callable[[], str]]]


def check_rules(rules: Rules) -> Iterator[Check]:
    """Yields how each rule is kept, up to the first that is not: the others build on it."""
    for title, rule in rules:
        try:
            yield Check("answers", title, OK, rule())
            continue
        except Violation as violation:
            yield Check("answers", title, FAULT, str(violation), violation.hint)
        except STOPPED:
            raise
        except BaseException as error:  # a plug-in may raise anything: that is the finding
            yield fault_of(error, "answers", title)
        return


def require(is_kept: bool | np.bool_, detail: str, hint: str = "") -> None:
    """Raises a violation unless a rule is kept."""
    if not is_kept:
        raise Violation(detail, hint)


def refuses(call: Callable[[], object], what: str) -> str:
    """Returns how something wrong is refused: by lodbench's own kind of error, in a line for people.

    Raises:
        Violation: It is not, or by another error.
    """
    try:
        call()
    except LodbenchError as error:
        return f"{type(error).__name__}: {error.message}"
    except STOPPED:
        raise
    except BaseException as error:  # anything else ends a run with a traceback
        raise Violation(
            f"{what} raises {type(error).__name__}: {error}", "Raise an error of lodbench.errors."
        ) from error
    raise Violation(f"{what} is taken without a word", "Raise an error of lodbench.errors.")


def trial_dataset(folder: Path) -> tuple[Scene, Dataset]:
    """Returns the blocks, and a dataset of three views; photos and masks are written to a folder."""
    scene = scene_of_blocks(BLOCKS)
    painter = cast(LayerRenderer, open_renderer("raster", scene, 1))
    entries, truth = [], {}
    for k, (pitch, roll, yaw, *center) in enumerate(TRUTHS):
        pose = Pose.from_euler(EulerAngles(pitch, roll, yaw), center)
        prior = Pose.from_euler(EulerAngles(pitch, roll, yaw + 3.0), pose.center + np.array([5.0, -4.0, 6.0]))
        photo, mask = folder / f"view_{k}.png", folder / f"mask_{k}.png"
        cv2.imwrite(str(photo), painter.draw(CAMERA, pose).colour[:, :, ::-1])
        cv2.imwrite(str(mask), painter.render(CAMERA, pose).astype(np.uint8) * 255)
        entries.append(Entry(photo.name, "trial", CAMERA, prior, photo, mask, (prior,)))
        truth[entries[-1].key] = pose
    return scene, Dataset("trial", "", folder, None, None, ("trial",), tuple(entries), truth)
