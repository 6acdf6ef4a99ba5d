"""Segmenters: a photo in, the probability of building at each pixel out."""

from lodbench.segmentation.protocol import (
    BUILDING_THRESHOLD,
    Segmenter,
    binary_mask,
    check_mask,
    notes_of,
    resized,
)

__all__ = ["BUILDING_THRESHOLD", "Segmenter", "binary_mask", "check_mask", "notes_of", "resized"]
