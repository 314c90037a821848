"""Shared visibility: which nodes of a cut through the light tree each fragment sees.

All fragments use one cut, chosen by the light that its nodes carry, as the global cuts of
many-light methods are (Hasan, Pellacini & Bala, "Matrix row-column sampling for the many-light
problem", ACM Transactions on Graphics 26(3), 2007, sample rows and columns of the same matrix of
lights by pixels). Neighbouring fragments share their visibility masks where these agree.
"""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from traitbrdf.scene.lights import turn_about_y
from traitbrdf.scene.scene import Scene
from traitbrdf.transport.bundles import expand
from traitbrdf.transport.kernels import cut_ranges, disagreement, inherit, pack_bits
from traitbrdf.transport.lighttree import LightTree
from traitbrdf.transport.thin import ThinShadows

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

Progress = Callable[[str, float], None]
"""Called with the stage of the work and the fraction done; may raise to cancel."""

_SCALES = (1 / 16, 1 / 8, 1 / 4, 1 / 2)
"""Factors on `_BEND`: a part that bends this much less interpolates that much narrower lobes."""

_KEPT = 0.9
"""Least share of the interpolated fragments that must remain interpolated at such a scale."""

_LEVELS = (4, 2)
"""Spacing in pixels of the lattices on which far images are computed."""

_BEND = (0.003, 0.06)
"""Greatest distance of a half vector, relative to the normal, from those of its cell's corners:
from their mean, and from each."""

_UNEVEN = 0.005
"""Greatest disagreement of a cell's corners about the light that they see; see `disagreement`."""

_ROWS = 512
"""Visibility rows that are found at a time, between two reports."""

_RAYS = 1 << 18
"""Most rays that are cast at a time."""

_AT_ONCE = 1 << 13
"""Fragments whose cells are looked at together."""

_TURNED = 0.3
"""Distance that a normal counts for where near fragments are sought, in radii of the shape."""


@dataclass(frozen=True)
class VisibilityCut:
    """A cut through the light tree: the visibility of each of its nodes is one bit.

    Attributes
    ----------
    first, last : (n,) int32
        The cut nodes under (or above) every node of the tree are `first` to `last - 1`.
    directions : (D, 3) float64, towards the light, in the map's frame
    share : (D,) float64, of all flux
    neighbours : (D, 6) int32, the nearest other directions
    """

    first: NDArray[np.int32]
    last: NDArray[np.int32]
    directions: Float64
    share: Float64
    neighbours: NDArray[np.int32]

    @classmethod
    def build(cls, tree: LightTree, spacing: float, share: float) -> VisibilityCut:
        """Build the cut whose nodes are small and carry little light.

        Parameters
        ----------
        tree : LightTree
        spacing : float
            Greatest radius of a node, in radians.
        share : float
            Greatest share of all flux in a node. Leaves of the tree may exceed both.
        """
        known: VisibilityCut | None = tree.derived.get(("cut", spacing, share))
        if known is not None:
            return known
        flux = tree.flux
        whole = (tree.child < 0).all(axis=1)
        total = max(float(flux[whole].sum()), 1e-300)
        split = ~whole & ((tree.radius > spacing) | (flux > share * total))
        first, last, cut = cut_ranges(tree.child, split)
        directions = tree.direction[cut].astype(np.float64)
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        near = min(7, len(cut))
        _, nearest = cKDTree(directions).query(directions, k=near)
        neighbours = np.repeat(np.arange(len(cut), dtype=np.int32)[:, None], 6, axis=1)
        neighbours[:, : near - 1] = np.asarray(nearest).reshape(len(cut), near)[:, 1:]
        made = cls(first, last, directions, flux[cut] / total, neighbours)
        tree.derived["cut", spacing, share] = made
        return made


