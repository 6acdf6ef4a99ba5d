"""Points that two pictures have in common: what extracts and matches them, and poses from them, by name.

Extractors and matchers are modules of their own (networks of transformers are in
``learned_matchers``); pose solvers are in ``pose_solver``; a ``retrieval`` describes whole pictures.
"""

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
