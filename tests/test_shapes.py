"""Shapes: hits against closed forms, the teapot's figures, mesh files and their failures."""

from __future__ import annotations

import copy
import itertools
import json
import time
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_erosion, binary_fill_holes
from scipy.spatial import ConvexHull

from traitbrdf.formats.files import FormatError
from traitbrdf.scene.meshes import load_mesh
from traitbrdf.scene.shapes import MIN_COSINE, Hits, Mesh, Shape, sphere
from traitbrdf.scene.teapot import teapot

SCALES = [1e-6, 1.0, 1e6]
TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
TETRAHEDRON_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
TWO_GROUPS = """\
# two squares that share an edge
o thing
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v\t2 0 0
v 2 1 0 # the last
usemtl grey
g left
f 1 2 3 4
g right side
f 2/1 5/2 \\
  6/3
f -5 -1 -4 # the same square's other half
"""


def unit(v: NDArray[np.float64]) -> NDArray[np.float64]:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def view(
    shape: Shape, azimuth: float, elevation: float, size: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Orthographic rays (size**2, 3) that cover the shape; angles in degrees, row 0 at the top."""
    a, e = np.radians([azimuth, elevation])
    back = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    right = unit(np.cross([0.0, 1.0, 0.0], back))
    grid = ((np.arange(size) + 0.5) / size * 2.0 - 1.0) * shape.radius
    x, y = np.meshgrid(grid, -grid)
    plane = x[..., None] * right + y[..., None] * np.cross(back, right)
    origins = shape.center + 3.0 * shape.radius * back + plane.reshape(-1, 3)
    return origins, np.tile(-back, (size * size, 1))


def check_hits(hits: Hits, directions: NDArray[np.float64]) -> None:
    """Check what holds for the hits of every shape."""
    assert hits.part.dtype == np.int32
    assert hits.position.dtype == hits.normal.dtype == hits.start.dtype == np.float64
    hit = hits.part >= 0
    for missed in (hits.position[~hit], hits.normal[~hit], hits.start[~hit]):
        assert not missed.any()
    assert np.allclose(np.linalg.norm(hits.normal[hit], axis=1), 1.0, atol=1e-12)
    assert np.all(np.sum(hits.normal[hit] * directions[hit], axis=1) <= 0.0)


# ---------------------------------------------------------------------------------------- sphere

coordinate = st.floats(-1.0, 1.0)


@given(
    st.tuples(coordinate, coordinate, coordinate),
    st.floats(0.0, 0.999),
    st.floats(0.0, 6.28),
    st.sampled_from(SCALES),
    st.floats(1.1, 1e4),
)
def test_sphere_is_hit_where_the_closed_form_says(
    center: tuple[float, float, float], offset: float, turn: float, scale: float, far: float
) -> None:
    # a ray along -z at distance `offset` from the axis meets the unit sphere at sqrt(1 - offset^2)
    c = np.array(center) * scale
    local = np.array([offset * np.cos(turn), offset * np.sin(turn), np.sqrt(1.0 - offset**2)])
    ball = sphere(scale, c)
    origin = c + scale * (local + np.array([0.0, 0.0, far]))
    hits = ball.intersect(origin, np.array([[0.0, 0.0, -1.0]]))
    assert hits.part[0] == 0
    # the origin has one rounding error, which a grazing hit magnifies
    tolerance = 4e-16 * (far + 2.0) / local[2]
    assert np.allclose(hits.normal[0], local, rtol=0.0, atol=tolerance + 1e-14)
    assert np.allclose(hits.position[0], c + scale * local, rtol=0.0, atol=2.0 * scale * tolerance)


@pytest.mark.parametrize("scale", SCALES)
def test_sphere_misses(scale: float) -> None:
    ball = sphere(scale)
    origins = scale * np.array([[1.001, 0.0, 5.0], [0.0, 0.0, 5.0], [0.0, 0.0, 5.0]])
    directions = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    hits = ball.intersect(origins, directions)
    check_hits(hits, directions)
    assert np.all(hits.part == -1)
    assert not ball.occluded(origins, directions).any()


def test_sphere_from_inside_shows_its_inner_side() -> None:
    hits = sphere(2.0).intersect(np.zeros(3), np.array([[0.0, 1.0, 0.0]]))
    assert np.allclose(hits.position[0], [0.0, 2.0, 0.0])
    assert np.allclose(hits.normal[0], [0.0, -1.0, 0.0])


@pytest.mark.parametrize("scale", SCALES)
def test_sphere_does_not_shadow_its_own_surface(scale: float) -> None:
    rng = np.random.default_rng(1)
    normal = unit(rng.normal(size=(1000, 3)))
    w = unit(rng.normal(size=(1000, 3)))
    w *= np.sign(np.sum(w * normal, axis=1))[:, None]
    center = scale * np.array([3.0, -2.0, 1.0])
    ball = sphere(scale, center)
    assert ball.convex
    assert not ball.occluded(center + scale * normal, w).any()
    inwards = np.abs(np.sum(w * normal, axis=1)) > 1e-3
    assert ball.occluded(center + scale * normal, -w)[inwards].all()


def test_sphere_lowest_point_and_start_of_shadow_rays() -> None:
    ball = sphere(2.0, (1.0, 5.0, 0.0))
    assert ball.lowest == 3.0
    hits = ball.intersect(*view(ball, 20.0, 30.0, 8))
    np.testing.assert_array_equal(hits.start, hits.position)


@pytest.mark.parametrize("shape", [sphere(), teapot(4)])
def test_occlusion_ends_at_the_distance(shape: Shape) -> None:
    o, d = view(shape, 20.0, 10.0, 24)
    hits = shape.intersect(o, d)
    hit = hits.part >= 0
    assert 0.1 < hit.mean() < 0.9
    assert np.array_equal(shape.occluded(o, d), hit)
    distance = np.where(hit, np.linalg.norm(hits.position - o, axis=1), 1.0)
    assert not shape.occluded(o, d, 0.999 * distance).any()
    assert np.array_equal(shape.occluded(o, d, 1.001 * distance), hit)
    assert not shape.occluded(o, d, 0.0).any()
    assert not shape.occluded(o, -d).any()


@pytest.mark.parametrize("shape", [sphere(), teapot(4)])
def test_ray_arguments_are_checked(shape: Shape) -> None:
    d = np.array([[0.0, 0.0, -1.0]])
    with pytest.raises(ValueError, match="expected unit vectors"):
        shape.intersect(np.zeros(3), 2.0 * d)
    with pytest.raises(ValueError, match=r"directions: expected shape \(n, 3\)"):
        shape.intersect(np.zeros(3), d[0])
    with pytest.raises(ValueError, match="origins: expected shape"):
        shape.intersect(np.zeros((2, 3)), d)
    with pytest.raises(ValueError, match="origins: expected finite"):
        shape.intersect(np.array([np.nan, 0.0, 0.0]), d)
    with pytest.raises(ValueError, match="max_distance: expected numbers >= 0"):
        shape.occluded(np.zeros(3), d, np.nan)
    with pytest.raises(ValueError, match="max_distance: expected a number or shape"):
        shape.occluded(np.zeros(3), d, [1.0, 2.0])
    nothing = shape.intersect(np.zeros((0, 3)), np.zeros((0, 3)))
    assert nothing.part.shape == (0,) and nothing.normal.shape == (0, 3)


@pytest.mark.parametrize("radius", [0.0, -1.0, np.nan, np.inf])
def test_sphere_arguments_are_checked(radius: float) -> None:
    with pytest.raises(ValueError, match="radius"):
        sphere(radius)
    with pytest.raises(ValueError, match="center"):
        sphere(1.0, (0.0, np.nan, 0.0))


# ---------------------------------------------------------------------------------------- teapot


def vertex_parts(mesh: Mesh) -> NDArray[np.int32]:
    part = np.full(len(mesh.vertices), -1, dtype=np.int32)  # at the poles some go unused
    part[mesh.faces.ravel()] = np.repeat(mesh.face_part, 3)
    return part


def test_teapot_parts_and_size() -> None:
    pot = teapot()
    assert pot.parts == ("rim", "body", "handle", "spout", "lid", "bottom")
    assert 36_000 < len(pot.faces) <= 32 * 2 * 24 * 24
    low, high = pot.vertices.min(axis=0), pot.vertices.max(axis=0)
    assert np.allclose(low, [-3.0, 0.0, -2.0], atol=1e-12)
    assert np.allclose(high[1:], [3.15, 2.0], atol=1e-12)
    assert 3.3 < high[0] < 3.525  # the spout's lip bulges, but stays within its control points
    assert np.all(np.linalg.norm(pot.vertices - pot.center, axis=1) <= pot.radius * (1 + 1e-12))
    part = vertex_parts(pot)
    assert np.all(pot.vertices[part == 2, 0] < -1.4)
    assert np.all(pot.vertices[part == 3, 0] > 1.6)
    assert pot.vertices[part == 4, 1].min() >= 2.4 - 1e-12  # lid above, bottom below: y is up
    assert pot.vertices[part == 5, 1].max() <= 0.15 + 1e-12
    assert teapot(24) is pot
    with pytest.raises(ValueError, match="read-only"):
        pot.vertices[0] = 0.0


def test_teapot_is_turned_and_not_mirrored() -> None:
    text = resources.files("traitbrdf").joinpath("data/newell_teapot.json").read_text("utf-8")
    figures = json.loads(text)
    assert "Newell 1975" in figures["source"]
    control = np.array(figures["patches"])
    pot = teapot(8)
    corners = np.ix_(range(32), [0, 8], [0, 8])
    found = pot.vertices.reshape(32, 9, 9, 3)[corners].reshape(-1, 3)
    given_corners = control[np.ix_(range(32), [0, 3], [0, 3])].reshape(-1, 3)
    turn, *_ = np.linalg.lstsq(given_corners, found)
    assert np.allclose(given_corners @ turn, found, atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)


@pytest.mark.parametrize("resolution", [6, 24])
def test_teapot_normals_point_outwards(resolution: int) -> None:
    pot = teapot(resolution)
    n, v, part = pot.normals, pot.vertices, vertex_parts(pot)
    assert np.allclose(np.linalg.norm(n, axis=1), 1.0, atol=1e-12)
    body = part == 1
    assert np.all(n[body, 0] * v[body, 0] + n[body, 2] * v[body, 2] > 0.0)
    assert np.all(n[part == 5, 1] <= 1e-12)  # the bottom's edge is upright
    # the poles, where the patches' own derivatives vanish
    assert np.allclose(n[v[:, 1] == 3.15], [0.0, 1.0, 0.0])
    assert np.allclose(n[np.all(v == 0.0, axis=1)], [0.0, -1.0, 0.0])
    # every triangle is wound as its normals say
    a, b, c = (v[pot.faces[:, i]] for i in range(3))
    facet = unit(np.cross(b - a, c - a))
    assert np.all(np.sum(facet * n[pot.faces].mean(axis=1), axis=1) > 0.0)
    # handle and spout are tubes: seen from outside, their front comes first and faces us
    o, d = view(pot, 0.0, 0.0, 64)
    hits = pot.intersect(o, d)
    for name in ("handle", "spout"):
        p = hits.position[hits.part == pot.parts.index(name)]
        assert len(p) > 20 and np.all(p[:, 2] >= -0.05)


def test_teapot_normals_are_those_of_the_curved_patches() -> None:
    # differences on a mesh ten times as fine have the same normals, up to their own error
    coarse, fine = teapot(4), teapot(40)
    n = coarse.normals.reshape(32, 5, 5, 3)[:, 1:-1, 1:-1]
    p = fine.vertices.reshape(32, 41, 41, 3)
    du = p[:, 11:32:10, 10:31:10] - p[:, 9:30:10, 10:31:10]
    dv = p[:, 10:31:10, 11:32:10] - p[:, 10:31:10, 9:30:10]
    assert np.allclose(unit(np.cross(dv, du)), n, atol=5e-3)


def test_teapot_patches_meet_without_a_step_in_position_or_normal() -> None:
    pot = teapot(6)
    part = vertex_parts(pot)
    _, index, count = np.unique(pot.vertices, axis=0, return_inverse=True, return_counts=True)
    index = index.reshape(-1)
    # rings of 4 patches, 6 quads each: without exact sharing the counts would be higher
    for name, distinct in (("body", 4 * 6 * 13), ("rim", 4 * 6 * 7), ("bottom", 4 * 6 * 6 + 1)):
        assert len(np.unique(index[part == pot.parts.index(name)])) == distinct
    total = np.stack([np.bincount(index, pot.normals[:, k]) for k in range(3)], axis=-1)
    stepped = np.flatnonzero(np.linalg.norm(total, axis=1) / count < 0.999)
    # the one true edge in the data: the handle's end touches a corner of the body
    assert set(part[np.isin(index, stepped)]) <= {1, 2}
    assert len(stepped) == 1


def test_ray_from_the_front_hits_the_body() -> None:
    hits = teapot().intersect(np.array([0.0, 1.0, 10.0]), np.array([[0.0, 0.0, -1.0]]))
    assert hits.part[0] == 1
    assert hits.position[0, 2] == pytest.approx(2.0, abs=0.01)
    assert hits.normal[0, 2] > 0.95


VIEWS = [(0.0, 0.0), (35.0, 20.0), (120.0, -25.0), (250.0, 60.0)]


@pytest.mark.parametrize(("azimuth", "elevation"), VIEWS)
def test_no_ray_slips_through_the_teapot(azimuth: float, elevation: float) -> None:
    fine = teapot(32)
    o, d = view(fine, azimuth, elevation, 64)
    hits = fine.intersect(o, d)
    check_hits(hits, d)
    covered = (hits.part >= 0).reshape(64, 64)
    # no pinholes: the one hole of the silhouette is the handle's, which is large
    holes = binary_fill_holes(covered) & ~covered
    opened = binary_erosion(holes)
    assert holes.sum() == 0 or opened.sum() > 5
    cosine = -np.sum(hits.normal * d, axis=1)[hits.part >= 0]
    assert cosine.min() >= MIN_COSINE
    coarse = teapot(12).intersect(o, d).part.reshape(64, 64) >= 0
    assert abs(int(coarse.sum()) - int(covered.sum())) <= 0.01 * covered.sum()
    # rays aimed at the shared vertices and edges of patches, where a crack would open
    edge = fine.vertices.reshape(32, 33, 33, 3)[:, [0, 32], :].reshape(-1, 3)
    direction = np.tile(d[0], (len(edge), 1))
    assert np.all(fine.intersect(edge - 9.0 * direction, direction).part >= 0) or (
        _misses_are_on_the_silhouette(fine, edge, direction)
    )


def _misses_are_on_the_silhouette(
    mesh: Mesh, points: NDArray[np.float64], d: NDArray[np.float64]
) -> bool:
    """Whether each missed point is next to free space, as at a silhouette but not at a crack."""
    missed = mesh.intersect(points - 9.0 * d, d).part < 0
    nudges = 1e-3 * np.stack(np.broadcast_arrays(*np.eye(3)))
    beside = np.zeros(missed.sum(), dtype=bool)
    for nudge in np.concatenate([nudges, -nudges]):
        moved = points[missed] + nudge - 9.0 * d[missed]
        beside |= mesh.intersect(moved, d[missed]).part < 0
    return bool(beside.all())


# ------------------------------------------------------------------------------------------ mesh


@pytest.mark.parametrize("scale", SCALES)
def test_mesh_works_at_any_size_and_distance(scale: float) -> None:
    pot = teapot(4)
    other = Mesh(
        scale * (pot.vertices + 5.0), pot.faces, pot.normals, pot.face_part, list(pot.parts)
    )
    o, d = view(pot, 30.0, 15.0, 32)
    expected = pot.intersect(o, d)
    for away in (0.0, 1e6):
        hits = other.intersect(scale * (o + 5.0 - away * d), d)
        same = hits.part == expected.part
        assert same.mean() > 0.995  # a ray along an edge may hit either side
        assert np.allclose(
            hits.position[same & (hits.part >= 0)] / scale - 5.0,
            expected.position[same & (hits.part >= 0)],
            atol=2e-5,
        )
        distance = scale * (away + 6.0 * pot.radius)
        start = scale * (o + 5.0 - away * d)
        assert np.array_equal(other.occluded(start, d, distance), hits.part >= 0)
        assert not other.occluded(start, d, scale * (away + pot.radius)).any()
    nowhere = other.occluded(np.full(3, 1e200), d)
    assert not nowhere.any()


def test_mesh_hits_lie_on_the_triangle_in_double_precision() -> None:
    corner = np.array([[0.1, 0.2, 0.3], [1.7, 0.1, 0.4], [0.3, 1.9, 0.2]])
    normal = unit(np.cross(corner[1] - corner[0], corner[2] - corner[0]))
    tri = Mesh(corner, [[0, 1, 2]], np.tile(normal, (3, 1)), [0], ("t",))
    rng = np.random.default_rng(2)
    target = corner.T @ rng.dirichlet(np.ones(3), 50).T
    d = unit(rng.normal(size=(50, 3)) * 0.3 - normal)
    hits = tri.intersect(target.T - 4.0 * d, d)
    assert np.all(hits.part == 0)
    assert np.allclose((hits.position - corner[0]) @ normal, 0.0, atol=1e-14)
    assert np.allclose(hits.position, target.T, atol=1e-5)
    assert np.allclose(hits.normal, normal)
    behind = tri.intersect(target.T + 4.0 * d, -d)
    assert np.allclose(behind.normal, -normal)


def test_shading_normals_are_bent_towards_the_viewer() -> None:
    corner = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    d = np.array([[0.0, 0.0, -1.0]])
    for tilted in ([1.0, 0.0, 0.001], [1.0, 0.0, -0.5], [0.0, 0.0, -1.0]):
        tri = Mesh(corner, [[0, 1, 2]], np.tile(unit(np.array(tilted)), (3, 1)), [0], ("t",))
        hits = tri.intersect(np.array([0.2, 0.2, 1.0]), d)
        assert np.linalg.norm(hits.normal[0]) == pytest.approx(1.0, abs=1e-12)
        assert hits.normal[0, 2] >= MIN_COSINE
    flat = Mesh(corner, [[0, 1, 2]], np.tile([1.0, 0.0, 0.001], (3, 1)), [0], ("t",))
    assert flat.intersect(np.array([0.2, 0.2, 1.0]), d).normal[0, 2] == pytest.approx(MIN_COSINE)
    # corner normals that cancel leave the triangle's own
    opposed = Mesh(
        corner,
        [[0, 1, 2]],
        [[1, 0, 0.0], [-0.5, 0.75**0.5, 0], [-0.5, -(0.75**0.5), 0]],
        [0],
        ("t",),
    )
    hits = opposed.intersect(np.array([1 / 3, 1 / 3, 1.0]), d)
    assert hits.normal[0, 2] >= MIN_COSINE


def test_winding_may_disagree_with_the_normals() -> None:
    # the normals decide which side is outside, so the winding does not matter
    pot = teapot(8)
    turned = Mesh(pot.vertices, pot.faces[:, ::-1], pot.normals, pot.face_part, pot.parts)
    o, d = view(pot, 35.0, 20.0, 24)
    expected, hits = pot.intersect(o, d), turned.intersect(o, d)
    assert np.array_equal(hits.part, expected.part)
    assert np.allclose(hits.normal, expected.normal, atol=1e-5)


def test_mesh_can_be_copied() -> None:
    pot = teapot(3)
    o, d = view(pot, 35.0, 20.0, 8)
    expected = pot.intersect(o, d)
    hits = copy.deepcopy(pot).intersect(o, d)
    assert np.array_equal(hits.position, expected.position)


# ------------------------------------------------------------- mesh: where shadow rays start


def bulging_triangle(*bend: float) -> Mesh:
    """An equilateral triangle that faces +z; its corners' normals lean outwards by sines `bend`."""
    angle = np.radians([90.0, 210.0, 330.0])
    around = np.stack([np.cos(angle), np.sin(angle), np.zeros(3)], axis=1)
    sine = np.array(bend)[:, None]
    normals = sine * around + np.sqrt(1.0 - sine**2) * np.array([0.0, 0.0, 1.0])
    return Mesh(around, [[0, 1, 2]], normals, [0], ("t",))


@pytest.mark.parametrize(("bend", "side"), [(0.3, 1.0), (-0.3, -1.0)])
def test_a_bulging_triangle_lifts_the_start_by_hand(bend: float, side: float) -> None:
    # at the centroid each tangent plane is |bend| away; components across the normal cancel
    tri = bulging_triangle(bend, bend, bend)
    origin, down = np.array([0.0, 0.0, side * 5.0]), np.array([[0.0, 0.0, -side]])
    hits = tri.intersect(origin, down)
    lift = abs(bend) * np.sqrt(1.0 - bend**2)
    assert np.allclose(hits.start[0], [0.0, 0.0, side * (lift + 1e-4 * tri.radius)], atol=1e-7)
    # from the other side the surface is concave, and nothing is lifted
    hollow = tri.intersect(-origin, -down)
    assert np.allclose(hollow.start[0], [0.0, 0.0, -side * 1e-4 * tri.radius], atol=1e-7)


def test_only_the_corners_that_bulge_lift_the_start() -> None:
    saddle = bulging_triangle(0.3, -0.3, 0.0)
    hits = saddle.intersect(np.array([0.0, 0.0, 5.0]), np.array([[0.0, 0.0, -1.0]]))
    expected = 0.1 * saddle.normals[0] + [0.0, 0.0, 1e-4 * saddle.radius]
    assert np.allclose(hits.start[0], expected, atol=1e-7)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(SCALES))
