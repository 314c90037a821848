"""EditSession: edits that do what they say, undo, strokes, design files, honest reports; views,
preparations behind, drafts, the cache, and what lies outside the basis."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import CancelledError
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import traitbrdf as tb
from traitbrdf import editing
from traitbrdf.editing import EditSession, Material
from traitbrdf.formats import FormatError, read_arrays, write_arrays
from traitbrdf.models import GGX, Lambert, PerfectMirror
from traitbrdf.strokes import Stroke, follow
from traitbrdf.traits import default_traits
from traitbrdf.transport import Training, Transport

TRAITS = default_traits().names
EMBEDDING = tb.default_embedding()
LIBRARY = tb.default_library()


@pytest.fixture(autouse=True)
def small_training(training, monkeypatch):
    monkeypatch.setattr(editing, "_training", lambda library, seed: training)


@pytest.fixture(scope="module")
def prepared(small_teapot, training):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(editing, "_training", lambda library, seed: training)
        return EditSession(small_teapot, quality="preview").prepare()


@pytest.fixture(scope="module")
def prepared_ball(training):
    """A ball on the ground, in few pixels: the transport that sessions over its scene start with."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(editing, "_training", lambda library, seed: training)
        return EditSession(ball_scene(), quality="preview").prepare()


def ball_scene(size=20, **arguments):
    settings = {"camera": tb.Camera.orbit(20.0, 25.0), "ground": True, **arguments}
    return tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=16), size=size, **settings)


def over(transport, **arguments):
    """A new session over a prepared scene; what it trains is its own."""
    session = EditSession(transport.scene, quality="preview", **arguments)
    again = Transport.restored(transport.scene, transport.grid, transport.arrays())
    again._operator = transport._operator  # the rays are cast once
    session._view.transport = again
    return session


@pytest.fixture
def fresh(prepared):
    """Makes new sessions over one prepared scene; they do without exact frames unless asked."""
    return lambda **arguments: over(prepared, **{"error": 1.0, **arguments})


@pytest.fixture
def edit(fresh):
    return fresh()


def on(scene, part, amount=0.6, trait="shiny", **arguments):
    """A stroke that touches one part alone."""
    points, radius = follow(scene.part_image == scene.parts.index(part))
    return Stroke(points, trait=trait, amount=amount, radius=radius, **arguments)


def same(first, second):
    np.testing.assert_array_equal(first, second)


def inside(scene, part):
    """Mask (H, W) of the pixels that show a part, be it in a corner."""
    mask = np.zeros(scene.height * scene.width, bool)
    mask[scene.pixels[scene.part_slice(scene.parts.index(part))]] = True
    return mask.reshape(scene.height, scene.width)


# -- materials --------------------------------------------------------------------------------


def test_every_part_starts_with_a_material(edit):
    image = edit.render()
    assert image.shape == (48, 60, 3)
    assert image.dtype == np.float32
    assert np.isfinite(image).all()
    assert image.min() >= 0.0
    assert {edit.material(part).name for part in edit.scene.parts} == {"white-plastic"}
    assert edit.history == []
    outside = edit.scene.uncovered.reshape(48, 60) == 1.0
    same(image[outside], edit.scene.backdrop()[outside])
    assert "0 edits" in repr(edit)


def test_the_ground_starts_plain(prepared_ball):
    session = over(prepared_ball)
    assert session.scene.parts == ("sphere", "ground")
    assert session.material("ground").name == "concrete"
    assert session.material("sphere").name == "white-plastic"
    albedo = session.brdf("ground").albedo(np.radians([30.0]))[0]
    assert 0.1 < albedo.min() and albedo.max() < 0.5 and np.ptp(albedo) < 0.1 * albedo.max()
    session.assign("ground", "blue-plastic")
    assert session.undo()
    assert session.material("ground").name == "concrete"


def test_assigning_changes_one_part_or_several(edit):
    before = edit.render()
    edit.assign("body", "blue-plastic")
    after = edit.render()
    changed = np.any(after != before, axis=-1)
    body = inside(edit.scene, "body")
    assert changed[body].mean() > 0.99
    assert not changed[~body].any()
    edit.assign(["lid", "spout"], "gold-polished")
    assert edit.material("lid") is edit.material("spout")
    assert edit.material("lid").name == "gold-polished"
    assert edit.undo()
    same(edit.render(), after)


