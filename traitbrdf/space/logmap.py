"""The log map from tables to a linear space, and weights that follow the light."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.optimize
import scipy.sparse
import scipy.spatial
from numpy.typing import NDArray
from scipy.special import sph_harm_y

from traitbrdf.directions import from_half_diff_angles
from traitbrdf.reflectance.brdf import (
    HalfDiffGrid,
    TabulatedBRDF,
    albedo_operator,
    hemisphere_nodes,
)

if TYPE_CHECKING:  # importing torch takes a second: functions that need it import it
    import torch


Float32 = NDArray[np.float32]

FLOOR = 1e-3
"""Added to f (1/sr) before the logarithm: a BRDF below it looks black."""

OPPONENT = np.array(
    [
        [1.0, 1.0, 1.0] / np.sqrt(3.0),
        [1.0, 0.0, -1.0] / np.sqrt(2.0),
        [-1.0, 2.0, -1.0] / np.sqrt(6.0),
    ]
)
"""Orthonormal rows: mean of the channels, red against blue, green against magenta."""

_CAP = 30.0
"""Upper bound of log(f + FLOOR): no BRDF reaches 1e13 /sr, and exp must not overflow."""

_TIE = 1e-6
"""Relative distance at which two albedos count as equal, as do the channels of a grey material."""


def product(a: Any, b: Any) -> Any:
    """Multiply two matrices, a @ b, with torch.

    After a product numpy's threads spin for milliseconds, and the next product, which is torch's,
    would wait for the same cores.

    Parameters
    ----------
    a : (n, m) array or tensor
    b : (m, p) array or tensor, of the same kind

    Returns
    -------
    (n, p) array or tensor, as given
    """
    import torch

    if isinstance(a, torch.Tensor):
        return a @ b
    return torch.mm(torch.from_numpy(a), torch.from_numpy(b)).numpy()


def channel_logs(table: TabulatedBRDF) -> Float32:
    """Return log(f + FLOOR) of a table, one row for each channel.

    Parameters
    ----------
    table : TabulatedBRDF

    Returns
    -------
    (3, cells) float32
    """
    return log_map(table.values).reshape(-1, 3).T


def log_map(values: NDArray[Any]) -> Float32:
    """Compute log(f + FLOOR).

    Parameters
    ----------
    values : array
        f in 1/sr, at least 0.

    Returns
    -------
    float32 array of the same shape
    """
    logs: Float32 = np.log(np.asarray(values, np.float32) + np.float32(FLOOR))
    return logs


@functools.lru_cache(maxsize=4)
def exposure(grid: HalfDiffGrid) -> Float32:
    """Compute how much each cell contributes to what a sphere reflects under uniform light.

    Parameters
    ----------
    grid : HalfDiffGrid

    Returns
    -------
    (cells,) float32
        The factor by which a cell's f enters the mean radiance, up to one constant for all cells.
    """
    views = (np.arange(12) + 0.5) / 12 * math.radians(88.0)
    share = np.sin(views) * np.cos(views)
    return np.asarray(share @ albedo_operator(grid, views) / share.sum(), np.float32)


@functools.lru_cache(maxsize=4)
def natural_light(grid: HalfDiffGrid, order: int = 12, views: int = 8) -> torch.Tensor:
    """Build rows that measure visible differences of f on a sphere under natural light.

    The sum of squares of the rows times a difference of f is the expected mean square of the
    difference in radiance over a sphere's pixels. The expectation is over random environment maps
    without a preferred direction, whose power falls with the order l of the spherical harmonics as
    1 / (l + 1). Real maps lie on both sides of that: about 1 / l^2 without light sources, flat
    where a sun or a lamp is in sight (Dror, Willsky & Adelson, "Statistical characterization of
    real-world illumination", Journal of Vision 4, 2004).

    Parameters
    ----------
    grid : HalfDiffGrid
    order : int
        Highest order of the spherical harmonics.
    views : int
        Number of view angles between 0 and 88 degrees.

    Returns
    -------
    (n, cells) float32 tensor, n at most 200
    """
    import torch

    x, share = np.polynomial.legendre.leggauss(views)
    angles = 0.5 * (x + 1.0) * math.radians(88.0)
    share = share * np.sin(angles) * np.cos(angles)
    nodes = np.unique(np.append(grid.theta_h, math.pi / 2))
    rows = []
    for angle, part in zip(angles, share / share.sum(), strict=True):
        th, td, pd, weight = hemisphere_nodes(float(angle), nodes, per_interval=1, azimuths=32)
        wi, wo = from_half_diff_angles(th, td, pd)
        azimuth = np.arctan2(wi[:, 1], wi[:, 0]) - np.arctan2(wo[:, 1], wo[:, 0])
        polar = np.arccos(np.clip(wi[:, 2], -1.0, 1.0))
        # the two halves of azimuths are mirror images, so only the cosine harmonics remain
        harmonics = np.stack(
            [
                math.sqrt((2.0 if m else 1.0) / (n + 1)) * sph_harm_y(n, m, polar, azimuth).real
                for n in range(order + 1)
                for m in range(n + 1)
            ]
        )
        index, corner = grid.stencil(th, td, pd)
        ends = np.arange(0, index.size + 1, index.shape[1])
        shape = len(th), grid.size
        sampled = scipy.sparse.csr_array((corner.ravel(), index.ravel(), ends), shape)
        rows.append((sampled.T @ (harmonics * (math.sqrt(part) * weight)).T).T)
    every = torch.from_numpy(np.concatenate(rows).astype(np.float32))
    # the 200 strongest combinations of rows carry nearly all of the energy
    _, vectors = torch.linalg.eigh((every @ every.T).double())
    kept: torch.Tensor = (vectors[:, -200:].T.float() @ every).contiguous()
    return kept


def reflectance(xp: Any, logs: Any, out: Any = None) -> Any:
    """Invert the log map: return f from log(f + FLOOR).

    Parameters
    ----------
    xp : module
        ``numpy`` or ``torch``.
    logs : array or tensor
    out : array or tensor, optional
        Where to write the result; ``out=logs`` spares numpy the copies.

    Returns
    -------
    array or tensor of the same shape
        f in 1/sr, at least 0.
    """
    raised = xp.exp(xp.clip(logs, None, _CAP, out=out), out=out)
    return xp.clip(xp.subtract(raised, FLOOR, out=out), 0.0, None, out=out)


def log_slope(logs: Float32) -> Float32:
    """Return the derivative d f / d log(f + FLOOR).

    Parameters
    ----------
    logs : array
        log(f + FLOOR).

    Returns
    -------
    array of the same shape
        f + FLOOR, or 0 where `reflectance` holds f at 0 or at its upper bound.
    """
    raised = np.exp(np.minimum(logs, _CAP))
    return np.where((raised >= FLOOR) & (logs <= _CAP), raised, np.float32(0.0))


def tied_albedo(albedo: Any) -> Any:
    """Mark the albedos that equal the greatest one to a relative 1e-6.

    Parameters
    ----------
    albedo : (3, angles) array or tensor

    Returns
    -------
    (3, angles) bool array or tensor
    """
    return albedo >= (1.0 - _TIE) * albedo.max()


def cell_weight(grid: HalfDiffGrid) -> Float32:
    """Return the weight of each cell in a fit: the square root of the lower cosine.

    Parameters
    ----------
    grid : HalfDiffGrid

    Returns
    -------
    (cells,) float32, 0 below the horizon
    """
    return np.asarray(np.sqrt(np.maximum(grid.lower_cosine, 0.0)).ravel(), np.float32)


def channel_mixing(n_components: tuple[int, int]) -> NDArray[np.float64]:
    """Return how coordinates add up to each channel's scores on the principal components.

    Parameters
    ----------
    n_components : (int, int)
        Components of the mean of the channels, and of each of the two colour axes; m in all.

    Returns
    -------
    (3, m, k) float64
    """
    achromatic, chromatic = n_components
    result = np.zeros((3, achromatic + chromatic, achromatic + 2 * chromatic))
    grey, red_blue, green = OPPONENT
    result[:, :achromatic, :achromatic] = grey[:, None, None] * np.eye(achromatic)
    middle = achromatic + chromatic
    result[:, achromatic:, achromatic:middle] = red_blue[:, None, None] * np.eye(chromatic)
    result[:, achromatic:, middle:] = green[:, None, None] * np.eye(chromatic)
    return result
