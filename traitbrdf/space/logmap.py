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

if TYPE_CHECKING:  # where it is needed it is imported: it takes a second
    import torch


Float32 = NDArray[np.float32]

FLOOR = 1e-3
"""Added to f (1/sr) before the logarithm: below it a BRDF is black to the eye."""

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

_TIE = 1e-6
"""Relative distance at which two albedos count as equal: the channels of a grey material."""


def product(a: Any, b: Any) -> Any:
    """a @ b of arrays or tensors, by torch: numpy's threads spin for milliseconds after a product,
    and those of the next one, which is torch's, wait for the same cores."""
    import torch

    if isinstance(a, torch.Tensor):
        return a @ b
    return torch.mm(torch.from_numpy(a), torch.from_numpy(b)).numpy()


def channel_logs(table: TabulatedBRDF) -> Float32:
    """log(f + FLOOR) (3, cells) of a table."""
    return log_map(table.values).reshape(-1, 3).T


def log_map(values: NDArray[Any]) -> Float32:
    logs: Float32 = np.log(np.asarray(values, np.float32) + np.float32(FLOOR))
    return logs


@functools.lru_cache(maxsize=4)
def exposure(grid: HalfDiffGrid) -> Float32:
    """(cells,) what of a cell's f a sphere reflects under even light, to a factor."""
    views = (np.arange(12) + 0.5) / 12 * math.radians(88.0)
    share = np.sin(views) * np.cos(views)
    return np.asarray(share @ albedo_operator(grid, views) / share.sum(), np.float32)


@functools.lru_cache(maxsize=4)
def natural_light(grid: HalfDiffGrid, order: int = 12, views: int = 8) -> torch.Tensor:
    """Rows (n, cells): what of f differs visibly on a sphere under light as it is found.

    The sum of squares of the rows times a difference of f is the mean square of the difference in
    radiance over a sphere's pixels, in the mean over maps: random ones, of no preferred direction,
    whose power falls with the order l of the spherical harmonics as 1 / (l + 1). Real maps lie on
    both sides of that: about 1 / l^2 without light sources, flat where a sun or a lamp is in sight
    (Dror, Willsky & Adelson, "Statistical characterization of real-world illumination", Journal of
    Vision 4, 2004).
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
        # azimuths of one half stand for both: of the harmonics the cosines remain
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
    # few combinations carry nearly all of it
    _, vectors = torch.linalg.eigh((every @ every.T).double())
    kept: torch.Tensor = (vectors[:, -200:].T.float() @ every).contiguous()
    return kept


def reflectance(xp: Any, logs: Any, out: Any = None) -> Any:
    """f from log(f + FLOOR); `xp` is numpy or torch. `out=logs` spares numpy the copies."""
    raised = xp.exp(xp.clip(logs, None, _CAP, out=out), out=out)
    return xp.clip(xp.subtract(raised, FLOOR, out=out), 0.0, None, out=out)


def log_slope(logs: Float32) -> Float32:
    """d f / d log(f + FLOOR): f + FLOOR, or 0 beyond the kinks of `reflectance`."""
    raised = np.exp(np.minimum(logs, _CAP))
    return np.where((raised >= FLOOR) & (logs <= _CAP), raised, np.float32(0.0))


def tied_albedo(albedo: Any) -> Any:
    """Which albedos (3, 16) are the greatest; arrays or tensors."""
    return albedo >= (1.0 - _TIE) * albedo.max()


def cell_weight(grid: HalfDiffGrid) -> Float32:
    return np.asarray(np.sqrt(np.maximum(grid.lower_cosine, 0.0)).ravel(), np.float32)
