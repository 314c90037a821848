"""Laws of the direction changes of variables, and the conventions they state."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from traitbrdf.directions import (
    as_directions,
    direction_to_latlong,
    fold_phi_d,
    from_half_diff_angles,
    half_diff_angles,
    latlong_to_direction,
    reflect,
    shading_frame,
    to_local,
    to_world,
)

angles = st.floats(-math.pi, math.pi)
polar = st.floats(0.0, math.pi / 2)


def direction(theta, phi):
    return np.array(
        [math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)]
    )


sphere = st.builds(direction, st.floats(0.0, math.pi), angles)
upper = st.builds(direction, st.floats(0.0, math.pi / 2), angles)


def turn(a, b):
    """The angle between two azimuths."""
    return np.abs((np.asarray(a) - b + math.pi) % (2 * math.pi) - math.pi)


# ---------------------------------------------------------------------------------------------
# half/difference angles


@given(st.one_of(polar, st.floats(1e-12, 1e-6)), st.floats(0.0, 1.57), angles, angles)
@settings(deadline=None)
def test_half_difference_angles_round_trip(theta_h, theta_d, phi_d, phi_h):
    wi, wo = from_half_diff_angles(theta_h, theta_d, phi_d, phi_h)
    np.testing.assert_allclose([wi @ wi, wo @ wo], 1.0, atol=1e-14)
    th, td, pd = half_diff_angles(wi, wo)
    # wi + wo is short at large theta_d, which costs digits
    assert abs(th - theta_h) < 1e-15 / math.cos(theta_d) + 1e-15
    assert abs(td - theta_d) < 1e-14
    # an azimuth matters less close to its pole
    assert turn(pd, phi_d) * math.sin(theta_d) * math.sin(theta_h) < 1e-14 / math.cos(theta_d)


@given(sphere, sphere)
@settings(deadline=None)
def test_directions_come_back_from_their_angles(wi, wo):
    total = wi + wo
    if np.linalg.norm(total) < 1e-6:
        return
    again = from_half_diff_angles(*half_diff_angles(wi, wo), np.arctan2(total[1], total[0]))
    np.testing.assert_allclose(again, (wi, wo), atol=1e-9)


@pytest.mark.parametrize("theta_h", [1e-7, 3e-6, 1.9e-4, 0.7])
def test_small_angles_survive_in_float32(theta_h):
    theta_d, phi_d = np.meshgrid(
        np.linspace(0.0, 1.4, 15, dtype=np.float32), np.linspace(-3, 3, 13, dtype=np.float32)
    )
    wi, wo = from_half_diff_angles(np.full_like(theta_d, theta_h), theta_d, phi_d)
    th, td, pd = half_diff_angles(wi, wo)
    for array in (wi, wo, th, td, pd):
        assert array.dtype == np.float32
    np.testing.assert_allclose(th, theta_h, atol=6e-7)
    np.testing.assert_allclose(td, theta_d, atol=6e-7)
    if theta_h < 1e-4:  # the arc cosine cannot resolve it
        h = (wi + wo)[..., 2] / np.linalg.norm(wi + wo, axis=-1)
        assert np.median(np.abs(np.arccos(np.minimum(h, 1)) - theta_h)) >= 0.9 * theta_h


@given(sphere, sphere)
@settings(deadline=None)
def test_swapping_light_and_viewer_turns_phi_d_by_pi(wi, wo):
    th, td, pd = half_diff_angles(wi, wo)
    swapped = half_diff_angles(wo, wi)
    assert swapped[0] == th
    assert swapped[1] == td
    if math.sin(td) > 1e-6 and math.cos(td) > 1e-6:
        assert turn(swapped[2], pd + math.pi) < 1e-9


@given(sphere, sphere, angles)
@settings(deadline=None)
def test_turning_both_about_the_normal_changes_nothing(wi, wo, angle):
    c, s = math.cos(angle), math.sin(angle)
    r = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    th, td, pd = half_diff_angles(wi, wo)
    th2, td2, pd2 = half_diff_angles(r @ wi, r @ wo)
    if math.cos(td) < 1e-5:  # the half vector is nearly undefined
        return
    assert abs(th2 - th) < 1e-9
    assert abs(td2 - td) < 1e-9
    assert turn(pd2, pd) * math.sin(td) * math.sin(th) < 1e-9


def test_opposite_directions_take_the_normal_for_half_vector():
    w = np.array([[0.6, 0.0, 0.8], [1.0, 0.0, 0.0]])
    th, td, _ = half_diff_angles(w, -w)
    np.testing.assert_array_equal(th, 0.0)
    np.testing.assert_allclose(td, math.pi / 2)


def test_phi_d_is_zero_where_the_light_is_lower_than_the_half_vector():
    wi, wo = from_half_diff_angles(0.3, 0.5, 0.0)
    assert wi[2] < wo[2]
    np.testing.assert_allclose(wi, direction(0.8, 0.0), atol=1e-15)
    np.testing.assert_allclose(wo, direction(-0.2, 0.0), atol=1e-15)


def test_angles_broadcast():
    wi, wo = from_half_diff_angles(np.zeros((4, 1)), np.zeros(3), 1, 2)
    assert wi.shape == wo.shape == (4, 3, 3)
    assert from_half_diff_angles(1, 0, 0)[0].dtype == np.float64
    assert all(a.shape == (4, 3) for a in half_diff_angles(wi, wo))


@given(st.floats(-10.0, 10.0))
@settings(deadline=None)
def test_fold_has_the_symmetries(phi):
    folded = fold_phi_d(np.array([phi, -phi, phi + math.pi, math.pi - phi]))
    assert np.all((folded >= 0.0) & (folded <= math.pi / 2))
    np.testing.assert_allclose(folded, folded[0], atol=1e-14)
    if 0.0 <= phi <= math.pi / 2:
        assert folded[0] == phi


# ---------------------------------------------------------------------------------------------
# frames and mirrors

POLES = [
    (0.0, 0.0, 1.0),
    (0.0, 0.0, -1.0),
    (0.0, -0.0, -1.0),
    (1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (1.0, 0.0, -0.0),
    (1e-9, 0.0, -1.0),
    (0.0, -1e-160, -1.0),
]


def check_frame(n):
    tangent, bitangent = shading_frame(n)
    frame = np.stack([tangent, bitangent, n])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(frame), 1.0, atol=1e-14)


@given(sphere)
@settings(deadline=None)
def test_shading_frames_are_right_handed(n):
    check_frame(n)


@pytest.mark.parametrize("n", POLES)
def test_shading_frames_at_the_poles(n):
    check_frame(np.array(n))


@given(sphere, sphere)
@settings(deadline=None)
def test_local_and_world_are_inverse(w, n):
    local = to_local(w, n)
    np.testing.assert_allclose(to_world(local, n), w, atol=1e-14)
    np.testing.assert_allclose(local[2], w @ n, atol=1e-15)
    np.testing.assert_allclose(to_local(n, n), (0, 0, 1), atol=1e-14)


def test_frames_keep_float32():
    n = np.array(POLES, np.float32)
    for array in (*shading_frame(n), to_local(n, n), to_world(n, n), reflect(n, n)):
        assert array.dtype == np.float32


@given(sphere, sphere)
@settings(deadline=None)
def test_reflect_is_an_involution_that_keeps_the_angle(w, n):
    m = reflect(w, n)
    np.testing.assert_allclose(m @ m, 1.0, atol=1e-14)
    np.testing.assert_allclose(m @ n, w @ n, atol=1e-14)
    np.testing.assert_allclose(reflect(m, n), w, atol=1e-14)


@given(upper)
@settings(deadline=None)
def test_mirror_pairs_have_theta_h_zero(w):
    th, td, _ = half_diff_angles(w, reflect(w, np.array([0.0, 0.0, 1.0])))
    assert th == 0.0
    assert abs(td - math.atan2(math.hypot(w[0], w[1]), w[2])) < 1e-15


# ---------------------------------------------------------------------------------------------
# the lat-long sphere


@pytest.mark.parametrize(
    ("u", "v", "expected"),
    [
        (0.5, 0.5, (0, 0, -1)),  # the centre
        (0.75, 0.5, (1, 0, 0)),  # right of it
        (0.25, 0.5, (-1, 0, 0)),
        (0.0, 0.5, (0, 0, 1)),
        (1.0, 0.5, (0, 0, 1)),
        (0.3, 0.0, (0, 1, 0)),  # the top
        (0.3, 1.0, (0, -1, 0)),
    ],
)
def test_latlong_convention(u, v, expected):
    np.testing.assert_allclose(latlong_to_direction(u, v), expected, atol=1e-15)


def test_latlong_is_the_mapping_of_the_source():
    u, v = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 7))
    theta, phi = math.pi * (1.0 - v), 2.0 * math.pi * u  # theta counts from -y
    source = np.stack(
        [-np.sin(theta) * np.sin(phi), -np.cos(theta), np.sin(theta) * np.cos(phi)], axis=-1
    )
    np.testing.assert_allclose(latlong_to_direction(u, v), source, atol=1e-15)
    w = source[1:-1, 1:-1]
    back_u, back_v = direction_to_latlong(w)
    np.testing.assert_allclose(back_v, 1.0 - np.arccos(-w[..., 1]) / math.pi, atol=1e-14)
    phi_of_source = np.arctan2(w[..., 0], -w[..., 2]) + math.pi
    np.testing.assert_allclose(back_u, phi_of_source / (2 * math.pi), atol=1e-14)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
@settings(deadline=None)
def test_latlong_round_trip(u, v):
    w = latlong_to_direction(u, v)
    np.testing.assert_allclose(w @ w, 1.0, atol=1e-14)
    u2, v2 = direction_to_latlong(w)
    assert 0.0 <= u2 <= 1.0
    assert 0.0 <= v2 <= 1.0
    assert abs(v2 - v) < 1e-15
    assert turn(2 * math.pi * u2, 2 * math.pi * u) * math.sin(math.pi * v) < 1e-14


@given(sphere)
@settings(deadline=None)
def test_latlong_round_trip_of_directions(w):
    np.testing.assert_allclose(latlong_to_direction(*direction_to_latlong(w)), w, atol=1e-14)


def test_latlong_keeps_float32():
    u, v = direction_to_latlong(np.array([[0.0, 1.0, 0.0], [0.6, 0.0, 0.8]], np.float32))
    assert u.dtype == v.dtype == np.float32


# ---------------------------------------------------------------------------------------------
# checks


def test_as_directions_takes_what_numpy_takes():
    assert as_directions([0, 0, 1], "w").dtype == np.float64
    assert as_directions(np.zeros((0, 3)), "w").shape == (0, 3)
    w = np.array([[0.0, 0.6, 0.8]], np.float32)
    assert as_directions(w, "w") is w


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ((0.0, 1.0), r"w: expected directions of shape \(\.\.\., 3\), got shape \(2,\)"),
        (1.0, r"got shape \(\)"),
        ((0.0, 0.0, 0.0), "expected unit vectors, got lengths from 0 to 0"),
        ((0.0, 0.0, 1.1), "from 1.1"),
        ((math.nan, 0.0, 1.0), "nan"),
        ((math.inf, 0.0, 1.0), "inf"),
        ((1e200, 0.0, 1.0), "unit vectors"),
    ],
)
def test_as_directions_refuses(value, message):
    with pytest.raises(ValueError, match=message):
        as_directions(value, "w")
