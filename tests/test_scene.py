"""Scenes: which pixels see what, where the camera stands, what stands behind, what hides light."""

from __future__ import annotations

import itertools
import math
import pickle
import time

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from traitbrdf.scene.camera import MAX_SIDE, Camera
from traitbrdf.scene.lights import DirectionalLight, EnvironmentMap, PointLight
from traitbrdf.scene.scene import GROUND, Scene, sample_pattern
from traitbrdf.scene.shapes import Mesh, sphere
from traitbrdf.scene.teapot import teapot

SKY = EnvironmentMap.sky(rows=16)
cameras = st.builds(
    Camera,
    st.floats(-360.0, 360.0),
    st.floats(-90.0, 90.0),
    fov=st.floats(5.0, 120.0),
    zoom=st.floats(0.3, 1.0),
)
few = settings(deadline=None, max_examples=25)


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def quads(*corners, parts=None):
    """Flat quads (4, 3) wound counter-clockwise seen from outside; one part, or one part each."""
    vertices = np.array(corners, np.float64)
    normal = unit(np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0]))
    count = np.arange(len(corners))
    faces = (4 * count[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    part = np.repeat(count if parts else 0 * count, 2)
    return Mesh(
        vertices.reshape(-1, 3), faces, np.repeat(normal, 4, axis=0), part, parts or ("quads",)
    )


def square():
    """A square that faces +z."""
    return quads([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def sheets():
    """Two squares that face +z, one half in front of the other, of one part."""
    near = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    return quads(near, near + np.array([1.0, 0.0, -1.0]))


def flat(made, shift=0.0, scale=1.0, drop=0):
    """A trimesh mesh without its first faces, with the normals of its facets."""
    faces = np.asarray(made.faces)[drop:]
    normals = np.repeat(np.asarray(made.face_normals)[drop:, None], 3, axis=1)
    vertices = scale * (np.asarray(made.vertices) + shift)
    return Mesh(vertices, faces, normals, np.zeros(len(faces), int), ("body",))


def cube():
    return flat(trimesh.creation.box())


def ball(subdivisions, drop=0):
    """A faceted sphere that is shaded smoothly; open where faces are dropped."""
    made = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices, faces = np.asarray(made.vertices), np.asarray(made.faces)[drop:]
    return Mesh(vertices, faces, vertices, np.zeros(len(faces), int), ("ball",))


def spiral(count):
    """Directions (count, 3) spread evenly over the sphere."""
    height = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    around = np.arange(count) * math.pi * (3.0 - math.sqrt(5.0))
    across = np.sqrt(1.0 - height**2)
    return np.stack([across * np.cos(around), height, across * np.sin(around)], axis=-1)


def everything(scene):
    return np.arange(len(scene.normals))


def of_part(scene, name):
    """The samples of one part."""
    where = scene.part_slice(scene.parts.index(name))
    return np.arange(scene.offsets[where.start], scene.offsets[where.stop])


# -- pixels -----------------------------------------------------------------------------------


@few
@given(cameras, st.integers(1, 40), st.integers(1, 40))
def test_without_antialiasing_fragments_are_the_covered_pixels(camera, height, width):
    shape = sphere(1.5, (1.0, -2.0, 3.0))
    scene = Scene(shape, SKY, camera=camera, size=(height, width), subsamples=1)
    count = len(scene.pixels)
    assert scene.coverage == count / (height * width)
    assert scene.part_image.shape == (height, width)
    np.testing.assert_array_equal(np.flatnonzero(scene.part_image.ravel() >= 0), scene.pixels)
    np.testing.assert_array_equal(scene.uncovered, scene.part_image.ravel() < 0)
    np.testing.assert_array_equal(scene.offsets, np.arange(count + 1))
    assert np.all(scene.weights == 1.0)
    assert not scene.bordering.any()
    # through the centres of the pixels
    _, rays = camera.rays(shape, height, width)
    np.testing.assert_allclose(scene.views, -rays.reshape(-1, 3)[scene.pixels], atol=1e-12)
    np.testing.assert_allclose(
        scene.positions, np.array([1.0, -2.0, 3.0]) + 1.5 * scene.normals, atol=1e-6
    )


def test_parts_are_slices_in_order(small_teapot):
    scene = small_teapot
    assert scene.parts == ("rim", "body", "handle", "spout", "lid", "bottom")
    assert np.all(np.diff(scene.pixel_part) >= 0)
    stop = 0
    for i in range(len(scene.parts)):
        where = scene.part_slice(i)
        assert where.start == stop
        stop = where.stop
        assert np.all(scene.pixel_part[where] == i)
        assert np.all(np.diff(scene.pixels[where]) > 0)
    assert stop == len(scene.pixels)
    # every pixel whose centre shows a part has a fragment of it, if not all samples miss it
    seen = np.isin(np.flatnonzero(scene.part_image.ravel() == 1), scene.pixels[scene.part_slice(1)])
    assert seen.mean() > 0.99


# -- samples and fragments --------------------------------------------------------------------

SHAPES = [sphere(1.5, (1.0, -2.0, 3.0)), teapot(4), cube(), sheets()]
scenes = st.builds(
    lambda shape, camera, size, ground, subsamples: Scene(
        shape, SKY, camera=camera, size=size, ground=ground, subsamples=subsamples
    ),
    st.sampled_from(SHAPES),
    cameras,
    st.tuples(st.integers(1, 40), st.integers(1, 40)),
    st.sampled_from([False, True, 0.7]),
    st.sampled_from([1, 2, 5, 8]),
)


@few
@given(scenes)
def test_fragments_share_the_pixels_out(scene):
    size = scene.height * scene.width
    covered = np.bincount(scene.pixels, scene.weights, size)
    np.testing.assert_allclose(covered + scene.uncovered, 1.0, rtol=0.0, atol=1e-6)
    assert np.all(scene.weights > 0.0)
    key = scene.pixel_part.astype(np.int64) * size + scene.pixels
    assert np.all(np.diff(key) > 0)  # sorted by part; each pixel occurs once
    count = np.diff(scene.offsets)
    assert scene.offsets[0] == 0
    assert scene.offsets[-1] == len(scene.normals)
    np.testing.assert_allclose(
        scene.weights[scene.bordering] * scene.subsamples, count[scene.bordering]
    )
    assert np.all(count[~scene.bordering] == 1)
    assert np.all(scene.weights[~scene.bordering] == 1.0)
    # an inner pixel has the part and normal of its centre
    image, inside = scene.part_image.ravel(), ~scene.bordering
    np.testing.assert_array_equal(image[scene.pixels[inside]], scene.pixel_part[inside])
    assert not scene.uncovered[scene.pixels[inside]].any()
    assert scene.uncovered.dtype == np.float32
    assert scene.part_image.dtype == scene.pixel_part.dtype == np.int32
    assert scene.pixels.dtype == scene.offsets.dtype == np.int64


@few
@given(scenes)
def test_samples_lie_in_their_pixels_and_face_the_viewer(scene):
    for name in ("normals", "views", "positions", "starts"):
        assert getattr(scene, name).shape == (scene.offsets[-1], 3)
        assert getattr(scene, name).dtype == np.float64
    np.testing.assert_allclose(np.linalg.norm(scene.normals, axis=-1), 1.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(scene.views, axis=-1), 1.0, atol=1e-9)
    assert np.all(np.sum(scene.normals * scene.views, axis=-1) > 0.0)
    # project back to the image, from the camera's angles
    camera = scene.camera
    a, e = np.radians([camera.azimuth, camera.elevation])
    back = np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    offset = scene.positions - camera.position(scene.shape, scene.height, scene.width)
    pixel = 2.0 * np.tan(np.radians(camera.fov) / 2) / scene.height
    x = scene.width / 2 - offset @ right / (offset @ back) / pixel
    y = scene.height / 2 + offset @ np.cross(back, right) / (offset @ back) / pixel
    sample, owner, _ = scene.samples(np.arange(len(scene.pixels)))
    np.testing.assert_array_equal(sample, everything(scene))
    row, column = np.divmod(scene.pixels[owner], scene.width)
    assert np.all(np.abs(x - column - 0.5) <= 0.5 + 1e-3)
    assert np.all(np.abs(y - row - 0.5) <= 0.5 + 1e-3)


@few
@given(scenes, st.integers(0, 2**32 - 1))
def test_samples_of_chosen_fragments(scene, seed):
    rng = np.random.default_rng(seed)
    index = rng.permutation(len(scene.pixels))[: rng.integers(0, 50)]
    sample, owner, share = scene.samples(index)
    expected = [np.arange(scene.offsets[f], scene.offsets[f + 1]) for f in index]
    np.testing.assert_array_equal(sample, np.concatenate([[], *expected]))
    np.testing.assert_array_equal(owner, np.repeat(np.arange(len(index)), [*map(len, expected)]))
    np.testing.assert_allclose(
        np.bincount(owner, share, len(index)), scene.weights[index], atol=1e-12
    )
    assert all(np.ptp(share[owner == i]) == 0.0 for i in range(len(index)))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("ground", [False, True])
def test_pixels_beside_another_part_are_at_a_border(shape, ground):
    scene = Scene(shape, SKY, size=50, ground=ground)
    image = np.pad(scene.part_image, 1, mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(image, (3, 3)).reshape(50, 50, 9)
    mixed = np.flatnonzero((around != around[..., 4:5]).any(axis=-1).ravel())
    border = np.zeros(2500, bool)
    border[scene.pixels[scene.bordering]] = True
    border |= scene.uncovered.astype(bool) & (scene.part_image.ravel() < 0)
    assert 0 < len(mixed) < 1000
    assert border[mixed].all()


def test_creases_and_jumps_within_a_part_are_borders():
    camera = Camera.orbit(30.0, 25.0)
    solid = Scene(cube(), SKY, camera=camera, size=60)
    whole = solid.bordering & (solid.weights == 1.0)
    sample, owner, _ = solid.samples(np.flatnonzero(whole))
    facets = solid.normals[sample] @ [1.0, 10.0, 100.0]
    kinds = [len(np.unique(facets[owner == i].round(6))) for i in range(whole.sum())]
    assert len(kinds) > 50
    assert np.mean(np.array(kinds) > 1) > 0.2  # beside the crease as well
    # one sheet before the other, with the same normal: the edge between them
    two = Scene(sheets(), SKY, camera=Camera(), size=60)
    x, y, z = two.positions[two.offsets[:-1]].T
    inside = (np.abs(y) < 0.8) & (x > -0.8) & (x < 1.8)
    jump = two.bordering & inside
    assert np.all(np.abs(x[jump] - 1.0) < 0.3)
    assert np.all(two.weights[jump] == 1.0)
    assert 40 < jump.sum() < 100
    depths = [np.ptp(two.positions[a:b, 2]) for a, b in itertools.pairwise(two.offsets)]
    assert np.count_nonzero(np.array(depths)[jump] > 0.9) > 20
    assert z.min() == -1.0


def test_flat_and_gently_curved_surfaces_have_no_borders_inside():
    wide = Camera(azimuth=40.0, elevation=70.0, fov=100.0)
    for shape in (square(), sphere()):
        scene = Scene(shape, SKY, camera=wide, size=200, ground=30.0)
        row, column = np.divmod(scene.pixels[scene.bordering], 200)
        image = np.pad(scene.part_image, 3, mode="edge")
        near = np.lib.stride_tricks.sliding_window_view(image, (7, 7)).reshape(200, 200, 49)
        assert len(row) > 20
        assert np.all(np.ptp(near[row, column], axis=-1) > 0)


def test_antialiasing_finds_the_area_better():
    # seen from afar the outline of a centred sphere is a circle: its area is known
    errors = {1: [], 8: []}
    for zoom in np.linspace(0.4, 0.9, 40):
        camera = Camera(zoom=zoom)
        away = np.linalg.norm(camera.position(sphere(), 32, 32))
        radius = np.tan(np.arcsin(1.0 / away)) / (2.0 * np.tan(np.radians(15.0)))
        for n, found in errors.items():
            scene = Scene(sphere(), SKY, camera=camera, size=32, subsamples=n)
            found.append(scene.coverage - math.pi * radius**2)
    coarse, fine = (np.sqrt(np.mean(np.square(errors[n]))) for n in (1, 8))
    assert fine < 0.4 * coarse
    assert abs(np.mean(errors[8])) < 3e-4


@pytest.mark.parametrize("count", [1, 2, 3, 8, 16, 256])
def test_an_edge_along_the_axes_comes_out_in_equal_steps(count):
    x, y = sample_pattern(count)
    steps = (np.arange(count) + 0.5) / count
    np.testing.assert_allclose(np.sort(x), steps)
    np.testing.assert_allclose(np.sort(y), steps)
    # well spread: no two of 8 samples are nearer than a fifth of a pixel
    if count == 8:
        apart = np.hypot(x[:, None] - x, y[:, None] - y) + np.eye(8)
        assert apart.min() > 0.2


# -- the frame --------------------------------------------------------------------------------


def test_the_default_scene_covers_enough():
    for shape in (sphere(), teapot()):
        assert Scene(shape, SKY, size=64).coverage > 0.2
    assert Scene(sphere(), size=4).environment.image.shape == EnvironmentMap.sky().image.shape
    assert "covered pixels" in repr(Scene(sphere(), SKY, size=4))


def test_a_single_pixel_looks_at_the_middle():
    scene = Scene(sphere(), SKY, camera=Camera.orbit(40.0, 30.0), size=1)
    assert scene.coverage == 1.0
    np.testing.assert_allclose(scene.normals, scene.views, atol=1e-9)
    assert scene.backdrop().shape == (1, 1, 3)


def test_looking_past_the_shape_covers_nothing():
    scene = Scene(sphere(), SKY, camera=Camera(target=(50.0, 0.0, 0.0), zoom=20.0), size=8)
    assert len(scene.pixels) == 0
    assert scene.coverage == 0.0
    assert scene.part_slice(0) == slice(0, 0)


def test_a_centred_sphere_is_symmetric():
    for camera in (Camera(), Camera.orbit(70.0, -25.0), Camera(elevation=90.0)):
        mask = Scene(sphere(), SKY, camera=camera, size=(40, 50)).part_image >= 0
        assert mask.any()
        np.testing.assert_array_equal(mask, mask[::-1])
        np.testing.assert_array_equal(mask, mask[:, ::-1])
        np.testing.assert_array_equal(mask[:, 5:45], mask[:, 5:45].T)


@pytest.mark.parametrize("size", [(40, 40), (24, 60), (60, 24)])
def test_the_whole_shape_fits_and_nearly_fills_the_narrow_side(size):
    mask = Scene(sphere(), SKY, camera=Camera(zoom=0.95), size=size).part_image >= 0
    assert not mask[0].any()
    assert not mask[-1].any()
    assert not mask[:, 0].any()
    assert not mask[:, -1].any()
    across = max(mask.any(axis=0).sum(), mask.any(axis=1).sum())
    assert across >= 0.85 * min(size)
    # pixels are square
    assert mask.any(axis=0).sum() == mask.any(axis=1).sum()


def test_zoom_and_field_of_view():
    sizes = [Scene(sphere(), SKY, camera=Camera(zoom=z), size=64).coverage for z in (0.4, 0.6, 0.9)]
    assert sizes[0] < sizes[1] < sizes[2]
    wide, narrow = (Camera(fov=fov).rays(sphere(), 9, 9) for fov in (80.0, 10.0))
    assert np.linalg.norm(wide[0]) < np.linalg.norm(narrow[0])


# -- conventions ------------------------------------------------------------------------------


def test_the_camera_at_zero_stands_on_z_with_y_up_and_x_to_the_right():
    origin, rays = Camera().rays(sphere(), 5, 7)
    assert origin[2] > 1.0
    np.testing.assert_allclose(origin[:2], 0.0, atol=1e-12)
    np.testing.assert_allclose(rays[2, 3], [0.0, 0.0, -1.0], atol=1e-12)
    assert np.all(rays[0, :, 1] > 0.0)  # the first row looks up
    assert np.all(rays[:, -1, 0] > 0.0)  # the last column looks to +x
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, atol=1e-12)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "place", "up", "right"),
    [
        (0.0, 0.0, (0, 0, 1), (0, 1, 0), (1, 0, 0)),
        (90.0, 0.0, (1, 0, 0), (0, 1, 0), (0, 0, -1)),
        (180.0, 0.0, (0, 0, -1), (0, 1, 0), (-1, 0, 0)),
        (-90.0, 0.0, (-1, 0, 0), (0, 1, 0), (0, 0, 1)),
        (0.0, 90.0, (0, 1, 0), (0, 0, -1), (1, 0, 0)),
        (0.0, -90.0, (0, -1, 0), (0, 0, 1), (1, 0, 0)),
    ],
)
def test_where_the_camera_stands(azimuth, elevation, place, up, right):
    shape = sphere(1.0, (3.0, 4.0, 5.0))
    origin, rays = Camera.orbit(azimuth, elevation).rays(shape, 3, 3)
    away = origin - shape.center
    np.testing.assert_allclose(away / np.linalg.norm(away), place, atol=1e-9)
    np.testing.assert_allclose(rays[1, 1], -np.array(place), atol=1e-9)
    assert (rays[0, 1] - rays[2, 1]) @ np.array(up) > 0.1
    assert (rays[1, 2] - rays[1, 0]) @ np.array(right) > 0.1


def test_the_image_is_not_mirrored():
    """A small sphere on the right (+x) and above (+y) is seen right and above."""
    shape = sphere(0.2, (0.5, 0.5, 0.0))
    mask = Scene(shape, SKY, camera=Camera(target=(0, 0, 0), zoom=0.3), size=60).part_image >= 0
    rows, columns = np.nonzero(mask)
    assert rows.mean() < 30.0
    assert columns.mean() > 30.0


def test_the_teapot_stands_upright_with_its_spout_on_the_right():
    scene = Scene(teapot(), SKY, camera=Camera(), size=80)
    row, column = np.divmod(scene.pixels, scene.width)
    at = {
        name: (row[scene.part_slice(i)].mean(), column[scene.part_slice(i)].mean())
        for i, name in enumerate(scene.parts)
        if scene.part_slice(i).stop > scene.part_slice(i).start
    }
    assert at["lid"][0] < at["body"][0]
    assert abs(at["spout"][1] - at["handle"][1]) > 30.0
    assert at["spout"][1] > at["handle"][1]


def test_another_target():
    origin, rays = Camera(target=(1.0, 2.0, 3.0)).rays(sphere(), 3, 3)
    np.testing.assert_allclose(origin[:2], [1.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(rays[1, 1], [0.0, 0.0, -1.0], atol=1e-12)


def test_normals_face_the_viewer_from_either_side():
    front = Scene(square(), SKY, camera=Camera(), size=9)
    back = Scene(square(), SKY, camera=Camera.orbit(180.0, 0.0), size=9)
    assert len(front.pixels) == len(back.pixels) > 0
    np.testing.assert_allclose(front.normals[:, 2], 1.0, atol=1e-6)
    np.testing.assert_allclose(back.normals[:, 2], -1.0, atol=1e-6)


# -- the backdrop -----------------------------------------------------------------------------


@pytest.mark.parametrize("camera", [Camera(), Camera.orbit(35.0, 20.0), Camera(elevation=-90.0)])
def test_the_backdrop_is_the_map_along_the_rays(camera):
    scene = Scene(sphere(), SKY.rotated(0.3), camera=camera, size=(9, 12))
    _, rays = camera.rays(sphere(), 9, 12)
    backdrop = scene.backdrop()
    assert backdrop.dtype == np.float32
    np.testing.assert_array_equal(backdrop, SKY.rotated(0.3).backdrop(rays))
    assert backdrop.shape == (9, 12, 3)


def test_the_camera_at_zero_looks_at_the_middle_of_the_map():
    image = np.zeros((32, 64, 3))
    image[16:, 32:] = (1.0, 0.5, 0.25)  # below the horizon, right of -z
    backdrop = Scene(sphere(), EnvironmentMap(image), camera=Camera(), size=40).backdrop()
    np.testing.assert_allclose(backdrop[-1, -1], [1.0, 0.5, 0.25])
    assert backdrop[0].max() == 0.0
    assert backdrop[-1, 0].max() == 0.0


# -- the ground -------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_the_ground_lies_under_the_shape_and_changes_nothing_else(shape):
    bare = Scene(shape, SKY, size=50)
    scene = Scene(shape, SKY, size=50, ground=1.5)
    assert scene.parts == (*bare.parts, GROUND)
    assert scene.ground == 1.5
    assert Scene(shape, SKY, size=4, ground=True).ground == 2.0
    assert bare.ground is False
    np.testing.assert_array_equal(np.where(scene.part_image == len(bare.parts), -1,
                                           scene.part_image), bare.part_image)  # fmt: skip
    assert scene.coverage == pytest.approx(bare.coverage, abs=2e-3)  # border pixels may add samples
    own = of_part(scene, GROUND)
    assert len(own) > 100
    assert np.all(scene.positions[own, 1] == shape.lowest)
    assert np.all(scene.normals[own] == [0.0, 1.0, 0.0])
    away = (scene.positions[own] - shape.center)[:, [0, 2]]
    reach = np.linalg.norm(away, axis=1).max() / shape.radius
    assert 1.3 < reach <= 1.5 + 1e-9
    rest = np.setdiff1d(everything(scene), own)
    assert np.all(scene.positions[rest, 1] >= shape.lowest - 1e-9)


@pytest.mark.parametrize(("elevation", "fov"), [(-30.0, 30.0), (-90.0, 30.0), (-50.0, 130.0)])
def test_the_ground_is_not_seen_from_below(elevation, fov):
    # the widest view looks down as well, away from the ground
    camera = Camera.orbit(10.0, elevation, fov=fov, zoom=0.5)
    scene = Scene(sphere(), SKY, camera=camera, size=30, ground=50.0)
    bare = scene.changed(ground=False)
    assert len(of_part(scene, GROUND)) == 0
    np.testing.assert_array_equal(scene.uncovered, bare.uncovered)


def test_a_level_camera_sees_the_ground_edge_on():
    # rays along the ground and almost along it cause no division by zero
    scene = Scene(sphere(), SKY, camera=Camera(elevation=0.0), size=(31, 41), ground=1e3)
    assert len(of_part(scene, GROUND)) > 0
    assert np.isfinite(scene.positions).all()


@pytest.mark.parametrize("ground", [0, 0.0, -1.0, math.nan, math.inf, "big", None, (1.0,)])
def test_bad_grounds(ground):
    with pytest.raises(ValueError, match="ground: expected True, False or a radius"):
        Scene(sphere(), SKY, size=4, ground=ground)


def test_a_shape_with_a_ground_of_its_own_gets_no_other():
    made = quads([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], parts=(GROUND,))
    assert Scene(made, SKY, size=4).parts == (GROUND,)
    with pytest.raises(ValueError, match="without a part 'ground'"):
        Scene(made, SKY, size=4, ground=True)


# -- shadows ----------------------------------------------------------------------------------

UNDER = (0.3, -2.0, 0.5)


def check_shadow(scene, light, inside, least):
    """The ground's samples are dark where `inside` (m,), a measure of nearness, is below one."""
    own = of_part(scene, GROUND)
    toward, irradiance = scene.arriving(light, own)
    expected_toward, given = light.arriving(scene.positions[own])
    np.testing.assert_array_equal(toward, expected_toward)
    lit = irradiance.any(axis=-1)
    np.testing.assert_array_equal(irradiance[lit], given[lit])
    measure = inside(scene.positions[own])
    clear = np.abs(measure - 1.0) > 1e-3
    assert np.count_nonzero(measure < 1.0) > least
    assert clear.mean() > 0.99
    np.testing.assert_array_equal(lit[clear], measure[clear] > 1.0)


@pytest.mark.parametrize("shape", [sphere(0.5, UNDER), teapot(4)])
def test_scenes_without_shadows_cast_no_rays(shape):
    light = PointLight((2.0, -4.0, 3.0))
    scene = Scene(shape, SKY, [light], size=30, ground=True, shadows=False)
    assert not any(scene.casts)
    index = everything(scene)
    assert scene.visible(index, scene.normals).all()
    toward, irradiance = scene.arriving(light, index)
    given_toward, given = light.arriving(scene.positions)
    behind = np.sum(given_toward * scene.normals, axis=-1) <= 0.0
    np.testing.assert_array_equal(toward, given_toward)
    np.testing.assert_array_equal(irradiance[~behind], given[~behind])
    assert not irradiance[behind].any()
    assert 0.1 < behind.mean() < 0.9
    assert scene.rays_cast == 0


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(("azimuth", "elevation"), [(0.0, 80.0), (70.0, 45.0), (200.0, 20.0)])
def test_a_sphere_in_parallel_light_throws_an_ellipse(scale, azimuth, elevation):
    shape = sphere(0.5 * scale, scale * np.array(UNDER))
    scene = Scene(shape, SKY, camera=Camera.orbit(30.0, 40.0), size=150, ground=4.0)
    a, e = np.radians([azimuth, elevation])
    light = DirectionalLight((np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)))

    def ellipse(points):
        level = (points - shape.center)[:, [0, 2]] / shape.radius
        away = np.array([np.sin(a), np.cos(a)])
        along = (level @ away + 1.0 / np.tan(e)) * np.sin(e)
        across = level @ [away[1], -away[0]]
        return np.hypot(along, across)

    check_shadow(scene, light, ellipse, 300)


@pytest.mark.parametrize("make", [sphere, lambda r, c: scaled(ball(6), r, c)])
@pytest.mark.parametrize("place", [(0.0, 3.0, 0.0), (2.5, 1.5, -1.0), (0.0, 1.3, 1.3)])
def test_a_sphere_before_a_point_light_throws_a_cone(make, place):
    shape = make(0.5, np.array(UNDER))
    scene = Scene(shape, SKY, camera=Camera.orbit(30.0, 40.0), size=150, ground=4.0)
    light = PointLight(tuple(np.array(UNDER) + 0.5 * np.array(place)))
    apex = np.array(light.position)

    def cone(points):
        axis = np.array(UNDER) - apex
        cosine = unit(points - apex) @ unit(axis)
        return np.arccos(np.clip(cosine, -1.0, 1.0)) / np.arcsin(0.5 / np.linalg.norm(axis))

    check_shadow(scene, light, cone, 300)


def scaled(mesh, factor, shift):
    return Mesh(
        factor * mesh.vertices + shift, mesh.faces, mesh.normals, mesh.face_part, mesh.parts
    )


def room():
    """A floor of 8 x 8 and on its rim at z = 0 a wall, 6 wide and 4 high."""
    return quads(
        [[-4, 0, 0], [-4, 0, 8], [4, 0, 8], [4, 0, 0]],
        [[-3, 0, 0], [3, 0, 0], [3, 4, 0], [-3, 4, 0]],
        parts=("floor", "wall"),
    )


def test_a_wall_hides_its_solid_angle_of_the_sky():
    scene = Scene(room(), SKY, camera=Camera.orbit(20.0, 50.0), size=60)
    assert scene.casts == (True, True)
    chosen = np.random.default_rng(4).choice(of_part(scene, "floor"), 30, replace=False)
    sky = spiral(8000)
    sky = sky[sky[:, 1] > 0.0]
    seen = scene.visible(np.repeat(chosen, len(sky)), np.tile(sky, (30, 1)))
    x, _, away = scene.positions[chosen].T

    def quarter(width):
        """Solid angle of a rectangle 4 high, from below one of its corners."""
        return np.arctan(width * 4.0 / (away * np.sqrt(away**2 + width**2 + 16.0)))

    exact = 1.0 - (quarter(3.0 - x) + quarter(3.0 + x)) / (2.0 * math.pi)
    assert exact.min() < 0.7 < 0.95 < exact.max()
    np.testing.assert_allclose(seen.reshape(30, -1).mean(axis=1), exact, atol=4e-3)
    assert scene.rays_cast == 30 * len(sky)


def test_point_lights_shine_no_further_than_from_where_they_are():
    # a ceiling over a floor, and lights below, on and above it
    level = np.array([[-1.0, 0.0, -1.0], [-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0]])
    made = quads(3.0 * level, level + np.array([0.0, 2.0, 0.0]), parts=("floor", "ceiling"))
    scene = Scene(made, SKY, camera=Camera.orbit(0.0, 40.0), size=60)
    floor = of_part(scene, "floor")
    hidden = np.abs(scene.positions[floor][:, [0, 2]]).max(axis=1)

    def lit(height):
        return scene.arriving(PointLight((0.0, height, 0.0)), floor)[1].any(axis=-1)

    assert lit(1.9).all()
    assert lit(2.0).all()
    assert not lit(2.001)[hidden < 2.9].any()
    far = lit(1e9)
    assert not far[hidden < 0.99].any()
    assert far[hidden > 1.01].all()
    assert 0.05 < far.mean() < 0.95


def test_light_at_a_sample_is_no_light():
    scene = Scene(square(), SKY, camera=Camera(), size=9)
    for at in (scene.positions[3], scene.starts[3]):
        _, irradiance = scene.arriving(PointLight(tuple(at)), everything(scene))
        assert np.isfinite(irradiance).all()


@pytest.mark.parametrize("shape", [sphere(), cube(), ball(3)])
def test_convex_shapes_need_no_rays(shape):
    light = DirectionalLight((-1.0, 2.0, 0.5))
    scene = Scene(shape, SKY, [light], size=40)
    assert scene.casts == (False,)
    index = everything(scene)
    assert scene.visible(index, np.broadcast_to(spiral(1), scene.normals.shape)).all()
    _, irradiance = scene.arriving(light, index)
    toward = np.array(light.direction)
    np.testing.assert_array_equal(irradiance.any(axis=-1), scene.normals @ toward > 0.0)
    assert scene.rays_cast == 0
    # samples on the ground need rays, and only these
    scene = scene.changed(ground=True)
    assert scene.casts == (False, True)
    own = of_part(scene, GROUND)
    scene.visible(everything(scene), scene.normals)
    assert scene.rays_cast == len(own)
    scene.arriving(light, everything(scene))
    assert scene.rays_cast == 2 * len(own)


@pytest.mark.parametrize("shape", [sphere(), cube()])
def test_from_within_a_convex_shape_all_is_dark(shape):
    scene = Scene(shape, SKY, camera=Camera(zoom=1e3), size=9)
    assert scene.casts == (True,)
    assert not scene.visible(everything(scene), scene.normals).any()
    _, irradiance = scene.arriving(PointLight((9.0, 9.0, 9.0)), everything(scene))
    assert not irradiance.any()
    inside = PointLight(tuple(0.1 * shape.center + 0.01))
    assert scene.arriving(inside, everything(scene))[1].any(axis=-1).all()


def test_the_ground_hides_lights_beneath_it_and_nothing_of_the_map():
    scene = Scene(sphere(), SKY, camera=Camera.orbit(0.0, -30.0), size=40, ground=0.5)
    index = of_part(scene, "sphere")
    down = np.broadcast_to([0.0, -1.0, 0.0], (len(index), 3))
    assert scene.visible(index, down).all()
    _, irradiance = scene.arriving(DirectionalLight((0.0, -1.0, 0.0)), index)
    lit = irradiance.any(axis=-1)
    faces_down = scene.normals[index, 1] < 0.0
    above_disc = np.linalg.norm(scene.positions[index][:, [0, 2]], axis=1) <= 0.5
    np.testing.assert_array_equal(lit, faces_down & ~above_disc)
    assert min(np.count_nonzero(lit), np.count_nonzero(above_disc)) > 20
    # a point light: along the segment to it, if it is below the ground
    for height, hides in ((-1.5, True), (-0.999, False)):
        light = PointLight((0.2, height, 0.1))
        toward, irradiance = scene.arriving(light, index)
        lit = irradiance.any(axis=-1)
        point = scene.positions[index]
        along = (-1.0 - point[:, 1]) / np.where(toward[:, 1] == 0.0, 1.0, toward[:, 1])
        crossing = point + along[:, None] * toward
        faces = np.sum(toward * scene.normals[index], axis=-1) > 0.0
        within = np.hypot(crossing[:, 0], crossing[:, 2]) <= 0.5
        np.testing.assert_array_equal(lit, faces & ~(within & hides))
        assert np.count_nonzero(lit) > 10
    assert scene.rays_cast == 0


@pytest.mark.parametrize("subdivisions", [1, 2, 3])
def test_coarse_triangles_do_not_shadow_a_smooth_surface(subdivisions):
    # the missing face is at the back; an open mesh is not known to be convex
    shape = ball(subdivisions, drop=1)
    hole = ball(subdivisions).vertices[ball(subdivisions).faces[0]].mean(axis=0)
    azimuth, elevation = np.degrees([np.arctan2(-hole[0], -hole[2]), np.arcsin(-hole[1])])
    scene = Scene(shape, SKY, camera=Camera(azimuth, elevation), size=100)
    assert scene.casts == (True,)
    naive = still = 0
    for toward in spiral(40):
        light = DirectionalLight(tuple(toward))
        _, irradiance = scene.arriving(light, everything(scene))
        facing = scene.normals @ toward > 0.15
        assert irradiance[facing].any(axis=-1).all()
        grazing = (scene.normals @ toward > 0.0) & ~facing
        start = scene.positions[grazing] + 1e-4 * scene.normals[grazing]
        naive += np.count_nonzero(
            shape.occluded(start, np.broadcast_to(np.array(light.direction), start.shape))
        )
        still += np.count_nonzero(~irradiance[grazing].any(axis=-1))
    assert still < 0.05 * naive  # this is the purpose of the starts


def test_a_coarse_teapot_is_shadowed_like_a_fine_one():
    frames = []
    for resolution in (4, 32):
        scene = Scene(teapot(resolution), SKY, size=80, ground=True)
        light = DirectionalLight((-1.0, 1.5, 1.0))
        toward, irradiance = scene.arriving(light, everything(scene))
        cosine = np.sum(toward * scene.normals, axis=-1)
        sample, owner, share = scene.samples(np.arange(len(scene.pixels)))
        shaded = share * irradiance[sample, 0] * np.maximum(cosine[sample], 0.0)
        frames.append(np.bincount(scene.pixels[owner], shaded, 80 * 80))
    assert np.mean(np.abs(frames[0] - frames[1])) < 0.03 * np.mean(frames[1])


def test_light_reaches_what_the_camera_sees(small_teapot):
    # nothing hides visible points from the camera, except the offsets of the starts
    scene = small_teapot.changed(ground=True)
    free = scene.visible(everything(scene), unit(
        scene.camera.position(scene.shape, scene.height, scene.width) - scene.starts
    ))  # fmt: skip
    assert free.mean() > 0.99
    # and no light from below the ground passes through the shape
    own = of_part(scene, GROUND)
    dark = ~scene.visible(own, np.broadcast_to([0.0, 1.0, 0.0], (len(own), 3)))
    under = np.hypot(*scene.positions[own][:, [0, 2]].T) < 1.0
    assert dark[under].all()
    assert dark.mean() < 0.5


def test_rays_are_cast_in_chunks(monkeypatch, small_teapot):
    lights = [PointLight((3.0, 4.0, 3.0)), DirectionalLight((-1.0, 2.0, 0.7))]
    rng = np.random.default_rng(0)

    def answers():
        scene = Scene(teapot(4), SKY, size=20, ground=True)
        index = rng.permutation(np.tile(everything(scene), 2))
        directions = unit(rng.normal(size=(len(index), 3)))
        found = [scene.visible(index, directions)]
        found += [scene.arriving(light, index)[1] for light in lights]
        return [scene.normals, scene.starts, scene.weights, scene.rays_cast, *found]

    whole = answers()
    rng = np.random.default_rng(0)
    monkeypatch.setattr("traitbrdf.scene.scene.RAYS_AT_ONCE", 37)
    for a, b in zip(whole, answers(), strict=True):
        np.testing.assert_array_equal(a, b)


def test_directions_are_checked(small_sphere, small_teapot):
    some = np.arange(4)
    for scene in (small_sphere, small_teapot):
        with pytest.raises(ValueError, match=r"directions: expected shape \(4, 3\)"):
            scene.visible(some, np.array([0.0, 1.0, 0.0]))
        nothing = scene.visible(some[:0], np.zeros((0, 3)))
        assert nothing.shape == (0,)
        assert nothing.dtype == bool
        toward, irradiance = scene.arriving(PointLight((9.0, 9.0, 9.0)), some[:0])
        assert toward.shape == irradiance.shape == (0, 3)
    with pytest.raises(ValueError, match="unit vectors"):
        small_teapot.visible(some, np.full((4, 3), 2.0))


# -- other settings ---------------------------------------------------------------------------

NAMES = ("normals", "starts", "views", "weights", "offsets", "pixels", "pixel_part", "uncovered")


@pytest.mark.parametrize(
    "settings",
    [
        {"camera": Camera.orbit(-70.0, 10.0)},
        {"size": 21},
        {"size": (10, 30)},
        {"ground": 3.0},
        {"ground": False},
        {"subsamples": 3},
        {"shadows": False},
        {"lights": [DirectionalLight((0.0, 1.0, 0.0))], "ground": False, "size": 8},
        {"environment": EnvironmentMap.uniform()},
        {},
    ],
)
def test_a_changed_scene_is_one_made_so(settings):
    made = {
        "environment": SKY,
        "lights": (PointLight((9.0, 9.0, 9.0)),),
        "camera": Camera.orbit(20.0, 30.0),
        "size": (20, 24),
        "ground": 1.5,
        "shadows": True,
        "subsamples": 4,
    }
    scene = Scene(teapot(4), **made)
    scene.visible(everything(scene), scene.normals)
    before = {name: getattr(scene, name).copy() for name in NAMES}
    changed, fresh = scene.changed(**settings), Scene(teapot(4), **{**made, **settings})
    for name in NAMES:
        np.testing.assert_array_equal(getattr(changed, name), getattr(fresh, name))
        np.testing.assert_array_equal(getattr(scene, name), before[name])
    for name in ("casts", "parts", "ground", "shadows", "subsamples", "camera", "environment",
                 "lights", "height", "width", "rays_cast"):  # fmt: skip
        assert getattr(changed, name) == getattr(fresh, name)
    reused = changed.normals is scene.normals
    assert reused == (settings.keys() <= {"environment", "lights", "shadows"})


def test_unknown_settings_are_refused(small_sphere):
    for name in ("shape", "enviroment", "fov"):
        with pytest.raises(TypeError, match=name):
            small_sphere.changed(**{name: 3})
    with pytest.raises(TypeError, match="lights"):
        small_sphere.changed(lights=["sun"])
    with pytest.raises(ValueError, match="size"):
        small_sphere.changed(size=0)


# -- any mesh ---------------------------------------------------------------------------------


def with_degenerate_faces():
    solid = cube()
    faces = np.vstack([[[0, 0, 1], [2, 2, 2]], solid.faces, [[3, 4, 3]]])
    normals = np.vstack([np.ones((2, 3, 3)), solid.normals, np.ones((1, 3, 3))])
    return Mesh(solid.vertices, faces, normals, np.zeros(len(faces), int), ("body",))


def with_some_faces_turned():
    solid = cube()
    faces = solid.faces.copy()
    faces[::2] = faces[::2, ::-1]
    return Mesh(solid.vertices, faces, solid.normals, solid.face_part, solid.parts)


def with_normals_inside():
    solid = cube()
    return Mesh(solid.vertices, solid.faces, -solid.normals, solid.face_part, solid.parts)


def with_empty_parts():
    solid = cube()
    return Mesh(
        solid.vertices, solid.faces, solid.normals, np.ones(12, int), ("none", "body", "last")
    )


ODD = {
    "degenerate faces": with_degenerate_faces(),
    "winding turned": with_some_faces_turned(),
    "normals inside": with_normals_inside(),
    "empty parts": with_empty_parts(),
    "open": flat(trimesh.creation.box(), drop=2),
    "one triangle": Mesh(np.eye(3), [[0, 1, 2]], np.ones((3, 3)), [0], ("body",)),
    "tiny": flat(trimesh.creation.torus(2.0, 0.7), scale=1e-6),
    "huge": flat(trimesh.creation.torus(2.0, 0.7), scale=1e6),
    "far off": flat(trimesh.creation.torus(2.0, 0.7), shift=1e3),
}


@pytest.mark.parametrize("name", ODD)
def test_scenes_of_odd_meshes(name):
    shape = ODD[name]
    lights = [
        DirectionalLight((-1.0, 0.8, 0.3)),
        PointLight(tuple(shape.center + shape.radius * np.array([-3.0, 4.0, 2.0]))),
    ]
    scene = Scene(shape, SKY, lights, size=40, ground=True)
    assert 0.02 < scene.coverage < 0.9
    stop = 0
    for i, part in enumerate(scene.parts):
        where = scene.part_slice(i)
        assert where.start == stop
        assert (where.stop > stop) == (part not in ("none", "last"))
        stop = where.stop
    index = everything(scene)
    for light in lights:
        _, irradiance = scene.arriving(light, index)
        assert np.isfinite(irradiance).all()
        assert 0.1 < irradiance.any(axis=-1).mean() < 1.0
    # light from the camera reaches every visible point, whatever the winding and normals
    forced = scene.changed()
    forced.casts = (True,) * len(scene.parts)
    eye = scene.camera.position(shape, 40, 40)
    assert forced.visible(index, unit(eye - scene.starts)).mean() > 0.98
    own = of_part(scene, "body")
    assert not forced.visible(own, -scene.normals[own]).any()  # its own triangle hides it


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_shadows_do_not_depend_on_scale(scale):
    pot = teapot(6)
    other = scaled(pot, scale, scale * np.array([2.0, -1.0, 0.5]))
    a, b = (Scene(shape, SKY, size=40, ground=True) for shape in (pot, other))
    assert np.mean(a.part_image == b.part_image) > 0.998
    assert abs(a.coverage - b.coverage) < 1e-3
    light = DirectionalLight((-1.0, 2.0, 0.7))
    frames = []
    for scene in (a, b):
        sample, owner, share = scene.samples(np.arange(len(scene.pixels)))
        seen = scene.visible(sample, np.broadcast_to(np.array(light.direction), (len(sample), 3)))
        frames.append(np.bincount(scene.pixels[owner], share * seen, 1600))
    assert np.mean(np.abs(frames[0] - frames[1]) > 1e-6) < 0.005


@pytest.mark.slow
def test_half_a_million_triangles_take_seconds():
    made = trimesh.creation.uv_sphere(count=[355, 355])
    vertices, faces = np.asarray(made.vertices), np.asarray(made.faces)
    assert len(faces) > 499_000
    start = time.perf_counter()
    shape = Mesh(vertices, faces, vertices, np.zeros(len(faces), int), ("ball",))
    scene = Scene(shape, SKY, size=64, ground=True)
    free = scene.visible(everything(scene), unit(scene.normals + 0.5 * spiral(1)))
    assert time.perf_counter() - start < 30.0  # some 2 s on an idle machine
    assert free[of_part(scene, "ball")].all()
    assert scene.coverage == pytest.approx(Scene(sphere(), SKY, size=64).coverage, abs=1e-3)


# -- errors -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "size",
    [0, -3, 2.0, math.nan, "64", None, True, (0, 5), (5, -1), (5.0, 5), (1, 2, 3), (), 10**6,
     (MAX_SIDE + 1, 1), [3, None]],
)  # fmt: skip
def test_bad_sizes(size):
    with pytest.raises(ValueError, match="size: expected a whole number"):
        Scene(sphere(), SKY, size=size)


def test_sizes_of_several_kinds():
    for size in ((3, 4), [3, 4], np.array([3, 4]), (np.int64(3), np.uint8(4))):
        scene = Scene(sphere(), SKY, size=size)
        assert (scene.height, scene.width) == (3, 4)
    assert Scene(sphere(), SKY, size=np.int32(3)).height == 3


@pytest.mark.parametrize("subsamples", [0, -1, 257, 2.0, True, None, "8"])
def test_bad_numbers_of_subsamples(subsamples):
    with pytest.raises(ValueError, match="subsamples: expected a whole number from 1 to 256"):
        Scene(sphere(), SKY, size=4, subsamples=subsamples)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"shape": "teapot"}, "shape"),
        ({"shadows": 1}, "shadows"),
        ({"shadows": None}, "shadows"),
        ({"environment": np.ones((2, 4, 3))}, "environment"),
        ({"lights": ["sun"]}, "lights"),
        ({"camera": (0.0, 20.0)}, "camera"),
    ],
)
def test_wrong_kinds(settings, match):
    with pytest.raises(TypeError, match=match):
        Scene(**{"shape": sphere(), "environment": SKY, "size": 4, **settings})


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"azimuth": math.nan}, "azimuth"),
        ({"azimuth": "left"}, "azimuth"),
        ({"elevation": 90.5}, "elevation"),
        ({"elevation": -91.0}, "elevation"),
        ({"fov": 0.0}, "fov"),
        ({"fov": 170.0}, "fov"),
        ({"fov": -30.0}, "fov"),
        ({"zoom": 0.0}, "zoom"),
        ({"zoom": -1.0}, "zoom"),
        ({"zoom": math.inf}, "zoom"),
        ({"target": (1.0, 2.0)}, "target"),
        ({"target": (1.0, 2.0, math.nan)}, "target"),
    ],
)
def test_bad_cameras(change, match):
    with pytest.raises(ValueError, match=match):
        Camera(**change)
    with pytest.raises(ValueError, match=match):
        Camera.orbit(**{"azimuth": 0.0, "elevation": 0.0, **change})


