import copy
import csv
import io
import json
import re

import pytest

from lodbench.errors import ConfigError, DatasetError
from lodbench.reporting.summaries import read_summary, with_seconds, with_settings
from lodbench.reporting.table_heads import names_of
from lodbench.reporting.tables import FORMATS, format_csv, format_text, tables_of


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
    assert [line.label for line in table.lines] == ["Prior", "lodlocv2 no refine", "lodlocv2 full"]
    assert table.splits == ("in_place", "out_of_place")


@pytest.mark.parametrize("other", [{"tilt": "prior"}, {"queries": "other"}, {"masks": "other"}])
def test_other_protocols_and_other_queries_never_share_a_table(other):
    assert len(tables_of([summary("full", 97.9), summary("full", 40.0, **other)])) == 2


def test_runs_on_other_photos_never_share_a_table():
    by_day, by_night, masks = (summary(name, 97.9) for name in ("day", "night", "masks"))
    by_day["dataset"]["images"], by_night["dataset"]["images"] = "d", "n"
    assert len(tables_of([by_day, masks])) == 1
    assert len(tables_of([by_day, by_night])) == 2
    assert len(tables_of([by_day, by_night, masks])) == 3


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_every_format_holds_every_number(name):
    (table,) = tables_of([summary("full", 97.9)])
    text = FORMATS[name](table)
    for number in ("97.9", "48.95", "100") if name == "csv" else ("97.90", "48.95", "100.00"):
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
        ("Prior", "in_place", "0"),
        ("Prior", "out_of_place", "0"),
        ("lodlocv2 full", "in_place", "97.9"),
        ("lodlocv2 full", "out_of_place", "48.95"),
    ]


def test_a_folder_that_is_no_run_of_this_schema_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="summary"):
        read_summary(tmp_path)
    for content, words in (([1], "not a run summary"), ({**summary("full", 1.0), "schema": 1}, "schema 1")):
        (tmp_path / "summary.json").write_text(json.dumps(content))
        with pytest.raises(DatasetError, match=words):
            read_summary(tmp_path)


@pytest.mark.attack
@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("splits",), -1),
        (("splits", "in_place", "recall"), [1]),
        (("splits", "in_place", "recall", "2m-2deg"), {"a": 1}),
        (("splits", "in_place", "num_failed"), 10**26),
        (("splits", "in_place", "recall_interval_95"), {"2m-2deg": [1.0]}),
        (("splits", "in_place", "metrics"), 10**400),
        (("prior", "in_place", "median_translation_m"), "x"),
        (("protocol",), {}),
        (("method", "name"), None),
        (("dataset", "images"), ["a"]),
        (("schema",), 2),
    ],
)
def test_a_summary_of_another_form_is_one_line(tmp_path, place, value):
    changed = {**copy.deepcopy(summary("full", 97.9)), "schema": 3, "notes": []}
    if place == ("schema",):
        changed["splits"] = 5
    target = changed
    for key in place[:-1]:
        target = target[key]
    target[place[-1]] = value
    (tmp_path / "summary.json").write_text(json.dumps(changed))
    with pytest.raises(DatasetError, match="not a run summary") as fault:
        read_summary(tmp_path)
    assert len(fault.value.message) < 600


def test_runs_of_one_method_are_reported_apart_by_what_differs():
    runs = [summary("full", 90.0), summary("full", 95.0)]
    for run, steps in zip(runs, (40, 5), strict=True):
        run["method"]["params"] = {"steps": steps, "beams": 2}
    (table,) = tables_of(runs)
    assert [line.label for line in table.lines] == [
        "Prior",
        "lodlocv2 full steps=5",
        "lodlocv2 full steps=40",
    ]


def test_seeds_become_one_row_with_mean_and_spread():
    runs = [summary("full", value) for value in (90.0, 94.0, 98.0)]
    for seed, run in enumerate(runs):
        run["protocol"]["seed"] = seed
    assert len(tables_of(runs)) == 3
    (table,) = tables_of(runs, over_seeds=True)
    assert [line.label for line in table.lines] == ["Prior", "lodlocv2 full (3 seeds)"]
    assert "94.00 ±4.00" in format_text(table)
    assert r"94.00 $\pm$4.00" in FORMATS["latex"](table)


