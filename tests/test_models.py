"""Laws of the closed-form models: reciprocity, energy, finiteness, and known values."""

from __future__ import annotations

import dataclasses
import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from traitbrdf.reflectance.brdf import albedo_of, from_half_diff_angles, hemisphere_nodes
from traitbrdf.reflectance.models import (
    ABC,
    GGX,
    GTR,
    AshikhminShirley,
    Beckmann,
    BlinnPhong,
    BoundedPhong,
    BoundedTorranceSparrow,
    Coated,
    Interference,
    Lambert,
    Model,
    NormalizedPhong,
    OrenNayar,
    PerfectMirror,
    Plastic,
    RetroReflection,
    Scaled,
    Sheen,
    ShiftedGamma,
    Sum,
    TorranceSparrowSimplified,
    Ward,
    fresnel_conductor,
    fresnel_dielectric,
    ggx_distribution,
    parameter_values,
)

MODELS: tuple[type[Model], ...] = (
    Lambert,
    OrenNayar,
    PerfectMirror,
    NormalizedPhong,
    BoundedPhong,
    TorranceSparrowSimplified,
    BoundedTorranceSparrow,
    AshikhminShirley,
    GGX,
    Sheen,
    Plastic,
    BlinnPhong,
    Beckmann,
    GTR,
    ABC,
    ShiftedGamma,
    Ward,
    RetroReflection,
    Interference,
)
RECIPROCAL = [cls for cls in MODELS if cls.reciprocal]
BOUNDED = [cls for cls in MODELS if cls.energy_bounded]

# a grid that resolves lobes of width 1e-4, unlike the nodes of a table
FINE = np.unique(
    np.concatenate(
        [[0.0], np.geomspace(1e-6, 0.05, 60), (np.arange(1, 60) / 59) ** 2 * math.pi / 2]
    )
)


def albedo(model: Model, degrees: float) -> np.ndarray:
    """Directional albedo (3,) of an isotropic model."""
    th, td, pd, weight = hemisphere_nodes(math.radians(degrees), FINE, 3, 32)
    return weight @ model.eval(*from_half_diff_angles(th, td, pd))


def direction(degrees: float, phi: float = 0.0) -> np.ndarray:
    t = math.radians(degrees)
    return np.array([math.sin(t) * math.cos(phi), math.sin(t) * math.sin(phi), math.cos(t)])


def random_directions(rng: np.random.Generator, n: int) -> np.ndarray:
    w = rng.normal(size=(n, 3))
    w[:, 2] = np.abs(w[:, 2])
    return w / np.linalg.norm(w, axis=-1, keepdims=True)


def values_of(parameter):
    """Any legal value of a parameter, log-spaced if the parameter is."""
    if parameter.log:
        low, high = math.log(parameter.low), math.log(parameter.high)
        one = st.floats(low, high).map(
            lambda v: min(max(math.exp(v), parameter.low), parameter.high)
        )
    else:
        one = st.floats(parameter.low, parameter.high, allow_subnormal=False)
    return st.one_of(one, st.tuples(one, one, one)) if parameter.rgb else one


@st.composite
def models(draw, classes=MODELS, isotropic=False) -> Model:
    cls = draw(st.sampled_from(classes))
    values = {p.name: draw(values_of(p)) for p in cls.parameters}
    if isotropic and cls is AshikhminShirley:
        values["n_v"] = values["n_u"]
    return cls(**values)


@pytest.mark.parametrize("cls", MODELS)
def test_parameters_match_the_fields(cls):
    fields = dataclasses.fields(cls)
    assert [f.name for f in fields] == [p.name for p in cls.parameters]
    assert [f.default for f in fields] == [p.default for p in cls.parameters]
    for p in cls.parameters:
        assert p.low <= p.default <= p.high
        assert p.meaning
    assert parameter_values(cls()) == {
        p.name: (p.default,) * 3 if p.rgb else p.default for p in cls.parameters
    }


@pytest.mark.parametrize("cls", MODELS)
def test_documented_with_source(cls):
    assert "Parameters\n" in cls.__doc__
    assert any(c.isdigit() for c in cls.__doc__) or cls is PerfectMirror
    for p in cls.parameters:
        assert p.name in cls.__doc__


