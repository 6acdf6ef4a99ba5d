"""City models: from any file to buildings in metres, and from buildings to a scene.

Names are loaded when first used, so that importing this package costs nothing. The way of a file, and where
each thing goes:

- its bytes: ``source`` (files, archives, folders), ``gml/xml``, ``json_documents``, ``vector/gdal``;
  what nobody but the user knows of them: ``options``;
- which reader: ``read``, ``formats``; formats in ``gml``, ``cityjson``, ``mesh``, ``vector``, ``surface``.
  How a publisher writes CityGML that its schema does not say: names in ``gml/names``, what is borrowed from
  elsewhere in ``gml/links``, geometry in ``gml/walk``, attributes in ``gml/details``;
- what readers hand over: ``raw``; then ``cleaning``, and ``crs``, ``axis_order``, ``frame`` (metres, east,
  north), ``bases``, ``polygons``: a ``model``. All that is wrong or left out has one of ``codes``;
- from a model to a ``scene``: ``lods``, ``derive`` and ``extrude`` (levels), ``triangulate``, ``meshing``;
  kept by ``cache`` and ``scene_file``;
- reported: ``city_info`` in ``read``, ``checks``;
- written: ``convert``, with ``gml/writer``, ``cityjson/writer``, ``mesh/writer``;
- photographed surfaces: ``pictures`` of a model, ``mesh/textured`` of a textured map.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.citymodel.meshing import CityMesh as CityMesh
    from lodbench.citymodel.meshing import mesh_city as mesh_city
    from lodbench.citymodel.meshing import mesh_model as mesh_model
    from lodbench.citymodel.model import CityModel as CityModel
    from lodbench.citymodel.options import ReadOptions as ReadOptions
    from lodbench.citymodel.read import city_info as city_info
    from lodbench.citymodel.read import open_scene as open_scene
    from lodbench.citymodel.read import parse_city_model as parse_city_model
    from lodbench.citymodel.read import read_city_model as read_city_model
    from lodbench.citymodel.scene import Scene as Scene

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "CityMesh": "meshing",
        "CityModel": "model",
        "ReadOptions": "options",
        "Scene": "scene",
        "city_info": "read",
        "mesh_city": "meshing",
        "mesh_model": "meshing",
        "open_scene": "read",
        "parse_city_model": "read",
        "read_city_model": "read",
    },
)
