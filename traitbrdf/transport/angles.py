"""Which angles of a BRDF a scene shows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from traitbrdf.reflectance.brdf import HalfDiffGrid
from traitbrdf.scene.scene import Scene
from traitbrdf.transport.operator import Operator as Operator
from traitbrdf.transport.visibility import Progress as Progress

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class AnglesSeen:
    """The angles of a BRDF that a scene can show.

    Where light and view leave out some angles, edits of the BRDF at these do not change the image.

    Attributes
    ----------
    grid : HalfDiffGrid of the tables
    share : (n_theta_h, n_theta_d) float64
        Share of the light that a white diffuse surface reflects to the image at these angles, all
        phi_d together. The sum is 1.
    fragments : int
        Number of fragments that were measured.
    """

    grid: HalfDiffGrid
    share: Float64
    fragments: int

    @property
    def density(self) -> Float64:
        """Share by square degree (n_theta_h, n_theta_d), relative to its maximum."""
        h, d = np.degrees(self.grid.theta_h), np.degrees(self.grid.theta_d)
        found: Float64 = self.share / (np.gradient(h)[:, None] * np.gradient(d)[None, :])
        return found / max(float(found.max()), 1e-300)

    @property
    def cells(self) -> float:
        """Share of the pairs of theta_h and theta_d whose density is above 1e-4."""
        return float(np.mean(self.density > 1e-4))

    def within(self, share: float = 0.9) -> tuple[float, float]:
        """Return theta_h and theta_d in degrees below which a share of the light is reflected.

        Raises
        ------
        ValueError
            If the share is not from 0 to 1.
        """
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"share: expected 0 to 1, got {share!r}")
        found = []
        for angles, axis in ((self.grid.theta_h, 1), (self.grid.theta_d, 0)):
            total = np.cumsum(self.share.sum(axis=axis))
            place = int(np.searchsorted(total, share * total[-1]))
            found.append(math.degrees(float(angles[min(place, len(angles) - 1)])))
        return found[0], found[1]

    def as_dict(self) -> dict[str, Any]:
        """Return the measures as plain values, for a report."""
        half, most = self.within(0.5), self.within(0.9)
        return {
            "cells_seen": self.cells,
            "theta_h_degrees": {"50 % of the light below": half[0], "90 % below": most[0]},
            "theta_d_degrees": {"50 % of the light below": half[1], "90 % below": most[1]},
            "fragments": self.fragments,
        }


def angles_seen(
    scene: Scene, grid: HalfDiffGrid, part: int | None = None, count: int = 384, seed: int = 0
) -> AnglesSeen:
    """Measure the angles of a BRDF that a scene shows, from exact rows of some fragments.

    The scene need not be prepared.

    Parameters
    ----------
    scene : Scene
    grid : HalfDiffGrid of the tables
    part : int or None
        Index into ``scene.parts``; None for all parts of the shape.
    count : int
        Most fragments to measure.
    seed : int
        Chooses them.

    Raises
    ------
    ValueError
        If nothing of the part is in the picture.
    """
    parts = range(len(scene.shape.parts)) if part is None else [part]
    spans = [scene.part_slice(i) for i in parts]
    all_of = np.concatenate([np.arange(span.start, span.stop) for span in spans])
    if not len(all_of):
        raise ValueError("angles: expected a part that is in the picture, got one that is not")
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.permutation(all_of)[:count])
    rows = Operator(scene, grid).rows(chosen)
    light = rows.mean(axis=1).sum(axis=0, dtype=np.float64)
    share = np.maximum(light, 0.0).reshape(grid.shape).sum(axis=2)
    return AnglesSeen(grid, share / max(float(share.sum()), 1e-300), len(chosen))
