"""What footprints are read with: WKB, rings, blocks, columns, terrain."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lodbench.citymodel import ReadOptions
from lodbench.citymodel.extrude import clean_rings, extrude
from lodbench.citymodel.terrain import ground_under
from lodbench.citymodel.vector.columns import find_column
from lodbench.citymodel.vector.gdal import WkbPolygons
from lodbench.errors import CityModelError, ConfigError

from .gml_text import write


class TestWkb:
    ring = np.array([[0, 0, 1], [4, 0, 2], [4, 4, 3], [0, 0, 1]], np.float64)

    @pytest.mark.parametrize(
        ("order", "code", "width", "extra"),
        [("<", 3, 2, b""), (">", 3, 2, b""), ("<", 1003, 3, b""), ("<", 0x80000003, 3, b""),
         ("<", 0xA0000003, 3, struct.pack("<I", 4326))],
    )  # fmt: skip
    def test_dialects(self, order: str, code: int, width: int, extra: bytes) -> None:
        head = struct.pack(order + "BI", order == "<", code) + extra + struct.pack(order + "II", 1, 4)
        polygons = WkbPolygons()
        polygons.add(head + self.ring[:, :width].astype(order + "f8").tobytes(), 7)
        assert polygons.owner == [7]
        assert polygons.rings[0][:, :width].tolist() == self.ring[:, :width].tolist()

    @pytest.mark.parametrize("cut", [3, 8, 20, 60])
    def test_cut_off(self, cut: int) -> None:
        data = struct.pack("<BIII", 1, 3, 1, 4) + self.ring[:, :2].astype("<f8").tobytes()
        with pytest.raises(ValueError, match="cut off"):
            WkbPolygons().add(data[:cut], 0)

    def test_nesting_ends(self) -> None:
        with pytest.raises(ValueError, match="nested"):
            WkbPolygons().add(struct.pack("<BII", 1, 7, 1) * 50, 0)


class TestParts:
    def test_clean_rings(self) -> None:
        ring = np.array([[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 0]], np.float64)
        points, starts, repeats = clean_rings([ring, ring[:0], ring[2:3]])
        assert points.tolist() == [[0, 0], [1, 0], [1, 1]]
        assert starts.tolist() == [0, 3, 3, 3]
        assert repeats.tolist() == [1, 0, 0]

    def test_extrude_counts(self) -> None:
        points = np.array([[0, 0], [1, 0], [0, 1]], np.float64)
        blocks = extrude(points, np.array([0, 3]), np.array([0, 1]), np.array([2.0]), np.array([5.0]))
        assert blocks.ring_lengths.tolist() == [3, 3, 4, 4, 4]
        assert blocks.kind.tolist() == [3, 2, 1, 1, 1]

    def test_find_column(self) -> None:
        assert find_column(["ID", "Bldg_Height"], ("height", "bldgheight")) == "Bldg_Height"
        assert find_column(["a"], ("height",)) is None

    @pytest.mark.parametrize(
        "text",
        [
            "",
            "ncols 2\nnrows x\n",
            "ncols 2\nnrows 2\n1 2 3\n",
            "ncols 0\nnrows 9\n",
            "ncols inf\nnrows 9\n",
            "ncols 1\nnrows 1\ncellsize 0\n1\n",
            "ncols 1\nnrows 1\nxllcorner 0\nyllcorner 0\n1\n",
            "ncols 1\nnrows 1\ncellsize 1e999\n1\n",
            "ncols 1\nnrows 1\nxllcorner nan\n1\n",
        ],
    )
    def test_malformed_terrain(self, tmp_path: Path, text: str) -> None:
        options = ReadOptions(terrain=str(write(tmp_path / "t.asc", text)))
        with pytest.raises(CityModelError, match="no ASCII grid"):
            ground_under(np.zeros((1, 2)), "EPSG:4326", options)

    @pytest.mark.parametrize(
        "options",
        [{"storey_height_m": 0.0}, {"base": "flying"}, {"sunk_m": -1.0}],
        ids=lambda o: next(iter(o)),
    )
    def test_options_out_of_range(self, options: dict[str, Any]) -> None:
        with pytest.raises(ConfigError):
            ReadOptions(**options)