def test_runs_of_one_method_are_named_by_what_sets_them_apart():
    runs = [summary("full", 97.9, tilt="prior"), summary("full", 97.9), summary("no_select", 90.0)]
    runs[1]["protocol"]["seed"] = 3
    assert names_of(runs) == [
        "lodlocv2 full tilt=prior seed=0",
        "lodlocv2 full tilt=truth seed=3",
        "lodlocv2 no select tilt=truth",
    ]
    assert names_of([runs[0], runs[0]]) == ["lodlocv2 full #1", "lodlocv2 full #2"]


def test_tables_and_runs_that_are_called_alike_say_how_their_data_were_set():
    """As of dataset=views: its version says neither the city nor how far priors are off."""
    runs = [
        with_settings(
            summary("full", value, queries=city),
            {
                "dataset": {"name": "views", "range_m": 30.0, "area": None, "world": {"focal": focal}},
                "limit": None,
            },
            f"cities/{city}",
        )
        for value, city, focal in ((90.0, "a.obj", 0.0), (80.0, "b.obj", 0.03))
    ]
    head = "demo (town 1) · LoD1 · tilt=truth · segmenter=masks · seed=0"
    assert [table.title for table in tables_of(runs)] == [
        f"{head} · city=a.obj · world.focal=0.0",
        f"{head} · city=b.obj · world.focal=0.03",
    ]
    assert names_of(runs) == [
        "lodlocv2 full city=a.obj world.focal=0.0",
        "lodlocv2 full city=b.obj world.focal=0.03",
    ]
    assert [table.title for table in tables_of(runs[:1])] == [head]


def test_rows_and_tables_say_which_settings_of_their_segmenter_differ():
    runs = []
    for masks, weights, size in (("a", "nets/a.onnx", 512), ("b", "nets/b.onnx", 512), ("c", None, None)):
        settings = {"weights": weights, "size": size} if size else {}
        run = summary("full", 90.0, masks=masks)
        run["protocol"]["segmenter"] = "net" if size else "masks"
        segmenter = {"name": run["protocol"]["segmenter"], **settings}
        runs.append(with_settings(run, {"dataset": {"name": "demo"}, "segmenter": segmenter}, None))
    heads = [table.title.split("seed=0")[1] for table in tables_of(runs)]
    assert heads == [" · segmenter.weights=a.onnx", " · segmenter.weights=b.onnx", ""]
    (table,) = tables_of(runs, free={"segmenter"})
    assert [line.label for line in table.lines[1:]] == [
        "lodlocv2 full segmenter=masks",
        "lodlocv2 full segmenter=net segmenter.weights=a.onnx",
        "lodlocv2 full segmenter=net segmenter.weights=b.onnx",
    ]


def test_a_setting_that_is_not_the_default_is_named_where_another_table_has_it_otherwise():
    runs = []
    for steps, masks in ((3, "a"), (5, "b")):
        run = summary("full", 90.0, masks=masks)
        run["method"]["params"] = {"steps": steps}
        runs.append(with_settings(run, {"dataset": {}, "method": {"name": "lodlocv2", "steps": steps}}, None))
    assert [table.lines[-1].label for table in tables_of(runs)] == [
        "lodlocv2 full steps=3",
        "lodlocv2 full steps=5",
    ]
    assert [table.lines[-1].label for table in tables_of(runs[:1])] == ["lodlocv2 full"]


def test_failures_over_seeds_are_a_mean_and_none_is_rounded_away():
    runs = [summary("full", 90.0) for _ in range(4)]
    for seed, run in enumerate(runs):
        run["protocol"]["seed"] = seed
        run["splits"]["in_place"]["num_failed"] = int(seed == 3)
    (table,) = tables_of(runs, over_seeds=True)
    prior, mean = (line.splits["in_place"] for line in table.lines)
    assert (prior["failed"], mean["failed"], mean["failed spread"]) == (1, 0.25, 0.5)
    column = table.shown()[-1]
    assert [column.text(row) for row in (prior, mean)] == ["1", "0.2 ±0.5"]


