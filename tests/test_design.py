"""The document: effects, layers, undo and redo, history that replays, and design files."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sessions import on, same

import traitbrdf as tb
from traitbrdf.design import effects
from traitbrdf.design.document import Design, Document
from traitbrdf.design.effects import Applied, Assign, Effect, Move, Palette, Tint, mixed
from traitbrdf.design.layers import Layer
from traitbrdf.design.masks import Parts
from traitbrdf.design.strokes import Stroke
from traitbrdf.formats.files import FormatError, read_arrays, write_arrays
from traitbrdf.reflectance import models
from traitbrdf.reflectance.models import GGX, Lambert, PerfectMirror
from traitbrdf.session.editing import EditSession
from traitbrdf.session.preparation import promised
from traitbrdf.space.learning import Trait
from traitbrdf.space.material import Material

LIBRARY = tb.default_library()
EMBEDDING = tb.default_embedding()
PALETTE = Palette(LIBRARY, tb.default_traits())
TRAITS = PALETTE.traits.names
SYNONYMS = ("lustrous", "metal", "gold-like")
ODD = ("high gloss", "two-tone", "class", "hold", "photoreal", "self", "blå", 'it\'s "so"')
PLAIN = Material.of_library("white-plastic", LIBRARY)
PARTS = ("body", "handle", "lid")

pytestmark = pytest.mark.usefixtures("small_training")


@pytest.fixture(scope="module")
def odd_traits():
    """The shipped traits, and some of one's own whose names are no Python identifiers."""
    space = tb.default_traits()
    for i, name in enumerate(ODD):
        liked, other = LIBRARY.names[40 * i + 3], LIBRARY.names[40 * i + 23]
        space = space.with_trait(Trait.from_labels(name, [liked, other], [1, -1], space), LIBRARY)
    return space


def document(**arguments):
    return Document(Design(dict.fromkeys(PARTS, PLAIN)), arguments.pop("palette", PALETTE))


def layer(part, **amounts):
    return Layer(Move(amounts), Parts.of(part))


def replay(session, again):
    for line in session.history:
        exec(line, {"tb": tb, "edit": again, "tables": session.tables})
    return again


# -- effects ----------------------------------------------------------------------------------

amount = st.floats(-1.0, 1.0)
names = st.sampled_from([*TRAITS, *SYNONYMS, *ODD])
moves = st.builds(
    lambda amounts, hold, photoreal: Move(amounts, hold=hold, photoreal=photoreal),
    st.dictionaries(names, amount, min_size=1, max_size=2),
    st.none() | st.sampled_from([(), "colour", ("colour", "lightness"), ("body",)]),
    st.booleans(),
)
tables = st.sampled_from([
    tb.TabulatedBRDF.from_model(GGX(0.3, 1.5, 0.0), EMBEDDING.grid_, "mine"),
    tb.TabulatedBRDF.from_model(Lambert((0.1, 0.5, 0.2)), EMBEDDING.grid_, "mine"),
    tb.TabulatedBRDF.from_model(0.5 * PerfectMirror(0.3) + Lambert(0.2), EMBEDDING.grid_, "it's"),
])  # fmt: skip
closed_forms = st.sampled_from([
    GGX(0.2, 1.5, 0.0),
    PerfectMirror(0.7) + 0.2 * Lambert((0.5, 0.1, 0.9)),
    models.Plastic(k_d=(0.1, 0.2, 0.3)),
])  # fmt: skip
assigned = (
    st.sampled_from(LIBRARY.names)
    | st.integers(0, len(LIBRARY) - 1).map(lambda i: LIBRARY.coordinates[i])
    | closed_forms
    | tables
)
assignments = st.builds(Assign, assigned)

factors = st.floats(0.0, 4.0)
tints = st.builds(
    Tint,
    st.tuples(factors, factors, factors) | factors,
    st.sampled_from(["body", "reflections", "all"]),
)
any_effect = moves | assignments | tints


@given(moves | tints | st.builds(Assign, st.sampled_from(LIBRARY.names) | closed_forms))
def test_the_repr_of_an_effect_makes_it(effect):
    assert eval(repr(effect), {"tb": tb}) == effect


