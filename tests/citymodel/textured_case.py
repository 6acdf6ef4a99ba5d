"""A roof with a picture on it, as a mesh or a city of every kind that textured maps are read from."""

import base64
import json
import struct

import cv2
import numpy as np

# A square roof of 20 x 10 m at 7 m, picture of 4 x 2 pixels: red, green, blue, white over black.
CORNERS = np.array([(0.0, 0.0, 7.0), (20.0, 0.0, 7.0), (20.0, 10.0, 7.0), (0.0, 10.0, 7.0)])
UV = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
PICTURE = np.zeros((2, 4, 3), dtype=np.uint8)
PICTURE[0] = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)]
EAST, NORTH = 691000.0, 5335000.0


def write_picture(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), PICTURE[:, :, ::-1])
    return path


def write_obj(folder, picture="roof.png", name="map.obj", shift=(0.0, 0.0, 0.0)):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "map.mtl").write_text(f"newmtl roof\nmap_Kd {picture}\n")
    lines = ["mtllib map.mtl", "usemtl roof"]
    lines += [f"v {x} {y} {z}" for x, y, z in CORNERS + shift]
    lines += [f"vt {u} {v}" for u, v in UV] + ["f 1/1 2/2 3/3", "f 1/1 3/3 4/4"]
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder / name


def write_gltf(folder, uri="roof.png", change=lambda content: None):
    """glTF has y up and (0, 0) at a picture's upper left corner."""
    points = np.stack([CORNERS[:, 0], CORNERS[:, 2], -CORNERS[:, 1]], axis=1).astype("<f4")
    uv = np.stack([UV[:, 0], 1 - UV[:, 1]], axis=1).astype("<f4")
    indices = np.array([0, 1, 2, 0, 2, 3], dtype="<u2")
    blob = points.tobytes() + uv.tobytes() + indices.tobytes()
    views = [(0, 48), (48, 32), (80, 12)]
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}
        ],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": uri}],
        "buffers": [
            {
                "byteLength": len(blob),
                "uri": "data:application/octet-stream;base64," + base64.b64encode(blob).decode(),
            }
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": a, "byteLength": n} for a, n in views],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": 4,
                "type": "VEC3",
                "min": points.min(axis=0).tolist(),
                "max": points.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
    }
    change(content)
    path = folder / "map.gltf"
    path.write_text(json.dumps(content))
    return path


def write_glb(folder, change=lambda content: None):
    path = write_gltf(folder)
    content = json.loads(path.read_text())
    content["images"] = [
        {"uri": "data:image/png;base64," + base64.b64encode((folder / "roof.png").read_bytes()).decode()}
    ]
    change(content)
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    path.unlink()
    path = folder / "map.glb"
    chunk = struct.pack("<II", len(text), 0x4E4F534A) + text
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunk)) + chunk)
    return path