def test_cameras_take_numbers_of_any_kind():
    assert Camera(np.float32(30.0), np.int64(20)) == Camera(30.0, 20.0)
    assert Camera(target=np.array([1, 2, 3])) == Camera(target=(1.0, 2.0, 3.0))


def test_lights_are_kept():
    lights = [PointLight((1.0, 2.0, 3.0)), DirectionalLight((0.0, 1.0, 0.0))]
    assert Scene(sphere(), SKY, lights, size=2).lights == tuple(lights)


# -- primary rays on demand -------------------------------------------------------------------


class Counted:
    """A shape that counts its rays."""

    def __init__(self, shape):
        self._shape, self.rays = shape, 0

    def __getattr__(self, name):
        return getattr(self._shape, name)

    def intersect(self, origins, directions):
        self.rays += len(directions)
        return self._shape.intersect(origins, directions)


def test_primary_rays_wait_until_they_are_needed():
    shape = Counted(sphere())
    scene = Scene(shape, SKY, size=300, ground=True)
    small = scene.changed(size=16, subsamples=1)
    lit = scene.changed(environment=EnvironmentMap.sky(rows=8))
    assert shape.rays == 0
    assert len(small.pixels) > 0
    assert shape.rays == 16 * 16
    assert len(lit.normals) > 90_000
    once = shape.rays
    assert len(lit.pixels) == len(lit.weights) <= len(lit.positions)
    assert shape.rays == once
    with pytest.raises(AttributeError, match="colour"):
        _ = scene.colour
    again = pickle.loads(pickle.dumps(Scene(sphere(), SKY, size=8)))  # noqa: S301
    np.testing.assert_array_equal(again.pixels, Scene(sphere(), SKY, size=8).pixels)


