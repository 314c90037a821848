"""Rows of the operator against the reference, in light and in shadow."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest

from traitbrdf import reference
from traitbrdf.directions import reflect
from traitbrdf.reflectance.brdf import HalfDiffGrid, TabulatedBRDF
from traitbrdf.reflectance.models import GGX, Lambert
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import DirectionalLight, EnvironmentMap, PointLight, texel_moments
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import sphere
from traitbrdf.scene.teapot import teapot
from traitbrdf.space.embedding import GRID
from traitbrdf.space.library import default_library
from traitbrdf.transport.lighttree import LightTree
from traitbrdf.transport.operator import FLAT, Operator, core_of, lobe_of
from traitbrdf.transport.visibility import VisibilityCut

LIBRARY = default_library()
NAMES = ("chrome", "blue-plastic", "green-felt", "red-rubber", "gold-satin", "white-plaster")
TABLES = [LIBRARY[name] for name in NAMES]
MANY = [LIBRARY[name] for name in LIBRARY.names[1::20]]
GREY = np.full((GRID.size, 1), 1.0 / math.pi, np.float32)
"""A Lambert surface of albedo 1."""


def flat(table):
    """Values (cells, 3) of a table on the grid."""
    return np.ascontiguousarray(table.values.reshape(-1, 3), np.float32)


def by_rows(operator, index, tables):
    """Radiance (m, B, 3) float64 from the rows of fragments."""
    columns = np.stack([flat(t) for t in tables], axis=1).astype(np.float64)
    rows = operator.rows(index).astype(np.float64)
    return np.einsum("pck,kbc->pbc", rows, columns, optimize=True)


def diagonal(images):
    """Radiance (m, T, 3) from images (m, 3, 3 T): each colour of light with its own channel."""
    each = images.reshape(*images.shape[:2], -1, 3)
    return np.einsum("pctc->ptc", each)


def by_images(operator, index, tables):
    """Radiance (m, B, 3) from the images of the tables' channels."""
    return diagonal(operator.images(index, channels(tables)))


def channels(tables):
    return np.concatenate([flat(t) for t in tables], axis=1)


def errors(shown, true):
    """Mean relative L1 (B,) of radiance (m, B, 3)."""
    return np.abs(shown - true).mean(axis=(0, 2)) / true.mean(axis=(0, 2))


def some(scene, count, seed=0, bordering=None, part=None):
    """Random fragments: of all parts or one; at borders, inside, or both."""
    chosen = np.ones(len(scene.pixels), bool)
    if bordering is not None:
        chosen &= scene.bordering == bordering
    if part is not None:
        chosen &= scene.pixel_part == scene.parts.index(part)
    index = np.flatnonzero(chosen)
    return np.sort(np.random.default_rng(seed).choice(index, count, replace=False))


def noise(rows, columns, seed=0, **settings):
    image = np.random.default_rng(seed).uniform(0.1, 3.0, (rows, columns, 3))
    return EnvironmentMap(image, **settings)


def one_texel(row, column, rows, bright=1e4, rest=1e-3):
    """A map with nearly all its light in one texel."""
    image = np.full((rows, 2 * rows, 3), rest)
    image[row, column] = bright
    return EnvironmentMap(image)


def shadowed(scene, index, count=256):
    """Which fragments get less than nine tenths of the light above their horizon."""
    toward = np.random.default_rng(9).normal(size=(count, 3))
    toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
    light = scene.environment.radiance(toward).mean(axis=-1)
    sample = scene.offsets[:-1][index]
    cos = np.maximum(scene.normals[sample] @ toward.T, 0.0)
    free = np.stack([scene.visible(sample, np.broadcast_to(w, (len(sample), 3))) for w in toward])
    return (cos * light * free.T).sum(axis=1) < 0.9 * (cos * light).sum(axis=1)


@functools.cache
def ball_on_ground(size=40, rows=32, **settings):
    sky = EnvironmentMap.sky(rows=rows)
    return Scene(sphere(), sky, camera=Camera.orbit(20.0, 25.0), size=size, ground=True, **settings)


