"""The live canvas without a browser: the session, the page's server, the widget, the module."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from sessions import over
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

import traitbrdf as tb
from traitbrdf.cli import main
from traitbrdf.design.strokes import Stroke, follow
from traitbrdf.formats.display import Display, exposure_of, tone_map
from traitbrdf.session import preparation, viewer
from traitbrdf.session.editing import EditSession
from traitbrdf.studio import studio
from traitbrdf.studio.page import Server, application, pack, unpack
from traitbrdf.studio.session import LARGEST, Session

BRUSH = {"trait": "shiny", "amount": -0.6, "radius": 2.0, "stay": True}


@pytest.fixture
def session(prepared, training, tmp_path, monkeypatch):
    """Over a prepared teapot, of one material."""
    monkeypatch.setattr(preparation, "training_of", lambda library, seed: training)
    session = Session(over(prepared, cache=False), tmp_path)
    yield session
    session.close()


def samples(points, pressure=1.0, lift=True, begin=True):
    """Of one stroke, or of a piece of it."""
    phase = [1.0] * len(points)
    if begin:
        phase[0] = 0.0
    rows = [[x, y, pressure, p] for (x, y), p in zip(points, phase, strict=True)]
    if lift:
        rows.append([*points[-1], pressure, 2.0])
    return np.array(rows, "<f4").tobytes()


def along(session, part="handle"):
    scene = session.edit.scene
    points, _ = follow(scene.part_image == scene.parts.index(part))
    return points


def ask(session, buffers=(), view="a", **header):
    return session.handle({"kind": "input", "view": view, "seq": 1, **header}, buffers)


def frame(replies):
    (found,) = (header for header, _ in replies if header["kind"] == "frame")
    return found


def errors(replies):
    return [header["message"] for header, _ in replies if header["kind"] == "error"]


class Screen:
    """What a page draws."""

    def __init__(self):
        self.pixels = None

    def draw(self, replies):
        for header, buffers in replies:
            if header["kind"] != "frame":
                continue
            if self.pixels is None or self.pixels.shape[:2] != (header["height"], header["width"]):
                self.pixels = np.zeros((header["height"], header["width"], 3), np.uint8)
            x, y, w, h = (header[key] for key in "xywh")
            if header["format"] == "rgb":
                drawn = np.frombuffer(buffers[0], np.uint8).reshape(h, w, 3)
            elif header["format"] == "none":
                continue
            else:
                drawn = np.asarray(Image.open(io.BytesIO(buffers[0])).convert("RGB"))
            self.pixels[y : y + h, x : x + w] = drawn
        return self.pixels.copy()


# -- the protocol -----------------------------------------------------------------------------


def test_hello_has_all_that_a_page_needs(session):
    replies = session.handle({"kind": "hello", "view": "a", "seq": 3})
    header = frame(replies)
    scene = session.edit.scene
    assert (header["view"], header["seq"]) == ("a", 3)
    assert (header["width"], header["height"]) == (scene.width, scene.height)
    assert (header["x"], header["y"], header["w"], header["h"]) == (0, 0, scene.width, scene.height)
    assert header["parts"] == list(scene.parts)
    assert header["traits"] == list(session.edit.traits.names)
    assert "blue-plastic" in header["library"]
    assert set(header["ms"]) == {"edit", "render", "encode"}
    state = header["state"]
    assert state["ready"] and state["fraction"] == 1.0
    assert 0.0 < state["error"] < 0.1
    assert set(state["scores"]) == set(header["traits"])
    assert set(state["plausibility"]) == {"energy_scale", "gamut_margin", "plausibility"}
    json.dumps(header, allow_nan=False)
    image = session.edit.render(exact=False)
    shown = Screen().draw(replies).astype(int)
    assert np.abs(shown - tone_map(image, exposure_of(image))).mean() < 4.0


def test_a_stroke_changes_the_handle_and_nothing_else(session):
    screen = Screen()
    session.handle({"kind": "hello", "view": "a"})
    before = screen.draw(ask(session, rest=True))
    old = {part: session.edit.material(part) for part in session.edit.scene.parts}
    points = along(session)
    screen.draw(ask(session, [samples(points[:3], lift=False)], brush=BRUSH))
    screen.draw(ask(session, [samples(points[3:], begin=False)], brush=BRUSH))
    after = screen.draw(ask(session, rest=True))
    changed = {p for p in old if session.edit.material(p) is not old[p]}
    assert changed == {"handle"}
    scene = session.edit.scene
    inside = np.zeros(scene.height * scene.width, bool)
    inside[scene.pixels[scene.part_slice(scene.parts.index("handle"))]] = True
    differs = (before != after).any(axis=-1).reshape(-1)
    assert differs.any()
    assert not differs[~inside].any()
    assert len(session.edit.history) == 1
    assert frame(ask(session))["state"]["part"] == "handle"


def test_a_stroke_in_pieces_is_the_whole_stroke(session):
    """However it arrives, it is one edit, and that of the stroke."""
    points = along(session)
    for i in range(len(points)):
        last = i == len(points) - 1
        piece = samples(points[i : i + 1], lift=last, begin=i == 0)
        assert not errors(ask(session, [piece], brush=BRUSH))
    (line,) = session.edit.history
    kept = session.edit.material("handle").z.copy()
    session.edit.undo()
    assert not session.edit.undoable
    whole = ask(session, [samples(points)], brush=BRUSH)
    assert not errors(whole)
    np.testing.assert_allclose(session.edit.material("handle").z, kept)
    assert session.edit.history == [line]
    amount = BRUSH["amount"]
    session.edit.undo()
    # long enough that it has all of the amount
    edit = eval(line.replace("edit.paint(", "dict(stroke=", 1), {"tb": tb, "dict": dict})
    assert edit["stroke"].amount == pytest.approx(amount)
    assert edit["only"] == "handle"
    session.edit.paint(edit["stroke"], only=edit["only"])
    np.testing.assert_allclose(session.edit.material("handle").z, kept)


def test_pressure_and_way_dose_a_stroke(session):
    points = along(session)

    def amount(rows, **brush):
        assert not errors(ask(session, [rows], brush={**BRUSH, **brush}))
        line = session.edit.history[-1]
        ask(session, do="undo")
        return float(line.split("amount=")[1].split(",")[0])

    full = amount(samples(points))
    assert full == pytest.approx(-0.6)
    assert amount(samples(points, pressure=0.25)) == pytest.approx(0.25 * full, rel=1e-5)
    assert amount(samples(points[:1])) == pytest.approx(full / 3.0)
    assert amount(samples(points, pressure=7.0)) == pytest.approx(full)


def test_strokes_in_one_message_are_edits_of_their_own(session):
    both = samples(along(session)) + samples(along(session, "lid"))
    assert not errors(ask(session, [both], brush=BRUSH))
    assert len(session.edit.history) == 2
    assert "only='handle'" in session.edit.history[0]
    assert "only='lid'" in session.edit.history[1]


def test_a_stroke_that_may_leave_its_part(session):
    wide = {**BRUSH, "radius": 400.0, "stay": False}
    ask(session, [samples(along(session))], brush=wide)
    moved = {m.z.tobytes() for m in map(session.edit.material, session.edit.scene.parts)}
    assert len(moved) > 3
    assert "only" not in session.edit.history[0]


def test_a_stroke_beside_the_object_does_nothing(session):
    assert not errors(ask(session, [samples([(1.0, 1.0), (2.0, 1.0)])], brush=BRUSH))
    assert session.edit.history == []
    # and one that comes in from there paints where it arrives
    ask(session, [samples([(1.0, 1.0), *along(session)])], brush=BRUSH)
    assert len(session.edit.history) == 1


def test_sliders_move_the_chosen_part(session):
    old = session.edit.scores("lid")
    for change in (0.1, 0.2, 0.4):
        slide = {"part": "lid", "amounts": {"matte": change}, "done": change == 0.4}
        state = frame(ask(session, slide=slide, part="lid"))["state"]
    assert session.edit.history == ["edit.move('lid', matte=0.4)"]
    assert state["scores"]["matte"] == pytest.approx(old["matte"] + 0.4, abs=0.05)
    ask(session, slide={"part": "lid", "amounts": {"red": 0.3}, "done": True})
    assert session.edit.history[1:] == ["edit.move('lid', red=0.3)"]


def test_a_slider_at_work_takes_back_nothing_of_others(session):
    ask(session, slide={"part": "lid", "amounts": {"matte": 0.1}})
    session.edit.move("body", shiny=-0.2)  # a cell of the notebook
    ask(session, slide={"part": "lid", "amounts": {"matte": 0.3}, "done": True})
    assert [line.split("(")[1].split(",")[0] for line in session.edit.history] == [
        "'lid'", "'body'", "'lid'",
    ]  # fmt: skip


def test_undo_redo_and_before(session):
    screen = Screen()
    first = screen.draw(ask(session, rest=True))
    ask(session, [samples(along(session))], brush=BRUSH)
    edited = screen.draw(ask(session, rest=True))
    assert (first != edited).any()
    np.testing.assert_array_equal(screen.draw(ask(session, before=True, rest=True)), first)
    assert len(session.edit.history) == 1
    np.testing.assert_array_equal(screen.draw(ask(session, rest=True)), edited)
    reply = ask(session, do="undo", rest=True)
    np.testing.assert_array_equal(screen.draw(reply), first)
    assert (frame(reply)["state"]["undo"], frame(reply)["state"]["redo"]) == (False, True)
    np.testing.assert_array_equal(screen.draw(ask(session, do="redo", rest=True)), edited)
    assert not errors(ask(session, do="redo"))  # nothing to do again
    assert errors(ask(session, do="dance"))


def test_a_frame_at_rest_is_lossless(session):
    replies = ask(session, rest=True)
    image = session.edit.render(exact=False)
    assert frame(replies)["format"] == "png"
    np.testing.assert_array_equal(Screen().draw(replies), Display(exposure_of(image))(image))


def test_only_what_changed_is_sent(session):
    session.handle({"kind": "hello", "view": "a"})
    assert frame(ask(session))["format"] == "none"
    header = frame(ask(session, [samples(along(session))], brush=BRUSH))
    assert header["format"] == "rgb"
    scene = session.edit.scene
    assert header["w"] * header["h"] < 0.3 * scene.width * scene.height


def test_choosing(session):
    assert frame(ask(session, part="lid"))["state"]["part"] == "lid"
    scene = session.edit.scene
    y, x = np.argwhere(scene.part_image == scene.parts.index("spout"))[3]
    assert frame(ask(session, pick=[float(x), float(y)]))["state"]["part"] == "spout"
    # beside the object, or beside the image, nothing else is chosen
    for place in ([0.0, 0.0], [-5.0, 3.0], [1e5, 1e5]):
        assert frame(ask(session, pick=place))["state"]["part"] == "spout"
    state = frame(ask(session, assign={"part": "spout", "material": "gold-satin"}))["state"]
    assert state["material"] == "gold-satin"
    assert errors(ask(session, part="spoon"))[0].startswith("part: unknown part 'spoon'")
    assert errors(ask(session, assign={"part": "lid", "material": "cheese"}))


def test_orbit_zoom_and_turn(session):
    old = session.edit.scene.camera
    turned = session.edit.scene.environment.rotation
    replies = ask(session, orbit=[20.0, 500.0], zoom=1.5, dragging=True)
    camera = session.edit.scene.camera
    assert camera.azimuth == pytest.approx(old.azimuth + 20.0)
    assert (camera.elevation, camera.zoom) == (89.0, pytest.approx(1.5 * old.zoom))
    state = frame(replies)["state"]
    assert not state["ready"]
    assert state["error"] > 0.0
    assert "glance" in session.edit.view.times  # a hand that turns the object sees it turn
    ask(session, turn=90.0, dragging=True)
    now = session.edit.scene.environment.rotation
    assert (now - turned) % (2.0 * np.pi) == pytest.approx(0.5 * np.pi)
    assert session.refiner is None  # nothing is prepared while the hand drags


def test_views_are_prepared_once_the_hand_rests(session):
    told = []
    done = threading.Event()

    def push(header, buffers):
        told.append(header)
        if header["ready"]:
            done.set()

    end = session.subscribe(push)
    ask(session, orbit=[15.0, 0.0], dragging=True)
    assert not frame(ask(session, dragging=False))["state"]["ready"]
    assert done.wait(120.0)
    assert {header["kind"] for header in told} == {"changed"}
    replies = ask(session)
    assert frame(replies)["state"]["ready"]
    end()
    count = len(told)
    ask(session, part="lid")
    assert len(told) == count


def test_a_preparation_that_fails_is_told(session, monkeypatch):
    def fail(*arguments):
        raise RuntimeError("no rays today")

    monkeypatch.setattr(viewer, "prepare_view", fail)
    ask(session, orbit=[15.0, 0.0])
    session.refiner.join(60.0)
    assert "no rays today" in frame(ask(session, dragging=True))["state"]["trouble"]


def test_exact_frames_are_made_when_asked_for(session):
    edit = session.edit
    edit.settings = dataclasses.replace(edit.settings, error=1e-9)  # nothing meets that
    state = frame(ask(session))["state"]
    assert set(state["doubtful"]) == set(edit.scene.parts[: len(edit.scene.shape.parts)])
    state = frame(ask(session, exact=True))["state"]
    assert state["doubtful"] == []
    assert edit.report()["exact_frames"] > 0


def test_parts_become_exact_behind_a_hand_that_rests(session):
    edit = session.edit
    edit.settings = dataclasses.replace(edit.settings, error=1e-9)  # nothing meets that
    state = frame(ask(session))["state"]
    assert state["doubtful"] and session.refiner is None  # while somebody edits, nobody computes
    ask(session, rest=True)
    session.refiner.join(60.0)
    state = frame(ask(session))["state"]
    assert state["doubtful"] == [] and state["trouble"] == ""
    assert edit.report()["exact_frames"] > 0


def test_a_hand_that_rests_as_the_refiner_ends_is_not_forgotten(session, monkeypatch):
    edit = session.edit
    edit.settings = dataclasses.replace(edit.settings, error=1e-9)  # nothing meets that
    plain, late = edit.improve, []

    def improve():
        more = plain()
        if not more and not late:  # it has looked for the last time
            late.append(ask(session, assign={"part": "lid", "material": "red-rubber"}, rest=True))
        return more

    monkeypatch.setattr(edit, "improve", improve)
    ask(session, rest=True)
    session.refiner.join(60.0)
    assert frame(late[0])["state"]["doubtful"] == ["lid"]
    assert frame(ask(session))["state"]["doubtful"] == []


def test_closing_ends_what_becomes_exact(session, monkeypatch):
    edit = session.edit
    edit.settings = dataclasses.replace(edit.settings, error=1e-9)
    reached, opened, ended = (threading.Event() for _ in range(3))

    def endless(self, index, table, mirror=None, progress=None):
        reached.set()
        assert opened.wait(60.0)
        try:
            progress("exact images", 0.5)
        except BaseException:
            ended.set()
            raise
        raise AssertionError("nobody wants it any more")

    monkeypatch.setattr(type(edit.prepare()), "shade_exactly", endless)
    ask(session)
    ask(session, rest=True)
    assert reached.wait(60.0)
    refiner = session.refiner
    threading.Timer(0.05, opened.set).start()
    session.close()
    assert not refiner.is_alive() and ended.is_set()
    assert session._trouble == ""


def test_saving_and_opening(session, tmp_path):
    ask(session, [samples(along(session))], brush=BRUSH)
    shown = Screen().draw(ask(session, rest=True))
    assert not errors(ask(session, save="mine"))
    assert (tmp_path / "mine.tbr").is_file()
    z = session.edit.material("handle").z
    ask(session, do="undo")
    assert not errors(ask(session, open="mine.tbr", dragging=True))
    np.testing.assert_array_equal(session.edit.material("handle").z, z)
    assert len(session.edit.history) == 1
    session.edit.prepare()
    again = Screen().draw(ask(session, rest=True))
    assert np.abs(again.astype(int) - shown).max() <= 3
    assert "did you mean" in errors(ask(session, open="mines"))[0]
    for odd in ("", "../mine", "/etc/passwd", "a/b", "..", ".hidden", "c:x", "n\0", 7, "x" * 200):
        assert errors(ask(session, save=odd)), odd
        assert errors(ask(session, open=odd)), odd
    assert [p.name for p in tmp_path.iterdir()] == ["mine.tbr"]


# -- what goes wrong --------------------------------------------------------------------------


def test_two_views_of_one_session(session):
    """Each draws what the other did, by asking for it when it suits."""
    told = []
    session.subscribe(lambda header, buffers: told.append(header))
    first, second = Screen(), Screen()
    for view, screen in (("a", first), ("b", second)):
        screen.draw(session.handle({"kind": "hello", "view": view}))
    first.draw(ask(session, [samples(along(session))], brush=BRUSH))
    ask(session, do="redo")
    deadline = time.monotonic() + 10.0
    while not told and time.monotonic() < deadline:
        time.sleep(0.01)
    assert [news["by"] for news in told] == ["a"]  # what comes at once is told at once
    second.draw(ask(session, view="b"))
    first.draw(ask(session, rest=True))
    second.draw(ask(session, view="b", rest=True))
    np.testing.assert_array_equal(first.pixels, second.pixels)


def test_hands_of_two_views_do_not_mix(session):
    handle, lid = along(session), along(session, "lid")
    ask(session, [samples(handle[:8], lift=False)], brush=BRUSH)
    state = frame(ask(session, [samples(lid, lift=False)], view="b", brush=BRUSH))["state"]
    assert "history" not in state  # b's own is not told before it ends
    # a's went on meanwhile: it was given up, and what it did stays
    state = frame(ask(session, [samples(handle[8:], begin=False)], brush=BRUSH))["state"]
    assert [line.split("only=")[1] for line in state["history"]] == ["'handle')", "'lid')"]
    moved = session.edit.material("handle")
    ask(session, [samples(lid[:3], begin=False)], view="b", brush=BRUSH)
    assert len(session.edit.history) == 2
    assert session.edit.material("handle") == moved
    # nor do sliders
    slide = {"part": "body", "amounts": {"matte": 0.2}, "done": False}
    ask(session, slide=slide)
    ask(session, view="b", slide=slide)
    assert len(session.edit.history) == 4
    ask(session, view="b", slide={**slide, "done": True})
    assert len(session.edit.history) == 4


def test_a_page_that_is_closed_in_the_middle_of_a_stroke(session):
    """What was painted stays, the next view sees it and can take it back."""
    ask(session, [samples(along(session), lift=False)], brush=BRUSH)
    header = frame(session.handle({"kind": "hello", "view": "b"}))
    assert "only='handle'" in header["state"]["history"][0]
    state = frame(ask(session, view="b", do="undo"))["state"]
    assert state["history"] == []
    assert not state["undo"]
    # its last samples come late, or never
    assert not errors(ask(session, [samples(along(session), begin=False)], brush=BRUSH))
    assert session.edit.history == []


def test_a_view_that_is_gone_is_no_trouble(session):
    def gone(header, buffers):
        raise ConnectionError("closed")

    session.subscribe(gone)
    assert not errors(ask(session, part="lid"))


def test_an_edit_that_raises_is_told_and_the_session_goes_on(session, monkeypatch):
    def fail(*arguments, **more):
        raise RuntimeError("out of paint")

    with monkeypatch.context() as patch:
        patch.setattr(EditSession, "paint", fail)
        replies = ask(session, [samples(along(session))], brush=BRUSH)
    assert "out of paint" in errors(replies)[0]
    assert frame(replies)["state"]["ready"]
    assert not errors(ask(session, [samples(along(session))], brush=BRUSH))
    with monkeypatch.context() as patch:
        patch.setattr(EditSession, "render", fail)
        ((header, _),) = ask(session)
    assert (header["kind"], header["seq"]) == ("error", 1)
    assert not errors(ask(session))


def test_a_slow_frame_is_only_slow(session, monkeypatch):
    render = EditSession.render

    def slow(self, **arguments):
        time.sleep(0.1)
        return render(self, **arguments)

    monkeypatch.setattr(EditSession, "render", slow)
    assert frame(ask(session))["ms"]["render"] >= 100.0


def test_ten_thousand_samples_at_once(session):
    angle = np.linspace(0.0, 40.0, 10_000)
    points = [(30.0 + 12.0 * np.cos(a), 24.0 + 12.0 * np.sin(a)) for a in angle]
    replies = ask(session, [samples(points)], brush=BRUSH)
    assert not errors(replies)
    assert len(session.edit.history) == 1
    assert len(session.edit.history[0]) < 400_000
    assert len(frame(replies)["state"]["history"][0]) < 200


def test_messages_that_are_too_large(session):
    (reply,) = session.handle({"kind": "input", "view": "a"}, [bytes(LARGEST + 1)])
    assert "expected at most" in reply[0]["message"]


def test_odd_samples_are_refused(session):
    for odd in (b"123", np.full((1, 4), np.nan, "<f4").tobytes()):
        assert errors(ask(session, [odd], brush=BRUSH))[0].startswith("brush: expected samples")
    for odd in (None, [], {}, {**BRUSH, "radius": 0.0}, {**BRUSH, "trait": "tasty"},
                {**BRUSH, "radius": "wide"}, {**BRUSH, "amount": float("inf")}):  # fmt: skip
        assert errors(ask(session, [samples(along(session))], brush=odd)), odd
    assert session.edit.history == []
    # a piece of a stroke whose beginning was refused is nothing
    ask(session, [samples(along(session), begin=False)], brush=BRUSH)
    assert session.edit.history == []


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner),
    max_leaves=8,
)
KEYS = st.sampled_from(
    ["kind", "view", "seq", "part", "pick", "brush", "slide", "assign", "orbit", "zoom", "turn",
     "do", "save", "open", "before", "rest", "pad", "exact"]
)  # fmt: skip


@pytest.mark.parametrize("seq", [float("inf"), float("nan"), True, "1", [1]])
def test_a_number_that_is_none_is_not_repeated(session, seq):
    (reply, _), *_ = session.handle({"kind": "input", "view": "a", "seq": seq})
    assert reply["seq"] is None
    json.dumps(reply, allow_nan=False)


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    header=JSON | st.dictionaries(KEYS, JSON).map(lambda d: {"kind": "input", **d}),
    buffers=st.lists(st.binary(max_size=40), max_size=2),
)
def test_no_message_makes_it_raise(session, header, buffers):
    if isinstance(header, dict):
        header["dragging"] = True  # a new view need not be prepared here
    replies = session.handle(header, buffers)
    assert replies
    for reply, binary in replies:
        assert reply["kind"] in ("frame", "error")
        json.dumps(reply, allow_nan=False)
        assert all(isinstance(part, bytes) for part in binary)


def test_a_reply_is_padded_where_it_is_asked_for(session):
    ((plain, (pixels,)),) = session.handle({"kind": "hello", "view": "a"})
    assert plain["bytes"] == len(pixels)
    ((header, (padded,)),) = session.handle({"kind": "hello", "view": "a", "pad": True})
    assert len(padded) == 66_000
    assert header["bytes"] == len(pixels)
    assert padded == pixels + bytes(66_000 - len(pixels))
    # even one that has nothing to show
    ((header, (padded,)),) = ask(session, pad=True)
    assert (header["format"], header["bytes"], len(padded)) == ("none", 0, 66_000)


def test_strokes_that_grow_cover_what_whole_ones_do():
    points = [(10.0 + 3.0 * i, 20.0 + 5.0 * np.sin(i)) for i in range(9)]
    whole = Stroke(points, trait="shiny", amount=0.5, radius=4.0).coverage(48, 60)
    grown = Stroke(points[:1], trait="shiny", amount=0.1, radius=4.0)
    grown.coverage(48, 60)
    for i in range(1, 9, 2):
        grown = grown.extended(points[i : i + 2], 0.5)
        if i != 3:
            grown.coverage(48, 60)
    assert grown == Stroke(points, trait="shiny", amount=0.5, radius=4.0)
    np.testing.assert_array_equal(grown.coverage(48, 60), whole)
    np.testing.assert_array_equal(grown.coverage(48, 60), whole)
    other = Stroke(points, trait="shiny", amount=0.5, radius=4.0).coverage(30, 90)
    np.testing.assert_array_equal(grown.coverage(30, 90), other)


def test_a_display_shows_what_the_tone_map_does():
    values = np.concatenate([np.geomspace(1e-6, 1e4, 3000), [0.0]])
    linear = np.repeat(values[:, None], 3, axis=1).astype(np.float32)
    for exposure in (0.01, 1.0, 37.0):
        shown = Display(exposure)(linear).astype(int)
        assert np.abs(shown - tone_map(linear, exposure)).max() <= 1


# -- the page ---------------------------------------------------------------------------------

HOME = "http://127.0.0.1:80"


def test_a_fast_stroke_stays_on_the_part_on_which_it_begins(session):
    """All of a stroke may come in one message, and its end lie on another part."""
    image, parts = session.edit.scene.part_image, session.edit.scene.parts
    body, handle = parts.index("body"), parts.index("handle")
    rows, columns = np.nonzero((image[:, :-1] == handle) & (image[:, 1:] == body))
    y, x = rows[0] + 0.5, columns[0] + 0.5
    for points, part in (([(x, y), (x + 1, y)], "handle"), ([(x + 1, y), (x, y)], "body")):
        assert not errors(ask(session, [samples(points)], brush={**BRUSH, "radius": 4.0}))
        assert f"only='{part}'" in session.edit.history[-1]


# -- materials to choose from, and lists ----------------------------------------------------------


def test_a_shelf_is_told_at_once_and_drawn_behind(session):
    pushed = []
    session.subscribe(lambda header, buffers: pushed.append((header, buffers)))
    replies = ask(session, shelf={"query": "old brass"})
    (told,) = (header for header, _ in replies if header["kind"] == "shelf")
    found = tb.find_materials("old brass")
    assert told["names"] == found[:24]
    assert told["total"] == len(found)
    shelves: list = []
    deadline = time.monotonic() + 60.0
    while len(shelves) < -(-len(found) // 6) and time.monotonic() < deadline:
        time.sleep(0.05)
        shelves = [one for one in pushed if one[0]["kind"] == "shelf"]
    header, (strip,) = shelves[-1]
    assert (header["view"], header["query"]) == ("a", "old brass")
    image = np.asarray(Image.open(io.BytesIO(strip)))
    side = header["side"]
    assert image.shape == (side, side * len(found), 3)
    for i in range(len(found)):  # a lit sphere of a yellow metal
        middle = image[15:25, side * i + 15 : side * i + 25].reshape(-1, 3).mean(axis=0)
        assert middle[0] > 60
        assert middle[0] > middle[2]
    # the next time nothing is left to draw
    again = ask(session, shelf={"query": "old brass"})
    assert next(b for h, b in again if h["kind"] == "shelf") == [strip]


@pytest.mark.parametrize(
    ("shelf", "said"),
    [
        ({"query": "shiny > high"}, "expected terms"), ({"query": 7}, "expected a query"),
        ({"query": "x" * 201}, "expected a query"), ("brass", "expected a query"),
        ({"query": "shinny > 1"}, "did you mean 'shiny'"),
    ],
)  # fmt: skip
def test_bad_queries_are_told(session, shelf, said):
    replies = ask(session, shelf=shelf)
    assert said in errors(replies)[0]
    assert not [header for header, _ in replies if header["kind"] == "shelf"]


def test_a_material_goes_to_the_part_at_a_place(session):
    x, y = along(session, "handle")[0]
    replies = ask(session, assign={"at": [x, y], "material": "gold-satin"})
    assert frame(replies)["state"]["part"] == "handle"
    assert session.edit.material("handle").name == "gold-satin"
    assert session.edit.material("body").name != "gold-satin"
    # what is dropped beside the object goes nowhere
    count = len(session.edit.layers)
    assert "beside it" in errors(ask(session, assign={"at": [0, 0], "material": "chrome"}))[0]
    assert len(session.edit.layers) == count


def test_all_traits_are_in_groups_and_own_ones_last(session):
    reply = frame(session.handle({"kind": "hello", "view": "a", "seq": 1}))
    names = [name for _, group in reply["groups"] for name in group]
    assert sorted(names) == sorted(session.edit.traits.names)
    mine = tb.Trait.from_labels("mine", ["blue-plastic", "red-rubber"], [1, -1])
    session.edit.traits = session.edit.traits.with_trait(mine)
    reply = frame(ask(session))  # the lists have changed, and come unasked
    assert reply["groups"][-1] == ("yours", ["mine"])
    assert "groups" not in frame(ask(session))


def told(session, request, seconds=120.0, **more):
    """What is told of an export."""
    heard = []
    end = session.subscribe(lambda header, _: heard.append(header))
    replies = ask(session, export=request, **more)
    assert not errors(replies), errors(replies)
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        done = [header for header in heard if header["kind"] == "told"]
        if done:
            end()
            return done[0]
        time.sleep(0.02)
    raise AssertionError("never told")


def test_files_for_other_programs_are_written_behind(session, tmp_path):
    assert told(session, "mine.png")["message"] == "mine.png"
    shown = np.asarray(Image.open(tmp_path / "mine.png"))
    np.testing.assert_array_equal(shown, session.display(session.edit.render(exact=False)))
    assert told(session, "lid.binary", part="lid")["done"]
    assert (tmp_path / "lid.binary").stat().st_size == 34_992_012
    assert told(session, "lid.npz", part="lid")["done"]
    read = tb.TabulatedBRDF.read(tmp_path / "lid.npz")
    np.testing.assert_array_equal(read.values, session.edit.brdf("lid").values)
    scene = told(session, "mine.py")
    assert scene["message"].startswith("mine.py, mine.npz")
    assert (tmp_path / "mine.py").exists()
    # one at a time, and one that fails is told of
    (tmp_path / "no.glb").mkdir()
    failed = told(session, "no.glb", view="b")
    assert failed["done"] is False
    assert failed["view"] == "b"
    assert "export: " in failed["message"]


@pytest.mark.parametrize("name", ["../x.glb", "", ".glb", "a/b.png", 3, None])
def test_files_elsewhere_are_refused(session, tmp_path, name):
    assert "export: expected" in errors(ask(session, export=name))[0]
    assert not list(tmp_path.iterdir())


def test_numbers_of_the_history_are_short(session):
    ask(session, slide={"part": "lid", "amounts": {"shiny": 0.1 + 0.2}, "done": True})
    ask(session)
    last = frame(ask(session))["state"]["history"][-1]
    assert "0.3" in last
    assert "0.30000000000000004" not in last


def test_a_deleted_folder_is_told_when_it_is_needed(prepared, tmp_path, monkeypatch):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    session = Session(over(prepared, cache=False))
    try:
        replies = ask(session, save="mine")
        assert "the folder of designs was deleted" in errors(replies)[0]
        assert frame(replies)["state"]["part"]
    finally:
        session.close()


@pytest.fixture
def client(session):
    with TestClient(application(session, "secret", {HOME}), base_url=HOME) as client:
        yield client


def test_the_page_asks_for_its_token(client):
    assert client.get("/").status_code == 403
    assert client.get("/?token=guess").status_code == 403
    page = client.get("/?token=secret")
    assert page.status_code == 200
    assert "page.js" in page.text
    assert "default-src 'self'" in page.headers["content-security-policy"]
    for name in ("canvas.js", "link.js", "page.js"):
        module = client.get(f"/{name}")
        assert module.status_code == 200
        assert module.headers["content-type"].startswith("text/javascript")
    for other in ("/session.py", "/../cli.py", "/nothing"):
        assert client.get(other).status_code == 404


@pytest.mark.parametrize(
    ("token", "origin"),
    [
        ("guess", HOME), ("", HOME), ("secret", "https://elsewhere.example"), ("secret", "null"),
        ("secret", None), ("secr\u00e9t", HOME),
    ],
)  # fmt: skip
def test_the_socket_asks_for_token_and_origin(client, session, token, origin):
    headers = {} if origin is None else {"origin": origin}
    with (
        pytest.raises(WebSocketDisconnect) as closed,
        client.websocket_connect(f"/socket?token={token}", headers=headers),
    ):
        pass
    assert closed.value.code == 4403
    assert not session.subscribers


def test_messages_over_the_socket(client, session):
    with client.websocket_connect("/socket?token=secret", headers={"origin": HOME}) as socket:
        socket.send_bytes(pack({"kind": "hello", "view": "a", "seq": 1}, []))
        header, buffers = unpack(socket.receive_bytes())
        assert (header["kind"], header["seq"]) == ("frame", 1)
        assert Screen().draw([(header, buffers)]).shape == (header["height"], header["width"], 3)
        message = {"kind": "input", "view": "a", "seq": 2, "brush": BRUSH}
        socket.send_bytes(pack(message, [samples(along(session))]))
        kinds = [unpack(socket.receive_bytes())[0]["kind"] for _ in range(2)]
        assert sorted(kinds) == ["changed", "frame"]
        for odd in (b"", b"\xff\xff\xff\xff", pack({}, [])[:5], b"\x02\0\0\0{]"):
            socket.send_bytes(odd)
            assert unpack(socket.receive_bytes())[0]["kind"] == "error"
        socket.send_text("hello")
        assert unpack(socket.receive_bytes())[0]["kind"] == "error"
        assert len(session.subscribers) == 1
    deadline = time.monotonic() + 10.0
    while session.subscribers and time.monotonic() < deadline:  # a closed tab is forgotten
        time.sleep(0.02)
    assert not session.subscribers
    assert len(session.edit.history) == 1


def test_packing():
    assert unpack(pack({"kind": "x", "é": 1.5}, [b"abc"])) == ({"kind": "x", "é": 1.5}, [b"abc"])
    assert unpack(pack({}, [])) == ({}, [])
    for odd in (b"", b"abc", b"\x09\0\0\0{}", b"\x01\0\0\0{", b"\x01\0\0\0\xff"):
        with pytest.raises(ValueError, match="message: expected"):
            unpack(odd)


@pytest.fixture
def server(session):
    server = Server(session)
    thread = threading.Thread(target=server.run)
    thread.start()
    yield server
    server.stop()
    thread.join(30.0)
    assert not thread.is_alive()


def reach(server, **settings):
    """A socket of the running server."""
    origin = settings.pop("origin", f"http://127.0.0.1:{server.port}")
    address = f"ws://127.0.0.1:{server.port}/socket?token={server.token}"
    return connect(address, origin=origin, max_size=None, **settings)


def test_a_served_session(server):
    with reach(server) as socket:
        socket.send(pack({"kind": "hello", "view": "a", "seq": 1}, []))
        assert unpack(socket.recv())[0]["kind"] == "frame"
    with reach(server) as socket:
        with pytest.raises(ConnectionClosed) as closed:
            socket.send(bytes(LARGEST + 100))
            socket.recv()
        told = closed.value.rcvd  # None where the line was cut while the message was on its way
        assert told is None or told.code == 1009  # too big
    with reach(server) as socket:  # and the next tab is served
        socket.send(pack({"kind": "hello", "view": "b", "seq": 1}, []))
        assert unpack(socket.recv())[0]["kind"] == "frame"
    with pytest.raises(Exception, match="403"):
        reach(server, origin="http://127.0.0.1:1")


def test_a_port_in_use_is_refused(session, server):
    with pytest.raises(OSError):
        Server(session, server.port)


def test_servers_listen_on_this_machine_alone(server):
    assert server.url.startswith("http://127.0.0.1:")
    assert server.listener.getsockname()[0] == "127.0.0.1"
    assert len(server.token) >= 32


# -- the widget -------------------------------------------------------------------------------


def test_the_widget_answers(session, monkeypatch):
    widget = studio(session.edit)
    sent = []
    monkeypatch.setattr(widget, "send", lambda header, buffers=None: sent.append(header))
    widget._handle_custom_msg({"kind": "hello", "view": "a", "seq": 1}, [])
    assert sent[-1]["kind"] == "frame"
    points = samples(along(session))
    message = {"kind": "input", "view": "a", "seq": 2, "brush": BRUSH}
    widget._handle_custom_msg(message, [memoryview(points)])
    assert sent[-1]["kind"] == "frame"
    assert "socket" not in sent[-1]
    assert len(session.edit.history) == 1
    widget._handle_custom_msg("what", [])
    assert sent[-1]["kind"] == "error"
    deadline = time.monotonic() + 10.0
    while sent[-1]["kind"] != "changed" and time.monotonic() < deadline:
        time.sleep(0.01)
    assert sent[-1]["by"] == "a"
    widget.close()


def test_pages_of_this_machine_are_offered_a_socket(session, monkeypatch):
    widget = studio(session.edit)
    sent = []
    monkeypatch.setattr(widget, "send", lambda header, buffers=None: sent.append(header))
    for origin in ("https://hub.example", "http://127.0.0.1.example:8888", "", 3, "x" * 101, None):
        widget._handle_custom_msg({"kind": "hello", "view": "a", "origin": origin}, [])
        assert (sent[-1]["kind"], sent[-1]["socket"]) == ("frame", None)
    assert widget.server is None
    home = "http://localhost:8888"
    widget._handle_custom_msg({"kind": "hello", "view": "a", "origin": home}, [])
    address = sent[-1]["socket"]
    assert address.startswith("ws://127.0.0.1:")
    with pytest.raises(Exception, match="403"):
        connect(address, origin="http://127.0.0.1:1")
    with connect(address, origin=home, max_size=None) as socket:
        socket.send(pack({"kind": "hello", "view": "a", "seq": 7}, []))
        header, _ = unpack(socket.recv())
        assert (header["kind"], header["seq"]) == ("frame", 7)
        widget.close()
        with pytest.raises(ConnectionClosed):
            while True:
                socket.recv(timeout=10.0)


def test_the_widget_leaves_a_still_picture(session):
    widget = studio(session.edit)
    bundle = widget._repr_mimebundle_()
    bundle = bundle[0] if isinstance(bundle, tuple) else bundle
    scene = session.edit.scene
    assert Image.open(io.BytesIO(bundle["image/png"])).size == (scene.width, scene.height)
    assert "application/vnd.jupyter.widget-view+json" in bundle
    widget.close()


def test_studio_wants_a_session():
    with pytest.raises(TypeError, match="expected an EditSession"):
        studio("teapot")


def test_importing_the_package_imports_no_server():
    code = (
        "import sys, traitbrdf; "
        "print([m for m in ('anywidget', 'starlette', 'uvicorn') if m in sys.modules])"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "[]"


# -- the module -------------------------------------------------------------------------------


def test_the_front_end_by_itself():
    node = shutil.which("node")
    if node is None:
        if os.environ.get("CI") == "true":
            pytest.fail("node is not installed: CI has to have it")
        pytest.skip("node is not installed")
    test = Path(__file__).with_name("canvas.test.mjs")
    done = subprocess.run([node, "--test", str(test)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_canvas_says_what_it_needs(small_sphere, monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    needed = r"needs the package anywidget.*traitbrdf\[studio\]"
    with pytest.raises(RuntimeError, match=needed):
        tb.studio(tb.EditSession(small_sphere))
    assert main(["studio"]) == 1
    assert "traitbrdf[studio]" in capsys.readouterr().err


# -- paint on the surface -----------------------------------------------------------------------

SOFT = {**BRUSH, "where": "local", "radius": 6.0, "hardness": 0.3, "amount": 0.6}
SPOT = [(24.0, 26.0), (30.0, 30.0), (36.0, 30.0)]


def test_a_soft_stroke_grows_and_is_one_undo(session):
    before = session.edit.render()
    for count in (1, 2, 3):
        piece = samples(SPOT[count - 1 : count], begin=count == 1, lift=count == 3)
        assert not errors(ask(session, [piece], brush=SOFT))
        assert len(session.edit.layers) == 1
    whole = over(session.edit.prepare(), cache=False)
    stroke = Stroke(SPOT, radius=6.0, hardness=0.3, pressure=[1.0, 1.0, 1.0])
    whole.paint(stroke, tb.Move(shiny=0.6), only="body", where="local")
    assert session.edit.design.layers == whole.design.layers
    (told,) = frame(ask(session))["state"]["layers"]
    assert told["local"]
    assert told["opacity"] == 1.0
    assert "shiny" in told["effect"]
    assert frame(ask(session, do="undo"))["state"]["layers"] == []
    np.testing.assert_array_equal(session.edit.render(), before)


def test_paint_with_materials_colours_and_the_eraser(session):
    ask(session, [samples(SPOT)], brush={**SOFT, "material": "gold-polished"})
    ask(session, [samples(SPOT)], brush={**SOFT, "tint": "#ff8000"})
    first, second = session.edit.layers
    assert first.effect == tb.Assign("gold-polished")
    assert second.effect == tb.Colour("#ff8000")
    assert len(first.mask.strokes) == 1
    ask(session, [samples(SPOT[:1])], brush={**SOFT, "onto": 0})
    ask(session, [samples(SPOT[1:])], brush={**SOFT, "onto": 0, "erase": True})
    assert [one.erase for one in session.edit.layers[0].mask.strokes] == [False, False, True]
    assert len(session.edit.layers) == 2
    for brush, message in (
        ({"erase": True}, "choose one"), ({"tint": "red"}, "expected a colour such as"),
        ({"onto": 7}, "index"), ({"onto": "top"}, "index of a layer"),
        ({"hardness": 9}, "hardness"),
        ({"material": "gold"}, "unknown"), ({"flow": 0}, "flow"),
    ):  # fmt: skip
        replies = ask(session, [samples(SPOT)], brush={**SOFT, **brush})
        assert message in errors(replies)[0]
    assert len(session.edit.layers) == 2


def test_layers_are_changed_from_the_list(session):
    ask(session, [samples(SPOT)], brush=SOFT)
    ask(session, [samples(SPOT)], brush={**SOFT, "material": "gold-polished"})
    for opacity, done in ((0.9, False), (0.6, False), (0.4, True)):
        layer = {"index": 0, "set": {"opacity": opacity}, "done": done}
        assert not errors(ask(session, layer=layer))
    assert session.edit.layers[0].opacity == 0.4
    ask(session, do="undo")
    assert session.edit.layers[0].opacity == 1.0
    for do, effects in (
        ("up", ["Assign", "Move"]), ("duplicate", ["Assign", "Assign", "Move"]),
        ("delete", ["Assign", "Move"]), ("invert", ["Assign", "Move"]),
        ("clear", ["Assign", "Move"]),
    ):  # fmt: skip
        assert not errors(ask(session, layer={"index": 0, "do": do}))
        assert [type(layer.effect).__name__ for layer in session.edit.layers] == effects
    ask(session, layer={"index": 1, "set": {"name": "worn", "visible": False}})
    assert session.edit.layers["worn"].visible is False
    for layer, message in (
        ({"index": 5, "do": "delete"}, "expected a layer"), ({"do": "delete"}, "an index"),
        ({"index": 0, "do": "explode"}, "expected one of"), ("top", "an object"),
        ({"index": 0, "set": {"mask": None}}, "settings among"),
        ({"index": 0, "set": {"opacity": 7.0}}, "opacity"),
    ):  # fmt: skip
        assert message in errors(ask(session, layer=layer))[0]
