"""Named materials that are typical of their families."""

from __future__ import annotations

from collections.abc import Callable

from traitbrdf.recipes.looks import (
    COLOURS,
    METALS,
    RGB,
    STONES,
    WOODS,
    Material,
    Parameters,
    anodised,
    car_paint,
    cloth,
    coated_rough,
    dusty,
    greasy,
    metal,
    metallic_paint,
    phenolic,
    plastic,
    rough_diffuse,
    rubber,
    silk,
    wax,
)
from traitbrdf.reflectance.models import (
    Model,
)

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


def anchor_materials() -> list[Material]:
    """Return the named materials, such as "blue-plastic"; they do not depend on any seed."""
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
            WOODS["oak"],
            sigma=0.2,
            alpha=0.05,
            eta=1.5,
        ),
        _named(
            "walnut-varnished",
            "varnished-wood",
            coated_rough,
            WOODS["walnut"],
            sigma=0.2,
            alpha=0.03,
            eta=1.5,
        ),
        _named(
            "pine-raw",
            "raw-wood",
            rough_diffuse,
            WOODS["pine"],
            sigma=0.4,
            specular=0.3,
            alpha=0.5,
        ),
        _named(
            "marble-polished",
            "polished-stone",
            coated_rough,
            STONES["marble"],
            sigma=0.0,
            alpha=0.02,
            eta=1.55,
        ),
        _named(
            "granite-polished",
            "polished-stone",
            coated_rough,
            STONES["granite"],
            sigma=0.1,
            alpha=0.03,
            eta=1.55,
        ),
        _named(
            "sandstone",
            "rough-stone",
            rough_diffuse,
            STONES["sandstone"],
            sigma=0.6,
            specular=0.05,
            alpha=0.7,
        ),
        _named(
            "concrete",
            "rough-stone",
            rough_diffuse,
            STONES["concrete"],
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
