"""Mesh files: every form of glTF accessor, primitive, node and extension; OBJ and PLY polygons.

Files are written here, and area, bounds and parts are what the specification says of them.
"""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import DracoPy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from traitbrdf.formats.files import FormatError
from traitbrdf.formats.polygons import triangulate
from traitbrdf.scene.meshes import load_mesh
from traitbrdf.scene.shapes import Mesh

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
TWO = np.array([0, 1, 2, 0, 2, 3], np.uint16)
_TYPES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_WIDTHS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


def area(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def part_areas(mesh: Mesh) -> dict[str, float]:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return {n: float(areas[mesh.face_part == i].sum()) for i, n in enumerate(mesh.parts)}


def bounds(mesh: Mesh) -> list[list[float]]:
    used = mesh.vertices[mesh.faces].reshape(-1, 3)
    return [used.min(axis=0).round(6).tolist(), used.max(axis=0).round(6).tolist()]


class Writer:
    """Writes glTF files piece by piece."""

    def __init__(self) -> None:
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0"}, "meshes": [], "nodes": [], "scenes": [{"nodes": []}],
            "scene": 0, "accessors": [], "bufferViews": [], "buffers": [],
        }  # fmt: skip
        self.data = b""

    def view(self, data: bytes, stride: int | None = None) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        entry = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        if stride is not None:
            entry["byteStride"] = stride
        self.data += data
        self.document["bufferViews"].append(entry)
        return len(self.document["bufferViews"]) - 1

    def accessor(self, values: Any, view: int | None = None, **more: Any) -> int:
        values = np.asarray(values)
        width = 1 if values.ndim == 1 else values.shape[1]
        if view is None and more.get("sparse") is None:
            view = self.view(values.tobytes())
        entry = {
            "componentType": _TYPES[values.dtype.str[1:]], "count": len(values),
            "type": _WIDTHS[width], **more,
        }  # fmt: skip
        if view is not None:
            entry["bufferView"] = view
        self.document["accessors"].append(entry)
        return len(self.document["accessors"]) - 1

    def mesh(self, primitives: list[dict[str, Any]], **more: Any) -> int:
        self.document["meshes"].append({"primitives": primitives, **more})
        return len(self.document["meshes"]) - 1

    def node(self, root: bool = True, **entry: Any) -> int:
        self.document["nodes"].append(entry)
        index = len(self.document["nodes"]) - 1
        if root:
            self.document["scenes"][0]["nodes"].append(index)
        return index

    def simple(self, positions: Any = SQUARE, indices: Any = TWO, **primitive: Any) -> int:
        """Add a mesh of one primitive; return it."""
        found = {"attributes": {"POSITION": self.accessor(positions)}, **primitive}
        if indices is not None:
            found["indices"] = self.accessor(indices)
        return self.mesh([found])

    def write(self, path: Path, uri: str | None = "") -> Path:
        """Write .gltf with a buffer at `uri` (embedded if empty), or .glb."""
        document = dict(self.document)
        document["buffers"] = [{"byteLength": len(self.data)}]
        document = {k: v for k, v in document.items() if v != []}
        if path.suffix == ".glb":
            text = json.dumps(document).encode()
            text += b" " * (-len(text) % 4)
            body = self.data + b"\0" * (-len(self.data) % 4)
            chunks = struct.pack("<I4s", len(text), b"JSON") + text
            chunks += struct.pack("<I4s", len(body), b"BIN\0") + body
            path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
            return path
        if uri == "":
            uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        document["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(document))
        return path


def read(writer: Writer, tmp_path: Path, suffix: str = ".gltf") -> Mesh:
    return load_mesh(writer.write(tmp_path / f"made{suffix}"))


# -- glTF: buffers --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("uri", "name"),
    [
        ("my%20chair.bin", "my chair.bin"),
        ("my chair.bin", "my chair.bin"),
        ("my%20chair.bin", "my%20chair.bin"),
        ("parts/a.bin", "parts/a.bin"),
        ("st%C3%BChle.bin", "stühle.bin"),
        ("a%2Bb%23c.bin", "a+b#c.bin"),
    ],
)
def test_buffers_beside_the_file(tmp_path, uri, name):
    writer = Writer()
    writer.node(mesh=writer.simple())
    file = tmp_path / name
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(writer.data)
    mesh = load_mesh(writer.write(tmp_path / "a.gltf", uri))
    assert area(mesh) == pytest.approx(1.0)


