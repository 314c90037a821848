"""Shadows of thin things: where they fall, and how much of each pixel they cover.

A wire that is thinner than the spacing of shadow rays is met by chance. So the mesh is asked: seen
from a lamp, its outline has two sides, and where these lie within a few pixels of each other, it is
thin. Its shadow is found by rays from there, away from the lamp. Pixels near it cast rays from many
places within them, which give the share of the pixel that sees each node of the lamp.

Outlines in object space are those of Appel, "The notion of quantitative invisibility and the
machine rendering of solids", Proceedings of the ACM National Conference, 1967: edges between a
triangle that faces the light and one that does not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from traitbrdf.scene.lights import Light, PointLight
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import Mesh

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

_THIN = 3.0
"""Width in pixels below which a thing is thin: rays around it find wider ones."""

_LONG = 24
"""Least number of points of a thin thing's outline within as many pixels."""

_DENSE = 3.0
"""Least share of all flux per steradian of a lamp's node: wider lights blur thin shadows away."""

_LAMP = (0.1, 0.02)
"""Greatest radius of a lamp in radians, and its least share of all flux."""

_RAYS = (256, 4, 128)
"""Rays of a pixel to a lamp, and the least and the most of them to one node."""

_NEAR = 3
"""Pixels around a thin shadow that count as near it."""

_MOST = 1 << 20
"""Most rays at a time, and most points of outlines."""


class Outline(NamedTuple):
    """Points on the edges of a mesh's outline as a lamp sees it.

    Attributes
    ----------
    points : (n, 3) float64 world positions, about a pixel apart
    inward : (n, 3) float64
        Unit vectors across the edge and the light, to the side that hides the light.
    toward : (n, 3) float64 unit directions to the lamp
    pixel : (n,) float64 size of a pixel at the points
    """

    points: Float64
    inward: Float64
    toward: Float64
    pixel: Float64

    def take(self, which: NDArray[np.generic]) -> Outline:
        """Return the points of an index or a mask."""
        return Outline(*(array[which] for array in self))