def test_shadow_rays_start_on_the_side_that_is_seen(seed: int, scale: float) -> None:
    # for any normals the start is at least the offset above the triangle
    rng = np.random.default_rng(seed)
    corner = scale * rng.normal(size=(3, 3))
    tri = Mesh(corner, [[0, 1, 2]], rng.normal(size=(3, 3)), [0], ("t",))
    target = rng.dirichlet(np.ones(3), 20) @ corner
    d = unit(rng.normal(size=(20, 3)))
    hits = tri.intersect(target - 3.0 * tri.radius * d, d)
    check_hits(hits, d)
    hit = hits.part >= 0
    facet = unit(np.cross(corner[1] - corner[0], corner[2] - corner[0]))
    above = (hits.start - hits.position) @ facet * -np.sign(d @ facet)
    assert np.all(above[hit] >= 0.999e-4 * tri.radius)
    assert not tri.occluded(hits.start[hit], -d[hit]).any()


def test_flat_shading_lifts_nothing() -> None:
    flat = np.cross(*np.moveaxis(np.diff(TETRAHEDRON[TETRAHEDRON_FACES], axis=1), 1, 0))
    solid = Mesh(
        TETRAHEDRON, TETRAHEDRON_FACES, np.repeat(flat[:, None], 3, axis=1), [0] * 4, ["t"]
    )
    hits = solid.intersect(*view(solid, 35.0, 20.0, 24))
    assert np.count_nonzero(hits.part == 0) > 50
    away = (hits.start - hits.position)[hits.part == 0]
    assert np.allclose(away, 1e-4 * solid.radius * hits.normal[hits.part == 0], atol=1e-12)