class Visibility:
    """Visibility of the nodes of a cut, one bit each, at fragments where rays were cast.

    Parameters
    ----------
    scene : Scene
    cut : VisibilityCut
    middle : (fragments,) int64
        The sample that stands for each fragment.

    Attributes
    ----------
    toward : (D, 3) float64 unit world directions towards the nodes
    row_of : (fragments,) int32 row of each fragment, -1 for none
    row_of_sample : (samples,) int32 row of each sample that has one of its own, -1 for none
    rows : int, number of rows
    second_row : (fragments,) int32
        Further row of each fragment that thin shadows cover partly, -1 for none.
    second_share : (fragments,) float64
        Share of the fragment that sees what the further row says.
    """

    def __init__(self, scene: Scene, cut: VisibilityCut, middle: Int64) -> None:
        self.scene = scene
        self.cut = cut
        self.toward = turn_about_y(cut.directions, scene.environment.rotation)
        self.row_of = np.full(len(scene.pixels), -1, np.int32)
        # a fragment at a border has samples on both sides of an edge: each has its own row
        self.row_of_sample = np.full(len(scene.normals), -1, np.int32)
        self.rows = 0
        self.second_row = np.full(len(scene.pixels), -1, np.int32)
        self.second_share = np.zeros(len(scene.pixels))
        self._sharp = cut.share > 0.02  # suns, which cast sharp shadows
        self._settled = False
        self._lock = threading.Lock()  # one thread casts for the next part while another shades
        self._middle = middle
        self._bits = np.zeros((0, (len(cut.share) + 3) // 4), np.uint8)  # four to a byte
        words = (len(cut.share) + 63) // 64
        self._masks = tuple(np.zeros((0, words), np.uint64) for _ in range(3))

    @property
    def packed(self) -> NDArray[np.uint8]:
        """Bits (rows, D / 4), four to a byte: 0 hidden, 1 visible, 2 below the horizon."""
        return self._bits[: self.rows]

    def of_node(self, node: int) -> NDArray[np.uint8]:
        """Return the bits (rows,) of one node."""
        byte, place = divmod(node, 4)
        return np.asarray((self.packed[:, byte] >> (2 * place)) & 3, np.uint8)

    @property
    def masks(self) -> tuple[NDArray[np.uint64], ...]:
        """The arrays `hidden`, `unseen` and `unhidden` of `arrays.VisibilityMasks`."""
        return self._masks

    def settle(self) -> None:
        """Give back what only further fragments would take over: they would cast all their rays."""
        self._settled = True
        self._bits = self._bits[:0].copy()

    def cast(
        self,
        index: Int64,
        around: NDArray[np.int32],
        least: int,
        verify: bool = False,
        report: Callable[[], None] = lambda: None,
    ) -> None:
        """Find the bits of fragments, with rays where the rows around them disagree.

        Parameters
        ----------
        index : (m,) int64 fragments
        around : (m, 4) int32
            Rows of fragments nearby, -1 for none.
        least : int
            With fewer rows around, every node above the horizon gets a ray.
        verify : bool
            Cast an eighth of the rays on which the rows around agree, and all rays of a fragment
            where one of these proves them wrong.
        report : callable
            Is called now and then; may raise to cancel.
        """
        for i in range(0, len(index), _ROWS):
            some = slice(i, min(i + _ROWS, len(index)))
            bits = self._found(self._middle[index[some]], around[some], least, verify)
            with self._lock:
                self.row_of[index[some]] = self._append(bits)
            report()

    def around(self, index: Int64) -> Callable[[Int64], NDArray[np.int32]]:
        """Return a function of samples (m,) that returns rows (m, 4) of fragments near each.

        Parameters
        ----------
        index : (n,) int64
            Fragments; those that have rows can be near.
        """
        known = index[self.row_of[index] >= 0]
        scene, middle = self.scene, self._middle[known]

        def places(samples: Int64) -> Float64:
            apart = scene.positions[samples] / scene.shape.radius
            return np.concatenate([apart, _TURNED * scene.normals[samples]], axis=1)

        tree = cKDTree(places(middle))

        def near(samples: Int64) -> NDArray[np.int32]:
            found = np.full((len(samples), 4), -1, np.int32)
            nearest = min(4, len(known))
            if nearest:
                _, at = tree.query(places(samples), range(1, nearest + 1), workers=-1)
                found[:, :nearest] = self.row_of[known[at]]
            return found

        return near

    def cast_samples(
        self,
        index: Int64,
        fine: bool,
        near: Callable[[Int64], NDArray[np.int32]] | None = None,
    ) -> None:
        """Find the bits of every sample of fragments that have several samples.

        Parameters
        ----------
        index : (m,) int64 fragments
        fine : bool
            Cast rays for every sample. If False, a sample between the first, the middle and the
            last takes the bits on which these three agree.
        near : callable or None
            What `around` returns: the first and the last sample of a fragment take the bits on
            which the fragments near agree. None casts all of their rays.
        """
        offsets = self.scene.offsets
        count = np.diff(offsets)[index]
        index = index[(count > 1) & (self.row_of[index] >= 0)]
        known = self.row_of_sample[offsets[index]] >= 0
        index = index[~known]
        self.row_of_sample[self._middle[index]] = self.row_of[index]
        ends = np.stack([offsets[index], offsets[index + 1] - 1], axis=1)
        nothing = np.full((len(ends), 4), -1, np.int32)
        for side in (0, 1):
            beside = nothing if near is None else near(ends[:, side])
            self._cast_samples(ends[:, side], beside, 4, verify=True)
        around = nothing
        if not fine:
            around[:, 0] = self.row_of[index]
            around[:, 1:3] = self.row_of_sample[ends]
        samples, starts = expand(offsets, index)
        self._cast_samples(samples, np.repeat(around, np.diff(starts), axis=0), 3)

    def _cast_samples(
        self, samples: Int64, around: NDArray[np.int32], least: int, verify: bool = False
    ) -> None:
        """Find the bits of samples that have none; parameters as for `cast`."""
        new = self.row_of_sample[samples] < 0
        samples, around = samples[new], around[new]
        for i in range(0, len(samples), _ROWS):
            chosen = samples[i : i + _ROWS]
            bits = self._found(chosen, around[i : i + _ROWS], least, verify)
            with self._lock:
                self.row_of_sample[chosen] = self._append(bits)

    def _found(
        self, samples: Int64, around: NDArray[np.int32], least: int, verify: bool
    ) -> NDArray[np.uint8]:
        """Return the bits (m, D) of samples; parameters as for `cast`."""
        bits = np.empty((len(samples), len(self.cut.share)), np.uint8)
        normals = self.scene.normals[samples]
        if self._settled:
            around = np.full_like(around, -1)
        inherit(bits, normals, self.toward, self._bits, around, least, self._sharp)
        if verify:
            inherited = bits[:, ::8].copy()
            bits[:, ::8][inherited < 2] = 3
            self._ray(bits, samples)
            wrong = ((inherited != bits[:, ::8]) & (inherited < 2)).any(axis=1)
            bits[wrong] = np.where(bits[wrong] < 2, 3, bits[wrong])
        self._ray(bits, samples)
        return bits

    @functools.cached_property
    def thin(self) -> ThinShadows:
        """Where the shadows of thin things fall."""
        return ThinShadows(
            self.scene, np.asarray(self.toward, np.float64), self.cut.share, self.cut.neighbours
        )

    def split(self, index: Int64) -> None:
        """Give fragments near thin shadows rows that are right for the whole of their pixels.

        A fragment of one sample that sees some nodes in part gets two rows: one in which these are
        visible, for as much of the pixel as sees them in the mean, and one in which they are
        hidden. A fragment of several samples has a row for each.

        Parameters
        ----------
        index : (m,) int64 fragments that have rows
        """
        nodes, offsets = self.thin.nodes, self.scene.offsets
        single = index[~self.scene.bordering[index]]
        for i in range(0, len(single), _ROWS):
            some = single[i : i + _ROWS]
            seen = self.thin.seen(some)
            partly = (seen > 0.0) & (seen < 1.0)
            cos = self.scene.normals[offsets[some]] @ self.toward[nodes].T
            flux = np.where(partly, self.cut.share[nodes] * cos.clip(1e-6), 0.0)
            most = (seen > 0.0).astype(np.uint8)
            self.row_of[some] = self._replaced(self.row_of[some], nodes, most)
            cut = np.flatnonzero(partly.any(axis=1))
            if len(cut):
                least = (seen[cut] == 1.0).astype(np.uint8)
                self.second_row[some[cut]] = self._replaced(self.row_of[some[cut]], nodes, least)
                hidden = (flux * (1.0 - seen)).sum(axis=1) / flux.sum(axis=1).clip(1e-300)
                self.second_share[some[cut]] = hidden[cut]
        samples, _ = expand(offsets, index[self.scene.bordering[index]])
        samples = samples[self.row_of_sample[samples] >= 0]
        for i in range(0, len(samples), _ROWS):
            chosen = samples[i : i + _ROWS]
            own = self.row_of_sample[chosen]
            self.row_of_sample[chosen] = self._replaced(
                own, nodes, self.thin.seen_by_samples(chosen)
            )

    def samples(self, index: Int64) -> tuple[Int64, Int64, Float64, NDArray[np.int32]]:
        """Return the samples of fragments as `Scene.samples` does, and the row of each, or -1.

        The sample of a fragment with two rows is there twice.

        Parameters
        ----------
        index : (m,) int64 fragments
        """
        sample, owner, share = self.scene.samples(index)
        row = self.row_of_sample[sample]
        second = self.second_row[index][owner]
        if not (second >= 0).any():
            return sample, owner, share, row
        again = np.repeat(np.arange(len(sample)), 1 + (second >= 0))
        later = np.diff(again, prepend=-1) == 0
        part = self.second_share[index][owner][again]
        two = second[again] >= 0
        row = np.where(later, second[again], np.where(two, self.row_of[index][owner][again],
                                                      row[again]))  # fmt: skip
        share = share[again] * np.where(later, part, np.where(two, 1.0 - part, 1.0))
        return sample[again], owner[again], share, row.astype(np.int32)

    def _replaced(
        self, rows: NDArray[np.int32], nodes: Int64, seen: NDArray[np.uint8]
    ) -> NDArray[np.int32]:
        """Return new rows (m,) with other bits (m, N) of some nodes above the horizon."""
        packed = self._bits[rows]
        bits = (packed[:, :, None] >> np.arange(0, 8, 2, dtype=np.uint8)) & np.uint8(3)
        bits = np.ascontiguousarray(bits.reshape(len(rows), -1)[:, : len(self.cut.share)])
        bits[:, nodes] = np.where(bits[:, nodes] < 2, seen, bits[:, nodes])
        with self._lock:
            return self._append(bits).astype(np.int32)

    def _append(self, bits: NDArray[np.uint8]) -> Int64:
        """Append rows of bits, and return their numbers."""
        need = self.rows + len(bits)
        if need > len(self._masks[0]):
            # room that nobody writes to costs nothing, but copies do: at first, there is room for
            # all fragments and for the samples of those at borders
            count = np.diff(self.scene.offsets)
            usual = len(count) + int(count[count > 1].sum())
            size = max(need, 2 * len(self._masks[0]) or usual)
            if not self._settled:
                self._bits = _grown(self._bits, size)
            self._masks = tuple(_grown(a, size) for a in self._masks)
        rows = slice(self.rows, need)
        if not self._settled:
            self._bits[rows] = _four_to_a_byte(bits)
        pack_bits(bits, self.cut.neighbours, *(a[rows] for a in self._masks))
        self.rows = need
        return np.arange(rows.start, rows.stop)

    def _ray(self, bits: NDArray[np.uint8], sample: Int64) -> None:
        """Replace the bits that are 3 by casting rays from the samples (m,)."""
        # some rows at a time: where each needs all its rays, these fill much memory
        step = max(_RAYS // max(bits.shape[1], 1), 1)
        for i in range(0, len(bits), step):
            some = bits[i : i + step]
            at, node = np.nonzero(some == 3)
            some[at, node] = self.scene.visible(sample[i + at], self.toward[node])


def _four_to_a_byte(bits: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Pack bits (m, D) from 0 to 3 into bytes (m, D / 4), the first lowest."""
    whole = np.pad(bits, ((0, 0), (0, -bits.shape[1] % 4))).reshape(len(bits), -1, 4)
    packed = whole[..., 0] | whole[..., 1] << 2 | whole[..., 2] << 4 | whole[..., 3] << 6
    return np.asarray(packed, np.uint8)


def _grown(array: NDArray[Any], size: int) -> NDArray[Any]:
    """Return a copy of an array with room for `size` rows."""
    larger = np.empty((size, array.shape[1]), array.dtype)
    larger[: len(array)] = array
    return larger


@dataclass(frozen=True)
class Plan:
    """Where a part's far images are computed, and how the others are interpolated from these.

    Attributes
    ----------
    computed : (K,) int64
        Fragments whose far images are computed, counted within the part.
    corners : (P, 4) int32
        For each fragment, the indices into `computed` that it is interpolated from.
    weights : (P, 4) float32
        Weights of the corners.
    mask_rows : (P, 4) int32 visibility rows around each fragment, -1 for none
    scale : float
        Factor on `_BEND`, and on the theta_h where far images begin; 1 or less.
    grazing : float
        Largest angle of a view from its normal, in radians.
    """

    computed: Int64
    corners: NDArray[np.int32]
    weights: Float32
    mask_rows: NDArray[np.int32]
    scale: float
    grazing: float

    @classmethod
    def make(
        cls,
        scene: Scene,
        part: int,
        visibility: Visibility | None,
        loose: float,
        fine: bool,
        report: Progress,
    ) -> Plan:
        """Cast a part's shadow rays, and choose the fragments whose far images are computed.

        Parameters
        ----------
        scene : Scene
        part : int
            Index into ``scene.parts``.
        visibility : Visibility or None
            Where rays are kept; None where nothing casts shadows.
        loose : float
            Factor on the tolerances of interpolation, from 1.
        fine : bool
            Whether every sample at a border casts its own rays.
        report : called with (stage, fraction done)
        """
        span = scene.part_slice(part)
        count = span.stop - span.start
        casts = visibility if scene.casts[part] else None
        pixels = scene.pixels[span]
        x, y = pixels % scene.width, pixels // scene.width
        single = ~scene.bordering[span]
        middle = scene.offsets[:-1][span] + np.diff(scene.offsets)[span] // 2
        positions, normals = scene.positions[middle], scene.normals[middle]
        views = scene.views[middle]
        lattice = _Lattice(scene.height, scene.width, x, y, single, positions, normals)
        everything = np.arange(count)
        known = np.zeros(count, bool)  # has a visibility row
        nothing = np.full((count, 4), -1, np.int64)

        def look(some: Int64, around: Int64, least: int = 3, verify: bool = False) -> None:
            new = ~known[some]
            some, around = some[new], around[new]
            if casts is not None and len(some):
                rows = np.where(around >= 0, casts.row_of[span][around], -1).astype(np.int32)
                casts.cast(
                    some + span.start, rows, least, verify and loose == 1.0,
                    lambda: report("shadows", 0.0),
                )  # fmt: skip
            known[some] = True

        if casts is not None:
            coarse = 16
            on = lattice.on(coarse)
            look(on, nothing[on])
            while coarse > _LEVELS[0]:
                around, _ = lattice.cell(everything, coarse)
                coarse //= 2
                on = lattice.on(coarse)
                look(on, around[on], verify=True)
                report("shadows", 0.0)
        sharp = _sharp_bits(scene, span, casts)
        # fragments in and near the shadows of thin things are computed one by one
        near = casts.thin.near if casts is not None and loose == 1.0 else None
        thin = np.zeros(count, bool) if near is None else near[span]
        corners = np.repeat(everything[:, None], 4, axis=1)
        weights = np.zeros((count, 4))
        weights[:, 0] = 1.0
        around = nothing.copy()
        open_ = everything[single]
        # half vectors move against the normal with either of them
        bend = np.concatenate([normals, 0.5 * views], axis=1)
        found, weight = lattice.cell(open_, _LEVELS[0])
        off, spread = _departure(bend, open_, found, weight)
        off, spread = (np.where((weight != 0.0).any(axis=1), d, np.inf) for d in (off, spread))
        fits = [np.count_nonzero(_predictable(off, spread, loose * s)) for s in (*_SCALES, 1.0)]
        good = [s for s, n in zip(_SCALES, fits, strict=False) if n >= max(_KEPT * fits[-1], 1)]
        scale = good[0] if good else 1.0
        for level in _LEVELS:
            on = lattice.on(level)
            if level != _LEVELS[0]:
                # only the corners of cells that are still open
                wanted, _ = lattice.cell(open_, level)
                on = np.unique(wanted[wanted >= 0])
                look(on, around[on], 2, verify=True)
            found, weight = lattice.cell(open_, level)
            ok = (weight != 0.0).any(axis=1)
            ok &= _predictable(*_departure(bend, open_, found, weight), loose * scale)
            if casts is not None:
                ok &= _shadows_agree(casts, span, normals, open_, found, sharp, loose)
                ok &= ~(thin[open_] | (thin[found] & (found >= 0)).any(axis=1))
            good = open_[ok]
            # a missing corner has no weight: any other index will do
            some = np.take_along_axis(found, (found >= 0).argmax(axis=1)[:, None], axis=1)
            corners[good] = np.where(found >= 0, found, some)[ok]
            weights[good] = weight[ok]
            around[open_] = np.where((found >= 0).sum(1)[:, None] >= 2, found, around[open_])
            open_ = open_[~ok]
        border = everything[~single]
        around[border], _ = lattice.cell(border, _LEVELS[0])
        alone = np.concatenate([open_, border])
        look(alone, around[alone], 2, verify=True)  # creases hold narrow shadows
        if casts is not None:
            near_rows = casts.around(everything + span.start)
            for some in np.array_split(border, len(border) // 256 + 1):
                casts.cast_samples(some + span.start, fine, near_rows)
                report("shadows", 1.0)
            crossed = np.flatnonzero(thin) + span.start
            for i in range(0, len(crossed), 256):
                casts.split(crossed[i : i + 256])
                report("shadows", 1.0)
        report("shadows", 1.0)
        corners[alone] = alone[:, None]
        weights[alone] = (1.0, 0.0, 0.0, 0.0)
        computed, index = np.unique(corners, return_inverse=True)
        mask_rows = np.full((count, 4), -1, np.int32)
        if casts is not None:
            rows = casts.row_of[span]
            mask_rows = rows[corners].astype(np.int32)
            mask_rows[alone, 1:] = -1
            free = ~(casts.masks[0][: casts.rows] != 0).any(axis=1)
            # where nothing hides anything around, there is nothing to look up
            clear = np.where(mask_rows >= 0, free[mask_rows], True).all(axis=1) & single
            mask_rows[clear] = -1
            mask_rows = -np.sort(-mask_rows, axis=1)  # the walk reads up to the first -1
        return cls(
            computed, index.reshape(corners.shape).astype(np.int32),
            weights.astype(np.float32), mask_rows, scale,
            math.acos(np.einsum("mc,mc->m", normals, views).clip(0.0, 1.0).min(initial=1.0)),
        )  # fmt: skip


class _Lattice:
    """The fragments of one part by pixel, and the cells of square lattices around them."""

    def __init__(
        self,
        height: int,
        width: int,
        x: Int64,
        y: Int64,
        single: NDArray[np.bool_],
        positions: Float64,
        normals: Float64,
    ) -> None:
        self._x, self._y, self._single = x, y, single
        self._positions, self._normals = positions, normals
        # a margin at the right and at the bottom spares tests at the frame's edge
        margin = 32
        self._at = np.full((height + margin, width + margin), -1, np.int64)
        inside = np.flatnonzero(single)
        self._at[y[inside], x[inside]] = inside

    def on(self, spacing: int) -> Int64:
        """Return the fragments that are points of the lattice."""
        mask = self._single & (self._x % spacing == 0) & (self._y % spacing == 0)
        return np.flatnonzero(mask)

    def cell(self, some: Int64, spacing: int) -> tuple[Int64, Float64]:
        """Return the corners (m, 4) of the cells of fragments, -1 where missing, and their weights.

        Weights are bilinear. Where one corner is missing they are those of the plane through the
        other three; where more are missing and would count, they are zero.
        """
        x0, y0 = self._x[some] // spacing * spacing, self._y[some] // spacing * spacing
        u = (self._x[some] - x0) / spacing
        v = (self._y[some] - y0) / spacing
        step = ((0, 0), (0, spacing), (spacing, 0), (spacing, spacing))
        corners = np.stack([self._at[y0 + dy, x0 + dx] for dy, dx in step], axis=1)
        weights = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], axis=1)
        # a corner on another sheet of the surface, before or behind, is no neighbour
        apart = self._positions[corners] - self._positions[some, None]
        off = np.abs(np.einsum("mkc,mc->mk", apart, self._normals[some]))
        corners[off > 0.25 * np.linalg.norm(apart, axis=-1)] = -1
        missing = corners < 0
        lacking = missing.sum(axis=1)
        # a corner is its two neighbours less the opposite one
        for k, (a, b, c) in enumerate(((1, 2, 3), (0, 3, 2), (0, 3, 1), (1, 2, 0))):
            gone = missing[:, k] & (lacking == 1)
            w = weights[gone, k]
            weights[gone, a] += w
            weights[gone, b] += w
            weights[gone, c] -= w
            weights[gone, k] = 0.0
        needed = (missing & (weights > 0.0)).any(axis=1)
        weights[(lacking > 1) & needed] = 0.0
        weights[missing] = 0.0
        return corners, weights


def _departure(
    bend: Float64, some: Int64, corners: Int64, weights: Float64
) -> tuple[Float64, Float64]:
    """Return how far `bend` at fragments `some` (m,) is from that at their cells' corners.

    The first array is the distance from the interpolated value, the second the greatest distance
    from a corner.
    """
    off, spread = np.empty(len(some)), np.empty(len(some))
    for i in range(0, len(some), _AT_ONCE):
        now = slice(i, min(i + _AT_ONCE, len(some)))
        at = np.where(corners[now] >= 0, corners[now], some[now, None])
        around, own = bend[at], bend[some[now]]
        mean = np.einsum("mk,mkc->mc", weights[now], around)
        off[now] = np.linalg.norm(mean - own, axis=-1)
        spread[now] = np.linalg.norm(around - own[:, None], axis=-1).max(axis=1)
    return off, spread


def _predictable(off: Float64, spread: Float64, loose: float) -> NDArray[np.bool_]:
    """Return whether half vectors vary linearly enough over a cell to interpolate wide lobes."""
    answer: NDArray[np.bool_] = (off < loose * _BEND[0]) & (spread < loose * _BEND[1])
    return answer


def _sharp_bits(
    scene: Scene, span: slice, visibility: Visibility | None
) -> tuple[NDArray[np.int64], NDArray[np.bool_]] | None:
    """Find the brightest nodes of the cut, and cast a ray to each from every fragment of a part.

    Returns the nodes (k,) and whether each fragment sees them (P, k), or None if no node is bright.
    """
    if visibility is None:
        return None
    nodes = np.argsort(-visibility.cut.share)[:4]
    nodes = nodes[visibility.cut.share[nodes] > 0.03]
    if not len(nodes):
        return None
    sample = scene.offsets[:-1][span] + np.diff(scene.offsets)[span] // 2
    bits = np.zeros((len(sample), len(nodes)), bool)
    for k, node in enumerate(nodes):
        toward = visibility.toward[node]
        up = np.flatnonzero(scene.normals[sample] @ toward > 0.0)
        bits[up, k] = scene.visible(sample[up], np.broadcast_to(toward, (len(up), 3)))
    return nodes, bits


def _shadows_agree(
    visibility: Visibility,
    span: slice,
    normals: Float64,
    some: Int64,
    corners: Int64,
    sharp: tuple[NDArray[np.int64], NDArray[np.bool_]] | None,
    loose: float,
) -> NDArray[np.bool_]:
    """Return whether the corners of each fragment's cell are lit alike."""
    rows = np.where(corners >= 0, visibility.row_of[span][corners], -1).astype(np.int32)
    cells, which = np.unique(rows, axis=0, return_inverse=True)
    first = np.zeros(len(cells), np.int64)
    first[which.reshape(-1)[::-1]] = np.arange(len(which))[::-1]
    unlike = np.empty(len(cells), np.float32)
    disagreement(
        unlike, visibility.packed, cells, normals[some[first]],
        visibility.toward, visibility.cut.share,
    )  # fmt: skip
    agree: NDArray[np.bool_] = (unlike < loose**1.5 * _UNEVEN)[which.reshape(-1)]
    if sharp is not None:
        nodes, own = sharp
        for k, node in enumerate(nodes):
            bit = np.append(visibility.of_node(int(node)), np.uint8(2))  # for row -1: unknown
            # a corner below the light's horizon says nothing about its shadow
            same = np.where(rows >= 0, (bit[rows] == own[some, k, None]) | (bit[rows] == 2), True)
            agree &= same.all(axis=1)
    return agree