@pytest.mark.parametrize("kind", ["base64", "percent", "glb"])
def test_embedded_buffers(tmp_path, kind):
    writer = Writer()
    writer.node(mesh=writer.simple())
    if kind == "glb":
        assert area(read(writer, tmp_path, ".glb")) == pytest.approx(1.0)
        return
    uri = "data:application/gltf-buffer," + "".join(f"%{b:02x}" for b in writer.data)
    if kind == "base64":
        uri = "data:;base64," + base64.b64encode(writer.data).decode()
    assert area(load_mesh(writer.write(tmp_path / "a.gltf", uri))) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("https://example.org/a.bin", "only files beside it"),
        ("missing.bin", "no file 'missing.bin' beside it"),
        ("data:application/octet-stream;base64", "without a comma"),
        ("data:;base64,AAAA", "buffer 0 of 3 bytes"),
        (None, "buffer 0 without a uri|uri"),
    ],
)
def test_buffers_that_cannot_be_had(tmp_path, uri, message):
    writer = Writer()
    writer.node(mesh=writer.simple())
    with pytest.raises(FormatError, match=message):
        load_mesh(writer.write(tmp_path / "a.gltf", uri))


# -- glTF: accessors ------------------------------------------------------------------------------


def sparse(writer: Writer, rows: Any, values: Any) -> dict[str, Any]:
    rows, values = np.asarray(rows), np.asarray(values)
    return {
        "count": len(rows),
        "indices": {
            "bufferView": writer.view(rows.tobytes()), "componentType": _TYPES[rows.dtype.str[1:]]
        },
        "values": {"bufferView": writer.view(values.tobytes())},
    }  # fmt: skip


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.uint32])
def test_sparse_accessors_move_corners(tmp_path, kind):
    writer = Writer()
    moved = sparse(writer, np.array([1, 2], kind), np.array([[3, 0, 0], [3, 1, 0]], np.float32))
    positions = writer.accessor(SQUARE, writer.view(SQUARE.tobytes()), sparse=moved)
    mesh = writer.mesh([{"attributes": {"POSITION": positions}, "indices": writer.accessor(TWO)}])
    writer.node(mesh=mesh)
    found = read(writer, tmp_path)
    assert area(found) == pytest.approx(3.0)
    assert bounds(found) == [[0, 0, 0], [3, 1, 0]]


