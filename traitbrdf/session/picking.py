"""What is seen at a place of the image: the picker, and lobes that show light there."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from traitbrdf.design.colours import Highlight
from traitbrdf.design.document import Document
from traitbrdf.design.masks import Local
from traitbrdf.design.surface import SurfaceWeights, points_of
from traitbrdf.scene.scene import Scene
from traitbrdf.space.material import Material
from traitbrdf.space.traits import TraitSpace
from traitbrdf.transport.transport import Transport

_CRESTS = np.arange(0.0, 61.0, 2.0)
"""Angles in degrees at which a created highlight may have its crest."""


@dataclass(frozen=True)
class Picked:
    """What is seen at a place of the image.

    Attributes
    ----------
    part : str
        Name of the part.
    material : Material, all layers counted
    scores : mapping of trait to score
    layers : mapping of index to amount
        The layers of the stack that count there, 0 the lowest; opacity times mask, in (0, 1].
    names : mapping of index to name, of layers that have one
    """

    part: str
    material: Material
    scores: Mapping[str, float]
    layers: Mapping[int, float]
    names: Mapping[int, str]

    def __str__(self) -> str:
        said = [
            f"{i}{f' {self.names[i]!r}' if i in self.names else ''}"
            + ("" if amount == 1.0 else f" ({amount:.0%})")
            for i, amount in self.layers.items()
        ]
        layers = f"; layers: {', '.join(said)}" if said else ""
        return f"{self.part}: {self.material.name or 'a material of its own'}{layers}"


def pick(
    scene: Scene, place: tuple[float, float], document: Document, traits: TraitSpace
) -> Picked | None:
    """Return what is seen at a place of the image; None where no part is.

    Parameters
    ----------
    scene : Scene
    place : (x, y) in pixels from the top left corner
    document : Document
    traits : TraitSpace
    """
    hits = scene.hits(np.array([place[0]]), np.array([place[1]]))
    if hits.part[0] < 0:
        return None
    part = scene.parts[hits.part[0]]
    here = SurfaceWeights(scene, points_of(hits))
    varying, material = document.varying(part), document.materials[part]
    if varying is not None:
        material = varying.material(here.amounts(varying)[:, 0].tolist())
    amounts = {}
    for i, layer in enumerate(document.design.layers):
        weight = layer.weight(part)
        if isinstance(layer.mask, Local):
            weight = layer.strength * float(here.of(layer.mask)[0])
        if weight > 0.0:
            amounts[i] = weight
    names = {i: document.design.layers[i].name for i in amounts if document.design.layers[i].name}
    return Picked(part, material, traits.score(material.z), amounts, names)


def _row_at(scene: Scene, transport: Transport, place: tuple[float, float]) -> NDArray[np.float64]:
    """Return the row of the operator (cells,), all colours added, at a place of the image."""
    x, y = (math.floor(value) for value in place)
    inside = 0 <= x < scene.width and 0 <= y < scene.height
    found = np.flatnonzero(scene.pixels == y * scene.width + x)
    if not inside or not len(found):
        raise ValueError(f"at: expected a place where a part is seen, got {place}")
    fragment = found[np.argmax(scene.weights[found])]
    row = transport.exact_rows(np.array([fragment]))[0]
    return np.asarray(row.sum(axis=0) / scene.weights[fragment], np.float64)


def white_at(scene: Scene, transport: Transport, place: tuple[float, float]) -> float:
    """Return the radiance of a white matte surface at a place of the image, mean of the colours."""
    return float(_row_at(scene, transport, place).sum()) / (3.0 * math.pi)


def lobe_at(
    scene: Scene,
    transport: Transport,
    place: tuple[float, float],
    intensity: float,
    width: float,
    rgb: tuple[float, float, float],
) -> Highlight:
    """Return the lobe that shows most light at a place of the image, of an intensity there.

    Parameters
    ----------
    scene : Scene
    transport : Transport
    place : (x, y) in pixels
    intensity : float
        Radiance that it adds there, as a share of a white matte surface's.
    width : float
        In degrees, see `Highlight`.
    rgb : (3,)
    """
    row = _row_at(scene, transport, place)
    white = row.sum() / math.pi
    if white <= 0.0:
        raise ValueError(f"at: expected a place where light arrives, got {place}")
    grid = transport.grid
    lobes = [Highlight(strength=1.0, at=float(a), width=width, rgb=rgb) for a in _CRESTS]
    shown = np.array([row @ lobe.lobe(grid) for lobe in lobes])
    # of lobes that show nearly as much light, the one nearest to the mirror direction
    best = int(np.flatnonzero(shown >= 0.9 * shown.max())[0])
    colour = max(float(np.mean(rgb)), 1e-9)
    return dataclasses.replace(
        lobes[best], strength=float(intensity * white / shown[best] / colour)
    )
