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

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sessions import on, over, same

import traitbrdf as tb
from traitbrdf.design.strokes import Stroke
from traitbrdf.formats.files import read_arrays, write_arrays
from traitbrdf.pictures import angle_map
from traitbrdf.reflectance.descriptors import cielab, hue
from traitbrdf.reflectance.models import GGX, Lambert, PerfectMirror
from traitbrdf.scene.shapes import Mesh
from traitbrdf.session import budget as promises
from traitbrdf.session import frames, preparation, rendering
from traitbrdf.session.cache import CACHE_BYTES, Cache, cache_key, fixed_key
from traitbrdf.session.editing import EditSession
from traitbrdf.session.frames import enlarged
from traitbrdf.session.preparation import (
    EXACT_ABOVE,
    LightTrees,
    Prepared,
    StoppedError,
    Turns,
    promised,
    trusted_error,
)
from traitbrdf.session.rendering import TRAINED_IMAGES
from traitbrdf.session.settings import Settings
from traitbrdf.space.learning import Trait
from traitbrdf.space.traits import default_traits
from traitbrdf.transport.basis import Training
from traitbrdf.transport.lighttree import LightTree
from traitbrdf.transport.transport import Transport

TRAITS = default_traits().names
EMBEDDING = tb.default_embedding()
LIBRARY = tb.default_library()


pytestmark = pytest.mark.usefixtures("small_training")