@pytest.mark.parametrize("cls", MODELS)
def test_values_are_hashable_comparable_and_picklable(cls):
    model = cls()
    assert model == cls()
    assert hash(model) == hash(cls())
    assert pickle.loads(pickle.dumps(model)) == model  # noqa: S301


@settings(max_examples=150, deadline=None)
@given(models(RECIPROCAL), st.integers(0, 2**32 - 1))
def test_reciprocity(model, seed):
    rng = np.random.default_rng(seed)
    wi, wo = random_directions(rng, 100), random_directions(rng, 100)
    np.testing.assert_allclose(model.eval(wi, wo), model.eval(wo, wi), rtol=1e-7, atol=1e-12)


def test_the_phong_of_the_source_is_not_reciprocal():
    model = NormalizedPhong(1.0, 10.0)
    assert not model.reciprocal
    a, b = direction(60.0), direction(40.0, math.pi)
    assert model.eval(a, b)[0] / model.eval(b, a)[0] == pytest.approx(b[2] / a[2])


def extreme_directions() -> np.ndarray:
    cosines = [1.0, 1e-5, 1e-9, 1e-17, 1e-100, 1e-300, 5e-324, 0.0, -1e-300, -0.5]
    out = []
    for degrees in (0.0, 1e-6, 30.0, 89.99):
        out += [direction(degrees, phi) for phi in (0.0, 1.0, math.pi)]
    for c in cosines:
        s = math.sqrt(1.0 - c * c)
        out += [np.array([s * x, s * y, c]) for x, y in ((1, 0), (-1, 0), (0, 1))]
    return np.array(out)


EXTREME = extreme_directions()


@settings(max_examples=150, deadline=None)
@given(models())
def test_finite_and_not_negative_everywhere(model):
    f = model.eval(EXTREME[:, None], EXTREME)
    assert f.shape == (len(EXTREME), len(EXTREME), 3)
    assert f.dtype == np.float64
    assert np.isfinite(f).all()
    assert (f >= 0.0).all()
    below = EXTREME[:, 2] <= 0.0
    assert not f[below].any()
    assert not f[:, below].any()


@pytest.mark.parametrize("cls", MODELS)
def test_finite_at_the_ends_of_every_range(cls):
    for end in ("low", "high"):
        model = cls(**{p.name: getattr(p, end) for p in cls.parameters})
        f = model.eval(EXTREME[:, None], EXTREME)
        assert np.isfinite(f).all()
        assert (f >= 0.0).all()


@pytest.mark.parametrize("model", [GGX(1e-4), BoundedPhong(1.0, 1e6), NormalizedPhong(1.0, 1e6)])
def test_float32_directions_of_inexact_length_are_accepted(model):
    wi = (direction(30.0) * 1.0005).astype(np.float32)
    wo = (direction(30.0, math.pi) * 1.0005).astype(np.float32)
    exact = model.eval(direction(30.0), direction(30.0, math.pi))
    np.testing.assert_allclose(model.eval(wi, wo), exact, rtol=1e-3)


@settings(max_examples=150, deadline=None)
@given(models(BOUNDED, isotropic=True), st.integers(0, 80))
def test_bounded_models_do_not_make_energy(model, degrees):
    assert (albedo(model, degrees) + model.mirror <= model.albedo_bound + 1e-3).all()
    assert (model.albedo_bound <= 1.0).all()


@pytest.mark.parametrize("degrees", [0.0, 40.0, 70.0, 80.0, 89.0])
def test_energy_of_the_brightest_settings(degrees):
    bright = [
        OrenNayar(1.0, 0.23),
        OrenNayar(1.0, 0.1),
        Sheen(1.0, 0.25),
        BoundedPhong(1.0, 1e4),
        BoundedTorranceSparrow(1.0, 0.01),
        AshikhminShirley(1.0, 0.0, 1e4, 1e4),
        AshikhminShirley(1.0, 0.5, 10.0, 10.0),
        AshikhminShirley(1.0, 1.0, 1e5, 1e5),
        Plastic(1.0, 0.5, 1.01),
        Plastic(1.0, 0.005, 1.2),
        Coated(GGX(0.05, 0.05, 12.0), 0.3, 1.05),
        Coated(BoundedTorranceSparrow(1.0, 0.05), 1.0, 1.1),
        Coated(OrenNayar(1.0, 0.2), 0.1, 1.3),
    ]
    for model in bright:
        assert model.energy_bounded
        assert albedo(model, degrees).max() <= 1.0 + 1e-3, model


