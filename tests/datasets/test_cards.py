"""The cards: the files in the checkout are those that are made, complete, and valid Croissant."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from lodbench.datasets.cards import CARDS, card_markdown, card_of
from lodbench.datasets.codes import CATALOGUE
from lodbench.datasets.croissant import card_croissant, croissant_text
from lodbench.datasets.published.specs import SPECS
from lodbench.errors import ConfigError
from tests.data.published_layouts import write_uavd4l

_FOLDER = Path(__file__).resolve().parents[2] / "data_cards"


def test_every_published_dataset_has_one():
    assert set(CARDS) == set(SPECS)
    with pytest.raises(ConfigError, match="no card of 'swiss'"):
        card_of("swiss")


@pytest.mark.parametrize("name", sorted(CARDS))
def test_the_files_are_those_that_are_made(name):
    # After a change: lodbench dataset card NAME --out data_cards
    assert (_FOLDER / f"{name}.md").read_text() == card_markdown(CARDS[name])
    assert (_FOLDER / f"{name}.croissant.json").read_text() == croissant_text(CARDS[name])


@pytest.mark.parametrize("name", sorted(CARDS))
def test_a_card_says_what_a_reader_must_know(name):
    head, body = re.fullmatch(r"---\n(.*?)---\n(.*)", card_markdown(CARDS[name]), re.S).groups()
    values = yaml.safe_load(head)
    assert values["id"] == name
    assert set(values["splits"]) == {split.name for split in SPECS[name].splits}
    for word in ("How to get it", "Splits", "Provenance", "True poses", "Priors", "What to know"):
        assert f"\n## {word}\n" in body
    assert "Uncertainty: " in body
    for code in re.findall(r"LB\d+", body):
        assert code in CATALOGUE


@pytest.mark.parametrize("name", sorted(CARDS))
def test_croissant_is_valid_and_its_splits_can_be_read(name, caplog):
    mlcroissant = pytest.importorskip("mlcroissant")
    dataset = mlcroissant.Dataset(jsonld=str(_FOLDER / f"{name}.croissant.json"))
    assert dataset.metadata.issues.report() == ""
    assert not [record for record in caplog.records if "not standard" in record.getMessage()]
    rows = {record["splits/name"]: record["splits/queries"] for record in dataset.records("splits")}
    assert rows == {split.name: split.num_queries or 0 for split in SPECS[name].splits}


def test_croissant_s_patterns_read_the_lines_of_a_pose_file(tmp_path):
    root = write_uavd4l(tmp_path)
    line = (root / "UAVD4L-LoD" / "inTraj" / "GT_pose.txt").read_text().splitlines()[0]
    _, truth, priors = card_croissant(CARDS["uavd4l_lodv2"])["recordSet"]
    for records in (truth, priors):
        patterns = [field["source"]["transform"]["regex"] for field in records["field"]]
        assert [re.search(pattern, line)[1] for pattern in patterns] == line.split()


def test_the_page_lists_every_finding():
    page = (_FOLDER.parent / "docs" / "datasets.md").read_text()
    for code in CATALOGUE.values():
        assert f"| {code.code} | {code.name} | {code.severity.value} | {code.meaning} |" in page
