"""`lodbench bench maps`: its table, figures and picture from answers, and what it refuses."""

import numpy as np
import pandas as pd
import pytest

from lodbench.bench import maps
from lodbench.bench.maps import MapsOptions, measure_maps
from lodbench.evaluation.queries import ERROR


@pytest.fixture
def answered(monkeypatch):
    """Answers of two methods: over the surface model all are found, over the blocks those in place."""
    asked = []

    def queries_of(demo, survey, name, method, options):
        asked.append((name, method))
        is_found = np.array([True, True, name == "DSM", name == "DSM"])
        return pd.DataFrame(
            {
                ERROR[0]: np.where(is_found, 0.5, 40.0),
                ERROR[1]: np.where(is_found, 0.1, 9.0),
                "split": ["in_place", "in_place", "out_of_place", "out_of_place"],
                "map": name,
                "method": method,
                "triangles": 12_000,
                "cpu_s": 1.5,
            }
        )

    class Demo:
        root, version = None, "town 0"

    monkeypatch.setattr(maps, "_queries_of", queries_of)
    monkeypatch.setattr(maps, "open_demo", lambda params: Demo())
    monkeypatch.setattr(maps, "surveyed", lambda root, seed: None)
    return asked


def test_a_row_per_map_and_method_and_a_picture(answered, tmp_path):
    report = measure_maps(MapsOptions(maps=("LoD1", "DSM")))
    assert answered == [(m, k) for m in ("LoD1", "DSM") for k in ("region", "contour_alignment")]
    rows = {line[:26].strip(): line.split() for line in report.text.splitlines() if "12,000" in line}
    assert [row[-6:-4] for row in rows.values()] == [
        ["100", "0"],
        ["100", "0"],
        ["100", "100"],
        ["100", "100"],
    ]
    found = {each.figure: each.value for each in report.figures}
    assert found["within (2 m, 2 deg), region, LoD1, out_of_place"] == 0.0
    assert found["within (2 m, 2 deg), region, DSM, out_of_place"] == 100.0
    assert found["median error, region, DSM"] == 0.5
    report.write_pictures(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"maps.png", "maps.svg"}
