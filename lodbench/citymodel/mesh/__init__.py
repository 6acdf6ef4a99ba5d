"""Triangle meshes: OBJ, PLY, STL and glTF, with and without textures, read and written."""
