"""Frames at once: images at some thousand nodes, interpolated to all fragments by kriging.

`Transport` fits a basis to its scene, which takes half a minute. `NodeTransport` takes a basis that
is fitted to no scene (`UniversalBasis`) and computes its images at few fragments, the nodes. All
other fragments are interpolated from their neighbours in position, normal and mirror direction. A
frame is A (B (C rho)), within milliseconds, after some seconds. It is linear in the table, but for
where the sum over nodes would overshoot what these show (`interpolate_nodes`).

*Nodes.* Half of the first are drawn evenly. All others are drawn where the error of leaving a node
out, times the distance to the next node, is large: at highlights, outlines of shadows and creases.
`NodeTransport.refined` adds nodes. Fragments of a part are interpolated from nodes of that part.

*Error.* Some fragments, the probes, keep exact rows; comparing with them measures each frame.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from traitbrdf.directions import reflect
from traitbrdf.scene.scene import Scene
from traitbrdf.transport.blends import Blend, has_mirrors, mirror_weights
from traitbrdf.transport.interpolation import interpolate_nodes, kriging
from traitbrdf.transport.lighttree import LightTree
from traitbrdf.transport.operator import Operator
from traitbrdf.transport.reflections import Regression, reflections, slopes_of
from traitbrdf.transport.universal import UniversalBasis
from traitbrdf.transport.visibility import Progress

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

NEIGHBOURS = 8
"""Nodes that a fragment is interpolated from."""

PROBES = 20
"""Fragments of a part that keep exact rows, to measure errors."""

_LEAST = 3 * NEIGHBOURS
"""Nodes of each part, however small it is."""

_AT_ONCE = 4096
"""Nodes whose images are computed between two reports of progress."""

_OTHERS = 0.5
"""What errors of typical materials count, beside those of the present ones."""

_EVEN = 0.02
"""Share of the mean error that every place counts as having, so that none is left out."""


class NodeFrame(NamedTuple):
    """A frame, and its measured error.

    Attributes
    ----------
    image : (H, W, 3) float32
        Linear radiance, backdrop included, never negative.
    error : float
        Mean relative L1 of covered pixels without mirrors, measured on the probes.
    """

    image: Float32
    error: float


class Nodes(NamedTuple):
    """The nodes of one part, and how its other fragments are interpolated from them.

    Attributes
    ----------
    at : (n,) int64
        Fragments of the scene, in the order in which they were drawn.
    images : (n, 3, R) float32
        Radiance of nodes under the tables of the basis, as if they covered their pixel.
    near : (P, k) int32
        Nodes of the part that each of its fragments is interpolated from.
    weights : (P, k) float32
        Their weights.
    regression : Regression
        Of the radiance of the nodes on the reflections around them.
    left_out : pair of (n, k) int64 and (n, k) float32
        The nodes that each node is interpolated from if it is left out, and their weights.
    """

    at: Int64
    images: Float32
    near: NDArray[np.int32]
    weights: Float32
    regression: Regression
    left_out: tuple[Int64, Float32]


class _Drawn(NamedTuple):
    """A part as it was drawn last.

    Attributes
    ----------
    table : (cells, 3) float32
    radiance : (P, 3) float32
    deviation, level : float
        Sums of |I - I_exact| and of I_exact over its fragments, measured on the probes.
    """

    table: Float32
    radiance: Float32
    deviation: float
    level: float


class NodeTransport:
    """The operator of a scene at some nodes, for frames within seconds of a new view or light.

    Parameters
    ----------
    scene : Scene
    basis : UniversalBasis, of the grid of the tables
    tables : sequence of (cells, 3) float32, one for each part
        What the parts are made of at present: nodes are placed for these.
    count : int
        Number of nodes.
    resolution : float
        As for `Operator`.
    tree : LightTree or None
        The tree of the scene's map, if it was built before.
    seed : int
        Draws nodes and probes.
    progress : called with (stage, fraction done); may raise to cancel

    Attributes
    ----------
    count : int
        Number of nodes that was asked for. There are fewer in a small scene, and some more if it
        has small parts.
    operator : Operator
        What images are computed with.
    parts : list of Nodes, one for each part
    """

    def __init__(
        self,
        scene: Scene,
        basis: UniversalBasis,
        tables: Sequence[Float32],
        count: int = 1000,
        resolution: float = 0.35,
        tree: LightTree | None = None,
        seed: int = 0,
        progress: Progress | None = None,
    ) -> None:
        report = progress or (lambda stage, fraction: None)
        report("nodes", 0.0)
        self.scene, self.basis, self.count = scene, basis, count
        self.operator = Operator(scene, basis.grid, resolution, tree)
        self._rng = np.random.default_rng(seed)
        self._places = places_of(scene)
        spans = [scene.part_slice(part) for part in range(len(scene.parts))]
        self._probes = np.concatenate(
            [np.sort(s.start + self._rng.permutation(s.stop - s.start)[:PROBES]) for s in spans]
        )
        rows = Operator(scene, basis.grid, 1.0, self.operator.tree).rows(self._probes)
        self._rows = torch.from_numpy(np.ascontiguousarray(rows.transpose(1, 0, 2)))
        self._pixels = torch.from_numpy(scene.pixels)
        backdrop = scene.backdrop().reshape(-1, 3) * scene.uncovered[:, None]
        self._backdrop = torch.from_numpy(np.ascontiguousarray(backdrop, dtype=np.float32))
        self._mirror: torch.Tensor | None = None
        self._projection = torch.from_numpy(np.ascontiguousarray(basis.projection))
        self._columns = reflections(scene)
        self._images: list[torch.Tensor] = []
        self._drawn: dict[int, _Drawn] = {}
        none = np.zeros(0, np.int64), np.zeros((0, 3, basis.tables.shape[1]), np.float32)
        nothing = np.zeros((0, NEIGHBOURS), np.int32), np.zeros((0, NEIGHBOURS), np.float32)
        alone = np.zeros((0, 0), np.int64), np.zeros((0, 0), np.float32)
        equations = Regression.of(self._columns[:0], *alone)
        self.parts = [Nodes(*none, *nothing, equations, alone) for _ in spans]
        for most in (count // 2, count):
            self._add(most, tables, report)
        self._join(report)

    def refined(
        self,
        count: int,
        tables: Sequence[Float32],
        progress: Progress | None = None,
    ) -> NodeTransport:
        """Return a transport with more nodes, those of this one included.

        This transport does not change, but for the numbers that it draws.

        Parameters
        ----------
        count : int
            Number of nodes.
        tables : sequence of (cells, 3) float32, one for each part
            What the parts are made of at present.
        progress : called with (stage, fraction done); may raise to cancel
        """
        report = progress or (lambda stage, fraction: None)
        other = copy.copy(self)
        other.count, other.parts = count, list(self.parts)
        other._add(count, tables, report)
        other._join(report)
        return other

    def forget(self) -> None:
        """Give back the memory that only `refined` needs; it would find all again."""
        self.operator.forget()

    @property
    def nodes(self) -> Int64:
        """Fragments at which images are computed."""
        return np.concatenate([part.at for part in self.parts])

    def frame(
        self,
        tables: Sequence[Float32],
        mirrors: Sequence[Float64] | None = None,
        blends: Mapping[int, Blend] | None = None,
    ) -> NodeFrame:
        """Compute a frame.

        Parameters
        ----------
        tables : sequence of (cells, 3) float32, one for each part
            f_r in 1/sr.
        mirrors : sequence of (3,) or None
            Weight of a perfect mirror beside each table.
        blends : mapping of part to Blend, or None
            Fragments of parts that have other materials. The error is measured without them.
        """
        scene = self.scene
        deviation = level = 0.0
        shown: dict[tuple[int, int], tuple[list[Float32], Float32]] = {}
        pieces = [np.zeros((0, 3), np.float32)]
        for part, table in enumerate(tables):
            span = scene.part_slice(part)
            if span.start == span.stop:
                continue
            known = self._drawn.get(part)
            if known is None or known.table is not table:
                group = self._groups[int(part >= len(scene.shape.parts))]
                key = id(table), group.start
                if key not in shown:
                    shown[key] = self._at_nodes(table, group)
                values, slopes = shown[key]
                known = self._draw(part, table, values[part - group.start], slopes)
                self._drawn[part] = known
            # another thread may draw other materials meanwhile: this frame has its own
            blend = None if blends is None else blends.get(part)
            pieces.append(known.radiance if blend is None else self._blended(part, known, blend))
            deviation += known.deviation
            level += known.level
        radiance = torch.from_numpy(np.concatenate(pieces))
        if mirrors is not None and has_mirrors(mirrors, blends):
            if self._mirror is None:
                self._mirror = torch.from_numpy(self.operator.mirror(np.arange(len(radiance))))
            weight = mirror_weights(scene, mirrors, blends)
            radiance += torch.from_numpy(weight) * self._mirror
        image = self._backdrop.clone().index_add_(0, self._pixels, radiance)
        frame = image.reshape(scene.height, scene.width, 3).numpy()
        return NodeFrame(frame, deviation / level if level > 0.0 else deviation)

    def _blended(self, part: int, drawn: _Drawn, blend: Blend) -> Float32:
        """Return the radiance (P, 3) of a part some fragments of which have other materials."""
        span, nodes = self.scene.part_slice(part), self.parts[part]
        group = self._groups[int(part >= len(self.scene.shape.parts))]
        shown = np.zeros((len(blend.at), 3), np.float32)
        for corner, table in enumerate(blend.tables):
            point, share = blend.of(corner)
            at = blend.at[point]
            values, slopes = self._at_nodes(table, group)
            columns = self._columns[span]
            rest = values[part - group.start] - np.einsum(
                "ncd,cd->nc", self._columns[nodes.at], slopes
            )
            found = np.empty((len(at), 3), np.float32)
            interpolate_nodes(found, rest, nodes.near[at], nodes.weights[at], columns[at], slopes)
            shown[point] += share[:, None] * found
        radiance = drawn.radiance.copy()
        radiance[blend.at] = shown * self._covered[span][blend.at]
        return radiance

    def _draw(self, part: int, table: Float32, shown: Float32, slopes: Float32) -> _Drawn:
        """Interpolate a part from its nodes (n, 3), and measure its error."""
        span, nodes = self.scene.part_slice(part), self.parts[part]
        columns = self._columns[span]
        rest = shown - np.einsum("ncd,cd->nc", self._columns[nodes.at], slopes)
        radiance = np.empty((span.stop - span.start, 3), np.float32)
        interpolate_nodes(radiance, rest, nodes.near, nodes.weights, columns, slopes)
        # a fragment shows the share of its pixel that it covers
        radiance *= self._covered[span]
        probes = slice(*np.searchsorted(self._probes, (span.start, span.stop)).tolist())
        cells = torch.from_numpy(table).T.contiguous()
        exact = torch.stack([self._rows[c, probes] @ cells[c] for c in range(3)], dim=1).numpy()
        stands_for = (span.stop - span.start) / len(exact)
        off = np.abs(radiance[self._probes[probes] - span.start] - exact)
        return _Drawn(
            table, radiance, stands_for * float(off.sum()), stands_for * float(exact.sum())
        )

    def _at_nodes(self, table: Float32, group: range) -> tuple[list[Float32], Float32]:
        """Return what the nodes (n, 3) of each part of a group show, and coefficients (3, D).

        These are found on all nodes of the group, whatever its parts are made of: small parts have
        few, and an edit of one part must not change another.
        """
        cells = torch.from_numpy(table).T.contiguous()
        coefficients = [self._projection @ cells[c] for c in range(3)]
        width = self._columns.shape[2]
        gram, moments = np.zeros((3, width, width), np.float32), np.zeros((3, width), np.float32)
        values = []
        for part in group:
            images, equations = self._images[part], self.parts[part].regression
            shown = torch.stack([images[c] @ coefficients[c] for c in range(3)], dim=1).numpy()
            values.append(shown)
            gram += equations.gram
            moments += np.einsum("cdn,nc->cd", equations.moments, shown)
        return values, slopes_of(gram, moments)

    @property
    def _groups(self) -> tuple[range, range]:
        """Parts of the shape, and the ground."""
        count = len(self.scene.shape.parts)
        return range(count), range(count, len(self.parts))

    # -- nodes ----------------------------------------------------------------------------------

    def _add(self, count: int, tables: Sequence[Float32], report: Progress) -> None:
        """Draw nodes, until there are `count` in the scene, and compute their images."""
        fresh = [np.zeros(0, np.int64) for _ in self.parts]
        # errors on the ground do not compare with those on the shape: each has its share of nodes
        for group in self._groups:
            spans = [self.scene.part_slice(part) for part in group]
            size = sum(span.stop - span.start for span in spans)
            if not size:
                continue
            most = round(count * size / max(len(self.scene.pixels), 1))
            have = sum(len(self.parts[part].at) for part in group)
            scores = [self._score(part, tables[part]) for part in group]
            whole = np.concatenate(scores)
            drawn = min(max(most, 1) - have, int(np.count_nonzero(whole)))
            if drawn > 0:
                # what is drawn has no order among places: any few of them are spread evenly
                chance = whole / whole.max()  # near darkness a sum of squares may underflow
                chosen = self._rng.choice(size, drawn, replace=False, p=chance / chance.sum())
                for part, span in zip(group, spans, strict=True):
                    at = chosen + spans[0].start
                    fresh[part] = at[(at >= span.start) & (at < span.stop)]
            for part, span in zip(group, spans, strict=True):
                lacking = min(_LEAST, span.stop - span.start) - len(self.parts[part].at)
                lacking -= len(fresh[part])
                if lacking > 0:
                    known = np.concatenate([self.parts[part].at, fresh[part]])
                    free = np.setdiff1d(np.arange(span.start, span.stop), known)
                    more = self._rng.choice(free, lacking, replace=False)
                    fresh[part] = np.concatenate([fresh[part], more])
        self._compute(fresh, report)

    def _compute(self, fresh: Sequence[Int64], report: Progress) -> None:
        """Compute images at further fragments of each part."""
        done, whole = 0, max(sum(map(len, fresh)), 1)
        for part, at in enumerate(fresh):
            known = self.parts[part]
            share = 0.9 * done / whole
            self.operator.cast(at, self._places, functools.partial(report, "nodes", share))
            images = [known.images]
            for some in np.array_split(at, len(at) // _AT_ONCE + 1):
                found = self.operator.images(some, self.basis.tables, self.operator.core)
                found /= self.scene.weights[some].astype(np.float32)[:, None, None]
                images.append(found)
                done += len(some)
                report("nodes", 0.9 * done / whole)
            nodes = np.concatenate([known.at, at])
            if len(at):
                left_out = kriging(self._places, nodes, nodes, NEIGHBOURS, leave_out=True)
                equations = Regression.of(self._columns[nodes], *left_out)
                known = known._replace(regression=equations, left_out=left_out)
            self.parts[part] = known._replace(at=nodes, images=np.concatenate(images))

    def _score(self, part: int, table: Float32) -> NDArray[np.float64]:
        """Return how much a part's fragments (P,) need a node: 0 for those that are one."""
        known, span = self.parts[part], self.scene.part_slice(part)
        score = np.ones(span.stop - span.start)
        if len(known.at) > NEIGHBOURS:
            places = self._places
            away, nearest = cKDTree(places[known.at]).query(places[span], 1, workers=-1)
            own = self.basis.projection @ table
            typical = self.basis.typical[:, :, None].repeat(3, axis=2).transpose(1, 0, 2)
            # materials may change: a share of the nodes goes where others would need them
            error = self._left_out(known, [own])
            error += _OTHERS * self._left_out(known, list(typical)) / len(typical)
            score = (error[nearest] + _EVEN * error.mean()) * away
        score[known.at - span.start] = 0.0
        return score

    def _join(self, report: Progress) -> None:
        """Prepare the interpolation, and what frames read."""
        report("nodes", 0.9)
        self._images, self._drawn = [], {}
        for part, nodes in enumerate(self.parts):
            span = self.scene.part_slice(part)
            every = np.arange(span.start, span.stop)
            at, weights = kriging(self._places, nodes.at, every, NEIGHBOURS)
            self.parts[part] = nodes._replace(near=at.astype(np.int32), weights=weights)
            images = np.ascontiguousarray(nodes.images.transpose(1, 0, 2))
            self._images.append(torch.from_numpy(images))
        self._covered = self.scene.weights[:, None].astype(np.float32)
        report("nodes", 1.0)

    def _left_out(self, nodes: Nodes, shown: Sequence[Float32]) -> NDArray[np.float64]:
        """Return each node's relative error (n,) if it is interpolated from the others."""
        near, weights = nodes.left_out
        columns = self._columns[nodes.at]
        error = np.full(len(nodes.at), 1e-12)
        for coefficients in shown:
            radiance = np.einsum("ncr,rc->nc", nodes.images, coefficients)
            slope = nodes.regression.slopes(radiance)
            rest = radiance - np.einsum("ncd,cd->nc", columns, slope)
            found = np.einsum("nk,nkc->nc", weights, rest[near])
            error += np.abs(found - rest).mean(axis=1) / max(float(radiance.mean()), 1e-30)
        return error


def places_of(scene: Scene) -> Float32:
    """Return where fragments lie (P, 9): twice their position in radii, normal, mirror direction.

    What they show under any table and light depends on these.
    """
    middle = scene.offsets[:-1] + np.diff(scene.offsets) // 2
    normals, views = scene.normals[middle], scene.views[middle]
    positions = 2.0 * scene.positions[middle] / scene.shape.radius
    return np.concatenate([positions, normals, reflect(views, normals)], axis=1).astype(np.float32)