def test_anisotropic_lobe_does_not_make_energy():
    mu, w = np.polynomial.legendre.leggauss(100)
    mu, w = 0.5 * (mu + 1.0), 0.5 * w
    phi = np.arange(128) * (2 * math.pi / 128)
    s = np.sqrt(1.0 - mu * mu)[:, None]
    z = np.broadcast_to(mu[:, None], (100, 128))
    wi = np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1)
    weight = np.broadcast_to((w * mu)[:, None] * (2 * math.pi / 128), (100, 128))
    for n_u, n_v in ((1.0, 100.0), (30.0, 5.0)):
        model = AshikhminShirley(1.0, 0.6, n_u, n_v)
        for view_phi in (0.0, 0.7, math.pi / 2):
            f = model.eval(wi, direction(60.0, view_phi))
            assert np.einsum("ij,ijc->c", weight, f).max() <= 1.0 + 1e-3


def test_known_weaknesses_of_the_source():
    phong = NormalizedPhong(1.0, 10.0)
    assert not phong.energy_bounded
    # the reflected share of light from 89 degrees; the albedo by view stays below 1
    leaving = albedo_of(lambda wi, wo: phong.eval(wo, wi), math.radians(89.0))
    np.testing.assert_allclose(leaving, 6.93, atol=0.01)
    assert albedo(phong, 89.0).max() < 1.0
    torrance_sparrow = TorranceSparrowSimplified(1.0, 0.2)
    assert not torrance_sparrow.energy_bounded
    np.testing.assert_allclose(
        albedo_of(torrance_sparrow.eval, math.radians(89.0)), 3.67, atol=0.01
    )
    assert np.isinf(phong.albedo_bound).all()


def test_bounded_twins_keep_the_peak():
    wi, wo = direction(35.0), direction(35.0, math.pi)
    np.testing.assert_allclose(
        BoundedPhong(0.4, 30.0).eval(wi, wo), NormalizedPhong(0.4, 30.0).eval(wi, wo)
    )
    np.testing.assert_allclose(
        BoundedTorranceSparrow(0.4, 0.1).eval(wi, wo),
        TorranceSparrowSimplified(0.4, 0.1).eval(wi, wo),
    )


def test_torrance_sparrow_by_hand():
    wi, wo = direction(20.0), direction(40.0, math.pi)
    s = math.exp(-((math.radians(10.0) / 0.2) ** 2)) / (math.pi * 0.04)
    expected = 0.5 * s / (4.0 * wi[2] * wo[2])
    np.testing.assert_allclose(TorranceSparrowSimplified(0.5, 0.2).eval(wi, wo), expected)


def test_oren_nayar_by_hand():
    np.testing.assert_allclose(
        OrenNayar(0.6, 0.0).eval(direction(50), direction(20)), 0.6 / math.pi
    )
    wi, wo = direction(60.0, 0.5), direction(30.0)
    a, b = 1.0 - 0.5 * 0.25 / 0.58, 0.45 * 0.25 / 0.34
    alpha, beta = math.radians(60.0), math.radians(30.0)
    expected = 0.6 / math.pi * (a + b * math.cos(0.5) * math.sin(alpha) * math.tan(beta))
    np.testing.assert_allclose(OrenNayar(0.6, 0.5).eval(wi, wo), expected)


@pytest.mark.parametrize("alpha", [0.001, 0.05, 0.3, 1.0])
def test_ggx_distribution_is_normalised(alpha):
    # theta = alpha tan(u) spreads the peak over the nodes
    x, w = np.polynomial.legendre.leggauss(100)
    top = math.atan(math.pi / 2 / alpha)
    u = 0.5 * top * (x + 1.0)
    theta = alpha * np.tan(u)
    d_theta = 0.5 * top * w * alpha / np.cos(u) ** 2
    h = np.stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)], axis=-1)
    d = ggx_distribution(h, alpha)
    total = np.sum(d * np.cos(theta) * np.sin(theta) * d_theta) * 2.0 * math.pi
    assert total == pytest.approx(1.0, abs=1e-6)


