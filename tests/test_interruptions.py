"""Sessions that are interrupted at random: no stale frame, no thread left, no lost edit.

A conductor holds each preparation in the background at its reports, so that what happens between
two reports is drawn, not a matter of luck.
"""

from __future__ import annotations

import functools
import gc
import threading
import time
import weakref
from concurrent.futures import CancelledError

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sessions import on, same

import traitbrdf as tb
from traitbrdf.session.cache import Cache
from traitbrdf.session.editing import EditSession
from traitbrdf.session.frames import View, enlarged, measured
from traitbrdf.session.preparation import TURNS
from traitbrdf.studio.session import Session
from traitbrdf.transport.drafts import Draft
from traitbrdf.transport.universal import UniversalBasis

LIBRARY = tb.default_library()
EMBEDDING = LIBRARY.embedding
SKY, OTHER = tb.EnvironmentMap.sky(rows=8), tb.EnvironmentMap.sky((80.0, 15.0), rows=8)
FIRST = {
    "camera": tb.Camera.orbit(35.0, 20.0), "environment": SKY, "rotation": 0.0, "lights": (),
    "size": (12, 12),
}  # fmt: skip
LOOKS = (
    {"camera": FIRST["camera"]},
    {"camera": tb.Camera.orbit(-60.0, 45.0)},
    {"environment": SKY, "rotation": 0.0},
    {"environment": OTHER, "rotation": 0.0},
    {"rotation": 2.0},
    {"lights": ()},
    {"lights": (tb.PointLight((2.0, 4.0, 2.0), (9.0, 5.0, 5.0)),)},
    {"size": (12, 12)},
    {"size": (10, 14)},
)
FAREWELL = 30.0

PARTS = st.sampled_from(("sphere", "ground"))
EDITS = st.one_of(
    st.tuples(
        st.just("assign"), PARTS, st.sampled_from(("red-rubber", "gold-satin", "blue-plastic"))
    ),
    st.tuples(st.just("move"), PARTS, st.sampled_from((-0.5, 0.5))),
    st.tuples(st.just("paint"), PARTS, st.sampled_from((-0.5, 0.5))),
    st.tuples(st.sampled_from(("undo", "redo"))),
)
LOOK = st.tuples(st.just("look"), st.sampled_from(LOOKS))
SHOW = st.sampled_from((("show",), ("draft", None), ("draft", 6), ("glance",)))
CANCEL = st.tuples(st.just("cancel"))
STEPS = st.one_of(
    LOOK,
    EDITS,
    SHOW,
    CANCEL,
    st.just(("prepare",)),
    st.tuples(st.just("go"), st.integers(1, 22)),
    st.tuples(st.just("old"), st.integers(1, 22)),
    st.just(("fail",)),
    st.tuples(st.just("frames"), st.integers(1, 3)),
    st.just(("close",)),
    st.just(("improve",)),
    st.just(("drop",)),
    st.tuples(
        st.just("wait"), st.integers(1, 22), st.one_of(LOOK, EDITS, SHOW, CANCEL, st.just(None))
    ),
    st.tuples(st.just("wait"), st.integers(1, 22), st.just(("fail",))),
)


class StopItError(Exception):
    """Raised by a progress callback."""


class Held:
    """A preparation in the background, at one of its reports."""

    def __init__(self):
        self.arrived, self.passes = threading.Event(), threading.Semaphore(0)
        self.fails = self.free = False


class Conductor:
    """A progress callback that holds preparations in the background, and acts in free ones."""

    def __init__(self):
        self.held: dict[threading.Thread, Held] = {}
        self.void: set[threading.Thread] = set()  # cancelled: these may tell nothing more
        self.at, self.act = 0, None
        self.failures, self.faults = 0, []

    def __call__(self, stage, fraction):
        thread = threading.current_thread()
        if thread in self.void:
            self.faults.append(f"told {stage} after it was cancelled")
        if thread.name == "traitbrdf-prepare":
            held = self.held.setdefault(thread, Held())
            if not held.free:
                held.arrived.set()
                if not held.passes.acquire(timeout=FAREWELL):
                    self.faults.append(f"never went on from {stage}")
            if held.fails:
                self.fail()
            if not held.free:
                return
        self.at -= 1
        if self.at == 0 and self.act is not None:
            act, self.act = self.act, None
            act()

    def fail(self):
        self.failures += 1
        raise StopItError

    def settle(self):
        """Wait until each preparation has come to a report, or to its end."""
        until = time.perf_counter() + FAREWELL
        while any(not self._settled(thread) for thread in threads("traitbrdf-prepare")):
            assert time.perf_counter() < until
            time.sleep(0.0005)

    def _settled(self, thread):
        held = self.held.get(thread)
        return not thread.is_alive() or (held is not None and held.arrived.is_set())

    def go(self, thread, count=1):
        held = self.held[thread]
        for _ in range(count):
            held.arrived.clear()
            held.passes.release()
            self.settle()

    def waiting(self):
        """Preparations that are held, the oldest first."""
        return [thread for thread in self.held if thread.is_alive()]


