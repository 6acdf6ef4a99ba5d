import re

from lodbench.evaluation.metrics import calibrate
from lodbench.reporting.figures import BudgetPoint, draw_budget, draw_calibration


def test_calibration_names_methods_areas_and_counts():
    curves = {
        "one": calibrate([0.95, 0.9, 0.3], [True, True, False]),
        "two": calibrate([0.5] * 7, [True] * 7),
    }
    pictures = draw_calibration(curves)
    svg = pictures["svg"].decode()
    for text in ("one, AURC 11.1 %", "two, AURC 0.0 %", ">7<", "within 2 m, 2 deg"):
        assert text in svg
    assert pictures["png"].startswith(b"\x89PNG")


def test_budget_names_methods():
    curves = {"ours": [BudgetPoint(100, 50, 40, 60), BudgetPoint(1000, 90, 85, 95)]}
    svg = draw_budget({"a city, 20 views": curves})["svg"].decode()
    assert "ours" in svg
    assert "a city, 20 views" in svg
    assert "poses drawn per query" in svg


def test_budget_has_a_panel_for_each_split_and_a_line_for_what_draws_nothing():
    many = {name: [BudgetPoint(10.0 * (n + 1), 50, 40, 60)] for n, name in enumerate("abcd")}
    panels = {"in place": many, "out of place": {"a": many["a"], "prior_only": [BudgetPoint(0, 5, 1, 20)]}}
    svg = draw_budget(panels)["svg"].decode()
    for text in ("in place", "out of place", ">a<", ">d<", ">prior_only<"):
        assert svg.count(text) >= 1
    assert svg.count(">a<") == 1


def test_methods_that_draw_nothing_can_be_told_apart_where_colours_come_again():
    many = {name: [BudgetPoint(0, 5, 1, 20)] for name in "abcdefgh"}
    svg = draw_budget({"in place": many})["svg"].decode()
    lines = re.findall(r"stroke-dasharray: ([^;]+);[^\"]*stroke: (#\w+)", svg)
    assert len(set(lines)) == 8