def test_effects_read_like_calls():
    assert repr(tb.Move(shiny=0.6)) == "tb.Move(shiny=0.6)"
    assert repr(tb.Move(shiny=1, hold="colour")) == "tb.Move(shiny=1.0, hold=('colour',))"
    odd = tb.Move({"high-gloss": 0.5}, matte=np.float32(0.25), photoreal=False)
    assert repr(odd) == "tb.Move({'high-gloss': 0.5, 'matte': 0.25}, photoreal=False)"
    assert repr(tb.Assign("chrome")) == "tb.Assign('chrome')"
    assert repr(tb.Assign([1.0, 2.0])) == "tb.Assign([1.0, 2.0])"
    assert repr(tb.Assign(Lambert(0.5))) == "tb.Assign(tb.models.Lambert(k_d=(0.5, 0.5, 0.5)))"


@pytest.mark.parametrize(
    ("make", "error", "match"),
    [
        (lambda: tb.Move(), ValueError, "at least one trait"),
        (lambda: tb.Move({"shiny": 0.1}, shiny=0.2), ValueError, "'shiny' twice"),
        (lambda: tb.Move(shiny="very"), TypeError, "amount of 'shiny'"),
        (lambda: tb.Move(shiny=True), TypeError, "amount of 'shiny'"),
        (lambda: tb.Move(shiny=math.inf), ValueError, "finite"),
        (lambda: tb.Move({3: 0.1}), TypeError, "names of traits"),
        (lambda: tb.Move(shiny=0.1, hold=3), TypeError, "hold: expected names"),
        (lambda: tb.Move(shiny=0.1, hold=(3,)), TypeError, "hold: expected names"),
        (lambda: tb.Tint("red"), TypeError, "rgb: expected"),
        (lambda: tb.Tint((1.0, 0.5)), TypeError, "rgb: expected"),
        (lambda: tb.Tint((1.0, -0.5, 0.0)), ValueError, "rgb: expected"),
        (lambda: tb.Tint(math.inf), ValueError, "rgb: expected"),
        (lambda: tb.Tint(0.5, "highlight"), ValueError, "of: expected"),
        (lambda: tb.Assign(3.0), TypeError, "material: expected"),
        (lambda: tb.Assign(["a"]), TypeError, "material: expected real numbers"),
        (lambda: Layer("shiny", Parts.of("body")), TypeError, "effect"),
        (lambda: Layer(Move(shiny=0.1), "body"), TypeError, "mask"),
        (lambda: Parts.of([]), ValueError, "at least one name"),
        (lambda: Parts.of([3]), TypeError, "part: expected a name"),
        (lambda: Parts.of({"body": 1.5}), ValueError, "0 to 1"),
        (lambda: Parts.of({"body": math.nan}), ValueError, "weight of 'body': expected a finite"),
        (lambda: Parts((("a", 1.0), ("a", 0.5))), ValueError, "each part once"),
    ],
)
def test_what_makes_no_effect(make, error, match):
    with pytest.raises(error, match=match):
        make()


@pytest.mark.parametrize("kind", sorted(effects.KINDS))
def test_no_weight_changes_nothing(kind):
    effect = EXAMPLES[kind]
    applied = effect.apply(PLAIN, 0.0, PALETTE)
    assert applied.material is PLAIN or applied.material == PLAIN


EXAMPLES: dict[str, Effect] = {
    "Assign": Assign("chrome"),
    "Move": Move(shiny=0.4),
    "Parameters": tb.Parameters("GGX", alpha=0.3),
    "Tint": Tint((1.0, 0.2, 0.1)),
    "Colour": tb.Colour("#b03030"),
    "Highlight": tb.Highlight(blur=2.0),
}


def test_every_effect_has_an_example():
    assert EXAMPLES.keys() == effects.KINDS.keys()
    assert all(getattr(tb, name) is kind for name, kind in effects.KINDS.items())


@given(st.floats(0.0, 1.0))
@settings(max_examples=20)
def test_a_mixture_goes_straight(weight):
    """Frames of a surface that is half covered are half of each; mirrors beside tables as well."""
    chrome = Material.of_reflectance(GGX(0.1, 1.5, 0.0) + PerfectMirror(0.2), EMBEDDING)
    found = mixed(PLAIN, chrome, weight, EMBEDDING)
    np.testing.assert_allclose(found.mirror, weight * chrome.mirror, atol=1e-12)
    ends = [one.values(EMBEDDING).astype(np.float64) for one in (PLAIN, chrome)]
    straight = (1.0 - weight) * ends[0] + weight * ends[1]
    np.testing.assert_allclose(found.values(EMBEDDING), straight, rtol=2e-3, atol=2e-5)
    if weight == 1.0:
        assert found is chrome
    elif weight == 0.0:
        assert found is PLAIN