def test_the_lowest_point_is_that_of_the_triangles_kept() -> None:
    vertices = np.vstack([TETRAHEDRON + np.array([0.0, 2.0, 0.0]), [0.0, -9.0, 0.0]])
    solid = Mesh(vertices, TETRAHEDRON_FACES, np.ones((5, 3)), [0] * 4, ["t"])
    assert solid.lowest == 2.0
    assert teapot(4).lowest == pytest.approx(0.0, abs=1e-12)


# ------------------------------------------------------------------------------- mesh: convexity


def plain(vertices: ArrayLike, faces: ArrayLike) -> Mesh:
    """A mesh of one part whose normals do not matter."""
    return Mesh(
        vertices, faces, np.tile([0.0, 1.0, 0.0], (len(vertices), 1)), [0] * len(faces), ["a"]
    )


def solid(made: trimesh.Trimesh) -> Mesh:
    return plain(made.vertices, made.faces)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(4, 80), st.sampled_from(SCALES))
def test_convex_hulls_are_convex_and_dented_ones_not(seed: int, count: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    points = unit(rng.normal(size=(count, 3))) * rng.uniform(0.5, 2.0, 3)
    hull = trimesh.convex.convex_hull(points)
    vertices = scale * (hull.vertices + rng.normal(size=3))
    faces = rng.permutation(hull.faces)
    faces[::2] = faces[::2, ::-1]  # winding does not matter
    body = plain(vertices, faces)
    assert body.convex
    # float32, as files store it
    assert plain(vertices.astype(np.float32), faces).convex
    assert not plain(vertices, faces[1:]).convex  # open
    # a corner moved inwards by a twentieth leaves a dent, unless it stays outermost
    inward = hull.vertices.copy()
    at = faces[0, 0]
    inward[at] += 0.05 * (inward.mean(axis=0) - inward[at])
    a, b, c = (inward[hull.faces[:, i]] for i in range(3))
    volume = np.sum(np.cross(a, b) * c) / 6.0
    if ConvexHull(inward).volume > 1.001 * volume:
        assert not plain(inward, faces).convex


def great_icosahedron() -> trimesh.Trimesh:
    """Twenty large triangles that pass through one another; each edge bends outwards."""
    corner = trimesh.creation.icosahedron().vertices
    apart = np.linalg.norm(corner[:, None] - corner[None], axis=-1).round(6)
    far = np.unique(apart)[2]
    faces = [
        c
        for c in itertools.combinations(range(12), 3)
        if all(apart[a, b] == far for a, b in itertools.combinations(c, 2))
    ]
    assert len(faces) == 20
    return trimesh.Trimesh(corner, faces, process=False)


def shrunk_corner(factor: float) -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(subdivisions=3)
    corner = ball.vertices.copy()
    corner[7] *= factor
    return trimesh.Trimesh(corner, ball.faces, process=False)


def together(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.util.concatenate(meshes)


BOX = trimesh.creation.box()


@pytest.mark.parametrize(
    ("made", "convex"),
    [
        (BOX, True),
        (trimesh.creation.icosphere(subdivisions=3), True),
        (trimesh.creation.cylinder(1.0, 2.0), True),
        (shrunk_corner(0.9999), True),  # stays outside its neighbours' planes
        (shrunk_corner(0.99), False),
        (shrunk_corner(1.05), False),
        (trimesh.creation.torus(2.0, 0.5), False),
        (great_icosahedron(), False),
        (together(BOX, trimesh.creation.box(extents=[0.2] * 3)), False),
        (together(BOX, BOX.copy().apply_translation([3.0, 0.0, 0.0])), False),
        (together(BOX, BOX.copy().apply_translation([1.0, 0.0, 0.0])), False),
        (trimesh.Trimesh(TETRAHEDRON[:3], [[0, 1, 2], [0, 2, 1]], process=False), False),
        (trimesh.Trimesh(TETRAHEDRON[:3], [[0, 1, 2]], process=False), False),
    ],
)
def test_convexity_of_known_shapes(made: trimesh.Trimesh, convex: bool) -> None:
    assert solid(made).convex is convex


def test_a_finely_cut_box_is_convex_in_float32() -> None:
    box = trimesh.creation.box()
    for _ in range(4):
        box = box.subdivide()
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    assert plain((box.vertices @ turn + 3.0).astype(np.float32), box.faces).convex


def test_small_dents_that_add_up_are_found() -> None:
    # a fine grid whose edges each bend inwards by less than the tolerance
    n = 200
    grid = np.linspace(-1.0, 1.0, n + 1)
    x, z = (a.ravel() for a in np.meshgrid(grid, grid))
    bowl = 2e-4 * (x**2 + z**2 - 2.0)
    top = np.stack([x, bowl, z], axis=1)
    corner = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = (q.ravel() for q in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:],
                                      corner[1:, :-1]))  # fmt: skip
    lid = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    rim = np.concatenate([corner[0], corner[1:, -1], corner[-1, -2::-1], corner[-2:0:-1, 0]])
    tip = np.full(len(rim), len(top))
    side = np.stack([rim, np.roll(rim, -1), tip], 1)
    vertices = np.vstack([top, [0.0, -2.0, 0.0]])
    bent = plain(vertices, np.concatenate([lid, side]))
    vertices[:, 1] = np.where(vertices[:, 1] < -1.0, -2.0, 0.0)
    assert plain(vertices, np.concatenate([lid, side])).convex
    assert not bent.convex


