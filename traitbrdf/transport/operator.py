"""Rows of the transport operator: the light that reaches a pixel, cut into leaves of one tree.

The radiance of a pixel is I = sum over leaves of E_leaf * f(theta_h, theta_d, phi_d), which is
linear in the table's cells. A *leaf* is a piece of the environment map with its exact vector
irradiance. `Operator` turns leaves into rows (a weight for every cell) or, which is much cheaper,
into images of given tables.

*Leaves.* The map is walked as a tree (`LightTree`; Walter et al. 2005). A node of light stands for
its texels where it looks small from the mirror peak, measured in half-vector space; a texel that
looks large is cut further. A node's irradiance is exact, and its extent is carried into theta_h to
second order (two samples one standard deviation apart). So the error falls with the fourth power of
the node size, while the number of nodes grows with its inverse square.

*Shadows.* A cut through the tree has some thousand nodes of little light each, and bright lights
are cut down to single texels. Each node of the cut gets one shadow ray (`VisibilityCut`).
Neighbouring pixels see nearly the same occluders, so rays are cast on a coarse lattice of pixels,
and between lattice points only where the points around disagree. At borders, where the samples of a
pixel lie on both sides of an edge, rays are cast for every sample; near the shadows of thin things,
they are cast from many places of every pixel (`ThinShadows`). A glossy surface shows the
outline of an occluder near the mirror direction; leaves there cast rays of their own.

*Far and near.* Images of lobes wider than `_SPLIT` vary slowly from pixel to pixel. These far
images are computed on the lattice, and interpolated wherever normals and shadows vary linearly over
its cells. Elsewhere, and for the narrow rest (near images), every pixel is computed. A smooth
window over theta_h separates the two, so their sum is exact.

References
----------
B. Walter, S. Fernandez, A. Arbree, K. Bala, M. Donikian, D. Greenberg, "Lightcuts: a scalable
approach to illumination", ACM Transactions on Graphics 24(3), 2005: cuts through a tree of lights.
S. Rusinkiewicz, "A new change of variables for efficient BRDF representation", EGWR 1998.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from traitbrdf.directions import reflect
from traitbrdf.reflectance.brdf import HalfDiffGrid
from traitbrdf.scene.lights import EnvironmentMap, Light, turn_about_y
from traitbrdf.scene.scene import Scene
from traitbrdf.transport.arrays import (
    QuadratureSettings,
    Questions,
    Tables,
    TreeArrays,
    VisibilityMasks,
)
from traitbrdf.transport.bundles import (
    Bundles,
    alike_masks,
    centres,
    expand,
    first_rows,
    questions,
)
from traitbrdf.transport.kernels import interpolate_images, one_leaf, shade_rows
from traitbrdf.transport.lighttree import LightTree
from traitbrdf.transport.thin import light_on_thin_shadows
from traitbrdf.transport.visibility import Plan, Progress, Visibility, VisibilityCut

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
f32 = np.float32

_SPLIT = (0.15, 0.35)
"""theta_h in radians over which the window passes from near to far, at a scale of 1."""

FLAT = 0.03
"""Greatest change of a table within the width of its lobe, relative to its largest value."""

_OUTLINE = 0.03
"""theta_h in radians up to which leaves at an occluder's outline cast rays of their own."""

_CUT = (0.09, 1 / 500)
"""Greatest radius (radians) and greatest share of the flux of a node of the visibility cut."""

_QUESTIONS = 192
"""Most rays that a group of samples casts at the outlines of occluders."""

CORE = 3e-3
"""theta_h in radians: half the width of the narrowest peak that leaves resolve by default."""

SHARPEST = 1e-4
"""theta_h in radians: half the width of the narrowest peak that any table is resolved to."""

_SHARED = ((4, 0.002), (2, 0.007))
"""Side in pixels of blocks that share one walk, and how far their half vectors may differ in
radians."""

_FIRST = 1000
"""Scattered fragments that cast all of their rays, before others take over what they see."""

_PIECE = 1024
"""Samples that are shaded between two reports: whoever cancels should not wait."""

_UNITED = 0.007
"""How far the half vectors of the samples of a fragment may differ for one walk, in radians."""


