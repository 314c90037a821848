"""Frames at once: images at some thousand nodes, interpolated to all fragments by kriging.

`Transport` fits a basis to its scene, which takes half a minute. `NodeTransport` takes a basis that
is fitted to no scene (`UniversalBasis`) and computes its images at few fragments, the nodes. All
other fragments are interpolated from their neighbours in position, normal and mirror direction. A
frame is A (B (C rho)): linear in the table, within milliseconds, after some seconds.

*Nodes.* Half of the first are drawn evenly. All others are drawn where the error of leaving a node
out, times the distance to the next node, is large: at highlights, outlines of shadows and creases.
`NodeTransport.refined` adds nodes.

*Error.* Some fragments, the probes, keep exact rows; comparing with them measures each frame.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from traitbrdf.directions import reflect
from traitbrdf.scene.scene import Scene
from traitbrdf.transport.kernels import kriging_weights
from traitbrdf.transport.lighttree import LightTree
from traitbrdf.transport.operator import Operator
from traitbrdf.transport.universal import UniversalBasis
from traitbrdf.transport.visibility import Progress

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

NEIGHBOURS = 8
"""Nodes that a fragment is interpolated from."""

PROBES = 20
"""Fragments of a part that keep exact rows, to measure errors."""

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


class _Group(NamedTuple):
    """Fragments that are interpolated from nodes among them.

    Attributes
    ----------
    fragments : (P,) int64
    nodes : (n,) int64, some of the fragments
    images : (n, 3, R) float32
        Radiance of nodes under the tables of the basis, as if they covered their pixel.
    """

    fragments: Int64
    nodes: Int64
    images: Float32


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
        Number of nodes that was asked for; there are fewer in a small scene.
    nodes : (n,) int64
        Fragments at which images are computed.
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
        self._operator = Operator(scene, basis.grid, resolution, tree)
        self._rng = np.random.default_rng(seed)
        self._places = _places(scene)
        spans = [scene.part_slice(part) for part in range(len(scene.parts))]
        self._probes = np.concatenate(
            [np.sort(s.start + self._rng.permutation(s.stop - s.start)[:PROBES]) for s in spans]
        )
        rows = Operator(scene, basis.grid, 1.0, self._operator.tree).rows(self._probes)
        self._rows = torch.from_numpy(np.ascontiguousarray(rows.transpose(1, 0, 2)))
        self._projection = torch.from_numpy(np.ascontiguousarray(basis.projection))
        self._pixels = torch.from_numpy(scene.pixels)
        backdrop = scene.backdrop().reshape(-1, 3) * scene.uncovered[:, None]
        self._backdrop = torch.from_numpy(np.ascontiguousarray(backdrop, dtype=np.float32))
        self._mirror: torch.Tensor | None = None
        none = np.zeros(0, np.int64), np.zeros((0, 3, basis.tables.shape[1]), np.float32)
        self._groups = [_Group(fragments, *none) for fragments in _fragments(scene)]
        for most in (count // 2, count):
            self._groups = [self._more(group, most, tables, report) for group in self._groups]
        self._join(report)

    def refined(
        self, count: int, tables: Sequence[Float32], progress: Progress | None = None
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
        other.count = count
        other._groups = [self._more(group, count, tables, report) for group in self._groups]
        other._join(report)
        return other

    def frame(
        self, tables: Sequence[Float32], mirrors: Sequence[Float64] | None = None
    ) -> NodeFrame:
        """Compute a frame.

        Parameters
        ----------
        tables : sequence of (cells, 3) float32, one for each part
            f_r in 1/sr.
        mirrors : sequence of (3,) or None
            Weight of a perfect mirror beside each table.
        """
        scene = self.scene
        radiance = torch.empty((len(scene.pixels), 3))
        deviation = level = 0.0
        known: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}
        for part, table in enumerate(tables):
            span = scene.part_slice(part)
            if span.start == span.stop:
                continue
            if id(table) not in known:
                columns = torch.from_numpy(table).T.contiguous()
                at_nodes = [self._images[c] @ (self._projection @ columns[c]) for c in range(3)]
                known[id(table)] = columns, torch.stack(at_nodes, dim=1)
            columns, shown = known[id(table)]
            radiance[span] = torch.nn.functional.embedding_bag(
                self._near[span], shown, per_sample_weights=self._weights[span], mode="sum"
            ).clamp_min_(0.0)
            probes = slice(*np.searchsorted(self._probes, (span.start, span.stop)).tolist())
            exact = torch.stack([self._rows[c, probes] @ columns[c] for c in range(3)], dim=1)
            stands_for = (span.stop - span.start) / len(exact)
            found = radiance[self._probes[probes]]
            deviation += stands_for * float((found - exact).abs().sum())
            level += stands_for * float(exact.sum())
        if mirrors is not None and any(np.any(m) for m in mirrors):
            if self._mirror is None:
                self._mirror = torch.from_numpy(self._operator.mirror(np.arange(len(radiance))))
            weight = np.stack([np.asarray(m, np.float32) for m in mirrors])[scene.pixel_part]
            radiance += torch.from_numpy(weight) * self._mirror
        image = self._backdrop.clone().index_add_(0, self._pixels, radiance)
        frame = image.reshape(scene.height, scene.width, 3).numpy()
        return NodeFrame(frame, deviation / level if level > 0.0 else deviation)

    # -- nodes ----------------------------------------------------------------------------------

    def _more(
        self, group: _Group, count: int, tables: Sequence[Float32], report: Progress
    ) -> _Group:
        """Draw more nodes of a group, of `count` in the whole scene, and compute their images."""
        fragments, nodes, images = group
        whole = len(self.scene.pixels)
        most = min(max(1, round(count * len(fragments) / whole)), len(fragments))
        score = np.ones(len(fragments))
        if len(nodes) > NEIGHBOURS:
            tree = cKDTree(self._places[nodes])
            away, nearest = tree.query(self._places[fragments], 1, workers=-1)
            parts = np.unique(self.scene.pixel_part[fragments])
            shown = {id(tables[part]): tables[part] for part in parts}.values()
            own = [self.basis.projection @ one for one in shown]
            typical = self.basis.typical[:, :, None].repeat(3, axis=2).transpose(1, 0, 2)
            # materials may change: a share of the nodes goes where others would need them
            error = self._left_out(nodes, images, own) / max(len(own), 1)
            error += _OTHERS * self._left_out(nodes, images, list(typical)) / len(typical)
            score = (error[nearest] + _EVEN * error.mean()) * away
        score[np.searchsorted(fragments, nodes)] = 0.0
        drawn = min(most - len(nodes), int(np.count_nonzero(score)))
        if drawn <= 0:
            return group
        chosen = self._rng.choice(len(fragments), drawn, replace=False, p=score / score.sum())
        fresh = fragments[np.sort(chosen)]
        found = self._operator.images(fresh, self.basis.tables)
        found /= self.scene.weights[fresh].astype(np.float32)[:, None, None]
        report("nodes", 0.8 * float(fragments[-1]) / whole)
        return _Group(fragments, np.concatenate([nodes, fresh]), np.concatenate([images, found]))

    def _join(self, report: Progress) -> None:
        """Collect what frames read of all groups."""
        report("nodes", 0.8)
        none = np.zeros(0, np.int64), np.zeros((0, 3, self.basis.tables.shape[1]), np.float32)
        nodes, images = [none[0]], [none[1]]
        near = [np.zeros((0, NEIGHBOURS), np.int64)]
        weights = [np.zeros((0, NEIGHBOURS), np.float32)]
        for group in self._groups:
            at, share = self._kriging(group.fragments, group.nodes)
            missing = ((0, 0), (0, NEIGHBOURS - at.shape[1]))
            near.append(np.pad(at + sum(map(len, nodes)), missing, "edge"))
            weights.append(np.pad(share, missing))
            nodes.append(group.nodes)
            images.append(group.images)
        self.nodes = np.concatenate(nodes)
        whole = np.concatenate(images).transpose(1, 0, 2)
        self._images = torch.from_numpy(np.ascontiguousarray(whole))
        self._near = torch.from_numpy(np.concatenate(near).astype(np.int32))
        # a fragment shows the share of its pixel that it covers
        covered = self.scene.weights[:, None].astype(np.float32)
        self._weights = torch.from_numpy(np.concatenate(weights) * covered)
        report("nodes", 1.0)

    def _left_out(
        self, nodes: Int64, images: Float32, shown: Sequence[Float32]
    ) -> NDArray[np.float64]:
        """Return each node's relative error (n,) if it is interpolated from the others."""
        near, weights = self._kriging(nodes, nodes, leave_out=True)
        error = np.full(len(nodes), 1e-12)
        for coefficients in shown:
            radiance = np.einsum("ncr,rc->nc", images, coefficients)
            found = np.einsum("nk,nkc->nc", weights, radiance[near])
            error += np.abs(found - radiance).mean(axis=1) / max(float(radiance.mean()), 1e-30)
        return error

    def _kriging(self, at: Int64, nodes: Int64, leave_out: bool = False) -> tuple[Int64, Float32]:
        places = self._places
        count = min(NEIGHBOURS, len(nodes) - leave_out)
        _, near = cKDTree(places[nodes]).query(places[at], count + leave_out, workers=-1)
        near = near.reshape(len(at), -1)[:, int(leave_out) :].astype(np.int64)
        weights = np.empty(near.shape, np.float32)
        kriging_weights(weights, places[nodes], places[at], np.ascontiguousarray(near))
        return near, weights


def _fragments(scene: Scene) -> list[Int64]:
    """Return the fragments of the shape, and those of the ground: these groups do not mix."""
    spans = [scene.part_slice(part) for part in range(len(scene.parts))]
    count = len(scene.shape.parts)
    groups = [group for group in (spans[:count], spans[count:]) if group]
    found = [np.arange(group[0].start, group[-1].stop) for group in groups]
    return [fragments for fragments in found if len(fragments)]


def _places(scene: Scene) -> Float32:
    """Return where fragments lie (P, 9): twice their position in radii, normal, mirror direction.

    What they show under any table and light depends on these.
    """
    middle = scene.offsets[:-1] + np.diff(scene.offsets) // 2
    normals, views = scene.normals[middle], scene.views[middle]
    positions = 2.0 * scene.positions[middle] / scene.shape.radius
    return np.concatenate([positions, normals, reflect(views, normals)], axis=1).astype(np.float32)
