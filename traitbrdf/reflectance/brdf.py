"""Tabulated isotropic BRDFs in half/difference angles.

A table holds f_r in 1/sr, WITHOUT the cosine, as linear Rec.709 RGB at the nodes of a
`HalfDiffGrid`; its axes are theta_h, theta_d, phi_d, colour. Between nodes `TabulatedBRDF.eval`
interpolates f linearly in the three angles, so that radiance is linear in the table.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.arguments import numbers, told, whole
from traitbrdf.directions import (
    Array,
    as_directions,
    fold_phi_d,
    from_half_diff_angles,
    half_diff_angles,
)
from traitbrdf.formats.brdfs import MERL_SCALE, read_merl, write_merl, write_rgl
from traitbrdf.formats.files import FormatError, as_path, read_arrays, stem, write_arrays
from traitbrdf.host import steady
from traitbrdf.reflectance.measured import rgl_fields

if TYPE_CHECKING:
    import scipy.sparse

Float64 = NDArray[np.float64]

SUFFIXES = (".binary", ".bsdf", ".npz")
"""Of the files that `TabulatedBRDF.write` writes."""

_Bracket: TypeAlias = tuple[NDArray[np.int64], NDArray[np.int64], Float64]
"""Indices of the lower nodes, of the upper nodes, and the weights of the upper ones."""


class Reflectance(Protocol):
    """Anything that can be tabulated and integrated: models and tables alike."""

    @property
    def mirror(self) -> Float64:
        """Weight (3,) of a perfect mirror (a delta term), in addition to `eval`."""

    def eval(self, wi: ArrayLike, wo: ArrayLike) -> Array:
        """Return f_r (..., 3) in 1/sr, without the cosine, for local unit directions.

        Parameters
        ----------
        wi, wo : (..., 3) array_like
            Directions to the light and to the viewer.
        """


def checked_reflectance(given: object, name: str) -> Reflectance:
    """Return a table, a model or a measurement; say what else was given, and what to do.

    Parameters
    ----------
    given : object
    name : str, of the argument

    Raises
    ------
    TypeError
    """
    if isinstance(given, type):
        raise TypeError(
            f"{name}: expected a BRDF such as {given.__name__}(), got the class {given.__name__}"
        )
    if isinstance(given, (str, PathLike)):
        raise TypeError(
            f"{name}: expected a table or a model, got {str(given)!r}: {how_to_read(given)}"
        )
    if not callable(getattr(given, "eval", None)):
        raise TypeError(
            f"{name}: expected a table or a model with an eval method, got {told(given)}"
        )
    return given  # type: ignore[return-value]


def how_to_read(given: str | PathLike[str]) -> str:
    """Return what to do with the name of a file, or of a library material, that is no BRDF yet."""
    if Path(given).suffix.lower() == ".bsdf":
        return "read a file by tb.MeasuredBRDF.read"
    if Path(given).suffix:
        return "read a file by tb.TabulatedBRDF.read"
    return "take a library material by tb.default_library()[name]"


@dataclass(frozen=True)
class HalfDiffGrid:
    """The nodes of a table in half/difference angles (Rusinkiewicz 1998).

    There are two layouts. Both space theta_h = x^2 pi/2 quadratically, densest at the highlight:

    - ``"merl"``: node i of n is the lower edge of bin i, as in MERL's own (flooring) look-up:
      theta_h = (i/n)^2 pi/2, theta_d = (j/n) pi/2, phi_d = (l/n) pi, periodic in pi by
      reciprocity. Beyond the last theta node the value of that node is used.
    - ``"folded"``: both ends are nodes: theta_h = (i/(n-1))^2 pi/2, theta_d = j/(n-1) pi/2,
      phi_d = l/(n-1) pi/2, folded by reciprocity and mirror symmetry.

    Parameters
    ----------
    n_theta_h, n_theta_d, n_phi_d : int
        Numbers of nodes, at least 2 each.
    layout : "merl" or "folded"

    Raises
    ------
    ValueError
        On fewer nodes, or another layout.

    Examples
    --------
    >>> HalfDiffGrid.merl().shape
    (90, 90, 180)
    >>> [round(float(t), 3) for t in HalfDiffGrid(3, 2, 2).theta_h]
    [0.0, 0.393, 1.571]
    """

    n_theta_h: int
    n_theta_d: int
    n_phi_d: int
    layout: Literal["merl", "folded"] = "folded"

    def __post_init__(self) -> None:
        for name in ("n_theta_h", "n_theta_d", "n_phi_d"):
            object.__setattr__(self, name, whole(getattr(self, name), name, 2))
        if self.layout not in ("merl", "folded"):
            raise ValueError(f"layout: expected 'merl' or 'folded', got {self.layout!r}")

    @classmethod
    def merl(cls) -> HalfDiffGrid:
        """Return the grid of a MERL ``.binary`` file (Matusik et al. 2003): 90 x 90 x 180."""
        return cls(90, 90, 180, "merl")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of nodes along theta_h, theta_d and phi_d."""
        return self.n_theta_h, self.n_theta_d, self.n_phi_d

    @property
    def size(self) -> int:
        """Number of nodes."""
        return self.n_theta_h * self.n_theta_d * self.n_phi_d

    def _last(self, count: int) -> int:
        """Return the node index at the far end of an axis of `count` nodes."""
        return count if self.layout == "merl" else count - 1

    @cached_property
    def theta_h(self) -> Float64:
        """Nodes (n_theta_h,) in radians."""
        x = np.arange(self.n_theta_h) / self._last(self.n_theta_h)
        return np.asarray(x * x * (math.pi / 2))

    @cached_property
    def theta_d(self) -> Float64:
        """Nodes (n_theta_d,) in radians."""
        return np.asarray(np.arange(self.n_theta_d) / self._last(self.n_theta_d) * (math.pi / 2))

    @cached_property
    def phi_d(self) -> Float64:
        """Nodes (n_phi_d,) in radians."""
        span = math.pi if self.layout == "merl" else math.pi / 2
        return np.asarray(np.arange(self.n_phi_d) / self._last(self.n_phi_d) * span)

    def node_angles(self) -> tuple[Float64, Float64, Float64]:
        """Return theta_h, theta_d and phi_d of every node in radians, each of the grid's shape."""
        th, td, pd = np.meshgrid(self.theta_h, self.theta_d, self.phi_d, indexing="ij")
        return th, td, pd

    def node_directions(self, min_cos: float = 0.01) -> tuple[Float64, Float64]:
        """Return directions wi, wo, each (*grid.shape, 3), at which to sample the nodes.

        Where a node has a direction below the horizon, theta_d is lowered until the lower of the
        two cosines equals `min_cos`. So interpolation next to the horizon meets sensible values,
        not zeros.

        Parameters
        ----------
        min_cos : float
            Least cosine of either direction, in (0, 1).
        """
        th, td, pd = self.node_angles()
        # both cosines are cos_h cos_d +- sin_h sin_d cos(phi_d): the lower one is
        # amplitude * cos(theta_d + shift)
        a, b = np.cos(th), np.sin(th) * np.abs(np.cos(pd))
        amplitude, shift = np.hypot(a, b), np.arctan2(b, a)
        reachable = np.minimum(1.0, min_cos / np.maximum(amplitude, 1e-300))
        limit = np.arccos(reachable) - shift
        td = np.minimum(td, np.maximum(limit, 0.0))
        th = np.minimum(th, math.acos(min_cos))
        wi, wo = from_half_diff_angles(th, td, pd)
        return np.asarray(wi, np.float64), np.asarray(wo, np.float64)

    @cached_property
    def lower_cosine(self) -> Float64:
        """Cosine of the lower of each node's directions, grid-shaped; negative below horizon."""
        th, td, pd = self.node_angles()
        lower = np.cos(th) * np.cos(td) - np.sin(th) * np.sin(td) * np.abs(np.cos(pd))
        return np.asarray(lower)

    @cached_property
    def above_horizon(self) -> NDArray[np.bool_]:
        """Mask, of the grid's shape, of nodes with both directions above the horizon."""
        return np.asarray(self.lower_cosine > 1e-9)

    @cached_property
    def reached(self) -> NDArray[np.bool_]:
        """Mask, of the grid's shape, of nodes that some pair of directions above the horizon uses.

        Of the bins around a node, the corner with the lowest theta_h and theta_d is seen best, at
        the azimuth nearest to 90 degrees.
        """
        lowest = [np.maximum(np.arange(n) - 1, 0) for n in self.shape[:2]]
        cosines = np.abs(np.cos(self.phi_d))
        ends = (-1, 0) if self.layout == "merl" else (0, -1)  # periodic, or folded at both ends
        padded = np.concatenate([cosines[[ends[0]]], cosines, cosines[[ends[1]]]])
        cosine = np.minimum(np.minimum(padded[:-2], padded[1:-1]), padded[2:])
        th, td = self.theta_h[lowest[0]][:, None, None], self.theta_d[lowest[1]][:, None]
        lower = np.cos(th) * np.cos(td) - np.sin(th) * np.sin(td) * cosine
        return np.asarray(lower > 0.0)

    def stencil(
        self, theta_h: ArrayLike, theta_d: ArrayLike, phi_d: ArrayLike
    ) -> tuple[NDArray[np.int64], Float64]:
        """Return the 8 cells and weights that interpolate a table at the given angles.

        Parameters
        ----------
        theta_h, theta_d, phi_d : (...) array_like
            Radians; they broadcast.

        Returns
        -------
        index : (..., 8) int64
            Flat (C order) node indices.
        weight : (..., 8) float64
            Trilinear weights in [0, 1], summing to 1.
        """
        th, td, pd = np.broadcast_arrays(
            np.asarray(theta_h, np.float64),
            np.asarray(theta_d, np.float64),
            np.asarray(phi_d, np.float64),
        )
        (i0, i1, fi), (j0, j1, fj), (l0, l1, fl) = self._brackets(th, td, pd)
        index = np.empty((*th.shape, 8), np.int64)
        weight = np.empty((*th.shape, 8), np.float64)
        corner = 0
        for i, wi in ((i0, 1.0 - fi), (i1, fi)):
            for j, wj in ((j0, 1.0 - fj), (j1, fj)):
                for m, wm in ((l0, 1.0 - fl), (l1, fl)):
                    index[..., corner] = (i * self.n_theta_d + j) * self.n_phi_d + m
                    weight[..., corner] = wi * wj * wm
                    corner += 1
        return index, weight

    def _brackets(self, theta_h: Float64, theta_d: Float64, phi_d: Float64) -> list[_Bracket]:
        """Return, for each axis, the nodes on both sides and the weight of the upper one."""
        scale = self._last(self.n_theta_d) / (math.pi / 2)
        along = [
            self._bracket_theta_h(theta_h),
            _bracket_uniform(theta_d * scale, self.n_theta_d),
        ]
        if self.layout == "merl":
            x = np.mod(phi_d, math.pi) * (self.n_phi_d / math.pi)
            base = np.floor(x)
            low = base.astype(np.int64) % self.n_phi_d
            return [*along, (low, (low + 1) % self.n_phi_d, x - base)]
        folded = fold_phi_d(phi_d) * ((self.n_phi_d - 1) / (math.pi / 2))
        return [*along, _bracket_uniform(np.asarray(folded, np.float64), self.n_phi_d)]

    def _bracket_theta_h(self, theta_h: Float64) -> _Bracket:
        nodes = self.theta_h
        x = np.sqrt(np.maximum(theta_h, 0.0) / (math.pi / 2)) * self._last(self.n_theta_h)
        low = np.clip(np.floor(x).astype(np.int64), 0, self.n_theta_h - 2)
        fraction = (theta_h - nodes[low]) / (nodes[low + 1] - nodes[low])
        return low, low + 1, np.clip(fraction, 0.0, 1.0)