def test_assigning_coordinates(edit):
    z = tb.default_library().coordinates[7]
    edit.assign("body", z)
    same(edit.material("body").z, EMBEDDING.clip(z))
    edit.assign("lid", (EMBEDDING.high_ + 1.0).tolist())
    same(edit.material("lid").z, EMBEDDING.high_)


def test_an_assigned_table_is_shown_and_given_back_as_it_is(edit, tmp_path):
    table = tb.TabulatedBRDF.from_model(GGX(0.2, 1.5, 0.0), EMBEDDING.grid_, "mine")
    edit.assign("body", table)
    back = edit.brdf("body")
    same(back.values, table.values)
    assert back.name == "mine"
    edit.move("body", bright=0.2)
    assert not np.array_equal(edit.brdf("body").values, table.values)
    assert edit.brdf("body").max_albedo() <= 1.0 + 1e-3
    edit.undo()
    same(edit.brdf("body").values, table.values)
    edit.brdf("body").write(tmp_path / "mine.binary")
    again = tb.TabulatedBRDF.read(tmp_path / "mine.binary")
    assert again.name == "mine"
    angles = np.radians([0.0, 30.0, 60.0])
    np.testing.assert_allclose(again.albedo(angles), table.albedo(angles), rtol=0.02)


def test_an_edited_table_keeps_what_it_has_beyond_the_manifold(edit):
    table = tb.TabulatedBRDF.from_model(GGX(0.2, 1.5, 0.0), EMBEDDING.grid_)
    edit.assign("body", table)
    offset = edit.material("body").offset
    edit.move("body", rough=0.1)
    edit.move("body", rough=-0.1)
    assert edit.material("body").offset is offset
    again, first = edit.brdf("body").values, table.values
    assert np.median(np.abs(again - first) / (first + 1e-3)) < 0.01


def test_a_perfect_mirror_shows_the_map(edit):
    edit.assign("body", PerfectMirror((0.5, 0.25, 1.0)))
    image = edit.render().reshape(-1, 3)
    where = edit.scene.part_slice(edit.part("body"))
    seen = edit.prepare().parts[edit.part("body")].mirror.numpy()
    alone = edit.scene.weights[where] == 1.0
    np.testing.assert_allclose(
        image[edit.scene.pixels[where][alone]], (seen * [0.5, 0.25, 1.0])[alone], rtol=1e-3,
        atol=1e-3,
    )  # fmt: skip
    same(edit.brdf("body").mirror, [0.5, 0.25, 1.0])


