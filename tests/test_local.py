"""Local paint: soft strokes on the surface, in layers that can be changed afterwards."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sessions import over, same

import traitbrdf as tb
from traitbrdf import reference
from traitbrdf.design.surface import SurfaceWeights
from traitbrdf.scene.camera import Camera
from traitbrdf.session.editing import EditSession
from traitbrdf.session.local import fewer, lagrange
from traitbrdf.transport.blends import Shares

ON = [(24.0, 26.0), (30.0, 30.0), (36.0, 30.0)]  # on the body of the small teapot
EVERYWHERE = {"units": "world", "radius": 1e3}


def stroke(points=ON, **settings) -> tb.Stroke:
    return tb.Stroke(points, **{"radius": 7.0, **settings})


def weight_of(edit: EditSession, layer: int = -1) -> np.ndarray:
    return SurfaceWeights(edit.scene).of(edit.layers[layer].mask)


def changed(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Pixels that differ, as a flat mask."""
    return (first != second).any(axis=2).ravel()


def test_only_what_is_under_the_brush_changes(edit):
    before = edit.render()
    edit.paint(stroke(), tb.Move(shiny=0.6), where="local")
    after = edit.render()
    touched = np.zeros(before[..., 0].size, bool)
    np.logical_or.at(touched, edit.scene.pixels, weight_of(edit) > 0.0)
    different = changed(before, after)
    assert not different[~touched].any()
    assert different[touched].mean() > 0.9
    assert set(edit.layers[0].mask.parts) == {"body"}


def test_a_constant_weight_is_the_material_that_a_whole_part_gets(fresh):
    """Halfway in weight is halfway along the move, not a blend of two frames."""
    some = ON[1:2]
    for effect in (tb.Move(shiny=0.7), tb.Assign("gold-polished"), tb.Tint((0.2, 0.5, 1.0))):
        whole, local = fresh(), fresh()
        for edit in (whole, local):
            edit.assign(edit.scene.parts, "red-rubber")
        facing = stroke(some, flow=0.5, hardness=1.0, **EVERYWHERE)
        local.paint(facing, effect, where="local")
        whole.apply({"body": 0.5}, effect)
        inside = local.scene.pixels[np.abs(weight_of(local) - 0.5) < 1e-6]
        a, b = (edit.render().reshape(-1, 3)[inside] for edit in (local, whole))
        assert len(inside) > 100
        assert np.abs(a - b).mean() < 2e-3 * b.mean()
        assert np.abs(a - whole.before().reshape(-1, 3)[inside]).mean() > 0.02 * b.mean()


def test_undo_and_redo_give_the_same_frames(edit):
    frames = [edit.render()]
    edit.paint(stroke(), tb.Move(shiny=0.6), where="local")
    frames.append(edit.render())
    edit.paint(stroke([(34, 20), (34, 36)]), tb.Assign("gold-polished"), where="local")
    frames.append(edit.render())
    edit.layers[0].opacity = 0.4
    frames.append(edit.render())
    for frame in frames[-2::-1]:
        assert edit.undo()
        np.testing.assert_allclose(edit.render(), frame, rtol=1e-5, atol=1e-6)
    for frame in frames[1:]:
        assert edit.redo()
        np.testing.assert_allclose(edit.render(), frame, rtol=1e-5, atol=1e-6)


def paint_much(edit: EditSession) -> None:
    edit.assign("body", "red-rubber")
    edit.paint(stroke(hardness=0.2), tb.Move(shiny=0.6), where="local")
    edit.layers[-1].paint(stroke([(20, 34), (30, 36)], pressure=[0.2, 1.0], flow=0.9))
    edit.layers[-1].erase(stroke([(30, 28)], radius=4.0))
    edit.layers[-1].name = "worn"
    edit.paint(stroke([(34, 18), (34, 38)]), tb.Assign("gold-polished"), where="local")
    edit.layers[-1].opacity = 0.6
    layer = edit.layers.add(tb.Tint((0.3, 0.5, 1.0)))
    layer.paint(stroke([(26, 34)], radius=5.0), across=True)
    edit.layers[-1].clip(("body", "lid"))
    edit.layers[1].duplicate().invert()
    edit.layers[2].opacity = 0.2


