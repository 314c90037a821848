"""The embedding: BRDFs as points of a low-dimensional space (after Matusik et al. 2003).

A table's values are mapped by y = log(f + FLOOR). Matusik et al. ("A Data-Driven Reflectance
Model", SIGGRAPH 2003) take one vector of all colours for each material; here the mean of the three
channels' logarithms and their differences (red against blue, green against magenta) are embedded
apart, by two PCAs: materials differ in many ways in shape and in few in colour. With m = (14, 5)
components a material has k = 24 coordinates: 14 achromatic ones first, then 5 for red against blue,
then 5 for green against magenta; each axis is scaled to unit variance.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Literal, NamedTuple, overload

import numpy as np
import scipy.optimize
import torch
from numpy.typing import ArrayLike, NDArray

from traitbrdf.brdf import ALBEDO_ANGLES, HalfDiffGrid, Reflectance, TabulatedBRDF, albedo_operator
from traitbrdf.formats import artifact, unknown_name

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]

FLOOR = 1e-3
"""Added to f (1/sr) before the logarithm: below it a BRDF is black to the eye."""

GRID = HalfDiffGrid(90, 24, 9, "folded")
"""The grid on which the library lives and frames are decoded."""

OPPONENT = np.array(
    [
        [1.0, 1.0, 1.0] / np.sqrt(3.0),
        [1.0, 0.0, -1.0] / np.sqrt(2.0),
        [-1.0, 2.0, -1.0] / np.sqrt(6.0),
    ]
)
"""Orthonormal rows: mean of the channels, red against blue, green against magenta."""

_CAP = 30.0
"""Where log(f + FLOOR) ends: no BRDF reaches 1e13, and exp must not overflow."""

_MARGIN = 1.0 + 1e-6
"""What scaled tables stay below albedo 1 by, so that rounding does not lift them above it."""

_BATCH = 128
"""Materials that are held in memory at once while fitting."""

_NOISE = 0.1
"""Assumed deviation of log f from the manifold, where samples are encoded."""

_ROUNDS = 25
"""At most so many times are the weights of samples found anew."""

_ROBUST = 0.03
"""Deviation of log f beyond which a sample counts less, as the inverse of it: what is nearly the
least sum of absolute deviations follows most samples, not the worst."""

_TIE = 1e-6
"""Relative distance at which two albedos count as equal: the channels of a grey material."""


class _Rows(NamedTuple):
    """The basis at some cells, as arrays or as tensors; colours first, which is the faster way.

    index : (n,) flat cell indices, or slice(None)
    basis : (m, n)
    mean : (n,)
    """

    index: Any
    basis: Any
    mean: Any

    def logs(self, scores: Any, offset: Any) -> Any:
        """log(f + FLOOR) (3, n) of channel scores (3, m), with an offset (cells, 3) or None."""
        logs = _product(scores, self.basis)
        logs += self.mean
        if offset is not None:
            whole = isinstance(self.index, slice) or isinstance(offset, torch.Tensor)
            # numpy's take of rows is ten times as fast as its indexing
            logs += (offset[self.index] if whole else offset.take(self.index, axis=0)).T
        return logs


def _product(a: Any, b: Any) -> Any:
    """a @ b of arrays or tensors, by torch: numpy's threads spin for milliseconds after a product,
    and those of the next one, which is torch's, wait for the same cores."""
    if isinstance(a, torch.Tensor):
        return a @ b
    return torch.mm(torch.from_numpy(a), torch.from_numpy(b)).numpy()


class _Tensors(NamedTuple):
    """What `BRDFEmbedding.decode_tensor` needs, on one device and in one precision."""

    every: _Rows
    checked: _Rows
    check: torch.Tensor
    low: torch.Tensor
    high: torch.Tensor
    mixing: torch.Tensor