class _Lobes(NamedTuple):
    """The lobes that leaves have to resolve.

    Attributes
    ----------
    window : range of theta_h in radians of the light that is added
    width : theta_h in radians within which the tables hardly change
    core : half the width of the narrowest peak in radians; None for the operator's
    exact : whether leaves are as fine as sharp lobes need at silhouettes
    """

    window: tuple[float, float] = (-1.0, 9.0)
    width: float = 0.0
    core: float | None = None
    exact: bool = False


class _Light(NamedTuple):
    """What the walk reads beside the samples."""

    tree: TreeArrays
    masks: VisibilityMasks
    settings: QuadratureSettings


class Operator:
    """The transport operator W of a scene: what every cell of a table adds to every fragment.

    Parameters
    ----------
    scene : Scene
    grid : HalfDiffGrid of the "folded" layout
    resolution : float
        1 is the default; 2 halves the size of the light's leaves and of the visibility nodes.
    tree : LightTree or None
        What `light_tree` makes of the scene's map, if it was built before.
    core : float
        Half the width in theta_h, in radians, of the narrowest peak that rows and interpolated
        images resolve. Exact images resolve the peaks of their tables.
    shadows : float or None
        Resolution of the visibility nodes alone; None for `resolution`.

    Attributes
    ----------
    visibility : Visibility or None
        Shared visibility of the fragments; None where nothing casts shadows.
    rules, exact_rules : (2, 4) float32
        How finely leaves are cut for interpolated and for exact images: the first four columns of
        `QuadratureSettings.rules`.
    capacity : int
        Room for the leaves of one group of samples; doubled for groups that need more.

    Raises
    ------
    ValueError
        If the grid has another layout, or a number is not positive and finite.
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
            tree = light_tree(scene.environment)
        self.tree = tree
        self._nodes = TreeArrays(*self.tree.packed, environment.image)
        scale = 1.0 / resolution
        # wider leaves than these at a peak would lose sharp lobes
        rule = np.array([0.5 * min(scale, 4.0), scale**2 / 200.0, 0.05 * scale, 0.1 * scale])
        border = rule * (1.6, 2.56, 1.6, 1.6)  # the eight samples of a fragment share the error
        # exact images serve sharp lobes, which need leaves of half that size at the grazing angles
        # of a silhouette
        fine = border * (0.5 / 1.6, 1.0, 1.0, 1.0)
        self.rules = np.stack([rule, border]).astype(np.float32)
        self.exact_rules = np.stack([rule, fine]).astype(np.float32)
        self.capacity = int(1600 * resolution**2) + 200
        to_map = scene.environment.to_map
        self._normals = np.ascontiguousarray(to_map(scene.normals), np.float32)
        self._views = np.ascontiguousarray(to_map(scene.views), np.float32)
        # where one sample has to stand for a fragment, it is the middle one
        self._middle = scene.offsets[:-1] + np.diff(scene.offsets) // 2
        self.visibility: Visibility | None = None
        if any(scene.casts):
            wide = 1.0 / (resolution if shadows is None else shadows)
            width = min(wide, math.sqrt(wide))  # shadows blur less well than lobes do
            cut = VisibilityCut.build(self.tree, _CUT[0] * width, _CUT[1] * width**2)
            self.visibility = Visibility(scene, cut, self._middle)
        self._plans: dict[int, Plan] = {}
        self._thin: dict[Light, tuple[Int64, Float64]] = {}

    # -- single fragments -----------------------------------------------------------------------

    def rows(self, index: NDArray[np.integer]) -> Float32:
        """Compute rows of W: (m, 3, grid.size) float32, one for each fragment and colour.

        Parameters
        ----------
        index : (m,) int
            Fragments of the scene.
        """
        at = np.asarray(index, np.int64)
        out = np.zeros((len(at), 3, self.grid.size), np.float32)
        self._shade(out, at, self._mask_rows(at), _Lobes(), _NO_TABLES)
        self._add_lights(out, at, _NO_TABLES)
        return out

    def rows_as_shown(self, index: NDArray[np.integer]) -> Float32:
        """Compute the rows of W, (m, 3, grid.size) float32, that `part_images` applies.

        They use the shadows and the leaves that fragments share with the pixels around them, so
        these rows and the images belong to one operator. Those of `rows` are slightly more exact.

        Parameters
        ----------
        index : (m,) int
            Distinct fragments of the scene.
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
            masks = self.plan(part).mask_rows
            self._shade(out, everything, masks, _Lobes(), _NO_TABLES, place=place)
        self._add_lights(out, at, _NO_TABLES)
        return out

    def images(
        self, index: NDArray[np.integer], tables: Float32, core: float | None = None
    ) -> Float32:
        """Compute the radiance (m, 3, T) float32 of fragments under scalar tables.

        Parameters
        ----------
        index : (m,) int
            Fragments of the scene.
        tables : (grid.size, T) float32, in 1/sr
        core : float or None
            Half the width in theta_h, in radians, of the narrowest peak that is resolved; None is
            that of the tables. With the operator's own, these are `rows` times the tables.
        """
        at = np.asarray(index, np.int64)
        tables = np.ascontiguousarray(tables, np.float32)
        out = np.zeros((len(at), 3, tables.shape[1]), np.float32)
        lobes = _Lobes(core=self._core_of(tables) if core is None else core)
        self._shade(out, at, self._mask_rows(at), lobes, tables)
        self._add_lights(out, at, tables)
        return out

    def mirror(self, index: NDArray[np.integer]) -> Float32:
        """Compute the radiance (m, 3) float32 that a perfect mirror shows at fragments (m,)."""
        scene = self.scene
        index = np.asarray(index, np.int64)
        sample, owner, share = scene.samples(index)
        toward = np.asarray(reflect(scene.views[sample], scene.normals[sample]), np.float64)
        seen = scene.environment.radiance(toward) * scene.visible(sample, toward)[:, None]
        out = np.zeros((len(index), 3))
        np.add.at(out, owner, seen * share[:, None])
        return out.astype(np.float32)

    def _core_of(self, tables: Float32) -> float:
        return min(self.core, core_of(self.grid, tables))

    def settle(self) -> None:
        """Give back some memory of the shadow rays, if all parts have cast theirs."""
        spans = [self.scene.part_slice(part) for part in range(len(self.scene.parts))]
        cast = all(part in self._plans or s.start == s.stop for part, s in enumerate(spans))
        if cast and self.visibility is not None:
            self.visibility.settle()

    def forget(self) -> None:
        """Give back the memory of all shadow rays; what needs them casts them again."""
        if self.visibility is not None:
            self.visibility = Visibility(self.scene, self.visibility.cut, self._middle)
        self._plans = {}

    # -- whole parts ----------------------------------------------------------------------------

    def part_images(
        self,
        part: int,
        tables: Float32,
        progress: Progress | None = None,
        interpolate: bool = True,
        out: Float32 | None = None,
    ) -> Float32:
        """Compute the radiance (P, 3, T) float32 of all fragments of a part under scalar tables.

        Parameters
        ----------
        part : int
            Index into ``scene.parts``.
        tables : (grid.size, T) float32, in 1/sr
        progress : called with (stage, fraction done); may raise to cancel
        interpolate : bool
            Interpolate shadows where rays agree, and far images where normals and shadows vary
            linearly. This is ten times faster than `images`, and resolves peaks down to the
            operator's `core` only. Tables without narrow lobes have far images alone, in any case.
        out : (P, 3, T) float32 or None
            Zeros, to which the radiance is added.
        """
        report = progress or (lambda stage, fraction: None)
        span = self.scene.part_slice(part)
        index = np.arange(span.start, span.stop)
        tables = np.ascontiguousarray(tables, np.float32)
        if out is None:
            out = np.zeros((len(index), 3, tables.shape[1]), np.float32)
        if len(index) == 0:
            return out
        plan = self.plan(part, report)
        # where neighbouring pixels differ less, narrower lobes are interpolated too
        nodes = np.searchsorted(self.grid.theta_h, plan.scale * np.array(_SPLIT))
        low, high = (float(self.grid.theta_h[node]) for node in nodes)
        lobe = lobe_of(self.grid, tables, plan.grazing)
        broad = lobe >= high  # there is no near image
        if not interpolate and not broad:
            lobes = _Lobes(width=lobe, core=self._core_of(tables), exact=True)
            self._shade(
                out, index, plan.mask_rows, lobes, tables,
                lambda fraction: report("exact images", fraction),
            )  # fmt: skip
            self._add_lights(out, index, tables)
            return out
        near = np.repeat(_near_window(self.grid, low, high), self.grid.size // self.grid.shape[0])
        wide, far = tables, _Lobes(width=lobe)
        if not broad:
            wide, far = tables * (1.0 - near)[:, None], _Lobes((low, 9.0), lobe)
        coarse = np.zeros((len(plan.computed), 3, tables.shape[1]), np.float32)
        computed = index[plan.computed]
        self._shade(
            coarse, computed, self._own_rows(computed), far, wide,
            lambda fraction: report("far images", fraction),
        )  # fmt: skip
        interpolate_images(out, coarse, plan.corners, plan.weights)
        if not broad:
            self._shade(
                out, index, plan.mask_rows, _Lobes((-1.0, high), lobe), tables * near[:, None],
                lambda fraction: report("near images", fraction),
            )  # fmt: skip
        self._add_lights(out, index, tables)
        return out

    # -- leaves ---------------------------------------------------------------------------------

    def _bundles(self, index: Int64, mask_rows: NDArray[np.int32]) -> Bundles:
        """Return the samples of fragments `index`, in groups that share one walk of the tree."""
        scene = self.scene
        if self.visibility is None:
            sample, owner, share = scene.samples(index)
            own_row = np.full(len(sample), -1, np.int32)
        else:
            sample, owner, share, own_row = self.visibility.samples(index)
        count = np.bincount(owner, minlength=len(index))
        starts = np.concatenate([[0], np.cumsum(count)])
        normals, views = self._normals[sample], self._views[sample]
        single = np.flatnonzero(count == 1)
        x, y = scene.pixels[index] % scene.width, scene.pixels[index] // scene.width
        part = scene.pixel_part[index].astype(np.int64)
        group = np.full(len(index), -1, np.int64)  # of each fragment of one sample
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
            alike = alike_masks(
                edge, size, normals[starts[member]], views[starts[member]],
                scene.positions[sample[starts[member]]], mask_rows[member], limit,
            ) & (size > 1)  # fmt: skip
            joined = np.repeat(alike, size)
            group[member[joined]] = found + np.repeat(np.arange(alike.sum()), size[alike])
            found += int(alike.sum())
            single = np.sort(member[~joined])
        # a bundle is a group of fragments, or one fragment whose samples are one or many groups
        sampled = np.flatnonzero(count > 1)
        united = np.zeros(len(index), bool)
        if len(sampled):
            members, edge = expand(starts, sampled)
            united[sampled] = alike_masks(
                edge[:-1], count[sampled], normals[members], views[members],
                scene.positions[sample[members]], mask_rows[owner[members]], _UNITED,
            )  # fmt: skip
        united[owner[own_row >= 0]] = False
        alone = group < 0
        group[alone] = found + np.arange(alone.sum())
        order = np.argsort(group, kind="stable")
        sorted_samples, _ = expand(starts, order)
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
        return Bundles(
            bundle_start, group_start, target, normals[sorted_samples], views[sorted_samples],
            share[sorted_samples].astype(np.float32), sample[sorted_samples],
            *centres(group_start, normals[sorted_samples], views[sorted_samples]),
            first_rows(group_start, masks), several,
        )  # fmt: skip

    def _light(self, lobes: _Lobes) -> _Light:
        """Return the nodes, masks and settings of a walk that resolves some lobes."""
        low, high = lobes.window
        low, high = math.sin(max(low, -0.5)), math.sin(min(high, 0.5 * math.pi))
        masks = _NO_MASKS
        if self.visibility is not None:
            cut = self.visibility.cut
            masks = VisibilityMasks(cut.first, cut.last, *self.visibility.masks)
        exact = lobes.exact or self.resolution > 1.0
        core = self.core if lobes.core is None else lobes.core
        rules = np.concatenate(
            [self.exact_rules if exact else self.rules, np.full((2, 1), core, np.float32)], axis=1
        )
        settings = QuadratureSettings(
            rules, f32(low), f32(high if high < 1.0 else 9.0),
            f32(math.sin(_OUTLINE) if lobes.width <= _SPLIT[1] else -9.0),
            f32(math.sin(lobes.width)), self.capacity,
        )  # fmt: skip
        return _Light(self._nodes, masks, settings)

    def _shade(
        self,
        out: Float32,
        index: Int64,
        mask_rows: NDArray[np.int32],
        lobes: _Lobes,
        tables: Float32,
        report: Callable[[float], None] = lambda fraction: None,
        place: Int64 | None = None,
    ) -> None:
        """Add the light of the map to fragments.

        Parameters
        ----------
        out : (m, 3, T) radiance under the tables, or (m, 3, cells) rows where T is 0
        index : (m,) fragments
        mask_rows : (m, 4) visibility rows that surround each fragment, -1 for none
        lobes : which leaves are taken
        tables : (cells, T)
        report : called with the fraction done
        place : (m,) where in `out` each fragment is; those of -1 are left out
        """
        step = 1 << 13
        light = self._light(lobes)
        for i in range(0, len(index), step):
            at = slice(i, min(i + step, len(index)))
            if place is not None and not (place[at] >= 0).any():
                continue
            bundles, target = self._bundles(index[at], mask_rows[at]), out[at]
            if place is not None:
                bundles, target = bundles.of(place[at]), out
            done, whole = 0, max(len(bundles.target), 1)
            for some in bundles.pieces(_PIECE):
                self._shade_all(target, some, light, tables)
                done += len(some.target)
                report((at.start + (at.stop - at.start) * done / whole) / len(index))

    def _shade_all(self, out: Float32, bundles: Bundles, light: _Light, tables: Float32) -> None:
        """Shade bundles; repeat with twice the room those that have more leaves than it holds."""
        settings = light.settings._replace(capacity=self.capacity)
        while len(bundles.several):
            light = light._replace(settings=settings)
            bundles = bundles.take(self._shade_some(out, bundles, light, tables))
            settings = settings._replace(capacity=2 * settings.capacity)

    def _shade_some(
        self, out: Float32, bundles: Bundles, light: _Light, tables: Float32
    ) -> NDArray[np.bool_]:
        """Shade bundles, and return which groups have more leaves than the capacity."""
        groups = len(bundles.several)
        shown = Tables(*self.grid.shape, tables)
        asked = np.zeros(groups, np.int64)
        ask = np.empty((groups, _QUESTIONS, 3), np.float32)
        unanswered = Questions(ask, np.ones((groups, _QUESTIONS), np.uint8), False)
        shade_rows(out, asked, unanswered, bundles, *light, shown)
        again = asked > 0
        # pixels that need rays do not share a walk
        shared = again & (np.diff(bundles.group_start) > 1)
        again &= ~shared
        if shared.any():
            self._shade_all(out, bundles.take(shared).separated(), light, tables)
        if again.any():
            local, which = questions(ask[again], asked[again])
            toward = turn_about_y(local, self.scene.environment.rotation)
            some = bundles.take(again)
            count = len(some.several)
            answers = np.ones((count, _QUESTIONS), np.uint8)
            asker = some.sample[some.group_start[:-1]]
            answers[which] = self.scene.visible(asker[which[0]], toward)
            final = Questions(ask[:count], answers, True)
            shade_rows(out, np.zeros(count, np.int64), final, some, *light, shown)
        return asked < 0

    def _add_lights(self, out: Float32, index: Int64, tables: Float32) -> None:
        """Add the point and directional lights: each is one leaf for every sample."""
        scene = self.scene
        step = 1 << 16
        for light in scene.lights:
            for i in range(0, len(index), step):
                at = slice(i, min(i + step, len(index)))
                sample, owner, share = scene.samples(index[at])
                toward, irradiance = self._lights_reach(light, sample)
                leaves = np.zeros((len(sample), 13, 1), np.float32)
                local = scene.environment.to_map(toward)
                leaves[:, :3, 0] = local
                # vector irradiance: a surface that faces the light gets all of it
                leaves[:, 3:12, 0] = (irradiance[:, :, None] * local[:, None, :]).reshape(-1, 9)
                starts = np.searchsorted(owner, np.arange(at.stop - at.start + 1)).astype(np.int64)
                one_leaf(
                    out[at], starts, self._normals[sample], self._views[sample],
                    share.astype(np.float32), leaves, Tables(*self.grid.shape, tables),
                )  # fmt: skip

    def _lights_reach(self, light: Light, sample: Int64) -> tuple[Float64, Float64]:
        """Return what `Scene.arriving` does, the mean over pixels that thin shadows cross."""
        toward, irradiance = self.scene.arriving(light, sample)
        if self.resolution >= 1.0:
            if light not in self._thin:
                self._thin[light] = light_on_thin_shadows(self.scene, light)
            which, mean = self._thin[light]
            if len(which):
                at = np.searchsorted(which, sample).clip(max=len(which) - 1)
                irradiance = np.where((which[at] == sample)[:, None], mean[at], irradiance)
        return toward, irradiance

    # -- visibility -----------------------------------------------------------------------------

    def _own_rows(self, index: Int64) -> NDArray[np.int32]:
        """Return (m, 4) with each fragment's own visibility row first; -1 for none."""
        rows = np.full((len(index), 4), -1, np.int32)
        if self.visibility is not None:
            rows[:, 0] = self.visibility.row_of[index]
        return rows

    def _mask_rows(self, index: Int64) -> NDArray[np.int32]:
        """Return own rows (m, 4) of any fragments, and cast rays for those that have none yet."""
        visibility = self.visibility
        if visibility is None or not len(index):
            return self._own_rows(index)
        unknown = self._without_rows(index)
        if len(unknown):
            around = np.full((len(unknown), 4), -1, np.int32)
            for part, plan in list(self._plans.items()):
                span = self.scene.part_slice(part)
                mine = (unknown >= span.start) & (unknown < span.stop)
                around[mine] = plan.mask_rows[unknown[mine] - span.start]
            visibility.cast(unknown, around, least=3)
            visibility.cast_samples(unknown, self.resolution > 1.0)
        return self._own_rows(index)

    def _without_rows(self, index: Int64) -> Int64:
        """Return those of fragments (m,), sorted, that need rays and have cast none."""
        if self.visibility is None:
            return np.zeros(0, np.int64)
        casts = np.asarray(self.scene.casts)[self.scene.pixel_part[index]]
        return np.unique(index[casts & (self.visibility.row_of[index] < 0)])

    def cast(
        self,
        index: Int64,
        places: NDArray[np.floating[Any]],
        report: Callable[[], None] = lambda: None,
    ) -> None:
        """Cast the rays of scattered fragments: fewer than `images` would where places are near.

        A few fragments cast all rays. Of the others, twice as many each time, each takes over that
        on which the four nearest agree.

        Parameters
        ----------
        index : (m,) int64
            Fragments, in random order, none twice.
        places : (fragments, d) float
            Where all fragments of the scene lie; near ones see the same.
        report : callable
            Is called now and then; may raise to cancel.
        """
        visibility = self.visibility
        if visibility is None or not len(index):
            return
        known = index[visibility.row_of[index] >= 0]
        missing = index[np.isin(index, self._without_rows(index))]
        done = 0
        while done < len(missing):
            fresh = missing[done : done + max(len(known), _FIRST)]
            around = np.full((len(fresh), 4), -1, np.int32)
            if len(known) >= _FIRST:
                _, near = cKDTree(places[known]).query(places[fresh], 4, workers=-1)
                around = visibility.row_of[known[near]]
            visibility.cast(fresh, around, 4, verify=True, report=report)
            visibility.cast_samples(fresh, self.resolution > 1.0)
            known = np.concatenate([known, fresh])
            done += len(fresh)

    def prepare(self, part: int, progress: Progress | None = None) -> None:
        """Cast a part's rays and choose where its far images are computed, unless that is done.

        Parameters
        ----------
        part : int
            Index into ``scene.parts``.
        progress : called with (stage, fraction done); may raise to cancel
        """
        self.plan(part, progress)

    def plan(self, part: int, progress: Progress | None = None) -> Plan:
        """Return where a part's far images are computed; see `prepare`."""
        if part not in self._plans:
            report = progress or (lambda stage, fraction: None)
            loose = max(1.0, 1.0 / self.resolution)
            fine = self.resolution > 1.0
            self._plans[part] = Plan.make(self.scene, part, self.visibility, loose, fine, report)
        return self._plans[part]


def light_tree(environment: EnvironmentMap) -> LightTree:
    """Return the tree that an `Operator` walks; it is built once for all operators under a map."""
    image = environment.image
    known = _TREES.get(id(image))
    if known is None or known.derived[_BUILT_FROM] is not image:
        known = LightTree.build(_divided(environment))
        known.derived[_BUILT_FROM] = image
        _TREES[id(image)] = known
    return known


def _divided(environment: EnvironmentMap) -> EnvironmentMap:
    """Return the same light in texels of at most 1/256 of a half turn.

    A texel is visible or hidden as a whole, and the walk uses series about its centre.
    """
    rows, columns, _ = environment.image.shape
    down, across = -(-256 // rows), -(-512 // columns)
    if down == across == 1:
        return environment
    image = environment.image.repeat(down, axis=0).repeat(across, axis=1)
    return EnvironmentMap(image, environment.rotation)


def _near_window(grid: HalfDiffGrid, low: float, high: float) -> Float32:
    """Return the window (theta_h nodes,) of near images: 1, then a smooth fall to 0.

    The fall begins at `low` and ends at `high`. Both are nodes, so no leaf beyond either of them
    touches a cell of the other side.
    """
    t = np.clip((grid.theta_h - low) / (high - low), 0.0, 1.0)
    return np.asarray(1.0 - t * t * (3.0 - 2.0 * t), np.float32)


def lobe_of(grid: HalfDiffGrid, tables: Float32, grazing: float) -> float:
    """Return the theta_h in radians within which tables hardly change: the width of their lobes.

    Parameters
    ----------
    grid : HalfDiffGrid
    tables : (grid.size, T) float32
    grazing : float
        Largest angle in radians of a view from its normal; cells beyond it do not count.
    """
    seen = grid.theta_d <= grazing + _SPLIT[1]
    values = tables.reshape(*grid.shape, -1)[:, seen].reshape(grid.shape[0], -1, tables.shape[1])
    change = np.abs(values - values[0]).max(axis=1) > FLAT * np.abs(values).max(axis=(0, 1))
    steps = np.flatnonzero(change.any(axis=1))
    return float(grid.theta_h[max(steps[0] - 1, 0)]) if len(steps) else 0.5 * math.pi


def core_of(grid: HalfDiffGrid, tables: Float32) -> float:
    """Return half the theta_h in radians where the narrowest peak of tables falls to its half.

    Only peaks above a hundredth of their table's highest count. The result is from `SHARPEST` to
    `CORE`.

    Parameters
    ----------
    grid : HalfDiffGrid
    tables : (grid.size, T) float32
    """
    nodes = int(np.searchsorted(grid.theta_h, 2.0 * CORE)) + 1
    values = tables.reshape(grid.shape[0], -1, tables.shape[1])[:nodes]
    peak = values[0]
    high = peak > 0.01 * peak.max(axis=0)
    low = np.flatnonzero(((values < 0.5 * peak) & high).any(axis=(1, 2)))
    if not len(low):
        return CORE
    return float(np.clip(0.5 * grid.theta_h[low[0]], SHARPEST, CORE))


_TREES: weakref.WeakValueDictionary[int, LightTree] = weakref.WeakValueDictionary()
"""The trees in use, by the identity of their maps' images, which they keep."""
_BUILT_FROM = ("image",)

_NO_TABLES = np.zeros((1, 0), np.float32)
_NO_NODES, _NO_WORDS = np.zeros(1, np.int32), np.zeros((1, 1), np.uint64)
_NO_MASKS = VisibilityMasks(_NO_NODES, _NO_NODES, _NO_WORDS, _NO_WORDS, _NO_WORDS)
