"""Masks: where a layer of a design applies, and how much.

A mask is a frozen dataclass with ``parts``, the names of the parts that it may touch. `Parts` and
`Painted` give each of them one weight in [0, 1]; `Local` gives one to each point of the surface
(`traitbrdf.scene.trails` computes it). Strokes are kept as they were drawn, with the camera that
they were drawn under, so that a layer can be replayed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self, TypeAlias

from traitbrdf.arguments import number
from traitbrdf.design.strokes import Stroke
from traitbrdf.formats.files import unknown_name
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

    def source(self) -> str:
        """Return the framing as Python source."""
        return f"(tb.{self.camera!r}, ({self.height}, {self.width}))"


Seen: TypeAlias = tuple[Camera, tuple[int, int]]
"""A camera, and (height, width) of the image in pixels, as calls have it."""


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
            return cls(
                tuple(
                    (name, number(weight, f"weight of {name!r}")) for name, weight in target.items()
                )
            )
        if not isinstance(target, Iterable):
            raise TypeError(f"part: expected names of parts, got {target!r}")
        names = [target] if isinstance(target, str) else dict.fromkeys(target)
        return cls(tuple((name, 1.0) for name in names))

    @cached_property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts."""
        return tuple(name for name, _ in self.weights)

    def source(self) -> str:
        """Return the target as Python source."""
        names = self.parts
        if any(weight != 1.0 for _, weight in self.weights):
            return repr(dict(self.weights))
        return repr(names[0] if len(names) == 1 else [*names])


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


@dataclass(frozen=True)
class Brushed:
    """A stroke on the surface, as a mask keeps it.

    Attributes
    ----------
    stroke : Stroke
        Its points are pixels of an image; trait, amount and hold do not count.
    framing : Framing
        Of that image.
    parts : tuple of str
        The parts that it may paint on; at least one.
    erase : bool
        Whether it takes paint away.
    across : bool
        Whether paint flows from part to part.
    """

    stroke: Stroke
    framing: Framing
    parts: tuple[str, ...]
    erase: bool = False
    across: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.stroke, Stroke) or not isinstance(self.framing, Framing):
            raise TypeError(f"stroke: expected a Stroke and a Framing, got {self.stroke!r}")
        if not self.parts or not all(isinstance(name, str) for name in self.parts):
            raise ValueError(f"parts: expected at least one name, got {self.parts!r}")


@dataclass(frozen=True)
class Local:
    """Soft strokes on the surface.

    The weight of a point is the largest that any stroke gives it: to go over a place twice is to
    paint it once. Strokes that erase multiply what is there by 1 minus their own weight, in the
    order in which they were painted.

    Attributes
    ----------
    strokes : tuple of Brushed
        None at all is a mask that is 0 everywhere.
    whole : tuple of str
        All parts of the design.
    inverted : bool
        Whether the weight is 1 minus that of the strokes, on all parts.
    only : tuple of str, or None
        The weight is 0 on all other parts; None is no limit.
    """

    strokes: tuple[Brushed, ...]
    whole: tuple[str, ...]
    inverted: bool = False
    only: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        for one in self.strokes:
            if not isinstance(one, Brushed):
                raise TypeError(f"strokes: expected strokes on the surface, got {one!r}")
        if not isinstance(self.inverted, bool):
            raise TypeError(f"inverted: expected True or False, got {self.inverted!r}")
        for name in (*(name for one in self.strokes for name in one.parts), *(self.only or ())):
            if name not in self.whole:
                raise ValueError(unknown_name("part", name, self.whole))

    @cached_property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts where the weight may be above 0."""
        painted = {name for one in self.strokes if not one.erase for name in one.parts}
        return tuple(
            name
            for name in self.whole
            if (self.inverted or name in painted) and (self.only is None or name in self.only)
        )

    def with_stroke(self, stroke: Brushed) -> Local:
        """Return the mask with one more stroke."""
        return replace(self, strokes=(*self.strokes, stroke))


Mask: TypeAlias = Parts | Local
"""Where a layer applies."""