def threads(*names):
    return [thread for thread in threading.enumerate() if thread.name.startswith(names)]


def ended():
    """Wait until no thread of the package is left."""
    until = time.perf_counter() + FAREWELL
    while threads("traitbrdf") and time.perf_counter() < until:
        time.sleep(0.001)
    assert not threads("traitbrdf")


@pytest.fixture(scope="module")
def shown(training, tmp_path_factory):
    """Small sessions with a cache of their own, and what they have to show."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRAITBRDF_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("TRAITBRDF_CACHE_BYTES", str(10**9))
        patch.setattr("traitbrdf.session.preparation.training_of", lambda library, seed: training)
        patch.setattr("traitbrdf.session.viewer._TICK", 0.001)
        patch.setattr("traitbrdf.session.viewer.NODES", (60, 90))  # of some 130 fragments
        basis = UniversalBasis.fit(EMBEDDING.grid_, training, 48)
        for room in ("viewer", "preparation"):
            patch.setattr(f"traitbrdf.session.{room}.universal_basis", lambda *a: basis)
        # what is found again has two reports: most preparations shall start from scratch
        read = Cache.read
        shown = Shown()
        patch.setattr(Cache, "read", lambda *a: read(*a) if shown.cached else None)
        yield shown


class Shown:
    """What is shown if nobody interrupts."""

    def __init__(self):
        self.cached = False
        self._known = {}

    def session(self, conductor=None):
        return EditSession(self.scene(FIRST), "preview", progress=conductor)

    def once(self, what, key, make):
        key = what, *key
        if key not in self._known:
            self._known[key] = make()
        return self._known[key]

    @staticmethod
    def key(view):
        return tuple(id(v) if isinstance(v, tb.EnvironmentMap) else v for v in view.values())

    def scene(self, view):
        given = {key: value for key, value in view.items() if key != "rotation"}
        given["environment"] = tb.EnvironmentMap(view["environment"].image, view["rotation"])
        return self.once(
            "scene",
            self.key(view),
            lambda: tb.Scene(tb.sphere(), **given, ground=True, subsamples=1),
        )

    def draft(self, view, size, materials):
        """The draft, to the bit."""
        scene = self.scene(view)
        draft = self.once(
            "draft", (*self.key(view), size), lambda: Draft(scene, EMBEDDING.grid_, size)
        )
        tables = {m: m.values(EMBEDDING) for m in materials}
        image, _ = draft.render([tables[m] for m in materials], [m.mirror for m in materials])
        return enlarged(image, scene.height, scene.width)

    def frame(self, view, materials):
        """The frame and its error, of a basis that serves all materials of all parts."""

        def prepared():
            session = EditSession(self.scene(view), "preview", cache=False)
            session.assign("ground", "red-rubber")
            return session, session.prepare()

        def drawn():
            session, transport = self.once("prepared", self.key(view), prepared)
            bare = View(session.scene)
            return session.renderer.frame(bare, transport, materials, False), measured(
                bare, transport
            )

        return self.once("frame", (*self.key(view), *materials), drawn)


class Run:
    """A session under a conductor, beside one that is only edited."""

    def __init__(self, shown):
        self.shown, self.conductor, self.told = shown, Conductor(), 0
        self.begin()

    def begin(self):
        self.view, self.images = dict(FIRST), None
        self.session, self.model = self.shown.session(self.conductor), self.shown.session()

    @property
    def materials(self):
        return list(self.model.materials.values())

    def step(self, what, *given):
        expected = what == "wait" and given[1] == ("cancel",)
        try:
            getattr(self, f"do_{what}")(*given)
        except StopItError:  # each failure is told at most once
            self.told += 1
            self.images = None
        except CancelledError:
            if not expected:
                raise
        self.conductor.settle()
        job = self.session.view.job
        live = None if job is None else job.thread
        self.conductor.void |= {t for t in self.conductor.waiting() if t is not live}
        self.edits_are_kept()

    def edits_are_kept(self):
        assert not self.conductor.faults
        assert self.told <= self.conductor.failures
        assert self.session.materials == self.model.materials
        assert self.session.history == self.model.history
        assert self.session.undoable == self.model.undoable
        assert self.session.redoable == self.model.redoable

    def is_present(self, image, size=None, ready=None):
        """Check that an image shows the present view and materials."""
        scene, true = self.session.scene, self.shown.scene(self.view)
        assert image.shape == (*self.view["size"], 3)
        assert (scene.camera, scene.lights) == (true.camera, true.lights)
        assert scene.environment.image is true.environment.image
        assert scene.environment.rotation == true.environment.rotation
        nodes = self.session.view.nodes
        if self.session.ready if ready is None else ready:
            assert self.session.prepare().scene is scene
            expected, error = self.shown.frame(self.view, self.materials)
            # the ground is prepared for one material or for all: bases differ, not the picture
            allowed = 0.01 + error + self.session.frame_error
            assert np.abs(image - expected).mean() < allowed * expected.mean()
        elif nodes is None or size is not None:
            same(image, self.shown.draft(self.view, size or 128, self.materials))
        else:
            assert nodes.scene is scene
            tables = {m: m.values(EMBEDDING) for m in self.materials}
            mirrors = [m.mirror for m in self.materials]
            same(image, nodes.frame([tables[m] for m in self.materials], mirrors).image)

    # -- steps ------------------------------------------------------------------------------

    def do_look(self, wanted):
        self.view.update(wanted)
        for one in (self.session, self.model):
            one.look(**wanted)

    def do_assign(self, part, name):
        for one in (self.session, self.model):
            one.assign(part, name)

    def do_move(self, part, amount):
        for one in (self.session, self.model):
            one.apply(part, tb.Move(shiny=amount))

    def do_paint(self, part, amount):
        stroke = on(self.shown.scene(self.view), part, amount, "bright")
        for one in (self.session, self.model):
            one.paint(stroke, only=part)

    def do_undo(self):
        assert self.session.undo() == self.model.undo()

    def do_redo(self):
        assert self.session.redo() == self.model.redo()

    def do_prepare(self):
        found = self.session.prepare(wait=False)
        assert (found is None) == (not self.session.ready)

    def do_show(self):
        self.is_present(self.session.render(wait=False, exact=False))

    def do_draft(self, size):
        self.is_present(self.session.draft(size)[0], size, ready=False)

    def do_glance(self):
        image, said = self.session.glance(8)
        assert image.shape == (*self.view["size"], 3)
        true, _ = self.shown.frame(self.view, self.materials)
        assert np.isfinite(said)
        assert np.abs(image - true).mean() < 0.4 * true.mean()

    def do_improve(self):
        self.session.improve()

    def do_cancel(self):
        self.session.cancel()

    def do_fail(self):
        job = self.session.view.job
        if job is not None and job.thread in self.conductor.waiting():
            self.conductor.held[job.thread].fails = True
            self.conductor.go(job.thread)

    def do_go(self, count):
        for thread in self.conductor.waiting()[-1:]:
            self.conductor.go(thread, count)

    def do_old(self, count):
        for thread in self.conductor.waiting()[:1]:
            self.conductor.go(thread, count)

    def do_frames(self, count):
        if self.images is None:
            self.images = self.session.frames(exact=False)
        for _ in range(count):
            found = next(self.images, None)
            if found is None:  # cancelled, or finished
                self.images = None
                return
            self.conductor.settle()
            image, _, fraction = found
            self.is_present(image, ready=fraction == 1.0)

    def do_close(self):
        if self.images is not None:
            self.images.close()
            self.images = None
            job = self.session.view.job
            # one that has failed stays until that is told
            assert self.session.ready or job is None or job.error is not None

    def do_drop(self):
        gone, self.images, self.session = weakref.ref(self.session), None, None
        gc.collect()
        assert gone() is None
        waiting = self.conductor.waiting()
        self.conductor.void |= set(waiting)
        for thread in waiting:
            self.conductor.go(thread)
            assert not thread.is_alive()
        self.begin()

    def do_wait(self, reports, act):
        """Wait for the frame, and act at one of the reports until then."""
        conductor, job = self.conductor, self.session.view.job
        if act is not None:
            call = conductor.fail if act == ("fail",) else getattr(self, f"do_{act[0]}")
            conductor.at, conductor.act = reports, functools.partial(call, *act[1:])
        if job is not None and job.thread in conductor.waiting():
            conductor.held[job.thread].free = True
            conductor.held[job.thread].passes.release()
        try:
            image = self.session.render(exact=False)
        finally:
            conductor.act = None
        self.is_present(image, ready=True)

    # -- the end ----------------------------------------------------------------------------

    def end(self):
        self.step("draft", None)
        self.step("close")
        self.session.cancel()
        waiting = self.conductor.waiting()
        self.conductor.void |= set(waiting)
        for thread in waiting:
            self.conductor.go(thread)
        ended()
        assert TURNS._owner is None
        self.step("wait", 0, None)
        if not self.session.ready:  # a failure of before was told
            self.step("wait", 0, None)
        assert self.session.ready
        while self.model.undoable:
            self.step("undo")
        while self.model.redoable:
            self.step("redo")
        self.step("show")
        self.step("drop")
        ended()


def check(shown, steps, cached):
    shown.cached = cached
    run = Run(shown)

    def follow():
        try:
            for step in steps:
                run.step(*step)
            run.end()
        except BaseException as error:
            failed.append(error)

    failed: list[BaseException] = []
    # in a thread of its own: what waits for ever fails
    following = threading.Thread(target=follow, name="test-steps", daemon=True)
    following.start()
    following.join(4.0 * FAREWELL)
    assert not following.is_alive()
    if failed:
        for thread, held in run.conductor.held.items():
            held.free = True
            held.passes.release()
            thread.join(FAREWELL)
        raise failed[0]


quietly = functools.partial(settings, suppress_health_check=[HealthCheck.function_scoped_fixture])
# most begin in the middle of a preparation, where there is something to interrupt
SEVERAL = st.builds(
    lambda reports, steps: [("prepare",), ("go", reports), *steps],
    st.integers(0, 22),
    st.lists(STEPS, min_size=1, max_size=10),
)
CACHED = st.sampled_from((False, False, False, True))


@quietly(max_examples=20)
@given(SEVERAL, CACHED)
def test_interruptions(shown, steps, cached):
    check(shown, steps, cached)


@pytest.mark.slow
@quietly(max_examples=200)
@given(SEVERAL, CACHED)
def test_two_hundred_interruptions(shown, steps, cached):
    check(shown, steps, cached)


MESSAGES = st.one_of(
    st.fixed_dictionaries({"orbit": st.sampled_from(([40.0, 5.0], [-40.0, 0.0]))}),
    st.fixed_dictionaries({"turn": st.just(30.0), "dragging": st.booleans()}),
    st.fixed_dictionaries(
        {
            "assign": st.fixed_dictionaries(
                {"part": PARTS, "material": st.sampled_from(("red-rubber", "gold-satin"))}
            )
        }
    ),
    st.fixed_dictionaries({"do": st.sampled_from(("undo", "redo")), "rest": st.booleans()}),
    st.just({}),
)


@quietly(max_examples=20)
@given(st.lists(st.one_of(MESSAGES, st.integers(1, 22), st.just("fail")), min_size=1, max_size=6))
def test_a_canvas_is_closed_in_the_middle(shown, steps):
    shown.cached = False
    conductor = Conductor()
    session, model = shown.session(conductor), shown.session()
    canvas = Session(session)

    def settled():
        job, refiner = session.view.job, canvas.refiner
        if canvas._dragging or refiner is None or not refiner.is_alive():
            return True
        held = None if job is None else conductor.held.get(job.thread)
        return held is not None and held.arrived.is_set()

    for step in ({}, *steps):
        if isinstance(step, dict):
            replies = canvas.handle({"kind": "input", "view": "a", "seq": 1, **step})
            assert [header["kind"] for header, _ in replies] == ["frame"]
            if "assign" in step:
                model.assign(**step["assign"])
            elif "do" in step:
                getattr(model, step["do"])()
        else:
            for thread in conductor.waiting()[-1:]:
                conductor.held[thread].fails = step == "fail"
                conductor.go(thread, 1 if step == "fail" else step)
        until = time.perf_counter() + FAREWELL
        while not settled():
            assert time.perf_counter() < until
            time.sleep(0.001)
    refiner = canvas.refiner
    canvas.close()
    assert refiner is None or not refiner.is_alive()  # whatever is held
    for thread in conductor.waiting():
        conductor.held[thread].free = True
        conductor.held[thread].passes.release()
    ended()
    for timer in [t for t in threading.enumerate() if isinstance(t, threading.Timer)]:
        timer.join(FAREWELL)
        assert not timer.is_alive()
    assert canvas.handle({"kind": "input", "view": "a"})  # who asks still gets a picture
    assert not threads("traitbrdf-studio", "traitbrdf-prepare")
    assert not conductor.faults
    assert session.materials == model.materials and session.history == model.history
