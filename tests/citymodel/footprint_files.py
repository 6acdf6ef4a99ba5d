"""Vector files of footprints for the tests."""

from pathlib import Path
from typing import Any

import numpy as np


def squares(path: Path, count: int = 40, driver: str = "ESRI Shapefile", **options: Any) -> Path:
    """Writes footprints of 10 m with heights; ``options`` are those of ``pyogrio.raw.write``."""
    import pyogrio
    import shapely

    x = 500000.0 + 20.0 * np.arange(count)
    boxes = shapely.to_wkb(shapely.box(x, 5600000.0, x + 10.0, 5600010.0))
    pyogrio.raw.write(
        str(path),
        boxes,
        [np.full(count, 6.0), np.array([f"b{i}" for i in range(count)], object)],
        fields=["height", "ID"],
        geometry_type="Polygon",
        crs="EPSG:25832",
        driver=driver,
        **options,
    )
    return path
