"""Parts of a fit to a library: its tables in batches, principal components, weights."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from traitbrdf.reflectance.brdf import HalfDiffGrid, TabulatedBRDF
from traitbrdf.space.logmap import FLOOR, OPPONENT, channel_logs, exposure

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

_BATCH = 128
"""Materials that are held in memory at once while fitting."""

_ENERGY = 0.9
"""Share of a fit's weights that follows the light which a cell reflects; the rest is uniform."""


def checked_grid(tables: Iterable[TabulatedBRDF]) -> tuple[HalfDiffGrid, int]:
    """Return the grid of tables that can be fitted to, and their number.

    Parameters
    ----------
    tables : iterable of TabulatedBRDF

    Raises
    ------
    ValueError
        If there are fewer than two, of several grids, or not of the folded layout.
    """
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


def batches(tables: Iterable[TabulatedBRDF]) -> Iterator[Float32]:
    """Yield log(f + FLOOR) (n, 3, cells) of up to 128 tables at a time.

    Parameters
    ----------
    tables : iterable of TabulatedBRDF, on one grid
    """
    waiting: list[Float32] = []
    for table in tables:
        waiting.append(channel_logs(table))
        if len(waiting) == _BATCH:
            yield np.stack(waiting)
            waiting.clear()
    if waiting:
        yield np.stack(waiting)


def fit_weight(logs: Float32, weight: Float32, grid: HalfDiffGrid) -> Float32:
    """Return weights of log(f + FLOOR) that follow the light which a cell reflects.

    Parameters
    ----------
    logs : (n, 3, cells) float32
        log(f + FLOOR).
    weight : (cells,) float32
        Square root of the weights of the uniform part.
    grid : HalfDiffGrid

    Returns
    -------
    (n, 3, cells) float32
        Their sum is 3 for each material.
    """
    even = weight**2 / np.sum(weight**2)
    shown = np.maximum(np.exp(logs) - np.float32(FLOOR), 0.0) * exposure(grid)
    shown *= 3.0 * _ENERGY / np.maximum(shown.sum(axis=(1, 2), keepdims=True), 1e-30)
    shown += (1.0 - _ENERGY) * even
    found: Float32 = shown
    return found


def principal_axes(
    tables: Iterable[TabulatedBRDF],
    axes: slice,
    count: int,
    materials: int,
    mean: Float32,
    weight: Float32,
) -> tuple[Float32, Float64, float]:
    """Find principal components of the tables on colour axes.

    Parameters
    ----------
    tables : iterable of TabulatedBRDF
    axes : slice
        Rows of `OPPONENT`: the mean of the channels, or both differences.
    count : int
        Number of components.
    materials : int
        Number of tables.
    mean : (cells,) float32
        Mean of log(f + FLOOR).
    weight : (cells,) float32
        Weights of cells.

    Returns
    -------
    components : (cells, count) float32
    variances : (count,) float64
    total : float
        The whole variance.

    Raises
    ------
    ValueError
        If the tables span fewer dimensions than `count`.
    """
    from sklearn.decomposition import IncrementalPCA  # slow to import, and needed only here

    offset = math.sqrt(3.0) * mean if axes.start == 0 else np.float32(0.0)

    def rows() -> Iterator[Float32]:
        for logs in batches(tables):
            turned = np.einsum("ac,ncx->nax", OPPONENT[axes].astype(np.float32), logs) - offset
            yield turned.reshape(-1, logs.shape[2])

    signs = 1 if axes.start == 0 else 2
    some = min(materials, _BATCH) * (axes.stop - axes.start) * signs
    pca = IncrementalPCA(min(4 * count + 16, some, len(mean)))
    for batch in rows():
        weighted = batch * weight
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
    cross = np.zeros((count, len(mean)))
    for batch in rows():
        scores = (batch * weight) @ pca.components_[:count].T / deviation
        gram += scores.T @ scores
        cross += scores.T @ batch
    loadings = np.linalg.solve(gram, cross).T
    total = float(np.sum(pca.var_))
    shares = np.asarray(pca.explained_variance_ratio_[:count], np.float64)
    return np.ascontiguousarray(loadings, np.float32), total * shares, total