@functools.cache
def teapot_on_ground(size=48):
    lights = [
        PointLight(position=(3.0, 4.0, 3.0), intensity=(20.0, 18.0, 15.0)),
        DirectionalLight(direction=(-1.0, 2.0, 0.7), irradiance=(0.3, 0.4, 0.6)),
    ]
    sky = EnvironmentMap.sky(rows=64).rotated(0.7)
    camera = Camera.orbit(35.0, 25.0)
    return Scene(teapot(), sky, lights, camera, size=(size, size + 12), ground=True)


# -- against the oracle -----------------------------------------------------------------------


@pytest.mark.slow
def test_rows_without_shadows(small_teapot):
    """Sharp and rough tables under a map and two lights beside it."""
    scene = small_teapot.changed(shadows=False)
    tables = TABLES + [TabulatedBRDF.from_model(m, GRID) for m in (GGX(0.01, 1.5, 0.0), Lambert(1))]
    index = np.concatenate([some(scene, 10, bordering=False), some(scene, 4, bordering=True)])
    true, own = reference.fragments(scene, index, tables, 1e-3)
    shown = by_rows(Operator(scene, GRID), index, tables)
    assert np.all(errors(shown, true) < 0.003)
    level = true.max(axis=(1, 2), keepdims=True)
    assert np.all(np.abs(shown - true) < 0.01 * true + 3.0 * own + 1e-4 * level)
    assert scene.rays_cast == 0


@pytest.mark.parametrize("make", [ball_on_ground, teapot_on_ground])
def test_rows_with_shadows(make):
    """Fragments of all kinds, lit and in shadow, inside and at borders."""
    scene = make()
    index = np.concatenate([
        some(scene, 16, bordering=False, part="ground"),
        some(scene, 12, bordering=False),
        some(scene, 6, bordering=True),
    ])  # fmt: skip
    true, _ = reference.fragments(scene, index, MANY, 1e-3)
    shown = by_rows(Operator(scene, GRID), index, MANY)
    error = errors(shown, true)
    print(f"rows: median {np.median(error):.4f}, worst {error.max():.4f}")
    assert np.median(error) < 0.01
    assert error.max() < 0.04


@pytest.mark.slow
@pytest.mark.parametrize("make", [ball_on_ground, teapot_on_ground])
def test_shadowed_fragments(make):
    """Fragments that lose a tenth of their light or more; also in images of a whole part."""
    scene = make(56)
    ground = scene.parts.index("ground")
    span = scene.part_slice(ground)
    candidates = np.flatnonzero(~scene.bordering)
    own = candidates[scene.pixel_part[candidates] == ground]
    rng = np.random.default_rng(4)
    dark = own[shadowed(scene, own)]
    assert len(dark) > 60
    index = np.sort(rng.choice(dark, 40, replace=False))
    true, _ = reference.fragments(scene, index, MANY, 1e-3)
    whole = diagonal(Operator(scene, GRID).part_images(ground, channels(MANY)))[index - span.start]
    rows = by_rows(Operator(scene, GRID), index, MANY)
    for kind, shown in (("rows", rows), ("part images", whole)):
        error = errors(shown, true)
        print(f"{kind}: median {np.median(error):.4f}, worst {error.max():.4f}")
        assert np.median(error) < 0.01, kind
        assert error.max() < 0.04, kind


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (2, 2), (2, 4), (4, 8), (16, 32)])
def test_maps_of_a_few_texels(shape):
    """Texels as large as the sky are cut into pieces without losing any of their light."""
    scene = Scene(sphere(), noise(*shape, rotation=0.3), camera=Camera.orbit(20.0, 10.0), size=36,
                  subsamples=1)  # fmt: skip
    index = some(scene, 30)
    true, _ = reference.fragments(scene, index, TABLES, 3e-4)
    assert np.all(errors(by_rows(Operator(scene, GRID), index, TABLES), true) < 0.006)


@pytest.mark.parametrize("shape", [(1, 1), (2, 4), (4, 8), (8, 16), (16, 32), (64, 128)])
def test_shadows_under_maps_of_a_few_texels(shape):
    """The shadow of a large texel is soft, however few texels the map has."""
    scene = ball_on_ground().changed(environment=noise(*shape))
    place = scene.positions[scene.offsets[:-1]]
    near = (np.hypot(place[:, 0], place[:, 2]) < 1.6) & ~scene.bordering
    index = np.flatnonzero(near & (scene.pixel_part == 1))[::5]
    assert len(index) > 20
    true, _ = reference.fragments(scene, index, TABLES, 1e-3)
    error = errors(by_rows(Operator(scene, GRID), index, TABLES), true)
    print(f"{shape}: {np.round(error, 4)}")
    assert np.median(error) < 0.01
    assert error.max() < 0.03


