"""Laws that moves of traits keep, on small samples of what ``traitbrdf bench traits`` measures.

All is read off decoded tables. Targets are the bench's, but where so few moves cannot show them.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from traitbrdf.bench.people import spearman
from traitbrdf.bench.traits import (
    AMOUNTS,
    FALL,
    LIGHTER,
    REACHED,
    STARTS,
    TURN,
    Composed,
    Made,
    Sweep,
    colours,
    composed,
    composites,
    difference,
    held_change,
    joined,
    jumps,
    made,
    read_tables,
    rendered_steps,
    scores_read,
    starting,
    sweep,
    unrelated_change,
)
from traitbrdf.reflectance.descriptors import read
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.space.holding import COLOURS, LIGHT
from traitbrdf.space.library import default_library
from traitbrdf.space.traits import default_traits

SPACE = default_traits()
PLAIN = [name for name in SPACE.names if name not in COLOURS]
SWEPT = ("shiny", "metallic", "diffuse", "plastic", "rough", "dusty")
"""Traits of the highlight, of what a thing is made of, of its body and of its surface."""


@pytest.fixture(scope="module")
def swept() -> list[Sweep]:
    return [sweep(start, trait) for start in starting(6) for trait in SWEPT]


@pytest.fixture(scope="module")
def in_a_row() -> Composed:
    parts = [composed(seed, 25) for seed in range(3)]
    return Composed(
        np.concatenate([part.added for part in parts]),
        np.concatenate([part.undone for part in parts]),
        sum(part.tried for part in parts),
    )


@pytest.fixture(scope="module")
def half() -> Made:
    return joined(made(start, PLAIN, (-0.5, 0.5)) for start in STARTS)


# -- how it is measured ----------------------------------------------------------------------------


def test_a_jump_is_made_at_once():
    slow = np.full(40, 1.0)
    assert not jumps(slow).any()
    leap = slow.copy()
    leap[10] = 9.0
    assert np.flatnonzero(jumps(leap)).tolist() == [10]
    at_the_end = slow.copy()
    at_the_end[-1] = 9.0
    assert np.flatnonzero(jumps(at_the_end)).tolist() == [39]
    # fast for a while, fast everywhere, and small
    assert not jumps(slow + 9.0 * np.exp(-0.5 * (np.arange(40) - 20.0) ** 2 / 9.0)).any()
    assert not jumps(9.0 * slow).any()
    assert not jumps(0.5 * leap).any()
    # a sweep that stands still but for one step
    still = np.zeros(40)
    still[3] = 8.5
    assert jumps(still).sum() == 1


def test_colours_are_those_of_the_decoded_table():
    library = default_library()
    z = library.coordinates[[library.index(name) for name in STARTS]]
    z = np.clip(z, SPACE.low, SPACE.high)
    readings = read_tables(z[[0, 1, 1, 2, 3, 4]])
    assert np.array_equal(readings[1], readings[2])
    for found, name in zip(readings[[0, 1, 3, 4, 5]], STARTS, strict=True):
        point = np.clip(library.coordinates[library.index(name)], SPACE.low, SPACE.high)
        table = library.embedding.decode(point)
        np.testing.assert_allclose(found, read(table), rtol=1e-6, atol=1e-9)
    white = np.full((1, readings.shape[1], 3), 1.0)
    lab = colours(white)
    np.testing.assert_allclose(lab[0, :3], [[100.0, 0.0, 0.0]] * 3, atol=1e-9)
    body = 116.0 * np.cbrt(math.pi) - 16.0
    np.testing.assert_allclose(lab[0, 3], [body, 0.0, 0.0], atol=1e-9)
    assert difference(lab, lab + np.array([1.0, 2.0, 2.0]))[0] == pytest.approx(3.0)


def test_scores_of_tables_are_those_of_coordinates():
    """But for the error of the few cells that coordinates are read by: their median is small."""
    z = np.clip(default_library().coordinates[::40], SPACE.low, SPACE.high)
    away = np.abs(scores_read(SPACE, z, read_tables(z)) - SPACE.scores(z))
    assert np.median(away) < 0.01


def test_spearman_shares_ties():
    assert spearman(np.array([1.0, 2.0, 2.0, 3.0]), np.array([10.0, 20.0, 20.0, 90.0])) == 1.0
    assert spearman(np.arange(5.0), -(np.arange(5.0) ** 3)) == pytest.approx(-1.0)


def test_starts_are_members_and_the_same_each_time():
    assert starting(3) == list(STARTS[:3])
    many = starting(25)
    assert many[:5] == list(STARTS)
    assert len(set(many)) == 25
    assert many == starting(25)
    assert set(many) <= set(default_library().names)


def test_hues_turn_only_where_there_are_any():
    lab = np.zeros((4, 2, 4, 3))
    lab[0, :, :, 1] = 20.0  # red, and stays so
    lab[1, :, 3, 1] = lab[1, 0, 3, 1] = 20.0  # a body that turns by 90 degrees
    lab[1, 1, 3, 1:] = [0.0, 20.0]
    lab[2, 0, 1, 1], lab[2, 1, 1, 2] = 20.0, 5.0  # pale afterwards
    lab[3, 0, 0, 1], lab[3, 1, 0, 2] = 20.0, 20.0  # at 10 degrees, of which no hue is asked
    scores = np.zeros((4, 2, len(SPACE.names)))
    moves = Made(
        np.zeros(4, np.int64), np.ones(4), np.zeros((4, 2, 24)), lab, scores,
        np.zeros((4, 0), np.int64), ("",) * 4,
    )  # fmt: skip
    np.testing.assert_allclose(moves.turned, [0.0, 90.0, np.nan, np.nan])


# -- the laws --------------------------------------------------------------------------------------


def test_sweeps_are_continuous(swept):
    for one in swept:
        assert len(one.z) == len(AMOUNTS)
        # 36 sweeps: a share of 1 % is none of them
        assert not jumps(one.steps).any(), (one.start, one.trait, one.steps.max())
        assert one.steps.max() <= 20.0, (one.start, one.trait)


def test_pictures_of_a_sweep_are_continuous(swept):
    """Under a sky, and smaller than in the bench: what matters is that nothing pops."""
    sky = EnvironmentMap.sky(rows=32)
    for one in swept[:2]:
        steps = rendered_steps(one.z, sky, 16)
        assert steps.shape == (len(AMOUNTS) - 1,)
        assert not jumps(steps).any()
        assert 0.0 < steps.max() <= 20.0


def test_scores_of_sweeps_rise(swept):
    falls = np.array([one.own_fall for one in swept])
    assert np.mean(falls <= FALL) >= 0.99
    # on tables the few cells that moves read are off by a little where a move hardly goes on
    assert np.mean([one.fall <= 0.1 for one in swept]) >= 0.95
    assert all(one.score[-1] > one.score[0] for one in swept)


def test_two_moves_in_a_row_are_one(in_a_row):
    # the others stopped, or slid along a wall on one of three ways
    assert len(in_a_row.added) >= 0.25 * in_a_row.tried
    assert np.median(in_a_row.added) <= 1.0
    assert np.percentile(in_a_row.added, 95.0) <= 3.0


def test_a_move_back_undoes_a_move(in_a_row):
    assert len(in_a_row.undone) >= 0.3 * in_a_row.tried
    assert np.median(in_a_row.undone) <= 1.0
    assert np.percentile(in_a_row.undone, 95.0) <= 3.0


def test_hues_stay_where_they_are_held(half):
    turned = half.turned[np.isfinite(half.turned)]
    assert len(turned) > 150
    assert np.mean(turned <= TURN) >= 0.98


def test_lightness_stays_where_it_is_held(half):
    still = half.among(name for name in PLAIN if name not in LIGHT)
    assert len(still.trait) == 2 * len(STARTS) * len(set(PLAIN) - LIGHT)
    assert np.mean(np.abs(still.lighter) <= LIGHTER) >= 0.9


def test_moves_reach_what_is_asked_for():
    moves = joined(made(start, SPACE.names, (0.5,), within=True) for start in starting(8))
    shares = [
        np.mean(one.share >= REACHED)
        for name in SPACE.names
        if len((one := moves.among([name])).trait)
    ]
    # no least of a trait here: each has a few moves at most
    assert np.mean(shares) >= 0.8
    assert np.mean(unrelated_change(moves)[moves.complete]) <= 0.15


def test_held_traits_stay():
    moves = joined(made(start, SPACE.names, (0.5,), within=True, held=3) for start in STARTS[:3])
    free = np.array([not why.startswith("held") for why in moves.stopped])
    assert moves.held.shape == (len(moves.trait), 3)
    assert held_change(moves, shown=False)[free].max() <= 0.02


def test_composite_edits_are_physical():
    found = composites(0, 25)
    assert found.least >= 0.0
    assert found.albedo <= 1.001
    assert found.hole <= 0.02


def test_straight_vectors_leap_nowhere_but_turn_hues(half):
    """Those of Matusik et al. 2003: along one direction, whatever it does to colours."""
    swept = [sweep(start, trait, "linear") for start in STARTS[:2] for trait in SWEPT]
    assert not any(jumps(one.steps).any() for one in swept)
    straight = joined(made(start, PLAIN, (-0.5, 0.5), "linear") for start in STARTS[:3])
    turned = straight.turned[np.isfinite(straight.turned)]
    assert np.mean(turned <= TURN) < 0.8
    ours = half.turned[np.isfinite(half.turned)]
    assert np.mean(ours <= TURN) > np.mean(turned <= TURN) + 0.15
