"""Stability at the extremes: no NaN, no negative, no overflow, and energy as the table has it.

Roughness, peaks, suns, maps, images and worlds as far out as anybody will take them. Where there is
a closed form or the oracle can follow, the answer is checked against it as well.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from traitbrdf import reference
from traitbrdf.bench.trade import surface_mesh
from traitbrdf.directions import latlong_to_direction, to_local
from traitbrdf.reflectance.brdf import TabulatedBRDF
from traitbrdf.reflectance.models import GGX, BoundedPhong, Lambert
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import DirectionalLight, EnvironmentMap, PointLight
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import Mesh, sphere
from traitbrdf.scene.teapot import teapot
from traitbrdf.session.budget import QUALITIES
from traitbrdf.session.editing import EditSession
from traitbrdf.space.embedding import GRID
from traitbrdf.space.library import default_embedding, default_library
from traitbrdf.space.traits import default_traits
from traitbrdf.transport.lighttree import LightTree
from traitbrdf.transport.operator import Operator
from traitbrdf.transport.transport import Transport

FINEST = QUALITIES["reference"][1]
LIBRARY = default_library()


def tabulated(model, bounded=True):
    """A model's table, scaled down to an albedo of at most 1 if `bounded`.

    Between its nodes a table is linear, a model is not: the peak of roughness 1e-4 has more in it.
    """
    table = TabulatedBRDF.from_model(model, GRID)
    angles = np.radians(np.linspace(0.0, 89.9, 60))
    most = float(table.albedo(angles).max())
    return TabulatedBRDF(GRID, table.values / most) if bounded and most > 1.0 else table


SHARP = {
    "GGX 1e-4": tabulated(GGX(1e-4, 0.2, 3.0)),
    "GGX 1e-3": tabulated(GGX(1e-3, 1.5)),
    "GGX 0.01": tabulated(GGX(0.01, 0.2, 3.0)),
    "GGX 0.1": tabulated(GGX(0.1, 1.5)),
    "GGX 1": tabulated(GGX(1.0, 0.2, 3.0)),
    "Phong 1e6": tabulated(BoundedPhong(0.9, 1e6)),
    "Lambert": tabulated(Lambert(1.0)),
}


def column(table):
    """(cells, 1) of a colourless table."""
    return np.ascontiguousarray(table.values.reshape(-1, 3)[:, 1:2], np.float32)


def facing(scene, index):
    """(m,) cosine of the view, of fragments of one sample."""
    first = scene.offsets[index]
    return np.sum(scene.normals[first] * scene.views[first], axis=-1)


def inner(scene, count, seed=0, part=None):
    """Random fragments of one sample."""
    index = np.flatnonzero(~scene.bordering)
    if part is not None:
        index = index[scene.pixel_part[index] == scene.parts.index(part)]
    return np.sort(np.random.default_rng(seed).permutation(index)[:count])


def ball_mesh(rings=24):
    """A sphere of triangles: convex, but shadow rays are cast."""
    theta = np.linspace(0.0, math.pi, rings + 1)
    phi = np.linspace(0.0, 2.0 * math.pi, 2 * rings + 1)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    points = np.stack([np.sin(t) * np.sin(p), np.cos(t), np.sin(t) * np.cos(p)], axis=-1)
    return surface_mesh(points, points, "ball")


def finite(values):
    """Check for NaN and negative light."""
    found = np.asarray(values)
    assert np.isfinite(found).all()
    assert found.min() >= 0.0
    return found


# -- energy -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHARP)
def test_a_furnace_gives_back_the_albedo(name):
    """Shadows on: what leaves the ball is the albedo of the table to 0.1 %, never above what came.

    The finest quality is held to that; the usual one to 0.5 %, which is what its leaves cost.
    """
    scene = Scene(ball_mesh(), EnvironmentMap.uniform(1.0), size=40)
    assert scene.casts == (True,)
    index = inner(scene, 120)
    table = SHARP[name]
    albedo = table.albedo(np.arccos(np.minimum(facing(scene, index), 1.0)))[:, 1]
    for resolution, allowed in ((FINEST, 1e-3), (1.0, 5e-3)):
        shown = finite(Operator(scene, GRID, resolution).images(index, column(table))[:, :, 0])
        assert abs(shown.mean() / albedo.mean() - 1.0) < allowed
        assert shown.mean() <= 1.0 + 1e-4
    assert table.albedo(np.radians(np.linspace(0.0, 89.9, 60))).max() <= 1.0 + 1e-6


def test_shadows_only_take_away():
    """A teapot in a furnace hides parts of it from itself: energy out is below the table's."""
    scene = Scene(teapot(10), EnvironmentMap.uniform(1.0), size=48)
    index = inner(scene, 200)
    albedo = {}
    for name in ("GGX 1e-4", "GGX 0.1", "Lambert"):
        table = SHARP[name]
        shown = finite(Operator(scene, GRID, FINEST).images(index, column(table))[:, 1, 0])
        angle = np.arccos(np.clip(facing(scene, index), 0.0, 1.0))
        albedo[name] = table.albedo(angle)[:, 1]
        assert shown.sum() < albedo[name].sum() * 1.001
        assert shown.sum() > 0.5 * albedo[name].sum()
        assert shown.max() < 1.02