def test_lights_alone(small_sphere):
    """Without a map a row is the table's own eval: exact."""
    lights = [PointLight((2.0, 3.0, 2.0), (40.0, 30.0, 20.0)), DirectionalLight((0.0, 1.0, 0.3))]
    dark = EnvironmentMap(np.zeros((4, 8, 3)))
    scene = small_sphere.changed(environment=dark, lights=lights)
    index = np.concatenate([some(scene, 40, bordering=False), some(scene, 10, bordering=True)])
    true, _ = reference.fragments(scene, index, TABLES)
    operator = Operator(scene, GRID)
    # at borders some samples graze: their tiny values need not agree to all digits
    for shown in (by_rows(operator, index, TABLES), by_images(operator, index, TABLES)):
        np.testing.assert_allclose(shown, true, rtol=1e-3, atol=1e-5 * true.max())


def test_a_finer_resolution_errs_less(small_teapot):
    scene = small_teapot.changed(shadows=False, lights=())
    index = some(scene, 12, bordering=False)
    true, _ = reference.fragments(scene, index, TABLES, 3e-4)
    coarse, fine = (
        errors(by_rows(Operator(scene, GRID, r), index, TABLES), true) for r in (0.5, 2)
    )
    assert np.mean(fine) < 0.3 * np.mean(coarse)


# -- closed forms -----------------------------------------------------------------------------

MAPS = ("forest", "lobby", "night", "studio", "sunset", "venice", "warehouse", "workshop")


@pytest.mark.parametrize("light", ["sky", "turned", "uniform", "one texel", *MAPS])
def test_a_lambert_surface_sees_the_irradiance(light, small_sphere, request):
    environment = {
        "sky": lambda: EnvironmentMap.sky(rows=64),
        "turned": lambda: EnvironmentMap.sky(rows=32).rotated(2.0),
        "uniform": lambda: EnvironmentMap.uniform((0.5, 1.0, 2.0), rows=128),
        "one texel": lambda: one_texel(2, 13, 16, bright=1.0, rest=0.0),
    }.get(light) or (
        lambda: EnvironmentMap.read(
            request.getfixturevalue("shared_data") / "envmaps" / f"{light}.exr"
        )
    )
    scene = Scene(sphere(), environment(), camera=small_sphere.camera, size=48)
    index = some(scene, 150, bordering=False)
    shown = Operator(scene, GRID).images(index, GREY)[..., 0]
    true = scene.environment.irradiance(scene.normals[scene.offsets[index]]) / math.pi
    # the sum over texels is exact where the horizon cuts none
    whole = true[:, 1] > 0.3 * true[:, 1].max() if light == "one texel" else slice(None)
    assert np.abs(shown - true)[whole].mean() < 1e-3 * true[whole].mean()


def test_a_uniform_map_is_the_albedo(small_sphere):
    """Under radiance 1 from everywhere a pixel shows the directional albedo of its table."""
    scene = small_sphere.changed(environment=EnvironmentMap.uniform(rows=32))
    index = np.flatnonzero(~scene.bordering)
    first = scene.offsets[index]
    cos = np.sum(scene.normals[first] * scene.views[first], axis=-1)
    seen = np.flatnonzero(cos > math.cos(math.radians(75.0)))[::20]
    shown = by_rows(Operator(scene, GRID), index[seen], TABLES)
    for i, table in enumerate(TABLES):
        np.testing.assert_allclose(shown[:, i], table.albedo(np.arccos(cos[seen])), rtol=0.01)


def test_no_light_is_black():
    scene = ball_on_ground().changed(environment=EnvironmentMap(np.zeros((4, 8, 3))))
    operator = Operator(scene, GRID)
    index = some(scene, 20)
    assert not operator.rows(index).any()
    assert not operator.part_images(1, GREY).any()
    assert not operator.mirror(index).any()


# -- symmetries -------------------------------------------------------------------------------