def test_accessors_without_a_view_are_zeros_and_sparse_values(tmp_path):
    writer = Writer()
    moved = sparse(writer, np.array([1, 2, 3], np.uint8), SQUARE[1:])
    positions = writer.accessor(SQUARE, None, sparse=moved)
    mesh = writer.mesh([{"attributes": {"POSITION": positions}, "indices": writer.accessor(TWO)}])
    writer.node(mesh=mesh)
    assert area(read(writer, tmp_path)) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("kind", "normalized", "size"),
    [
        (np.int8, True, 1.0), (np.uint8, True, 1.0), (np.int16, True, 1.0), (np.uint16, True, 1.0),
        (np.int8, False, 127.0), (np.uint8, False, 255.0), (np.int16, False, 32767.0),
        (np.uint16, False, 65535.0), (np.float32, False, 1.0),
    ],
)  # fmt: skip
def test_integers_are_numbers_or_shares(tmp_path, kind, normalized, size):
    writer = Writer()
    top = 1 if kind is np.float32 else np.iinfo(kind).max
    # rows padded to four bytes, as the format demands
    step = -(-3 * np.dtype(kind).itemsize // 4) * 4
    rows = b"".join((top * row).astype(kind).tobytes().ljust(step, b"\0") for row in SQUARE)
    flag = {"normalized": True} if normalized else {}
    positions = writer.accessor(SQUARE.astype(kind), writer.view(rows, step), **flag)
    mesh = writer.mesh([{"attributes": {"POSITION": positions}, "indices": writer.accessor(TWO)}])
    writer.node(mesh=mesh, scale=[0.25, 0.25, 0.25])
    writer.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    assert area(read(writer, tmp_path)) == pytest.approx((0.25 * size) ** 2, rel=1e-6)


def test_negative_shares_end_at_minus_one(tmp_path):
    writer = Writer()
    corners = np.array([[-128, 0, 0, 0], [127, 0, 0, 0], [0, 127, 0, 0]], np.int8)
    view = writer.view(corners.tobytes(), 4)
    positions = writer.accessor(corners[:, :3], view, normalized=True)
    writer.node(mesh=writer.mesh([{"attributes": {"POSITION": positions}}]))
    assert bounds(read(writer, tmp_path)) == [[-1, 0, 0], [1, 1, 0]]


def test_interleaved_attributes(tmp_path):
    writer = Writer()
    normals = np.tile(np.float32([0, 0, 1]), (4, 1))
    uvs = SQUARE[:, :2] * np.float32(0.5)
    rows = np.concatenate([SQUARE, normals, uvs], axis=1).astype(np.float32)
    view = writer.view(b"\7" * 8 + rows.tobytes(), 32)
    attributes = {
        "POSITION": writer.accessor(SQUARE, view, byteOffset=8),
        "NORMAL": writer.accessor(normals, view, byteOffset=20),
        "TEXCOORD_0": writer.accessor(uvs, view, byteOffset=32),
    }
    indices = writer.accessor(TWO)
    writer.node(mesh=writer.mesh([{"attributes": attributes, "indices": indices}]))
    found = read(writer, tmp_path)
    assert area(found) == pytest.approx(1.0)
    assert np.allclose(found.normals, [0, 0, 1])
    corners = found.vertices[found.faces][..., :2] * 0.5
    assert np.allclose(found.uvs, corners * [1, -1] + [0, 1])  # v is down in the file


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.uint32])
def test_kinds_of_indices(tmp_path, kind):
    writer = Writer()
    writer.node(mesh=writer.simple(indices=TWO.astype(kind)))
    assert area(read(writer, tmp_path)) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda d: d["accessors"][1].update(count=7), "for 7 elements"),
        (lambda d: d["accessors"][0].update(count=3), "index 3 of 3 positions"),
        (lambda d: d["accessors"][0].update(type="VEC2"), "VEC3 is expected"),
        (lambda d: d["accessors"][0].update(type="VEC9"), "VEC3 is expected"),
        (lambda d: d["accessors"][0].update(componentType=5124), "of type 5124"),
        (lambda d: d["accessors"][0].update(byteOffset=-4), "elements of 12 bytes"),
        (lambda d: d["accessors"][0].update(bufferView=9), "index 9 of 2 bufferViews"),
        (lambda d: d["accessors"][0].update(count=1 << 40), "bytes in a file of"),
        (lambda d: d["accessors"][1].update(componentType=5126), "elements|type"),
        (lambda d: d["bufferViews"][0].update(byteLength=999), "buffer view 0: bytes"),
        (lambda d: d["bufferViews"][0].update(byteStride=4), "4 apart"),
        (lambda d: d["nodes"][0].update(mesh=-1), "index -1 of 1 meshes"),
        (lambda d: d["nodes"][0].update(mesh=True), "True for an index"),
        (lambda d: d["nodes"][0].update(matrix=[1.0] * 15), "reshape"),
        (lambda d: d["nodes"][0].update(translation=[float("inf"), 0, 0]), "not finite"),
        (lambda d: d["nodes"][0].update(children=[0]), "two parents"),
        (lambda d: d["meshes"][0]["primitives"][0].update(mode=9), "mode 9"),
        (lambda d: d["asset"].update(version="1.0"), "version '1.0'"),
        (lambda d: d["asset"].update(minVersion="2.1"), "minVersion '2.1'"),
        (lambda d: d.update(scene=3), "index 3 of 1 scenes"),
        (lambda d: d.update(extensionsRequired=["ACME_geometry"]), "ACME_geometry"),
        (lambda d: d.update(extensionsRequired=["EXT_meshopt_compression"]), "EXT_meshopt"),
        (lambda d: d.pop("meshes"), "expected"),
    ],
)
def test_faults_are_named(tmp_path, spoil, message):
    writer = Writer()
    writer.node(mesh=writer.simple())
    spoil(writer.document)
    with pytest.raises(FormatError, match=message):
        read(writer, tmp_path)


# -- glTF: primitives -----------------------------------------------------------------------------


@pytest.mark.parametrize("indexed", [True, False])
@pytest.mark.parametrize(
    ("mode", "corners"),
    [
        (4, [[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]]),
        (5, [[0, 0], [1, 0], [0, 1], [1, 1], [0, 2], [1, 2]]),
        (6, [[0, 0], [2, 0], [2, 1], [1, 2], [0, 2]]),
    ],
)
def test_modes_of_triangles(tmp_path, mode, corners, indexed):
    writer = Writer()
    positions = np.c_[np.array(corners, np.float32), np.zeros(len(corners), np.float32)]
    indices = np.arange(len(corners), dtype=np.uint16) if indexed else None
    writer.node(mesh=writer.simple(positions, indices, mode=mode))
    mesh = read(writer, tmp_path)
    expected = {4: 1.0, 5: 2.0, 6: 3.5}[mode]
    assert area(mesh) == pytest.approx(expected)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] > 0.0).all()  # all wind as the first one
    assert np.allclose(mesh.normals, [0, 0, 1])