def test_ggx_white_furnace():
    # eta = 0.05, k = 12 is a metal that reflects 99.86 %
    for degrees in (0.0, 45.0, 75.0):
        for alpha in (0.001, 0.1, 0.5, 1.0):
            assert albedo(GGX(alpha, 0.05, 12.0), degrees).max() <= 1.0
        assert albedo(GGX(0.002, 0.05, 12.0), degrees).min() > 0.99
    # single scattering only, as documented
    assert albedo(GGX(1.0, 0.05, 12.0), 0.0)[0] == pytest.approx(0.31, abs=0.01)


LOBES = (BlinnPhong, Beckmann, GTR, ABC, ShiftedGamma)


@settings(max_examples=60, deadline=None)
@given(models(LOBES))
def test_densities_of_half_vectors_integrate_to_one(lobe):
    """Integrated by a different rule from the one that computes their norm."""
    theta = np.concatenate([[0.0], np.geomspace(1e-7, 0.5 * math.pi, 40_001)])
    density = lobe.density(theta)
    # the solid angles are exact; the density is averaged over both ends of each
    steps = 2.0 * math.pi * -np.diff(np.cos(theta))
    steps[theta[1:] < 1e-3] = math.pi * np.diff(theta**2)[theta[1:] < 1e-3]
    assert (0.5 * (density[1:] + density[:-1])) @ steps == pytest.approx(1.0, rel=2e-4)


def test_lobes_of_known_norms_and_limits():
    n = 40.0
    wi, wo = direction(50.0), direction(20.0, 2.0)
    half = (wi + wo) / np.linalg.norm(wi + wo)
    frame = 4.0 * (half @ wi) * max(wi[2], wo[2])
    fresnel = 0.2 + 0.8 * (1.0 - half @ wi) ** 5
    expected = 0.5 * fresnel * (n + 1.0) / (2.0 * math.pi) * half[2] ** n / frame
    assert BlinnPhong(0.5, 0.2, n).eval(wi, wo)[0] == pytest.approx(expected, rel=1e-6)
    same = AshikhminShirley(r_d=0.0, r_s=0.2, n_u=n, n_v=n)
    assert 0.5 * same.eval(wi, wo)[0] == pytest.approx(expected, rel=1e-6)
    # narrow lobes are densities of facets: D cos(theta_h) = P
    alpha = 0.02
    wi, wo = direction(31.0), direction(30.0, math.pi)
    half = (wi + wo) / np.linalg.norm(wi + wo)
    frame = 4.0 * (half @ wi) * max(wi[2], wo[2])
    ggx = ggx_distribution(half, alpha) / frame
    assert GTR(1.0, 1.0, alpha, 2.0).eval(wi, wo)[0] == pytest.approx(ggx, rel=2e-3)
    beckmann = Beckmann(1.0, 1.0, alpha).eval(wi, wo)[0]
    assert Ward(1.0, alpha).eval(wi, wo)[0] == pytest.approx(beckmann, rel=0.02)
    assert ShiftedGamma(1.0, 1.0, 0.04, 0.0).eval(wi, wo)[0] == pytest.approx(
        Beckmann(1.0, 1.0, 0.2).eval(wi, wo)[0], rel=1e-9
    )


def test_tails_are_as_heavy_as_their_parameter_says():
    def fall(lobe):
        peak = lobe.eval(direction(30.0), direction(30.0, math.pi))[0]
        return lobe.eval(direction(10.0), direction(50.0, math.pi))[0] / peak

    falls = [fall(GTR(0.5, 1.0, 0.05, gamma)) for gamma in (1.0, 1.5, 2.0, 4.0)]
    assert sorted(falls, reverse=True) == falls
    assert falls[0] > 40.0 * falls[2] > 0.0
    assert fall(ABC(0.5, 1.0, 800.0, 0.7)) > 30.0 * fall(Beckmann(0.5, 1.0, 0.05))


