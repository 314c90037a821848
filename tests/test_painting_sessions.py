"""Long random sessions: whatever is done, the same history gives the same frame."""

from __future__ import annotations

import json
import random
import subprocess
import sys
import time

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from sessions import over

import traitbrdf as tb
from traitbrdf.formats.files import FormatError, read_arrays, write_arrays
from traitbrdf.session.editing import EditSession

POINTS = st.lists(st.tuples(st.floats(12, 50), st.floats(8, 44)), min_size=1, max_size=4)
EFFECTS = st.sampled_from([
    tb.Move(shiny=0.5), tb.Move(dusty=-0.4), tb.Assign("gold-polished"), tb.Assign("red-rubber"),
    tb.Tint((0.3, 0.5, 1.0)), tb.Tint((0.9, 0.9, 0.2), "all"),
])  # fmt: skip
PARTS = st.sampled_from(["body", "lid", "handle"])
HOME = tb.Camera.orbit(35.0, 20.0)


class Painting(RuleBasedStateMachine):
    """A session; frames are finished ones where the prepared camera looks, else drafts."""

    prepared = None
    folder = None

    @initialize()
    def begin(self) -> None:
        self.edit = over(self.prepared, error=1.0)
        self.home = True

    def frame(self) -> np.ndarray:
        return self.edit.render() if self.home else self.edit.draft(12)[0]

    def attempt(self, act) -> None:
        """Do something that may be refused; then nothing may have changed."""
        before = self.edit.design
        try:
            act()
        except ValueError:
            assert self.edit.design is before

    @rule(points=POINTS, radius=st.floats(1, 15), hardness=st.floats(0, 1), effect=EFFECTS)
    def paint(self, points, radius, hardness, effect) -> None:
        stroke = tb.Stroke(points, radius=radius, hardness=hardness)
        self.attempt(lambda: self.edit.paint(stroke, effect, where="local"))

    @rule(points=POINTS, effect=EFFECTS)
    def paint_parts(self, points, effect) -> None:
        self.attempt(lambda: self.edit.paint(tb.Stroke(points, radius=6), effect))

    @rule(part=PARTS, effect=EFFECTS, weight=st.floats(0, 1))
    def apply(self, part, effect, weight) -> None:
        self.edit.apply({part: weight}, effect)

    @precondition(lambda self: len(self.edit.layers))
    @rule(data=st.data(), points=POINTS, erase=st.booleans(), across=st.booleans())
    def onto_a_layer(self, data, points, erase, across) -> None:
        layer = data.draw(st.sampled_from(list(self.edit.layers)))
        act = layer.erase if erase else layer.paint
        self.attempt(lambda: act(tb.Stroke(points, radius=8), across))

    @precondition(lambda self: len(self.edit.layers))
    @rule(data=st.data(), opacity=st.floats(0, 1), effect=EFFECTS, part=PARTS)
    def change_a_layer(self, data, opacity, effect, part) -> None:
        layer = data.draw(st.sampled_from(list(self.edit.layers)))
        what = data.draw(st.sampled_from([
            "opacity", "effect", "visible", "name", "delete", "duplicate", "invert", "clear",
            "clip", "first", "last",
        ]))  # fmt: skip
        acts = {
            "opacity": lambda: setattr(layer, "opacity", opacity),
            "effect": lambda: setattr(layer, "effect", effect),
            "visible": lambda: setattr(layer, "visible", not layer.visible),
            "name": lambda: setattr(layer, "name", f"layer {opacity:.2f}"),
            "delete": layer.delete, "duplicate": layer.duplicate, "invert": layer.invert,
            "clear": layer.clear, "clip": lambda: layer.clip(part),
            "first": lambda: layer.move_to(0), "last": lambda: layer.move_to(-1),
        }  # fmt: skip
        self.attempt(acts[what])

    @rule(times=st.integers(1, 3))
    def undo_and_redo(self, times) -> None:
        design = self.edit.design
        done = sum(self.edit.undo() for _ in range(times))
        for _ in range(done):
            assert self.edit.redo()
        assert self.edit.design is design

    @rule()
    def undo(self) -> None:
        self.edit.undo()

    @rule(azimuth=st.sampled_from([35.0, 35.0, -60.0]), turn=st.sampled_from([0.7, 0.7, 2.0]))
    def look(self, azimuth, turn) -> None:
        scene = self.prepared.scene
        if (azimuth, turn) == (35.0, 0.7):
            if not self.home:
                again = over(self.prepared, error=1.0)
                again.design = self.edit.design
                self.edit, self.home = again, True
        else:
            sky = tb.EnvironmentMap(scene.environment.image, turn)
            self.edit.look(camera=tb.Camera.orbit(azimuth, 20.0), environment=sky)
            self.home = False

    @rule()
    def save_and_load(self) -> None:
        path = self.folder / "painted.tbr"
        frame = self.frame()
        self.edit.save(path)
        loaded = EditSession.load(path)
        if self.home:
            again = over(self.prepared, error=1.0)
            again.design = loaded.design
            self.edit = again
        else:
            self.edit = loaded
        self.alike(self.frame(), frame)

    @staticmethod
    def alike(one, other) -> None:
        assert np.abs(one - other).mean() <= 2e-3 * max(other.mean(), 1e-6)

    @invariant()
    def frames_are_radiance(self) -> None:
        if hasattr(self, "edit"):
            frame = self.edit.render(exact=False) if self.home else self.edit.draft(12)[0]
            assert np.isfinite(frame).all()
            assert frame.min() >= 0.0

    def teardown(self) -> None:
        """The history, replayed on a fresh session, gives the same frame."""
        if not hasattr(self, "edit"):
            return
        again = over(self.prepared, error=1.0)
        if not self.home:
            home = over(self.prepared, error=1.0)
            home.design = self.edit.design
            self.edit = home
        for line in self.edit.history:
            exec(line, {"tb": tb, "edit": again, "tables": self.edit.tables})
        self.alike(again.render(), self.edit.render())
        assert str(again.layers) == str(self.edit.layers)


