"""Search of a library by words and traits: "metallic > .7, not shiny, reddish"."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from traitbrdf.arguments import told
from traitbrdf.formats.files import unknown_name
from traitbrdf.space.library import Library, default_library
from traitbrdf.space.traits import TraitSpace, default_traits

_HIGH = 0.7
"""Score from which a material has a trait that is only named."""
_LIKE = {
    "reddish": "red", "greenish": "green", "bluish": "blue", "blueish": "blue",
    "golden": "gold", "silvery": "silver", "old": "dusty", "aged": "dusty", "worn": "dusty",
}  # fmt: skip
_TERM = re.compile(
    r"(?P<not>not\s+|no\s+|-)?(?P<words>[^<>=]+?)\s*"
    r"(?:(?P<sign><=?|>=?)\s*(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)))?"
)


class _Found(NamedTuple):
    """Which materials (n,) bool a term allows, and how well (n,) they fit it."""

    allowed: NDArray[np.bool_]
    fit: NDArray[np.float64]


def find_materials(
    query: str, library: Library | None = None, traits: TraitSpace | None = None
) -> list[str]:
    """Return the names of the materials that a query describes, the best ones first.

    Terms are separated by commas, and all of them hold. A term is a trait and a bound of its score
    ("shiny > .7"), or words ("old brass"), of which each begins a word of the name, or is a trait
    or its everyday name whose score is above 0.7. "not" turns a term round.

    Parameters
    ----------
    query : str
        Of nothing but spaces, it describes all materials.
    library : Library, optional
        The default one if left out.
    traits : TraitSpace, optional
        The default one if left out.

    Returns
    -------
    list of str

    Raises
    ------
    TypeError
        If the query is no text.
    ValueError
        If a term is no term, or a bound is that of no trait; the message names the nearest ones.

    Examples
    --------
    >>> from traitbrdf import find_materials
    >>> find_materials("glossy red plastic")[:1]
    ['glossy-red-acrylic-52']
    """
    if not isinstance(query, str):
        raise TypeError(f"query: expected words, got {told(query)}")
    library = default_library() if library is None else library
    traits = default_traits() if traits is None else traits
    scores = traits.scores(library.coordinates)
    names = [f"-{name}".lower() for name in library.names]
    allowed = np.ones(len(names), bool)
    fit = np.zeros(len(names))
    for term in filter(None, (one.strip().lower() for one in query.split(","))):
        found = _found(term, names, scores, traits)
        allowed &= found.allowed
        fit += found.fit
    order = np.argsort(-fit, kind="stable")
    return [library.names[i] for i in order if allowed[i]]


def _found(term: str, names: list[str], scores: NDArray[np.float64], traits: TraitSpace) -> _Found:
    parsed = _TERM.fullmatch(term)
    if parsed is None:
        raise ValueError(
            f"query: expected terms like 'shiny > .7', 'not dusty' or 'brass', got {term!r}"
        )
    words, turned = parsed["words"].split(), parsed["not"] is not None
    if parsed["sign"]:
        name = " ".join(words)
        score = _score(name, scores, traits)
        if score is None:
            raise ValueError(f"query: {unknown_name('trait', name, traits.names)}")
        bound, above = float(parsed["number"]), parsed["sign"][0] == ">"
        held = score > bound if above else score < bound
        if parsed["sign"].endswith("="):
            held |= score == bound
        fit = score if above else -score
    else:
        held, fit = np.ones(len(names), bool), np.zeros(len(names))
        for word in words:
            begun = np.array([f"-{word}" in name for name in names])
            score = _score(word, scores, traits)
            held &= begun if score is None else begun | (score > _HIGH)
            fit = fit + begun + (0.0 if score is None else score)
    return _Found(held != turned, -fit if turned else fit)


def _score(
    word: str, scores: NDArray[np.float64], traits: TraitSpace
) -> NDArray[np.float64] | None:
    """Return the scores (n,) of the trait that a word names, or None."""
    try:
        return np.asarray(scores[:, traits.index(_LIKE.get(word, word))])
    except ValueError:
        return None
