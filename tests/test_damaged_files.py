"""Damaged files: every reader answers with FormatError, without a crash, a word or much memory."""

from __future__ import annotations

import os
import resource
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from test_meshes import SQUARE, TWO, Writer, polygon_ply

import traitbrdf as tb
from traitbrdf.formats.brdfs import write_merl, write_rgl
from traitbrdf.formats.files import FormatError
from traitbrdf.formats.images import write_exr
from traitbrdf.reflectance.measured import rgl_fields

COUNT = int(os.environ.get("TRAITBRDF_MUTATIONS", "0"))
"""Mutations of each kind of file; 0 for as many as a test has time for. `make fuzz` sets it."""


def exr(path: Path) -> None:
    ramp = np.linspace(0, 1, 12 * 24 * 3).reshape(12, 24, 3)
    write_exr(path, ramp)


def tiled(path: Path) -> None:
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 8
    pixels = np.linspace(0, 1, 12 * 24 * 3, dtype=np.float32).reshape(12, 24, 3)
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.tiledimage, "tiles": tiles}
    with OpenEXR.File(header, {"RGB": pixels}) as file:
        file.write(str(path))


def hdr(path: Path) -> None:
    rgbe = np.random.default_rng(0).integers(0, 250, (8, 16, 4)).astype(np.uint8)
    head = "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\nPRIMARIES=.7 .3 .2 .7 .1 .1 .3 .3\n\n"
    path.write_bytes((head + "-Y 8 +X 16\n").encode() + rgbe.tobytes())


def gltf(path: Path) -> None:
    writer = Writer()
    normals = np.tile(np.float32([0, 0, 1]), (4, 1))
    attributes = {
        "POSITION": writer.accessor(SQUARE), "NORMAL": writer.accessor(normals),
        "TEXCOORD_0": writer.accessor(SQUARE[:, :2].copy()),
        "JOINTS_0": writer.accessor(np.zeros((4, 4), np.uint8)),
        "WEIGHTS_0": writer.accessor(np.full((4, 4), 0.25, np.float32)),
    }  # fmt: skip
    one = {"attributes": attributes, "indices": writer.accessor(TWO)}
    mesh = writer.mesh([one, {**one, "mode": 5}], name="a")
    writer.document["skins"] = [{"joints": [writer.node()]}]
    writer.node(mesh=mesh, skin=0)
    writer.node(mesh=mesh, rotation=[0, 0, 0, 1], scale=[1, 2, 3])
    writer.write(path)


def obj(path: Path) -> None:
    path.write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\ng a\ns 1\nf 1/1/1 2/1/1 3//1\n"
        "usemtl b\nf -4 -2 -1 3\n"
    )


def ply(path: Path) -> None:
    path.write_bytes(polygon_ply(np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0]]), "<"))


def ply_text(path: Path) -> None:
    path.write_bytes(polygon_ply(np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0]]), ""))


def merl(path: Path) -> None:
    values = np.random.default_rng(0).random((4, 3, 5, 3))
    write_merl(path, values)


def rgl(path: Path) -> None:
    write_rgl(path, rgl_fields(lambda h, d, p: np.ones((*h.shape, 3)), 4, "made"))


def npz(path: Path) -> None:
    values = np.random.default_rng(0).random((4, 3, 5, 3))
    tb.TabulatedBRDF(tb.HalfDiffGrid(4, 3, 5), values).write(path)