def test_the_history_replays_to_the_same_frame(fresh, tmp_path):
    edit = fresh()
    paint_much(edit)
    frame = edit.render()
    for path in (None, tmp_path / "painted.tbr"):
        again = fresh()
        if path is None:
            for line in edit.history:
                exec(line, {"tb": tb, "edit": again, "tables": edit.tables})
        else:
            edit.save(path)
            stored = EditSession.load(path)
            again.design = stored.design
        np.testing.assert_allclose(again.render(), frame, rtol=1e-5, atol=1e-6)
        assert str(again.layers) == str(edit.layers)
        assert again.history == edit.history


def test_strokes_belong_to_the_surface_not_to_the_camera(fresh):
    edit = fresh()
    edit.paint(stroke(), tb.Move(shiny=0.6), where="local")
    here, home = edit.render(), edit.scene.camera
    told = edit.history
    edit.look(camera=Camera.orbit(60.0, 30.0))
    elsewhere = edit.history
    assert "framing=(tb.Camera(" in elsewhere[0]
    assert "framing" not in told[0]
    again = fresh()
    for line in elsewhere:
        exec(line, {"tb": tb, "edit": again})
    np.testing.assert_array_equal(again.render(), here)
    edit.look(camera=home)
    assert edit.history == told


def test_layers_are_changed_after_they_were_painted(edit):
    bare = edit.render()
    edit.paint(stroke(), tb.Move(shiny=0.6), where="local")
    painted = edit.render()
    layer = edit.layers[0]
    layer.visible = False
    same(edit.render(), bare)
    layer.visible = True
    layer.effect = tb.Tint((1.0, 0.1, 0.1))
    tinted = edit.render()
    assert (
        tinted[..., 0].sum()
        > 2.0 * tinted[..., 1].sum() * bare[..., 0].sum() / bare[..., 1].sum() * 0.4
    )
    layer.effect = tb.Move(shiny=0.6)
    np.testing.assert_allclose(edit.render(), painted, rtol=1e-5, atol=1e-6)
    layer.clear()
    same(edit.render(), bare)
    layer.invert()
    assert changed(edit.render(), bare).mean() > 0.2
    del edit.layers[0]
    same(edit.render(), bare)


def test_opacity_scales_the_effect(fresh):
    half, whole = fresh(), fresh()
    half.paint(stroke(), tb.Move(shiny=0.6), where="local")
    half.layers[0].opacity = 0.5
    whole.paint(stroke(flow=0.5), tb.Move(shiny=0.6), where="local")
    a, b = half.render(), whole.render()
    assert np.abs(a - b).mean() < 1e-3 * b.mean()


def test_the_order_of_layers_counts(edit):
    edit.paint(stroke(), tb.Assign("gold-polished"), where="local")
    edit.paint(stroke(), tb.Tint((0.1, 0.2, 1.0), "all"), where="local")
    above = edit.render()
    edit.layers[1].move_to(0)
    below = edit.render()
    assert changed(above, below).any()
    edit.layers[1].move_to(0)
    np.testing.assert_allclose(edit.render(), above, rtol=1e-5, atol=1e-6)


