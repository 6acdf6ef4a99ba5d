"""Sample files and small towns: counts as catalogued, areas against an independent sum, all formats alike."""

import subprocess
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, cleaning, mesh_city, mesh_model, read_city_model
from lodbench.citymodel.gml import folding
from lodbench.citymodel.gml.folding import parse_rings
from lodbench.citymodel.model import CityModel, Polygons, SurfaceKind, starts_of
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.triangulate import triangulate
from lodbench.findings import Findings

from .gml_text import write
from .twins import TOWN, documents

_CATALOGUE = Path(__file__).resolve().parents[3] / "shared" / "data" / "README.md"


@dataclass(frozen=True)
class Row:
    """One line of the table of sample files."""

    path: str
    buildings: int
    parts: int
    polygons: int
    duplicates: int


def _rows(kinds: tuple[str, ...]) -> list[Row]:
    if not _CATALOGUE.is_file():
        return []
    rows = []
    for line in _CATALOGUE.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("| ").split(" | ")]
        if len(cells) < 9 or not cells[2].startswith(kinds) or "/" not in cells[3]:
            continue
        buildings, parts = (int(text) for text in cells[3].split(" / "))
        rows.append(Row(cells[0], buildings, parts, int(cells[4]), int(cells[8].split("/")[2])))
    return rows


FILES = [row for row in _rows(("CityGML", "CityJSON")) if "503100000000296" not in row.path]
# Polygons of the sources that fold over or cross themselves, by eye.
CROSSING = {"ingolstadt_lod3/4018148.xml": 1}


def newell_areas(model: CityModel) -> list[float]:
    """Polygon areas the slow and obvious way: cross products of each ring, holes taken off."""
    polygons = model.polygons
    areas = []
    for n in range(len(polygons)):
        total = 0.0
        for k, ring in enumerate(range(polygons.polygon_starts[n], polygons.polygon_starts[n + 1])):
            points = polygons.points[polygons.ring_starts[ring] : polygons.ring_starts[ring + 1]]
            points = points - points.mean(axis=0)
            vector = np.cross(np.roll(points, 1, axis=0), points).sum(axis=0)
            total += (1 if k == 0 else -1) * 0.5 * float(np.linalg.norm(vector))
        areas.append(max(total, 0.0))
    return areas


@pytest.mark.parametrize("row", FILES, ids=[row.path for row in FILES])
def test_catalogued_counts(shared_data, row):
    # One sample has buildings demolished from 2021 to 2099.
    options = ReadOptions(date="2020-01-01")
    model = read_city_model(shared_data / "city" / row.path, options=options)
    assert len(model.building_ids) == row.buildings
    assert model.num_parts == row.parts
    assert sum(model.polygons_read) == row.polygons
    counts = model.findings.counts()
    if "jsonl" not in row.path:  # the catalogue counted those without their transform
        assert counts.get("LB102 DUPLICATE_POINTS", 0) == row.duplicates
    assert not any(code.startswith("LB2") for code in counts if code[:5] not in ("LB201", "LB209"))


@pytest.mark.parametrize("row", FILES, ids=[row.path for row in FILES])
def test_area_of_every_polygon(shared_data: Path, row: Row) -> None:
    model = read_city_model(shared_data / "city" / row.path)
    findings = Findings()
    result = triangulate(model.polygons, model.building_ids, findings)
    expected = np.array(newell_areas(model))
    assert np.allclose(result.area_m2, expected, rtol=1e-9, atol=1e-9)
    named = {int(item.detail.split()[1].rstrip(":")) for item in findings.items}
    others = np.setdiff1d(np.arange(len(expected)), np.array(sorted(named), np.int64))
    # Seen along its normal every polygon is covered, bent or not: nothing is lost.
    assert np.all(np.abs(result.covered_m2 - expected)[others] <= 1e-4 * expected[others])
    assert result.lost_m2 <= 1e-6 * expected.sum()
    assert findings.counts().get("LB106 AREA_MISMATCH", 0) == CROSSING.get(row.path, 0)


@pytest.mark.parametrize(
    ("path", "lod", "crs", "triangles"),
    [
        ("plateau/53395404_bldg_6697_op.gml", "1", "EPSG:6677+6695", 12912),
        ("plateau/51311568_bldg_6697_op.gml", "1", "EPSG:6671+6695", 5084),
        ("plateau/64412288_bldg_6697_op.gml", "1", "EPSG:6680+6695", None),
        ("germany_lod2/LoD2_32_280_5657_1_NW.gml", "2", "EPSG:25832+7837", 2676),
        ("germany_lod2/LoD2_576_5950_1_HH_2016.xml", "2", "EPSG:25832+5783", 1314),
        ("germany_lod2/berlin_open_data_sample_data.citygml", "2", "EPSG:25833", 4879),
        ("ingolstadt_lod3/4018148.xml", "3", "EPSG:32632", None),
        ("switzerland/zurich-lod2-citygml1.xml", "2", "EPSG:21781+5728", None),
        ("netherlands_other/delft-citygml2.xml", "1", "EPSG:7415", None),
    ],
)
def test_default_level_and_reference_system(shared_data, path, lod, crs, triangles):
    scene = mesh_city(read_city_model(shared_data / "city" / path))
    assert (scene.lod, scene.crs) == (lod, crs)
    assert triangles is None or len(scene.triangles) == triangles
    low, high = scene.extent_m
    assert low[:2].min() >= 0
    assert (high - low)[:2].max() < 1000


