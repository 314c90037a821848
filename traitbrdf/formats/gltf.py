"""Read glTF 2.0 files, .gltf and .glb: what the specification says, or a refusal that names why.

Khronos, "glTF 2.0 Specification" (ISO/IEC 12113:2022); numbers in brackets are its sections. What
is read, what is refused and what is ignored stands in docs/files.md. trimesh, which reads them too,
ignores sparse and normalized accessors, skins, instancing, morph targets and required extensions,
and drops what it cannot read.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import struct
import urllib.parse
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from traitbrdf.formats.files import FormatError, fits_in_memory
from traitbrdf.formats.polygons import FLAT, Piece

Float = NDArray[np.float64]
Int = NDArray[np.int64]

_KINDS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}

_UNDERSTOOD = {
    "EXT_mesh_gpu_instancing",
    "KHR_draco_mesh_compression",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
}
"""Extensions that change the geometry and are read."""

_HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_",
             "KHR_xmp", "EXT_lights_", "KHR_animation_pointer", "EXT_materials_")  # fmt: skip
"""Beginnings of the names of extensions that do not change the geometry."""

_MOST_NODES = 1 << 20


def read_gltf(path: Path) -> list[Piece]:
    """Return the triangles of a glTF file's scene as pieces, in the order of its nodes.

    Parameters
    ----------
    path : Path

    Raises
    ------
    FormatError
        If the file is damaged or incomplete, breaks the specification where that matters for its
        geometry, or needs what is not supported.
    """
    document, binary = _document(path)
    try:
        # `load_mesh` rejects vertices that are not finite
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return _File(path, document, binary).pieces()
    except FormatError:
        raise
    # what stands where is not checked field by field
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError,
            RecursionError) as error:  # fmt: skip
        got = f"a value of another type than the specification's ({error})"
        if isinstance(error, KeyError):
            got = f"no {error} where the specification requires it"
        raise FormatError(path, f"a readable {path.suffix.lower()} file", got) from error


def _document(path: Path) -> tuple[dict[str, Any], bytes | None]:
    """Return the JSON document and the binary chunk of a file [4]."""

    def refuse(got: str) -> NoReturn:
        raise FormatError(path, f"a readable {path.suffix.lower()} file", got)

    data = path.read_bytes()
    binary = None
    if data.startswith(b"glTF"):
        if len(data) < 20:
            refuse(f"{len(data)} bytes")
        version, length = struct.unpack_from("<II", data, 4)
        if version != 2:
            refuse(f"version {version} of the container; 2 is read")
        if length > len(data):
            refuse(f"{len(data)} bytes of {length}")
        text, at = b"", 12
        while at + 8 <= length:
            size, kind = struct.unpack_from("<I4s", data, at)
            if at + 8 + size > length:
                refuse(f"{len(data)} bytes, cut within a chunk")
            body = data[at + 8 : at + 8 + size]
            if at == 12:
                if kind != b"JSON":
                    refuse(f"a first chunk {kind!r}; JSON is expected")
                text = body
            elif kind == b"BIN\0" and binary is None:
                binary = body
            at += 8 + size
    else:
        text = data
    try:
        document = json.loads(text.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        refuse(f"{type(error).__name__}: {error}")
    if not isinstance(document, dict):
        refuse(f"a JSON {type(document).__name__}")
    return document, binary


class _File:
    """A glTF document and what has been read of its buffers."""

    def __init__(self, path: Path, document: dict[str, Any], binary: bytes | None) -> None:
        self.path, self.document, self.binary = path, document, binary
        self.buffers: dict[int, bytes] = {}
        self.size = path.stat().st_size
        asset = document.get("asset", {})
        if str(asset.get("version", "")).split(".")[0] != "2":
            self.refuse(f"version {asset.get('version')!r}; 2.0 is read")
        if str(asset.get("minVersion", "2.0")) != "2.0":
            self.refuse(f"minVersion {asset['minVersion']!r}; 2.0 is read")
        for name in document.get("extensionsRequired", []):
            if name not in _UNDERSTOOD and not str(name).startswith(_HARMLESS):
                hint = "; uncompressed files are read" if "compression" in str(name) else ""
                self.refuse(f"the extension {name}, which it requires{hint}")

    def refuse(self, got: str) -> NoReturn:
        raise FormatError(self.path, f"a readable {self.path.suffix.lower()} file", got)

    def item(self, kind: str, index: Any) -> Any:
        """Return an entry of one of the document's lists."""
        entries = self.document.get(kind, [])
        if isinstance(index, bool) or not isinstance(index, int):
            self.refuse(f"{index!r} for an index of {kind}")
        if not 0 <= index < len(entries):
            self.refuse(f"index {index} of {len(entries)} {kind}")
        return entries[index]

    # ------------------------------------------------------------------------------- bytes

    def buffer(self, index: int) -> bytes:
        """Return the bytes of a buffer [3.6.1]."""
        if index not in self.buffers:
            entry = self.item("buffers", index)
            uri, length = entry.get("uri"), int(entry["byteLength"])
            if uri is None:
                if index != 0 or self.binary is None:
                    self.refuse(f"buffer {index} without a uri")
                data = self.binary
            elif uri.startswith("data:"):
                data = self.embedded(uri, index)
            else:
                data = self.beside(uri)
            if len(data) < length:
                self.refuse(f"buffer {index} of {len(data)} bytes, not {length}")
            self.buffers[index] = data[:length]
        return self.buffers[index]

    def embedded(self, uri: str, index: int) -> bytes:
        """Return the bytes of a data URI (RFC 2397)."""
        head, comma, body = uri.partition(",")
        if not comma:
            self.refuse(f"buffer {index} with a data URI without a comma")
        data = urllib.parse.unquote_to_bytes(body)
        if not head.endswith(";base64"):
            return data
        try:
            return base64.b64decode(b"".join(data.split()) + b"==", validate=False)
        except binascii.Error as error:
            self.refuse(f"buffer {index} with damaged base64 ({error})")

    def beside(self, uri: str) -> bytes:
        """Return the bytes of a file that a relative, percent-encoded URI names."""
        if urllib.parse.urlsplit(uri).scheme not in ("", "file") or uri.startswith("//"):
            self.refuse(f"a buffer at {uri[:60]!r}; only files beside it are read")
        for name in (urllib.parse.unquote(uri), uri):  # some programs do not encode names
            found = self.path.parent / name
            if "\0" not in name and found.is_file():
                break
        else:
            self.refuse(f"no file {urllib.parse.unquote(uri)!r} beside it")
        self.size += found.stat().st_size
        return found.read_bytes()

    def view(self, index: int) -> tuple[bytes, int | None]:
        """Return the bytes of a buffer view, and its stride."""
        entry = self.item("bufferViews", index)
        for name in entry.get("extensions", {}):
            if "meshopt" in name:
                self.refuse(f"a buffer view compressed by {name}; uncompressed files are read")
        start, length = int(entry.get("byteOffset", 0)), int(entry["byteLength"])
        data = self.buffer(entry["buffer"])
        if start < 0 or length < 1 or start + length > len(data):
            self.refuse(f"buffer view {index}: bytes {start} to {start + length} of {len(data)}")
        stride = entry.get("byteStride")
        return data[start : start + length], None if stride is None else int(stride)

    def accessor(self, index: int, widths: tuple[str, ...]) -> Any:
        """Return the numbers (count, width) of an accessor, sparse ones in place [3.6.2].

        Normalized integers become numbers in [0, 1] or [-1, 1]; others stay what they are.
        """
        entry = self.item("accessors", index)
        count, kind = int(entry["count"]), _KINDS.get(entry["componentType"])
        if entry["type"] not in widths or kind is None or count < 1:
            self.refuse(
                f"accessor {index} of {count} {entry['type']} of type {entry['componentType']}, "
                f"where {' or '.join(widths)} is expected"
            )
        width = _WIDTHS[entry["type"]]
        needed = count * width * np.dtype(kind).itemsize
        if not fits_in_memory(8 * count * width, self.size):
            self.refuse(f"accessor {index} of {needed} bytes in a file of {self.size}")
        if "bufferView" in entry:
            place = int(entry.get("byteOffset", 0))
            values = self.strided(entry["bufferView"], place, count, width, kind)
        else:
            values = np.zeros((count, width), kind)
        if "sparse" in entry:
            values = values.copy()
            sparse = entry["sparse"]
            many, rows, own = int(sparse["count"]), sparse["indices"], sparse["values"]
            at = self.strided(
                rows["bufferView"], int(rows.get("byteOffset", 0)), many, 1,
                _KINDS[rows["componentType"]],
            )[:, 0].astype(np.int64)  # fmt: skip
            if at.min() < 0 or at.max() >= count:
                self.refuse(f"accessor {index}: sparse index {at.max()} of {count}")
            values[at] = self.strided(
                own["bufferView"], int(own.get("byteOffset", 0)), many, width, kind
            )
        if entry.get("normalized"):
            if values.dtype.kind == "f" or values.dtype.itemsize > 2:
                self.refuse(f"accessor {index}: normalized numbers of type {values.dtype}")
            top = float(np.iinfo(values.dtype).max)
            return np.maximum(values.astype(np.float64) / top, -1.0)
        return values

    def strided(self, view: int, start: int, count: int, width: int, kind: str) -> Any:
        """Return numbers (count, width) of a buffer view."""
        data, stride = self.view(view)
        size = np.dtype(kind).itemsize * width
        step = size if stride is None else stride
        if start < 0 or count < 1 or step < size or start + step * (count - 1) + size > len(data):
            self.refuse(
                f"buffer view {view} of {len(data)} bytes for {count} elements of {size} bytes, "
                f"{step} apart"
            )
        row = np.ndarray((count, width), kind, data, start, (step, np.dtype(kind).itemsize))
        return np.ascontiguousarray(row)

    # ------------------------------------------------------------------------------ meshes

    def pieces(self) -> list[Piece]:
        """Return all triangles, placed."""
        for group, what in (("nodes", "node"), ("meshes", "mesh")):
            if not isinstance(self.document.get(group, []), list):
                self.refuse(f"{group} that are no list of a {what} each")
        if "nodes" not in self.document:
            meshes = self.document.get("meshes", [])
            self.document["nodes"] = [{"mesh": i} for i in range(len(meshes))]
        places = self.places()
        names = self.names()
        made: dict[int, list[tuple[str, dict[str, Any]]]] = {}
        result = []
        for node, matrix in places.items():
            entry = self.item("nodes", node)
            if "mesh" not in entry:
                continue
            mesh = entry["mesh"]
            if mesh not in made:
                made[mesh] = self.mesh(mesh, entry.get("weights"), names)
            shapes = made[mesh]
            if "weights" in entry:  # of this node alone
                shapes = self.mesh(mesh, entry["weights"], names)
            for name, shape in shapes:
                if "skin" in entry:
                    result.append(self.skinned(name, shape, entry["skin"], places))
                    continue
                for instance in self.instances(entry):
                    result.append(_placed(name, shape, matrix @ instance))
        return result

    def places(self) -> dict[int, Float]:
        """Return the global transforms (4, 4) of the nodes of the scene [3.5]."""
        scenes = self.document.get("scenes", [])
        nodes = self.document["nodes"]
        if scenes:
            roots = self.item("scenes", self.document.get("scene", 0)).get("nodes", [])
        else:
            below = {c for n in nodes for c in n.get("children", [])}
            roots = [i for i in range(len(nodes)) if i not in below]
        found: dict[int, Float] = {}
        todo = [(root, np.eye(4)) for root in reversed(roots)]
        while todo:
            node, above = todo.pop()
            if node in found or len(found) > _MOST_NODES:
                self.refuse(f"node {node} with two parents")
            entry = self.item("nodes", node)
            visible = entry.get("extensions", {}).get("KHR_node_visibility", {})
            if visible.get("visible") is False:
                continue
            found[node] = above @ self.transform(entry, node)
            todo += [(child, found[node]) for child in reversed(entry.get("children", []))]
        return found

    def transform(self, entry: dict[str, Any], node: int) -> Float:
        """Return a node's own transform (4, 4)."""
        if "matrix" in entry:
            matrix = np.array(entry["matrix"], np.float64).reshape(4, 4).T
        else:
            matrix = _trs(
                np.array(entry.get("translation", (0, 0, 0)), np.float64)[None],
                np.array(entry.get("rotation", (0, 0, 0, 1)), np.float64)[None],
                np.array(entry.get("scale", (1, 1, 1)), np.float64)[None],
            )[0]
        if not np.isfinite(matrix).all():
            self.refuse(f"node {node} with a transform that is not finite")
        return np.asarray(matrix, np.float64)

    def instances(self, entry: dict[str, Any]) -> Float:
        """Return transforms (n, 4, 4) of the instances of a node (EXT_mesh_gpu_instancing)."""
        found = entry.get("extensions", {}).get("EXT_mesh_gpu_instancing")
        if found is None:
            return np.eye(4)[None]
        own = {
            name: np.asarray(
                self.accessor(index, ("VEC4",) if name == "ROTATION" else ("VEC3",)), np.float64
            )
            for name, index in found["attributes"].items()
            if name in ("TRANSLATION", "ROTATION", "SCALE")
        }
        count = max((len(v) for v in own.values()), default=1)
        return _trs(
            own.get("TRANSLATION", np.zeros((count, 3))),
            own.get("ROTATION", np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))),
            own.get("SCALE", np.ones((count, 3))),
        )

    def names(self) -> dict[tuple[int, int], str]:
        """Return the part's name of each primitive, by its mesh and number; empty for none.

        A mesh of several primitives has one part for each of its materials.
        """
        meshes = self.document.get("meshes", [])
        materials = self.document.get("materials", [])
        nodes = {n["mesh"]: n.get("name") for n in self.document["nodes"] if "mesh" in n}
        unnamed = "mesh {}" if len(meshes) > 1 else ""
        own = [
            str(m.get("name") or nodes.get(i) or unnamed.format(i)) for i, m in enumerate(meshes)
        ]
        taken: dict[str, int] = {}
        for i, name in enumerate(own):
            taken[name] = taken.get(name, 0) + 1
            if name and taken[name] > 1:
                own[i] = f"{name}_{taken[name] - 1}"
        found: dict[tuple[int, int], str] = {}
        several = {i for i, m in enumerate(meshes) if len(m["primitives"]) > 1}
        labels: dict[tuple[int, int], str] = {}
        for i in several:
            for k, primitive in enumerate(meshes[i]["primitives"]):
                material = primitive.get("material")
                named = material is not None and self.item("materials", material).get("name")
                labels[i, k] = str(named or ("" if material is None else f"material {material}"))
        proposed = [own[i] for i in range(len(meshes)) if i not in several]
        proposed += [n for i in several for n in {labels[i, k] for k in _of(meshes[i])}]
        clear = all(proposed) and len(set(proposed)) == len(proposed)
        for i, mesh in enumerate(meshes):
            for k in _of(mesh):
                if i not in several:
                    found[i, k] = own[i]
                elif clear:
                    found[i, k] = labels[i, k]
                else:
                    last = labels[i, k] if materials and labels[i, k] else str(k)
                    found[i, k] = f"{own[i]} {last}".strip()
        return found

    def mesh(
        self, index: int, weights: Any, names: dict[tuple[int, int], str]
    ) -> list[tuple[str, dict[str, Any]]]:
        """Return the name and the arrays of each primitive of triangles of a mesh [3.7.2]."""
        entry = self.item("meshes", index)
        weights = np.array(entry.get("weights", []) if weights is None else weights, np.float64)
        made = []
        for k, primitive in enumerate(entry["primitives"]):
            mode = primitive.get("mode", 4)
            if mode not in range(7):
                self.refuse(f"a primitive of mode {mode!r}")
            if mode >= 4 and "POSITION" in primitive["attributes"]:
                made.append((names[index, k], self.primitive(primitive, mode, weights)))
        return made

    def primitive(self, primitive: dict[str, Any], mode: int, weights: Float) -> dict[str, Any]:
        """Return positions, faces, normals, texture coordinates, joints and weights."""
        draco = primitive.get("extensions", {}).get("KHR_draco_mesh_compression")
        if draco is not None:
            arrays = self.draco(primitive, draco)
            order = arrays.pop("indices")
        else:
            arrays = {}
            for name, index in primitive["attributes"].items():
                kinds = _ATTRIBUTES.get(name.split("_")[0], ())
                if kinds and (name in ("POSITION", "NORMAL", "TEXCOORD_0") or kinds == ("VEC4",)):
                    arrays[name] = self.accessor(index, kinds)
            count = len(arrays["POSITION"])
            order = np.arange(count)
            if "indices" in primitive:
                order = self.accessor(primitive["indices"], ("SCALAR",))[:, 0]
                if order.dtype.kind != "u":
                    self.refuse(f"indices of type {order.dtype}")
        count = len(arrays["POSITION"])
        for name, values in arrays.items():
            if len(values) != count:
                self.refuse(f"{len(values)} {name} of {count} positions")
        order = order.astype(np.int64)
        if order.max(initial=0) >= count:
            self.refuse(f"index {order.max()} of {count} positions")
        arrays = {name: np.asarray(values, np.float64) for name, values in arrays.items()}
        for name in ("POSITION", "NORMAL"):
            for weight, target in zip(weights, primitive.get("targets", []), strict=False):
                if weight and name in target and name in arrays:
                    arrays[name] = arrays[name] + weight * self.accessor(target[name], ("VEC3",))
        return {**arrays, "faces": self.triangles(order, mode)}

    def triangles(self, order: Int, mode: int) -> Int:
        """Return triangles (F, 3) of a list, strip or fan of vertices [3.7.2.1]."""
        if mode == 4:
            if len(order) % 3:
                self.refuse(f"{len(order)} indices of triangles")
            return order.reshape(-1, 3)
        i = np.arange(len(order) - 2)
        if mode == 5:
            return np.stack([order[i], order[i + 1 + i % 2], order[i + 2 - i % 2]], axis=1)
        return np.stack([order[i + 1], order[i + 2], np.full(len(i), order[0])], axis=1)

    def draco(self, primitive: dict[str, Any], entry: dict[str, Any]) -> dict[str, Any]:
        """Return the arrays of a primitive that is compressed by Draco."""
        try:
            import DracoPy
        except ImportError:
            self.refuse(
                "geometry that is compressed by KHR_draco_mesh_compression; install "
                "'traitbrdf[meshes]', or write the file uncompressed"
            )
        if not fits_in_memory(self.draco_size(primitive), self.size):
            self.refuse("a compressed mesh of more vertices than its file can hold")
        data, _ = self.view(entry["bufferView"])
        try:
            found = DracoPy.decode(data)
            by_id = {a["unique_id"]: a["data"] for a in found.attributes}
        # its C++ core raises several kinds of errors
        except Exception as error:
            self.refuse(f"damaged Draco data ({error})")
        arrays: dict[str, Any] = {"indices": np.asarray(found.faces).reshape(-1).astype(np.uint32)}
        for name, index in primitive["attributes"].items():
            kinds = _ATTRIBUTES.get(name.split("_")[0], ())
            if kinds and (name in ("POSITION", "NORMAL", "TEXCOORD_0") or kinds == ("VEC4",)):
                if name not in entry["attributes"]:
                    arrays[name] = self.accessor(index, kinds)
                    continue
                values = np.asarray(by_id[entry["attributes"][name]])
                described = self.item("accessors", index)
                if described.get("normalized") and values.dtype.kind in "iu":
                    top = float(np.iinfo(values.dtype).max)
                    values = np.maximum(values.astype(np.float64) / top, -1.0)
                arrays[name] = values.reshape(len(values), -1)
        return arrays

    def draco_size(self, primitive: dict[str, Any]) -> int:
        """Return the bytes of positions and indices that the accessors speak of, by 4."""
        own = [primitive["attributes"]["POSITION"], primitive.get("indices")]
        return sum(int(self.item("accessors", i)["count"]) for i in own if i is not None) // 4

    def skinned(self, name: str, shape: dict[str, Any], skin: int, places: Any) -> Piece:
        """Return a primitive moved by the joints of a skin; its node does not count [3.7.3]."""
        entry = self.item("skins", skin)
        joints = entry["joints"]
        inverse = np.tile(np.eye(4), (len(joints), 1, 1))
        if "inverseBindMatrices" in entry:
            flat = self.accessor(entry["inverseBindMatrices"], ("MAT4",))
            if len(flat) < len(joints):
                self.refuse(f"{len(flat)} inverse bind matrices of {len(joints)} joints")
            columns = np.asarray(flat[: len(joints)], np.float64).reshape(-1, 4, 4)
            inverse = np.swapaxes(columns, 1, 2)
        for joint in joints:
            if joint not in places:
                self.refuse(f"joint {joint} of skin {skin} outside of the scene")
        moves = np.stack([places[j] for j in joints]) @ inverse
        total = np.zeros((len(shape["POSITION"]), 4, 4))
        weight_sum = np.zeros(len(total))
        for key in (k for k in shape if k.startswith("JOINTS_")):
            index, weight = shape[key].astype(np.int64), shape[key.replace("JOINTS", "WEIGHTS")]
            if index.min() < 0 or index.max() >= len(joints):
                self.refuse(f"joint {index.max()} of {len(joints)} in {key}")
            total += np.einsum("vk,vkij->vij", weight, moves[index])
            weight_sum += weight.sum(axis=1)
        if not (weight_sum > 0.0).all():
            self.refuse(f"vertices of mesh {name!r} without a joint of skin {skin}")
        total /= weight_sum[:, None, None]
        points = np.einsum("vij,vj->vi", total[:, :3, :3], shape["POSITION"]) + total[:, :3, 3]
        normals = shape.get("NORMAL")
        if normals is not None:
            normals = np.einsum("vij,vj->vi", _cofactors(total[:, :3, :3]), normals)
        return _piece(name, points, shape["faces"], normals, shape.get("TEXCOORD_0"))


