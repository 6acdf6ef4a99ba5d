"""Recall over poses drawn: which runs are one line, and which are not."""

from types import SimpleNamespace

from lodbench.harness.runs.compare import budget_panels


def run(recall: float | None, hypotheses: float, version: str = "1", **protocol: str) -> SimpleNamespace:
    bounds = [None, None] if recall is None else [recall - 5, recall + 5]
    scored = {
        "num_queries": 20,
        "recall": {"2m-2deg": recall},
        "recall_interval_95": {"2m-2deg": bounds},
        "hypotheses_per_query": hypotheses,
    }
    said = {"tilt": "prior", "segmenter": "masks", "lod": "1", "prior": "file", **protocol}
    method = {"name": "ours", "variant": "full", "params": {"steps": hypotheses, "fit": "iou"}}
    dataset = {"name": "town", "version": version}
    return SimpleNamespace(
        summary={"dataset": dataset, "method": method, "protocol": said, "splits": {"a": scored}}
    )


def test_runs_of_other_masks_levels_and_priors_are_other_lines():
    few, many = run(50, 100), run(90, 1000)
    assert list(budget_panels([many, few])["town, a, tilt=prior"]) == ["ours"]
    for other, name in (
        ({"segmenter": "compact"}, "compact"),
        ({"lod": "2.2"}, "LoD2.2"),
        ({"prior": "uniform around the truth"}, "priors uniform around the truth"),
    ):
        (curves,) = budget_panels([few, many, run(20, 500, **other)]).values()
        assert sorted(map(len, curves.values())) == [1, 2]
        assert [len(points) for line, points in curves.items() if name in line] == [1]


def test_runs_over_other_data_of_one_version_are_other_lines():
    """As views of one seed with priors of another width: their recalls are no curve."""
    near, far = run(90, 100), run(50, 100)
    for each, range_m, limit in ((near, 10.0, None), (far, 50.0, 5)):
        each.summary["settings"] = {"range_m": range_m, "limit": limit}
    assert list(budget_panels([near, far])["town, a, tilt=prior"]) == [
        "ours range_m=10.0",
        "ours range_m=50.0",
    ]


def test_two_versions_of_a_dataset_share_no_panel():
    assert list(budget_panels([run(50, 100), run(90, 1000, "2")])) == [
        "town (1), a, tilt=prior",
        "town (2), a, tilt=prior",
    ]


def test_a_split_without_a_truth_has_no_point():
    half = run(50, 100)
    half.summary["splits"]["b"] = run(None, 100).summary["splits"]["a"]
    assert list(budget_panels([half])) == ["town, a, tilt=prior"]