def test_peaks_of_1e8_and_zeros():
    """The brightest cell that MERL's format can store, in a table of zeros."""
    values = np.zeros((*GRID.shape, 3), np.float32)
    values[0] = 1e8
    table = TabulatedBRDF(GRID, values)
    scene = Scene(sphere(), EnvironmentMap.uniform(1.0), size=24)
    index = inner(scene, 60)
    angle = np.arccos(np.minimum(facing(scene, index), 1.0))
    expected = table.albedo(angle)[:, 0]
    shown = finite(Operator(scene, GRID, FINEST).images(index, column(table))[:, 0, 0])
    assert shown.sum() == pytest.approx(expected.sum(), rel=5e-3)
    sun = np.zeros((64, 128, 3))
    sun[20, 30] = 1e6
    under = Scene(sphere(), EnvironmentMap(sun), size=24)
    finite(Operator(under, GRID).images(inner(under, 60), column(table)))
    nothing = np.zeros((GRID.size, 1), np.float32)
    assert not Operator(scene, GRID).images(index, nothing).any()


@pytest.mark.parametrize("name", ["GGX 1e-4", "Phong 1e6"])
def test_a_session_shows_needles(name):
    """The error of tables far sharper than the training set is noticed."""
    scene = Scene(sphere(), EnvironmentMap.uniform(0.5), size=16)
    session = EditSession(scene, quality="reference", cache=False)
    session.assign("sphere", SHARP[name])
    image = finite(session.render())
    assert session.report()["parts"]["sphere"]["tier"] != "basis"
    index = inner(scene, 60)
    albedo = SHARP[name].albedo(np.arccos(np.minimum(facing(scene, index), 1.0)))[:, 1]
    shown = image.reshape(-1, 3)[scene.pixels[index], 1]
    assert shown.sum() == pytest.approx(0.5 * albedo.sum(), rel=5e-3)


# -- light ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["GGX 0.01", "GGX 0.1", "GGX 1", "Lambert"])
def test_a_sun_of_one_texel_beside_a_dark_sky(name):
    """A sun of 1e6 and a sky of 1e-4: both are right."""
    image = np.full((64, 128, 3), 1e-4)
    image[18, 70] = 1e6
    scene = Scene(sphere(), EnvironmentMap(image), camera=Camera.orbit(10.0, 20.0), size=32)
    index = inner(scene, 150)
    table = SHARP[name]
    shown = finite(Operator(scene, GRID).images(index, column(table))[:, 1, 0])
    true, _ = reference.fragments(scene, index, [table], 1e-3)
    true = true[:, 0, 1]
    assert reference.relative_error(shown, true) < 0.01
    # behind the terminator the sky alone shines; where the horizon cuts the sun's texel, whose
    # radius is 0.035, it is there or not as a whole
    toward = latlong_to_direction(70.5 / 128, 18.5 / 64)
    assert scene.environment.radiance(toward)[0] == 1e6
    lit = scene.normals[scene.offsets[index]] @ toward
    dark = (true < 1e-3) & (np.abs(lit) > 0.035)
    assert np.count_nonzero(dark) > 10
    np.testing.assert_allclose(shown[dark], true[dark], rtol=0.05)


def test_a_black_map_is_black():
    scene = Scene(teapot(8), EnvironmentMap(np.zeros((4, 8, 3))), size=16)
    session = EditSession(scene, quality="preview", cache=False)
    session.assign(scene.parts, "chrome")
    assert not session.render().any()
    assert session.frame_error == 0.0