@given(st.floats(0.0, 1e-3))
@settings(max_examples=10)
def test_coordinates_of_a_mixture_begin_and_end_with_those_of_its_parts(step):
    gold = Material.of_library("gold-polished", LIBRARY)
    span = EMBEDDING.high_ - EMBEDDING.low_
    for share, end in ((step, PLAIN), (1.0 - step, gold)):
        found = mixed(PLAIN, gold, share, EMBEDDING)
        assert np.abs((found.z - end.z) / span).max() < 0.1


members = st.integers(0, len(LIBRARY) - 1).map(
    lambda i: Material.of_library(LIBRARY.names[i], LIBRARY)
)


def table_of(material):
    grid = EMBEDDING.grid_
    return tb.TabulatedBRDF(grid, material.values(EMBEDDING).reshape(*grid.shape, 3))


@given(members, tints, st.floats(0.0, 1.0))
@settings(max_examples=30)
def test_a_tint_stays_physical(material, tint, weight):
    found = tint.apply(material, weight, PALETTE).material
    table = table_of(found)
    assert np.isfinite(table.values).all() and table.values.min() >= 0.0
    assert table.max_albedo() <= 1.0 + 1e-3
    assert np.all((EMBEDDING.low_ <= found.z) & (found.z <= EMBEDDING.high_))


@given(members, st.tuples(*[st.floats(0.05, 1.0)] * 3))
@settings(max_examples=20)
def test_a_tint_of_all_multiplies_the_albedo(material, rgb):
    angles = np.radians([0.0, 45.0, 70.0])
    tinted = table_of(Tint(rgb, "all").apply(material, 1.0, PALETTE).material)
    expected = table_of(material).albedo(angles) * rgb
    np.testing.assert_allclose(tinted.albedo(angles), expected, rtol=2e-3, atol=2e-5)


def test_a_tint_colours_what_it_is_asked_to():
    white, gold = (table_of(Material.of_library(n, LIBRARY)) for n in ("white-plastic", "chrome"))
    body, shine = Tint((1.0, 0.2, 0.1)), Tint((1.0, 0.2, 0.1), "reflections")
    for name, effect, other, table in (
        ("white-plastic", body, shine, white), ("chrome", shine, body, gold),
    ):  # fmt: skip
        material = Material.of_library(name, LIBRARY)
        before = table.albedo(np.radians([30.0]))[0]
        coloured, kept = (
            table_of(one.apply(material, 1.0, PALETTE).material).albedo(np.radians([30.0]))[0]
            for one in (effect, other)
        )
        # hardly more than the 4 % that a coat reflects stay white
        np.testing.assert_allclose(coloured / before, (1.0, 0.2, 0.1), atol=0.07)
        np.testing.assert_allclose(kept / before, 1.0, atol=0.07)
    peak = np.log(white.values[0, 0, 0])  # the highlight keeps its own colour
    red = table_of(body.apply(PLAIN, 1.0, PALETTE).material)
    assert np.ptp(np.log(red.values[0, 0, 0]) - peak) < 0.2


def test_scores_know_a_tint():
    z = Tint((1.0, 0.1, 0.1)).apply(PLAIN, 1.0, PALETTE).material.z
    before, after = (PALETTE.traits.score(one) for one in (PLAIN.z, z))
    assert after["red"] > before["red"] + 0.3
    assert abs(after["shiny"] - before["shiny"]) < 0.1


# -- layers and undo --------------------------------------------------------------------------


def test_layers_are_changed_later(edit):
    edit.assign("body", "red-rubber")
    edit.move("body", shiny=0.5)
    edit.move("lid", matte=0.3)
    rubber = LIBRARY.coordinates[LIBRARY.index("red-rubber")]
    layers = edit.layers
    layers[1].name = "polish"
    assert layers["polish"] == layers[1]
    layers["polish"].opacity = 0.5
    half = edit.traits.move(EMBEDDING.clip(rubber), {"shiny": 0.25})
    same(edit.material("body").z, half)
    layers["polish"].visible = False
    same(edit.material("body").z, EMBEDDING.clip(rubber))
    layers["polish"].visible = True
    layers["polish"].effect = tb.Move(matte=0.5)
    same(edit.material("body").z, edit.traits.move(EMBEDDING.clip(rubber), {"matte": 0.25}))
    layers[0].effect = tb.Assign("gold-polished")
    gold = EMBEDDING.clip(LIBRARY.coordinates[LIBRARY.index("gold-polished")])
    same(edit.material("body").z, edit.traits.move(gold, {"matte": 0.25}))
    layers[0].move_to(-1)
    same(edit.material("body").z, gold)
    del layers["polish"]
    assert [str(one) for one in edit.design.layers] == [
        "tb.Move(matte=0.3) on lid", "tb.Assign('gold-polished') on body",
    ]  # fmt: skip
    for _ in range(8):
        assert edit.undo()
    assert len(edit.layers) == 3
    same(edit.material("body").z, edit.traits.move(EMBEDDING.clip(rubber), {"shiny": 0.5}))


