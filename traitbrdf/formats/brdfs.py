"""Read and write measured BRDFs: MERL ``.binary`` and RGL ``.bsdf`` files."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.formats.files import FormatError, PathName, atomic_path, file_size, open_binary

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

MERL_SCALE: tuple[float, float, float] = (1.0 / 1500.0, 1.15 / 1500.0, 1.66 / 1500.0)
"""1/sr per stored unit of a MERL ``.binary`` file, red, green, blue (Matusik et al. 2003)."""


# ---------------------------------------------------------------------------------------------
# MERL materials


def read_merl(path: PathName) -> Float64:
    """Read a MERL ``.binary`` file (Matusik et al., "A Data-Driven Reflectance Model", 2003).

    The file holds three int32 dimensions, then the planes R, G, B in float64. The scale factors
    `MERL_SCALE` are applied.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    (n_theta_h, n_theta_d, n_phi_d, 3) float64
        f_r in 1/sr; cells that the measurement marks invalid are negative, as stored.

    Raises
    ------
    FileNotFoundError
    FormatError
        If the dimensions are not positive, do not match the size of the file, or a value is not
        finite.
    """
    with open_binary(path) as file:
        header = file.read(12)
        size = file_size(file)
        if len(header) < 12:
            raise FormatError(path, "a MERL header of 12 bytes", f"{len(header)} bytes")
        dims = struct.unpack("<3i", header)
        count = math.prod(dims)
        if min(dims) < 1 or size != 12 + 24 * count:
            shape = " x ".join(map(str, dims))
            needed = f" of {12 + 24 * count} bytes" if min(dims) > 0 else ""
            raise FormatError(
                path, "a MERL file, 90 x 90 x 180 as a rule", f"{size} bytes, {shape}{needed}"
            )
        values = np.empty((*dims, 3))
        for channel, scale in enumerate(MERL_SCALE):
            plane = np.fromfile(file, "<f8", count)
            if len(plane) < count or not np.isfinite(plane).all():
                raise FormatError(
                    path,
                    f"{count} finite values a colour",
                    f"{int(np.isfinite(plane).sum())} in colour {channel}",
                )
            values[..., channel] = plane.reshape(dims) * scale
    return values


def write_merl(path: PathName, values: ArrayLike) -> None:
    """Write a MERL ``.binary`` file; `read_merl` returns the same values up to rounding.

    What it returns is written with the same bytes again.

    Parameters
    ----------
    path : path-like
    values : (n_theta_h, n_theta_d, n_phi_d, 3) array_like
        f_r in 1/sr at MERL's nodes; other programs expect 90 x 90 x 180.

    Raises
    ------
    ValueError
        On another shape, or values that are not finite.
    """
    table = np.asarray(values)
    if table.ndim != 4 or table.shape[-1] != 3 or 0 in table.shape:
        raise ValueError(
            f"values: expected shape (n_theta_h, n_theta_d, n_phi_d, 3), got {table.shape}"
        )
    if not np.isfinite(table).all():
        bad = int(np.count_nonzero(~np.isfinite(table)))
        raise ValueError(f"values: expected finite numbers, got {bad} that are not")
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<3i", *table.shape[:3]))
        for channel, scale in enumerate(MERL_SCALE):
            stored = table[..., channel].astype(np.float64) / scale
            for _ in range(3):  # to numbers that come back unchanged when they are read and written
                stored = stored * scale / scale
            file.write(stored.astype("<f8").tobytes())


# ---------------------------------------------------------------------------------------------
# RGL materials


@dataclass(frozen=True, eq=False)
class RGLFields:
    """The fields of an RGL material file (Dupuy & Jakob 2018), as stored.

    All arrays are float32 and finite, and have rows along azimuth and columns along elevation. The
    first direction has p azimuths and t elevations.

    Parameters
    ----------
    phi_i, theta_i : (p,) and (t,) arrays
        Azimuths and elevations of the first direction in radians, increasing.
    sigma, ndf : (rows, columns) arrays
        Projected microfacet area and microfacet distribution.
    vndf : (p, t, rows, columns) array
        Density of visible normals that warps the unit square.
    luminance, rgb : (p, t, n, n) and (p, t, 3, n, n) arrays
        The measurement on the warped square; `rgb` is linear Rec.709.
    jacobian : bool
        Whether the measurement must be multiplied by ndf / (4 sigma).
    description : str
    """

    phi_i: Float32
    theta_i: Float32
    sigma: Float32
    ndf: Float32
    vndf: Float32
    luminance: Float32
    rgb: Float32
    jacobian: bool
    description: str


_TENSOR_MAGIC = b"tensor_file\0"
_TENSOR_TYPES = ("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")
_RGL_RANKS = {"phi_i": 1, "theta_i": 1, "sigma": 2, "ndf": 2, "vndf": 4, "luminance": 4, "rgb": 5}


def read_rgl(path: PathName) -> RGLFields:
    """Read an RGL ``.bsdf`` material in its RGB variant.

    Dupuy & Jakob, "An Adaptive Parameterization for Efficient Material Acquisition and Rendering",
    2018. The container starts with ``tensor_file`` and a zero byte, the version 1.0 and the number
    of fields (uint32). A field is the length of its name (uint16), the name, its rank (uint16),
    type (uint8), offset in the file (uint64) and shape (uint64 each), all little endian.

    Parameters
    ----------
    path : path-like

    Raises
    ------
    FileNotFoundError
    FormatError
        If the file is something else, truncated, of another version, lacks one of the fields (the
        spectral files have no ``rgb``), or the shapes of its fields disagree.
    """
    with open_binary(path) as file:
        table = _tensor_table(path, file)
        arrays: dict[str, NDArray[Any]] = {}
        for name, rank in (*_RGL_RANKS.items(), ("jacobian", 1), ("description", 1)):
            if name not in table:
                raise FormatError(path, f"a field {name!r}", f"fields {', '.join(table)}")
            kind, offset, shape = table[name]
            expected = "<f4" if name in _RGL_RANKS else "u1"
            if kind != expected or len(shape) != rank or 0 in shape:
                raise FormatError(
                    path, f"{name} as {expected} with {rank} axes", f"{kind} of shape {shape}"
                )
            file.seek(offset)
            array = np.fromfile(file, kind, math.prod(shape)).reshape(shape)
            if not np.isfinite(array).all():
                raise FormatError(path, f"finite values in {name}", "others")
            arrays[name] = array
    description = arrays.pop("description").tobytes().decode("utf-8", "replace").rstrip("\0")
    jacobian = bool(arrays.pop("jacobian")[0])
    fields = RGLFields(**arrays, jacobian=jacobian, description=description)
    _check_rgl(path, fields)
    return fields


def write_rgl(path: PathName, fields: RGLFields) -> None:
    """Write an RGL ``.bsdf`` material in its RGB variant; see `read_rgl` for the container.

    Parameters
    ----------
    path : path-like
    fields : RGLFields
    """
    text = fields.description.encode() or b"\0"
    arrays: dict[str, NDArray[Any]] = {
        "description": np.frombuffer(text, "u1"),
        **{name: np.ascontiguousarray(getattr(fields, name), "<f4") for name in _RGL_RANKS},
        "jacobian": np.array([fields.jacobian], "u1"),
    }
    head = _TENSOR_MAGIC + struct.pack("<2BI", 1, 0, len(arrays))
    size = len(head) + sum(2 + len(n) + 11 + 8 * a.ndim for n, a in arrays.items())
    for name, array in arrays.items():
        kind = _TENSOR_TYPES.index("u1" if array.dtype == np.uint8 else "<f4") + 1
        head += struct.pack(f"<H{len(name)}sHBQ", len(name), name.encode(), array.ndim, kind, size)
        head += struct.pack(f"<{array.ndim}Q", *array.shape)
        size += array.nbytes
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(head)
        for array in arrays.values():
            file.write(array.tobytes())


def _tensor_table(path: PathName, file: BinaryIO) -> dict[str, tuple[str, int, tuple[int, ...]]]:
    """Return the (type, offset, shape) of every field, checked to lie within the file."""
    size = file_size(file)

    def take(layout: str) -> tuple[Any, ...]:
        data = file.read(struct.calcsize(layout))
        if len(data) < struct.calcsize(layout):
            raise FormatError(path, "a complete tensor file", f"{size} bytes, cut in its table")
        return struct.unpack(layout, data)

    magic = file.read(len(_TENSOR_MAGIC))
    if magic != _TENSOR_MAGIC:
        raise FormatError(path, "a tensor file (.bsdf)", f"a file that starts with {magic!r}")
    version = take("<2B")
    if version != (1, 0):
        raise FormatError(path, "tensor file version 1.0", f"version {version[0]}.{version[1]}")
    table: dict[str, tuple[str, int, tuple[int, ...]]] = {}
    for _ in range(take("<I")[0]):
        (length,) = take("<H")
        name = take(f"<{length}s")[0].decode("utf-8", "replace")
        rank, kind, offset = take("<HBQ")
        if not 1 <= kind <= len(_TENSOR_TYPES) or rank > 8 or name in table:
            raise FormatError(
                path,
                "fields of known type, at most 8 axes and different names",
                f"{name!r} of type {kind} with {rank} axes",
            )
        shape = take(f"<{rank}Q")
        dtype = _TENSOR_TYPES[kind - 1]
        needed = math.prod(shape) * np.dtype(dtype).itemsize
        if offset + needed > size:  # Python integers cannot overflow
            raise FormatError(
                path,
                f"{name} of shape {shape} within the file",
                f"bytes {offset} to {offset + needed} of {size}",
            )
        table[name] = dtype, offset, shape
    return table


def _check_rgl(path: PathName, fields: RGLFields) -> None:
    p, t = len(fields.phi_i), len(fields.theta_i)
    n = fields.luminance.shape[-1]
    shapes: dict[str, tuple[int, ...]] = {
        "sigma": fields.sigma.shape,
        "ndf": fields.ndf.shape,
        "vndf": (p, t, *fields.vndf.shape[2:]),
        "luminance": (p, t, n, n),
        "rgb": (p, t, 3, n, n),
    }
    for name, shape in shapes.items():
        got = getattr(fields, name).shape
        if got != shape or min(shape[-2:]) < 2:
            raise FormatError(
                path,
                f"{name} of {p} azimuths, {t} elevations, at least 2 x 2 nodes",
                f"shape {got}",
            )
    for name in ("phi_i", "theta_i"):
        if np.any(np.diff(getattr(fields, name)) <= 0.0):
            raise FormatError(path, f"increasing {name}", str(getattr(fields, name).tolist()))
    if fields.vndf.min() < 0.0 or fields.vndf.sum(axis=(2, 3)).min() <= 0.0:
        raise FormatError(path, "a vndf that is a density", f"a minimum of {fields.vndf.min()}")
    if fields.sigma.min() <= 0.0 or fields.ndf.min() < 0.0:
        raise FormatError(
            path,
            "positive sigma and ndf",
            f"minima of {fields.sigma.min()} and {fields.ndf.min()}",
        )