def test_points_and_lines_are_no_surface(tmp_path):
    writer = Writer()
    positions = writer.accessor(SQUARE)
    lines = [{"attributes": {"POSITION": positions}, "mode": m} for m in range(4)]
    writer.node(mesh=writer.mesh(lines))
    with pytest.raises(FormatError, match="expected triangles, got none"):
        read(writer, tmp_path)
    faces = {"attributes": {"POSITION": positions}, "indices": writer.accessor(TWO)}
    writer.document["meshes"][0]["primitives"].append(faces)
    found = read(writer, tmp_path)
    assert area(found) == pytest.approx(1.0)
    assert len(found.parts) == 1


def test_without_normals_faces_are_flat(tmp_path):
    writer = Writer()
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1]], np.float32)
    writer.node(mesh=writer.simple(corners, np.array([0, 1, 2, 1, 3, 2], np.uint8)))
    mesh = read(writer, tmp_path)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    facet = np.cross(b - a, c - a)
    facet /= np.linalg.norm(facet, axis=1, keepdims=True)
    assert np.allclose(mesh.normals, facet[:, None])


def test_morph_targets_have_their_weights(tmp_path):
    writer = Writer()
    move = writer.accessor(np.array([[0, 0, 0], [2, 0, 0], [2, 0, 0], [0, 0, 0]], np.float32))
    mesh = writer.simple(targets=[{"POSITION": move}, {"POSITION": move}])
    writer.document["meshes"][mesh]["weights"] = [0.5, 0.0]
    writer.node(mesh=mesh)
    writer.node(mesh=mesh, weights=[0.5, 1.0], translation=[0, 9, 0])
    found = read(writer, tmp_path)
    assert area(found) == pytest.approx(2.0 + 4.0)
    assert bounds(found) == [[0, 0, 0], [4, 10, 0]]


def test_parts_are_meshes_and_materials(tmp_path):
    writer = Writer()
    first = writer.simple()
    writer.document["meshes"][first]["name"] = "seat"
    writer.node(mesh=first)
    writer.node(mesh=first, translation=[5, 0, 0])
    positions, indices = writer.accessor(2 * SQUARE), writer.accessor(TWO)
    one = {"attributes": {"POSITION": positions}, "indices": indices}
    legs = writer.mesh([{**one, "material": 0}, {**one, "material": 1}], name="legs")
    writer.document["materials"] = [{"name": "wood"}, {"name": "brass"}]
    writer.node(mesh=legs, translation=[0, 5, 0])
    assert part_areas(read(writer, tmp_path)) == pytest.approx(
        {"seat": 2.0, "wood": 4.0, "brass": 4.0}
    )


def test_two_meshes_of_one_name_are_two_parts(tmp_path):
    writer = Writer()
    for shift in (0, 3):
        mesh = writer.simple()
        writer.document["meshes"][mesh]["name"] = "leg"
        writer.node(mesh=mesh, translation=[shift, 0, 0])
    assert part_areas(read(writer, tmp_path)) == pytest.approx({"leg": 1.0, "leg_1": 1.0})


def test_parts_without_an_area_are_none(tmp_path):
    writer = Writer()
    flat = writer.simple(np.zeros((4, 3), np.float32))
    writer.document["meshes"][flat]["name"] = "nothing"
    whole = writer.simple()
    writer.document["meshes"][whole]["name"] = "something"
    writer.node(mesh=flat)
    writer.node(mesh=whole)
    assert read(writer, tmp_path).parts == ("something",)


# -- glTF: nodes ----------------------------------------------------------------------------------


def test_transforms_go_down_the_tree(tmp_path):
    writer = Writer()
    mesh = writer.simple()
    leaf = writer.node(root=False, mesh=mesh, scale=[2, 3, 1])
    half = 0.5**0.5
    turned = writer.node(root=False, rotation=[0, 0, half, half], children=[leaf])
    shift = np.eye(4)
    shift[:3, 3] = [10, 20, 30]
    writer.node(matrix=shift.T.ravel().tolist(), children=[turned])
    found = read(writer, tmp_path)
    # x' = 10 - 3 y, y' = 20 + 2 x
    assert bounds(found) == [[7, 20, 30], [10, 22, 30]]
    assert area(found) == pytest.approx(6.0)