def run(prepared, tmp_path, examples: int, steps: int) -> None:
    machine = type("Machine", (Painting,), {"prepared": prepared, "folder": tmp_path})
    case = machine.TestCase
    case.settings = settings(
        max_examples=examples, stateful_step_count=steps, deadline=None,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    case().runTest()


def test_random_sessions_replay_to_the_same_frame(prepared, tmp_path):
    run(prepared, tmp_path, 6, 10)


@pytest.mark.slow
def test_many_long_random_sessions_replay_to_the_same_frame(prepared, tmp_path):
    run(prepared, tmp_path, 10, 20)


# -- files ----------------------------------------------------------------------------------------

_SAVING = """
import itertools, sys
from traitbrdf.formats.files import read_arrays, write_arrays
path, *designs = sys.argv[1:]
known = [read_arrays(design) for design in designs]
print("ready", flush=True)
for i in itertools.count():
    write_arrays(path, known[i % 2])
"""


@pytest.mark.slow
def test_who_is_killed_while_saving_keeps_the_previous_file(edit, tmp_path):
    """200 processes, each killed while it saves two designs in turns."""
    designs = [tmp_path / "one.tbr", tmp_path / "two.tbr"]
    for design in designs:
        edit.paint(tb.Stroke([(30, 30)], radius=8), tb.Move(shiny=0.5), where="local")
        edit.save(design)
    texts = {json.dumps(str(read_arrays(design)["design"])) for design in designs}
    path, rng = tmp_path / "design.tbr", random.Random(0)
    start = time.perf_counter()
    write_arrays(path, read_arrays(designs[0]))
    takes = time.perf_counter() - start
    seen = set()
    for _ in range(200):
        call = [sys.executable, "-c", _SAVING, str(path), *map(str, designs)]
        with subprocess.Popen(call, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
            time.sleep(rng.uniform(0.0, 3.0 * takes))
            process.kill()
        arrays = read_arrays(path)
        seen.add(json.dumps(str(arrays["design"])))
        assert seen <= texts
    assert seen == texts
    EditSession.load(path)


def test_designs_with_paint_that_does_not_fit_are_refused(edit, tmp_path):
    path = tmp_path / "painted.tbr"
    edit.paint(tb.Stroke([(30, 30)], radius=8), tb.Move(shiny=0.5), where="local")
    edit.layers[0].erase(tb.Stroke([(32, 30)], radius=3, pressure=[0.5]))
    edit.save(path)
    assert EditSession.load(path).design == edit.design
    arrays = read_arrays(path)
    whole = str(arrays["design"])

    def refused(change) -> None:
        header = json.loads(whole)
        change(header, header["layers"][0]["mask"])
        write_arrays(tmp_path / "other.tbr", {**arrays, "design": np.array(json.dumps(header))})
        with pytest.raises(FormatError, match=r"other\.tbr: expected"):
            EditSession.load(tmp_path / "other.tbr")

    refused(lambda header, mask: header.update(format=99))
    refused(lambda header, mask: mask.update(whole=["body"]))
    refused(lambda header, mask: mask.update(inverted="yes"))
    refused(lambda header, mask: mask.update(only=["cup"]))
    refused(lambda header, mask: mask["strokes"].append({"is": "Parts", "weights": [["lid", 1.0]]}))
    for change in (
        {"radius": -1.0}, {"hardness": 7.0}, {"flow": 0.0}, {"pressure": [2.0]}, {"units": "miles"},
        {"points": []}, {"points": [[float("inf"), 0.0]]},
    ):  # fmt: skip
        refused(lambda _, mask, change=change: mask["strokes"][0]["stroke"].update(change))
    refused(lambda header, mask: mask["strokes"][0].update(parts=["cup"]))
    refused(lambda header, mask: mask["strokes"][0].update(framing=None))
