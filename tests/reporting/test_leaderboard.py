"""The leaderboard: ranking, keeping apart, the schema, hostile names; its pages in a real browser."""

import copy
import csv
import io
import json
import re
from html import unescape
from pathlib import Path
from urllib.parse import unquote

import pytest

from lodbench.errors import DatasetError
from lodbench.evaluation.metrics import is_taken
from lodbench.reporting.aligned_text import csv_cell, plain_text
from lodbench.reporting.leaderboard import (
    blocks_of,
    build_leaderboard,
    entry_path,
    entry_text,
    format_leaderboard_csv,
    leaderboard_frame,
    reasons_against,
    schema_faults,
)
from tests.reporting.browser import DESK, PHONE, column_texts, fits, opened, press

DIGEST = "0123456789ab"


def entry(name: str, recall: float, *, tilt: str = "prior", prior: str = DIGEST, reasons: tuple = ()) -> dict:
    split = {
        "num_queries": 40,
        "num_failed": 1,
        "recall": {"2m-2deg": recall, "3m-3deg": recall, "5m-5deg": 100.0},
        "recall_interval_95": {"2m-2deg": [1.0, 99.0]},
        "median_translation_m": 0.725,
        "median_rotation_deg": None,
        "hypotheses_per_query": 2425.0,
        "seconds_per_query": 0.5,
    }
    return {
        "schema": 1,
        "source": "measured",
        "dataset": {"name": "town", "version": "1"},
        "method": {"name": name, "variant": "", "map": ""},
        "protocol": {
            "condition": "",
            "prior": prior,
            "split": DIGEST,
            "tilt": tilt,
            "segmenter": "masks",
            "renderer": "silhouette",
            "lod": "1",
            "seeds": [0],
            "evaluator": 1,
        },
        "splits": {"in_place": split},
        "ranking": {"ranked": not reasons, "reasons": list(reasons)},
        "hardware": {},
        "provenance": {"run": DIGEST, "notes": []},
    }


def ranks(entries: list[dict]) -> list[list[tuple[str, int | None]]]:
    blocks = blocks_of(entries)
    return [[(e["method"]["name"], r) for e, r in zip(b.entries, b.ranks, strict=True)] for b in blocks]


def test_the_better_ranks_first_and_equals_share_a_rank():
    assert ranks([entry("b", 50.0), entry("a", 90.0), entry("c", 50.0)]) == [[("a", 1), ("b", 2), ("c", 2)]]


def test_a_recall_that_is_not_known_is_worse_than_any_that_is():
    unknown, none = entry("a", 0.0), entry("b", 0.0)
    del unknown["splits"]["in_place"]["recall"]["2m-2deg"]
    none["splits"] = {}
    assert ranks([unknown, none, entry("c", 0.0)])[0][0] == ("c", 1)


@pytest.mark.parametrize("other", [{"tilt": "truth"}, {"prior": "ba9876543210"}])
def test_other_protocols_never_rank_together(other):
    assert sorted(ranks([entry("a", 90.0), entry("b", 95.0, **other)])) == [[("a", 1)], [("b", 1)]]


def test_entries_of_other_photos_rank_apart_and_those_of_none_beside_the_only_ones():
    by_day, by_night, masks = entry("day", 90.0), entry("night", 95.0), entry("masks", 50.0)
    alone = blocks_of([masks])[0]
    by_day["protocol"]["images"], by_night["protocol"]["images"] = "0123456789aa", "0123456789bb"
    assert ranks([by_day, masks]) == [[("day", 1), ("masks", 2)]]
    assert blocks_of([by_day, masks])[0].title == alone.title
    every = [by_day, by_night, masks]
    assert sorted(ranks(every)) == [[("day", 1)], [("masks", 1)], [("night", 1)]]
    assert leaderboard_frame(blocks_of(every))["protocol"].nunique() == 3
    assert len({block.title for block in blocks_of(every)}) == 3


