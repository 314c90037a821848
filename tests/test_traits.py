"""Traits: a move does what was asked, keeps what is held, and stays in the gamut."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from traitbrdf.bench.people import RATINGS, rated_materials, spearman
from traitbrdf.reflectance.brdf import TabulatedBRDF
from traitbrdf.reflectance.descriptors import DESCRIPTORS, cielab, descriptors, hue
from traitbrdf.space.definitions import Definition, Labelled, Statistics
from traitbrdf.space.embedding import GRID
from traitbrdf.space.holding import COLOURS, KEEPS_BODY, LIGHT
from traitbrdf.space.learning import Trait, suggest
from traitbrdf.space.library import default_embedding, default_library
from traitbrdf.space.scores import Box
from traitbrdf.space.traits import TraitSpace, default_traits

EMBEDDING = default_embedding()
LIBRARY = default_library()
SPACE = default_traits()
LOW, HIGH = SPACE.low, SPACE.high
INNER = [
    z for z in LIBRARY.coordinates if np.all((z - LOW > 0.1 * (HIGH - LOW)) & (HIGH - z > 0.1))
]

members = st.integers(0, len(LIBRARY) - 1).map(lambda i: np.clip(LIBRARY.coordinates[i], LOW, HIGH))
names = st.sampled_from(SPACE.names)
amounts = st.floats(-3.0, 3.0)
holds = st.sampled_from(
    [None, (), ("colour",), ("bright",), ("rough", "red"), ("colour", "bright")]
)
laws = settings(deadline=None, max_examples=60)


def scores(z):
    return np.array(list(SPACE.score(z).values()))


def at_a_wall(z):
    return bool(np.any((z <= LOW + 1e-9) | (z >= HIGH - 1e-9)))


def held_by(name, hold):
    """Whether `name` cannot be moved while that is held."""
    return any(name in SPACE.held(one) for one in hold or ())


@laws
@given(members, names, amounts, holds)
def test_a_move_changes_its_score_by_the_amount_and_no_held_one(z, name, amount, hold):
    if held_by(name, hold):
        return
    found = SPACE.reach(z, {name: amount}, hold)
    assert np.all((found.z >= LOW) & (found.z <= HIGH))
    change = dict(zip(SPACE.names, scores(found.z) - scores(z), strict=True))
    if found.complete:
        assert change[name] == pytest.approx(amount, abs=2.5e-3)
    if "held" in found.stopped:  # what is held and what is moved depend on each other
        with pytest.raises(ValueError, match="depend on each other"):
            SPACE.move(z, {name: amount}, hold)
        return
    # where the gamut ends less is reached than asked, but never more, nor the contrary
    assert -3e-3 <= change[name] * np.sign(amount) <= abs(amount) + 3e-3
    assert found.reached[name] == pytest.approx(change[name], abs=1e-9)
    for member in set(hold or ()) - {"colour"}:
        assert abs(change[member]) < 2.5e-3
        assert found.held[member] == pytest.approx(change[member], abs=1e-9)
    np.testing.assert_array_equal(SPACE.move(z, {name: amount}, hold), found.z)


@laws
@given(members, names, st.lists(amounts, min_size=2, max_size=4), holds)
def test_scores_are_monotone_in_the_amount(z, name, several, hold):
    if held_by(name, hold):
        return
    found = [SPACE.reach(z, {name: a}, hold) for a in sorted(several)]
    if any("held" in one.stopped for one in found):
        return
    reached = np.array([one.reached[name] for one in found])
    far = np.array([one.complete for one in found])
    # exactly where all of it is reached; where the gamut ends, as near as a path finds its end
    assert np.all(np.diff(reached) >= np.where(far[1:] & far[:-1], -3e-3, -0.1))


@laws
@given(members, st.lists(amounts, min_size=3, max_size=3))
def test_several_traits_move_at_once(z, three):
    asked = dict(zip(("shiny", "bright", "red"), three, strict=True))
    found = SPACE.reach(z, asked)
    change = {name: SPACE.score(found.z)[name] - SPACE.score(z)[name] for name in asked}
    if found.complete:
        for name, amount in asked.items():
            assert change[name] == pytest.approx(amount, abs=2.5e-3)


@laws
@given(members, names)
def test_an_amount_of_zero_is_the_identity(z, name):
    moved = SPACE.move(z, {name: 0.0})
    np.testing.assert_array_equal(moved, z)
    assert moved is not z
    np.testing.assert_array_equal(SPACE.move(z, {name: 0}, ("colour",) if name == "rough" else ()),
                                  z)  # fmt: skip
    np.testing.assert_array_equal(SPACE.move(z, {}), z)


@laws
@given(names, st.floats(-0.3, 0.3), st.integers(0, len(INNER) - 1))
def test_small_moves_can_be_taken_back(name, amount, i):
    there = SPACE.reach(INNER[i], {name: amount})
    back = SPACE.reach(there.z, {name: -amount})
    if there.complete and back.complete:
        np.testing.assert_allclose(
            SPACE.score(back.z)[name], SPACE.score(INNER[i])[name], atol=4.5e-3
        )


@laws
@given(members, names, amounts)
def test_a_move_in_two_steps_scores_as_in_one(z, name, amount):
    whole = SPACE.reach(z, {name: amount})
    first = SPACE.reach(z, {name: 0.5 * amount})
    second = SPACE.reach(first.z, {name: 0.5 * amount})
    if whole.complete and first.complete and second.complete:
        assert SPACE.score(second.z)[name] == pytest.approx(SPACE.score(whole.z)[name], abs=4.5e-3)


@pytest.mark.parametrize("amount", [1e-300, 1e-9, 1e3, 1e9, 1e300, -1e300])
def test_extreme_amounts_stay_in_the_box(amount):
    for name in SPACE.names:
        moved = SPACE.move(INNER[0], {name: amount})
        assert np.all((moved >= LOW) & (moved <= HIGH))
        assert np.isfinite(scores(moved)).all()
        change = SPACE.score(moved)[name] - SPACE.score(INNER[0])[name]
        assert change * np.sign(amount) >= -1e-3


def test_start_points_outside_the_box_end_inside():
    moved = SPACE.move(HIGH + 1.0, {"shiny": 0.1})
    assert np.all((moved >= LOW) & (moved <= HIGH))


def test_half_a_unit_is_reached_from_most_starts():
    """Less than when moves leapt (99 %): where a way ends, it ends."""
    shares = []
    for i, name in enumerate(SPACE.names):
        every = SPACE.scores(LIBRARY.coordinates)[:, i]
        can = np.flatnonzero(every + 0.5 <= SPACE.limits[i, 1])
        found = [SPACE.reach(LIBRARY.coordinates[j], {name: 0.5}) for j in can[::40]]
        shares.append(np.mean([one.reached[name] >= 0.45 for one in found]))
        assert all(one.complete or one.stopped for one in found)
    assert np.mean(shares) >= 0.8
    assert min(shares) >= 0.6, dict(zip(SPACE.names, shares, strict=True))


def test_colour_and_lightness_are_held_by_default_unless_a_trait_is_about_them():
    assert SPACE.holds({"shiny": 0.5}) == ("colour", "lightness")
    assert SPACE.holds({"dusty": 0.5}) == ("colour",)
    assert SPACE.holds({"red": 0.5}) == ("lightness",)
    assert SPACE.holds({"gold": 0.5}) == SPACE.holds({"shiny": 0.5, "golden": 0.2}) == ()
    assert set(SPACE.names) >= COLOURS | LIGHT
    for name in ("shiny", "dusty", "red", "gold"):
        told = SPACE.move(INNER[0], {name: 0.3}, SPACE.holds({name: 0.3}))
        np.testing.assert_array_equal(SPACE.move(INNER[0], {name: 0.3}), told)
    let_go = SPACE.move(INNER[0], {"shiny": 0.3}, ())
    assert np.abs(let_go - SPACE.move(INNER[0], {"shiny": 0.3})).max() > 1e-3


def test_what_a_move_comes_to_does_not_depend_on_what_was_asked_before():
    """Moves keep the ways that they know: a drag goes on from there."""
    amounts = (0.5, 0.52, 0.3, -0.2, 0.555, 0.05, 1.0)
    warm = [SPACE.move(INNER[1], {"glossy": a}) for a in amounts]
    for amount, found in zip(amounts, warm, strict=True):
        cold = TraitSpace.from_arrays({**SPACE.arrays(), "low": LOW, "high": HIGH})
        np.testing.assert_array_equal(cold.move(INNER[1], {"glossy": amount}), found)


@settings(deadline=None, max_examples=20)
@given(members, names, st.sampled_from([None, ("rough",), ()]), st.booleans())
def test_a_drag_is_smooth_between_the_steps_of_a_move(z, name, hold, up):
    if held_by(name, hold):
        return
    amounts = np.linspace(0.0, 0.3, 46) * (1.0 if up else -1.0)
    moves = [SPACE.reach(z, {name: a}, hold) for a in amounts]
    way = np.array([m.z for m in moves])
    shown = np.array([SPACE.colours(point) for point in way])
    # a step of 0.05 may show 20; the worst step of a seventh of it shows at most 2.7 in all but 9
    # of 496 random drags, and 4.3 in the worst, where the gamut ends
    assert np.linalg.norm(np.diff(shown, axis=0), axis=-1).max() < 6.0
    for amount, m in zip(amounts, moves, strict=True):
        if m.complete:
            assert m.reached[name] == pytest.approx(amount, abs=2.6e-3)
        assert max(map(abs, m.held.values()), default=0.0) < 0.02
    assert np.all((way >= LOW) & (way <= HIGH))


def test_a_path_is_the_whole_curve_of_a_move():
    curve = SPACE.path(INNER[2], {"rough": -0.4, "bright": 0.2}, steps=8)
    assert curve.shape == (9, 24)
    np.testing.assert_array_equal(curve[0], INNER[2])
    for i in (3, 8):
        amounts = {"rough": -0.4 * i / 8, "bright": 0.2 * i / 8}
        np.testing.assert_array_equal(curve[i], SPACE.move(INNER[2], amounts))
    assert np.linalg.norm(np.diff(curve, axis=0), axis=1).max() < 0.2 * np.sqrt(24)
    for steps in (0, -1, 2.5, True, None):
        with pytest.raises(ValueError, match="steps: expected a positive integer"):
            SPACE.path(INNER[2], {"rough": -0.4}, steps=steps)


def test_straight_vectors_go_straight():
    z = INNER[3]
    ends = [SPACE.move(z, {"shiny": a}, method="linear") for a in (0.1, 0.2)]
    np.testing.assert_allclose(ends[1] - z, 2.0 * (ends[0] - z), atol=1e-9)
    held = SPACE.move(z, {"shiny": 0.01}, ("bright",), method="linear")
    assert abs(SPACE.score(held)["bright"] - SPACE.score(z)["bright"]) < 1e-3
    flow = SPACE.move(z, {"shiny": 0.01}, ("bright",))
    assert SPACE.score(held)["shiny"] == pytest.approx(SPACE.score(flow)["shiny"], abs=1e-3)
    far = SPACE.reach(z, {"shiny": 30.0}, method="linear")
    assert np.all(far.z <= HIGH)
    assert far.stopped == "a straight way ends elsewhere"
    with pytest.raises(ValueError, match="method: expected 'flow' or 'linear'"):
        SPACE.move(z, {"shiny": 0.1}, method="newton")


def test_scores_are_zero_and_one_at_the_library_s_percentiles():
    all_scores = np.array([scores(z) for z in LIBRARY.coordinates])
    low, high = np.percentile(all_scores, [10.0, 90.0], axis=0)
    np.testing.assert_allclose(low, 0.0, atol=1e-3)
    np.testing.assert_allclose(high, 1.0, atol=1e-3)


MATUSIK = (
    "red", "green", "blue", "specular", "diffuse", "glossy", "metallic", "plastic", "rough",
    "silver", "gold", "fabric", "acrylic", "greasy", "dusty", "rubber",
)  # fmt: skip
SERRANO = (
    "plastic", "rubber", "metallic", "fabric", "ceramic", "soft", "hard", "matte", "glossy",
    "bright", "rough", "strength", "sharpness", "tint",
)  # fmt: skip


def test_the_published_traits_are_there_by_their_names_and_everyday_ones():
    assert set(SPACE.names) == {*MATUSIK, *SERRANO, "shiny"}
    assert len(SPACE.names) == 25
    assert SPACE.index("glossiness") == SPACE.index("glossy")
    assert SPACE.index("refstrng") == SPACE.index("strength")
    assert SPACE.meaning("oily") == SPACE.meaning("greasy") != "greasy"
    z = INNER[0]
    np.testing.assert_array_equal(SPACE.move(z, {"dull": 0.2}), SPACE.move(z, {"matte": 0.2}))


def test_traits_mean_what_they_say():
    assert SPACE.index("rough") == SPACE.names.index("rough")
    assert "shiny" in repr(SPACE)
    assert default_traits() is SPACE
    at = {name: SPACE.score(LIBRARY.coordinates[LIBRARY.index(name)]) for name in (
        "chrome", "white-plaster", "blue-plastic", "red-rubber", "black-velvet", "gold-polished",
    )}  # fmt: skip
    assert at["chrome"]["shiny"] > 0.7 > 0.3 > at["white-plaster"]["shiny"]
    assert at["gold-polished"]["metallic"] > 0.7 > at["white-plaster"]["metallic"]
    assert at["blue-plastic"]["blue"] > 0.7 > at["red-rubber"]["blue"]
    assert at["red-rubber"]["red"] > 0.7
    assert at["white-plaster"]["bright"] > 0.7 > 0.3 > at["black-velvet"]["bright"]
    for entry in at.values():
        assert (entry["glossy"] > 0.5) == (entry["matte"] < 0.5)
    assert at["gold-polished"]["gold"] > 0.9
    assert at["gold-polished"]["gold"] > at["chrome"]["gold"] + 0.1
    assert at["chrome"]["silver"] > at["gold-polished"]["silver"]


def test_moves_do_to_the_table_what_they_say():
    z = np.clip(LIBRARY.coordinates[LIBRARY.index("blue-plastic")], LOW, HIGH)
    angle = math.radians(30.0)
    before = EMBEDDING.decode(z)
    shinier = EMBEDDING.decode(SPACE.move(z, {"shiny": -0.5}, ("colour",)))
    assert shinier.values[0].max() < before.values[0].max()
    brighter = EMBEDDING.decode(SPACE.move(z, {"bright": 0.5}, ("shiny",)))
    assert brighter.albedo(angle).mean() > 1.2 * before.albedo(angle).mean()
    redder = EMBEDDING.decode(SPACE.move(z, {"red": 0.5}))
    share = [t.albedo(angle)[0] / t.albedo(angle).sum() for t in (before, redder)]
    assert share[1] > share[0]


# -- errors ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asked", "hold", "error", "match"),
    [
        ({"shinny": 0.5}, (), ValueError, "unknown trait 'shinny'.*'shiny'"),
        ({"shiny": 0.5}, ("colours",), ValueError, "unknown trait 'colours'"),
        ({"shiny": 0.5}, ("metalic",), ValueError, "'metallic"),
        ({"shiny": math.nan}, (), ValueError, "amount of 'shiny'"),
        ({"shiny": math.inf}, (), ValueError, "amount of 'shiny'"),
        ({"shiny": "lots"}, (), TypeError, "amount of 'shiny'"),
        ({"shiny": None}, (), TypeError, "amount of 'shiny'"),
        ({"shiny": 0.5}, ("shiny",), ValueError, "'shiny' cannot be moved and held"),
        ({"red": 0.5}, ("colour",), ValueError, "'red' cannot be moved and held"),
        ({"red": 0.0}, "color", ValueError, "'red' cannot be moved and held"),
    ],
)
def test_bad_moves(asked, hold, error, match):
    with pytest.raises(error, match=match):
        SPACE.move(INNER[0], asked, hold)


def straight_space(names, normals, box):
    """Traits that are linear functions of the coordinates."""
    typical = np.array([0.0, 1.0])
    traits = [
        Definition(n, np.zeros(0), np.array(v), typical)
        for n, v in zip(names, normals, strict=True)
    ]
    return TraitSpace(traits, box, Statistics(np.eye(len(box.low))))


@pytest.mark.parametrize(
    ("asked", "hold"), [({"a": 0.5}, ("c",)), ({"a": 0.5, "c": 0.5}, ()), ({"a": 1.0}, ("d", "b"))]
)
def test_holds_that_forbid_the_move(asked, hold):
    """c is the contrary of a, and d is a + b: neither can stay alone."""
    normals = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 1.0, 0.0]]
    space = straight_space("abcd", normals, Box(np.full(3, -2.0), np.full(3, 2.0)))
    with pytest.raises(ValueError, match="depend on each other"):
        space.move(np.zeros(3), asked, hold)
    np.testing.assert_allclose(space.move(np.zeros(3), {"a": 0.5, "c": -0.5}), [0.5, 0.0, 0.0])
    np.testing.assert_allclose(space.move(np.zeros(3), {"a": 1.0}, "b"), [1.0, 0.0, 0.0])


@pytest.mark.parametrize("z", [np.zeros(3), np.zeros((1, 24)), [math.nan] * 24, 1.0])
def test_bad_points(z):
    with pytest.raises(ValueError, match="z: expected 24 finite"):
        SPACE.score(z)
    with pytest.raises(ValueError, match="z: expected 24 finite"):
        SPACE.move(z, {"shiny": 0.5})


def fit(labels, z=None, families=None):
    if z is None:
        z = np.random.default_rng(0).normal(size=(20, 3))
    traits = [Labelled(name, given) for name, given in labels.items()]
    return TraitSpace.fit(z, traits, Box(np.full(3, -5.0), np.full(3, 5.0)), families)


def test_a_fit_finds_the_axis_that_separates():
    z = np.random.default_rng(0).normal(size=(200, 3))
    label = np.sign(z[:, 1]) * (np.abs(z[:, 1]) > 0.3)
    space = fit({"second": label}, z)
    axis = space.normals[0] / np.linalg.norm(space.normals[0])
    assert axis[1] > 0.98
    moved = space.move(np.zeros(3), {"second": 1.0}, photoreal=False)
    change = space.score(moved)["second"] - space.score(np.zeros(3))["second"]
    assert change == pytest.approx(1.0, abs=1e-4)
    least, most = space.limits[0]
    far = space.reach(np.zeros(3), {"second": 100.0})
    assert space.score(far.z)["second"] == pytest.approx(most, abs=1e-4)
    assert far.stopped == "no material of the library goes further"
    assert least < 0.0 < 1.0 < most


def test_a_fit_is_deterministic_and_survives_arrays():
    z = np.random.default_rng(1).normal(size=(30, 3))
    label = np.where(z[:, 0] > 0, 1, -1)
    kinds = ["a", "b", "c"] * 10
    first, second = fit({"x": label}, z, kinds), fit({"x": label}, z, kinds)
    again = TraitSpace.from_arrays({**first.arrays(), "low": first.low, "high": first.high})
    for name, value in first.arrays().items():
        np.testing.assert_array_equal(second.arrays()[name], value)
        np.testing.assert_array_equal(again.arrays()[name], value)
    np.testing.assert_array_equal(again.move(z[0], {"x": 0.4}), first.move(z[0], {"x": 0.4}))


@pytest.mark.parametrize(
    ("labels", "match"),
    [
        (np.ones(20), "with and without"),
        (np.zeros(20), "with and without"),
        (np.ones(19), r"expected \(20,\)"),
        (np.full(20, 2), "-1, 0 or 1"),
        (np.full(20, math.nan), "-1, 0 or 1"),
    ],
)
def test_bad_labels(labels, match):
    with pytest.raises(ValueError, match=match):
        fit({"x": labels})


def test_bad_families_and_shapes():
    label = np.tile([1, -1], 10)
    with pytest.raises(ValueError, match="families"):
        fit({"x": label}, families=["a"])
    good = fit({"x": label})
    (trait,), known = good.traits, Statistics(good.covariance)

    def same(statistics=known, box=good.box, body=None, **changes):
        return TraitSpace([replace(trait, **changes)], box, statistics, body=body)

    assert same().names == ("x",)
    for name, wrong in (("covariance", 4), ("related", 2), ("limits", 2)):
        with pytest.raises(ValueError, match=f"^{name}: expected shape"):
            same(replace(known, **{name: np.eye(wrong)}))
    for name, size in (("normal", 3), ("typical", 2), ("weights", 0)):
        with pytest.raises(ValueError, match=f"^{name} of 'x': expected shape .{size},."):
            same(**{name: np.zeros(5)})
    with pytest.raises(ValueError, match="high"):
        same(box=Box(good.low, good.high[:2]))
    with pytest.raises(ValueError, match="body"):
        same(body=np.eye(2))
    with pytest.raises(ValueError, match="percentile"):
        same(typical=np.ones(2))
    with pytest.raises(ValueError, match=r"'x'.*more than once"):
        same(synonyms=("x",))


def test_a_table_decides_its_scores():
    """Two names for one table score alike: nothing but the table is looked at."""
    table = LIBRARY["chrome"]
    other = TabulatedBRDF(GRID, table.values.copy(), name="white-paper")
    assert SPACE.score(EMBEDDING.encode(other)) == SPACE.score(EMBEDDING.encode(table))


# -- what a move keeps -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(KEEPS_BODY - {"greasy", "plastic"}))
def test_traits_of_the_highlight_keep_the_body(name):
    z = np.clip(LIBRARY.coordinates[LIBRARY.index("red-rubber")], LOW, HIGH)
    body = SPACE.body @ SPACE.move(z, {name: 0.25})
    np.testing.assert_allclose(body, SPACE.body @ z, atol=0.06)  # of log f


def test_hues_of_all_light_stay_where_colour_is_held():
    rng = np.random.default_rng(0)
    angles = np.radians([30.0, 60.0])
    turned = []
    for _ in range(60):
        z = np.clip(LIBRARY.coordinates[rng.integers(len(LIBRARY))], LOW, HIGH)
        name = str(rng.choice(sorted(set(SPACE.names) - COLOURS)))
        found = SPACE.reach(z, {name: float(rng.uniform(-0.6, 0.6))})
        tables = EMBEDDING.decode(z), EMBEDDING.decode(found.z)
        before, after = (hue(cielab(table.albedo(angles))) for table in tables)
        seen = (before[:, 1] >= 8.0) & (after[:, 1] >= 6.0)
        away = np.abs(before[:, 0] - after[:, 0])[seen]
        turned += np.minimum(away, 360.0 - away).tolist()
    assert len(turned) > 60
    assert np.mean(np.array(turned) <= 5.0) >= 0.98


def test_red_rubber_becomes_red_metal():
    """Where a body gives way to reflection with colour held, the reflection takes the colour."""
    z = np.clip(LIBRARY.coordinates[LIBRARY.index("red-rubber")], LOW, HIGH)
    rubber, metal = EMBEDDING.decode(z), EMBEDDING.decode(SPACE.move(z, {"metallic": 0.9}))
    was, now = descriptors(rubber), descriptors(metal)
    assert now["specular"] > 3.0 * now["diffuse"] > 0.0
    assert was["specular"] < 0.5 * was["diffuse"]
    (h0, c0), (h1, c1) = (hue(cielab(t.albedo(math.radians(30.0)))) for t in (rubber, metal))
    assert abs(h0 - h1) < 5.0
    assert c1 > 0.8 * c0


@pytest.mark.parametrize("name", ["blue-plastic", "red-rubber", "blue-denim", "oak-varnished"])
def test_dust_is_never_dark_and_gold_is_golden(name):
    z = np.clip(LIBRARY.coordinates[LIBRARY.index(name)], LOW, HIGH)
    before, dusty, gold = (
        cielab(EMBEDDING.decode(at).albedo(math.radians(30.0)))
        for at in (z, SPACE.move(z, {"dusty": 0.6}), SPACE.move(z, {"gold": 1.2}))
    )
    assert dusty[0] >= before[0]
    pale, deep = (np.hypot(*lab[1:]) / (lab[0] + 16.0) for lab in (dusty, before))
    assert pale < 0.8 * deep
    # between orange and greenish yellow
    assert 55.0 < hue(gold)[0] < 105.0


def test_moves_stay_where_materials_are_unless_told():
    z = np.clip(LIBRARY.coordinates[LIBRARY.index("red-rubber")], LOW, HIGH)
    within = SPACE.reach(z, {"red": 3.0})
    beyond = SPACE.reach(z, {"red": 3.0}, photoreal=False)
    assert within.stopped
    assert str(within).startswith("red +")
    assert within.plausibility > beyond.plausibility
    assert beyond.reached["red"] > within.reached["red"] + 0.5
    table = EMBEDDING.decode(beyond.z)  # physical all the same
    assert table.values.min() >= 0.0
    assert table.max_albedo() <= 1.0 + 1e-3


def test_plausibility_is_the_share_that_is_less_likely():
    known = np.array([SPACE.plausibility(z) for z in LIBRARY.coordinates[::20]])
    assert 0.3 < known.mean() < 0.7
    assert SPACE.plausibility(0.5 * (LOW + HIGH) + 0.49 * (HIGH - LOW)) == 0.0
    assert SPACE.plausibility(HIGH + 1.0) == 0.0


def test_density_knows_its_slope():
    density = SPACE.density
    z = INNER[3]
    _, slope = density.slope(z)
    step = 1e-5
    for i in range(len(z)):
        away = np.eye(len(z))[i] * step
        numeric = (density.log(z + away) - density.log(z - away)) / (2.0 * step)
        assert slope[i] == pytest.approx(numeric, rel=1e-4, abs=1e-4)


def test_scores_are_read_off_few_cells_as_off_tables():
    """Descriptors had of coordinates are those of the decoded table, but for a little."""
    names = SPACE.optics.grades.names
    for z in LIBRARY.coordinates[::190]:
        z = np.clip(z, LOW, HIGH)
        table = descriptors(EMBEDDING.decode(z))
        whole = SPACE.optics.grades.of(np.array([table[n] for n in DESCRIPTORS]))
        few = SPACE.grades(z)
        assert np.median(np.abs(few - whole)) < 0.05, dict(zip(names, few - whole, strict=True))


def test_related_traits_are_those_that_members_have_together():
    # matte reads gloss at 20 degrees as well: no longer the exact contrary
    assert SPACE.related[SPACE.index("matte"), SPACE.index("glossy")] < -0.999
    assert SPACE.related[SPACE.index("hard"), SPACE.index("sharpness")] > 0.9
    assert abs(SPACE.related[SPACE.index("red"), SPACE.index("glossy")]) < 0.2
    np.testing.assert_allclose(SPACE.related, SPACE.related.T, atol=1e-12)


# -- explanations ----------------------------------------------------------------------------------


def test_an_explanation_says_what_changed():
    z = LIBRARY.coordinates[LIBRARY.index("red-rubber")]
    found = SPACE.reach(z, {"shiny": 0.5})
    told = SPACE.explain(z, found.z)
    before, after = told.traits["shiny"]
    assert after - before == pytest.approx(found.reached["shiny"], abs=1e-9)
    assert after - before > 0.48
    assert told.descriptors["gloss_60"][1] > told.descriptors["gloss_60"][0]
    text = str(told)
    assert text.startswith("traits: ")
    changes = {name: after - before for name, (before, after) in told.traits.items()}
    most = max(changes, key=lambda name: abs(changes[name]))
    assert f"{most} {changes[most]:+.2f}" in text
    assert "gloss at 60 degrees" in text
    assert "diffuse hue" in text
    picture = told.picture(size=32)
    assert picture.dtype == np.uint8
    assert picture.shape[1] > 64
    left, right = picture[-32:, -64:-32], picture[-32:, -32:]
    assert np.abs(left.astype(int) - right).max() > 20
    assert told._repr_png_()[:4] == b"\x89PNG"
    same = SPACE.explain(z, z)
    assert "none changed" in str(same)


# -- traits of one's own ---------------------------------------------------------------------------


def test_a_trait_is_learnt_from_a_handful_of_labels():
    every = SPACE.scores(LIBRARY.coordinates)[:, SPACE.index("metallic")]
    order = np.argsort(every)
    chosen = np.concatenate([order[:: len(order) // 6][:6], order[::-1][:: len(order) // 6][:6]])
    labels = np.where(every[chosen] > np.median(every), 1, -1)
    names = [LIBRARY.names[i] for i in chosen]
    mine = Trait.from_labels("tinny", names, labels, meaning="like tin")
    space = SPACE.with_trait(mine)
    assert space.names == (*SPACE.names, "tinny")
    assert space.meaning("tinny") == "like tin"
    found = space.scores(LIBRARY.coordinates)[:, -1]
    assert spearman(found, every) > 0.85
    low, high = np.percentile(found, [10.0, 90.0])
    assert (low, high) == pytest.approx((0.0, 1.0), abs=1e-6)
    z = LIBRARY.coordinates[LIBRARY.index("red-rubber")]
    assert space.reach(z, {"tinny": 0.3}).reached["tinny"] == pytest.approx(0.3, abs=2.5e-3)
    again = TraitSpace.from_arrays({**space.arrays(), "low": LOW, "high": HIGH})
    assert again.score(z) == space.score(z)
    replaced = space.with_trait(Trait.from_labels("tinny", names, -labels))
    assert replaced.names == space.names
    assert replaced.score(z)["tinny"] == pytest.approx(1.0 - space.score(z)["tinny"], abs=1e-6)


def test_a_trait_of_one_s_own_leaves_moves_of_others_as_they_are():
    mine = Trait.from_labels("candy", ["blue-plastic", "red-rubber"], [1, -1])
    other = Trait.from_labels("bleak", ["chrome", "red-rubber"], [-1, 1])
    space = SPACE.with_trait(mine).with_trait(other)
    again = TraitSpace.from_arrays({**space.arrays(), "low": LOW, "high": HIGH})
    rng = np.random.default_rng(5)
    for name in SPACE.names:
        z = LIBRARY.coordinates[rng.integers(len(LIBRARY))]
        amount = rng.uniform(-0.5, 0.5)
        expected = SPACE.move(z, {name: amount})
        np.testing.assert_array_equal(space.move(z, {name: amount}), expected)
        np.testing.assert_array_equal(again.move(z, {name: amount}), expected)
    with pytest.raises(ValueError, match="unknown trait"):
        SPACE.move(z, {"candy": 0.1})


def test_a_trait_is_learnt_from_ratings_of_tables_and_coordinates():
    some = LIBRARY.coordinates[::400]
    ratings = SPACE.scores(some)[:, SPACE.index("bright")]
    mine = Trait.from_ratings("airy", [*some[:-1], LIBRARY["white-plaster"]], ratings)
    assert np.isfinite(mine.weights).all()
    assert mine.typical[1] > mine.typical[0]


def test_the_next_material_to_label_is_one_unlike_the_known():
    known = ["blue-plastic", "red-rubber"]
    candidates = ["blue-plastic", "gold-polished", "red-rubber"]
    assert suggest(known, candidates) == 1
    assert suggest([], candidates) in range(3)
    with pytest.raises(ValueError, match="candidates"):
        suggest(known, [])


@pytest.mark.parametrize(
    ("materials", "labels", "match"),
    [
        (["chrome", "red-rubber"], [1, 1], "with and without"),
        (["chrome", "red-rubber"], [0, 0], "with and without"),
        (["chrome", "red-rubber"], [1], "expected .2,."),
        (["chrome", "red-rubber"], [1, 2], "-1, 0 or 1"),
        (["chrome", "red-rubber", "chrome"], [1, -1, -1], "labelled both ways"),
        (["crome", "red-rubber"], [1, -1], "unknown material 'crome'"),
        ([], [], "at least one"),
    ],
)
def test_bad_labels_of_a_trait(materials, labels, match):
    with pytest.raises(ValueError, match=match):
        Trait.from_labels("x", materials, labels)


@pytest.mark.parametrize(
    ("ratings", "match"),
    [([1.0, 1.0], "all the same"), ([1.0, math.nan], "finite"), ([1.0], "expected .2,.")],
)
def test_bad_ratings(ratings, match):
    with pytest.raises(ValueError, match=match):
        Trait.from_ratings("x", ["chrome", "red-rubber"], ratings)


def test_a_trait_is_moved_once():
    with pytest.raises(ValueError, match="'glossy' twice"):
        SPACE.move(INNER[0], {"glossy": 0.3, "glossiness": 0.2})


def test_everyday_names_cannot_be_taken():
    mine = Trait.from_labels("glossiness", ["chrome", "red-rubber"], [1, -1])
    with pytest.raises(ValueError, match="everyday name of 'glossy'"):
        SPACE.with_trait(mine)


def test_straight_traits_alone_learn_nothing():
    space = straight_space("a", np.eye(24)[:1], SPACE.box)
    with pytest.raises(ValueError, match="reads descriptors"):
        Trait.from_labels("x", ["chrome", "red-rubber"], [1, -1], space)


# -- people ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_traits_agree_with_people(shared_data):
    """On 42 real materials, of whose ratings nothing that is measured here knows."""
    names, z, ratings = rated_materials(shared_data)
    assert len(names) == 42
    every = SPACE.scores(z)
    found = {
        name: spearman(every[:, SPACE.index(name)], ratings[column])
        for name, (column, floor) in RATINGS.items()
        if floor is not None
    }
    for name, value in found.items():
        assert round(value, 2) >= RATINGS[name][1], found
