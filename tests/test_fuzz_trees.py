"""A slice of the trees of ``make fuzz``."""

from copy import deepcopy

import numpy as np
import pytest

from lodbench.datasets.inputs import declared_inputs
from lodbench.errors import ConfigError
from tests.fuzz_trees import MADE, fuzz, mutate_tree

# Whole commands, half a second each.
SLOW = {"plug-in", "verify summary.json", "verify provenance.json"}


def test_a_tree_is_changed_and_its_original_is_not():
    before, changed = deepcopy(MADE), [mutate_tree(MADE, np.random.default_rng(k)) for k in range(200)]
    assert before == MADE
    assert sum(repr(tree) != repr(MADE) for tree in changed) > 180
    assert len({type(tree) for tree in changed}) > 3


@pytest.mark.filterwarnings("ignore")
def test_trees_of_the_wrong_shape_are_read_or_refused():
    seen = fuzz(range(390), seed=1, without=SLOW)
    assert seen["read"] > 50
    assert seen["refused"] > 150


@pytest.mark.filterwarnings("ignore")
@pytest.mark.nightly
def test_whole_commands_over_trees_of_the_wrong_shape():
    assert fuzz(range(90), seed=5).total() == 90


@pytest.mark.parametrize("declared", [None, 3, object()])
def test_inputs_that_are_no_set_are_named(declared):
    part = type("Part", (), {"name": "kit", "requires": declared})
    with pytest.raises(ConfigError, match=r"kit says requires .*, which are no inputs\."):
        declared_inputs(part, "requires")
