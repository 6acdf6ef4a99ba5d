"""Segmenters: a photo in, the probability of building at each pixel out."""

from lodbench.segmentation.protocol import Segmenter, binary_mask, check_mask

__all__ = ["Segmenter", "binary_mask", "check_mask"]