@pytest.fixture(scope="module")
def prepared_ball(training):
    """A ball on the ground, in few pixels, prepared for edits of both."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preparation, "training_of", lambda library, seed: training)
        session = EditSession(ball_scene(), quality="preview")
        session.move("ground", bright=0.1)
        return session.prepare()


def ball_scene(size=20, **arguments):
    settings = {"camera": tb.Camera.orbit(20.0, 25.0), "ground": True, **arguments}
    return tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=16), size=size, **settings)


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
    assert "0 layers" in repr(edit)


def test_the_ground_starts_plain(prepared_ball):
    session = over(prepared_ball)
    assert session.scene.parts == ("sphere", "ground")
    assert session.material("ground").name == "concrete"
    assert session.material("sphere").name == "white-plastic"
    albedo = session.brdf("ground").albedo(np.radians([30.0]))[0]
    assert 0.9 * albedo.max() < albedo.min() < albedo.max() < 0.5
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
    edit.move("body", shiny=0.05)
    assert edit.material("body").offset is offset
    moved, z = edit.brdf("body").values, edit.material("body").z
    same(moved, EMBEDDING.decode_values(z, offset).reshape(table.values.shape))
    edit.move("body", shiny=-0.05)
    again = edit.brdf("body").values
    assert np.median(np.abs(again - table.values) / (table.values + 1e-3)) < 0.02


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
    before, history = dict(edit.materials), edit.history
    with pytest.raises(error, match=match):
        call(edit)
    assert edit.materials == before
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
    edit.view.kept.clear()  # also when computed anew
    same(edit.render(), before)


# -- strokes ----------------------------------------------------------------------------------


def test_painting_a_part_changes_no_pixel_outside_and_does_what_it_says(edit):
    edit.assign("handle", "red-rubber")
    before, score, rubber = edit.render(), edit.scores("handle"), edit.brdf("handle")
    moved = edit.paint(on(edit.scene, "handle", 0.6))
    assert moved == {"handle": 0.6}
    edit.view.kept.clear()
    after = edit.render()
    handle = inside(edit.scene, "handle")
    same(after[~handle], before[~handle])
    assert np.any(after[handle] != before[handle], axis=-1).mean() > 0.99
    assert edit.scores("handle")["shiny"] - score["shiny"] >= 0.9 * 0.6
    # colour is held unless it is painted: that of all light, as a person sees it
    was, now = (
        hue(cielab(table.albedo(np.radians([30.0, 60.0]))))
        for table in (rubber, edit.brdf("handle"))
    )
    np.testing.assert_allclose(now[:, 0], was[:, 0], atol=5.0)  # degrees
    np.testing.assert_allclose(now[:, 1], was[:, 1], rtol=0.15)


def test_painting_a_colour_holds_none(edit):
    score = edit.scores("handle")
    edit.paint(on(edit.scene, "handle", 0.5, "red"))
    assert edit.scores("handle")["red"] - score["red"] >= 0.9 * 0.5


def test_what_is_held_stays(edit):
    edit.assign("body", "blue-plastic")
    score = edit.scores("body")
    edit.paint(on(edit.scene, "body", 0.3, "shiny", hold=("bright",)))
    assert edit.scores("body")["bright"] == pytest.approx(score["bright"], abs=1e-4)
    edit.move("body", shiny=0.3, hold=("colour", "bright"))
    assert edit.scores("body")["bright"] == pytest.approx(score["bright"], abs=1e-4)


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


# -- promises -------------------------------------------------------------------------------


def test_the_more_error_the_fewer_images(prepared_ball):
    """Held on materials that neither basis nor choice was fitted to; and no exact frame needed."""
    known = Prepared(prepared_ball, False, {}, prepared_ball)
    images = []
    for error in (0.3, 0.1, 0.03, 0.01):
        found = promised(known, LIBRARY, Settings("preview", error))
        promise, transport = found.promise, found.transport
        assert promise.basis_images == transport.rank_used <= promise.of == prepared_ball.rank_used
        assert promise.error_95 <= error or not promise.kept
        images.append(promise.basis_images)
        if not promise.kept:
            assert promise.basis_images == promise.of
            continue
        errors = []
        for z in LIBRARY.coordinates[5::97]:
            values = EMBEDDING.decode_values(z)
            frame = transport.shade(0, torch.from_numpy(values[transport.cells]))
            exact = prepared_ball.shade_exactly(0, values).radiance
            errors.append(float((frame.radiance - exact).abs().mean() / exact.mean()))
        assert np.mean(np.array(errors) <= error) >= 0.95, (error, errors)
    assert images == sorted(images)
    assert images[0] < images[-1]


def test_truncated_transports_are_the_first_images(prepared_ball):
    table = torch.from_numpy(EMBEDDING.decode_values(LIBRARY.coordinates[7])[prepared_ball.cells])
    same(prepared_ball.truncated(1000).radiance(0, table), prepared_ball.radiance(0, table))
    few = prepared_ball.truncated(5)
    assert few.rank_used == 5
    basis = prepared_ball.bases[0]
    expected = (
        basis.basis[:, :5] @ (basis.projection[:, :5] @ basis.at_cells(table)[..., None])[..., 0].T
    )
    np.testing.assert_allclose(few.radiance(0, table), expected, rtol=1e-4, atol=1e-5)
    # and what it says of its error is what the probes say
    deviation, level = prepared_ball.probed(table.T[None].permute(2, 1, 0), [5])
    shown = few.shade(0, table)
    assert deviation[0, 0, 0] == pytest.approx(shown.deviation, rel=1e-4)
    assert level[0, 0] == pytest.approx(shown.level, rel=1e-4)


def test_a_promised_speed_is_measured(prepared_ball):
    known = Prepared(prepared_ball, False, {}, prepared_ball)
    slow = promised(known, LIBRARY, Settings("preview", fps=1.0)).promise
    assert slow.kept
    assert slow.basis_images == slow.of
    assert slow.seconds < 1.0
    fast = promised(known, LIBRARY, Settings("preview", fps=1e7)).promise
    assert not fast.kept
    assert fast.basis_images == min(promises.LADDER)
    assert fast.error_95 > slow.error_95


def test_no_frame_waits_for_exactness_where_speed_was_asked_for(prepared_ball):
    session = over(prepared_ball, fps=30.0)
    noise = np.random.default_rng(0).uniform(0.0, 1.0, (*EMBEDDING.grid_.shape, 3))
    session.assign("sphere", tb.TabulatedBRDF(EMBEDDING.grid_, noise / 10.0))
    session.render()
    assert session.report()["parts"]["sphere"]["tier"] == "basis"
    assert session.report()["exact_frames"] == 0


def test_reference_shows_exact_frames_alone():
    session = EditSession(ball_scene(10), quality="reference")
    session.assign("sphere", "blue-plastic")
    session.render()
    report = session.report()
    assert {part["tier"] for part in report["parts"].values()} == {"exact"}
    assert report["trained_images"] == {}
    assert report["frame_error"] < 0.02


@pytest.mark.parametrize("part", [None, "sphere"])
def test_angles_that_a_scene_shows(part):
    """A light behind the viewer shows theta_d of 0 alone; a map from all around nearly all."""
    session = EditSession(ball_scene(24, ground=False))
    seen = session.angles(part)
    assert seen.share.shape == EMBEDDING.grid_.shape[:2]
    assert seen.share.sum() == pytest.approx(1.0)
    assert (seen.share >= 0.0).all()
    half, most = seen.within(0.5), seen.within(0.9)
    assert 0.0 < half[0] < most[0] < 90.0
    assert 0.0 < half[1] < most[1] < 90.0
    flash = tb.EnvironmentMap(np.zeros((16, 32, 3), np.float32))
    camera = tb.Camera.orbit(0.0, 0.0)
    lamp = tb.PointLight(position=tuple(camera.position(tb.sphere(), 24, 24)), intensity=(9.0,) * 3)
    scene = tb.Scene(tb.sphere(), flash, lights=[lamp], camera=camera, size=24)
    lit = EditSession(scene).angles()
    assert lit.within(0.99)[1] < 8.0
    assert lit.cells < 0.3 < seen.cells
    picture = angle_map(lit, 90)
    assert picture.dtype == np.uint8
    assert picture.shape[2] == 3


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
    assert 0.0 < report["frame_error"] < 0.2
    assert report["error_asked"] == 1.0
    assert report["history"] == edit.history
    for part, entry in report["parts"].items():
        assert entry["tier"] == "basis"
        assert entry["scores"] == edit.scores(part)
        assert 0.0 <= entry["max_albedo"] <= 1.0 + 1e-3
        assert 0.0 <= entry["gamut_margin"] <= 0.5
    edit.assign("body", "red-rubber")  # no frame in between
    assert edit.report()["parts"]["body"]["material"] == "red-rubber"


def test_frames_are_the_callers(fresh):
    """Memory is used again, but never that of a frame, or part of one, that somebody holds."""
    edit = fresh()
    kept, copies = [], []
    for k in range(8):
        edit.move("body", shiny=0.1)
        image = edit.render()
        kept.append((image, image[3:9], torch.from_numpy(image))[k % 3])
        copies.append(np.asarray(kept[-1]).copy())
        del image
    for held, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(np.asarray(held), copy)
    edit.render()[:] = -1.0
    assert edit.render().min() >= 0.0


def test_small_parts_bear_more_error(fresh):
    scene = fresh().scene
    counts = np.bincount(scene.pixel_part, minlength=len(scene.parts))
    allowed = np.array([trusted_error(scene, i) for i in range(len(counts))])
    share = counts / counts[: len(scene.shape.parts)].sum()
    assert (allowed[share >= 0.1] == promises.TRUSTED * EXACT_ABOVE).all()
    assert (allowed <= 3.0 * promises.TRUSTED * EXACT_ABOVE).all()
    small = share < 0.1
    assert small.any()
    assert (allowed[small] > promises.TRUSTED * EXACT_ABOVE).all()
    # together they add no more to the frame's error than a part of a tenth of the shape may
    assert (allowed * share)[small].max() <= 0.1 * promises.TRUSTED * EXACT_ABOVE


def test_the_report_says_what_was_left_out(prepared_ball):
    session = over(prepared_ball, error=1.0)
    session.render()
    session.assign("sphere", "blue-plastic")
    session.render()
    left = session.report()["left_out"]
    scene, transport = session.scene, session.prepare()
    assert left["shadow_rays"]["parts"] == ["sphere"]  # convex: the ground alone needs rays
    assert left["cells"]["seen"] == len(transport.cells) < left["cells"]["of"]
    assert left["channels"] == {"computed": 3, "of": 3}
    assert left["parts_not_edited"]["parts"] == ["ground"]
    assert left["parts_not_edited"]["seconds_saved"] > 0.0
    assert left["pixels"]["redrawn"] == inside(scene, "sphere").sum()
    assert left["pixels"]["of"] == scene.height * scene.width
    times = [
        left[what][key] for what in ("cells", "pixels") for key in ("seconds", "seconds_for_all")
    ]
    assert min(times) > 0.0
    session.look(environment=tb.EnvironmentMap.uniform(rows=4))
    assert session.report()["left_out"]["channels"]["computed"] == 1


# -- a ground that nobody edits ----------------------------------------------------------------


def test_a_ground_that_nobody_edits_is_prepared_for_its_material(prepared_ball):
    session = EditSession(ball_scene(), "preview", cache=False)
    frame = session.render()
    report = session.report()
    left = report["left_out"]["edits"]
    assert left["parts"] == ["ground"]
    assert 0 < left["basis_images"] < left["of"]
    assert report["parts"]["ground"]["tier"] == "basis"
    assert report["parts"]["ground"]["error"] < 0.01
    full = over(prepared_ball, error=1.0).render()
    assert np.abs(frame - full).mean() < 0.01 * full.mean()
    # edits of the rest need nothing more
    session.move("sphere", shiny=0.4)
    assert session.ready


def test_the_first_edit_of_the_ground_has_it_prepared_for_all(prepared_ball):
    session = EditSession(ball_scene(), "preview", cache=False)
    before = session.render()
    transport = session.prepare()
    session.move("ground", shiny=0.5, bright=-0.3)
    assert not session.ready
    shown = session.render()
    assert session.ready
    assert session.prepare() is not transport
    assert session.report()["left_out"]["edits"] == {"parts": [], "basis_images": 0, "of": 40}
    other = over(prepared_ball, error=1.0)
    other.move("ground", shiny=0.5, bright=-0.3)
    np.testing.assert_allclose(shown, other.render(), rtol=0.02, atol=1e-3)
    # the ball is shown from what was there before
    free = session.prepare()
    assert free.bases[0].basis is transport.bases[0].basis
    session.undo()
    assert session.ready
    same(session.render(), before)
    # the next view is prepared for such edits from the start
    session.look(rotation=0.5)
    session.prepare()
    session.move("ground", shiny=0.2)
    assert session.ready


def test_a_ground_is_prepared_for_what_it_was_assigned():
    session = EditSession(ball_scene(12), "preview", cache=False)
    session.assign("ground", "blue-plastic")
    session.prepare()
    assert session.prepare().fixed == {1}
    session.assign("ground", "chalk" if "chalk" in LIBRARY else "gold-satin")
    assert not session.ready
    assert session.prepare().fixed == frozenset()


def test_gradients_of_a_ground_have_it_prepared_for_all():
    session = EditSession(ball_scene(12), "preview", cache=False)
    session.prepare()
    session.gradient("ground")
    assert session.prepare().fixed == frozenset()


def test_a_ground_that_was_assigned_is_seen_as_it_was_before():
    session = EditSession(ball_scene(), "preview", error=1.0, cache=False)
    session.assign("ground", "gold-satin")
    assert session.prepare().fixed == {1}
    other = EditSession(session.scene, "preview", error=1.0, cache=False)
    plain = other.render()
    np.testing.assert_allclose(session.before(), plain, rtol=0.02, atol=2e-3)
    assert session.material("ground").name == "gold-satin"


def test_an_edit_of_the_ground_while_it_is_prepared(gate):
    """What ends then is not enough: the frame waits for the rest."""
    session = EditSession(ball_scene(12), "preview", progress=gate, cache=False)
    session.prepare(wait=False)
    assert gate.reached.wait(60.0)
    session.move("ground", shiny=0.4)
    gate.opened.set()
    session.render()
    assert session.prepare().fixed == frozenset()


def test_cached_grounds(cache):
    first = EditSession(ball_scene(12), "preview")
    plain = first.render()
    written()
    second = EditSession(ball_scene(12), "preview")
    same(second.render(), plain)
    assert second.report()["prepared_from"] == "cache"
    assert second.prepare().fixed == {1}
    second.move("ground", shiny=0.4)
    moved = second.render()
    written()
    third = EditSession(ball_scene(12), "preview")
    third.render()
    # the one for all edits serves this as well
    assert third.report()["prepared_from"] == "cache"
    assert third.prepare().fixed == frozenset()
    third.move("ground", shiny=0.4)
    same(third.render(), moved)


# -- ground, shadows, older files -------------------------------------------------------------


def test_a_design_keeps_ground_shadows_and_texture_coordinates(tmp_path, training):
    pot = tb.teapot()
    mesh = Mesh(pot.vertices, pot.faces, pot.normals, pot.face_part, pot.parts, pot.vertices[:, :2])
    sky = tb.EnvironmentMap.sky(rows=16)
    scene = tb.Scene(mesh, sky, size=16, ground=1.5, shadows=False, subsamples=3)
    session = EditSession(scene, "preview")
    session.assign("ground", "grey-felt" if "grey-felt" in LIBRARY else "chalk")
    session.save(tmp_path / "pot.tbr")
    again = EditSession.load(tmp_path / "pot.tbr")
    assert (again.scene.ground, again.scene.shadows, again.scene.subsamples) == (1.5, False, 3)
    assert again.scene.parts == scene.parts
    assert again.material("ground").name == session.material("ground").name
    same(again.scene.shape.uvs, mesh.uvs)
    same(again.scene.weights, scene.weights)
    # so that what was prepared for it is found again
    keys = [cache_key(s.scene, LIBRARY, 24, 0.7, 0) for s in (session, again)]
    assert keys[0] == keys[1]


# -- looking ----------------------------------------------------------------------------------


def test_looking_elsewhere_keeps_the_design(edit):
    edit.assign("body", "blue-plastic")
    edit.move("lid", shiny=0.2)
    edit.undo()
    edit.render()
    scene, history = edit.scene, edit.history
    edit.look(camera=tb.Camera.orbit(80.0, 30.0), size=(20, 30))
    assert (edit.scene.height, edit.scene.width) == (20, 30)
    assert edit.scene.camera == tb.Camera.orbit(80.0, 30.0)
    assert edit.scene.environment is scene.environment
    assert edit.scene.lights == scene.lights
    assert not edit.ready
    assert edit.history == history
    assert edit.material("body").name == "blue-plastic"
    assert edit.render().shape == (20, 30, 3)
    assert edit.redo()
    assert edit.history[-1] == "edit.move('lid', shiny=0.2)"


def test_looking_under_another_light(edit):
    scene = edit.scene
    edit.look(rotation=1.25)
    assert edit.scene.environment.rotation == 1.25
    assert edit.scene.environment.image is scene.environment.image
    same(edit.scene.normals, scene.normals)
    light = tb.PointLight((0.0, 5.0, 0.0))
    edit.look(environment=tb.EnvironmentMap.uniform(rows=4), lights=[light])
    assert edit.scene.lights == (light,)
    assert edit.scene.environment.rotation == 0.0
    edit.look(lights=())
    assert edit.scene.lights == ()


def test_looking_at_the_same_again_keeps_what_is_prepared(edit):
    scene = edit.scene
    edit.look()
    edit.look(
        camera=tb.Camera(**vars(scene.camera)), environment=scene.environment,
        lights=list(scene.lights), size=(48, 60), rotation=scene.environment.rotation,
    )  # fmt: skip
    assert edit.scene is scene
    assert edit.ready


@pytest.mark.parametrize(
    ("wanted", "error"),
    [
        ({"camera": "left"}, TypeError),
        ({"environment": "sky.exr"}, TypeError),
        ({"environment": "sky.exr", "rotation": 1.0}, TypeError),
        ({"lights": ["a lamp"]}, TypeError),
        ({"size": 0}, ValueError),
        ({"size": (4, 0)}, ValueError),
        ({"rotation": math.nan}, ValueError),
        ({"rotation": 1.0, "size": -1}, ValueError),
    ],
)
def test_a_look_that_cannot_be_taken_changes_nothing(edit, wanted, error):
    scene = edit.scene
    with pytest.raises(error, match=r"expected"):
        edit.look(**wanted)
    assert edit.scene is scene
    assert edit.ready


def test_strokes_replay_after_the_picture_was_framed_anew(prepared_ball, tmp_path):
    """A stroke lies on the image of its view: elsewhere the history names the parts."""
    session = over(prepared_ball)
    stroke = Stroke([(2.0, 10.0), (18.0, 18.0)], "shiny", 0.4, 4.0)
    moved = session.paint(stroke)
    assert len(moved) == 2
    assert session.history[0].startswith("edit.paint(")
    session.look(rotation=1.0)  # the light moves nothing on the image
    assert session.history[0].startswith("edit.paint(")
    session.look(camera=tb.Camera.orbit(-60.0, 50.0), size=24)
    session.paint(Stroke([(2.0, 10.0), (18.0, 18.0)], "bright", 0.3, 4.0, hold=("colour", "shiny")))
    first, second = session.history
    assert first.startswith("edit.move({'sphere': ")
    assert second.startswith("edit.paint(")
    session.save(tmp_path / "ball.tbr")
    loaded = EditSession.load(tmp_path / "ball.tbr")
    assert loaded.history == session.history
    assert loaded.scene.camera == session.scene.camera == tb.Camera.orbit(-60.0, 50.0)
    assert loaded.scene.environment.rotation == 1.0
    assert (loaded.scene.height, loaded.scene.width) == (24, 24)
    for one in (session, loaded):
        again = EditSession(one.scene, "preview")
        for line in one.history:
            exec(line, {"tb": tb, "edit": again})
        for part in one.scene.parts:
            same(again.material(part).z, session.material(part).z)
    for one in (session, loaded):  # and framed once more
        one.look(camera=tb.Camera.orbit(0.0, 10.0))
        assert all("edit.paint" not in line for line in one.history)
        again = EditSession(one.scene, "preview")
        for line in one.history:
            exec(line, {"tb": tb, "edit": again})
        for part in one.scene.parts:
            same(again.material(part).z, session.material(part).z)
    assert loaded.history == session.history


# -- several parts at once --------------------------------------------------------------------


def test_parts_of_one_material_stay_so(edit):
    edit.assign(["lid", "rim"], "gold-satin")
    edit.move(["lid", "rim", "spout"], shiny=0.2, hold="colour")
    assert edit.material("lid") is edit.material("rim")
    assert edit.material("lid") is not edit.material("spout")
    assert edit.history[-1] == "edit.move(['lid', 'rim', 'spout'], shiny=0.2, hold=('colour',))"
    assert edit.undo()
    assert edit.material("rim").name == "gold-satin"
    before = dict(edit.materials)
    for wrong in (["lid", "rimm"], []):
        with pytest.raises(ValueError, match="part"):
            edit.move(wrong, shiny=0.2)
    assert edit.materials == before


def test_equal_materials_are_decoded_once(edit, monkeypatch):
    calls = []
    plain = EMBEDDING.decode_values

    def counted(*arguments):
        calls.append(arguments)
        return plain(*arguments)

    edit.assign(edit.scene.parts, LIBRARY.coordinates[5])
    monkeypatch.setattr(EMBEDDING, "decode_values", counted)
    edit.render()
    assert len(calls) == 1
    edit.move("handle", bright=0.1)
    edit.render()
    edit.render()
    assert len(calls) == 2  # parts that were not edited are not decoded


# -- what is drawn again ----------------------------------------------------------------------


def test_pixels_that_are_drawn_again_are_those_of_the_whole_picture(edit):
    """Borders of parts, and with the backdrop, are sums: bit by bit those of a full composition."""
    rng = np.random.default_rng(4)
    transport = edit.prepare()
    seen = {}
    for _ in range(25):
        kind = rng.integers(5)
        if kind == 0:
            edit.undo()
        elif kind == 1:
            edit.redo()
        else:
            parts = rng.choice(edit.scene.parts, rng.integers(1, 4), replace=False).tolist()
            edit.assign(parts, LIBRARY.coordinates[rng.integers(len(LIBRARY))])
        image = edit.render()
        whole = transport.compose([one.frame for one in edit.view.shown])
        same(image, whole.numpy())
        design = tuple(edit.materials.values())
        same(image, seen.setdefault(design, image))
    assert len(seen) < 25


def test_the_caller_may_write_into_a_frame(edit):
    image = edit.render()
    whole = image.copy()
    image[:] = -1.0
    same(edit.render(), whole)
    edit.assign("lid", "chrome")
    edit.render()[:] = 7.0
    edit.undo()
    same(edit.render(), whole)


def test_a_frame_that_was_cut_off_is_drawn_again(edit, monkeypatch):
    whole = edit.render()
    edit.assign("body", "chrome")

    def interrupted(changed, frames):
        edit.view.canvas.pixels[: 48 * 30] = 3.0
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(edit.view.canvas, "redraw", interrupted)
        with pytest.raises(KeyboardInterrupt):
            edit.render()
    edit.undo()
    same(edit.render(), whole)


def test_kept_frames_are_bounded(edit, monkeypatch):
    monkeypatch.setattr(frames, "FRAMES_KEPT", 60_000)
    first = edit.render()
    for i in range(20):
        edit.assign("body", LIBRARY.coordinates[i])
        edit.render()
    view = edit.view
    assert view.kept_bytes == sum(one.bytes for one in view.kept.values()) <= 60_000
    for _ in range(20):
        edit.undo()
    same(edit.render(), first)  # computed anew


# -- drafts -----------------------------------------------------------------------------------


def test_a_draft_shows_the_frame_at_once(prepared_ball):
    session = EditSession(prepared_ball.scene, "preview")
    session.assign("sphere", PerfectMirror((0.4, 0.5, 0.6)) + 0.5 * Lambert(0.5))
    image, error = session.draft()
    assert not session.ready
    assert image.shape == (20, 20, 3)
    assert image.dtype == np.float32
    assert 0.0 <= error < 0.1
    after = over(prepared_ball)
    after.assign("sphere", PerfectMirror((0.4, 0.5, 0.6)) + 0.5 * Lambert(0.5))
    frame = after.render()
    assert np.abs(image - frame).mean() < 0.05 * frame.mean()
    _, draft = session.view.draft
    image[:] = 0.0  # the caller's
    assert session.draft()[0].max() > 0.0
    session.assign("sphere", "red-rubber")
    second, _ = session.draft()
    assert session.view.draft[1] is draft
    assert np.abs(second - frame).mean() > 0.05 * frame.mean()


def test_a_draft_is_enlarged_to_the_size_of_the_scene(prepared_ball):
    session = EditSession(ball_scene(size=(33, 48), ground=False), "preview")
    for wanted in (12, 24):
        image, _ = session.draft(wanted)
        assert image.shape == (33, 48, 3)
        size, draft = session.view.draft
        assert size == max(draft.scene.height, draft.scene.width) == wanted
    same(session.draft(24)[0], image)
    session.draft()  # as large as the scene: nothing is gained by more
    assert session.view.draft[1].scene.width == 48
    for odd in (0, -3, True, 12.5):
        with pytest.raises(ValueError, match="size: expected a positive number of pixels"):
            session.draft(odd)
    assert image.flags.c_contiguous
    ramp = np.broadcast_to(np.arange(8, dtype=np.float32)[None, :, None], (4, 8, 3)).copy()
    larger = enlarged(ramp, 8, 16)
    np.testing.assert_allclose(larger[3, 1:-1, 0], np.arange(0.25, 7.0, 0.5))


def test_the_light_is_sorted_once(small_sphere, monkeypatch):
    built = []
    plain = LightTree.build
    monkeypatch.setattr(LightTree, "build", lambda light: built.append(light) or plain(light))
    trees = LightTrees()
    light = small_sphere.environment
    assert trees.of(light) is trees.of(light.rotated(1.0))
    assert len(built) == 1
    trees.of(light.scaled(2.0))
    assert len(built) == 2


# -- preparing behind -------------------------------------------------------------------------


class Gate:
    """A progress callback that holds the preparation until it is opened, or fails then."""

    def __init__(self, failure=None):
        self.reached, self.opened = threading.Event(), threading.Event()
        self.failure = failure
        self.threads = set()

    def __call__(self, stage, fraction):
        self.threads.add(threading.current_thread())
        self.reached.set()
        assert self.opened.wait(60.0)
        if self.failure is not None:
            raise self.failure


class FailureError(Exception):
    pass


@pytest.fixture
def gate():
    gate = Gate()
    yield gate
    gate.opened.set()


def ended(job):
    assert job.done.wait(60.0)
    return job


def test_preparing_tells_and_can_be_cancelled():
    scene = tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=16), size=12)
    told = []
    session = EditSession(scene, "preview", progress=lambda *news: told.append(news))
    assert not told  # nothing is prepared before it is needed
    assert not session.ready
    transport = session.prepare()
    assert session.ready
    assert told[-1][1] == 1.0
    assert session.prepare() is transport

    def cancel(stage, fraction):
        raise FailureError

    session = EditSession(scene, "preview", progress=cancel)
    with pytest.raises(FailureError):
        session.render()
    assert not session.ready
    session.progress = None
    same(session.render(), session.render())


def test_a_preparation_behind_leaves_the_session_usable(gate):
    session = EditSession(ball_scene(), "preview", progress=gate)
    assert session.prepare(wait=False) is None
    assert gate.reached.wait(60.0)
    assert session.prepare(wait=False) is None  # one is enough
    assert not session.ready
    session.assign("sphere", "blue-plastic")
    session.move("sphere", shiny=0.2)
    session.undo()
    first = session.render(wait=False)  # the draft
    assert first.shape == (20, 20, 3)
    same(first, session.draft()[0])
    assert not session.ready
    assert len(session.history) == 1
    gate.opened.set()
    frame = session.render()
    assert session.ready
    assert len(gate.threads) == 1
    assert threading.current_thread() not in gate.threads
    same(session.render(wait=False), frame)
    assert session.view.job is None
    assert session.report()["prepared_from"] == "scratch"
    assert np.abs(first - frame).mean() < 0.05 * frame.mean()


def test_a_cancelled_preparation_stops_soon(gate):
    session = EditSession(ball_scene(), "preview", progress=gate)
    session.cancel()  # nothing runs
    session.prepare(wait=False)
    job = session.view.job
    assert gate.reached.wait(60.0)
    session.cancel()
    gate.opened.set()
    ended(job)
    assert job.error is None
    assert job.stopped
    assert not session.ready
    assert session.render().shape == (20, 20, 3)  # begins anew
    session.cancel()
    assert session.ready


def test_who_waits_for_a_cancelled_preparation_is_told(gate):
    session = EditSession(ball_scene(), "preview", progress=gate)
    caught = []

    def wait():
        try:
            session.render()
        except CancelledError as error:
            caught.append(error)

    waiting = threading.Thread(target=wait)
    waiting.start()
    assert gate.reached.wait(60.0)
    session.cancel()
    gate.opened.set()
    waiting.join(60.0)
    assert len(caught) == 1
    assert "cancelled" in str(caught[0])


@pytest.mark.parametrize("call", ["prepare", "render", "look on", "behind"])
def test_what_fails_behind_is_raised_once(call):
    gate = Gate(FailureError("no light"))
    session = EditSession(ball_scene(), "preview", progress=gate)
    session.prepare(wait=False)
    job = session.view.job
    gate.opened.set()
    ended(job)
    assert isinstance(job.error, FailureError)
    assert not session.ready
    session.draft()  # does not need it
    gate.failure = None
    if call == "look on":  # what has failed for another view is of no interest any more
        session.look(rotation=1.0)
    else:
        with pytest.raises(FailureError, match="no light"):
            if call == "behind":
                session.render(wait=False)
            else:
                getattr(session, call)()
    assert session.render().shape == (20, 20, 3)


def test_a_thread_that_cannot_start_is_told(monkeypatch):
    session = EditSession(ball_scene(12, ground=False), "preview")

    def full(self):
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", full)
        with pytest.raises(RuntimeError, match="new thread"):
            session.prepare(wait=False)
    assert session.view.job is None
    assert session.render().shape == (12, 12, 3)


def test_looking_elsewhere_stops_the_old_preparation(gate):
    session = EditSession(ball_scene(ground=False), "preview", progress=gate)
    old = session.draft()[0]
    session.render(wait=False)
    job = session.view.job
    assert gate.reached.wait(60.0)
    session.look(camera=tb.Camera.orbit(150.0, 5.0))
    gate.opened.set()
    ended(job)
    assert job.stopped
    assert not session.ready
    assert not np.array_equal(session.draft()[0], old)
    frame = session.render()
    plain = EditSession(session.scene, "preview").render()
    same(frame, plain)


def test_a_preparation_that_ends_after_the_look_is_not_shown(gate):
    """Even if the old one can no longer be stopped."""
    session = EditSession(ball_scene(), "preview", progress=gate)
    session.prepare(wait=False)
    job = session.view.job
    assert gate.reached.wait(60.0)
    old = session.view
    job.stop = lambda: None  # comes too late
    session.look(rotation=2.0)
    gate.opened.set()
    ended(job)
    assert old.prepared is not None
    assert not session.ready
    assert session.prepare().scene is session.scene


def test_looking_about_from_another_thread_never_shows_the_old_view():
    session = EditSession(ball_scene(12, ground=False), "preview")
    sizes = [(12, 12), (10, 14), (14, 10), (8, 16)]
    shown, failed = [], []

    def watch():
        try:
            for _ in range(12):
                before = session.scene
                image = session.render(wait=False)
                after = session.scene
                shown.append(image.shape)
                if before is after:
                    assert image.shape == (after.height, after.width, 3)
            session.render()
        except Exception as error:
            failed.append(error)

    watching = threading.Thread(target=watch)
    watching.start()
    for i in range(8):
        session.look(size=sizes[i % 4])
        session.move("sphere", bright=0.02)
        time.sleep(0.05)
    watching.join(120.0)
    assert not watching.is_alive()
    assert not failed
    assert session.render().shape == (8, 16, 3)
    assert len(session.history) == 8


def test_a_progress_callback_may_use_the_session_but_not_wait_for_itself(training):
    session = EditSession(ball_scene(12, ground=False), "preview")
    seen = []

    def progress(stage, fraction):
        if not seen:
            seen.append(session.draft()[0].shape)
            session.move("sphere", shiny=0.1)
            seen.append(session.prepare(wait=False))
            with pytest.raises(RuntimeError, match="another thread"):
                session.render()
            seen.append("told")

    session.progress = progress
    session.render()
    assert seen == [(12, 12, 3), None, "told"]


def test_a_session_that_is_gone_is_not_prepared(gate):
    session = EditSession(ball_scene(12, ground=False), "preview", progress=gate)
    session.prepare(wait=False)
    job = session.view.job
    assert gate.reached.wait(60.0)
    view = session.view
    del session
    gate.opened.set()
    ended(job)
    assert view.prepared is None


@pytest.mark.parametrize("when", ["at once", "at work"])
def test_the_interpreter_ends_while_a_scene_is_prepared(when):
    """A thread that is cut off inside compiled code would abort the process."""
    wait = "while edit.view.job and not edit.view.job.fraction: time.sleep(0.01)"
    code = f"""
