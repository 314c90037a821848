"""Things to look at: the sphere, Newell's teapot, mesh files; each with named parts.

Conventions: the world is y up, rays carry unit directions, lengths have the unit of the shape
itself. `Hits` holds what a viewer sees: shading normals always face the viewer, whichever side
of the surface is hit.

A ray that starts *on* a mesh meets that mesh at once: rays that test for shadow start at
`Hits.start`, a little off it. The sphere ignores hits nearer than 1e-7 of its radius and needs no
such offset.
"""

from __future__ import annotations

import functools
import json
import math
import re
from dataclasses import dataclass
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import embreex.mesh_construction
import embreex.rtcore_scene
import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.directions import as_directions, shading_frame
from traitbrdf.formats import FormatError

if TYPE_CHECKING:
    import trimesh

Float = NDArray[np.float64]
Int = NDArray[np.int32]
Bool = NDArray[np.bool_]

MIN_COSINE = 0.01
"""Least cosine between a mesh's shading normal and the direction to the viewer."""

_MESH_OFFSET = 1e-4  # of the radius; shadow rays start so far off their triangle
_CONVEX_FACES = 200_000  # more are not looked at: a hull of so many takes a second
_CONVEX_HEIGHT = 1e-6  # of the radius; neighbours stand out less (files round to float32)
_CONVEX_VOLUME = 1e-5  # of the volume; what the convex hull may have beyond the mesh
_SPHERE_SELF_HIT = 1e-7  # of the radius; nearer hits are the surface point that the ray left


@dataclass(frozen=True, eq=False)
class Hits:
    """The nearest hits of n rays.

    Attributes
    ----------
    part : (n,) int32 array
        Index into the shape's `parts`; -1 where the ray missed.
    position : (n, 3) float64 array
        World position; zero where the ray missed.
    normal : (n, 3) float64 array
        Unit shading normal in world space, facing the viewer; zero where the ray missed.
    start : (n, 3) float64 array
        Where rays that test for shadow start: off the surface, on the viewer's side; zero where
        the ray missed.
    """

    part: Int
    position: Float
    normal: Float
    start: Float


