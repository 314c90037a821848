"""Frames at once: the universal basis, kriging, frames at nodes, and sessions that show them."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import traitbrdf as tb
from traitbrdf.reflectance.models import GGX, Lambert, PerfectMirror
from traitbrdf.session.cache import Cache
from traitbrdf.session.editing import EditSession
from traitbrdf.session.preparation import universal_basis
from traitbrdf.transport.interpolation import interpolate_nodes, kriging, kriging_weights
from traitbrdf.transport.nodes import NEIGHBOURS, NodeTransport
from traitbrdf.transport.operator import Operator
from traitbrdf.transport.universal import UniversalBasis, light

LIBRARY = tb.default_library()
EMBEDDING = LIBRARY.embedding
GRID = EMBEDDING.grid_
NAMES = ("white-plastic", "red-rubber", "gold-satin", "blue-plastic", "oak-varnished")


def flat(name):
    return EMBEDDING.decode_values(LIBRARY.coordinates[LIBRARY.index(name)])


def tabulated(model):
    table = tb.TabulatedBRDF.from_model(model, GRID)
    return np.ascontiguousarray(table.values.reshape(-1, 3), np.float32)


TABLES = [flat(name) for name in NAMES]


@pytest.fixture(scope="module")
def universal(training):
    """Of few members and of few views."""
    return UniversalBasis.fit(GRID, training, 64)


def scene(size=48, seed=5, shape=None, **settings):
    lit = light(np.random.default_rng(seed), 32)  # no light that the basis was fitted to
    camera = tb.Camera.orbit(35.0, 20.0)
    given = {"camera": camera, "ground": True, "size": size, **settings}
    return tb.Scene(tb.teapot() if shape is None else shape, lit, **given)


@pytest.fixture(scope="module")
def nodes(universal):
    seen = scene()
    return NodeTransport(seen, universal, [TABLES[0]] * len(seen.parts), 400)


def error(found, true):
    return float(np.abs(found - true).mean() / true.mean())


# -- the universal basis ----------------------------------------------------------------------


@pytest.mark.parametrize("seed", [5, 6, 7])
def test_one_basis_serves_any_scene(universal, seed):
    """Of shapes, lights, and views that it was not fitted to; each colour by the same numbers."""
    shape = tb.sphere(0.7, (3.0, 1.0, 0.0)) if seed == 6 else None
    seen = scene(seed=seed, shape=shape, lights=[tb.PointLight((2.0, 4.0, 2.0), (9.0, 5.0, 5.0))])
    rng = np.random.default_rng(seed)
    some = np.sort(rng.permutation(len(seen.pixels))[:60])
    operator = Operator(seen, GRID, 1.0)
    images = operator.images(some, universal.tables)
    for table in [*TABLES, tabulated(Lambert((0.2, 0.5, 0.8)))]:
        coefficients = universal.projection @ table
        found = np.einsum("ncr,rc->nc", images, coefficients)
        true = np.einsum("ncc->nc", operator.images(some, table))
        assert error(found, true) < 0.02


def test_few_tables_make_a_small_basis(training):
    """As many tables as what is given spans: no quotient of zeros."""
    few = replace(training, tables=training.tables[:, :3], weight=training.weight[:3])
    basis = UniversalBasis.fit(GRID, few)
    assert 1 <= basis.tables.shape[1] <= 3
    assert np.isfinite(basis.tables).all() and np.isfinite(basis.projection).all()


def test_lights_are_drawn_by_seed():
    one, again, other = (light(np.random.default_rng(seed), 16).image for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)
    assert np.isfinite(one).all() and one.min() >= 0.0 and one.max() > 0.0


# -- kriging ----------------------------------------------------------------------------------


@settings(max_examples=50)
@given(st.integers(0, 10**6), st.integers(1, 8))
def test_kriging_keeps_constants_and_known_places(seed, count):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(20, 9)).astype(np.float32)
    at = np.concatenate([points[:3], rng.normal(size=(5, 9)).astype(np.float32)])
    distance = np.linalg.norm(at[:, None] - points[None], axis=-1)
    near = np.argsort(distance, axis=1)[:, :count].astype(np.int64)
    weights = np.empty(near.shape, np.float32)
    kriging_weights(weights, points, at, near)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(weights[:3, 0], 1.0, atol=1e-4)  # each is its own neighbour
    np.testing.assert_allclose(weights[:3, 1:], 0.0, atol=1e-4)


def test_what_is_interpolated_stays_within_the_nodes_around():
    """At the edge of a shadow, where weights below 0 would make it darker than black."""
    line = np.arange(8, dtype=np.float32)
    places = np.stack([line, 0.0 * line], axis=1)
    at = np.stack([np.linspace(0.0, 7.0, 60), np.full(60, 0.2)], axis=1).astype(np.float32)
    shown = np.repeat((line > 3.5)[:, None], 3, axis=1).astype(np.float32)
    every = np.concatenate([places, at])
    near, weights = kriging(every, np.arange(8), np.arange(8, 68), 4)
    plain = np.einsum("pk,pkc->pc", weights, shown[near])
    assert plain.min() < -0.01 and plain.max() > 1.01
    out = np.empty((60, 3), np.float32)
    columns = np.full((60, 3, 1), 0.5, np.float32)
    slopes = np.array([[0.0], [2.0], [-4.0]], np.float32)
    interpolate_nodes(out, shown, near.astype(np.int32), weights, columns, slopes)
    np.testing.assert_allclose(out[:, 0], plain[:, 0].clip(0.0, 1.0), atol=1e-6)
    np.testing.assert_allclose(out[:, 1], out[:, 0] + 1.0, atol=1e-6)  # beside reflections
    np.testing.assert_array_equal(out[:, 2], 0.0)  # never negative


# -- frames -----------------------------------------------------------------------------------


def test_frames_are_as_good_as_they_say(nodes):
    seen = nodes.scene
    rng = np.random.default_rng(1)
    covered = np.flatnonzero(seen.weights == 1.0)
    some = np.sort(rng.permutation(covered)[:150])
    operator = Operator(seen, GRID, 1.0)
    parts = len(seen.parts)
    stated, errors = [], []
    for table in TABLES:
        image, said = nodes.frame([table] * parts)
        assert image.shape == (48, 48, 3) and image.dtype == np.float32
        assert np.isfinite(image).all() and image.min() >= 0.0
        true = np.einsum("ncc->nc", operator.images(some, table))
        errors.append(error(image.reshape(-1, 3)[seen.pixels[some]], true))
        stated.append(said)
    assert np.median(errors) < 0.05 and max(errors) < 0.1
    assert 0.4 < np.mean(stated) / np.mean(errors) < 2.5


def test_nodes_show_what_was_computed_there(nodes, universal):
    seen, table = nodes.scene, TABLES[1]
    image, _ = nodes.frame([table] * len(seen.parts))
    several = np.bincount(seen.pixels, minlength=48 * 48)[seen.pixels[nodes.nodes]] > 1
    own = nodes.nodes[~several & (seen.weights[nodes.nodes] == 1.0)]
    images = Operator(seen, GRID, 0.35).images(own, universal.tables)
    found = np.einsum("ncr,rc->nc", images, universal.projection @ table)
    shown = image.reshape(-1, 3)[seen.pixels[own]]
    np.testing.assert_allclose(shown, np.maximum(found, 0.0), rtol=0.02, atol=2e-3 * found.max())


def test_more_nodes_are_better_and_keep_the_others(nodes, universal):
    seen = nodes.scene
    tables = [TABLES[3]] * len(seen.parts)
    before = nodes.frame(tables)
    finer = nodes.refined(1200, tables)
    assert set(nodes.nodes) < set(finer.nodes)
    assert len(set(finer.nodes)) == len(finer.nodes)
    assert abs(len(finer.nodes) - 1200) <= 1  # shape and ground are rounded apart
    assert nodes.frame(tables).error == before.error  # it has not changed
    np.testing.assert_array_equal(nodes.frame(tables).image, before.image)
    errors = [
        np.mean([one.frame([table] * len(seen.parts)).error for table in TABLES])
        for one in (nodes, finer)
    ]
    assert errors[1] < 0.8 * errors[0]


def test_frames_are_linear_in_tables_and_parts_are_apart(nodes):
    seen = nodes.scene
    parts = len(seen.parts)
    one, other = TABLES[0], TABLES[2]
    frames = [nodes.frame([table] * parts).image for table in (one, other, one + 2.0 * other)]
    backdrop = seen.backdrop() * seen.uncovered.reshape(48, 48, 1)
    lit = [frame - backdrop for frame in frames]
    # where nothing was negative, and so cut off
    single = (np.bincount(seen.pixels, minlength=48 * 48) == 1).reshape(48, 48, 1)
    clear = (lit[0] > 0.01) & (lit[1] > 0.01) & single
    expected = lit[0] + 2.0 * lit[1]
    # but for where the sum over nodes would overshoot what they show
    off = np.abs(lit[2] - expected)[clear]
    within = off <= 1e-3 + 1e-3 * expected[clear]
    assert within.mean() > 0.95 and (off / expected[clear]).mean() < 2e-3
    body = seen.parts.index("body")
    mixed = nodes.frame([other if part == body else one for part in range(parts)]).image
    inside = np.zeros(48 * 48, bool)
    inside[seen.pixels[seen.part_slice(body)]] = True
    inside = inside.reshape(48, 48)
    np.testing.assert_array_equal(mixed[~inside], frames[0][~inside])
    assert np.abs(mixed - frames[0])[inside].mean() > 0.01


def test_a_mirror_beside_a_table_is_shown(nodes):
    seen = nodes.scene
    parts = len(seen.parts)
    black = np.zeros((GRID.size, 3), np.float32)
    image, _ = nodes.frame([black] * parts, [np.full(3, 0.5)] * parts)
    every = np.arange(len(seen.pixels))
    radiance = 0.5 * Operator(seen, GRID, 0.35).mirror(every)
    expected = (seen.backdrop().reshape(-1, 3) * seen.uncovered[:, None]).astype(np.float32)
    np.add.at(expected, seen.pixels, radiance)
    np.testing.assert_allclose(image.reshape(-1, 3), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("size", "settings", "count"),
    [
        ((1, 1), {}, 1000),
        ((2, 3), {"ground": False}, 1),
        ((16, 16), {"camera": tb.Camera.orbit(0.0, 0.0, zoom=0.05)}, 1000),  # a speck
        ((16, 16), {"shadows": False, "subsamples": 1}, 3),
        ((8, 8), {"camera": tb.Camera.orbit(0.0, 0.0, target=(99.0, 0.0, 0.0))}, 50),  # nothing
    ],
)
def test_extremes(universal, size, settings, count):
    seen = scene(size, **settings)
    tables = [TABLES[1]] * len(seen.parts)
    found = NodeTransport(seen, universal, tables, count)
    assert len(found.nodes) <= max(len(seen.pixels), 2)
    image, said = found.frame(tables)
    assert image.shape == (seen.height, seen.width, 3)
    assert np.isfinite(image).all() and image.min() >= 0.0 and np.isfinite(said)
    assert len(found.refined(10 * count, tables).frame(tables).image)


def test_each_part_has_nodes_however_small_it_is(universal):
    seen = scene(12)
    tables = [TABLES[1]] * len(seen.parts)
    found = NodeTransport(seen, universal, tables, 1)
    sizes = [len(part.at) for part in found.parts]
    spans = [seen.part_slice(part) for part in range(len(seen.parts))]
    assert sizes == [min(span.stop - span.start, 3 * NEIGHBOURS) for span in spans]
    assert min(sizes) < NEIGHBOURS  # some have fewer fragments than neighbours are asked for
    for span, part in zip(spans, found.parts, strict=True):
        assert ((part.at >= span.start) & (part.at < span.stop)).all()
    assert np.isfinite(found.frame(tables).image).all()


# -- sessions ---------------------------------------------------------------------------------


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TRAITBRDF_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("TRAITBRDF_CACHE_BYTES")


class Hold:
    """Holds a preparation at a stage."""

    def __init__(self, stage):
        self.stage, self.reached, self.opened = stage, threading.Event(), threading.Event()

    def __call__(self, stage, fraction):
        if stage == self.stage:
            self.reached.set()
            assert self.opened.wait(60.0)


@pytest.fixture
def held(cache, small_training, universal, monkeypatch):
    """A session whose preparation has come as far as nodes."""
    monkeypatch.setattr("traitbrdf.session.viewer.universal_basis", lambda *arguments: universal)
    hold = Hold("tables")
    session = EditSession(scene(), "preview", progress=hold)
    session.prepare(wait=False)
    assert hold.reached.wait(60.0)
    yield session
    hold.opened.set()
    session.cancel()


def test_edits_show_at_nodes_until_the_view_is_prepared(held, monkeypatch):
    def walk(*arguments, **named):
        raise AssertionError("the light is walked again")

    assert not held.ready and held.view.nodes is not None
    monkeypatch.setattr(Operator, "images", walk)
    monkeypatch.setattr(Operator, "part_images", walk)
    first, said = held.draft()
    assert first.shape == (48, 48, 3) and 0.0 < said < 0.2
    held.assign("body", "red-rubber")
    second, _ = held.draft()
    red = second - first
    inside = np.zeros(48 * 48, bool)
    seen = held.scene
    inside[seen.pixels[seen.part_slice(seen.parts.index("body"))]] = True
    inside = inside.reshape(48, 48)
    assert np.abs(red[inside]).mean() > 0.01
    np.testing.assert_array_equal(second[~inside], first[~inside])
    held.undo()
    np.testing.assert_array_equal(held.draft()[0], first)
    np.testing.assert_array_equal(held.render(wait=False), first)
    held.draft()[0][:] = 7.0  # the array is the caller's
    np.testing.assert_array_equal(held.draft()[0], first)
    held.assign("lid", PerfectMirror(0.5) + GGX(0.3, 1.5, 0.0))
    monkeypatch.undo()
    assert np.isfinite(held.draft()[0]).all()


def test_a_look_leaves_no_frame_of_the_old_view(held):
    old = held.draft()[0]
    held.look(camera=tb.Camera.orbit(-90.0, 30.0))
    assert held.view.nodes is None
    assert not np.array_equal(held.draft(32)[0], old)


def test_a_cancelled_preparation_leaves_its_nodes(held):
    nodes, first = held.view.nodes, held.progress
    held.cancel()
    first.opened.set()
    held.progress = second = Hold("tables")
    try:
        held.prepare(wait=False)
        assert second.reached.wait(60.0)
        assert held.view.nodes is nodes
    finally:
        second.opened.set()


def test_the_prepared_frame_follows_without_a_jump(held):
    drafted, said = held.draft()
    held.progress.opened.set()
    frame = held.render(exact=False)
    assert held.ready and held.view.nodes is None
    covered = (held.scene.uncovered < 1.0).reshape(48, 48)
    assert error(drafted[covered], frame[covered]) < max(3.0 * said, 0.05)


def test_who_waits_for_the_frame_gets_no_nodes(cache, small_training, monkeypatch):
    monkeypatch.setattr("traitbrdf.session.viewer.universal_basis", None)
    session = EditSession(scene(16), "preview")
    assert session.render().shape == (16, 16, 3)


def test_a_universal_basis_is_fitted_once(cache, small_training, monkeypatch):
    store = Cache.usual()
    told = []

    def report(stage, fraction):
        told.append((stage, fraction))

    first = universal_basis(LIBRARY, 0, store, report)
    assert told[0] == ("universal basis", 0.0)
    assert [f for _, f in told] == sorted(f for _, f in told)
    for thread in threading.enumerate():
        if thread.name == "traitbrdf-cache":
            thread.join()
    told.clear()
    start = time.perf_counter()
    again = universal_basis(LIBRARY, 0, store, report)
    assert not told and time.perf_counter() - start < 5.0
    for name in ("tables", "projection", "typical"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    (file,) = store.folder.glob("*.npz")
    file.write_bytes(file.read_bytes()[:1000])  # damaged: it is fitted anew
    universal_basis(LIBRARY, 0, store, report)
    assert told