def test_hidden_layers_are_checked_and_saved(edit, tmp_path):
    edit.assign("body", "red-rubber")
    edit.assign("body", "chrome")
    edit.layers[-1].visible = False
    with pytest.raises(ValueError, match="'shiny'"):
        edit.layers[-1].effect = tb.Move(shinny=0.5)
    table = tb.TabulatedBRDF.from_model(Lambert((0.1, 0.5, 0.2)), EMBEDDING.grid_, "mine")
    edit.layers[-1].effect = tb.Assign(table)
    assert edit.material("body").name == "red-rubber"
    assert edit.reached("body") is None
    edit.save(tmp_path / "hidden.tbr")
    again = EditSession.load(tmp_path / "hidden.tbr")
    assert again.history == edit.history
    again.layers[-1].visible = True
    same(again.brdf("body").values, table.values)


def test_an_effect_means_what_the_palette_says():
    """The same effect in two sessions: a name is looked up in the library at hand."""
    picked = [3, 11, LIBRARY.index("chrome")]
    other = tb.Library(
        EMBEDDING,
        ["chrome", "white-plastic", "concrete"],
        LIBRARY.coordinates[picked],
        ["a", "b", "c"],
    )
    effect = Assign("chrome")
    palettes = (PALETTE, Palette(other, PALETTE.traits), PALETTE)
    found = [effect.apply(PLAIN, 1.0, palette).material.z for palette in palettes]
    same(found[0], found[2])
    same(found[1], EMBEDDING.clip(LIBRARY.coordinates[3]))


def test_a_layer_that_is_gone_says_so(edit):
    edit.move("body", shiny=0.5)
    top = edit.layers[-1]
    edit.undo()
    with pytest.raises(ValueError, match="not in it"):
        top.opacity = 0.5
    with pytest.raises(ValueError, match="not in it"):
        _ = top.opacity
    edit.redo()
    top.opacity = 0.5
    assert top.opacity == 0.5 and top.index == 0


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        (lambda e: setattr(e.layers[0], "opacity", 1.5), ValueError, "opacity: expected 0 to 1"),
        (lambda e: setattr(e.layers[0], "opacity", "half"), TypeError, "opacity"),
        (lambda e: setattr(e.layers[0], "visible", 1), TypeError, "visible"),
        (lambda e: setattr(e.layers[0], "name", 3), TypeError, "name"),
        (lambda e: setattr(e.layers[0], "effect", "shiny"), TypeError, "effect"),
        (lambda e: setattr(e.layers[0], "effect", tb.Move(shinny=1)), ValueError, "'shiny'"),
        (lambda e: setattr(e.layers[0], "mask", Parts.of("bdy")), ValueError, "'body'"),
        (lambda e: setattr(e.layers[0], "colour", 3), AttributeError, "colour"),
        (lambda e: e.layers[0].colour, AttributeError, "colour"),
        (lambda e: e.layers["polsh"], ValueError, "'polish'"),
        (lambda e: e.layers[0].move_to(7), ValueError, "index"),
        (lambda e: setattr(e, "design", "a file"), TypeError, "design"),
        (lambda e: setattr(e, "design", Design({"sphere": PLAIN})), ValueError, "parts"),
        (lambda e: e.paint(on(e.scene, "body"), tb.Move(shiny=0.1)), ValueError, "both"),
        (lambda e: e.paint(on(e.scene, "body", trait=None)), ValueError, "neither"),
    ],
)
def test_a_change_that_cannot_be_made_changes_nothing(edit, change, error, match):
    edit.move("body", shiny=0.2)
    edit.layers[0].name = "polish"
    edit.move("lid", shiny=0.2)
    edit.undo()
    design, materials = edit.design, dict(edit.materials)
    with pytest.raises(error, match=match):
        change(edit)
    assert edit.design is design
    assert edit.materials == materials
    assert edit.redo()


class Counting(Effect):
    """Counts how often it is applied."""

    count = 0

    def apply(self, material, weight, palette):
        type(self).count += 1
        return Applied(material)