class BRDFEmbedding:
    """Log-mapped PCA of tabulated BRDFs.

    Parameters
    ----------
    n_components : (int, int)
        Components of the mean of the channels, and of each of the two colour axes: (14, 5) makes
        14 + 2 * 5 coordinates. One number stands for both.

    Attributes
    ----------
    grid_ : HalfDiffGrid
    mean_ : (cells,) float32, mean of log(f + FLOOR)
    components_ : (cells, m) float32, those of the mean of the channels first
    weight_ : (cells,) float32
        What a cell counts in the fit: the square root of the lower cosine, 0 below the horizon.
    low_, high_ : (k,) float64
        The gamut box: the range of the library's coordinates.
    explained_variance_ratio_ : (m,) float64, of the whole variance
    """

    def __init__(self, n_components: int | tuple[int, int] = (14, 5)) -> None:
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
        self._mixing = _mixing(self.n_components)

    def fit(self, tables: Iterable[TabulatedBRDF]) -> BRDFEmbedding:
        """Fit to a library of at least two tables on one grid; returns self.

        Parameters
        ----------
        tables : iterable of TabulatedBRDF
            Anything but an iterator may be larger than memory: it is gone through seven times, and
            128 tables are held at once.

        Raises
        ------
        ValueError
            If there are too few tables, of several grids, or too alike.
        """
        if isinstance(tables, Iterator):
            tables = list(tables)
        self.__dict__.pop("components_", None)  # a fit that fails leaves none
        self.grid_, count = _checked_grid(tables)
        achromatic, chromatic = self.n_components
        if count <= max(achromatic, chromatic):
            raise ValueError(
                f"n_components: expected fewer than the {count} tables of the library, "
                f"got {self.n_components}"
            )
        self.weight_ = _cell_weight(self.grid_)
        total = np.zeros(self.grid_.size)
        for logs in _batches(tables):
            total += logs.sum(axis=(0, 1))
        self.mean_ = (total / (3 * count)).astype(np.float32)
        grey = self._axes(tables, slice(0, 1), achromatic, count)
        # both signs: the mean is grey, whatever colours the library prefers
        colour = self._axes(tables, slice(1, 3), chromatic, count)
        self.components_ = np.concatenate([grey[0], colour[0]], axis=1)
        variance = np.concatenate([grey[1], 2.0 * colour[1]])
        self.explained_variance_ratio_ = variance / (grey[2] + 2.0 * colour[2])
        self._prepare()
        encoded = (self.encode(table) for table in tables)
        coordinates = np.stack(list(encoded))
        self.low_, self.high_ = coordinates.min(axis=0), coordinates.max(axis=0)
        return self

    def _axes(
        self, tables: Iterable[TabulatedBRDF], axes: slice, count: int, materials: int
    ) -> tuple[Float32, Float64, float]:
        """Components (cells, count) of some of the three colour axes, their variances, and the
        variance in all."""
        from sklearn.decomposition import IncrementalPCA  # slow to import, and needed only here

        offset = math.sqrt(3.0) * self.mean_ if axes.start == 0 else np.float32(0.0)

        def rows() -> Iterator[Float32]:
            for logs in _batches(tables):
                turned = np.einsum("ac,ncx->nax", OPPONENT[axes].astype(np.float32), logs) - offset
                yield turned.reshape(-1, logs.shape[2])

        signs = 1 if axes.start == 0 else 2
        some = min(materials, _BATCH) * (axes.stop - axes.start) * signs
        pca = IncrementalPCA(min(4 * count + 16, some, self.grid_.size))
        for batch in rows():
            weighted = batch * self.weight_
            with np.errstate(invalid="ignore", divide="ignore"):  # shares of no variance at all
                pca.partial_fit(np.concatenate([weighted, -weighted]) if signs == 2 else weighted)
        variance = np.asarray(pca.explained_variance_[:count], np.float64)
        deviation = np.sqrt(variance)
        if deviation.min() <= 1e-5 * max(1.0, float(deviation.max())):
            raise ValueError(
                f"tables: expected at least {count + 1} different ones on every colour axis, "
                f"got tables that span {int(np.sum(deviation > 1e-5))} dimensions of one"
            )
        # loadings by regression on the scores, so that cells below the horizon have them too
        gram = np.zeros((count, count))
        cross = np.zeros((count, self.grid_.size))
        for batch in rows():
            scores = (batch * self.weight_) @ pca.components_[:count].T / deviation
            gram += scores.T @ scores
            cross += scores.T @ batch
        loadings = np.linalg.solve(gram, cross).T
        total = float(np.sum(pca.var_))
        shares = np.asarray(pca.explained_variance_ratio_[:count], np.float64)
        return np.ascontiguousarray(loadings, np.float32), total * shares, total

    def _prepare(self) -> None:
        """What follows from the fitted state: the projection and the albedo check."""
        squared = (self.weight_.astype(np.float64) ** 2)[:, None]
        self._project = []
        for own in np.split(self.components_.astype(np.float64), [self.n_components[0]], axis=1):
            weighted = own * squared
            self._project.append(np.linalg.solve(weighted.T @ own, weighted.T))
        self._albedo = albedo_operator(self.grid_, ALBEDO_ANGLES).astype(np.float32)
        # the energy check by itself, for when only some cells are decoded: three quarters of the
        # grid, so a dense product is faster than the sparse one
        checked = np.unique(self._albedo.indices)
        self._check: Float32 = np.ascontiguousarray(self._albedo[:, checked].toarray().T)
        self._every = _Rows(slice(None), np.ascontiguousarray(self.components_.T), self.mean_)
        self._checked = _Rows(
            checked, np.ascontiguousarray(self.components_[checked].T), self.mean_[checked]
        )
        fan = self._mixing.transpose(1, 0, 2).reshape(self.components_.shape[1], -1)
        self._fan = np.ascontiguousarray(fan, np.float32)
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
        """`z` as a finite (k,) array.

        Raises
        ------
        ValueError
        """
        self._fitted()
        value = np.asarray(z, np.float64)
        if value.shape != (self.size,):
            raise ValueError(f"z: expected shape ({self.size},), got {value.shape}")
        if not np.isfinite(value).all():
            raise ValueError(f"z: expected finite coordinates, got {value!r}")
        return value

    def encode(self, brdf: Reflectance) -> Float64:
        """Coordinates (k,) of a table on any grid, or of a model; not clipped to the gamut.

        Raises
        ------
        TypeError
            On something that has no ``eval``.
        """
        self._fitted()
        if not callable(getattr(brdf, "eval", None)):
            raise TypeError(f"brdf: expected a table or a model with an eval method, got {brdf!r}")
        if isinstance(brdf, TabulatedBRDF):
            table = brdf.regrid(self.grid_)
        else:
            table = TabulatedBRDF.from_model(brdf, self.grid_)
        logs = _log_map(table.values).reshape(-1, 3) - self.mean_[:, None]
        grey, red_blue, green = (logs @ OPPONENT.T).T
        achromatic, chromatic = self._project
        return np.concatenate([achromatic @ grey, chromatic @ red_blue, chromatic @ green])

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
        """Coordinates (k,) of scattered or masked measurements, within the gamut box.

        Parameters
        ----------
        theta_h, theta_d, phi_d : (n,) array_like, radians
        rgb : (n, 3) array_like
            f_r in 1/sr without the cosine; rows that are negative or not finite are left out.
        return_std : bool
            Also return the standard deviation (k,) of each coordinate: near 1 (the library's own)
            where the samples say nothing of it.

        Notes
        -----
        Outliers among the samples count little: iteratively reweighted least squares, nearly the
        least sum of absolute deviations of log f. A ridge whose prior is the library's unit
        variance keeps what the samples do not determine near the mean; 0.1 is the assumed deviation
        of log f from the manifold.

        Raises
        ------
        ValueError
            On wrong shapes, or if no valid sample is left.
        """
        self._fitted()
        values = np.asarray(rgb, np.float64)
        angles = [np.asarray(a, np.float64) for a in (theta_h, theta_d, phi_d)]
        if values.ndim != 2 or values.shape[1] != 3:
            raise ValueError(f"rgb: expected shape (n, 3), got {values.shape}")
        for name, a in zip(("theta_h", "theta_d", "phi_d"), angles, strict=True):
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
        if not return_std:
            return z
        return z, np.sqrt(np.diag(np.linalg.inv(gram)))

    def clip(self, z: ArrayLike) -> Float64:
        """The nearest point (k,) in the gamut box."""
        return np.clip(self.as_coordinates(z), self.low_, self.high_)

    def decode_values(
        self, z: ArrayLike, offset: Float32 | None = None, cells: ArrayLike | None = None
    ) -> Float32:
        """f_r (n, 3) in 1/sr at cells of the grid, float32: positive and with albedo <= 1.

        `z` is clipped to the gamut box; where the directional albedo of any colour at any of the
        16 check angles exceeds 1, all colours are divided by it.

        Parameters
        ----------
        z : (k,) array_like
        offset : (cells, 3) float32, optional
            Added to log(f + FLOOR): what a given table has beyond the manifold. Always for the
            whole grid.
        cells : (n,) integers, optional
            Flat indices of the cells to decode, in any order; all of them if left out. The
            energy check reads the cells that it needs (three quarters of the grid) in either
            case, so values are those of the whole table, to float32 rounding.

        Raises
        ------
        ValueError
            On a wrong shape, coordinates that are not finite, or an index outside the grid.
        """
        values, albedo = self._decode(z, offset, cells)
        if albedo > 1.0:
            values /= np.float32(albedo * _MARGIN)
        return values

    def energy_scale(self, z: ArrayLike, offset: Float32 | None = None) -> float:
        """The factor in (0, 1] by which `decode_values` lowers f to keep the albedo within 1.

        1 where nothing is lowered. Below that the shown material is darker than its coordinates
        say, and its traits are less pronounced than their scores.
        """
        return min(1.0, 1.0 / max(self._decode(z, offset)[1], 1e-30))

    def jacobian(
        self, z: ArrayLike, offset: Float32 | None = None, cells: ArrayLike | None = None
    ) -> Float32:
        """d f / d z (n, 3, k) in 1/sr, float32, of what `decode_values` returns at `cells`.

        In closed form, with the slope of the energy scaling where that is active.

        Parameters
        ----------
        z, offset, cells
            As for `decode_values`.

        Notes
        -----
        `decode_values` has kinks; there the slope is that of one side or of the mean:

        - A coordinate outside the gamut box moves nothing (`z` is clipped): its column is 0. On
          the face of the box the column is the slope towards the inside.
        - Where f before the energy scaling is held at 0, or at the cap of 1e13, that has slope
          0; exactly on these kinks, the slope of the side on which it moves.
        - The energy scaling follows the greatest albedo. Where several are greatest to 1e-6
          (the three colours of a grey material) it is the mean of their slopes, so that no
          colour is favoured. Where the greatest is exactly 1, f counts as not scaled.

        Raises
        ------
        ValueError
            On a wrong shape, coordinates that are not finite, or an index outside the grid.
        """
        point = self.as_coordinates(z)
        clipped = self.clip(point)
        self._check_offset(offset)
        rows = self._rows(cells)
        scores = (self._mixing @ clipped).astype(np.float32)
        logs = rows.logs(scores, offset)
        albedo = self._check_albedos(scores, offset)
        greatest = float(albedo.max())
        scale = 1.0 / (greatest * _MARGIN) if greatest > 1.0 else 1.0
        # d log(f + FLOOR) of colour c by a coordinate is the sum of mixing[c, m] basis[m]
        result: Float32 = (rows.basis.T @ self._fan).reshape(-1, 3, self.size)
        result *= (_slope(logs) * np.float32(scale)).T[..., None]
        if greatest > 1.0:
            tied = _tied(albedo)
            weight = (tied / np.float32(tied.sum())) @ self._check.T
            weight *= _slope(self._checked.logs(scores, offset))
            by_score = (self._checked.basis @ weight.T).T[..., None]
            rise = np.sum(by_score * self._mixing, axis=(0, 1)).astype(np.float32)
            values = _reflectance(np, logs, out=logs) * np.float32(scale / greatest)
            result -= values.T[..., None] * rise
        result[..., point != clipped] = 0.0
        return result

    def decode_tensor(
        self,
        z: torch.Tensor,
        offset: Float32 | torch.Tensor | None = None,
        cells: ArrayLike | None = None,
    ) -> torch.Tensor:
        """`decode_values` in torch, on the device and in the precision of `z`; differentiable.

        Its gradient by `z` is `jacobian`, with the same choices at the kinks, and it passes to
        an `offset` that requires one.

        Parameters
        ----------
        z : (k,) tensor, float32 or float64
            Not checked for coordinates that are not finite (a device would have to be waited
            for): they give NaN.
        offset : (cells, 3) array or tensor, optional
        cells : (n,) integers, optional
            As for `decode_values`; on the host.

        Returns
        -------
        (n, 3) tensor

        Raises
        ------
        ValueError
            On a wrong shape or precision, or an index outside the grid.
        """
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
        rows = on.every
        if cells is not None:
            index = torch.tensor(self._cell_indices(cells), device=z.device)
            rows = _Rows(index, rows.basis[:, index], rows.mean[index])
        scores = on.mixing @ torch.clamp(z, on.low, on.high)
        values = _reflectance(torch, rows.logs(scores, offset)).T
        albedo = _reflectance(torch, on.checked.logs(scores, offset)) @ on.check
        tied = _tied(albedo)
        greatest = torch.where(tied, albedo, 0.0).sum() / tied.sum()
        scaled: torch.Tensor = values / torch.where(greatest > 1.0, greatest * _MARGIN, 1.0)
        return scaled

    def _on(self, device: torch.device, dtype: torch.dtype) -> _Tensors:
        """The fitted state as tensors, kept: 2 MB in float32 for the default embedding."""
        key = (device, dtype)
        if key not in self._tensors:

            def tensor(array: NDArray[Any], dtype: torch.dtype = dtype) -> torch.Tensor:
                return torch.tensor(array, dtype=dtype, device=device)

            # tensors made in inference mode could not be differentiated through later
            with torch.inference_mode(False):
                self._tensors[key] = _Tensors(
                    _Rows(slice(None), tensor(self._every.basis), tensor(self._every.mean)),
                    _Rows(
                        tensor(self._checked.index, torch.int64),
                        tensor(self._checked.basis),
                        tensor(self._checked.mean),
                    ),
                    tensor(self._check),
                    tensor(self.low_),
                    tensor(self.high_),
                    tensor(self._mixing),
                )
        return self._tensors[key]

    def _rows(self, cells: ArrayLike | None) -> _Rows:
        if cells is None:
            return self._every
        index = self._cell_indices(cells)
        return _Rows(index, self.components_.take(index, axis=0).T, self.mean_[index])

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

    def _decode(
        self, z: ArrayLike, offset: Float32 | None, cells: ArrayLike | None = None
    ) -> tuple[Float32, float]:
        """f (n, 3) before its energy is checked, and its greatest directional albedo."""
        scores = (self._mixing @ self.clip(z)).astype(np.float32)
        self._check_offset(offset)
        logs = self._rows(cells).logs(scores, offset)
        values: Float32 = np.ascontiguousarray(_reflectance(np, logs, out=logs).T)
        if cells is None:
            return values, float((self._albedo @ values).max())
        return values, float(self._check_albedos(scores, offset).max())

    def _check_albedos(self, scores: Float32, offset: Float32 | None) -> Float32:
        """Directional albedos (3, 16) of channel scores (3, m), before the energy scaling."""
        logs = self._checked.logs(scores, offset)
        albedo: Float32 = _product(_reflectance(np, logs, out=logs), self._check)
        return albedo

    def residual(self, brdf: TabulatedBRDF) -> Float32:
        """(cells, 3) difference of log(f + FLOOR) between a table and its encoding.

        ``decode_values(encode(brdf), residual(brdf))`` is the table itself.
        """
        self._fitted()
        table = brdf.regrid(self.grid_)
        scores = (self._mixing @ self.clip(self.encode(table))).astype(np.float32)
        decoded = self._every.logs(scores, None).T
        return np.asarray(_log_map(table.values).reshape(-1, 3) - decoded, np.float32)

    def body_rows(self) -> Float64:
        """(3, k) rows that give, to a constant, the mean log f of the body on the colour axes.

        The body is what is seen between 35 and 50 degrees from the mirror direction's half
        vector, far from grazing; log f is linear in the coordinates, so this is exact.
        """
        self._fitted()
        th, td, _ = self.grid_.node_angles()
        h, d = np.degrees(th), np.degrees(td)
        body = ((h > 35.0) & (h < 50.0) & (d > 2.0) & (d < 25.0)).ravel()
        row = self.components_[body].mean(axis=0).astype(np.float64)
        return np.asarray(OPPONENT @ (row @ self._mixing), np.float64)

    def decode(self, z: ArrayLike, grid: HalfDiffGrid | None = None) -> TabulatedBRDF:
        """The table at coordinates `z` (k,), on the embedding's grid or any other."""
        values = self.decode_values(z).reshape(*self.grid_.shape, 3)
        table = TabulatedBRDF(self.grid_, values)
        return table if grid is None else table.regrid(grid)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The fitted state as plain arrays, components in float16 (their error is 1e-3 of f)."""
        self._fitted()
        return {
            "grid": np.array(self.grid_.shape),
            "n_components": np.array(self.n_components),
            "mean": self.mean_,
            "components": self.components_.astype(np.float16),
            "low": self.low_,
            "high": self.high_,
            "explained_variance_ratio": self.explained_variance_ratio_,
        }

    @classmethod
    def from_arrays(cls, state: dict[str, NDArray[Any]]) -> BRDFEmbedding:
        """The inverse of `arrays`."""
        components = state["components"].astype(np.float32)
        achromatic, chromatic = (int(n) for n in state["n_components"])
        result = cls((achromatic, chromatic))
        n_h, n_d, n_p = (int(n) for n in state["grid"])
        result.grid_ = HalfDiffGrid(n_h, n_d, n_p, "folded")
        result.weight_ = _cell_weight(result.grid_)
        result.mean_ = state["mean"].astype(np.float32)
        result.components_ = np.ascontiguousarray(components)
        result.low_ = state["low"].astype(np.float64)
        result.high_ = state["high"].astype(np.float64)
        result.explained_variance_ratio_ = state["explained_variance_ratio"].astype(np.float64)
        result._prepare()
        return result


def _log_map(values: NDArray[Any]) -> Float32:
    logs: Float32 = np.log(np.asarray(values, np.float32) + np.float32(FLOOR))
    return logs


def _mixing(n_components: tuple[int, int]) -> Float64:
    """(3, m, k): what a coordinate gives to each channel's scores on the m components."""
    achromatic, chromatic = n_components
    result = np.zeros((3, achromatic + chromatic, achromatic + 2 * chromatic))
    grey, red_blue, green = OPPONENT
    result[:, :achromatic, :achromatic] = grey[:, None, None] * np.eye(achromatic)
    middle = achromatic + chromatic
    result[:, achromatic:, achromatic:middle] = red_blue[:, None, None] * np.eye(chromatic)
    result[:, achromatic:, middle:] = green[:, None, None] * np.eye(chromatic)
    return result