def test_a_map_of_one_texel_is_a_furnace():
    one = Scene(sphere(), EnvironmentMap(np.full((1, 1, 3), 0.7)), size=24)
    many = Scene(sphere(), EnvironmentMap.uniform(0.7, rows=32), size=24)
    index = inner(one, 60)
    for name in ("GGX 0.1", "Lambert"):
        shown, expected = (
            finite(Operator(scene, GRID).images(index, column(SHARP[name])))
            for scene in (one, many)
        )
        np.testing.assert_allclose(shown, expected, rtol=5e-3)


def test_blocks_of_texels_shine_as_their_texels():
    """In large maps a leaf of the tree is a block of texels, which the walk cuts further."""
    rng = np.random.default_rng(0)
    image = 0.1 + rng.random((300, 602, 3)) ** 8
    image[100, 217] = 1e4
    environment = EnvironmentMap(image, 0.4)
    scene = Scene(sphere(), environment, size=32)
    index = inner(scene, 100)
    tables = np.concatenate([column(SHARP[n]) for n in ("GGX 0.01", "GGX 0.1", "Lambert")], axis=1)
    fine = LightTree.build(environment)
    assert fine.block == 1
    plain = finite(Operator(scene, GRID).images(index, tables))
    coarse = LightTree.build(environment, most_rows=80)
    assert coarse.block == 4
    assert len(coarse.radius) < 0.1 * len(fine.radius)
    np.testing.assert_allclose(coarse.moment[0], fine.moment[0], rtol=1e-6)
    blocks = finite(Operator(scene, GRID, tree=coarse).images(index, tables))
    # the map's rows and columns are no multiples of 4: the last blocks are smaller
    error = np.abs(blocks - plain).mean(axis=(0, 1)) / plain.mean(axis=(0, 1))
    assert error.max() < 6e-3


@pytest.mark.slow
def test_a_map_of_8192_by_4096():
    """The largest maps on the market, with a one-texel sun and a bright floor."""
    rows = 4096
    image = np.empty((rows, 2 * rows, 3), np.float32)
    image[:] = np.linspace(0.2, 1.0, rows, dtype=np.float32)[:, None, None]
    image[1000, 3000] = 1e6
    scene = Scene(sphere(), EnvironmentMap(image), size=24)
    index = inner(scene, 40)
    tables = np.concatenate([column(SHARP["GGX 0.1"]), column(SHARP["Lambert"])], axis=1)
    shown = finite(Operator(scene, GRID).images(index, tables))
    irradiance = scene.environment.irradiance(scene.normals[scene.offsets[index]])
    np.testing.assert_allclose(shown[..., 1], irradiance / math.pi, rtol=2e-3)


# -- grazing ----------------------------------------------------------------------------------


def floor():
    """A square of 2 by 2 that faces up."""
    points = np.array([[-1.0, 0.0, -1.0], [-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0]])
    up = np.tile([0.0, 1.0, 0.0], (4, 1))
    return Mesh(points, [[0, 1, 2], [0, 2, 3]], up, [0, 0], ("floor",))


@pytest.mark.parametrize("light", [0.0, 45.0, 89.99])
@pytest.mark.parametrize("view", [0.0, 60.0, 89.99])
def test_grazing_light_and_view(view, light):
    """Exact: irradiance times f and the cosine. Includes light exactly at the view."""
    black = EnvironmentMap(np.zeros((2, 4, 3)))
    t = math.radians(light)
    sun = DirectionalLight((0.0, math.cos(t), math.sin(t)), (2.0, 2.0, 2.0))
    # from so far that all pixels look alike, or the narrowest lobes would show the difference; at
    # 89.99 degrees from near by, that the picture has a strip of the floor
    far = {"fov": 0.01, "zoom": 3000.0} if view > 80.0 else {"fov": 0.05}
    scene = Scene(floor(), black, [sun], Camera.orbit(0.0, 90.0 - view, **far), size=17)
    index = np.arange(len(scene.pixels))
    assert len(index) > 50
    sample, owner, share = scene.samples(index)
    toward = np.broadcast_to(np.asarray(sun.direction), (len(sample), 3))
    wi, wo = (to_local(w, scene.normals[sample]) for w in (toward, scene.views[sample]))
    # a scene shows no surface at more than 89.43 degrees to its normal
    assert np.degrees(np.arccos(wo[:, 2])) == pytest.approx(min(view, 89.427), abs=0.1)
    for name, table in SHARP.items():
        shown = finite(Operator(scene, GRID).images(index, column(table))[:, 1, 0])
        f = table.eval(wi, wo)[:, 1] * np.maximum(wi[:, 2], 0.0)
        expected = np.bincount(owner, share * f * 2.0, minlength=len(index))
        if name in ("GGX 1e-4", "GGX 1e-3", "Phong 1e6"):
            # float32 resolves an angle of 1e-4 to some percent: compare the sum, not each pixel
            assert shown.sum() == pytest.approx(expected.sum(), rel=0.05, abs=1e-6)
        else:
            np.testing.assert_allclose(shown, expected, rtol=5e-3, atol=1e-5 * (1 + expected.max()))


