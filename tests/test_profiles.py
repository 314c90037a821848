"""Profiles of log f along theta_h: holes and spikes are removed, all else stays."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from traitbrdf.bench.metrics import highlight_hole
from traitbrdf.reflectance.brdf import HalfDiffGrid, TabulatedBRDF
from traitbrdf.reflectance.models import GGX, Coated, Lambert, OrenNayar, Sheen
from traitbrdf.space.highlights import HIGHLIGHT, Profiles
from traitbrdf.space.library import default_embedding
from traitbrdf.space.logmap import FLOOR

GRID = HalfDiffGrid(24, 8, 4)
MEMBERS = [
    Lambert(0.5),
    OrenNayar(0.4, 0.8),
    GGX(0.02, (0.2, 0.4, 1.4), (3.4, 2.3, 1.8)),
    GGX(0.3, 1.5),
    Coated(Lambert((0.3, 0.1, 0.02)), alpha=0.1),
    Coated(OrenNayar(0.2, 0.5), alpha=0.5),
    0.4 * Lambert(0.5) + 0.6 * Sheen((0.5, 0.3, 0.2), 0.4),
]
TALL = GRID.theta_d < math.radians(80.0)


def logs_of(model):
    table = TabulatedBRDF.from_model(model, GRID)
    return np.log(table.values.reshape(-1, 3).T + np.float32(FLOOR))


LIBRARY = np.stack([logs_of(model) for model in MEMBERS])
PROFILES = Profiles.of(lambda: iter([LIBRARY[:3], LIBRARY[3:]]), GRID)
few = settings(deadline=None, max_examples=25)
seeds = st.integers(0, 2**32 - 1)


def fields(logs):
    return np.asarray(logs).reshape(3, GRID.n_theta_h, GRID.n_theta_d, GRID.n_phi_d)


def garbage(seed, size=3.0):
    """A member of the library with noise."""
    rng = np.random.default_rng(seed)
    return (LIBRARY[rng.integers(len(LIBRARY))] + size * rng.normal(size=(3, GRID.size))).astype(
        np.float32
    )


@pytest.mark.parametrize("i", range(len(MEMBERS)), ids=repr)
def test_members_change_by_their_valleys_alone(i):
    """Values outside valleys of the highlight stay as they are."""
    kept, before = fields(PROFILES.keep(LIBRARY[i])), fields(LIBRARY[i])
    assert np.all(kept >= before - 1e-5)
    changed = np.abs(kept - before) > 1e-5
    nodes = GRID.theta_h > HIGHLIGHT
    assert not changed[:, nodes].any()
    shown = changed & (GRID.lower_cosine > math.cos(math.radians(75.0)))
    assert np.abs(kept - before)[shown].max(initial=0.0) < 0.1


@few
@given(seeds)
def test_no_hole_in_any_highlight(seed):
    """Up to 30 degrees, a profile that falls does not rise again."""
    kept = fields(PROFILES.keep(garbage(seed)))
    inner = PROFILES.inner.reshape(GRID.n_theta_d, GRID.n_phi_d)
    assert inner[TALL].any()
    for j, p in np.argwhere(inner > 2):
        head = kept[:, : inner[j, p], j, p]
        before = np.maximum.accumulate(head, axis=1)
        after = np.maximum.accumulate(head[:, ::-1], axis=1)[:, ::-1]
        rims = np.minimum(before, after)
        np.testing.assert_array_equal(head, rims)
    values = np.maximum(np.exp(np.minimum(kept, 30.0)) - FLOOR, 0.0).reshape(3, -1).T
    assert highlight_hole(GRID, values) <= 1e-6


@few
@given(seeds)
def test_nothing_rises_beyond_the_library(seed):
    kept = PROFILES.keep(garbage(seed)).reshape(3, GRID.n_theta_h, -1)
    last = PROFILES.last
    x = garbage(seed).reshape(kept.shape)
    first = x[:, : PROFILES.core].max(axis=1)
    trend = np.maximum(x[:, last, np.arange(len(last))] - first, 0.0)[:, None]
    rise = kept - np.minimum.accumulate(kept, axis=1)
    assert np.all(rise <= PROFILES.share * trend + PROFILES.grazing + 1e-4)


@few
@given(seeds, st.floats(0.1, 5.0))
def test_a_falling_profile_stays_as_it_is(seed, scale):
    steps = np.random.default_rng(seed).exponential(scale, (3, GRID.n_theta_h, GRID.size // 24))
    falling = -np.cumsum(steps, axis=1).astype(np.float32).reshape(3, -1)
    np.testing.assert_array_equal(PROFILES.keep(falling), falling)


def test_holes_are_filled_and_spikes_cut():
    plain = fields(LIBRARY[4]).copy()
    hole, spike = plain.copy(), plain.copy()
    hole[:, 2, :4] -= 3.0
    filled = fields(PROFILES.keep(hole.reshape(3, -1)))[:, 2, :4]
    np.testing.assert_allclose(filled, plain[:, 3, :4], atol=0.02)  # its lower rim
    spike[:, 18, 2] += 8.0
    kept = fields(PROFILES.keep(spike.reshape(3, -1)))
    assert np.all(kept[:, 18, 2] < spike[:, 18, 2] - 2.0)
    np.testing.assert_array_equal(kept[:, :18], fields(PROFILES.keep(plain.reshape(3, -1)))[:, :18])


@few
@given(seeds)
def test_sources_and_tensors_say_the_same(seed):
    logs = garbage(seed, 1.0).astype(np.float64)
    kept, cells, extra, first = PROFILES.sources(logs)
    assert np.all(first < PROFILES.core * (GRID.size // GRID.n_theta_h))
    assert np.all(cells % (GRID.size // GRID.n_theta_h) == np.arange(GRID.size) % (GRID.size // 24))
    point = torch.tensor(logs, requires_grad=True)
    tensor = PROFILES.keep(point)
    np.testing.assert_allclose(tensor.detach().numpy(), kept, rtol=1e-12, atol=1e-12)
    # the derivative along a random direction agrees with a finite difference
    rng = np.random.default_rng(seed)
    along = rng.normal(size=logs.shape)
    weight = rng.normal(size=logs.shape)
    (tensor * torch.tensor(weight)).sum().backward()
    step = 1e-7
    after, before = (PROFILES.keep(logs + s * step * along) for s in (1.0, -1.0))
    expected = float(np.sum(weight * (after - before)) / (2.0 * step))
    assert float(np.sum(point.grad.numpy() * along)) == pytest.approx(expected, rel=1e-4, abs=1e-3)
    assert extra.shape == logs.shape


def test_the_shipped_library_may_rise_where_velvets_do():
    own = default_embedding().profiles_
    assert own.share.shape == own.grazing.shape
    assert np.all((own.share >= 0.0) & (own.share <= 1.701))
    assert own.share[: own.core, own.last >= own.core].max() <= 0.701
    assert np.all(np.diff(own.share, axis=0) >= 0.0)
    assert np.all(np.diff(own.grazing, axis=0) >= -1e-3)
    assert own.grazing[:40].max() < own.grazing[-1].max()


def test_a_dark_point_in_the_middle_is_no_velvet():
    """A dip at theta_h = 0 is filled: a rise counts from the maximum of the first 10 degrees."""
    spoilt = fields(LIBRARY[1]).copy()
    nodes = GRID.theta_h < math.radians(4.0)
    assert nodes.sum() >= 3
    spoilt[:, nodes] -= 3.0
    kept = fields(PROFILES.keep(spoilt.reshape(3, -1)))
    near = GRID.theta_d < math.radians(60.0)
    assert np.abs(kept - fields(LIBRARY[1]))[:, nodes][..., near, :].max() < 0.3


def test_a_measure_of_holes_finds_one():
    values = np.maximum(np.exp(LIBRARY[3].T) - FLOOR, 0.0)
    assert highlight_hole(GRID, values) < 0.02
    spoilt = values.reshape(*GRID.shape, 3).copy()
    spoilt[3, :3] *= 0.7
    assert highlight_hole(GRID, spoilt.reshape(-1, 3)) > 0.2
