"""Public sample models, Khronos' own among them, beside a few independent lines that read them.

They are those of Debian's package assimp-testmodels: ``apt-get install assimp-testmodels``.
"""

from __future__ import annotations

import base64
import itertools
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import traitbrdf as tb
from traitbrdf.formats.files import FormatError

MODELS = Path("/usr/share/assimp/models")
TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


@pytest.fixture(autouse=True)
def _installed():
    if not MODELS.is_dir():
        reason = f"no {MODELS}: apt-get install assimp-testmodels"
        if os.environ.get("CI") == "true":
            pytest.fail(reason)
        pytest.skip(reason)


def plain_gltf(path: Path) -> np.ndarray:
    """The triangles (n, 3, 3) of a glTF 2.0 file without sparse accessors."""
    data = path.read_bytes()
    binary = b""
    if data[:4] == b"glTF":
        size = struct.unpack("<I", data[12:16])[0]
        data, binary = data[20 : 20 + size], data[28 + size :]
    said = json.loads(data)

    def buffer(index: int) -> bytes:
        uri = said["buffers"][index].get("uri")
        if uri is None:
            return binary
        if uri.startswith("data:"):
            return base64.b64decode(uri.split(",")[1])
        return (path.parent / uri).read_bytes()

    def array(index: int) -> np.ndarray:
        one = said["accessors"][index]
        view, kind = said["bufferViews"][one["bufferView"]], np.dtype(TYPES[one["componentType"]])
        start, width = view.get("byteOffset", 0) + one.get("byteOffset", 0), WIDTHS[one["type"]]
        stride = view.get("byteStride", kind.itemsize * width)
        found = np.ndarray(
            (one["count"], width), kind, buffer(view["buffer"]), start, (stride, kind.itemsize)
        )
        return found[:, 0] if width == 1 else found

    def matrix(node: dict) -> np.ndarray:
        if "matrix" in node:
            return np.reshape(node["matrix"], (4, 4)).T
        made = np.eye(4)
        turn = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
        made[:3, :3] = turn * node.get("scale", (1, 1, 1))
        made[:3, 3] = node.get("translation", (0, 0, 0))
        return made

    world: dict[int, np.ndarray] = {}

    def walk(index: int, above: np.ndarray) -> None:
        world[index] = above @ matrix(said["nodes"][index])
        for child in said["nodes"][index].get("children", []):
            walk(child, world[index])

    for root in said["scenes"][said.get("scene", 0)]["nodes"]:
        walk(root, np.eye(4))
    found = []
    for index, place in world.items():
        node = said["nodes"][index]
        if "mesh" not in node:
            continue
        mesh = said["meshes"][node["mesh"]]
        for one in mesh["primitives"]:
            given = one["attributes"]
            points = array(given["POSITION"]).astype(np.float64)
            weights = node.get("weights", mesh.get("weights", []))
            for weight, target in zip(weights, one.get("targets", []), strict=False):
                points = points + weight * array(target["POSITION"])
            points = np.c_[points, np.ones(len(points))]
            if "skin" in node:
                skin = said["skins"][node["skin"]]
                inverse = array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
                bones = np.array([world[j] for j in skin["joints"]]) @ inverse
                share = array(given["WEIGHTS_0"])[..., None, None]
                place_of = (share * bones[array(given["JOINTS_0"])]).sum(axis=1)
                points = (place_of @ points[:, :, None])[:, :3, 0]
            else:
                points = (points @ place.T)[:, :3]
            order = array(one["indices"]) if "indices" in one else np.arange(len(points))
            mode = one.get("mode", 4)
            if mode == 4:
                faces = order.reshape(-1, 3)
            elif mode == 5:
                faces = np.array([order[i : i + 3] for i in range(len(order) - 2)])
            elif mode == 6:
                faces = np.array([[order[0], a, b] for a, b in itertools.pairwise(order[1:])])
            else:
                continue
            found.append(points[faces.astype(np.int64)])
    return np.concatenate(found)


