"""Samples in groups that share one walk of the light tree.

Neighbouring samples whose half vectors hardly differ see the same leaves, so a group walks the tree
once, for its middle.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


class Bundles(NamedTuple):
    """Samples in groups that share one walk, and groups in bundles that are shaded together.

    All samples of a fragment are in one bundle.

    Attributes
    ----------
    bundle_start : (B + 1,) int64, where bundles start among the groups
    group_start : (G + 1,) int64, where groups start among the samples
    target : (n,) int64, the fragment that each sample belongs to
    normals, views : (n, 3) float32 unit vectors in the map's frame
    share : (n,) float32, of each sample in its fragment
    sample : (n,) int64, indices of the samples in the scene
    middle_normals, middle_views : (G, 3) float32, means of the groups
    spread : (G,) float32
        How far half vectors against the normals differ within each group, in radians.
    masks : (G, 4) int32 visibility rows, -1 for none
    several : (G,) bool, whether the fragment has other groups
    """

    bundle_start: Int64
    group_start: Int64
    target: Int64
    normals: Float32
    views: Float32
    share: Float32
    sample: Int64
    middle_normals: Float32
    middle_views: Float32
    spread: Float32
    masks: NDArray[np.int32]
    several: NDArray[np.bool_]

    def of(self, place: Int64) -> Bundles:
        """Return the samples of some fragments alone, in their groups.

        Parameters
        ----------
        place : (fragments,) int64
            The new number of each fragment; those of -1 are left out.
        """
        target = place[self.target]
        kept = target >= 0
        left = np.concatenate([[0], np.cumsum(kept)])[self.group_start]
        return self._replace(
            group_start=left, target=target[kept], normals=self.normals[kept],
            views=self.views[kept], share=self.share[kept], sample=self.sample[kept],
        ).take(np.diff(left) > 0)  # fmt: skip

    def separated(self) -> Bundles:
        """Return each sample in a group of its own."""
        size = np.diff(self.group_start)
        starts = np.arange(len(self.target) + 1)
        return self._replace(
            bundle_start=self.group_start[self.bundle_start], group_start=starts,
            middle_normals=self.normals, middle_views=self.views,
            spread=np.zeros(len(self.target), np.float32),
            masks=np.repeat(self.masks, size, axis=0), several=np.repeat(self.several, size),
        )  # fmt: skip

    def pieces(self, samples: int) -> Iterator[Bundles]:
        """Return bundles of about so many samples together, one piece after the other."""
        first = self.group_start[self.bundle_start[:-1]]
        which = np.repeat(first // samples, np.diff(self.bundle_start))
        for piece in np.unique(which):
            yield self.take(which == piece)

    def take(self, groups: NDArray[np.bool_]) -> Bundles:
        """Return the groups of a mask (G,) alone."""
        kept = np.flatnonzero(groups)
        samples, group_start = expand(self.group_start, kept)
        bundle = np.repeat(np.arange(len(self.bundle_start) - 1), np.diff(self.bundle_start))[kept]
        bundle_start = np.append(np.flatnonzero(np.diff(bundle, prepend=-1)), len(kept))
        return Bundles(
            bundle_start, group_start, self.target[samples], self.normals[samples],
            self.views[samples], self.share[samples], self.sample[samples],
            self.middle_normals[kept], self.middle_views[kept], self.spread[kept],
            self.masks[kept], self.several[kept],
        )  # fmt: skip


def expand(starts: Int64, chosen: Int64) -> tuple[Int64, Int64]:
    """Select some sets of a list that is divided into sets.

    Parameters
    ----------
    starts : (sets + 1,) int64
        Set k holds the members `starts[k]` to `starts[k + 1] - 1`.
    chosen : (m,) int64
        Sets to select.

    Returns
    -------
    members : (n,) int64 members of the chosen sets, one set after the other
    new : (m + 1,) int64 where these sets start among `members`
    """
    size = np.diff(starts)[chosen]
    new = np.concatenate([[0], np.cumsum(size)])
    members = np.arange(new[-1]) - np.repeat(new[:-1] - starts[chosen], size)
    return members, new


def alike_masks(
    edge: Int64,
    size: Int64,
    normals: Float32,
    views: Float32,
    positions: Float64,
    masks: NDArray[np.int32],
    limit: float,
) -> NDArray[np.bool_]:
    """Return whether the members of each set can share one walk of the light tree.

    They can if their half vectors nearly agree, they lie on one sheet of the surface, and their
    visibility masks are the same.

    Parameters
    ----------
    edge, size : (sets,) int64
        First member of each set, and its number of members.
    normals, views : (n, 3) float32 unit vectors of the members
    positions : (n, 3) float64
    masks : (n, 4) int32 visibility rows, -1 for none
    limit : float
        How far half vectors may differ, in radians.

    Returns
    -------
    (sets,) bool
    """
    whose = np.repeat(np.arange(len(edge)), size)

    def away(values: NDArray[Any]) -> tuple[Float64, Float64]:
        mean = np.add.reduceat(values.astype(np.float64), edge, axis=0) / size[:, None]
        off = values - mean[whose]
        return off, np.linalg.norm(off, axis=-1)

    _, turned = away(normals)
    _, moved = away(views)
    apart, distance = away(positions)
    # on one sheet of the surface
    lifted = np.abs(np.einsum("nk,nk->n", apart, normals)) > 0.3 * distance + 1e-9
    good = (turned + 0.5 * moved <= limit) & ~lifted
    masked = masks[:, 0] >= 0
    highest = np.maximum.reduceat(masks, edge, axis=0)[whose]
    good &= ~masked | (masks == highest).all(axis=1)
    answer: NDArray[np.bool_] = np.logical_and.reduceat(good, edge)
    return answer


def centres(
    group_start: Int64, normals: Float32, views: Float32
) -> tuple[Float32, Float32, Float32]:
    """Average the normals and views of groups of samples.

    Parameters
    ----------
    group_start : (G + 1,) int64 where groups start among the samples
    normals, views : (n, 3) float32 unit vectors of the samples

    Returns
    -------
    normals, views : (G, 3) float32 mean unit vectors
    spread : (G,) float32
        How far the half vectors of the members depart from that of the means, in radians.
    """
    size = np.diff(group_start)
    means = []
    off = np.zeros(len(normals))
    for values, weight in ((normals, 1.0), (views, 0.5)):
        mean = np.add.reduceat(values.astype(np.float64), group_start[:-1], axis=0)
        mean /= np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-12)
        off += weight * np.linalg.norm(values - np.repeat(mean, size, axis=0), axis=-1)
        means.append(mean.astype(np.float32))
    spread = np.maximum.reduceat(off, group_start[:-1])
    spread[size == 1] = 0.0
    return means[0], means[1], spread.astype(np.float32)


def first_rows(group_start: Int64, masks: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the mask rows (G, 4) of groups, from those (n, 4) of their members.

    All members of a group that have masks have the same.
    """
    rows: NDArray[np.int32] = np.maximum.reduceat(masks, group_start[:-1], axis=0)
    return rows


def questions(ask: Float32, asked: Int64) -> tuple[Float64, tuple[Int64, Int64]]:
    """Return the unit directions of all questions, and the group and number of each.

    Parameters
    ----------
    ask : (groups, most, 3) float32 directions
    asked : (groups,) int64 number of each group's questions
    """
    sample, question = np.nonzero(np.arange(ask.shape[1]) < asked[:, None])
    toward = ask[sample, question].astype(np.float64)
    toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
    return toward, (sample.astype(np.int64), question.astype(np.int64))
