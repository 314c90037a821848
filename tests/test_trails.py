"""Trails of a brush over surfaces: where paint goes depends on nothing but the stroke."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from traitbrdf.design.masks import Brushed, Framing, Local
from traitbrdf.design.strokes import Stroke, follow
from traitbrdf.design.surface import SurfaceWeights, points_of, touched
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import sphere
from traitbrdf.scene.teapot import teapot
from traitbrdf.scene.trails import evenly, trail_of

SKY = EnvironmentMap.sky(rows=16)
LINE = [(30.0, 62.0), (52.0, 74.0), (85.0, 70.0)]


def pot(size: int = 128, azimuth: float = -35.0) -> Scene:
    return Scene(teapot(), SKY, camera=Camera.orbit(azimuth, 20), size=size, ground=True)


def brushed(scene: Scene, stroke: Stroke, **settings: bool) -> Brushed:
    parts = touched(scene, stroke, Framing.of(scene))
    if settings.get("across"):
        parts = scene.parts
    return Brushed(stroke, Framing.of(scene), parts, **settings)


def painted(scene: Scene, *strokes: Stroke | Brushed, **settings: object):
    """Weights at the fragments of a scene, which the strokes were drawn on."""
    some = tuple(brushed(scene, s) if isinstance(s, Stroke) else s for s in strokes)
    return SurfaceWeights(scene).of(Local(some, scene.parts, **settings))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return pot()


@settings(max_examples=30)
@given(cuts=st.lists(st.tuples(st.integers(0, 1), st.floats(0.01, 0.99)), max_size=12))
def test_how_a_stroke_is_cut_changes_no_weight(scene, cuts):
    whole = painted(scene, Stroke(LINE, radius=12))
    line = np.array(LINE)
    points = []
    for i in range(2):
        shares = sorted({0.0, *(share for piece, share in cuts if piece == i)})
        points += [tuple(line[i] + share * (line[i + 1] - line[i])) for share in shares]
    cut = painted(scene, Stroke([*points, LINE[-1]], radius=12))
    np.testing.assert_allclose(cut, whole, atol=1e-6)
    assert whole.max() == 1.0


@settings(max_examples=20)
@given(
    points=st.lists(st.tuples(st.floats(0, 128), st.floats(0, 128)), min_size=1, max_size=6),
    radius=st.floats(1, 40),
    hardness=st.floats(0, 1),
)
def test_weights_lie_between_none_and_all(scene, points, radius, hardness):
    stroke = Stroke(points, radius=radius, hardness=hardness)
    if touched(scene, stroke, Framing.of(scene)):
        weight = painted(scene, stroke)
        assert weight.min() >= 0.0
        assert weight.max() <= 1.0


def test_a_stroke_that_grows_is_the_stroke_at_once(scene):
    growing = SurfaceWeights(scene)
    rng = np.random.default_rng(3)
    points = [(20 + 80 * t, 66 + 8 * np.sin(9 * t)) for t in rng.random(40).cumsum() / 20]
    first = brushed(scene, Stroke([(40, 60), (70, 80)], radius=9))
    for count in range(1, len(points) + 1):
        grown = brushed(scene, Stroke(points[:count], radius=11))
        weight = growing.of(Local((first, grown), scene.parts))
    np.testing.assert_array_equal(weight, painted(scene, first, grown))


def test_the_area_does_not_depend_on_the_size_of_the_image():
    """The same stroke on small and large images covers the same surface."""
    fine = pot(1024)
    areas = []
    for size in (256, 512, 1024):
        small, scale = pot(size), size / 128
        stroke = Stroke([(x * scale, y * scale) for x, y in LINE], radius=10 * scale)
        weight = SurfaceWeights(fine).of(Local((brushed(small, stroke),), small.parts))
        # a fragment's share of the surface: its solid angle over the cosine, at its distance
        middle = fine.offsets[:-1]
        cosine = np.einsum("pk,pk->p", fine.normals[middle], fine.views[middle])
        areas.append(float((weight * fine.weights / np.maximum(cosine, 0.05)).sum()))
    np.testing.assert_allclose(areas, areas[-1], rtol=0.01)


def test_world_radii_are_those_of_pixels_at_their_distance(scene):
    weight = painted(scene, Stroke(LINE, radius=12))
    trail = trail_of(scene, LINE, 12.0)
    world = Stroke(LINE, radius=float(trail.radius.mean()), units="world")
    assert np.ptp(trail.radius) < 0.1 * trail.radius.mean()
    assert np.abs(painted(scene, world) - weight).mean() < 0.02 * weight.mean()


def test_nothing_comes_out_on_the_far_side_of_the_handle(scene):
    handle = scene.parts.index("handle")
    points, _ = follow(scene.part_image == handle)
    points = points[len(points) // 4 : -len(points) // 4]
    stroke = brushed(scene, Stroke(points, radius=40))
    assert stroke.parts == ("handle",)
    behind = pot(azimuth=145.0)
    weight = SurfaceWeights(behind).of(Local((stroke,), scene.parts))
    # rays go on where the brush touches the near side: there is the far side
    trail = trail_of(scene, stroke.stroke.points, 40.0)
    toward = trail.points - scene.camera.position(scene.shape, 128, 128)
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    far = scene.shape.intersect(trail.points + 0.9 * trail.radius[:, None] * toward, -toward)
    assert (far.part == handle).all()
    at = SurfaceWeights(scene, points_of(far)).of(Local((stroke,), scene.parts))
    near = SurfaceWeights(scene, points_of(scene.hits(*np.array(points).T)))
    assert (near.of(Local((stroke,), scene.parts)) > 0.999).all()
    # what faces away from all normals of the trail has no paint
    away = (behind.normals[behind.offsets[:-1]] @ trail.normals.T).max(axis=1) <= 0.0
    assert (weight[away & (behind.pixel_part == handle)] == 0.0).all()
    assert (at[(far.normal @ trail.normals.T).max(axis=1) <= 0.0] == 0.0).all()


def test_paint_stays_on_the_part_unless_it_may_flow(scene):
    body = scene.parts.index("body")
    stroke = Stroke([(60, 72)], radius=30)
    inside = painted(scene, stroke)
    assert set(scene.pixel_part[inside > 0.0]) == {body}
    across = painted(scene, brushed(scene, stroke, across=True))
    assert set(scene.pixel_part[across > 0.0]) > {body}
    same = scene.pixel_part == body
    np.testing.assert_array_equal(across[same], inside[same])


def test_twice_over_a_place_is_once(scene):
    stroke = brushed(scene, Stroke(LINE, radius=12, flow=0.6))
    once = painted(scene, stroke)
    np.testing.assert_array_equal(painted(scene, stroke, stroke), once)
    assert once.max() == np.float32(0.6)


def test_the_eraser_takes_paint_away(scene):
    stroke = Stroke(LINE, radius=12)
    both = painted(scene, stroke, brushed(scene, stroke, erase=True))
    once = painted(scene, stroke)
    np.testing.assert_allclose(both, once * (1.0 - once), atol=1e-7)
    again = painted(scene, stroke, brushed(scene, stroke, erase=True), stroke)
    np.testing.assert_array_equal(again, np.maximum(both, once))


def test_inverted_and_clipped_masks(scene):
    stroke = Stroke(LINE, radius=12)
    body = scene.pixel_part == scene.parts.index("body")
    once = painted(scene, stroke)
    np.testing.assert_array_equal(painted(scene, stroke, inverted=True), 1.0 - once)
    clipped = painted(scene, stroke, inverted=True, only=("body",))
    np.testing.assert_array_equal(clipped, np.where(body, 1.0 - once, 0.0))
    assert not painted(scene).any()


@pytest.mark.parametrize("hardness", [0.0, 0.5, 0.9, 1.0])
def test_a_brush_is_full_inside_and_fades_to_its_rim(hardness):
    ball = Scene(sphere(), SKY, camera=Camera.orbit(0.0, 0.0), size=200, shadows=False)
    weight = painted(ball, Stroke([(100, 100)], radius=30, hardness=hardness))
    points = ball.positions[ball.offsets[:-1]]
    trail = trail_of(ball, [(100, 100)], 30.0)
    away = np.linalg.norm(points - trail.points[0], axis=1) / trail.radius[0]
    assert (weight[away > 1.0] == 0.0).all()
    assert weight[away < min(hardness, 0.95)] == pytest.approx(1.0)
    order = np.argsort(away)
    assert (np.diff(weight[order]) <= 1e-4).all()


def test_pressure_is_interpolated_along_the_stroke():
    ball = Scene(sphere(), SKY, camera=Camera.orbit(0.0, 0.0), size=200, shadows=False)
    line = [(50, 100), (150, 100)]
    soft = painted(ball, Stroke(line, radius=10, pressure=[0.0, 1.0], flow=0.8))
    middle = np.flatnonzero(ball.pixels == 100 * 200 + 100)
    assert soft[middle] == pytest.approx(0.4, abs=0.05)
    halves = Stroke([line[0], (100, 100), line[1]], radius=10, pressure=[0, 0.5, 1], flow=0.8)
    np.testing.assert_allclose(painted(ball, halves), soft, atol=1e-6)


def test_strokes_far_beyond_the_image_cost_nothing():
    places, _, settled = evenly(np.array([[-1e9, 50.0], [1e9, 50.0]]), 1.0, (100, 100))
    assert len(places) == settled == 101 or len(places) == settled == 100
    assert places[:, 0].min() >= 0.0
    assert places[:, 0].max() <= 100.0