def test_nodes_outside_the_scene_are_not_shown(tmp_path):
    writer = Writer()
    mesh = writer.simple()
    writer.node(root=False, mesh=mesh, scale=[7, 7, 7])
    writer.node(mesh=mesh)
    assert area(read(writer, tmp_path)) == pytest.approx(1.0)
    writer.document["scenes"].append({"nodes": [0]})
    writer.document["scene"] = 1
    assert area(read(writer, tmp_path)) == pytest.approx(49.0)


def test_without_scenes_all_roots_are_shown(tmp_path):
    writer = Writer()
    mesh = writer.simple()
    child = writer.node(root=False, mesh=mesh)
    writer.node(root=False, mesh=mesh, children=[child])
    del writer.document["scenes"], writer.document["scene"]
    assert area(read(writer, tmp_path)) == pytest.approx(2.0)
    writer.document["nodes"] = []
    assert area(read(writer, tmp_path)) == pytest.approx(1.0)


def test_hidden_nodes(tmp_path):
    writer = Writer()
    mesh = writer.simple()
    writer.node(mesh=mesh)
    below = writer.node(root=False, mesh=mesh, translation=[9, 0, 0])
    hidden = {"KHR_node_visibility": {"visible": False}}
    writer.node(mesh=mesh, translation=[5, 0, 0], children=[below], extensions=hidden)
    assert bounds(read(writer, tmp_path)) == [[0, 0, 0], [1, 1, 0]]


def test_mirrored_nodes_keep_their_outside(tmp_path):
    writer = Writer()
    writer.node(mesh=writer.simple(), scale=[-1, 1, 1])
    assert np.allclose(read(writer, tmp_path).normals, [0, 0, 1])


def test_instances(tmp_path):
    writer = Writer()
    shifts = np.array([[0, 0, 0], [3, 0, 0], [6, 0, 0]], np.float32)
    scales = np.array([[1, 1, 1], [2, 1, 1], [1, 3, 1]], np.float32)
    attributes = {"TRANSLATION": writer.accessor(shifts), "SCALE": writer.accessor(scales)}
    writer.node(
        mesh=writer.simple(), scale=[2, 2, 2],
        extensions={"EXT_mesh_gpu_instancing": {"attributes": attributes}},
    )  # fmt: skip
    writer.document["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    found = read(writer, tmp_path)
    assert area(found) == pytest.approx(4.0 * (1 + 2 + 3))
    assert bounds(found) == [[0, 0, 0], [14, 6, 0]]
    half = np.int16(round(0.5**0.5 * 32767))
    turns = np.array([[0, 0, 0, 32767], [0, 0, half, half], [0, 0, 0, 32767]], np.int16)
    attributes["ROTATION"] = writer.accessor(turns, normalized=True)
    assert bounds(read(writer, tmp_path)) == [[0, 0, 0], [14, 6, 0]]


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_skins_replace_the_transform_of_their_node(tmp_path, kind):
    writer = Writer()
    weights = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 1, 0, 0], [1, 0, 0, 0]], np.float32)
    joints = np.array([[0, 1, 0, 0]] * 4, kind)
    inverse = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    inverse[1, 0, 3] = -1.0  # the second joint was bound at x = 1
    attributes = {
        "POSITION": writer.accessor(SQUARE), "JOINTS_0": writer.accessor(joints),
        "WEIGHTS_0": writer.accessor(weights),
    }  # fmt: skip
    mesh = writer.mesh([{"attributes": attributes, "indices": writer.accessor(TWO)}])
    bones = [
        writer.node(root=False, translation=[0, 0, 0]),
        writer.node(root=False, translation=[4, 0, 0]),
    ]
    writer.node(children=bones)
    columns = np.swapaxes(inverse, 1, 2).reshape(2, 16)
    writer.document["skins"] = [{"joints": bones, "inverseBindMatrices": writer.accessor(columns)}]
    writer.node(mesh=mesh, skin=0, scale=[100, 100, 100])
    found = read(writer, tmp_path)
    assert bounds(found) == [[0, 0, 0], [4, 1, 0]]
    assert area(found) == pytest.approx(4.0)
    del writer.document["skins"][0]["inverseBindMatrices"]
    assert bounds(read(writer, tmp_path)) == [[0, 0, 0], [5, 1, 0]]


def test_joints_that_do_not_exist_are_named(tmp_path):
    writer = Writer()
    attributes = {
        "POSITION": writer.accessor(SQUARE),
        "JOINTS_0": writer.accessor(np.full((4, 4), 5, np.uint8)),
        "WEIGHTS_0": writer.accessor(np.full((4, 4), 0.25, np.float32)),
    }
    mesh = writer.mesh([{"attributes": attributes, "indices": writer.accessor(TWO)}])
    bone = writer.node()
    writer.document["skins"] = [{"joints": [bone]}]
    writer.node(mesh=mesh, skin=0)
    with pytest.raises(FormatError, match="joint 5 of 1"):
        read(writer, tmp_path)