def _checked_grid(tables: Iterable[TabulatedBRDF]) -> tuple[HalfDiffGrid, int]:
    """The grid of tables that can be fitted to, and their number."""
    grid, count = None, 0
    for table in tables:
        if grid is None:
            grid = table.grid
        elif table.grid != grid:
            raise ValueError("tables: expected all on one grid, got several")
        count += 1
    if grid is None or count < 2:
        raise ValueError(f"tables: expected at least two, got {count}")
    if grid.layout != "folded":
        raise ValueError(f"tables: expected the 'folded' layout, got {grid.layout!r}")
    return grid, count


def _batches(tables: Iterable[TabulatedBRDF]) -> Iterator[Float32]:
    """log(f + FLOOR) (n, 3, cells) of some tables at a time."""
    waiting: list[Float32] = []
    for table in tables:
        waiting.append(_log_map(table.values).reshape(-1, 3).T)
        if len(waiting) == _BATCH:
            yield np.stack(waiting)
            waiting.clear()
    if waiting:
        yield np.stack(waiting)


def _reflectance(xp: Any, logs: Any, out: Any = None) -> Any:
    """f from log(f + FLOOR); `xp` is numpy or torch. `out=logs` spares numpy the copies."""
    raised = xp.exp(xp.clip(logs, None, _CAP, out=out), out=out)
    return xp.clip(xp.subtract(raised, FLOOR, out=out), 0.0, None, out=out)


