"""Triangle meshes: OBJ, PLY, STL and glTF, with and without textures, read and written."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lodbench.citymodel.formats import MESH_FORMATS, text_of

if TYPE_CHECKING:
    from lodbench.citymodel.options import ReadOptions
    from lodbench.citymodel.raw import RawCity
    from lodbench.citymodel.source import Source


class Obj:
    """Wavefront OBJ (a ``CityFormat``)."""

    label = "OBJ"
    suffixes = (".obj",)

    @staticmethod
    def identify(head: bytes, suffix: str) -> bool:
        """Returns whether a file is called so, or its lines begin as points and faces do."""
        text = text_of(head)
        if text.startswith((b"<", b"{", b"[")):
            return False
        first_words = {line.split(None, 1)[0] for line in text.splitlines() if line.strip()}
        return suffix == ".obj" or bool(first_words & {b"v", b"f", b"o", b"mtllib"})

    @staticmethod
    def read(source: Source, options: ReadOptions) -> RawCity:
        """Returns the buildings."""
        from lodbench.citymodel.mesh.obj import read_obj

        with source.open() as stream:
            return read_obj(stream, source.name, options.up_axis)


class Mesh:
    """PLY, STL and glTF (a ``CityFormat``)."""

    label = "meshes"
    suffixes = tuple(MESH_FORMATS)

    @staticmethod
    def identify(head: bytes, suffix: str) -> bool:
        """Returns whether a file is called as these are."""
        return suffix in MESH_FORMATS

    @staticmethod
    def read(source: Source, options: ReadOptions) -> RawCity:
        """Returns the buildings."""
        from lodbench.citymodel.mesh.reader import read_mesh

        with source.open() as stream:
            return read_mesh(stream, source.name, source.suffix, options)
