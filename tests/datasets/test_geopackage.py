"""GeoPackages of features: layers, columns and types as GDAL reads them; never a city among tiles."""

import numpy as np
import pytest
import shapely

from lodbench.citymodel.source import is_own_geopackage, open_sources
from lodbench.datasets.exchange.geojson import nowhere_feature, write_geopackage

pyogrio = pytest.importorskip("pyogrio", reason="GDAL reads what was written")

FEATURES = [
    {
        "type": "Feature",
        "geometry": {"type": "Point", "coordinates": [7.1, 51.2]},
        "properties": {"name": "a \"quoted\" 'name'.jpg", "height_m": 3, "is_good": True, "tags": ["x", 1]},
    },
    {
        "type": "Feature",
        "geometry": {"type": "LineString", "coordinates": [[7.1, 51.2], [7.2, 51.3]]},
        "properties": {"name": "a"},
    },
    {
        "type": "Feature",
        "geometry": {"type": "Polygon", "coordinates": [[[7, 51], [8, 51], [8, 52], [7, 51]]]},
        "properties": {"name": "a", "ground_m": 1.5},
    },
    nowhere_feature({"name": "lost \udce9.jpg", "failure": "no GPS"}),
]


def test_gdal_reads_layers_columns_and_types(tmp_path):
    path = tmp_path / "a.gpkg"
    write_geopackage(FEATURES, path)
    layers = {name: kind for name, kind in pyogrio.list_layers(path)}
    assert layers == {"cameras": "Point", "views": "LineString", "footprints": "Polygon"}
    meta, _, geometries, values = pyogrio.raw.read(path, layer="cameras")
    rows = dict(zip(meta["fields"], values, strict=True))
    assert meta["crs"] == "EPSG:4326"
    assert shapely.from_wkb(geometries).tolist() == [shapely.Point(7.1, 51.2), None]
    assert rows["name"].tolist() == ["a \"quoted\" 'name'.jpg", "lost \\udce9.jpg"]
    assert rows["height_m"][0] == 3.0
    assert np.isnan(rows["height_m"][1])
    assert rows["tags"][0] == '["x", 1]'
    assert rows["failure"].tolist() == [None, "no GPS"]
    bounds = pyogrio.read_info(path, layer="footprints")["total_bounds"]
    assert tuple(bounds) == (7, 51, 8, 52)


def test_it_is_the_same_again_and_no_city(tmp_path):
    for name in ("a.gpkg", "b.gpkg"):
        write_geopackage(FEATURES, tmp_path / name)
    assert (tmp_path / "a.gpkg").read_bytes() == (tmp_path / "b.gpkg").read_bytes()
    (tmp_path / "tile.gml").write_text("<CityModel/>")
    (tmp_path / "broken.gpkg").write_bytes(b"SQLite format 3\0 and nothing else")
    assert is_own_geopackage(tmp_path / "a.gpkg")
    assert not is_own_geopackage(tmp_path / "broken.gpkg")
    assert [source.path.name for source in open_sources(tmp_path)] == ["broken.gpkg", "tile.gml"]


def test_no_features_at_all_are_an_empty_layer(tmp_path):
    write_geopackage([], tmp_path / "a.gpkg")
    assert pyogrio.read_info(tmp_path / "a.gpkg")["features"] == 0