def test_plateau_lies_in_nishitokyo(shared_data: Path) -> None:
    from pyproj import Transformer

    model = read_city_model(shared_data / "city/plateau/53395404_bldg_6697_op.gml")
    east, north = (model.polygons.points + model.origin)[0, :2]
    to_degrees = Transformer.from_crs("EPSG:6677", "EPSG:6668", always_xy=True)
    assert to_degrees.transform(east, north) == pytest.approx((139.55424111, 35.75599828), abs=1e-7)


def test_bent_polygons_are_named_with_both_areas(shared_data: Path) -> None:
    mesh = mesh_model(read_city_model(shared_data / "city/germany_lod2/LoD2_32_280_5657_1_NW.gml"))
    bent = [item for item in mesh.findings.items if item.code.code == "LB105"]
    assert len(bent) == 25
    assert all("triangles" in item.detail and item.object_id.startswith("DENW") for item in bent)


ODD_TEXTS = [
    "",
    " \n",
    "1 2.5 -3",
    "-0 -0.0 .5 5. 1e3 1E-3 +7",
    "1e400 2",
    "1e-400",
    "0.1234567890123456789012345 3",
    "123456789012345678901234567890",
    "5e22 5e23 9007199254740993e1",
    "nan 1",
    "1 inf 2",
    "1_000",
    "1e",
    ".",
    "- 2",
    "1..2 4",
    "1,5 2",
    "\x1c1 2",
    "1\t2\r\n3\x0b4\x0c5",
    "00000000000000000000000000000000012.5",
    "x" * 50 + "9" * 5000 + "x",
]


def both(texts: list[str], monkeypatch: pytest.MonkeyPatch) -> list[tuple[bytes, ...]]:
    found = []
    for is_few in (True, False):
        monkeypatch.setattr(folding, "is_few", lambda _, is_few=is_few: is_few)
        found.append(tuple(part.tobytes() for part in parse_rings([text.encode() for text in texts])))
    return found


@pytest.mark.parametrize("text", ODD_TEXTS)
def test_texts_are_read_as_the_compiled_reader_reads_them(text, monkeypatch):
    plain, compiled = both([text, "4 5"], monkeypatch)
    assert plain == compiled


def test_texts_of_other_scripts_and_with_separators_are_read_likewise(monkeypatch):
    plain, compiled = both(["1 2", "\u0663 4", "5;6", "7"], monkeypatch)
    assert plain == compiled


def test_many_numbers_are_read_to_the_bit(monkeypatch):
    rng = np.random.default_rng(1)
    values = rng.normal(size=6000) * 10.0 ** rng.integers(-9, 9, 6000)
    forms = ("{!r}", "{:.3f}", "{:.12g}", "{:e}")
    texts = [" ".join(form.format(float(value)) for value in values) for form in forms]
    plain, compiled = both(texts, monkeypatch)
    assert plain == compiled


@pytest.mark.parametrize("count", [0, 1, 60])
def test_points_are_marked_as_by_a_plain_loop(count):
    rng = np.random.default_rng(count)
    starts = starts_of(rng.integers(0, 7, count))
    points = rng.integers(0, 2, (starts[-1], 3)).astype(np.float64)
    kept, lengths = np.zeros(len(points), np.bool_), np.zeros(count, np.int64)
    closed, repeated = np.zeros((2, count), np.bool_)
    cleaning._mark_points(points, starts, kept, lengths, closed, repeated)
    expected: list[bool] = []
    for ring in range(count):
        own = points[starts[ring] : starts[ring + 1]].tolist()
        stays = [p != q for p, q in pairwise(own)]
        is_closed = len(own) > 1 and own[0] == own[-1]
        stays_of_ring = stays + [not is_closed] * bool(own)
        expected += stays_of_ring
        assert (closed[ring], repeated[ring]) == (is_closed, not all(stays))
        assert lengths[ring] == sum(stays_of_ring)
    assert kept.tolist() == expected
    assert count < 60 or all(part.any() and not part.all() for part in (kept, closed, repeated))


