"""Interpolation between scattered nodes: ordinary kriging, and compiled loops for it."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from traitbrdf.compiled import CACHED

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
f32 = np.float32


def kriging(
    places: Float32,
    nodes: Int64,
    at: Int64,
    neighbours: int,
    leave_out: bool = False,
    loose: float = 0.0,
) -> tuple[Int64, Float32]:
    """Find the nodes that fragments are interpolated from, and their weights, both (m, k).

    Parameters
    ----------
    places : (fragments, d) float32
        Where fragments lie.
    nodes : (n,) int64
        Fragments that are known.
    at : (m,) int64
        Fragments to interpolate at.
    neighbours : int
        k, or the number of nodes if that is smaller.
    leave_out : bool
        Whether `at` are the nodes, each of which is to be interpolated from the others.
    loose : float
        By what share a node that is taken may be further away than one that is not.
    """
    count = min(neighbours, len(nodes) - leave_out)
    if count <= 0:
        return np.zeros((len(at), 0), np.int64), np.zeros((len(at), 0), np.float32)
    tree = cKDTree(places[nodes])
    _, near = tree.query(places[at], count + leave_out, eps=loose, workers=-1)
    near = near.reshape(len(at), -1)[:, int(leave_out) :].astype(np.int64)
    weights = np.empty(near.shape, np.float32)
    kriging_weights(weights, places[nodes], places[at], np.ascontiguousarray(near))
    return near, weights


@numba.njit(parallel=True, cache=CACHED, nogil=True)
def interpolate_nodes(
    out: Any, shown: Any, near: Any, weights: Any, columns: Any, slopes: Any
) -> None:
    """Set what fragments show, from nodes and reflections; never negative.

    What is interpolated stays within what the nodes around show. Weights of kriging may be
    negative: at the edge of a shadow their sum would overshoot.

    Parameters
    ----------
    out : (P, 3) float32, which is set
    shown : (n, 3) float32
        What nodes show beside reflections.
    near : (P, k) int32 nodes of each fragment
    weights : (P, k) float32
    columns : (P, 3, D) float32 reflections
    slopes : (3, D) float32 coefficients of them
    """
    for p in numba.prange(len(out)):
        for c in range(3):
            low, high, total = f32(np.inf), f32(-np.inf), f32(0.0)
            for k in range(near.shape[1]):
                value = shown[near[p, k], c]
                total += weights[p, k] * value
                low, high = min(low, value), max(high, value)
            sharp = f32(0.0)
            for d in range(columns.shape[2]):
                sharp += columns[p, c, d] * slopes[c, d]
            if near.shape[1] > 0:
                sharp += min(max(total, low), high)
            out[p, c] = max(sharp, f32(0.0))


@numba.njit(parallel=True, cache=CACHED, error_model="numpy", nogil=True)
def kriging_weights(out: Any, points: Any, at: Any, near: Any) -> None:
    """Solve for the weights of ordinary kriging with the variogram d^1.5.

    The weights minimise the expected squared error of a sum over neighbours, under the condition
    that they add up to 1 (Cressie, "Statistics for Spatial Data", 1993, section 3.2).

    Parameters
    ----------
    out : (q, k) float32
        The weights, written.
    points : (n, d) float32
        Known places.
    at : (q, d) float32
        Places to interpolate at.
    near : (q, k) int64
        Neighbours of each among `points`, all different.
    """
    count, k = near.shape
    for i in numba.prange(count):
        system = np.zeros((k + 1, k + 2))
        for a in range(k):
            for b in range(a):
                square = 0.0
                for d in range(points.shape[1]):
                    square += (points[near[i, a], d] - points[near[i, b], d]) ** 2
                system[a, b] = system[b, a] = math.sqrt(square) * math.sqrt(math.sqrt(square))
            square = 0.0
            for d in range(points.shape[1]):
                square += (points[near[i, a], d] - at[i, d]) ** 2
            system[a, a] = -1e-9
            system[a, k] = system[k, a] = 1.0
            system[a, k + 1] = math.sqrt(square) * math.sqrt(math.sqrt(square))
        system[k, k + 1] = 1.0
        for a in range(k + 1):  # Gaussian elimination with row pivots
            pivot = a
            for b in range(a + 1, k + 1):
                if abs(system[b, a]) > abs(system[pivot, a]):
                    pivot = b
            if pivot != a:
                for c in range(a, k + 2):
                    system[a, c], system[pivot, c] = system[pivot, c], system[a, c]
            for b in range(a + 1, k + 1):
                factor = system[b, a] / system[a, a]
                if factor != 0.0:
                    for c in range(a, k + 2):
                        system[b, c] -= factor * system[a, c]
        for a in range(k, -1, -1):
            rest = system[a, k + 1]
            for c in range(a + 1, k + 1):
                rest -= system[a, c] * system[c, k + 1]
            system[a, k + 1] = rest / system[a, a]
        for a in range(k):
            out[i, a] = system[a, k + 1]
