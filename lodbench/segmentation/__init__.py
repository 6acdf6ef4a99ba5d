"""Segmenters: a photo in, the probability of building at each pixel out."""

from lodbench.segmentation.protocol import (
    BUILDING_THRESHOLD,
    ClassSegmenter,
    InstanceSegmenter,
    MapGuidedInstanceSegmenter,
    MapGuidedSegmenter,
    Segmenter,
    binary_mask,
    check_classes,
    check_instances,
    check_mask,
    no_wider,
    notes_of,
    resized,
    resized_classes,
)

__all__ = [
    "BUILDING_THRESHOLD",
    "ClassSegmenter",
    "InstanceSegmenter",
    "MapGuidedInstanceSegmenter",
    "MapGuidedSegmenter",
    "Segmenter",
    "binary_mask",
    "check_classes",
    "check_instances",
    "check_mask",
    "no_wider",
    "notes_of",
    "resized",
    "resized_classes",
]
