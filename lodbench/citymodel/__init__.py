"""City models: from any file to buildings in metres, and from buildings to a scene.

Names are loaded when first used, so that importing this package costs nothing. The way of a file, and where
each thing goes:

- its bytes: ``source`` (files, archives, folders), ``gml/xml``, ``vector/gdal``;
  what nobody but the user knows of them: ``options``;
- which reader: ``formats``, ``read``; readers in ``gml``, ``cityjson``, ``mesh``, ``vector``, ``surface``.
  How a publisher writes CityGML that its schema does not say: names in ``gml/names``, what is borrowed from
  elsewhere in ``gml/links``, geometry in ``gml/walk``, attributes in ``gml/details``;
- what readers hand over: ``raw``, with ``attributes`` that count (dates, roofs, heights); then ``cleaning``,
  ``crs``, ``frame`` (metres, east, north), ``polygons``: a ``model``. What is wrong or left out has one of
  ``codes``;
- from a model to a ``scene``: ``triangulate`` (levels too), ``derive`` and ``extrude``, ``read``; kept by
  ``cache`` and ``scene_file``;
- reported: ``checks/report``;
- written: ``convert``, with ``gml/writer``, ``cityjson/writer``, ``mesh/writer``;
- photographed surfaces: ``textures`` for readers and writers, ``textured_map`` for what is rendered.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.citymodel.checks.report import city_info as city_info
    from lodbench.citymodel.model import CityModel as CityModel
    from lodbench.citymodel.options import ReadOptions as ReadOptions
    from lodbench.citymodel.read import CityMesh as CityMesh
    from lodbench.citymodel.read import mesh_city as mesh_city
    from lodbench.citymodel.read import mesh_model as mesh_model
    from lodbench.citymodel.read import open_scene as open_scene
    from lodbench.citymodel.read import parse_city_model as parse_city_model
    from lodbench.citymodel.read import read_city_model as read_city_model
    from lodbench.citymodel.scene import Scene as Scene

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "CityMesh": "read",
        "CityModel": "model",
        "ReadOptions": "options",
        "Scene": "scene",
        "city_info": "checks.report",
        "mesh_city": "read",
        "mesh_model": "read",
        "open_scene": "read",
        "parse_city_model": "read",
        "read_city_model": "read",
    },
)