def test_very_large_meshes_are_not_taken_for_convex() -> None:
    ball = trimesh.creation.icosphere(subdivisions=7)
    assert len(ball.faces) > 200_000
    start = time.perf_counter()
    assert solid(ball).convex is False
    assert time.perf_counter() - start < 20.0


# ------------------------------------------------------------------- mesh: texture coordinates


def test_texture_coordinates_are_kept_with_the_faces() -> None:
    faces = np.vstack([[[0, 0, 1]], TETRAHEDRON_FACES])  # the first has no area
    corner = np.arange(5 * 3 * 2.0).reshape(5, 3, 2)
    made = Mesh(TETRAHEDRON, faces, np.ones((4, 3)), [0] * 5, ["t"], corner)
    np.testing.assert_array_equal(made.uvs, corner[1:])
    np.testing.assert_array_equal(copy.deepcopy(made).uvs, corner[1:])
    plane = corner[:2, :2].reshape(4, 2)
    per_vertex = Mesh(TETRAHEDRON, faces, np.ones((4, 3)), [0] * 5, ["t"], plane)
    assert per_vertex.uvs.shape == (4, 2)
    assert copy.deepcopy(teapot(3)).uvs is None
    with pytest.raises(ValueError, match="read-only"):
        made.uvs[0] = 0.0


