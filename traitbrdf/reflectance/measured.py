"""Measured isotropic materials of the RGL database.

Dupuy & Jakob, "An Adaptive Parameterization for Efficient Material Acquisition and Rendering" (ACM
TOG 37(6), 2018), sections 4 and 5. A measurement is stored on a unit square. A density of visible
normals (the vndf, one per elevation of the first direction) warps the square to the half vectors,
so that its nodes are dense where the material reflects.

Known weaknesses: the stored quantity includes the cosine of the second direction. Dividing it out
amplifies noise and interpolation error next to the horizon, where the instrument could not measure
and the data are extrapolated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.directions import Array, as_directions, half_diff_angles
from traitbrdf.formats.brdfs import RGLFields, read_rgl
from traitbrdf.formats.files import FormatError, stem
from traitbrdf.host import steady

Float64 = NDArray[np.float64]
Index = NDArray[np.int64]

MIN_COS = 1e-3
"""Floor of the cosine that is divided out; it acts only within 0.06 degrees of the horizon."""

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)

_CHUNK = 1 << 15  # pairs of directions at a time: keeps the temporaries below some 30 MB


_ELEVATIONS = 46  # of the first direction in files that are written, close together at the horizon


def rgl_fields(
    f: Callable[[Float64, Float64, Float64], Float64], nodes: int, description: str = ""
) -> RGLFields:
    """Return the fields of an RGL material that holds any isotropic BRDF.

    The format warps the unit square by a density of visible normals. A constant one leaves it as it
    is: its axes are then sqrt(theta_h 2 / pi), along which tables have their nodes as well, and the
    azimuth between the half vector and the first direction. So no BRDF needs a microfacet
    distribution. What is stored is f times the cosine of the second direction, below the horizon
    too, where it is negative: so it vanishes at the horizon between the nodes.

    Parameters
    ----------
    f : callable
        f(theta_h, theta_d, phi_d) returns f_r (..., 3) in 1/sr for angles (...) in radians, also
        where a direction is below the horizon.
    nodes : int
        Nodes along each axis of the square, at least 2.
    description : str
    """
    theta_i = np.radians(89.5 * (1.0 - np.linspace(1.0, 0.0, _ELEVATIONS) ** 1.4))
    share = np.linspace(0.0, 1.0, nodes)
    theta_h = (share**2 * (0.5 * math.pi))[None, :]
    phi = ((2.0 * share - 1.0) * math.pi)[:, None]  # of the half vector, wi at azimuth 0
    half = np.stack(
        [np.sin(theta_h) * np.cos(phi), np.sin(theta_h) * np.sin(phi), np.cos(theta_h) + 0.0 * phi],
        axis=-1,
    )
    # a least-squares fit: chords between samples would pass above what rises towards the horizon
    x, w = np.polynomial.legendre.leggauss(3)
    step = np.diff(theta_i)[:, None]
    angles = (theta_i[:-1, None] + 0.5 * step * (x + 1.0)).ravel()
    hats = np.stack([np.interp(angles, theta_i, row) for row in np.eye(_ELEVATIONS)])
    weighted = hats * (0.5 * step * w).ravel()
    sums = np.zeros((_ELEVATIONS, nodes, nodes, 3))
    for k, angle in enumerate(angles):
        wi = np.array([math.sin(angle), 0.0, math.cos(angle)])
        dot = half @ wi
        wo = 2.0 * dot[..., None] * half - wi
        found = half_diff_angles(np.broadcast_to(wi, wo.shape), wo)
        _, theta_d, phi_d = (np.asarray(one, np.float64) for one in found)
        value = f(np.broadcast_to(theta_h, dot.shape), theta_d, phi_d) * wo[..., 2:]
        value[dot <= 0.0] = 0.0
        for row in np.flatnonzero(weighted[:, k]):
            sums[row] += weighted[row, k] * value
    fitted = np.linalg.solve(weighted @ hats.T, sums.reshape(_ELEVATIONS, -1))
    stored = fitted.reshape(1, _ELEVATIONS, nodes, nodes, 3).astype(np.float32)
    rgb = np.ascontiguousarray(np.moveaxis(stored, -1, 2))
    luminance = np.maximum(np.einsum("ptcyx,c->ptyx", rgb, _LUMINANCE), 0.0)
    luminance += 1e-3 * luminance.mean(axis=(2, 3), keepdims=True) + 1e-6
    ones = np.ones((2, 2), np.float32)
    return RGLFields(
        np.zeros(1, np.float32), theta_i.astype(np.float32), ones, ones,
        np.ones((1, _ELEVATIONS, 2, 2), np.float32), luminance.astype(np.float32), rgb, False,
        description,
    )  # fmt: skip


@steady
class MeasuredBRDF:
    """A measured isotropic BRDF, evaluated in its own parametrisation.

    Parameters
    ----------
    fields : traitbrdf.formats.brdfs.RGLFields
        Fields of an isotropic material, which has one azimuth. If it has two, the first is used,
        because the azimuth of the first direction is arbitrary.
    name : str

    Raises
    ------
    ValueError
        If the material is anisotropic.

    Notes
    -----
    With g(wi, wo) the stored quantity, f cos(theta_o), the value is the mean of g(wi, wo) /
    cos(theta_o) and g(wo, wi) / cos(theta_i), which is reciprocal by construction. Cosines are at
    least `MIN_COS`. Negative values (colours out of gamut) are set to 0 before the mean is taken.
    """

    def __init__(self, fields: RGLFields, name: str = "") -> None:
        if len(fields.phi_i) > 2:
            raise ValueError(
                f"fields: expected an isotropic material (1 azimuth), got {len(fields.phi_i)}"
            )
        self.name = name
        self.description = fields.description
        self._theta_i = fields.theta_i.astype(np.float64)
        self._u_phi_i = (float(fields.phi_i[0]) + math.pi) / (2.0 * math.pi)
        self._sigma = fields.sigma.astype(np.float64)[None, ..., None]
        self._ndf = fields.ndf.astype(np.float64)[None, ..., None]
        self._jacobian = fields.jacobian
        self._rgb = np.moveaxis(fields.rgb[0].astype(np.float64), 1, -1).copy()
        self._warp = _Warp(fields.vndf[0].astype(np.float64))

    def __repr__(self) -> str:
        return f"MeasuredBRDF({self.name!r})"

    @classmethod
    def read(cls, path: str | PathLike[str]) -> MeasuredBRDF:
        """Read a ``.bsdf`` file; the BRDF is named after the file.

        Parameters
        ----------
        path : path-like

        Raises
        ------
        FileNotFoundError
        traitbrdf.formats.files.FormatError
            If the file is no RGB material of that format, or an anisotropic one.
        """
        fields = read_rgl(path)
        if len(fields.phi_i) > 2:
            raise FormatError(
                path, "an isotropic material (1 azimuth)", f"{len(fields.phi_i)} azimuths"
            )
        return cls(fields, stem(path))

    @property
    def mirror(self) -> Float64:
        """Weight (3,) of a perfect mirror, in addition to `eval`: none."""
        return np.zeros(3)

    def eval(self, wi: ArrayLike, wo: ArrayLike) -> Array:
        """Return f_r in 1/sr, without the cosine; 0 unless both directions are above the horizon.

        Parameters
        ----------
        wi, wo : (..., 3) array_like
            Local unit directions to the light and to the viewer.

        Returns
        -------
        (..., 3) float64
            Finite, not negative, linear Rec.709 RGB.
        """
        wi, wo = np.broadcast_arrays(as_directions(wi, "wi"), as_directions(wo, "wo"))
        f = np.zeros(wi.shape)
        above = (wi[..., 2] > 0.0) & (wo[..., 2] > 0.0)
        a, b = wi[above].astype(np.float64), wo[above].astype(np.float64)
        values = np.empty(a.shape)
        for start in range(0, len(a), _CHUNK):
            part = slice(start, start + _CHUNK)
            values[part] = self._reciprocal(a[part], b[part])
        f[above] = values
        return f

    def _reciprocal(self, wi: Float64, wo: Float64) -> Float64:
        half = wi + wo
        forward = self._stored(wi, half) / np.maximum(wo[:, 2:], MIN_COS)
        backward = self._stored(wo, half) / np.maximum(wi[:, 2:], MIN_COS)
        return np.asarray(0.5 * (forward + backward))

    def _stored(self, first: Float64, half: Float64) -> Float64:
        """Return f times the cosine of the other direction, (n, 3); `half` has any length."""
        theta_i, phi_i = _spherical(first)
        theta_m, phi_m = _spherical(half)
        turn = (phi_m - phi_i) / (2.0 * math.pi) + 0.5
        y = turn - np.floor(turn)
        x = np.sqrt(theta_m * (2.0 / math.pi))
        low, weight = self._elevation(theta_i)
        value = _bilinear(self._rgb, low, weight, *self._warp.invert(x, y, low, weight))
        value = np.maximum(value, 0.0)
        if self._jacobian:
            zero = np.zeros_like(low)
            u_phi = np.full_like(x, self._u_phi_i)
            u_theta = np.sqrt(theta_i * (2.0 / math.pi))
            sigma = _bilinear(self._sigma, zero, None, u_theta, u_phi)
            value = value * _bilinear(self._ndf, zero, None, x, y) / (4.0 * sigma)
        return value

    def _elevation(self, theta_i: Float64) -> tuple[Index, Float64 | None]:
        """Return the index of the elevation below and the weight of the next, both clamped."""
        nodes = self._theta_i
        if len(nodes) == 1:
            return np.zeros(theta_i.shape, np.int64), None
        low = np.clip(np.searchsorted(nodes, theta_i, "right") - 1, 0, len(nodes) - 2)
        weight = (theta_i - nodes[low]) / (nodes[low + 1] - nodes[low])
        return low, np.clip(weight, 0.0, 1.0)


class _Warp:
    """The inverse of sampling a bilinear density: first rows by the marginal, then columns.

    The distributions of all elevations are normalised first and then interpolated, densities and
    cumulative sums alike, as in section 5 and in the authors' own reader.

    Parameters
    ----------
    density : (slices, rows, columns) float64, not negative
    """

    def __init__(self, density: Float64) -> None:
        slices, rows, columns = density.shape
        along = np.zeros((slices, rows, columns))
        np.cumsum(0.5 * (density[..., 1:] + density[..., :-1]), axis=-1, out=along[..., 1:])
        marginal = np.zeros((slices, rows))
        row_mass = along[..., -1]
        np.cumsum(0.5 * (row_mass[:, 1:] + row_mass[:, :-1]), axis=-1, out=marginal[:, 1:])
        total = marginal[:, -1]
        self._density = density / total[:, None, None]
        self._along = along / total[:, None, None]
        self._marginal = marginal / total[:, None]

    def invert(
        self, x: Float64, y: Float64, low: Index, weight: Float64 | None
    ) -> tuple[Float64, Float64]:
        """Return the points (n,) of the unit square that sampling would map to (x, y)."""
        _, rows, columns = self._density.shape
        column, row = x * (columns - 1), y * (rows - 1)
        i = np.clip(column.astype(np.int64), 0, columns - 2)
        j = np.clip(row.astype(np.int64), 0, rows - 2)
        s, t = column - i, row - j

        def across(table: Float64, at: Index) -> Float64:
            """Interpolate between the rows j and j + 1, at column `at`."""
            below, above = (_slices(table, low, weight, r * columns + at) for r in (j, j + 1))
            return np.asarray((1.0 - t) * below + t * above)

        c0, c1 = across(self._density, i), across(self._density, i + 1)
        last = np.full_like(i, columns - 1)
        r0, r1 = (_slices(self._along, low, weight, r * columns + last) for r in (j, j + 1))
        mass = (1.0 - t) * r0 + t * r1
        u = across(self._along, i) + s * (c0 + 0.5 * s * (c1 - c0))
        # a row without mass is never sampled, so any of its points may stand for it
        u = np.where(mass > 0.0, u / np.where(mass > 0.0, mass, 1.0), x)
        v = _slices(self._marginal, low, weight, j) + t * (r0 + 0.5 * t * (r1 - r0))
        return np.clip(u, 0.0, 1.0), np.clip(v, 0.0, 1.0)


def _spherical(w: Float64) -> tuple[Float64, Float64]:
    """Return polar angle and azimuth (n,) of vectors (n, 3) of any length."""
    polar = np.arctan2(np.hypot(w[:, 0], w[:, 1]), w[:, 2])
    return np.asarray(polar), np.asarray(np.arctan2(w[:, 1], w[:, 0]))


def _slices(table: Float64, low: Index, weight: Float64 | None, at: Index) -> Float64:
    """Return element `at` of each flattened slice `low`, blended with the next slice."""
    flat = table.reshape(-1)
    size = math.prod(table.shape[1:])
    index = low * size + at
    if weight is None:
        return np.asarray(flat[index])
    return np.asarray((1.0 - weight) * flat[index] + weight * flat[index + size])


def _bilinear(
    table: NDArray[Any], low: Index, weight: Float64 | None, x: Float64, y: Float64
) -> Float64:
    """Interpolate a (slices, rows, columns, channels) table at x (columns) and y (rows) in [0, 1].

    Returns
    -------
    (n, channels) float64
    """
    _, rows, columns, channels = table.shape
    flat = table.reshape(-1, channels)
    column, row = x * (columns - 1), y * (rows - 1)
    i = np.clip(column.astype(np.int64), 0, columns - 2)
    j = np.clip(row.astype(np.int64), 0, rows - 2)
    s, t = (column - i)[:, None], (row - j)[:, None]
    value = np.zeros((len(x), channels))
    shares = [(0, None)] if weight is None else [(0, 1.0 - weight), (1, weight)]
    for step, share in shares:
        index = ((low + step) * rows + j) * columns + i
        patch = (1.0 - t) * ((1.0 - s) * flat[index] + s * flat[index + 1]) + t * (
            (1.0 - s) * flat[index + columns] + s * flat[index + columns + 1]
        )
        value += patch if share is None else share[:, None] * patch
    return value