def test_rows_are_linear_in_the_light(small_sphere):
    sky = EnvironmentMap.sky(rows=32, sun=None)
    sun = EnvironmentMap.sky(rows=32, softboxes=False)
    both = EnvironmentMap(sky.image + sun.image)
    index = some(small_sphere, 12)

    def radiance(environment):
        scene = small_sphere.changed(environment=environment)
        return by_rows(Operator(scene, GRID), index, TABLES)

    np.testing.assert_allclose(radiance(sky.scaled(4.0)), 4.0 * radiance(sky), rtol=1e-5)
    together, apart = radiance(both), radiance(sky) + radiance(sun)
    assert np.abs(together - apart).mean() < 0.003 * together.mean()


def test_brighter_light_casts_the_same_shadows():
    scene = ball_on_ground()
    brighter = scene.changed(environment=scene.environment.scaled(4.0))
    index = some(scene, 20)
    once, four = (by_rows(Operator(s, GRID), index, TABLES) for s in (scene, brighter))
    np.testing.assert_allclose(four, 4.0 * once, rtol=1e-5)


@pytest.mark.parametrize("ground", [False, True])
def test_turning_everything_changes_nothing(ground):
    """The map, the lights and the camera turned about +y together."""
    shown = []
    for turn in (0.0, 0.9):
        c, s = math.cos(turn), math.sin(turn)
        lights = [
            DirectionalLight((0.6 * c + 0.8 * s, 1.0, 0.8 * c - 0.6 * s)),
            PointLight((3.0 * s, 3.0, 3.0 * c), (9.0, 9.0, 9.0)),
        ]
        sky = EnvironmentMap.sky(rows=32).rotated(turn)
        camera = Camera(math.degrees(turn), 15.0)
        scene = Scene(sphere(), sky, lights, camera, size=32, ground=ground)
        # rounding may move a sample at an edge to either side
        index = np.flatnonzero(~scene.bordering)[::16]
        shown.append((scene.pixels[index], by_rows(Operator(scene, GRID), index, TABLES)))
    (pixels, first), (turned, second) = shown
    np.testing.assert_array_equal(turned, pixels)
    # rounding also decides rays that graze an edge
    off = np.abs(second - first).max(axis=(1, 2)) > 2e-3 * first.max(axis=(1, 2))
    assert np.count_nonzero(off) <= (0.05 * len(off) if ground else 0)
    assert np.all(errors(second, first) < (5e-3 if ground else 5e-4))


@pytest.mark.slow
def test_samples_at_borders_have_shadows_of_their_own():
    """Under a bright sun each sample of a border is lit or not; higher resolution errs less."""
    image = np.full((32, 64, 3), 0.05)
    image[9, 20] = 300.0
    scene = Scene(teapot(), EnvironmentMap(image), camera=Camera.orbit(35.0, 25.0), size=64)
    index = some(scene, 30, bordering=True)
    true, _ = reference.fragments(scene, index, TABLES, 1e-3)
    found = [errors(by_images(Operator(scene, GRID, r), index, TABLES), true) for r in (1.0, 2.0)]
    print(f"borders: {np.median(found[0]):.4f} and, finer, {np.median(found[1]):.4f}")
    assert np.median(found[0]) < 0.02
    assert np.median(found[1]) < 0.006
    # without own rays all samples see what the middle one sees
    blind = Operator(scene, GRID, 2.0)
    blind.visibility.cast_samples = lambda index, fine: None
    assert np.median(errors(by_images(blind, index, TABLES), true)) > 2.0 * np.median(found[1])


@pytest.mark.parametrize("make", [ball_on_ground, teapot_on_ground])
def test_how_fragments_are_grouped_does_not_show(make):
    scene = make()
    core = core_of(GRID, channels(TABLES))
    operator = Operator(scene, GRID, core=core)
    index = some(scene, 40)
    shuffled = np.random.default_rng(2).permutation(len(index))
    whole = by_images(operator, index, TABLES)
    level = whole.mean()
    np.testing.assert_allclose(
        by_images(operator, index[shuffled], TABLES), whole[shuffled], rtol=1e-5, atol=1e-6 * level
    )
    anew = Operator(scene, GRID, core=core)
    parts = [by_images(anew, few, TABLES) for few in np.split(index, [1, 8, 31])]
    np.testing.assert_allclose(np.concatenate(parts), whole, rtol=1e-5, atol=1e-6 * level)
    np.testing.assert_allclose(by_rows(anew, index, TABLES), whole, rtol=1e-3, atol=1e-5 * level)
    operator.capacity = 40  # too small for any fragment, so it is doubled several times
    np.testing.assert_allclose(
        by_images(operator, index, TABLES), whole, rtol=1e-5, atol=1e-6 * level
    )
    assert operator.images(index[:0], GREY).shape == (0, 3, 1)
    assert operator.rows(index[:0]).shape == (0, 3, GRID.size)
    assert operator.mirror(index[:0]).shape == (0, 3)


