"""Rows of the transport operator: the light that reaches a pixel, cut into leaves of one tree.

For one pixel I = sum over leaves of E_leaf * f(theta_h, theta_d, phi_d): linear in the table's
cells. A *leaf* is a piece of the environment map with its exact vector irradiance. `Operator`
turns leaves into rows (a weight for every cell) or, far cheaper, into images of given tables.

*Leaves.* The map is walked as a tree (`lights.LightTree`): a node of light stands for its texels
where it looks small from the mirror peak, measured in half-vector space; a texel that looks large
is cut further. A node's irradiance is exact, and its own extent is carried into theta_h to second
order (two samples one standard deviation apart), so the error falls with the fourth power of the
node size while the number of nodes grows with its inverse square.

*Shadows.* A cut through the tree, some thousand nodes of little light each, gets one shadow ray a
node (`VisibilityCut`), bright lights down to single texels. Neighbouring pixels see nearly the same
occluders: rays are cast on a coarse lattice of pixels, and between lattice points only where those
around disagree; at borders, where a pixel's samples lie on either side of an edge, of every sample.
Near the mirror direction, where a glossy surface shows the occluder's outline, leaves at that
outline cast their own rays.

*Far and near.* Images of lobes wider than `_SPLIT` vary slowly from pixel to pixel: they are
computed on the lattice and interpolated, wherever normals and shadows vary linearly over its
cells; elsewhere, and for the narrow rest, every pixel is computed. The two are separated by a
smooth window over theta_h, so their sum is exact.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from traitbrdf.brdf import HalfDiffGrid
from traitbrdf.directions import reflect
from traitbrdf.lights import EnvironmentMap, LightTree, turn_about_y
from traitbrdf.scene import Scene

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Progress = Callable[[str, float], None]
"""Called with what is being done and the fraction done; may raise to cancel."""

_SPLIT = (0.15, 0.35)
"""theta_h in radians between which the window passes from near to far, at a scale of 1."""
_SCALES = (1 / 16, 1 / 8, 1 / 4, 1 / 2)
"""How much less a part may bend than `_BEND` for far images to begin nearer."""
_KEPT = 0.9
"""Share of the fragments with interpolated far images that must remain so at such a scale."""
_FLAT = 0.03
"""How much of their largest value tables may change within the width of their lobes."""
_OUTLINE = 0.03
"""theta_h in radians up to which leaves at the outline of an occluder cast their own rays."""
_LEVELS = (4, 2)
"""Spacing in pixels of the lattices on which far images are computed."""
_CUT = (0.09, 1 / 500)
"""Greatest radius (radians) and share of the flux of a node whose visibility is one bit."""
_BEND = (0.003, 0.06)
"""Most that a half vector departs, seen against the normal, from those of its cell's corners:
from their mean, and from any."""
_UNEVEN = 0.005
"""Most that a cell's corners differ in what light they see: see `_disagreement`."""
_QUESTIONS = 192
"""Most rays of its own that a sample casts at occluders' outlines."""
CORE = 3e-3
"""theta_h in radians: leaves at a mirror peak are as small as peaks of twice that width need."""
SHARPEST = 1e-4
"""The same for the narrowest peaks that a table holds."""
_ALL = (-1.0, 9.0)
_SHARED = ((4, 0.002), (2, 0.007))
"""Blocks of pixels that share one walk, and how far their half vectors may differ (radians)."""
_UNITED = 0.007
"""The same for the samples of one fragment."""

f32 = np.float32