def test_what_is_kept_apart_has_no_rank_and_says_why():
    kept = entry("oracle", 100.0, reasons=("oracle: masks made from the truth",))
    assert ranks([kept, entry("a", 90.0)]) == [[("a", 1)], [("oracle", None)]]
    assert "Kept apart: oracle" in blocks_of([kept])[0].title


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"tilt": "truth"}, "tilt=truth"),
        ({"segmenter": {"name": "noisy_oracle"}}, "noisy_oracle"),
        ({"segmenter": {"name": "net", "weights": "random"}}, "random weights"),
        ({"segmenter": {"name": "unstated"}}, "author's word"),
        ({"limit": 5}, "first 5 queries"),
        ({"split": ["in"]}, "only some splits: in"),
    ],
)
def test_reasons_against_ranking(change, reason):
    config = {"tilt": "prior", "segmenter": {"name": "masks"}, "limit": None, "split": []}
    assert reasons_against(config) == []
    assert reason in reasons_against({**config, **change})[0]


def test_whoever_is_shown_the_truth_does_not_rank_whatever_its_name():
    config = {"tilt": "prior", "segmenter": {"name": "masks"}, "method": {"name": "peek", "matcher": "own"}}
    assert reasons_against(config, None, ["queries"]) == []
    (reason,) = reasons_against(config, None, ["queries", "truth"])
    assert reason.startswith("oracle: ")
    config["method"]["matcher"] = "oracle"
    assert len(reasons_against(config, None, ["queries", "truth"])) == 1


def test_a_limit_above_all_queries_and_all_splits_leave_nothing_out():
    config = {"tilt": "prior", "segmenter": {"name": "masks"}, "limit": 20, "split": ["in", "out"]}
    assert reasons_against(config, {"in": 20, "out": 12}) == []
    assert "first 20 queries" in reasons_against(config, {"in": 21, "out": 12})[0]
    assert "only some splits" in reasons_against(config, {"in": 20, "out": 12, "far": 1})[0]


@pytest.mark.parametrize("name", ["=1+1", "+cmd", "-2", "@sum", "\x1b[31m=red", "\t=tab"])
def test_csv_cells_are_no_formulas_and_drive_no_terminal(name):
    hostile = entry("x", 1.0)
    hostile["method"]["variant"] = name
    (line,) = csv.DictReader(io.StringIO(format_leaderboard_csv(blocks_of([hostile]))))
    assert line["variant"].startswith("'")
    assert "\x1b" not in line["variant"]


def test_numbers_stay_numbers_and_text_stays_text():
    assert [csv_cell(v) for v in (-1.5, 0, None, "-", "a=b", "=x")] == ["-1.5", "0", "", "-", "a=b", "'=x"]
    assert plain_text("a\x1b]8;;http://x\x07b\x1b[0m\u202ec\n") == "ab c"


class TestSchema:
    def test_accepts_an_entry(self):
        assert schema_faults(entry("a", 50.0)) == []

    @pytest.mark.attack
    @pytest.mark.parametrize(
        ("path", "value", "said"),
        [
            (("schema",), 2, "entry.schema: 1 was expected"),
            (("source",), "guessed", "is not one of"),
            (("dataset", "name"), "=x", "does not match"),
            (("protocol", "prior"), "xyz", "does not match"),
            (("protocol", "seeds"), [0.5], "is not of type 'integer'"),
            (("ranking", "ranked"), 1, "is not of type 'boolean'"),
            (("splits", "in_place", "recall", "2m-2deg"), 101.0, "is greater than the maximum"),
            (("splits", "in_place", "recall", "2m-2deg"), float("nan"), "is not of type 'number'"),
            (("splits", "in_place", "recall_interval_95", "2m-2deg"), [1.0], "is too short"),
            (("splits", "in_place", "extra"), 1, "was unexpected"),
            (("splits",), {}, "entry.splits: {} should be non-empty"),
        ],
    )
    def test_refuses(self, path, value, said):
        changed = copy.deepcopy(entry("a", 50.0))
        target = changed
        for key in path[:-1]:
            target = target[key]
        target[path[-1]] = value
        assert said in schema_faults(changed)[0]
        with pytest.raises(DatasetError, match="no leaderboard entry"):
            entry_text(changed)

    @pytest.mark.parametrize(
        "name", ["rank", "2m-2deg", "median_rotation_deg", "5m-5deg low", "kept apart because"]
    )
    def test_no_metric_takes_the_name_of_a_column(self, name):
        changed = entry("a", 50.0)
        changed["splits"]["in_place"]["metrics"] = {name: 1.0}
        assert f"entry.splits.in_place.metrics: {name} is a name" in schema_faults(changed)[0]

    def test_no_column_is_free_for_a_metric(self):
        columns = leaderboard_frame(blocks_of([entry("a", 50.0)])).columns
        assert [name for name in columns if not is_taken(name)] == ["mask_iou"]

    def test_names_what_is_missing(self):
        assert "entry: 'splits' is a required property" in schema_faults({"schema": 1})


