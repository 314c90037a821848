"""Compiled loops that walk the light tree and sum its leaves.

Torch cannot express these loops: they descend trees and sum lists of different lengths. Numba
compiles them. Everything that runs while a user paints is torch, on any device.

Named tuples group the arguments; `traitbrdf.transport.arrays` has those that callers make. A loop
that numba runs in parallel may write only to arrays that are arguments of their own: numba removes
an assignment to an array of a tuple as dead code.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np

from traitbrdf.compiled import CACHED
from traitbrdf.transport.arrays import (
    QuadratureSettings,
    Questions,
    Tables,
    TreeArrays,
    VisibilityMasks,
)

f32 = np.float32
_UNKNOWN, _LIT, _DOUBTFUL, _PARTLY = 0, 1, 2, 3


class _Frame(NamedTuple):
    """What the samples of one group share.

    Attributes
    ----------
    normal, viewer : (3,) float32
        Mean unit normal, and mean unit direction towards the viewer, in the map's frame.
    mask : (4,) int32
        Rows of the visibility masks; -1 ends the list.
    spread : float32
        Greatest angle in radians between the half vector of a sample and that of the means.
    """

    normal: Any
    viewer: Any
    mask: Any
    spread: Any


class _Pending(NamedTuple):
    """Stacks of a walk: what it still has to visit.

    Attributes
    ----------
    stack : (n,) int32
        Nodes.
    fates : (n,) int8
        What is known about the visibility of each node.
    cells : (n, 6) float32
        Pieces of texels: bounds of polar angle and azimuth, relative to the middle of the leaf, in
        radians; then row and column of the texel.
    """

    stack: Any
    fates: Any
    cells: Any


class _Sample(NamedTuple):
    """One sample: unit normal (3,), unit direction to the viewer (3,), share of the fragment."""

    normal: Any
    viewer: Any
    share: Any


class _Stencil(NamedTuple):
    """Where leaves fall in a table.

    Attributes
    ----------
    cell : (3, n) int32
        Index of the lowest cell (theta_h and theta_d in one) of the nearer theta_h sample; how many
        theta_h nodes further the other sample starts; lowest node of phi_d.
    place : (7, n) float32
        Fractions along theta_h (both samples), theta_d and phi_d, and the irradiance RGB.
    """

    cell: Any
    place: Any


class _Row(NamedTuple):
    """A row of the operator while it is summed.

    Attributes
    ----------
    values : (cells, 4) float32
        RGB and padding.
    touched : (2, pairs) int32
        `touched[0]` lists the pairs of theta_h and theta_d that are not zero; `touched[1]` is 1 at
        each of them.
    """

    values: Any
    touched: Any


@numba.njit(cache=CACHED, nogil=True)
def cut_ranges(child: Any, split: Any) -> Any:
    """Find the cut through a tree, and the range of cut nodes under every node.

    Parameters
    ----------
    child : (n, 2) int32
        Children of each node, -1 where there is none.
    split : (n,) bool
        Whether the cut passes below a node.

    Returns
    -------
    first, last : (n,) int32
        The cut nodes under a node are `first` to `last - 1`. A node below the cut has the one cut
        node above it.
    cut : (D,) int64
        Nodes of the cut, in the order of a depth-first descent.
    """
    n = len(child)
    first = np.zeros(n, np.int32)
    last = np.zeros(n, np.int32)
    cut = np.empty(n, np.int64)
    stack = np.empty(1024, np.int64)
    inside = np.empty(1024, np.bool_)
    found = 0
    top = 0
    stack[0] = 0
    inside[0] = False
    done = np.zeros(n, np.bool_)
    while top >= 0:
        i, below = stack[top], inside[top]
        if done[i]:  # all its children were visited
            last[i] = found
            top -= 1
            continue
        first[i] = found - 1 if below else found
        if below or not split[i]:
            if not below:
                cut[found] = i
                found += 1
                first[i] = found - 1
            below = True
        done[i] = True
        for s in range(2):
            if child[i, s] >= 0:
                top += 1
                stack[top] = child[i, s]
                inside[top] = below
    return first, last, cut[:found].copy()


@numba.njit(parallel=True, cache=CACHED, nogil=True)
def inherit(
    bits: Any, normals: Any, toward: Any, known: Any, around: Any, least: Any, sharp: Any
) -> None:
    """Set the visibility bits on which all neighbouring rows agree.

    Parameters
    ----------
    bits : (m, D) uint8
        Set to 0 (hidden), 1 (visible), 2 (below the horizon) or 3 (a ray is needed).
    normals : (m, 3) unit
    toward : (D, 3) unit directions towards the light
    known : (rows, D / 4) uint8 bits that were found before, four to a byte
    around : (m, 4) int32 neighbouring rows of `known`, -1 for none
    least : int
        With fewer rows around, every direction above the horizon needs a ray.
    sharp : (D,) bool directions that need a ray in any case
    """
    for p in numba.prange(len(bits)):
        have = 0
        for k in range(4):
            if around[p, k] >= 0:
                have += 1
        for d in range(bits.shape[1]):
            cos = (
                normals[p, 0] * toward[d, 0]
                + normals[p, 1] * toward[d, 1]
                + normals[p, 2] * toward[d, 2]
            )
            if cos < -0.06:
                bits[p, d] = 2
                continue
            value = 3
            if have >= least and not sharp[d]:
                for k in range(4):
                    if around[p, k] >= 0:
                        b = (known[around[p, k], d >> 2] >> (2 * (d & 3))) & 3
                        if b == 2 or (value != 3 and b != value):
                            value = 3
                            break
                        value = b
            bits[p, d] = value


@numba.njit(parallel=True, cache=CACHED, nogil=True)
def pack_bits(bits: Any, neighbours: Any, hidden: Any, unseen: Any, unhidden: Any) -> None:
    """Pack visibility bits into the three sets of `VisibilityMasks`.

    Parameters
    ----------
    bits : (m, D) uint8, 0 hidden, 1 visible, 2 below the horizon
    neighbours : (D, k) int32 nearest other directions
    hidden, unseen, unhidden : (m, words) uint64, which are set
    """
    for p in numba.prange(len(bits)):
        hidden[p] = 0
        unseen[p] = 0
        unhidden[p] = 0
        for d in range(bits.shape[1]):
            own = bits[p, d]
            some_seen, some_hidden = own != 0, own != 1
            for k in range(neighbours.shape[1]):
                other = bits[p, neighbours[d, k]]
                if other == 1:
                    some_seen = True
                elif other == 0:
                    some_hidden = True
            one = np.uint64(1) << np.uint64(d & 63)
            if own == 0:
                hidden[p, d >> 6] |= one
            if some_hidden:
                unseen[p, d >> 6] |= one
            if some_seen:
                unhidden[p, d >> 6] |= one


@numba.njit(cache=CACHED, inline="always")
def _some(words: Any, row: Any, start: Any, stop: Any, wanted: Any) -> Any:
    """Return whether any of the bits `start` to `stop - 1` of a row equals `wanted`."""
    ones = np.uint64(0xFFFFFFFFFFFFFFFF)
    low, high = start >> 6, (stop - 1) >> 6
    found = False
    for k in range(low, high + 1):
        word = words[row, k] if wanted else ~words[row, k]
        if k == low:
            word &= ones << np.uint64(start & 63)
        if k == high:
            word &= ones >> np.uint64(63 - ((stop - 1) & 63))
        found |= word != np.uint64(0)
    return found


@numba.njit(parallel=True, cache=CACHED, nogil=True)
def disagreement(out: Any, bits: Any, cells: Any, normals: Any, toward: Any, share: Any) -> None:
    """Measure how differently the corners of lattice cells are lit.

    The measure is the root of the summed squares of the shares of irradiance that some corners see
    and others do not. Many small shares change smoothly across a cell; one large share jumps.

    Parameters
    ----------
    out : (m,) float32, which is set
    bits : (rows, D / 4) uint8, four to a byte: 0 hidden, 1 visible, 2 below the horizon
    cells : (m, 4) int32 rows of the corners, -1 for none
    normals : (m, 3) unit
    toward : (D, 3) unit directions towards the light
    share : (D,) share of all flux
    """
    for p in numba.prange(len(cells)):
        total, unlike = 1e-30, 0.0
        for d in range(len(toward)):
            cos = (
                normals[p, 0] * toward[d, 0]
                + normals[p, 1] * toward[d, 1]
                + normals[p, 2] * toward[d, 2]
            )
            if cos <= 0.0:
                continue
            seen = 0
            blocked = 0
            for k in range(4):
                if cells[p, k] >= 0:
                    b = (bits[cells[p, k], d >> 2] >> (2 * (d & 3))) & 3
                    seen += b == 1
                    blocked += b == 0
            if seen > 0:
                total += share[d] * cos
                if blocked > 0:
                    unlike += (share[d] * cos) ** 2
        out[p] = math.sqrt(unlike) / total


@numba.njit(parallel=True, cache=CACHED, nogil=True)
def interpolate_images(out: Any, coarse: Any, corners: Any, weights: Any) -> None:
    """Add images that are interpolated between the fragments where they were computed.

    Parameters
    ----------
    out : (P, 3, T) float32, to which they are added
    coarse : (K, 3, T) float32 radiance of the computed fragments
    corners : (P, k) int32 indices into `coarse`
    weights : (P, k) float32
    """
    for p in numba.prange(len(out)):
        for k in range(corners.shape[1]):
            w, q = weights[p, k], corners[p, k]
            if w != 0.0:
                for c in range(out.shape[1]):
                    for j in range(out.shape[2]):
                        out[p, c, j] += w * coarse[q, c, j]


@numba.njit(cache=CACHED, inline="always")
def _push_texels(cells: Any, top: Any, box: Any, t_step: Any, f_step: Any) -> Any:
    """Push the texels of a leaf on the stack `cells`, and return the new top.

    Their bounds are relative to the middle of the leaf `box`; `t_step` and `f_step` are height and
    width of a texel in radians.
    """
    row, column = 0.5 * (box[0] + box[1]), 0.5 * (box[2] + box[3])
    for i in range(box[0], box[1]):
        for j in range(box[2], box[3]):
            top += 1
            cells[top, 0], cells[top, 1] = (i - row) * t_step, (i + 1 - row) * t_step
            cells[top, 2], cells[top, 3] = (j - column) * f_step, (j + 1 - column) * f_step
            cells[top, 4], cells[top, 5] = i, j
    return top


@numba.njit(cache=CACHED, inline="always")
def _push_quarters(cells: Any, top: Any, t0: Any, t1: Any, f0: Any, f1: Any) -> Any:
    """Push the quarters of the piece just above the stack's top, and return the new top."""
    tm, fm = f32(0.5) * (t0 + t1), f32(0.5) * (f0 + f1)
    row, column = cells[top + 1, 4], cells[top + 1, 5]
    for a in range(4):
        top += 1
        cells[top, 4], cells[top, 5] = row, column
        cells[top, 0] = t0 if a < 2 else tm
        cells[top, 1] = tm if a < 2 else t1
        cells[top, 2] = f0 if a % 2 == 0 else fm
        cells[top, 3] = fm if a % 2 == 0 else f1
    return top