@few
@given(cameras, st.integers(0, 10**6))
def test_projection_is_the_way_back(camera, seed):
    rng = np.random.default_rng(seed)
    shape, size = sphere(0.7, (3.0, 1.0, 0.0)), (30, 50)
    x, y = rng.uniform(0.0, 50.0, 20), rng.uniform(0.0, 30.0, 20)
    origin = camera.position(shape, *size)
    away = rng.uniform(0.1, 50.0, (20, 1))
    found = camera.project(shape, *size, origin + away * camera.through(*size, x, y))
    np.testing.assert_allclose(found, np.stack([x, y], axis=1), atol=1e-6)
    behind = camera.project(shape, *size, origin - away * camera.through(*size, x, y))
    assert np.isnan(behind).all()


def test_rays_of_several_threads_are_those_of_one(monkeypatch):
    scenes = []
    for threads in ("1", "2"):
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        scene = Scene(teapot(8), SKY, size=150, ground=True)
        rng = np.random.default_rng(0)
        at = rng.integers(0, len(scene.normals), 20_000)
        seen = scene.visible(at, unit(rng.normal(size=(20_000, 3))))
        scenes.append((scene.part_image, scene.positions, scene.normals, scene.weights, seen))
        assert scene.rays_cast == 20_000
    for one, other in zip(*scenes, strict=True):
        np.testing.assert_array_equal(one, other)
