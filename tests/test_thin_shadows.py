"""Shadows of things thinner than the spacing of shadow rays: whole, and dark enough."""

from __future__ import annotations

import math

import numpy as np
import pytest

from traitbrdf.directions import latlong_to_direction
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import DirectionalLight, EnvironmentMap, PointLight, texel_moments
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import Mesh, sphere
from traitbrdf.scene.teapot import teapot
from traitbrdf.space.embedding import GRID
from traitbrdf.transport.operator import Operator
from traitbrdf.transport.thin import light_on_thin_shadows, shadows_near

GREY = np.full((GRID.size, 1), 1.0 / math.pi, np.float32)
CAMERA = Camera.orbit(20.0, 50.0)
TOWARD = np.array([0.41, 0.77, 0.49]) / np.linalg.norm([0.41, 0.77, 0.49])
WIDTHS = (0.1, 0.3, 1.0, 2.0)


def tubes(segments, radius, sides=8):
    """A mesh of closed tubes along segments (start, end)."""
    points, normals, faces = [], [], []
    first = 0
    for start, end in np.asarray(segments, np.float64):
        along = (end - start) / np.linalg.norm(end - start)
        u = np.cross(along, (0.0, 1.0, 0.0) if abs(along[1]) < 0.9 else (1.0, 0.0, 0.0))
        u /= np.linalg.norm(u)
        angle = np.arange(sides)[:, None] * 2.0 * math.pi / sides
        ring = np.cos(angle) * u + np.sin(angle) * np.cross(along, u)
        points += [start + radius * ring, end + radius * ring, start[None], end[None]]
        normals += [ring, ring, -along[None], along[None]]
        k = first + np.arange(sides)
        after = first + (np.arange(sides) + 1) % sides
        low, high = np.full(sides, first + 2 * sides), np.full(sides, first + 2 * sides + 1)
        faces += [np.stack(f, axis=1) for f in (
            (k, after, after + sides), (k, after + sides, k + sides),
            (after, k, low), (k + sides, after + sides, high),
        )]  # fmt: skip
        first += 2 * sides + 2
    faces = np.concatenate(faces)
    return Mesh(np.concatenate(points), faces, np.concatenate(normals),
                np.zeros(len(faces), np.int64), ["wire"])  # fmt: skip


def ribbon(start, end, width):
    """A strip without thickness, in the plane of the ground."""
    along = (end - start) / np.linalg.norm(end - start)
    side = 0.5 * width * np.cross(along, (0.0, 1.0, 0.0))
    points = np.array([start - side, start + side, end + side, end - side])
    up = np.tile((0.0, 1.0, 0.0), (4, 1))
    return points, np.array([[0, 1, 2], [0, 2, 3]]), up


def lamp(radius, rows=128):
    """A map of one round lamp of a radius in degrees; 0 is one texel."""
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(2 * rows) + 0.5) / (2 * rows),
                       indexing="ij")  # fmt: skip
    cos = latlong_to_direction(u, v) @ TOWARD
    image = np.full((rows, 2 * rows, 3), 1e-3)
    image[cos >= min(math.cos(math.radians(radius)), cos.max())] = 3000.0
    return EnvironmentMap(image)


def wire(width, angle, size=96, **settings):
    """A straight wire, some pixels wide, above the ground, at an angle in degrees to +x."""
    turn = math.radians(angle)
    along = np.array([math.cos(turn), 0.0, math.sin(turn)])
    raised = np.array([0.0, 0.35, 0.0])
    # what stands on the ground, far from the shadow, says how high the wire is
    foot = np.array([[-0.9, 0.0, 0.6], [-0.88, 0.0, 0.6]])
    segments = [(raised - along, raised + along), foot]
    rough = tubes(segments, 0.01)
    away = np.linalg.norm(CAMERA.position(rough, size, size) - rough.center)
    pixel = 2.0 * math.tan(math.radians(CAMERA.fov) / 2) / size * away
    mesh = tubes(segments, 0.5 * width * pixel)
    return Scene(mesh, camera=CAMERA, size=size, ground=True, **settings), segments[0]


def lamps_of(scene):
    """Directions (k, 3) and flux (k,) of a map's bright texels, cut into quarters of a degree."""
    image = scene.environment.image.repeat(2, axis=0).repeat(2, axis=1)
    fine = EnvironmentMap(image)
    bright = image[..., 0] > 1.0
    moment = texel_moments(fine)[bright]
    size = np.linalg.norm(moment, axis=-1)
    return moment / size[:, None], image[bright, 0] * size


