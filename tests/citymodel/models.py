"""City models read from texts that tests write, and the codes of what was found in them."""

from pathlib import Path

from lodbench.citymodel import read_city_model
from lodbench.citymodel.model import CityModel

from .gml_text import write


def model_of(tmp_path: Path, text: str | bytes, **options: object) -> CityModel:
    """Reads a CityGML text."""
    return read_city_model(write(tmp_path / "city.gml", text), **options)  # type: ignore[arg-type]


def codes(model: CityModel) -> dict[str, int]:
    """Counts findings by code."""
    return {key.split()[0]: count for key, count in model.findings.counts().items()}