@pytest.mark.attack
def test_an_entry_under_another_dataset_or_malformed_is_refused(tmp_path):
    path = entry_path(tmp_path, entry("a", 50.0))
    assert path.name == f"a-{DIGEST}.json"
    path.parent.mkdir(parents=True)
    path.write_text(entry_text(entry("a", 50.0)))
    assert {p.name for p in build_leaderboard(tmp_path)} == set(
        """
        index.html town.csv town.html town.md town.tex
    """.split()
    )
    moved = tmp_path / "entries" / "other" / "a.json"
    moved.parent.mkdir()
    moved.write_text(path.read_text())
    with pytest.raises(DatasetError, match="is of dataset town"):
        build_leaderboard(tmp_path)
    moved.write_text(json.dumps({"schema": 1}))
    with pytest.raises(DatasetError, match="'source' is a required property"):
        build_leaderboard(tmp_path)
    for text in ("[" * 100_000, json.dumps(entry("a", 50.0)).replace('"version": "1"', '"version": NaN')):
        moved.write_text(text)
        with pytest.raises(DatasetError, match="not readable as JSON"):
            build_leaderboard(tmp_path)


def test_runs_of_one_method_are_named_by_the_settings_that_differ(tmp_path):
    """In all four formats, as `compare` names them; the CSV has them in a column."""
    entries = [entry("shake", 50.0), entry("shake", 90.0), entry("steady", 70.0)]
    for each, tries in zip(entries, (64, 1024, 9), strict=True):
        each["method"]["params"] = {"name": each["method"]["name"], "tries": tries, "sigma_m": 3.0}
        each["provenance"]["run"] = f"{tries:012d}"
        path = entry_path(tmp_path, each)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(entry_text(each))
    texts = {path.suffix: text for path, text in build_leaderboard(tmp_path).items() if path.stem == "town"}
    for suffix in (".md", ".tex", ".html"):
        for name in ("1. shake tries=1024", "2. steady", "3. shake tries=64"):
            assert f"{name}<" in texts[suffix] or f"{name} " in texts[suffix], suffix
        assert "sigma" not in texts[suffix]
    rows = list(csv.DictReader(io.StringIO(texts[".csv"])))
    assert [(row["method"], row["settings"]) for row in rows] == [
        ("shake", "tries=1024"), ("steady", ""), ("shake", "tries=64"),
    ]  # fmt: skip
    index = next(text for path, text in build_leaderboard(tmp_path).items() if path.stem == "index")
    assert "shake tries=1024" in index