# -- whole parts ------------------------------------------------------------------------------


@pytest.mark.parametrize("shadows", [False, True])
def test_images_of_whole_parts(shadows):
    """Far images are interpolated over some pixels, with an error too small to see."""
    scene = teapot_on_ground().changed(shadows=shadows)
    operator = Operator(scene, GRID)
    tables = channels(MANY)
    shown, true = [], []
    for part in range(len(scene.parts)):
        span = scene.part_slice(part)
        index = np.arange(span.start, span.stop)[::3]
        whole = operator.part_images(part, tables)
        assert whole.shape == (span.stop - span.start, 3, tables.shape[1])
        shown.append(diagonal(whole)[::3])
        true.append(diagonal(operator.images(index, tables)))
    error = errors(np.concatenate(shown), np.concatenate(true))
    print(f"part images: median {np.median(error):.4f}, worst {error.max():.4f}")
    assert np.median(error) < 0.005
    assert error.max() < 0.015


@pytest.mark.parametrize("make", [ball_on_ground, teapot_on_ground])
def test_rows_as_shown_are_those_of_the_images(make):
    """A basis is fitted to them, so they need the same shadows and leaves as the images."""
    scene = make()
    operator = Operator(scene, GRID, core=core_of(GRID, channels(TABLES)))
    index = some(scene, 60)
    rows = operator.rows_as_shown(index)
    found = np.einsum("mck,kt->mct", rows, channels(TABLES), optimize=True)
    operator.exact_rules = operator.rules  # not interpolated, but with the same leaves
    images = [
        operator.part_images(part, channels(TABLES), interpolate=False)
        for part in range(len(scene.parts))
    ]
    true = np.concatenate(images)[index]
    off = np.abs(found - true).max(axis=(1, 2)) > 1e-3 * true.max(axis=(1, 2))
    assert np.count_nonzero(off) <= 1  # a ray that grazes an edge may fall to either side
    np.testing.assert_allclose(found, true, rtol=2e-2, atol=1e-4 * true.mean())
    np.testing.assert_array_equal(operator.rows_as_shown(index[7:9]), rows[7:9])
    assert operator.rows_as_shown(index[:0]).shape == (0, 3, GRID.size)


@pytest.mark.parametrize("make", [ball_on_ground, teapot_on_ground])
def test_rows_do_not_depend_on_what_was_prepared(make):
    """Fewer rays are cast once the fragments around have theirs; the rows hardly change."""
    scene = make()
    index = np.concatenate([some(scene, 60), some(scene, 60, part="ground")])
    alone = by_rows(Operator(scene, GRID), index, MANY)
    operator = Operator(scene, GRID)
    for part in range(len(scene.parts)):
        operator.prepare(part)
    error = errors(by_rows(operator, index, MANY), alone)
    print(f"rows after preparation: median {np.median(error):.4f}, worst {error.max():.4f}")
    assert error.max() < 0.005


def test_a_part_that_is_not_seen():
    scene = Scene(teapot(), camera=Camera.orbit(0.0, 90.0), size=12)
    counts = np.bincount(scene.pixel_part, minlength=len(scene.parts))
    unseen = int(np.flatnonzero(counts == 0)[0])
    assert Operator(scene, GRID).part_images(unseen, GREY).shape == (0, 3, 1)


def test_preparing_is_done_once_and_told():
    scene = ball_on_ground(96).changed(environment=noise(16, 32))
    operator = Operator(scene, GRID)
    told = []
    operator.prepare(1, lambda *news: told.append(news))
    assert told[-1][1] == 1.0
    cast = scene.rays_cast
    assert cast > 0
    # all samples of a border count: some cast all rays, the others few
    count = np.diff(scene.offsets)[scene.pixel_part == 1].sum()
    # neighbours share visibility: far fewer than one ray for each direction and sample
    assert cast < 0.5 * 0.5 * count * len(operator.visibility.cut.share)
    operator.prepare(1)
    assert scene.rays_cast == cast