# -- glTF: extensions -----------------------------------------------------------------------------


def compressed(writer: Writer, points: np.ndarray, faces: np.ndarray) -> dict[str, Any]:
    data = DracoPy.encode(points, faces.reshape(-1, 3), quantization_bits=14)
    view = writer.view(data)
    names = {a["attribute_type"]: a["unique_id"] for a in DracoPy.decode(data).attributes}
    described = [
        {"componentType": 5126, "count": len(points), "type": "VEC3"},
        {"componentType": 5125, "count": faces.size, "type": "SCALAR"},
    ]
    start = len(writer.document["accessors"])
    writer.document["accessors"] += described
    extension = {"bufferView": view, "attributes": {"POSITION": names[0]}}
    return {
        "attributes": {"POSITION": start}, "indices": start + 1,
        "extensions": {"KHR_draco_mesh_compression": extension},
    }  # fmt: skip


def test_a_compressed_seat_beside_a_plain_leg(tmp_path, monkeypatch):
    writer = Writer()
    seat = writer.mesh([compressed(writer, 2 * SQUARE, TWO.astype(np.uint32))], name="seat")
    leg = writer.simple()
    writer.document["meshes"][leg]["name"] = "leg"
    writer.node(mesh=seat)
    writer.node(mesh=leg, translation=[0, 0, 1])
    writer.document["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    found = part_areas(read(writer, tmp_path))
    assert found == pytest.approx({"seat": 4.0, "leg": 1.0}, rel=1e-3)
    monkeypatch.setitem(__import__("sys").modules, "DracoPy", None)
    with pytest.raises(FormatError, match=r"KHR_draco_mesh_compression; install 'traitbrdf\[mesh"):
        read(writer, tmp_path)


def test_damaged_compression_is_named(tmp_path):
    writer = Writer()
    writer.node(mesh=writer.mesh([compressed(writer, SQUARE, TWO.astype(np.uint32))]))
    writer.data = writer.data[:20] + bytes(len(writer.data) - 20)
    with pytest.raises(FormatError, match="damaged Draco data"):
        read(writer, tmp_path)


@pytest.mark.parametrize("name", ["EXT_meshopt_compression", "KHR_meshopt_compression"])
def test_compressed_views_are_refused(tmp_path, name):
    writer = Writer()
    writer.node(mesh=writer.simple())
    writer.document["bufferViews"][0]["extensions"] = {name: {"buffer": 0, "byteLength": 9}}
    with pytest.raises(FormatError, match=f"compressed by {name}"):
        read(writer, tmp_path)


@pytest.mark.parametrize(
    "name", ["KHR_materials_sheen", "KHR_texture_transform", "KHR_lights_punctual", "KHR_xmp"]
)
def test_extensions_of_looks_do_not_change_shapes(tmp_path, name):
    writer = Writer()
    writer.node(mesh=writer.simple())
    writer.document["extensionsRequired"] = [name]
    writer.document["extensionsUsed"] = [name, "ACME_geometry"]  # used, but not required
    assert area(read(writer, tmp_path)) == pytest.approx(1.0)


@pytest.mark.parametrize("cut", range(0, 200, 7))
def test_cut_containers(tmp_path, cut):
    writer = Writer()
    writer.node(mesh=writer.simple())
    path = writer.write(tmp_path / "a.glb")
    path.write_bytes(path.read_bytes()[: -1 - cut])
    with pytest.raises(FormatError):
        load_mesh(path)


# -- OBJ ------------------------------------------------------------------------------------------

TRIANGLE = "v 0 0 0\nv 3 0 0\nv 0 1.58 0\nf 1 2 3\n"


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-8", "utf-16-le-bom"])
def test_byte_order_marks(tmp_path, encoding):
    path = tmp_path / "marked.obj"
    if encoding == "utf-16-le-bom":
        path.write_bytes(b"\xff\xfe" + TRIANGLE.encode("utf-16-le"))
    else:
        path.write_bytes(TRIANGLE.encode(encoding))
    assert area(load_mesh(path)) == pytest.approx(2.37)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_ends_of_lines(tmp_path, end):
    path = tmp_path / "lines.obj"
    path.write_bytes(TRIANGLE.replace(" 3\n", " \\\n3\n").replace("\n", end).encode())
    assert area(load_mesh(path)) == pytest.approx(2.37)


@pytest.mark.parametrize("key", ["g", "o", "usemtl"])
@pytest.mark.parametrize(
    ("names", "encoding"),
    [
        (("Anodized Grey #1", "Anodized Grey #2"), "utf-8"),
        (("#1", "#2"), "utf-8"),
        (("Stühle", "Stöhle"), "latin-1"),
        (("Стул", "Стол"), "cp1251"),
        (("椅子", "机"), "shift_jis"),
        (("椅子", "机"), "utf-8"),
    ],
)
def test_names_are_kept_apart(tmp_path, key, names, encoding):
    path = tmp_path / "named.obj"
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1  # a comment\n"
    text += f"{key} {names[0]}\nf 1 2 3 # this one\n{key} {names[1]}\nf 1 2 4\n"
    path.write_bytes(text.encode(encoding))
    mesh = load_mesh(path)
    assert len(mesh.parts) == 2
    if encoding in ("utf-8", "latin-1"):
        assert mesh.parts == names


ELL = [[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]]


def polygon_obj(points: np.ndarray) -> str:
    lines = ["v {} {} {}".format(*p) for p in points]
    return "\n".join([*lines, "f " + " ".join(str(i + 1) for i in range(len(points)))]) + "\n"


def polygon_ply(points: np.ndarray, order: str) -> bytes:
    form = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    head = f"ply\nformat {form} 1.0\nelement vertex {len(points)}\n"
    head += "property double x\nproperty double y\nproperty double z\n"
    head += "element face 1\nproperty list uchar uint vertex_indices\nend_header\n"
    if not order:
        rows = [" ".join(map(str, p)) for p in points]
        rows.append(" ".join(map(str, [len(points), *range(len(points))])))
        return (head + "\n".join(rows) + "\n").encode()
    body = np.asarray(points, order + "f8").tobytes()
    body += bytes([len(points)]) + np.arange(len(points)).astype(order + "u4").tobytes()
    return head.encode() + body


@pytest.mark.parametrize("kind", ["obj", "<", ">", ""])
@pytest.mark.parametrize("first", range(6))
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("bend", [0.0, 0.02])
def test_concave_polygons(tmp_path, kind, first, turned, bend):
    flat = np.roll(np.array(ELL, float), -first, axis=0)
    flat = flat[::-1] if turned else flat
    points = np.c_[flat, bend * flat[:, 0] * flat[:, 1]]
    path = tmp_path / ("l.obj" if kind == "obj" else "l.ply")
    if kind == "obj":
        path.write_text(polygon_obj(points))
    else:
        path.write_bytes(polygon_ply(points, kind))
    mesh = load_mesh(path)
    assert area(mesh) == pytest.approx(3.0, rel=1e-9 if bend == 0.0 else 0.02)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] * (-1 if turned else 1) > -1e-9).all()


