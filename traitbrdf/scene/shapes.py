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
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import embreex.mesh_construction
import embreex.rtcore_scene
import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.directions import as_directions, shading_frame

if TYPE_CHECKING:
    pass


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


def dots(a: Float, b: Float) -> Float:
    product: Float = np.einsum("...k,...k->...", a, b)
    return product


def to_unit(v: Float) -> Float:
    """Vectors (..., 3) of unit length; zero vectors stay zero."""
    length = np.sqrt(dots(v, v))
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
        outward = to_unit(offset[hit] + t[hit, None] * d[hit])
        position = np.zeros(d.shape)
        normal = np.zeros(d.shape)
        # from the normal, so that the point lies on the sphere however far away the ray starts
        position[hit] = self.center + self.radius * outward
        facing = dots(outward, d[hit]) <= 0.0
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
        longest = np.maximum(dots(side, side), np.maximum(dots(across, across), dots(up, up)))
        keep = np.sqrt(dots(area, area)) > 1e-12 * longest
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
        self.normals: Float = to_unit(n if n.ndim == 2 else n[keep])
        self.face_part: Int = p[keep].astype(np.int32)
        self.uvs: Float | None = uv[keep] if uv is not None and uv.ndim == 3 else uv
        # a file's winding may disagree with its normals: where they clearly do (a coarse, strongly
        # curved triangle may seem to a little) the normals say which side is out
        facet = to_unit(area[keep])
        mean = self._corner_normals(np.arange(len(facet))).mean(axis=1)
        against = dots(facet, mean) < -0.5
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
        distant = np.flatnonzero(dots(local, local) > 4.0)
        if len(distant):
            a, b = local[distant], d[distant]
            step = np.maximum(-dots(a, b) - 1.5, 0.0)
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
    planes = to_unit(np.cross(few[:, 1] - few[:, 0], few[:, 2] - few[:, 0]))
    height = points @ planes.T - dots(planes, few[:, 0])
    if np.minimum(height.max(axis=0), -height.min(axis=0)).max() > 1e-3:
        return False
    corners = points[faces]
    double = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.sqrt(dots(double, double))
    # the surface's centroid is well inside; that of its corners may crowd at one side
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
    facing = welded[np.roll(corner, 1, axis=1).ravel()] - inner  # the corner across from each edge
    height = dots(facing[other], normal[one // 3]) - offset[one // 3]
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
    vanished = dots(smooth, smooth) < 1e-24  # the corners' normals cancel
    normal = side[:, None] * to_unit(np.where(vanished[:, None], facet, smooth))
    low = np.flatnonzero(dots(normal, wo) < MIN_COSINE)
    if len(low):
        w = wo[low]
        tangent = normal[low] - dots(normal[low], w)[:, None] * w
        opposite = dots(tangent, tangent) < 1e-24  # looks straight away: any tangent will do
        tangent = to_unit(np.where(opposite[:, None], shading_frame(w)[0], tangent))
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
    outwards = side * dots(lift, facet) > 0.0
    return np.where(outwards[:, None], lift, 0.0)
