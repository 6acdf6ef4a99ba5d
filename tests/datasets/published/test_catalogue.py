"""Published datasets by name: cards, complete and valid Croissant; downloads, whole, cut off or wrong."""

import hashlib
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import yaml

from lodbench.cli.dataset import config_card, main_card
from lodbench.datasets.faults import CATALOGUE
from lodbench.datasets.pose_text import format_pose
from lodbench.datasets.published.catalogue import SPECS, card_croissant, croissant_text, fetch, read_card
from lodbench.datasets.published.layout import Download
from lodbench.errors import ConfigError, DatasetError
from lodbench.synthesis.demo import DemoParams
from lodbench.synthesis.town.build import PRIORS, QUERY_CAMERA, TARGET_IOU
from lodbench.synthesis.town.town import CRS_NAME, TOWN_VERSION
from tests.town import true_poses

_FOLDER = Path(__file__).resolve().parents[3] / "data_cards"


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


CONTENT = bytes(range(256)) * 2000


@dataclass
class Site:
    """What the server does, and what it was asked."""

    url: str = ""
    stop_after: int | None = None
    knows_ranges: bool = True
    ranges: list[str] = field(default_factory=list)


@pytest.fixture
def site() -> Iterator[Site]:
    pytest.importorskip("pooch")
    state = Site()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            wanted = self.headers.get("Range", "")
            state.ranges.append(wanted)
            start = int(wanted.removeprefix("bytes=").rstrip("-")) if wanted and state.knows_ranges else 0
            if self.path != "/city.obj":
                self.send_error(404)
                return
            self.send_response(206 if start else 200)
            self.send_header("Content-Length", str(len(CONTENT) - start))
            self.end_headers()
            end = len(CONTENT) if state.stop_after is None else start + state.stop_after
            self.wfile.write(CONTENT[start:end])

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    state.url = f"http://127.0.0.1:{server.server_port}/city.obj"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield state
    server.shutdown()
    server.server_close()


@pytest.fixture
def download(site: Site) -> Download:
    return Download(site.url, "MODEL/city.obj", hashlib.sha256(CONTENT).hexdigest(), len(CONTENT))


def files(root: Path) -> list[str]:
    return sorted(path.name for path in root.rglob("*") if path.is_file())


def test_a_file_is_fetched_once(site, download, tmp_path):
    path, is_new = fetch(download, tmp_path)
    assert path == tmp_path / "MODEL" / "city.obj"
    assert path.read_bytes() == CONTENT
    assert is_new
    assert files(tmp_path) == ["city.obj"]
    assert fetch(download, tmp_path) == (path, False)
    assert len(site.ranges) == 1


@pytest.mark.parametrize("knows_ranges", [True, False])
def test_an_interrupted_download_goes_on(site, download, tmp_path, knows_ranges):
    site.stop_after = 100_000
    with pytest.raises(DatasetError, match="cannot be fetched") as caught:
        fetch(download, tmp_path)
    assert "goes on where it stopped" in caught.value.hint
    assert files(tmp_path) == [".city.obj.part"]
    have = (tmp_path / "MODEL" / ".city.obj.part").stat().st_size
    assert 0 < have <= 100_000
    site.stop_after, site.knows_ranges = None, knows_ranges
    path, _ = fetch(download, tmp_path)
    assert path.read_bytes() == CONTENT
    assert site.ranges == ["", f"bytes={have}-"]
    assert files(tmp_path) == ["city.obj"]


def test_another_content_is_refused(download, tmp_path):
    with pytest.raises(DatasetError, match="not the published file"):
        fetch(replace(download, sha256="0" * 64), tmp_path)
    assert files(tmp_path) == []


def test_more_than_the_file_has_is_refused(download, tmp_path):
    with pytest.raises(DatasetError, match="more than the 1,000 bytes"):
        fetch(replace(download, num_bytes=1000), tmp_path)
    assert files(tmp_path) == []


def test_a_missing_page(site, download, tmp_path):
    with pytest.raises(DatasetError, match="the server answers 404"):
        fetch(replace(download, url=site.url + "x"), tmp_path)
    assert files(tmp_path) == []


def test_a_file_put_there_by_hand_is_left_alone(site, download, tmp_path):
    path = tmp_path / "MODEL" / "city.obj"
    path.parent.mkdir()
    path.write_bytes(CONTENT)
    assert fetch(download, tmp_path) == (path, False)
    path.write_bytes(b"mine")
    with pytest.raises(DatasetError, match="another file"):
        fetch(download, tmp_path)
    assert path.read_bytes() == b"mine"
    assert site.ranges == []


def test_the_published_checksum_is_that_of_the_sample_data(shared_data):
    (download,) = SPECS["uavd4l_lodv2"].downloads
    content = (shared_data / "uavd4l" / "UAVD4L-LoD1.obj").read_bytes()
    assert len(content) == download.num_bytes
    assert hashlib.sha256(content).hexdigest() == download.sha256
