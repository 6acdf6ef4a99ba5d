import csv
import io
import json

import pytest

from lodbench.errors import DatasetError
from lodbench.reporting.tables import FORMATS, format_csv, format_text, read_summary, tables_of


def summary(variant: str, recall: float, tilt: str = "truth", queries: str = "q", masks: str = "m") -> dict:
    def split(value: float) -> dict:
        return {
            "num_queries": 40,
            "num_failed": 1,
            "recall": {"2m-2deg": value, "5m-5deg": 100.0},
            "median_translation_m": 0.725,
            "median_rotation_deg": None,
            "hypotheses_per_query": 2425.0,
        }

    return {
        "dataset": {"name": "demo", "version": "town 1", "queries": queries, "masks": masks, "scene": "s"},
        "method": {"name": "lodlocv2", "variant": variant},
        "protocol": {"tilt": tilt, "seed": 0, "segmenter": "masks", "renderer": "silhouette", "lod": "1"},
        "splits": {"in_place": split(recall), "out_of_place": split(recall / 2)},
        "prior": {"in_place": split(0.0), "out_of_place": split(0.0)},
    }


def test_runs_of_one_protocol_share_a_table_under_the_prior():
    (table,) = tables_of([summary("no_refine", 11.68), summary("full", 97.9)])
    assert [label for label, _ in table.rows] == ["Prior", "lodlocv2 no refine", "lodlocv2 full"]
    assert table.splits == ("in_place", "out_of_place")


@pytest.mark.parametrize("other", [{"tilt": "prior"}, {"queries": "other"}, {"masks": "other"}])
def test_other_protocols_and_other_queries_never_share_a_table(other):
    assert len(tables_of([summary("full", 97.9), summary("full", 40.0, **other)])) == 2


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_every_format_holds_every_number(name):
    (table,) = tables_of([summary("full", 97.9)])
    text = FORMATS[name](table)
    for number in ("97.90", "48.95", "100.00"):
        assert number in text


def test_text_is_aligned_and_dashes_what_is_not_known():
    (table,) = tables_of([summary("full", 97.9)])
    lines = format_text(table).splitlines()
    assert "0.72/-" in lines[-1] or "0.73/-" in lines[-1]
    assert len({len(line) for line in lines[-3:]}) == 1


def test_csv_has_a_line_per_method_and_split():
    (table,) = tables_of([summary("full", 97.9)])
    rows = list(csv.DictReader(io.StringIO(format_csv(table))))
    assert [(row["method"], row["split"], row["2m-2deg"]) for row in rows] == [
        ("Prior", "in_place", "0.00"),
        ("Prior", "out_of_place", "0.00"),
        ("lodlocv2 full", "in_place", "97.90"),
        ("lodlocv2 full", "out_of_place", "48.95"),
    ]


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="summary"):
        read_summary(tmp_path)
    (tmp_path / "summary.json").write_text(json.dumps([1]))
    with pytest.raises(DatasetError, match="not a run summary"):
        read_summary(tmp_path)