@numba.njit(cache=CACHED, inline="always")
def _turned(angle: Any, sine: Any, cosine: Any) -> Any:
    """Return sine and cosine of the sum of an angle and a small one (at most 0.4 radians)."""
    x = angle * angle
    s = angle * (f32(1.0) - x * (f32(1 / 6) - x * (f32(1 / 120) - x * f32(1 / 5040))))
    c = f32(1.0) - x * (f32(0.5) - x * (f32(1 / 24) - x * (f32(1 / 720) - x * f32(1 / 40320))))
    return sine * c + cosine * s, cosine * c - sine * s


@numba.njit(cache=CACHED, error_model="numpy", fastmath=True, nogil=True)
def _coarse_irradiance(n: Any, place: Any, moment: Any, child: Any, stack: Any) -> Any:
    """Estimate the irradiance, all colours together, to some percent.

    The walk compares the flux of bright nodes with it.
    """
    total = f32(0.0)
    top = 0
    stack[0] = 0
    while top >= 0:
        i = stack[top]
        top -= 1
        cos_i = n[0] * place[i, 0] + n[1] * place[i, 1] + n[2] * place[i, 2]
        if place[i, 3] > f32(0.2) and (child[i, 0] >= 0 or child[i, 1] >= 0):
            for s in range(2):
                if child[i, s] >= 0:
                    top += 1
                    stack[top] = child[i, s]
        elif cos_i > f32(0.0):
            for c in range(3):
                e = n[0] * moment[i, 3 * c] + n[1] * moment[i, 3 * c + 1]
                total += max(f32(0.0), e + n[2] * moment[i, 3 * c + 2])
    return max(total, f32(1e-30))


