"""Families of materials, and how the members of each are drawn."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from traitbrdf.recipes.looks import (
    COLOURS,
    METALS,
    NEUTRAL,
    RGB,
    STONES,
    WOODS,
    Parameters,
    anodised,
    car_paint,
    cloth,
    coated_rough,
    desaturate,
    dusty,
    greasy,
    hazy,
    metal,
    metallic_paint,
    over,
    pearl,
    phenolic,
    plastic,
    retro_reflective,
    rough_diffuse,
    rounded,
    rubber,
    scaled,
    silk,
    wax,
)
from traitbrdf.reflectance.models import (
    ABC,
    Beckmann,
    BlinnPhong,
    Lambert,
    Model,
    ShiftedGamma,
    Ward,
    fresnel_conductor,
)


class Draw:
    """The random choices for one material, independent of all other materials.

    Roughnesses step through their range by the golden ratio, so that even few members spread over
    it.

    Parameters
    ----------
    seed : int
        Not negative.
    family : int
        Index of the family.
    step : int
        Number of the material in its family.
    """

    def __init__(self, seed: int, family: int, step: int) -> None:
        self.rng = np.random.default_rng((seed, family, step))
        offset = float(np.random.default_rng((seed, family)).random())
        self._phase = (offset + step * 0.6180339887498949) % 1.0

    def uniform(self, low: float, high: float) -> float:
        """Return a random number between `low` and `high`."""
        return rounded(self.rng.uniform(low, high))

    def log(self, low: float, high: float) -> float:
        """Return a random number between `low` and `high`, uniform on a logarithmic scale."""
        return rounded(math.exp(self.rng.uniform(math.log(low), math.log(high))))

    def spread(self, low: float, high: float) -> float:
        """Return a number in [low, high] that steps evenly on a log scale from member to member.

        Parameters
        ----------
        low, high : float
            Above zero.
        """
        return rounded(math.exp(math.log(low) + self._phase * math.log(high / low)))

    def pick(self, names: Mapping[str, RGB] | tuple[str, ...]) -> str:
        """Return one of `names` at random."""
        options = tuple(names)
        return options[int(self.rng.integers(len(options)))]

    def vary(self, colour: RGB, amount: float = 0.15) -> RGB:
        """Return `colour` with random changes of each channel and of the whole.

        Parameters
        ----------
        colour : (3,) albedo
        amount : float
            Standard deviation of the change of the whole, on a log scale.
        """
        changes = self.rng.normal(0.0, amount * 0.5, 3) + self.rng.normal(0.0, amount)
        r, g, b = (rounded(min(c * math.exp(x), 0.9)) for c, x in zip(colour, changes, strict=True))
        return r, g, b

    def colour(self, names: tuple[str, ...] | None = None) -> tuple[str, RGB]:
        """Return the name and a varied albedo of one of `COLOURS`.

        Parameters
        ----------
        names : tuple of str or None
            Names to choose from; None is all.
        """
        name = self.pick(names or COLOURS)
        return name, self.vary(COLOURS[name])


_Made: TypeAlias = tuple[str, Model, Parameters]
_Recipe: TypeAlias = Callable[[Draw], _Made]


def _finish(alpha: float) -> str:
    return "glossy" if alpha < 0.06 else "satin" if alpha < 0.3 else "matte"


def _metal_family(adjective: str, low: float, high: float) -> _Recipe:
    def make(draw: Draw) -> _Made:
        name = draw.pick(tuple(METALS))
        eta, k = METALS[name]
        # alloys and treated metals differ from the pure element
        eta = _times(eta, draw.uniform(0.92, 1.08))
        k = _times(k, draw.uniform(0.92, 1.08))
        alpha = draw.spread(low, high)
        return f"{adjective}-{name}", metal(eta, k, alpha), {"eta": eta, "k": k, "alpha": alpha}

    return make


def _times(rgb: RGB, factor: float) -> RGB:
    r, g, b = (rounded(c * factor) for c in rgb)
    return r, g, b


def _anodised(draw: Draw) -> _Made:
    name, colour = draw.colour()
    colour = scaled(colour, 1.0, normalise=draw.uniform(0.4, 0.9))
    alpha = draw.spread(0.03, 0.5)
    model = anodised(colour, alpha)
    return f"anodised-{name}-metal", model, {"colour": colour, "alpha": alpha}


def _paint_family(
    noun: str, recipe: Callable[[RGB, float, float, float], Model], low: float, high: float
) -> _Recipe:
    def make(draw: Draw) -> _Made:
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
    def make(draw: Draw) -> _Made:
        name, colour = draw.colour()
        alpha, index = draw.spread(low, high), draw.uniform(*eta)
        values: Parameters = {"colour": colour, "alpha": alpha, "eta": index}
        first = adjective or _finish(alpha)
        return f"{first}-{name}-{noun}", plastic(colour, alpha, index), values

    return make


def _phenolic(draw: Draw) -> _Made:
    name, colour = draw.colour()
    specular, exponent = draw.uniform(0.03, 0.09), draw.spread(8.0, 2e4)
    values: Parameters = {"colour": colour, "specular": specular, "exponent": exponent}
    adjective = _finish(math.sqrt(2.0 / (exponent + 2.0)))
    return f"{adjective}-{name}-phenolic", phenolic(colour, specular, exponent), values


def _rubber(draw: Draw) -> _Made:
    name, colour = draw.colour()
    colour = scaled(colour, 0.7)
    specular, width = draw.log(0.01, 0.06), draw.spread(0.12, 0.7)
    sigma = draw.uniform(0.1, 0.6)
    values: Parameters = {"colour": colour, "specular": specular, "width": width, "sigma": sigma}
    adjective = "smooth" if width < 0.25 else "dull"
    return f"{adjective}-{name}-rubber", rubber(colour, specular, width, sigma), values


def _cloth_family(
    nouns: tuple[str, ...], sheen: tuple[float, float], scale: float, alpha: tuple[float, float]
) -> _Recipe:
    def make(draw: Draw) -> _Made:
        name, colour = draw.colour()
        colour = scaled(colour, scale)
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


def _silk(draw: Draw) -> _Made:
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
    def make(draw: Draw) -> _Made:
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
    def make(draw: Draw) -> _Made:
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


def _wax(draw: Draw) -> _Made:
    name, colour = draw.colour()
    alpha, sheen = draw.spread(0.12, 0.6), draw.uniform(0.05, 0.25)
    values: Parameters = {"colour": colour, "alpha": alpha, "sheen": sheen}
    return f"{_finish(alpha)}-{name}-wax", wax(colour, alpha, sheen), values


def _greasy(draw: Draw) -> _Made:
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


def _dusty(draw: Draw) -> _Made:
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


def _reflectance(draw: Draw, metallic: bool) -> tuple[str, RGB]:
    """Return a name and the reflectance at normal incidence of a metal or a dielectric."""
    if not metallic:
        r0 = draw.uniform(0.02, 0.12)
        return "", (r0, r0, r0)
    name = draw.pick(tuple(METALS))
    eta, k = (np.array(values) for values in METALS[name])
    r, g, b = (float(v) for v in fresnel_conductor(1.0, eta, k))
    bare = draw.vary((r, g, b), 0.1)
    if draw.uniform(0.0, 1.0) < 0.6:
        return name, bare
    # under a clear dye that light crosses several times, as on saturated candy wrappers
    dye = draw.pick(COLOURS)
    passes = draw.uniform(0.5, 2.0)
    r, g, b = (
        rounded(v * c**passes)
        for v, c in zip(bare, scaled(COLOURS[dye], 1.0, normalise=1.0), strict=True)
    )
    return f"{dye}-{name}", (r, g, b)


def _lobe_family(adjective: str, lobe: Callable[[Draw, RGB], tuple[Model, Parameters]]) -> _Recipe:
    """Return a recipe: each member is the lobe alone, as a metal, or the lobe over a body."""

    def make(draw: Draw) -> _Made:
        metallic = draw.uniform(0.0, 1.0) < 0.35
        noun, r0 = _reflectance(draw, metallic)
        model, values = lobe(draw, r0)
        values["reflectance"] = r0
        if metallic:
            # interreflection and dust scatter some light even far from a metal's lobe
            share, stray = draw.uniform(0.5, 0.95), draw.log(0.003, 0.05)
            values |= {"share": share, "stray": stray}
            return f"{adjective}-{noun}", share * model + Lambert(stray), values
        name, colour = draw.colour()
        sigma, weight = draw.uniform(0.0, 0.8), draw.log(0.03, 0.9)
        values |= {"colour": colour, "sigma": sigma, "weight": weight}
        return f"{adjective}-{name}-enamel", over(colour, sigma, weight, model), values

    return make


def _hazy(draw: Draw, r0: RGB) -> tuple[Model, Parameters]:
    alpha = draw.spread(0.002, 0.6)
    wide = min(1.0, rounded(alpha * draw.log(1.5, 60.0)))
    gamma, wide_gamma = draw.uniform(0.9, 3.5), draw.uniform(0.6, 3.0)
    haze = draw.log(0.01, 0.8)
    values: Parameters = {
        "alpha": alpha, "gamma": gamma, "haze": haze, "wide": wide, "wide_gamma": wide_gamma
    }  # fmt: skip
    return hazy(r0, alpha, gamma, haze, wide, wide_gamma), values


def _polished(draw: Draw, r0: RGB) -> tuple[Model, Parameters]:
    b, c = rounded(2.0 / draw.spread(0.002, 0.6) ** 2), draw.uniform(0.4, 2.5)
    return ABC(1.0, r0, b, c), {"b": b, "c": c}


def _shifted(draw: Draw, r0: RGB) -> tuple[Model, Parameters]:
    alpha, p = draw.spread(0.002, 0.9), draw.uniform(0.2, 1.8)
    return ShiftedGamma(1.0, r0, alpha, p), {"alpha": alpha, "p": p}


def _blasted(draw: Draw, r0: RGB) -> tuple[Model, Parameters]:
    alpha = draw.spread(0.02, 1.0)
    if draw.uniform(0.0, 1.0) < 0.5:
        return Beckmann(1.0, r0, alpha), {"alpha": alpha}
    n = max(rounded(2.0 / alpha**2), 1.0)
    return BlinnPhong(1.0, r0, n), {"n": n}


def _ward(draw: Draw) -> _Made:
    name, colour = draw.colour()
    alpha, weight = draw.spread(0.01, 0.4), draw.log(0.01, 0.4)
    values: Parameters = {"colour": colour, "alpha": alpha, "weight": weight}
    return f"{_finish(alpha)}-{name}-lacquer", over(colour, 0.2, weight, Ward(1.0, alpha)), values


def _pearl(draw: Draw) -> _Made:
    name, colour = draw.colour()
    tint = scaled(COLOURS[draw.pick(COLOURS)], 1.0, normalise=draw.uniform(0.4, 0.95))
    tint = desaturate(tint, draw.uniform(0.0, 1.0))
    film, flakes = draw.uniform(0.0, 700.0), rounded(1.0 - draw.log(0.005, 0.8))
    index, fringes = draw.uniform(1.35, 2.4), draw.uniform(0.4, 1.0)
    flake_alpha, alpha = draw.log(0.08, 0.6), draw.spread(0.004, 0.2)
    values: Parameters = {
        "colour": colour, "flakes": flakes, "tint": tint, "film": film,
        "index": index, "fringes": fringes, "flake_alpha": flake_alpha, "alpha": alpha,
    }  # fmt: skip
    model = pearl(colour, flakes, tint, film, index, fringes, flake_alpha, alpha)
    return f"pearl-{name}-paint", model, values


def _retro(draw: Draw) -> _Made:
    name, colour = draw.colour()
    sigma, back, sharpness = draw.uniform(0.2, 1.0), draw.log(0.02, 0.4), draw.log(1.0, 60.0)
    specular, alpha = draw.log(0.02, 0.4), draw.spread(0.05, 0.8)
    values: Parameters = {
        "colour": colour, "sigma": sigma, "back": back, "sharpness": sharpness,
        "specular": specular, "alpha": alpha,
    }  # fmt: skip
    model = retro_reflective(colour, sigma, back, sharpness, specular, alpha)
    return f"beaded-{name}-coat", model, values


def _worn(draw: Draw) -> _Made:
    """Mix two materials of other families, finer than the eye resolves: wear, rust, threads."""
    others = [name for name in RECIPES if name != "worn"]
    share = draw.uniform(0.1, 0.9)
    first, second = (others[int(i)] for i in draw.rng.choice(len(others), 2, replace=False))
    (one, a, of_one), (two, b, of_two) = RECIPES[first](draw), RECIPES[second](draw)
    values: Parameters = {"share": share}
    for family, known in ((first, of_one), (second, of_two)):
        values |= {f"{family}.{name}": value for name, value in known.items()}
    words = one.split("-")[-1], two.split("-")[-1]
    return f"worn-{words[0]}-and-{words[1]}", (1.0 - share) * a + share * b, values


_NEUTRALS: Mapping[str, RGB] = MappingProxyType({name: COLOURS[name] for name in NEUTRAL[:5]})
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

RECIPES: Mapping[str, _Recipe] = MappingProxyType(
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
            "", WOODS, (0.1, 0.4), (0.01, 0.2), (1.48, 1.54), "varnished"
        ),
        "raw-wood": _rough_family("", WOODS, (0.2, 0.6), (0.05, 0.5), "raw"),
        "polished-stone": _film_family(
            "", STONES, (0.0, 0.2), (0.008, 0.15), (1.5, 1.65), "polished"
        ),
        "rough-stone": _rough_family("", STONES, (0.3, 1.0), (0.0, 0.25), "rough"),
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

FAMILIES: tuple[str, ...] = tuple(RECIPES)
"""Names of the families, in the order in which `materials` draws from them."""