@given(st.integers(4, 24), st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=60)
def test_polygons_around_a_point_keep_their_area(corners, seed, reverse):
    rng = np.random.default_rng(seed)
    turn = 2 * np.pi * (np.arange(corners) + rng.uniform(-0.4, 0.4, corners)) / corners
    flat = rng.uniform(0.2, 1.0, (corners, 1)) * np.c_[np.cos(turn), np.sin(turn)]
    flat = flat[::-1] if reverse else flat
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = flat @ frame[:2]
    a, b = flat, np.roll(flat, -1, axis=0)
    expected = 0.5 * np.abs((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    cut = triangulate(points[None])[0]
    a, b, c = (points[cut[:, i]] for i in range(3))
    normals = 0.5 * np.cross(b - a, c - a)
    assert np.linalg.norm(normals, axis=1).sum() == pytest.approx(expected, rel=1e-9)
    assert np.linalg.norm(normals.sum(axis=0)) == pytest.approx(expected, rel=1e-9)


def test_polygons_without_an_area_or_that_cross_are_fans():
    star = np.array([[np.cos(a), np.sin(a), 0.0] for a in 0.8 * np.pi * np.arange(5)])
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    point = np.ones((4, 3))
    fan = [[0, 1, 2], [0, 2, 3], [0, 3, 4]]
    assert triangulate(star[None])[0].tolist() == fan
    assert triangulate(line[None])[0].tolist() == fan[:2]
    assert triangulate(point[None])[0].tolist() == fan[:2]


RIDGE = "v 0 0 0\nv 1 0 0\nv 1 1 1\nv 0 1 1\nv 0 2 0\nv 1 2 0\n"


@pytest.mark.parametrize(
    ("one", "other", "smooth"),
    [("s off\n", "", False), ("s 0\n", "", False), ("s 1\n", "", True), ("", "", True),
     ("s 1\n", "s 2\n", False), ("s off\n", "s 1\n", False)],
)  # fmt: skip
def test_flat_where_the_file_says_flat(tmp_path, one, other, smooth):
    path = tmp_path / "ridge.obj"
    path.write_text(f"{RIDGE}{one}f 1 2 3 4\n{other}f 4 3 6 5\n")
    mesh = load_mesh(path)
    top = mesh.normals[np.isclose(mesh.vertices[mesh.faces][..., 2], 1.0)]
    upright = np.isclose(top @ [0, 0, 1], 1.0).all()
    assert upright == smooth


# -- PLY ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("extra", [False, True])
def test_binary_ply_with_mixed_polygons(tmp_path, order, extra):
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0], [1, 3, 0]])
    polygons = [[0, 1, 2, 3], [1, 4, 5], [3, 2, 6], [1, 5, 2], [2, 5, 4, 1, 0], [0, 1]]
    head = f"ply\nformat {form} 1.0\ncomment mixed\nelement vertex {len(points)}\n"
    head += "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
    head += f"element face {len(polygons)}\n"
    if extra:
        head += "property list uchar float texcoord\n"
    head += "property list uchar int vertex_index\nproperty short flags\nend_header\n"
    vertex = np.dtype([("p", order + "f4", (3,)), ("red", "u1")])
    rows = np.zeros(len(points), vertex)
    rows["p"] = points
    body = rows.tobytes()
    for polygon in polygons:
        if extra:
            uv = 0.5 * points[polygon][:, :2]
            body += bytes([2 * len(polygon)]) + uv.astype(order + "f4").tobytes()
        body += bytes([len(polygon)]) + np.array(polygon, order + "i4").tobytes() + b"\7\7"
    path = tmp_path / "mixed.ply"
    path.write_bytes(head.encode() + body)
    mesh = load_mesh(path)
    # a square, two triangles of 0.5, one of 1, and a pentagon that folds back
    assert len(mesh.faces) == 2 + 1 + 1 + 1 + 3
    assert area(mesh) == pytest.approx(1.0 + 0.5 + 1.0 + 0.5 + area_of_pentagon(points))
    if extra:
        assert np.allclose(mesh.uvs, 0.5 * mesh.vertices[mesh.faces][..., :2])
    path.write_bytes((head.encode() + body)[:-3])
    with pytest.raises(FormatError, match="cut within 'face'"):
        load_mesh(path)