@pytest.mark.parametrize(
    ("call", "error", "match"),
    [
        (lambda e: e.assign("hadle", "chrome"), ValueError, r"unknown part 'hadle'.*'handle'"),
        (lambda e: e.assign(["body", "lit"], "chrome"), ValueError, r"unknown part 'lit'.*'lid'"),
        (lambda e: e.assign([], "chrome"), ValueError, "part: expected at least one"),
        (lambda e: e.assign("body", "chrom"), ValueError, r"unknown material 'chrom'.*'chrome'"),
        (lambda e: e.assign("body", None), TypeError, "material: expected"),
        (lambda e: e.assign("body", 3.0), TypeError, "material: expected"),
        (lambda e: e.assign("body", np.zeros(5)), ValueError, "z: expected shape"),
        (lambda e: e.assign("body", [math.nan] * 24), ValueError, "z: expected finite"),
        (lambda e: e.move("bdy", shiny=0.5), ValueError, r"unknown part 'bdy'.*'body'"),
        (lambda e: e.move("body", shinny=0.5), ValueError, r"unknown trait 'shinny'.*'shiny'"),
        (lambda e: e.move("body"), ValueError, "at least one trait"),
        (lambda e: e.move("body", shiny=math.nan), ValueError, "finite"),
        (lambda e: e.move("body", shiny=-math.inf), ValueError, "finite"),
        (lambda e: e.move("body", shiny="very"), TypeError, "amount of 'shiny'"),
        (lambda e: e.move("body", shiny=0.5, hold=("colours",)), ValueError, "unknown trait"),
        (lambda e: e.move("body", shiny=0.5, hold="shiny"), ValueError, "moved and held"),
        (lambda e: e.paint("a stroke"), TypeError, "stroke: expected a Stroke"),
        (lambda e: e.paint(on(e.scene, "body", trait="shinny")), ValueError, "'shiny'"),
        (lambda e: e.paint(on(e.scene, "body", hold=("nothing",))), ValueError, "unknown trait"),
        (lambda e: e.paint(on(e.scene, "body", hold=("shiny",))), ValueError, "moved and held"),
        (lambda e: e.paint(Stroke([(2.0, 2.0)], "shiny", 0.5, 1.5)), ValueError, "beside it"),
        (lambda e: e.paint(Stroke([(-500.0, 9.0)], "shiny", 0.5, 9.0)), ValueError, "beside it"),
        (lambda e: e.brdf("hanlde"), ValueError, "'handle'"),
        (lambda e: e.scores("hanlde"), ValueError, "'handle'"),
    ],
)
def test_what_cannot_be_done_changes_nothing(edit, call, error, match):
    edit.assign("body", "blue-plastic")
    edit.move("lid", shiny=-0.2)
    edit.undo()
    before, history = dict(edit._materials), edit.history
    with pytest.raises(error, match=match):
        call(edit)
    assert edit._materials == before
    assert edit.history == history
    assert edit.redo()  # what was undone is not forgotten either


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"scene": "teapot"}, TypeError, "scene"),
        ({"quality": "interactiv"}, ValueError, "'interactive'"),
        ({"error": 0.0}, ValueError, "error"),
        ({"error": -0.1}, ValueError, "error"),
        ({"error": math.nan}, ValueError, "error"),
    ],
)
def test_bad_sessions(small_teapot, arguments, error, match):
    with pytest.raises(error, match=match):
        EditSession(**{"scene": small_teapot, **arguments})


# -- undo and redo ----------------------------------------------------------------------------


def some_edit(session, kind, part, trait, amount):
    if kind == "assign":
        session.assign(part, tb.default_library().names[int(abs(amount) * 100)])
    elif kind == "move":
        session.move(part, **{trait: amount})
    else:
        session.paint(on(session.scene, part, amount, trait))


edits = st.lists(
    st.tuples(
        st.sampled_from(["assign", "move", "paint"]),
        st.sampled_from(["body", "handle", "spout", "lid"]),
        st.sampled_from(TRAITS),
        st.floats(-1.0, 1.0),
    ),
    min_size=1,
    max_size=4,
)


