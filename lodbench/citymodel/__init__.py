"""City models: from any file to buildings in metres, and from buildings to a scene.

Names are loaded when first used, so that importing this package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lodbench.citymodel.info import city_info as city_info
    from lodbench.citymodel.meshing import CityMesh as CityMesh
    from lodbench.citymodel.meshing import mesh_city as mesh_city
    from lodbench.citymodel.meshing import mesh_model as mesh_model
    from lodbench.citymodel.model import CityModel as CityModel
    from lodbench.citymodel.options import ReadOptions as ReadOptions
    from lodbench.citymodel.read import open_scene as open_scene
    from lodbench.citymodel.read import parse_city_model as parse_city_model
    from lodbench.citymodel.read import read_city_model as read_city_model
    from lodbench.citymodel.scene import Scene as Scene

_HOMES = {
    "CityMesh": "meshing",
    "CityModel": "model",
    "ReadOptions": "options",
    "Scene": "scene",
    "city_info": "info",
    "mesh_city": "meshing",
    "mesh_model": "meshing",
    "open_scene": "read",
    "parse_city_model": "read",
    "read_city_model": "read",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