def _bracket_uniform(x: Float64, count: int) -> _Bracket:
    low = np.clip(np.floor(x).astype(np.int64), 0, count - 2)
    return low, low + 1, np.clip(x - low, 0.0, 1.0)


_KEPT = 100_000
"""Nodes of the greatest grid whose directions are kept once they have been computed."""


@functools.lru_cache(maxsize=4)
def _kept_directions(grid: HalfDiffGrid) -> tuple[Float64, Float64]:
    wi, wo = grid.node_directions()
    wi.flags.writeable = wo.flags.writeable = False
    return wi, wo


@steady
class TabulatedBRDF:
    """An isotropic BRDF given by its values on a half/difference grid.

    Parameters
    ----------
    grid : HalfDiffGrid
    values : (n_theta_h, n_theta_d, n_phi_d, 3) array
        f_r in 1/sr, finite and not negative. float32 and float64 are kept; others become float64.
    mirror : (3,) array
        Weight in [0, 1] of a perfect mirror, a delta term that no table can hold.
    name : str

    Raises
    ------
    ValueError
        On a wrong shape, or values that are negative or not finite.
    """

    def __init__(
        self,
        grid: HalfDiffGrid,
        values: ArrayLike,
        mirror: ArrayLike = (0.0, 0.0, 0.0),
        name: str = "",
    ) -> None:
        if not isinstance(grid, HalfDiffGrid):
            raise TypeError(f"grid: expected a HalfDiffGrid, got {told(grid)}")
        table = numbers(values, "values")
        if table.dtype not in (np.float32, np.float64):
            table = table.astype(np.float64)
        if table.shape != (*grid.shape, 3):
            raise ValueError(f"values: expected shape {(*grid.shape, 3)}, got {table.shape}")
        if not np.isfinite(table).all():
            bad = int(np.count_nonzero(~np.isfinite(table)))
            raise ValueError(f"values: expected finite numbers, got {bad} that are not")
        if table.min() < 0.0:
            raise ValueError(f"values: expected f >= 0, got a minimum of {table.min():.6g}")
        self.grid = grid
        self.values = table
        self._mirror = _mirror_weight(mirror)
        self.name = name

    def __repr__(self) -> str:
        shape = "x".join(map(str, self.grid.shape))
        return f"TabulatedBRDF({self.name!r}, {shape} {self.grid.layout})"

    @property
    def mirror(self) -> Float64:
        """Weight (3,) in [0, 1] of a perfect mirror, in addition to the table."""
        return self._mirror

    @classmethod
    def from_model(
        cls, model: Reflectance, grid: HalfDiffGrid, name: str = "", dtype: Any = np.float32
    ) -> TabulatedBRDF:
        """Sample a model, or anything else with an ``eval``, at the nodes of a grid.

        Parameters
        ----------
        model : Reflectance
        grid : HalfDiffGrid
        name : str
        dtype : float32 or float64
            Type of the table.
        """
        checked_reflectance(model, "model")
        if not isinstance(grid, HalfDiffGrid):
            raise TypeError(f"grid: expected a HalfDiffGrid, got {told(grid)}")
        wi, wo = _kept_directions(grid) if grid.size < _KEPT else grid.node_directions()
        return cls(grid, model.eval(wi, wo).astype(dtype), model.mirror, name)

    @classmethod
    def read(cls, path: str | PathLike[str]) -> TabulatedBRDF:
        """Read a MERL ``.binary`` file, whose invalid (negative) cells become 0, or an ``.npz``.

        For ``.bsdf`` see `MeasuredBRDF.read`.

        Parameters
        ----------
        path : path-like

        Raises
        ------
        FileNotFoundError
        traitbrdf.formats.files.FormatError
            As `traitbrdf.formats.brdfs.read_merl`, or on fewer than 2 nodes along an axis, or an
            ``.npz`` that `write` has not made.
        """
        if as_path(path).suffix.lower() == ".npz":
            return cls._read_arrays(path)
        values = read_merl(path)
        n_h, n_d, n_p, _ = values.shape
        if min(n_h, n_d, n_p) < 2:
            raise FormatError(path, "2 nodes an axis", f"{n_h} x {n_d} x {n_p}")
        grid = HalfDiffGrid(n_h, n_d, n_p, "merl")
        return cls(grid, np.maximum(values, 0.0), name=stem(path))

    @classmethod
    def _read_arrays(cls, path: str | PathLike[str]) -> TabulatedBRDF:
        arrays = read_arrays(path)
        if not {"values", "layout", "mirror"} <= set(arrays) or arrays["values"].ndim != 4:
            raise FormatError(
                path, "a table, with values, layout and mirror", ", ".join(arrays) or "no arrays"
            )
        try:
            n_h, n_d, n_p, _ = arrays["values"].shape
            grid = HalfDiffGrid(n_h, n_d, n_p, str(arrays["layout"]))  # type: ignore[arg-type]
            return cls(grid, arrays["values"], arrays["mirror"], stem(path))
        except (ValueError, TypeError) as error:
            raise FormatError(path, "a table of a BRDF", str(error)) from error

    def write(self, path: str | PathLike[str]) -> None:
        """Write a file: MERL ``.binary``, RGL ``.bsdf`` or, without any loss, ``.npz``.

        MERL: a table on another grid is fitted on that format's 90 x 90 x 180 without regard to the
        horizon, so that the file read here looks as the table does: nodes below the horizon count
        where part of the bins around them is above it. Nodes that no visible pair of directions
        reaches are marked invalid, as the format has it. RGL: see
        `traitbrdf.reflectance.measured.rgl_fields`. Neither has a field for `mirror`, so that is
        not written.

        Parameters
        ----------
        path : path-like
            Its suffix selects the format.

        Raises
        ------
        ValueError
            On another suffix.
        """
        suffix = as_path(path).suffix.lower()
        if suffix == ".binary":
            grid = HalfDiffGrid.merl()
            values = self.values.astype(np.float64) if self.grid == grid else self._fitted(grid)
            unseen = ~grid.reached & (self.grid != grid or ~values.any(axis=-1))
            values[unseen] = -np.array(MERL_SCALE)  # -1 in the file's own unit
            write_merl(path, values)
        elif suffix == ".bsdf":
            write_rgl(path, rgl_fields(self._anywhere, 2 * self.grid.n_theta_h - 1, self.name))
        elif suffix == ".npz":
            layout = np.array(self.grid.layout)
            write_arrays(path, {"values": self.values, "layout": layout, "mirror": self._mirror})
        else:
            raise ValueError(f"path: expected a name in {', '.join(SUFFIXES)}, got {str(path)!r}")

    def _anywhere(self, theta_h: Float64, theta_d: Float64, phi_d: Float64) -> Float64:
        """Interpolate the table at angles (...), without regard to the horizon."""
        index, weight = self.grid.stencil(theta_h, theta_d, phi_d)
        flat = self.values.reshape(-1, 3)
        return np.asarray(np.einsum("...k,...kc->...c", weight, flat[index]), np.float64)

    def _fitted(self, grid: HalfDiffGrid) -> Float64:
        """Return values at another grid's nodes between which integrals are those of the table.

        Samples would not do: between them, a chord passes above each kink of the table. The factors
        (Richardson 1972, Lucy 1974) keep values positive, where a least-squares fit would ring.
        """
        axes = (_Overlap.of(self.grid.theta_h, grid.theta_h),
                _Overlap.of(self.grid.theta_d, grid.theta_d))  # fmt: skip
        table = self.values.astype(np.float64)

        def both(one: Float64, other: Float64, values: Float64) -> Float64:
            found: Float64 = np.einsum("ah,bd,hdpc->abpc", one, other, values, optimize=True)
            return found

        wanted = both(axes[0].mixed, axes[1].mixed, table)
        values = both(axes[0].samples, axes[1].samples, table)
        for _ in range(_FITTING):
            found = both(axes[0].own, axes[1].own, values)
            values *= np.where(found > 0.0, wanted / np.maximum(found, 1e-300), 1.0)
        _, _, (low, high, share) = self.grid._brackets(
            grid.theta_h[:1], grid.theta_d[:1], grid.phi_d
        )
        lower, upper = values[:, :, low], values[:, :, high]
        result: Float64 = lower + share[:, None] * (upper - lower)
        return result

    def eval(self, wi: ArrayLike, wo: ArrayLike) -> Array:
        """Return f_r (..., 3) in 1/sr, without the cosine.

        It is 0 unless both directions are above the horizon.

        Parameters
        ----------
        wi, wo : (..., 3) array_like
            Local unit directions to the light and to the viewer.
        """
        wi, wo = as_directions(wi, "wi"), as_directions(wo, "wo")
        wi, wo = np.broadcast_arrays(wi, wo)
        index, weight = self.grid.stencil(*half_diff_angles(wi, wo))
        flat = self.values.reshape(-1, 3)
        f = np.einsum("...k,...kc->...c", weight, flat[index])
        visible = (wi[..., 2] > 0.0) & (wo[..., 2] > 0.0)
        return np.where(visible[..., None], f, 0.0)

    def albedo(self, theta_o: ArrayLike) -> Float64:
        """Return the directional-hemispherical albedo (..., 3).

        The integral of f cos(theta_i) over the hemisphere, plus the mirror weight.

        Parameters
        ----------
        theta_o : (...) array_like
            View angles in radians, in [0, pi/2).
        """
        theta = numbers(theta_o, "theta_o").astype(np.float64)
        rows = albedo_operator(self.grid, theta.ravel())
        result = rows @ self.values.reshape(-1, 3).astype(np.float64) + self._mirror
        return np.asarray(result).reshape(*theta.shape, 3)

    def max_albedo(self) -> float:
        """Return the largest albedo over the 16 check angles (0 to 80 degrees) and the channels.

        This is the energy check: a passive surface reaches at most 1.
        """
        return float(self.albedo(ALBEDO_ANGLES).max())

    def reciprocity_error(self, count: int = 4096, seed: int = 0) -> float:
        """Return max |f(wi, wo) - f(wo, wi)| / (1e-3 + f) over random pairs of directions.

        Parameters
        ----------
        count : int
            Number of pairs.
        seed : int
            Seed of the random numbers.
        """
        rng = np.random.default_rng(seed)
        pairs = rng.normal(size=(2, count, 3))
        pairs[..., 2] = np.abs(pairs[..., 2])
        wi, wo = pairs / np.linalg.norm(pairs, axis=-1, keepdims=True)
        forward, backward = self.eval(wi, wo), self.eval(wo, wi)
        return float(np.max(np.abs(forward - backward) / (1e-3 + forward)))

    def regrid(self, grid: HalfDiffGrid) -> TabulatedBRDF:
        """Resample to another grid `grid`, interpolating log f (lobes span many decades)."""
        if grid == self.grid:
            return self
        floor = self.values.dtype.type(1e-12)
        logs = np.log(self.values + floor)
        nodes = self.grid._brackets(grid.theta_h, grid.theta_d, grid.phi_d)
        for axis, (low, high, fraction) in enumerate(nodes):  # the interpolation is separable
            shape = [-1 if a == axis else 1 for a in range(4)]
            part = fraction.astype(logs.dtype).reshape(shape)
            lower = logs.take(low, axis=axis)
            logs = logs.take(high, axis=axis)
            logs -= lower
            logs *= part
            logs += lower
        np.exp(logs, out=logs)
        logs -= floor
        np.maximum(logs, 0.0, out=logs)
        return TabulatedBRDF(grid, logs, self._mirror, self.name)