import time, traitbrdf as tb
scene = tb.Scene(tb.teapot(), tb.EnvironmentMap.sky(rows=32), size=64)
edit = tb.EditSession(scene)
edit.prepare(wait=False)
{wait if when == "at work" else ""}
print(edit.ready, flush=True)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "False\n", "")


def test_turns_are_taken_by_those_who_are_waited_for_first():
    turns, order = Turns(), []
    behind, urgent = object(), threading.Event()
    turns.take("first", False, lambda: False)

    def patient():
        turns.take(behind, False, lambda: False)
        order.append("behind")
        turns.give(behind)

    def pressing():
        urgent.set()
        with turns.urgent():
            order.append("urgent")

    threads = [threading.Thread(target=patient), threading.Thread(target=pressing)]
    for thread in threads:
        thread.start()
    assert urgent.wait(10.0)
    time.sleep(0.1)
    turns.give("nobody")
    assert order == []
    turns.give("first")
    for thread in threads:
        thread.join(10.0)
    assert order == ["urgent", "behind"]
    stopped = threading.Event()
    turns.take("first", True, stopped.is_set)
    threading.Timer(0.05, lambda: (stopped.set(), turns.wake())).start()
    with pytest.raises(StoppedError):
        turns.take("second", False, stopped.is_set)