def test_layers_of_whole_parts_lie_above_and_below(fresh):
    """Where the paint is full, the material is that of the same stack of whole layers."""
    local, whole = fresh(), fresh()
    for edit in (local, whole):
        edit.assign("body", "red-rubber")
    local.paint(stroke(ON[1:2], **EVERYWHERE), tb.Assign("green-plastic"), where="local")
    whole.assign("body", "green-plastic")
    for edit in (local, whole):
        edit.apply({"body": 0.7}, tb.Move(rough=0.3))
    full = local.scene.pixels[weight_of(local, 1) == 1.0]
    a, b = (edit.render().reshape(-1, 3)[full] for edit in (local, whole))
    assert len(full) > 50
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_between_knots_little_is_lost(fresh):
    """Painted fragments are what the basis shows of their very material, to a percent."""
    edit = fresh()
    edit.assign("body", "red-rubber")
    edit.paint(stroke(), tb.Move(shiny=0.5), where="local")
    edit.paint(stroke([(34, 20), (30, 36)]), tb.Assign("gold-polished"), where="local")
    edit.layers[-1].opacity = 0.7
    edit.paint(stroke([(22, 34), (38, 34)]), tb.Tint((0.3, 0.5, 1.0)), where="local")
    frame, scene, transport = edit.render(), edit.scene, edit.prepare()
    alone = np.bincount(scene.pixels, minlength=frame[..., 0].size) == 1
    body = scene.parts.index("body")
    weights = np.stack([weight_of(edit, i) for i in (1, 2, 3)])
    inside = (weights > 0.0).any(axis=0) & alone[scene.pixels] & ~scene.bordering
    inside &= scene.pixel_part == body
    crossing = inside & ((weights > 0.1) & (weights < 0.9)).all(axis=0)
    some = np.flatnonzero(inside)[::9]
    shown, known = [], []
    for fragment in [*some, *np.flatnonzero(crossing)]:
        y, x = divmod(int(scene.pixels[fragment]), scene.width)
        material = edit.pick(x + 0.5, y + 0.5).material
        table = torch.from_numpy(material.values(edit.embedding, transport.cells))
        whole = transport.shade(body, table).radiance
        known.append(whole[fragment - scene.part_slice(body).start].numpy())
        shown.append(frame[y, x])
    off = np.abs(np.array(shown) - known).mean(axis=1) / np.mean(known, axis=1)
    assert len(some) > 20
    assert np.median(off) < 2e-3
    assert off.max() < 0.02


@pytest.mark.slow
def test_painted_pixels_are_those_of_the_reference(fresh):
    edit = fresh(error=None)
    edit.paint(stroke(), tb.Move(shiny=0.5), where="local")
    edit.paint(stroke([(34, 20), (30, 36)]), tb.Tint((0.3, 0.5, 1.0)), where="local")
    frame, scene = edit.render(), edit.scene
    alone = np.bincount(scene.pixels, minlength=frame[..., 0].size) == 1
    inside = (np.maximum(weight_of(edit, 0), weight_of(edit, 1)) > 0.0) & ~scene.bordering
    some = np.flatnonzero(inside & alone[scene.pixels])
    some = np.random.default_rng(1).choice(some, 24, replace=False)
    shown, exact = [], []
    for fragment in some:
        y, x = divmod(int(scene.pixels[fragment]), scene.width)
        seen = edit.pick(x + 0.5, y + 0.5)
        brdf = edit.brdf(seen.part, at=(x + 0.5, y + 0.5))
        exact.append(reference.fragments(scene, [fragment], [brdf])[0][0, 0])
        shown.append(frame[y, x])
    off = np.abs(np.array(shown) - exact).mean(axis=1) / np.mean(exact, axis=1)
    assert np.median(off) < 0.02
    assert off.max() < 0.1


def test_live_frames_are_finished_behind(fresh):
    edit, whole = fresh(error=None), fresh(error=None)
    for one in (edit, whole):
        one.paint(stroke(hardness=0.0), tb.Move(shiny=0.6), where="local")
        one.paint(stroke([(34, 20), (30, 36)], hardness=0.0), tb.Move(dusty=0.5), where="local")
        one.paint(
            stroke([(22, 34), (38, 34)], hardness=0.0), tb.Assign("gold-polished"), where="local"
        )
    live, finished = edit.render(exact=False), whole.render()
    assert np.abs(live - finished).mean() < 0.1 * finished.mean()
    assert changed(live, finished).any()
    for _ in range(40):
        if not edit.improve():
            break
    else:
        pytest.fail("it is never done")
    shown = edit.render(exact=False)
    assert np.abs(shown - finished).mean() < 5e-3 * finished.mean()