def test_a_seed_counts_once_in_a_mean_over_seeds():
    runs = [summary("full", value) for value in (90.0, 94.0, 94.0)]
    for seed, run in zip((0, 1, 1), runs, strict=True):
        run["protocol"]["seed"] = seed
    with pytest.raises(ConfigError, match="2 of the runs of lodlocv2 full have seed 1"):
        tables_of(runs, over_seeds=True)
    assert len(tables_of(runs)) == 2


@pytest.mark.parametrize(("name", "words"), [("code", "code"), ("weights", "weights"), ("masks", "masks")])
def test_a_mean_over_seeds_is_of_runs_that_are_otherwise_alike(name, words):
    runs = [summary("full", 97.9), summary("full", 95.0), summary("full", 96.0)]
    for seed, run in enumerate(runs):
        run["protocol"] = {**run["protocol"], "seed": seed}
    runs[0]["dataset"][name] = runs[1]["dataset"][name] = "a"
    runs[2]["dataset"].pop(name, None)  # one that does not say
    (table,) = tables_of(runs, free={"segmenter"}, over_seeds=True)
    assert "3 seeds" in table.lines[-1].label
    runs[1]["dataset"][name] = "b"
    with pytest.raises(ConfigError, match=f"differ in their {words}, not in their seed alone"):
        tables_of(runs, free={"segmenter"}, over_seeds=True)


def test_what_is_freed_stands_in_the_row():
    runs = [summary("full", 90.0), summary("full", 95.0)]
    runs[1]["protocol"]["lod"] = "2"
    runs[1]["dataset"]["scene"] = "other"
    assert len(tables_of(runs)) == 2
    (table,) = tables_of(runs, free=["lod"])
    assert [line.label for line in table.lines[1:]] == ["lodlocv2 full lod=1", "lodlocv2 full lod=2"]


@pytest.mark.parametrize(
    ("columns", "metrics", "cells"),
    [
        (
            "details",
            {"median_horizontal_m": 0.31, "median_vertical_m": 0.62, "median_yaw_deg": 0.04},
            ("61.50", "99.10", "0.31", "0.62", "0.04", "2425", "0.51"),
        ),
        ("segmenter", {"mask_iou": 0.8765}, ("IoU", "0.88")),
        (
            "calibration",
            {"mean_confidence_percent": 91.25, "ece_percent": 3.5, "aurc_percent": 0.75},
            ("91.25", "3.50", "0.75"),
        ),
    ],
)
def test_columns_of_a_group_show_its_numbers(columns, metrics, cells):
    run = summary("full", 97.9)
    areas, of_answered = {"2m-2deg": 61.5, "5m-5deg": 80.0}, {"2m-2deg": 99.1, "5m-5deg": 100.0}
    run["splits"]["in_place"] |= {"auc": areas, "recall_of_answered": of_answered, "metrics": metrics}
    (table,) = tables_of([with_seconds(run, {"in_place": 0.51})])
    text = format_text(table.with_columns(columns))
    assert [cell for cell in cells if cell not in text] == []
    assert columns != "segmenter" or "T.e./R.e." not in text


def test_hostile_names_are_harmless_in_every_format():
    run = summary("full", 97.9)
    run["method"]["name"] = "=<script>\x1b[31m&%_"
    (table,) = tables_of([run])
    texts = {name: render(table) for name, render in FORMATS.items()}
    assert not any("\x1b" in text for text in texts.values())
    assert "<script>" not in texts["html"] + texts["markdown"]
    assert "\n'=<script>" in texts["csv"].replace(",'=", "\n'=")
    assert r"\&\%\_" in texts["latex"]


@pytest.mark.parametrize("name", ["[ours]", "*ours"])
def test_no_row_of_latex_begins_with_what_the_row_above_would_take(name):
    named = summary("", 90.0)
    named["method"]["name"] = name
    (table,) = tables_of([named])
    assert f"\n{{}}{name} & " in FORMATS["latex"](table)


def test_best_numbers_are_bold_in_latex():
    (table,) = tables_of([summary("no_refine", 11.68), summary("full", 97.9)])
    assert r"\textbf{97.90}" in FORMATS["latex"](table)
    assert r"\textbf{11.68}" not in FORMATS["latex"](table)


