"""Strokes: coverage as a function of distance alone, shares of regions, bad input."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from traitbrdf.design.strokes import Stroke, follow, region_weights

coordinate = st.floats(-30.0, 70.0)
point = st.tuples(coordinate, coordinate)
lines = st.lists(point, min_size=1, max_size=5)
radii = st.floats(0.5, 60.0)


def stroke(points, radius=6.0, **settings):
    return Stroke(points, trait="shiny", amount=0.5, radius=radius, **settings)


@given(lines, radii)
def test_coverage_is_within_zero_and_one(points, radius):
    cover = stroke(points, radius).coverage(30, 40)
    assert cover.shape == (30, 40)
    assert cover.dtype == np.float32
    assert cover.min() >= 0.0
    assert cover.max() <= 1.0


@given(lines, radii, st.floats(0.0, 1.0), st.data())
def test_coverage_does_not_depend_on_how_the_line_is_cut(points, radius, at, data):
    i = data.draw(st.integers(0, len(points) - 1))
    a, b = np.array(points[i]), np.array(points[min(i + 1, len(points) - 1)])
    cut = [*points[: i + 1], tuple(a + at * (b - a)), *points[i + 1 :]]
    np.testing.assert_allclose(
        stroke(cut, radius).coverage(30, 40), stroke(points, radius).coverage(30, 40), atol=1e-6
    )


@given(lines, radii)
def test_coverage_does_not_depend_on_the_direction_of_the_line(points, radius):
    np.testing.assert_allclose(
        stroke(points[::-1], radius).coverage(30, 40),
        stroke(points, radius).coverage(30, 40),
        atol=1e-6,
    )


@given(lines, radii, st.integers(-20, 20), st.integers(-20, 20))
def test_coverage_moves_with_the_line(points, radius, dx, dy):
    moved = stroke([(x + dx, y + dy) for x, y in points], radius).coverage(90, 100)
    still = stroke(points, radius).coverage(90, 100)
    np.testing.assert_allclose(moved[20 + dy : 70 + dy, 20 + dx : 80 + dx], still[20:70, 20:80],
                               atol=1e-5)  # fmt: skip


@given(lines, radii, st.integers(0, 30), st.integers(0, 40))
def test_coverage_of_a_smaller_image_is_a_part_of_it(points, radius, height, width):
    whole = stroke(points, radius).coverage(30, 40)
    np.testing.assert_array_equal(
        stroke(points, radius).coverage(height, width), whole[:height, :width]
    )


@given(lines, radii)
def test_a_wider_brush_covers_more(points, radius):
    narrow = stroke(points, radius).coverage(30, 40)
    assert np.all(stroke(points, 1.5 * radius).coverage(30, 40) >= narrow - 1e-6)


def test_a_point_is_a_disc_full_in_its_inner_half():
    cover = stroke([(20.5, 15.5)], radius=8.0).coverage(32, 40)
    y, x = np.mgrid[:32, :40]
    distance = np.hypot(x - 20.0, y - 15.0)
    assert np.all(cover[distance <= 4.0] == 1.0)
    assert np.all(cover[distance >= 8.0] == 0.0)
    rim = (distance > 4.0) & (distance < 8.0)
    assert np.all((cover[rim] > 0.0) & (cover[rim] < 1.0))
    assert cover[15, 26] == pytest.approx(0.5)  # half way between
    np.testing.assert_allclose(cover[:, 1:40], cover[:, 39:0:-1], atol=1e-6)


def test_the_rim_is_continuous():
    cover = stroke([(100.0, 100.0)], radius=90.0).coverage(200, 200)
    assert np.abs(np.diff(cover, axis=0)).max() < 2.0 / 45.0


def test_coverage_off_the_image():
    assert stroke([(-50.0, -50.0)], radius=10.0).coverage(30, 40).max() == 0.0
    crossing = stroke([(-1e3, 15.0), (1e3, 15.0)], radius=4.0).coverage(30, 40)
    assert np.all(crossing[14:16] == 1.0)
    assert np.all(crossing[:10] == 0.0)


@pytest.mark.parametrize(
    "points",
    [[(1e9, 5.0)], [(-1e9, 1e9), (5.0, 5.0)], [(20.0, 15.0), (20.0, 15.0)], [(1e-300, 0.0)]],
)
def test_extreme_points_do_no_harm(points):
    for radius in (1e-300, 1e-3, 1.0, 1e9):
        cover = stroke(points, radius).coverage(30, 40)
        assert np.isfinite(cover).all()
        assert 0.0 <= cover.min() <= cover.max() <= 1.0


def test_a_huge_brush_covers_all():
    assert np.all(stroke([(20.0, 15.0)], radius=1e6).coverage(30, 40) == 1.0)


def test_repeated_points_change_nothing():
    once, thrice = [(3.0, 4.0), (20.0, 9.0)], [(3.0, 4.0), (3.0, 4.0), (20.0, 9.0), (20.0, 9.0)]
    np.testing.assert_array_equal(stroke(once).coverage(30, 40), stroke(thrice).coverage(30, 40))


def test_points_may_be_an_array_and_are_frozen():
    line = np.array([[1.0, 2.0], [3.0, 4.0]], np.float32)
    made = stroke(line)
    assert made.points == ((1.0, 2.0), (3.0, 4.0))
    line[:] = 0.0
    assert made.points == ((1.0, 2.0), (3.0, 4.0))
    assert made == stroke([(1, 2), (3, 4)])
    assert stroke([(0, 0)], hold="colour").hold == ("colour",)
    assert stroke([(0, 0)], hold=["red", "bright"]).hold == ("red", "bright")


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"points": []}, ValueError, "at least one"),
        ({"points": [1.0, 2.0]}, ValueError, "shape"),
        ({"points": [(1.0, 2.0, 3.0)]}, ValueError, "shape"),
        ({"points": [(1.0, math.nan)]}, ValueError, "finite"),
        ({"points": [(1.0, math.inf)]}, ValueError, "finite"),
        ({"points": [(1.0, 1e30)]}, ValueError, "points"),
        ({"points": "abc"}, TypeError, "pairs"),
        ({"points": None}, (TypeError, ValueError), "points"),
        ({"points": [(1.0, 2.0), (3.0,)]}, TypeError, "pairs"),
        ({"trait": 3}, TypeError, "trait"),
        ({"amount": math.nan}, ValueError, "amount"),
        ({"amount": -math.inf}, ValueError, "amount"),
        ({"amount": "much"}, TypeError, "amount"),
        ({"amount": None}, TypeError, "amount"),
        ({"radius": 0.0}, ValueError, "radius"),
        ({"radius": -2.0}, ValueError, "radius"),
        ({"radius": math.nan}, ValueError, "radius"),
        ({"radius": 1e30}, ValueError, "radius"),
        ({"radius": [3.0]}, TypeError, "radius"),
        ({"hold": 5}, TypeError, "hold"),
    ],
)
def test_bad_strokes(change, error, match):
    with pytest.raises(error, match=match):
        Stroke(**{"points": [(1.0, 2.0)], "trait": "shiny", "amount": 0.5, **change})


@given(lines, radii, st.integers(0, 2**32 - 1))
def test_region_weights_sum_to_one_or_nothing(points, radius, seed):
    region = np.random.default_rng(seed).integers(-1, 4, (30, 40))
    cover = stroke(points, radius).coverage(30, 40)
    weights = region_weights(cover, region, 4)
    assert weights.shape == (4,)
    assert np.all(weights >= 0.0)
    touched = cover[region >= 0].sum() > 0.0
    assert weights.sum() == pytest.approx(1.0 if touched else 0.0)


def test_region_weights_are_shares_of_the_covered_object():
    region = np.full((10, 20), -1)
    region[:, 5:10], region[:, 10:15] = 0, 2
    cover = np.ones((10, 20), np.float32)
    np.testing.assert_allclose(region_weights(cover, region, 3), [0.5, 0.0, 0.5])
    cover[:, 10:] = 0.25
    np.testing.assert_allclose(region_weights(cover, region, 3), [0.8, 0.0, 0.2])
    cover[region >= 0] = 0.0
    np.testing.assert_array_equal(region_weights(cover, region, 3), np.zeros(3))


def bent(seed):
    """A random band, shaped like a bent spout or handle."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:60, :80]
    centre = rng.uniform((20.0, 20.0), (60.0, 40.0))
    radius, width = rng.uniform(8.0, 25.0), rng.uniform(1.5, 8.0)
    angle = np.arctan2(y - centre[1], x - centre[0]) - rng.uniform(-np.pi, np.pi)
    inside = np.abs(np.hypot(x - centre[0], y - centre[1]) - radius) < width
    return inside & (np.cos(angle) > rng.uniform(-0.8, 0.8))


@given(st.integers(0, 2**32 - 1))
def test_a_followed_region_is_touched_and_nothing_else(seed):
    inside = bent(seed)
    if not inside.any():
        with pytest.raises(ValueError, match="inside"):
            follow(inside)
        return
    points, radius = follow(inside)
    assert len(points) >= 1
    assert all(inside[int(y), int(x)] for x, y in points)
    cover = stroke(points, radius).coverage(*inside.shape)
    assert cover[inside].max() > 0.0
    assert cover[~inside].max() == 0.0


def test_following_a_single_pixel_and_a_whole_image():
    inside = np.zeros((9, 9), bool)
    inside[4, 6] = True
    points, radius = follow(inside)
    assert points == [(6.5, 4.5)]
    assert stroke(points, radius).coverage(9, 9).sum() == 1.0
    points, radius = follow(np.ones((9, 30), bool))
    assert stroke(points, radius).coverage(9, 30).max() == 1.0
    assert len(points) > 1  # along the longer side