class Shape(Protocol):
    """What a scene asks of a shape.

    Attributes
    ----------
    parts : tuple of str
        Unique names of the parts.
    center : (3,) float64 array
        Centre of a bounding sphere.
    radius : float
        Radius of that bounding sphere.
    lowest : float
        World y of the lowest point.
    convex : bool
        True where the shape is known to cast no shadow on itself, seen from outside.
    """

    @property
    def parts(self) -> tuple[str, ...]: ...

    @property
    def center(self) -> Float: ...

    @property
    def radius(self) -> float: ...

    @property
    def lowest(self) -> float: ...

    @property
    def convex(self) -> bool: ...

    def intersect(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """Nearest hit of each ray: `origins` (n, 3) or (3,), unit `directions` (n, 3)."""
        ...

    def occluded(
        self, origins: ArrayLike, directions: ArrayLike, max_distance: ArrayLike = math.inf
    ) -> Bool:
        """Whether each ray (n, 3) meets the shape before `max_distance`, a number or (n,)."""
        ...


def _as_rays(origins: ArrayLike, directions: ArrayLike) -> tuple[Float, Float]:
    """Checked float64 rays, both (n, 3); a single origin (3,) serves all directions."""
    d = as_directions(directions, "directions").astype(np.float64, copy=False)
    o = np.asarray(origins, dtype=np.float64)
    if d.ndim != 2:
        raise ValueError(f"directions: expected shape (n, 3), got {d.shape}")
    if o.shape not in ((3,), d.shape):
        raise ValueError(f"origins: expected shape (3,) or {d.shape}, got {o.shape}")
    if not np.isfinite(o).all():
        raise ValueError("origins: expected finite numbers, got NaN or infinity")
    return np.broadcast_to(o, d.shape), d


def _as_distances(max_distance: ArrayLike, count: int) -> Float:
    """Checked distances (count,); infinity is allowed."""
    m = np.asarray(max_distance, dtype=np.float64)
    if m.shape not in ((), (count,)):
        raise ValueError(f"max_distance: expected a number or shape ({count},), got {m.shape}")
    if not (m >= 0.0).all():  # NaN fails this as well
        raise ValueError("max_distance: expected numbers >= 0, got a negative one or NaN")
    return np.broadcast_to(m, (count,))


def _dot(a: Float, b: Float) -> Float:
    product: Float = np.einsum("...k,...k->...", a, b)
    return product


def _unit(v: Float) -> Float:
    """Vectors (..., 3) of unit length; zero vectors stay zero."""
    length = np.sqrt(_dot(v, v))
    unit: Float = v / np.where(length == 0.0, 1.0, length)[..., None]
    return unit


# ---------------------------------------------------------------------------------------- sphere


@dataclass(frozen=True, eq=False)
class Sphere:
    """An exact sphere of one part, "sphere"; made by `sphere`.

    Its normals are exact up to the silhouette, where the cosine to the viewer goes to zero.
    """

    radius: float
    center: Float
    parts: tuple[str, ...] = ("sphere",)
    convex: bool = True

    @property
    def lowest(self) -> float:
        """World y of the lowest point."""
        return float(self.center[1]) - self.radius

    def intersect(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """Nearest hits of rays from `origins` (n, 3) or (3,) along unit `directions` (n, 3).

        From inside, the far wall is hit and its normal points inwards, to the viewer.

        Raises
        ------
        ValueError
            If shapes do not fit, origins are not finite or directions are not of unit length.
        """
        o, d = _as_rays(origins, directions)
        offset = o - self.center
        t = self._distance(offset, d)
        hit = np.isfinite(t)
        outward = _unit(offset[hit] + t[hit, None] * d[hit])
        position = np.zeros(d.shape)
        normal = np.zeros(d.shape)
        # from the normal, so that the point lies on the sphere however far away the ray starts
        position[hit] = self.center + self.radius * outward
        facing = _dot(outward, d[hit]) <= 0.0
        normal[hit] = np.where(facing[:, None], outward, -outward)
        # shadow rays may start on the sphere itself: `_distance` overlooks where they start
        return Hits(np.where(hit, 0, -1).astype(np.int32), position, normal, position)

    def occluded(
        self, origins: ArrayLike, directions: ArrayLike, max_distance: ArrayLike = math.inf
    ) -> Bool:
        """Whether rays (n, 3) meet the sphere before `max_distance`, a number or (n,).

        Raises
        ------
        ValueError
            As `intersect`, or if a distance is negative or NaN.
        """
        o, d = _as_rays(origins, directions)
        limit = _as_distances(max_distance, len(d))
        t = self._distance(o - self.center, d)
        return np.isfinite(t) & (t < limit)

    def _distance(self, offset: Float, d: Float) -> Float:
        """Distance (n,) to the nearest hit, infinite for a miss; `offset` is origin - centre.

        The discriminant is taken from the ray's nearest point to the centre and the smaller root
        from the product of the roots: Haines et al., "Precision Improvements for Ray/Sphere
        Intersection", Ray Tracing Gems (2019), chapter 7. The textbook formula loses all digits
        when the sphere is small or far away.
        """
        along = -_dot(offset, d)
        nearest = offset + along[:, None] * d
        distance = np.sqrt(_dot(offset, offset))
        discriminant = self.radius**2 - _dot(nearest, nearest)
        meets = discriminant >= 0.0
        q = along + np.copysign(np.sqrt(np.where(meets, discriminant, 0.0)), along)
        product = (distance - self.radius) * (distance + self.radius)
        other = np.where(q == 0.0, 0.0, product / np.where(q == 0.0, 1.0, q))
        near, far = np.minimum(q, other), np.maximum(q, other)
        epsilon = _SPHERE_SELF_HIT * self.radius
        t = np.where(near > epsilon, near, np.where(far > epsilon, far, np.inf))
        return np.where(meets, t, np.inf)


def sphere(radius: float = 1.0, center: ArrayLike = (0.0, 0.0, 0.0)) -> Sphere:
    """A sphere, intersected in closed form.

    Parameters
    ----------
    radius : float
        Above zero.
    center : (3,) array_like
        World position of the centre.

    Raises
    ------
    ValueError
        If the radius is not above zero, or a number is not finite.
    """
    c = np.array(center, dtype=np.float64)
    if c.shape != (3,) or not np.isfinite(c).all():
        raise ValueError(f"center: expected three finite numbers, got {center!r}")
    if not (math.isfinite(radius) and radius > 0.0):
        raise ValueError(f"radius: expected a finite number above 0, got {radius!r}")
    c.flags.writeable = False
    return Sphere(float(radius), c)


# ------------------------------------------------------------------------------------------ mesh


class Mesh:
    """Triangles with smooth normals and named parts, intersected with Embree.

    Embree works in float32, so it sees the mesh scaled to unit radius about its centre and rays
    that start near it; hits are then placed on the float64 triangle by their barycentric
    coordinates. Sizes from 1e-6 to 1e6 and viewers 1e6 radii away work alike.

    Parameters
    ----------
    vertices : (V, 3) array_like
        World positions.
    faces : (F, 3) array_like of int
        Vertex indices. Triangles without area are dropped.
    normals : (V, 3) or (F, 3, 3) array_like
        Outward normals of the vertices, or of each face's corners; scaled to unit length.
    face_part : (F,) array_like of int
        Index into `parts` of each face.
    parts : sequence of str
        Unique names; some may have no faces.
    uvs : (V, 2) or (F, 3, 2) array_like or None
        Texture coordinates of the vertices, or of each face's corners: u to the right, v up.

    Attributes
    ----------
    vertices, faces, normals, face_part, parts, uvs
        As given, less the dropped faces; read-only arrays. They build an equal mesh again.
    center : (3,) float64 array
        Centre of the bounding box, and of the bounding sphere.
    radius : float
        Radius of the bounding sphere.
    lowest : float
        World y of the lowest corner of a triangle.

    Raises
    ------
    ValueError
        If shapes do not fit, an index is out of range, a number is not finite, a normal has no
        length, names repeat, or no triangle with an area is left.
    """

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        normals: ArrayLike,
        face_part: ArrayLike,
        parts: tuple[str, ...] | list[str],
        uvs: ArrayLike | None = None,
    ) -> None:
        v = np.array(vertices, dtype=np.float64)
        f = np.array(faces)
        n = np.array(normals, dtype=np.float64)
        p = np.array(face_part)
        self.parts = tuple(parts)
        _check_mesh(v, f, n, p, self.parts)
        uv = None if uvs is None else _checked_uvs(uvs, len(v), len(f))
        center, radius = _bounds(_used(v, f)[0])
        corner = ((v - center) / radius)[f]
        across, up = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        side = corner[:, 2] - corner[:, 1]
        area = np.cross(across, up)
        longest = np.maximum(_dot(side, side), np.maximum(_dot(across, across), _dot(up, up)))
        keep = np.sqrt(_dot(area, area)) > 1e-12 * longest
        if not keep.any():
            raise ValueError(f"faces: expected triangles with an area, got {len(f)} without")
        # stray vertices and triangles that were dropped must not blow up the bounding sphere
        self.center: Float
        self.radius: float
        used, _ = _used(v, f[keep])
        self.center, self.radius = _bounds(used)
        self.lowest = float(used[:, 1].min())
        self._local = (v - self.center) / self.radius
        self.vertices: Float = v
        self.faces: Int = f[keep].astype(np.int32)
        self.normals: Float = _unit(n if n.ndim == 2 else n[keep])
        self.face_part: Int = p[keep].astype(np.int32)
        self.uvs: Float | None = uv[keep] if uv is not None and uv.ndim == 3 else uv
        # a file's winding may disagree with its normals: where they clearly do (a coarse, strongly
        # curved triangle may seem to a little) the normals say which side is out
        facet = _unit(area[keep])
        mean = self._corner_normals(np.arange(len(facet))).mean(axis=1)
        against = _dot(facet, mean) < -0.5
        self._facet = np.where(against[:, None], -facet, facet)
        for array in (self.vertices, self.faces, self.normals, self.face_part, self.center):
            array.flags.writeable = False
        if self.uvs is not None:
            self.uvs.flags.writeable = False

    def __reduce__(self) -> tuple[type[Mesh], tuple[object, ...]]:
        # Embree's scene cannot be pickled or copied: build it again
        given = (self.vertices, self.faces, self.normals, self.face_part, self.parts, self.uvs)
        return Mesh, given

    def __repr__(self) -> str:
        return f"Mesh({len(self.faces)} triangles, parts={self.parts!r})"

    def intersect(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """Nearest hits of rays from `origins` (n, 3) or (3,) along unit `directions` (n, 3).

        The shading normal is interpolated over the triangle, turned round where the surface is
        seen from behind, and bent towards the viewer where it would make a cosine below
        `MIN_COSINE` with the direction to the viewer, as it does along silhouettes.

        Raises
        ------
        ValueError
            If shapes do not fit, origins are not finite or directions are not of unit length.
        """
        o, d = _as_rays(origins, directions)
        origin, _ = self._approach(o, d)
        found = self._embree.run(origin, d.astype(np.float32), output=True)
        face = np.asarray(found["primID"])
        hit = face >= 0
        face = face[hit]
        u = found["u"][hit].astype(np.float64)
        v = found["v"][hit].astype(np.float64)
        weight = np.stack([1.0 - u - v, u, v], axis=-1)
        position = np.zeros(d.shape)
        normal = np.zeros(d.shape)
        start = np.zeros(d.shape)
        corners = self.vertices[self.faces[face]]
        corner_normals = self._corner_normals(face)
        point = np.einsum("nc,nck->nk", weight, corners)
        smooth = np.einsum("nc,nck->nk", weight, corner_normals)
        facet, wo = self._facet[face], -d[hit]
        # the triangle tells which side is seen: at silhouettes the smooth normal alone does not
        side = np.where(_dot(facet, wo) < 0.0, -1.0, 1.0)
        position[hit] = point
        normal[hit] = _facing_normal(smooth, facet, side, wo)
        start[hit] = (
            point
            + _smooth_lift(point, weight, corners, corner_normals, facet, side)
            + (_MESH_OFFSET * self.radius * side)[:, None] * facet
        )
        part = np.full(len(d), -1, dtype=np.int32)
        part[hit] = self.face_part[face]
        return Hits(part, position, normal, start)

    def occluded(
        self, origins: ArrayLike, directions: ArrayLike, max_distance: ArrayLike = math.inf
    ) -> Bool:
        """Whether rays (n, 3) meet the mesh before `max_distance`, a number or (n,).

        An origin on the surface meets the surface: start at `Hits.start`.

        Raises
        ------
        ValueError
            As `intersect`, or if a distance is negative or NaN.
        """
        o, d = _as_rays(origins, directions)
        limit = _as_distances(max_distance, len(d))
        start, skipped = self._approach(o, d)
        # nothing lies further off than the bounding sphere is wide; this also keeps float32 happy
        reach = np.minimum(limit / self.radius - skipped, 8.0)
        found = self._embree.run(
            start,
            d.astype(np.float32),
            np.maximum(reach, 0.0).astype(np.float32),
            query="OCCLUDED",
        )
        blocked: Bool = (np.asarray(found) >= 0) & (reach > 0.0)
        return blocked

    def _approach(self, o: Float, d: Float) -> tuple[NDArray[np.float32], Float]:
        """Local float32 origins (n, 3), and by how many radii (n,) each was moved along its ray.

        A distant origin moves up to the bounding sphere: in float32 a ray from 1000 radii away
        would miss its target by 1e-4 radii.
        """
        local = (o - self.center) / self.radius
        skipped = np.zeros(len(local))
        distant = np.flatnonzero(_dot(local, local) > 4.0)
        if len(distant):
            a, b = local[distant], d[distant]
            step = np.maximum(-_dot(a, b) - 1.5, 0.0)
            # a ray that passes far outside may still be anywhere: keep it within float32
            local[distant] = np.clip(a + step[:, None] * b, -1e30, 1e30)
            skipped[distant] = step
        return local.astype(np.float32), skipped

    def _corner_normals(self, face: NDArray[np.integer]) -> Float:
        """Unit normals (n, 3, 3) of the corners of faces (n,)."""
        index = self.faces[face] if self.normals.ndim == 2 else face
        corner: Float = self.normals[index]
        return corner

    @functools.cached_property
    def convex(self) -> bool:
        """True where the mesh is closed and convex for certain, and not too large to tell."""
        return len(self.faces) <= _CONVEX_FACES and _is_convex(self._local, self.faces)

    @functools.cached_property
    def _embree(self) -> embreex.rtcore_scene.EmbreeScene:
        # robust: rays through a shared edge hit one of its two triangles and never slip between
        scene = embreex.rtcore_scene.EmbreeScene(robust=True)
        embreex.mesh_construction.TriangleMesh(scene, self._local.astype(np.float32), self.faces)
        return scene


def _used(points: Float, faces: NDArray[np.integer]) -> tuple[Float, NDArray[np.integer]]:
    """Those of points (V, 3) that faces (F, 3) use, in order, and the faces' indices among them."""
    mask = np.zeros(len(points), dtype=bool)
    mask[faces] = True
    return points[mask], (np.cumsum(mask) - 1)[faces]


def _bounds(points: Float) -> tuple[Float, float]:
    """Centre (3,) of the bounding box of points (n, 3), and the radius about it."""
    low, high = points.min(axis=0), points.max(axis=0)
    center: Float = 0.5 * low + 0.5 * high
    with np.errstate(over="ignore"):  # an infinite size is refused next
        offset = points - center
        radius = float(np.sqrt(_dot(offset, offset).max()))
    if not (math.isfinite(radius) and radius > 0.0):
        raise ValueError(f"vertices: expected a finite size above 0, got {radius}")
    return center, radius


def _check_mesh(
    v: Float, f: NDArray[np.generic], n: Float, p: NDArray[np.generic], parts: tuple[str, ...]
) -> None:
    """Raise the ValueErrors of `Mesh` that concern its arguments."""
    if v.ndim != 2 or v.shape[1] != 3:
        raise ValueError(f"vertices: expected shape (V, 3), got {v.shape}")
    if f.ndim != 2 or f.shape[1] != 3 or len(f) == 0 or f.dtype.kind not in "iu":
        raise ValueError(f"faces: expected integers of shape (F, 3), got {f.dtype} {f.shape}")
    if f.min() < 0 or f.max() >= len(v):
        raise ValueError(
            f"faces: expected indices from 0 to {len(v) - 1}, got {f.min()} to {f.max()}"
        )
    if n.shape not in (v.shape, (*f.shape, 3)):
        raise ValueError(f"normals: expected shape {v.shape} or {(*f.shape, 3)}, got {n.shape}")
    for name, array in (("vertices", v), ("normals", n)):
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: expected finite numbers, got NaN or infinity")
    if not n.any(axis=-1).all():
        raise ValueError("normals: expected vectors of some length, got zero vectors")
    if p.shape != (len(f),) or p.dtype.kind not in "iu":
        raise ValueError(f"face_part: expected {len(f)} integers, got {p.dtype} {p.shape}")
    if p.min() < 0 or p.max() >= len(parts):
        raise ValueError(
            f"face_part: expected indices from 0 to {len(parts) - 1}, got {p.min()} to {p.max()}"
        )
    if len(set(parts)) != len(parts):
        raise ValueError(f"parts: expected unique names, got {parts}")


def _checked_uvs(uvs: ArrayLike, vertices: int, faces: int) -> Float:
    """Texture coordinates as float64, (V, 2) or (F, 3, 2); ValueError where they do not fit."""
    uv = np.array(uvs, dtype=np.float64)
    if uv.shape not in ((vertices, 2), (faces, 3, 2)):
        raise ValueError(f"uvs: expected shape {(vertices, 2)} or {(faces, 3, 2)}, got {uv.shape}")
    if not np.isfinite(uv).all():
        raise ValueError("uvs: expected finite numbers, got NaN or infinity")
    return uv


def _is_convex(points: Float, faces: NDArray[np.integer]) -> bool:
    """Whether triangles (F, 3) of points (V, 3), at most 1 from their centre, bound a convex body.

    Closed: each edge has two triangles. No edge bends inwards. And the body is all of its convex
    hull: a surface that bends outwards everywhere may still wind round twice or be in two pieces,
    and bends too small to count may add up. Neither winding nor normals matter.
    """
    points, faces = _used(points, faces)
    # most shapes have points on both sides of one of a few planes: so much for them
    few = points[faces[:: len(faces) // 16 + 1]]
    planes = _unit(np.cross(few[:, 1] - few[:, 0], few[:, 2] - few[:, 0]))
    height = points @ planes.T - _dot(planes, few[:, 0])
    if np.minimum(height.max(axis=0), -height.min(axis=0)).max() > 1e-3:
        return False
    corners = points[faces]
    double = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.sqrt(_dot(double, double))
    # the surface's centroid is well inside; that of its corners may crowd at one side
    inner = np.average(corners.mean(axis=1), axis=0, weights=area)
    normal = _unit(double)
    offset = _dot(normal, corners[:, 0] - inner)
    normal = np.where(offset[:, None] < 0.0, -normal, normal)
    offset = np.abs(offset)
    welded, weld = np.unique(points + 0.0, axis=0, return_inverse=True)  # -0.0 becomes 0.0
    corner = weld.reshape(-1)[faces]
    a, b = corner, np.roll(corner, -1, axis=1)
    edge = (np.minimum(a, b) * len(welded) + np.maximum(a, b)).ravel()
    order = np.argsort(edge, kind="stable")
    one, other = order[0::2], order[1::2]
    if len(edge) % 2 or (edge[one] != edge[other]).any():
        return False
    facing = welded[np.roll(corner, 1, axis=1).ravel()] - inner  # the corner across from each edge
    height = _dot(facing[other], normal[one // 3]) - offset[one // 3]
    if height.max() > _CONVEX_HEIGHT:
        return False
    volume = float(np.sum(area * offset)) / 3.0
    import scipy.spatial  # slow to import, and few shapes come so far

    try:
        hull = float(scipy.spatial.ConvexHull(welded).volume)
    except scipy.spatial.QhullError:  # flat
        return False
    return abs(hull - volume) <= _CONVEX_VOLUME * hull


def _facing_normal(smooth: Float, facet: Float, side: Float, wo: Float) -> Float:
    """Shading normals (n, 3) that face the viewer, by a cosine of at least `MIN_COSINE`.

    Parameters
    ----------
    smooth : (n, 3) array
        Interpolated outward normals, of any length.
    facet : (n, 3) array
        Unit outward normals of the triangles.
    side : (n,) array
        1 where the triangle's outer side is seen, -1 where its inner.
    wo : (n, 3) array
        Unit directions to the viewer.
    """
    vanished = _dot(smooth, smooth) < 1e-24  # the corners' normals cancel
    normal = side[:, None] * _unit(np.where(vanished[:, None], facet, smooth))
    low = np.flatnonzero(_dot(normal, wo) < MIN_COSINE)
    if len(low):
        w = wo[low]
        tangent = normal[low] - _dot(normal[low], w)[:, None] * w
        opposite = _dot(tangent, tangent) < 1e-24  # looks straight away: any tangent will do
        tangent = _unit(np.where(opposite[:, None], shading_frame(w)[0], tangent))
        cosine = MIN_COSINE * (1.0 + 1e-9)  # a hair above, so that rounding stays above too
        normal[low] = cosine * w + math.sqrt(1.0 - cosine**2) * tangent
    return normal


def _smooth_lift(
    point: Float, weight: Float, corners: Float, normals: Float, facet: Float, side: Float
) -> Float:
    """Offsets (n, 3) from points on triangles to the smooth surface that their normals tell of.

    Without them a surface lit at a grazing angle would lie in the shadow of its own coarse
    triangles: Hanika, "Hacking the Shadow Terminator", Ray Tracing Gems II (2021). A point goes to
    the mean, by its barycentric weights, of its projections on the corners' tangent planes. Flat
    and hollow triangles are left alone.

    Parameters
    ----------
    point, facet : (n, 3) arrays
        The points, and the unit outward normals of their triangles.
    weight : (n, 3) array
        Barycentric weights of the corners.
    corners, normals : (n, 3, 3) arrays
        Positions and unit outward normals of the corners.
    side : (n,) array
        1 where the triangle's outer side is seen, -1 where its inner.
    """
    height = np.einsum("nck,nck->nc", point[:, None, :] - corners, normals)
    # seen from inside, what bulges is hollow
    depth = np.minimum(side[:, None] * height, 0.0)
    lift = -np.einsum("nc,nck->nk", side[:, None] * weight * depth, normals)
    # normals that contradict their triangle must not sink the point
    outwards = side * _dot(lift, facet) > 0.0
    return np.where(outwards[:, None], lift, 0.0)


# ---------------------------------------------------------------------------------------- teapot


def teapot(resolution: int = 24) -> Mesh:
    """The Utah teapot, y up, handle at -x and spout at +x, 3.15 high.

    Newell's 32 bicubic Bezier patches (1975, with the bottom added later) in the parts rim,
    body, handle, spout, lid and bottom. Normals are those of the patches themselves, not of the
    triangles. The surface is open: a slit runs round under the lid's brim and the spout has a
    mouth, through which the inner side shows. Repeated calls return the same mesh.

    Parameters
    ----------
    resolution : int
        Quads along each side of a patch, at least 2; 24 makes about 36 thousand triangles.

    Raises
    ------
    ValueError
        If the resolution is not an integer of at least 2.
    """
    if isinstance(resolution, bool) or int(resolution) != resolution or resolution < 2:
        raise ValueError(f"resolution: expected an integer of at least 2, got {resolution!r}")
    return _teapot(int(resolution))


@functools.lru_cache(maxsize=4)
def _teapot(resolution: int) -> Mesh:
    text = resources.files("traitbrdf").joinpath("data/newell_teapot.json").read_text("utf-8")
    figures = json.loads(text)
    x, y, z = np.moveaxis(np.array(figures["patches"], dtype=np.float64), -1, 0)
    control = np.stack([x, z, -y], axis=-1)  # z up to y up: a quarter turn, no mirroring
    parts = tuple(dict.fromkeys(figures["parts"]))
    position, normal = _evaluate_patches(control, resolution)
    count, side = len(control), resolution + 1
    corner = np.arange(side * side).reshape(side, side)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    quads = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    faces = quads[None] + side * side * np.arange(count)[:, None, None]
    index = np.array([parts.index(name) for name in figures["parts"]])
    return Mesh(
        position.reshape(-1, 3),
        faces.reshape(-1, 3),
        normal.reshape(-1, 3),
        np.repeat(index, len(quads)),
        parts,
    )


def _evaluate_patches(control: Float, resolution: int) -> tuple[Float, Float]:
    """Points and unit outward normals (P, n+1, n+1, 3) of bicubic patches (P, 4, 4, 3).

    The sums are written so that a boundary curve comes out bit for bit the same from either end:
    neighbouring patches share their edges exactly and no crack opens between them.
    """
    t = np.arange(resolution + 1) / resolution
    s = t[::-1]
    value = np.stack([s * s * s, 3.0 * (s * s) * t, 3.0 * (t * t) * s, t * t * t])
    slope = np.stack(
        [-3.0 * s * s, 3.0 * s * s - 6.0 * s * t, 6.0 * s * t - 3.0 * t * t, 3.0 * t * t]
    )

    def blend(basis: Float, points: Float) -> Float:
        """Contract the second axis of `points` (P, 4, ..., 3); its place goes last but one."""
        terms = [points[:, i, ..., None, :] * basis[i][:, None] for i in range(4)]
        total: Float = (terms[0] + terms[3]) + (terms[1] + terms[2])
        return total

    # after the first contraction the axes are (P, v, u, xyz), after the second (P, u, v, xyz)
    along, along_du = blend(value, control), blend(slope, control)
    position = blend(value, along)
    du, dv, dudv = blend(value, along_du), blend(slope, along), blend(slope, along_du)
    normal = np.cross(dv, du)  # Newell's patches have du x dv pointing inwards
    # where an edge shrinks to a point (the lid's top, the bottom's centre) its derivative along
    # itself vanishes and grows inwards at the rate of the mixed one: take the limit
    inwards = np.where(t < 0.5, 1.0, -1.0)[:, None]
    scale = 1e-12 * np.abs(control).max() ** 2
    flat = _dot(normal, normal) < scale**2
    no_dv = flat & (_dot(dv, dv) < scale)
    no_du = flat & (_dot(du, du) < scale)
    normal = np.where(no_dv[..., None], np.cross(dudv, du) * inwards[:, None], normal)
    normal = np.where(no_du[..., None], np.cross(dv, dudv) * inwards, normal)
    return position, _unit(normal)


# ------------------------------------------------------------------------------------ mesh files

_SUFFIXES = (".obj", ".ply", ".gltf", ".glb")
# names that writers give to what has none
_PLACEHOLDER = re.compile(r"(geometry|GLTF|mesh|default)?([ _.]?\d+)?", re.IGNORECASE)


@dataclass(frozen=True)
class _Piece:
    """Triangles of one part of a file.

    `normals` (F, 3, 3) and `uvs` (F, 3, 2) of the corners are NaN where the file has none.
    """

    name: str
    vertices: Float
    faces: NDArray[np.int64]
    normals: Float
    uvs: Float


def load_mesh(path: str | PathLike[str]) -> Mesh:
    """Read a mesh file: Wavefront OBJ, PLY, glTF or glb.

    Parts are the named pieces of the file. OBJ: its groups (``g``) where they divide the faces,
    else its objects (``o``), else its materials (``usemtl``). glTF: its meshes, and the
    materials within a mesh of several. A file without names is one part, named after the file.
    Normals are the file's own; where it has none they are averaged over the triangles about a
    vertex, weighted by their angles, across the borders of parts too. Polygons are split into
    fans. Nodes of a glTF scene are placed by their transforms; units and axes stay as they are.
    Texture coordinates are kept, with v upwards; where only some corners have any, the others lie
    at 0, 0. glTF: those of primitives with a material.

    Parameters
    ----------
    path : str or path
        Its suffix tells the format.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    FormatError
        If the format is another, the file cannot be read, has no triangles with an area, or has
        vertices that are not finite.
    """
    file = Path(path)
    if not file.exists():
        raise FileNotFoundError(f"{file}: no such mesh file")
    suffix = file.suffix.lower()
    if not file.is_file() or suffix not in _SUFFIXES:
        got = repr(file.suffix) if file.is_file() else "a folder"
        raise FormatError(file, f"a mesh file ({', '.join(_SUFFIXES)})", got)
    pieces = _read_obj(file) if suffix == ".obj" else _read_trimesh(file)
    pieces = [piece for piece in pieces if len(piece.faces)]
    if not pieces:
        raise FormatError(file, "triangles", "none")
    start = np.cumsum([0] + [len(piece.vertices) for piece in pieces])
    faces = np.concatenate([p.faces + s for p, s in zip(pieces, start, strict=False)])
    vertices = np.concatenate([piece.vertices for piece in pieces])
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise FormatError(
            file, f"vertex indices below {len(vertices)}", f"{faces.min()} to {faces.max()}"
        )
    bad = int((~np.isfinite(vertices)).any(axis=1).sum())
    if bad:
        raise FormatError(file, "finite vertices", f"{bad} that are not")
    normals = np.concatenate([piece.normals for piece in pieces])
    length = np.sqrt(_dot(normals, normals))
    missing = ~(np.isfinite(length) & (length > 0.0))
    if missing.any():
        normals[missing] = _smooth_corner_normals(vertices, faces)[missing]
    uvs = np.concatenate([piece.uvs for piece in pieces])
    textured = np.isfinite(uvs).all(axis=-1, keepdims=True)
    names = [piece.name for piece in pieces]
    if len(set(names)) == 1 and _PLACEHOLDER.fullmatch(names[0]):
        names = [file.stem] * len(names)
    parts = tuple(dict.fromkeys(names))
    face_part = np.concatenate(
        [np.full(len(p.faces), parts.index(n)) for p, n in zip(pieces, names, strict=True)]
    )
    try:
        return Mesh(
            vertices,
            faces,
            normals,
            face_part,
            parts,
            np.where(textured, uvs, 0.0) if textured.any() else None,
        )
    except ValueError as error:
        raise FormatError(file, "triangles with an area", str(error)) from error


def _smooth_corner_normals(vertices: Float, faces: NDArray[np.int64]) -> Float:
    """Unit normals (F, 3, 3) of the corners, averaged over all triangles at the same position.

    Weighted by the angle of the corner (Thuermer & Wuthrich, "Computing Vertex Normals from
    Polygonal Facets", 1998), so that the way a polygon was cut does not show.
    """
    _, weld = np.unique(vertices + 0.0, axis=0, return_inverse=True)  # -0.0 becomes 0.0
    shared = weld.reshape(-1)[faces]
    size = float(np.abs(vertices[np.unique(faces)]).max()) or 1.0
    corner = (vertices / size)[faces]
    following = np.roll(corner, -1, axis=1) - corner
    previous = np.roll(corner, 1, axis=1) - corner
    cross = np.cross(following, previous)
    angle = np.arctan2(np.sqrt(_dot(cross, cross)), _dot(following, previous))
    facet = _unit(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))
    weighted = angle[..., None] * facet[:, None, :]
    sums = [np.bincount(shared.ravel(), weighted[..., k].ravel()) for k in range(3)]
    total = np.stack(sums, axis=-1).astype(np.float64)
    normal = _unit(total)[shared]
    # two sides of a sheet may cancel; a triangle without area has no normal and is dropped later
    flat = _dot(facet, facet) == 0.0
    own = np.where(flat[:, None], np.array([0.0, 1.0, 0.0]), facet)
    cancelled = _dot(total, total)[shared] < 1e-24
    return np.where(cancelled[..., None], own[:, None, :], normal)


def _read_obj(file: Path) -> list[_Piece]:
    """Parts of a Wavefront OBJ file in order of appearance.

    Read here and not by trimesh, which can split a file at its groups but counts relative indices
    from the file's end, forgets the names of materials without their library, and drops all
    normals and texture coordinates where one corner has none.
    """
    text = file.read_text("utf-8", errors="replace").replace("\\\n", " ")
    # one flat list each: lists of rows would keep the garbage collector busy
    tables: dict[str, list[float]] = {"v": [], "vt": [], "vn": []}
    corners: list[tuple[int, int, int]] = []  # rows of v, vt, vn, or -1; three a triangle
    labels: list[tuple[str, str, str]] = []  # group, object, material of each triangle
    current = {"g": "", "o": "", "usemtl": ""}
    label = ("", "", "")
    known: dict[str, tuple[int, int, int]] = {}  # corners seen before: most are, some six times
    for number, line in enumerate(text.splitlines(), start=1):
        key, *words = line.split("#")[0].split() or [""]
        try:
            if key in tables:
                row = [float(x) for x in words[:3]]
                least = 1 if key == "vt" else 3
                if len(row) < least:
                    raise ValueError(f"fewer than {least} coordinates")
                tables[key] += [*row, 0.0][:2] if key == "vt" else row
            elif key == "f":
                polygon = [known.get(w) or _obj_corner(w, tables, known) for w in words]
                if len(polygon) < 3:
                    raise ValueError("fewer than three corners")
                for i in range(1, len(polygon) - 1):
                    corners += [polygon[0], polygon[i], polygon[i + 1]]
                    labels.append(label)
            elif key in current:
                current[key] = " ".join(words)
                label = (current["g"], current["o"], current["usemtl"])
        except ValueError as error:
            raise FormatError(
                file,
                f"'{key}' with valid numbers in line {number}",
                f"{line.strip()[:60]!r} ({error})",
            ) from error
    if not labels:
        return []
    columns = list(zip(*labels, strict=True))
    # the first of groups, objects and materials that divides the faces, else any one name
    divides = [c for c in columns if len(set(c)) > 1]
    named = [c for c in columns[:2] if c[0]]
    names = [*divides, *named, columns[0]][0]
    vertex = np.array(tables["v"]).reshape(-1, 3)
    # a last row of NaN answers index -1
    texture = np.array(tables["vt"] + [math.nan] * 2).reshape(-1, 2)
    normal = np.array(tables["vn"] + [math.nan] * 3).reshape(-1, 3)
    face, face_uv, face_normal = np.moveaxis(np.array(corners).reshape(-1, 3, 3), -1, 0)
    order = {name: i for i, name in enumerate(dict.fromkeys(names))}
    index = np.array([order[name] for name in names])
    pieces = []
    for name, i in order.items():
        used, local = np.unique(face[index == i], return_inverse=True)
        pieces.append(
            _Piece(
                name or file.stem,
                vertex[used],
                local.reshape(-1, 3),
                normal[face_normal[index == i]],
                texture[face_uv[index == i]],
            )
        )
    return pieces


def _obj_corner(
    word: str, tables: dict[str, list[float]], known: dict[str, tuple[int, int, int]]
) -> tuple[int, int, int]:
    """Rows of an OBJ corner ``v``, ``v/vt``, ``v//vn`` or ``v/vt/vn``; -1 where there is none."""
    fields = [*word.split("/"), "", ""]

    def row(field: str, count: int) -> int:
        value = int(field)
        found = value - 1 if value > 0 else count + value
        if value == 0 or not 0 <= found < count:
            raise ValueError(f"index {value} of {count}")
        return found

    vertex = row(fields[0], len(tables["v"]) // 3)
    normal = row(fields[2], len(tables["vn"]) // 3) if fields[2] else -1
    try:
        texture = row(fields[1], len(tables["vt"]) // 2) if fields[1] else -1
    except ValueError:
        texture = -1  # some writers leave the numbers and not the coordinates: no loss to a shape
    if "-" not in word:  # a relative index depends on where it stands
        known[word] = vertex, texture, normal
    return vertex, texture, normal


def _read_trimesh(file: Path) -> list[_Piece]:
    """Parts of a PLY, glTF or glb file, in the order of the file's geometries."""
    try:
        graph, geometries = _load_scene(file)
        uvs = {name: _corner_uvs(g) for name, g in geometries.items()}
        if file.suffix.lower() == ".ply" and not all(np.isnan(uv).all() for uv in uvs.values()):
            # where trimesh cuts a PLY file's vertices at a texture's seams, it loses their normals
            _, geometries = _load_scene(file, fix_texture=False)
        names = _geometry_names(geometries, file)
        pieces = []
        for node in graph.nodes_geometry:
            matrix, geometry_key = graph[node]
            key = str(geometry_key)
            if key in geometries:
                pieces.append(_placed(geometries[key], np.asarray(matrix), names[key], uvs[key]))
    # whatever trips a reader over a broken file, the caller needs one kind of error
    except Exception as error:
        raise FormatError(
            file, f"a readable {file.suffix.lower()} file", f"{type(error).__name__}: {error}"
        ) from error
    order = list(names.values())
    return sorted(pieces, key=lambda piece: order.index(piece.name))


def _load_scene(file: Path, **options: Any) -> tuple[Any, dict[str, trimesh.Trimesh]]:
    """The scene graph of a file and its geometries that are made of triangles."""
    import trimesh  # half a second of imports that most sessions never need

    # unprocessed: trimesh would merge vertices and with them the file's own normals
    scene = trimesh.load(str(file), force="scene", process=False, **options)
    if not isinstance(scene, trimesh.Scene):
        raise TypeError(f"trimesh made a {type(scene).__name__} of it")
    found = {name: g for name, g in scene.geometry.items() if isinstance(g, trimesh.Trimesh)}
    return scene.graph, found


def _geometry_names(geometries: dict[str, trimesh.Trimesh], file: Path) -> dict[str, str]:
    """Part names by trimesh's geometry names; materials name the primitives of one glTF mesh."""
    names = {key: file.stem if key == file.name else key for key in geometries}
    split = [k for k, g in geometries.items() if g.metadata.get("from_gltf_primitive")]
    materials = {
        key: str(getattr(getattr(geometries[key].visual, "material", None), "name", None) or "")
        for key in split
    }
    others = [name for key, name in names.items() if key not in materials]
    proposed = [*materials.values(), *others]
    if all(proposed) and len(set(proposed)) == len(proposed):
        names.update(materials)
    return names


def _corner_uvs(geometry: trimesh.Trimesh) -> Float:
    """Texture coordinates (F, 3, 2) of a geometry's corners; NaN where it has none."""
    uv = getattr(geometry.visual, "uv", None)
    if uv is None or np.shape(uv)[:1] != (len(geometry.vertices),):
        uv = np.full((len(geometry.vertices), 2), np.nan)
    corners: Float = np.asarray(uv, dtype=np.float64)[:, :2][geometry.faces]
    return corners


def _placed(geometry: trimesh.Trimesh, matrix: Float, name: str, uvs: Float) -> _Piece:
    """A geometry under a node's 4 x 4 transform, with texture coordinates (F, 3, 2)."""
    linear = matrix[:3, :3]
    with np.errstate(invalid="ignore", over="ignore"):  # `load_mesh` looks for such vertices
        vertices = np.asarray(geometry.vertices, dtype=np.float64) @ linear.T + matrix[:3, 3]
    faces = np.asarray(geometry.faces, dtype=np.int64).reshape(-1, 3)
    mirrored = np.linalg.det(linear) < 0.0
    if "vertex_normals" in geometry._cache:  # there only if the file gave them
        # normals go by the cofactors, which exist for singular transforms as well
        cofactor = np.cross(np.roll(linear, -1, axis=0), np.roll(linear, -2, axis=0))
        turned = np.asarray(geometry.vertex_normals) @ (-cofactor if mirrored else cofactor).T
        normals = turned[faces]
    else:
        normals = np.full((len(faces), 3, 3), np.nan)
    # a mirror turns the winding round
    return _Piece(
        name,
        vertices,
        faces[:, ::-1] if mirrored else faces,
        normals[:, ::-1] if mirrored else normals,
        uvs[:, ::-1] if mirrored else uvs,
    )
