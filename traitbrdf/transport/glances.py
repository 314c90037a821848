"""Glances: small frames of the real materials, while a camera or a light is moved.

A frame at nodes (`traitbrdf.transport.nodes`) for one material takes a tenth of a second if it has
few nodes. Nodes are points of the surface. Those that are still seen stay from frame to frame, so
that the picture does not flicker; a few leave where the frame is smooth, and others come where
leaving one out would show. Under a light that turns, the interpolation stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from traitbrdf.reflectance.brdf import HalfDiffGrid
from traitbrdf.scene.scene import Scene
from traitbrdf.transport.blends import Blend, has_mirrors, mirror_weights
from traitbrdf.transport.interpolation import interpolate_nodes, kriging
from traitbrdf.transport.lighttree import LightTree
from traitbrdf.transport.nodes import NodeFrame
from traitbrdf.transport.operator import Operator
from traitbrdf.transport.reflections import Regression, blurred, reflections

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

NODES = 400
"""Nodes of a frame."""

NEIGHBOURS = 4
"""Nodes that a fragment is interpolated from."""

RESOLUTION = 0.12
"""Of the light, as for `Operator`."""

PROBES = (20, 0.35)
"""Fragments that measure the error, and the resolution of the light there."""

_NEW = 0.15
"""Share of the nodes that leave and come at each frame."""

_FIRST = 0.5
"""Share of the nodes of a first, unseen frame that stay."""

_CANDIDATES = 4000
"""Fragments of which the new nodes are chosen."""

_EVEN = 0.1
"""Share of the mean error that every place counts as having, so that none is left out."""

_NORMAL = 2.2
"""How much the normal counts beside the position: as with its mirror direction, sqrt(1 + 4)."""

_APART = 100.0
"""How far parts lie from each other: far more than any two fragments of one part."""


Blends: TypeAlias = Callable[[Scene], Mapping[int, Blend]]


class _Nodes(NamedTuple):
    """The nodes of the last frame.

    Attributes
    ----------
    at : (n,) int64, fragments of the small scene
    near : (P, k) int32, the nodes that each fragment is interpolated from
    weights : (P, k) float32
    error : (n,) float64, of each node if it is interpolated from the others
    """

    at: Int64
    near: NDArray[np.int32]
    weights: Float32
    error: Float64


class Glances:
    """Makes small frames of scenes that differ in camera or light.

    Parameters
    ----------
    grid : HalfDiffGrid of the tables
    size : int
        Pixels along the longer side, or the scene's own number if that is smaller.
    seed : int
        Draws nodes and probes.
    """

    def __init__(self, grid: HalfDiffGrid, size: int = 256, seed: int = 0) -> None:
        self.grid, self.size = grid, size
        self._rng = np.random.default_rng(seed)
        self._of: Scene | None = None
        self._scene: Scene | None = None
        self._places: Float32 | None = None
        self._nodes: _Nodes | None = None
        self._levels: tuple[Float32, list[torch.Tensor]] | None = None

    def frame(
        self,
        scene: Scene,
        tables: Sequence[Float32],
        mirrors: Sequence[Float64] | None = None,
        tree: LightTree | None = None,
        blends: Blends | None = None,
    ) -> NodeFrame:
        """Render a small frame (h, w, 3), and measure its error.

        Parameters
        ----------
        scene : Scene
            At its full size.
        tables : sequence of (cells, 3) float32, one for each part
            f_r in 1/sr.
        mirrors : sequence of (3,) or None
            Weight of a perfect mirror beside each table.
        tree : LightTree or None
            The tree of the scene's map, if it was built before.
        blends : callable or None
            Returns the fragments of the small scene that have other materials, by part. The error
            is measured without them.
        """
        if self._nodes is None or self._scene is None or self._scene.shape is not scene.shape:
            self._nodes = None
            self._frame(scene, tables, None, tree)  # it tells where nodes are needed
            self._of = None
        return self._frame(scene, tables, mirrors, tree, blends)

    def _frame(
        self,
        scene: Scene,
        tables: Sequence[Float32],
        mirrors: Sequence[Float64] | None,
        tree: LightTree | None,
        blends: Blends | None = None,
    ) -> NodeFrame:
        # the distinct tables, and which parts are made of each
        distinct = {id(table): table for table in tables}.values()
        made_of = [(one, np.array([table is one for table in tables])) for one in distinct]
        small = self._small(scene)
        count = len(small.pixels)  # casts the camera's rays
        with ThreadPoolExecutor(1, "traitbrdf-glance") as pool:
            # one core looks up the map while the other begins with the nodes
            looked_up = pool.submit(reflections, small, self._blurred(scene))
            behind = pool.submit(_behind, small)
            places, nodes = self._placed(scene, small)
            operator = Operator(small, self.grid, RESOLUTION, tree)
            shown = np.zeros((len(nodes.at), 3), np.float32)
            probes = np.sort(self._rng.choice(count, min(PROBES[0], count), replace=False))
            finer = Operator(small, self.grid, PROBES[1], operator.tree)
            exact = np.zeros((len(probes), 3), np.float32)
            for one, parts in made_of:
                for at, out, by in ((nodes.at, shown, operator), (probes, exact, finer)):
                    mine = np.flatnonzero(parts[small.pixel_part[at]])
                    if len(mine):
                        images = by.images(at[mine], one, by.core)
                        out[mine] = np.einsum("pcc->pc", images) / small.weights[at[mine], None]
            columns, picture = looked_up.result(), behind.result()
        known, weights = kriging(places, nodes.at, nodes.at, NEIGHBOURS, leave_out=True)
        radiance = np.zeros((count, 3), np.float32)
        for _, parts in made_of:
            mine = np.flatnonzero(parts[small.pixel_part[nodes.at]])
            if not len(mine):
                continue
            own = np.isin(known[mine], mine)
            order = np.where(own, np.searchsorted(mine, known[mine]), 0)
            found = Regression.of(columns[nodes.at[mine]], order, weights[mine] * own)
            slopes = found.slopes(shown[mine])
            shown[mine] -= np.einsum("ncd,cd->nc", columns[nodes.at[mine]], slopes)
            every = np.flatnonzero(parts[small.pixel_part])
            part = np.empty((len(every), 3), np.float32)
            interpolate_nodes(
                part, shown, nodes.near[every], nodes.weights[every], columns[every], slopes
            )
            radiance[every] = part
        measured = radiance[probes]
        others = blends(small) if blends is not None else {}
        for index, blend in others.items():
            every = small.part_slice(index).start + blend.at
            mine = np.flatnonzero(small.pixel_part[nodes.at] == index)
            if not len(mine):
                continue
            images = operator.images(
                nodes.at[mine], np.concatenate(blend.tables, axis=1), operator.core
            )
            images /= small.weights[nodes.at[mine], None, None].astype(np.float32)
            under = np.einsum("pckc->kpc", images.reshape(len(mine), 3, len(blend.tables), 3))
            own = np.isin(known[mine], mine)
            order = np.where(own, np.searchsorted(mine, known[mine]), 0)
            equations = Regression.of(columns[nodes.at[mine]], order, weights[mine] * own)
            at_nodes = np.zeros_like(shown)
            mixed = np.zeros((len(every), len(blend.tables), 3), np.float32)
            for k, one in enumerate(under):
                slopes = equations.slopes(one)
                at_nodes[mine] = one - np.einsum("ncd,cd->nc", columns[nodes.at[mine]], slopes)
                part = np.empty((len(every), 3), np.float32)
                interpolate_nodes(
                    part, at_nodes, nodes.near[every], nodes.weights[every], columns[every], slopes
                )
                mixed[:, k] = part
            radiance[every] = blend.sums(mixed)
        deviation, level = float(np.abs(measured - exact).sum()), float(exact.sum())
        left_out = np.einsum("nk,nkc->nc", weights, shown[known])
        self._nodes = nodes._replace(error=np.abs(left_out - shown).mean(axis=1))
        if mirrors is not None and has_mirrors(mirrors, others):
            weight = mirror_weights(small, mirrors, others)
            radiance = radiance + weight * operator.mirror(np.arange(count))
        # with one sample a pixel, no pixel has two fragments
        picture[small.pixels] += radiance * small.weights[:, None].astype(np.float32)
        frame = picture.reshape(small.height, small.width, 3)
        return NodeFrame(frame, deviation / level if level > 0.0 else deviation)

    def _blurred(self, scene: Scene) -> list[torch.Tensor]:
        """Return the scene's map at several sizes."""
        image = scene.environment.image
        if self._levels is None or self._levels[0] is not image:
            self._levels = image, blurred(scene.environment)
        return self._levels[1]

    def _small(self, scene: Scene) -> Scene:
        """Return the scene at a small size: with the last one's fragments under another light."""
        if self._of is not None and self._scene is not None and _same_view(self._of, scene):
            light = {name: getattr(scene, name) for name in ("environment", "lights", "shadows")}
            return self._scene.changed(**light)
        scale = min(1.0, self.size / max(scene.height, scene.width))
        shape = (max(1, round(scene.height * scale)), max(1, round(scene.width * scale)))
        return scene.changed(size=shape, subsamples=1)

    def _placed(self, scene: Scene, small: Scene) -> tuple[Float32, _Nodes]:
        """Return where fragments lie, and nodes."""
        last, known, first = self._scene, self._nodes, self._of is None
        same = self._of is not None and _same_view(self._of, scene)
        self._of, self._scene = scene, small
        if same and known is not None and self._places is not None:
            return self._places, known
        places = _places(small)
        kept, error = np.zeros(0, np.int64), np.zeros(0)
        if last is not None and known is not None:
            kept, error = _carried(last, known, small)
        at = self._chosen(places, kept, error, _FIRST if first else 1.0 - _NEW)
        near, weights = kriging(places, at, np.arange(len(places)), NEIGHBOURS, loose=0.5)
        # a part with few nodes has neighbours elsewhere, perhaps of another material
        other = small.pixel_part[at[near]] != small.pixel_part[:, None]
        mixed = other.any(axis=1)
        weights[mixed] = np.where(other[mixed], 0.0, np.maximum(weights[mixed], 1e-3))
        weights[mixed] /= weights[mixed].sum(axis=1, keepdims=True)
        self._places = places
        self._nodes = _Nodes(at, near.astype(np.int32), weights, np.zeros(len(at)))
        return places, self._nodes

    def _chosen(self, places: Float32, kept: Int64, error: Float64, share: float) -> Int64:
        """Return nodes (n,): at most a share of known ones, and fresh ones where needed."""
        count = len(places)
        wanted = min(NODES, count)
        most = int(share * wanted)
        if len(kept) > most:  # those go that the frame would miss least
            nearest = cKDTree(places[kept]).query(places[kept], 2)[0][:, 1]
            stay = np.argsort(-(error + _EVEN * error.mean()) * nearest, kind="stable")[:most]
            kept, error = kept[stay], error[stay]
        some = self._rng.choice(count, min(_CANDIDATES, count), replace=False)
        some = np.setdiff1d(some, kept)
        score = np.ones(len(some))
        if len(kept):
            away, near = cKDTree(places[kept]).query(places[some], 1)
            score = (error[near] + _EVEN * error.mean() + 1e-9) * away + 1e-12
        fresh = min(wanted - len(kept), len(some))
        if fresh > 0:
            chosen = self._rng.choice(some, fresh, replace=False, p=score / score.sum())
            kept = np.concatenate([kept, chosen])
        # a small part without nodes would show the material of another
        part = places[:, -1]
        for one in np.unique(part):
            lacking = NEIGHBOURS + 1 - int((part[kept] == one).sum())
            if lacking > 0:
                free = np.setdiff1d(np.flatnonzero(part == one), kept)
                few = self._rng.choice(free, min(len(free), lacking), replace=False)
                kept = np.concatenate([kept, few])
        return kept