_FITTING = 12
"""Times that values of a fitted table are multiplied by what is missing."""


@dataclass(frozen=True, eq=False)
class _Overlap:
    """How piecewise linear functions on two sets of nodes overlap.

    Attributes
    ----------
    samples : (n, m) array
        Values of the first ones at the second nodes.
    mixed, own : (n, m) and (n, n) arrays
        Means of the first functions, and of the second ones, weighted by each of the second hats.
    """

    samples: Float64
    mixed: Float64
    own: Float64

    @classmethod
    def of(cls, first: Float64, second: Float64) -> _Overlap:
        """Return the overlap of nodes (m,) and (n,), ascending angles up to pi / 2."""
        breaks = np.unique(np.concatenate([first, second, [math.pi / 2]]))
        x, w = np.polynomial.legendre.leggauss(3)
        low, step = breaks[:-1, None], np.diff(breaks)[:, None]
        places, weights = (low + 0.5 * step * (x + 1.0)).ravel(), (0.5 * step * w).ravel()
        ones, others = _hats(first, places), _hats(second, places)
        weighted = others * (weights[:, None] / (weights @ others))
        return cls(_hats(first, second), weighted.T @ ones, weighted.T @ others)


def _hats(nodes: Float64, places: Float64) -> Float64:
    """Return the linear interpolation weights (n, m) of nodes (m,) at places (n,)."""
    return np.stack([np.interp(places, nodes, row) for row in np.eye(len(nodes))], axis=1)


