"""`lodbench report`, `status`, and commands given several runs."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from lodbench.datasets.pose_text import format_pose, read_poses
from lodbench.evaluation.predictions import Prediction
from lodbench.harness.runs.predict import open_predictions
from tests.reporting.browser import PHONE, column_texts, fits, opened, press
from tests.town import box_obj, write_dataset


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> tuple[Path, Path]:
    return write_dataset(tmp_path_factory.mktemp("town"), count=4)


def run(lodbench, tmp_path, data, *more: str) -> Path:
    words = ["run", "dataset=folder", f"dataset.root={data[0]}", f"dataset.city_model={data[1]}"]
    done = lodbench(*words, "tilt=truth", "method.steps=3", "executor.threads=1", *more)
    assert done.returncode == 0, done.stderr
    return tmp_path / re.search(r"results:\s+(\S+)", done.stdout)[1]


@pytest.mark.slow
def test_the_page_shows_a_run_in_one_quiet_file(lodbench, tmp_path, data):
    folder = run(lodbench, tmp_path, data)
    assert lodbench("report", str(folder)).returncode == 0
    with opened(folder / "report.html", PHONE, "dark") as (page, complaints):
        words = page.inner_text("main")
        for said in ("Verified: every number follows", "From above", "Pictures", "Score by step"):
            assert said in words
        # A picture of every query, all of them decoded; curves and traces are drawings in the page's ink.
        sizes = page.eval_on_selector_all("main img", "all => all.map(i => i.naturalWidth)")
        assert len(sizes) == 4
        assert min(sizes) > 0
        assert page.locator(".chart svg").count() == 2
        ink = "e => getComputedStyle(e).fill"
        assert page.locator(".chart svg text").first.evaluate(ink) == "rgb(230, 237, 243)"
        last = page.locator("table").count() - 1
        press(page, last, 1)
        errors = [float(cell) for cell in column_texts(page, last, 1)]
        assert len(errors) == 4
        assert errors == sorted(errors)
        anchors = page.eval_on_selector_all("nav a", "all => all.map(a => a.getAttribute('href'))")
        assert all(page.locator(f"section{anchor}").count() == 1 for anchor in anchors)
        assert fits(page)
        assert page.get_by_text("The same in 3D").get_attribute("href") == "report_3d.html"
        assert complaints == []
    with opened(folder / "report_3d.html") as (page, _):
        page.wait_for_selector(".state:empty", state="attached")
        assert page.locator(".list li").count() == 4
        assert {"prior", "estimate", "truth"} <= set(page.inner_text(".legend").split())


@pytest.mark.slow
def test_a_row_a_camera_and_a_picture_lead_to_the_picture_and_a_filter_hides_all_three(
    lodbench, tmp_path, data
):
    folder = run(lodbench, tmp_path, data)
    assert lodbench("report", str(folder)).returncode == 0
    with opened(folder / "report.html") as (page, complaints):
        viewer = page.locator("dialog.viewer")
        row = page.locator("tr[data-key]").nth(2)
        key = row.get_attribute("data-key")
        row.click()
        assert viewer.is_visible()
        assert viewer.locator("figcaption").inner_text().startswith(key)
        page.keyboard.press("ArrowRight")
        assert not viewer.locator("figcaption").inner_text().startswith(key)
        page.keyboard.press("Escape")
        assert not viewer.is_visible()
        page.locator("g.spot").nth(1).locator(".dot").first.click(force=True)
        assert viewer.is_visible()
        page.keyboard.press("Escape")
        page.locator("input.filter").fill("view_02")
        assert page.locator("tr[data-key]:visible").count() == 1
        assert page.locator("figure[data-key]:visible").count() == 1
        assert page.locator("g.spot:not(.hidden)").count() == 1
        assert "1 of 4" in page.inner_text(".tools")
        assert complaints == []


@pytest.mark.slow
def test_the_map_zooms_about_the_pointer_moves_and_comes_back(lodbench, tmp_path, data):
    folder = run(lodbench, tmp_path, data)
    assert lodbench("report", str(folder)).returncode == 0
    with opened(folder / "report.html") as (page, complaints):
        svg = page.locator(".map svg")
        svg.scroll_into_view_if_needed()
        box = "e => { const b = e.viewBox.baseVal; return [b.x, b.y, b.width, b.height]; }"
        before = svg.evaluate(box)
        page.locator(".map button").first.click()
        closer = svg.evaluate(box)
        assert closer[2] == pytest.approx(0.7 * before[2])
        area = svg.bounding_box()
        page.mouse.move(area["x"] + 100, area["y"] + 100)
        page.mouse.down()
        page.mouse.move(area["x"] + 160, area["y"] + 100)
        page.mouse.up()
        assert svg.evaluate(box)[0] < closer[0]
        page.locator(".map button").last.click()
        assert svg.evaluate(box) == pytest.approx(before)
        assert page.locator(".map .bar").inner_text().endswith(" m")
        assert complaints == []


@pytest.mark.slow
def test_without_a_truth_the_page_has_the_answers_and_no_empty_table(lodbench, tmp_path):
    root, city = write_dataset(tmp_path / "mine", count=3)
    (root / "GT_pose.txt").unlink()
    city.rename(root / "city.obj")
    (root / "dataset.json").write_text('{"truth": false, "city_model": "city.obj"}')
    done = lodbench("run", "dataset=folder", f"dataset.root={root}", "method=contour_alignment")
    assert done.returncode == 0, done.stderr
    folder = tmp_path / re.search(r"results:\s+(\S+)", done.stdout)[1]
    # Nobody knows which is the best: pictures are named by what they are chosen by.
    names = {re.sub(r"_\d_.*", "", path.name) for path in (folder / "overlays").glob("*.png")}
    assert names == {"data_most_probable"}
    assert lodbench("report", str(folder)).returncode == 0
    with opened(folder / "report.html") as (page, complaints):
        words = page.inner_text("main")
        assert re.search(r"3 of 3 queries have an answer: \d (good|doubtful|not to be trusted)", words)
        # What has no value is not shown as an empty field.
        assert all(page.locator("dd").all_inner_texts())
        assert "Recall" not in words
        assert "no true pose" not in words
        assert page.locator("table").count() == 1
        heads = page.locator("thead th").all_inner_texts()
        cells = page.locator("tbody tr").first.locator("td").all_inner_texts()
        assert len(heads) == len(cells)
        # No column without anything in it.
        heads = [head.split(" ↕")[0] for head in heads]
        assert not {"", "-"} & {cell for head, cell in zip(heads, cells, strict=True) if head != "why"}
        trusted = dict(
            zip(column_texts(page, 0, 0), column_texts(page, 0, heads.index("trust")), strict=True)
        )
        if "why" in heads:
            why = dict(zip(trusted, column_texts(page, 0, heads.index("why")), strict=True))
            assert all(why[name] for name, trust in trusted.items() if trust != "good")
        assert "why" in heads or set(trusted.values()) == {"good"}
        assert {"easting m", "height m", "heading deg", "from the prior m", "probability", "trust"} <= set(
            heads
        )
        assert page.locator("main img").count() == page.locator("g.spot").count() == 3
        assert complaints == []


def test_a_query_that_failed_without_a_truth_says_why_and_leaves_the_map_in_scale(lodbench, tmp_path):
    root, city = write_dataset(tmp_path / "mine", count=3)
    (root / "GT_pose.txt").unlink()
    city.rename(root / "city.obj")
    (root / "dataset.json").write_text('{"truth": false, "city_model": "city.obj"}')
    poses = read_poses(root / "GPS_pose.txt")
    far = {
        name: pose.shifted(np.array([3e4, 0, 0])) if "01" in name else pose for name, pose in poses.items()
    }
    (root / "GPS_pose.txt").write_text("".join(f"{format_pose(*each)}\n" for each in far.items()))
    done = lodbench("run", "dataset=folder", f"dataset.root={root}", "method=prior_only")
    why = re.search(r"1 x (the prior lies [\d.]+ km outside the city model)", done.stdout)[1]
    folder = tmp_path / re.search(r"results:\s+(\S+)", done.stdout)[1]
    assert lodbench("report", str(folder)).returncode == 0
    page = (folder / "report.html").read_text()
    assert "no true pose" not in page
    assert page.count(why) >= 3
    assert float(re.search(r'<svg viewBox="\S+ \S+ (\S+) ', page)[1]) < 1000


@pytest.mark.slow
def test_a_changed_summary_is_said_on_the_page_and_by_the_exit_code(lodbench, tmp_path, data):
    folder = run(lodbench, tmp_path, data)
    summary = folder / "summary.json"
    summary.write_text(summary.read_text().replace('"num_failed": 0', '"num_failed": 1', 1))
    done = lodbench("report", str(folder))
    assert done.returncode == 1
    assert "Not verified" in (folder / "report.html").read_text()


def test_a_scored_pose_file_has_a_page_with_overlays(lodbench, tmp_path, data):
    words = [f"poses={data[0] / 'GPS_pose.txt'}", "dataset=folder", f"dataset.root={data[0]}"]
    done = lodbench("evaluate", *words, f"dataset.city_model={data[1]}")
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "runs" / "folder" / "GPS_pose").iterdir()
    assert len(list((folder / "overlays").glob("*.png"))) == 4
    assert lodbench("report", str(folder)).returncode == 0
    page = (folder / "report.html").read_text()
    assert "Pictures" in page
    assert "Score by step" not in page


def test_no_run_is_one_line(lodbench, tmp_path):
    done = lodbench("report", str(tmp_path))
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 2)


@pytest.mark.slow
def test_each_flight_of_a_run_has_a_page_with_imagery_and_links(lodbench, tmp_path):
    rasterio = pytest.importorskip("rasterio")
    (tmp_path / "city.obj").write_text(box_obj())
    words = [
        "dataset=flights",
        "dataset.city_model=city.obj",
        "dataset.num_flights=2",
        "dataset.num_photos=3",
    ]
    words += ["dataset.path=orbit", "dataset.wrong_heights=0.3", "method=flight", "method.steps=2"]
    done = lodbench("run", *words)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / re.search(r"results:\s+(\S+)", done.stdout)[1]
    # A picture of the place without a reference system, as the city has none.
    place = rasterio.transform.from_origin(-500.0, 500.0, 10.0, 10.0)
    grey = np.full((3, 100, 100), 90, np.uint8)
    with rasterio.open(
        tmp_path / "dop.tif", "w", width=100, height=100, count=3, dtype="uint8", transform=place
    ) as picture:
        picture.write(grey)
    told = lodbench("report", str(folder), "--imagery", "dop.tif")
    assert told.returncode == 0, told.stderr
    view = (folder / "report_3d.html").read_text()
    for name in ("flights-flight_00", "flights-flight_01"):
        page = (folder / "flights" / f"{name}.html").read_text()
        assert "3 photos placed" in page
        assert f"{name}.html" in told.stdout
        assert '<image class="imagery" href="data:image/webp' in page
        assert 'href="../report_3d.html">The same in 3D' in page
        assert f'<a href="flights/{name}.html">{name}</a>' in view
    assert '<a href="report.html">The run</a>' in view
    # A page elsewhere has its other pages beside it, and leaves the run alone.
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    (tmp_path / "else where").mkdir()
    assert lodbench("report", str(folder), "--out", "else where/page.html").returncode == 0
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    name = "page_flights-flight_00.html"
    assert f'href="{name}">' in (tmp_path / "else where" / "page_3d.html").read_text()
    assert 'href="page_3d.html">The same in 3D' in (tmp_path / "else where" / name).read_text()
    missing = lodbench("report", str(folder), "--imagery", "nowhere.tif")
    assert missing.returncode == 2
    assert "There is no imagery at nowhere.tif." in missing.stderr
    report = (folder / "report.html").read_text()
    assert "Systematic errors of flights" in report
    assert "corrections to the given poses" in report
    for broken in ("{", '{"constants": {"height": 3}}', '{"changes": [{"kind": "gone"}]}', '{"lost": 3}'):
        (folder / "flights" / "flights-flight_00.json").write_text(broken)
        told = lodbench("report", str(folder))
        assert told.returncode == 2
        assert "flights-flight_00.json" in told.stderr
        assert "Traceback" not in told.stderr


@pytest.fixture(scope="module")
def three(tmp_path_factory) -> tuple[Path, Path]:
    return write_dataset(tmp_path_factory.mktemp("town"), count=3)


@pytest.mark.attack
def test_a_run_is_finished_then_torn_then_unreadable(lodbench, tmp_path, three):
    (three[0] / "masks" / "view_02.png").unlink()
    words = ["run", "dataset=folder", f"dataset.root={three[0]}", f"dataset.city_model={three[1]}"]
    done = lodbench(*words, "method.steps=2", "executor.threads=1")
    folder = tmp_path / re.search(r"results:\s+(\S+)", done.stdout)[1]
    said = lodbench("status", str(folder)).stdout
    assert "3 of 3 queries, finished" in said
    assert "1 x no mask in the masks folder" in said
    ledger = folder / "predictions.jsonl"
    torn = ledger.read_bytes().splitlines(keepends=True)[0] + b'{"key": "half'
    ledger.write_bytes(torn)
    said = lodbench("status", str(folder)).stdout
    assert re.search(r"1 of 3 queries, unfinished, about \d+ s of work left", said)
    assert ledger.read_bytes() == torn
    (folder / "plan.json").unlink()
    done = lodbench("status", str(folder))
    assert (done.returncode, "holds no run" in done.stderr) == (2, True)
    for keys in (5, None, [[1]]):
        (folder / "plan.json").write_text(json.dumps({"queries": keys}))
        assert lodbench("status", str(folder)).returncode in (0, 2)


@pytest.mark.attack
def test_an_answer_of_another_form_is_one_line(lodbench, tmp_path):
    (tmp_path / "plan.json").write_text('{"queries": ["a"]}')
    ledger = open_predictions(tmp_path)
    ledger.record("a", {**Prediction(None, "no mask").to_json(), "failure": [[]]})
    done = lodbench("status", str(tmp_path))
    assert (done.returncode, "a is no prediction" in done.stderr) == (2, True)


@pytest.mark.attack
def test_a_damaged_run_does_not_hide_those_after_it(lodbench, tmp_path):
    for name, text in (("a", "{"), ("b", '{"queries": ["x"]}')):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "plan.json").write_text(text)
    done = lodbench("status", str(tmp_path / "runs"))
    assert done.returncode == 2
    assert "a holds no run" in done.stderr
    assert "b: 0 of 1 query, unfinished" in done.stdout


@pytest.fixture
def runs(lodbench, tmp_path) -> list[str]:
    """Two runs, a folder that is none and a file, as a pattern names them."""
    root, city = write_dataset(tmp_path / "town", count=2)
    words = ["run", "dataset=folder", f"dataset.root={root}", f"city={city}", "method=prior_only"]
    made = [re.search(r"results:\s+(\S+)", lodbench(*words, f"seed={n}").stdout)[1] for n in (0, 1)]
    other, note = Path(made[0]).parent / "pictures", Path(made[0]).parent / "notes.txt"
    (tmp_path / other).mkdir()
    (tmp_path / note).write_text("the second is better")
    return [made[0], str(other), str(note), made[1]]


@pytest.mark.parametrize(
    "words",
    [["report"], ["export", "--format", "csv"], ["compare"], ["leaderboard", "add"]],
    ids=lambda words: words[0],
)
def test_what_is_no_run_is_passed_over_with_a_note(lodbench, tmp_path, runs, words):
    at = 2 if words[0] == "leaderboard" else 1
    done = lodbench(*words[:at], *runs, *words[at:])
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stderr.splitlines() if "skipped" in line] == [
        f"lodbench: skipped, not a finished run: {path}" for path in runs[1:3]
    ]
    files = {"report": "report.html", "export": "export/poses.csv"}
    if words[0] in files:
        for run in (runs[0], runs[3]):
            assert (tmp_path / run / files[words[0]]).is_file()
            assert f"{run}/{files[words[0]]}" in done.stdout
    if words[0] == "leaderboard":
        assert len(list((tmp_path / "leaderboard" / "entries").rglob("*.json"))) == 2


@pytest.mark.parametrize("command", ["report", "export"])
def test_one_out_is_not_for_several_runs(lodbench, runs, command):
    form = ["--format", "csv"] if command == "export" else []
    done = lodbench(command, *runs, *form, "--out", "one.html")
    assert done.returncode == 2
    assert "--out one.html is one place, and there are 2 runs" in done.stderr
    # A pattern that names one run is one run.
    assert lodbench(command, *runs[:3], *form, "--out", "one.html").returncode == 0


@pytest.mark.parametrize("command", ["report", "compare"])
def test_where_nothing_is_a_run_the_first_says_why(lodbench, runs, command):
    done = lodbench(command, *runs[1:3])
    assert done.returncode == 2
    assert "pictures is not a run folder" in done.stderr
    assert lodbench(command, runs[0], "nowhere").returncode == 2