def _behind(small: Scene) -> Float32:
    """Return the map (pixels, 3) behind the object, where it is seen."""
    picture = np.zeros((small.height * small.width, 3), np.float32)
    open_ = np.flatnonzero(small.uncovered)
    y, x = np.divmod(open_, small.width)
    rays = small.camera.through(small.height, small.width, x + 0.5, y + 0.5)
    picture[open_] = small.environment.backdrop(rays) * small.uncovered[open_, None]
    return picture


def _places(small: Scene) -> Float32:
    """Return where fragments lie (P, 7): position, normal and part.

    The mirror direction, which nodes of finished frames respect as well, turns twice as far as the
    normal: fewer dimensions are searched faster.
    """
    middle = small.offsets[:-1]
    positions = 2.0 * small.positions[middle] / small.shape.radius
    apart = _APART * small.pixel_part[:, None]
    return np.concatenate([positions, _NORMAL * small.normals[middle], apart], axis=1).astype("f4")


def _same_view(one: Scene, other: Scene) -> bool:
    """Return whether two scenes show the same fragments."""
    return (
        one.shape is other.shape
        and one.camera == other.camera
        and (one.height, one.width, one.parts) == (other.height, other.width, other.parts)
    )


def _carried(last: Scene, nodes: _Nodes, small: Scene) -> tuple[Int64, Float64]:
    """Return the fragments of a scene where nodes of the last one are still seen, and errors."""
    points = last.positions[last.offsets[nodes.at]]
    height, width = small.height, small.width
    x, y = np.nan_to_num(small.camera.project(small.shape, height, width, points), nan=-1.0).T
    inside = (x >= 0.0) & (y >= 0.0) & (x < width) & (y < height)
    pixel = np.where(inside, np.floor(np.clip(y, 0, height - 1)) * width + np.floor(x), 0)
    fragment = np.full(height * width, -1, np.int64)
    fragment[small.pixels] = np.arange(len(small.pixels))
    at = fragment[pixel.astype(np.int64).clip(0, height * width - 1)]
    found = np.flatnonzero(inside & (at >= 0))
    there = small.positions[small.offsets[at[found]]]
    # within two pixels of the same point of the same part, not in front of it or behind
    same = small.pixel_part[at[found]] == last.pixel_part[nodes.at[found]]
    near = 4.0 * small.shape.radius / min(height, width) * 2.0
    same &= np.linalg.norm(there - points[found], axis=1) < near
    at, first = np.unique(at[found[same]], return_index=True)
    return at, nodes.error[found[same]][first]