def test_progress_can_cancel():
    class StopError(Exception):
        pass

    def stop(stage, fraction):
        raise StopError

    with pytest.raises(StopError):
        Operator(ball_on_ground(), GRID).part_images(0, GREY, stop)
    with pytest.raises(StopError):
        Operator(ball_on_ground(), GRID).prepare(1, stop)


# -- shadows ----------------------------------------------------------------------------------


def lit(shown, cos):
    """Whether fragments get a light whose unshadowed irradiance is proportional to `cos`."""
    full = np.max(shown / cos)
    share = shown / (full * cos)
    assert np.all((share < 0.05) | (share > 0.95)), "half a shadow"
    return share > 0.5


@pytest.mark.parametrize("shape", [sphere, teapot])
@pytest.mark.parametrize("rows", [256, 512])
def test_a_small_sun_casts_a_shadow_sharp_to_the_pixel(shape, rows):
    row, column = int(0.28 * rows), int(0.33 * 2 * rows)
    light = one_texel(row, column, rows)
    camera = Camera.orbit(20.0, 30.0)
    scene = Scene(shape(), light, camera=camera, size=64, ground=True)
    ground = scene.parts.index("ground")
    span = scene.part_slice(ground)
    index = np.flatnonzero((scene.pixel_part == ground) & ~scene.bordering)
    toward = texel_moments(light)[row, column]
    toward /= np.linalg.norm(toward)  # the centre of its light
    sample = scene.offsets[index]
    free = scene.visible(sample, np.broadcast_to(toward, (len(sample), 3)))
    assert 0.05 < np.mean(~free) < 0.6
    operator = Operator(scene, GRID)
    whole = operator.part_images(ground, GREY)[:, 1, 0]
    # what is a pixel or two wide casts a shadow that covers pixels in part
    sharp = operator.visibility.second_row[index] < 0
    assert sharp.mean() > 0.95
    index, free = index[sharp], free[sharp]
    whole = whole[index - span.start]
    np.testing.assert_array_equal(lit(whole, toward[1]), free)
    alone = operator.images(index, GREY)[:, 1, 0]
    np.testing.assert_array_equal(lit(alone, toward[1]), free)
    rows_of = operator.rows(index[::7])[:, 1].sum(axis=-1)
    np.testing.assert_array_equal(lit(rows_of, toward[1]), free[::7])


@pytest.mark.parametrize(
    "light",
    [
        DirectionalLight((0.8, 1.0, 0.3), (2.0, 2.0, 2.0)),
        PointLight((2.0, 2.5, 1.0), (9.0, 9.0, 9.0)),
    ],
    ids=["directional", "point"],
)
def test_lights_cast_the_shadow_of_a_ball(light):
    """The shadow of the ball on the ground, in closed form."""
    dark = EnvironmentMap(np.zeros((4, 8, 3)))
    scene = Scene(sphere(), dark, [light], Camera.orbit(20.0, 30.0), size=64, ground=True)
    index = np.flatnonzero((scene.pixel_part == 1) & ~scene.bordering)
    points = scene.positions[scene.offsets[index]]
    toward, irradiance = light.arriving(points)
    along = np.sum(-points * toward, axis=-1)  # to the point that is nearest to the ball's centre
    apart = np.linalg.norm(points + along[:, None] * toward, axis=-1)
    free = (along < 0.0) | (apart > 1.0)
    sure = np.abs(apart - 1.0) > 1e-6
    assert 0.05 < np.mean(~free) < 0.6
    operator = Operator(scene, GRID)
    full = irradiance[:, 1] * toward[:, 1] / math.pi
    expected = np.where(free, full, 0.0)[sure]
    for shown in (
        operator.images(index, GREY)[:, 1, 0],
        operator.rows(index)[:, 1].sum(axis=-1) / math.pi,
        operator.part_images(1, GREY)[index - scene.part_slice(1).start, 1, 0],
    ):
        np.testing.assert_allclose(shown[sure], expected, rtol=1e-4, atol=1e-6)


