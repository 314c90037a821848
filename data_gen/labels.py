"""Traits: what each means, and labels of library members from descriptors of their tables.

Never from the parameters of the recipes, and never from ratings: what a table looks like decides,
so that a measured material would get the same label. A trait's grade is a mean (or, where it takes
all of several things at once, the least) of ranks of descriptors among the members; ranks make
descriptors of different units comparable. Names are the 16 of Matusik et al. 2003 and the 14 of
Serrano et al. 2016, and "shiny".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Ranks = Mapping[str, Float64]

SHARE = 1.0 / 3.0
"""Members in the upper third of a trait's grade have it, in the lower third have it not."""


class Definition(NamedTuple):
    """A trait: what it means in a line, everyday names, its descriptors, and its grade.

    `grade` gets the rank in [0, 1] of every descriptor among the members.
    """

    meaning: str
    synonyms: tuple[str, ...]
    descriptors: tuple[str, ...]
    grade: Callable[[Ranks], Float64]


def _metallic(r: Ranks) -> Float64:
    return 0.5 * r["highlight"] + 0.5 * r["reflection"]


TRAITS: Mapping[str, Definition] = MappingProxyType(
    {
        "shiny": Definition(
            "bright, clear highlights", ("lustrous", "polished"), ("highlight", "gloss_60"),
            lambda r: 0.5 * r["highlight"] + 0.5 * r["gloss_60"],
        ),
        "glossy": Definition(
            "highlights that stand out from what lies below", ("glossiness", "gloss"),
            ("highlight",), lambda r: r["highlight"],
        ),
        "matte": Definition(
            "no highlight stands out", ("flat", "dull"), ("highlight",),
            lambda r: 1.0 - r["highlight"],
        ),
        "strength": Definition(
            "how strong reflections are", ("reflective", "refstrng"), ("highlight", "specular"),
            lambda r: 0.7 * r["highlight"] + 0.3 * r["specular"],
        ),
        "sharpness": Definition(
            "how sharply surroundings are mirrored", ("sharp", "refsharp", "mirror-like"),
            ("highlight", "width"), lambda r: 0.5 * r["highlight"] + 0.5 * (1.0 - r["width"]),
        ),
        "tint": Definition(
            "colour of the reflections", ("tinted", "reftint"), ("tint",), lambda r: r["tint"],
        ),
        "specular": Definition(
            "how much light leaves as reflection", ("specularness",), ("specular",),
            lambda r: r["specular"],
        ),
        "diffuse": Definition(
            "how much light leaves scattered from the body", ("diffuseness",), ("diffuse",),
            lambda r: r["diffuse"],
        ),
        "metallic": Definition(
            "all light leaves as a strong reflection", ("metal", "metallic-like"),
            ("highlight", "specular", "diffuse"), _metallic,
        ),
        "silver": Definition(
            "a light, colourless metal", ("silvery", "silverness"),
            ("highlight", "specular", "diffuse", "tint", "lightness"),
            lambda r: np.minimum.reduce([_metallic(r), 1.0 - r["tint"], r["lightness"]]),
        ),
        "gold": Definition(
            "a metal of the colour of gold", ("golden", "gold-like"),
            ("highlight", "specular", "diffuse", "gold"),
            lambda r: np.minimum(_metallic(r), r["gold"]),
        ),
        "plastic": Definition(
            "a clear colourless highlight over a body", ("plastic-like",),
            ("highlight", "diffuse", "tint"),
            lambda r: np.minimum.reduce([r["highlight"], r["diffuse"], 1.0 - r["tint"]]),
        ),
        "acrylic": Definition(
            "a sharp colourless highlight over a saturated body", ("acrylic-like", "lacquered"),
            ("width", "diffuse_chroma", "tint"),
            lambda r: np.minimum.reduce([1.0 - r["width"], r["diffuse_chroma"], 1.0 - r["tint"]]),
        ),
        "ceramic": Definition(
            "a sharp colourless highlight over a light body", ("porcelain", "glazed"),
            ("width", "diffuse", "tint"),
            lambda r: np.minimum.reduce([1.0 - r["width"], r["diffuse"], 1.0 - r["tint"]]),
        ),
        "rubber": Definition(
            "a dull dark surface", ("rubbery", "rubber-like"), ("highlight", "lightness"),
            lambda r: 0.8 * (1.0 - r["highlight"]) + 0.2 * (1.0 - r["lightness"]),
        ),
        "fabric": Definition(
            "no highlight, and light edges", ("cloth", "fabric-like"), ("highlight", "sheen"),
            lambda r: 0.7 * (1.0 - r["highlight"]) + 0.3 * r["sheen"],
        ),
        "soft": Definition(
            "looks soft to the touch: hardly a highlight, light edges", (), ("highlight", "sheen"),
            lambda r: 0.8 * (1.0 - r["highlight"]) + 0.2 * r["sheen"],
        ),
        "hard": Definition(
            "looks hard to the touch: strong, narrow highlights", ("solid",),
            ("highlight", "width"), lambda r: 0.7 * r["highlight"] + 0.3 * (1.0 - r["width"]),
        ),
        "rough": Definition(
            "wide, weak highlights", ("roughness", "coarse"), ("highlight", "width"),
            lambda r: 0.5 * (1.0 - r["highlight"]) + 0.5 * r["width"],
        ),
        "greasy": Definition(
            "strong highlights with a haze around them", ("oily", "greasiness"),
            ("highlight", "haze"), lambda r: np.minimum(r["highlight"], r["haze"]),
        ),
        "dusty": Definition(
            "dull and pale, with light edges", ("dustiness", "powdery"),
            ("highlight", "sheen", "diffuse_chroma"),
            lambda r: (1.0 - r["highlight"] + r["sheen"] + 1.0 - r["diffuse_chroma"]) / 3.0,
        ),
        "bright": Definition(
            "how light it is", ("light", "brightness"), ("body_lightness",),
            lambda r: r["body_lightness"],
        ),
        "red": Definition("more red than the other colours", ("redness",), ("red",),
                          lambda r: r["red"]),
        "green": Definition("more green than the other colours", ("greenness",), ("green",),
                            lambda r: r["green"]),
        "blue": Definition("more blue than the other colours", ("blueness",), ("blue",),
                           lambda r: r["blue"]),
    }
)  # fmt: skip
"""Every trait that the package ships."""


def trait_values(rows: Sequence[Mapping[str, float]]) -> dict[str, Float64]:
    """For each trait one grade for each member: how much its descriptors speak for the trait."""
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    # no body below the lobe: light leaves as reflection (cube roots, as lightness has them)
    columns["reflection"] = np.cbrt(columns["specular"]) - np.cbrt(columns["diffuse"])
    ranks = {
        name: np.argsort(np.argsort(v, kind="stable"), kind="stable") / max(len(v) - 1, 1)
        for name, v in columns.items()
    }
    return {name: definition.grade(ranks) for name, definition in TRAITS.items()}


def labels(values: Float64) -> NDArray[np.int8]:
    """1 (yes) in the upper third, -1 (no) in the lower third, 0 (unclear) between."""
    low, high = np.quantile(values, [SHARE, 1.0 - SHARE])
    return np.asarray((values >= high).astype(np.int8) - (values <= low).astype(np.int8))
