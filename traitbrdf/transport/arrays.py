"""Named tuples of arrays and numbers that the compiled kernels take as arguments."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
UInt64 = NDArray[np.uint64]


class TreeArrays(NamedTuple):
    """The light tree as the walk reads it, and the map that the tree was built from.

    Attributes
    ----------
    place : (n, 8) float32
        Unit direction of a node's light, radius in radians, variance; the rest is padding.
    moment : (n, 12) float32
        Vector irradiance: x, y, z of red, of green, of blue; the rest is padding.
    child : (n, 2) int32
        Indices of the two halves, -1 where there is none, -2 where the node is a leaf.
    box : (n, 4) int32
        First row, last row + 1, first column, last column + 1 of a node's texels.
    image : (rows, columns, 3) float32
        Radiance of the map's texels.
    """

    place: Float32
    moment: Float32
    child: Int32
    box: Int32
    image: Float32


class VisibilityMasks(NamedTuple):
    """Shared visibility of the nodes of one cut: one bit a node, 64 nodes in a word.

    A node counts as surely visible (or surely hidden) if its nearest neighbours agree with it.

    Attributes
    ----------
    first, last : (n,) int32
        The cut nodes under (or above) a node of the tree are `first` to `last - 1`.
    hidden : (rows, words) uint64
        Nodes that are hidden.
    unseen : (rows, words) uint64
        Nodes that are not surely visible.
    unhidden : (rows, words) uint64
        Nodes that are not surely hidden.
    """

    first: Int32
    last: Int32
    hidden: UInt64
    unseen: UInt64
    unhidden: UInt64


class QuadratureSettings(NamedTuple):
    """How finely the walk divides the light, and which half vectors it covers.

    Attributes
    ----------
    rules : (2, 5) float32
        Greatest extent of a node relative to its distance from the mirror peak, greatest share of
        the irradiance, greatest radius at the horizon, greatest radius, and half the width of the
        narrowest peak. Lengths are in radians. The first row is for fragments of one or two
        samples, the second for fragments of more, whose samples share the error.
    low, high : float32
        Bounds of sin(theta_h).
    outline : float32
        sin(theta_h) up to which leaves at the outline of an occluder cast rays of their own.
    lobe : float32
        sin(theta_h) within which the tables hardly change.
    capacity : int
        Most leaves of a group.
    """

    rules: Float32
    low: np.float32
    high: np.float32
    outline: np.float32
    lobe: np.float32
    capacity: int


class Questions(NamedTuple):
    """Shadow rays that the walk asks for at the outlines of occluders, and their answers.

    Attributes
    ----------
    ask : (groups, most, 3) float32
        Directions of the rays, in the map's frame; the walk writes them.
    answers : (groups, most) uint8
        1 where light passes.
    final : bool
        Whether the answers are known. If not, groups with questions are left out.
    """

    ask: Float32
    answers: NDArray[np.uint8]
    final: bool


class Tables(NamedTuple):
    """Scalar tables on a grid of half and difference angles.

    Attributes
    ----------
    n_h, n_d, n_p : int
        Numbers of nodes along theta_h, theta_d and phi_d.
    values : (n_h * n_d * n_p, T) float32
        T tables. Without a column (T = 0), rows of the operator are computed, not radiance.
    """

    n_h: int
    n_d: int
    n_p: int
    values: Float32
