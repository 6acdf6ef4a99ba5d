"""Segmenters: a photo in, the probability of building at each pixel out."""

from lodbench.segmentation.protocol import (
    BUILDING_THRESHOLD,
    InstanceSegmenter,
    MapGuidedInstanceSegmenter,
    MapGuidedSegmenter,
    Segmenter,
    binary_mask,
    check_instances,
    check_mask,
    no_wider,
    notes_of,
    resized,
)

__all__ = [
    "BUILDING_THRESHOLD",
    "InstanceSegmenter",
    "MapGuidedInstanceSegmenter",
    "MapGuidedSegmenter",
    "Segmenter",
    "binary_mask",
    "check_instances",
    "check_mask",
    "no_wider",
    "notes_of",
    "resized",
]