# -- frames that get better -------------------------------------------------------------------


def test_frames_get_better():
    session = EditSession(ball_scene(), "preview")
    several = list(session.frames())
    assert len(several) >= 2
    images, errors, fractions = zip(*several, strict=True)
    assert fractions[0] == 0.0
    assert list(fractions) == sorted(fractions)
    assert fractions[-1] == 1.0
    assert max(fractions[:-1]) < 1.0
    same(images[-1], session.render())
    assert errors[-1] == session.report()["frame_error"]
    assert [f for *_, f in session.frames()] == [1.0]  # all is done


def test_closing_the_frames_cancels(gate):
    session = EditSession(ball_scene(), "preview", progress=gate)
    frames = session.frames()
    next(frames)
    next(frames)
    job = session.view.job
    assert gate.reached.wait(60.0)
    frames.close()
    gate.opened.set()
    ended(job)
    assert job.stopped
    assert not session.ready
    assert session.view.job is None


def test_frames_end_when_their_preparation_is_cancelled(gate):
    session = EditSession(ball_scene(), "preview", progress=gate)
    count = 0
    for _ in session.frames():
        count += 1
        if count == 3:
            session.cancel()
            gate.opened.set()
    assert count == 3
    assert not session.ready


def test_frames_follow_edits_and_looks(gate):
    session = EditSession(ball_scene(), "preview", progress=gate)
    frames = session.frames()
    first, *_ = next(frames)
    session.assign("sphere", "gold-polished")
    second, *_ = next(frames)
    assert not np.array_equal(first, second)
    session.look(size=(10, 12))
    gate.opened.set()
    rest = list(frames)
    assert {image.shape for image, *_ in rest} == {(10, 12, 3)}
    assert rest[-1][2] == 1.0
    same(rest[-1][0], session.render())


