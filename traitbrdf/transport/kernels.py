"""Compiled loops of the walk over the light."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np

f32 = np.float32
_UNKNOWN, _LIT, _DOUBTFUL, _PARTLY = 0, 1, 2, 3


# The loops below are what torch cannot express: tree descents, and sums over lists of uneven
# length. Numba compiles them; everything that runs while a user paints is torch, on any device.


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

    place: Any
    moment: Any
    child: Any
    box: Any
    image: Any


class VisibilityMasks(NamedTuple):
    """Shared visibility of the nodes of one cut, 64 nodes in a word.

    Attributes
    ----------
    first, last : (n,) int32
        The cut nodes under (or above) a node of the tree are `first` to `last - 1`.
    hidden, unseen, unhidden : (rows, words) uint64
        Nodes that are hidden, that are not surely visible, that are not surely hidden.
    """

    first: Any
    last: Any
    hidden: Any
    unseen: Any
    unhidden: Any


class QuadratureSettings(NamedTuple):
    """How finely the walk divides the light, and which half vectors it covers.

    Attributes
    ----------
    rules : (2, 5) float32
        Greatest extent of a node relative to its distance from the mirror peak, greatest share of
        the irradiance, greatest radius at the horizon, greatest radius, and half the width of the
        narrowest peak. Lengths are in radians. The first row holds for groups that make up their
        fragment alone, the second for the others.
    low, high : float32
        Bounds of sin(theta_h).
    outline : float32
        sin(theta_h) up to which leaves at the outline of an occluder cast rays of their own.
    lobe : float32
        sin(theta_h) within which the tables hardly change.
    capacity : int
        Most leaves of a group.
    """

    rules: Any
    low: Any
    high: Any
    outline: Any
    lobe: Any
    capacity: Any


class Questions(NamedTuple):
    """Shadow rays that a walk asks for, and their answers.

    Attributes
    ----------
    ask : (groups, most, 3) float32
        Directions of the rays, in the map's frame; the walk writes them.
    answers : (groups, most) uint8
        1 where light passes.
    final : bool
        Whether the answers are known. If not, groups with questions are left out.
    """

    ask: Any
    answers: Any
    final: Any


class Tables(NamedTuple):
    """Scalar tables on a grid of half and difference angles.

    Attributes
    ----------
    n_h, n_d, n_p : int
        Numbers of nodes along theta_h, theta_d and phi_d.
    values : (n_h * n_d * n_p, T) float32
        T tables. Without a column (T = 0), rows of the operator are computed, not radiance.
    """

    n_h: Any
    n_d: Any
    n_p: Any
    values: Any


class _Frame(NamedTuple):
    """What a group of samples shares: mean unit normal and view, mask rows (4,), and the greatest
    departure of the members' half vectors, in radians."""

    normal: Any
    viewer: Any
    mask: Any
    spread: Any


class _Pending(NamedTuple):
    """Stacks of a walk: nodes and what is known of their visibility, and pieces (n, 6) of texels."""

    stack: Any
    fates: Any
    cells: Any


class _Sample(NamedTuple):
    """Unit normal and view of a sample, and its share of the fragment."""

    normal: Any
    viewer: Any
    share: Any


class _Stencil(NamedTuple):
    """Where leaves fall in a table: see `_stencils`."""

    cell: Any
    place: Any


class _Row(NamedTuple):
    """A row of the operator: values (cells, 4), RGB and a filler, and the pairs of theta_h and
    theta_d that hold something: `touched[0]` lists them, `touched[1]` is 1 at each."""

    values: Any
    touched: Any


@numba.njit(cache=True, nogil=True)
def cut_ranges(child: Any, split: Any) -> Any:
    """Ranges of cut nodes under every node, in the order of a descent, and the cut itself."""
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
        if done[i]:  # its children are through
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


@numba.njit(parallel=True, cache=True, nogil=True)
def inherit(
    bits: Any, normals: Any, toward: Any, known: Any, around: Any, least: Any, sharp: Any
) -> None:
    """Bits that all rows around agree on, 2 below the horizon, 3 where a ray is needed."""
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
                        b = known[around[p, k], d]
                        if b == 2 or (value != 3 and b != value):
                            value = 3
                            break
                        value = b
            bits[p, d] = value