Case = tuple[Callable[[Path], None], Callable[[Path], object], str]
CASES: dict[str, Case] = {
    "exr": (exr, tb.EnvironmentMap.read, ".exr"),
    "tiled exr": (tiled, tb.EnvironmentMap.read, ".exr"),
    "hdr": (hdr, tb.EnvironmentMap.read, ".hdr"),
    "glb": (gltf, tb.load_mesh, ".glb"),
    "gltf": (gltf, tb.load_mesh, ".gltf"),
    "obj": (obj, tb.load_mesh, ".obj"),
    "ply": (ply, tb.load_mesh, ".ply"),
    "ply text": (ply_text, tb.load_mesh, ".ply"),
    "merl": (merl, tb.TabulatedBRDF.read, ".binary"),
    "rgl": (rgl, tb.MeasuredBRDF.read, ".bsdf"),
    "npz": (npz, tb.TabulatedBRDF.read, ".npz"),
}


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut, flip, overwrite by large numbers, NaN or text, double or drop a piece."""
    made = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(0, max(len(made) - 8, 1)))
        kind = int(rng.integers(0, 7))
        if kind == 0:
            del made[at:]
        elif kind == 1:
            made[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 2:
            made[at : at + 4] = struct.pack("<i", int(rng.choice([-1, 0, 1 << 30, 2**31 - 1, 999])))
        elif kind == 3:
            made[at : at + 4] = struct.pack("<f", float(rng.choice([np.nan, np.inf, -1e38, 1e-40])))
        elif kind == 4:
            made[at : at + 8] = struct.pack(">d", float("nan"))
        elif kind == 5:
            made[at:at] = made[at : at + int(rng.integers(1, 64))]
        else:
            del made[at : at + int(rng.integers(1, 64))]
        if len(made) < 9:
            break
    return bytes(made)


@pytest.mark.parametrize("name", CASES)
def test_mutated_files_end_in_format_errors(tmp_path, capfd, name):
    # a damaged EXR file is read in a process of its own, which takes 0.2 s to start
    feed(tmp_path, capfd, name, 60 if "exr" in name else 200)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_many_mutated_files_end_in_format_errors(tmp_path, capfd, name):
    feed(tmp_path, capfd, name, COUNT or (500 if "exr" in name else 10_000))


def feed(tmp_path, capfd, name, count):
    """Feed a reader so many mutations of a file."""
    make, read, suffix = CASES[name]
    path = tmp_path / f"a{suffix}"
    make(path)
    data, rng = path.read_bytes(), np.random.default_rng([count, len(name)])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused = 0
    for _ in range(count):
        path.write_bytes(mutated(data, rng))
        try:
            read(path)
        except FormatError as error:
            refused += 1
            assert str(path) in str(error)
    assert refused > count // 20
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 200 * 1024  # kilobytes
    assert capfd.readouterr() == ("", "")


# -- what the mutations found ----------------------------------------------------------------------


def test_a_property_that_comes_twice_is_named(tmp_path):
    path = tmp_path / "a.ply"
    ply(path)
    header, rest = path.read_bytes().split(b"end_header")
    path.write_bytes(header.replace(b" y\n", b" x\n") + b"end_header" + rest)
    with pytest.raises(FormatError, match="property 'x' of 'vertex' twice"):
        tb.load_mesh(path)


def test_members_that_are_no_arrays_are_named(tmp_path):
    path = tmp_path / "a.npz"
    npz(path)
    with zipfile.ZipFile(path) as file:
        members = {name: file.read(name) for name in file.namelist()}
    with zipfile.ZipFile(path, "w") as file:
        for name, data in members.items():
            file.writestr(name, b"text" if name == "values.npy" else data)
    with pytest.raises(FormatError, match="'values' is no array"):
        tb.TabulatedBRDF.read(path)


@pytest.mark.parametrize("given", [{"rotation": [0, 0, 0, 0]}, {"scale": [float("inf"), 1, 1]}])
def test_transforms_that_end_in_no_number_are_named(tmp_path, given):
    path = tmp_path / "a.glb"
    writer = Writer()
    one = {"attributes": {"POSITION": writer.accessor(SQUARE)}, "indices": writer.accessor(TWO)}
    writer.node(mesh=writer.mesh([one]), **given)
    writer.write(path)
    with pytest.raises(FormatError, match="not finite"):
        tb.load_mesh(path)


# -- sizes that lie -------------------------------------------------------------------------------


def test_zip_bombs_are_refused(tmp_path):
    path = tmp_path / "bomb.npz"
    head = b"\x93NUMPY\x01\x00"
    text = "{'descr': '<f4', 'fortran_order': False, 'shape': (300, 300, 1000, 3), }"
    text = text.ljust(118 - len(head) + 1) + "\n"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file,
        file.open("values.npy", "w") as f,
    ):
        f.write(head + struct.pack("<H", len(text)) + text.encode())
        for _ in range(1080):
            f.write(bytes(1_000_000))
    assert path.stat().st_size < 2_000_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(FormatError, match="that its size can hold"):
        tb.TabulatedBRDF.read(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 * 1024


def test_arrays_whose_header_lies_are_refused(tmp_path):
    path = tmp_path / "lie.npz"
    text = (
        "{'descr': '<f8', 'fortran_order': False, 'shape': (9000000, 9000000), }".ljust(117) + "\n"
    )
    with zipfile.ZipFile(path, "w") as file:
        data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + bytes(80)
        file.writestr("values.npy", data)
    with pytest.raises(FormatError):
        tb.TabulatedBRDF.read(path)


def test_an_image_of_zeros_that_fills_the_memory_is_refused(tmp_path):
    path = tmp_path / "a.exr"
    exr(path)
    data = path.read_bytes()
    window = data.index(b"dataWindow\0box2i\0") + 17 + 4
    path.write_bytes(data[:window] + struct.pack("<4i", 0, 0, 15999, 7999) + data[window + 16 :])
    with pytest.raises(FormatError, match="that its size can hold"):
        tb.EnvironmentMap.read(path)


def test_designs_that_are_damaged(tmp_path):
    edit = tb.EditSession(
        tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=8), size=16), cache=False
    )
    edit.assign("sphere", "red-rubber")
    path = tmp_path / "a.tbr"
    edit.save(path)
    data, rng = path.read_bytes(), np.random.default_rng(5)
    for _ in range(60):
        path.write_bytes(mutated(data, rng))
        try:
            tb.EditSession.load(path)
        except FormatError:
            continue