def test_fringes_turn_with_the_angle():
    film = Interference(0.8, 0.3, 400.0, 1.6, 1.0)
    for degrees in (0.0, 30.0, 60.0):
        wi, wo = direction(degrees), direction(degrees, math.pi)
        inside = math.sqrt(1.0 - (math.sin(math.radians(degrees)) / 1.6) ** 2)
        phase = 4.0 * math.pi * 1.6 * 400.0 * inside / np.array([650.0, 550.0, 450.0])
        plain = Interference(0.8, 0.3, 0.0, 1.6, 1.0).eval(wi, wo)
        np.testing.assert_allclose(film.eval(wi, wo), plain * 0.5 * (1.0 + np.cos(phase)))


def test_retro_reflection_goes_back():
    model = RetroReflection(0.4, 200.0)
    wi = direction(50.0)
    peak = model.eval(wi, wi)[0]
    assert peak == pytest.approx(0.4 * 201.0 / (2.0 * math.pi) / wi[2])
    assert model.eval(wi, direction(50.0, math.pi))[0] < 1e-6 * peak
    assert albedo(model, 0.0) == pytest.approx(0.4, rel=0.01)


def test_fresnel_known_values():
    assert fresnel_dielectric(1.0, 1.5) == pytest.approx(0.04)
    assert fresnel_dielectric(0.0, 1.5) == pytest.approx(1.0)
    assert fresnel_dielectric(0.3, 1.0) == pytest.approx(0.0, abs=1e-15)
    brewster = math.cos(math.atan(1.5))
    # only r_s is left at Brewster's angle: ((eta^2 - 1)/(eta^2 + 1))^2 / 2
    assert fresnel_dielectric(brewster, 1.5) == pytest.approx(0.5 * (1.25 / 3.25) ** 2)
    assert fresnel_dielectric(0.5, 1.0 / 1.5) == 1.0  # beyond the critical angle
    normal = ((0.2 - 1.0) ** 2 + 9.0) / ((0.2 + 1.0) ** 2 + 9.0)
    assert fresnel_conductor(1.0, 0.2, 3.0) == pytest.approx(normal)


def test_fresnel_conductor_without_extinction_is_the_dielectric():
    cos = np.concatenate([np.linspace(0.0, 1.0, 201), np.geomspace(1e-12, 1e-3, 20)])[:, None]
    eta = np.array([0.3, 0.7, 1.0, 1.33, 1.5, 3.0])
    np.testing.assert_allclose(
        fresnel_conductor(cos, eta, 0.0), fresnel_dielectric(cos, eta), rtol=1e-9, atol=1e-12
    )


def test_ashikhmin_shirley_turned_by_90_degrees_swaps_the_exponents():
    rng = np.random.default_rng(3)
    wi, wo = random_directions(rng, 500), random_directions(rng, 500)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    a = AshikhminShirley(0.3, 0.2, 10.0, 300.0).eval(wi, wo)
    b = AshikhminShirley(0.3, 0.2, 300.0, 10.0).eval(wi @ turn.T, wo @ turn.T)
    np.testing.assert_allclose(a, b, rtol=1e-9)
    assert not np.allclose(a, AshikhminShirley(0.3, 0.2, 300.0, 10.0).eval(wi, wo))


