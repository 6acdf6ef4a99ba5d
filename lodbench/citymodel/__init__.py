"""City models: from any file to buildings in metres, and from buildings to a scene.

Names are loaded when first used, so that importing this package costs nothing. The way of a file, and where
each thing goes:

- its bytes: ``source`` (archives, folders of tiles), ``streams``, ``xml``, ``json_documents``, ``gdal``;
  what nobody but the user knows of them: ``options``;
- which reader: ``read``, ``readers``; a format each in ``citygml``, ``cityjson``, ``footprints``, ``obj``,
  ``mesh_reader``. How a publisher writes CityGML that its schema does not say: names in ``gml_names``, what
  is borrowed from elsewhere in ``gml_links``, geometry in ``gml_walk``, attributes in ``gml_details``;
- what readers hand over: ``raw``; then ``cleaning``, and ``crs``, ``axis_order``, ``handedness``, ``frame``
  (metres, east, north), ``polygons``: a ``model`` with its ``objects``. All that is wrong or left out has one
  of ``codes``;
- from a model to a ``scene``: ``lods``, ``derive`` and ``extrude`` (levels), ``triangulate``, ``meshing``;
  kept by ``cache``, ``scene_file``; many tiles: ``tiling``, ``scene_join``;
- told: ``info``, ``check`` (``plane_check``, ``shells``, ``solid_check``);
- written: ``convert``, ``citygml_writer`` with ``gml_dialect``, ``cityjson_writer``, ``mesh_writer``;
- photographed surfaces: ``pictures`` of a model, ``textured_mesh`` of a textured map.
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
        "city_info": "info",
        "mesh_city": "meshing",
        "mesh_model": "meshing",
        "open_scene": "read",
        "parse_city_model": "read",
        "read_city_model": "read",
    },
)
