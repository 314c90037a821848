"""Search of the library by words and traits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import traitbrdf as tb

LIBRARY, TRAITS = tb.default_library(), tb.default_traits()
SCORES = TRAITS.scores(LIBRARY.coordinates)


def scores_of(names, trait):
    rows = [LIBRARY.index(name) for name in names]
    return SCORES[rows, TRAITS.index(trait)]


@given(st.sampled_from(TRAITS.names), st.floats(-0.5, 1.5), st.sampled_from(["<", ">", "<=", ">="]))
def test_bounds_of_traits(trait, bound, sign):
    found = tb.find_materials(f"{trait} {sign} {bound:.3f}")
    scores = scores_of(found, trait)
    bound = float(f"{bound:.3f}")
    assert {">": scores > bound, "<": scores < bound,
            ">=": scores >= bound, "<=": scores <= bound}[sign].all()  # fmt: skip
    # the best ones first, and the others are all that is left
    assert (np.diff(scores if ">" in sign else -scores) <= 1e-9).all()
    other = tb.find_materials(f"not {trait} {sign} {bound:.3f}")
    assert sorted(found + other) == sorted(LIBRARY.names)


def test_terms_hold_together():
    found = tb.find_materials("metallic > .7, not shiny, reddish")
    assert len(found) > 5
    assert scores_of(found, "metallic").min() > 0.7
    assert scores_of(found, "shiny").max() <= 0.7
    assert scores_of(found, "red").min() > 0.7
    assert set(found) <= set(tb.find_materials("reddish"))


def test_words_begin_words_of_names():
    assert set(tb.find_materials("brass")) == {n for n in LIBRARY.names if "-brass" in f"-{n}"}
    assert tb.find_materials("velv")
    assert not tb.find_materials("elvet")
    old = tb.find_materials("old brass")
    assert old
    assert all("brass" in name for name in old)
    assert scores_of(old, "dusty").min() > 0.7
    assert tb.find_materials("blue-plastic")[0] == "blue-plastic"


@pytest.mark.parametrize("query", ["", "  ", ",", " , ,"])
def test_nothing_describes_everything(query):
    assert tb.find_materials(query) == list(LIBRARY.names)


def test_unknown_words_find_nothing():
    assert tb.find_materials("zzz") == []
    assert len(tb.find_materials("not zzz")) == len(LIBRARY.names)


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("shinny > .5", "did you mean 'shiny'"), ("shiny > high", "expected terms like"),
        ("> .5", "expected terms like"), ("shiny >", "expected terms like"),
        ("shiny > .5 > .3", "expected terms like"), ("old brass > .5", "unknown trait 'old brass'"),
    ],
)  # fmt: skip
def test_bad_terms_are_named(query, said):
    with pytest.raises(ValueError, match=said):
        tb.find_materials(query)


def test_queries_are_text():
    with pytest.raises(TypeError, match="query: expected words"):
        tb.find_materials(7)


@given(st.text(max_size=40))
def test_any_text_is_answered_or_named(query):
    try:
        found = tb.find_materials(query)
    except ValueError as error:
        assert "query" in str(error)
    else:
        assert set(found) <= set(LIBRARY.names)
