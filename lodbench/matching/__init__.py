"""Points that two pictures have in common: what extracts and matches them, by name."""

from lodbench.matching.protocol import (
    FeatureExtractor,
    Features,
    Matcher,
    Matches,
    check_image,
    match_images,
    open_extractor,
    open_matcher,
    open_matching,
)

__all__ = [
    "FeatureExtractor",
    "Features",
    "Matcher",
    "Matches",
    "check_image",
    "match_images",
    "open_extractor",
    "open_matcher",
    "open_matching",
]
