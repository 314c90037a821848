"""Procedural materials: named, seeded, physically plausible reflectances of many families.

`materials` streams them: first curated anchors with plain names ("blue-plastic"), round-robin over
the families so that any prefix is varied, then random members family by family. Every material is
isotropic, reciprocal and has a proven or checked albedo of at most 1 (``model.energy_bounded``):
layers are either coats (`Coated`, `Plastic`), convex mixtures, or sums whose albedos add to at
most 1. Colours are linear Rec.709 albedos.

A seed gives the same materials on every processor: numbers are rounded (`_rounded`) before models,
names or choices depend on them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from data_gen.spectra import SPECTRA, indices
from traitbrdf.brdf import Reflectance
from traitbrdf.models import (
    ABC,
    GGX,
    GTR,
    AshikhminShirley,
    Beckmann,
    BlinnPhong,
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
    ShiftedGamma,
    Ward,
    fresnel_conductor,
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
        What the recipe of the family was given: numbers, and colours as three numbers.
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
_NEUTRAL = ("white", "ivory", "beige", "light-grey", "grey", "charcoal", "black")
_WOODS: Mapping[str, RGB] = MappingProxyType(
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
_STONES: Mapping[str, RGB] = MappingProxyType(
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
"""Significant digits of what is drawn, and of what is reckoned from that."""


def _rounded(value: float) -> float:
    """The nearest number of `DIGITS` digits.

    The 16th digit of a logarithm, a power, a sum or an array's element depends on the processor,
    for which libraries choose their instructions; nothing else may.
    """
    return float(f"{value:.{DIGITS}g}")


# ---------------------------------------------------------------------------------------------
# Recipes: the model of a family from its own few parameters


def metal(eta: RGB, k: RGB, alpha: float) -> Model:
    """Bare metal; a satin one stands for isotropic brushing."""
    return GGX(alpha=alpha, eta=eta, k=k)


def anodised(colour: RGB, alpha: float) -> Model:
    """Dyed oxide over aluminium: a tinted metal under a thin clear layer of low index."""
    eta, k = METALS["aluminium"]
    return Coated(GGX(alpha=alpha, eta=eta, k=k, k_s=colour), alpha=alpha, eta=1.3)


def metallic_paint(colour: RGB, flakes: float, flake_alpha: float, alpha: float) -> Model:
    """Aluminium flakes in tinted binder under a satin surface."""
    return Coated(_flakes(colour, flakes, flake_alpha), alpha=alpha, eta=1.45)


def car_paint(colour: RGB, flakes: float, flake_alpha: float, alpha: float) -> Model:
    """Metallic or plain base under a sharp clear coat: two lobes."""
    return Coated(_flakes(colour, flakes, flake_alpha), alpha=alpha, eta=1.5)


def _flakes(colour: RGB, flakes: float, flake_alpha: float) -> Model:
    eta, k = METALS["aluminium"]
    # flakes reflect through the binder once more than the eye expects: brighter, less saturated
    tint = _scale(_desaturate(colour, 0.2), 1.0, normalise=0.9)
    return flakes * GGX(alpha=flake_alpha, eta=eta, k=k, k_s=tint) + (1.0 - flakes) * Lambert(
        colour
    )


def plastic(colour: RGB, alpha: float, eta: float) -> Model:
    return Plastic(k_d=colour, alpha=alpha, eta=eta)


def phenolic(colour: RGB, specular: float, exponent: float) -> Model:
    """Moulded resin: a Phong-like lobe, sharper in its tails than GGX."""
    return AshikhminShirley(r_d=colour, r_s=specular, n_u=exponent, n_v=exponent)


def rubber(colour: RGB, specular: float, width: float, sigma: float) -> Model:
    """Rough diffuse body with a weak, wide Gaussian highlight."""
    return (1.0 - specular) * OrenNayar(colour, sigma) + BoundedTorranceSparrow(specular, width)


def cloth(colour: RGB, sheen: float, sheen_alpha: float, sigma: float) -> Model:
    """Rough diffuse threads under a fuzz of loose fibres of half the saturation."""
    tint = _scale(_desaturate(colour, 0.5), 1.0, normalise=1.0)
    return (1.0 - sheen) * OrenNayar(colour, sigma) + sheen * Sheen(tint, sheen_alpha)


def silk(colour: RGB, weight: float, exponent: float, sheen: float) -> Model:
    """Smooth threads: a wide coloured lobe that keeps the dye, and a little sheen."""
    tint = _scale(_desaturate(colour, 0.3), 1.0, normalise=0.85)
    return (
        (1.0 - weight - sheen) * Lambert(colour)
        + weight * BoundedPhong(tint, exponent)
        + sheen * Sheen(_desaturate(tint, 0.5), 0.5)
    )


def coated_rough(colour: RGB, sigma: float, alpha: float, eta: float) -> Model:
    """Clear film over a rough diffuse body: leather, varnished wood, polished stone."""
    return Coated(OrenNayar(colour, sigma), alpha=alpha, eta=eta)


def rough_diffuse(colour: RGB, sigma: float, specular: float, alpha: float) -> Model:
    """Rough diffuse body with a faint dielectric lobe: raw wood, stone, paper, plaster."""
    return (1.0 - specular) * OrenNayar(colour, sigma) + specular * Plastic(colour, alpha, 1.5)


def wax(colour: RGB, alpha: float, sheen: float) -> Model:
    """Soft body whose light spreads below the surface: a blurred coat and a pale rim."""
    pale = _desaturate(colour, 0.3)
    return (1.0 - sheen) * Coated(Lambert(colour), alpha=alpha, eta=1.44) + sheen * Sheen(pale, 0.8)


def greasy(colour: RGB, sigma: float, alpha: float, film_alpha: float, film: float) -> Model:
    """A film of oil that covers part of a dull surface: a sharp lobe over a wide one."""
    return (1.0 - film) * Coated(OrenNayar(colour, sigma), alpha=alpha, eta=1.4) + film * Coated(
        Lambert(_scale(colour, 0.85)), alpha=film_alpha, eta=1.47
    )


def dusty(base: Model, dust: RGB, cover: float) -> Model:
    """Dust that covers a fraction of another material and glows at the rim."""
    return (1.0 - cover) * base + cover * (0.8 * OrenNayar(dust, 0.6) + 0.2 * Sheen(dust, 0.6))


def _over(colour: RGB, sigma: float, weight: float, lobe: Model) -> Model:
    """A lobe of albedo up to `weight` over what it leaves to a rough diffuse body."""
    return (1.0 - weight) * OrenNayar(colour, sigma) + weight * lobe


def hazy(
    reflectance: RGB, alpha: float, gamma: float, haze: float, wide: float, wide_gamma: float
) -> Model:
    """A sharp lobe and a wide one from one surface: haze of polish, wear, orange peel."""
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
    """Interference flakes in a binder under a clear coat: the colour turns with the angle."""
    flake = Interference(tint, flake_alpha, film, index, fringes)
    base = flakes * flake + (1.0 - flakes) * Lambert(colour)
    return Coated(base, alpha=alpha, eta=1.5)


def retro_reflective(
    colour: RGB, sigma: float, back: float, sharpness: float, specular: float, alpha: float
) -> Model:
    """Rough body that throws light back: road paint, moss, dry soil, coarse weave."""
    tint = _scale(_desaturate(colour, 0.3), 1.0, normalise=0.9)
    return (
        (1.0 - back - specular) * OrenNayar(colour, sigma)
        + back * RetroReflection(tint, sharpness)
        + specular * GTR(1.0, 0.04, alpha, 1.5)
    )


# ---------------------------------------------------------------------------------------------
# Random members


def _scale(colour: RGB, factor: float, normalise: float | None = None) -> RGB:
    """`colour` times `factor`, or brought to the maximum `normalise`; at most 0.95."""
    if normalise is not None:
        factor = normalise / max(*colour, 1e-6)
    r, g, b = (_rounded(min(c * factor, 0.95)) for c in colour)
    return r, g, b


def _desaturate(colour: RGB, amount: float) -> RGB:
    mean = sum(colour) / 3.0
    r, g, b = (_rounded(c + amount * (mean - c)) for c in colour)
    return r, g, b


class _Draw:
    """The random choices of one material, independent of all others.

    `step` is the material's number in its family: roughnesses step through their range by the
    golden ratio, so that few members already spread over it.
    """

    def __init__(self, seed: int, family: int, step: int) -> None:
        self.rng = np.random.default_rng((seed, family, step))
        offset = float(np.random.default_rng((seed, family)).random())
        self._phase = (offset + step * 0.6180339887498949) % 1.0

    def uniform(self, low: float, high: float) -> float:
        return _rounded(self.rng.uniform(low, high))

    def log(self, low: float, high: float) -> float:
        return _rounded(math.exp(self.rng.uniform(math.log(low), math.log(high))))

    def spread(self, low: float, high: float) -> float:
        """Log-spaced in [low, high], stepping evenly from member to member."""
        return _rounded(math.exp(math.log(low) + self._phase * math.log(high / low)))

    def pick(self, names: Mapping[str, RGB] | tuple[str, ...]) -> str:
        options = tuple(names)
        return options[int(self.rng.integers(len(options)))]

    def vary(self, colour: RGB, amount: float = 0.15) -> RGB:
        """`colour` with each channel and the whole changed by some `amount`."""
        changes = self.rng.normal(0.0, amount * 0.5, 3) + self.rng.normal(0.0, amount)
        r, g, b = (
            _rounded(min(c * math.exp(x), 0.9)) for c, x in zip(colour, changes, strict=True)
        )
        return r, g, b

    def colour(self, names: tuple[str, ...] | None = None) -> tuple[str, RGB]:
        name = self.pick(names or COLOURS)
        return name, self.vary(COLOURS[name])


_Made: TypeAlias = tuple[str, Model, Parameters]
_Recipe: TypeAlias = Callable[[_Draw], _Made]


def _finish(alpha: float) -> str:
    return "glossy" if alpha < 0.06 else "satin" if alpha < 0.3 else "matte"


def _metal_family(adjective: str, low: float, high: float) -> _Recipe:
    def make(draw: _Draw) -> _Made:
        name = draw.pick(tuple(METALS))
        eta, k = METALS[name]
        # alloys and treatments differ from the pure element
        eta = _times(eta, draw.uniform(0.92, 1.08))
        k = _times(k, draw.uniform(0.92, 1.08))
        alpha = draw.spread(low, high)
        return f"{adjective}-{name}", metal(eta, k, alpha), {"eta": eta, "k": k, "alpha": alpha}

    return make


def _times(rgb: RGB, factor: float) -> RGB:
    r, g, b = (_rounded(c * factor) for c in rgb)
    return r, g, b


def _anodised(draw: _Draw) -> _Made:
    name, colour = draw.colour()
    colour = _scale(colour, 1.0, normalise=draw.uniform(0.4, 0.9))
    alpha = draw.spread(0.03, 0.5)
    model = anodised(colour, alpha)
    return f"anodised-{name}-metal", model, {"colour": colour, "alpha": alpha}


def _paint_family(
    noun: str, recipe: Callable[[RGB, float, float, float], Model], low: float, high: float
) -> _Recipe:
    def make(draw: _Draw) -> _Made:
        name, colour = draw.colour()
        alpha = draw.spread(low, high)
        flakes = draw.uniform(0.1, 0.75)
        flake_alpha = max(draw.log(0.12, 0.5), alpha)
        values: Parameters = {
            "colour": colour,
            "flakes": flakes,
            "flake_alpha": flake_alpha,
            "alpha": alpha,
        }
        adjective = "sparkling" if flakes > 0.45 else "plain"
        model = recipe(colour, flakes, flake_alpha, alpha)
        return f"{adjective}-{name}-{noun}", model, values

    return make


def _plastic_family(
    noun: str, low: float, high: float, eta: tuple[float, float], adjective: str = ""
) -> _Recipe:
    def make(draw: _Draw) -> _Made:
        name, colour = draw.colour()
        alpha, index = draw.spread(low, high), draw.uniform(*eta)
        values: Parameters = {"colour": colour, "alpha": alpha, "eta": index}
        first = adjective or _finish(alpha)
        return f"{first}-{name}-{noun}", plastic(colour, alpha, index), values

    return make


def _phenolic(draw: _Draw) -> _Made:
    name, colour = draw.colour()
    specular, exponent = draw.uniform(0.03, 0.09), draw.spread(8.0, 2e4)
    values: Parameters = {"colour": colour, "specular": specular, "exponent": exponent}
    adjective = _finish(math.sqrt(2.0 / (exponent + 2.0)))
    return f"{adjective}-{name}-phenolic", phenolic(colour, specular, exponent), values


def _rubber(draw: _Draw) -> _Made:
    name, colour = draw.colour()
    colour = _scale(colour, 0.7)
    specular, width = draw.log(0.01, 0.06), draw.spread(0.12, 0.7)
    sigma = draw.uniform(0.1, 0.6)
    values: Parameters = {"colour": colour, "specular": specular, "width": width, "sigma": sigma}
    adjective = "smooth" if width < 0.25 else "dull"
    return f"{adjective}-{name}-rubber", rubber(colour, specular, width, sigma), values


def _cloth_family(
    nouns: tuple[str, ...], sheen: tuple[float, float], scale: float, alpha: tuple[float, float]
) -> _Recipe:
    def make(draw: _Draw) -> _Made:
        name, colour = draw.colour()
        colour = _scale(colour, scale)
        noun = draw.pick(nouns)
        weight, sheen_alpha = draw.uniform(*sheen), draw.spread(*alpha)
        sigma = draw.uniform(0.2, 0.9)
        values: Parameters = {
            "colour": colour,
            "sheen": weight,
            "sheen_alpha": sheen_alpha,
            "sigma": sigma,
        }
        adjective = "soft" if weight > 0.5 * sum(sheen) else "plain"
        return f"{adjective}-{name}-{noun}", cloth(colour, weight, sheen_alpha, sigma), values

    return make


def _silk(draw: _Draw) -> _Made:
    name, colour = draw.colour()
    weight, exponent = draw.uniform(0.15, 0.5), draw.spread(4.0, 80.0)
    sheen = draw.uniform(0.02, 0.15)
    values: Parameters = {
        "colour": colour,
        "weight": weight,
        "exponent": exponent,
        "sheen": sheen,
    }
    noun = draw.pick(("silk", "satin-cloth"))
    adjective = "lustrous" if exponent > 20.0 else "soft"
    return f"{adjective}-{name}-{noun}", silk(colour, weight, exponent, sheen), values


def _film_family(
    noun: str,
    palette: Mapping[str, RGB] | None,
    sigma: tuple[float, float],
    alpha: tuple[float, float],
    eta: tuple[float, float],
    adjective: str = "",
) -> _Recipe:
    def make(draw: _Draw) -> _Made:
        name = draw.pick(palette or COLOURS)
        colour = draw.vary((palette or COLOURS)[name])
        a, index, spread = draw.spread(*alpha), draw.uniform(*eta), draw.uniform(*sigma)
        values: Parameters = {"colour": colour, "sigma": spread, "alpha": a, "eta": index}
        words = "-".join(w for w in (adjective or _finish(a), name, noun) if w)
        return words, coated_rough(colour, spread, a, index), values

    return make


def _rough_family(
    noun: str,
    palette: Mapping[str, RGB],
    sigma: tuple[float, float],
    specular: tuple[float, float],
    adjective: str,
) -> _Recipe:
    def make(draw: _Draw) -> _Made:
        name = draw.pick(palette)
        colour = draw.vary(palette[name])
        spread, weight, alpha = draw.uniform(*sigma), draw.uniform(*specular), draw.spread(0.3, 1.0)
        values: Parameters = {
            "colour": colour,
            "sigma": spread,
            "specular": weight,
            "alpha": alpha,
        }
        words = "-".join(w for w in (adjective, name, noun) if w)
        return words, rough_diffuse(colour, spread, weight, alpha), values

    return make


def _wax(draw: _Draw) -> _Made:
    name, colour = draw.colour()
    alpha, sheen = draw.spread(0.12, 0.6), draw.uniform(0.05, 0.25)
    values: Parameters = {"colour": colour, "alpha": alpha, "sheen": sheen}
    return f"{_finish(alpha)}-{name}-wax", wax(colour, alpha, sheen), values


def _greasy(draw: _Draw) -> _Made:
    name, colour = draw.colour()
    sigma, alpha = draw.uniform(0.1, 0.6), draw.log(0.3, 0.8)
    film_alpha, film = draw.spread(0.02, 0.25), draw.uniform(0.2, 0.9)
    values: Parameters = {
        "colour": colour,
        "sigma": sigma,
        "alpha": alpha,
        "film_alpha": film_alpha,
        "film": film,
    }
    return f"greasy-{name}-surface", greasy(colour, sigma, alpha, film_alpha, film), values


def _dusty(draw: _Draw) -> _Made:
    below = draw.pick(("plastic", "metal", "rubber", "varnish"))
    dust, cover = draw.vary(COLOURS["beige"], 0.25), draw.uniform(0.1, 0.85)
    alpha = draw.spread(0.01, 0.4)
    values: Parameters = {"dust": dust, "cover": cover, "alpha": alpha}
    if below == "metal":
        name = draw.pick(tuple(METALS))
        values["eta"], values["k"] = METALS[name]
        return f"dusty-bare-{name}", dusty(metal(*METALS[name], alpha), dust, cover), values
    name, colour = draw.colour()
    values["colour"] = colour
    base = {
        "plastic": plastic(colour, alpha, 1.5),
        "rubber": rubber(colour, 0.04, max(alpha, 0.15), 0.3),
        "varnish": coated_rough(colour, 0.2, alpha, 1.5),
    }[below]
    return f"dusty-{name}-{below}", dusty(base, dust, cover), values


def _reflectance(draw: _Draw, metallic: bool) -> tuple[str, RGB]:
    """Reflectance at normal incidence: of a metal, or of a dielectric, a little tinted at times."""
    if not metallic:
        r0 = draw.uniform(0.02, 0.12)
        return "", (r0, r0, r0)
    name = draw.pick(tuple(METALS))
    eta, k = (np.array(values) for values in METALS[name])
    r, g, b = (float(v) for v in fresnel_conductor(1.0, eta, k))
    bare = draw.vary((r, g, b), 0.1)
    if draw.uniform(0.0, 1.0) < 0.6:
        return name, bare
    # under a clear dye, which light passes twice or more: as saturated as candy wrappers
    dye = draw.pick(COLOURS)
    passes = draw.uniform(0.5, 2.0)
    r, g, b = (
        _rounded(v * c**passes)
        for v, c in zip(bare, _scale(COLOURS[dye], 1.0, normalise=1.0), strict=True)
    )
    return f"{dye}-{name}", (r, g, b)


def _lobe_family(adjective: str, lobe: Callable[[_Draw, RGB], tuple[Model, Parameters]]) -> _Recipe:
    """A lobe by itself as a metal, or over a body: each member draws which."""

    def make(draw: _Draw) -> _Made:
        metallic = draw.uniform(0.0, 1.0) < 0.35
        noun, r0 = _reflectance(draw, metallic)
        model, values = lobe(draw, r0)
        values["reflectance"] = r0
        if metallic:
            # no metal is black beside its lobe: light bounces twice, and dust lies on it
            share, stray = draw.uniform(0.5, 0.95), draw.log(0.003, 0.05)
            values |= {"share": share, "stray": stray}
            return f"{adjective}-{noun}", share * model + Lambert(stray), values
        name, colour = draw.colour()
        sigma, weight = draw.uniform(0.0, 0.8), draw.log(0.03, 0.9)
        values |= {"colour": colour, "sigma": sigma, "weight": weight}
        return f"{adjective}-{name}-enamel", _over(colour, sigma, weight, model), values

    return make


def _hazy(draw: _Draw, r0: RGB) -> tuple[Model, Parameters]:
    alpha = draw.spread(0.002, 0.6)
    wide = min(1.0, _rounded(alpha * draw.log(1.5, 60.0)))
    gamma, wide_gamma = draw.uniform(0.9, 3.5), draw.uniform(0.6, 3.0)
    haze = draw.log(0.01, 0.8)
    values: Parameters = {
        "alpha": alpha, "gamma": gamma, "haze": haze, "wide": wide, "wide_gamma": wide_gamma
    }  # fmt: skip
    return hazy(r0, alpha, gamma, haze, wide, wide_gamma), values


def _polished(draw: _Draw, r0: RGB) -> tuple[Model, Parameters]:
    b, c = _rounded(2.0 / draw.spread(0.002, 0.6) ** 2), draw.uniform(0.4, 2.5)
    return ABC(1.0, r0, b, c), {"b": b, "c": c}


def _shifted(draw: _Draw, r0: RGB) -> tuple[Model, Parameters]:
    alpha, p = draw.spread(0.002, 0.9), draw.uniform(0.2, 1.8)
    return ShiftedGamma(1.0, r0, alpha, p), {"alpha": alpha, "p": p}


def _blasted(draw: _Draw, r0: RGB) -> tuple[Model, Parameters]:
    alpha = draw.spread(0.02, 1.0)
    if draw.uniform(0.0, 1.0) < 0.5:
        return Beckmann(1.0, r0, alpha), {"alpha": alpha}
    n = max(_rounded(2.0 / alpha**2), 1.0)
    return BlinnPhong(1.0, r0, n), {"n": n}


def _ward(draw: _Draw) -> _Made:
    name, colour = draw.colour()
    alpha, weight = draw.spread(0.01, 0.4), draw.log(0.01, 0.4)
    values: Parameters = {"colour": colour, "alpha": alpha, "weight": weight}
    return f"{_finish(alpha)}-{name}-lacquer", _over(colour, 0.2, weight, Ward(1.0, alpha)), values


def _pearl(draw: _Draw) -> _Made:
    name, colour = draw.colour()
    tint = _scale(COLOURS[draw.pick(COLOURS)], 1.0, normalise=draw.uniform(0.4, 0.95))
    tint = _desaturate(tint, draw.uniform(0.0, 1.0))
    film, flakes = draw.uniform(0.0, 700.0), _rounded(1.0 - draw.log(0.005, 0.8))
    index, fringes = draw.uniform(1.35, 2.4), draw.uniform(0.4, 1.0)
    flake_alpha, alpha = draw.log(0.08, 0.6), draw.spread(0.004, 0.2)
    values: Parameters = {
        "colour": colour, "flakes": flakes, "tint": tint, "film": film,
        "index": index, "fringes": fringes, "flake_alpha": flake_alpha, "alpha": alpha,
    }  # fmt: skip
    model = pearl(colour, flakes, tint, film, index, fringes, flake_alpha, alpha)
    return f"pearl-{name}-paint", model, values


def _retro(draw: _Draw) -> _Made:
    name, colour = draw.colour()
    sigma, back, sharpness = draw.uniform(0.2, 1.0), draw.log(0.02, 0.4), draw.log(1.0, 60.0)
    specular, alpha = draw.log(0.02, 0.4), draw.spread(0.05, 0.8)
    values: Parameters = {
        "colour": colour, "sigma": sigma, "back": back, "sharpness": sharpness,
        "specular": specular, "alpha": alpha,
    }  # fmt: skip
    model = retro_reflective(colour, sigma, back, sharpness, specular, alpha)
    return f"beaded-{name}-coat", model, values


def _worn(draw: _Draw) -> _Made:
    """Two materials of other families side by side, finer than the eye: wear, rust, threads."""
    others = [name for name in _RECIPES if name != "worn"]
    share = draw.uniform(0.1, 0.9)
    first, second = (others[int(i)] for i in draw.rng.choice(len(others), 2, replace=False))
    (one, a, of_one), (two, b, of_two) = _RECIPES[first](draw), _RECIPES[second](draw)
    values: Parameters = {"share": share}
    for family, known in ((first, of_one), (second, of_two)):
        values |= {f"{family}.{name}": value for name, value in known.items()}
    words = one.split("-")[-1], two.split("-")[-1]
    return f"worn-{words[0]}-and-{words[1]}", (1.0 - share) * a + share * b, values


_NEUTRALS: Mapping[str, RGB] = MappingProxyType({name: COLOURS[name] for name in _NEUTRAL[:5]})
_HIDES: Mapping[str, RGB] = MappingProxyType(
    {
        n: COLOURS[n]
        for n in (
            "brown",
            "chocolate",
            "black",
            "beige",
            "red",
            "navy",
            "forest",
            "ivory",
            "mustard",
            "crimson",
            "grey",
            "olive",
        )
    }
)

_RECIPES: Mapping[str, _Recipe] = MappingProxyType(
    {
        "polished-metal": _metal_family("polished", 0.005, 0.05),
        "brushed-metal": _metal_family("brushed", 0.06, 0.25),
        "rough-metal": _metal_family("rough", 0.28, 0.9),
        "anodised-metal": _anodised,
        "metallic-paint": _paint_family("metallic-paint", metallic_paint, 0.12, 0.5),
        "car-paint": _paint_family("car-paint", car_paint, 0.005, 0.03),
        "glossy-plastic": _plastic_family("plastic", 0.01, 0.059, (1.45, 1.6)),
        "satin-plastic": _plastic_family("plastic", 0.061, 0.29, (1.45, 1.6)),
        "matte-plastic": _plastic_family("plastic", 0.31, 1.0, (1.4, 1.55)),
        "acrylic": _plastic_family("acrylic", 0.005, 0.25, (1.48, 1.5)),
        "ceramic": _plastic_family("ceramic", 0.005, 0.12, (1.5, 1.9), "glazed"),
        "phenolic": _phenolic,
        "rubber": _rubber,
        "fabric": _cloth_family(("felt", "cotton", "wool", "linen"), (0.05, 0.4), 0.85, (0.4, 1.0)),
        "silk": _silk,
        "velvet": _cloth_family(("velvet", "velour"), (0.4, 0.85), 0.4, (0.25, 0.5)),
        "leather": _film_family("leather", _HIDES, (0.2, 0.6), (0.1, 0.6), (1.4, 1.5)),
        "varnished-wood": _film_family(
            "", _WOODS, (0.1, 0.4), (0.01, 0.2), (1.48, 1.54), "varnished"
        ),
        "raw-wood": _rough_family("", _WOODS, (0.2, 0.6), (0.05, 0.5), "raw"),
        "polished-stone": _film_family(
            "", _STONES, (0.0, 0.2), (0.008, 0.15), (1.5, 1.65), "polished"
        ),
        "rough-stone": _rough_family("", _STONES, (0.3, 1.0), (0.0, 0.25), "rough"),
        "paper": _rough_family("paper", COLOURS, (0.0, 0.4), (0.1, 0.8), "plain"),
        "plaster": _rough_family("plaster", _NEUTRALS, (0.4, 1.1), (0.0, 0.1), "chalky"),
        "wax": _wax,
        "greasy": _greasy,
        "dusty": _dusty,
        "hazy": _lobe_family("hazy", _hazy),
        "polished": _lobe_family("buffed", _polished),
        "shifted-gamma": _lobe_family("burnished", _shifted),
        "blasted": _lobe_family("blasted", _blasted),
        "lacquer": _ward,
        "pearl-paint": _pearl,
        "retro-reflective": _retro,
        "worn": _worn,
    }
)

FAMILIES: tuple[str, ...] = tuple(_RECIPES)
"""Names of the families, in the order in which they take turns."""


# ---------------------------------------------------------------------------------------------
# Anchors


def _named_metal(name: str, metal_name: str, family: str, alpha: float) -> Material:
    eta, k = METALS[metal_name]
    return Material(name, family, metal(eta, k, alpha), {"eta": eta, "k": k, "alpha": alpha})


def _named(
    name: str, family: str, recipe: Callable[..., Model], colour: str | RGB, **values: float
) -> Material:
    rgb = COLOURS[colour] if isinstance(colour, str) else colour
    return Material(name, family, recipe(rgb, **values), {"colour": rgb, **values})


def _dusty_anchor(name: str, base: Material, dust: RGB, cover: float) -> Material:
    assert isinstance(base.model, Model)
    values: Parameters = {**base.parameters, "dust": dust, "cover": cover}
    return Material(name, "dusty", dusty(base.model, dust, cover), values)


def _anchors() -> list[Material]:
    beige = COLOURS["beige"]
    plain = [
        _named_metal("gold-polished", "gold", "polished-metal", 0.03),
        _named_metal("silver-polished", "silver", "polished-metal", 0.02),
        _named_metal("copper-polished", "copper", "polished-metal", 0.04),
        _named_metal("chrome", "chrome", "polished-metal", 0.005),
        _named_metal("brass-polished", "brass", "polished-metal", 0.05),
        _named_metal("aluminium-brushed", "aluminium", "brushed-metal", 0.2),
        _named_metal("steel-brushed", "iron", "brushed-metal", 0.15),
        _named_metal("gold-satin", "gold", "brushed-metal", 0.2),
        _named_metal("nickel-satin", "nickel", "brushed-metal", 0.12),
        _named_metal("iron-cast", "iron", "rough-metal", 0.5),
        _named_metal("titanium-blasted", "titanium", "rough-metal", 0.4),
        _named_metal("copper-rough", "copper", "rough-metal", 0.35),
        _named("anodised-red", "anodised-metal", anodised, (0.8, 0.06, 0.05), alpha=0.2),
        _named("anodised-blue", "anodised-metal", anodised, (0.06, 0.15, 0.8), alpha=0.25),
        _named(
            "silver-paint",
            "metallic-paint",
            metallic_paint,
            "light-grey",
            flakes=0.7,
            flake_alpha=0.35,
            alpha=0.25,
        ),
        _named(
            "gold-paint",
            "metallic-paint",
            metallic_paint,
            (0.6, 0.35, 0.06),
            flakes=0.7,
            flake_alpha=0.35,
            alpha=0.25,
        ),
        _named(
            "blue-metallic-paint",
            "metallic-paint",
            metallic_paint,
            "blue",
            flakes=0.5,
            flake_alpha=0.3,
            alpha=0.2,
        ),
        _named(
            "red-car-paint", "car-paint", car_paint, "red", flakes=0.3, flake_alpha=0.25, alpha=0.01
        ),
        _named(
            "silver-car-paint",
            "car-paint",
            car_paint,
            "light-grey",
            flakes=0.7,
            flake_alpha=0.2,
            alpha=0.01,
        ),
        _named(
            "black-car-paint",
            "car-paint",
            car_paint,
            "black",
            flakes=0.1,
            flake_alpha=0.2,
            alpha=0.005,
        ),
        _named("blue-plastic", "glossy-plastic", plastic, "blue", alpha=0.05, eta=1.5),
        _named("red-plastic", "glossy-plastic", plastic, "red", alpha=0.05, eta=1.5),
        _named("green-plastic", "glossy-plastic", plastic, "green", alpha=0.05, eta=1.5),
        _named("white-plastic", "glossy-plastic", plastic, "white", alpha=0.04, eta=1.5),
        _named("black-plastic", "glossy-plastic", plastic, "black", alpha=0.03, eta=1.5),
        _named("yellow-plastic", "satin-plastic", plastic, "yellow", alpha=0.15, eta=1.5),
        _named("grey-plastic", "satin-plastic", plastic, "grey", alpha=0.2, eta=1.5),
        _named("orange-plastic-matte", "matte-plastic", plastic, "orange", alpha=0.4, eta=1.48),
        _named("black-plastic-matte", "matte-plastic", plastic, "black", alpha=0.5, eta=1.48),
        _named("blue-acrylic", "acrylic", plastic, "blue", alpha=0.01, eta=1.49),
        _named("pink-acrylic", "acrylic", plastic, "pink", alpha=0.03, eta=1.49),
        _named("white-porcelain", "ceramic", plastic, "white", alpha=0.02, eta=1.6),
        _named("blue-glaze", "ceramic", plastic, "navy", alpha=0.015, eta=1.7),
        _named("red-phenolic", "phenolic", phenolic, "crimson", specular=0.05, exponent=800.0),
        _named("black-phenolic", "phenolic", phenolic, "black", specular=0.06, exponent=3000.0),
        _named("red-rubber", "rubber", rubber, "red", specular=0.03, width=0.35, sigma=0.3),
        _named("black-rubber", "rubber", rubber, "black", specular=0.03, width=0.4, sigma=0.3),
        _named("green-felt", "fabric", cloth, "green", sheen=0.2, sheen_alpha=0.7, sigma=0.6),
        _named("white-cotton", "fabric", cloth, "white", sheen=0.1, sheen_alpha=0.8, sigma=0.4),
        _named("blue-denim", "fabric", cloth, "navy", sheen=0.08, sheen_alpha=0.8, sigma=0.5),
        _named("red-silk", "silk", silk, "red", weight=0.4, exponent=25.0, sheen=0.05),
        _named("ivory-satin", "silk", silk, "ivory", weight=0.35, exponent=15.0, sheen=0.05),
        _named("black-velvet", "velvet", cloth, "black", sheen=0.4, sheen_alpha=0.3, sigma=0.5),
        _named("red-velvet", "velvet", cloth, "crimson", sheen=0.6, sheen_alpha=0.3, sigma=0.5),
        _named("brown-leather", "leather", coated_rough, "brown", sigma=0.4, alpha=0.25, eta=1.45),
        _named("black-leather", "leather", coated_rough, "black", sigma=0.4, alpha=0.2, eta=1.45),
        _named(
            "oak-varnished",
            "varnished-wood",
            coated_rough,
            _WOODS["oak"],
            sigma=0.2,
            alpha=0.05,
            eta=1.5,
        ),
        _named(
            "walnut-varnished",
            "varnished-wood",
            coated_rough,
            _WOODS["walnut"],
            sigma=0.2,
            alpha=0.03,
            eta=1.5,
        ),
        _named(
            "pine-raw",
            "raw-wood",
            rough_diffuse,
            _WOODS["pine"],
            sigma=0.4,
            specular=0.3,
            alpha=0.5,
        ),
        _named(
            "marble-polished",
            "polished-stone",
            coated_rough,
            _STONES["marble"],
            sigma=0.0,
            alpha=0.02,
            eta=1.55,
        ),
        _named(
            "granite-polished",
            "polished-stone",
            coated_rough,
            _STONES["granite"],
            sigma=0.1,
            alpha=0.03,
            eta=1.55,
        ),
        _named(
            "sandstone",
            "rough-stone",
            rough_diffuse,
            _STONES["sandstone"],
            sigma=0.6,
            specular=0.05,
            alpha=0.7,
        ),
        _named(
            "concrete",
            "rough-stone",
            rough_diffuse,
            _STONES["concrete"],
            sigma=0.5,
            specular=0.1,
            alpha=0.6,
        ),
        _named("white-paper", "paper", rough_diffuse, "white", sigma=0.15, specular=0.4, alpha=0.6),
        _named(
            "cardboard",
            "paper",
            rough_diffuse,
            (0.42, 0.26, 0.13),
            sigma=0.3,
            specular=0.2,
            alpha=0.7,
        ),
        _named(
            "white-plaster", "plaster", rough_diffuse, "white", sigma=0.5, specular=0.0, alpha=1.0
        ),
        _named(
            "chalk",
            "plaster",
            rough_diffuse,
            (0.86, 0.86, 0.85),
            sigma=0.8,
            specular=0.0,
            alpha=1.0,
        ),
        _named("candle-wax", "wax", wax, "ivory", alpha=0.3, sheen=0.15),
        _named("skin-like-wax", "wax", wax, (0.55, 0.30, 0.20), alpha=0.35, sheen=0.1),
        _named(
            "greasy-iron-pan",
            "greasy",
            greasy,
            "black",
            sigma=0.3,
            alpha=0.5,
            film_alpha=0.08,
            film=0.7,
        ),
        _named(
            "oiled-cardboard",
            "greasy",
            greasy,
            (0.25, 0.14, 0.06),
            sigma=0.4,
            alpha=0.6,
            film_alpha=0.15,
            film=0.6,
        ),
    ]
    by_name = {material.name: material for material in plain}
    return [
        *plain,
        _dusty_anchor("dusty-black-plastic", by_name["black-plastic"], beige, 0.4),
        _dusty_anchor("dusty-chrome", by_name["chrome"], beige, 0.5),
        _dusty_anchor("dusty-red-car-paint", by_name["red-car-paint"], beige, 0.35),
    ]


def _round_robin(anchors: list[Material]) -> list[Material]:
    """The first anchor of every family, then the second of every family, and so on."""
    seen: dict[str, int] = {}
    keys = []
    for material in anchors:
        turn = seen.get(material.family, 0)
        seen[material.family] = turn + 1
        keys.append((turn, FAMILIES.index(material.family)))
    return [anchors[i] for i in sorted(range(len(anchors)), key=keys.__getitem__)]


def materials(seed: int = 0, count: int = 256, start: int = 0) -> Iterator[Material]:
    """Stream `count` materials: the anchors, then random members, family after family.

    A longer stream begins with the shorter one of the same seed, and any stretch of it spreads
    over the families. The anchors do not depend on the seed.

    Parameters
    ----------
    seed : int
        Not negative.
    count : int
        At least 0; thousands are fine, nothing is kept.
    start : int
        Leave out so many of the `count`.

    Raises
    ------
    ValueError
    """
    for name, value in (("seed", seed), ("count", count), ("start", start)):
        if not isinstance(value, int | np.integer) or value < 0:
            raise ValueError(f"{name}: expected an integer of at least 0, got {value!r}")
    return _stream(int(seed), int(count), int(start))


def _stream(seed: int, count: int, start: int) -> Iterator[Material]:
    anchors = _round_robin(_anchors())
    yield from anchors[start:count]
    for i in range(max(start - len(anchors), 0), count - len(anchors)):
        step, turn = divmod(i, len(FAMILIES))
        family = FAMILIES[turn]
        name, model, parameters = _RECIPES[family](_Draw(seed, turn, step))
        # the number is the member's own in its family: unique without remembering any name
        yield Material(f"{name}-{step + 1}", family, model, parameters)
