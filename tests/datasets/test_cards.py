"""The cards: the files in the checkout are those that are made, complete, and valid Croissant."""

import re
from pathlib import Path

import pytest
import yaml

from lodbench.cli.dataset_list import config_card, main_card
from lodbench.datasets.faults import CATALOGUE
from lodbench.datasets.pose_text import format_pose
from lodbench.datasets.published.catalogue import SPECS, card_croissant, croissant_text, read_card
from lodbench.errors import ConfigError
from lodbench.synthesis.demo import DemoParams
from lodbench.synthesis.town.build import PRIORS, QUERY_CAMERA, TARGET_IOU
from lodbench.synthesis.town.town import CRS_NAME, TOWN_VERSION
from tests.town import true_poses

_FOLDER = Path(__file__).resolve().parents[2] / "data_cards"


def _parts(card):
    """Returns a card's YAML head, read, and its text."""
    head, body = re.fullmatch(r"---\n(.*?)---\n(.*)", card, re.S).groups()
    return yaml.safe_load(head), body


def test_the_demo_s_card_says_what_its_generator_does():
    head, body = _parts(config_card("demo").text)
    assert sum(head["splits"].values()) == DemoParams().num_queries
    assert (head["version"], head["crs"]) == (f"town {TOWN_VERSION}", CRS_NAME)
    assert f"photos of {QUERY_CAMERA.width} x {QUERY_CAMERA.height} pixels" in body
    for split, (mean, spread) in TARGET_IOU.items():
        row = re.search(rf"^\| {split} \| .*$", body, re.MULTILINE)[0]
        assert row.startswith(f"| {split} | {head['splits'][split]} |")
        assert row.endswith(f"| {PRIORS[split].describe()} | {mean:.2f}, +-{spread:.2f} |")


class TestCommand:
    def test_writes_what_a_dataset_has(self, tmp_path, capsys):
        assert main_card(["card", "demo", "--out", str(tmp_path)]) == 0
        assert main_card(["card", "swiss_epfl", "--out", str(tmp_path)]) == 0
        written = {"demo.md", "swiss_epfl.md", "swiss_epfl.croissant.json"}
        assert {path.name for path in tmp_path.iterdir()} == written
        assert [Path(line).name for line in capsys.readouterr().out.splitlines()] == [
            "demo.md",
            "swiss_epfl.md",
            "swiss_epfl.croissant.json",
        ]

    @pytest.mark.parametrize(
        ("words", "match"), [(["swiss"], "no card of 'swiss'"), (["demo", "--croissant"], "no Croissant")]
    )
    def test_says_what_there_is_not(self, words, match):
        with pytest.raises(ConfigError, match=match):
            main_card(["card", *words])


@pytest.mark.parametrize("name", sorted(SPECS))
def test_the_croissant_is_made_from_the_card(name):
    # After a change: lodbench dataset card NAME --out data_cards
    assert (_FOLDER / f"{name}.croissant.json").read_text() == croissant_text(read_card(name))


@pytest.mark.parametrize("name", sorted(SPECS))
def test_a_card_says_what_the_code_knows(name):
    spec, card = SPECS[name], read_card(name)
    assert card.head["splits"] == {split.name: split.num_queries for split in spec.splits}
    assert (card.head["title"], card.head["lods"]) == (spec.title, [spec.lod])
    assert spec.photo_crs is None or card.head["crs"].endswith(spec.photo_crs)
    for host in spec.hosts:
        assert f"- {host.what}: <{host.url}> ({host.how})" in card.section("How to get it")
    for split in spec.splits:
        medians = "-" if split.prior_median is None else "{:g} m / {:g} deg".format(*split.prior_median)
        row = f"| {split.name} | `{split.folders[0]}` | {split.num_queries or 'unknown'} | {medians} |"
        assert row in card.section("Splits")


@pytest.mark.parametrize("name", sorted(SPECS))
def test_a_card_says_what_a_reader_must_know(name):
    values, body = _parts(read_card(name).text)
    assert values["id"] == name
    assert set(values["splits"]) == {split.name for split in SPECS[name].splits}
    for word in ("How to get it", "Splits", "Provenance", "True poses", "Priors", "What to know"):
        assert f"\n## {word}\n" in body
    assert "Uncertainty: " in body
    for code in re.findall(r"LB\d+", body):
        assert code in CATALOGUE


@pytest.mark.parametrize("name", sorted(SPECS))
def test_croissant_is_valid_and_its_splits_can_be_read(name, caplog):
    mlcroissant = pytest.importorskip("mlcroissant")
    dataset = mlcroissant.Dataset(jsonld=str(_FOLDER / f"{name}.croissant.json"))
    assert dataset.metadata.issues.report() == ""
    assert not [record for record in caplog.records if "not standard" in record.getMessage()]
    rows = {record["splits/name"]: record["splits/queries"] for record in dataset.records("splits")}
    assert rows == {split.name: split.num_queries or 0 for split in SPECS[name].splits}


def test_croissant_s_patterns_read_the_lines_of_a_pose_file():
    line = format_pose("0001.jpg", true_poses(1)["view_00.png"])
    _, truth, priors = card_croissant(read_card("uavd4l_lodv2"))["recordSet"]
    for records in (truth, priors):
        patterns = [field["source"]["transform"]["regex"] for field in records["field"]]
        assert [re.search(pattern, line)[1] for pattern in patterns] == line.split()


def test_the_page_lists_every_finding():
    page = (_FOLDER.parent / "docs" / "datasets.md").read_text()
    for code in CATALOGUE.values():
        assert f"| {code.code} | {code.name} | {code.severity.value} | {code.meaning} |" in page
