"""Shapes: spheres and triangle meshes, each with named parts.

Conventions: the world is y up, rays have unit directions, and lengths have the unit of the shape
itself. `Hits` holds what a viewer sees: shading normals always face the viewer, whichever side of
the surface is hit.

A ray that starts *on* a mesh hits that mesh at once, so shadow rays start at `Hits.start`, slightly
off the surface. The sphere ignores hits nearer than 1e-7 of its radius and needs no such offset.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import embreex.mesh_construction
import embreex.rtcore_scene
import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.arguments import number, numbers
from traitbrdf.directions import as_directions, shading_frame

Float = NDArray[np.float64]
Int = NDArray[np.int32]
Bool = NDArray[np.bool_]

MIN_COSINE = 0.01
"""Least cosine between a mesh's shading normal and the direction to the viewer."""

_MESH_OFFSET = 1e-4  # distance of shadow ray starts from their triangle, in radii
_CONVEX_FACES = 200_000  # larger meshes count as not convex: their hull takes over a second
_CONVEX_HEIGHT = 1e-6  # in radii; tolerance for bends inwards (files round to float32)
_CONVEX_VOLUME = 1e-5  # relative excess of the convex hull's volume that is tolerated
_SPHERE_SELF_HIT = 1e-7  # in radii; nearer hits are the point where the ray starts


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
    """What a scene needs of a shape.

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
        True only if the shape, seen from outside, is known to cast no shadow on itself.
    """

    @property
    def parts(self) -> tuple[str, ...]:
        """Unique names of the parts."""

    @property
    def center(self) -> Float:
        """Centre (3,) of a bounding sphere."""

    @property
    def radius(self) -> float:
        """Radius of that bounding sphere."""

    @property
    def lowest(self) -> float:
        """World y of the lowest point."""

    @property
    def convex(self) -> bool:
        """Whether the shape is known to cast no shadow on itself, seen from outside."""

    def intersect(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """Return the nearest hits of rays.

        Parameters
        ----------
        origins : (n, 3) or (3,) array_like
        directions : (n, 3) array_like
            Unit vectors.
        """
        ...

    def occluded(
        self, origins: ArrayLike, directions: ArrayLike, max_distance: ArrayLike = math.inf
    ) -> Bool:
        """Return whether each ray meets the shape before `max_distance`, as booleans (n,).

        Parameters
        ----------
        origins : (n, 3) or (3,) array_like
        directions : (n, 3) array_like
            Unit vectors.
        max_distance : float or (n,) array_like
        """
        ...


def _as_rays(origins: ArrayLike, directions: ArrayLike) -> tuple[Float, Float]:
    """Return checked float64 rays, both (n, 3); a single origin (3,) serves all directions."""
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
    """Return checked distances (count,); infinity is allowed."""
    m = np.asarray(max_distance, dtype=np.float64)
    if m.shape not in ((), (count,)):
        raise ValueError(f"max_distance: expected a number or shape ({count},), got {m.shape}")
    if not (m >= 0.0).all():  # NaN fails this as well
        raise ValueError("max_distance: expected numbers >= 0, got a negative one or NaN")
    return np.broadcast_to(m, (count,))


def dots(a: Float, b: Float) -> Float:
    """Return the dot products (...) of vectors `a` and `b`, both (..., n)."""
    product: Float = np.einsum("...k,...k->...", a, b)
    return product


def to_unit(v: Float) -> Float:
    """Scale vectors `v` (..., 3) to unit length; zero vectors stay zero."""
    length = np.sqrt(dots(v, v))
    unit: Float = v / np.where(length == 0.0, 1.0, length)[..., None]
    return unit


# ---------------------------------------------------------------------------------------- sphere


@dataclass(frozen=True, eq=False)
class Sphere:
    """An exact sphere with the one part "sphere"; `sphere` makes it.

    Its normals are exact up to the silhouette, where the cosine to the viewer goes to zero.

    Parameters
    ----------
    radius : float
    center : (3,) array
        World position.
    parts : tuple of str
    convex : bool
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
        """Return the nearest hits of rays.

        From inside, a ray hits the far wall, whose normal then points inwards, to the viewer.

        Parameters
        ----------
        origins : (n, 3) or (3,) array_like
        directions : (n, 3) array_like
            Unit vectors.

        Raises
        ------
        ValueError
            If shapes do not fit, origins are not finite or directions are not of unit length.
        """
        o, d = _as_rays(origins, directions)
        offset = o - self.center
        t = self._distance(offset, d)
        hit = np.isfinite(t)
        outward = to_unit(offset[hit] + t[hit, None] * d[hit])
        position = np.zeros(d.shape)
        normal = np.zeros(d.shape)
        # computed from the normal, so that the point lies on the sphere even for distant origins
        position[hit] = self.center + self.radius * outward
        facing = dots(outward, d[hit]) <= 0.0
        normal[hit] = np.where(facing[:, None], outward, -outward)
        # shadow rays may start on the sphere itself: `_distance` ignores their start
        return Hits(np.where(hit, 0, -1).astype(np.int32), position, normal, position)

    def occluded(
        self, origins: ArrayLike, directions: ArrayLike, max_distance: ArrayLike = math.inf
    ) -> Bool:
        """Return whether rays meet the sphere before `max_distance`, as booleans (n,).

        Parameters
        ----------
        origins : (n, 3) or (3,) array_like
        directions : (n, 3) array_like
            Unit vectors.
        max_distance : float or (n,) array_like
            Not negative.

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
        """Return the distance (n,) to the nearest hit, infinite for a miss.

        `offset` is origin - centre. The discriminant is computed from the ray's nearest point to
        the centre, and the smaller root from the product of the roots: Haines et al., "Precision
        Improvements for Ray/Sphere Intersection", Ray Tracing Gems (2019), chapter 7. The textbook
        formula loses all digits when the sphere is small or far away.
        """
        along = -dots(offset, d)
        nearest = offset + along[:, None] * d
        distance = np.sqrt(dots(offset, offset))
        discriminant = self.radius**2 - dots(nearest, nearest)
        meets = discriminant >= 0.0
        q = along + np.copysign(np.sqrt(np.where(meets, discriminant, 0.0)), along)
        product = (distance - self.radius) * (distance + self.radius)
        other = np.where(q == 0.0, 0.0, product / np.where(q == 0.0, 1.0, q))
        near, far = np.minimum(q, other), np.maximum(q, other)
        epsilon = _SPHERE_SELF_HIT * self.radius
        t = np.where(near > epsilon, near, np.where(far > epsilon, far, np.inf))
        return np.where(meets, t, np.inf)


def sphere(radius: float = 1.0, center: ArrayLike = (0.0, 0.0, 0.0)) -> Sphere:
    """Return a sphere, which is intersected in closed form.

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
    c = numbers(center, "center").astype(np.float64)
    if c.shape != (3,) or not np.isfinite(c).all():
        raise ValueError(f"center: expected three finite numbers, got {center!r}")
    if number(radius, "radius") <= 0.0:
        raise ValueError(f"radius: expected a finite number above 0, got {radius!r}")
    c.flags.writeable = False
    return Sphere(float(radius), c)


# ------------------------------------------------------------------------------------------ mesh


class Edges(NamedTuple):
    """The sides of a mesh's triangles, those that share an edge one after the other.

    Attributes
    ----------
    face : (n,) int64 triangle of each side
    ends : (n, 2) int64 vertices
    starts : (edges + 1,) int64, where edges start among the sides
    """

    face: NDArray[np.int64]
    ends: NDArray[np.int64]
    starts: NDArray[np.int64]


class Mesh:
    """Triangles with smooth normals and named parts, intersected with Embree.

    Embree works in float32. So it gets the mesh scaled to unit radius about its centre, and rays
    that start near it; the barycentric coordinates of a hit then give the point on the float64
    triangle. Sizes from 1e-6 to 1e6 and viewers 1e6 radii away work alike.

    Parameters
    ----------
    vertices : (V, 3) array_like
        World positions.
    faces : (F, 3) array_like of int
        Vertex indices. Triangles without area are dropped.
    normals : (V, 3) or (F, 3, 3) array_like
        Outward normals of the vertices, or of each face's corners; they are normalised.
    face_part : (F,) array_like of int
        Index into `parts` of each face.
    parts : sequence of str
        Unique names; some may have no faces.
    uvs : (V, 2) or (F, 3, 2) array_like or None
        Texture coordinates of the vertices, or of each face's corners: u to the right, v up.

    Attributes
    ----------
    vertices, faces, normals, face_part, parts, uvs
        As given, without the dropped faces; read-only arrays that build an equal mesh again.
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
        longest = np.maximum(dots(side, side), np.maximum(dots(across, across), dots(up, up)))
        keep = np.sqrt(dots(area, area)) > 1e-12 * longest
        if not keep.any():
            raise ValueError(f"faces: expected triangles with an area, got {len(f)} without")
        # unused vertices and dropped triangles must not enlarge the bounding sphere
        self.center: Float
        self.radius: float
        used, _ = _used(v, f[keep])
        self.center, self.radius = _bounds(used)
        self.lowest = float(used[:, 1].min())
        self._local = (v - self.center) / self.radius
        self.vertices: Float = v
        self.faces: Int = f[keep].astype(np.int32)
        self.normals: Float = to_unit(n if n.ndim == 2 else n[keep])
        self.face_part: Int = p[keep].astype(np.int32)
        self.uvs: Float | None = uv[keep] if uv is not None and uv.ndim == 3 else uv
        # a file's winding may disagree with its normals: where it clearly does, the normals
        # decide which side is outside (coarse, strongly curved triangles may disagree a little)
        facet = to_unit(area[keep])
        mean = self._corner_normals(np.arange(len(facet))).mean(axis=1)
        against = dots(facet, mean) < -0.5
        self._facet = np.where(against[:, None], -facet, facet)
        for array in (self.vertices, self.faces, self.normals, self.face_part, self.center):
            array.flags.writeable = False
        if self.uvs is not None:
            self.uvs.flags.writeable = False

    def __reduce__(self) -> tuple[type[Mesh], tuple[object, ...]]:
        # Embree's scene cannot be pickled or copied, so it is built again
        given = (self.vertices, self.faces, self.normals, self.face_part, self.parts, self.uvs)
        return Mesh, given

    def __repr__(self) -> str:
        return f"Mesh({len(self.faces)} triangles, parts={self.parts!r})"

    def intersect(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """Return the nearest hits of rays.

        The shading normal is interpolated over the triangle and flipped where the surface is seen
        from behind. Where its cosine with the direction to the viewer would be below `MIN_COSINE`,
        as along silhouettes, it is bent towards the viewer.

        Parameters
        ----------
        origins : (n, 3) or (3,) array_like
        directions : (n, 3) array_like
            Unit vectors.

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
        # the triangle decides which side is visible; at silhouettes the smooth normal may err
        side = np.where(dots(facet, wo) < 0.0, -1.0, 1.0)
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
        """Return whether rays meet the mesh before `max_distance`, as booleans (n,).

        A ray that starts on the surface meets the surface: start at `Hits.start`.

        Parameters
        ----------
        origins : (n, 3) or (3,) array_like
        directions : (n, 3) array_like
            Unit vectors.
        max_distance : float or (n,) array_like
            Not negative.

        Raises
        ------
        ValueError
            As `intersect`, or if a distance is negative or NaN.
        """
        o, d = _as_rays(origins, directions)
        limit = _as_distances(max_distance, len(d))
        start, skipped = self._approach(o, d)
        # the mesh is nowhere further away than this, and float32 can represent it
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
        """Return local float32 origins (n, 3), and by how many radii (n,) each moved along its ray.

        A distant origin moves up to the bounding sphere: in float32 a ray from 1000 radii away
        would miss its target by 1e-4 radii.
        """
        local = (o - self.center) / self.radius
        skipped = np.zeros(len(local))
        distant = np.flatnonzero(dots(local, local) > 4.0)
        if len(distant):
            a, b = local[distant], d[distant]
            step = np.maximum(-dots(a, b) - 1.5, 0.0)
            # a ray that passes far outside may start anywhere: keep it within float32
            local[distant] = np.clip(a + step[:, None] * b, -1e30, 1e30)
            skipped[distant] = step
        return local.astype(np.float32), skipped

    def _corner_normals(self, face: NDArray[np.integer]) -> Float:
        """Return unit normals (n, 3, 3) of the corners of faces (n,)."""
        index = self.faces[face] if self.normals.ndim == 2 else face
        corner: Float = self.normals[index]
        return corner

    @functools.cached_property
    def convex(self) -> bool:
        """Whether the mesh is certainly closed and convex; False if it is too large to test."""
        return len(self.faces) <= _CONVEX_FACES and _is_convex(self._local, self.faces)

    @functools.cached_property
    def edges(self) -> Edges:
        """The edges between triangles; vertices at one place count as one."""
        # at rounding errors of float32, seams between smooth patches close
        key = np.round(self._local * 2.0**21).astype(np.int64)
        place = np.unique(key, axis=0, return_inverse=True)[1].ravel()
        ends = self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64)
        low, high = np.sort(place[ends], axis=1).T
        side = low * np.int64(len(place)) + high
        order = np.argsort(side, kind="stable")
        starts = np.flatnonzero(np.diff(side[order], prepend=-1, append=-1))
        return Edges(order // 3, ends[order], starts)

    @functools.cached_property
    def _embree(self) -> embreex.rtcore_scene.EmbreeScene:
        # robust: a ray through a shared edge hits one of its two triangles
        scene = embreex.rtcore_scene.EmbreeScene(robust=True)
        embreex.mesh_construction.TriangleMesh(scene, self._local.astype(np.float32), self.faces)
        # the first ray builds the tree, which several threads must not do at once
        scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32), query="OCCLUDED")
        return scene


def _used(points: Float, faces: NDArray[np.integer]) -> tuple[Float, NDArray[np.integer]]:
    """Return the points (V, 3) that faces (F, 3) use, and the faces' indices among them."""
    mask = np.zeros(len(points), dtype=bool)
    mask[faces] = True
    return points[mask], (np.cumsum(mask) - 1)[faces]


def _bounds(points: Float) -> tuple[Float, float]:
    """Return the centre (3,) of the bounding box of points (n, 3), and the radius about it."""
    low, high = points.min(axis=0), points.max(axis=0)
    center: Float = 0.5 * low + 0.5 * high
    with np.errstate(over="ignore"):  # the test below rejects an infinite size
        offset = points - center
        radius = float(np.sqrt(dots(offset, offset).max()))
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
    """Return texture coordinates as float64, (V, 2) or (F, 3, 2); ValueError if they do not fit."""
    uv = np.array(uvs, dtype=np.float64)
    if uv.shape not in ((vertices, 2), (faces, 3, 2)):
        raise ValueError(f"uvs: expected shape {(vertices, 2)} or {(faces, 3, 2)}, got {uv.shape}")
    if not np.isfinite(uv).all():
        raise ValueError("uvs: expected finite numbers, got NaN or infinity")
    return uv


def _is_convex(points: Float, faces: NDArray[np.integer]) -> bool:
    """Return whether triangles (F, 3) of points (V, 3) bound a convex body.

    The points are at most 1 from their centre. Three things are tested. The surface is closed: each
    edge has two triangles. No edge bends inwards. And the volume is that of the convex hull,
    because a surface that bends outwards everywhere may still wind round twice or be in two pieces,
    and many tiny bends may add up. Neither winding nor normals matter.
    """
    points, faces = _used(points, faces)
    # a cheap first test: most shapes have points on both sides of one of a few planes
    few = points[faces[:: len(faces) // 16 + 1]]
    planes = to_unit(np.cross(few[:, 1] - few[:, 0], few[:, 2] - few[:, 0]))
    height = points @ planes.T - dots(planes, few[:, 0])
    if np.minimum(height.max(axis=0), -height.min(axis=0)).max() > 1e-3:
        return False
    corners = points[faces]
    double = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.sqrt(dots(double, double))
    # the centroid of the surface is well inside; that of its corners may be near one side
    inner = np.average(corners.mean(axis=1), axis=0, weights=area)
    normal = to_unit(double)
    offset = dots(normal, corners[:, 0] - inner)
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
    facing = welded[np.roll(corner, 1, axis=1).ravel()] - inner  # the corner opposite each edge
    height = dots(facing[other], normal[one // 3]) - offset[one // 3]
    if height.max() > _CONVEX_HEIGHT:
        return False
    volume = float(np.sum(area * offset)) / 3.0
    import scipy.spatial  # slow to import, and few shapes reach this test

    try:
        hull = float(scipy.spatial.ConvexHull(welded).volume)
    except scipy.spatial.QhullError:  # flat
        return False
    return abs(hull - volume) <= _CONVEX_VOLUME * hull


def _facing_normal(smooth: Float, facet: Float, side: Float, wo: Float) -> Float:
    """Return shading normals (n, 3) that face the viewer, with a cosine of at least `MIN_COSINE`.

    Parameters
    ----------
    smooth : (n, 3) array
        Interpolated outward normals, of any length.
    facet : (n, 3) array
        Unit outward normals of the triangles.
    side : (n,) array
        1 where the triangle's outer side is visible, -1 where its inner side is.
    wo : (n, 3) array
        Unit directions to the viewer.
    """
    vanished = dots(smooth, smooth) < 1e-24  # the corners' normals cancel
    normal = side[:, None] * to_unit(np.where(vanished[:, None], facet, smooth))
    low = np.flatnonzero(dots(normal, wo) < MIN_COSINE)
    if len(low):
        w = wo[low]
        tangent = normal[low] - dots(normal[low], w)[:, None] * w
        opposite = dots(tangent, tangent) < 1e-24  # points straight away: take any tangent
        tangent = to_unit(np.where(opposite[:, None], shading_frame(w)[0], tangent))
        cosine = MIN_COSINE * (1.0 + 1e-9)  # slightly more, so that rounding cannot go below
        normal[low] = cosine * w + math.sqrt(1.0 - cosine**2) * tangent
    return normal


def _smooth_lift(
    point: Float, weight: Float, corners: Float, normals: Float, facet: Float, side: Float
) -> Float:
    """Return offsets (n, 3) from points on triangles to the smooth surface implied by the normals.

    Without them a surface lit at a grazing angle would be in the shadow of its own coarse
    triangles: Hanika, "Hacking the Shadow Terminator", Ray Tracing Gems II (2021). A point moves to
    the mean, weighted by its barycentric coordinates, of its projections onto the corners' tangent
    planes. Flat and concave triangles are not changed.

    Parameters
    ----------
    point, facet : (n, 3) arrays
        The points, and the unit outward normals of their triangles.
    weight : (n, 3) array
        Barycentric weights of the corners.
    corners, normals : (n, 3, 3) arrays
        Positions and unit outward normals of the corners.
    side : (n,) array
        1 where the triangle's outer side is visible, -1 where its inner side is.
    """
    height = np.einsum("nck,nck->nc", point[:, None, :] - corners, normals)
    # seen from inside, a convex surface is concave
    depth = np.minimum(side[:, None] * height, 0.0)
    lift = -np.einsum("nc,nck->nk", side[:, None] * weight * depth, normals)
    # normals that contradict their triangle must not move the point inwards
    outwards = side * dots(lift, facet) > 0.0
    return np.where(outwards[:, None], lift, 0.0)