def test_the_shadow_of_a_ball_under_a_grey_sky_is_soft():
    """The irradiance that the ball hides under a uniform sky, in closed form."""
    scene = Scene(sphere(), EnvironmentMap.uniform(rows=128), camera=Camera.orbit(0.0, 40.0),
                  size=64, ground=True)  # fmt: skip
    index = some(scene, 150, bordering=False, part="ground")
    points = scene.positions[scene.offsets[index]]
    # a ball of angular radius a, wholly above the horizon, hides sin(a)^2 cos(angle to the normal)
    away = np.linalg.norm(points, axis=-1)
    whole = points[:, 1] < -0.999
    hidden = (1.0 / away) ** 2 * (1.0 / away)
    shown = Operator(scene, GRID).images(index, GREY)[:, 1, 0]
    error = np.abs(shown - (1.0 - hidden))
    print(f"soft shadow: mean error {error[whole].mean():.5f}, worst {error[whole].max():.4f}")
    assert whole.all()
    assert hidden.max() > 0.55
    assert error.mean() < 0.004
    assert error.max() < 0.02


def test_a_convex_shape_alone_casts_no_rays(small_sphere):
    scene = small_sphere.changed(shadows=True)
    operator = Operator(scene, GRID)
    index = some(scene, 20)
    operator.rows(index)
    operator.part_images(0, GREY)
    operator.mirror(index)
    assert scene.rays_cast == 0
    on_ground = ball_on_ground().changed(shadows=True)
    operator = Operator(on_ground, GRID)
    operator.part_images(0, GREY)
    operator.mirror(some(on_ground, 20, part="sphere"))
    assert on_ground.rays_cast == 0
    operator.part_images(1, GREY)
    assert on_ground.rays_cast > 0


def test_a_perfect_mirror_shows_what_is_not_hidden():
    scene = teapot_on_ground()
    shown = Operator(scene, GRID).mirror(np.arange(len(scene.pixels)))
    sample, owner, share = scene.samples(np.arange(len(scene.pixels)))
    toward = reflect(scene.views, scene.normals)
    seen = scene.environment.radiance(toward) * share[:, None]
    free = scene.visible(sample, toward)
    expected = np.zeros_like(shown)
    np.add.at(expected, owner, np.where(free[:, None], seen, 0.0))
    np.testing.assert_allclose(shown, expected, rtol=1e-5)
    everything = Operator(scene.changed(shadows=False), GRID).mirror(np.arange(len(scene.pixels)))
    assert np.all(shown <= everything * (1.0 + 1e-6))
    assert np.mean(shown.max(axis=-1) < 0.5 * everything.max(axis=-1)) > 0.02


@pytest.mark.parametrize(
    "environment",
    [
        EnvironmentMap.sky(rows=64),
        one_texel(5, 20, 32),
        noise(4, 8),
        EnvironmentMap.uniform(rows=1),
        EnvironmentMap(np.eye(16)[:, :, None] * np.ones(3)),
        EnvironmentMap(np.zeros((4, 8, 3))),
    ],
    ids=["sky", "one texel", "coarse", "one row", "diagonal", "dark"],
)
@pytest.mark.parametrize(("spacing", "share"), [(0.1, 1 / 300), (0.4, 0.05)])
def test_visibility_cut(environment, spacing, share):
    tree = LightTree.build(environment)
    cut = VisibilityCut.build(tree, spacing, share)
    count = len(cut.share)
    assert cut.directions.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(cut.directions, axis=-1), 1.0, atol=1e-6)
    flux = np.linalg.norm(tree.moment.sum(axis=1, dtype=np.float64), axis=-1)
    if environment.image.any():
        # the directions of a node's light differ, so its vector irradiance is a little shorter
        assert 1.0 - spacing**2 < cut.share.sum() < 1.0 + 1e-5
    else:
        assert cut.share.sum() == 0.0
    # ranges nest: the children of a node divide its range, or share it below the cut
    assert (cut.first[0], cut.last[0]) == (0, count)
    reached = np.zeros(len(flux), bool)
    reached[0] = True
    owners = np.zeros(count, int)
    for i in range(len(flux)):  # a node's children come after it
        if not reached[i]:
            continue
        first, last = int(cut.first[i]), int(cut.last[i])
        assert last > first
        children = [c for c in tree.child[i] if c >= 0]
        reached[children] = True
        if last - first > 1:
            ranges = sorted((int(cut.first[c]), int(cut.last[c])) for c in children)
            assert ranges[0][0] == first
            assert ranges[-1][1] == last
            assert len(ranges) == 1 or ranges[0][1] == ranges[1][0]
        else:
            for c in children:
                assert (cut.first[c], cut.last[c]) == (first, last)
    # every texel with light belongs to one node of the cut, which stands for its direction
    box = tree.rectangle
    texel = (box[:, 1] - box[:, 0] == 1) & (box[:, 3] - box[:, 2] == 1)
    leaves = np.flatnonzero(texel & reached)
    if environment.image.any():
        assert len(leaves) == np.count_nonzero(environment.image.any(axis=-1))
    assert np.all(cut.last[leaves] - cut.first[leaves] == 1)
    np.add.at(owners, cut.first[leaves], 1)
    if environment.image.any():
        assert np.all(owners > 0)
        several = owners[cut.first[leaves]] > 1
        angle = np.linalg.norm(tree.direction[leaves] - cut.directions[cut.first[leaves]], axis=-1)
        assert np.all(angle[several] < 2.0 * spacing)
        assert np.all(angle[~several] < 1e-6)
        # only single texels may be brighter than the limit
        assert np.all((cut.share <= 1.001 * share) | (owners == 1))
    assert cut.neighbours.shape == (count, 6)
    assert cut.neighbours.min() >= 0
    assert cut.neighbours.max() < count
    if count > 6:
        assert np.all(cut.neighbours != np.arange(count)[:, None])