@numba.njit(cache=CACHED, error_model="numpy", fastmath=True, nogil=True)
def _walk(
    leaves: Any, ask: Any, answers: Any, frame: _Frame, tree: TreeArrays, masks: VisibilityMasks,
    wanted: Any, pending: _Pending,
) -> Any:  # fmt: skip
    """Write the leaves of one group, and the shadow rays that it asks for.

    A node is a leaf if all of the following hold for all half vectors up to `frame.spread` away
    from that of `frame`. Its reach in half-vector space is at most `relative` times the sum of
    `core` and its distance from the mirror peak (or `lobe`, if that is more). It carries at most
    the share `brightest` of the irradiance, or its reach is accordingly smaller. Its radius is at
    most `widest` and, if the horizon cuts it, at most `horizon`.

    Parameters
    ----------
    leaves : (13, capacity) float32
        Set to direction, vector irradiance RGB, and variance of the direction.
    ask : (most, 3) float32
        Set to the directions of shadow rays: one decides on a leaf, or on all pieces of a texel.
    answers : (most,) uint8, 1 where the ray is free
    frame : _Frame
    tree : TreeArrays
    masks : VisibilityMasks
    wanted : rule (5,) of the group, low, high, outline, lobe; see `QuadratureSettings`
    pending : _Pending

    Returns
    -------
    count : int, number of leaves; the capacity if there are too many
    asked : int, number of shadow rays
    """
    n, v, mask, spread = frame.normal, frame.viewer, frame.mask, frame.spread
    place, moment, child, box, image = tree.place, tree.moment, tree.child, tree.box, tree.image
    first, last = masks.first, masks.last
    hidden, unseen, unhidden = masks.hidden, masks.unseen, masks.unhidden
    rule, low, high, outline, lobe = wanted
    stack, fates, cells = pending.stack, pending.fates, pending.cells
    relative, brightest, horizon, widest, core = rule[0], rule[1], rule[2], rule[3], rule[4]
    t_step, f_step = math.pi / image.shape[0], 2.0 * math.pi / image.shape[1]
    row_sin = row_cos = column_sin = column_cos = f32(0.0)
    total = _coarse_irradiance(n, place, moment, child, stack)
    n0, n1, n2 = n[0], n[1], n[2]
    v0, v1, v2 = v[0], v[1], v[2]
    rows = 0
    while rows < 4 and mask[rows] >= 0:
        rows += 1
    count = 0
    asked = 0
    top = 0
    stack[0] = 0
    fates[0] = _UNKNOWN if rows > 0 else _LIT
    fate = _LIT
    seen = f32(1.0)
    piece = -1
    texel = row = column = 0
    while top >= 0 or piece >= 0:
        in_texel = piece >= 0
        t0 = t1 = f0 = f1 = st = m0 = m1 = m2 = f32(0.0)
        if in_texel:
            i = texel
            t0, t1, f0, f1 = cells[piece, 0], cells[piece, 1], cells[piece, 2], cells[piece, 3]
            row, column = int(cells[piece, 4]), int(cells[piece, 5])
            piece -= 1
            st, ct = _turned(f32(0.5) * (t0 + t1), row_sin, row_cos)
            sf, cf = _turned(f32(0.5) * (f0 + f1), column_sin, column_cos)
            cx, cy, cz = -st * sf, ct, st * cf
            dt, df = t1 - t0, st * (f1 - f0)
            r = f32(0.5) * f32(math.sqrt(dt * dt + df * df))
            variance = r * r / f32(6.0)
        else:
            i = int(stack[top])
            top -= 1
            cx, cy, cz = place[i, 0], place[i, 1], place[i, 2]
            r, variance = place[i, 3], place[i, 4]
        cos_i = n0 * cx + n1 * cy + n2 * cz
        # the centroid may lie in a corner: the node reaches at most 2 r from it
        if cos_i < f32(-2.0) * r - spread:
            continue
        hx, hy, hz = cx + v0, cy + v1, cz + v2
        length = f32(math.sqrt(hx * hx + hy * hy + hz * hz))
        px, py, pz = hy * n2 - hz * n1, hz * n0 - hx * n2, hx * n1 - hy * n0
        sin_h = f32(math.sqrt(px * px + py * py + pz * pz)) / max(length, f32(1e-6))
        reach = r / max(length, f32(0.15))
        nearest = sin_h - f32(2.0) * reach - spread
        if nearest > high or sin_h + f32(2.0) * reach + spread < low:
            continue
        if not in_texel:
            # what is known about a node's visibility holds for all nodes below it
            fate = fates[top + 1]
            if fate == _UNKNOWN:
                d0, d1 = first[i], last[i]
                if nearest > outline:
                    some_hidden, some_lit = False, False
                    for k in range(rows):
                        some_hidden |= _some(hidden, mask[k], d0, d1, True)
                        some_lit |= _some(hidden, mask[k], d0, d1, False)
                    if not some_lit:
                        continue
                    if not some_hidden:
                        fate = _LIT
                    elif d1 - d0 == 1:
                        fate = _PARTLY
                else:
                    some_hidden, some_lit = False, False
                    for k in range(rows):
                        some_hidden |= _some(unseen, mask[k], d0, d1, True)
                        some_lit |= _some(unhidden, mask[k], d0, d1, True)
                    if not some_lit:
                        continue
                    if not some_hidden:
                        fate = _LIT
                    elif d1 - d0 == 1:
                        fate = _DOUBTFUL
            seen = f32(1.0)
            if fate == _PARTLY or (fate == _DOUBTFUL and nearest > outline):
                for k in range(rows):
                    if _some(hidden, mask[k], first[i], last[i], True):
                        seen -= f32(1.0) / f32(rows)
        if in_texel:
            half, _ = _turned(f32(0.5) * (t1 - t0), f32(0.0), f32(1.0))
            # the mean of its directions is shorter than one by half their variance
            omega = f32(2.0) * st * half * (f1 - f0) * (f32(1.0) - variance)
            m0 = image[row, column, 0] * omega
            m1 = image[row, column, 1] * omega
            m2 = image[row, column, 2] * omega
            flux = (m0 + m1 + m2) * cos_i
        else:
            flux = (
                n0 * (moment[i, 0] + moment[i, 3] + moment[i, 6])
                + n1 * (moment[i, 1] + moment[i, 4] + moment[i, 7])
                + n2 * (moment[i, 2] + moment[i, 5] + moment[i, 8])
            )
        allowed = relative * (max(sin_h - reach - spread, lobe) + core)
        share = flux / total
        if share > brightest:
            allowed *= max(f32(0.25), f32(math.sqrt(brightest / share)))
        if (
            reach > allowed
            or r > widest
            or (not in_texel and fate == _UNKNOWN)
            or (abs(cos_i) < f32(2.0) * r + spread and r > horizon)
        ):
            if in_texel:
                if piece + 4 < len(cells) and r > f32(1e-5):
                    piece = _push_quarters(cells, piece, t0, t1, f0, f1)
                    continue
            elif child[i, 0] == -2:
                if fate == _DOUBTFUL and nearest <= outline and asked < len(ask):
                    # one ray for the whole texel
                    ask[asked, 0], ask[asked, 1], ask[asked, 2] = cx, cy, cz
                    seen = f32(answers[asked])
                    asked += 1
                    fate = _LIT
                texel = i
                t, f = (
                    0.5 * (box[i, 0] + box[i, 1]) * t_step,
                    0.5 * (box[i, 2] + box[i, 3]) * f_step,
                )
                row_sin, row_cos = f32(math.sin(t)), f32(math.cos(t))
                column_sin, column_cos = f32(math.sin(f)), f32(math.cos(f))
                piece = _push_texels(cells, piece, box[i], t_step, f_step)
                if box[i, 1] - box[i, 0] == 1 and box[i, 3] - box[i, 2] == 1:
                    # the leaf is this one texel, which was just found too large
                    t, f = f32(0.5 * t_step), f32(0.5 * f_step)
                    piece = _push_quarters(cells, piece - 1, -t, t, -f, f)
                continue
            else:
                for s in range(2):
                    if child[i, s] >= 0:
                        top += 1
                        stack[top] = child[i, s]
                        fates[top] = fate
                continue
        if cos_i <= -spread:
            continue
        if fate == _DOUBTFUL and nearest <= outline and asked < len(ask) and not in_texel:
            ask[asked, 0], ask[asked, 1], ask[asked, 2] = cx, cy, cz
            seen = f32(answers[asked])
            asked += 1
        if seen == f32(0.0):
            continue
        if count == leaves.shape[1]:
            return count, asked
        leaves[0, count], leaves[1, count], leaves[2, count] = cx, cy, cz
        if in_texel:
            m0, m1, m2 = m0 * seen, m1 * seen, m2 * seen
            leaves[3, count], leaves[4, count], leaves[5, count] = m0 * cx, m0 * cy, m0 * cz
            leaves[6, count], leaves[7, count], leaves[8, count] = m1 * cx, m1 * cy, m1 * cz
            leaves[9, count], leaves[10, count], leaves[11, count] = m2 * cx, m2 * cy, m2 * cz
        else:
            for k in range(9):
                leaves[3 + k, count] = seen * moment[i, k]
        leaves[12, count] = variance
        count += 1
    return count, asked


