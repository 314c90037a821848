"""Masks: where a layer of a design applies, and how much.

A mask is a frozen dataclass that gives each part a weight in [0, 1]. Strokes keep what was drawn
beside it, so that a layer can be replayed as the stroke that it was.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Self, TypeAlias

from traitbrdf.design.strokes import Stroke
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.scene import Scene

Weights: TypeAlias = tuple[tuple[str, float], ...]
Target: TypeAlias = "str | Iterable[str] | Mapping[str, float]"
"""Parts to edit: a name, several, or a weight in [0, 1] for each."""


class Framing(NamedTuple):
    """Where on the image things lie: strokes in pixels mean something under one framing alone."""

    camera: Camera
    height: int
    width: int

    @classmethod
    def of(cls, scene: Scene) -> Self:
        """Return the framing of a scene."""
        return cls(scene.camera, scene.height, scene.width)


@dataclass(frozen=True)
class Parts:
    """Whole parts.

    Attributes
    ----------
    weights : (part, weight) pairs
        Weights are in [0, 1]; at least one part.
    """

    weights: Weights

    def __post_init__(self) -> None:
        names = [name for name, _ in self.weights]
        if not names:
            raise ValueError("part: expected at least one name, got none")
        if len(set(names)) < len(names):
            raise ValueError(f"part: expected each part once, got {names}")
        for name, weight in self.weights:
            if not isinstance(name, str):
                raise TypeError(f"part: expected a name, got {name!r}")
            if not (math.isfinite(weight) and 0.0 <= weight <= 1.0):
                raise ValueError(f"weight of {name!r}: expected 0 to 1, got {weight!r}")

    @classmethod
    def of(cls, target: Target) -> Self:
        """Return the mask of a part, of several, or of weighted ones."""
        if isinstance(target, Mapping):
            return cls(tuple((name, float(weight)) for name, weight in target.items()))
        names = [target] if isinstance(target, str) else dict.fromkeys(target)
        return cls(tuple((name, 1.0) for name in names))

    def source(self) -> str:
        """Return the target as Python source."""
        names = [name for name, _ in self.weights]
        if any(weight != 1.0 for _, weight in self.weights):
            return repr(dict(self.weights))
        return repr(names[0] if len(names) == 1 else names)


@dataclass(frozen=True)
class Painted(Parts):
    """The parts that a stroke on the image touches, each by its share of the stroke.

    Attributes
    ----------
    stroke : Stroke, in pixels of the image
    framing : Framing, of the image
    only : the parts that were free to change; None is all
    """

    stroke: Stroke
    framing: Framing
    only: tuple[str, ...] | None = None