def test_corner_normals_may_differ_at_a_vertex() -> None:
    pot = teapot(3)
    corner = Mesh(pot.vertices, pot.faces, pot.normals[pot.faces], pot.face_part, pot.parts)
    o, d = view(pot, 10.0, 40.0, 16)
    assert np.allclose(corner.intersect(o, d).normal, pot.intersect(o, d).normal)
    assert repr(corner).startswith("Mesh(") and not corner.convex
    flat = np.cross(*np.moveaxis(np.diff(TETRAHEDRON[TETRAHEDRON_FACES], axis=1), 1, 0))
    creased = Mesh(
        TETRAHEDRON, TETRAHEDRON_FACES, np.repeat(flat[:, None], 3, axis=1), [0] * 4, ["t"]
    )
    hits = creased.intersect(
        np.array([[0.2, 0.2, -1.0], [1.0, 1.0, 1.0]]),
        np.array([[0.0, 0.0, 1.0], -np.ones(3) / np.sqrt(3.0)]),
    )
    assert np.allclose(hits.normal, [[0.0, 0.0, -1.0], np.ones(3) / np.sqrt(3.0)])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices": np.zeros((4, 2))}, "vertices: expected shape"),
        ({"vertices": np.full((4, 3), np.inf)}, "vertices: expected finite"),
        ({"vertices": np.where(TETRAHEDRON == 1.0, np.nan, 0.0)}, "vertices: expected finite"),
        ({"vertices": np.ones((4, 3))}, "vertices: expected a finite size"),
        ({"vertices": np.outer(np.arange(4.0), [1.0, 1.0, 1.0])}, "triangles with an area"),
        ({"faces": np.zeros((0, 3), dtype=int)}, "faces: expected integers"),
        ({"faces": TETRAHEDRON_FACES + 0.5}, "faces: expected integers"),
        ({"faces": TETRAHEDRON_FACES + 1}, "faces: expected indices from 0 to 3"),
        ({"normals": np.ones((3, 3))}, "normals: expected shape"),
        ({"normals": np.full((4, 3), np.nan)}, "normals: expected finite"),
        ({"normals": np.zeros((4, 3))}, "zero vectors"),
        ({"face_part": [0, 0, 0]}, "face_part: expected 4 integers"),
        ({"face_part": [0, 0, 0, 1]}, "face_part: expected indices"),
        ({"parts": ("a", "a")}, "unique names"),
        ({"uvs": np.zeros((4, 3))}, r"uvs: expected shape \(4, 2\) or \(4, 3, 2\)"),
        ({"uvs": np.full((4, 2), np.nan)}, "uvs: expected finite"),
    ],
)
def test_mesh_arguments_are_checked(change: dict[str, object], message: str) -> None:
    arguments: dict[str, object] = {
        "vertices": TETRAHEDRON,
        "faces": TETRAHEDRON_FACES,
        "normals": np.ones((4, 3)),
        "face_part": np.zeros(4, dtype=int),
        "parts": ("a",),
    }
    with pytest.raises(ValueError, match=message):
        Mesh(**(arguments | change))


