"""What the lists of the page say: groups of traits, layers, the history."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from traitbrdf.design.layers import Layer

_GROUPS: dict[str, tuple[str, ...]] = {
    "look": ("shiny", "metallic", "rough", "dusty", "bright"),
    "highlight": ("glossy", "matte", "strength", "sharpness", "tint", "specular"),
    "touch": ("soft", "hard", "greasy", "diffuse"),
    "made of": ("silver", "gold", "plastic", "acrylic", "ceramic", "rubber", "fabric"),
    "colour": ("red", "green", "blue"),
}
"""What traits are about; the first group is the one that is needed most."""


def grouped(names: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Return titles and traits of the groups, those that no group knows last."""
    known = {name for group in _GROUPS.values() for name in group}
    groups = [(title, [n for n in group if n in names]) for title, group in _GROUPS.items()]
    groups.append(("yours", [name for name in names if name not in known]))
    return [(title, group) for title, group in groups if group]


def layer_told(layer: Layer) -> dict[str, Any]:
    """Return what a list of layers shows of one."""
    return {
        "name": layer.name, "effect": shortened(repr(layer.effect)),
        "parts": ", ".join(layer.mask.parts) or "nothing", "opacity": layer.opacity,
        "visible": layer.visible, "local": layer.local,
    }  # fmt: skip


def shortened(line: str) -> str:
    """Shorten a line of the history: long strokes are told by their number of points.

    Numbers are rounded to four digits.
    """
    line = re.sub(r"\d+\.\d{5,}(e[-+]?\d+)?", lambda found: f"{float(found[0]):.4g}", line)
    start, _, rest = line.partition("Stroke([")
    points, close, end = rest.partition("], trait=")
    if not close or points.count("(") <= 2:
        return line if len(line) < 160 else f"{line[:150]} ..."
    return f"{start}Stroke(<{points.count('(')} points>, trait={end}"
