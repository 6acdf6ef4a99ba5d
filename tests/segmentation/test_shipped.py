"""The weights in the package: those of their record, small, and run without torch."""

import subprocess
import sys

import pytest

from lodbench.segmentation.compact import Compact, CompactParams
from lodbench.segmentation.efficient_unet import EfficientUnet, EfficientUnetParams
from lodbench.storage import file_digest

SHIPPED = {"compact": Compact(CompactParams()), "efficient_unet": EfficientUnet(EfficientUnetParams())}


@pytest.mark.parametrize(("name", "most_bytes"), [("compact", 8_000_000), ("efficient_unet", 20_000_000)])
def test_the_weights_are_those_of_their_record(name, most_bytes):
    network = SHIPPED[name]
    path = network.packaged_weights()
    assert network.packaged_training()["weights"][path.name] == file_digest(path)
    assert path.stat().st_size <= most_bytes


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [("compact", "Compact"), ("efficient_unet", "EfficientUnet")])
def test_they_answer_without_torch_and_say_where_they_come_from(name, kind):
    code = f"""
import sys
import numpy as np
from lodbench.segmentation.{name} import {kind}, {kind}Params
network = {kind}({kind}Params())
found = network.probability(np.full((90, 120, 3), 128, np.uint8))
assert found.shape == (384, 512) and found.dtype == np.float32
assert 0 <= found.min() <= found.max() <= 1
assert "torch" not in sys.modules
print(network.notes()[0])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "domain: synthetic" in done.stdout