def _mirror_weight(value: ArrayLike) -> Float64:
    weight = np.asarray(value, np.float64)
    if weight.shape != (3,) or not np.all((weight >= 0.0) & (weight <= 1.0)):
        raise ValueError(f"mirror: expected three weights in [0, 1], got {value!r}")
    return weight


ALBEDO_ANGLES: Float64 = np.radians(np.linspace(0.0, 80.0, 16))
"""View angles (radians) at which energy is checked and decoded tables are normalised."""


def hemisphere_nodes(
    theta_o: float, theta_h: Float64, per_interval: int = 2, azimuths: int = 48
) -> tuple[Float64, Float64, Float64, Float64]:
    """Return a quadrature of the light hemisphere, built around the mirror direction of one view.

    The rule is Gauss-Legendre between consecutive `theta_h` nodes, because tables are smooth
    between them. On every ring it covers exactly one half of the azimuths for which wi is above the
    horizon (the other half is its mirror image), with d omega_i = 4 cos(theta_d) d omega_h.

    Parameters
    ----------
    theta_o : float
        View angle in radians, in [0, pi/2).
    theta_h : (m,) array
        Nodes in radians, ascending.
    per_interval : int
        Gauss-Legendre points between two nodes.
    azimuths : int
        Gauss-Legendre points on each ring.

    Returns
    -------
    theta_h, theta_d, phi_d, weight : (n,) arrays
        ``sum(weight * f)`` is the integral of f cos(theta_i) d omega_i.
    """
    x, wx = np.polynomial.legendre.leggauss(per_interval)
    # between these two angles the horizon cuts the rings: the integrand has a kink at both
    kinks = np.array([0.25 * math.pi - 0.5 * theta_o, 0.25 * math.pi + 0.5 * theta_o])
    breaks = np.unique(np.concatenate([theta_h, np.clip(kinks, theta_h[0], theta_h[-1])]))
    low, high = breaks[:-1], breaks[1:]
    th = (low + (high - low) * 0.5 * (x[:, None] + 1.0)).T.ravel()
    wh = ((high - low) * 0.5 * wx[:, None]).T.ravel()
    so, co = math.sin(theta_o), math.cos(theta_o)
    # wi.n = 2 (wo.h) cos(theta_h) - cos(theta_o) > 0 bounds cos(phi_h) from below
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        bound = (co / (2.0 * np.cos(th)) - co * np.cos(th)) / (so * np.sin(th))
    bound = np.where(np.isnan(bound), -np.inf, bound)
    phi_max = np.arccos(np.clip(bound, -1.0, 1.0))
    y, wy = np.polynomial.legendre.leggauss(azimuths)
    phi = phi_max[:, None] * 0.5 * (y + 1.0)
    w_phi = phi_max[:, None] * wy  # twice the half width: both halves of the ring
    sh, ch = np.sin(th)[:, None], np.cos(th)[:, None]
    wo_h = so * sh * np.cos(phi) + co * ch
    h = np.stack([sh * np.cos(phi), sh * np.sin(phi), np.broadcast_to(ch, phi.shape)], axis=-1)
    wo = np.array([so, 0.0, co])
    wi = 2.0 * wo_h[..., None] * h - wo
    weight = wh[:, None] * w_phi * sh * 4.0 * np.maximum(wo_h, 0.0) * np.maximum(wi[..., 2], 0.0)
    _, td, pd = half_diff_angles(wi, np.broadcast_to(wo, wi.shape))
    thetas = np.broadcast_to(th[:, None], phi.shape)
    return (
        thetas.ravel(),
        np.asarray(td, np.float64).ravel(),
        np.asarray(pd, np.float64).ravel(),
        np.asarray(weight, np.float64).ravel(),
    )


