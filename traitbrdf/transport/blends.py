"""Materials that vary from fragment to fragment, as sums over a few tables.

Along one layer of paint a material runs along a curve, over several overlapping layers along a
surface with one dimension for each. The operator is linear in the table: where tables at corners of
a fine grid are known, so are frames of all that lies between. A point of the grid's cube lies in
the simplex of at most one more corner than there are layers (Kuhn's triangulation), so that the
number of layers has no limit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from traitbrdf.scene.scene import Scene

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Shares:
    """Points in a cube as sums over corners of a grid.

    Attributes
    ----------
    corners : (K, n) int64
        Distinct corners, in steps of the grid.
    first : (m + 1,) int64
        The entries of point p are `first[p]` to `first[p + 1]`.
    corner : (e,) int64
        Index of a corner, for each entry.
    share : (e,) float32
        Its share, above 0; those of a point add up to 1.
    """

    corners: Int64
    first: Int64
    corner: Int64
    share: Float32

    @classmethod
    def of(cls, amounts: Float32, steps: int) -> Shares:
        """Find the corners around points, and their shares.

        Parameters
        ----------
        amounts : (n, m) float32
            Coordinates of m points, in [0, 1].
        steps : int
            Of the grid along each axis.
        """
        axes, count = amounts.shape
        place = amounts.astype(np.float64) * steps
        low = np.floor(place)
        rest = place - low
        order = np.argsort(-rest, axis=0, kind="stable")
        rest = np.take_along_axis(rest, order, axis=0)
        bounds = np.concatenate([np.ones((1, count)), rest, np.zeros((1, count))])
        share = (bounds[:-1] - bounds[1:]).T
        # from the lowest corner, one axis after the other goes a step on
        taken = np.zeros((axes + 1, axes, count), np.int64)
        for i in range(axes):
            taken[i + 1] = taken[i]
            np.put_along_axis(taken[i + 1], order[i : i + 1], 1, axis=0)
        point, entry = np.nonzero(share)
        whole = low.astype(np.int64)[:, point] + taken[entry, :, point].T
        corners, corner = _distinct(whole, steps + 1)
        first = np.searchsorted(point, np.arange(count + 1))
        return cls(corners, first, corner, share[point, entry].astype(np.float32))


def _distinct(whole: Int64, base: int) -> tuple[Int64, Int64]:
    """Return the distinct columns (K, n) of numbers (n, e) below `base`, and which each is."""
    code = np.zeros(whole.shape[1], np.int64)
    room = 1
    for row in whole:
        if room > (1 << 62) // base:  # number what there is, to make room
            _, code = np.unique(code, return_inverse=True)
            room = len(code) + 1
        code = code * base + row
        room *= base
    _, where, corner = np.unique(code, return_index=True, return_inverse=True)
    return np.ascontiguousarray(whole[:, where].T), corner.astype(np.int64)


@dataclass(frozen=True, eq=False)
class Blend:
    """Fragments of a part that have materials of their own.

    Attributes
    ----------
    at : (m,) int64
        Which fragments of the part.
    shares : Shares, of these fragments
    tables : sequence of (cells, 3) float32
        f_r in 1/sr at each corner.
    mirrors : (K, 3) float32
        Weight of a perfect mirror there.
    """

    at: Int64
    shares: Shares
    tables: Sequence[Float32]
    mirrors: Float32

    def of(self, corner: int) -> tuple[Int64, Float32]:
        """Return the fragments (among `at`) that a corner has a share in, and these shares."""
        entries = np.flatnonzero(self.shares.corner == corner)
        point = np.searchsorted(self.shares.first, entries, side="right") - 1
        return point, self.shares.share[entries]

    def sums(self, shown: Float32) -> Float32:
        """Return what fragments show (m, 3), given that under each of the tables (m, K, 3)."""
        point = np.repeat(np.arange(len(self.at)), np.diff(self.shares.first))
        terms = self.shares.share[:, None] * shown[point, self.shares.corner]
        whole = np.zeros((len(self.at), 3), np.float32)
        np.add.at(whole, point, terms)
        return whole

    def mirror(self) -> Float32:
        """Return the weight (m, 3) of a perfect mirror at each of the fragments."""
        return self.sums(np.broadcast_to(self.mirrors, (len(self.at), *self.mirrors.shape)))


def has_mirrors(
    mirrors: Sequence[Float64] | None, blends: Mapping[int, Blend] | None = None
) -> bool:
    """Return whether any material has a perfect mirror.

    Parameters
    ----------
    mirrors : sequence of (3,) or None
        Weight of a perfect mirror on each part; None is no mirrors, on blends neither.
    blends : mapping of part to Blend, or None
    """
    if mirrors is None:
        return False
    some = any(np.any(blend.mirrors) for blend in (blends or {}).values())
    return some or any(np.any(mirror) for mirror in mirrors)


def mirror_weights(
    scene: Scene, mirrors: Sequence[Float64], blends: Mapping[int, Blend] | None = None
) -> Float32:
    """Return the weight (P, 3) of a perfect mirror at each fragment of a scene.

    Parameters
    ----------
    scene : Scene
    mirrors : sequence of (3,), one for each part
    blends : mapping of part to Blend, or None
    """
    weight = np.stack([np.asarray(m, np.float32) for m in mirrors])[scene.pixel_part]
    for part, blend in (blends or {}).items():
        weight[scene.part_slice(part)][blend.at] = blend.mirror()
    return weight