@numba.njit(cache=CACHED, inline="always")
def _arctan(y: Any, x: Any) -> Any:
    """Return atan2 in the first quadrant, to 2e-6 of the angle (Abramowitz & Stegun 4.4.49)."""
    t = min(x, y) / max(max(x, y), f32(1e-30))
    s = t * t
    a = f32(-0.0040540580)
    a = a * s + f32(0.0218612288)
    a = a * s + f32(-0.0559098861)
    a = a * s + f32(0.0964200441)
    a = a * s + f32(-0.1390853351)
    a = a * s + f32(0.1994653599)
    a = a * s + f32(-0.3332985605)
    a = a * s + f32(0.9999993329)
    a *= t
    return a if y <= x else f32(0.5 * math.pi) - a


@numba.njit(cache=CACHED, error_model="numpy", fastmath=True, nogil=True)
def _stencils(sample: _Sample, leaves: Any, count: Any, tables: Tables, stencil: _Stencil) -> None:
    """Set the cells and interpolation weights of the first `count` leaves of a sample.

    The loop has no branches, so that the compiler vectorises it.
    """
    n, v = sample.normal, sample.viewer
    n_h, n_d, n_p = tables.n_h, tables.n_d, tables.n_p
    cell, place = stencil.cell, stencil.place
    n0, n1, n2 = n[0], n[1], n[2]
    v0, v1, v2 = v[0], v[1], v[2]
    half_pi = f32(0.5 * math.pi)
    k = f32(n_h - 1)
    for q in range(count):
        cx, cy, cz = leaves[0, q], leaves[1, q], leaves[2, q]
        hx, hy, hz = cx + v0, cy + v1, cz + v2
        squared = hx * hx + hy * hy + hz * hz
        length = f32(math.sqrt(squared))
        scale = f32(1.0) / max(length, f32(1e-6))
        px, py, pz = hy * n2 - hz * n1, hz * n0 - hx * n2, hx * n1 - hy * n0
        px, py, pz = px * scale, py * scale, pz * scale
        sin_h = f32(math.sqrt(px * px + py * py + pz * pz))
        cos_h = (hx * n0 + hy * n1 + hz * n2) * scale
        cos_i = n0 * cx + n1 * cy + n2 * cz
        dx, dy, dz = cx - v0, cy - v1, cz - v2
        theta_d = _arctan(f32(math.sqrt(dx * dx + dy * dy + dz * dz)), length)
        theta_h = _arctan(sin_h, max(cos_h, f32(0.0)))
        across = abs(cx * px + cy * py + cz * pz)
        along = abs(f32(0.5) * length * cos_h - cos_i)
        phi_d = _arctan(across, along)
        y = theta_d * (f32(n_d - 1) / half_pi)
        b0 = min(np.int32(y), np.int32(n_d - 2))
        z = phi_d * (f32(n_p - 1) / half_pi)
        c0 = min(np.int32(z), np.int32(n_p - 2))
        # h moves half as far as wi in the plane of incidence, 1 / (2 cos theta_d) as far across
        stretch = f32(4.0) / max(squared, f32(0.01))
        ss = across * across / max(across * across + along * along, f32(1e-30))
        outward = f32(0.25) * leaves[12, q] * ((f32(1.0) - ss) + ss * stretch)
        sideways = f32(0.25) * leaves[12, q] * (ss + (f32(1.0) - ss) * stretch)
        middle = f32(math.sqrt(theta_h * theta_h + sideways))
        delta = f32(math.sqrt(outward))
        near = min(abs(middle - delta), half_pi)
        a0 = min(np.int32(f32(math.sqrt(near / half_pi)) * k), np.int32(n_h - 2))
        start = f32(a0) * f32(a0)
        fa = (near / half_pi * k * k - start) / (f32(2.0) * f32(a0) + f32(1.0))
        far = min(middle + delta, half_pi)
        a1 = min(np.int32(f32(math.sqrt(far / half_pi)) * k), np.int32(n_h - 2))
        start = f32(a1) * f32(a1)
        fb = (far / half_pi * k * k - start) / (f32(2.0) * f32(a1) + f32(1.0))
        cell[0, q] = a0 * n_d + b0
        cell[1, q] = a1 - a0
        cell[2, q] = c0
        place[0, q] = min(max(fa, f32(0.0)), f32(1.0))
        place[1, q] = min(max(fb, f32(0.0)), f32(1.0))
        place[2, q] = min(y - f32(b0), f32(1.0))
        place[3, q] = min(z - f32(c0), f32(1.0))
        up = f32(1.0) if cos_i > f32(0.0) else f32(0.0)
        e0 = n0 * leaves[3, q] + n1 * leaves[4, q] + n2 * leaves[5, q]
        e1 = n0 * leaves[6, q] + n1 * leaves[7, q] + n2 * leaves[8, q]
        e2 = n0 * leaves[9, q] + n1 * leaves[10, q] + n2 * leaves[11, q]
        place[4, q] = max(e0, f32(0.0)) * up
        place[5, q] = max(e1, f32(0.0)) * up
        place[6, q] = max(e2, f32(0.0)) * up