# -- traits -----------------------------------------------------------------------------------


@pytest.mark.parametrize("amount", [100.0, -100.0])
def test_traits_by_a_hundred(amount):
    """The move ends at the limits of the library, or at the walls of the box if allowed."""
    space, embedding = default_traits(), default_embedding()
    start = LIBRARY.coordinates[LIBRARY.names.index("blue-plastic")]
    for name in space.names:
        for photoreal in (True, False):
            z = space.reach(start, {name: amount}, photoreal=photoreal).z
            assert np.isfinite(z).all()
            table = embedding.decode(z)
            finite(table.values)
            assert table.max_albedo() <= 1.001


def test_a_session_survives_them_all():
    scene = Scene(teapot(8), EnvironmentMap.sky(rows=16), size=20)
    session = EditSession(scene, quality="preview", cache=False)
    before = session.render().copy()
    for name in ("shiny", "metallic", "rough", "dusty", "bright"):
        for amount in (100.0, -100.0):
            session.move("body", **{name: amount})
            finite(session.render())
    for _ in range(10):
        session.undo()
    np.testing.assert_array_equal(session.render(), before)


# -- stores -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "allowed"), [(torch.float16, 1e-3), (torch.bfloat16, 8e-3)])
def test_half_precision_stores(training, dtype, allowed):
    """Columns are scaled: neither a peak of 1e8 nor a sun of 1e6 overflows, nothing underflows."""
    image = np.full((32, 64, 3), 1e-4)
    image[8, 20] = 1e6
    values = SHARP["GGX 0.1"].values.copy()
    values[0] = 1e8
    for environment in (EnvironmentMap(image), EnvironmentMap.sky(rows=32)):
        scene = Scene(sphere(), environment, size=28)
        plain = Transport(scene, GRID, training, rank=24)
        half = plain.stored(dtype)
        assert half.bytes < plain.bytes
        for table in (LIBRARY["blue-plastic"].values, LIBRARY["chrome"].values, values):
            seen = torch.from_numpy(np.ascontiguousarray(table.reshape(-1, 3)[plain.cells]))
            one, two = (finite(t.shade(0, seen.float()).radiance) for t in (plain, half))
            assert reference.relative_error(two, one) < allowed
    with pytest.raises(ValueError, match="float32, float16 or bfloat16"):
        plain.stored(torch.int8)


def test_a_store_of_half_precision_learns(training):
    """The basis learns frames outside its span, and keeps its type and accuracy."""
    scene = Scene(sphere(), EnvironmentMap.sky(rows=32), size=28)
    half = Transport(scene, GRID, training, rank=16).stored(torch.float16)
    table = np.ascontiguousarray(SHARP["GGX 0.01"].values.reshape(-1, 3), np.float32)
    exact = half.shade_exactly(0, table)
    half.train(0, exact.radiance)
    assert half.bases[0].basis.dtype == torch.float16
    shown = half.shade(0, torch.from_numpy(table[half.cells]))
    assert reference.relative_error(shown.radiance, exact.radiance) < 0.02


# -- images and worlds ------------------------------------------------------------------------


def test_an_image_of_one_pixel():
    scene = Scene(sphere(), EnvironmentMap.sky(rows=16), size=1)
    session = EditSession(scene, quality="preview", cache=False)
    session.assign("sphere", "gold-polished")
    image = finite(session.render())
    assert image.shape == (1, 1, 3)
    assert image.min() > 0.0
    true = reference.render(scene, session.brdf("sphere"), 1e-3)
    assert reference.relative_error(image, true) < 0.02


