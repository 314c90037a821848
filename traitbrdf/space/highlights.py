"""Constraints on log f along theta_h: no holes in highlights, no spikes that no material has.

A linear space of log f holds lobes with holes in them (Matusik et al. 2003 met them) and spikes
towards grazing. A profile is log f along theta_h at fixed theta_d and phi_d. Every decoded profile
is corrected, by as little as possible, to what profiles of the library do. In this order:

1. The trend of a profile is its rise from its maximum in the first 10 degrees to the last node that
   both directions reach (50 degrees at most), or 0 if it falls. Velvets rise; highlights do not,
   with a hole or without. At each node a share of the trend is allowed, the greatest share that a
   member of the library has there.
2. Up to `HIGHLIGHT` a profile does not rise by more than that: a value lower than a later one is
   raised to it.
3. Nowhere does a profile rise above its running minimum by more than any member of the library
   does: the excess is cut.
4. Up to `HIGHLIGHT` there is no valley: it is filled to its lower rim.

A profile that meets these conditions does not change. Beyond theta_d = 80 degrees, next to the
horizon, only the third applies.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from traitbrdf.compiled import CACHED
from traitbrdf.reflectance.brdf import HalfDiffGrid

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]

HIGHLIGHT = math.radians(30.0)
"""theta_h in radians up to which a profile has no valley."""

_TALL = math.radians(80.0)
_TREND = math.radians(50.0)
_CORE = math.radians(10.0)
_RISES = 0.1
"""Trends below this (in log f) do not count when the library's shares are measured."""

_EARLY = 0.7
"""Upper bound of the share of its trend by which a profile may rise in its first 10 degrees: models
of sheen have a dark point in the middle that no cloth has.
"""


@dataclass(frozen=True)
class Profiles:
    """What is allowed of n = n_theta_d * n_phi_d profiles with n_theta_h nodes each.

    Parameters
    ----------
    share : (n_theta_h, n) float32 in [0, 1.7]
        The share of its trend by which a profile may have risen at a node.
    grazing : (n_theta_h, n) float32
        The rise in log f that is allowed beyond that.
    inner : (n,) int32
        How many of the first nodes belong to the highlight.
    last : (n,) int32
        The node at which the trend is read.
    core : int
        How many of the first nodes the trend may start from.
    """

    share: Float32
    grazing: Float32
    inner: Int32
    last: Int32
    core: int

    @classmethod
    def none(cls, grid: HalfDiffGrid) -> Profiles:
        """Return the profiles to start from: no rise is allowed but the trend's, at its last node.

        Parameters
        ----------
        grid : HalfDiffGrid
        """
        lower = grid.lower_cosine.reshape(grid.n_theta_h, -1)
        nodes = np.arange(grid.n_theta_h)[:, None]
        wide, narrow = (np.maximum((lower > c).sum(axis=0) - 1, 0) for c in (0.1, 0.2))
        last = np.clip(wide, 1, max(int(np.sum(grid.theta_h < _TREND)), 1))
        last = np.minimum(last, grid.n_theta_h - 1)
        inner = np.minimum(int(np.sum(grid.theta_h <= HIGHLIGHT)), np.minimum(narrow + 1, last))
        tall = np.repeat(grid.theta_d < _TALL, grid.n_phi_d)
        share = (nodes >= last).astype(np.float32)
        return cls(
            share,
            np.zeros_like(share),
            np.where(tall, inner, 0).astype(np.int32),
            last.astype(np.int32),
            int(np.sum(grid.theta_h <= _CORE)),
        )

    @classmethod
    def of(cls, logs: Callable[[], Iterator[Float32]], grid: HalfDiffGrid) -> Profiles:
        """Measure what a library's members do.

        Later corrections change no member, except for valleys in its highlight and a dark point in
        its middle.

        Parameters
        ----------
        logs : callable
            Returns an iterator of batches (n, 3, cells) of log(f + FLOOR); it is called twice.
        grid : HalfDiffGrid
        """
        free = cls.none(grid)
        share, grazing = free.share.copy(), free.grazing.copy()
        nodes = np.arange(len(share))[:, None]
        for batch in logs():
            x = batch.reshape(-1, *share.shape)
            trend = free._trend(x)
            rise = np.where(trend > _RISES, (x - x[:, :1]) / np.maximum(trend, _RISES), 0.0)
            np.maximum(share, rise.max(axis=0), out=share)
        share = np.minimum(share, np.where(nodes < free.core, _EARLY, 1.0 + _EARLY))
        share = np.maximum.accumulate(share.astype(np.float32), axis=0)
        for batch in logs():
            x = batch.reshape(-1, *share.shape)
            x = x - share * free._trend(x)
            rise = (x - np.minimum.accumulate(x, axis=1)).max(axis=0)
            np.maximum(grazing, rise, out=grazing)
        grazing = np.where(nodes >= np.maximum(free.inner, 1), grazing, np.float32(0.0))
        return replace(free, share=share, grazing=np.maximum.accumulate(grazing, axis=0))

    def _trend(self, x: Float32) -> Float32:
        """Return the trend (..., 1, n) of profiles (..., n_theta_h, n)."""
        first = x[..., : self.core, :].max(axis=-2)
        rise = x[..., self.last, np.arange(len(self.last))] - first
        trend: Float32 = np.maximum(rise, 0.0)[..., None, :]
        return trend

    def keep(self, logs: Any) -> Any:
        """Correct profiles.

        Parameters
        ----------
        logs : (3, cells) array or tensor
            log(f + FLOOR).

        Returns
        -------
        (3, cells) array or tensor, as given; a tensor is differentiable
        """
        if isinstance(logs, np.ndarray):
            return self._found(logs)[0].reshape(3, -1)
        import torch  # importing it takes a second, which arrays need not wait for

        found = self.sources(logs.detach().cpu().numpy())
        kept, cells, extra, first = (torch.from_numpy(v).to(logs.device) for v in found)
        last = torch.from_numpy(self.last.astype(np.int64)).to(logs.device) * len(self.last)
        profile = torch.arange(logs.shape[1], device=logs.device) % len(last)
        trend = logs[:, last[profile] + profile] - logs.gather(1, first[:, profile])
        moved = logs.gather(1, cells) + extra.to(logs.dtype) * trend
        # slopes of the one, and exactly the values of the other
        kept_here: torch.Tensor = moved + (kept - moved).detach()
        return kept_here

    def sources(
        self, logs: NDArray[Any]
    ) -> tuple[NDArray[Any], NDArray[np.int64], Float32, NDArray[np.int64]]:
        """Correct profiles, and tell which values the result is made of.

        Parameters
        ----------
        logs : (3, cells) array
            log(f + FLOOR).

        Returns
        -------
        kept : (3, cells)
            The corrected log(f + FLOOR).
        cells : (3, cells) int64
            The cell of the same profile and colour whose value is taken.
        extra : (3, cells) float32
            The share of the profile's trend that is added to it; 0 where there is no trend.
        first : (3, n) int64
            The cell that each profile's trend starts from.
        """
        kept, node, extra, top = self._found(logs)
        profile = np.arange(len(self.last))
        cells, first = (n.astype(np.int64) * len(profile) + profile for n in (node, top))
        return kept.reshape(3, -1), cells.reshape(3, -1), extra.reshape(3, -1), first

    def _found(self, logs: NDArray[Any]) -> Any:
        x = np.ascontiguousarray(logs).reshape(3, *self.share.shape)
        return _keep(x, self.share, self.grazing, self.inner, self.last, self.core)