def bold(*runs: dict) -> list[str]:
    """Returns what a table of runs has in bold."""
    (table,) = tables_of(list(runs))
    return re.findall(r"\\textbf\{(.*?)\}", FORMATS["latex"](table))


def test_a_recall_of_zero_and_the_prior_are_never_bold():
    runs = [summary("no_refine", 0.0), summary("full", 0.0)]
    for run in (*runs, runs[0]):
        for split in run["splits"].values():
            split["recall"]["5m-5deg"] = 0.0
    assert bold(*runs) == []
    prior = copy.deepcopy(runs[0])
    prior["method"] = {"name": "prior_only", "variant": ""}
    for split in prior["splits"].values():
        split["recall"]["2m-2deg"] = 99.0
    runs[1]["splits"]["in_place"]["recall"]["2m-2deg"] = 5.0
    assert bold(*runs, prior) == ["5.00"]


@pytest.mark.parametrize(("rotation_deg", "found"), [(0.1, ["0.50/0.10"] * 2), (0.3, [])])
def test_a_cell_of_two_numbers_is_bold_if_both_are_best(rotation_deg, found):
    runs = [summary("no_refine", 0.0), summary("full", 0.0)]
    for run, numbers in zip(runs, ((0.725, 0.2), (0.5, rotation_deg)), strict=True):
        for split in run["splits"].values():
            split["median_translation_m"], split["median_rotation_deg"] = numbers
            split["recall"] = {"2m-2deg": 0.0}
    assert bold(*runs) == found


def test_a_number_of_any_metric_is_a_column_by_its_name():
    run = summary("full", 97.9)
    run["splits"]["in_place"]["metrics"] = {"worst_m": 12.3456}
    (table,) = tables_of([run])
    assert "12.35" in format_text(table.with_columns("worst_m"))
    assert "12.3456" in format_csv(table)
    with pytest.raises(ConfigError, match="no columns 'wurst_m'"):
        table.with_columns("wurst_m")


@pytest.mark.parametrize(
    "name", ["2m-2deg", "median_translation_m", "failed", "2m-2deg spread", "AUC 5m-5deg"]
)
def test_no_metric_stands_for_a_number_of_another_name(name):
    run = summary("full", 97.9)
    before = format_csv(*tables_of([run])), format_text(*tables_of([run]))
    run["splits"]["in_place"]["metrics"] = {name: 12.0}
    assert (format_csv(*tables_of([run])), format_text(*tables_of([run]))) == before


def test_summaries_of_the_last_version_are_read_under_todays_names(tmp_path):
    old = {**summary("full", 97.9), "schema": 2}
    calibration = {"said": 91.25, "said_found": 3.5, "risk_area": 0.75}
    old["splits"]["in_place"] |= {"mask_iou": 0.9, "calibration": calibration}
    (tmp_path / "summary.json").write_text(json.dumps(old))
    found = read_summary(tmp_path)["splits"]["in_place"]
    numbers = {"mean_confidence_percent": 91.25, "ece_percent": 3.5, "aurc_percent": 0.75, "mask_iou": 0.9}
    assert found["metrics"] == numbers
    assert found["recall"] == old["splits"]["in_place"]["recall"]


def test_intervals_of_areas_and_medians_stand_beside_them():
    shown = summary("full", 97.9)
    shown["splits"]["in_place"] |= {
        "auc": {"2m-2deg": 61.0},
        "auc_interval_95": {"2m-2deg": [50.04, 71.0]},
        "median_interval_95": {"translation_m": [0.612, None], "rotation_deg": [None, None]},
    }
    (table,) = tables_of([shown])
    intervals = table.with_columns("intervals")
    line = intervals.lines[1]
    cells = {column.head: column.text(numbers) for column, numbers in list(intervals.cells(line))[:6]}
    assert cells["AUC 2m-2deg"] == "61.00 [50.0, 71.0]"
    assert cells["T.e."] == "0.72 [0.61, -]"  # so few were found that the median may be infinite
    assert cells["R.e."] == "-"