def area_of(triangles: np.ndarray) -> float:
    edges = triangles[:, 1:] - triangles[:, :1]
    return float(0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum())


def check(mesh, triangles: np.ndarray, rel: float = 1e-5) -> None:
    ours = mesh.vertices[mesh.faces]
    size = float(np.ptp(triangles.reshape(-1, 3), axis=0).max())
    assert len(ours) <= len(triangles)  # those of no area are dropped
    assert area_of(ours) == pytest.approx(area_of(triangles), rel=rel)
    for end in (np.min, np.max):
        theirs = end(triangles.reshape(-1, 3), axis=0)
        assert np.allclose(end(ours.reshape(-1, 3), axis=0), theirs, atol=rel * size)
    # no part of no triangles
    assert set(np.unique(mesh.face_part)) == set(range(len(mesh.parts)))


GLTF = {  # the number of parts, counted by hand
    "2CylinderEngine-glTF-Binary/2CylinderEngine.glb": 34,
    "BoxBadNormals-glTF-Binary/BoxBadNormals.glb": 1,
    "BoxTexcoords-glTF/boxTexcoords.gltf": 1,
    "BoxTextured-glTF/BoxTextured.gltf": 1,
    "BoxTextured-glTF-Binary/BoxTextured.glb": 1,
    "BoxTextured-glTF-Embedded/BoxTextured.gltf": 1,
    "BoxTextured-glTF-pbrSpecularGlossiness/BoxTextured.gltf": 1,
    "ClearCoat-glTF/ClearCoatTest.gltf": 27,
    "cameras/Cameras.gltf": 1,
    "glTF-Sample-Models/AnimatedMorphCube-glTF/AnimatedMorphCube.gltf": 1,
    "issue_3269/texcoord_crash.gltf": 5,
    "simple_skin/simple_skin.gltf": 1,
    "textureTransform/TextureTransformTest.gltf": 9,
    **{
        f"glTF-Asset-Generator/Mesh_PrimitiveMode/Mesh_PrimitiveMode_{i:02d}.gltf": 1
        for i in (4, 5, 6, 11, 12, 13, 14, 15)
    },
}


@pytest.mark.parametrize("name", GLTF)
def test_gltf(name):
    mesh = tb.load_mesh(MODELS / "glTF2" / name)
    check(mesh, plain_gltf(MODELS / "glTF2" / name))
    assert len(mesh.parts) == GLTF[name]


def test_draco_is_the_same_engine():
    # Draco has dropped triangles of no area, and rounds positions
    plain = plain_gltf(MODELS / "glTF2/2CylinderEngine-glTF-Binary/2CylinderEngine.glb")
    packed = tb.load_mesh(MODELS / "glTF2/draco/2CylinderEngine.gltf")
    assert len(packed.parts) == 34
    assert area_of(packed.vertices[packed.faces]) == pytest.approx(area_of(plain), rel=1e-3)
    for end in (np.min, np.max):
        theirs = end(plain.reshape(-1, 3), axis=0)
        assert np.allclose(end(packed.vertices, axis=0), theirs, atol=0.5)


