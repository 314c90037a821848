"""The reference against closed forms, against finer meshes, and against the laws of light."""

from __future__ import annotations

import math
import types

import finer
import numpy as np
import pytest

from traitbrdf import reference
from traitbrdf.directions import from_half_diff_angles, reflect, to_local
from traitbrdf.reflectance.brdf import HalfDiffGrid, TabulatedBRDF, albedo_of, hemisphere_nodes
from traitbrdf.reflectance.models import (
    GGX,
    AshikhminShirley,
    BoundedPhong,
    BoundedTorranceSparrow,
    Interference,
    Lambert,
    NormalizedPhong,
    OrenNayar,
    PerfectMirror,
    Plastic,
    RetroReflection,
    Sheen,
    TorranceSparrowSimplified,
)
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import DirectionalLight, EnvironmentMap, PointLight, turn_about_y
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import Mesh, sphere

# resolves the sharpest lobe here, of width 0.002, which the nodes of a table do not
FINE = np.unique(np.concatenate([[0.0], np.geomspace(1e-6, 0.05, 60), np.linspace(0.05, 1.57, 60)]))


def points(count, seed=0, min_cos=0.15):
    """Random normals (n, 3), and views whose cosine is uniform from min_cos to 1."""
    rng = np.random.default_rng(seed)
    normals, across = rng.normal(size=(2, count, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    across -= np.sum(across * normals, axis=-1, keepdims=True) * normals
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    cos = rng.uniform(min_cos, 1.0, (count, 1))
    return normals, cos * normals + np.sqrt(1.0 - cos * cos) * across


def random_map(rows=8, seed=0):
    return EnvironmentMap(np.random.default_rng(seed).random((rows, 2 * rows, 3)) ** 6)


def cosine(normals, views):
    return np.sum(normals * views, axis=-1)


# ---------------------------------------------------------------------------------------------
# closed forms


def test_furnace_shows_the_albedo():
    level = np.array([2.0, 1.0, 0.5])
    environment = EnvironmentMap.uniform(level, rows=8)
    normals, views = points(3)
    models = [Lambert((0.9, 0.5, 0.1)), GGX(alpha=0.3), GGX(alpha=0.08, k=3.0), OrenNayar(0.5, 0.6)]
    values, _ = reference.radiance(normals, views, models, environment)
    np.testing.assert_allclose(
        values[:, 0], np.broadcast_to(level * (0.9, 0.5, 0.1), (3, 3)), rtol=1e-4
    )
    for p, theta in enumerate(np.arccos(cosine(normals, views))):
        for b in (1, 2, 3):
            expected = level * albedo_of(models[b].eval, theta)
            np.testing.assert_allclose(values[p, b], expected, rtol=3e-4)


@pytest.mark.parametrize(
    "model",
    [NormalizedPhong(k_s=1.0, s=5000.0), TorranceSparrowSimplified(k_s=1.0, s=0.002)],
    ids=["phong", "torrance-sparrow"],
)
def test_sharp_lobes_in_the_furnace(model):
    environment = EnvironmentMap.uniform(rows=16)
    normals, views = points(3, seed=1, min_cos=0.3)
    values, _ = reference.radiance(normals, views, [model], environment, tolerance=1e-4)
    for p, cos in enumerate(cosine(normals, views)):
        th, td, pd, weight = hemisphere_nodes(math.acos(cos), FINE, per_interval=4, azimuths=64)
        wi, wo = from_half_diff_angles(th, td, pd)
        expected = weight @ model.eval(wi, wo)
        np.testing.assert_allclose(values[p, 0], expected, rtol=1e-4)


def test_sharp_lobe_under_a_map_with_edges():
    """Half the sky is lit: a lobe centred on its edge reflects half of its albedo."""
    image = np.zeros((8, 16, 3))
    image[:, 8:] = 1.0  # from -z over +x to +z
    model = TorranceSparrowSimplified(k_s=1.0, s=0.002)
    normal, view = np.array([[0.0, 1.0, 0.0]]), np.array([[0.0, 0.8, 0.6]])
    half, _ = reference.radiance(normal, view, [model], EnvironmentMap(image))
    whole, _ = reference.radiance(normal, view, [model], EnvironmentMap.uniform(rows=8))
    np.testing.assert_allclose(half, 0.5 * whole, rtol=1e-4)


@pytest.mark.parametrize("name", ["studio", "forest"])
def test_lambert_shows_the_irradiance_of_real_maps(shared_data, name):
    environment = EnvironmentMap.read(shared_data / "envmaps" / f"{name}.exr").rotated(0.7)
    # `irradiance` never cuts a texel at the horizon, so give it smaller texels of the same light
    fine = EnvironmentMap(environment.image.repeat(3, axis=0).repeat(3, axis=1), 0.7)
    normals, views = points(3, seed=2)
    k_d = np.array([0.9, 0.5, 0.1])
    values, error = reference.radiance(normals, views, [Lambert(tuple(k_d))], environment)
    expected = fine.irradiance(normals) * k_d / math.pi
    difference = np.abs(values[:, 0] - expected)
    assert np.all(difference <= 1e-4 * expected.max(axis=-1, keepdims=True))
    np.testing.assert_allclose(values[:, 0], environment.irradiance(normals) * k_d / math.pi, 1e-3)
    assert np.all(error[:, 0].max(-1) <= 1e-4 * values[:, 0].max(-1))


def test_perfect_mirror_shows_the_texel():
    environment = random_map().rotated(0.4)
    normals, views = points(8)
    k_s = (1.0, 0.5, 0.25)
    values, error = reference.radiance(normals, views, [PerfectMirror(k_s)], environment)
    np.testing.assert_allclose(values[:, 0], environment.radiance(reflect(views, normals)) * k_s)
    np.testing.assert_array_equal(error, 0.0)


def test_mirror_adds_to_the_rest():
    environment = random_map()
    normals, views = points(2)
    parts = [Lambert(0.3), PerfectMirror(0.5)]
    values, _ = reference.radiance(normals, views, [*parts, parts[0] + parts[1]], environment)
    np.testing.assert_allclose(values[:, 2], values[:, 0] + values[:, 1])


def test_point_and_directional_lights_are_closed_form():
    normals, views = points(50, seed=3)
    positions = np.random.default_rng(0).random((50, 3))
    lamp = PointLight((2.0, 3.0, 2.0), (40.0, 20.0, 10.0))
    sun = DirectionalLight((1.0, 1.0, 0.5), (3.0, 2.0, 1.0))
    model = GGX(alpha=0.3) + Lambert(0.4)
    for light in (lamp, sun):
        values, error = reference.radiance(
            normals, views, [model], lights=[light], positions=positions
        )
        offset = np.array(lamp.position) - positions
        squared = np.sum(offset**2, axis=-1, keepdims=True)
        toward = offset / np.sqrt(squared) if light is lamp else np.array(sun.direction)
        across = np.array(lamp.intensity) / squared if light is lamp else np.array(sun.irradiance)
        wi, wo = to_local(np.broadcast_to(toward, (50, 3)), normals), to_local(views, normals)
        expected = model.eval(wi, wo) * across * np.maximum(wi[:, 2:], 0.0)
        np.testing.assert_allclose(values[:, 0], expected, rtol=1e-10, atol=1e-14)
        np.testing.assert_array_equal(error, 0.0)
    both, _ = reference.radiance(normals, views, [model], lights=[lamp, sun], positions=positions)
    one, _ = reference.radiance(normals, views, [model], lights=[lamp], positions=positions)
    np.testing.assert_allclose(both, one + values, rtol=1e-12)


def test_point_lights_need_positions():
    normals, views = points(1)
    with pytest.raises(ValueError, match="positions: point lights need"):
        reference.radiance(normals, views, [Lambert()], lights=[PointLight((0, 0, 0))])
    reference.radiance(normals, views, [Lambert()], lights=[DirectionalLight((0, 1, 0))])


# ---------------------------------------------------------------------------------------------
# laws


def test_radiance_is_linear_in_the_light():
    first, second = random_map(seed=1), random_map(seed=2)
    mixed = EnvironmentMap(2.0 * first.image.astype(float) + 0.5 * second.image.astype(float))
    normals, views = points(3, seed=4)
    models = [GGX(alpha=0.1), Lambert(0.5)]
    a, b, c = (reference.radiance(normals, views, models, e)[0] for e in (first, second, mixed))
    np.testing.assert_allclose(c, 2.0 * a + 0.5 * b, rtol=3e-4)


def test_radiance_is_linear_in_the_table():
    grid = HalfDiffGrid(20, 8, 5)
    first = TabulatedBRDF.from_model(GGX(alpha=0.2), grid, dtype=np.float64)
    second = TabulatedBRDF.from_model(Sheen(), grid, dtype=np.float64)
    mixed = TabulatedBRDF(grid, 2.0 * first.values + 3.0 * second.values)
    normals, views = points(2, seed=5)
    values, _ = reference.radiance(normals, views, [first, second, mixed], random_map())
    np.testing.assert_allclose(values[:, 2], 2.0 * values[:, 0] + 3.0 * values[:, 1], rtol=1e-12)


def test_a_table_is_what_its_eval_says():
    """The integrator sums tables in another way than models: the results agree."""
    table = TabulatedBRDF.from_model(Plastic(alpha=0.2), HalfDiffGrid(20, 8, 5))
    other = TabulatedBRDF.from_model(Lambert(0.2), HalfDiffGrid(10, 6, 12, "merl"))
    disguised = types.SimpleNamespace(eval=table.eval, mirror=table.mirror)
    normals, views = points(2, seed=6)
    values, _ = reference.radiance(normals, views, [other, disguised, table], random_map())
    np.testing.assert_allclose(values[:, 1], values[:, 2], rtol=1e-9)
    alone, _ = reference.radiance(normals, views, [other], random_map())
    np.testing.assert_allclose(values[:, :1], alone, rtol=1e-4)


@pytest.mark.parametrize("angle", [0.5, -2.0, 7.0])
def test_rotating_the_map_rotates_the_lookup(angle):
    environment = random_map(seed=3)
    normals, views = points(2, seed=7)
    models = [GGX(alpha=0.1) + PerfectMirror(0.2), Lambert(0.5)]
    turned, _ = reference.radiance(
        turn_about_y(normals, angle), turn_about_y(views, angle), models, environment.rotated(angle)
    )
    still, _ = reference.radiance(normals, views, models, environment)
    np.testing.assert_allclose(turned, still, rtol=1e-6)


def test_no_light_gives_nothing():
    normals, views = points(3)
    models = [Lambert(), GGX(alpha=0.01), TorranceSparrowSimplified(s=0.002), PerfectMirror()]
    black = EnvironmentMap(np.zeros((4, 8, 3)))
    for environment in (black, None):
        values, error = reference.radiance(normals, views, models, environment)
        np.testing.assert_array_equal(values, 0.0)
        np.testing.assert_array_equal(error, 0.0)


def test_light_below_the_horizon_gives_nothing():
    image = np.zeros((8, 16, 3))
    image[4:] = 1.0
    normal, view = np.array([[0.0, 1.0, 0.0]]), np.array([[0.0, 0.6, 0.8]])
    models = [Lambert(), GGX(alpha=0.01), PerfectMirror()]
    values, _ = reference.radiance(normal, view, models, EnvironmentMap(image))
    np.testing.assert_allclose(values, 0.0, atol=1e-14)


def test_light_that_only_grazes_the_surface():
    """The middle of the one lit row is below the horizon, but its upper part is above."""
    image = np.zeros((9, 2, 3))
    image[4] = 1.0  # polar angles from 80 to 100 degrees
    tilt = math.radians(-2.0)
    normal = np.array([[0.0, math.cos(tilt), math.sin(tilt)]])
    values, _ = reference.radiance(normal, normal, [Lambert(1.0)], EnvironmentMap(image))
    t = np.radians(80.0 + 20.0 * (np.arange(2000) + 0.5) / 2000)
    p = 2.0 * math.pi * (np.arange(4000) + 0.5) / 4000
    cos = np.cos(t)[:, None] * normal[0, 1] + np.sin(t)[:, None] * np.cos(p) * normal[0, 2]
    band = np.sum(np.maximum(cos, 0.0) * np.sin(t)[:, None]) * math.radians(0.01)
    expected = band * (2.0 * math.pi / 4000) / math.pi
    np.testing.assert_allclose(values[0, 0], expected, rtol=2e-4)


@pytest.mark.parametrize("row", [0, 7])
def test_texels_at_the_poles_are_not_lost_at_the_horizon(row):
    """A polar texel reaches further from its middle than half of its height."""
    image = np.zeros((8, 16, 3))
    image[row, 3] = 1.0
    environment = EnvironmentMap(image)
    middle = math.pi / 16 if row == 0 else math.pi * 15 / 16
    azimuth = 2.0 * math.pi * 3.5 / 16
    t = middle + math.pi / 2 * (1 if row == 0 else -1) * 1.1  # the middle is below the horizon
    normal = np.array(
        [[-math.sin(t) * math.sin(azimuth), math.cos(t), math.sin(t) * math.cos(azimuth)]]
    )
    values, _ = reference.radiance(normal, normal, [Lambert(1.0)], environment)
    n = 1000
    ts = (np.arange(n) + 0.5) / n * math.pi / 8 + row * math.pi / 8
    ps = 2.0 * math.pi * (3 + (np.arange(n) + 0.5) / n) / 16
    s = np.sin(ts)[:, None]
    w = np.stack(np.broadcast_arrays(-s * np.sin(ps), np.cos(ts)[:, None], s * np.cos(ps)), axis=-1)
    cell = (math.pi / 8 / n) * (2.0 * math.pi / 16 / n)
    expected = np.sum(np.maximum(w @ normal[0], 0.0) * s) * cell / math.pi
    assert expected > 0.0
    np.testing.assert_allclose(values[0, 0], expected, rtol=1e-3)


# ---------------------------------------------------------------------------------------------
# the stated error


def refined(environment, normals, views, models, resolution=0.05):
    evaluate = reference.Evaluator(models)
    texels = reference.Cells.texels(environment.image)
    return np.array(
        [
            reference.integrate(texels, n, v, evaluate, resolution)
            for n, v in zip(normals, views, strict=True)
        ]
    )


@pytest.mark.parametrize("seed", range(3))
def test_stated_error_contains_the_truth(monkeypatch, seed):
    environment = random_map(seed=seed) if seed else EnvironmentMap.sky(rows=16)
    models = [
        Lambert(0.5),
        GGX(alpha=0.02),
        GGX(alpha=0.4),
        NormalizedPhong(s=20.0),
        TabulatedBRDF.from_model(GGX(alpha=0.1) + Lambert(0.2), HalfDiffGrid(40, 16, 7)),
    ]
    normals, views = points(2, seed=seed)
    values, error = reference.radiance(normals, views, models, environment, tolerance=1e-4)
    monkeypatch.setattr(reference, "MAX_CELLS", 10_000_000)
    truth = refined(environment, normals, views, models)
    assert np.all(np.abs(values - truth) <= error)
    assert np.all(error.max(-1) <= 1e-4 * values.max(-1))


def random_brdf(rng):
    """Draw a model or table of any kind; many are sharp."""

    def between(low, high):
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    colour = tuple(rng.random(3))
    kind = rng.integers(13)
    if kind == 11:
        nodes = [int(rng.integers(2, most)) for most in (40, 10, 6)]
        grid = HalfDiffGrid(*nodes, str(rng.choice(["merl", "folded"])))
        values = rng.random((*grid.shape, 3)) ** rng.choice([1, 6])
        values[rng.random(grid.shape) < rng.choice([0.0, 0.3, 0.8])] = 0.0
        values[0] *= between(1.0, 1e4)
        return TabulatedBRDF(grid, values)
    if kind == 12:
        grid = HalfDiffGrid(int(rng.integers(10, 91)), int(rng.integers(4, 20)), 5)
        return TabulatedBRDF.from_model(GGX(between(0.01, 1.0)) + Lambert(0.1), grid)
    model = [
        lambda: GGX(between(1e-3, 1.0), k=float(rng.choice([0.0, 3.0]))),
        lambda: GGX(between(1e-3, 1.0), eta=float(rng.uniform(1.0, 3.0))),
        lambda: NormalizedPhong(colour, between(1.0, 1e5)),
        lambda: BoundedPhong(colour, between(1.0, 1e5)),
        lambda: TorranceSparrowSimplified(colour, between(1e-3, 1.0)),
        lambda: BoundedTorranceSparrow(colour, between(1e-3, 1.0)),
        lambda: Sheen(colour, float(rng.uniform(0.25, 1.0))),
        lambda: OrenNayar(colour, float(rng.uniform(0.0, 1.5))),
        lambda: RetroReflection(colour, between(1.0, 500.0)),
        lambda: AshikhminShirley(n_u=between(1.0, 1e4), n_v=between(1.0, 1e4)),
        lambda: Interference(colour, between(1e-2, 1.0), float(rng.uniform(0.0, 1000.0))),
    ][kind]()
    return model + Lambert(tuple(rng.random(3))) if rng.random() < 0.3 else model


def random_light(rng):
    """Maps of 1 x 1 to 64 x 128: noise, bands, one texel, a sun of up to 1e6; much is black."""
    rows = int(rng.choice([1, 2, 3, 4, 8, 16, 64], p=[0.03, 0.07, 0.1, 0.2, 0.3, 0.2, 0.1]))
    image = rng.random((rows, rows * int(rng.choice([1, 2, 3])), 3)) ** rng.choice([1, 6])
    lit = rng.random(image.shape[:2]) < rng.choice([0.03, 0.15, 1.0], p=[0.5, 0.43, 0.07])
    kind = rng.integers(4)
    if kind == 0:
        lit = np.broadcast_to(lit[:, :1], lit.shape)
    at = rng.integers(rows), rng.integers(image.shape[1])
    if kind == 1:
        lit = np.zeros_like(lit)
        lit[at] = True
    image[~lit] = 0.0
    if kind == 2 or not lit.any():
        image[at] = 10.0 ** rng.uniform(2.0, 6.0)
    return EnvironmentMap(image, rng.uniform(-4.0, 4.0))


def random_view(rng):
    """A point's normal (1, 3) and view (1, 3), one in five within 10 degrees of grazing."""
    normal, across = rng.normal(size=(2, 3))
    normal /= np.linalg.norm(normal)
    across -= across @ normal * normal
    across /= np.linalg.norm(across)
    angle = math.radians(rng.uniform(80.0, 89.9) if rng.random() < 0.2 else rng.uniform(0.0, 80.0))
    return normal[None], (math.cos(angle) * normal + math.sin(angle) * across)[None]


def closed_forms(rng, tolerance):
    """Stated and true errors of cases with a closed form: (kind, error (3,), off (3,))."""
    normal, view = random_view(rng)
    while cosine(normal, view)[0] < 0.15:
        normal, view = random_view(rng)
    colour, level = tuple(rng.random(3)), rng.random(3)
    models = [
        Lambert(colour),
        GGX(float(rng.uniform(0.1, 1.0)), k=3.0),
        BoundedTorranceSparrow(1.0, float(rng.uniform(0.05, 1.0))),
        Sheen(colour, float(rng.uniform(0.25, 1.0))) + PerfectMirror(0.3),
    ]
    angle = math.acos(cosine(normal, view)[0])
    nodes = np.unique(np.concatenate([FINE, np.linspace(0.05, 1.57, 200), [0.5 * math.pi]]))
    th, td, pd, weight = hemisphere_nodes(angle, nodes, per_interval=3, azimuths=64)
    wi, wo = from_half_diff_angles(th, td, pd)
    albedos = np.array(
        [np.array(colour), *(weight @ m.eval(wi, wo) + m.mirror for m in models[1:])]
    )
    uniform = EnvironmentMap.uniform(level, rows=int(rng.integers(1, 5)))
    values, error = reference.radiance(normal, view, models, uniform, tolerance=tolerance)
    true = albedos * uniform.image[0, 0]
    for b in range(4):
        yield "furnace", error[0, b], np.abs(values[0, b] - true[b])
    sun = DirectionalLight(tuple(rng.normal(size=3)), tuple(level))
    values, error = reference.radiance(normal, view, models[:2], lights=[sun])
    w = np.array(sun.direction)[None]
    cos = max(cosine(normal, w)[0], 0.0)
    true = models[1].eval(to_local(w, normal), to_local(view, normal))[0] * cos * level
    yield (
        "sun",
        error[0, 0] + 1e-12,
        np.abs(values[0, 0] - np.array(colour) / math.pi * cos * level),
    )
    yield "sun", error[0, 1] + 1e-12, np.abs(values[0, 1] - true)


def finer_runs(rng, tolerance, monkeypatch):
    """The same for BRDFs at one point, against `finer`, or else a mesh of ten times the cells.

    None stands for a refusal, and NaN for a true value that could not be computed.
    """
    environment = random_light(rng)
    normal, view = random_view(rng)
    brdfs = [random_brdf(rng) for _ in range(3)]
    visible, shadows, cell = None, None, 0.1
    if rng.random() < 0.2:
        axis, bound = rng.normal(size=3), rng.uniform(-0.5, 0.9)
        axis /= np.linalg.norm(axis)
        visible = lambda point, w: w @ axis < bound  # noqa: E731
        shadows = reference.Shadows(visible, cell)
    groups = [[brdf] for brdf in brdfs] if rng.random() < 0.4 else [brdfs]
    results, resolutions = [], []
    integrate = reference.integrate

    def watched(*args):
        resolutions.append(args[4])
        return integrate(*args)

    with monkeypatch.context() as patch:
        patch.setattr(reference, "integrate", watched)
        for group in groups:
            try:
                values, error = reference.radiance(
                    normal, view, group, environment, (), None, tolerance, shadows
                )
            except reference.IntegrationError:
                yield "refused", None, None
                continue
            last = resolutions[-1]
            results += zip(group, values[0], error[0], [last] * len(group), strict=True)
    if not results:
        return
    if visible is None:
        cells = reference.Cells.texels(environment.image)
    else:
        cells = reference.Pieces(environment, cell).seen(0, normal[0], visible)
    n, v = (np.asarray(environment.to_map(w[0]), np.float64) for w in (normal, view))
    allowed = np.array([0.05 * error.max() for _, _, error, _ in results])
    truth = finer.settled(cells, n, v, [brdf for brdf, *_ in results], allowed)
    for (brdf, value, error, last), true in zip(results, truth, strict=True):
        if np.isnan(true).any():
            evaluate = reference.Evaluator([brdf])
            run = integrate(cells, n, v, evaluate, last / 3.3)
            true = np.full(3, np.nan) if run is None else run[0]
        kind = "table" if isinstance(brdf, TabulatedBRDF) else type(brdf).__name__
        yield kind + " in shadow" * (visible is not None), error, np.abs(value - true)


@pytest.mark.slow
def test_stated_error_contains_the_truth_in_a_thousand_cases(monkeypatch):
    """99 % of random cases hold, and no visible error exceeds four times the stated one.

    Errors stated at a quarter of their size would hold in 97 %.
    """
    rng = np.random.default_rng(20)
    cases, refused, unknown, settings = [], 0, 0, 0
    while len(cases) < 1000:
        tolerance = float(rng.choice([1e-2, 1e-3, 1e-4], p=[0.45, 0.4, 0.15]))
        settings += 1
        closed = settings % 4 == 0
        drawn = closed_forms(rng, tolerance) if closed else finer_runs(rng, tolerance, monkeypatch)
        for kind, error, off in drawn:
            if error is None:
                refused += 1
            elif np.isnan(off).any():
                unknown += 1
            else:
                seen = np.maximum(off - 1e-20, 0.0)  # far tails of lobes are not visible
                within, nearly = bool(np.all(off <= error)), bool(np.all(seen <= 4.0 * error))
                cases.append((kind, within, nearly))
    cases = cases[:1000]
    assert settings >= 250
    assert refused < 0.05 * len(cases)
    assert unknown < 0.02 * len(cases)
    outside = sorted(kind for kind, within, _ in cases if not within)
    assert len(outside) <= 0.01 * len(cases), outside
    assert all(nearly for _, _, nearly in cases)


def test_a_grazing_view_meets_the_tolerance(monkeypatch):
    normals, views = points(1, min_cos=0.05)
    cos = 0.06
    across = views[0] - cosine(normals, views) * normals[0]
    views = cos * normals + math.sqrt(1 - cos * cos) * across / np.linalg.norm(across)
    environment, models = random_map(), [GGX(alpha=0.1), Lambert(0.5)]
    values, error = reference.radiance(normals, views, models, environment)
    monkeypatch.setattr(reference, "MAX_CELLS", 10_000_000)
    truth = refined(environment, normals, views, models, 0.08)
    assert np.all(np.abs(values - truth) <= error)


def test_a_looser_tolerance_is_met_and_stated():
    normals, views = points(2, seed=9)
    models = [GGX(alpha=0.05)]
    values, error = reference.radiance(normals, views, models, random_map(), tolerance=1e-2)
    better, _ = reference.radiance(normals, views, models, random_map(), tolerance=1e-4)
    assert np.all(np.abs(values - better) <= error)
    assert np.all(error.max(-1) <= 1e-2 * values.max(-1))


def test_refuses_rather_than_lies(monkeypatch):
    normals, views = points(2)
    monkeypatch.setattr(reference, "MAX_CELLS", 500)
    with pytest.raises(reference.IntegrationError, match="point 0: more than 500 cells needed"):
        reference.radiance(normals, views, [GGX(alpha=0.01)], random_map())


def test_refuses_what_no_mesh_resolves(monkeypatch):
    """Integrating a reflectance that is noise never converges: it ends with an error."""
    monkeypatch.setattr(reference, "MAX_CELLS", 40_000)
    rng = np.random.default_rng(0)
    noise = types.SimpleNamespace(eval=lambda wi, wo: rng.random(wi.shape), mirror=np.zeros(3))
    normals, views = points(1)
    with pytest.raises(reference.IntegrationError):
        reference.radiance(normals, views, [noise], random_map(), tolerance=1e-5)


# ---------------------------------------------------------------------------------------------
# shadows


def over_the_ground(environment=None, lights=(), radius=1.0, **settings):
    """A sphere that lies on the ground, seen from above."""
    settings = {"size": 20, "camera": Camera.orbit(30.0, 25.0, zoom=0.6)} | settings
    light = EnvironmentMap(np.zeros((2, 4, 3))) if environment is None else environment
    return Scene(sphere(radius), light, lights, ground=True, **settings)


def beside_a_wall(environment=None, scale=1.0, **settings):
    """A floor of 6 x 4 at the foot of a wall 2 high, seen from the front."""
    low, high = [[-3, 0, 0], [3, 0, 0], [3, 0, 4], [-3, 0, 4]], [[3, 2, 0], [-3, 2, 0]]
    shape = Mesh(
        scale * np.array([*low, *low[:2], *high], np.float64),
        [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]],
        [[0, 1, 0]] * 4 + [[0, 0, 1]] * 4,
        [0, 0, 1, 1],
        ("floor", "wall"),
    )
    settings = {"size": 20, "camera": Camera.orbit(0.0, 35.0, zoom=2.0)} | settings
    return Scene(shape, environment, **settings)


def inner_fragments(scene, part, count, seed=0):
    """Random fragments of one part that fill their pixels, of one sample each."""
    index = np.arange(len(scene.pixels))[scene.part_slice(scene.parts.index(part))]
    index = index[~scene.bordering[index]]
    return np.random.default_rng(seed).permutation(index)[:count]


def sphere_hides(scene, toward, distance=np.inf):
    """Whether the sphere hides directions (n, 3) from all samples, and by what margin."""
    offset = scene.positions - scene.shape.center
    along = -np.sum(offset * toward, axis=-1)
    nearest = np.linalg.norm(offset + along[:, None] * toward, axis=-1) / scene.shape.radius
    return (nearest < 1.0) & (along > 0.0) & (along < distance), np.abs(nearest - 1.0)


@pytest.mark.parametrize(
    "light",
    [
        DirectionalLight((1.0, 1.2, -0.3), (3.0, 2.0, 1.0)),
        PointLight((2.0, 1.5, 0.5), (40.0, 20.0, 10.0)),
    ],
    ids=["directional", "point"],
)
def test_shadow_of_a_sphere_on_the_ground(light):
    """Every sample has the closed form, or is black in the shadow; those of the sphere, too."""
    scene = over_the_ground(lights=[light], size=40)
    if isinstance(light, PointLight):
        offset = np.array(light.position) - scene.positions
        distance = np.linalg.norm(offset, axis=-1)
        toward = offset / distance[:, None]
        across = np.array(light.intensity) / distance[:, None] ** 2
    else:
        distance = np.inf
        toward = np.broadcast_to(light.direction, scene.positions.shape)
        across = np.array(light.irradiance)
    cos = cosine(scene.normals, toward)
    hidden, margin = sphere_hides(scene, toward, distance)
    ground = scene.normals[:, 1] == 1.0
    expected = (
        0.5 / math.pi * across * np.where(hidden & ground, 0.0, np.maximum(cos, 0.0))[:, None]
    )
    index = np.arange(len(scene.pixels))
    sample, owner, share = scene.samples(index)
    # rounding decides exactly at the edge of the shadow
    sure = np.bincount(owner, (margin < 1e-4) & ground) == 0
    assert np.mean(~sure) < 0.01
    assert 30 < np.count_nonzero(hidden & ground) < 0.5 * np.count_nonzero(ground)
    total = np.zeros((len(index), 3))
    np.add.at(total, owner, share[:, None] * expected[sample])
    values, error = reference.fragments(scene, index, [Lambert(0.5)])
    np.testing.assert_allclose(values[sure, 0], total[sure], rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(error, 0.0)


def test_sky_hidden_by_a_sphere():
    """Seen from a plane, a sphere above it has the form factor cos(theta) (R / d)^2."""
    scene = over_the_ground(EnvironmentMap.uniform((1.0, 2.0, 3.0)))
    index = inner_fragments(scene, "ground", 40)
    values, _ = reference.fragments(scene, index, [Lambert(0.8)])
    distance = np.linalg.norm(scene.positions[scene.offsets[index]] - scene.shape.center, axis=-1)
    factor = 1.0 / distance**3  # cos(theta) = R / d: the sphere lies on the plane
    assert factor.max() > 0.4
    np.testing.assert_allclose(
        values[:, 0], 0.8 * (1.0 - factor)[:, None] * (1.0, 2.0, 3.0), rtol=1e-3
    )


def test_sky_hidden_by_a_wall():
    """The form factor of a rectangle that stands upright before the floor; at its foot 1/2."""
    camera = Camera.orbit(0.0, 35.0, zoom=8.0, target=(0.0, 0.0, 0.3))
    scene = beside_a_wall(EnvironmentMap.uniform(), camera=camera)
    index = inner_fragments(scene, "floor", 40)
    values, _ = reference.fragments(scene, index, [Lambert(0.8)])
    x, _, z = scene.positions[scene.offsets[index]].T

    def quarter(width):  # Howell's catalogue of view factors: element to perpendicular rectangle
        slant = np.hypot(2.0, z)
        near, far = np.arctan2(width, z), z / slant * np.arctan2(width, slant)
        return (near - far) / (2.0 * math.pi)

    factor = quarter(3.0 - x) + quarter(3.0 + x)
    assert factor.max() > 0.45
    np.testing.assert_allclose(values[:, 0, 0], 0.8 * (1.0 - factor), rtol=3e-3)


def test_smaller_pieces_come_nearer():
    scene = over_the_ground(EnvironmentMap.uniform())
    index = inner_fragments(scene, "ground", 20)
    distance = np.linalg.norm(scene.positions[scene.offsets[index]] - scene.shape.center, axis=-1)
    deviation = [
        np.sqrt(np.mean((values[:, 0, 0] / (1.0 - 1.0 / distance**3) - 1.0) ** 2))
        for values, _ in (
            reference.fragments(scene, index, [Lambert(1.0)], shadow_cell=cell)
            for cell in (0.1, 0.025)
        )
    ]
    assert deviation[1] < 0.3 * deviation[0]


def test_a_sun_of_one_texel_casts_a_sharp_shadow():
    """At 256 rows a texel is one piece, visible or hidden as its centroid is."""
    image = np.zeros((256, 512, 3))
    image[60, 100] = 1000.0
    environment = EnvironmentMap(image, 0.3)
    scene = over_the_ground(environment)
    # the irradiance on planes along the axes gives the direction of a single light
    moment = (environment.irradiance(np.eye(3)) - environment.irradiance(-np.eye(3)))[:, 0]
    toward = moment / np.linalg.norm(moment)
    hidden, margin = sphere_hides(scene, toward)
    index = inner_fragments(scene, "ground", 400)
    first = scene.offsets[index]
    assert margin[first].min() > 1e-4
    values, _ = reference.fragments(scene, index, [Lambert(1.0)])
    dark = hidden[first]
    assert 5 < np.count_nonzero(dark) < 0.5 * len(dark)
    np.testing.assert_array_equal(values[dark], 0.0)
    lit = environment.irradiance(np.array([0.0, 1.0, 0.0])) / math.pi
    np.testing.assert_allclose(values[~dark, 0], np.broadcast_to(lit, (sum(~dark), 3)), rtol=1e-4)


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_hidden_texels_are_as_good_as_black(angle):
    """All pieces of half the map are hidden: the same as a map that is black there."""
    environment = random_map().rotated(angle)
    image = environment.image.copy()
    image[:, :8] = 0.0  # from +z over -x to -z
    normals, views = points(3)
    models = [GGX(alpha=0.1), Lambert(0.5), PerfectMirror(0.5)]

    def visible(point, w):
        assert point.shape == w.shape[:1]
        return turn_about_y(w, -angle)[:, 0] > 0.0

    shaded, error = reference.radiance(
        normals, views, models, environment, shadows=reference.Shadows(visible)
    )
    black, _ = reference.radiance(normals, views, models, EnvironmentMap(image, angle))
    np.testing.assert_allclose(shaded, black, rtol=1e-6)
    assert np.all(error.max(-1) <= 1e-4 * shaded.max(-1))


def test_nothing_hidden_is_no_shadow():
    environment, models = random_map(), [GGX(alpha=0.1) + PerfectMirror(0.3), Lambert(0.5)]
    normals, views = points(3)
    free, _ = reference.radiance(normals, views, models, environment)
    seen, _ = reference.radiance(
        normals,
        views,
        models,
        environment,
        shadows=reference.Shadows(lambda point, w: np.ones(len(w), bool)),
    )
    np.testing.assert_allclose(seen, free, rtol=1e-6)
    dark, error = reference.radiance(
        normals,
        views,
        models,
        environment,
        shadows=reference.Shadows(lambda point, w: np.zeros(len(w), bool)),
    )
    np.testing.assert_array_equal(dark, 0.0)
    np.testing.assert_array_equal(error, 0.0)


def test_rays_go_only_where_light_may_come_from():
    image = np.zeros((8, 16, 3))
    image[:3, 4:9] = 1.0
    normals, views = points(2)
    asked = []

    def visible(point, w):
        asked.append((point, w))
        return np.ones(len(w), bool)

    environment = EnvironmentMap(image, 0.4)
    reference.radiance(
        normals, views, [Lambert(1.0)], environment, shadows=reference.Shadows(visible)
    )
    point, w = (np.concatenate(both) for both in zip(*asked, strict=True))
    assert np.all(environment.radiance(w) > 0.0)
    assert np.all(cosine(normals[point], w) > -0.02)
    above = cosine(normals, np.broadcast_to([0.0, 1.0, 0.0], (2, 3))) > 0.0
    assert set(point[above[point]]) == set(np.flatnonzero(above))
    # pieces of pi / 8 / 32: 3 x 5 texels of 32 x 32 at most for each point
    assert len(w) <= 2 * 15 * 32**2


def test_a_mirror_shows_the_wall_black():
    """One ray in the mirror direction decides whether the floor reflects the map."""
    environment = random_map(seed=5)
    scene = beside_a_wall(environment, subsamples=1)
    index = inner_fragments(scene, "floor", 50)
    values, _ = reference.fragments(scene, index, [PerfectMirror(1.0)])
    first = scene.offsets[index]
    x, _, z = scene.positions[first].T
    toward = reflect(scene.views, scene.normals)[first]
    with np.errstate(divide="ignore"):
        away = np.where(toward[:, 2] < 0.0, -z / toward[:, 2], np.inf)
    meets = (away * toward[:, 1] < 2.0) & (np.abs(x + away * toward[:, 0]) < 3.0)
    assert 5 < np.count_nonzero(meets) < 45
    shown = np.where(meets[:, None], 0.0, environment.radiance(toward))
    np.testing.assert_allclose(values[:, 0], shown, rtol=1e-6)


def test_shadowed_radiance_is_linear_in_the_light():
    first, second = random_map(seed=1), random_map(seed=2)
    mixed = EnvironmentMap(2.0 * first.image.astype(float) + 0.5 * second.image.astype(float))
    lamp = PointLight((1.0, 3.0, 2.0), (4.0, 5.0, 6.0))
    double = PointLight(lamp.position, (8.0, 10.0, 12.0))
    models = [GGX(alpha=0.1), Lambert(0.5)]
    scene = beside_a_wall(first, lights=[lamp])
    index = inner_fragments(scene, "floor", 6)
    a, b, c = (
        reference.fragments(scene.changed(environment=e, lights=lights), index, models)[0]
        for e, lights in ((first, [lamp]), (second, []), (mixed, [double]))
    )
    np.testing.assert_allclose(c, 2.0 * a + 0.5 * b, rtol=3e-4)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_size_of_the_world_does_not_matter(scale):
    environment = random_map()
    sun = DirectionalLight((1.0, 1.2, -0.3), (3.0, 2.0, 1.0))
    for make in (over_the_ground, beside_a_wall):
        size = {"radius": scale} if make is over_the_ground else {"scale": scale}
        first, second = make(environment, lights=[sun]), make(environment, lights=[sun], **size)
        np.testing.assert_array_equal(second.pixels, first.pixels)
        part = first.parts[0] if make is beside_a_wall else "ground"
        index = inner_fragments(first, part, 10)
        a, b = (reference.fragments(s, index, [Lambert(0.5)])[0] for s in (first, second))
        # rounding may change the result of a ray along an edge: one piece in a hundred thousand
        np.testing.assert_allclose(b, a, rtol=2e-4)


def test_nothing_is_asked_where_nothing_can_fall(monkeypatch):
    """A sphere alone hides no light from itself: no ray is cast, and shadows change nothing."""
    environment = random_map()
    scene = Scene(sphere(), environment, camera=Camera.orbit(20.0, 10.0), size=8)
    index = np.arange(0, len(scene.pixels), 15)
    model = Lambert(0.5) + PerfectMirror(0.1)
    plain, _ = reference.fragments(scene.changed(shadows=False), index, [model])
    monkeypatch.setattr(Scene, "visible", None)
    values, _ = reference.fragments(scene, index, [model])
    np.testing.assert_array_equal(values, plain)
    assert scene.rays_cast == 0


@pytest.mark.parametrize("cell", [0.0, -0.1, math.nan])
def test_pieces_need_a_size(cell):
    normals, views = points(1)
    with pytest.raises(ValueError, match="shadow_cell: expected an angle above 0 radians, got"):
        shadows = reference.Shadows(lambda point, w: np.ones(len(w), bool), cell)
        reference.radiance(normals, views, [Lambert()], random_map(), shadows=shadows)


# ---------------------------------------------------------------------------------------------
# frames


@pytest.fixture(scope="module")
def lit_scene():
    """A scene of 4 x 5 pixels with borders, ground and a lamp."""
    lamp = PointLight((0.0, 5.0, 0.0), (9.0, 9.0, 9.0))
    return over_the_ground(random_map(), [lamp], size=(4, 5), subsamples=4)


def test_a_fragment_is_the_sum_of_its_samples(lit_scene):
    """Each sample adds its share of the pixel, in any order of fragments."""
    scene, models = lit_scene, [Lambert(0.9), GGX(alpha=0.3)]
    several = np.flatnonzero(np.diff(scene.offsets) > 1)
    index = several[[3, 0, 5, 3, -1]]
    values, error = reference.fragments(scene, index, models)
    for f, value, stated in zip(index, values, error, strict=True):
        rows = np.arange(scene.offsets[f], scene.offsets[f + 1])
        each, errors = reference.radiance(
            scene.normals[rows],
            scene.views[rows],
            models,
            scene.environment,
            [scene.arriving(light, rows) for light in scene.lights],
            shadows=reference.Shadows(lambda point, w, rows=rows: scene.visible(rows[point], w)),
        )
        # the samples that hit the part, of the four of its pixel
        np.testing.assert_allclose(value, each.sum(axis=0) / 4.0, rtol=1e-6)
        np.testing.assert_allclose(stated, errors.sum(axis=0) / 4.0, rtol=1e-3)


def test_frames_are_made_of_fragments(lit_scene):
    scene = lit_scene
    brdfs = {"sphere": Lambert(0.9), "ground": Lambert(0.3), "unseen": Lambert(0.1)}
    told = []
    image = reference.render(scene, brdfs, progress=lambda *what: told.append(what))
    assert image.shape == (4, 5, 3)
    assert image.dtype == np.float64
    values, _ = reference.fragments(
        scene, np.arange(len(scene.pixels)), [Lambert(0.9), Lambert(0.3)]
    )
    own = values[np.arange(len(values)), scene.pixel_part]
    expected = scene.backdrop().reshape(-1, 3) * scene.uncovered[:, None].astype(np.float64)
    for pixel, value in zip(scene.pixels, own, strict=True):
        expected[pixel] += value
    np.testing.assert_allclose(image.reshape(-1, 3), expected, rtol=2e-4)
    # pixels of three kinds: whole, shared by two parts, and open to the backdrop
    shared = np.bincount(scene.pixels, minlength=20) > 1
    assert shared.any()
    assert np.any((scene.uncovered > 0.0) & (scene.uncovered < 1.0))
    assert np.any(scene.uncovered == 1.0)
    assert [name for name, _ in told] == ["reference"] * len(told)
    fractions = [done for _, done in told]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0


def test_one_brdf_serves_all_parts(lit_scene):
    scene = lit_scene.changed(environment=EnvironmentMap(np.zeros((2, 4, 3))))
    alone = reference.render(scene, Lambert(0.3))
    each = reference.render(scene, {"sphere": Lambert(0.3), "ground": Lambert(0.3)})
    np.testing.assert_array_equal(alone, each)
    assert alone.any()


def test_every_part_seen_needs_a_brdf(lit_scene):
    with pytest.raises(ValueError, match=r"got none for \['ground'\]"):
        reference.render(lit_scene, {"sphere": Lambert(0.3)})


def test_there_must_be_such_a_fragment(lit_scene):
    with pytest.raises(IndexError):
        reference.fragments(lit_scene, [10_000], [Lambert(0.3)])


def test_relative_error_is_the_mean_over_the_mean():
    truth = np.array([[1.0, 2.0, 3.0]])
    assert reference.relative_error(truth, truth) == 0.0
    assert abs(reference.relative_error(truth + np.array([0.3, -0.3, 0.0]), truth) - 0.1) < 1e-15
    assert reference.relative_error(np.zeros(3), np.zeros(3)) == 0.0
    with pytest.raises(ValueError, match=r"expected the reference's shape \(3,\), got \(4,\)"):
        reference.relative_error(np.zeros(4), np.zeros(3))


def test_psnr_of_the_tone_mapped_picture():
    truth = np.random.default_rng(0).random((20, 20, 3))
    assert reference.tone_mapped_psnr(truth, truth) == 99.0
    noise = np.random.default_rng(1).normal(size=truth.shape)
    near, far = (reference.tone_mapped_psnr(truth + s * noise, truth) for s in (0.01, 0.1))
    assert 10.0 < far < near < 60.0