@numba.njit(cache=CACHED, error_model="numpy", fastmath=True, nogil=True)
def _collect(
    whole: _Row,
    found: Any,
    sample: _Sample,
    leaves: Any,
    count: Any,
    tables: Tables,
    stencil: _Stencil,
) -> Any:
    """Add the first `count` leaves of one sample to a row.

    `found` pairs of theta_h and theta_d of the row are not zero so far; returns how many are now.
    """
    _stencils(sample, leaves, count, tables, stencil)
    row, touched = whole.values, whole.touched
    share, n_d, n_p = sample.share, tables.n_d, tables.n_p
    cell, place = stencil.cell, stencil.place
    for q in range(count):
        e0, e1, e2 = share * place[4, q], share * place[5, q], share * place[6, q]
        if e0 + e1 + e2 == f32(0.0):
            continue
        fb, fc, c = place[2, q], place[3, q], cell[2, q]
        sides = 1 if cell[1, q] == 0 else 2  # both samples may lie between the same nodes
        for side in range(sides):
            weight = f32(1.0) if sides == 1 else f32(0.5)
            fa = f32(0.5) * (place[0, q] + place[1, q]) if sides == 1 else place[side, q]
            base = cell[0, q] + side * cell[1, q] * n_d
            for a in range(2):
                wa = weight * (fa if a else f32(1.0) - fa)
                for b in range(2):
                    w1 = wa * (fb if b else f32(1.0) - fb)
                    w0 = w1 * (f32(1.0) - fc)
                    w1 *= fc
                    i = base + a * n_d + b
                    if touched[1, i] == 0:
                        touched[1, i] = 1
                        touched[0, found] = i
                        found += 1
                    k = i * n_p + c
                    row[k, 0] += w0 * e0
                    row[k, 1] += w0 * e1
                    row[k, 2] += w0 * e2
                    row[k, 3] += w0  # padding: four numbers make one vector instruction
                    row[k + 1, 0] += w1 * e0
                    row[k + 1, 1] += w1 * e1
                    row[k + 1, 2] += w1 * e2
                    row[k + 1, 3] += w1
    return found