@settings(
    deadline=None, max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(edits)
def test_undo_and_redo_give_identical_frames(fresh, several):
    session = fresh()
    frames = [session.render()]
    for one in several:
        some_edit(session, *one)
        frames.append(session.render())
    assert len(session.history) == len(several)
    for frame in frames[-2::-1]:
        assert session.undo()
        same(session.render(), frame)
    assert not session.undo()
    assert session.history == []
    for frame in frames[1:]:
        assert session.redo()
        same(session.render(), frame)
    assert not session.redo()
    assert len(session.history) == len(several)


def test_a_new_edit_forgets_what_was_undone(edit):
    edit.move("body", shiny=0.2)
    edit.undo()
    edit.move("body", bright=0.2)
    assert not edit.redo()
    assert edit.history == ["edit.move('body', bright=0.2)"]


@pytest.mark.parametrize("trait", TRAITS)
def test_an_amount_of_zero_changes_no_pixel(edit, trait):
    edit.assign("body", "red-rubber")
    before, material = edit.render(), edit.material("body")
    edit.move("body", **{trait: 0.0})
    edit.paint(on(edit.scene, "body", 0.0, trait))
    assert edit.material("body") is material
    edit._view.kept.clear()  # also when computed anew
    same(edit.render(), before)


# -- strokes ----------------------------------------------------------------------------------


def test_painting_a_part_changes_no_pixel_outside_and_does_what_it_says(edit):
    edit.assign("handle", "red-rubber")
    before, score = edit.render(), edit.scores("handle")
    moved = edit.paint(on(edit.scene, "handle", 0.6))
    assert moved == {"handle": 0.6}
    edit._view.kept.clear()
    after = edit.render()
    handle = inside(edit.scene, "handle")
    same(after[~handle], before[~handle])
    assert np.any(after[handle] != before[handle], axis=-1).mean() > 0.99
    assert edit.scores("handle")["shiny"] - score["shiny"] >= 0.9 * 0.6
    for colour in ("red", "green", "blue"):  # held unless it is painted
        assert edit.scores("handle")[colour] == pytest.approx(score[colour], abs=1e-6)


def test_painting_a_colour_holds_none(edit):
    score = edit.scores("handle")
    edit.paint(on(edit.scene, "handle", 0.5, "red"))
    assert edit.scores("handle")["red"] - score["red"] >= 0.9 * 0.5


def test_what_is_held_stays(edit):
    edit.assign("body", "blue-plastic")
    score = edit.scores("body")
    edit.paint(on(edit.scene, "body", 0.3, "shiny", hold=("bright",)))
    assert edit.scores("body")["bright"] == pytest.approx(score["bright"], abs=1e-6)
    edit.move("body", shiny=0.3, hold=("colour", "bright"))
    assert edit.scores("body")["bright"] == pytest.approx(score["bright"], abs=1e-6)


def test_a_stroke_over_several_parts_is_shared(edit):
    scene = edit.scene
    stroke = Stroke([(0.0, 24.0), (60.0, 24.0)], "shiny", 0.5, 6.0)
    cover = stroke.coverage(scene.height, scene.width)
    before = {part: edit.scores(part)["shiny"] for part in scene.parts}
    moved = edit.paint(stroke)
    assert len(moved) >= 3
    assert sum(moved.values()) == pytest.approx(0.5)
    whole = cover[scene.part_image >= 0].sum()
    for i, part in enumerate(scene.parts):
        share = float(0.5 * cover[scene.part_image == i].sum() / whole)
        assert moved.get(part, 0.0) == pytest.approx(share, abs=1e-6)
        change = edit.scores(part)["shiny"] - before[part]
        assert change == pytest.approx(share, abs=0.1 * share + 1e-6)
    assert len(edit.history) == 1
    edit.undo()
    assert {part: edit.scores(part)["shiny"] for part in scene.parts} == before


# -- history ----------------------------------------------------------------------------------


def test_the_history_replays_to_the_identical_frame(edit, fresh):
    edit.assign("body", "blue-plastic")
    edit.assign(["lid", "rim"], "gold-satin")
    edit.move("body", shiny=1.0 / 3.0, red=-0.1234567890123, hold=("bright",))
    edit.move("spout", rough=np.float32(0.2))
    edit.paint(on(edit.scene, "handle", math.pi / 5))
    edit.paint(Stroke([(1.0 / 3.0, 24.1), (59.7, 22.3)], "matte", 0.37, 7.0 / 3.0, hold=()))
    edit.paint(on(edit.scene, "body", np.float64(-0.2), "metallic", hold="colour"))
    edit.assign("bottom", tb.default_library().coordinates[11])
    again = fresh()
    for line in edit.history:
        exec(line, {"tb": tb, "edit": again})
    assert again.history == edit.history
    same(again.render(), edit.render())


# -- files ------------------------------------------------------------------------------------


def test_a_teapot_design_survives_its_file(edit, fresh, tmp_path, shared_data):
    edit.assign("body", tb.MeasuredBRDF.read(next((shared_data / "rgl").glob("card*.bsdf"))))
    edit.assign("lid", PerfectMirror(0.7) + 0.2 * Lambert((0.5, 0.1, 0.9)))
    edit.assign("spout", "chrome")
    edit.assign("rim", GGX(0.1, 1.5, 0.0))
    edit.move("rim", bright=0.1)
    edit.paint(on(edit.scene, "handle"))
    edit.move("body", shiny=0.1)
    edit.undo()
    edit.save(tmp_path / "design.tbr")
    again = EditSession.load(tmp_path / "design.tbr")
    assert again.quality == "preview"
    assert again.scene.lights == edit.scene.lights
    assert again.scene.camera == edit.scene.camera
    assert again.scene.environment.rotation == edit.scene.environment.rotation
    assert again.scene.parts == edit.scene.parts
    assert again.history == edit.history
    same(again.render(), edit.render())  # prepared anew
    assert not again.undo()
    assert {p: again.material(p).name for p in again.scene.parts} == {
        p: edit.material(p).name for p in edit.scene.parts
    }
    # and what is edited further goes the same way
    for session in (edit, again):
        session.move("body", shiny=0.1)
        session.move("lid", bright=-0.1)
    same(again.render(), edit.render())
    again.save(tmp_path / "second.tbr")
    assert EditSession.load(tmp_path / "second.tbr").history == edit.history


def test_a_sphere_design_survives_its_file(tmp_path):
    camera = tb.Camera.orbit(10.0, 80.0, fov=50.0, zoom=0.7, target=(0.1, 2.0, 3.0))
    light = tb.DirectionalLight((0.3, 0.2, 0.7))
    sky = tb.EnvironmentMap.sky(rows=16).rotated(-1.0)
    scene = tb.Scene(tb.sphere(2.5, (0.1, 2.0, 3.3)), sky, [light], camera, (16, 20))
    session = EditSession(scene, "preview", error=0.2, seed=3)
    session.assign("sphere", "red-velvet")
    session.save(tmp_path / "ball.tbr")
    again = EditSession.load(tmp_path / "ball.tbr")
    assert (again.error, again.seed, again.quality) == (0.2, 3, "preview")
    same(again.render(), session.render())
    assert EditSession.load(tmp_path / "ball.tbr", quality="accurate").quality == "accurate"


def test_the_caller_s_mistakes_are_not_the_file_s(edit, tmp_path):
    edit.save(tmp_path / "design.tbr")
    with pytest.raises(ValueError, match="unknown quality") as caught:
        EditSession.load(tmp_path / "design.tbr", quality="best")
    assert not isinstance(caught.value, FormatError)
    with pytest.raises(TypeError):
        EditSession.load(tmp_path / "design.tbr", colour="red")
    with pytest.raises(FileNotFoundError):
        EditSession.load(tmp_path / "other.tbr")


@pytest.fixture(scope="module")
def saved(small_teapot, tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "design.tbr"
    session = EditSession(small_teapot, quality="preview")
    session.assign("body", GGX(0.2, 1.5, 0.0))
    session.save(path)
    return path


def test_a_cut_design_is_refused(saved, tmp_path):
    data = saved.read_bytes()
    for count in (0, 1, 100, len(data) // 2, len(data) - 1):
        (tmp_path / "cut.tbr").write_bytes(data[:count])
        with pytest.raises(FormatError, match=r"cut\.tbr: expected"):
            EditSession.load(tmp_path / "cut.tbr")


def test_a_damaged_design_is_refused_or_the_same(saved, tmp_path):
    data, whole = saved.read_bytes(), read_arrays(saved)
    rng = np.random.default_rng(0)
    refused = 0
    for at in rng.integers(0, len(data), 40):
        broken = bytearray(data)
        broken[at] ^= 0xFF
        (tmp_path / "broken.tbr").write_bytes(broken)
        try:
            arrays = read_arrays(tmp_path / "broken.tbr")
        except FormatError:
            refused += 1
        else:  # a byte that carries nothing: a date, a comment
            for name, value in whole.items():
                same(arrays[name], value)
    assert refused > 30


def test_files_that_are_no_designs(tmp_path):
    for name, content in (("a.tbr", b""), ("b.tbr", b"PK\3\4"), ("c.tbr", b"hello" * 99)):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FormatError):
            EditSession.load(tmp_path / name)
    write_arrays(tmp_path / "d.tbr", {"numbers": np.arange(3)})
    with pytest.raises(FormatError, match=r"EditSession\.save"):
        EditSession.load(tmp_path / "d.tbr")
    np.save(tmp_path / "e.npy", np.arange(3))
    with pytest.raises(FormatError):
        EditSession.load(tmp_path / "e.npy")


def change_header(**values):
    def change(arrays):
        header = json.loads(str(arrays["design"]))
        header.update(values)
        arrays["design"] = np.array(json.dumps(header))

    return change


def replaced(**values):
    return lambda arrays: arrays.update(values)


@pytest.mark.parametrize(
    "change",
    [
        change_header(format=3),
        change_header(format=None),
        change_header(embedding="0123456789abcdef"),
        change_header(shape={"kind": "mesh", "parts": ["one"]}),
        change_header(shape=None),
        change_header(size=[0, 4]),
        change_header(size=[4]),
        change_header(size=[1e9, 4]),
        change_header(camera={"azimuth": "left"}),
        change_header(camera={"height": 3.0}),
        change_header(rotation=None),
        change_header(rotation="x"),
        change_header(lights=[{"kind": "Laser"}]),
        change_header(lights=[{"kind": "PointLight", "position": [1, 2]}]),
        change_header(lights=3),
        change_header(materials=[]),
        change_header(materials=[{"part": "body", "name": "x"}] * 6),
        change_header(history=None),
        change_header(quality="best"),
        change_header(error=-1.0),
        lambda arrays: arrays.pop("design"),
        lambda arrays: arrays.pop("environment"),
        lambda arrays: arrays.pop("z_3"),
        lambda arrays: arrays.pop("mirror_0"),
        lambda arrays: arrays.pop("shape_faces"),
        replaced(design=np.array("no json")),
        replaced(design=np.array("[]")),
        replaced(design=np.array("[" * 100_000)),
        replaced(environment=np.full((4, 8, 3), -1.0)),
        replaced(environment=np.array("light")),
        replaced(shape_faces=np.full((2, 3), 10**6)),
        replaced(shape_vertices=np.full((9, 3), np.nan)),
        replaced(z_0=np.zeros(3)),
        replaced(z_1=np.full(24, np.nan)),
        replaced(mirror_0=np.full(3, 7.0)),
        replaced(offset_1=np.zeros((4, 3))),
        replaced(offset_1=np.full((EMBEDDING.grid_.size, 3), np.nan)),
        replaced(table_1=np.zeros((4, 3))),
        replaced(table_1=np.full((EMBEDDING.grid_.size, 3), -1.0)),
        replaced(table_1=np.full((EMBEDDING.grid_.size, 3), np.inf)),
        replaced(table_1=np.array("rough")),
    ],
)
def test_designs_that_do_not_fit_are_refused(saved, tmp_path, change):
    arrays = read_arrays(saved)
    change(arrays)
    write_arrays(tmp_path / "other.tbr", arrays)
    with pytest.raises(FormatError, match=r"other\.tbr: expected"):
        EditSession.load(tmp_path / "other.tbr")


def test_a_failed_save_leaves_the_old_file(edit, tmp_path, monkeypatch):
    path = tmp_path / "design.tbr"
    edit.save(path)
    old = path.read_bytes()
    edit.move("body", shiny=0.5)

    def fail(file, **arrays):
        file.write(b"half of it")
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez_compressed", fail)
        with pytest.raises(OSError, match="disk full"):
            edit.save(path)
    assert path.read_bytes() == old
    assert list(tmp_path.iterdir()) == [path]
    edit.save(path)
    assert path.read_bytes() != old
    with pytest.raises(FileNotFoundError):
        edit.save(tmp_path / "nowhere" / "design.tbr")
    with pytest.raises(IsADirectoryError):
        edit.save(tmp_path)


# -- reports ----------------------------------------------------------------------------------


def numbers(value):
    if isinstance(value, dict):
        for one in value.values():
            yield from numbers(one)
    elif isinstance(value, list):
        for one in value:
            yield from numbers(one)
    elif isinstance(value, (int, float)):
        yield value


def test_the_report_is_plain_finite_json(edit):
    edit.assign("body", "chrome")
    edit.assign("lid", PerfectMirror(1.0))
    report = edit.report()
    again = json.loads(json.dumps(report, allow_nan=False))
    assert again == report
    assert all(math.isfinite(n) for n in numbers(report))
    assert report["covered_pixels"] == np.count_nonzero(edit.scene.uncovered < 1.0)
    assert report["fragments"] == len(edit.scene.pixels)
    assert set(report["parts"]) == set(edit.scene.parts)
    assert sum(part["pixels"] for part in report["parts"].values()) == len(edit.scene.pixels)
    assert report["frame_error"] < 0.05
    assert report["error_asked"] == 1.0
    assert report["history"] == edit.history
    for part, entry in report["parts"].items():
        assert entry["tier"] == "basis"
        assert entry["scores"] == edit.scores(part)
        assert 0.0 <= entry["max_albedo"] <= 1.0 + 1e-3
        assert 0.0 <= entry["gamut_margin"] <= 0.5
    edit.assign("body", "red-rubber")  # no frame in between
    assert edit.report()["parts"]["body"]["material"] == "red-rubber"