_ATTRIBUTES = {
    "POSITION": ("VEC3",),
    "NORMAL": ("VEC3",),
    "TEXCOORD": ("VEC2",),
    "JOINTS": ("VEC4",),
    "WEIGHTS": ("VEC4",),
}


def _of(mesh: dict[str, Any]) -> range:
    return range(len(mesh["primitives"]))


def _trs(translation: Float, rotation: Float, scale: Float) -> Float:
    """Return transforms (n, 4, 4) of translations, quaternions (x, y, z, w) and scales."""
    x, y, z, w = (rotation / np.sqrt((rotation**2).sum(axis=1, keepdims=True))).T
    matrix = np.zeros((len(translation), 4, 4))
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    matrix[:, :3, :3] = np.moveaxis(np.array(rows), 2, 0)
    matrix[:, :3, :3] *= scale[:, None, :]
    matrix[:, :3, 3] = translation
    matrix[:, 3, 3] = 1.0
    return matrix


def _cofactors(linear: Float) -> Float:
    """Return what turns normals (..., 3, 3); it exists for singular transforms as well."""
    a, b = np.roll(linear, -1, axis=-2), np.roll(linear, -2, axis=-2)
    flipped = np.where(np.linalg.det(linear) < 0.0, -1.0, 1.0)
    return np.asarray(np.cross(a, b) * flipped[..., None, None])


def _placed(name: str, shape: dict[str, Any], matrix: Float) -> Piece:
    """Return a primitive placed by a transform (4, 4)."""
    linear = matrix[:3, :3]
    points = shape["POSITION"] @ linear.T + matrix[:3, 3]
    normals = shape.get("NORMAL")
    if normals is not None:
        normals = normals @ _cofactors(linear).T
    faces = shape["faces"]
    if np.linalg.det(linear) < 0.0:  # a mirroring transform reverses the winding
        faces = faces[:, ::-1]
    return _piece(name, points, faces, normals, shape.get("TEXCOORD_0"))


def _piece(name: str, points: Float, faces: Int, normals: Any, uvs: Any) -> Piece:
    corners = np.full((len(faces), 3, 3), math.nan) if normals is None else normals[faces]
    coordinates = np.full((len(faces), 3, 2), math.nan)
    if uvs is not None:
        coordinates = np.stack([uvs[:, 0], 1.0 - uvs[:, 1]], axis=1)[faces]  # v is down in glTF
    # without normals, faces are flat [3.7.2.1]
    return Piece(name, points, faces, corners, coordinates, np.full(len(faces), FLAT))