@numba.njit(cache=CACHED, error_model="numpy", fastmath=True, nogil=True)
def _release(out: Any, whole: _Row, found: Any, shown: Tables) -> None:
    """Add a row, or its radiance under tables, to `out`; then clear the row.

    `out` is (3, T) radiance, or the row itself (3, cells) where the tables have no column.
    """
    row, touched, n_p, tables = whole.values, whole.touched, shown.n_p, shown.values
    for j in range(found):
        i = touched[0, j]
        touched[1, i] = 0
        k, end = i * n_p, i * n_p + n_p
        if tables.shape[1] == 0:
            for m in range(k, end):
                for c in range(3):
                    out[c, m] += row[m, c]
        else:
            while k + 2 < end:  # three rows of the tables for each pass over `out`
                x0, x1, x2 = row[k, 0], row[k + 1, 0], row[k + 2, 0]
                y0, y1, y2 = row[k, 1], row[k + 1, 1], row[k + 2, 1]
                z0, z1, z2 = row[k, 2], row[k + 1, 2], row[k + 2, 2]
                if x0 + x1 + x2 + y0 + y1 + y2 + z0 + z1 + z2 > f32(0.0):
                    for t in range(tables.shape[1]):
                        f0, f1, f2 = tables[k, t], tables[k + 1, t], tables[k + 2, t]
                        out[0, t] += x0 * f0 + x1 * f1 + x2 * f2
                        out[1, t] += y0 * f0 + y1 * f1 + y2 * f2
                        out[2, t] += z0 * f0 + z1 * f1 + z2 * f2
                k += 3
            while k < end:
                for c in range(3):
                    for t in range(tables.shape[1]):
                        out[c, t] += row[k, c] * tables[k, t]
                k += 1
        for m in range(i * n_p, end):
            for c in range(4):
                row[m, c] = f32(0.0)


