"""Triangle meshes: OBJ, PLY, STL and glTF, with and without textures, read and written."""

from lodbench.citymodel.formats import Mesh as Mesh
from lodbench.citymodel.formats import Obj as Obj
