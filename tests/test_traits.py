"""Traits: a move does what was asked, keeps what is held, and stays in the gamut."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from traitbrdf.brdf import TabulatedBRDF
from traitbrdf.embedding import GRID, default_embedding, default_library
from traitbrdf.traits import GROUPS, TraitSpace, default_traits

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
holds = st.sampled_from([(), ("colour",), ("bright",), ("rough", "red"), ("colour", "bright")])
laws = settings(deadline=None, max_examples=60)


def scores(z):
    return np.array(list(SPACE.score(z).values()))


def at_a_wall(z):
    return bool(np.any((z <= LOW + 1e-9) | (z >= HIGH - 1e-9)))


def held_by(name, hold):
    """Whether `name` is among what is held."""
    return any(name in GROUPS.get(group, (group,)) for group in hold)


@laws
@given(members, names, amounts, holds)
def test_a_move_changes_its_score_by_the_amount_and_no_held_one(z, name, amount, hold):
    if held_by(name, hold):
        return
    moved = SPACE.move(z, {name: amount}, hold)
    assert np.all((moved >= LOW) & (moved <= HIGH))
    change = dict(zip(SPACE.names, scores(moved) - scores(z), strict=True))
    if not at_a_wall(moved):
        assert change[name] == pytest.approx(amount, abs=1e-6)
    # at a wall less is reached than asked, but never more, nor the contrary
    assert -1e-6 <= change[name] * np.sign(amount) <= abs(amount) + 1e-6
    for group in hold:
        for member in GROUPS.get(group, (group,)):
            assert abs(change[member]) < 1e-6


@laws
@given(members, names, st.lists(amounts, min_size=2, max_size=5), holds)
def test_scores_are_monotone_in_the_amount(z, name, several, hold):
    if held_by(name, hold):
        return
    several = sorted(several)
    reached = [SPACE.score(SPACE.move(z, {name: a}, hold))[name] for a in several]
    assert np.all(np.diff(reached) >= -1e-6)


@laws
@given(members, st.lists(amounts, min_size=3, max_size=3))
def test_several_traits_move_at_once(z, three):
    asked = dict(zip(("shiny", "bright", "red"), three, strict=True))
    moved = SPACE.move(z, asked)
    change = {name: SPACE.score(moved)[name] - SPACE.score(z)[name] for name in asked}
    if not at_a_wall(moved):
        for name, amount in asked.items():
            assert change[name] == pytest.approx(amount, abs=1e-6)


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
def test_small_moves_within_the_box_can_be_taken_back(name, amount, i):
    there = SPACE.move(INNER[i], {name: amount})
    if not at_a_wall(there):
        np.testing.assert_allclose(SPACE.move(there, {name: -amount}), INNER[i], atol=1e-9)


@laws
@given(members, names, amounts)
def test_a_move_in_two_steps_is_the_move_in_one(z, name, amount):
    whole = SPACE.move(z, {name: amount})
    halves = SPACE.move(SPACE.move(z, {name: 0.5 * amount}), {name: 0.5 * amount})
    if not at_a_wall(whole):
        np.testing.assert_allclose(halves, whole, atol=1e-9)


@pytest.mark.parametrize("amount", [1e-300, 1e-9, 1e3, 1e9, 1e300, -1e300])
def test_extreme_amounts_stay_in_the_box(amount):
    for name in SPACE.names:
        moved = SPACE.move(INNER[0], {name: amount}, () if name in GROUPS["colour"] else "colour")
        assert np.all((moved >= LOW) & (moved <= HIGH))
        if abs(amount) >= 1e3:
            assert at_a_wall(moved)
            assert (SPACE.score(moved)[name] - SPACE.score(INNER[0])[name]) * amount > 0.0


def test_start_points_outside_the_box_end_inside():
    moved = SPACE.move(HIGH + 1.0, {"shiny": 0.1})
    assert np.all((moved >= LOW) & (moved <= HIGH))


@pytest.mark.parametrize("name", SPACE.names)
def test_half_a_unit_is_reached_from_nearly_everywhere(name):
    shares = []
    for z in LIBRARY.coordinates[::2]:
        z = np.clip(z, LOW, HIGH)
        shares.append((SPACE.score(SPACE.move(z, {name: 0.5}))[name] - SPACE.score(z)[name]) / 0.5)
    assert np.mean(np.array(shares) >= 0.9) >= 0.9


def test_scores_are_zero_and_one_at_the_library_s_percentiles():
    all_scores = np.array([scores(z) for z in LIBRARY.coordinates])
    low, high = np.percentile(all_scores, [10.0, 90.0], axis=0)
    np.testing.assert_allclose(low, 0.0, atol=1e-3)
    np.testing.assert_allclose(high, 1.0, atol=1e-3)


def test_the_nine_traits_mean_what_they_say():
    assert set(SPACE.names) == {
        "shiny", "matte", "metallic", "plastic", "rough", "bright", "red", "green", "blue",
    }  # fmt: skip
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
        assert (entry["shiny"] > 0.5) == (entry["matte"] < 0.5)


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


# -- errors -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asked", "hold", "error", "match"),
    [
        ({"shinny": 0.5}, (), ValueError, "unknown trait 'shinny'.*'shiny'"),
        ({"shiny": 0.5}, ("colours",), ValueError, "unknown trait 'colours'"),
        ({"shiny": 0.5}, ("metalic",), ValueError, "'metallic'"),
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


@pytest.mark.parametrize(
    ("asked", "hold"), [({"a": 0.5}, ("c",)), ({"a": 0.5, "c": 0.5}, ()), ({"a": 1.0}, ("d", "b"))]
)
def test_holds_that_forbid_the_move(asked, hold):
    """c is the contrary of a, and d is a + b: neither can stay alone."""
    normals = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 1.0, 0.0]]
    space = TraitSpace(
        "abcd", normals, [[0.0, 1.0]] * 4, np.eye(3), np.full(3, -2.0), np.full(3, 2.0)
    )
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
    return TraitSpace.fit(z, labels, np.full(3, -5.0), np.full(3, 5.0), families)


def test_a_fit_finds_the_axis_that_separates():
    z = np.random.default_rng(0).normal(size=(200, 3))
    label = np.sign(z[:, 1]) * (np.abs(z[:, 1]) > 0.3)
    space = fit({"second": label}, z)
    axis = space.normals[0] / np.linalg.norm(space.normals[0])
    assert axis[1] > 0.98
    moved = space.move(np.zeros(3), {"second": 1.0})
    assert space.score(moved)["second"] - space.score(np.zeros(3))["second"] == pytest.approx(1.0)


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
    with pytest.raises(ValueError, match="covariance"):
        TraitSpace(["x"], good.normals, good.typical, np.eye(4), good.low, good.high)
    with pytest.raises(ValueError, match="normals"):
        TraitSpace(["x", "y"], good.normals, good.typical, good.covariance, good.low, good.high)
    with pytest.raises(ValueError, match="percentile"):
        TraitSpace(["x"], good.normals, [[1.0, 1.0]], good.covariance, good.low, good.high)


def test_a_table_decides_its_scores():
    """Two names for one table score alike: nothing but the table is looked at."""
    table = LIBRARY["chrome"]
    other = TabulatedBRDF(GRID, table.values.copy(), name="white-paper")
    assert SPACE.score(EMBEDDING.encode(other)) == SPACE.score(EMBEDDING.encode(table))