@numba.njit(parallel=True, cache=CACHED, error_model="numpy", nogil=True)
def one_leaf(
    out: Any, starts: Any, normals: Any, views: Any, share: Any, leaves: Any, tables: Tables
) -> None:
    """Add a light that is one leaf for every sample, such as a point light.

    Parameters
    ----------
    out : (m, 3, T) or (m, 3, cells) float32
        Radiance under the tables, or rows where the tables have no column; the light is added.
    starts : (m + 1,) int64
        The samples of fragment f are `starts[f]` to `starts[f + 1] - 1`.
    normals, views : (n, 3) float32 unit vectors in the map's frame
    share : (n,) float32 share of each sample in its fragment
    leaves : (n, 13, 1) float32 direction, vector irradiance RGB, variance
    tables : Tables
    """
    block = 64
    n_h, n_d, n_p = tables.n_h, tables.n_d, tables.n_p
    for u in numba.prange((len(out) + block - 1) // block):
        stencil = _Stencil(np.empty((3, 1), np.int32), np.empty((7, 1), np.float32))
        row = _Row(np.zeros((n_h * n_d * n_p, 4), np.float32), np.zeros((2, n_h * n_d), np.int32))
        for f in range(u * block, min(u * block + block, len(out))):
            found = 0
            for p in range(starts[f], starts[f + 1]):
                sample = _Sample(normals[p], views[p], share[p])
                found = _collect(row, found, sample, leaves[p], 1, tables, stencil)
            _release(out[f], row, found, tables)


@numba.njit(parallel=True, cache=CACHED, error_model="numpy", nogil=True)
def shade_rows(
    out: Any, asked: Any, questions: Questions, bundles: Any, tree: TreeArrays,
    masks: VisibilityMasks, settings: QuadratureSettings, tables: Tables,
) -> None:  # fmt: skip
    """Add the light of all groups of samples, a bundle of groups at a time.

    Parameters
    ----------
    out : (m, 3, T) or (m, 3, cells) float32
        Radiance under the tables, or rows where the tables have no column; the light is added.
    asked : (groups,) int64
        Set to the number of each group's questions, or to -1 where a group has more leaves than
        the capacity; such groups add nothing. Groups with questions add nothing either, unless
        the answers are final.
    questions : Questions
    bundles : bundles.Bundles
    tree : TreeArrays
    masks : VisibilityMasks
    settings : QuadratureSettings
    tables : Tables
    """
    block = 16
    bundle_count = len(bundles.bundle_start) - 1
    n_h, n_d, n_p = tables.n_h, tables.n_d, tables.n_p
    capacity, final = settings.capacity, questions.final
    for u in numba.prange((bundle_count + block - 1) // block):
        pending = _Pending(
            np.empty(512, np.int32), np.empty(512, np.int8), np.empty((512, 6), np.float32)
        )
        leaves = np.empty((13, capacity), np.float32)
        stencil = _Stencil(np.empty((3, capacity), np.int32), np.empty((7, capacity), np.float32))
        # all samples of a fragment share a row, since they touch nearly the same cells
        row = _Row(np.zeros((n_h * n_d * n_p, 4), np.float32), np.zeros((2, n_h * n_d), np.int32))
        found, current = 0, -1
        first = bundles.bundle_start[u * block]
        last = bundles.bundle_start[min(u * block + block, bundle_count)]
        for g in range(first, last):
            frame = _Frame(
                bundles.middle_normals[g], bundles.middle_views[g], bundles.masks[g],
                bundles.spread[g],
            )  # fmt: skip
            wanted = (
                settings.rules[1 if bundles.several[g] else 0],
                settings.low, settings.high, settings.outline, settings.lobe,
            )  # fmt: skip
            count, rays = _walk(
                leaves, questions.ask[g], questions.answers[g], frame, tree, masks, wanted, pending
            )
            asked[g] = -1 if count == capacity else rays
            if count == capacity:
                continue
            if rays > 0 and not final:
                continue
            for p in range(bundles.group_start[g], bundles.group_start[g + 1]):
                target = bundles.target[p]
                if target != current and found > 0:
                    _release(out[current], row, found, tables)
                    found = 0
                current = target
                sample = _Sample(bundles.normals[p], bundles.views[p], bundles.share[p])
                found = _collect(row, found, sample, leaves, count, tables, stencil)
        if found > 0:
            _release(out[current], row, found, tables)