def test_a_metric_of_a_plug_in_is_a_column_of_every_file_of_its_board(tmp_path):
    with_it, without = entry("a", 90.0), entry("b", 50.0)
    with_it["splits"]["in_place"]["metrics"] = {"p90_m": 4.125, "median_yaw_deg": 0.5}
    for each in (with_it, without):
        path = entry_path(tmp_path, each)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(entry_text(each))
    texts = {path.name: text for path, text in build_leaderboard(tmp_path).items()}
    rows = list(csv.DictReader(io.StringIO(texts["town.csv"])))
    assert [row["p90_m"] for row in rows] == ["4.125", ""]
    markdown = texts["town.md"].splitlines()
    assert any(line.endswith("in_place p90_m |") for line in markdown)
    assert [line.split("|")[-2].strip() for line in markdown if line.startswith("| 1. a")] == ["4.12"]
    assert r"& p90\_m" in texts["town.tex"]
    assert ">p90_m</button>" in texts["town.html"]
    # Metrics of lodbench's own have their places already.
    assert "median_yaw_deg" not in texts["town.md"]


def test_settings_that_are_not_the_defaults_are_always_named():
    plain, other = entry("flight", 90.0), entry("flight", 80.0, prior="ba9876543210")
    other["method"] |= {"params": {"single": "region", "weights": "/a/b.pt"}}
    other["method"]["settings"] = {"single": "region", "weights": "/a/b.pt"}
    frame = leaderboard_frame(blocks_of([plain, other]))
    # Of other priors: they stand in blocks of their own.
    assert sorted(frame["settings"]) == ["", "single=region weights=b.pt"]
    assert schema_faults(other) == []


ROOT = Path(__file__).resolve().parents[2] / "leaderboard"
PAGE = ROOT / "uavd4l_lodv2.html"


@pytest.mark.slow
@pytest.mark.parametrize(("size", "scheme"), [(DESK, "light"), (PHONE, "dark")])
def test_the_page_is_readable_and_quiet(size, scheme):
    with opened(PAGE, size, scheme) as (page, complaints):
        assert "1.13/044" in page.inner_text("main")
        assert fits(page)
        ink, paper = page.evaluate("(s => [s.color, s.backgroundColor])(getComputedStyle(document.body))")
        assert brightness(ink) > 0.7 if scheme == "dark" else brightness(paper) > 0.9
        assert abs(brightness(ink) - brightness(paper)) > 0.7
        assert complaints == []


@pytest.mark.slow
def test_columns_sort_by_number_and_unknown_ones_stay_last():
    with opened(PAGE) as (page, complaints):
        before = column_texts(page, 0, 1)
        press(page, 0, 1)
        rising = column_texts(page, 0, 1)
        assert rising == sorted(before, key=float)
        press(page, 0, 1)
        assert column_texts(page, 0, 1) == sorted(before, key=float, reverse=True)
        press(page, 0, 4)
        medians = column_texts(page, 0, 4)
        known = [float(cell.split("/")[0]) for cell in medians if cell != "-"]
        assert known == sorted(known)
        assert medians[len(known) :] == ["-"] * (len(medians) - len(known))
        press(page, 0, 0)
        names = column_texts(page, 0, 0)
        assert names == sorted(names, key=str.lower)
        assert complaints == []


@pytest.mark.slow
def test_on_a_phone_the_index_shows_its_figures_and_its_links_look_like_links():
    with opened(ROOT / "index.html", PHONE) as (page, complaints):
        for cell in page.locator("tbody b").all():
            box = cell.bounding_box()
            assert 0 <= box["x"]
            assert box["x"] + box["width"] <= PHONE["width"]
        link = page.get_by_role("link", name="All rows of demo")
        assert link.evaluate("e => getComputedStyle(e).textDecorationLine") == "underline"
        assert page.locator("h2 a").count() == 0
        assert complaints == []


def test_every_link_leads_somewhere():
    for file in ROOT.glob("*.html"):
        targets = re.findall(r'<a href="([^"#]+)', file.read_text(encoding="utf-8"))
        assert targets
        assert [t for t in targets if not (ROOT / unquote(unescape(t))).is_file()] == []


def brightness(colour: str) -> float:
    """Returns the mean of the channels of ``rgb(r, g, b)``, 0 to 1."""
    channels = [float(word) for word in colour[colour.index("(") + 1 : -1].split(",")[:3]]
    return sum(channels) / (3 * 255)
