"""Parts of a city: buildings by id, place and attribute; another reference system."""

import re
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from lodbench.citymodel import ReadOptions, mesh_model, read_city_model
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.subset import choose_buildings, reproject
from lodbench.errors import CityModelError

from .gml_text import box_area, box_rings, city, member, solid_of, write


@pytest.fixture
def row(tmp_path: Path) -> CityModel:
    """Three boxes 20 m apart; the second is a church."""
    members = "".join(
        member(
            f"<bldg:function>{'church' if n == 1 else 'house'}</bldg:function>"
            + solid_of(box_rings(x=500000.0 + 20 * n)),
            f"b{n}",
        )
        for n in range(3)
    )
    text = city(members, srs="EPSG:25832+7837")
    return read_city_model(write(tmp_path / "a.gml", text), options=ReadOptions(has_details=True))


def test_by_id_place_and_attribute(row: CityModel) -> None:
    assert choose_buildings(row, ids=["b2", "b0"]).building_ids == ("b0", "b2")
    box = (500015.0, 5600000.0, 500100.0, 5600010.0)
    assert choose_buildings(row, bbox=box).building_ids == ("b1", "b2")
    church = choose_buildings(row, where=[("function", "church")], bbox=box)
    assert church.building_ids == ("b1",)
    assert mesh_model(church).area_m2 == pytest.approx(box_area())
    assert church.solids is not None
    assert church.solids.faces.tolist() == list(range(6))
    assert church.objects is not None
    assert church.objects.attributes == ({"function": "church"},)


def test_what_is_not_there(row: CityModel) -> None:
    with pytest.raises(CityModelError, match="no building 'b9'"):
        choose_buildings(row, ids=["b9"])
    with pytest.raises(CityModelError, match="No building fulfils"):
        choose_buildings(row, where=[("function", "mill")])
    with pytest.raises(CityModelError, match="No building fulfils") as fault:
        choose_buildings(row, bbox=(5.87, 51.02, 5.88, 51.03))
    # Whoever gave degrees sees what is wanted.
    assert re.search(r"lie in 5000\d\d 56000\d\d 5000\d\d 56000\d\d, in EPSG:25832\+7837", fault.value.hint)
    # The rectangle is not at fault where buildings lie in it.
    with pytest.raises(CityModelError, match="No building fulfils") as fault:
        choose_buildings(row, where=[("function", "mill")], bbox=(499000.0, 5600000.0, 501000.0, 5601000.0))
    assert fault.value.hint == "See what there is: lodbench city info FILE."
    with pytest.raises(CityModelError, match="No building has an attribute 'use'"):
        choose_buildings(row, where=[("use", "mill")])


def test_reprojection(row: CityModel) -> None:
    other = reproject(row, "EPSG:31467")
    assert other.crs == "EPSG:31467+7837"
    placed, before = other.polygons.points + other.origin, row.polygons.points + row.origin
    transformer = Transformer.from_crs(25832, 31467, always_xy=True)
    expected = np.stack(transformer.transform(before[:, 0], before[:, 1]), axis=1)
    assert np.allclose(placed[:, :2], expected, atol=1e-6)
    assert np.array_equal(placed[:, 2], before[:, 2])
    assert not other.findings.counts()
    with pytest.raises(CityModelError, match="is not in metres"):
        reproject(row, "EPSG:4326")


def test_a_target_that_is_not_made_for_the_place_is_told_or_refused(row: CityModel) -> None:
    other = reproject(row, "EPSG:25834")
    assert list(other.findings.counts()) == ["LB303 CRS_IMPLAUSIBLE", "LB309 SCALE_OFF"]
    assert not row.findings.counts()
    # Mercator of the whole world: a metre on the ground is 1.6 of its metres there.
    with pytest.raises(CityModelError, match="A metre of EPSG:3857 is off") as caught:
        reproject(row, "EPSG:3857")
    assert "EPSG:32632" in caught.value.hint
