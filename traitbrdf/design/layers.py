"""Layers: an effect, a mask and an opacity each."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

from traitbrdf.arguments import number
from traitbrdf.design.effects import Effect, Move, Named, table_name
from traitbrdf.design.masks import Brushed, Framing, Local, Mask, Painted, Parts

KEYS = itertools.count()
"""Numbers that tell layers apart."""


@dataclass(frozen=True)
class Layer:
    """One layer of a design.

    Attributes
    ----------
    effect : Effect, what changes
    mask : Mask, where and how much
    opacity : in [0, 1], scales the effect
    visible : whether the layer counts at all
    name : for people; may be empty
    key : int
        Tells this layer from all others of the process, however its settings change; it is not
        part of the value.
    """

    effect: Effect
    mask: Mask
    opacity: float = 1.0
    visible: bool = True
    name: str = ""
    key: int = field(default_factory=lambda: next(KEYS), compare=False, repr=False)

    def __post_init__(self) -> None:
        if not isinstance(self.effect, Effect):
            raise TypeError(f"effect: expected an effect such as tb.Move, got {self.effect!r}")
        if not isinstance(self.mask, Mask):
            raise TypeError(f"mask: expected a mask, got {self.mask!r}")
        object.__setattr__(self, "opacity", number(self.opacity, "opacity"))
        if not 0.0 <= self.opacity <= 1.0:
            raise ValueError(f"opacity: expected 0 to 1, got {self.opacity!r}")
        if not isinstance(self.visible, bool):
            raise TypeError(f"visible: expected True or False, got {self.visible!r}")
        if not isinstance(self.name, str):
            raise TypeError(f"name: expected a string, got {self.name!r}")

    @property
    def local(self) -> bool:
        """Whether its mask differs from point to point."""
        return isinstance(self.mask, Local)

    def weight(self, part: str) -> float:
        """Return how much of the effect the whole of a part gets.

        It is 0 where the layer does not count, and where only some of the part gets it.
        """
        if isinstance(self.mask, Local):
            return 0.0
        return self.strength * dict(self.mask.weights).get(part, 0.0)

    @property
    def strength(self) -> float:
        """Its opacity; 0 if it is hidden."""
        return self.opacity if self.visible else 0.0

    @property
    def anywhere(self) -> set[str]:
        """The parts that the layer may lead anywhere in the gamut."""
        if not self.effect.anywhere and self.opacity == 1.0 and not self.local:
            return set()
        return set(self.mask.parts)

    def calls(self, framing: Framing, named: Named = table_name, idle: bool = False) -> list[str]:
        """Return the Python statements that add the layer to an `EditSession`.

        Parameters
        ----------
        framing : Framing
            A stroke that was painted under another one is told as the parts that it touched.
        named : as for `Effect.call`
        idle : bool
            Whether the effect does nothing at present, so that a call could refuse it.
        """
        settings = [
            f"edit.layers[-1].{name} = {value!r}"
            for name, value, usual in (
                ("name", self.name, ""),
                ("opacity", self.opacity, 1.0),
                ("visible", self.visible, True),
            )
            if value != usual
        ]
        if isinstance(self.mask, Local):
            return [*self._painted(self.mask, framing, named), *settings]
        return [self._added(self.mask, framing, named, idle), *settings]

    def _painted(self, mask: Local, framing: Framing, named: Named) -> list[str]:
        """Return the statements that paint a local mask."""
        effect = self.effect.source(named)
        strokes = [*mask.strokes]
        said = []
        if strokes and not strokes[0].erase:
            first = strokes.pop(0)
            stroke, how = _drawn(first, framing)
            said.append(f"edit.paint({stroke}, {effect}, where='local'{how})")
        else:
            said.append(f"edit.layers.add({effect})")
        for one in strokes:
            call = "erase" if one.erase else "paint"
            said.append(f"edit.layers[-1].{call}({''.join(_drawn(one, framing))})")
        if mask.only is not None:
            said.append(f"edit.layers[-1].clip({mask.only!r})")
        if mask.inverted:
            said.append("edit.layers[-1].invert()")
        return said

    def _added(self, mask: Parts, framing: Framing, named: Named, idle: bool) -> str:
        effect = self.effect
        if not isinstance(mask, Painted) or mask.framing != framing:
            if idle:
                return f"edit.apply({mask.source()}, {effect.source(named)})"
            return effect.call(mask.source(), named)
        said = [repr([*mask.stroke.points])]
        plain = isinstance(effect, Move) and len(effect.amounts) == 1 and effect.photoreal
        if isinstance(effect, Move) and plain and not idle:
            ((trait, amount),) = effect.amounts
            said += [f"trait={trait!r}", f"amount={amount!r}"]
            hold = "" if effect.hold is None else f", hold={effect.hold!r}"
            beside = ""
        else:
            hold, beside = "", f", {effect.source(named)}"
        said.append(f"radius={float(mask.stroke.radius)!r}{hold}")
        if mask.only is not None:
            only = mask.only[0] if len(mask.only) == 1 else mask.only
            beside += f", only={only!r}"
        return f"edit.paint(tb.Stroke({', '.join(said)}){beside})"

    def __str__(self) -> str:
        hidden = "" if self.visible else ", hidden"
        faint = "" if self.opacity == 1.0 else f", opacity {self.opacity:g}"
        name = f"{self.name!r}: " if self.name else ""
        if isinstance(self.mask, Local):
            count = len(self.mask.strokes)
            where = f"{', '.join(self.mask.parts) or 'nothing'} ({count} strokes"
            where += ", inverted)" if self.mask.inverted else ")"
        else:
            where = ", ".join(
                part if weight == 1.0 else f"{part} ({weight:.0%})"
                for part, weight in self.mask.weights
            )
        return f"{name}{self.effect!r} on {where}{faint}{hidden}"


def _drawn(one: Brushed, framing: Framing) -> tuple[str, str]:
    """Return a stroke on the surface, and the keywords it is painted with, as Python source."""
    stroke = one.stroke
    said = [repr([*stroke.points]), f"radius={float(stroke.radius)!r}"]
    for name, usual in (("hardness", 0.5), ("flow", 1.0), ("pressure", None), ("units", "pixels")):
        value = getattr(stroke, name)
        if value != usual:
            said.append(f"{name}={value!r}")
    across = ", across=True" if one.across else ""
    seen = "" if one.framing == framing else f", framing={one.framing.source()}"
    return f"tb.Stroke({', '.join(said)})", across + seen
