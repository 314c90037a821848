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
from typing import Any

import numpy as np
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

    def decode_values(self, z: ArrayLike, offset: Float32 | None = None) -> Float32:
        """f_r (cells, 3) at all cells of the grid, float32: positive and with albedo <= 1.

        `z` is clipped to the gamut box; where the directional albedo of any colour at any of the
        16 check angles exceeds 1, all colours are divided by it. `offset` (cells, 3) is added to
        log(f + FLOOR): what a given table has beyond the manifold.
        """
        values, albedo = self._decode(z, offset)
        if albedo > 1.0:
            values /= np.float32(albedo * (1.0 + 1e-6))
        return values

    def energy_scale(self, z: ArrayLike, offset: Float32 | None = None) -> float:
        """The factor in (0, 1] by which `decode_values` lowers f to keep the albedo within 1.

        1 where nothing is lowered. Below that the shown material is darker than its coordinates
        say, and its traits are less pronounced than their scores.
        """
        return min(1.0, 1.0 / max(self._decode(z, offset)[1], 1e-30))

    def _decode(self, z: ArrayLike, offset: Float32 | None) -> tuple[Float32, float]:
        """f (cells, 3) before its energy is checked, and its greatest directional albedo."""
        scores = (_OPPONENT.T @ self.clip(z).reshape(3, -1)).T.astype(np.float32)
        logs: Float32 = self.components_ @ scores
        logs += self.mean_[:, None]
        if offset is not None:
            if offset.shape != logs.shape:
                raise ValueError(f"offset: expected shape {logs.shape}, got {offset.shape}")
            logs += offset
        # no BRDF reaches 1e13: keep exp from overflowing for offsets from outside
        np.exp(np.minimum(logs, 30.0, out=logs), out=logs)
        logs -= np.float32(FLOOR)
        np.maximum(logs, 0.0, out=logs)
        return logs, float((self._albedo @ logs).max())

    def residual(self, brdf: TabulatedBRDF) -> Float32:
        """(cells, 3) difference of log(f + FLOOR) between a table and its encoding.

        ``decode_values(encode(brdf), residual(brdf))`` is the table itself.
        """
        self._fitted()
        table = brdf.regrid(self.grid_)
        z = self.clip(self.encode(table)).reshape(3, -1)
        decoded = self.mean_[:, None] + self.components_ @ (_OPPONENT.T @ z).T.astype(np.float32)
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
