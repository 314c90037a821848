"""Procedural materials: named, seeded and physically plausible, of many families.

`materials` streams them. First come hand-made anchors with plain names ("blue-plastic"),
round-robin over the families so that any prefix is varied; then random members, family by family.
Every material is isotropic and reciprocal and has a proven or checked albedo of at most 1
(``model.energy_bounded``): layers are coats (`Coated`, `Plastic`), convex mixtures, or sums whose
albedos add up to at most 1. Colours are linear Rec.709 albedos.

A seed gives the same materials on every processor, because numbers are rounded
(`traitbrdf.recipes.looks.rounded`) before models, names or choices depend on them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from traitbrdf.recipes.anchors import anchor_materials
from traitbrdf.recipes.families import FAMILIES, RECIPES, Draw
from traitbrdf.recipes.looks import Material


def _round_robin(anchors: list[Material]) -> list[Material]:
    """Return the first anchor of every family, then the second of every family, and so on."""
    seen: dict[str, int] = {}
    keys = []
    for material in anchors:
        turn = seen.get(material.family, 0)
        seen[material.family] = turn + 1
        keys.append((turn, FAMILIES.index(material.family)))
    return [anchors[i] for i in sorted(range(len(anchors)), key=keys.__getitem__)]


def materials(seed: int = 0, count: int = 256, start: int = 0) -> Iterator[Material]:
    """Stream materials: the anchors, then random members, family by family.

    A longer stream begins with the shorter one of the same seed, and any stretch of it covers many
    families. The anchors do not depend on the seed.

    Parameters
    ----------
    seed : int
        Not negative.
    count : int
        Total number of materials, at least 0. The stream keeps none of them.
    start : int
        Number of materials to skip; `count` includes them.

    Raises
    ------
    ValueError
        On anything but integers of at least 0.
    """
    for name, value in (("seed", seed), ("count", count), ("start", start)):
        if not isinstance(value, int | np.integer) or value < 0:
            raise ValueError(f"{name}: expected an integer of at least 0, got {value!r}")
    return _stream(int(seed), int(count), int(start))


def _stream(seed: int, count: int, start: int) -> Iterator[Material]:
    anchors = _round_robin(anchor_materials())
    yield from anchors[start:count]
    for i in range(max(start - len(anchors), 0), count - len(anchors)):
        step, turn = divmod(i, len(FAMILIES))
        family = FAMILIES[turn]
        name, model, parameters = RECIPES[family](Draw(seed, turn, step))
        # numbered within the family: unique without a list of all names
        yield Material(f"{name}-{step + 1}", family, model, parameters)