@pytest.mark.slow
def test_an_image_of_4096_by_4096():
    """Far away: the image has 16.8 million pixels, some thousands show the ball."""
    camera = Camera.orbit(20.0, 30.0, zoom=0.02)
    scene = Scene(sphere(), EnvironmentMap.sky(rows=32), camera=camera, size=4096)
    session = EditSession(scene, quality="preview", cache=False)
    session.assign("sphere", "blue-plastic")
    image = finite(session.render())
    assert image.shape == (4096, 4096, 3)
    whole = scene.backdrop()
    away = (scene.uncovered == 1.0).reshape(4096, 4096)
    np.testing.assert_allclose(image[away], whole[away], rtol=1e-6)
    index = inner(scene, 40)
    true, _ = reference.fragments(scene, index, [session.brdf("sphere")], 1e-3)
    shown = image.reshape(-1, 3)[scene.pixels[index]]
    assert reference.relative_error(shown, true[:, 0]) < 0.05


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_size_of_the_world_does_not_matter(scale):
    """Scaling shape and lamps by a million does not change the picture."""
    shape = teapot(8)

    def world(s):
        mesh = Mesh(shape.vertices * s, shape.faces, shape.normals, shape.face_part, shape.parts)
        lamp = PointLight((2.0 * s, 3.0 * s, 2.0 * s), np.full(3, 9.0 * s * s))
        return Scene(mesh, EnvironmentMap.sky(rows=16), [lamp], size=32, ground=True)

    one, other = world(1.0), world(scale)
    np.testing.assert_array_equal(one.pixels, other.pixels)
    for name in ("GGX 0.1", "Lambert"):
        shown, expected = (
            finite(
                np.concatenate(
                    [
                        Operator(scene, GRID).part_images(part, column(SHARP[name]))
                        for part in range(len(scene.parts))
                    ]
                )
            )
            for scene in (other, one)
        )
        # a shadow ray that grazes an edge may pass on either side
        close = np.isclose(shown, expected, rtol=1e-3, atol=1e-6).all(axis=(1, 2))
        assert np.mean(close) > 0.995


# -- darkness -------------------------------------------------------------------------------------


def closed() -> Mesh:
    """A cube of 12 triangles."""
    corner = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    sides = corner[faces]
    facet = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    normals = np.repeat(facet[:, None], 3, axis=1)
    return Mesh(corner, faces, normals, np.zeros(12, int), ("cube",))


@pytest.mark.parametrize("shape", ["cube", "sphere"])
@pytest.mark.parametrize("light", [1.0, 1e-30, 0.0])
def test_a_camera_inside_sees_black_and_goes_on(shape, light):
    environment = EnvironmentMap.sky(rows=16).scaled(light)
    made = closed() if shape == "cube" else sphere()
    inside = Camera.orbit(20, 10, zoom=40.0)
    edit = EditSession(Scene(made, environment, camera=inside, size=64), cache=False)
    edit.assign(shape, "red-rubber")
    brightest = float(environment.image.max())
    for _ in range(2):
        frame = edit.render()
        assert np.isfinite(frame).all()
        assert frame.min() >= 0.0 and frame.max() <= 1e-5 * brightest
        edit.move(shape, shiny=0.3)
        edit.render(exact=False)
        edit.look(camera=Camera.orbit(50, 10, zoom=40.0))
    assert math.isfinite(edit.report()["frame_error"])
    edit.look(camera=Camera.orbit(20, 10))  # out again
    assert edit.render().max() > 0.0 or light == 0.0


@pytest.mark.parametrize("factor", [1e-30, 1e-38])
def test_near_zero_light_scales_the_frame(factor):
    frames = []
    for scale in (1.0, factor):
        environment = EnvironmentMap.sky(rows=16).scaled(scale)
        scene = Scene(sphere(), environment, camera=Camera.orbit(20, 10), size=32)
        edit = EditSession(scene, cache=False)
        edit.assign("sphere", "red-rubber")
        frames.append(edit.render().astype(np.float64) / scale)
    np.testing.assert_allclose(frames[1], frames[0], rtol=0.02, atol=1e-3 * frames[0].max())
