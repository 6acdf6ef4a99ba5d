"""The weights in the package: those of their record, small, and run without torch."""

import subprocess
import sys

from lodbench.segmentation.compact import packaged_training, packaged_weights
from lodbench.storage import file_digest


def test_the_weights_are_those_of_their_record():
    assert packaged_training()["weights"]["compact.onnx"] == file_digest(packaged_weights())
    assert packaged_weights().stat().st_size <= 8_000_000


def test_they_answer_without_torch_and_say_where_they_come_from():
    code = """
import sys
import numpy as np
from lodbench.segmentation.compact import Compact, CompactParams
compact = Compact(CompactParams())
found = compact.probability(np.full((90, 120, 3), 128, np.uint8))
assert found.shape == (384, 512) and found.dtype == np.float32
assert 0 <= found.min() <= found.max() <= 1
assert "torch" not in sys.modules
print(compact.notes()[0])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "domain: synthetic" in done.stdout