@numba.njit(cache=CACHED, nogil=True)
def _keep(x: Any, share: Any, grazing: Any, inner: Any, last: Any, core: Any) -> Any:
    """Correct profiles x (3, nodes, profiles).

    Returns the values, their source nodes, the shares of the trend added to them, and the nodes
    that trends start from. Rows are processed whole, so that all profiles of a row vectorise.
    """
    colours, nodes, profiles = x.shape
    y, source = np.empty_like(x), np.empty(x.shape, np.int32)
    extra = np.zeros(x.shape, np.float32)
    best, at = np.empty(profiles, x.dtype), np.empty(profiles, np.int32)
    trend, top = np.empty(profiles, x.dtype), np.empty((colours, profiles), np.int32)
    most = inner.max()
    rim, place = np.empty((most, profiles), x.dtype), np.empty((most, profiles), np.int32)
    for c in range(colours):
        for j in range(profiles):
            top[c, j] = 0
            for i in range(1, core):
                if x[c, i, j] > x[c, top[c, j], j]:
                    top[c, j] = i
            trend[j] = max(x[c, last[j], j] - x[c, top[c, j], j], 0.0)
            best[j], at[j] = -np.inf, 0
        for i in range(nodes - 1, -1, -1):
            for j in range(profiles):
                v = x[c, i, j] - share[i, j] * trend[j]
                highlight = i < inner[j]
                more = (v > best[j]) & highlight
                best[j] = v if more else best[j]
                at[j] = i if more else at[j]
                y[c, i, j] = best[j] if highlight else v
                source[c, i, j] = at[j] if highlight else i
        for j in range(profiles):
            best[j] = np.inf
        for i in range(nodes):
            for j in range(profiles):
                v, own = y[c, i, j], source[c, i, j]
                high = v > best[j] + grazing[i, j]
                source[c, i, j] = at[j] if high else own
                moved = (best[j] + grazing[i, j] if high else v) + share[i, j] * trend[j]
                less = v < best[j]
                best[j] = v if less else best[j]
                at[j] = own if less else at[j]
                # an unchanged value keeps its exact bits
                y[c, i, j] = x[c, i, j] if source[c, i, j] == i else moved
        for j in range(profiles):
            best[j], at[j] = -np.inf, 0
        for i in range(most - 1, -1, -1):
            for j in range(profiles):
                more = (y[c, i, j] > best[j]) & (i < inner[j])
                best[j] = y[c, i, j] if more else best[j]
                at[j] = i if more else at[j]
                rim[i, j], place[i, j] = best[j], at[j]
        for j in range(profiles):
            best[j], at[j] = -np.inf, 0
        for i in range(most):
            for j in range(profiles):
                more = y[c, i, j] > best[j]
                best[j] = y[c, i, j] if more else best[j]
                at[j] = i if more else at[j]
                lower = best[j] < rim[i, j]
                rim[i, j] = best[j] if lower else rim[i, j]
                place[i, j] = at[j] if lower else place[i, j]
        # safe in place: `rim` is a copy, so no value that was written is read again
        for i in range(most):
            for j in range(profiles):
                if i < inner[j] and place[i, j] != i:
                    y[c, i, j] = rim[i, j]
        for i in range(nodes):
            for j in range(profiles):
                p = place[i, j] if i < inner[j] else i
                if trend[j] > 0.0:
                    extra[c, i, j] = share[p, j] - share[source[c, p, j], j]
        for j in range(profiles):
            for i in range(inner[j]):
                place[i, j] = source[c, place[i, j], j]
            for i in range(inner[j]):
                source[c, i, j] = place[i, j]
    return y, source, extra, top
