"""Before any work: whether a run has what its method and its segmenter need."""

from __future__ import annotations

from collections.abc import Sequence

from lodbench.datasets.inputs import Input, declared_inputs, inputs_of, require_inputs
from lodbench.datasets.query import Dataset, Entry
from lodbench.methods import Method
from lodbench.segmentation import Segmenter
from lodbench.segmentation.oracle import Oracle

# What segmenters make, from whatever they themselves need.
SEGMENTED = frozenset({Input.MASK, Input.INSTANCES, Input.MASK_ON_DEMAND})
_LACKING = "the dataset has none"


def needs_segmenter(method: object) -> bool:
    """Tells whether a method looks at what a segmenter makes."""
    return bool(segmented_inputs(method))


def segmented_inputs(method: object) -> frozenset[Input]:
    """Returns what a method needs of a segmenter; one that declares nothing looks at masks."""
    return declared_inputs(method, "requires", {Input.MASK}) & SEGMENTED


def made_inputs(method: object) -> frozenset[Input]:
    """Returns what is made for a method query by query: by the segmenter, and of the truth for an oracle."""
    truth = declared_inputs(method, "requires", {Input.MASK}) & {Input.TRUE_PIXELS}
    return segmented_inputs(method) | truth


def is_oracle(method: Method, segmenter: Segmenter) -> bool:
    """Tells whether a method is shown the truth, by itself or by what makes its masks."""
    return Input.TRUE_PIXELS in made_inputs(method) or (
        needs_segmenter(method) and isinstance(segmenter, Oracle)
    )


def required_inputs(method: Method, segmenter: Segmenter) -> frozenset[Input]:
    """Returns what a run needs of its dataset: for its method, and for its segmenter where one is asked."""
    requires = declared_inputs(method, "requires", {Input.MASK}) - SEGMENTED
    return requires | declared_inputs(segmenter, "requires") if needs_segmenter(method) else requires


def require_run_inputs(
    method: Method, segmenter: Segmenter, dataset: Dataset, entries: Sequence[Entry]
) -> None:
    """Makes sure that a method and, if it is needed, the segmenter have what they need.

    What single queries lack is no matter of this: it is theirs, and counted.

    Raises:
        ConfigError: The method or the segmenter declares something that is no input.
        DatasetError: Something is missing; the hint says how to give it.
    """
    requires = declared_inputs(method, "requires", {Input.MASK})
    has = inputs_of(dataset, entries)
    made = frozenset[Input]()
    if needs_segmenter(method):
        made = declared_inputs(segmenter, "provides", {Input.MASK})
        made |= {Input.MASK_ON_DEMAND} if Input.MASK in made else set()
        name = f"segmenter={segmenter.name}"
        require_inputs(f"method={method.name}", requires & SEGMENTED, made, f"{name} makes none")
        require_inputs(name, declared_inputs(segmenter, "requires"), has, _LACKING)
    require_inputs(f"method={method.name}", requires - SEGMENTED, has, _LACKING)