@numba.njit(parallel=True, cache=True, nogil=True)
def pack_bits(bits: Any, neighbours: Any, hidden: Any, unseen: Any, unhidden: Any) -> None:
    """Sets of nodes that are hidden, not surely visible, not surely hidden."""
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


@numba.njit(cache=True, inline="always")
def _some(words: Any, row: Any, start: Any, stop: Any, wanted: Any) -> Any:
    """Whether any of the bits start to stop - 1 of a row is `wanted`."""
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


@numba.njit(parallel=True, cache=True, nogil=True)
def disagreement(out: Any, bits: Any, cells: Any, normals: Any, toward: Any, share: Any) -> None:
    """How unevenly the corners of a cell are lit: root of the summed squares of the shares of
    irradiance that some see and others do not. Many small ones vary evenly; a large one jumps."""
    for p in numba.prange(len(cells)):
        total, unlike = 1e-30, 0.0
        for d in range(bits.shape[1]):
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
                    b = bits[cells[p, k], d]
                    seen += b == 1
                    blocked += b == 0
            if seen > 0:
                total += share[d] * cos
                if blocked > 0:
                    unlike += (share[d] * cos) ** 2
        out[p] = math.sqrt(unlike) / total


@numba.njit(parallel=True, cache=True, nogil=True)
def interpolate_masks(out: Any, coarse: Any, corners: Any, weights: Any) -> None:
    for p in numba.prange(len(out)):
        for c in range(out.shape[1]):
            for j in range(out.shape[2]):
                out[p, c, j] = weights[p, 0] * coarse[corners[p, 0], c, j]
            for k in range(1, 4):
                if weights[p, k] != 0.0:
                    w, q = weights[p, k], corners[p, k]
                    for j in range(out.shape[2]):
                        out[p, c, j] += w * coarse[q, c, j]


@numba.njit(cache=True, inline="always")
def _push_texels(cells: Any, top: Any, box: Any, t_step: Any, f_step: Any) -> Any:
    """Put the texels of a leaf on the stack `cells`, as offsets from its middle, each with the row
    and the column it is of; returns the stack's new top."""
    row, column = 0.5 * (box[0] + box[1]), 0.5 * (box[2] + box[3])
    for i in range(box[0], box[1]):
        for j in range(box[2], box[3]):
            top += 1
            cells[top, 0], cells[top, 1] = (i - row) * t_step, (i + 1 - row) * t_step
            cells[top, 2], cells[top, 3] = (j - column) * f_step, (j + 1 - column) * f_step
            cells[top, 4], cells[top, 5] = i, j
    return top


@numba.njit(cache=True, inline="always")
def _push_quarters(cells: Any, top: Any, t0: Any, t1: Any, f0: Any, f1: Any) -> Any:
    """Put the quarters of the piece above the stack `cells` on it; returns its new top."""
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


@numba.njit(cache=True, inline="always")
def _turned(angle: Any, sine: Any, cosine: Any) -> Any:
    """Sine and cosine after turning by a small angle (at most 0.4)."""
    x = angle * angle
    s = angle * (f32(1.0) - x * (f32(1 / 6) - x * (f32(1 / 120) - x * f32(1 / 5040))))
    c = f32(1.0) - x * (f32(0.5) - x * (f32(1 / 24) - x * (f32(1 / 720) - x * f32(1 / 40320))))
    return sine * c + cosine * s, cosine * c - sine * s


@numba.njit(cache=True, error_model="numpy", fastmath=True, nogil=True)
def _coarse_irradiance(n: Any, place: Any, moment: Any, child: Any, stack: Any) -> Any:
    """Irradiance (summed over colours) to some percent: what bright nodes are measured against."""
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


