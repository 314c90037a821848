"""Trails of a brush over surfaces, and how much each point of a surface gets of it.

A stroke is drawn on an image. Where rays through it meet the surface lies its *trail*: points with
normals, each with the radius of the brush there, in units of the world. The weight of a point of
the surface is a function of its distance to the trail alone, so it depends neither on a camera nor
on the size of an image. Two gates keep paint where the brush is: it stays on the part that the
brush touches, and on the side that faces it, so that nothing comes out on the far side of a handle.

Samples of the trail are evenly spaced along the stroke. How a stroke is cut into pieces changes
nothing.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.compiled import CACHED
from traitbrdf.scene.scene import Scene

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]

SPACING = 1 / 8
"""Distance between samples of a trail, in radii of the brush."""

SOFTEST_EDGE = 0.05
"""Even the hardest brush fades over this share of its radius, or its rim would be jagged."""

_JOINED = 1.5
"""Radii between two samples up to which paint covers what lies between them."""

_FACING = 0.35
"""Cosine between the normals of a point and of the brush from which the point gets all paint; it
gets none at 0."""

_LINKS_AT_ONCE = 16  # they share a bounding sphere


class Trail(NamedTuple):
    """Where a brush touched surfaces.

    Attributes
    ----------
    points, normals : (n, 3) float64
        World positions, and unit normals on the side of the viewer.
    parts : (n,) int32
        Index of the part that each sample lies on.
    radius : (n,) float64
        Radius of the brush in units of the world.
    flow : (n,) float64
        How much paint comes out, in [0, 1].
    joined : (n,) bool
        Whether the brush was drawn over the surface from the sample before.
    settled : int
        So many samples stay as they are if the stroke goes on; the last one is its present end.
    """

    points: Float64
    normals: Float64
    parts: Int32
    radius: Float64
    flow: Float64
    joined: NDArray[np.bool_]
    settled: int

    def until(self, count: int) -> Trail:
        """Return the first samples alone."""
        return Trail(
            self.points[:count], self.normals[:count], self.parts[:count], self.radius[:count],
            self.flow[:count], self.joined[:count], min(self.settled, count),
        )  # fmt: skip


def evenly(line: Float64, spacing: float, box: tuple[float, float]) -> tuple[Float64, Float64, int]:
    """Return places along a polyline at equal distances from its start.

    Parameters
    ----------
    line : (n, 2) float64
        At least one point.
    spacing : float
        Distance between two places, above 0.
    box : (width, height)
        Places outside of 0 to width and 0 to height are left out.

    Returns
    -------
    places : (m, 2) float64
        The last is the end of the polyline, if that is in the box.
    share : (m,) float64
        Index of the vertex before each place, plus the share of the way to the next.
    settled : int
        Number of places before the end.
    """
    steps = np.diff(line, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    found, shares = [], []
    for i, (start, step, length) in enumerate(zip(line[:-1], steps, lengths, strict=True)):
        if length <= 0.0:
            continue
        enters, leaves = 0.0, 1.0
        for axis in (0, 1):
            if step[axis] == 0.0:
                inside = 0.0 <= start[axis] <= box[axis]
                enters, leaves = (enters, leaves) if inside else (1.0, 0.0)
            else:
                a, b = sorted([-start[axis] / step[axis], (box[axis] - start[axis]) / step[axis]])
                enters, leaves = max(enters, a), min(leaves, b)
        first = math.ceil(max((ends[i] + enters * length) / spacing, ends[i] / spacing))
        # a vertex belongs to the piece that it begins
        last = math.ceil(min((ends[i] + leaves * length) / spacing + 1e-12, ends[i + 1] / spacing))
        if enters <= leaves and last > first:
            t = (np.arange(first, last) * spacing - ends[i]) / length
            found.append(start + t[:, None] * step)
            shares.append(i + np.clip(t, 0.0, 1.0))
    end = line[-1]
    settled = sum(map(len, found))
    if 0.0 <= end[0] <= box[0] and 0.0 <= end[1] <= box[1]:
        found.append(end[None])
        shares.append(np.array([len(line) - 1.0]))
    if not found:
        return np.zeros((0, 2)), np.zeros(0), 0
    return np.concatenate(found), np.concatenate(shares), settled


def trail_of(
    scene: Scene,
    line: ArrayLike,
    radius: float,
    world: bool = False,
    flow: ArrayLike = 1.0,
) -> Trail:
    """Return the trail of a stroke on a scene's image.

    Parameters
    ----------
    scene : Scene
        Its camera and size are those of the image.
    line : (n, 2) array_like
        The stroke as a polyline in pixels, x to the right and y down from the top left corner.
    radius : float
        Of the brush, above 0: in pixels, or in units of the world.
    world : bool
        Whether the radius is in units of the world.
    flow : float or (n,) array_like
        How much paint comes out at each point of the line, in [0, 1].
    """
    line = np.asarray(line, np.float64)
    pixel = 2.0 * math.tan(math.radians(scene.camera.fov) / 2.0) / scene.height
    eye = scene.camera.position(scene.shape, scene.height, scene.width)
    brush = radius
    if world:  # so wide on the image, in the middle of the shape
        brush = radius / (pixel * max(math.dist(eye, scene.shape.center), 1e-30))
    places, share, settled = evenly(line, max(SPACING * brush, 0.05), (scene.width, scene.height))
    hits = scene.hits(places[:, 0], places[:, 1])
    met = np.flatnonzero(hits.part >= 0)
    points = hits.position[met]
    away = np.sqrt(((points - eye) ** 2).sum(axis=1))
    wide = np.full(len(met), radius) if world else radius * pixel * away
    given = np.broadcast_to(np.asarray(flow, np.float64), len(line))
    strength = np.interp(share[met], np.arange(len(line)), given)
    joined = np.zeros(len(met), dtype=bool)
    if len(met):
        step = np.sqrt((np.diff(points, axis=0) ** 2).sum(axis=1))
        joined[1:] = (np.diff(met) == 1) & (np.diff(hits.part[met]) == 0)
        joined[1:] &= step < _JOINED * np.minimum(wide[1:], wide[:-1])
    return Trail(
        points, hits.normal[met], hits.part[met], wide, strength, joined,
        int((met < settled).sum()),
    )  # fmt: skip


def cover(
    weight: Float32,
    places: tuple[Float32, Float32, Int32],
    trail: Trail,
    hardness: float,
    across: bool = False,
    first: int = 0,
) -> None:
    """Raise weights of points to what a trail gives them.

    Parameters
    ----------
    weight : (n,) float32
        Weights in [0, 1]; changed in place.
    places : (n, 3) float32, (n, 3) float32 and (n,) int32
        World positions, unit normals and parts of the points.
    trail : Trail
    hardness : float
        Share of the radius, in [0, 1], within which the brush has full strength.
    across : bool
        Whether paint flows from part to part.
    first : int
        Samples of the trail before this one are left out, but for the link from the one before.
    """
    begins = np.maximum(np.arange(len(trail.points)) - trail.joined, 0)
    fade = max(1.0 - hardness, SOFTEST_EDGE)
    for start in range(first, len(trail.points), _LINKS_AT_ONCE):
        some = slice(start, start + _LINKS_AT_ONCE)
        both = np.concatenate([trail.points[some], trail.points[begins[some]]])
        middle = 0.5 * (both.min(axis=0) + both.max(axis=0))
        reach = math.sqrt(float(((both - middle) ** 2).sum(axis=1).max()))
        reach += float(max(trail.radius[some].max(), trail.radius[begins[some]].max()))
        span = start, min(start + _LINKS_AT_ONCE, len(trail.points))
        _cover(weight, places, trail, begins, span, (*middle.tolist(), reach), fade, across)


@numba.njit(cache=CACHED, nogil=True, error_model="numpy")
def _cover(
    weight: Any, places: Any, trail: Any, begins: Any, span: Any, ball: Any, fade: Any, across: Any
) -> None:
    """Raise weights to those of some links of a trail, which lie in a ball (x, y, z, radius)."""
    positions, normals, parts = places
    points, directions, radius, flow = trail.points, trail.normals, trail.radius, trail.flow
    for f in range(len(weight)):
        x, y, z = positions[f, 0], positions[f, 1], positions[f, 2]
        dx, dy, dz = x - ball[0], y - ball[1], z - ball[2]
        if dx * dx + dy * dy + dz * dz >= ball[3] * ball[3]:
            continue
        most = weight[f]
        for i in range(span[0], span[1]):
            if trail.parts[i] != parts[f] and not across:
                continue
            j = begins[i]
            ax, ay, az = points[j, 0], points[j, 1], points[j, 2]
            ux, uy, uz = points[i, 0] - ax, points[i, 1] - ay, points[i, 2] - az
            length = ux * ux + uy * uy + uz * uz
            t = 1.0
            if length > 0.0:
                t = ((x - ax) * ux + (y - ay) * uy + (z - az) * uz) / length
                t = min(max(t, 0.0), 1.0)
            dx, dy, dz = x - ax - t * ux, y - ay - t * uy, z - az - t * uz
            away, wide = dx * dx + dy * dy + dz * dz, radius[j] + t * (radius[i] - radius[j])
            if away >= wide * wide:
                continue
            nx = directions[j, 0] + t * (directions[i, 0] - directions[j, 0])
            ny = directions[j, 1] + t * (directions[i, 1] - directions[j, 1])
            nz = directions[j, 2] + t * (directions[i, 2] - directions[j, 2])
            facing = nx * normals[f, 0] + ny * normals[f, 1] + nz * normals[f, 2]
            facing /= np.sqrt(max(nx * nx + ny * ny + nz * nz, 1e-30))
            if facing <= 0.0:
                continue
            rim = min((1.0 - np.sqrt(away) / wide) / fade, 1.0)
            gate = min(facing / _FACING, 1.0)
            strength = flow[j] + t * (flow[i] - flow[j])
            strength *= rim * rim * (3.0 - 2.0 * rim) * gate * gate * (3.0 - 2.0 * gate)
            most = max(most, strength)
        weight[f] = most
