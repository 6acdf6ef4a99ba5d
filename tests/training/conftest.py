from __future__ import annotations

import pytest

from lodbench.synthesis.training_data.generate import generate_training_data
from lodbench.synthesis.training_data.params import TrainingParams
from tests.town import box_obj

# Few and small: what is tested does not depend on the size.
SMALL = {"pitch": [40.0], "height": [90.0], "yaw": [0.0, 120.0, 240.0], "size": (96, 80), "workers": 1}
WHOLE = {"val_share": 0.0, "test_share": 0.0}


@pytest.fixture(scope="session")
def box_file(tmp_path_factory):
    """A city of seven boxes as Wavefront OBJ."""
    path = tmp_path_factory.mktemp("boxes") / "city.obj"
    path.write_text(box_obj())
    return path


@pytest.fixture(scope="session")
def small_set(box_file, tmp_path_factory):
    """A finished training set with everything in it, and its parameters."""
    out = tmp_path_factory.mktemp("set") / "data"
    params = TrainingParams(str(box_file), str(out), labels=True, depth=True, **SMALL, **WHOLE)
    return params, generate_training_data(params)
