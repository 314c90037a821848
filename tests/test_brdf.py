"""Laws of tabulated BRDFs: interpolation, symmetry, energy, and the way to MERL files and back."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from traitbrdf.directions import fold_phi_d, from_half_diff_angles
from traitbrdf.formats.brdfs import write_merl
from traitbrdf.formats.files import FormatError
from traitbrdf.reflectance.brdf import (
    ALBEDO_ANGLES,
    HalfDiffGrid,
    TabulatedBRDF,
    albedo_of,
    albedo_operator,
    hemisphere_nodes,
)
from traitbrdf.reflectance.models import GGX, BoundedPhong, Lambert, PerfectMirror, Sheen

HALF_PI = math.pi / 2
FOLDED = HalfDiffGrid(9, 7, 5)
MERL_LIKE = HalfDiffGrid(9, 7, 10, "merl")
GRIDS = [FOLDED, MERL_LIKE, HalfDiffGrid(2, 2, 2), HalfDiffGrid(2, 2, 2, "merl")]
both = pytest.mark.parametrize("grid", GRIDS, ids=str)


def random_table(grid, seed=0, dtype=np.float64):
    values = np.random.default_rng(seed).random((*grid.shape, 3)).astype(dtype)
    values[:, 0] = values[:, 0, :1]  # wi = wo has no phi_d
    return TabulatedBRDF(grid, values)


def hemisphere(theta, phi):
    return np.array(
        [math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)]
    )


upper = st.builds(hemisphere, st.floats(0.0, 1.57), st.floats(-math.pi, math.pi))
half_circle = st.floats(0.0, HALF_PI)
azimuth = st.floats(-7.0, 7.0)


# ---------------------------------------------------------------------------------------------
# grids


def test_merl_nodes_are_lower_edges_of_bins():
    grid = HalfDiffGrid.merl()
    assert grid.shape == (90, 90, 180)
    assert grid.size == 90 * 90 * 180
    i = np.arange(90)
    np.testing.assert_allclose(grid.theta_h, (i / 90) ** 2 * HALF_PI, rtol=1e-15)
    np.testing.assert_allclose(grid.theta_d, i / 90 * HALF_PI, rtol=1e-15)
    np.testing.assert_allclose(grid.phi_d, np.arange(180) / 180 * math.pi, rtol=1e-15)
    assert 1.9e-4 < grid.theta_h[1] < 2e-4


def test_folded_nodes_reach_both_ends():
    grid = HalfDiffGrid(5, 3, 4)
    np.testing.assert_allclose(grid.theta_h, (np.arange(5) / 4) ** 2 * HALF_PI)
    np.testing.assert_allclose(grid.theta_d, [0.0, HALF_PI / 2, HALF_PI])
    np.testing.assert_allclose(grid.phi_d, np.arange(4) / 3 * HALF_PI)


@pytest.mark.parametrize("bad", [1, 0, -3, 2.0, "9", None])
@pytest.mark.parametrize("at", range(3))
def test_grids_refuse_bad_counts(bad, at):
    counts = [4, 4, 4]
    counts[at] = bad
    with pytest.raises(ValueError, match="expected a whole number of at least 2, got"):
        HalfDiffGrid(*counts)


def test_grids_refuse_unknown_layouts():
    with pytest.raises(ValueError, match="layout: expected 'merl' or 'folded', got 'brdf'"):
        HalfDiffGrid(4, 4, 4, "brdf")


@both
@given(half_circle, half_circle, azimuth)
@settings(deadline=None)
def test_stencil_weights_sum_to_one(grid, th, td, pd):
    index, weight = grid.stencil(th, td, pd)
    assert index.shape == weight.shape == (8,)
    assert np.all((index >= 0) & (index < grid.size))
    assert np.all((weight >= 0.0) & (weight <= 1.0))
    assert abs(weight.sum() - 1.0) < 1e-14


@both
def test_stencil_reproduces_node_values(grid):
    index, weight = grid.stencil(*grid.node_angles())
    own = np.arange(grid.size).reshape(grid.shape)
    at_own = np.sum(weight * (index == own[..., None]), axis=-1)
    np.testing.assert_allclose(at_own, 1.0, atol=1e-12)


@both
@given(half_circle, half_circle, azimuth)
@settings(deadline=None)
def test_stencil_reproduces_linear_functions(grid, th, td, pd):
    # a MERL table is clamped between the last node and the end of an axis
    ah, ad = min(th, grid.theta_h[-1]), min(td, grid.theta_d[-1])
    nodes = grid.node_angles()
    index, weight = grid.stencil(th, td, pd)
    plane = (2.0 + 0.3 * nodes[0] - 0.7 * nodes[1]).ravel()
    assert abs(weight @ plane[index] - (2.0 + 0.3 * ah - 0.7 * ad)) < 1e-12
    if grid.layout == "folded":
        assert abs(weight @ nodes[2].ravel()[index] - fold_phi_d(pd)) < 1e-12
    elif math.fmod(pd + 8 * math.pi, math.pi) <= grid.phi_d[-1]:
        value = weight @ nodes[2].ravel()[index]
        assert abs((value - pd + 1) % math.pi - 1) < 1e-12


@both
@given(half_circle, half_circle, azimuth)
@settings(deadline=None)
def test_tables_have_period_pi_in_phi_d(grid, th, td, pd):
    flat = random_table(grid).values.reshape(-1, 3)

    def value(phi):
        index, weight = grid.stencil(th, td, phi)
        return weight @ flat[index]

    np.testing.assert_allclose(value(pd + math.pi), value(pd), atol=1e-11)
    if grid.layout == "folded":
        np.testing.assert_allclose(value(-pd), value(pd), atol=1e-11)


@both
def test_node_directions_lie_above_the_horizon(grid):
    wi, wo = grid.node_directions()
    assert min(wi[..., 2].min(), wo[..., 2].min()) > 0.01 - 1e-12
    th, td, pd = grid.node_angles()
    exact = np.stack(from_half_diff_angles(th, td, pd))
    inside = exact[..., 2].min(axis=0) > 0.011
    np.testing.assert_allclose(np.stack([wi, wo])[:, inside], exact[:, inside], atol=1e-12)
    np.testing.assert_array_equal(grid.above_horizon, exact[..., 2].min(axis=0) > 1e-9)


# ---------------------------------------------------------------------------------------------
# eval


@both
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_eval_gives_the_node_values(grid, dtype):
    brdf = random_table(grid, dtype=dtype)
    inside = grid.above_horizon
    wi, wo = (w[inside] for w in from_half_diff_angles(*grid.node_angles()))
    np.testing.assert_allclose(brdf.eval(wi, wo), brdf.values[inside], atol=1e-7)


@both
@given(upper, upper)
@settings(deadline=None)
def test_eval_is_reciprocal(grid, wi, wo):
    brdf = random_table(grid)
    np.testing.assert_allclose(brdf.eval(wi, wo), brdf.eval(wo, wi), atol=1e-8)


@both
def test_reciprocity_error_of_tables_is_rounding(grid):
    assert random_table(grid).reciprocity_error() < 1e-8


def test_eval_is_zero_below_the_horizon():
    brdf = TabulatedBRDF(FOLDED, np.ones((*FOLDED.shape, 3)))
    up, down = np.array([0.6, 0.0, 0.8]), np.array([0.6, 0.0, -0.8])
    level = np.array([1.0, 0.0, 0.0])
    for wi, wo in ((up, down), (down, up), (down, down), (up, level), (level, up)):
        np.testing.assert_array_equal(brdf.eval(wi, wo), 0.0)
    np.testing.assert_allclose(brdf.eval(up, up), 1.0)


def test_eval_broadcasts_and_checks():
    brdf = random_table(FOLDED)
    w = np.array([0.0, 0.0, 1.0])
    assert brdf.eval(np.broadcast_to(w, (4, 1, 3)), np.broadcast_to(w, (5, 3))).shape == (4, 5, 3)
    with pytest.raises(ValueError, match="wo: expected unit vectors"):
        brdf.eval(w, 2 * w)


def test_the_peak_is_kept():
    model = BoundedPhong(k_s=1.0, s=5000.0)
    grid = HalfDiffGrid(32, 16, 8)
    brdf = TabulatedBRDF.from_model(model, grid, "peak")
    assert brdf.values.dtype == np.float32
    for degrees in (0.0, 12.0, 48.0, 72.0):
        theta_d = grid.theta_d[round(degrees / 6)]
        wi, wo = from_half_diff_angles(0.0, theta_d, 0.3)
        np.testing.assert_allclose(brdf.eval(wi, wo), model.eval(wi, wo), rtol=1e-6)


# ---------------------------------------------------------------------------------------------
# energy


def test_hemisphere_nodes_integrate_the_cosine():
    for theta in (0.0, 5e-324, 1e-310, 1e-12, 0.3, 1.2, 1.57, np.nextafter(HALF_PI, 0)):
        th, td, _, weight = hemisphere_nodes(theta, HalfDiffGrid(90, 2, 2).theta_h)
        assert np.all(weight >= 0.0)
        assert np.isfinite(weight).all()
        assert np.all((td >= 0.0) & (td <= HALF_PI) & (th >= 0.0) & (th <= HALF_PI))
        assert abs(weight.sum() - math.pi) < 1e-4


@pytest.mark.parametrize("grid", [HalfDiffGrid(24, 12, 6), HalfDiffGrid(60, 12, 12, "merl")])
def test_albedo_of_lambert_is_k_d_at_every_angle(grid):
    k_d = (0.8, 0.5, 0.1)
    brdf = TabulatedBRDF.from_model(Lambert(k_d), grid)
    angles = np.radians([0.0, 1e-5, 10, 45, 60, 80, 85, 89, 89.9])
    np.testing.assert_allclose(brdf.albedo(angles), np.broadcast_to(k_d, (9, 3)), rtol=1e-4)
    assert abs(brdf.max_albedo() - 0.8) < 1e-4


def brute_force_albedo(f, theta, n=400):
    """The midpoint rule over the light's angles, a different quadrature from the package's."""
    t, p = np.meshgrid((np.arange(n) + 0.5) / n * HALF_PI, (np.arange(n) + 0.5) / n * math.pi)
    wi = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)
    weight = np.cos(t) * np.sin(t) * (HALF_PI / n) * (math.pi / n) * 2.0
    wo = np.broadcast_to(hemisphere(theta, math.pi), wi.shape)
    return np.einsum("ij,ijc->c", weight, f(wi, wo))


@pytest.mark.parametrize("degrees", [0.0, 35.0, 70.0])
def test_albedo_operator_agrees_with_brute_force(degrees):
    model = GGX(alpha=0.3, eta=(0.2, 1.5, 1.0), k=(3.9, 0.0, 1.0))
    theta = math.radians(degrees)
    brdf = TabulatedBRDF.from_model(model, HalfDiffGrid(40, 20, 9), dtype=np.float64)
    expected = brute_force_albedo(brdf.eval, theta)
    np.testing.assert_allclose(brdf.albedo(theta), expected, rtol=2e-3)
    row = albedo_operator(brdf.grid, theta)
    assert row.shape == (1, brdf.grid.size)
    np.testing.assert_allclose(row @ brdf.values.reshape(-1, 3), [brdf.albedo(theta)])
    np.testing.assert_allclose(
        albedo_of(model.eval, theta), brute_force_albedo(model.eval, theta), rtol=5e-4
    )


@both
@given(st.integers(0, 1000), st.floats(0.0, 5.0), st.floats(0.0, 5.0), st.floats(0.0, 1.5))
@settings(deadline=None, max_examples=8)
def test_albedo_is_linear_in_the_table(grid, seed, a, b, theta):
    first, second = random_table(grid, seed), random_table(grid, seed + 1)
    mixed = TabulatedBRDF(grid, a * first.values + b * second.values)
    expected = a * first.albedo(theta) + b * second.albedo(theta)
    np.testing.assert_allclose(mixed.albedo(theta), expected, rtol=1e-12, atol=1e-12)


def test_the_mirror_counts_as_albedo():
    brdf = TabulatedBRDF.from_model(Lambert(0.25) + PerfectMirror((0.5, 0.25, 0.0)), FOLDED)
    np.testing.assert_array_equal(brdf.mirror, (0.5, 0.25, 0.0))
    np.testing.assert_allclose(brdf.albedo(0.5), (0.75, 0.5, 0.25), rtol=1e-2)


def test_albedo_keeps_the_shape_of_the_angles():
    brdf = random_table(FOLDED)
    assert brdf.albedo(0.1).shape == (3,)
    assert brdf.albedo(np.zeros((2, 4))).shape == (2, 4, 3)
    assert brdf.max_albedo() == brdf.albedo(ALBEDO_ANGLES).max()


@pytest.mark.parametrize("angle", [-0.1, HALF_PI, 2.0, math.nan])
def test_albedo_refuses_angles_off_the_hemisphere(angle):
    with pytest.raises(ValueError, match="theta_o: expected angles in"):
        random_table(FOLDED).albedo(angle)


# ---------------------------------------------------------------------------------------------
# other grids and files


def test_regrid_keeps_shared_nodes():
    fine = HalfDiffGrid(17, 13, 9)  # holds every node of FOLDED
    brdf = random_table(FOLDED)
    again = brdf.regrid(fine)
    np.testing.assert_allclose(again.values[::2, ::2, ::2], brdf.values, rtol=1e-9)
    assert brdf.regrid(HalfDiffGrid(9, 7, 5)) is brdf


@given(st.integers(0, 1000))
@settings(deadline=None, max_examples=10)
def test_regrid_stays_between_the_neighbours(seed):
    brdf = random_table(FOLDED, seed)
    again = brdf.regrid(HalfDiffGrid(23, 11, 30, "merl"))
    assert again.values.min() >= brdf.values.min() * (1 - 1e-9)
    assert again.values.max() <= brdf.values.max() * (1 + 1e-9)


def test_regrid_keeps_the_rest():
    brdf = TabulatedBRDF(FOLDED, np.zeros((*FOLDED.shape, 3), np.float32), (0.1, 0.2, 0.3), "n")
    again = brdf.regrid(MERL_LIKE)
    assert again.name == "n"
    assert again.values.dtype == np.float32
    np.testing.assert_array_equal(again.mirror, brdf.mirror)
    np.testing.assert_allclose(again.values, 0.0, atol=1e-20)


def test_merl_files_keep_values_and_peak(tmp_path):
    model = Lambert((0.3, 0.2, 0.1)) + GGX(alpha=0.02) + Sheen(k_s=0.1)
    brdf = TabulatedBRDF.from_model(model, HalfDiffGrid(46, 16, 7))
    path = tmp_path / "material.binary"
    brdf.write(path)
    again = TabulatedBRDF.read(path)
    assert again.grid == HalfDiffGrid.merl()
    assert again.name == "material"
    angles = np.radians([0.0, 40.0, 70.0])
    np.testing.assert_allclose(again.albedo(angles), brdf.albedo(angles), rtol=2e-5)
    for j in (0, 30, 60):  # theta_d of nodes of both grids
        wi, wo = from_half_diff_angles(0.0, j / 90 * HALF_PI, 0.0)
        np.testing.assert_allclose(again.eval(wi, wo), model.eval(wi, wo), rtol=1e-6)


def test_reading_turns_invalid_cells_to_zero(tmp_path):
    values = np.random.default_rng(0).random((3, 4, 6, 3))
    values[0, 1] = -1.0
    write_merl(tmp_path / "a.binary", values)
    brdf = TabulatedBRDF.read(tmp_path / "a.binary")
    assert brdf.grid == HalfDiffGrid(3, 4, 6, "merl")
    np.testing.assert_array_equal(brdf.values[0, 1], 0.0)
    np.testing.assert_allclose(brdf.values[1], values[1])


def test_reading_refuses_files_that_are_no_table(tmp_path):
    with pytest.raises(FileNotFoundError):
        TabulatedBRDF.read(tmp_path / "none.binary")
    (tmp_path / "thin.binary").write_bytes(struct.pack("<3i", 1, 2, 2) + bytes(24 * 4))
    with pytest.raises(FormatError, match="2 nodes an axis"):
        TabulatedBRDF.read(tmp_path / "thin.binary")


# ---------------------------------------------------------------------------------------------
# checks


def test_tables_keep_their_precision():
    for dtype, kept in ((np.float32, np.float32), (np.float64, np.float64), (int, np.float64)):
        assert TabulatedBRDF(FOLDED, np.ones((*FOLDED.shape, 3), dtype)).values.dtype == kept
    assert "9x7x5 folded" in repr(random_table(FOLDED))


@pytest.mark.parametrize("shape", [(9, 7, 5), (9, 7, 5, 4), (9, 7, 4, 3), (0,)])
def test_tables_refuse_wrong_shapes(shape):
    with pytest.raises(ValueError, match=r"values: expected shape \(9, 7, 5, 3\), got"):
        TabulatedBRDF(FOLDED, np.zeros(shape))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (math.nan, "expected finite numbers, got 1 that are not"),
        (math.inf, "expected finite numbers"),
        (-1e-9, r"expected f >= 0, got a minimum of -1e-09"),
    ],
)
def test_tables_refuse_bad_values(value, message):
    values = np.ones((*FOLDED.shape, 3))
    values[1, 2, 3, 0] = value
    with pytest.raises(ValueError, match=message):
        TabulatedBRDF(FOLDED, values)


@pytest.mark.parametrize(
    "mirror", [(0.0, 0.0), 0.5, (0.0, 0.0, 1.1), (-0.1, 0, 0), (math.nan,) * 3]
)
def test_tables_refuse_bad_mirrors(mirror):
    with pytest.raises(ValueError, match="mirror: expected three weights in"):
        TabulatedBRDF(FOLDED, np.ones((*FOLDED.shape, 3)), mirror)