def test_drafts_show_local_paint(prepared):
    transport = prepared
    edit = over(transport, error=1.0)
    edit.paint(stroke(), tb.Assign("gold-polished"), where="local")
    edit.paint(stroke([(34, 20), (30, 36)]), tb.Tint((0.1, 0.2, 1.0), "all"), where="local")
    frame = edit.render()
    bare = edit.before()
    inside = changed(frame, bare)
    for image, error in (edit.draft(64), edit.glance(64)):
        assert error < 0.5
        off = np.abs(image - frame).reshape(-1, 3)[inside].mean()
        without = np.abs(bare - frame).reshape(-1, 3)[inside].mean()
        assert off < 0.5 * without


def test_the_picker_says_what_is_here(edit):
    edit.paint(stroke(), tb.Move(shiny=0.6), where="local")
    edit.layers[0].name = "worn edge"
    edit.move("body", bright=0.1)
    x, y = ON[1]
    seen = edit.pick(x, y)
    assert seen.part == "body"
    assert set(seen.layers) == {0, 1}
    assert seen.layers[0] == pytest.approx(1.0)
    assert "worn edge" in str(seen)
    assert seen.scores["shiny"] > edit.scores("body")["shiny"] + 0.3
    assert edit.pick(1.0, 1.0) is None
    values = edit.brdf("body", at=(x, y)).values
    np.testing.assert_allclose(
        values.reshape(-1, 3), seen.material.values(edit.embedding), rtol=1e-6
    )
    with pytest.raises(ValueError, match="at: expected a pixel that shows 'lid', got 'body'"):
        edit.brdf("lid", at=(x, y))


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda e: e.paint(stroke(), tb.Move(shiny=1), where="similar"), "where: expected 'part'"),
        (lambda e: e.paint(stroke([(1, 1)]), tb.Move(shiny=1), where="local"), "lies beside"),
        (lambda e: e.paint(stroke(), where="local"), "neither"),
        (lambda e: e.paint(stroke(), tb.Move(shiny=1), only="lit", where="local"), "lid"),
        (lambda e: e.layers[0].paint(stroke()), "painted locally"),
        (lambda e: e.layers[0].invert(), "painted locally"),
        (lambda e: e.layers.add(tb.Move(shiny=1)).clip("lit"), "lid"),
        (lambda e: stroke(hardness=1.5), "hardness: expected 0 to 1"),
        (lambda e: stroke(flow=0.0), "flow: expected above 0"),
        (lambda e: stroke(pressure=[1.0]), "pressure: expected one for each of 3 points"),
        (lambda e: stroke(units="metres"), "units: expected 'pixels' or 'world'"),
    ],
)
def test_what_cannot_be_painted_is_refused(edit, call, match):
    edit.move("body", shiny=0.1)
    before = edit.design
    with pytest.raises(ValueError, match=match):
        call(edit)
    assert edit.design.layers[0] == before.layers[0]


def test_a_soft_stroke_has_no_edge(edit):
    """No step between pixels beyond what the slope of the mask explains."""
    edit.assign("body", "red-rubber")
    bare = edit.render()
    edit.paint(stroke(ON[1:2], radius=14.0, hardness=0.0), tb.Tint((0.2, 0.4, 1.0)), where="local")
    ratio = np.full(bare[..., 0].size, np.nan)
    inside = edit.scene.weights == 1.0
    pixels = edit.scene.pixels[inside]
    whole = edit.render().reshape(-1, 3)
    ratio[pixels] = whole[pixels, 0] / np.maximum(bare.reshape(-1, 3)[pixels, 0], 1e-6)
    weight = np.full(bare[..., 0].size, np.nan)
    weight[pixels] = weight_of(edit)[inside]
    for axis in (0, 1):
        steps = np.abs(np.diff(ratio.reshape(bare.shape[:2]), axis=axis))
        slopes = np.abs(np.diff(weight.reshape(bare.shape[:2]), axis=axis))
        known = np.isfinite(steps) & np.isfinite(slopes)
        assert (steps[known] <= 1.5 * slopes[known] + 0.02).all()