REFUSED = {
    "glTF/BoxTextured-glTF-Binary/BoxTextured.glb": "version 1 of the container",
    "glTF/BoxTextured-glTF/BoxTextured.gltf": "version '1.0'; 2.0 is read",
    "glTF/CesiumMilkTruck/CesiumMilkTruck.gltf": "version 1; 2.0 is read",
    "glTF2/BoxTextured-glTF-techniqueWebGL/BoxTextured.gltf": "KHR_technique_webgl",
    "glTF2/BoxWithInfinites-glTF-Binary/BoxWithInfinites.glb": "finite vertices",
    "glTF2/IncorrectVertexArrays/Cube.gltf": "35 indices of triangles",
    "glTF2/IndexOutOfRange/AllIndicesOutOfRange.gltf": "index 65535 of 24 positions",
    "glTF2/IndexOutOfRange/IndexOutOfRange.gltf": "index 255 of 24 positions",
    "glTF2/MissingBin/BoxTextured.gltf": "no file 'BoxTextured0.bin' beside it",
    "glTF2/RecursiveNodes/RecursiveNodes.gltf": "node 0 with two parents",
    "glTF2/SchemaFailures/sceneWrongType.gltf": "'hello' for an index of scenes",
    "glTF2/TestNoRootNode/NoScene.gltf": "expected triangles, got none",
    "glTF2/TestNoRootNode/SceneWithoutNodes.gltf": "expected triangles, got none",
    "glTF2/glTF-Asset-Generator/Mesh_PrimitiveMode/Mesh_PrimitiveMode_00.gltf": "got none",
    "glTF2/glTF-Asset-Generator/Mesh_PrimitiveMode/Mesh_PrimitiveMode_10.gltf": "got none",
    "glTF2/wrongTypes/badArray.gltf": "another type than the specification's",
    "OBJ/number_formats.obj": "in line 11, got 'v 1e+2 2.e+1 3.1+e2'",
    "OBJ/point_cloud.obj": "expected triangles, got none",
    "OBJ/testline.obj": "expected triangles, got none",
    "PLY/Wuson.ply": "a header with 'Created by Blender3D 247",
    "PLY/issue623.ply": "'vertex_indices' of 'vertex'",
    "PLY/points.ply": "expected triangles, got none",
    "PLY/pond.0.ply": "cut within 'vertex'",
    "invalid/empty.obj": "expected triangles, got none",
    "invalid/empty.ply": "starts with b''",
    "invalid/malformed.obj": "index 12 of 8",
    "invalid/malformed2.obj": "fewer than three corners",
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused_is_named(name):
    with pytest.raises(FormatError) as raised:
        tb.load_mesh(MODELS / name)
    assert REFUSED[name] in str(raised.value)
    assert "Error:" not in str(raised.value)


POLYGONS = {  # the number of parts, counted by hand
    "OBJ/WusonOBJ.obj": 1,
    "OBJ/box.obj": 1,
    "OBJ/box_UTF16BE.obj": 1,
    "OBJ/box_longline.obj": 1,
    "OBJ/box_mat_with_spaces.obj": 1,
    "OBJ/box_without_lineending.obj": 1,
    "OBJ/cube_mtllib_after_g.obj": 1,
    "OBJ/cube_usemtl.obj": 3,
    "OBJ/cube_with_vertexcolors.obj": 1,
    "OBJ/spider.obj": 19,
    "OBJ/testmixed.obj": 1,
    "PLY/cube.ply": 1,
    "PLY/cube_binary.ply": 1,
    "PLY/cube_uv.ply": 1,
    "PLY/float-color.ply": 1,
}


def plain_obj(path: Path) -> np.ndarray:
    """The triangles (n, 3, 3) of an OBJ file of convex polygons, as fans."""
    data = path.read_bytes()
    text = data.decode("utf-16" if data[:2] in (b"\xfe\xff", b"\xff\xfe") else "utf-8")
    lines = [line.split() for line in text.replace("\\\n", " ").splitlines()]
    points = np.array([line[1:4] for line in lines if line[:1] == ["v"]], np.float64)
    found = []
    for line in lines:
        if line[:1] == ["f"]:
            corners = [int(word.split("/")[0]) for word in line[1:]]
            corners = [c - 1 if c > 0 else len(points) + c for c in corners]
            found += [(corners[0], a, b) for a, b in itertools.pairwise(corners[1:])]
    return points[np.array(found)]


@pytest.mark.parametrize("name", POLYGONS)
def test_polygons(name):
    mesh = tb.load_mesh(MODELS / name)
    if name.endswith(".obj"):
        triangles = plain_obj(MODELS / name)
    else:
        triangles = np.asarray(trimesh.load(MODELS / name, process=False).triangles)
    check(mesh, triangles)
    assert len(mesh.parts) == POLYGONS[name]