def area_of_pentagon(points: np.ndarray) -> float:
    """The fan of [2, 5, 4, 1, 0], whose corners 4, 1 and 0 lie on a line."""
    corners = points[[2, 5, 4, 1, 0]].astype(float)
    a, b = corners, np.roll(corners, -1, axis=0)
    return 0.5 * abs(float(np.cross(a, b)[:, 2].sum()))


def test_ply_strips(tmp_path):
    path = tmp_path / "strip.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 6\nproperty float x\nproperty float y\n"
        "property float z\nelement tristrips 1\nproperty list int int vertex_indices\nend_header\n"
        "0 0 0\n1 0 0\n0 1 0\n1 1 0\n5 0 0\n5 1 0\n"
        "8 0 1 2 3 -1 1 4 5\n"
    )
    mesh = load_mesh(path)
    assert area(mesh) == pytest.approx(1.0 + 2.0)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] > 0.0).all()


@pytest.mark.parametrize(
    ("head", "message"),
    [
        ("ply\nformat ascii 2.0.1 x\n", "a header with 'format ascii 2.0.1 x'"),
        ("ply\nelement vertex 1\nend_header\n", "without a known format"),
        ("ply\nformat ascii 1.0\nproperty float x\n", "a header with 'property float x'"),
        ("ply\nformat ascii 1.0\nelement vertex -3\n", "a header with 'element vertex -3'"),
        ("ply\nformat ascii 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n",
         "fewer than it has vertex elements"),
        ("ply\nformat binary_little_endian 1.0\nelement vertex 9999999999\nproperty float x\n"
         "end_header\n", "cut within 'vertex'"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\n", "property half x"),
        ("ply\nformat ascii 1.0\n", "a header without an end"),
    ],
)  # fmt: skip
def test_ply_headers_that_lie(tmp_path, head, message):
    path = tmp_path / "a.ply"
    path.write_text(head)
    with pytest.raises(FormatError, match=message):
        load_mesh(path)