def test_only_what_changed_is_computed_anew():
    doc = document()
    for _ in range(50):
        doc.add(Layer(Counting(), Parts.of("body")))
    assert Counting.count == 50
    doc.undo()
    doc.redo()
    doc.change(doc.design.with_settings(doc.design.layers[-1].key, opacity=0.5))
    assert Counting.count == 51
    doc.change(doc.design.with_settings(doc.design.layers[20].key, opacity=0.5))
    assert Counting.count == 52  # those above were applied to the same materials before


def folded(design, palette=PALETTE):
    return dict(Document(design, palette).materials)


steps = st.lists(
    st.one_of(
        st.tuples(st.just("add"), st.sampled_from(PARTS), st.sampled_from(TRAITS), amount),
        st.tuples(st.just("assign"), st.sampled_from(PARTS), st.sampled_from(LIBRARY.names)),
        st.tuples(st.just("opacity"), st.integers(0, 9), st.floats(0.0, 1.0)),
        st.tuples(st.just("visible"), st.integers(0, 9), st.booleans()),
        st.tuples(st.just("order"), st.integers(0, 9), st.integers(0, 9)),
        st.tuples(st.just("delete"), st.integers(0, 9)),
        st.tuples(st.just("undo")),
        st.tuples(st.just("redo")),
    ),
    max_size=12,
)


@settings(max_examples=60)
@given(steps)
def test_the_document_is_a_function_of_its_design(several):
    """Whatever led there: parts are what the layers make of them, and undo(do(x)) = x."""
    doc = document()
    past, future = [], []
    for kind, *given_ in several:
        before = doc.design
        layers = before.layers
        if kind == "undo":
            assert doc.undo() == bool(past)
            if past:
                future.append(before)
                assert doc.design is past.pop()
        elif kind == "redo":
            assert doc.redo() == bool(future)
            if future:
                past.append(before)
                assert doc.design is future.pop()
        else:
            if kind in ("add", "assign"):
                part, *what = given_
                effect = Assign(*what) if kind == "assign" else Move(dict([what]))
                try:
                    doc.add(Layer(effect, Parts.of(part)))
                except ValueError:
                    assert doc.design is before
                    continue
            elif not layers:
                continue
            else:
                key = layers[given_[0] % len(layers)].key
                if kind == "delete":
                    doc.change(before.without(key))
                elif kind == "order":
                    doc.change(before.with_order(key, given_[1] % len(layers)))
                else:
                    doc.change(before.with_settings(key, **{kind: given_[1]}))
            past.append(before)
            future.clear()
        assert (doc.undoable, doc.redoable) == (bool(past), bool(future))
    now, then = doc.materials, folded(doc.design)
    for part in PARTS:
        same(now[part].z, then[part].z)
        assert now[part].name == then[part].name
    while doc.undo():
        pass
    assert doc.materials == dict.fromkeys(PARTS, PLAIN)


def test_designs_are_values(edit):
    edit.assign("body", "red-rubber")
    first = edit.design
    edit.move("body", shiny=0.5)
    second = edit.design
    shown = edit.render()
    edit.design = first
    assert edit.material("body").name == "red-rubber" and len(edit.layers) == 1
    edit.design = second
    same(edit.render(), shown)
    assert edit.undo() and edit.design is first
    assert "1 layers" in repr(first)


def test_a_trait_of_one_s_own_leaves_the_design_as_it_is(edit):
    edit.assign("body", "red-rubber")
    edit.move("body", shiny=0.4)
    before = edit.material("body")
    edit.add_trait(Trait.from_labels("candy", ["blue-plastic", "red-rubber"], [1, -1]))
    assert edit.material("body") is before
    edit.layers[0].opacity = 0.5
    edit.layers[0].opacity = 1.0
    same(edit.material("body").z, before.z)
    edit.move("body", candy=0.2)
    moved = edit.material("body")
    # what it means is changed: the layer follows
    edit.add_trait(Trait.from_labels("candy", ["blue-plastic", "red-rubber"], [-1, 1]))
    assert np.abs(edit.material("body").z - moved.z).max() > 0.01
    with pytest.raises(ValueError, match="unknown trait 'candy'"):
        edit.traits = tb.default_traits()
    assert edit.scores("body")["candy"] > -9.0  # nothing has changed


# -- history ----------------------------------------------------------------------------------