GML = """<?xml version="1.0" encoding="UTF-8"?>
<CityModel xmlns="http://www.opengis.net/citygml/2.0" xmlns:app="http://www.opengis.net/citygml/appearance/2.0"
 xmlns:bldg="http://www.opengis.net/citygml/building/2.0" xmlns:gml="http://www.opengis.net/gml">
<gml:boundedBy><gml:Envelope srsName="EPSG:25832" srsDimension="3"><gml:lowerCorner>0 0 0</gml:lowerCorner>
<gml:upperCorner>1 1 1</gml:upperCorner></gml:Envelope></gml:boundedBy>
<cityObjectMember><bldg:Building gml:id="b"><bldg:lod1MultiSurface><gml:MultiSurface><gml:surfaceMember>
<gml:Polygon><gml:exterior><gml:LinearRing><gml:posList>0 0 0 1 0 0 1 1 0 0 0 0</gml:posList></gml:LinearRing>
</gml:exterior></gml:Polygon></gml:surfaceMember></gml:MultiSurface></bldg:lod1MultiSurface>
<bldg:boundedBy><bldg:RoofSurface gml:id="roof"><bldg:lod2MultiSurface><gml:MultiSurface><gml:surfaceMember>
<gml:Polygon gml:id="poly"><gml:exterior><gml:LinearRing gml:id="ring"><gml:posList>{ring}</gml:posList>
</gml:LinearRing></gml:exterior></gml:Polygon></gml:surfaceMember></gml:MultiSurface></bldg:lod2MultiSurface>
</bldg:RoofSurface></bldg:boundedBy></bldg:Building></cityObjectMember>
<app:appearanceMember><app:Appearance><app:theme>photo</app:theme><app:surfaceDataMember>{texture}
</app:surfaceDataMember></app:Appearance></app:appearanceMember>
</CityModel>
"""
BY_RING = """<app:ParameterizedTexture><app:imageURI>pictures/roof.png</app:imageURI><app:target uri="#poly">
<app:TexCoordList><app:textureCoordinates ring="#ring">0 0 1 0 1 1 0 1 0 0</app:textureCoordinates>
</app:TexCoordList></app:target></app:ParameterizedTexture>"""
BY_RING_OF_VERSION_3 = """<app:ParameterizedTexture><app:imageURI>pictures/roof.png</app:imageURI>
<app:textureParameterization><app:TextureAssociation><app:target>#poly</app:target>
<app:textureParameterization><app:TexCoordList>
<app:textureCoordinates>0 0 1 0 1 1 0 1 0 0</app:textureCoordinates>
<app:ring>#ring</app:ring></app:TexCoordList></app:textureParameterization></app:TextureAssociation>
</app:textureParameterization></app:ParameterizedTexture>"""
BY_MATRIX = f"""<app:ParameterizedTexture><app:imageURI>pictures/roof.png</app:imageURI>
<app:target uri="#poly"><app:TexCoordGen>
<app:worldToTexture>0.05 0 0 {-0.05 * EAST} 0 0.1 0 {-0.1 * NORTH} 0 0 0 1</app:worldToTexture>
</app:TexCoordGen></app:target></app:ParameterizedTexture>"""
# Pixels of 5 x 5 m; the middle of the upper left one.
BY_GROUND = f"""<app:GeoreferencedTexture><app:imageURI>pictures/roof.png</app:imageURI><app:referencePoint>
<gml:Point><gml:pos>{EAST + 2.5} {NORTH + 7.5}</gml:pos></gml:Point></app:referencePoint>
<app:orientation>5 0 0 -5</app:orientation><app:target>#roof</app:target></app:GeoreferencedTexture>"""
BY_WORLD_FILE = """<app:GeoreferencedTexture><app:preferWorldFile>true</app:preferWorldFile>
<app:imageURI>pictures/roof.png</app:imageURI><app:target>#poly</app:target></app:GeoreferencedTexture>"""
KINDS = {
    "ring": BY_RING,
    "version 3": BY_RING_OF_VERSION_3,
    "matrix": BY_MATRIX,
    "ground": BY_GROUND,
    "world file": BY_WORLD_FILE,
}


def write_gml(folder, texture=BY_RING):
    places = CORNERS[[0, 1, 2, 3, 0]] + (EAST, NORTH, 0)
    ring = " ".join(str(number) for number in places.ravel())
    path = folder / "map.gml"
    path.write_text(GML.format(ring=ring, texture=texture))
    write_picture(folder / "pictures" / "roof.png")
    (folder / "pictures" / "roof.pgw").write_text(f"5\n0\n0\n-5\n{EAST + 2.5}\n{NORTH + 7.5}\n")
    return path


def assert_is_the_roof(mesh, shift=(0.0, 0.0, 0.0)):
    """Every corner has the texture coordinates it was written with, and the picture its colours."""
    assert len(mesh.corners) == 2
    for corners, uv in zip(mesh.corners - np.asarray(shift), mesh.uv, strict=True):
        for corner, place in zip(corners, uv, strict=True):
            k = int(np.argmin(np.abs(CORNERS - corner).sum(axis=1)))
            np.testing.assert_allclose(corner, CORNERS[k], atol=1e-6)
            np.testing.assert_allclose(place, UV[k], atol=1e-5)
    assert mesh.picture.tolist() == [0, 0]
    np.testing.assert_array_equal(mesh.pictures[0], PICTURE)
