"""What flights say of a map, counted against what was done to it."""

from lodbench.evaluation.flight_findings import MapScore, score_map

CHANGED = {"heights": {"a": 3.0, "b": -2.0, "unseen": 4.0}, "missing": ["m", "hidden"], "extra": ["x", "y"]}
BOXES = {"m": (100.0, 100.0, 110.0, 112.0), "hidden": (300.0, 300.0, 310.0, 310.0)}


def building(name, higher_m, doubt, photos=5):
    return {"id": name, "higher_m": higher_m, "sigma_m": 0.3, "photos": photos, "doubt": doubt}


def place(west, south):
    ring = [[west, south], [west + 8, south], [west + 8, south + 8], [west, south + 8], [west, south]]
    return {
        "kind": "unmapped",
        "outline": [ring],
        "area_m2": 64.0,
        "height_m": 5.0,
        "sigma_m": 0.5,
        "at_most_m": 8.0,
        "share": 0.9,
        "photos": ["p"],
    }


def test_counts_of_a_flight_and_of_two():
    findings = {
        "buildings": [
            building("a", -2.8, True),  # recovered
            building("b", 1.0, False),  # too little, not found
            building("c", 0.2, False),  # right
            building("d", 1.6, True),  # in doubt for nothing
            building("e", 9.0, True),  # in doubt, though no photo shows its roof
            building("y", -5.0, True),  # stands in the map only
        ],
        "changes": [
            {"kind": "demolished", "id": "x", "probability": 1.0, "photos": ["p"]},
            {"kind": "demolished", "id": "c", "probability": 0.95, "photos": ["p"]},
            place(111.0, 113.0),  # beside the corner of what is missing, within three metres
            place(500.0, 500.0),
            place(700.0, 700.0),  # on a container
        ],
    }
    score = score_map(
        findings,
        CHANGED,
        {"a", "b", "c", "d", "m", "x", "y"},
        {"a", "b", "c", "d", "y"},
        BOXES,
        clutter=[(706.0, 700.0, 712.0, 702.4), (110.0, 110.0, 120.0, 120.0)],
    )
    assert score == MapScore(
        heights=4, recovered=2, wrong=2, found_wrong=1, doubted=3, rightly=1, demolished=2,
        reported_demolished=2, rightly_demolished=1, unmapped=1, found=1, places=3,
        rightly_unmapped=1, clutter=1,
    )  # fmt: skip
    assert (score + score).heights == 8
    assert (score + MapScore()) == score