parts = st.sampled_from(["body", "handle", "spout", "lid"])
targets = (
    parts
    | st.lists(parts, min_size=1, max_size=3, unique=True)
    | st.dictionaries(parts, st.floats(0.0, 1.0), min_size=1, max_size=3)
)
points = st.lists(st.tuples(st.floats(5.0, 55.0), st.floats(5.0, 43.0)), min_size=1, max_size=3)
actions = st.lists(
    st.one_of(
        st.tuples(st.just("apply"), targets, any_effect),
        st.tuples(st.just("paint"), points, any_effect, st.floats(1.0, 20.0)),
        st.tuples(st.just("trait"), points, names, amount, st.none() | parts),
        st.tuples(
            st.sampled_from(["opacity", "visible", "name", "effect"]),
            st.integers(0, 9), st.floats(0.0, 1.0), any_effect,
        ),
        st.tuples(st.just("order"), st.integers(0, 9), st.integers(0, 9)),
        st.tuples(st.just("delete"), st.integers(0, 9)),
        st.tuples(st.sampled_from(["undo", "redo", "save"])),
    ),
    min_size=1,
    max_size=7,
)  # fmt: skip


def act(session, kind, given_):
    layers = session.layers
    if kind in ("undo", "redo"):
        getattr(session, kind)()
    elif kind == "apply":
        session.apply(*given_)
    elif kind == "paint":
        line, effect, radius = given_
        session.paint(Stroke(line, radius=radius), effect)
    elif kind == "trait":
        line, trait, much, only = given_
        session.paint(Stroke(line, trait, much, 6.0), only=only)
    elif not len(layers):
        return
    else:
        one = layers[given_[0] % len(layers)]
        if kind == "order":
            one.move_to(given_[1] % len(layers))
        elif kind == "delete":
            one.delete()
        else:
            value = {
                "opacity": given_[1], "visible": given_[1] > 0.5, "name": f"it's {given_[1]}",
                "effect": given_[2],
            }[kind]  # fmt: skip
            setattr(one, kind, value)