def hidden_light(scene, fragments, sources, places=12):
    """What a white, matte ground lacks: the mean over each pixel of light that the wire hides.

    `sources` are pairs of irradiance and a function of points that gives directions and distances.
    """
    x, y = scene.pixels[fragments] % scene.width, scene.pixels[fragments] // scene.width
    # uneven steps, so that lines along the axes are met in proportion
    rng = np.random.default_rng(7)
    step = (np.arange(places) + rng.uniform(0.0, 1.0, (2, len(x), places, places))) / places
    u, v = step[0], step[1].swapaxes(1, 2)
    origin = scene.camera.position(scene.shape, scene.height, scene.width)
    rays = scene.camera.through(
        scene.height, scene.width, (x[:, None, None] + u).ravel(), (y[:, None, None] + v).ravel()
    )
    points = origin + (scene.shape.lowest - origin[1]) / rays[:, 1:2] * rays
    lacking = np.zeros(len(points))
    for irradiance, reach in sources:
        toward, far = reach(points)
        blocked = scene.shape.occluded(points, toward, far)
        lacking += irradiance / far_squared(far) * toward[:, 1] / math.pi * blocked
    return lacking.reshape(len(x), -1).mean(axis=1)


def far_squared(far):
    return np.where(np.isfinite(far), far, 1.0) ** 2


def from_afar(direction):
    return lambda points: (np.broadcast_to(direction, points.shape), np.full(len(points), np.inf))


def from_point(position):
    def reach(points):
        offset = np.asarray(position) - points
        far = np.linalg.norm(offset, axis=-1)
        return offset / far[:, None], far

    return reach