def albedo_operator(grid: HalfDiffGrid, theta_o: ArrayLike) -> scipy.sparse.csr_array:
    """Return sparse rows (n_angles, grid.size) that turn flat tables into directional albedos.

    Parameters
    ----------
    grid : HalfDiffGrid
    theta_o : (n_angles,) array_like
        View angles in radians, in [0, pi/2).

    Raises
    ------
    ValueError
        On other angles.
    """
    angles = np.atleast_1d(np.asarray(theta_o, np.float64))
    if angles.ndim != 1 or not np.all((angles >= 0.0) & (angles < math.pi / 2)):
        raise ValueError("theta_o: expected angles in [0, pi/2) radians")
    return _albedo_rows(grid, tuple(angles.tolist()))


@functools.lru_cache(maxsize=16)
def _albedo_rows(grid: HalfDiffGrid, angles: tuple[float, ...]) -> scipy.sparse.csr_array:
    import scipy.sparse  # slow to import, and models and tables do without

    nodes = np.unique(np.append(grid.theta_h, math.pi / 2))
    rows = []
    for theta in angles:
        th, td, pd, weight = hemisphere_nodes(theta, nodes)
        index, corner = grid.stencil(th, td, pd)
        row = np.bincount(
            index.ravel(), weights=(weight[:, None] * corner).ravel(), minlength=grid.size
        )
        rows.append(scipy.sparse.csr_array(row[None]))
    return scipy.sparse.csr_array(scipy.sparse.vstack(rows))


def albedo_of(f: Callable[[Float64, Float64], Array], theta_o: float) -> Float64:
    """Return the directional albedo (3,) of any reflectance function, by the same quadrature.

    Parameters
    ----------
    f : callable
        f(wi, wo) returns f_r (..., 3) in 1/sr for local unit directions (..., 3).
    theta_o : float
        View angle in radians, in [0, pi/2).
    """
    nodes = HalfDiffGrid(90, 2, 2).theta_h
    th, td, pd, weight = hemisphere_nodes(theta_o, nodes, per_interval=3, azimuths=64)
    wi, wo = from_half_diff_angles(th, td, pd)
    values = f(np.asarray(wi, np.float64), np.asarray(wo, np.float64))
    return np.asarray(weight @ values, np.float64)
