"""Analytic models of metals, paints, plastics, cloth and others, each by a few parameters.

In all functions `colour`, `tint` and the like are linear Rec.709 albedos (3,) in [0, 1], `alpha` is
a roughness in (0, 1], and `sigma` is the slope angle of `OrenNayar` in radians.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeAlias

from traitbrdf.recipes.spectra import SPECTRA, indices
from traitbrdf.reflectance.brdf import Reflectance
from traitbrdf.reflectance.models import (
    GGX,
    GTR,
    AshikhminShirley,
    BoundedPhong,
    BoundedTorranceSparrow,
    Coated,
    Interference,
    Lambert,
    Model,
    OrenNayar,
    Plastic,
    RetroReflection,
    Sheen,
)

RGB: TypeAlias = tuple[float, float, float]
Parameters: TypeAlias = dict[str, float | tuple[float, ...]]


@dataclass(frozen=True)
class Material:
    """A named member of a family.

    Parameters
    ----------
    name : str
        Unique, lower case, words joined by hyphens.
    family : str
    model : Reflectance
    parameters : dict
        The arguments of the family's recipe: numbers, and colours as three numbers.
    """

    name: str
    family: str
    model: Reflectance
    parameters: Parameters


METALS: Mapping[str, tuple[RGB, RGB]] = MappingProxyType({m: indices(m) for m in SPECTRA})
"""Index of refraction and extinction (R, G, B), from spectra."""

COLOURS: Mapping[str, RGB] = MappingProxyType(
    {
        "white": (0.82, 0.82, 0.80),
        "ivory": (0.78, 0.71, 0.55),
        "beige": (0.60, 0.48, 0.34),
        "light-grey": (0.50, 0.50, 0.50),
        "grey": (0.20, 0.20, 0.20),
        "charcoal": (0.045, 0.045, 0.048),
        "black": (0.012, 0.012, 0.012),
        "red": (0.55, 0.025, 0.02),
        "crimson": (0.32, 0.008, 0.025),
        "coral": (0.72, 0.19, 0.12),
        "pink": (0.75, 0.28, 0.38),
        "magenta": (0.48, 0.02, 0.26),
        "purple": (0.15, 0.025, 0.29),
        "navy": (0.008, 0.014, 0.085),
        "blue": (0.018, 0.06, 0.48),
        "sky": (0.22, 0.47, 0.74),
        "turquoise": (0.025, 0.40, 0.38),
        "teal": (0.010, 0.13, 0.13),
        "green": (0.025, 0.33, 0.045),
        "forest": (0.010, 0.085, 0.018),
        "olive": (0.15, 0.14, 0.025),
        "lime": (0.30, 0.60, 0.03),
        "yellow": (0.78, 0.55, 0.03),
        "mustard": (0.48, 0.27, 0.03),
        "orange": (0.72, 0.20, 0.015),
        "brown": (0.13, 0.055, 0.022),
        "chocolate": (0.045, 0.018, 0.009),
    }
)

NEUTRAL = ("white", "ivory", "beige", "light-grey", "grey", "charcoal", "black")
WOODS: Mapping[str, RGB] = MappingProxyType(
    {
        "oak": (0.36, 0.21, 0.095),
        "pine": (0.56, 0.37, 0.18),
        "walnut": (0.085, 0.042, 0.022),
        "cherry": (0.30, 0.10, 0.045),
        "maple": (0.60, 0.44, 0.27),
        "mahogany": (0.15, 0.035, 0.018),
        "ebony": (0.018, 0.014, 0.012),
    }
)

STONES: Mapping[str, RGB] = MappingProxyType(
    {
        "marble": (0.72, 0.71, 0.68),
        "granite": (0.22, 0.21, 0.21),
        "basalt": (0.045, 0.045, 0.048),
        "sandstone": (0.48, 0.33, 0.19),
        "limestone": (0.56, 0.51, 0.41),
        "slate": (0.075, 0.085, 0.10),
        "jade": (0.09, 0.26, 0.13),
        "terracotta": (0.36, 0.11, 0.05),
        "concrete": (0.33, 0.32, 0.30),
    }
)

DIGITS = 9
"""Significant digits of random numbers, and of numbers computed from them."""


def rounded(value: float) -> float:
    """Round `value` to `DIGITS` significant digits.

    Libraries choose their instructions by the processor, so the 16th digit of a logarithm, a power,
    a sum or an element of an array differs between processors. Materials must not.
    """
    return float(f"{value:.{DIGITS}g}")


# ---------------------------------------------------------------------------------------------
# Recipes: the model of a family from its own few parameters


def metal(eta: RGB, k: RGB, alpha: float) -> Model:
    """Return a bare metal; a satin metal serves as an isotropically brushed one.

    Parameters
    ----------
    eta, k : (3,) index of refraction and extinction coefficient
    alpha : float
        Roughness.
    """
    return GGX(alpha=alpha, eta=eta, k=k)


def anodised(colour: RGB, alpha: float) -> Model:
    """Return dyed oxide over aluminium: a tinted metal under a thin clear layer of low index.

    Parameters
    ----------
    colour : (3,) tint of the metal
    alpha : float
        Roughness.
    """
    eta, k = METALS["aluminium"]
    return Coated(GGX(alpha=alpha, eta=eta, k=k, k_s=colour), alpha=alpha, eta=1.3)


def metallic_paint(colour: RGB, flakes: float, flake_alpha: float, alpha: float) -> Model:
    """Return aluminium flakes in a tinted binder under a satin surface.

    Parameters
    ----------
    colour : (3,) albedo of the binder
    flakes : float
        Share of the flakes, in [0, 1].
    flake_alpha, alpha : float
        Roughness of the flakes and of the surface.
    """
    return Coated(_flakes(colour, flakes, flake_alpha), alpha=alpha, eta=1.45)


def car_paint(colour: RGB, flakes: float, flake_alpha: float, alpha: float) -> Model:
    """Return a metallic or plain base under a sharp clear coat: two lobes.

    Parameters
    ----------
    colour : (3,) albedo of the base
    flakes : float
        Share of the flakes, in [0, 1].
    flake_alpha, alpha : float
        Roughness of the flakes and of the coat.
    """
    return Coated(_flakes(colour, flakes, flake_alpha), alpha=alpha, eta=1.5)


def _flakes(colour: RGB, flakes: float, flake_alpha: float) -> Model:
    eta, k = METALS["aluminium"]
    # light reaches the flakes through little binder: brighter and less saturated
    tint = scaled(desaturate(colour, 0.2), 1.0, normalise=0.9)
    return flakes * GGX(alpha=flake_alpha, eta=eta, k=k, k_s=tint) + (1.0 - flakes) * Lambert(
        colour
    )


def plastic(colour: RGB, alpha: float, eta: float) -> Model:
    """Return a clear coat over a diffuse body.

    Parameters
    ----------
    colour : (3,) albedo of the body
    alpha : float
        Roughness of the coat.
    eta : float
        Index of refraction of the coat.
    """
    return Plastic(k_d=colour, alpha=alpha, eta=eta)


def phenolic(colour: RGB, specular: float, exponent: float) -> Model:
    """Return moulded resin: a Phong-like lobe, with shorter tails than GGX.

    Parameters
    ----------
    colour : (3,) albedo of the body
    specular : float
        Reflectance at normal incidence.
    exponent : float
        At least 1.
    """
    return AshikhminShirley(r_d=colour, r_s=specular, n_u=exponent, n_v=exponent)


def rubber(colour: RGB, specular: float, width: float, sigma: float) -> Model:
    """Return a rough diffuse body with a weak, wide Gaussian highlight.

    Parameters
    ----------
    colour : (3,) albedo of the body
    specular : float
        Weight of the highlight, in [0, 1].
    width : float
        Width of the highlight in theta_h, radians.
    sigma : float
        Roughness of the body.
    """
    return (1.0 - specular) * OrenNayar(colour, sigma) + BoundedTorranceSparrow(specular, width)


def cloth(colour: RGB, sheen: float, sheen_alpha: float, sigma: float) -> Model:
    """Return rough diffuse threads under a fuzz of loose fibres of half the saturation.

    Parameters
    ----------
    colour : (3,) albedo of the threads
    sheen : float
        Weight of the fuzz, in [0, 1].
    sheen_alpha : float
        Roughness of the fuzz, in [0.25, 1].
    sigma : float
        Roughness of the threads.
    """
    tint = scaled(desaturate(colour, 0.5), 1.0, normalise=1.0)
    return (1.0 - sheen) * OrenNayar(colour, sigma) + sheen * Sheen(tint, sheen_alpha)


def silk(colour: RGB, weight: float, exponent: float, sheen: float) -> Model:
    """Return smooth threads: a wide coloured lobe that keeps the dye's colour, and some sheen.

    Parameters
    ----------
    colour : (3,) albedo of the threads
    weight : float
        Weight of the lobe, in [0, 1].
    exponent : float
        Exponent of the lobe, at least 1.
    sheen : float
        Weight of the sheen, in [0, 1].
    """
    tint = scaled(desaturate(colour, 0.3), 1.0, normalise=0.85)
    return (
        (1.0 - weight - sheen) * Lambert(colour)
        + weight * BoundedPhong(tint, exponent)
        + sheen * Sheen(desaturate(tint, 0.5), 0.5)
    )


def coated_rough(colour: RGB, sigma: float, alpha: float, eta: float) -> Model:
    """Return a clear film over a rough diffuse body: leather, varnished wood, polished stone.

    Parameters
    ----------
    colour : (3,) albedo of the body
    sigma : float
        Roughness of the body.
    alpha : float
        Roughness of the film.
    eta : float
        Index of refraction of the film.
    """
    return Coated(OrenNayar(colour, sigma), alpha=alpha, eta=eta)


def rough_diffuse(colour: RGB, sigma: float, specular: float, alpha: float) -> Model:
    """Return a rough diffuse body with a faint dielectric lobe: raw wood, stone, paper, plaster.

    Parameters
    ----------
    colour : (3,) albedo of the body
    sigma : float
        Roughness of the body.
    specular : float
        Share with the lobe, in [0, 1].
    alpha : float
        Roughness of the lobe.
    """
    return (1.0 - specular) * OrenNayar(colour, sigma) + specular * Plastic(colour, alpha, 1.5)


def wax(colour: RGB, alpha: float, sheen: float) -> Model:
    """Return a body that scatters light below its surface: a blurred coat and a pale rim.

    Parameters
    ----------
    colour : (3,) albedo of the body
    alpha : float
        Roughness of the coat.
    sheen : float
        Weight of the rim, in [0, 1].
    """
    pale = desaturate(colour, 0.3)
    return (1.0 - sheen) * Coated(Lambert(colour), alpha=alpha, eta=1.44) + sheen * Sheen(pale, 0.8)


def greasy(colour: RGB, sigma: float, alpha: float, film_alpha: float, film: float) -> Model:
    """Return a film of oil that covers part of a dull surface: a sharp lobe over a wide one.

    Parameters
    ----------
    colour : (3,) albedo of the surface
    sigma, alpha : float
        Roughness of the dull body and of its own lobe.
    film_alpha : float
        Roughness of the film.
    film : float
        Share that the film covers, in [0, 1].
    """
    return (1.0 - film) * Coated(OrenNayar(colour, sigma), alpha=alpha, eta=1.4) + film * Coated(
        Lambert(scaled(colour, 0.85)), alpha=film_alpha, eta=1.47
    )


def dusty(base: Model, dust: RGB, cover: float) -> Model:
    """Return dust that covers a fraction of another material and brightens its rim.

    Parameters
    ----------
    base : Model
    dust : (3,) albedo of the dust
    cover : float
        Share that the dust covers, in [0, 1].
    """
    return (1.0 - cover) * base + cover * (0.8 * OrenNayar(dust, 0.6) + 0.2 * Sheen(dust, 0.6))


def over(colour: RGB, sigma: float, weight: float, lobe: Model) -> Model:
    """Return a lobe over a rough diffuse body that gets the remaining light.

    Parameters
    ----------
    colour : (3,) albedo of the body
    sigma : float
        Roughness of the body.
    weight : float
        Weight of the lobe, in [0, 1].
    lobe : Model
        Of albedo at most 1.
    """
    return (1.0 - weight) * OrenNayar(colour, sigma) + weight * lobe


def hazy(
    reflectance: RGB, alpha: float, gamma: float, haze: float, wide: float, wide_gamma: float
) -> Model:
    """Return a sharp lobe and a wide one on one surface: haze of polish, wear, orange peel.

    Parameters
    ----------
    reflectance : (3,) reflectance at normal incidence
    alpha, gamma : float
        Roughness and fall-off of the sharp lobe, as for `GTR`.
    haze : float
        Share of the wide lobe, in [0, 1].
    wide, wide_gamma : float
        Roughness and fall-off of the wide lobe.
    """
    sharp = GTR(1.0, reflectance, alpha, gamma)
    return (1.0 - haze) * sharp + haze * GTR(1.0, reflectance, wide, wide_gamma)


def pearl(
    colour: RGB,
    flakes: float,
    tint: RGB,
    film: float,
    index: float,
    fringes: float,
    flake_alpha: float,
    alpha: float,
) -> Model:
    """Return interference flakes in a binder under a coat; their colour varies with the angle.

    Parameters
    ----------
    colour : (3,) albedo of the binder
    flakes : float
        Share of the flakes, in [0, 1].
    tint : (3,) weight of the flakes
    film : float
        Thickness of the flakes' film, nm.
    index : float
        Index of refraction of the film.
    fringes : float
        Visibility of the fringes, in [0, 1].
    flake_alpha, alpha : float
        Roughness of the flakes and of the coat.
    """
    flake = Interference(tint, flake_alpha, film, index, fringes)
    base = flakes * flake + (1.0 - flakes) * Lambert(colour)
    return Coated(base, alpha=alpha, eta=1.5)


def retro_reflective(
    colour: RGB, sigma: float, back: float, sharpness: float, specular: float, alpha: float
) -> Model:
    """Return a rough body with retro-reflection: road paint, moss, dry soil, coarse weave.

    Parameters
    ----------
    colour : (3,) albedo of the body
    sigma : float
        Roughness of the body.
    back, sharpness : float
        Weight and exponent of the retro-reflection.
    specular, alpha : float
        Weight and roughness of the specular lobe.
    """
    tint = scaled(desaturate(colour, 0.3), 1.0, normalise=0.9)
    return (
        (1.0 - back - specular) * OrenNayar(colour, sigma)
        + back * RetroReflection(tint, sharpness)
        + specular * GTR(1.0, 0.04, alpha, 1.5)
    )


# ---------------------------------------------------------------------------------------------
# Random members


def scaled(colour: RGB, factor: float, normalise: float | None = None) -> RGB:
    """Return `colour` times `factor`, at most 0.95 in each channel.

    Parameters
    ----------
    colour : (3,) albedo
    factor : float
    normalise : float or None
        If given, the greatest channel becomes this, whatever `factor`.
    """
    if normalise is not None:
        factor = normalise / max(*colour, 1e-6)
    r, g, b = (rounded(min(c * factor, 0.95)) for c in colour)
    return r, g, b


def desaturate(colour: RGB, amount: float) -> RGB:
    """Return `colour` (3,) moved towards grey by `amount`, in [0, 1]."""
    mean = sum(colour) / 3.0
    r, g, b = (rounded(c + amount * (mean - c)) for c in colour)
    return r, g, b