@pytest.mark.parametrize("resolution", [1, 2.5, True])
def test_teapot_resolution_is_checked(resolution: int) -> None:
    with pytest.raises(ValueError, match="resolution: expected an integer"):
        teapot(resolution)


# ------------------------------------------------------------------------------------ mesh files


def test_obj_groups_become_parts(tmp_path: Path) -> None:
    path = tmp_path / "two.obj"
    path.write_text(TWO_GROUPS)
    mesh = load_mesh(path)
    assert mesh.parts == ("left", "right side")
    assert mesh.face_part.tolist() == [0, 0, 1, 1]
    hits = mesh.intersect(
        np.array([[0.5, 0.4, 1.0], [1.5, 0.4, 1.0], [1.5, 0.6, -1.0], [2.5, 0.5, 1.0]]),
        np.array([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]),
    )
    assert hits.part.tolist() == [0, 1, 1, -1]
    assert np.allclose(hits.normal[:, 2], [1.0, 1.0, -1.0, 0.0])


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("g ", "o ", ("left", "right side")),
        ("g ", "usemtl ", ("left", "right side")),
        ("g ", "# ", ("thing",)),
        ("g right", "# ", ("left",)),
    ],
)
def test_obj_parts_fall_back(tmp_path: Path, old: str, new: str, parts: tuple[str, ...]) -> None:
    path = tmp_path / "two.obj"
    path.write_text(TWO_GROUPS.replace(old, new))
    assert load_mesh(str(path)).parts == parts


def test_an_obj_without_names_is_named_after_the_file(tmp_path: Path) -> None:
    path = tmp_path / "two.obj"
    lines = [x for x in TWO_GROUPS.splitlines() if x.split(" ")[0] not in ("o", "g", "usemtl")]
    path.write_text("\n".join(lines))
    assert load_mesh(path).parts == ("two",)
    path.write_text("o default\n" + "\n".join(lines))
    assert load_mesh(path).parts == ("two",)


def test_obj_keeps_its_own_normals(tmp_path: Path) -> None:
    path = tmp_path / "tilted.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nvn 1 0 1\nf 1//1 2//1 3//1\nf 2 4 3\n")
    mesh = load_mesh(path)
    down = np.tile([0.0, 0.0, -1.0], (2, 1))
    hits = mesh.intersect(np.array([[0.2, 0.2, 1.0], [0.8, 0.8, 1.0]]), down)
    assert np.allclose(hits.normal, [[0.5**0.5, 0.0, 0.5**0.5], [0.0, 0.0, 1.0]])


