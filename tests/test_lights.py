"""Laws of light: exact solid angles, look-ups, rotation, irradiance, the light tree, and files."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from traitbrdf.directions import direction_to_latlong, latlong_to_direction
from traitbrdf.formats.files import FormatError
from traitbrdf.formats.images import read_image, write_exr
from traitbrdf.scene.lights import (
    DirectionalLight,
    EnvironmentMap,
    PointLight,
    texel_moments,
    turn_about_y,
)
from traitbrdf.transport.lighttree import LightTree

SIZES = [(1, 1), (1, 7), (9, 1), (2, 2), (3, 5), (16, 32), (33, 66), (256, 512)]
MAPS = (
    "forest",
    "lobby",
    "night",
    "studio",
    "sunset",
    "venice",
    "warehouse",
    "workshop",
)

angle = st.floats(-7.0, 7.0)
sizes = st.tuples(st.integers(1, 9), st.integers(1, 9))


def random_map(size, seed=0):
    return EnvironmentMap(np.random.default_rng(seed).random((*size, 3)) ** 4)


def random_directions(count, seed=0):
    w = np.random.default_rng(seed).normal(size=(count, 3))
    return w / np.linalg.norm(w, axis=-1, keepdims=True)


def texel_centres(rows, columns):
    v, u = np.meshgrid(
        (np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij"
    )
    return latlong_to_direction(u, v)


# ---------------------------------------------------------------------------------------------
# texels


@pytest.mark.parametrize("size", SIZES)
def test_solid_angles_cover_the_sphere(size):
    total = random_map(size).solid_angles.sum() * size[1]
    assert abs(total - 4.0 * math.pi) < 1e-12


@pytest.mark.parametrize("size", SIZES)
def test_moments_add_up_to_nothing_and_are_shorter_than_solid_angles(size):
    environment = random_map(size)
    moments = texel_moments(environment)
    np.testing.assert_allclose(moments.sum(axis=(0, 1)), 0.0, atol=1e-12)
    length = np.linalg.norm(moments, axis=-1)
    assert np.all(length <= environment.solid_angles[:, None] * (1 + 1e-12))


def test_moments_agree_with_a_finer_map():
    coarse, fine = texel_moments(random_map((3, 4))), texel_moments(random_map((12, 20)))
    np.testing.assert_allclose(coarse, fine.reshape(3, 4, 4, 5, 3).sum(axis=(1, 3)), atol=1e-14)
    fine_sum = np.zeros((3, 4, 3))
    sub = random_map((300, 400))
    centres = texel_centres(300, 400) * sub.solid_angles[:, None, None]
    fine_sum = centres.reshape(3, 100, 4, 100, 3).sum(axis=(1, 3))
    np.testing.assert_allclose(coarse, fine_sum, atol=1e-4)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_lookup_hits_texel_centres(size, dtype):
    environment = random_map(size)
    at_centres = environment.radiance(texel_centres(*size).astype(dtype))
    np.testing.assert_array_equal(at_centres, environment.image)
    assert at_centres.dtype == np.float32


def test_lookup_at_seam_and_poles():
    environment = random_map((4, 8))
    image = environment.image
    seam = np.array([0.0, 0.0, 1.0])
    for x, column in ((-1e-12, 0), (0.0, 0), (-0.0, 0), (1e-12, 7)):
        w = seam + np.array([x, 1e-9, 0.0])
        assert np.any(np.all(environment.radiance(w) == image[1, [0, 7]], axis=-1))
        if x:
            np.testing.assert_array_equal(environment.radiance(w), image[1, column])
    for y, row in ((1.0, 0), (-1.0, 3)):
        for x in (0.0, -0.0):
            value = environment.radiance(np.array([x, y, x]))
            assert np.any(np.all(value == image[row], axis=-1))


def test_one_texel_shines_everywhere():
    environment = EnvironmentMap(np.array([[[1.0, 2.0, 3.0]]]))
    w = np.concatenate([random_directions(100), np.eye(3), -np.eye(3)])
    np.testing.assert_array_equal(environment.radiance(w), np.broadcast_to((1, 2, 3), w.shape))
    np.testing.assert_allclose(environment.backdrop(w), np.broadcast_to((1, 2, 3), w.shape))


def test_backdrop_passes_through_centres_without_seam():
    environment = random_map((8, 16))
    centres = texel_centres(8, 16)
    np.testing.assert_allclose(environment.backdrop(centres), environment.image, atol=1e-6)
    near = np.array([[1e-7, 0.3, 0.95], [-1e-7, 0.3, 0.95]])
    left, right = environment.backdrop(near / np.linalg.norm(near, axis=-1, keepdims=True))
    np.testing.assert_allclose(left, right, atol=1e-5)
    assert environment.backdrop(centres).dtype == np.float32


# ---------------------------------------------------------------------------------------------
# rotation and irradiance


def test_rotation_is_counter_clockwise_seen_from_above():
    east = turn_about_y(np.array([0.0, 0.0, 1.0]), math.pi / 2)
    np.testing.assert_allclose(east, (1.0, 0.0, 0.0), atol=1e-15)
    environment = EnvironmentMap.sky(sun=(0.0, 20.0), softboxes=False).rotated(math.pi / 2)
    toward = np.array([math.cos(math.radians(20)), math.sin(math.radians(20)), 0.0])
    assert environment.radiance(toward)[0] == 300.0


@given(angle, angle, st.integers(0, 100))
@settings(deadline=None)
def test_rotating_map_and_direction_together_changes_nothing(first, second, seed):
    environment = random_map((5, 8), seed)
    w = random_directions(50, seed)
    # a direction at a border may round to either side
    u, v = direction_to_latlong(w)
    inside = (np.abs((u * 8 + 0.5) % 1 - 0.5) > 1e-6) & (np.abs((v * 5 + 0.5) % 1 - 0.5) > 1e-6)
    w = w[inside]
    turned = environment.rotated(first).rotated(second)
    np.testing.assert_array_equal(
        turned.radiance(turn_about_y(w, first + second)), environment.radiance(w)
    )
    np.testing.assert_allclose(
        turned.irradiance(turn_about_y(w, first + second)), environment.irradiance(w), rtol=1e-9
    )
    np.testing.assert_allclose(
        turned.backdrop(turn_about_y(w, first + second)), environment.backdrop(w), atol=1e-5
    )


@given(sizes, st.integers(0, 100), angle)
@settings(deadline=None)
def test_irradiance_is_the_cosine_weighted_sum(size, seed, rotation):
    environment = random_map(size, seed).rotated(rotation)
    normals = random_directions(5, seed)
    expected = np.zeros((5, 3))
    moments = turn_about_y(texel_moments(environment), rotation)
    for row in range(size[0]):
        for column in range(size[1]):
            cosine = np.maximum(normals @ moments[row, column], 0.0)
            expected += cosine[:, None] * environment.image[row, column]
    np.testing.assert_allclose(environment.irradiance(normals), expected, rtol=1e-6, atol=1e-9)


@given(st.floats(0.0, 1e4), st.integers(0, 100))
@settings(deadline=None, max_examples=20)
def test_irradiance_of_uniform_light(level, seed):
    irradiance = EnvironmentMap.uniform(level, rows=64).irradiance(random_directions(70, seed))
    np.testing.assert_allclose(irradiance, math.pi * float(np.float32(level)), rtol=1e-3)


@given(st.floats(0.0, 10.0), st.floats(0.0, 10.0), st.integers(0, 100))
@settings(deadline=None)
def test_irradiance_is_linear_in_the_light(a, b, seed):
    first, second = random_map((4, 6), seed), random_map((4, 6), seed + 1)
    mixed = EnvironmentMap(a * first.image.astype(float) + b * second.image.astype(float))
    n = random_directions(10, seed)
    expected = a * first.irradiance(n) + b * second.irradiance(n)
    np.testing.assert_allclose(mixed.irradiance(n), expected, rtol=1e-5, atol=1e-6)


def test_scaling_by_number_and_colour():
    environment = random_map((4, 8)).rotated(0.3)
    assert environment.scaled(2.0).rotation == 0.3
    np.testing.assert_allclose(environment.scaled((1, 2, 0)).image, environment.image * (1, 2, 0))
    assert environment.irradiance(np.zeros((2, 0, 3))).shape == (2, 0, 3)


# ---------------------------------------------------------------------------------------------
# construction


def test_the_map_is_its_own_and_frozen():
    given_array = np.ones((2, 4, 3), np.float32)
    environment = EnvironmentMap(given_array)
    given_array[0, 0] = 5.0  # the caller may still write to it
    assert environment.image.max() == 1.0
    with pytest.raises(ValueError, match="read-only"):
        environment.image[0, 0] = 5.0
    assert "2x4" in repr(environment)


@pytest.mark.parametrize(
    ("radiance", "message"),
    [
        (np.ones((4, 8)), r"radiance: expected shape \(rows, columns, 3\), got \(4, 8\)"),
        (np.ones((4, 8, 4)), "expected shape"),
        (np.ones((0, 8, 3)), "expected shape"),
        (np.full((2, 2, 3), math.nan), "got 12 values that are not"),
        (np.full((2, 2, 3), 1e39), "finite float32"),
        (np.full((2, 2, 3), -0.5), "radiance that is not negative, got 12 values down to -0.5"),
    ],
)
def test_maps_refuse_what_is_no_light(radiance, message):
    with pytest.raises(ValueError, match=message):
        EnvironmentMap(radiance)


def test_maps_refuse_other_types_and_angles():
    with pytest.raises(TypeError, match="expected real numbers"):
        EnvironmentMap(np.ones((2, 2, 3), complex))
    with pytest.raises(ValueError, match="rotation: expected a finite number"):
        EnvironmentMap(np.ones((2, 2, 3)), math.nan)


def test_sky_is_deterministic():
    first, second = EnvironmentMap.sky(), EnvironmentMap.sky()
    assert first.image.shape == (128, 256, 3)
    np.testing.assert_array_equal(first.image, second.image)
    assert first.image.min() > 0.0
    assert EnvironmentMap.sky(sun=None).image.max() < 10.0
    assert EnvironmentMap.sky(sun=None, softboxes=False).image.max() < 1.0
    assert EnvironmentMap.sky(rows=1).image.shape == (1, 2, 3)


@given(st.floats(-180.0, 180.0), st.floats(-80.0, 80.0))
@settings(deadline=None, max_examples=20)
def test_sun_stands_where_asked(azimuth, elevation):
    environment = EnvironmentMap.sky(sun=(azimuth, elevation), softboxes=False)
    a, e = math.radians(azimuth), math.radians(elevation)
    toward = np.array([math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)])
    np.testing.assert_array_equal(environment.radiance(toward), (300.0, 270.0, 225.0))
    bright = environment.image[..., 0] == 300.0
    assert np.all(texel_centres(128, 256)[bright] @ toward > math.cos(math.radians(3.001)))


def test_sun_azimuths_are_those_of_the_camera():
    for azimuth, toward in ((0.0, (0, 0, 1)), (90.0, (1, 0, 0)), (180.0, (0, 0, -1))):
        sky = EnvironmentMap.sky(sun=(azimuth, 0.0), softboxes=False)
        assert sky.radiance(np.array(toward, float))[0] == 300.0


@pytest.mark.parametrize("rows", [0, -1, 1.5])
def test_sky_refuses_bad_sizes(rows):
    with pytest.raises(ValueError, match="rows: expected a whole number of at least 1"):
        EnvironmentMap.sky(rows=rows)


# ---------------------------------------------------------------------------------------------
# lights beside the map

point = st.tuples(*[st.floats(-100.0, 100.0)] * 3)


@given(point, point)
@settings(deadline=None)
def test_point_light_falls_off_with_the_square(position, at):
    light = PointLight(position, (1.0, 2.0, 3.0))
    offset = np.subtract(position, at)
    distance = np.linalg.norm(offset)
    direction, irradiance = light.arriving(np.array([at]))
    assert np.isfinite(irradiance).all()
    np.testing.assert_allclose(np.linalg.norm(direction), 1.0, rtol=1e-12)
    if distance > 1e-9:
        np.testing.assert_allclose(irradiance[0] * distance**2, (1, 2, 3), rtol=1e-12)
        np.testing.assert_allclose(direction[0] * distance, offset, atol=1e-12)
        twice, quarter = light.arriving(np.array([at]) - offset)
        np.testing.assert_allclose(quarter * 4.0, irradiance, rtol=1e-9)
        np.testing.assert_allclose(twice, direction, atol=1e-9)


def test_point_light_at_its_own_position():
    direction, irradiance = PointLight((1, 2, 3)).arriving(np.array([[1.0, 2.0, 3.0]]))
    np.testing.assert_array_equal(irradiance, 0.0)
    np.testing.assert_allclose(np.linalg.norm(direction), 1.0)


@given(point, st.floats(1e-300, 1e300))
@settings(deadline=None)
def test_directional_light_is_the_same_everywhere(vector, scale):
    largest = max(map(abs, vector))
    if largest < 1e-3:
        return
    light = DirectionalLight(tuple(c * (scale / 100.0) for c in vector), (1.0, 0.5, 0.25))
    direction, irradiance = light.arriving(np.zeros((4, 3)))
    unit = np.array(vector) / np.linalg.norm(vector)
    np.testing.assert_allclose(direction, np.broadcast_to(unit, (4, 3)), atol=1e-9)
    np.testing.assert_array_equal(irradiance, np.broadcast_to((1.0, 0.5, 0.25), (4, 3)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DirectionalLight((0, 0, 0)), "direction: expected a vector of non-zero length"),
        (lambda: DirectionalLight((0, 1)), "direction: expected three finite numbers, got"),
        (lambda: DirectionalLight((0, 1, math.nan)), "direction: expected three finite numbers"),
        (lambda: DirectionalLight((0, 1, 0), (-1, 0, 0)), "irradiance: .* of at least 0, got"),
        (lambda: PointLight((0, math.inf, 0)), "position: expected three finite numbers"),
        (lambda: PointLight((0, 0, 0), (1, 1, -1)), "intensity: .* of at least 0, got"),
    ],
)
def test_lights_refuse_bad_numbers(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# ---------------------------------------------------------------------------------------------
# the light tree


def reachable(tree):
    found, stack = [], [0]
    while stack:
        node = stack.pop()
        found.append(node)
        stack += [int(c) for c in tree.child[node] if c >= 0]
    return np.array(found)


def check_tree(environment):
    tree = LightTree.build(environment)
    image = environment.image.astype(np.float64)
    texels = np.einsum("ijc,ijk->ck", image, texel_moments(environment))
    scale = np.abs(texels).max() + image.sum()
    np.testing.assert_allclose(tree.moment[0], texels, atol=1e-6 * scale)
    nodes = reachable(tree)
    inner = nodes[np.any(tree.child[nodes] >= 0, axis=1)]
    total = np.zeros((len(inner), 3, 3))
    area = np.zeros(len(inner))
    for side in (0, 1):
        child = tree.child[inner, side]
        total += np.where((child >= 0)[:, None, None], tree.moment[child], 0.0)
        r0, r1, c0, c1 = tree.rectangle[child].T
        area += np.where(child >= 0, (r1 - r0) * (c1 - c0), 0)
    size = np.abs(tree.moment[inner]).max(initial=0.0) + 1e-30
    np.testing.assert_allclose(total, tree.moment[inner], atol=1e-6 * size)
    r0, r1, c0, c1 = tree.rectangle[inner].T
    assert np.all(area <= (r1 - r0) * (c1 - c0))
    # a leaf is one texel; together they are the lit texels
    leaf = nodes[np.all(tree.child[nodes] < 0, axis=1)]
    r0, r1, c0, c1 = tree.rectangle[leaf].T
    if image.any():
        assert np.all((r1 - r0 == 1) & (c1 - c0 == 1))
        lit = np.zeros(image.shape[:2], bool)
        lit[r0, c0] = True
        np.testing.assert_array_equal(lit, image.any(axis=-1))
        assert len(leaf) == lit.sum()
    np.testing.assert_allclose(np.linalg.norm(tree.direction, axis=-1), 1.0, atol=1e-6)
    assert np.all((tree.spread >= 0.0) & (tree.spread <= 1.0))
    assert np.all(tree.radius > 0.0)
    return tree


@pytest.mark.parametrize("size", SIZES[:-1])
def test_light_tree_sums_up(size):
    tree = check_tree(random_map(size))
    assert tuple(tree.rectangle[0]) == (0, size[0], 0, size[1])


@given(sizes, st.integers(0, 100), st.floats(0.0, 1.0))
@settings(deadline=None)
def test_light_tree_leaves_out_the_dark(size, seed, dark):
    rng = np.random.default_rng(seed)
    image = rng.random((*size, 3)) * (rng.random((*size, 1)) >= dark)
    check_tree(EnvironmentMap(image))


@pytest.mark.parametrize("size", SIZES[:-1])
def test_light_tree_of_darkness(size):
    tree = check_tree(EnvironmentMap(np.zeros((*size, 3))))
    assert np.all(tree.child == -1)
    np.testing.assert_array_equal(tree.moment, 0.0)


def test_light_tree_keeps_a_dim_sky_beside_a_bright_sun():
    image = np.full((16, 32, 3), 1e-4)
    image[4, 11] = 1e6
    environment = EnvironmentMap(image)
    tree = LightTree.build(environment)
    sky, node = np.zeros((3, 3)), 0
    while np.any(tree.child[node] >= 0):  # descend to the sun, collecting the siblings on the way
        on_way = -1
        for child in tree.child[node]:
            r0, r1, c0, c1 = tree.rectangle[child]
            if r0 <= 4 < r1 and c0 <= 11 < c1:
                on_way = int(child)
            else:
                sky += tree.moment[child]
        node = on_way
    moments = texel_moments(environment)
    expected = -moments[4, 11] * float(np.float32(1e-4))  # the whole sphere adds up to nothing
    np.testing.assert_allclose(sky, np.tile(expected, (3, 1)), atol=1e-6 * 4e-4 * math.pi)
    np.testing.assert_allclose(tree.moment[node][0], 1e6 * moments[4, 11], rtol=1e-6)


def test_light_tree_spread_of_uniform_light():
    # over the whole sphere the mean direction is zero, so only its variance remains
    tree = LightTree.build(EnvironmentMap.uniform(rows=8))
    assert abs(tree.spread[0] - math.sqrt(0.5)) < 1e-4
    leaf = np.all(tree.child < 0, axis=1)
    assert np.all(tree.spread[leaf] < tree.radius[leaf])


# ---------------------------------------------------------------------------------------------
# files


@pytest.mark.parametrize("name", MAPS)
def test_real_maps_read(shared_data, name):
    path = shared_data / "envmaps" / f"{name}.exr"
    environment = EnvironmentMap.read(path)
    assert environment.image.shape == (256, 512, 3)
    assert environment.image.min() == 0.0
    stored = read_image(path)
    assert environment.clipped_texels == np.count_nonzero((stored < 0.0).any(-1)) > 0
    np.testing.assert_array_equal(environment.image, np.maximum(stored, 0.0))


def test_written_maps_read_back(tmp_path):
    image = random_map((6, 12)).image
    write_exr(tmp_path / "a.exr", image)
    environment = EnvironmentMap.read(tmp_path / "a.exr")
    np.testing.assert_array_equal(environment.image, image)
    assert environment.clipped_texels == 0


def test_undershoot_is_clipped_and_counted(tmp_path):
    image = np.ones((16, 32, 3), np.float32)
    image[8, 0] = 40.0
    image[8, 31] = -9.0  # next to it across the seam, less than a quarter of it
    image[7, 1, 2] = -0.1
    write_exr(tmp_path / "a.exr", image)
    environment = EnvironmentMap.read(tmp_path / "a.exr")
    assert environment.clipped_texels == 2
    np.testing.assert_array_equal(environment.image, np.maximum(image, 0.0))


@pytest.mark.parametrize("layout", ["latlong", "angular", "mirrorball"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -3.0])
def test_maps_that_are_no_light_are_refused(tmp_path, value, layout):
    image = np.ones((16, 16, 3), np.float32)
    image[8, 5, 1] = value
    path = tmp_path / "outlier.exr"
    write_exr(path, image)
    expected = "1 values down to -3" if value == -3.0 else "1 values that are not"
    with pytest.raises(FormatError, match=r"outlier\.exr") as caught:
        EnvironmentMap.read(path, layout=layout)
    assert expected in str(caught.value)


def test_missing_files_and_unknown_layouts(tmp_path):
    with pytest.raises(FileNotFoundError):
        EnvironmentMap.read(tmp_path / "none.exr")
    with pytest.raises(ValueError, match=r"layout: expected .* got 'cube'"):
        EnvironmentMap.read(tmp_path / "none.exr", layout="cube")


def smooth(w):
    """A smooth known radiance of direction, different along all axes."""
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    return np.stack([2.0 + x + 0.5 * y, 2.0 - y + 0.5 * x * z, 2.0 + z - 0.7 * x], axis=-1)


def probe(layout, size=256):
    """A camera's picture: the direction of each pixel, by the definition of the layout."""
    x = (np.arange(size) + 0.5) / size * 2.0 - 1.0
    x, y = np.meshgrid(x, -x)
    r = np.hypot(x, y)
    outside = np.maximum(r, 1.0)
    x, y, r = x / outside, y / outside, np.minimum(r, 1.0)
    if layout == "angular":
        theta = math.pi * r
        return np.stack([x / r * np.sin(theta), y / r * np.sin(theta), -np.cos(theta)], axis=-1)
    n = np.stack([x, y, np.sqrt(1.0 - r * r)], axis=-1)
    ray = np.array([0.0, 0.0, -1.0])
    return ray - 2.0 * np.sum(ray * n, axis=-1, keepdims=True) * n


@pytest.mark.parametrize("layout", ["angular", "mirrorball"])
def test_probes_are_unwrapped(tmp_path, layout):
    directions = probe(layout)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, atol=1e-12)
    write_exr(tmp_path / "probe.exr", smooth(directions))
    environment = EnvironmentMap.read(tmp_path / "probe.exr", layout=layout)
    assert environment.image.shape == (128, 256, 3)
    error = np.abs(environment.image / smooth(texel_centres(128, 256)) - 1.0)
    assert error.mean() < 3e-3
    # the whole rim is one direction, whose neighbourhood has few samples
    blind = texel_centres(128, 256)[..., 2] < -0.98 if layout == "mirrorball" else None
    assert error[~blind if blind is not None else ...].max() < 0.03