def polygons_of(points: np.ndarray, ring_starts: np.ndarray, polygon_starts: np.ndarray) -> Polygons:
    of_polygons = np.zeros((3, len(polygon_starts) - 1), np.int64)
    return Polygons(points, ring_starts, polygon_starts, *of_polygons)


def test_corners_are_hashed_as_by_a_plain_loop():
    rng = np.random.default_rng(3)
    ring_starts = starts_of(rng.integers(3, 9, 80))
    polygon_starts = starts_of(np.full(40, 2))
    points = rng.normal(size=(ring_starts[-1], 3)).round(1)
    points[rng.integers(0, len(points), 30), 1] = -0.0
    chosen = rng.permutation(40)[:31]
    hashes = cleaning._hash_corners(polygons_of(points, ring_starts, polygon_starts), chosen)
    mask = 2**64 - 1
    for (total, twisted), polygon in zip(hashes.T.tolist(), chosen.tolist(), strict=True):
        first, last = (int(ring_starts[polygon_starts[k]]) for k in (polygon, polygon + 1))
        sums = [last - first, 0]
        for corner in points[first:last]:
            key = 0
            for word in (corner + 0.0).view(np.uint64).tolist():
                key = (key ^ word) * 0x9E3779B97F4A7C15 & mask
                key = (key ^ (key >> 31)) * 0xBF58476D1CE4E5B9 & mask
            key ^= key >> 31
            sums = [sums[0] + key & mask, sums[1] + (key * 0x9E3779B97F4A7C15 & mask ^ key >> 31) & mask]
        assert [total, twisted] == sums
    assert len(np.unique(hashes)) == hashes.size
    turned = points.copy()
    for first, last in pairwise(ring_starts):
        turned[first:last] = points[first:last][::-1]
    assert np.array_equal(
        hashes, cleaning._hash_corners(polygons_of(turned, ring_starts, polygon_starts), chosen)
    )


def test_numba_is_left_out_for_a_small_city_and_loaded_for_a_large_one():
    code = (
        "import sys\nfrom lodbench.citymodel.gml.folding import parse_rings\n"
        "parse_rings([b'1.25 2.50 3.75 ' * 1000]); print('numba' in sys.modules)\n"
        "parse_rings([b'1.25 2.50 3.75 ' * 900000]); print('numba' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]


def triangle_set(scene: Scene, *, up_to_translation: bool = False) -> list[set[tuple[int, ...]]]:
    """Per building, its triangles as sorted corners in whole millimetres of the reference system."""
    sets = []
    for b in range(scene.num_buildings):
        triangles = scene.triangles[scene.triangle_starts[b] : scene.triangle_starts[b + 1]]
        corners = scene.vertices.astype(np.float64)[triangles] + scene.origin
        if up_to_translation:
            corners -= corners.reshape(-1, 3).min(axis=0)
        rounded = np.rint(corners * 1000).astype(int)
        sets.append({tuple(np.array(sorted(t.tolist())).reshape(-1).tolist()) for t in rounded})
    return sets


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("town")
    return {name: write(folder / name, text) for name, text in documents().items()}


@pytest.mark.parametrize("name", list(documents()))
def test_every_format_gives_the_same_mesh(town: dict[str, Path], name: str) -> None:
    reference = triangle_set(mesh_city(read_city_model(town["v2.gml"])))
    model = read_city_model(town[name])
    scene = mesh_city(model, "3")
    assert model.findings.counts() == {}
    assert model.building_ids == ("house-0", "house-1", "house-2")
    assert (model.crs, model.lods, scene.lod) == ("EPSG:25832", ("3",), "3")
    assert triangle_set(scene) == reference
    kinds = [SurfaceKind(kind).name for kind in model.polygons.kind[: len(TOWN[0])]]
    assert kinds == ["GROUND", "ROOF"] + ["WALL"] * 6 + ["OPENING"]


def test_a_window_fills_the_hole_of_its_wall(town: dict[str, Path]) -> None:
    mesh = mesh_model(read_city_model(town["v3.gml"]))
    perimeter = sum(8 * (4.0 + i) * (5.0 + i) for i in range(3))
    floors = sum(2 * (3 - 0.09) * (4.0 + i) ** 2 for i in range(3))
    assert mesh.meshed_m2 == pytest.approx(perimeter + floors, abs=1e-3)


def test_real_pair_agrees_per_building_up_to_translation(shared_data: Path) -> None:
    folder = shared_data / "city" / "lod3_reference"
    first = mesh_city(read_city_model(folder / "lod2_buildings_v3.gml"))
    second = mesh_city(read_city_model(folder / "lod2_buildings_as_CityJSON_features.jsonl"))

    assert first.building_ids == second.building_ids
    assert triangle_set(first, up_to_translation=True) == triangle_set(second, up_to_translation=True)
