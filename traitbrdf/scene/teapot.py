"""The Utah teapot, from its published Bezier patches."""

from __future__ import annotations

import functools
import json
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from traitbrdf.host import steady
from traitbrdf.scene.shapes import Mesh, dots, to_unit

Float = NDArray[np.float64]

# ---------------------------------------------------------------------------------------- teapot


@steady
def teapot(resolution: int = 24) -> Mesh:
    """Return the Utah teapot: y up, handle at -x and spout at +x, 3.15 high.

    The mesh is Newell's 32 bicubic Bezier patches (1975, with the bottom added later) in the parts
    rim, body, handle, spout, lid and bottom. Normals are those of the patches, not of the
    triangles. The surface is open: there is a slit under the lid's brim, and through the mouth of
    the spout the inner side is visible. Repeated calls return the same mesh.

    Parameters
    ----------
    resolution : int
        Quads along each side of a patch, at least 2; 24 makes about 36 thousand triangles.

    Raises
    ------
    ValueError
        If the resolution is not an integer of at least 2.
    """
    if isinstance(resolution, bool) or int(resolution) != resolution or resolution < 2:
        raise ValueError(f"resolution: expected an integer of at least 2, got {resolution!r}")
    return _teapot(int(resolution))


@functools.lru_cache(maxsize=4)
def _teapot(resolution: int) -> Mesh:
    text = resources.files("traitbrdf").joinpath("data/newell_teapot.json").read_text("utf-8")
    figures = json.loads(text)
    x, y, z = np.moveaxis(np.array(figures["patches"], dtype=np.float64), -1, 0)
    control = np.stack([x, z, -y], axis=-1)  # z up to y up: a quarter turn, no mirroring
    parts = tuple(dict.fromkeys(figures["parts"]))
    position, normal = _evaluate_patches(control, resolution)
    count, side = len(control), resolution + 1
    corner = np.arange(side * side).reshape(side, side)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    quads = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    faces = quads[None] + side * side * np.arange(count)[:, None, None]
    index = np.array([parts.index(name) for name in figures["parts"]])
    return Mesh(
        position.reshape(-1, 3),
        faces.reshape(-1, 3),
        normal.reshape(-1, 3),
        np.repeat(index, len(quads)),
        parts,
    )


def _evaluate_patches(control: Float, resolution: int) -> tuple[Float, Float]:
    """Return points and unit outward normals (P, n+1, n+1, 3) of bicubic patches (P, 4, 4, 3).

    The sums are ordered so that a boundary curve is bit for bit the same from either end. So
    neighbouring patches share their edges exactly, and no crack opens between them.
    """
    t = np.arange(resolution + 1) / resolution
    s = t[::-1]
    value = np.stack([s * s * s, 3.0 * (s * s) * t, 3.0 * (t * t) * s, t * t * t])
    slope = np.stack(
        [-3.0 * s * s, 3.0 * s * s - 6.0 * s * t, 6.0 * s * t - 3.0 * t * t, 3.0 * t * t]
    )

    def blend(basis: Float, points: Float) -> Float:
        """Contract the second axis of `points` (P, 4, ..., 3); the new axis is last but one."""
        terms = [points[:, i, ..., None, :] * basis[i][:, None] for i in range(4)]
        total: Float = (terms[0] + terms[3]) + (terms[1] + terms[2])
        return total

    # after the first contraction the axes are (P, v, u, xyz), after the second (P, u, v, xyz)
    along, along_du = blend(value, control), blend(slope, control)
    position = blend(value, along)
    du, dv, dudv = blend(value, along_du), blend(slope, along), blend(slope, along_du)
    normal = np.cross(dv, du)  # on Newell's patches du x dv points inwards
    # where an edge degenerates to a point (the lid's top, the bottom's centre) the derivative
    # along it vanishes; next to the point it is proportional to the mixed one: take the limit
    inwards = np.where(t < 0.5, 1.0, -1.0)[:, None]
    scale = 1e-12 * np.abs(control).max() ** 2
    flat = dots(normal, normal) < scale**2
    no_dv = flat & (dots(dv, dv) < scale)
    no_du = flat & (dots(du, du) < scale)
    normal = np.where(no_dv[..., None], np.cross(dudv, du) * inwards[:, None], normal)
    normal = np.where(no_du[..., None], np.cross(dv, dudv) * inwards, normal)
    return position, to_unit(normal)