@numba.njit(cache=True, error_model="numpy", fastmath=True, nogil=True)
def _walk(
    leaves: Any, ask: Any, answers: Any, frame: Any, tree: Any, masks: Any, wanted: Any,
    pending: Any,
) -> Any:  # fmt: skip
    """Leaves of one group into `leaves` (13, n): direction, vector irradiance RGB, variance.

    Where a ray of its own decides on a leaf, or on all pieces of a texel, the direction is put
    into `ask` and the light let through if `answers` says so (1).

    A node is a leaf where its reach in half-vector space is at most `relative` times its distance
    from the mirror peak (or times `lobe`, where that is more) and `core`, it carries at most the
    share `brightest` of the irradiance or is accordingly smaller, it is no wider than `widest`,
    and, if the horizon cuts it, `horizon`. `low` and `high` bound sin(theta_h). All holds for half
    vectors up to `spread` away from those of `n` and `v`. Returns the number of leaves, the
    capacity if too many, and of questions.
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
        # the centroid may lie in a corner: everything is within 2 r of it
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
            # shadows: what is known of a node holds for all below it
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
                    # the texel as a whole has just been found too large
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


@numba.njit(cache=True, inline="always")
def _arctan(y: Any, x: Any) -> Any:
    """atan2 in the first quadrant, to 2e-6 of the angle (Abramowitz & Stegun 4.4.49)."""
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


@numba.njit(cache=True, error_model="numpy", fastmath=True, nogil=True)
def _stencils(sample: Any, leaves: Any, count: Any, tables: Any, stencil: Any) -> None:
    """First cells and interpolation weights of leaves: free of branches, so that it vectorises.

    cell (3, n): theta_h and theta_d of the lowest cell of the nearer theta_h sample as one index,
    how many theta_h nodes further the other one starts, and phi_d; place (7, n): fractions along
    theta_h (both samples), theta_d, phi_d, and the irradiance RGB.
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
        # in the plane of incidence h moves half as far as wi, across it 1 / (2 cos theta_d) as far
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


@numba.njit(cache=True, error_model="numpy", fastmath=True, nogil=True)
def _collect(
    whole: Any, found: Any, sample: Any, leaves: Any, count: Any, tables: Any, stencil: Any
) -> Any:
    """Add one sample's leaves to a row in which `found` pairs of theta_h and theta_d hold something.

    Returns how many do now.
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
                    row[k, 3] += w0  # nothing reads it, but four are one vector
                    row[k + 1, 0] += w1 * e0
                    row[k + 1, 1] += w1 * e1
                    row[k + 1, 2] += w1 * e2
                    row[k + 1, 3] += w1
    return found


@numba.njit(cache=True, error_model="numpy", fastmath=True, nogil=True)
def _release(out: Any, whole: Any, found: Any, shown: Any) -> None:
    """Add a row to `out`: (3, T) its radiance under tables (cells, T), or (3, cells) itself where
    `tables` has no column; then clear it."""
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


@numba.njit(parallel=True, cache=True, error_model="numpy", nogil=True)
def one_leaf(
    out: Any, starts: Any, normals: Any, views: Any, share: Any, leaves: Any, tables: Any
) -> None:
    """Add one leaf (13, 1) a sample: to radiance, or to rows where `tables` has no column."""
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


@numba.njit(parallel=True, cache=True, error_model="numpy", nogil=True)
def shade_rows(
    out: Any, asked: Any, questions: Any, bundles: Any, tree: Any, masks: Any, settings: Any,
    tables: Any,
) -> None:  # fmt: skip
    """Add the leaves of all groups: to radiance, or to rows where `tables` has no column.

    Sets `asked` (groups,) to the number of each group's questions. Unless the answers are final,
    groups with questions are left out; groups with more leaves than the capacity always are, and
    `asked` is -1 for them.
    """
    # arrays that are set in a parallel loop are arguments of their own: numba takes an assignment
    # to an array of a tuple for dead code
    block = 16
    count_of = len(bundles.bundle_start) - 1
    n_h, n_d, n_p = tables.n_h, tables.n_d, tables.n_p
    capacity, final = settings.capacity, questions.final
    for u in numba.prange((count_of + block - 1) // block):
        pending = _Pending(
            np.empty(512, np.int32), np.empty(512, np.int8), np.empty((512, 6), np.float32)
        )
        leaves = np.empty((13, capacity), np.float32)
        stencil = _Stencil(np.empty((3, capacity), np.int32), np.empty((7, capacity), np.float32))
        # every sample of a fragment goes into one row: its neighbours touch the same cells
        row = _Row(np.zeros((n_h * n_d * n_p, 4), np.float32), np.zeros((2, n_h * n_d), np.int32))
        found, current = 0, -1
        first = bundles.bundle_start[u * block]
        last = bundles.bundle_start[min(u * block + block, count_of)]
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
