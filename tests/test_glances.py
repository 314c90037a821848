"""Glances: small frames while a camera or a light is moved, and the reflections they rest on."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import traitbrdf as tb
from traitbrdf.reflectance.models import Lambert, PerfectMirror
from traitbrdf.session.editing import EditSession
from traitbrdf.transport.glances import NODES, Glances
from traitbrdf.transport.operator import Operator, light_tree
from traitbrdf.transport.reflections import Regression, blurred, reflections
from traitbrdf.transport.universal import light

LIBRARY = tb.default_library()
EMBEDDING = LIBRARY.embedding
GRID = EMBEDDING.grid_
NAMES = ("white-plastic", "red-rubber", "blue-plastic", "oak-varnished")


def flat(name):
    return EMBEDDING.decode_values(LIBRARY.coordinates[LIBRARY.index(name)])


def scene(**settings):
    lit = light(np.random.default_rng(5), 64)
    given = {"camera": tb.Camera.orbit(35.0, 20.0), "ground": True, "size": 160, **settings}
    return tb.Scene(tb.teapot(), lit, **given)


def turned(angle):
    return tb.Camera.orbit(35.0 + angle, 20.0 + 0.3 * angle)


def deviation(frame, table, small, tree, seed):
    """Mean relative L1 of a small frame against the operator, at some of its fragments."""
    rng = np.random.default_rng(seed)
    some = np.sort(rng.choice(len(small.pixels), 120, replace=False))
    exact = np.einsum("pcc->pc", Operator(small, GRID, 1.0, tree).images(some, table))
    shown = frame.reshape(-1, 3)[small.pixels[some]]
    return float(np.abs(shown - exact).mean() / exact.mean())


@pytest.mark.parametrize("change", ["camera", "light"])
def test_a_drag_shows_the_real_material(change):
    """Of any material, at every frame, with its error beside it."""
    first = scene()
    tree = light_tree(first.environment)
    errors, stated = [], []
    for name in NAMES:
        table = flat(name)
        glances = Glances(GRID, 96)
        for i in range(4):
            wanted = (
                {"camera": turned(4.0 * i)}
                if change == "camera"
                else {"environment": first.environment.rotated(0.1 * i)}
            )
            seen = first.changed(**wanted)
            frame = glances.frame(seen, [table] * len(seen.parts), None, tree)
            assert frame.image.shape == (96, 96, 3) and frame.image.dtype == np.float32
            assert np.isfinite(frame.image).all() and frame.image.min() >= 0.0
            small = seen.changed(size=96, subsamples=1)
            errors.append(deviation(frame.image, table, small, tree, i))
            stated.append(frame.error)
    assert np.median(errors) < 0.05 and max(errors) < 0.2
    assert 0.3 < np.median(stated) / np.median(errors) < 2.0


def test_frames_of_one_view_do_not_flicker():
    """A camera that comes back sees nearly the same picture, and a turned light exactly."""
    seen = scene()
    tables = [flat("red-rubber")] * len(seen.parts)
    glances = Glances(GRID, 96)
    frames = [glances.frame(seen.changed(camera=turned(a)), tables).image for a in (0.0, 0.5, 0.0)]
    assert np.abs(frames[2] - frames[0]).mean() < 0.02 * frames[0].mean()
    light_back = [
        glances.frame(seen.changed(environment=seen.environment.rotated(a)), tables).image
        for a in (0.0, 0.4, 0.0)
    ]
    np.testing.assert_array_equal(light_back[2], light_back[0])


def test_materials_of_parts_are_apart():
    seen = scene()
    body = seen.parts.index("body")
    one, other = flat("white-plastic"), flat("red-rubber")
    frames = [
        Glances(GRID, 96).frame(seen, [other if p == body and k else one
                                       for p in range(len(seen.parts))]).image
        for k in (0, 1)
    ]  # fmt: skip
    small = seen.changed(size=96, subsamples=1)
    inside = np.zeros(96 * 96, bool)
    inside[small.pixels[small.part_slice(body)]] = True
    inside = inside.reshape(96, 96)
    assert np.abs(frames[1] - frames[0])[inside].mean() > 0.01
    # nodes are drawn for the materials, so that other parts differ by their interpolation
    assert np.abs(frames[1] - frames[0])[~inside].mean() < 0.02 * frames[0][~inside].mean()


def test_small_parts_show_their_own_material(monkeypatch):
    """With fewer nodes than parts would need, each of another material."""
    monkeypatch.setattr("traitbrdf.transport.glances.NODES", 8)
    seen = scene(size=40, ground=False)
    flats = [np.full((GRID.size, 3), 0.02 * 3.0**i, np.float32) for i in range(len(seen.parts))]
    glances = Glances(GRID)
    for angle in (0.0, 3.0, 60.0):
        turned_scene = seen.changed(camera=turned(angle))
        image, said = glances.frame(turned_scene, flats)
        assert np.isfinite(said)
        small = turned_scene.changed(subsamples=1)
        for part in range(len(seen.parts)):
            span = small.part_slice(part)
            if span.start == span.stop:
                continue
            shown = image.reshape(-1, 3)[small.pixels[span]].mean()
            every = np.arange(span.start, span.stop)
            images = Operator(small, GRID, 0.3).images(every, flats[part])
            true = np.einsum("pcc->pc", images).mean()
            assert 0.3 < shown / true < 3.0


def test_mirrors_are_shown():
    seen = scene(ground=False)
    black = np.zeros((GRID.size, 3), np.float32)
    parts = len(seen.parts)
    image, _ = Glances(GRID, 64).frame(seen, [black] * parts, [np.full(3, 0.5)] * parts)
    small = seen.changed(size=64, subsamples=1)
    every = np.arange(len(small.pixels))
    expected = 0.5 * Operator(small, GRID, 0.3).mirror(every)
    np.testing.assert_allclose(image.reshape(-1, 3)[small.pixels], expected, atol=1e-5)


@pytest.mark.parametrize(
    ("size", "settings"),
    [
        (1, {}),
        ((3, 40), {"ground": False}),
        (16, {"camera": tb.Camera.orbit(0.0, 0.0, zoom=0.05)}),
        (8, {"camera": tb.Camera.orbit(0.0, 0.0, target=(99.0, 0.0, 0.0)), "ground": False}),
        (24, {"shadows": False, "lights": [tb.PointLight((2.0, 4.0, 2.0), (9.0, 5.0, 5.0))]}),
    ],
)
def test_extremes(size, settings):
    seen = scene(size=size, **settings)
    tables = [flat("blue-plastic")] * len(seen.parts)
    glances = Glances(GRID)
    for angle in (0.0, 170.0, 171.0):
        image, said = glances.frame(seen.changed(camera=turned(angle)), tables)
        assert image.shape == (seen.height, seen.width, 3)
        assert np.isfinite(image).all() and image.min() >= 0.0 and np.isfinite(said)
    image, said = glances.frame(seen, tables)  # another scene: nothing is carried over
    assert np.isfinite(image).all() and np.isfinite(said)
    other = tb.Scene(tb.sphere(), seen.environment, size=12)
    assert glances.frame(other, tables[:1]).image.shape == (12, 12, 3)


def test_sessions_show_the_view_they_look_at():
    session = EditSession(scene(size=(48, 64)), cache=False)
    before, said = session.glance()
    assert before.shape == (48, 64, 3) and 0.0 <= said < 0.3
    session.assign("body", "red-rubber")
    red, _ = session.glance()
    assert np.abs(red - before).mean() > 0.005
    session.look(camera=tb.Camera.orbit(200.0, 10.0))
    assert np.abs(session.glance()[0] - red).mean() > 0.005
    session.assign("lid", PerfectMirror(0.5) + Lambert(0.1))
    assert np.isfinite(session.glance(32)[0]).all()
    assert not session.ready  # nothing was prepared for it
    for size in (0, -1, 2.5, True, "12"):
        with pytest.raises(ValueError, match="size: expected a positive number of pixels"):
            session.glance(size)


# -- reflections ------------------------------------------------------------------------------


def test_a_blurred_map_has_the_light_of_the_map():
    lit = light(np.random.default_rng(3), 300)
    area = np.sin((np.arange(300) + 0.5) * np.pi / 300)[:, None, None]
    mean = (lit.image * area).sum((0, 1)) / (area.sum() * 600)
    for level in blurred(lit):
        rows = level.shape[1]
        weight = np.sin((np.arange(rows) + 0.5) * np.pi / rows)[None, :, None]
        found = (level.numpy() * weight).sum((1, 2)) / (weight.sum() * level.shape[2])
        np.testing.assert_allclose(found, mean, rtol=0.01)


def test_the_sharpest_reflection_is_that_of_a_mirror():
    seen = scene(size=48, subsamples=1)
    columns = reflections(seen)
    assert columns.shape == (len(seen.pixels), 3, 6) and columns.min() >= 0.0
    mirror = Operator(seen, GRID, 0.3).mirror(np.arange(len(seen.pixels)))
    # looked up between texels and not in them
    assert np.abs(columns[:, :, 0] - mirror).mean() < 0.1 * mirror.mean()
    np.testing.assert_array_equal(columns[:, :, 0] == 0.0, columns[:, :, 1] == 0.0)


@settings(max_examples=50)
@given(st.integers(0, 10**6), st.integers(0, 40), st.integers(1, 5))
def test_regression_finds_the_coefficients_of_reflections(seed, count, width):
    """Also beside what is smooth, and linear in the radiance."""
    rng = np.random.default_rng(seed)
    columns = rng.random((count, 3, width)).astype(np.float32)
    near = np.array([[(i + 1) % max(count, 1), (i + 2) % max(count, 1)] for i in range(count)])
    near = near.reshape(count, 2).astype(np.int64)
    weights = np.full((count, 2), 0.5, np.float32)
    found = Regression.of(columns, near, weights)
    assert found.gram.shape == (3, width, width) and found.moments.shape == (3, width, count)
    true = rng.normal(size=(3, width))
    radiance = np.einsum("ncd,cd->nc", columns, true) + 7.0  # a constant is none of theirs
    slope = found.slopes(radiance.astype(np.float32))
    assert np.isfinite(slope).all()
    if count < 4 * width + 4:
        return
    assert np.abs(slope - true).max() < 0.5 * np.abs(true).max() + 0.05


def test_there_are_as_many_nodes_as_pixels_at_most():
    seen = scene(size=12)
    assert len(seen.pixels) < NODES
    frame = Glances(GRID).frame(seen, [flat("red-rubber")] * len(seen.parts))
    assert np.isfinite(frame.image).all()