def test_frames_raise_what_fails(gate):
    gate.failure = FailureError("no light")
    gate.opened.set()
    session = EditSession(ball_scene(), "preview", progress=gate)
    with pytest.raises(FailureError):
        list(session.frames())


# -- the cache --------------------------------------------------------------------------------


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A folder for preparations."""
    folder = tmp_path / "there" / "cache"
    monkeypatch.setenv("TRAITBRDF_CACHE", str(folder))
    monkeypatch.delenv("TRAITBRDF_CACHE_BYTES")
    return folder


def written():
    """Wait until what was prepared lies on the disk."""
    for thread in threading.enumerate():
        if thread.name == "traitbrdf-cache":
            thread.join(60.0)


def views(cache):
    """The files of prepared views; the universal basis, which serves all views, is none of them."""
    return [file for file in cache.iterdir() if not file.name.startswith("universal-")]


def cache_session(**arguments):
    scene = tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=16), size=12)
    return EditSession(scene, "preview", **arguments)


def test_a_preparation_is_found_again(cache):
    first = cache_session()
    frame = first.render()
    written()
    (file,) = views(cache)
    os.utime(file, (0, 0))
    told = []
    second = cache_session(progress=lambda *news: told.append(news))
    same(second.render(), frame)
    assert second.report()["prepared_from"] == "cache"
    assert first.report()["prepared_from"] == "scratch"
    assert told == [("compiling", 0.0), ("reading", 1.0)]
    assert file.stat().st_mtime > 1e9  # it has been used
    for session in (first, second):
        session.assign("sphere", "gold-polished")
    same(second.render(), first.render())
    assert cache_session(cache=False)._cache is None
    third = EditSession(second.scene, "preview", seed=1)
    third.prepare()
    assert third.report()["prepared_from"] == "scratch"


def test_a_key_names_all_that_a_preparation_depends_on():
    light = tb.PointLight((3.0, 3.0, 3.0))
    scene = ball_scene(lights=[light])

    def key(scene=scene, library=LIBRARY, rank=24, resolution=0.7, seed=0, fixed=None):
        whole = cache_key(scene, library, rank, resolution, seed)
        return fixed_key(whole, fixed or {})

    other = tb.Library(EMBEDDING, LIBRARY.names, LIBRARY.coordinates * 0.99, LIBRARY.families)
    pot = tb.Scene(tb.teapot(), scene.environment, size=8)
    vertices = pot.shape.vertices.copy()
    vertices[99, 2] += 1e-3
    bent = Mesh(vertices, pot.shape.faces, pot.shape.normals, pot.shape.face_part, pot.shape.parts)
    keys = [
        key(),
        key(rank=25),
        key(resolution=0.8),
        key(seed=1),
        key(fixed={1: np.zeros((4, 3), np.float32)}),
        key(fixed={1: np.ones((4, 3), np.float32)}),
        key(fixed={0: np.ones((4, 3), np.float32)}),
        key(library=other),
        key(scene.changed(size=21)),
        key(scene.changed(camera=tb.Camera.orbit(20.0, 26.0))),
        key(scene.changed(environment=scene.environment.rotated(0.1))),
        key(scene.changed(environment=scene.environment.scaled(1.01))),
        key(scene.changed(lights=())),
        key(scene.changed(lights=[tb.PointLight((3.0, 3.0, 3.1))])),
        key(scene.changed(lights=[tb.PointLight((3.0, 3.0, 3.0), (1.0, 1.0, 0.9))])),
        key(scene.changed(ground=False)),
        key(scene.changed(ground=1.9)),
        key(scene.changed(shadows=False)),
        key(scene.changed(subsamples=4)),
        key(pot),
        key(tb.Scene(bent, scene.environment, size=8)),
    ]
    assert None not in keys
    assert len(set(keys)) == len(keys)
    assert key(ball_scene(lights=[light])) == keys[0]


def test_a_shape_that_only_knows_itself_is_not_cached(cache):
    class Own:
        """Casts shadows that nobody else can tell."""

        def __init__(self):
            self._shape = tb.sphere()
            self.parts, self.center, self.radius = ("own",), self._shape.center, 1.0
            self.lowest, self.convex = -1.0, False

        def intersect(self, origins, directions):
            return self._shape.intersect(origins, directions)

        def occluded(self, origins, directions, max_distance=math.inf):
            return self._shape.occluded(origins, directions, max_distance)

    scene = tb.Scene(Own(), tb.EnvironmentMap.sky(rows=16), size=8)
    assert cache_key(scene, LIBRARY, 24, 0.7, 0) is None
    EditSession(scene, "preview").prepare()
    written()
    assert views(cache) == []


@pytest.mark.parametrize("damage", ["cut", "flipped", "other", "shape", "type", "empty", "folder"])
def test_a_damaged_file_is_a_miss_and_goes(cache, damage):
    session = cache_session()
    frame = session.render()
    written()
    (file,) = views(cache)
    data = bytearray(file.read_bytes())
    if damage == "cut":
        file.write_bytes(data[: len(data) // 2])
    elif damage == "flipped":
        data[len(data) // 2] ^= 0xFF
        file.write_bytes(data)
    elif damage == "empty":
        file.write_bytes(b"")
    elif damage == "folder":
        file.unlink()
        file.mkdir()
    else:
        arrays = read_arrays(file)
        if damage == "other":
            arrays["pixels_0"] = arrays["pixels_0"] + 1
        elif damage == "shape":
            arrays["basis_0"] = arrays["basis_0"][:-1]
        else:
            arrays["rank"] = np.array("many")
        write_arrays(file, arrays)
    again = cache_session()
    same(again.render(), frame)
    assert again.report()["prepared_from"] == "scratch"
    written()
    if damage != "folder":
        third = cache_session()
        same(third.render(), frame)
        assert third.report()["prepared_from"] == "cache"  # written anew


def test_the_least_recently_used_go_first(tmp_path):
    arrays = {"numbers": np.zeros(1000)}  # some 8.3 kB in a file
    cache = Cache(tmp_path / "a" / "b", 30_000)
    for i, name in enumerate("abc"):
        cache.write(name, arrays)
        os.utime(cache.file(name), (1000 + i, 1000 + i))
    assert cache.read("a") is not None  # now the youngest
    cache.write("d", arrays)
    assert {p.stem for p in cache.folder.iterdir()} == {"a", "c", "d"}
    same(cache.read("c")["numbers"], arrays["numbers"])
    cache.write("e", {"numbers": np.zeros(4000)})  # larger than all that is allowed
    assert {p.stem for p in cache.folder.iterdir()} == {"a", "c", "d"}
    (cache.folder / ".left.tmp.npz").write_bytes(bytes(20_000))
    os.utime(cache.folder / ".left.tmp.npz", (1, 1))
    cache.write("f", arrays)
    assert not (cache.folder / ".left.tmp.npz").exists()
    assert cache.read("never") is None


def test_where_the_cache_lies(monkeypatch, tmp_path):
    usual = Cache.usual
    assert usual() is None  # the tests have it off
    monkeypatch.delenv("TRAITBRDF_CACHE_BYTES")
    monkeypatch.setenv("TRAITBRDF_CACHE", str(tmp_path))
    assert (usual().folder, usual().limit) == (tmp_path, CACHE_BYTES)
    monkeypatch.delenv("TRAITBRDF_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert usual().folder == tmp_path / "traitbrdf"
    monkeypatch.setenv("XDG_CACHE_HOME", "cache")  # its specification: relative ones do not count
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert usual().folder == tmp_path / "home" / ".cache" / "traitbrdf"

    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # a user without a home
    assert usual() is None
    monkeypatch.setenv("TRAITBRDF_CACHE_BYTES", "1e6")
    with pytest.raises(ValueError, match=r"TRAITBRDF_CACHE_BYTES: expected .* got '1e6'"):
        usual()
    monkeypatch.setenv("TRAITBRDF_CACHE_BYTES", "1000")
    monkeypatch.setenv("TRAITBRDF_CACHE", str(tmp_path))
    assert usual().limit == 1000


def test_a_folder_that_cannot_be_written_costs_nothing(tmp_path, monkeypatch):
    (tmp_path / "file").write_bytes(b"no folder")
    monkeypatch.setenv("TRAITBRDF_CACHE", str(tmp_path / "file"))
    monkeypatch.delenv("TRAITBRDF_CACHE_BYTES")
    session = cache_session()
    session.render()
    written()
    assert session.report()["prepared_from"] == "scratch"
    assert (tmp_path / "file").read_bytes() == b"no folder"


def test_a_disk_that_is_full_costs_nothing(cache, monkeypatch):
    def full(file, **arrays):
        file.write(b"half of it")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez", full)
    cache_session().render()
    written()
    assert list(cache.iterdir()) == []


# -- outside the basis ------------------------------------------------------------------------

METALS = ("polished-metal", "brushed-metal", "rough-metal", "metallic-paint", "car-paint",
          "anodised-metal")  # fmt: skip
CLOTH = ("fabric", "velvet", "silk")


def without(families):
    """Training tables of a library that lacks some families."""
    kept = [i for i, family in enumerate(LIBRARY.families) if family not in families][::4]
    channels = [EMBEDDING.decode_values(LIBRARY.coordinates[i]) for i in kept]
    return Training(np.concatenate(channels, axis=1), np.ones(3 * len(kept)))


@pytest.fixture(scope="module", params=[METALS, CLOTH], ids=["metals", "cloth"])
def lacking(request):
    """A transport that was never shown some families, their tables, and how they truly look."""
    scene = tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=32), size=32)
    built = Transport(scene, EMBEDDING.grid_, without(request.param), rank=24)
    names = [n for n, f in zip(LIBRARY.names, LIBRARY.families, strict=True) if f in request.param]
    names = np.random.default_rng(0).choice(names, 24, replace=False).tolist()
    tables = [EMBEDDING.decode_values(LIBRARY.coordinates[LIBRARY.index(n)]) for n in names]
    return built, dict(zip(names, zip(tables, truths(built, tables), strict=True), strict=True))


def truths(built, tables):
    """(P, 3) radiance of part 0 for each table, by exact rows."""
    images = built.operator.images(
        np.arange(len(built.scene.pixels)), np.concatenate(tables, axis=1)
    )
    return [np.stack([images[:, c, 3 * i + c] for c in range(3)], 1) for i in range(len(tables))]


def true_error(radiance, truth):
    return float(np.abs(np.asarray(radiance) - truth).mean() / truth.mean())


def lacking_session(lacking, monkeypatch, **arguments):
    built, known = lacking
    monkeypatch.setitem(promises.QUALITIES, "preview", (24, 1.0))
    return over(built, **arguments), known


def test_edits_to_a_family_that_the_basis_has_not_seen_are_detected(lacking):
    built, known = lacking
    true, measured = [], []
    for table, truth in known.values():
        frame = built.shade(0, torch.from_numpy(table[built.cells]))
        true.append(true_error(frame.radiance, truth))
        measured.append(frame.error)
    beyond = np.asarray(true) > EXACT_ABOVE
    assert beyond.sum() >= 5
    assert (np.asarray(measured)[beyond] > promises.TRUSTED * EXACT_ABOVE).all()


def test_what_is_shown_of_them_is_right(lacking, monkeypatch):
    session, known = lacking_session(lacking, monkeypatch)
    tiers = []
    for name, (_, truth) in known.items():
        session.assign("sphere", name)
        session.render()
        (shown,) = session.view.shown
        tiers.append(shown.tier)
        assert true_error(shown.frame.radiance, truth) <= 0.01
    assert tiers.count("exact") >= 3
    report = session.report()
    assert report["exact_frames"] == tiers.count("exact")
    assert 1 <= report["trained_images"]["sphere"] <= TRAINED_IMAGES


def test_edits_near_an_exact_frame_are_shown_by_the_basis(lacking, monkeypatch):
    session, known = lacking_session(lacking, monkeypatch)
    transport = session.prepare()
    worst = max(known, key=lambda n: transport.shade(
        0, torch.from_numpy(known[n][0][transport.cells])).error)  # fmt: skip
    session.assign("sphere", worst)
    frame = session.render()
    assert session.report()["parts"]["sphere"]["tier"] == "exact"
    for amount in (0.03, -0.05, 0.04):
        session.move("sphere", bright=amount)
        session.render()
        (shown,) = session.view.shown
        assert shown.tier == "trained"
        assert shown.frame.error <= 0.007
        values = session.brdf("sphere").values.reshape(-1, 3)
        assert true_error(shown.frame.radiance, truths(transport, [values])[0]) <= 0.01
    assert session.report()["exact_frames"] == 1
    for _ in range(3):
        session.undo()
    same(session.render(), frame)  # what was shown exactly


def test_a_basis_takes_only_so_many_images(lacking, monkeypatch):
    monkeypatch.setattr(rendering, "TRAINED_IMAGES", 2)
    session, known = lacking_session(lacking, monkeypatch, error=0.003)
    trained = []
    plain = Transport.train
    monkeypatch.setattr(
        Transport, "train", lambda self, *given: trained.append(given) or plain(self, *given)
    )
    for name in known:
        session.assign("sphere", name)
        session.render()
    assert session.report()["exact_frames"] > 2
    assert len(trained) <= 2


def test_an_error_that_cannot_be_met_is_never_trained_for(fresh, monkeypatch):
    monkeypatch.setattr(Transport, "train", None)
    asked = fresh(error=1e-9)
    asked.assign("body", "chrome")
    asked.assign("lid", PerfectMirror(0.5) + 0.5 * Lambert(0.5))
    image = asked.render().reshape(-1, 3)
    report = asked.report()
    scene, transport = asked.scene, asked.prepare()
    for i, part in enumerate(scene.parts):
        assert report["parts"][part]["tier"] == "exact"
        brdf = asked.brdf(part)
        mirror = torch.from_numpy(brdf.mirror.astype(np.float32))
        true = transport.shade_exactly(i, brdf.values.reshape(-1, 3), mirror).radiance
        alone = scene.weights[scene.part_slice(i)] == 1.0
        same(image[scene.pixels[scene.part_slice(i)][alone]], true.numpy()[alone])
    assert report["trained_images"] == {}
    assert report["exact_frames"] == len(scene.parts)


def test_by_default_parts_beyond_a_hundredth_are_exact(fresh, monkeypatch):
    noise = np.exp(2.0 * np.random.default_rng(0).normal(size=(*EMBEDDING.grid_.shape, 3)))
    wild = tb.TabulatedBRDF(EMBEDDING.grid_, noise.astype(np.float32))
    edit = fresh(error=None)
    edit.assign("handle", wild)
    edit.render()
    report = edit.report()
    assert report["error_asked"] == EXACT_ABOVE == 0.01
    assert report["parts"]["handle"]["tier"] == "exact"
    basis = edit.prepare()
    for i, part in enumerate(edit.scene.parts):
        entry = report["parts"][part]
        if entry["tier"] == "basis":
            assert entry["error"] <= edit.renderer.allowed(edit.view, i)
    assert basis is edit.prepare()


# -- gradients --------------------------------------------------------------------------------


@pytest.mark.parametrize("start", ["library", "table", "coordinates"])
def test_gradients_agree(prepared_ball, start):
    """Closed form, autograd and central differences."""
    session = over(prepared_ball, error=1.0)
    if start == "library":
        session.assign("sphere", "blue-plastic")
    elif start == "table":
        session.assign("sphere", GGX(0.2, 1.5, 0.0) + PerfectMirror(0.1))
        session.move("sphere", rough=0.05)
    else:
        session.assign("sphere", 0.5 * (EMBEDDING.low_ + EMBEDDING.high_))
    pixels, slopes = session.gradient("sphere")
    scene = session.scene
    z = session.material("sphere").z
    same(pixels, scene.pixels[scene.part_slice(0)])
    assert slopes.shape == (len(pixels), 3, len(z))
    assert slopes.dtype == np.float32
    scale = np.abs(slopes).max(axis=(0, 1))
    assert scale.min() > 0.0

    def shown(z):
        return session.radiance("sphere", z)

    by_autograd = torch.autograd.functional.jacobian(shown, torch.from_numpy(z.astype(np.float32)))
    assert by_autograd.shape == slopes.shape
    assert (np.abs(by_autograd.numpy() - slopes).max(axis=(0, 1)) <= 1e-3 * scale).all()
    rng = np.random.default_rng(1)
    low, high = EMBEDDING.low_ - z, EMBEDDING.high_ - z
    for _ in range(5):
        way = rng.normal(size=len(z))
        way[(low > -0.1) | (high < 0.1)] = 0.0  # off the walls, where the slope has two sides
        way /= np.linalg.norm(way)
        step = 3e-3  # what is shown is float32
        ahead, behind = (shown(torch.from_numpy(z + s * way)).numpy() for s in (step, -step))
        slope = slopes @ way
        assert np.abs((ahead - behind) / (2 * step) - slope).max() <= 0.01 * np.abs(slope).max()
    # and it is the frame's
    frame = session.render().reshape(-1, 3)[pixels]
    alone = scene.weights[scene.part_slice(0)] == 1.0
    now = shown(torch.from_numpy(z)).clamp_min(0.0).numpy()
    np.testing.assert_allclose(frame[alone], now[alone], rtol=1e-3, atol=1e-5)


def test_a_part_that_is_out_of_view():
    """The ground, seen from below."""
    scene = ball_scene(12, camera=tb.Camera.orbit(0.0, -30.0))
    session = EditSession(scene, "preview", error=1.0)
    pixels, slopes = session.gradient("ground")
    assert pixels.shape == (0,)
    assert slopes.shape == (0, 3, EMBEDDING.size)
    before = session.render()
    session.assign("ground", "gold-polished")
    same(session.render(), before)
    report = session.report()
    assert report["parts"]["ground"]["pixels"] == 0
    assert report["left_out"]["pixels"]["redrawn"] == 0
    json.dumps(report, allow_nan=False)
    with pytest.raises(ValueError, match="unknown part"):
        session.gradient("grounds")
    with pytest.raises(ValueError, match="z: expected shape"):
        session.radiance("sphere", torch.zeros(5))


# -- devices ----------------------------------------------------------------------------------


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_graphics_card_shows_the_same(prepared_ball):
    frames, slopes = [], []
    for device in ("cpu", "cuda"):
        session = EditSession(prepared_ball.scene, "preview", device=device)
        known = Transport.restored(
            prepared_ball.scene, EMBEDDING.grid_, prepared_ball.arrays(), device
        )
        session.view.prepared = Prepared(known, False, {}, known)
        session.assign("sphere", "gold-satin")
        session.render()
        session.assign("sphere", PerfectMirror(0.3) + Lambert(0.4))
        session.move("ground", bright=0.2)
        frames.append(session.render())
        session.undo()
        slopes.append(session.gradient("sphere")[1])
        assert session.report()["device"] == device
    np.testing.assert_allclose(frames[1], frames[0], rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(slopes[1], slopes[0], rtol=1e-3, atol=1e-3 * np.abs(slopes[0]).max())


# -- what a move came to ---------------------------------------------------------------------------


def test_a_move_says_how_far_it_came(edit):
    edit.assign("handle", "blue-plastic")
    assert edit.reached("handle") is None
    edit.move("handle", shiny=0.3)
    found = edit.reached("handle")
    assert found.complete and found.reached["shiny"] == pytest.approx(0.3, abs=3e-3)
    assert edit.reached("body") is None
    assert "shiny +0.30 of +0.30" in edit.report()["parts"]["handle"]["move"]
    edit.undo()
    assert edit.reached("handle") is None
    edit.move("handle", metallic=50.0)
    assert not edit.reached("handle").complete
    assert 0.0 <= edit.plausibility("handle")["plausibility"] <= 1.0
    edit.undo()
    edit.move("handle", photoreal=False, metallic=3.0)
    assert "photoreal=False" in edit.history[-1]


def test_a_trait_of_one_s_own_is_saved_with_the_design(edit, tmp_path):
    edit.add_trait(Trait.from_labels("candy", ["blue-plastic", "red-rubber"], [1, -1]))
    edit.assign("handle", "red-rubber")
    edit.move("handle", candy=0.3)
    edit.paint(on(edit.scene, "handle", 0.1, "candy"))
    edit.save(tmp_path / "own.tbr")
    again = tb.EditSession.load(tmp_path / "own.tbr")
    assert again.traits.names == edit.traits.names
    assert again.scores("handle") == edit.scores("handle")
    again.move("handle", candy=0.1)
    with pytest.raises(ValueError, match="unknown trait 'candy'"):
        tb.EditSession.load(tmp_path / "own.tbr", traits=tb.default_traits()).move(
            "handle", candy=0.1
        )


def test_a_frame_that_is_held_is_never_drawn_upon(small_sphere):
    """Its memory is used again once nobody has it, nor any view of it."""
    session = EditSession(small_sphere, cache=False)
    session.assign(small_sphere.parts, "red-rubber")
    views = [session.render()[::2, ..., 0], memoryview(session.render()), session.render().T]
    kept = [np.array(view) for view in views]
    place = session.render().ctypes.data
    session.assign(small_sphere.parts, "gold-polished")
    again = session.render()
    assert again.ctypes.data == place
    assert again.flags.writeable
    assert np.abs(again[::2, ..., 0] - kept[0]).max() > 0.01
    for view, was in zip(views, kept, strict=True):
        np.testing.assert_array_equal(np.asarray(view), was)


# -- exact frames behind ----------------------------------------------------------------------


def test_doubtful_parts_become_exact(small_teapot, prepared):
    """What `improve` finds is what a frame that somebody waits for would show."""
    session, waits = (EditSession(small_teapot, error=1e-9, transport=prepared) for _ in range(2))
    session.render(exact=False)
    doubtful = len(session.doubtful)
    assert doubtful
    calls = 0
    while session.improve():
        calls += 1
    assert calls == doubtful and not session.improve()
    np.testing.assert_array_equal(session.render(exact=False), waits.render())
    assert session.doubtful == [] and session.report()["exact_frames"] == doubtful


def test_edits_go_on_while_a_part_becomes_exact(small_teapot, prepared, monkeypatch):
    session = EditSession(small_teapot, error=1e-9, transport=prepared)
    session.render(exact=False)
    part = session.doubtful[0]
    reached, opened = threading.Event(), threading.Event()
    whole = type(prepared).shade_exactly

    def held(self, index, table, mirror=None, progress=None):
        reached.set()
        assert opened.wait(60.0)
        return whole(self, index, table, mirror, progress)

    monkeypatch.setattr(type(prepared), "shade_exactly", held)
    behind = threading.Thread(target=session.improve)
    behind.start()
    assert reached.wait(60.0)
    before = session.render(exact=False)  # nobody waits
    session.assign(part, "red-rubber")
    after = session.render(exact=False)
    assert not np.array_equal(before, after)
    opened.set()
    behind.join(60.0)
    assert not behind.is_alive()
    # what became exact was the old material: the new one is shown as before
    np.testing.assert_array_equal(session.render(exact=False), after)
    assert part in session.doubtful


def test_what_becomes_exact_can_be_cancelled(small_teapot, prepared, monkeypatch):
    session = EditSession(small_teapot, error=1e-9, transport=prepared)
    session.render(exact=False)
    doubtful = session.doubtful
    whole = type(prepared).shade_exactly

    def cancelled(self, index, table, mirror=None, progress=None):
        session.cancel()
        return whole(self, index, table, mirror, progress)

    with monkeypatch.context() as patch:
        patch.setattr(type(prepared), "shade_exactly", cancelled)
        assert not session.improve()  # a loop over it ends
    assert session.doubtful == doubtful
    assert session.improve()
    session.render(exact=False)
    assert session.doubtful == doubtful[1:]


def test_a_basis_learns_behind(prepared):
    """As in front: the same bases, and the first transport is as it was."""
    one = prepared
    known = [basis.basis for basis in one.bases]
    part = next(i for i, p in enumerate(one.parts) if p is not None)
    image = one.shade_exactly(part, EMBEDDING.decode_values(LIBRARY.coordinates[7])).radiance
    other = one.trained(part, image)
    assert all(a is b.basis for a, b in zip(known, one.bases, strict=True))
    assert other.rank_used > one.rank_used
