"""Unit directions, shading frames, half/difference angles and the lat-long sphere.

These conventions hold in the whole package:

- ``wi`` points to the light and ``wo`` to the viewer. Both are unit vectors of shape
  ``(..., 3)``. In a *local* frame +z is the surface normal.
- Half/difference angles follow Rusinkiewicz, "A New Change of Variables for Efficient BRDF
  Representation" (1998). The half vector ``h`` is the normalised sum of ``wi`` and ``wo``;
  ``theta_h`` in [0, pi/2] is its angle to the normal; ``theta_d`` in [0, pi/2] and ``phi_d`` are
  the polar angles of ``wi`` in the frame whose z axis is ``h`` and whose x axis lies in the plane
  of ``h`` and the normal, pointing away from the normal. All angles are in radians.
- Angles are computed with ``atan2``, never ``acos``: in float32 ``acos`` cannot resolve angles
  below 2e-4 rad, which is the first node of a MERL table.
- The world is y up. A lat-long image has row 0 at the top (+y). Its centre shows -z, and +x lies
  to the right of the centre (right-handed).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.arguments import numbers

Array = NDArray[np.floating[Any]]


def as_directions(value: ArrayLike, name: str) -> Array:
    """Return `value` as a floating ``(..., 3)`` array of unit vectors.

    Parameters
    ----------
    value : (..., 3) array_like
        Unit vectors; integers become float64.
    name : str
        Name of the argument, for error messages.

    Returns
    -------
    (..., 3) array
        `value` itself where it is a floating array already.

    Raises
    ------
    ValueError
        If the last axis is not 3, a component is not finite, or a length differs from 1 by more
        than 1e-3.
    """
    w = numbers(value, name)
    if not np.issubdtype(w.dtype, np.floating):
        w = w.astype(np.float64)
    if w.ndim == 0 or w.shape[-1] != 3:
        raise ValueError(f"{name}: expected directions of shape (..., 3), got shape {w.shape}")
    with np.errstate(over="ignore"):  # the test below rejects an infinite length
        squares = w * w  # added by hand: sums along short axes take eight times as long
        length = np.sqrt(squares[..., 0] + squares[..., 1] + squares[..., 2])
    if not np.all(np.abs(length - 1.0) < 1e-3):  # NaN fails this as well
        raise ValueError(
            f"{name}: expected unit vectors, got lengths from {np.min(length):.6g} "
            f"to {np.max(length):.6g}"
        )
    return w


def half_diff_angles(wi: Array, wo: Array) -> tuple[Array, Array, Array]:
    """Return the half/difference angles of direction pairs in the local frame.

    Parameters
    ----------
    wi, wo : (..., 3) array
        Unit directions to the light and to the viewer; +z is the normal.

    Returns
    -------
    theta_h, theta_d, phi_d : (...) arrays
        Radians; ``theta_h`` in [0, pi], ``theta_d`` in [0, pi/2], ``phi_d`` in (-pi, pi]. For
        ``wi == -wo`` the half vector is undefined, and the normal takes its place.
    """
    total = wi + wo
    length = np.sqrt(np.sum(total * total, axis=-1))
    difference = wi - wo
    theta_d = np.arctan2(np.sqrt(np.sum(difference * difference, axis=-1)), length)
    degenerate = length == 0.0
    h = total / np.where(degenerate, 1.0, length)[..., None]
    h = np.where(degenerate[..., None], np.array([0.0, 0.0, 1.0], dtype=h.dtype), h)
    sin_h = np.hypot(h[..., 0], h[..., 1])
    theta_h = np.arctan2(sin_h, h[..., 2])
    on_axis = sin_h == 0.0
    safe = np.where(on_axis, 1.0, sin_h)
    cos_phi = np.where(on_axis, 1.0, h[..., 0] / safe)
    sin_phi = np.where(on_axis, 0.0, h[..., 1] / safe)
    x = h[..., 2] * (cos_phi * wi[..., 0] + sin_phi * wi[..., 1]) - sin_h * wi[..., 2]
    y = cos_phi * wi[..., 1] - sin_phi * wi[..., 0]
    return theta_h, theta_d, np.arctan2(y, x)


def from_half_diff_angles(
    theta_h: ArrayLike, theta_d: ArrayLike, phi_d: ArrayLike, phi_h: ArrayLike = 0.0
) -> tuple[Array, Array]:
    """Return directions with the given half/difference angles: the inverse of `half_diff_angles`.

    Parameters
    ----------
    theta_h, theta_d, phi_d : (...) array_like
        Half/difference angles in radians; they broadcast.
    phi_h : (...) array_like
        Azimuth of the half vector about the normal, in radians.

    Returns
    -------
    wi, wo : (..., 3) arrays
        Unit directions in the local frame.
    """
    th, td, pd = np.broadcast_arrays(theta_h, theta_d, phi_d)
    if not np.issubdtype(th.dtype, np.floating):
        th = th.astype(np.float64)
    ph = np.asarray(phi_h, dtype=th.dtype)
    th, td, pd, ph = np.broadcast_arrays(th, td, pd, ph)
    sh, ch = np.sin(th), np.cos(th)
    sp, cp = np.sin(ph), np.cos(ph)
    h = np.stack([sh * cp, sh * sp, ch], axis=-1)
    x = np.stack([ch * cp, ch * sp, -sh], axis=-1)
    y = np.stack([-sp, cp, np.zeros_like(cp)], axis=-1)
    along = np.cos(td)[..., None] * h
    across = np.sin(td)[..., None] * (np.cos(pd)[..., None] * x + np.sin(pd)[..., None] * y)
    return along + across, along - across


def fold_phi_d(phi_d: Array) -> Array:
    """Fold ``phi_d`` (radians) to [0, pi/2], by reciprocity (period pi) and mirror symmetry."""
    folded = np.mod(phi_d, math.pi)
    return np.minimum(folded, math.pi - folded)


def shading_frame(normal: Array) -> tuple[Array, Array]:
    """Return two unit tangents that complete unit normals to a right-handed frame.

    Duff et al., "Building an Orthonormal Basis, Revisited" (JCGT 2017), listing 3. It has no branch
    that loses precision near the poles.

    Parameters
    ----------
    normal : (..., 3) array
        Unit normals.

    Returns
    -------
    tangent, bitangent : (..., 3) arrays
    """
    x, y, z = normal[..., 0], normal[..., 1], normal[..., 2]
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    tangent = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    bitangent = np.stack([b, sign + y * y * a, -y], axis=-1)
    return tangent, bitangent


def to_local(w: Array, normal: Array) -> Array:
    """Express world directions `w` (..., 3) in the local frames of unit `normal` (..., 3)."""
    tangent, bitangent = shading_frame(normal)
    return np.stack(
        [np.sum(w * tangent, -1), np.sum(w * bitangent, -1), np.sum(w * normal, -1)], axis=-1
    )


def to_world(w: Array, normal: Array) -> Array:
    """Turn local directions `w` (..., 3), in the frames of unit `normal` (..., 3), to the world."""
    tangent, bitangent = shading_frame(normal)
    return w[..., :1] * tangent + w[..., 1:2] * bitangent + w[..., 2:3] * normal


def reflect(w: Array, normal: Array) -> Array:
    """Mirror unit directions `w` (..., 3) about unit normals `normal` (..., 3)."""
    mirrored: Array = 2.0 * np.sum(w * normal, axis=-1, keepdims=True) * normal - w
    return mirrored


def latlong_to_direction(u: ArrayLike, v: ArrayLike) -> Array:
    """Return world directions (..., 3) at the lat-long image position (u, v).

    This is the mapping of Ramamoorthi & Hanrahan: x = -sin(theta) sin(phi), y = -cos(theta),
    z = sin(theta) cos(phi), where theta = pi (1 - v) is measured from -y and phi = 2 pi u.

    Parameters
    ----------
    u : (...) array_like
        Position in [0, 1] from left to right.
    v : (...) array_like
        Position in [0, 1] from the top (+y) to the bottom.
    """
    uu, vv = np.broadcast_arrays(np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64))
    phi, polar = 2.0 * math.pi * uu, math.pi * vv
    s = np.sin(polar)
    return np.stack([-s * np.sin(phi), np.cos(polar), s * np.cos(phi)], axis=-1)


def direction_to_latlong(w: ArrayLike) -> tuple[Array, Array]:
    """Return lat-long image positions (u, v) in [0, 1] of world directions `w` (..., 3)."""
    d = np.asarray(w)
    u = (np.arctan2(d[..., 0], -d[..., 2]) + math.pi) / (2.0 * math.pi)
    v = np.arctan2(np.hypot(d[..., 0], d[..., 2]), d[..., 1]) / math.pi
    return u, v