@pytest.mark.parametrize("cls", MODELS)
def test_isotropic_and_mirror_symmetric(cls):
    rng = np.random.default_rng(4)
    wi, wo = random_directions(rng, 200), random_directions(rng, 200)
    c, s = math.cos(0.8), math.sin(0.8)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    flip = np.array([1.0, -1.0, 1.0])
    f = cls().eval(wi, wo)
    np.testing.assert_allclose(f, cls().eval(wi @ turn.T, wo @ turn.T), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(f, cls().eval(wi * flip, wo * flip), rtol=1e-12)


def test_ashikhmin_shirley_peak_by_hand():
    wi, wo = direction(30.0), direction(30.0, math.pi)
    c, r_s = math.cos(math.radians(30.0)), 0.1
    fresnel = r_s + 0.9 * (1.0 - c) ** 5
    specular = math.sqrt(11.0 * 41.0) / (8.0 * math.pi) * fresnel / (c * c)
    diffuse = 28 * 0.4 / (23 * math.pi) * 0.9 * (1.0 - (1.0 - c / 2) ** 5) ** 2
    f = AshikhminShirley(0.4, r_s, 10.0, 40.0).eval(wi, wo)
    np.testing.assert_allclose(f, specular + diffuse)


def test_plastic_is_a_coat_over_lambert():
    rng = np.random.default_rng(5)
    wi, wo = random_directions(rng, 50), random_directions(rng, 50)
    f = Plastic((0.1, 0.5, 0.9), 0.2, 1.4).eval(wi, wo)
    np.testing.assert_array_equal(f, Coated(Lambert((0.1, 0.5, 0.9)), 0.2, 1.4).eval(wi, wo))
    through = np.outer(
        (1 - fresnel_dielectric(wi[:, 2], 1.4)) * (1 - fresnel_dielectric(wo[:, 2], 1.4)),
        np.array([0.1, 0.5, 0.9]) / math.pi,
    )
    np.testing.assert_allclose(f, GGX(0.2, 1.4).eval(wi, wo) + through)


def test_sums_and_weights():
    rng = np.random.default_rng(6)
    wi, wo = random_directions(rng, 50), random_directions(rng, 50)
    a, b, c = Lambert((0.1, 0.2, 0.3)), GGX(0.2), PerfectMirror(0.25)
    total = a + b + c
    assert isinstance(total, Sum)
    assert total.parts == (a, b, c)
    np.testing.assert_allclose(total.eval(wi, wo), a.eval(wi, wo) + b.eval(wi, wo))
    np.testing.assert_allclose(total.mirror, 0.25)
    np.testing.assert_allclose((2 * total).mirror, 0.5)
    tint = np.array([1.0, 0.5, 0.0])
    for tinted in (tint * a, a * tint, a * (1.0, 0.5, 0.0)):
        assert isinstance(tinted, Scaled)
        np.testing.assert_allclose(tinted.eval(wi, wo), a.eval(wi, wo) * tint)
    np.testing.assert_allclose((tint * a).albedo_bound, [0.1, 0.1, 0.0])
    with pytest.raises(TypeError):
        a + 1  # type: ignore[operator]
    with pytest.raises(TypeError):
        a * "red"  # type: ignore[operator]


def test_flags_of_sums():
    assert (Lambert(0.5) + BoundedPhong(0.5)).energy_bounded
    assert not (Lambert(0.6) + BoundedPhong(0.5)).energy_bounded
    assert (0.3 * Plastic(0.5) + 0.7 * Lambert(1.0)).energy_bounded
    assert not (2 * Plastic(0.5)).energy_bounded
    assert not (Lambert(0.1) + NormalizedPhong(0.1)).reciprocal
    assert not (0.5 * NormalizedPhong(0.1)).energy_bounded
    assert not Coated(NormalizedPhong(0.1)).reciprocal


@pytest.mark.parametrize("cls", MODELS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -0.5, 1e9, "0.5", None, (0.1, 0.2)])
def test_bad_parameters_raise(cls, bad):
    for p in cls.parameters:
        with pytest.raises(ValueError, match=rf"{p.name}: expected .* got"):
            cls(**{p.name: bad})
        if not p.rgb:
            with pytest.raises(ValueError, match=p.name):
                cls(**{p.name: (p.default,) * 3})


def test_bad_compositions_raise():
    with pytest.raises(ValueError, match="weight"):
        -1.0 * Lambert()
    with pytest.raises(ValueError, match="weight"):
        Lambert() * np.array([1.0, math.nan, 1.0])
    with pytest.raises(ValueError, match="parts"):
        Sum(())
    with pytest.raises(ValueError, match="base"):
        Coated(PerfectMirror())
    with pytest.raises(ValueError, match="model"):
        Scaled(3.0, 1.0)  # type: ignore[arg-type]


def test_bad_directions_raise():
    with pytest.raises(ValueError, match="wo"):
        Lambert().eval([0.0, 0.0, 1.0], [0.0, 0.0, 2.0])


def test_directions_broadcast_and_a_single_pair_works():
    one = direction(10.0)
    assert GGX().eval(one, one).shape == (3,)
    assert Plastic().eval(np.tile(one, (4, 1, 1)), np.tile(one, (5, 1))).shape == (4, 5, 3)