def test_weights_between_knots():
    for steps in (1, 2, 3, 4, 16):
        place = np.linspace(0.0, steps, 41)
        at, weight = lagrange(place, steps)
        assert at.min() >= 0
        assert at.max() <= steps
        np.testing.assert_allclose(weight.sum(axis=1), 1.0)
        order = min(steps, 3)
        np.testing.assert_allclose((weight * at**order).sum(axis=1), place**order, atol=1e-9)
    assert fewer([16, 8], 1000) == [16, 8]
    assert (
        fewer([16, 8, 4], 60) == [2, 4, 2] or np.prod([s + 1 for s in fewer([16, 8, 4], 60)]) <= 60
    )
    assert fewer([4, 4, 4, 4, 4], 1) == [1] * 5


@pytest.mark.parametrize("layers", [1, 2, 5, 14])
def test_shares_add_up_to_the_point(layers):
    amounts = np.random.default_rng(layers).random((layers, 200)).astype(np.float32)
    amounts[:, :40] = np.round(amounts[:, :40])
    shares = Shares.of(amounts, 8)
    point = np.repeat(np.arange(200), np.diff(shares.first))
    whole = np.zeros((200, layers))
    np.add.at(whole, point, shares.share[:, None] * shares.corners[shares.corner] / 8)
    np.testing.assert_allclose(whole.T, amounts, atol=1e-6)
    np.testing.assert_allclose(np.bincount(point, shares.share), 1.0, atol=1e-6)
    assert np.diff(shares.first).max() <= layers + 1


def test_a_wedge_shows_a_trait_in_steps(edit):
    edit.assign("body", "red-rubber")
    design, before = edit.design, edit.render()
    sheet = edit.wedge("shiny", 5, "body", -0.4, 0.4)
    assert edit.design is design
    assert len(sheet) == 5
    assert sheet.labels[0] == "shiny -0.40"
    np.testing.assert_allclose(sheet.images[2], before, rtol=1e-5, atol=1e-6)
    same(edit.render(), before)
    assert sheet.picture(32).shape == (32 + 16, 5 * 40, 3)
    sheet.take(4)
    np.testing.assert_allclose(edit.render(exact=False), sheet.images[4], rtol=1e-5, atol=1e-6)
    assert edit.undo()
    same(edit.render(), before)
    with pytest.raises(ValueError, match="count: expected a whole number of at least 2"):
        edit.wedge("shiny", 1)
    with pytest.raises(ValueError, match="index: expected 0 to 4"):
        sheet.take(5)


def test_variations_differ_and_can_be_taken(edit):
    sheet = edit.variations(4, "body")
    assert len({image.tobytes() for image in sheet.images}) == 4
    assert edit.variations(4, "body").labels == sheet.labels
    assert edit.variations(4, "body", seed=1).labels != sheet.labels
    sheet.take(2)
    assert len(edit.layers) == 1


def test_the_same_design_under_several_lights(edit):
    edit.paint(stroke(), tb.Assign("gold-polished"), where="local")
    maps = {
        "noon": tb.EnvironmentMap.sky(rows=16),
        "turned": tb.EnvironmentMap.sky(rows=16).rotated(2),
    }
    sheet = edit.under(maps, draft=True)
    assert sheet.labels == ("noon", "turned")
    assert changed(*sheet.images).any()
    assert sheet.picture().ndim == 3
    with pytest.raises(ValueError, match="environments: expected at least one"):
        edit.under({})


def test_a_look_is_copied_from_a_part_or_a_place(edit):
    edit.assign("lid", "green-plastic")
    edit.copy_look("lid", "handle")
    np.testing.assert_allclose(edit.material("handle").z, edit.material("lid").z)
    edit.paint(stroke(), tb.Tint((0.2, 0.3, 1.0)), where="local")
    edit.copy_look("body", "spout", at=ON[1])
    there = edit.brdf("body", at=ON[1]).values
    np.testing.assert_array_equal(edit.brdf("spout").values, there)
    with pytest.raises(ValueError, match="at: expected a pixel that shows 'lid'"):
        edit.copy_look("lid", "spout", at=ON[1])