# -- errors -----------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [0.0, -1.0, math.nan, math.inf])
def test_bad_resolutions(resolution, small_sphere):
    with pytest.raises(ValueError, match="resolution"):
        Operator(small_sphere, GRID, resolution)


def test_bad_grids(small_sphere):
    with pytest.raises(ValueError, match="folded"):
        Operator(small_sphere, HalfDiffGrid(9, 9, 9, "merl"))


@pytest.mark.parametrize("shape", [(3, 5), (32, 64)])
def test_a_light_tree_at_hand_is_used(shape, small_sphere):
    scene = small_sphere.changed(environment=noise(*shape))
    other = Operator(scene, GRID)
    index = some(scene, 5)
    operator = Operator(scene, GRID, tree=other.tree)
    assert operator.tree is other.tree
    np.testing.assert_array_equal(operator.rows(index), other.rows(index))


# -- leaves as fine as lobes require ----------------------------------------------------------


def test_lobes_as_wide_as_their_tables_are(small_sphere):
    angles = GRID.theta_h[:, None, None, None]
    for width in (0.05, 0.2):
        inside = 2.0 - np.clip(angles - width, 0.0, 1.0) + np.zeros((*GRID.shape, 1))
        found = lobe_of(GRID, inside.reshape(-1, 1).astype(np.float32), 1.5)
        # tables change within it by no more than FLAT
        assert width <= found <= width + 1.2 * FLAT * 2.0
    assert lobe_of(GRID, GREY, 1.5) == pytest.approx(0.5 * math.pi)
    noise = np.random.default_rng(0).random((GRID.size, 2), dtype=np.float32)
    assert lobe_of(GRID, np.concatenate([noise, GREY[:, :1]], axis=1), 1.5) == 0.0


def test_what_views_never_see_does_not_narrow_lobes():
    table = np.ones((*GRID.shape, 1), np.float32)
    table[:3, GRID.theta_d > 1.4] = 100.0
    assert lobe_of(GRID, table.reshape(-1, 1), 1.5) < 0.01
    assert lobe_of(GRID, table.reshape(-1, 1), 0.9) > 1.5


def test_wide_lobes_have_far_images_alone():
    """No near images are computed, and the error stays below 1 %."""
    scene = ball_on_ground()
    operator = Operator(scene, GRID)
    for part in range(2):
        told: list[str] = []
        tell = functools.partial(lambda told, stage, fraction: told.append(stage), told)
        wide = operator.part_images(part, GREY, tell)
        assert "far images" in told and "near images" not in told
        span = scene.part_slice(part)
        some = np.arange(span.start, span.stop, 7)
        exact = Operator(scene, GRID, 2.0, operator.tree).images(some, GREY)
        error = np.abs(wide[some - span.start] - exact).mean() / exact.mean()
        assert error < 0.01, part


def test_flat_parts_interpolate_narrower_lobes():
    operator = Operator(ball_on_ground(96), GRID)
    operator.prepare(0)
    operator.prepare(1)
    assert operator.plan(1).scale < operator.plan(0).scale <= 1.0
