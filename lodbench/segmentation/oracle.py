"""``segmenter=oracle``, ``noisy_oracle``: what networks can bring at most, made from the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import ROOF, WALL
from lodbench.datasets.inputs import Input, masks_of_labels
from lodbench.datasets.query import Entry
from lodbench.errors import QueryFault, require_numbers, require_within
from lodbench.storage import random_stream
from lodbench.synthesis.mask_degradation import degrade_mask, degraded_instances

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class OracleParams:
    """Settings of ``segmenter=oracle``.

    Attributes:
        name: Name to report.
        width: Of the mask, pixels.

    Raises:
        ConfigError: The width is out of range.
    """

    name: str = "oracle"
    width: int = 1024

    def __post_init__(self) -> None:
        require_within("segmenter.width", self.width, 16, 8192)


@dataclass(frozen=True, slots=True)
class NoisyOracleParams(OracleParams):
    """Settings of ``segmenter=noisy_oracle``.

    Attributes:
        iou: IoU of each mask with the true silhouette, in (0, 1].
        trees: Whether trees stand in front of buildings.
        merged: Of instances, share of buildings taken for one with a neighbour.
        split: Of instances, share cut in two.
        seed: Of the errors.

    Raises:
        ConfigError: A setting is out of range.
    """

    name: str = "noisy_oracle"
    iou: float = 0.88
    trees: bool = True
    merged: float = 0.1
    split: float = 0.05
    seed: int = 0

    def __post_init__(self) -> None:
        super(NoisyOracleParams, self).__post_init__()
        require_within("segmenter.iou", self.iou, 0, 1, "(]")
        require_numbers(self, "segmenter", ("merged", "split"), 0, 1)


class Oracle:
    """What the true pose shows. Whoever holds the truth draws it: a segmenter never sees a pose."""

    params_type: type[OracleParams] = OracleParams
    requires: frozenset[Input] = frozenset()
    provides = frozenset({Input.MASK, Input.INSTANCES, Input.CLASSES})

    def __init__(self, params: OracleParams) -> None:
        self.params = params
        self.name = params.name

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Never answers: a photo alone does not hold the truth.

        Raises:
            QueryFault: Always.
        """
        raise QueryFault(f"segmenter={self.name} needs the truth")

    def segment_instances(self, entry: Entry) -> Mask:
        """Never answers, as ``segment``.

        Raises:
            QueryFault: Always.
        """
        raise QueryFault(f"segmenter={self.name} needs the truth")

    def segment_classes(self, entry: Entry) -> NDArray[np.uint8]:
        """Never answers, as ``segment``.

        Raises:
            QueryFault: Always.
        """
        raise QueryFault(f"segmenter={self.name} needs the truth")

    def from_silhouette(self, silhouette: Mask, key: str) -> NDArray[np.float32]:
        """Returns the (H, W) float32 mask, 0 or 1, made of the true silhouette of the query ``key``."""
        return silhouette.astype(np.float32)

    def from_buildings(self, buildings: NDArray[np.int32], key: str) -> Mask:
        """Returns the (N, H, W) masks made of the buildings that the query ``key`` shows in truth.

        Args:
            buildings: (H, W), which building is seen, -1 for none.
            key: The query's.
        """
        return masks_of_labels(buildings + 1)

    def from_classes(self, classes: NDArray[np.uint8], key: str) -> NDArray[np.uint8]:
        """Returns the (H, W) classes made of those that the query ``key`` shows in truth."""
        return classes

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns nothing: a run's digests are of the settings, the city and the true poses already."""
        return ""


class NoisyOracle(Oracle):
    """The true silhouette, wrong as a network's masks are wrong."""

    params_type = NoisyOracleParams

    def from_silhouette(self, silhouette: Mask, key: str) -> NDArray[np.float32]:
        """Returns the (H, W) float32 mask, 0 or 1, degraded to the wanted IoU."""
        params = self.params
        assert isinstance(params, NoisyOracleParams)  # noqa: S101
        stream = random_stream(params.seed, "noisy_oracle", key)
        rough, _ = degrade_mask(silhouette, params.iou, stream, trees=params.trees)
        return rough.astype(np.float32)

    def from_buildings(self, buildings: NDArray[np.int32], key: str) -> Mask:
        """Returns the (N, H, W) masks of buildings with a network's errors: together they are the mask."""
        params = self.params
        assert isinstance(params, NoisyOracleParams)  # noqa: S101
        mask = self.from_silhouette(buildings >= 0, key) > 0
        stream = random_stream(params.seed, "noisy_oracle", key, "instances")
        labels = degraded_instances(buildings, mask, stream, merged=params.merged, split=params.split)
        return masks_of_labels(labels)

    def from_classes(self, classes: NDArray[np.uint8], key: str) -> NDArray[np.uint8]:
        """Returns the classes with a network's errors: together they are the mask.

        The border between roofs and walls wobbles like an outline; what was added to the mask is of the
        nearest class.
        """
        import cv2

        mask = self.from_silhouette(classes > 0, key) > 0
        if not mask.any() or not classes.any():
            return np.zeros_like(classes)
        away = [cv2.distanceTransform((classes != k).view(np.uint8), cv2.DIST_L2, 5) for k in (ROOF, WALL)]
        params = self.params
        assert isinstance(params, NoisyOracleParams)  # noqa: S101
        stream = random_stream(params.seed, "noisy_oracle", key, "classes")
        roofs, _ = degrade_mask(away[0] < away[1], params.iou, stream, trees=False)
        return np.where(mask, np.where(roofs, ROOF, WALL), 0).astype(np.uint8)
