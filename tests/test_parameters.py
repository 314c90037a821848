"""The effect that sets parameters of closed forms, and what lists them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from sessions import on, same

import traitbrdf as tb
from traitbrdf.design.effects import Palette
from traitbrdf.reflectance import models
from traitbrdf.reflectance.models import (
    GGX,
    ClassicPhong,
    ClassicTorranceSparrow,
    Coated,
    Lambert,
    PerfectMirror,
    Plastic,
    Scaled,
)
from traitbrdf.reflectance.parameters import (
    CLOSED_FORMS,
    STARTS,
    between,
    is_closed_form,
    same_form,
    settable_parameters,
    start,
    with_parameters,
)
from traitbrdf.session.editing import EditSession
from traitbrdf.session.preparation import promised
from traitbrdf.space.material import Material

LIBRARY = tb.default_library()
EMBEDDING = tb.default_embedding()
GRID = EMBEDDING.grid_
PALETTE = Palette(LIBRARY, tb.default_traits())
PLAIN = Material.of_library("white-plastic", LIBRARY)
NESTED = 0.5 * Coated(GGX(0.3, 0.2, 3.9), 0.05) + Lambert(0.2)
PANELS = {"phong": ClassicPhong, "torrance-sparrow": ClassicTorranceSparrow}

pytestmark = pytest.mark.usefixtures("small_training")


def applied(effect, material, weight=1.0):
    return effect.apply(material, weight, PALETTE)


def made_of(model):
    """A material as `Assign` makes it."""
    return applied(tb.Assign(model), PLAIN).material


def sampled(model):
    return tb.TabulatedBRDF.from_model(model, GRID).values.reshape(-1, 3)


def apart(first, second):
    """Mean difference of what two materials show, relative to the first."""
    one, other = (m.values(EMBEDDING).astype(np.float64) for m in (first, second))
    return np.abs(one - other).mean() / max(np.abs(one).mean(), 1e-12)


def values_of(parameter):
    """Any legal value of a parameter, log-spaced if the parameter is."""
    if parameter.log:
        exponents = st.floats(math.log(parameter.low), math.log(parameter.high))
        one = exponents.map(lambda v: min(max(math.exp(v), parameter.low), parameter.high))
    else:
        one = st.floats(parameter.low, min(parameter.high, 1e6), allow_subnormal=False)
    return one | st.tuples(one, one, one) if parameter.rgb else one


@st.composite
def starts(draw, names=tuple(STARTS)):
    """A name of a closed form, and values that it accepts for some of its parameters."""
    name = draw(st.sampled_from(names))
    values = {
        setting.name: draw(values_of(setting.parameter))
        for setting in settable_parameters(name)
        if draw(st.booleans())
    }
    try:
        with_parameters(start(name), values)
    except ValueError:  # of the classic editor, and too bright
        values["scale"] = 0.4
    return name, values


# -- models ------------------------------------------------------------------------------------


def test_all_settable_parameters_are_listed():
    found = {s.path: s for s in settable_parameters(NESTED)}
    assert [*found] == [
        "parts.0.weight", "parts.0.model.alpha", "parts.0.model.eta", "parts.0.model.base.alpha",
        "parts.0.model.base.eta", "parts.0.model.base.k", "parts.0.model.base.k_s",
        "parts.1.k_d",
    ]  # fmt: skip
    assert [s.name for s in found.values()] == [
        "weight", "model.alpha", "model.eta", "base.alpha", "base.eta", "k", "k_s", "k_d",
    ]  # fmt: skip
    assert found["parts.0.model.base.k"].value == (3.9, 3.9, 3.9)
    assert found["parts.0.model.base.alpha"].parameter.log
    for setting in found.values():
        changed = with_parameters(NESTED, {setting.name: setting.value})
        assert changed == with_parameters(NESTED, {setting.path: setting.value}) == NESTED


@pytest.mark.parametrize("name", sorted(STARTS))
def test_controls_can_be_built_from_a_name(name):
    for setting in settable_parameters(name):
        assert setting.parameter.check(setting.value) == setting.value
        assert setting.name == setting.path
    assert is_closed_form(start(name))


def test_what_is_a_closed_form():
    class Own(Lambert):
        pass

    assert is_closed_form(NESTED)
    assert not is_closed_form(Own())
    assert not is_closed_form(Own() + GGX())
    assert not is_closed_form(tb.TabulatedBRDF.from_model(GGX(), GRID))
    assert CLOSED_FORMS.keys() >= {"GGX", "Sum", "Scaled", "Coated", "ClassicPhong"}
    assert not same_form(GGX() + Lambert(), Lambert() + GGX())
    assert same_form(GGX(0.1) + Lambert(), GGX(0.2) + Lambert(0.3))


@given(starts(), st.floats(0.0, 1.0))
@settings(max_examples=60)
def test_parameters_go_straight(case, weight):
    name, values = case
    old, new = start(name), with_parameters(start(name), values)
    found = between(old, new, weight)
    assert same_form(found, new)
    assert between(old, new, 0.0) == old
    assert between(old, new, 1.0) == new
    scale = 1.0 if name not in PANELS else found.scale
    for p in new.parameters:
        first, last, at = (np.asarray(getattr(m, p.name)) for m in (old, new, found))
        assert np.all((at >= p.low) & (at <= p.high))
        if p.name == "scale":
            assert at <= (1 - weight) * first + weight * last + 1e-12
        elif p.log:
            expected = first ** (1 - weight) * last**weight
            np.testing.assert_allclose(at, expected, rtol=1e-9)
        else:
            np.testing.assert_allclose(at, (1 - weight) * first + weight * last, atol=1e-9)
    most = np.maximum(old.albedo_bound, new.albedo_bound)
    assert scale >= 0.0
    assert name not in PANELS or np.all(found.albedo_bound <= most + 1e-9)


def test_a_factor_never_brightens_beyond_both_ends():
    old, new = Scaled(PerfectMirror(0.5), 2.0), Scaled(PerfectMirror(1.0), 1.0)
    for weight in np.linspace(0.0, 1.0, 9):
        assert between(old, new, float(weight)).mirror.max() <= 1.0 + 1e-12
    one = ClassicPhong(0.1, 1.0, 0.5, 1.0)
    other = ClassicPhong(0.1, 0.5, 1.0, 0.5)
    assert between(one, other, 0.5).energy_bounded
    with pytest.raises(ValueError, match="of the form"):
        between(one, GGX(), 0.5)


@pytest.mark.parametrize(
    ("model", "values", "match"),
    [
        (GGX(), {"alfa": 0.1}, "unknown parameter of GGX 'alfa': did you mean 'alpha'"),
        (GGX(), {"alpha": 2.0}, r"alpha: expected a number in \[0.0001, 1\], got 2"),
        (GGX(), {"alpha": math.nan}, "alpha: expected a number"),
        (NESTED, {"alpha": 0.1}, "'alpha': expected one of 'parts.0.model.alpha', 'parts.0.model"),
        (Coated(GGX()), {"base.alhpa": 0.1}, "did you mean 'base.alpha'"),
        (NESTED, {"k": 1.0, "base.k": 2.0}, "each parameter once"),
        (ClassicPhong(), {"scale": 2.0}, r"at most 1 .* got 1.6: scale by 0.625 \(scale=1.25\)"),
        (Scaled(PerfectMirror(), 0.5), {"weight": 3.0}, "mirror of at most 1"),
    ],
)
def test_what_models_refuse(model, values, match):
    with pytest.raises(ValueError, match=match):
        with_parameters(model, values)


def test_the_field_of_the_outermost_model_goes_by_its_name():
    found = with_parameters(Coated(GGX(0.3), 0.1), {"alpha": 0.5, "base.alpha": 0.6})
    assert found == Coated(GGX(0.6), 0.5)


@pytest.mark.parametrize("kind", PANELS.values())
def test_the_classic_forms_are_what_they_say(kind):
    rng = np.random.default_rng(1)
    w = rng.normal(size=(2, 500, 3))
    w[..., 2] = np.abs(w[..., 2])
    wi, wo = w / np.linalg.norm(w, axis=-1, keepdims=True)
    model = kind(0.2, (0.1, 0.2, 0.3), 0.8, (0.5, 0.4, 0.3))
    lobe = (
        models.BoundedPhong((0.1, 0.2, 0.3), 12.5)
        if kind is ClassicPhong
        else models.BoundedTorranceSparrow((0.1, 0.2, 0.3), 0.2)
    )
    expected = 0.8 * (Lambert((0.5, 0.4, 0.3)).eval(wi, wo) + lobe.eval(wi, wo))
    np.testing.assert_allclose(model.eval(wi, wo), expected, rtol=1e-12)
    np.testing.assert_allclose(model.eval(wi, wo), model.eval(wo, wi), rtol=1e-9, atol=1e-12)
    assert eval(f"models.{model!r}", {"models": models}) == model


def test_the_classic_highlights_are_equally_wide():
    for roughness in (0.02, 0.05, 0.1):
        half = np.array([math.sin(roughness), 0.0, math.cos(roughness)])
        wo = np.array([0.0, 0.0, 1.0])
        wi = 2.0 * (half @ wo) * half - wo
        shares = [
            (m.eval(wi, wo) / m.eval(wo, wo))[0]
            for m in (kind(roughness, 1.0, 1.0, 0.0) for kind in PANELS.values())
        ]
        np.testing.assert_allclose(shares, math.exp(-1.0), rtol=0.02)


# -- laws of the effect ------------------------------------------------------------------------


@given(starts())
@settings(max_examples=25)
def test_weight_one_is_the_model_bit_for_bit(case):
    name, values = case
    effect = tb.Parameters(name, values)
    expected = with_parameters(start(name), values)
    for below in (PLAIN, applied(tb.Parameters(name), PLAIN).material):
        assert applied(effect, below, 0.0).material is below
        found = applied(effect, below).material
        assert found.model == expected
        assert found.table.tobytes() == sampled(expected).tobytes()
        same(found.values(EMBEDDING), found.table)
        same(found.mirror, expected.mirror)
        assert np.all((EMBEDDING.low_ <= found.z) & (found.z <= EMBEDDING.high_))
        assert found.energy_scale(EMBEDDING) == 1.0


@given(starts(), st.floats(0.0, 1.0))
@settings(max_examples=25)
def test_what_lies_between_is_physical(case, weight):
    name, values = case
    below = applied(tb.Parameters(name), PLAIN).material
    found = applied(tb.Parameters(name, values), below, weight).material
    shown = found.values(EMBEDDING)
    assert np.isfinite(shown).all()
    assert shown.min() >= 0.0
    assert np.all((found.mirror >= 0.0) & (found.mirror <= 1.0))
    assert np.all((EMBEDDING.low_ <= found.z) & (found.z <= EMBEDDING.high_))
    same(shown, sampled(found.model))
    rest = EMBEDDING.residual(tb.TabulatedBRDF(GRID, shown.reshape(*GRID.shape, 3)), found.z)
    same(rest, found.offset)  # so that edits on top start from what is shown


@given(
    st.sampled_from(sorted(PANELS)), st.floats(0.06, 0.7), st.floats(0.0, 1.0), st.floats(0.0, 1.0)
)
@settings(max_examples=25)
def test_the_classic_editor_conserves_energy(name, roughness, specular, weight):
    full = {"roughness": roughness, "specular": specular, "diffuse": 1.0 - specular}
    below = applied(tb.Parameters(name, specular=1.0, diffuse=1.0, scale=0.5), PLAIN).material
    found = applied(tb.Parameters(name, **full), below, weight).material
    table = tb.TabulatedBRDF(GRID, found.table.reshape(*GRID.shape, 3))
    assert found.model.energy_bounded
    assert table.max_albedo() <= 1.0 + 5e-3


@pytest.mark.parametrize(
    ("below", "effect"),
    [
        (made_of(GGX(0.05, 0.2, 3.9)), tb.Parameters(alpha=0.5)),
        (made_of(NESTED), tb.Parameters({"base.alpha": 0.1}, k_d=(0.5, 0.1, 0.0))),
        (applied(tb.Parameters("phong"), PLAIN).material, tb.Parameters(roughness=0.4, scale=0.3)),
        (made_of(PerfectMirror(0.9)), tb.Parameters(k_s=0.1)),
        (PLAIN, tb.Parameters("GGX", alpha=0.3, eta=0.3, k=3.0)),
        (PLAIN, tb.Parameters("torrance-sparrow", roughness=0.2)),
        (made_of(Lambert(0.3)), tb.Parameters("OrenNayar", k_d=0.7)),
    ],
)
def test_weights_are_continuous(below, effect):
    for at in (0.0, 0.3, 0.7, 1.0):
        here = applied(effect, below, at).material
        for size in (1e-4, 1e-6):
            other = at - size if at == 1.0 else at + size
            near = applied(effect, below, other).material
            # log f of a dark cell soars in a mixture, and with the inverse square of widths
            assert apart(here, near) <= 400.0 * size + 2e-4
            assert np.abs(here.z - near.z).max() <= 300.0 * size + 1e-4
            assert np.abs(here.mirror - near.mirror).max() <= size + 1e-9


def test_models_are_changed_exactly_and_back():
    material = made_of(NESTED)
    assert material.model == NESTED
    there = applied(tb.Parameters({"base.alpha": 0.6}), material).material
    expected = 0.5 * Coated(GGX(0.6, 0.2, 3.9), 0.05) + Lambert(0.2)
    assert there.model == expected
    back = applied(tb.Parameters({"base.alpha": 0.3}), there).material
    same(back.table, material.table)
    unchanged = tb.Parameters({"base.alpha": 0.3}, k_d=0.2)
    assert applied(unchanged, material, 0.5).material is material


def test_only_parameters_keep_the_model():
    material = made_of(GGX(0.3, 1.5, 0.0))
    for effect in (tb.Move(shiny=0.2), tb.Tint((0.5, 1.0, 1.0), "all"), tb.Assign("chrome")):
        assert applied(effect, material, 0.0).material.model == material.model
        assert applied(effect, material, 0.01).material.model is None
        assert applied(effect, material).material.model is None
    assert applied(tb.Assign(Lambert(0.2)), material).material.model == Lambert(0.2)
    assert applied(tb.Parameters(alpha=0.2), material, 0.01).material.model is not None
    assert PLAIN.model is None


def test_scores_know_parameters():
    rough, sharp = (
        PALETTE.traits.score(applied(tb.Parameters(alpha=a), made_of(GGX(0.3))).material.z)
        for a in (0.6, 0.1)
    )
    assert sharp["shiny"] > rough["shiny"] + 0.2
    red = applied(tb.Parameters("Plastic", k_d=(0.7, 0.02, 0.02)), PLAIN).material
    assert PALETTE.traits.score(red.z)["red"] > PALETTE.traits.score(PLAIN.z)["red"] + 0.3
    moved = applied(tb.Move(dusty=0.3), red).material
    assert not np.array_equal(moved.z, red.z)


def test_extremes():
    mirror_like = applied(tb.Parameters("GGX", alpha=1e-4, eta=0.05, k=12.0), PLAIN).material
    assert mirror_like.table.max() > 1e5
    black = applied(tb.Parameters("phong", specular=0.0, diffuse=0.0), PLAIN).material
    assert black.table.max() == 0.0
    strong = applied(tb.Parameters(weight=1e6), made_of(Scaled(Lambert(0.5), 1.0))).material
    np.testing.assert_allclose(strong.table, 5e5 / math.pi, rtol=1e-6)
    for material in (mirror_like, black, strong):
        for effect in (tb.Parameters("Plastic"), tb.Parameters("phong", roughness=0.3)):
            half = applied(effect, material, 0.5).material
            shown = half.values(EMBEDDING)
            assert np.isfinite(shown).all()
            assert shown.min() >= 0.0


# -- what is refused ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "error", "match"),
    [
        (lambda: tb.Parameters(), ValueError, "at least one parameter"),
        (lambda: tb.Parameters(3, alpha=1.0), TypeError, "name of a closed form"),
        (lambda: tb.Parameters("ggx"), ValueError, "unknown model 'ggx'"),
        (lambda: tb.Parameters("Phong"), ValueError, "did you mean 'phong'"),
        (lambda: tb.Parameters("Coated"), ValueError, "unknown model 'Coated'"),
        (lambda: tb.Parameters(alpha=math.nan), ValueError, "alpha: expected finite"),
        (lambda: tb.Parameters(k_s=(0.1, math.inf, 0.1)), ValueError, "k_s: expected finite"),
        (lambda: tb.Parameters(alpha=True), TypeError, "alpha: expected a number"),
        (lambda: tb.Parameters(alpha="rough"), TypeError, "alpha: expected a number"),
        (lambda: tb.Parameters(alpha=None), TypeError, "alpha: expected a number"),
        (lambda: tb.Parameters(k_s=(0.1, 0.2)), TypeError, "three numbers"),
        (lambda: tb.Parameters(k_s=[[1], [1, 2]]), TypeError, "three numbers"),
        (lambda: tb.Parameters({3: 0.1}), TypeError, "names of parameters"),
        (lambda: tb.Parameters("GGX", 0.1), TypeError, "mapping of name to value"),
        (lambda: tb.Parameters({"k": 0.1}, k=0.2), ValueError, "'k' twice"),
        (lambda: tb.Parameters("GGX", alhpa=0.1), ValueError, "did you mean 'alpha'"),
        (lambda: tb.Parameters("GGX", alpha=(0.1, 0.2, 0.3)), ValueError, "alpha: expected"),
        (lambda: tb.Parameters("phong", specular=0.7), ValueError, "scale by 0.8333"),
        (lambda: settable_parameters("metal"), ValueError, "unknown model"),
        (lambda: settable_parameters(3), TypeError, "closed form or its name"),
    ],
)
def test_what_makes_no_effect(make, error, match):
    with pytest.raises(error, match=match):
        make()


@pytest.mark.parametrize(
    ("below", "effect", "match"),
    [
        (PLAIN, tb.Parameters(alpha=0.1), "alpha: expected a material that is a closed form"),
        (made_of(GGX()), tb.Parameters(roughness=0.1), "unknown parameter of GGX 'roughness'"),
        (made_of(GGX()), tb.Parameters(alpha=3.0), "alpha: expected a number in"),
        (made_of(NESTED), tb.Parameters(alpha=0.1), "expected one of"),
        (made_of(ClassicPhong()), tb.Parameters(diffuse=0.9), "scale by"),
    ],
)
def test_materials_without_such_parameters_stay(below, effect, match):
    found = applied(effect, below)
    assert found.refused
    assert found.material is below
    with pytest.raises(ValueError, match=match):
        effect.check(below, found, PALETTE)


# -- sources, sessions and files ---------------------------------------------------------------


@given(starts())
def test_the_repr_makes_the_effect(case):
    effect = tb.Parameters(*case)
    assert eval(repr(effect), {"tb": tb}) == effect


def test_effects_read_like_calls():
    assert repr(tb.Parameters(alpha=1)) == "tb.Parameters(alpha=1.0)"
    assert repr(tb.Parameters("GGX")) == "tb.Parameters('GGX')"
    nested = tb.Parameters({"base.k": np.float32([0.5, 1.0, 2.0])}, alpha=0.25)
    assert repr(nested) == "tb.Parameters({'base.k': (0.5, 1.0, 2.0), 'alpha': 0.25})"
    assert eval(repr(nested), {"tb": tb}) == nested
    assert repr(tb.Parameters("GGX", {"k": 1.0})) == "tb.Parameters('GGX', k=1.0)"


def replayed(session, again):
    for line in session.history:
        exec(line, {"tb": tb, "edit": again, "tables": session.tables})
    return again


def test_a_session_replays_and_is_stored(types_take_as_long, edit, fresh, tmp_path):
    # as few basis images as its error needs, as the loaded one will have
    edit.view.prepared = promised(edit.view.prepared, edit.library, edit.settings)
    edit.assign("body", NESTED)
    edit.set_parameters("body", {"base.alpha": 0.5})
    edit.set_parameters("lid", "phong", roughness=0.2, diffuse=(0.5, 0.1, 0.0))
    edit.layers[-1].opacity = 0.6
    edit.paint(on(edit.scene, "handle", trait=None, amount=1.0), tb.Parameters("GGX", alpha=0.4))
    edit.move("lid", dusty=0.2)
    frame = edit.render()
    model = edit.material("body").model
    assert model == 0.5 * Coated(GGX(0.5, 0.2, 3.9), 0.05) + Lambert(0.2)
    assert edit.history[1] == "edit.set_parameters('body', {'base.alpha': 0.5})"
    again = fresh()
    again.view.prepared = edit.view.prepared
    same(replayed(edit, again).render(), frame)
    edit.save(tmp_path / "design.tbr")
    loaded = EditSession.load(tmp_path / "design.tbr", cache=False)
    same(loaded.render(), frame)
    assert loaded.history == edit.history
    assert loaded.material("body").model == model
    for session in (edit, loaded):  # a further edit comes to the same, since the model is stored
        session.apply("body", tb.Parameters(k_d=0.6))
    same(loaded.material("body").table, edit.material("body").table)
    before = edit.render()
    same(loaded.render(), before)
    edit.undo()
    same(edit.render(), frame)
    edit.redo()
    same(edit.render(), before)


def test_a_session_refuses_and_remembers(edit, fresh):
    with pytest.raises(ValueError, match="closed form"):
        edit.set_parameters("body", alpha=0.1)
    edit.assign("body", GGX(0.3))
    with pytest.raises(ValueError, match="did you mean 'alpha'"):
        edit.set_parameters(["body", "lid"], alhpa=0.1)
    assert len(edit.layers) == 1
    edit.set_parameters("body", alpha=0.1)
    edit.layers[0].effect = tb.Assign("chrome")  # the layer above has nothing to do any more
    assert edit.material("body").model is None
    same(replayed(edit, fresh()).render(), edit.render())
    edit.layers[0].effect = tb.Assign(GGX(0.2))
    assert edit.material("body").model == GGX(0.1)


def test_soft_strokes_take_parameters(edit):
    edit.assign("body", Plastic(0.4, 0.3))
    edit.render()
    edit.paint(
        on(edit.scene, "body", trait=None, amount=1.0),
        tb.Parameters(k_d=(0.6, 0.1, 0.1)),
        where="local",
    )
    frame = edit.render()
    assert np.isfinite(frame).all()
    edit.undo()
    assert not np.array_equal(edit.render(), frame)


@given(st.floats(1e-3, 1.0))
@settings(max_examples=20)
def test_the_same_material_is_one_value(alpha):
    assume(alpha != 0.1)
    effect = tb.Parameters("GGX", alpha=alpha)
    first, second = (applied(effect, PLAIN).material for _ in range(2))
    assert first == second
    assert first != applied(tb.Parameters("GGX", alpha=0.1), PLAIN).material