def test_obj_keeps_texture_coordinates(tmp_path: Path) -> None:
    path = tmp_path / "seam.obj"
    path.write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\n"
        "vt 0 0.25\nvt 1\nvt 0.5 1 0\nvn 0 0 1\n"
        "g b\nf 1/1 2/-2/1 3/3/1\n"  # relative, with and without a normal
        "g a\nf 2/3 4/1 3/2\nf 1 2 4\nf 1/9 3/1 4/1\n"  # none; one that is missing
    )
    made = load_mesh(path)
    assert made.parts == ("b", "a")
    expected = [
        [[0.0, 0.25], [1.0, 0.0], [0.5, 1.0]],
        [[0.5, 1.0], [0.0, 0.25], [1.0, 0.0]],
        [[0.0, 0.0]] * 3,
        [[0.0, 0.0], [0.0, 0.25], [0.0, 0.25]],
    ]
    np.testing.assert_array_equal(made.uvs, expected)
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/2 3/3\n")
    assert load_mesh(path).uvs is None


def test_obj_relative_indices_count_from_where_they_stand(tmp_path: Path) -> None:
    path = tmp_path / "relative.obj"
    path.write_text(
        "g a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\ng b\nv 5 0 0\nv 6 0 0\nv 5 1 0\nf -3 -2 -1\n"
    )
    made = load_mesh(path)
    assert made.vertices[made.faces[made.face_part == 0]].max() == 1.0
    assert made.vertices[made.faces[made.face_part == 1]][..., 0].min() == 5.0


def test_obj_groups_without_faces_are_no_parts(tmp_path: Path) -> None:
    path = tmp_path / "empty.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\ng none\ng some\nf 1 2 3\ng last\n")
    assert load_mesh(path).parts == ("some",)
    # a group that occurs twice is one part
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\ng a\nf 1 2 3\ng b\nf 1 3 2\ng a\nf 2 3 1\n")
    made = load_mesh(path)
    assert made.parts == ("a", "b")
    assert made.face_part.tolist() == [0, 0, 1]


def test_smooth_normals_cross_the_borders_of_parts(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    upper = ball.triangles_center[:, 1] > 0.0
    lines = ["v {} {} {}".format(*v) for v in ball.vertices]
    for name, mask in (("north", upper), ("south", ~upper)):
        lines.append(f"g {name}")
        lines += ["f {} {} {}".format(*(f + 1)) for f in ball.faces[mask]]
    path = tmp_path / "ball.obj"
    path.write_text("\n".join(lines))
    mesh = load_mesh(path)
    assert mesh.parts == ("north", "south")
    corner = mesh.vertices[mesh.faces]
    assert np.all(np.sum(corner * mesh.normals, axis=-1) > 0.999)


def test_ply_is_one_part_named_after_the_file(tmp_path: Path) -> None:
    path = tmp_path / "ball.ply"
    trimesh.creation.icosphere(subdivisions=2, radius=2.0).export(path)
    mesh = load_mesh(path)
    assert mesh.parts == ("ball",)
    assert mesh.radius == pytest.approx(2.0, rel=1e-3)
    hits = mesh.intersect(np.array([0.1, 0.2, 9.0]), np.array([[0.0, 0.0, -1.0]]))
    assert np.allclose(hits.normal[0], unit(hits.position[0]), atol=0.02)


def test_ply_keeps_texture_coordinates_and_normals_at_a_seam(tmp_path: Path) -> None:
    path = tmp_path / "seam.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 5\n"
        + "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
        + "element face 2\nproperty list uchar int vertex_indices\n"
        "property list uchar float texcoord\nend_header\n"
        "9 9 9 1 0 0\n"  # in no face
        "0 0 0 0 0 1\n1 0 0 0 0.6 0.8\n1 1 0 0 0 1\n0 1 0 0.6 0 0.8\n"
        "3 1 2 3 6 0 0 1 0 1 1\n"
        "3 1 3 4 6 0.5 0 1 0.5 0 1\n"  # the shared edge lies elsewhere in the picture
    )
    made = load_mesh(path)
    corner = made.normals if made.normals.ndim == 3 else made.normals[made.faces]
    assert np.allclose(corner[0], [[0, 0, 1], [0, 0.6, 0.8], [0, 0, 1]], atol=1e-6)
    assert np.allclose(corner[1], [[0, 0, 1], [0, 0, 1], [0.6, 0, 0.8]], atol=1e-6)
    assert np.allclose(made.uvs[0], [[0, 0], [1, 0], [1, 1]])
    assert np.allclose(made.uvs[1], [[0.5, 0], [1, 0.5], [0, 1]])
    assert np.allclose(made.vertices[made.faces[1]][:, :2], [[0, 0], [1, 1], [0, 1]])


@pytest.mark.parametrize("suffix", ["ply", "glb", "obj"])
def test_texture_coordinates_go_round(tmp_path: Path, suffix: str) -> None:
    # v is up in memory, whichever way the format counts
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(uv=0.25 * box.vertices[:, :2] + [0.5, 0.25])
    path = tmp_path / f"box.{suffix}"
    box.export(path)
    made = load_mesh(path)
    expected = 0.25 * made.vertices[made.faces][..., :2] + [0.5, 0.25]
    assert np.allclose(made.uvs, expected, atol=1e-6)
    assert made.convex


def test_a_mirrored_gltf_node_keeps_its_texture_on_its_corners(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2] + 0.5)
    scene = trimesh.Scene()
    scene.add_geometry(box, transform=np.diag([-2.0, 1.0, 1.0, 1.0]))
    path = tmp_path / "mirrored.glb"
    scene.export(path)
    made = load_mesh(path)
    expected = made.vertices[made.faces][..., :2] * [-0.5, 1.0] + 0.5
    assert np.allclose(made.uvs, expected, atol=1e-6)


