"""The light of an environment map as a tree of rectangles.

This is the light tree of Walter et al. 2005 (Lightcuts, section 3.1), except that a node stores the
exact vector irradiance of its texels, not one representative light.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from traitbrdf.scene.lights import EnvironmentMap, texel_moments

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]

ROWS = 1024
"""Most rows of leaves of a light tree: a node takes some 300 bytes."""

_BLOCK = 16
"""Most texels along the side of a leaf."""


@dataclass(frozen=True)
class LightTree:
    """An environment map as a binary tree of lat-long rectangles, the root first.

    A node's `moment` is the exact vector irradiance of its light in each colour, so that a Lambert
    surface shows no difference between a node and its texels. `direction` and `spread` are the
    mean and the standard deviation of the directions of that light. Rectangles without light are
    left out. The leaves are texels, or blocks of texels in a map of more than `ROWS` rows.

    Attributes
    ----------
    moment : (n, 3, 3) float32, integral of radiance (first axis: colour) times direction
    direction : (n, 3) float32 unit, in the map's frame
    spread : (n,) float32, standard deviation about `direction` along one axis, radians
    radius : (n,) float32, half the rectangle's diagonal, radians
    child : (n, 2) int32, indices of the halves; -1 where there is none
    rectangle : (n, 4) int32: first and last + 1 row, first and last + 1 column
    block : height and width of a leaf in texels; leaves at the last row and column may be smaller
    """

    moment: NDArray[np.float32]
    direction: NDArray[np.float32]
    spread: NDArray[np.float32]
    radius: NDArray[np.float32]
    child: NDArray[np.int32]
    rectangle: NDArray[np.int32]
    block: int = 1

    @cached_property
    def derived(self) -> dict[tuple[object, ...], Any]:
        """What others made of the tree, by names of their own; it is kept as long as the tree."""
        return {}

    @cached_property
    def packed(self) -> tuple[Float32, Float32, Int32, Int32]:
        """Arrays for the compiled walk: the first four of `arrays.TreeArrays`."""
        place = np.zeros((len(self.radius), 8), np.float32)
        place[:, :3] = self.direction
        place[:, 3] = self.radius
        place[:, 4] = self.spread**2
        moment = np.zeros((len(self.radius), 12), np.float32)
        moment[:, :9] = self.moment.reshape(-1, 9)
        box = self.rectangle
        leaf = (box[:, 1] - box[:, 0] <= self.block) & (box[:, 3] - box[:, 2] <= self.block)
        child = np.where(leaf[:, None], -2, self.child).astype(np.int32)
        return place, moment, child, box

    @cached_property
    def flux(self) -> NDArray[np.float64]:
        """Length (n,) of each node's vector irradiance, all colours together."""
        red, green, blue = self.moment.astype(np.float64).transpose(1, 0, 2)
        return np.asarray(np.linalg.norm(red + green + blue, axis=-1))

    @classmethod
    def build(cls, environment: EnvironmentMap, most_rows: int = ROWS) -> LightTree:
        """Build the tree of a map: halve rectangles across their longer side, down to leaves.

        Parameters
        ----------
        environment : EnvironmentMap
        most_rows : int
            Maps of more rows get leaves that are blocks of 2, 4, 8 or 16 texels a side.
        """
        rows, columns, _ = environment.image.shape
        block = 1
        while rows > most_rows * block and block < _BLOCK:
            block *= 2
        # until the end, rectangles are in units of blocks
        m, n = -(-rows // block), -(-columns // block)
        down = np.minimum(block * np.arange(m + 1), rows)
        across = np.minimum(block * np.arange(n + 1), columns)
        edges = environment.row_edges[down]
        levels = [np.array([[0, m, 0, n]])]
        children = []
        count = 1
        while True:
            box = levels[-1]
            tall = box[:, 1] - box[:, 0]
            wide = box[:, 3] - box[:, 2]
            height, width = _extent(box, edges, across)
            by_row = (tall > 1) & ((height >= width) | (wide == 1))
            split = (tall > 1) | (wide > 1)
            parents, lower = box[split], by_row[split]
            child = np.full((len(box), 2), -1)
            child[split] = count + np.arange(2 * len(parents)).reshape(-1, 2)
            children.append(child)
            if len(parents) == 0:
                break
            halves = np.repeat(parents, 2, axis=0)
            row = (parents[:, 0] + parents[:, 1]) // 2
            column = (parents[:, 2] + parents[:, 3]) // 2
            halves[0::2, 1] = np.where(lower, row, parents[:, 1])
            halves[1::2, 0] = np.where(lower, row, parents[:, 0])
            halves[0::2, 3] = np.where(lower, parents[:, 3], column)
            halves[1::2, 2] = np.where(lower, parents[:, 2], column)
            levels.append(halves)
            count += len(halves)
        box = np.concatenate(levels)
        child = np.concatenate(children)
        # summing from the leaves up keeps a dim sky beside a bright sun
        moment = np.zeros((len(box), 3, 3))
        flux = np.zeros(len(box))
        leaf = child[:, 0] < 0
        at = box[leaf, 0], box[leaf, 2]
        light, shine = _block_light(environment, block)
        flux[leaf] = light[at]
        moment[leaf] = shine[at]
        del light, shine
        starts = np.concatenate([[0], np.cumsum([len(level) for level in levels])])
        for start, stop in reversed(list(itertools.pairwise(starts))):
            inner = np.flatnonzero(child[start:stop, 0] >= 0) + start
            for side in (0, 1):
                moment[inner] += moment[child[inner, side]]
                flux[inner] += flux[child[inner, side]]
        white = moment.sum(axis=1)
        length = np.linalg.norm(white, axis=-1)
        lit = flux > 0.0
        # the mean of unit vectors is shorter than one by their variance about it
        mean_length = np.where(lit, length / np.where(lit, flux, 1.0), 1.0)
        spread = np.sqrt(np.maximum(1.0 - mean_length**2, 0.0) / 2.0)
        known = lit & (length > 0.0)
        unit = np.where(known[:, None], white / np.where(known, length, 1.0)[:, None], (0, 1, 0))
        child = np.where((child >= 0) & ~lit[child], -1, child)
        height, width = _extent(box, edges, across)
        box = np.concatenate([down[box[:, :2]], across[box[:, 2:]]], axis=1)
        return cls(
            moment.astype(np.float32),
            unit.astype(np.float32),
            spread.astype(np.float32),
            (0.5 * np.hypot(height, width)).astype(np.float32),
            child.astype(np.int32),
            box.astype(np.int32),
            block,
        )


def _block_light(environment: EnvironmentMap, block: int) -> tuple[Float64, Float64]:
    """Sum the light of blocks of texels.

    Returns
    -------
    light : (m, n) radiance times solid angle, all colours together
    shine : (m, n, 3, 3) vector irradiance, colour first
    """
    rows, columns, _ = environment.image.shape
    m, n = -(-rows // block), -(-columns // block)
    light, shine = np.empty((m, n)), np.empty((m, n, 3, 3))
    right = np.arange(0, columns, block)
    for band in environment.bands(block):
        texel = environment.image[band].astype(np.float64)
        energy = texel.sum(axis=-1) * environment.solid_angles[band, None]
        moment = texel[..., None] * texel_moments(environment, band)[..., None, :]
        lower = np.arange(0, len(texel), block)
        here = slice(band.start // block, band.start // block + len(lower))
        for whole, values in ((light, energy), (shine, moment)):
            whole[here] = np.add.reduceat(np.add.reduceat(values, lower, axis=0), right, axis=1)
    return light, shine


def _extent(
    box: NDArray[np.int64], edges: Float64, across: NDArray[np.int64]
) -> tuple[Float64, Float64]:
    """Return angular height and greatest width of rectangles (n, 4), in radians.

    `edges` are the polar angles of the row edges, `across` the texel columns of the column edges;
    the last of these is the number of columns.
    """
    top, bottom = edges[box[:, 0]], edges[box[:, 1]]
    widest = np.where(
        (top <= math.pi / 2) & (bottom >= math.pi / 2),
        1.0,
        np.maximum(np.sin(top), np.sin(bottom)),
    )
    texels = across[box[:, 3]] - across[box[:, 2]]
    return bottom - top, widest * texels * (2.0 * math.pi / across[-1])