@pytest.mark.slow
@settings(
    max_examples=200,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(actions)
def test_the_history_of_any_session_replays_to_the_identical_frame(
    fresh, odd_traits, tmp_path, several
):
    session = fresh(traits=odd_traits)
    for kind, *given_ in several:
        if kind == "save":
            session.save(tmp_path / "design.tbr")
            loaded = EditSession.load(tmp_path / "design.tbr", cache=False)
            assert loaded.history == session.history
            for part in session.scene.parts:
                assert loaded.material(part).name == session.material(part).name
                same(loaded.material(part).z, session.material(part).z)
            continue
        before = session.design
        try:
            act(session, kind, given_)
        except ValueError as error:  # nothing under the stroke, or what is held forbids the move
            assert "expected" in str(error) or "hold" in str(error), error
            assert session.design is before
    again = replay(session, fresh(traits=odd_traits))
    assert again.history == session.history
    same(again.render(exact=False), session.render(exact=False))


def test_a_table_that_is_assigned_twice_stays_one_table(edit, tmp_path):
    mine, other = (
        tb.TabulatedBRDF.from_model(GGX(r, 1.5, 0.0), EMBEDDING.grid_, "mine") for r in (0.3, 0.4)
    )
    for part, table in (("body", mine), ("lid", other), ("lid", mine), ("rim", mine)):
        edit.assign(part, table)
    edit.save(tmp_path / "design.tbr")
    loaded = EditSession.load(tmp_path / "design.tbr", cache=False)
    assert loaded.history == edit.history
    assert list(loaded.design.tables()) == ["mine", "mine (2)"]
    loaded.save(tmp_path / "again.tbr")
    assert EditSession.load(tmp_path / "again.tbr", cache=False).history == edit.history


def test_the_history_replays_to_the_identical_frame(edit, fresh):
    edit.assign("body", "blue-plastic")
    edit.assign(["lid", "rim"], "gold-satin")
    edit.move("body", shiny=1.0 / 3.0, red=-0.1234567890123, hold=("bright",))
    edit.move("spout", rough=np.float32(0.2))
    edit.paint(on(edit.scene, "handle", math.pi / 5))
    edit.paint(Stroke([(1.0 / 3.0, 24.1), (59.7, 22.3)], "matte", 0.37, 7.0 / 3.0, hold=()))
    edit.paint(on(edit.scene, "body", np.float64(-0.2), "metallic", hold="colour"))
    edit.assign("bottom", LIBRARY.coordinates[11])
    edit.paint(on(edit.scene, "spout", trait=None), tb.Assign("chrome"))
    edit.assign({"lid": 0.25}, GGX(0.2, 1.5, 0.0))
    edit.layers[-1].opacity = 0.75
    again = replay(edit, fresh())
    assert again.history == edit.history
    same(again.render(), edit.render())


def test_moves_that_are_forbidden_by_now_replay(edit, fresh, tmp_path):
    """Refused when asked for, but not where a layer became one later."""
    forbidden = tb.Move(glossy=0.5, specular=-0.5, hold=("strength", "sharpness", "shiny"))
    moved = next(
        name
        for name in LIBRARY.names
        if PALETTE.traits.reach(
            LIBRARY.coordinates[LIBRARY.index(name)], dict(forbidden.amounts), forbidden.hold
        ).stopped.startswith("held")
    )
    edit.assign(["body", "lid"], moved)
    with pytest.raises(ValueError, match="cannot move"):
        edit.move("body", dict(forbidden.amounts), hold=forbidden.hold)
    edit.move("body", bright=0.1)
    edit.layers[-1].effect = forbidden
    edit.paint(on(edit.scene, "lid", 0.1, "bright"))
    edit.layers[-1].effect = tb.Move(glossy=0.5, hold=("shiny", "matte"))
    edit.apply("lid", forbidden)
    edit.apply("lid", forbidden)
    edit.layers[-1].visible = False
    edit.apply({"lid": 0.5}, forbidden)
    edit.layers[-1].opacity = 0.5
    again = replay(edit, fresh())
    assert again.history == edit.history
    edit.save(tmp_path / "design.tbr")
    loaded = EditSession.load(tmp_path / "design.tbr")
    third = replay(loaded, fresh())
    for part in edit.scene.parts:
        for other in (again, loaded, third):
            same(other.material(part).z, edit.material(part).z)


@pytest.mark.parametrize("name", [*SYNONYMS, *ODD])
def test_history_names_every_trait(edit, fresh, odd_traits, name):
    session = fresh(traits=odd_traits)
    session.move("handle", {name: 0.2})
    session.paint(on(session.scene, "body", 0.1, name))
    again = replay(session, fresh(traits=odd_traits))
    for part in ("handle", "body"):
        same(again.material(part).z, session.material(part).z)


def test_tables_of_one_name_are_told_apart(edit, fresh):
    one, other = (
        tb.TabulatedBRDF.from_model(Lambert(albedo), EMBEDDING.grid_, "mine")
        for albedo in (0.2, 0.6)
    )
    edit.assign("body", one)
    edit.assign("lid", other)
    edit.assign("spout", one)
    assert edit.history == [
        "edit.assign('body', tables['mine'])",
        "edit.assign('lid', tables['mine (2)'])",
        "edit.assign('spout', tables['mine'])",
    ]
    again = replay(edit, fresh())
    same(again.render(exact=False), edit.render(exact=False))


# -- files ------------------------------------------------------------------------------------


def test_a_teapot_design_survives_its_file(types_take_as_long, edit, fresh, tmp_path, shared_data):
    # as few basis images as its error needs, as the loaded one will have
    known = edit.view.prepared
    edit.view.prepared = promised(known, edit.library, edit.settings)
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
    assert [str(layer) for layer in again.layers] == [str(layer) for layer in edit.layers]
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


def test_a_sphere_design_survives_its_file(types_take_as_long, tmp_path):
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
    session.move("lid", shiny=0.2)
    session.paint(on(small_teapot, "handle", 0.2, "matte"))
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


def change_layer(**values):
    """Another layer in the middle."""

    def change(arrays):
        header = json.loads(str(arrays["design"]))
        header["layers"][1].update(values)
        arrays["design"] = np.array(json.dumps(header))

    return change


def replaced(**values):
    return lambda arrays: arrays.update(values)


@pytest.mark.parametrize(
    "change",
    [
        change_header(format=5),
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
        change_header(below={}),
        change_header(below={"body": 0}),
        change_header(below=dict.fromkeys(tb.teapot().parts, 99)),
        change_header(layers=None),
        change_header(layers=[{}]),
        change_header(recorded=[["edit.undo()"]]),
        change_header(quality="best"),
        change_header(error=-1.0),
        change_layer(effect={"is": "Explode"}),
        change_layer(effect={"is": "Camera"}),
        change_layer(effect={"is": "Move", "amounts": []}),
        change_layer(effect={"is": "Move", "amounts": [["shiny", "x"]]}),
        change_layer(effect={"is": "Assign", "material": None, "known": None}),
        change_layer(effect="tb.Move(shiny=1)"),
        change_layer(mask={"is": "Parts", "weights": [["lid", 2.0]]}),
        change_layer(mask={"is": "Parts", "weights": [["cup", 1.0]]}),
        change_layer(mask={"is": "Stroke", "points": [[1.0, 2.0]]}),
        change_layer(opacity=7.0),
        change_layer(visible="no"),
        change_layer(after={}),
        change_layer(after={"lid": 99}),
        change_layer(after={"cup": 0}),
        lambda arrays: arrays.pop("design"),
        lambda arrays: arrays.pop("environment"),
        lambda arrays: arrays.pop("points"),
        lambda arrays: arrays.pop("mirrors"),
        lambda arrays: arrays.pop("table_0"),
        lambda arrays: arrays.pop("shape_faces"),
        replaced(design=np.array("no json")),
        replaced(design=np.array("[]")),
        replaced(design=np.array("[" * 100_000)),
        replaced(environment=np.full((4, 8, 3), -1.0)),
        replaced(environment=np.array("light")),
        replaced(shape_faces=np.full((2, 3), 10**6)),
        replaced(shape_vertices=np.full((9, 3), np.nan)),
        replaced(points=np.zeros((9, 3))),
        replaced(points=np.full((9, 24), np.nan)),
        replaced(mirrors=np.full((9, 3), 7.0)),
        replaced(table_0=np.zeros((4, 3))),
        replaced(table_0=np.full((EMBEDDING.grid_.size, 3), np.nan)),
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


def written_before(saved, number):
    """The arrays of a design as formats 1 and 2 had them: materials, and calls as text."""
    arrays, session = read_arrays(saved), EditSession.load(saved)
    header = json.loads(str(arrays["design"]))
    for name in ("below", "layers", "recorded"):
        del header[name]
    kept = {k: v for k, v in arrays.items() if k.partition("_")[0] in ("shape", "environment")}
    header |= {"format": number, "materials": []}
    for i, part in enumerate(session.scene.parts):
        material = session.material(part)
        header["materials"].append({"part": part, "name": material.name})
        kept |= {f"z_{i}": material.z, f"mirror_{i}": material.mirror}
        for kind in ("offset", "table"):
            if getattr(material, kind) is not None:
                kept[f"{kind}_{i}"] = getattr(material, kind)
    header["history"] = session.history
    header["anywhere"] = ["", "", "edit.move('handle', matte=0.2)"]
    if number == 1:
        for name in ("ground", "shadows", "subsamples", "anywhere"):
            del header[name]
    return {**kept, "design": np.array(json.dumps(header))}


@pytest.mark.parametrize("number", [1, 2])
def test_designs_from_before_there_were_layers_still_load(saved, tmp_path, number):
    write_arrays(tmp_path / "old.tbr", written_before(saved, number))
    again, now = EditSession.load(tmp_path / "old.tbr"), EditSession.load(saved)
    assert len(again.layers) == 0
    assert again.history == now.history
    for part in now.scene.parts:
        old, new = again.material(part), now.material(part)
        same(old.z, new.z)
        assert old.name == new.name
        assert (old.table is None) == (new.table is None)
    if number == 1:
        assert (again.scene.ground, again.scene.shadows) == (False, False)
        assert again.scene.subsamples == 1
    again.move("lid", bright=0.1)
    again.save(tmp_path / "new.tbr")
    later = EditSession.load(tmp_path / "new.tbr")
    assert later.history == [*now.history, "edit.move('lid', bright=0.1)"]
    assert later.scene.subsamples == again.scene.subsamples
    same(later.material("lid").z, again.material("lid").z)
    later.look(size=20)  # framed anew
    assert later.history[2] == ("edit.move('handle', matte=0.2)" if number == 2 else now.history[2])
    del later.layers[-1]
    same(later.material("lid").z, now.material("lid").z)


def test_a_design_opens_as_it_was_saved(saved, tmp_path):
    """Also where its effects come to something else by now: until a layer changes."""
    arrays = read_arrays(saved)
    after = json.loads(str(arrays["design"]))["layers"][1]["after"]["lid"]
    arrays["points"][after, 0] += 0.1
    write_arrays(tmp_path / "drifted.tbr", arrays)
    again, now = EditSession.load(tmp_path / "drifted.tbr"), EditSession.load(saved)
    same(again.material("lid").z, arrays["points"][after])
    again.move("body", shiny=0.1)
    again.layers[2].opacity = 0.5
    same(again.material("lid").z, arrays["points"][after])
    again.layers[1].opacity = 0.999
    np.testing.assert_allclose(again.material("lid").z, now.material("lid").z, atol=0.05)
