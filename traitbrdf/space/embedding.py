"""The embedding: BRDFs as points of a low-dimensional space (after Matusik et al. 2003).

A table's values are mapped by y = log(f + FLOOR). Matusik et al. ("A Data-Driven Reflectance
Model", SIGGRAPH 2003) take one vector of all colours for each material. Here the mean of the three
channels' logarithms and their differences (red against blue, green against magenta) are embedded
separately, by two PCAs: materials differ in many ways in shape and in few in colour. With
m = (16, 4) components a material has k = 24 coordinates: 16 achromatic ones first, then 4 for red
against blue, then 4 for green against magenta; each axis is scaled to unit variance.

The principal components are then refined with weights that follow the light which a cell reflects
(weighted low-rank approximation), since errors that nobody sees matter little. A linear space also
holds tables that no material has, with holes in highlights and spikes; decoding corrects them
(`traitbrdf.space.highlights`).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, overload

import numpy as np
import scipy  # its parts are loaded when they are first named
from numpy.typing import ArrayLike, NDArray

from traitbrdf.arguments import numbers
from traitbrdf.directions import fold_phi_d
from traitbrdf.host import steady
from traitbrdf.reflectance.brdf import (
    ALBEDO_ANGLES,
    HalfDiffGrid,
    Reflectance,
    TabulatedBRDF,
    albedo_operator,
    checked_reflectance,
)
from traitbrdf.space.fitting import batches, checked_grid, fit_weight, principal_axes
from traitbrdf.space.highlights import Profiles

if TYPE_CHECKING:  # importing torch takes a second: functions that need it import it
    import torch
from traitbrdf.space.logmap import (
    FLOOR,
    OPPONENT,
    cell_weight,
    channel_logs,
    channel_mixing,
    log_map,
    log_slope,
    natural_light,
    product,
    reflectance,
    tied_albedo,
)

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

GRID = HalfDiffGrid(90, 24, 9, "folded")
"""The grid on which the library lives and frames are decoded."""

_MARGIN = 1.0 + 1e-6
"""Factor that keeps scaled tables below albedo 1 in spite of rounding."""

_NOISE = 0.1
"""Assumed standard deviation of log f from the space, where samples are encoded."""

_SEEN = 8e-4
"""Assumed standard deviation of visible radiance, relative to all of it, under natural light."""

_PASSES = 2
"""How often the components are refined with these weights."""

_ROUNDS = 25
"""Greatest number of rounds in which the weights of samples are recomputed."""

_ROBUST = 0.03
"""Deviation of log f beyond which a sample's weight falls with its inverse: nearly the least sum of
absolute deviations, which follows most samples rather than the worst.
"""

_PRIOR = 0.01
"""Precision of the prior (the library's unit variance) where a point is refined: nearly none."""


class _Tensors(NamedTuple):
    """What decoding needs, on one device and in one precision."""

    basis: torch.Tensor  # (m, cells)
    mean: torch.Tensor  # (cells,)
    check: torch.Tensor  # (cells, 16) what turns f into directional albedos
    mixing: torch.Tensor  # (3, m, k)
    low: torch.Tensor
    high: torch.Tensor


@steady
class BRDFEmbedding:
    """Log-mapped PCA of tabulated BRDFs.

    Parameters
    ----------
    n_components : (int, int)
        Components of the mean of the channels, and of each of the two colour axes: (16, 4) makes
        16 + 2 * 4 coordinates. One number stands for both.

    Attributes
    ----------
    grid_ : HalfDiffGrid
    mean_ : (cells,) float32
        Mean of log(f + FLOOR).
    components_ : (cells, m) float32
        Those of the mean of the channels first.
    weight_ : (cells,) float32
        Weight of a cell apart from its light: the square root of the lower cosine, 0 below the
        horizon.
    low_, high_ : (k,) float64
        The gamut box: the range of the library's coordinates.
    profiles_ : Profiles
        How decoding corrects log f along theta_h.
    explained_variance_ratio_ : (m,) float64
        Of the whole variance, before the weights.

    Raises
    ------
    ValueError
        If `n_components` is not one or two positive integers.
    """

    def __init__(self, n_components: int | tuple[int, int] = (16, 4)) -> None:
        try:
            pair = (n_components,) * 2 if isinstance(n_components, int) else tuple(n_components)
        except TypeError:
            pair = ()
        if len(pair) != 2 or not all(
            isinstance(n, int | np.integer) and not isinstance(n, bool) and n >= 1 for n in pair
        ):
            raise ValueError(
                f"n_components: expected one or two positive integers, got {n_components!r}"
            )
        self.n_components = (int(pair[0]), int(pair[1]))
        self._mixing = channel_mixing(self.n_components)

    def fit(self, tables: Iterable[TabulatedBRDF]) -> BRDFEmbedding:
        """Fit to a library of at least two tables on one grid, and return self.

        Parameters
        ----------
        tables : iterable of TabulatedBRDF
            May be larger than memory unless it is an iterator: it is read eleven times, and 128
            tables are held at once.

        Raises
        ------
        ValueError
            If there are too few tables, tables of several grids, or tables that are too alike.
        """
        if isinstance(tables, Iterator):
            tables = list(tables)
        self.__dict__.pop("components_", None)  # a fit that fails leaves none
        self.grid_, count = checked_grid(tables)
        achromatic, chromatic = self.n_components
        if count <= max(achromatic, chromatic):
            raise ValueError(
                f"n_components: expected fewer than the {count} tables of the library, "
                f"got {self.n_components}"
            )
        self.weight_ = cell_weight(self.grid_)
        total = np.zeros(self.grid_.size)
        for logs in batches(tables):
            total += logs.sum(axis=(0, 1))
        self.mean_ = (total / (3 * count)).astype(np.float32)
        grey = principal_axes(tables, slice(0, 1), achromatic, count, self.mean_, self.weight_)
        # with both signs, so that the mean is grey whatever colours the library prefers
        colour = principal_axes(tables, slice(1, 3), chromatic, count, self.mean_, self.weight_)
        self.components_ = np.concatenate([grey[0], colour[0]], axis=1)
        variance = np.concatenate([grey[1], 2.0 * colour[1]])
        self.explained_variance_ratio_ = variance / (grey[2] + 2.0 * colour[2])
        for _ in range(_PASSES):
            self._reweighted(tables)
        self.profiles_ = Profiles.of(lambda: batches(tables), self.grid_)
        self._prepare()
        coordinates = np.concatenate([self.least_squares(logs) for logs in batches(tables)])
        self.low_, self.high_ = coordinates.min(axis=0), coordinates.max(axis=0)
        return self

    def _reweighted(self, tables: Iterable[TabulatedBRDF]) -> None:
        """Refine components and mean with weights that follow the light which a cell reflects.

        Weighted low-rank approximation by alternating least squares (Srebro & Jaakkola, "Weighted
        Low-Rank Approximations", ICML 2003, section 3).
        """
        import torch

        size = self.components_.shape[1] + 1
        upper = np.triu_indices(size)
        gram = torch.zeros((len(upper[0]), self.grid_.size), dtype=torch.float64)
        pull = torch.zeros((size, self.grid_.size), dtype=torch.float64)
        squares, count = np.zeros(self.size), 0
        for logs in batches(tables):
            z = self.least_squares(logs)
            squares, count = squares + np.sum(z**2, axis=0), count + len(z)
            scores = np.einsum("cmk,nk->ncm", self._mixing, z)
            scores = np.concatenate([scores, np.ones((*scores.shape[:2], 1))], axis=2)
            rows = torch.from_numpy(scores.reshape(-1, size).astype(np.float32))
            weight = torch.from_numpy(
                fit_weight(logs, self.weight_, self.grid_).reshape(len(rows), -1)
            )
            weight += 1e-8  # cells below the horizon are interpolated with, and so fitted too
            gram += (rows[:, upper[0]] * rows[:, upper[1]]).T @ weight
            weight *= torch.from_numpy(logs.reshape(len(rows), -1))
            pull += rows.T @ weight
        whole = np.empty((self.grid_.size, size, size))
        whole[:, upper[0], upper[1]] = whole[:, upper[1], upper[0]] = gram.numpy().T
        whole += 1e-7 * np.trace(whole, axis1=1, axis2=2)[:, None, None] / size * np.eye(size)
        found = np.linalg.solve(whole, pull.numpy().T[..., None])[..., 0]
        deviation = np.sqrt(np.maximum(squares / count, 1e-30))
        achromatic = self.n_components[0]
        colour = np.sqrt(0.5 * np.sum(deviation[achromatic:].reshape(2, -1) ** 2, axis=0))
        found[:, :-1] *= np.concatenate([deviation[:achromatic], colour])
        self.components_ = np.ascontiguousarray(found[:, :-1], np.float32)
        self.mean_ = np.ascontiguousarray(found[:, -1], np.float32)

    def least_squares(self, logs: Float32) -> Float64:
        """Return the coordinates that fit uses, and where `encode` starts.

        Least squares with weights that follow the light which a cell reflects, neither robust nor
        clipped to the gamut box.

        Parameters
        ----------
        logs : (n, 3, cells) float32
            log(f + FLOOR).

        Returns
        -------
        (n, k) float64
        """
        import torch

        components = torch.from_numpy(self.components_)
        rows = components.T.contiguous()  # scaled along its rows, this takes a third of the time
        found = np.empty((len(logs), self.size))
        for i, (weights, target) in enumerate(
            zip(fit_weight(logs, self.weight_, self.grid_), logs, strict=True)
        ):
            gram, pull = 1e-6 * np.eye(self.size), np.zeros(self.size)
            for mixing, weight, log in zip(self._mixing, weights, target, strict=True):
                weighted = rows * torch.from_numpy(weight)
                gram += mixing.T @ (weighted @ components).numpy() @ mixing
                pull += mixing.T @ (weighted @ torch.from_numpy(log - self.mean_)).numpy()
            found[i] = np.linalg.solve(gram, pull)
        return found

    def _prepare(self) -> None:
        """Derive from the fitted state the basis in decoding order and the albedo check."""
        self._basis = np.ascontiguousarray(self.components_.T)
        check = albedo_operator(self.grid_, ALBEDO_ANGLES).astype(np.float32)
        # three quarters of the cells count, so a dense product is faster than the sparse one
        self._check: Float32 = np.ascontiguousarray(check.toarray().T)
        self._tensors: dict[tuple[torch.device, torch.dtype], _Tensors] = {}

    def __repr__(self) -> str:
        state = f", k={self.size}, grid={self.grid_.shape}" if hasattr(self, "grid_") else ""
        return f"BRDFEmbedding(n_components={self.n_components}{state})"

    @property
    def size(self) -> int:
        """k, the number of coordinates of a material."""
        return self.n_components[0] + 2 * self.n_components[1]

    def _fitted(self) -> None:
        if not hasattr(self, "components_"):
            raise ValueError("this BRDFEmbedding is not fitted yet: call fit(tables) first")

    def as_coordinates(self, z: ArrayLike) -> Float64:
        """Return `z` as an array, after checking it.

        Parameters
        ----------
        z : (k,) array_like

        Returns
        -------
        (k,) float64

        Raises
        ------
        ValueError
            If `z` is not k finite numbers.
        """
        self._fitted()
        value = numbers(z, "z").astype(np.float64)
        if value.shape != (self.size,):
            raise ValueError(f"z: expected shape ({self.size},), got {value.shape}")
        if not np.isfinite(value).all():
            raise ValueError(f"z: expected finite coordinates, got {value!r}")
        return value

    def encode(self, brdf: Reflectance) -> Float64:
        """Find coordinates of a table or a model, within the gamut box.

        Parameters
        ----------
        brdf : Reflectance
            A table on any grid, or a model; a TypeError says what else came.

        Returns
        -------
        (k,) float64
        """
        self._fitted()
        table = checked_reflectance(brdf, "brdf")
        if not isinstance(table, TabulatedBRDF):
            table = TabulatedBRDF.from_model(brdf, self.grid_)
        table = table.regrid(self.grid_)
        logs = np.ascontiguousarray(channel_logs(table))
        weight = np.repeat(self.weight_[None].astype(np.float64) ** 2, 3, axis=0)
        weight *= 3.0 * 1000.0 / _NOISE**2 / weight.sum()
        return self._refined(self.clip(self.least_squares(logs[None])[0]), logs, weight)

    def _refined(self, start: Float64, logs: Float32, weight: Float64) -> Float64:
        """Return the point of the gamut box that best shows a table, starting near by.

        It minimises two costs: deviations of log(f + FLOOR) from `logs` (3, cells), robust
        (`_ROBUST`) and with weights (3, cells); and squared deviations of visible radiance under
        natural light (`natural_light`), relative to all of it, with deviation `_SEEN`.
        Levenberg-Marquardt steps, within the box.
        """
        import torch

        light = natural_light(self.grid_)
        given = torch.from_numpy(np.maximum(np.exp(logs) - np.float32(FLOOR), 0.0))
        seen = light @ given.T
        black = light @ torch.full_like(given.T, FLOOR)  # bounds the precision
        precision = 1.0 / (_SEEN**2 * float((seen**2 + black**2).sum()))

        def misfit(z: Float64) -> tuple[float, Float32, Float32, Any]:
            shown = self.decode_values(z)
            away = log_map(shown).T - logs
            robust = np.minimum(np.abs(away), _ROBUST)
            cost = float(np.sum(weight * robust * (np.abs(away) - 0.5 * robust)))
            apart = light @ torch.from_numpy(shown) - seen
            cost += 0.5 * precision * float((apart**2).sum()) + 0.5 * _PRIOR * float(z @ z)
            return cost, shown, away, apart

        z, damping = start, 1e-3
        cost, shown, away, apart = misfit(z)
        for _ in range(_ROUNDS):
            slopes = self.jacobian(z)
            gram, pull = _PRIOR * np.eye(self.size), _PRIOR * z
            count = (weight * _ROBUST / np.maximum(np.abs(away), _ROBUST)).astype(np.float32)
            for colour in range(3):
                slope = torch.from_numpy(np.ascontiguousarray(slopes[:, colour]))
                turned = light @ slope
                gram = gram + precision * (turned.T @ turned).numpy()
                pull = pull + precision * (turned.T @ apart[:, colour]).numpy()
                slope /= torch.from_numpy(shown[:, colour, None] + np.float32(FLOOR))
                counted = slope * torch.from_numpy(count[colour])[:, None]
                gram = gram + (counted.T @ slope).numpy()
                pull = pull + (counted.T @ torch.from_numpy(away[colour])).numpy()
            before = cost
            for _ in range(8):
                root = np.linalg.cholesky(gram + damping * np.diag(np.diag(gram)))
                aim = np.linalg.solve(root, -pull)
                least, most = self.low_ - z - 1e-12, self.high_ - z + 1e-12
                step = scipy.optimize.lsq_linear(root.T, aim, (least, most)).x
                moved = self.clip(z + step)
                trial = misfit(moved)
                if trial[0] < cost:
                    z, (cost, shown, away, apart) = moved, trial
                    damping = max(0.2 * damping, 1e-6)
                    break
                damping *= 8.0
            if before - cost < 1e-3 * before:
                break
        return z

    @overload
    def encode_samples(
        self,
        theta_h: ArrayLike,
        theta_d: ArrayLike,
        phi_d: ArrayLike,
        rgb: ArrayLike,
        return_std: Literal[False] = False,
    ) -> Float64: ...

    @overload
    def encode_samples(
        self,
        theta_h: ArrayLike,
        theta_d: ArrayLike,
        phi_d: ArrayLike,
        rgb: ArrayLike,
        return_std: Literal[True],
    ) -> tuple[Float64, Float64]: ...

    def encode_samples(
        self,
        theta_h: ArrayLike,
        theta_d: ArrayLike,
        phi_d: ArrayLike,
        rgb: ArrayLike,
        return_std: bool = False,
    ) -> Float64 | tuple[Float64, Float64]:
        """Find coordinates of scattered or masked measurements, within the gamut box.

        Parameters
        ----------
        theta_h, theta_d, phi_d : (n,) array_like, radians
        rgb : (n, 3) array_like
            f_r in 1/sr without the cosine; rows that are negative or not finite are left out.
        return_std : bool
            Also return the standard deviation of each coordinate. It is near 1 (the library's own)
            where the samples do not determine the coordinate.

        Returns
        -------
        z : (k,) float64
        std : (k,) float64
            Only with `return_std`.

        Notes
        -----
        Iteratively reweighted least squares, nearly the least sum of absolute deviations of log f,
        so that outliers have little influence. A ridge whose prior is the library's unit variance
        keeps near the mean what the samples do not determine; 0.1 is the assumed standard deviation
        of log f from the space.

        Raises
        ------
        ValueError
            On wrong shapes, or if no valid sample is left.
        """
        self._fitted()
        values = numbers(rgb, "rgb").astype(np.float64)
        given = {"theta_h": theta_h, "theta_d": theta_d, "phi_d": phi_d}
        angles = [numbers(a, name).astype(np.float64) for name, a in given.items()]
        if values.ndim != 2 or values.shape[1] != 3:
            raise ValueError(f"rgb: expected shape (n, 3), got {values.shape}")
        for name, a in zip(given, angles, strict=True):
            if a.shape != (len(values),):
                raise ValueError(f"{name}: expected shape ({len(values)},), got {a.shape}")
        valid = np.all(np.isfinite(values) & (values >= 0.0), axis=1)
        valid &= np.all([np.isfinite(a) for a in angles], axis=0)
        if not valid.any():
            raise ValueError(f"rgb: expected at least one valid sample, got none of {len(values)}")
        index, corner = self.grid_.stencil(*(a[valid] for a in angles))
        basis = np.einsum("nk,nkm->nm", corner, self.components_[index].astype(np.float64))
        mean = np.einsum("nk,nk->n", corner, self.mean_[index].astype(np.float64))
        target = np.log(values[valid] + FLOOR) - mean[:, None]
        # many samples of one measurement are not independent: count at most a thousand
        precision = min(1.0, 1000.0 / len(target)) / _NOISE**2
        weight = np.full(target.shape, precision)
        z: Float64 = np.zeros(self.size)
        for _ in range(_ROUNDS):
            gram, pull = np.eye(self.size), np.zeros(self.size)
            for mixing, w, t in zip(self._mixing, weight.T, target.T, strict=True):
                gram += mixing.T @ ((basis * w[:, None]).T @ basis) @ mixing
                pull += mixing.T @ (basis.T @ (w * t))
            before, z = z, np.asarray(np.linalg.solve(gram, pull), np.float64)
            if np.abs(z - before).max() < 1e-4:
                break
            away = np.abs(target - basis @ (self._mixing @ z).T)
            weight = precision * _ROBUST / np.maximum(away, _ROBUST)
        if np.any((z < self.low_) | (z > self.high_)):
            # the best point of the gamut, which the nearest one is not
            root = np.linalg.cholesky(gram)
            aim = np.linalg.solve(root, pull)
            z = scipy.optimize.lsq_linear(root.T, aim, (self.low_, self.high_)).x
        known = self.decode_values(z).astype(np.float64)
        shown = np.einsum("nk,nkc->nc", corner, known[index])
        rest = np.log(values[valid] + FLOOR) - np.log(shown + FLOOR)
        logs = log_map(known).T + self._spread(rest, *(a[valid] for a in angles))
        cells = np.bincount(index.ravel(), corner.ravel(), self.grid_.size)
        z = self._refined(z, logs, np.repeat(precision * cells[None], 3, axis=0))
        if not return_std:
            return z
        return z, np.sqrt(np.diag(np.linalg.inv(gram)))

    def _spread(self, rest: Float64, theta_h: Float64, theta_d: Float64, phi_d: Float64) -> Float32:
        """Return (3, cells) what samples add to a first guess, extended to the cells around them.

        It fades with the distance, slowest along phi_d, and is the median of fifteen samples, so
        that outliers do not spread.
        """

        def place(h: Float64, d: Float64, p: Float64) -> Float64:
            along = np.sqrt(h.ravel() * 2.0 / math.pi) * 15.0, d.ravel() * 4.0, p.ravel()
            return np.stack(along, axis=1)

        folded = np.asarray(fold_phi_d(phi_d), np.float64)
        tree = scipy.spatial.cKDTree(place(np.abs(theta_h), theta_d, folded))
        near = min(15, len(rest))
        distance, nearest = tree.query(place(*self.grid_.node_angles()), near)
        nearest = nearest.reshape(-1, near)
        fade = np.exp(-(distance.reshape(-1, near)[:, 0] ** 2))
        middle = np.clip(np.median(rest[nearest], axis=1), -1.0, 1.0)
        spread = middle * fade[:, None]
        return np.ascontiguousarray(spread.T, np.float32)

    def clip(self, z: ArrayLike) -> Float64:
        """Return the nearest point in the gamut box.

        Parameters
        ----------
        z : (k,) array_like

        Returns
        -------
        (k,) float64

        Raises
        ------
        ValueError
            If `z` is not k finite numbers.
        """
        return np.clip(self.as_coordinates(z), self.low_, self.high_)

    def decode_values(
        self, z: ArrayLike, offset: Float32 | None = None, cells: ArrayLike | None = None
    ) -> Float32:
        """Decode f_r at cells of the grid: positive, and with albedo <= 1.

        `z` is clipped to the gamut box; where the directional albedo of any colour at any of the 16
        check angles exceeds 1, all colours are divided by it.

        Parameters
        ----------
        z : (k,) array_like
        offset : (cells, 3) float32, optional
            Added to log(f + FLOOR): what a given table has beyond the space. Always for the whole
            grid.
        cells : (n,) integers, optional
            Flat indices of the cells to decode, in any order; all of them if left out. The energy
            check reads the cells that it needs (three quarters of the grid) in either case, so
            values are those of the whole table, to float32 rounding.

        Returns
        -------
        (n, 3) float32, in 1/sr

        Raises
        ------
        ValueError
            On a wrong shape, coordinates that are not finite, or an index outside the grid.
        """
        values, albedo = self._decode(z, offset)
        if cells is not None:
            values = values.take(self._cell_indices(cells), axis=1)
        shown: Float32 = np.ascontiguousarray(values.T)
        if albedo > 1.0:
            shown /= np.float32(albedo * _MARGIN)
        return shown

    def energy_scale(self, z: ArrayLike, offset: Float32 | None = None) -> float:
        """Return the factor in (0, 1] by which `decode_values` lowers f to conserve energy.

        Below 1 the shown material is darker than its coordinates say, and its traits are less
        pronounced than their scores.

        Parameters
        ----------
        z, offset
            As for `decode_values`.
        """
        return min(1.0, 1.0 / max(self._decode(z, offset)[1], 1e-30))

    def jacobian(
        self, z: ArrayLike, offset: Float32 | None = None, cells: ArrayLike | None = None
    ) -> Float32:
        """Differentiate `decode_values` by the coordinates, in closed form.

        The slope of the energy scaling is included where that is active.

        Parameters
        ----------
        z, offset, cells
            As for `decode_values`.

        Returns
        -------
        (n, 3, k) float32, in 1/sr

        Notes
        -----
        `decode_values` has kinks; there the slope is that of one side or of the mean:

        - A coordinate outside the gamut box changes nothing (`z` is clipped): its column is 0. On
        the face
          of the box the column is the slope towards the inside.
        - Where f before the energy scaling is held at 0, or at the upper bound of 1e13, that has
        slope 0;
          exactly on these kinks, the slope of the side on which it moves.
        - The energy scaling follows the greatest albedo. Where several are greatest to 1e-6 (the
        three
          colours of a grey material) it is the mean of their slopes, so that no colour is favoured.
          Where the greatest is exactly 1, f counts as not scaled.

        Raises
        ------
        ValueError
            On a wrong shape, coordinates that are not finite, or an index outside the grid.
        """
        point = self.as_coordinates(z)
        clipped = self.clip(point)
        self._check_offset(offset)
        logs, source, share, first = self.profiles_.sources(self._logs(clipped))
        if offset is not None:
            logs += offset.T
        index = slice(None) if cells is None else self._cell_indices(cells)
        slope = log_slope(logs)
        albedo = reflectance(np, logs.copy()) @ self._check
        greatest = float(albedo.max())
        scale = 1.0 / (greatest * _MARGIN) if greatest > 1.0 else 1.0
        result = np.stack(
            [
                self._log_slopes(c, source[c][index], share[c][index], first[c])
                * (slope[c][index, None] * np.float32(scale))
                for c in range(3)
            ],
            axis=1,
        )
        if greatest > 1.0:
            tied = tied_albedo(albedo)
            weight = (tied / np.float32(tied.sum())) @ self._check.T * slope
            rise = np.sum(
                [weight[c] @ self._log_slopes(c, source[c], share[c], first[c]) for c in range(3)],
                axis=0,
            )
            values = reflectance(np, logs[:, index]) * np.float32(scale / greatest)
            result -= values.T[..., None] * rise.astype(np.float32)
        result[..., point != clipped] = 0.0
        return result

    def _log_slopes(self, colour: int, source: Int64, share: Float32, first: Int64) -> Float32:
        """Return d log(f + FLOOR) / d z (n, k) of one colour.

        The cells are those from which `Profiles.sources` says values come.
        """
        rows = self.components_.take(source, axis=0)
        some = np.flatnonzero(share)
        if len(some):
            last = self.profiles_.last
            own = source[some] % len(last)
            trend = self.components_[last[own] * len(last) + own] - self.components_[first[own]]
            rows[some] += share[some, None] * trend
        slopes: Float32 = product(rows, self._mixing[colour].astype(np.float32))
        return slopes

    def decode_tensor(
        self,
        z: torch.Tensor,
        offset: Float32 | torch.Tensor | None = None,
        cells: ArrayLike | None = None,
    ) -> torch.Tensor:
        """Decode as `decode_values` does, in torch, on the device and in the precision of `z`.

        The result is differentiable. Its gradient by `z` is `jacobian`, with the same choices at
        the kinks; an `offset` that requires a gradient gets one.

        Parameters
        ----------
        z : (k,) tensor, float32 or float64
            Not checked for coordinates that are not finite, since that would wait for the device:
            they give NaN.
        offset : (cells, 3) array or tensor, optional
        cells : (n,) integers, optional
            As for `decode_values`; in host memory.

        Returns
        -------
        (n, 3) tensor, in 1/sr

        Raises
        ------
        ValueError
            On a wrong shape or precision, or an index outside the grid.
        """
        import torch

        self._fitted()
        if z.shape != (self.size,):
            raise ValueError(f"z: expected shape ({self.size},), got {tuple(z.shape)}")
        if z.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"z: expected float32 or float64, got {z.dtype}")
        self._check_offset(offset)
        if offset is not None:
            # arrays are copied here: torch warns of sharing one that is read-only
            whole = offset if isinstance(offset, torch.Tensor) else torch.tensor(offset)
            offset = whole.to(z)
        on = self._on(z.device, z.dtype)
        span = on.mixing @ torch.clamp(z, on.low, on.high) @ on.basis + on.mean
        logs = self.profiles_.keep(span)
        if offset is not None:
            logs = logs + offset.T
        f = reflectance(torch, logs)
        albedo = f @ on.check
        tied = tied_albedo(albedo)
        greatest = torch.where(tied, albedo, 0.0).sum() / tied.sum()
        if cells is not None:
            f = f[:, torch.tensor(self._cell_indices(cells), device=z.device)]
        scaled: torch.Tensor = f.T / torch.where(greatest > 1.0, greatest * _MARGIN, 1.0)
        return scaled

    def _on(self, device: torch.device, dtype: torch.dtype) -> _Tensors:
        """Return the fitted state as tensors, and keep them (2 MB for the default embedding)."""
        import torch

        key = (device, dtype)
        if key not in self._tensors:

            def tensor(array: NDArray[Any], dtype: torch.dtype = dtype) -> torch.Tensor:
                return torch.tensor(array, dtype=dtype, device=device)

            # tensors made in inference mode could not be differentiated through later
            with torch.inference_mode(False):
                self._tensors[key] = _Tensors(
                    tensor(self._basis),
                    tensor(self.mean_),
                    tensor(self._check),
                    tensor(self._mixing),
                    tensor(self.low_),
                    tensor(self.high_),
                )
        return self._tensors[key]

    def _cell_indices(self, cells: ArrayLike) -> NDArray[np.int64]:
        index = np.asarray(cells)
        if index.ndim != 1 or index.dtype.kind not in "iu":
            raise ValueError(
                f"cells: expected integers of shape (n,), got {index.dtype} of shape {index.shape}"
            )
        # a negative index would count from the end, and a large one is lost on a device
        if index.size and (index.min() < 0 or index.max() >= self.grid_.size):
            raise ValueError(
                f"cells: expected indices in [0, {self.grid_.size}), "
                f"got {index.min()} to {index.max()}"
            )
        return index.astype(np.int64, copy=False)

    def _check_offset(self, offset: Float32 | torch.Tensor | None) -> None:
        expected = (self.grid_.size, 3)
        if offset is not None and offset.shape != expected:
            raise ValueError(f"offset: expected shape {expected}, got {tuple(offset.shape)}")

    def _logs(self, z: ArrayLike) -> Float32:
        """Return log(f + FLOOR) (3, cells) of the linear space, before profiles are corrected."""
        scores = (self._mixing @ self.clip(z)).astype(np.float32)
        logs: Float32 = product(scores, self._basis)
        logs += self.mean_
        return logs

    def _decode(self, z: ArrayLike, offset: Float32 | None) -> tuple[Float32, float]:
        """Return f (3, cells) before its energy check, and its greatest directional albedo."""
        span = self._logs(z)
        self._check_offset(offset)
        logs: Float32 = self.profiles_.keep(span)
        if offset is not None:
            logs += offset.T
        values: Float32 = reflectance(np, logs, out=logs)
        return values, float(product(values, self._check).max())

    def residual(self, brdf: TabulatedBRDF, z: ArrayLike | None = None) -> Float32:
        """Return the difference of log(f + FLOOR) between a table and its encoding.

        ``decode_values(encode(brdf), residual(brdf))`` is the table itself.

        Parameters
        ----------
        brdf : TabulatedBRDF
        z : (k,) array_like, optional
            A point that takes the place of the table's encoding.

        Returns
        -------
        (cells, 3) float32
        """
        self._fitted()
        table = brdf.regrid(self.grid_)
        decoded = self.profiles_.keep(self._logs(self.encode(table) if z is None else z)).T
        return np.asarray(log_map(table.values).reshape(-1, 3) - decoded, np.float32)

    def body_rows(self) -> Float64:
        """Return rows that give the mean log f of the body on the colour axes, up to a constant.

        The body is what is seen between 35 and 50 degrees from the mirror direction's half vector,
        far from grazing; log f is linear in the coordinates, so this is exact.

        Returns
        -------
        (3, k) float64
        """
        self._fitted()
        th, td, _ = self.grid_.node_angles()
        h, d = np.degrees(th), np.degrees(td)
        body = ((h > 35.0) & (h < 50.0) & (d > 2.0) & (d < 25.0)).ravel()
        row = self.components_[body].mean(axis=0).astype(np.float64)
        return np.asarray(OPPONENT @ (row @ self._mixing), np.float64)

    def log_rows(self, cells: ArrayLike) -> tuple[Float64, Float64]:
        """Return log(f + FLOOR) at cells as a linear function of the coordinates.

        It is ``rows @ z + constants``, before profiles are corrected and energy is checked.

        Parameters
        ----------
        cells : (n,) integers
            Flat indices of cells of `grid_`.

        Returns
        -------
        rows : (3, n, k) float64
        constants : (n,) float64

        Raises
        ------
        ValueError
            On an index outside the grid.
        """
        at = self._cell_indices(cells)
        rows = np.einsum("nm,cmk->cnk", self.components_[at].astype(np.float64), self._mixing)
        return rows, self.mean_[at].astype(np.float64)

    def decode(self, z: ArrayLike, grid: HalfDiffGrid | None = None) -> TabulatedBRDF:
        """Decode a table.

        Parameters
        ----------
        z : (k,) array_like
        grid : HalfDiffGrid, optional
            The table's grid; the embedding's own if left out.

        Raises
        ------
        ValueError
            If `z` is not k finite numbers.
        """
        values = self.decode_values(z).reshape(*self.grid_.shape, 3)
        table = TabulatedBRDF(self.grid_, values)
        return table if grid is None else table.regrid(grid)

    def fingerprint(self) -> str:
        """Return a name of the state: coordinates of another embedding mean other materials."""
        state = sorted(self.arrays().items())
        whole = b"".join(n.encode() + np.ascontiguousarray(v).tobytes() for n, v in state)
        return hashlib.sha256(whole).hexdigest()[:16]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the fitted state as plain arrays.

        Components are rounded to float16 (an error of 1e-3 of f).
        """
        self._fitted()
        return {
            "grid": np.array(self.grid_.shape),
            "n_components": np.array(self.n_components),
            "mean": self.mean_,
            "components": self.components_.astype(np.float16),
            "share": self.profiles_.share.astype(np.float16),
            "grazing": self.profiles_.grazing.astype(np.float16),
            "low": self.low_,
            "high": self.high_,
            "explained_variance_ratio": self.explained_variance_ratio_,
        }

    @classmethod
    def from_arrays(cls, state: dict[str, NDArray[Any]]) -> BRDFEmbedding:
        """Make an embedding from its arrays, the inverse of `arrays`.

        Parameters
        ----------
        state : dict of arrays
        """
        components = state["components"].astype(np.float32)
        achromatic, chromatic = (int(n) for n in state["n_components"])
        result = cls((achromatic, chromatic))
        n_h, n_d, n_p = (int(n) for n in state["grid"])
        result.grid_ = HalfDiffGrid(n_h, n_d, n_p, "folded")
        result.weight_ = cell_weight(result.grid_)
        result.mean_ = state["mean"].astype(np.float32)
        result.components_ = np.ascontiguousarray(components)
        result.low_ = state["low"].astype(np.float64)
        result.high_ = state["high"].astype(np.float64)
        result.explained_variance_ratio_ = state["explained_variance_ratio"].astype(np.float64)
        result.profiles_ = replace(
            Profiles.none(result.grid_),
            share=state["share"].astype(np.float32),
            grazing=state["grazing"].astype(np.float32),
        )
        result._prepare()
        return result
