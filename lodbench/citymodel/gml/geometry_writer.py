"""Polygons, boundary surfaces and solids of an object as CityGML."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.gml.properties_writer import Dialect, Property, tag, text_of
from lodbench.citymodel.model import CityModel, Polygons, SurfaceKind, group_by, select_polygons
from lodbench.citymodel.textures import WrittenPictures
from lodbench.citymodel.triangulate import triangulate
from lodbench.findings import Findings

_THEME = "pictures"


class AppearanceXml:
    """Collects the rings of polygons with pictures while these are written.

    Args:
        polygons: Of the city.
        dialect: The version of CityGML.
        pictures: Its pictures.
    """

    def __init__(self, polygons: Polygons, dialect: Dialect, pictures: WrittenPictures) -> None:
        self._polygons, self._dialect, self._pictures = polygons, dialect, pictures
        self._by_picture: dict[int, dict[str, list[tuple[str, str]]]] = defaultdict(lambda: defaultdict(list))

    def add(self, polygon: int, polygon_id: str, ring: int, points: slice) -> str | None:
        """Returns the id that a ring gets because a picture lies on it, or None.

        Args:
            polygon: Its polygon.
            polygon_id: And that one's id.
            ring: Which of its rings.
            points: The ring's points among those of the city.
        """
        found = self._pictures.on_ring(self._polygons, polygon, points)
        if found is None:
            return None
        picture, places = found
        closed = np.concatenate([places, places[:1]])
        text = " ".join(["%.7g"] * closed.size) % tuple(closed.ravel().tolist())
        ring_id = f"{polygon_id}-ring{ring}"
        self._by_picture[picture][polygon_id].append((ring_id, text))
        return ring_id

    def take(self) -> str:
        """Returns the appearance of all that was added, and forgets it; nothing where there is none."""
        textures = [self._texture(number, targets) for number, targets in sorted(self._by_picture.items())]
        self._by_picture.clear()
        if not textures:
            return ""
        is_old = self._dialect.version == "2.0"
        holder = "app:surfaceDataMember" if is_old else "app:surfaceData"
        data = "".join(tag(holder, texture) for texture in textures)
        appearance = tag("app:Appearance", tag("app:theme", _THEME) + data)
        return tag("app:appearanceMember" if is_old else "core:appearanceMember", appearance) + "\n"

    def _texture(self, picture: int, targets: dict[str, list[tuple[str, str]]]) -> str:
        name, wrap = self._pictures.images[picture]
        mime = "image/jpeg" if name.endswith(".jpg") else "image/png"
        head = tag("app:imageURI", text_of(name)) + tag("app:mimeType", mime)
        head += tag("app:wrapMode", wrap) if wrap else ""
        target = self._target_2 if self._dialect.version == "2.0" else self._target_3
        return tag(
            "app:ParameterizedTexture", head + "".join(target(name, rings) for name, rings in targets.items())
        )

    def _target_2(self, polygon_id: str, rings: list[tuple[str, str]]) -> str:
        places = "".join(tag("app:textureCoordinates", text, ring=f"#{ring}") for ring, text in rings)
        return tag("app:target", tag("app:TexCoordList", places), uri=f"#{polygon_id}")

    def _target_3(self, polygon_id: str, rings: list[tuple[str, str]]) -> str:
        places = "".join(tag("app:textureCoordinates", text) for _, text in rings)
        places += "".join(tag("app:ring", f"#{ring}") for ring, _ in rings)
        inside = tag("app:textureParameterization", tag("app:TexCoordList", places))
        association = tag("app:TextureAssociation", tag("app:target", f"#{polygon_id}") + inside)
        return tag("app:textureParameterization", association)


Face = tuple[int, bool]  # a polygon, and whether it is viewed from behind


@dataclass(frozen=True, slots=True)
class LevelShapes:
    """What an object has at one whole level: solids, and polygons that are in none of them."""

    level: int
    solids: list[list[list[Face]]]
    loose: list[int]

    @property
    def enclosed(self) -> list[int]:
        """The polygons of the solids, each once."""
        return sorted({face for shells in self.solids for shell in shells for face, _ in shell})


def level_of(name: str, dialect: Dialect) -> int:
    """Returns the whole level that a level of detail is written as."""
    whole = int(name[:1]) if name[:1].isdigit() else 2
    return min(whole, dialect.levels[-1])


def left_out(model: CityModel, levels: list[int], notes: Counter[str]) -> NDArray[np.bool_]:
    """Returns which polygons are left out as their object has finer ones: CityGML has whole levels only."""
    polygons = model.polygons
    own = (polygons.building if polygons.part is None else polygons.part).astype(np.int64)
    # The names of levels ascend, so the finest of a whole level has the largest number.
    slot = own * (max(levels, default=0) + 1) + np.asarray(levels, np.int64)[polygons.lod]
    finest = np.full(int(slot.max(initial=-1)) + 1, -1, np.int64)
    np.maximum.at(finest, slot, polygons.lod)
    is_left_out: NDArray[np.bool_] = polygons.lod != finest[slot]
    for n, (name, level) in enumerate(zip(model.lods, levels, strict=True)):
        count = int((is_left_out & (polygons.lod == n)).sum())
        if count:
            notes[f"LoD{name}, {count} polygons: their objects have a finer LoD at level {level}"] += 1
        if name != str(level) and bool(((polygons.lod == n) & ~is_left_out).any()):
            notes[f"LoD{name or ' unnamed'} written as LoD{level}"] += 1
    return is_left_out


_FILLINGS = (SurfaceKind.OPENING, SurfaceKind.DOOR)
_INSTALLED = ("BuildingInstallation", "BuildingConstructiveElement", "BuildingFurniture")


class GeometryXml:
    """Writes the geometry of objects of a city."""

    def __init__(
        self,
        model: CityModel,
        dialect: Dialect,
        polygon_ids: list[str],
        pictures: WrittenPictures,
        notes: Counter[str],
    ) -> None:
        polygons = model.polygons
        self._polygons, self._building_ids = polygons, model.building_ids
        self._points, self._origin = polygons.points, model.origin
        self._rings = polygons.ring_starts.tolist()
        self._polygon_rings = polygons.polygon_starts.tolist()
        self._kinds: list[int] = polygons.kind.tolist()
        self._dialect, self._ids, self._notes = dialect, polygon_ids, notes
        self._solids = model.solids
        self._levels = [level_of(name, dialect) for name in model.lods]
        self._lods: list[int] = polygons.lod.tolist()
        self._of_part = group_by(polygons.building if polygons.part is None else polygons.part)
        self._solids_of_part = {} if model.solids is None else group_by(model.solids.part)
        self._is_left_out = left_out(model, self._levels, notes).tolist()
        self.appearance = AppearanceXml(polygons, dialect, pictures)

    def properties(self, part: int, object_id: str, type_: str) -> Iterator[Property]:
        """Yields the geometry of an object as properties, each with the name that tells its place."""
        for level, polygons, solids in self._by_level(part):
            yield from self._level(level, polygons, solids, object_id, type_)

    def levels_of(self, part: int) -> Iterator[LevelShapes]:
        """Yields the geometry of an object level by level, as it is."""
        for level, polygons, solids in self._by_level(part):
            enclosed = {face for shells in solids for shell in shells for face, _ in shell}
            yield LevelShapes(level, solids, [n for n in polygons if n not in enclosed])

    def _by_level(self, part: int) -> Iterator[tuple[int, list[int], list[list[list[Face]]]]]:
        by_level: dict[int, list[int]] = defaultdict(list)
        for polygon in self._of_part.get(part, ()):
            if not self._is_left_out[polygon]:
                by_level[self._levels[self._lods[polygon]]].append(polygon)
        solids: dict[int, list[list[list[Face]]]] = defaultdict(list)
        for solid in self._solids_of_part.get(part, ()):
            shells = [] if self._solids is None else self._solids.shells_of(solid)
            if shells and not self._is_left_out[shells[0][0][0]]:
                solids[self._levels[self._lods[shells[0][0][0]]]].append(shells)
        for level in sorted(by_level.keys() | solids.keys()):
            yield level, by_level[level], solids[level]

    def _level(
        self, level: int, polygons: list[int], solids: list[list[list[Face]]], object_id: str, type_: str
    ) -> Iterator[Property]:
        """Yields the geometry of one level: surfaces by kind, solids that refer to them, and the rest."""
        own, fillings = self._by_kind(level, polygons, type_)
        bound = {n for group in (*own.values(), *fillings.values()) for n in group}
        for kind, members in sorted(own.items()):
            held = fillings if kind == SurfaceKind.WALL else {}
            yield self._surface(level, kind, members, held, object_id)
        enclosed = {face for shells in solids for shell in shells for face, _ in shell}
        loose = [n for n in polygons if n not in bound and n not in enclosed]
        if self._dialect.version == "3.0":
            yield from self._level_3(level, polygons, solids, bound, loose)
        elif type_ in _INSTALLED:
            shapes = [self._volumes(solids, bound, polygons)] if solids else []
            shapes += [self._multi_surface(loose)] if loose else []
            if shapes:
                members_ = "".join(tag("gml:geometryMember", shape) for shape in shapes)
                shape = shapes[0] if len(shapes) == 1 else tag("gml:MultiGeometry", members_)
                name = f"bldg:lod{max(level, 2)}Geometry"
                yield name, tag(name, shape)
        else:
            space = "room" if type_ == "BuildingRoom" else "bldg"
            level = 4 if space == "room" else level  # the only one that rooms have
            if solids:
                yield (
                    f"{space}:lod{level}Solid",
                    tag(f"bldg:lod{level}Solid", self._volumes(solids, bound, polygons)),
                )
            edges = [n for n in loose if level == 0 and self._kinds[n] == SurfaceKind.ROOF]
            name = "lod0FootPrint" if level == 0 else f"lod{level}MultiSurface"
            for own_name, members in ((name, [n for n in loose if n not in edges]), ("lod0RoofEdge", edges)):
                if members:
                    yield f"{space}:{own_name}", tag(f"bldg:{own_name}", self._multi_surface(members))

    def _level_3(
        self,
        level: int,
        polygons: list[int],
        solids: list[list[list[Face]]],
        bound: set[int],
        loose: list[int],
    ) -> Iterator[Property]:
        """Yields solids and the rest of a level as CityGML 3 has them, which has no solids at level 0."""
        if level == 0:
            enclosed = {face for shells in solids for shell in shells for face, _ in shell}
            loose, solids = loose + sorted(enclosed - bound), []
        name = f"core:lod{level}Solid"
        if solids:
            yield name, tag(name, self._volumes(solids, bound, polygons))
        if loose:
            yield self._loose_3(level, loose)

    def _by_kind(
        self, level: int, polygons: list[int], type_: str
    ) -> tuple[dict[int, list[int]], dict[int, list[int]]]:
        """Returns the polygons that boundary surfaces take, and those of windows and doors, by kind."""
        own: dict[int, list[int]] = defaultdict(list)
        fillings: dict[int, list[int]] = defaultdict(list)
        dialect = self._dialect
        for polygon in polygons:
            kind = self._kinds[polygon]
            if kind == SurfaceKind.INTERIOR and type_ in (*_INSTALLED, "BuildingRoom"):
                continue  # the inside of what is inside needs no saying
            if kind in dialect.surfaces or kind in _FILLINGS:
                if level == 0 and kind == SurfaceKind.ROOF and dialect.version == "2.0":
                    continue  # the edge of a roof is said by its property
                if level not in dialect.surface_levels:
                    what = f"surface without its kind, which CityGML {dialect.version} has not at LoD{level}"
                    self._notes[what] += 1
                elif kind in _FILLINGS:
                    fillings[kind].append(polygon)
                else:
                    own[kind].append(polygon)
        if fillings:
            own[int(SurfaceKind.WALL)]  # what holds them, if need be without a surface of its own
        return own, fillings

    def _loose_3(self, level: int, polygons: list[int]) -> Property:
        """Returns surfaces that bound nothing, which an object of CityGML 3 has none of at level 1."""
        surfaces = self._multi_surface(polygons)
        if level in self._dialect.loose_levels:
            return f"core:lod{level}MultiSurface", tag(f"core:lod{level}MultiSurface", surfaces)
        shape = tag("core:lod1MultiSurface", surfaces)
        return "core:boundary", tag("core:boundary", tag("gen:GenericThematicSurface", shape))

    def _surface(
        self, level: int, kind: int, polygons: list[int], fillings: dict[int, list[int]], object_id: str
    ) -> Property:
        """Returns the boundary surface of a kind, with the openings that it holds."""
        dialect = self._dialect
        prefix = "bldg" if dialect.version == "2.0" else "core"
        name = f"{prefix}:lod{level}MultiSurface"
        content = tag(name, self._multi_surface(polygons)) if polygons else ""
        for filling, members in sorted(fillings.items()):
            for polygon in members:
                shape = tag(dialect.openings[filling], tag(name, self._multi_surface([polygon])))
                content += tag(dialect.opening, shape)
        label = dialect.surfaces[kind]
        own_id = f"{object_id}-lod{level}-{label.partition(':')[2]}"
        return dialect.boundary, tag(dialect.boundary, tag(label, content, gml__id=own_id))

    def solid(self, shapes: LevelShapes) -> str:
        """Returns the solids of an object as one, nothing where it has none."""
        return self._volumes(shapes.solids, set(), shapes.enclosed) if shapes.solids else ""

    def surfaces(self, polygons: list[int]) -> str:
        """Returns polygons as one surface, nothing where there are none."""
        return self._multi_surface(polygons) if polygons else ""

    def triangles(self, polygons: list[int]) -> str:
        """Returns polygons as triangles."""
        own = select_polygons(self._polygons, np.array(polygons, np.int64))
        corners = own.points[triangulate(own, self._building_ids, Findings()).triangles] + self._origin
        closed = np.concatenate([corners, corners[:, :1]], axis=1).reshape(-1, 12)
        form = " ".join(["%.4f"] * 12)
        rings = (tag("gml:posList", form % tuple(row), srsDimension="3") for row in closed.tolist())
        return "".join(
            tag("gml:Triangle", tag("gml:exterior", tag("gml:LinearRing", ring))) for ring in rings
        )

    def _multi_surface(self, polygons: list[int]) -> str:
        members = "".join(tag("gml:surfaceMember", self._polygon(n)) for n in polygons)
        return tag("gml:MultiSurface", members)

    def _volumes(self, solids: list[list[list[Face]]], bound: set[int], own: list[int]) -> str:
        """Returns one solid, or several as one; what a surface, or a face before, has is referred to."""
        faces_of_others = {n for shells in solids for shell in shells for n, _ in shell}.difference(own)
        written = bound | faces_of_others
        shapes = []
        for shells in solids:
            sides = []
            for number, shell in enumerate(shells):
                faces = "".join(self._face(face, written) for face in shell)
                surface = tag(
                    "gml:CompositeSurface" if self._dialect.version == "2.0" else "gml:Shell", faces
                )
                sides.append(tag("gml:interior" if number else "gml:exterior", surface))
            shapes.append(tag("gml:Solid", "".join(sides)))
        if len(shapes) == 1:
            return shapes[0]
        return tag("gml:CompositeSolid", "".join(tag("gml:solidMember", shape) for shape in shapes))

    def _face(self, face: Face, written: set[int]) -> str:
        polygon, is_flipped = face
        holder = "gml:baseSurface" if is_flipped else "gml:surfaceMember"
        if polygon in written:
            member = tag(holder, xlink__href=f"#{self._ids[polygon]}")
        else:
            written.add(polygon)
            member = tag(holder, self._polygon(polygon))
        if not is_flipped:
            return member
        return tag("gml:surfaceMember", tag("gml:OrientableSurface", member, orientation="-"))

    def _polygon(self, polygon: int) -> str:
        sides = []
        first = self._polygon_rings[polygon]
        for ring in range(first, self._polygon_rings[polygon + 1]):
            ends = self._rings[ring], self._rings[ring + 1]
            points = self._points[slice(*ends)]
            closed = np.concatenate([points, points[:1]]) + self._origin
            text = " ".join(["%.4f"] * closed.size) % tuple(closed.ravel().tolist())
            ring_id = self.appearance.add(polygon, self._ids[polygon], ring - first, slice(*ends))
            stated = {} if ring_id is None else {"gml__id": ring_id}
            line = tag("gml:LinearRing", tag("gml:posList", text, srsDimension="3"), **stated)
            sides.append(tag("gml:exterior" if ring == first else "gml:interior", line))
        return tag("gml:Polygon", "".join(sides), gml__id=self._ids[polygon])