def test_glb_scene_keeps_names_and_transforms(tmp_path: Path) -> None:
    box, ball = trimesh.creation.box(), trimesh.creation.icosphere(subdivisions=2)
    assert ball.vertex_normals is not None  # computed here, and so written
    mirrored = np.diag([-2.0, 1.0, 1.0, 1.0])
    mirrored[:3, 3] = [5.0, 0.0, 0.0]
    scene = trimesh.Scene()
    scene.add_geometry(box, geom_name="crate", node_name="first")
    scene.add_geometry(ball, geom_name="ball", node_name="second", transform=mirrored)
    path = tmp_path / "scene.glb"
    scene.export(path)
    mesh = load_mesh(path)
    assert mesh.parts == ("crate", "ball")
    o = np.array([[0.1, 0.2, 9.0], [5.0, 0.0, 9.0], [9.0, 0.0, 0.0], [6.8, 0.0, 9.0]])
    d = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    hits = mesh.intersect(o, d)
    assert hits.part.tolist() == [0, 1, 1, 1]
    assert np.allclose(hits.normal[1], [0.0, 0.0, 1.0], atol=0.02)
    assert np.allclose(hits.position[2], [7.0, 0.0, 0.0], atol=0.02)
    # the ellipsoid's outward normal: gradient of ((x - 5) / 2)^2 + y^2 + z^2
    p = hits.position[3] - [5.0, 0.0, 0.0]
    assert np.allclose(hits.normal[3], unit(p / [4.0, 1.0, 1.0]), atol=0.03)


def test_glb_without_names_is_named_after_the_file(tmp_path: Path) -> None:
    path = tmp_path / "lonely.glb"
    trimesh.creation.box().export(path)
    assert load_mesh(path).parts == ("lonely",)


def test_materials_name_the_primitives_of_one_gltf_mesh(tmp_path: Path) -> None:
    # two primitives of one mesh, as modelling programs write an object of two materials
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype="<f4")
    index = np.array([0, 1, 2, 1, 3, 2], dtype="<u2")
    (tmp_path / "two.bin").write_bytes(corner.tobytes() + index.tobytes())
    primitive = [{"attributes": {"POSITION": 0}, "indices": i + 1, "material": i} for i in (0, 1)]
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"name": "panel", "primitives": primitive}],
        "materials": [{"name": "paint"}, {"name": "chrome"}],
        "buffers": [{"uri": "two.bin", "byteLength": 60}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 12},
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": 4,
                "type": "VEC3",
                "min": [0, 0, 0],
                "max": [1, 1, 0],
            },
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
            {
                "bufferView": 1,
                "byteOffset": 6,
                "componentType": 5123,
                "count": 3,
                "type": "SCALAR",
            },
        ],
    }
    path = tmp_path / "two.gltf"
    path.write_text(json.dumps(document))
    mesh = load_mesh(path)
    assert mesh.parts == ("paint", "chrome")
    assert mesh.face_part.tolist() == [0, 1]


def test_degenerate_triangles_are_dropped(tmp_path: Path) -> None:
    path = tmp_path / "some.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nf 1 2 3\nf 1 2 4\nf 2 2 3\n")
    assert len(load_mesh(path).faces) == 1


def test_missing_mesh_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nothing\.obj"):
        load_mesh(tmp_path / "nothing.obj")


V3 = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY_HEADER = """\
ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
"""


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.txt", "hello", r"expected a mesh file .*got '\.txt'"),
        ("a.obj", "", "expected triangles, got none"),
        ("a.obj", V3, "expected triangles, got none"),
        ("a.obj", V3 + "f 1 2 4\n", r"line 4, got 'f 1 2 4' \(index 4 of 3\)"),
        ("a.obj", V3 + "f 1 2 0\n", "index 0 of 3"),
        ("a.obj", V3 + "f 1 2\n", "fewer than three corners"),
        ("a.obj", V3 + "f 1 2 x\n", "line 4"),
        ("a.obj", "v 0 0\n", "line 1"),
        ("a.obj", "vn 0 0\n", "line 1"),
        ("a.obj", V3 + "v nan 0 0\nf 1 2 4\n", "expected finite vertices, got 1"),
        ("a.obj", V3 + "v 2 0 0\nf 1 2 4\n", "expected triangles with an area"),
        ("a.obj", "v 1e308 0 0\nv -1e308 0 0\nv 0 9 0\nf 1 2 3", "expected a finite size"),
        ("a.obj", V3 + "f 1 1 1\n", "expected triangles with an area"),
        ("a.ply", "not a ply file", r"expected a readable \.ply file, got"),
        ("a.ply", PLY_HEADER + "0 0 0\n1 0 0\n", r"\.ply"),
        ("a.ply", PLY_HEADER + "0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", r"\.ply"),
        ("a.ply", PLY_HEADER + "0 0 0\n1 0 0\n0 inf 0\n3 0 1 2\n", "finite vertices"),
        ("a.glb", "glTF nonsense", r"expected a readable \.glb file, got"),
        ("a.gltf", "{}", r"\.gltf"),
        ("a.gltf", "", r"\.gltf"),
    ],
)
def test_broken_mesh_files(tmp_path: Path, name: str, content: str, message: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(FormatError, match=message) as caught:
        load_mesh(path)
    assert str(path) in str(caught.value)


def test_a_folder_is_no_mesh_file(tmp_path: Path) -> None:
    (tmp_path / "a.obj").mkdir()
    with pytest.raises(FormatError, match="got a folder"):
        load_mesh(tmp_path / "a.obj")


def test_a_dropped_triangle_does_not_count_for_the_size():
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9], [10, 10, 10], [11, 11, 11]]
    normals = np.tile([0.0, 0.0, 1.0], (6, 1))
    made = Mesh(vertices, [[0, 1, 2], [3, 4, 5]], normals, [0, 0], ("a",))
    again = Mesh(made.vertices, made.faces, made.normals, made.face_part, made.parts)
    assert made.radius == again.radius == pytest.approx(0.5**0.5)
    np.testing.assert_array_equal(made.center, again.center)