def along_the_shadow(scene, segment, toward):
    """Ground fragments around the shadow's middle line, and their place along it in pixels."""
    foot = [p - toward * (p[1] - scene.shape.lowest) / toward[1] for p in segment]
    ends = scene.camera.project(scene.shape, scene.height, scene.width, np.array(foot))
    length = np.linalg.norm(ends[1] - ends[0])
    line = (ends[1] - ends[0]) / length
    span = scene.part_slice(len(scene.parts) - 1)
    fragments = np.arange(span.start, span.stop)
    pixel = scene.pixels[fragments]
    offset = np.stack([pixel % scene.width, pixel // scene.width], axis=1) + 0.5 - ends[0]
    along, across = offset @ line, offset @ (-line[1], line[0])
    chosen = (np.abs(across) < 8.0) & (along > 0.12 * length) & (along < 0.88 * length)
    chosen &= scene.weights[fragments] == 1.0
    return fragments[chosen], along[chosen] - 0.12 * length


def compare(scene, segment, sources, toward):
    """Ratio of the mean darkness to the true one, and the unevenness along of both."""
    part = len(scene.parts) - 1
    chosen, along = along_the_shadow(scene, segment, toward)
    lit, shown = (
        Operator(s, GRID).part_images(part, GREY)[..., 0].mean(axis=1)
        for s in (scene.changed(shadows=False), scene)
    )
    first = scene.part_slice(part).start
    darker = (lit - shown)[chosen - first].astype(np.float64)
    true = hidden_light(scene, chosen, sources)
    # as many pixels lie in each piece, but the shadow crosses their corners differently
    piece = (along / 4.0).astype(np.int64)
    full = np.bincount(piece)[:-1]
    got, expected = (np.bincount(piece, d)[:-1] / full for d in (darker, true))
    return darker.sum() / true.sum(), got / got.mean() - expected / expected.mean()


def judge(name, ratio, uneven):
    print(f"{name}: darkness {ratio:.3f}, unevenness {uneven.std():.3f}")
    assert abs(ratio - 1.0) < 0.1, name
    assert uneven.std() < 0.15, name
    assert uneven.min() > -0.5, name


def in_map(radius, width, angle, size=96):
    scene, segment = wire(width, angle, size, environment=lamp(radius))
    toward, flux = lamps_of(scene)
    sources = [(f, from_afar(w)) for w, f in zip(toward, flux, strict=True)]
    middle = flux @ toward
    return compare(scene, segment, sources, middle / np.linalg.norm(middle))


@pytest.mark.parametrize("width", WIDTHS)
def test_shadow_of_a_wire_under_a_lamp(width):
    judge(f"{width} pixels", *in_map(2.0, width, 35.0))


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("angle", [-20.0, 10.0, 80.0])
@pytest.mark.parametrize("width", WIDTHS)
def test_shadows_of_wires_under_lamps(radius, angle, width):
    judge(f"lamp {radius}, {angle} degrees, {width} pixels", *in_map(radius, width, angle, 128))


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("kind", ["directional", "point"])
def test_shadow_of_a_wire_in_light_beside_the_map(kind, width):
    dark = EnvironmentMap(np.zeros((4, 8, 3)))
    position = 4.0 * TOWARD
    light = DirectionalLight(tuple(TOWARD), (3.0,) * 3)
    sources = [(3.0, from_afar(TOWARD))]
    if kind == "point":
        light, sources = PointLight(tuple(position), (30.0,) * 3), [(30.0, from_point(position))]
    scene, segment = wire(width, 35.0, environment=dark, lights=[light])
    if kind == "point":  # along the line where the light's rays past the wire's ends fall
        ends = np.array(segment)
        low = scene.shape.lowest
        fall = (ends[:, 1:2] - low) / (position[1] - ends[:, 1:2])
        segment = ends + fall * (ends - position)
        segment[:, 1] = low
    judge(f"{kind}, {width} pixels", *compare(scene, segment, sources, TOWARD))


@pytest.mark.parametrize("place", [(40.0, 50.0), (-50.0, 40.0)])
@pytest.mark.parametrize("width", [0.1, 0.3])
def test_a_wire_under_a_sky_is_not_dashed(place, width):
    """Under soft light and a sun: no piece of the shadow is much lighter than another."""
    sky = EnvironmentMap.sky(sun=place, rows=64)
    scene, segment = wire(width, 35.0, 160, environment=sky)
    a, e = np.radians(place)
    sun = np.array([math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)])
    chosen, along = along_the_shadow(scene, segment, sun)
    part = len(scene.parts) - 1
    lit, shown = (
        Operator(s, GRID).part_images(part, GREY)[..., 0].mean(axis=1)
        for s in (scene.changed(shadows=False), scene)
    )
    darker = (lit - shown)[chosen - scene.part_slice(part).start]
    piece = (along / 6.0).astype(np.int64)
    found = (np.bincount(piece, darker) / np.bincount(piece))[:-1]
    print(np.round(found / found.mean(), 2))
    assert found.std() < 0.2 * found.mean()
    assert found.min() > 0.6 * found.mean()


def test_a_ribbon_without_thickness_is_thin():
    """Also what has no inside, and what is made of many triangles."""
    start, end = np.array([-0.9, 0.4, -0.5]), np.array([0.9, 0.4, 0.3])
    points, faces, up = ribbon(start, end, 0.01)
    stand, foot, level = ribbon(np.array([-0.9, 0.0, 0.9]), np.array([-0.2, 0.0, 0.9]), 0.5)
    mesh = Mesh(np.concatenate([points, stand]), np.concatenate([faces, foot + 4]),
                np.concatenate([up, level]), np.zeros(4, np.int64), ["strip"])  # fmt: skip
    light = DirectionalLight(tuple(TOWARD))
    scene = Scene(mesh, lights=[light], camera=CAMERA, size=96, ground=True)
    near = shadows_near(scene, light)
    assert near is not None
    middle = 0.5 * (start + end)
    foot_at = middle - TOWARD * middle[1] / TOWARD[1]
    at = scene.camera.project(mesh, 96, 96, foot_at).astype(np.int64)
    ground = scene.pixel_part == 1
    assert near[ground & (scene.pixels == at[1] * 96 + at[0])].all()
    assert near.sum() < 0.2 * len(near)


@pytest.mark.parametrize("shape", [sphere, teapot])
def test_thick_things_take_the_usual_path(shape):
    """No fragment is split, so that a scene without thin things costs what it did."""
    light = DirectionalLight(tuple(TOWARD))
    scene = Scene(shape(), EnvironmentMap.sky(), [light], size=512, ground=True)
    operator = Operator(scene, GRID)
    assert operator.visibility.thin.near is None
    assert len(light_on_thin_shadows(scene, light)[0]) == 0


def test_shares_of_split_fragments_add_up():
    scene, _ = wire(0.5, 35.0, 64, environment=lamp(2.0))
    operator = Operator(scene, GRID)
    part = len(scene.parts) - 1
    operator.prepare(part)
    span = scene.part_slice(part)
    index = np.arange(span.start, span.stop)
    assert (operator.visibility.second_row[index] >= 0).sum() > 20
    _, owner, share, _ = operator.visibility.samples(index)
    total = np.bincount(owner, share, minlength=len(index))
    np.testing.assert_allclose(total, scene.weights[index])
    assert share.min() > 0.0
    # rows of the operator and its images belong together
    rows = operator.rows_as_shown(index[::7])
    images = operator.part_images(part, GREY, interpolate=False)[::7]
    np.testing.assert_allclose(rows @ GREY, images, rtol=2e-3, atol=1e-5)