@dataclass(frozen=True)
class VisibilityCut:
    """Nodes of a light tree whose visibility is one bit each.

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
        """Cut where nodes are no wider than `spacing` and hold no more than `share` of the flux."""
        flux = tree.flux
        whole = (tree.child < 0).all(axis=1)
        total = max(float(flux[whole].sum()), 1e-300)
        split = ~whole & ((tree.radius > spacing) | (flux > share * total))
        first, last, cut = _cut_ranges(tree.child, split)
        directions = tree.direction[cut].astype(np.float64)
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        near = min(7, len(cut))
        _, nearest = cKDTree(directions).query(directions, k=near)
        neighbours = np.repeat(np.arange(len(cut), dtype=np.int32)[:, None], 6, axis=1)
        neighbours[:, : near - 1] = np.asarray(nearest).reshape(len(cut), near)[:, 1:]
        return cls(first, last, directions, flux[cut] / total, neighbours)


class Operator:
    """Rows of W: what every cell of a table contributes to a fragment of the scene.

    Parameters
    ----------
    scene : Scene
    grid : HalfDiffGrid of the "folded" layout
    resolution : float
        1 is the default; 2 halves the size of the light's leaves and of the visibility nodes.
    tree : what `light_tree` makes of the scene's map, if it is at hand
    core : float
        In radians, half the width in theta_h of the narrowest peak that rows and interpolated
        images resolve. Exact images resolve what their tables hold.
    shadows : float or None
        The same as `resolution` for the visibility nodes alone; None: as that has it.
    """

    def __init__(
        self,
        scene: Scene,
        grid: HalfDiffGrid,
        resolution: float = 1.0,
        tree: LightTree | None = None,
        core: float = CORE,
        shadows: float | None = None,
    ) -> None:
        if grid.layout != "folded":
            raise ValueError(f"grid: expected the 'folded' layout, got {grid.layout!r}")
        for name, given in (("resolution", resolution), ("core", core), ("shadows", shadows)):
            if given is not None and not (math.isfinite(given) and given > 0.0):
                raise ValueError(f"{name}: expected a positive number, got {given!r}")
        self.scene = scene
        self.grid = grid
        self.resolution = resolution
        self.core = core
        environment = _divided(scene.environment)
        rows, columns, _ = environment.image.shape
        if tree is None or tuple(tree.rectangle[0]) != (0, rows, 0, columns):
            tree = LightTree.build(environment)
        self.tree = tree
        self._nodes = self.tree.packed
        self._image = environment.image
        scale = 1.0 / resolution
        # sharp lobes are lost where the leaves at their peaks grow wider than these
        rule = np.array([0.5 * min(scale, 4.0), scale**2 / 200.0, 0.05 * scale, 0.1 * scale])
        border = rule * (1.6, 2.56, 1.6, 1.6)  # the eight samples of a fragment share the error
        # exact images are asked for where lobes are sharp: at a silhouette's grazing angles they
        # need leaves of half that size
        fine = border * (0.5 / 1.6, 1.0, 1.0, 1.0)
        self._rules = np.stack([rule, border]).astype(np.float32)
        self._exact_rules = np.stack([rule, fine]).astype(np.float32)
        self._capacity = int(1600 * resolution**2) + 200
        to_map = scene.environment.to_map
        self._normals = np.ascontiguousarray(to_map(scene.normals), np.float32)
        self._views = np.ascontiguousarray(to_map(scene.views), np.float32)
        # the sample that stands for a fragment where one must: the middle one
        self._middle = scene.offsets[:-1] + np.diff(scene.offsets) // 2
        self._visibility: _Visibility | None = None
        if any(scene.casts):
            wide = 1.0 / (resolution if shadows is None else shadows)
            width = min(wide, math.sqrt(wide))  # shadows blur less well than lobes do
            cut = VisibilityCut.build(self.tree, _CUT[0] * width, _CUT[1] * width**2)
            self._visibility = _Visibility(scene, cut, self._middle)
        self._plans: dict[int, _Plan] = {}

    # -- single fragments -----------------------------------------------------------------------

    def rows(self, index: NDArray[np.integer]) -> Float32:
        """(m, 3, grid.size) rows of the fragments `index` (m,), one for each colour."""
        at = np.asarray(index, np.int64)
        out = np.zeros((len(at), 3, self.grid.size), np.float32)
        self._shade(out, at, self._mask_rows(at), _ALL, _NO_TABLES)
        self._add_lights(out, at, _NO_TABLES)
        return out

    def rows_as_shown(self, index: NDArray[np.integer]) -> Float32:
        """(m, 3, grid.size) rows of distinct fragments `index` (m,), as `part_images` sees them.

        With the shadows and the leaves that they share with the pixels around: the images and
        these rows are of one operator, while those of `rows` are a little nearer to the truth.
        """
        at = np.asarray(index, np.int64)
        out = np.zeros((len(at), 3, self.grid.size), np.float32)
        for part in range(len(self.scene.parts)):
            span = self.scene.part_slice(part)
            mine = np.flatnonzero((at >= span.start) & (at < span.stop))
            if not len(mine):
                continue
            place = np.full(span.stop - span.start, -1)
            place[at[mine] - span.start] = mine
            everything = np.arange(span.start, span.stop)
            masks = self._plan(part).mask_rows
            self._shade(out, everything, masks, _ALL, _NO_TABLES, place=place)
        self._add_lights(out, at, _NO_TABLES)
        return out

    def images(self, index: NDArray[np.integer], tables: Float32) -> Float32:
        """(m, 3, T) radiance of the fragments `index` (m,) under scalar tables (grid.size, T)."""
        at = np.asarray(index, np.int64)
        tables = np.ascontiguousarray(tables, np.float32)
        out = np.zeros((len(at), 3, tables.shape[1]), np.float32)
        self._shade(out, at, self._mask_rows(at), _ALL, tables, core=self._core_of(tables))
        self._add_lights(out, at, tables)
        return out

    def mirror(self, index: NDArray[np.integer]) -> Float32:
        """(m, 3) what a perfect mirror shows at the fragments `index` (m,)."""
        scene = self.scene
        index = np.asarray(index, np.int64)
        sample, owner, share = scene.samples(index)
        toward = np.asarray(reflect(scene.views[sample], scene.normals[sample]), np.float64)
        seen = scene.environment.radiance(toward) * scene.visible(sample, toward)[:, None]
        out = np.zeros((len(index), 3))
        np.add.at(out, owner, seen * share[:, None])
        return out.astype(np.float32)

    def _core_of(self, tables: Float32) -> float:
        return min(self.core, _core(self.grid, tables))

    # -- whole parts ----------------------------------------------------------------------------

    def part_images(
        self,
        part: int,
        tables: Float32,
        progress: Progress | None = None,
        interpolate: bool = True,
    ) -> Float32:
        """(P, 3, T) radiance of all fragments of a part under scalar tables (grid.size, T).

        Shadows are interpolated where rays agree, and far images where that is safe, unless
        `interpolate` is False: an order of magnitude faster than `images`. Lobes that are wide
        for the part have nothing but far images, and no leaves finer than they need. Peaks narrower
        than the operator's `core` are resolved only without interpolation.
        """
        report = progress or (lambda stage, fraction: None)
        span = self.scene.part_slice(part)
        index = np.arange(span.start, span.stop)
        tables = np.ascontiguousarray(tables, np.float32)
        if len(index) == 0:
            return np.zeros((0, 3, tables.shape[1]), np.float32)
        plan = self._plan(part, report)
        # narrower lobes are interpolated where neighbouring pixels differ less
        nodes = np.searchsorted(self.grid.theta_h, plan.scale * np.array(_SPLIT))
        low, high = (float(self.grid.theta_h[node]) for node in nodes)
        lobe = _lobe(self.grid, tables, plan.grazing)
        broad = lobe >= high  # nothing is near
        if not interpolate and not broad:
            out = np.zeros((len(index), 3, tables.shape[1]), np.float32)
            self._shade(
                out, index, plan.mask_rows, _ALL, tables,
                lambda fraction: report("exact images", fraction), exact=True, lobe=lobe,
                core=self._core_of(tables),
            )  # fmt: skip
            self._add_lights(out, index, tables)
            return out
        near = np.repeat(_near_window(self.grid, low, high), self.grid.size // self.grid.shape[0])
        wide, far = (tables, _ALL) if broad else (tables * (1.0 - near)[:, None], (low, 9.0))
        coarse = np.zeros((len(plan.computed), 3, tables.shape[1]), np.float32)
        computed = index[plan.computed]
        self._shade(
            coarse, computed, self._own_rows(computed), far, wide,
            lambda fraction: report("far images", fraction), lobe=lobe,
        )  # fmt: skip
        out = np.empty((len(index), 3, tables.shape[1]), np.float32)
        _interpolate(out, coarse, plan.corners, plan.weights)
        if not broad:
            self._shade(
                out, index, plan.mask_rows, (-1.0, high), tables * near[:, None],
                lambda fraction: report("near images", fraction), lobe=lobe,
            )  # fmt: skip
        self._add_lights(out, index, tables)
        return out

    # -- leaves ---------------------------------------------------------------------------------

    def _bundles(self, index: Int64, mask_rows: NDArray[np.int32]) -> _Bundles:
        """The samples of fragments `index`, in groups that share one walk through the light."""
        scene = self.scene
        sample, owner, share = scene.samples(index)
        count = np.bincount(owner, minlength=len(index))
        starts = np.concatenate([[0], np.cumsum(count)])
        normals, views = self._normals[sample], self._views[sample]
        single = np.flatnonzero(count == 1)
        x, y = scene.pixels[index] % scene.width, scene.pixels[index] // scene.width
        part = scene.pixel_part[index].astype(np.int64)
        group = np.full(len(index), -1, np.int64)  # of fragments of one sample
        found = 0
        for side, limit in _SHARED:
            key = (part[single] * (scene.height + side) + y[single] // side) * (
                scene.width + side
            ) + x[single] // side
            order = np.argsort(key, kind="stable")
            member = single[order]
            edge = np.flatnonzero(np.diff(key[order], prepend=-1))
            if not len(edge):
                break
            size = np.diff(edge, append=len(member))
            alike = _alike(
                edge, size, normals[starts[member]], views[starts[member]],
                scene.positions[sample[starts[member]]], mask_rows[member], limit,
            ) & (size > 1)  # fmt: skip
            joined = np.repeat(alike, size)
            group[member[joined]] = found + np.repeat(np.arange(alike.sum()), size[alike])
            found += int(alike.sum())
            single = np.sort(member[~joined])
        # a bundle is a group of fragments, or one fragment, whose samples are a group each, or one
        sampled = np.flatnonzero(count > 1)
        united = np.zeros(len(index), bool)
        if len(sampled):
            members, edge = _expand(starts, sampled)
            united[sampled] = _alike(
                edge[:-1], count[sampled], normals[members], views[members],
                scene.positions[sample[members]], mask_rows[owner[members]], _UNITED,
            )  # fmt: skip
        own_row = np.full(len(sample), -1, np.int32)
        if self._visibility is not None:
            own_row = self._visibility.row_of_sample[sample]
            united[owner[own_row >= 0]] = False
        alone = group < 0
        group[alone] = found + np.arange(alone.sum())
        order = np.argsort(group, kind="stable")
        sorted_samples, _ = _expand(starts, order)
        per_fragment = count[order]
        bundle_of_sample = np.repeat(group[order], per_fragment)
        own = (bundle_of_sample >= found) & ~united[owner[sorted_samples]]
        fresh = np.diff(bundle_of_sample, prepend=-1) != 0
        group_edge = np.flatnonzero(fresh | own)
        group_start = np.append(group_edge, len(sorted_samples))
        bundle_start = np.append(np.flatnonzero(fresh[group_edge]), len(group_edge))
        target = owner[sorted_samples]
        several = (count > 2)[target[group_edge]]
        masks = mask_rows[target]
        single_row = own_row[sorted_samples]
        masks[single_row >= 0] = -1
        masks[single_row >= 0, 0] = single_row[single_row >= 0]
        return _Bundles(
            bundle_start, group_start, target, normals[sorted_samples], views[sorted_samples],
            share[sorted_samples].astype(np.float32), sample[sorted_samples],
            *_centres(group_start, normals[sorted_samples], views[sorted_samples]),
            _first_rows(group_start, masks), several,
        )  # fmt: skip

    def _light(
        self, window: tuple[float, float], exact: bool, lobe: float, core: float
    ) -> tuple[Any, ...]:
        """What the walk needs beside the samples: nodes, masks and rules."""
        low, high = math.sin(max(window[0], -0.5)), math.sin(min(window[1], 0.5 * math.pi))
        cut, masks = _NO_CUT, _NO_MASKS
        if self._visibility is not None:
            cut = (self._visibility.cut.first, self._visibility.cut.last)
            masks = self._visibility.masks
        rules = np.concatenate(
            [self._exact_rules if exact else self._rules, np.full((2, 1), core, np.float32)], axis=1
        )
        return (
            *self._nodes, self._image, *cut, *masks, rules,
            f32(low), f32(high if high < 1.0 else 9.0),
            f32(math.sin(_OUTLINE) if lobe <= _SPLIT[1] else -9.0), f32(math.sin(lobe)),
        )  # fmt: skip

    def _shade(
        self,
        out: Float32,
        index: Int64,
        mask_rows: NDArray[np.int32],
        window: tuple[float, float],
        tables: Float32,
        report: Callable[[float], None] = lambda fraction: None,
        place: Int64 | None = None,
        exact: bool = False,
        lobe: float = 0.0,
        core: float | None = None,
    ) -> None:
        """Add the light of theta_h in `window` to the fragments `index`: to their radiance under
        `tables` (cells, T), or to their rows if there are no tables.

        `mask_rows` (m, 4) are the visibility rows that surround each fragment, -1 for none.
        `place` (m,) says where in `out` each fragment is; those of -1 are left out. `exact` takes
        leaves for sharp lobes, `lobe` none that are finer than lobes of that width need, and `core`
        (this operator's if left out) none that are wider at the peak than peaks of twice that width
        bear.
        """
        step = 1 << 13
        light = self._light(
            window, exact or self.resolution > 1.0, lobe, self.core if core is None else core
        )
        for i in range(0, len(index), step):
            at = slice(i, min(i + step, len(index)))
            if place is not None and not (place[at] >= 0).any():
                continue
            bundles, target = self._bundles(index[at], mask_rows[at]), out[at]
            if place is not None:
                bundles, target = bundles.of(place[at]), out
            self._shade_all(target, bundles, light, tables)
            report(at.stop / len(index))

    def _shade_all(
        self, out: Float32, bundles: _Bundles, light: tuple[Any, ...], tables: Float32
    ) -> None:
        """Shade bundles, those again that have more leaves than there was room for."""
        capacity = self._capacity
        while len(bundles.several):
            bundles = bundles.take(self._shade_some(out, bundles, light, tables, capacity))
            capacity *= 2

    def _shade_some(
        self,
        out: Float32,
        bundles: _Bundles,
        light: tuple[Any, ...],
        tables: Float32,
        capacity: int,
    ) -> NDArray[np.bool_]:
        """Shade bundles; returns which groups have more leaves than the capacity."""
        groups = len(bundles.several)
        short = np.zeros(groups, np.bool_)
        asked = np.zeros(groups, np.int64)
        ask = np.empty((groups, _QUESTIONS, 3), np.float32)
        answers = np.ones((groups, _QUESTIONS), np.uint8)
        rest = (capacity, *self.grid.shape, tables)
        _shade(  # type: ignore[call-arg]  # numba's decorator hides the signature
            out, short, ask, asked, answers, False, *bundles.for_the_walk(), *light, *rest
        )  # fmt: skip
        again = (asked > 0) & ~short
        # where rays decide, pixels do not share them
        shared = again & (np.diff(bundles.group_start) > 1)
        again &= ~shared
        if shared.any():
            apart = bundles.take(shared).separated()
            self._shade_all(out, apart, light, tables)
        if again.any():
            local, which = _questions(ask[again], asked[again])
            toward = turn_about_y(local, self.scene.environment.rotation)
            some = bundles.take(again)
            answers = np.ones((len(some.several), _QUESTIONS), np.uint8)
            asker = some.sample[some.group_start[:-1]]
            answers[which] = self.scene.visible(asker[which[0]], toward)
            count = len(some.several)
            _shade(  # type: ignore[call-arg]  # numba's decorator hides the signature
                out, np.zeros(count, np.bool_), ask[:count], asked[:count], answers, True,
                *some.for_the_walk(), *light, *rest,
            )  # fmt: skip
        return short

    def _add_lights(self, out: Float32, index: Int64, tables: Float32) -> None:
        """Add the point and directional lights, each one leaf a sample."""
        scene = self.scene
        step = 1 << 16
        for light in scene.lights:
            for i in range(0, len(index), step):
                at = slice(i, min(i + step, len(index)))
                sample, owner, share = scene.samples(index[at])
                toward, irradiance = scene.arriving(light, sample)
                leaves = np.zeros((len(sample), 13, 1), np.float32)
                local = scene.environment.to_map(toward)
                leaves[:, :3, 0] = local
                # the vector irradiance of a light: what faces it fully gets it fully
                leaves[:, 3:12, 0] = (irradiance[:, :, None] * local[:, None, :]).reshape(-1, 9)
                starts = np.searchsorted(owner, np.arange(at.stop - at.start + 1)).astype(np.int64)
                _one_leaf(
                    out[at], starts, self._normals[sample], self._views[sample],
                    share.astype(np.float32), leaves, *self.grid.shape, tables,
                )  # fmt: skip

    # -- visibility -----------------------------------------------------------------------------

    def _own_rows(self, index: Int64) -> NDArray[np.int32]:
        """(m, 4) with each fragment's own visibility row first, -1 where it has none."""
        rows = np.full((len(index), 4), -1, np.int32)
        if self._visibility is not None:
            rows[:, 0] = self._visibility.row_of[index]
        return rows

    def _mask_rows(self, index: Int64) -> NDArray[np.int32]:
        """Own rows (m, 4) of any fragments; rays are cast for those that have none yet."""
        visibility = self._visibility
        if visibility is None or not len(index):
            return self._own_rows(index)
        casts = np.asarray(self.scene.casts)[self.scene.pixel_part[index]]
        unknown = np.unique(index[casts & (visibility.row_of[index] < 0)])
        if len(unknown):
            around = np.full((len(unknown), 4), -1, np.int32)
            for part, plan in list(self._plans.items()):
                span = self.scene.part_slice(part)
                mine = (unknown >= span.start) & (unknown < span.stop)
                around[mine] = plan.mask_rows[unknown[mine] - span.start]
            visibility.cast(unknown, around, least=3)
            visibility.cast_samples(unknown, self.resolution > 1.0)
        return self._own_rows(index)

    def prepare(self, part: int, progress: Progress | None = None) -> None:
        """Cast a part's rays and find where its far images are computed, if that is not done."""
        self._plan(part, progress)

    def _plan(self, part: int, progress: Progress | None = None) -> _Plan:
        if part not in self._plans:
            report = progress or (lambda stage, fraction: None)
            loose = max(1.0, 1.0 / self.resolution)
            fine = self.resolution > 1.0
            self._plans[part] = _Plan.make(self.scene, part, self._visibility, loose, fine, report)
        return self._plans[part]


@dataclass(frozen=True)
class _Bundles:
    """Samples in groups that share one walk, and groups in bundles that one thread shades.

    `target` says which fragment a sample belongs to: all its samples are in one bundle.
    """

    bundle_start: Int64  # (B + 1,) into groups
    group_start: Int64  # (G + 1,) into samples
    target: Int64  # (n,)
    normals: Float32  # (n, 3)
    views: Float32  # (n, 3)
    share: Float32  # (n,)
    sample: Int64  # (n,) in the scene
    middle_normals: Float32  # (G, 3)
    middle_views: Float32  # (G, 3)
    spread: Float32  # (G,) how far half vectors against the normals differ within the group
    masks: NDArray[np.int32]  # (G, 4)
    several: NDArray[np.bool_]  # (G,) whether the fragment has other groups

    _PER_SAMPLE: ClassVar = ("normals", "views", "share", "sample")

    def for_the_walk(self) -> tuple[Any, ...]:
        return (
            self.bundle_start, self.group_start, self.target, self.normals, self.views, self.share,
            self.middle_normals, self.middle_views, self.spread, self.masks, self.several,
        )  # fmt: skip

    def of(self, place: Int64) -> _Bundles:
        """The samples of some fragments alone, in their groups; `place` renumbers the fragments,
        and those of -1 are left out."""
        target = place[self.target]
        left = np.concatenate([[0], np.cumsum(target >= 0)])[self.group_start]
        kept = replace(
            self, group_start=left, target=target[target >= 0],
            **{name: getattr(self, name)[target >= 0] for name in self._PER_SAMPLE},
        )  # fmt: skip
        return kept.take(np.diff(left) > 0)

    def separated(self) -> _Bundles:
        """Each sample in a group of its own."""
        size = np.diff(self.group_start)
        starts = np.arange(len(self.target) + 1)
        return replace(
            self, bundle_start=self.group_start[self.bundle_start], group_start=starts,
            middle_normals=self.normals, middle_views=self.views,
            spread=np.zeros(len(self.target), np.float32),
            masks=np.repeat(self.masks, size, axis=0), several=np.repeat(self.several, size),
        )  # fmt: skip

    def take(self, groups: NDArray[np.bool_]) -> _Bundles:
        """These groups alone."""
        kept = np.flatnonzero(groups)
        samples, group_start = _expand(self.group_start, kept)
        bundle = np.repeat(np.arange(len(self.bundle_start) - 1), np.diff(self.bundle_start))[kept]
        bundle_start = np.append(np.flatnonzero(np.diff(bundle, prepend=-1)), len(kept))
        return _Bundles(
            bundle_start, group_start, self.target[samples], self.normals[samples],
            self.views[samples], self.share[samples], self.sample[samples],
            self.middle_normals[kept], self.middle_views[kept], self.spread[kept],
            self.masks[kept], self.several[kept],
        )  # fmt: skip


def _expand(starts: Int64, chosen: Int64) -> tuple[Int64, Int64]:
    """Members of the `chosen` sets of a list in sets, and where the new sets start."""
    size = np.diff(starts)[chosen]
    new = np.concatenate([[0], np.cumsum(size)])
    members = np.arange(new[-1]) - np.repeat(new[:-1] - starts[chosen], size)
    return members, new


def _alike(
    edge: Int64,
    size: Int64,
    normals: Float32,
    views: Float32,
    positions: Float64,
    masks: NDArray[np.int32],
    limit: float,
) -> NDArray[np.bool_]:
    """Whether the members of each set see the light nearly alike and share their masks."""
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


def _centres(
    group_start: Int64, normals: Float32, views: Float32
) -> tuple[Float32, Float32, Float32]:
    """Mean unit normals and views of groups, and how far their members' half vectors depart."""
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


def _first_rows(group_start: Int64, masks: NDArray[np.int32]) -> NDArray[np.int32]:
    """The mask rows of each group: those of any member that has some."""
    rows: NDArray[np.int32] = np.maximum.reduceat(masks, group_start[:-1], axis=0)
    return rows


def _questions(ask: Float32, asked: Int64) -> tuple[Float64, tuple[Int64, Int64]]:
    """Unit directions of all questions, and (sample, question) of each."""
    sample, question = np.nonzero(np.arange(ask.shape[1]) < asked[:, None])
    toward = ask[sample, question].astype(np.float64)
    toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
    return toward, (sample.astype(np.int64), question.astype(np.int64))


class _Visibility:
    """One bit for every node of the cut, at the fragments where rays were cast."""

    def __init__(self, scene: Scene, cut: VisibilityCut, middle: Int64) -> None:
        self.scene = scene
        self.cut = cut
        self.toward = turn_about_y(cut.directions, scene.environment.rotation)
        self.row_of = np.full(len(scene.pixels), -1, np.int32)
        # of samples with rays of their own: a fragment at a border lies on either side of an edge
        self.row_of_sample = np.full(len(scene.normals), -1, np.int32)
        self.rows = 0
        self._sharp = cut.share > 0.02  # suns, that cast sharp shadows
        self._lock = threading.Lock()  # one thread casts for the next part while another shades
        self._middle = middle
        self._bits = np.zeros((0, len(cut.share)), np.uint8)
        words = (len(cut.share) + 63) // 64
        self._masks = tuple(np.zeros((0, words), np.uint64) for _ in range(3))

    @property
    def bits(self) -> NDArray[np.uint8]:
        """(rows, D): 0 hidden, 1 visible, 2 below the horizon."""
        return self._bits[: self.rows]

    @property
    def masks(self) -> tuple[NDArray[np.uint64], ...]:
        """Sets (rows, words) of nodes, 64 a word, that are: hidden; not surely visible; not
        surely hidden. Sure is a node whose neighbours on the sphere agree with it."""
        return self._masks

    def cast(
        self, index: Int64, around: NDArray[np.int32], least: int, verify: bool = False
    ) -> None:
        """Find the bits of fragments `index` (m,), with rays where the `around` (m, 4) disagree.

        Fewer than `least` rows around, and every node above the horizon gets a ray. `verify` casts
        an eighth of what they agree on, and all of it where that proves them wrong.
        """
        normals = self.scene.normals[self._middle[index]]
        for i in range(0, len(index), 2048):
            some = slice(i, min(i + 2048, len(index)))
            bits = np.empty((some.stop - some.start, len(self.cut.share)), np.uint8)
            _inherit(bits, normals[some], self.toward, self._bits, around[some], least, self._sharp)
            if verify:
                inherited = bits[:, ::8].copy()
                bits[:, ::8][inherited < 2] = 3
                self._ray(bits, self._middle[index[some]])
                wrong = ((inherited != bits[:, ::8]) & (inherited < 2)).any(axis=1)
                bits[wrong] = np.where(bits[wrong] < 2, 3, bits[wrong])
            self._ray(bits, self._middle[index[some]])
            with self._lock:
                self.row_of[index[some]] = self._append(bits)

    def cast_samples(self, index: Int64, fine: bool) -> None:
        """Bits of every sample of those of the fragments `index` that have several.

        The first and the last get rays; where these and the middle one agree, so do the others,
        unless all shall have them (`fine`).
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
            self._cast_samples(ends[:, side], nothing)
        around = nothing
        if not fine:
            around[:, 0] = self.row_of[index]
            around[:, 1:3] = self.row_of_sample[ends]
        samples, starts = _expand(offsets, index)
        self._cast_samples(samples, np.repeat(around, np.diff(starts), axis=0))

    def _cast_samples(self, samples: Int64, around: NDArray[np.int32]) -> None:
        """Bits of those samples that have none, with rays where the rows `around` disagree."""
        new = self.row_of_sample[samples] < 0
        samples, around = samples[new], around[new]
        for i in range(0, len(samples), 2048):
            chosen = samples[i : i + 2048]
            bits = np.empty((len(chosen), len(self.cut.share)), np.uint8)
            _inherit(
                bits, self.scene.normals[chosen], self.toward, self._bits,
                around[i : i + 2048], 3, self._sharp,
            )  # fmt: skip
            self._ray(bits, chosen)
            with self._lock:
                self.row_of_sample[chosen] = self._append(bits)

    def _append(self, bits: NDArray[np.uint8]) -> Int64:
        """Keep rows of bits; returns their numbers."""
        need = self.rows + len(bits)
        if need > len(self._bits):
            size = max(need, len(self._bits) * 5 // 4)
            self._bits = _grown(self._bits, size)
            self._masks = tuple(_grown(a, size) for a in self._masks)
        rows = slice(self.rows, need)
        self._bits[rows] = bits
        _pack_bits(bits, self.cut.neighbours, *(a[rows] for a in self._masks))
        self.rows = need
        return np.arange(rows.start, rows.stop)

    def _ray(self, bits: NDArray[np.uint8], sample: Int64) -> None:
        """Fill the bits that are 3 by rays from the samples (m,)."""
        at, node = np.nonzero(bits == 3)
        bits[at, node] = self.scene.visible(sample[at], self.toward[node])


def _grown(array: NDArray[Any], size: int) -> NDArray[Any]:
    larger = np.zeros((size, array.shape[1]), array.dtype)
    larger[: len(array)] = array
    return larger


@dataclass(frozen=True)
class _Plan:
    """Where a part's far images are computed, and how the others follow; indices in the part.

    Attributes
    ----------
    computed : (K,) fragments whose far images are computed
    corners : (P, 4) int32 indices into `computed`
    weights : (P, 4) float32
    mask_rows : (P, 4) int32 visibility rows around each fragment, -1 for none
    scale : of `_SPLIT` and `_BEND`
    grazing : the largest angle of a view from its normal, in radians
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
        visibility: _Visibility | None,
        loose: float,
        fine: bool,
        report: Progress,
    ) -> _Plan:
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
                casts.cast(some + span.start, rows, least, verify and loose == 1.0)
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
            good = open_[ok]
            # a missing corner weighs nothing: any other stands for it
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
            for some in np.array_split(border, len(border) // 1024 + 1):
                casts.cast_samples(some + span.start, fine)
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
            free = (casts.bits[:, :] == 0).sum(axis=1) == 0
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
    """Fragments of one part by pixel, and the cells of square lattices around them."""

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
        # a margin on the far sides spares the tests at the frame's edge
        margin = 32
        self._at = np.full((height + margin, width + margin), -1, np.int64)
        inside = np.flatnonzero(single)
        self._at[y[inside], x[inside]] = inside

    def on(self, spacing: int) -> Int64:
        """Fragments that are points of the lattice."""
        mask = self._single & (self._x % spacing == 0) & (self._y % spacing == 0)
        return np.flatnonzero(mask)

    def cell(self, some: Int64, spacing: int) -> tuple[Int64, Float64]:
        """Corners (m, 4) of the cells of fragments `some`, -1 where missing, and their weights.

        Bilinear; a plane through three where one is missing; zero where more are.
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
    """How far `bend` of fragments `some` (m,) is from their cells' corners: from the mean, and from
    any."""
    at = np.where(corners >= 0, corners, some[:, None])
    around, own = bend[at], bend[some]
    off = np.linalg.norm(np.einsum("mk,mkc->mc", weights, around) - own, axis=-1)
    return off, np.linalg.norm(around - own[:, None], axis=-1).max(axis=1)


def _predictable(off: Float64, spread: Float64, loose: float) -> NDArray[np.bool_]:
    """Whether half vectors vary so linearly over a cell that images of wide lobes do."""
    answer: NDArray[np.bool_] = (off < loose * _BEND[0]) & (spread < loose * _BEND[1])
    return answer


def _sharp_bits(
    scene: Scene, span: slice, visibility: _Visibility | None
) -> tuple[NDArray[np.int64], NDArray[np.bool_]] | None:
    """Cut nodes that outshine all others, and whether each fragment sees them, a ray for each."""
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
    visibility: _Visibility,
    span: slice,
    normals: Float64,
    some: Int64,
    corners: Int64,
    sharp: tuple[NDArray[np.int64], NDArray[np.bool_]] | None,
    loose: float,
) -> NDArray[np.bool_]:
    """Whether the corners of a fragment's cell are lit alike."""
    rows = np.where(corners >= 0, visibility.row_of[span][corners], -1).astype(np.int32)
    cells, which = np.unique(rows, axis=0, return_inverse=True)
    first = np.zeros(len(cells), np.int64)
    first[which.reshape(-1)[::-1]] = np.arange(len(which))[::-1]
    unlike = np.empty(len(cells), np.float32)
    _disagreement(
        unlike, visibility.bits, cells, normals[some[first]],
        visibility.toward, visibility.cut.share,
    )  # fmt: skip
    agree: NDArray[np.bool_] = (unlike < loose**1.5 * _UNEVEN)[which.reshape(-1)]
    if sharp is not None:
        nodes, own = sharp
        for k, node in enumerate(nodes):
            bit = np.append(visibility.bits[:, node], np.uint8(2))  # row -1: nothing is known
            # a corner below the light's horizon says nothing about its shadow
            same = np.where(rows >= 0, (bit[rows] == own[some, k, None]) | (bit[rows] == 2), True)
            agree &= same.all(axis=1)
    return agree


def light_tree(environment: EnvironmentMap) -> LightTree:
    """The tree that an `Operator` walks; build it once for several operators under one map."""
    return LightTree.build(_divided(environment))


def _divided(environment: EnvironmentMap) -> EnvironmentMap:
    """The same light in texels of at most 1/256 of a half turn: each is hidden or not as a whole,
    and small enough for series about its centre."""
    rows, columns, _ = environment.image.shape
    down, across = -(-256 // rows), -(-512 // columns)
    if down == across == 1:
        return environment
    image = environment.image.repeat(down, axis=0).repeat(across, axis=1)
    return EnvironmentMap(image, environment.rotation)


def _near_window(grid: HalfDiffGrid, low: float, high: float) -> Float32:
    """(theta_h nodes,) 1 for the narrow lobes' cells, falling smoothly to 0 from `low` to `high`,
    which are nodes: so leaves of either side meet none of the other's."""
    t = np.clip((grid.theta_h - low) / (high - low), 0.0, 1.0)
    return np.asarray(1.0 - t * t * (3.0 - 2.0 * t), np.float32)


def _lobe(grid: HalfDiffGrid, tables: Float32, grazing: float) -> float:
    """The theta_h within which tables (grid.size, T) hardly change: the width of their lobes.

    Views further from the normal than `grazing` are not asked for.
    """
    seen = grid.theta_d <= grazing + _SPLIT[1]
    values = tables.reshape(*grid.shape, -1)[:, seen].reshape(grid.shape[0], -1, tables.shape[1])
    change = np.abs(values - values[0]).max(axis=1) > _FLAT * np.abs(values).max(axis=(0, 1))
    steps = np.flatnonzero(change.any(axis=1))
    return float(grid.theta_h[max(steps[0] - 1, 0)]) if len(steps) else 0.5 * math.pi


def _core(grid: HalfDiffGrid, tables: Float32) -> float:
    """Half the theta_h within which the narrowest peak of tables (grid.size, T) falls to its half.

    Peaks are looked for where they are a notable share of their table's; `CORE` at most.
    """
    nodes = int(np.searchsorted(grid.theta_h, 2.0 * CORE)) + 1
    values = tables.reshape(grid.shape[0], -1, tables.shape[1])[:nodes]
    peak = values[0]
    high = peak > 0.01 * peak.max(axis=0)
    low = np.flatnonzero(((values < 0.5 * peak) & high).any(axis=(1, 2)))
    if not len(low):
        return CORE
    return float(np.clip(0.5 * grid.theta_h[low[0]], SHARPEST, CORE))


_NO_TABLES = np.zeros((1, 0), np.float32)
_UNKNOWN, _LIT, _DOUBTFUL, _PARTLY = 0, 1, 2, 3

_NO_CUT = (np.zeros(1, np.int32), np.zeros(1, np.int32))
_NO_MASKS = tuple(np.zeros((1, 1), np.uint64) for _ in range(3))


# The loops below are what torch cannot express: tree descents, and sums over lists of uneven
# length. Numba compiles them; everything that runs while a user paints is torch, on any device.


@numba.njit(cache=True, nogil=True)
def _cut_ranges(child: Any, split: Any) -> Any:
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
def _inherit(
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
def _pack_bits(bits: Any, neighbours: Any, hidden: Any, unseen: Any, unhidden: Any) -> None:
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
def _disagreement(out: Any, bits: Any, cells: Any, normals: Any, toward: Any, share: Any) -> None:
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
def _interpolate(out: Any, coarse: Any, corners: Any, weights: Any) -> None:
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
    leaves: Any, ask: Any, answers: Any, n: Any, v: Any, mask: Any,
    place: Any, moment: Any, child: Any, box: Any, image: Any,
    first: Any, last: Any, hidden: Any, unseen: Any, unhidden: Any,
    spread: Any, rule: Any, low: Any, high: Any, outline: Any, lobe: Any,
    stack: Any, fates: Any, cells: Any,
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
def _stencils(
    n: Any, v: Any, leaves: Any, count: Any,
    n_h: Any, n_d: Any, n_p: Any, cell: Any, place: Any,
) -> None:  # fmt: skip
    """First cells and interpolation weights of leaves: free of branches, so that it vectorises.

    cell (3, n): theta_h and theta_d of the lowest cell of the nearer theta_h sample as one index,
    how many theta_h nodes further the other one starts, and phi_d; place (7, n): fractions along
    theta_h (both samples), theta_d, phi_d, and the irradiance RGB.
    """
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
    row: Any, touched: Any, found: Any, n: Any, v: Any, share: Any, count: Any, leaves: Any,
    n_h: Any, n_d: Any, n_p: Any, cell: Any, place: Any,
) -> Any:  # fmt: skip
    """Add one sample's leaves to a row (cells, 4), RGB and a filler.

    `touched[0]` lists the `found` pairs of theta_h and theta_d that hold something, `touched[1]`
    says which these are; returns how many there are now.
    """
    _stencils(n, v, leaves, count, n_h, n_d, n_p, cell, place)
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
def _release(out: Any, row: Any, touched: Any, found: Any, n_p: Any, tables: Any) -> None:
    """Add a row to `out`: (3, T) its radiance under tables (cells, T), or (3, cells) itself where
    `tables` has no column; then clear it."""
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
def _one_leaf(
    out: Any, starts: Any, normals: Any, views: Any, share: Any, leaves: Any,
    n_h: Any, n_d: Any, n_p: Any, tables: Any,
) -> None:  # fmt: skip
    """Add one leaf (13, 1) a sample: to radiance, or to rows where `tables` has no column."""
    block = 64
    for u in numba.prange((len(out) + block - 1) // block):
        cell = np.empty((3, 1), np.int32)
        part = np.empty((7, 1), np.float32)
        row = np.zeros((n_h * n_d * n_p, 4), np.float32)
        touched = np.zeros((2, n_h * n_d), np.int32)
        for f in range(u * block, min(u * block + block, len(out))):
            found = 0
            for p in range(starts[f], starts[f + 1]):
                found = _collect(
                    row, touched, found, normals[p], views[p], share[p], 1, leaves[p],
                    n_h, n_d, n_p, cell, part,
                )  # fmt: skip
            _release(out[f], row, touched, found, n_p, tables)


@numba.njit(parallel=True, cache=True, error_model="numpy", nogil=True)
def _shade(
    out: Any, short: Any, ask: Any, asked: Any, answers: Any, final: Any,
    bundle_start: Any, group_start: Any, target: Any, normals: Any, views: Any, share: Any,
    middle_normals: Any, middle_views: Any, spread: Any, masks: Any, several: Any,
    place: Any, moment: Any, child: Any, box: Any, image: Any,
    first: Any, last: Any, hidden: Any, unseen: Any, unhidden: Any,
    rules: Any, low: Any, high: Any, outline: Any, lobe: Any, capacity: Any,
    n_h: Any, n_d: Any, n_p: Any, tables: Any,
) -> None:  # fmt: skip
    """Add the leaves of all groups: to radiance, or to rows where `tables` has no column.

    Unless this is the `final` call, groups with questions are left out; groups with more leaves
    than the capacity always are (`short`).
    """
    block = 16
    bundles = len(bundle_start) - 1
    for u in numba.prange((bundles + block - 1) // block):
        stack = np.empty(512, np.int32)
        fates = np.empty(512, np.int8)
        cells = np.empty((512, 6), np.float32)
        leaves = np.empty((13, capacity), np.float32)
        cell = np.empty((3, capacity), np.int32)
        part = np.empty((7, capacity), np.float32)
        # every sample of a fragment goes into one row: its neighbours touch the same cells
        row = np.zeros((n_h * n_d * n_p, 4), np.float32)
        touched = np.zeros((2, n_h * n_d), np.int32)
        found, current = 0, -1
        for g in range(bundle_start[u * block], bundle_start[min(u * block + block, bundles)]):
            count, asked[g] = _walk(
                leaves, ask[g], answers[g], middle_normals[g], middle_views[g], masks[g],
                place, moment, child, box, image, first, last, hidden, unseen, unhidden,
                spread[g], rules[1 if several[g] else 0], low, high, outline, lobe,
                stack, fates, cells,
            )  # fmt: skip
            if count == capacity:
                short[g] = True
                continue
            if asked[g] > 0 and not final:
                continue
            for p in range(group_start[g], group_start[g + 1]):
                if target[p] != current and found > 0:
                    _release(out[current], row, touched, found, n_p, tables)
                    found = 0
                current = target[p]
                found = _collect(
                    row, touched, found, normals[p], views[p], share[p], count, leaves,
                    n_h, n_d, n_p, cell, part,
                )  # fmt: skip
        if found > 0:
            _release(out[current], row, touched, found, n_p, tables)