def _slope(logs: Float32) -> Float32:
    """d f / d log(f + FLOOR): f + FLOOR, or 0 beyond the kinks of `_reflectance`."""
    raised = np.exp(np.minimum(logs, _CAP))
    return np.where((raised >= FLOOR) & (logs <= _CAP), raised, np.float32(0.0))


def _tied(albedo: Any) -> Any:
    """Which albedos (3, 16) are the greatest; arrays or tensors."""
    return albedo >= (1.0 - _TIE) * albedo.max()


def _cell_weight(grid: HalfDiffGrid) -> Float32:
    return np.asarray(np.sqrt(np.maximum(grid.lower_cosine, 0.0)).ravel(), np.float32)


class Library:
    """Named materials as points of an embedding.

    Attributes
    ----------
    names, families : tuples of str
    coordinates : (n, k) float64
    """

    def __init__(
        self,
        embedding: BRDFEmbedding,
        names: Sequence[str],
        coordinates: ArrayLike,
        families: Sequence[str],
    ) -> None:
        self.embedding = embedding
        self.names = tuple(names)
        self.families = tuple(families)
        self.coordinates = np.asarray(coordinates, np.float64)
        if self.coordinates.shape != (len(self.names), embedding.size):
            raise ValueError(
                f"coordinates: expected shape {(len(self.names), embedding.size)}, "
                f"got {self.coordinates.shape}"
            )
        self._index = {name: i for i, name in enumerate(self.names)}

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __contains__(self, name: object) -> bool:
        return name in self._index

    def __repr__(self) -> str:
        return f"Library({len(self)} materials of {len(set(self.families))} families)"

    def __getitem__(self, name: str) -> TabulatedBRDF:
        """The decoded table of a material."""
        table = self.embedding.decode(self.coordinates[self.index(name)])
        table.name = name
        return table

    def index(self, name: str) -> int:
        """Where `name` stands in `names`.

        Raises
        ------
        ValueError
            If there is no such material; the message names the nearest ones.
        """
        if name not in self._index:
            raise ValueError(unknown_name("material", name, self.names))
        return self._index[name]


@functools.lru_cache(maxsize=1)
def default_embedding() -> BRDFEmbedding:
    """The embedding that the package ships."""
    return BRDFEmbedding.from_arrays(artifact())


@functools.lru_cache(maxsize=1)
def default_library() -> Library:
    """The named materials that the package ships, as points of `default_embedding`."""
    state = artifact()
    return Library(
        default_embedding(),
        [str(n) for n in state["names"]],
        state["coordinates"],
        [str(f) for f in state["families"]],
    )
