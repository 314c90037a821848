"""Pictures of every brush."""

from __future__ import annotations

import numpy as np
import pytest

import traitbrdf as tb
from traitbrdf.design.effects import KINDS
from traitbrdf.session.gallery import EXAMPLES, brushes


def test_every_effect_has_an_example():
    assert len({example.title for example in EXAMPLES}) == len(EXAMPLES)
    shown = " ".join(example.title for example in EXAMPLES)
    for word in ("trait", "material", "tint", "colour", "highlight", "parameters"):
        assert word in shown
    assert {"Assign", "Move", "Tint", "Colour", "Highlight", "Parameters"} == KINDS.keys()


@pytest.mark.slow
def test_each_example_changes_both_objects():
    size = 48
    picture = brushes(size, tb.EnvironmentMap.sky(rows=32))
    halves = -(-len(EXAMPLES) // 2)
    tall = picture.shape[0] // halves
    wide = picture.shape[1] // 2
    for place, example in enumerate(EXAMPLES):
        across, down = divmod(place, halves)
        row = picture[down * tall :, across * wide :].astype(int)
        tiles = [row[:size, i * size : (i + 1) * size] for i in range(4)]
        for before, after in (tiles[:2], tiles[2:]):
            assert np.abs(before - after).max() > 8, example.title
