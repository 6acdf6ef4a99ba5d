"""GDAL reads by the ending, never by what a file says of itself; what is cut off is told."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest

from lodbench.citymodel import ReadOptions, read_city_model
from lodbench.citymodel.vector.gdal import missing_bytes
from lodbench.cli import main
from lodbench.errors import CityModelError

from .gml_text import squares, write

pytestmark = pytest.mark.attack

pytest.importorskip("pyogrio")

# A VRT runs the SQL of its open options and reads any other file.
_VRT = """<OGRVRTDataSource><OGRVRTLayer name="x">
<SrcDataSource>{inner}</SrcDataSource>
<OpenOptions><OOI key="PRELUDE_STATEMENTS">VACUUM INTO '{target}'</OOI></OpenOptions>
</OGRVRTLayer></OGRVRTDataSource>"""


class TestDrivers:
    @pytest.fixture
    def trap(self, tmp_path: Path) -> tuple[str, Path]:
        inner = squares(tmp_path / "inner.gpkg", driver="GPKG")
        target = tmp_path / "written.db"
        return _VRT.format(inner=inner, target=target), target

    @pytest.mark.parametrize("name", ["b.geojson", "b.gpkg", "b.shp", "b.fgb"])
    def test_a_vrt_under_another_name_is_refused(self, tmp_path, trap, name):
        text, target = trap
        (tmp_path / "tiles").mkdir()
        path = write(tmp_path / "tiles" / name, text)
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
            archive.writestr(name, text)
        for city in (path, path.parent, tmp_path / "a.zip"):
            with pytest.raises(CityModelError, match="although its ending says so"):
                read_city_model(city)
        assert not target.exists()

    def test_a_geojson_of_another_kind_of_json(self, tmp_path: Path) -> None:
        command = '{"type": "gdal_streamed_alg", "command_line": "gdal vector pipeline ! read x.gpkg"}'
        with pytest.raises(CityModelError, match="cannot be read"):
            read_city_model(write(tmp_path / "b.geojson", command))

    def test_only_known_drivers_are_registered(self, tmp_path: Path) -> None:
        path = squares(tmp_path / "a.gpkg", driver="GPKG")
        script = (
            "import sys; from lodbench.citymodel import read_city_model; read_city_model(sys.argv[1]);"
            "import pyogrio; print(*pyogrio.list_drivers(), sep=',')"
        )
        words = [sys.executable, "-c", script, str(path)]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        drivers = {"ESRI Shapefile", "FlatGeobuf", "GPKG", "GeoJSON", "OSM", "OpenFileGDB"}
        assert set(done.stdout.strip().split(",")) == drivers
        assert done.stderr == ""

    def test_a_vrt_as_terrain(self, tmp_path: Path) -> None:
        pytest.importorskip("rasterio")
        squares(tmp_path / "b.gpkg", driver="GPKG")
        for name, told in (
            ("t.tif", "cannot be read as a raster"),
            ("t.vrt", "no terrain model by its ending"),
        ):
            raster = write(tmp_path / name, '<VRTDataset rasterXSize="1" rasterYSize="1"/>')
            with pytest.raises(CityModelError, match=told):
                read_city_model(tmp_path / "b.gpkg", options=ReadOptions(terrain=str(raster)))


class TestCutOff:
    @pytest.mark.parametrize(("suffix", "keep"), [(".shp", 0.4), (".dbf", 0.5), (".shx", 0.6)])
    def test_a_shapefile_cut_short(self, tmp_path: Path, suffix: str, keep: float, capsys: Any) -> None:
        path = squares(tmp_path / "a.shp")
        assert missing_bytes(str(path)) == []
        cut = path.with_suffix(suffix)
        size = cut.stat().st_size
        with cut.open("r+b") as stream:
            stream.truncate(int(size * keep))
        with pytest.raises(CityModelError, match=rf"cut off: its {suffix} has \d+ of [0-9]+ bytes"):
            read_city_model(path)
        code = main(["city", "check", str(path)])
        out = capsys.readouterr()
        assert (code, "LB212" in out.out) == ((1, True) if suffix == ".shp" else (2, False)), out

    def test_in_a_zip(self, tmp_path: Path) -> None:
        path = squares(tmp_path / "a.shp")
        with path.open("r+b") as stream:
            stream.truncate(1000)
        shutil.make_archive(str(tmp_path / "z"), "zip", tmp_path, None)
        with pytest.raises(CityModelError, match=r"z\.zip!a\.shp is cut off"):
            read_city_model(tmp_path / "z.zip")

    def test_warnings_of_gdal_are_findings(self, tmp_path: Path, recwarn: Any) -> None:
        path = squares(tmp_path / "a.gpkg", driver="GPKG")
        import sqlite3

        with sqlite3.connect(path) as database:
            database.execute("PRAGMA user_version = 99000")
        model = read_city_model(path)
        assert model.findings.counts().get("LB214 READER_WARNING") == 1
        assert not recwarn.list

    def test_layers(self, tmp_path: Path, recwarn: Any) -> None:
        import sqlite3

        path = squares(tmp_path / "a.gpkg", driver="GPKG", layer="houses")
        with sqlite3.connect(path) as database:  # what a GIS leaves beside its layers
            database.execute("CREATE TABLE layer_styles (id INTEGER PRIMARY KEY, style TEXT)")
            database.execute(
                "INSERT INTO gpkg_contents (table_name, data_type) VALUES ('layer_styles', 'attributes')"
            )
        assert "LB214 READER_WARNING" not in read_city_model(path).findings.counts()
        squares(path, driver="GPKG", layer="sheds", append=True)
        (told,) = (
            item for item in read_city_model(path).findings.items if item.code.name == "READER_WARNING"
        )
        assert told.detail == "of its layers houses, sheds the first is read"
        chosen = read_city_model(path, options=ReadOptions(layer="sheds"))
        assert "LB214 READER_WARNING" not in chosen.findings.counts()
        with pytest.raises(CityModelError, match="no layer 'shed'") as caught:
            read_city_model(path, options=ReadOptions(layer="shed"))
        assert "sheds" in caught.value.hint
        assert not recwarn.list
