"""Scenes: which pixels see what, where the camera stands, what stands behind."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from traitbrdf.lights import DirectionalLight, EnvironmentMap, PointLight
from traitbrdf.scene import MAX_SIDE, Camera, Scene
from traitbrdf.shapes import Mesh, sphere, teapot

SKY = EnvironmentMap.sky(rows=16)
cameras = st.builds(
    Camera,
    st.floats(-360.0, 360.0),
    st.floats(-90.0, 90.0),
    fov=st.floats(5.0, 120.0),
    zoom=st.floats(0.3, 1.0),
)
few = settings(deadline=None, max_examples=25)


def square():
    """A square that faces +z."""
    vertices = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    up = np.broadcast_to([0.0, 0.0, 1.0], vertices.shape)
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]), up, np.zeros(2, int), ("square",))


# -- pixels -----------------------------------------------------------------------------------


@few
@given(cameras, st.integers(1, 40), st.integers(1, 40))
def test_pixels_normals_and_views(camera, height, width):
    scene = Scene(sphere(1.5, (1.0, -2.0, 3.0)), SKY, camera=camera, size=(height, width))
    count = len(scene.pixels)
    assert scene.coverage == count / (height * width)
    assert scene.part_image.shape == (height, width)
    assert np.count_nonzero(scene.part_image >= 0) == count
    assert len(np.unique(scene.pixels)) == count
    for name in ("normals", "views", "positions"):
        assert getattr(scene, name).shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(scene.normals, axis=-1), 1.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(scene.views, axis=-1), 1.0, atol=1e-9)
    assert np.all(np.sum(scene.normals * scene.views, axis=-1) > 0.0)
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
        assert where.stop - where.start == np.count_nonzero(scene.part_image == i)
    assert stop == len(scene.pixels)
    np.testing.assert_array_equal(scene.part_image.ravel()[scene.pixels], scene.pixel_part)
    assert np.all(np.sum(scene.normals * scene.views, axis=-1) > 0.0)


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


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"shape": "teapot"}, "shape"),
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
