"""Traits: what each means, and labels of library members from descriptors of their tables.

Labels never use the parameters of the recipes, and never ratings: the look of a table decides, so
that a measured material would get the same label. A descriptor is graded by how common its value is
among the members (`traitbrdf.space.scores.Grades`), which makes different units comparable; a
trait's value is a weighted sum of grades. Names are the 16 of Matusik et al. 2003, the 14 of
Serrano et al. 2016, and "shiny".
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

SHARE = 1.0 / 3.0
"""Members in the upper third of a trait's values have it, those in the lower third do not."""


class Definition(NamedTuple):
    """A trait: its meaning in one line, everyday names, and weights of graded descriptors.

    A descriptor with a negative weight speaks against the trait.

    Parameters
    ----------
    meaning : str
    synonyms : tuple of str
    weights : mapping of float, by descriptor
    """

    meaning: str
    synonyms: tuple[str, ...]
    weights: Mapping[str, float]


_METAL = {"highlight": 0.4, "reflection": 0.3, "specular": 0.3}

TRAITS: Mapping[str, Definition] = MappingProxyType(
    {
        "shiny": Definition(
            "bright, clear highlights",
            ("lustrous", "polished"),
            {"highlight": 0.5, "gloss_60": 0.5},
        ),
        "glossy": Definition(
            "highlights that stand out from what lies below",
            ("glossiness", "gloss"),
            {"highlight": 1.0},
        ),
        "matte": Definition(
            "no highlight stands out", ("flat", "dull"), {"highlight": -0.8, "gloss_20": -0.2}
        ),
        "strength": Definition(
            "how strong reflections are",
            ("reflective", "refstrng"),
            {"highlight": 0.7, "specular": 0.3},
        ),
        "sharpness": Definition(
            "how sharply surroundings are mirrored",
            ("sharp", "refsharp"),
            {"highlight": 0.5, "width": -0.5},
        ),
        "tint": Definition(
            "colour of the reflections", ("tinted", "reftint"), {"tint": 0.8, "highlight": 0.2}
        ),
        "specular": Definition(
            "how much light leaves as reflection", ("specularness",), {"specular": 1.0}
        ),
        "diffuse": Definition(
            "how much light leaves scattered from the body", ("diffuseness",), {"diffuse": 1.0}
        ),
        "metallic": Definition(
            "all light leaves as a strong reflection", ("metal", "metallic-like"), _METAL
        ),
        "silver": Definition(
            "a light, colourless metal",
            ("silvery", "silverness"),
            {"highlight": 0.3, "reflection": 0.3, "chroma": -0.2, "lightness": 0.2},
        ),
        "gold": Definition(
            "a metal of the colour of gold",
            ("golden", "gold-like"),
            {"highlight": 0.3, "reflection": 0.3, "lightness": 0.1, "gold": 0.3},
        ),
        "plastic": Definition(
            "a clear colourless highlight over a body",
            ("plastic-like",),
            {"highlight": 0.42, "reflection": -0.24, "fresnel": 0.17, "tint": -0.17},
        ),
        "acrylic": Definition(
            "a sharp colourless highlight over a saturated body",
            ("acrylic-like", "lacquered"),
            {"width": -0.35, "chroma": 0.35, "tint": -0.3},
        ),
        "ceramic": Definition(
            "a sharp colourless highlight over a light body",
            ("porcelain", "glazed"),
            {"width": -0.35, "diffuse": 0.35, "tint": -0.3},
        ),
        "rubber": Definition(
            "a dull surface that mirrors nothing",
            ("rubbery", "rubber-like"),
            {"highlight": -0.7, "flat": 0.3},
        ),
        "fabric": Definition(
            "no highlight, and light edges",
            ("cloth", "fabric-like"),
            {"highlight": -0.6, "flat": 0.25, "sheen": 0.15},
        ),
        "soft": Definition(
            "looks soft to the touch: hardly a highlight, light edges",
            (),
            {"highlight": -0.6, "flat": 0.2, "diffuse": 0.2},
        ),
        "hard": Definition(
            "looks hard to the touch: strong, narrow highlights",
            ("solid",),
            {"highlight": 0.7, "width": -0.3},
        ),
        "rough": Definition(
            "wide, weak highlights",
            ("roughness", "coarse"),
            {"highlight": -0.4, "width": 0.3, "flat": 0.3},
        ),
        "greasy": Definition(
            "strong highlights with a haze around them",
            ("oily", "greasiness"),
            {"highlight": 0.5, "haze": 0.5},
        ),
        "dusty": Definition(
            "dull and pale, with light edges",
            ("dustiness", "powdery"),
            {"highlight": -0.35, "sheen": 0.15, "chroma": -0.25, "lightness": 0.25},
        ),
        "bright": Definition("how light it is", ("light", "brightness"), {"lightness": 1.0}),
        "red": Definition("more red than the other colours", ("redness",), {"red": 1.0}),
        "green": Definition("more green than the other colours", ("greenness",), {"green": 1.0}),
        "blue": Definition("more blue than the other colours", ("blueness",), {"blue": 1.0}),
    }
)
"""Every trait that the package ships."""


def grading() -> tuple[tuple[str, ...], Float64]:
    """Return the descriptors that traits use, and their weights.

    Returns
    -------
    names : tuple of d str
    weights : (traits, d) float64
    """
    names = tuple(dict.fromkeys(name for d in TRAITS.values() for name in d.weights))
    weights = np.array([[d.weights.get(name, 0.0) for name in names] for d in TRAITS.values()])
    return names, weights


def labels(values: Float64) -> NDArray[np.int8]:
    """Label members: 1 (yes) in the upper third, -1 (no) in the lower third, 0 (unclear) between.

    Parameters
    ----------
    values : (n,) float64
        Values of one trait.

    Returns
    -------
    (n,) int8
    """
    low, high = np.quantile(values, [SHARE, 1.0 - SHARE])
    return np.asarray((values >= high).astype(np.int8) - (values <= low).astype(np.int8))
