"""The embedding: BRDFs as points of a low-dimensional space (after Matusik et al. 2003).

A table's values are mapped by y = log(f + FLOOR), and a PCA over the library's tables gives the
mean and the components. Matusik et al. ("A Data-Driven Reflectance Model", SIGGRAPH 2003) take
one vector of all colours for each material; here every colour channel is a sample of its own, so
that one basis serves the three channels (a third of the numbers to decode) and no colour is
favoured by the colours in the library. With m components a material has k = 3 m coordinates:
the m achromatic ones first (the channels' mean), then m for red against blue, then m for green
against magenta; each axis is scaled to unit variance over channels.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
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

_OPPONENT = np.array(
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
        logs = scores @ self.basis
        logs += self.mean
        if offset is not None:
            whole = isinstance(self.index, slice) or isinstance(offset, torch.Tensor)
            # numpy's take of rows is ten times as fast as its indexing
            logs += (offset[self.index] if whole else offset.take(self.index, axis=0)).T
        return logs


class _Tensors(NamedTuple):
    """What `BRDFEmbedding.decode_tensor` needs, on one device and in one precision."""

    every: _Rows
    checked: _Rows
    check: torch.Tensor
    low: torch.Tensor
    high: torch.Tensor
    opponent: torch.Tensor


class BRDFEmbedding:
    """Log-mapped PCA of tabulated BRDFs.

    Parameters
    ----------
    n_components : int
        Components for each colour channel, m; a material has 3 m coordinates.

    Attributes
    ----------
    grid_ : HalfDiffGrid
    mean_ : (cells,) float32, mean of log(f + FLOOR)
    components_ : (cells, m) float32
    weight_ : (cells,) float32
        What a cell counts in the fit: the square root of the lower cosine, 0 below the horizon.
    low_, high_ : (3 m,) float64
        The gamut box: the range of the library's coordinates.
    explained_variance_ratio_ : (m,) float64
    """

    def __init__(self, n_components: int = 8) -> None:
        if not isinstance(n_components, int) or n_components < 1:
            raise ValueError(f"n_components: expected a positive integer, got {n_components!r}")
        self.n_components = n_components

    def fit(self, tables: Sequence[TabulatedBRDF]) -> BRDFEmbedding:
        """Fit to a library of at least two tables on one grid; returns self."""
        from sklearn.decomposition import PCA  # slow to import, and needed only here

        if len(tables) < 2:
            raise ValueError(f"tables: expected at least two, got {len(tables)}")
        grid = tables[0].grid
        if any(t.grid != grid for t in tables):
            raise ValueError("tables: expected all on one grid, got several")
        if grid.layout != "folded":
            raise ValueError(f"tables: expected the 'folded' layout, got {grid.layout!r}")
        if 3 * len(tables) <= self.n_components:
            raise ValueError(
                f"n_components: expected fewer than the {3 * len(tables)} channels of the "
                f"library, got {self.n_components}"
            )
        logs = np.concatenate([_log_map(t.values).reshape(-1, 3).T for t in tables])
        self.grid_ = grid
        self.weight_ = _cell_weight(grid)
        # randomised, but converged: a full SVD of this matrix takes a minute where floats underflow
        pca = PCA(
            self.n_components,
            svd_solver="randomized",
            iterated_power=10,
            n_oversamples=24,
            random_state=0,
        )
        scores = pca.fit_transform(logs * self.weight_)
        deviation = np.sqrt(pca.explained_variance_)
        if deviation.min() <= 1e-5 * max(1.0, float(deviation.max())):
            raise ValueError(
                f"tables: expected at least {self.n_components + 1} different channels, "
                f"got tables that span {int(np.sum(deviation > 1e-5))} dimensions"
            )
        scores = scores / deviation
        self.explained_variance_ratio_ = np.asarray(pca.explained_variance_ratio_, np.float64)
        # loadings by regression on the scores, so that cells below the horizon have them too
        self.mean_ = logs.mean(axis=0).astype(np.float32)
        gram = scores.T @ scores
        self.components_ = np.linalg.solve(gram, scores.T @ (logs - self.mean_)).T
        self.components_ = np.ascontiguousarray(self.components_, np.float32)
        self._prepare()
        coordinates = np.stack([self.encode(t) for t in tables])
        self.low_, self.high_ = coordinates.min(axis=0), coordinates.max(axis=0)
        return self

    def _prepare(self) -> None:
        """What follows from the fitted state: the projection and the albedo check."""
        weighted = (self.components_ * self.weight_[:, None]).astype(np.float64)
        self._gram = weighted.T @ weighted
        self._project = np.linalg.solve(self._gram, (weighted * self.weight_[:, None]).T)
        self._albedo = albedo_operator(self.grid_, ALBEDO_ANGLES).astype(np.float32)
        # the energy check by itself, for when only some cells are decoded: three quarters of the
        # grid, so a dense product is faster than the sparse one
        checked = np.unique(self._albedo.indices)
        self._check: Float32 = np.ascontiguousarray(self._albedo[:, checked].toarray().T)
        self._every = _Rows(slice(None), np.ascontiguousarray(self.components_.T), self.mean_)
        self._checked = _Rows(
            checked, np.ascontiguousarray(self.components_[checked].T), self.mean_[checked]
        )
        self._fan = np.kron(_OPPONENT.T.reshape(1, 9), np.eye(self.n_components)).astype(np.float32)
        self._tensors: dict[tuple[torch.device, torch.dtype], _Tensors] = {}

    def __repr__(self) -> str:
        state = f", k={self.size}, grid={self.grid_.shape}" if hasattr(self, "grid_") else ""
        return f"BRDFEmbedding(n_components={self.n_components}{state})"

    @property
    def size(self) -> int:
        """k, the number of coordinates of a material."""
        return 3 * self.n_components

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
        scores = self._project @ (_log_map(table.values).reshape(-1, 3) - self.mean_[:, None])
        return self._to_coordinates(scores)

    def encode_samples(
        self, theta_h: ArrayLike, theta_d: ArrayLike, phi_d: ArrayLike, rgb: ArrayLike
    ) -> Float64:
        """Coordinates (k,) of scattered or masked measurements.

        Parameters
        ----------
        theta_h, theta_d, phi_d : (n,) array_like, radians
        rgb : (n, 3) array_like
            f_r in 1/sr without the cosine; rows that are negative or not finite are left out.

        Notes
        -----
        A ridge whose prior is the library's unit variance keeps what the samples do not determine
        near the mean; 0.1 is the assumed deviation of log f from the manifold.

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
        precision = min(1.0, 1000.0 / len(target)) / 0.1**2
        gram = precision * (basis.T @ basis) + np.eye(self.n_components)
        return self._to_coordinates(np.linalg.solve(gram, precision * (basis.T @ target)))

    def _to_coordinates(self, scores: Float64) -> Float64:
        """(m, 3) channel scores to (3 m,) coordinates."""
        return np.asarray((_OPPONENT @ scores.T).ravel(), np.float64)

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
        scores = _channel_scores(_OPPONENT, clipped).astype(np.float32)
        logs = rows.logs(scores, offset)
        albedo = self._check_albedos(scores, offset)
        greatest = float(albedo.max())
        scale = 1.0 / (greatest * _MARGIN) if greatest > 1.0 else 1.0
        # d log(f + FLOOR) of colour c, coordinate (axis a, component m) is opponent[a, c] basis[m]
        result: Float32 = (rows.basis.T @ self._fan).reshape(-1, 3, self.size)
        result *= (_slope(logs) * np.float32(scale)).T[..., None]
        if greatest > 1.0:
            tied = _tied(albedo)
            weight = (tied / np.float32(tied.sum())) @ self._check.T
            weight *= _slope(self._checked.logs(scores, offset))
            rise = self._to_coordinates(self._checked.basis @ weight.T).astype(np.float32)
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
        scores = _channel_scores(on.opponent, torch.clamp(z, on.low, on.high))
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
                    tensor(_OPPONENT),
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
        scores = _channel_scores(_OPPONENT, self.clip(z)).astype(np.float32)
        self._check_offset(offset)
        logs = self._rows(cells).logs(scores, offset)
        values: Float32 = np.ascontiguousarray(_reflectance(np, logs, out=logs).T)
        if cells is None:
            return values, float((self._albedo @ values).max())
        return values, float(self._check_albedos(scores, offset).max())

    def _check_albedos(self, scores: Float32, offset: Float32 | None) -> Float32:
        """Directional albedos (3, 16) of channel scores (3, m), before the energy scaling."""
        logs = self._checked.logs(scores, offset)
        albedo: Float32 = _reflectance(np, logs, out=logs) @ self._check
        return albedo

    def residual(self, brdf: TabulatedBRDF) -> Float32:
        """(cells, 3) difference of log(f + FLOOR) between a table and its encoding.

        ``decode_values(encode(brdf), residual(brdf))`` is the table itself.
        """
        self._fitted()
        table = brdf.regrid(self.grid_)
        scores = _channel_scores(_OPPONENT, self.clip(self.encode(table))).astype(np.float32)
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
        return np.kron(np.eye(3), row)

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
        result = cls(int(components.shape[1]))
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


def _channel_scores(opponent: Any, z: Any) -> Any:
    """(3 m,) coordinates to (3, m) channel scores; arrays or tensors."""
    return opponent.T @ z.reshape(3, -1)


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
    th, td, pd = grid.node_angles()
    lower = np.cos(th) * np.cos(td) - np.sin(th) * np.sin(td) * np.abs(np.cos(pd))
    return np.asarray(np.sqrt(np.maximum(lower, 0.0)).ravel(), np.float32)


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