class ThinShadows:
    """Which fragments of a scene lie in or near the shadows of thin things.

    Parameters
    ----------
    scene : Scene
    toward : (D, 3) float64 unit world directions to the nodes of the map's light
    share : (D,) float64, of all flux
    neighbours : (D, k) int, the nearest other nodes

    Attributes
    ----------
    nodes : (N,) int64 nodes of the lamps whose thin shadows show
    near : (fragments,) bool, or None where nothing thin has a shadow
    """

    def __init__(
        self, scene: Scene, toward: Float64, share: Float64, neighbours: NDArray[np.integer]
    ) -> None:
        self._scene = scene
        self._toward = toward
        self.nodes = np.zeros(0, np.int64)
        self.near: Bool | None = None
        found = [(nodes, shadows_near(scene, toward[nodes]))
                 for nodes in lamps(toward, share, neighbours)]  # fmt: skip
        masks = [mask for _, mask in found if mask is not None]
        if masks:
            self.nodes = np.concatenate([nodes for nodes, mask in found if mask is not None])
            self.near = np.logical_or.reduce(masks)

    def seen(self, index: Int64) -> Float64:
        """Return the share (m, N) of each fragment's pixel that sees each of `nodes`.

        Parameters
        ----------
        index : (m,) int64 fragments of one sample
        """
        total, least, most = _RAYS
        count = len(self.nodes)
        rays = min(max(total // count, least), most)
        places = max(rays, 16)
        # nodes side by side look from different places, so that a pixel's rays are spread
        place = (np.arange(rays) * (places // rays) + 5 * np.arange(count)[:, None]) % places
        directions = np.repeat(self._toward[self.nodes], rays, axis=0)
        sample = self._scene.offsets[index]
        answer = np.empty((len(index), count))
        step = max(_MOST // (count * rays), 1)
        for i in range(0, len(index), step):
            some = sample[i : i + step]
            starts = self._scene.spread(some, places)[:, place.ravel()].reshape(-1, 3)
            free = self._scene.visible(
                np.repeat(some, count * rays), np.tile(directions, (len(some), 1)), starts
            )
            answer[i : i + step] = free.reshape(len(some), count, rays).mean(axis=-1)
        return answer

    def seen_by_samples(self, sample: Int64) -> NDArray[np.uint8]:
        """Return which of `nodes` each sample sees: (m, N) 0 or 1.

        Parameters
        ----------
        sample : (m,) int64
        """
        count = len(self.nodes)
        answer = np.empty((len(sample), count), np.uint8)
        step = max(_MOST // count, 1)
        for i in range(0, len(sample), step):
            some = sample[i : i + step]
            free = self._scene.visible(
                np.repeat(some, count), np.tile(self._toward[self.nodes], (len(some), 1))
            )
            answer[i : i + step] = free.reshape(len(some), count)
        return answer


def lamps(toward: Float64, share: Float64, neighbours: NDArray[np.integer]) -> list[Int64]:
    """Return the nodes of each small bright light of a map, whose shadows are sharp.

    Parameters
    ----------
    toward : (D, 3) float64 unit directions to nodes of light
    share : (D,) float64, of all flux
    neighbours : (D, k) int, the nearest other nodes
    """
    apart = np.linalg.norm(toward - toward[neighbours[:, 0]], axis=-1)
    # a node is about as wide as it is far from the next; a single one has no other
    area = 0.25 * math.pi * np.where(apart > 0.0, apart, 0.01) ** 2
    bright = np.flatnonzero(share > _DENSE * area)
    bright = bright[np.argsort(-share[bright], kind="stable")]
    found = []
    while len(bright):
        mine = np.linalg.norm(toward[bright] - toward[bright[0]], axis=-1) < 2.0 * _LAMP[0]
        if share[bright[mine]].sum() > _LAMP[1]:
            found.append(np.sort(bright[mine]))
        bright = bright[~mine]
    return found


def shadows_near(scene: Scene, light: Float64 | Light) -> Bool | None:
    """Return which fragments (P,) are near the shadows of thin things; None for none.

    Parameters
    ----------
    scene : Scene
    light : PointLight, DirectionalLight or (N, 3) float64
        The directions to the nodes of a lamp of the map.
    """
    mesh = scene.shape
    if not isinstance(mesh, Mesh) or not any(scene.casts):
        return None
    if isinstance(light, PointLight):
        thin = _thin(mesh, outline(scene, mesh, np.asarray(light.position), near=True))
        away = [-thin.toward]
    else:
        nodes = light if isinstance(light, np.ndarray) else np.array([light.direction])
        middle = nodes.mean(axis=0)
        thin = _thin(mesh, outline(scene, mesh, middle / np.linalg.norm(middle)))
        away = [np.broadcast_to(-node, thin.points.shape) for node in nodes]
    if not len(thin.points):
        return None
    marked = np.zeros((scene.height, scene.width), bool)
    starts = _beside(mesh, thin)
    for directions in away:
        met = scene.reached(starts, directions)
        with np.errstate(invalid="ignore"):
            at = np.floor(scene.camera.project(mesh, scene.height, scene.width, met))
            inside = (at >= 0.0).all(axis=1) & (at < (scene.width, scene.height)).all(axis=1)
        x, y = at[inside].astype(np.int64).T
        marked[y, x] = True
    marked = binary_dilation(marked, np.ones((2 * _NEAR + 1, 2 * _NEAR + 1), bool))
    near: Bool = marked.ravel()[scene.pixels] & np.asarray(scene.casts)[scene.pixel_part]
    return near if near.any() else None


def outline(scene: Scene, mesh: Mesh, light: Float64, near: bool = False) -> Outline:
    """Return the outline of a mesh as a lamp sees it.

    Parameters
    ----------
    scene : Scene
    mesh : Mesh
    light : (3,) float64
        Unit direction to the lamp; its position if it is `near`.
    near : bool
    """
    edges = mesh.edges
    corners = mesh.vertices[mesh.faces]
    toward = light - corners[:, 0] if near else light
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    faces = (across * toward).sum(axis=-1) > 0.0
    first = edges.starts[:-1]
    low = np.minimum.reduceat(faces[edges.face], first)
    high = np.maximum.reduceat(faces[edges.face], first)
    chosen = np.flatnonzero((low != high) | (np.diff(edges.starts) == 1))
    a, b = (mesh.vertices[v] for v in edges.ends[first[chosen]].T)
    origin = scene.camera.position(mesh, scene.height, scene.width)
    per_pixel = 2.0 * math.tan(math.radians(scene.camera.fov) / 2) / scene.height
    size = per_pixel * np.linalg.norm(0.5 * (a + b) - origin, axis=-1)
    length = np.linalg.norm(b - a, axis=-1)
    pieces = np.ceil(length / size)
    pieces = np.maximum(np.ceil(pieces * min(1.0, _MOST / max(pieces.sum(), 1.0))), 1.0)
    edge = np.repeat(np.arange(len(chosen)), pieces.astype(np.int64))
    step = np.arange(len(edge)) - np.searchsorted(edge, edge)
    points = a[edge] + ((step + 0.5) / pieces[edge])[:, None] * (b - a)[edge]
    to_light = light - 0.5 * (a + b) if near else np.broadcast_to(light, a.shape)
    to_light = to_light / np.linalg.norm(to_light, axis=-1, keepdims=True)
    # across the edge and the light; the third corner of a triangle tells the side
    side = np.cross(b - a, to_light)
    side /= np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-300)
    third = corners[edges.face].sum(axis=1) - mesh.vertices[edges.ends].sum(axis=1)
    group = np.full(len(first), -1)
    group[chosen] = np.arange(len(chosen))
    mine = np.repeat(group, np.diff(edges.starts))
    some = mine >= 0
    reach = ((third[some] - a[mine[some]]) * side[mine[some]]).sum(axis=-1)
    inside = np.bincount(mine[some], reach, minlength=len(chosen))
    inward = np.where(inside < 0.0, -1.0, 1.0)[:, None] * side
    return Outline(points, inward[edge], to_light[edge], size[edge])


def _thin(mesh: Mesh, found: Outline) -> Outline:
    """Return those points of an outline that have its other side near."""
    if len(found.points) < 2:
        return found.take(np.zeros(0, np.int64))
    # points of several distances: the reach of each is a few of its own pixels
    thin = np.zeros(len(found.points), bool)
    tree = cKDTree(found.points)
    for i in range(0, len(found.points), 1 << 14):
        some = np.arange(i, min(i + (1 << 14), len(found.points)))
        near = tree.query_ball_point(found.points[some], _THIN * found.pixel[some])
        size = np.fromiter((len(n) for n in near), np.int64, len(near))
        one, other = np.repeat(some, size), np.concatenate(near).astype(np.int64)
        between = found.points[other] - found.points[one]
        inward, opposite = found.inward[one], found.inward[other]
        facing = (inward * opposite).sum(axis=-1) < -0.3
        facing &= (between * inward).sum(axis=-1) > 0.0
        facing &= (between * opposite).sum(axis=-1) < 0.0
        thin[one[facing]] = True
    found = found.take(thin)
    # the outline of a thick thing has kinks, but across it the light is hidden all the same; two
    # distances, because another thin thing may be in the way at one
    free = np.zeros(len(found.points), bool)
    for far in (1.1, 1.6):
        across = far * _THIN * found.pixel[:, None] * found.inward
        free |= ~mesh.occluded(found.points + across, found.toward)
    # what is in a shadow has none of its own
    free &= ~mesh.occluded(_beside(mesh, found), found.toward)
    found = found.take(free)
    if not len(found.points):
        return found
    # a thin thing is longer than it is wide; corners of thick things are not
    tree = cKDTree(found.points)
    around = tree.query_ball_point(found.points, _LONG * found.pixel, return_length=True)
    return found.take(np.asarray(around) >= _LONG)


def _beside(mesh: Mesh, found: Outline) -> Float64:
    """Return points (n, 3) just outside of an outline, where rays pass by the thing itself."""
    return found.points - (0.02 * found.pixel + 1e-5 * mesh.radius)[:, None] * found.inward


def light_on_thin_shadows(scene: Scene, light: Light) -> tuple[Int64, Float64]:
    """Return samples near thin shadows of a light, ascending, and the light on their pixels.

    Samples at borders are spread over their pixels already, so they are not among them.

    Parameters
    ----------
    scene : Scene
    light : PointLight or DirectionalLight

    Returns
    -------
    samples : (n,) int64
    irradiance : (n, 3) float64
        Mean over the pixel, on a surface that faces the light.
    """
    near = shadows_near(scene, light) if scene.shadows else None
    if near is None:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    samples = scene.offsets[np.flatnonzero(near & ~scene.bordering)]
    rays = _RAYS[2]
    mean = np.zeros((len(samples), 3))
    step = _MOST // rays
    for i in range(0, len(samples), step):
        some = samples[i : i + step]
        starts = scene.spread(some, rays).reshape(-1, 3)
        _, irradiance = scene.arriving(light, np.repeat(some, rays), starts)
        mean[i : i + step] = irradiance.reshape(-1, rays, 3).mean(axis=1)
    return samples, mean
