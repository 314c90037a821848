"""Sessions that are interrupted at random: no stale frame, no thread left, no lost edit."""

from __future__ import annotations

import contextlib
import gc
import threading
import time
import weakref
from concurrent.futures import CancelledError

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import traitbrdf as tb
from traitbrdf.session.editing import EditSession
from traitbrdf.studio.session import Session
from traitbrdf.transport.universal import UniversalBasis

LIBRARY = tb.default_library()
MATERIALS = ("red-rubber", "gold-satin", "blue-plastic")
VIEWS = (
    {"camera": tb.Camera.orbit(35.0, 20.0)},
    {"camera": tb.Camera.orbit(-60.0, 35.0)},
    {"rotation": 1.0},
    {"rotation": 0.0},
    {"size": (10, 14)},
    {"size": 14},
)
FAREWELL = 30.0

STEPS = st.one_of(
    st.tuples(st.just("look"), st.sampled_from(range(len(VIEWS)))),
    st.tuples(st.just("assign"), st.sampled_from(MATERIALS)),
    st.tuples(st.just("move"), st.sampled_from((-0.4, 0.4))),
    st.tuples(st.just("undo"), st.just(0)),
    st.tuples(st.just("redo"), st.just(0)),
    st.tuples(st.just("prepare"), st.integers(0, 12)),
    st.tuples(st.just("raise"), st.integers(0, 12)),
    st.tuples(st.just("frames"), st.integers(0, 2)),
    st.tuples(st.just("cancel"), st.just(0)),
    st.tuples(st.just("draft"), st.just(0)),
    st.tuples(st.just("glance"), st.just(0)),
    st.tuples(st.just("improve"), st.just(0)),
)


class StopItError(Exception):
    """Raised by a progress callback."""


class Gate:
    """A progress callback that lets some reports pass, and then stops or raises."""

    def __init__(self):
        self.passes, self.fails = 1 << 30, False
        self.reached, self.opened = threading.Event(), threading.Event()

    def close(self, after, fails):
        self.opened.set()  # whoever waits goes on
        self.reached, self.opened = threading.Event(), threading.Event()
        self.passes, self.fails = after, fails

    def __call__(self, stage, fraction):
        self.passes -= 1
        if self.passes >= 0:
            return
        reached, opened, fails = self.reached, self.opened, self.fails
        self.passes = 1 << 30
        reached.set()
        if fails:
            raise StopItError
        assert opened.wait(FAREWELL)


@pytest.fixture(scope="module")
def shown(training, tmp_path_factory):
    """Small sessions with a cache of their own, and the frames that they have to show."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRAITBRDF_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("TRAITBRDF_CACHE_BYTES", str(10**9))
        patch.setattr("traitbrdf.session.preparation.training_of", lambda library, seed: training)
        basis = UniversalBasis.fit(LIBRARY.embedding.grid_, training, 48)
        for room in ("viewer", "preparation"):
            patch.setattr(f"traitbrdf.session.{room}.universal_basis", lambda *a: basis)
        yield Shown()


class Shown:
    """Frames that were not interrupted."""

    def __init__(self):
        self._frames = {}

    def session(self, gate=None):
        sky = tb.EnvironmentMap.sky(rows=16)
        scene = tb.Scene(tb.teapot(), sky, size=14, ground=True, subsamples=1, **VIEWS[0])
        return EditSession(scene, "preview", progress=gate)

    def frame(self, scene, materials):
        key = (scene.camera, scene.environment.rotation, scene.height, *materials.values())
        if key not in self._frames:
            session = self.session()
            session.look(
                camera=scene.camera, size=(scene.height, scene.width),
                rotation=scene.environment.rotation,
            )  # fmt: skip
            for part, material in materials.items():
                session.assign(part, material.z)
            self._frames[key] = session.render(exact=False)
        return self._frames[key]


def alive():
    return [
        thread for thread in threading.enumerate()
        if thread.name.startswith("traitbrdf") and thread.name != "traitbrdf-cache"
    ]  # fmt: skip


def end(gate):
    """Wait until all threads have ended."""
    gate.opened.set()
    until = time.perf_counter() + FAREWELL
    while alive() and time.perf_counter() < until:
        time.sleep(0.005)
    assert not alive()


def follow(session, model, gate, what, value):
    """Take one step; edits are taken by the model, too."""
    if what == "look":
        session.look(**VIEWS[value])
    elif what in ("assign", "move", "undo", "redo"):
        for one in (session, model):
            if what == "assign":
                one.assign("body", value)
            elif what == "move":
                one.move("lid", shiny=value)
            elif what == "undo" and one.undoable:
                one.undo()
            elif what == "redo" and one.redoable:
                one.redo()
    elif what in ("prepare", "raise"):
        gate.close(value, what == "raise")
        session.prepare(wait=False)
        job = session.view.job
        while job is not None and not (gate.reached.is_set() or job.done.is_set()):
            time.sleep(0.001)
    elif what == "frames":
        gate.opened.set()
        with_frames = session.frames()
        for _ in range(value):
            next(with_frames, None)
        with_frames.close()
    elif what == "cancel":
        session.cancel()
        gate.opened.set()
    elif what == "draft":
        image, said = session.draft()
        assert image.shape == (session.scene.height, session.scene.width, 3)
        assert np.isfinite(image).all() and np.isfinite(said)
    elif what == "glance":
        gate.opened.set()
        assert session.glance(8)[0].shape == (session.scene.height, session.scene.width, 3)
    else:
        gate.opened.set()
        session.improve()


def check(shown, steps):
    gate = Gate()
    session, model = shown.session(gate), shown.session()
    for what, value in steps:
        # a failure is told once, to whoever asks next
        with contextlib.suppress(StopItError, CancelledError):
            follow(session, model, gate, what, value)
    session.cancel()
    end(gate)
    assert len(session.layers) == len(model.layers)
    assert session.materials == model.materials
    assert (session.undoable, session.redoable) == (model.undoable, model.redoable)
    gate.close(1 << 30, False)
    with contextlib.suppress(StopItError):  # of a preparation that nobody has asked for since
        session.prepare()
    frame = session.render(exact=False)
    true = shown.frame(session.scene, session.materials)
    assert frame.shape == true.shape
    # the ground is prepared for one material or for all: the bases differ, not the picture
    assert np.abs(frame - true).mean() < 0.01 * true.mean()
    while session.undoable:
        session.undo()
        model.undo()
    assert session.materials == model.materials and not model.undoable
    end(gate)
    gone = weakref.ref(session)
    del session
    gc.collect()
    assert gone() is None


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(STEPS, min_size=1, max_size=8))
def test_interruptions(shown, steps):
    check(shown, steps)


@pytest.mark.slow
@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(STEPS, min_size=2, max_size=12))
def test_two_hundred_interruptions(shown, steps):
    check(shown, steps)


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 12), st.booleans())
def test_a_canvas_is_closed_in_the_middle(shown, reports, turned):
    gate = Gate()
    gate.close(reports, False)
    session = shown.session(gate)
    canvas = Session(session)
    canvas.handle({"kind": "hello", "view": "a", "seq": 1})
    while not (gate.reached.is_set() or session.ready):
        time.sleep(0.001)
    if turned:
        canvas.handle({"kind": "input", "view": "a", "seq": 2, "orbit": [30.0, 5.0]})
    gate.opened.set()
    canvas.close()
    end(gate)
    assert session.materials == shown.session().materials
