"""What moves of traits hold by default, and what changes of it cost."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

COLOURS = frozenset(("red", "green", "blue", "gold"))
"""Traits that are colours: their moves hold no colour by default."""

LIGHT = frozenset(("bright", "diffuse", "specular", "silver", "gold", "dusty", "ceramic"))
"""Traits that describe how light a thing is: their moves hold no lightness by default.

"bright" is lightness itself; "diffuse" and "specular" are amounts of reflected light; silver, gold
and ceramic are light, and dust is paler than what it lies on.
"""

PALING = frozenset(("dusty", "acrylic", "tint", "silver"))
"""Traits that describe saturation: where their moves hold colour, they hold its hue alone."""

STEERED = MappingProxyType({"gold": (75.0, 0.06, 0.42), "silver": (80.0, 0.0, 0.0)})
"""Traits that lead towards a colour: its L*, and its a* and b* divided by L* + 16.

Gold's are near those of its reflectance at normal incidence (Johnson & Christy 1972: 91, 0.02,
0.31), and those of darker, warmer alloys.
"""

KEEPS_BODY = frozenset(("shiny", "glossy", "strength", "sharpness", "hard", "greasy", "plastic"))
"""Traits of the highlight: their moves keep the body below it as far as that is possible."""

GROUPS = ("colour", "color", "lightness", "body")
"""What can be held beside traits: the colour of all reflected light and of the body, its lightness,
and the look of the body below the highlight.
"""

# costs of changes of what is held: weights of squared rates, as in `traitbrdf.space.moves`
_HUE = 3.0  # for a degree of CIELAB hue
_CHROMA = 0.3  # for a unit of a* or b*
_LIGHTNESS = 0.2  # for a unit of L*
_LOBE = 300.0  # for log RGB of the lobe


class HeldCosts(NamedTuple):
    """Costs of changes of colour and lightness in a move.

    Parameters
    ----------
    hue, chroma, light : (5,) float64
        For each of `traitbrdf.space.scores.SURFACES`: cost of a degree of hue, of a unit of a* or
        b* apart from lightness, and of a unit of L*.
    steered : bool
        Whether the move leads towards a colour.
    steer : (3,) float64
        That colour: its L*, and its a* and b* divided by L* + 16.
    lobe : float
        Cost of a hue of the lobe that all light does not have, for a unit of log RGB.
    together : float
        Cost of changing L* of the body differently from that of all light, for a unit of L*.
    """

    hue: Float64
    chroma: Float64
    light: Float64
    steered: bool
    steer: Float64
    lobe: float
    together: float


def held_costs(names: Sequence[str], hold: Sequence[str] | None) -> HeldCosts:
    """Return what changes of colour and lightness cost.

    Parameters
    ----------
    names : sequence of str
        The traits that move.
    hold : sequence of str or None
        What is held: traits, or some of `GROUPS`; None if colours are unknown.
    """
    moved = set(names)
    colour = float(hold is not None and ("colour" in hold or "color" in hold))
    bodily = float(hold is not None and "body" not in hold and bool(moved & KEEPS_BODY))
    lightness = float(hold is not None and "lightness" in hold)
    steered = [name for name in names if name in STEERED] if len(names) == 1 else []
    # for each of SURFACES: light at 10, 30 and 60 degrees, the body, the body lit from the side
    hue = colour * _HUE * np.array([1.0, 1.0, 1.0, 1.0, 0.3])
    plain = 0.0 if moved & PALING else _CHROMA
    chroma = colour * plain * np.array([1.0, 1.0, 1.0, 0.1, 1.0])
    chroma += bodily * _CHROMA * np.array([0.0, 0.0, 0.0, 0.3, 0.0])
    light = lightness * _LIGHTNESS * np.array([1.0, 1.0, 1.0, 0.0, 0.3])
    light += bodily * _LIGHTNESS * np.array([0.0, 0.0, 0.0, 3.0, 0.0])
    return HeldCosts(
        hue,
        chroma,
        light,
        bool(steered),
        np.array(STEERED[steered[0]] if steered else (0.0, 0.0, 0.0)),
        colour * _LOBE,
        _LIGHTNESS * float("bright" in moved),
    )
