"""The stack of layers as a user handles it: found, read and set, each change one undoable step."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeAlias, overload

from traitbrdf.design.document import Design
from traitbrdf.design.effects import Effect, names_of
from traitbrdf.design.layers import KEYS, Layer
from traitbrdf.design.masks import Brushed, Local, Seen
from traitbrdf.design.strokes import Stroke
from traitbrdf.formats.files import unknown_name

Change: TypeAlias = Callable[[Callable[[Design], Design]], None]


Brush: TypeAlias = Callable[[Stroke, bool, bool, Seen | None], Brushed]
"""Puts a stroke on the surface: it is given whether to erase, whether paint flows across parts, and
the view that the stroke was drawn in."""


class StackedLayer:
    """A layer of a session's stack: its settings can be read and set, each change is undoable.

    It goes on meaning the same layer when others come, go or move. Setting a layer that is not in
    the design any more (undone or deleted) raises ValueError; so does reading it.

    Attributes
    ----------
    effect, mask, opacity, visible, name : as `Layer` has them
    """

    _key: int
    _read: Callable[[], Design]
    _change: Change
    _brush: Brush

    def __init__(self, key: int, read: Callable[[], Design], change: Change, brush: Brush) -> None:
        object.__setattr__(self, "_key", key)
        object.__setattr__(self, "_read", read)
        object.__setattr__(self, "_change", change)
        object.__setattr__(self, "_brush", brush)

    @property
    def layer(self) -> Layer:
        """The layer as a value."""
        return self._read().layers[self.index]

    @property
    def index(self) -> int:
        """Place in the stack: 0 is the lowest."""
        return self._read().place(self._key)

    def __getattr__(self, name: str) -> Any:
        if name in _SETTINGS:
            return getattr(self.layer, name)
        raise AttributeError(f"layer: expected one of {', '.join(_SETTINGS)}, got {name!r}")

    def __setattr__(self, name: str, value: object) -> None:
        if name not in _SETTINGS:
            raise AttributeError(f"layer: expected one of {', '.join(_SETTINGS)}, got {name!r}")
        self._change(lambda design: design.with_settings(self._key, **{name: value}))

    def delete(self) -> None:
        """Take the layer out of the stack."""
        self._change(lambda design: design.without(self._key))

    def move_to(self, index: int) -> None:
        """Move the layer to another place in the stack: 0 is the lowest, -1 the highest."""
        self._change(lambda design: design.with_order(self._key, index))

    def duplicate(self) -> StackedLayer:
        """Put an equal layer right above this one, and return it."""
        twin = replace(self.layer, key=next(KEYS))
        self._change(lambda design: design.with_layer_above(self._key, twin))
        return StackedLayer(twin.key, self._read, self._change, self._brush)

    # -- local masks ----------------------------------------------------------------------------

    def paint(self, stroke: Stroke, across: bool = False, framing: Seen | None = None) -> None:
        """Add a stroke to the layer's local mask.

        Parameters
        ----------
        stroke : Stroke
            Its trait, amount and hold do not count.
        across : bool
            Whether paint flows from the parts that the brush touches to others.
        framing : (Camera, (height, width)) or None
            Of the image that the stroke was drawn on; None is the scene's.

        Raises
        ------
        ValueError
            If the mask is one of whole parts, or the stroke touches no surface.
        """
        self._masked(self._local.with_stroke(self._brush(stroke, False, across, framing)))

    def erase(self, stroke: Stroke, across: bool = False, framing: Seen | None = None) -> None:
        """Take paint away from the layer's local mask; see `paint`."""
        self._masked(self._local.with_stroke(self._brush(stroke, True, across, framing)))

    def clear(self) -> None:
        """Remove all strokes from the layer's local mask."""
        self._masked(replace(self._local, strokes=(), inverted=False))

    def invert(self) -> None:
        """Paint what was not painted, and the other way round."""
        mask = self._local
        self._masked(replace(mask, inverted=not mask.inverted))

    def clip(self, parts: str | Iterable[str] | None) -> None:
        """Confine the layer's local mask to some parts; None lets go.

        Parameters
        ----------
        parts : name or names of parts, or None
        """
        only = None if parts is None else names_of(parts, "parts")
        self._masked(replace(self._local, only=only))

    @property
    def _local(self) -> Local:
        mask = self.layer.mask
        if not isinstance(mask, Local):
            raise ValueError(
                f"layer: expected one that is painted locally, got one of whole parts: {self.layer}"
            )
        return mask

    def _masked(self, mask: Local) -> None:
        self._change(lambda design: design.with_settings(self._key, mask=mask))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StackedLayer) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __repr__(self) -> str:
        return f"<layer {self.index}: {self.layer}>"


_SETTINGS = ("effect", "mask", "opacity", "visible", "name")


class Layers(Sequence[StackedLayer]):
    """The stack of a session, the lowest layer first.

    ``edit.layers[1]`` and ``edit.layers["worn edge"]`` find a layer, ``del edit.layers[1]`` deletes
    it, ``edit.layers[1].opacity = 0.3`` changes it.

    Parameters
    ----------
    read : returns the present design
    change : replaces the design by what a function makes of it, as one undoable step
    brush : puts strokes on the surface
    """

    def __init__(self, read: Callable[[], Design], change: Change, brush: Brush) -> None:
        self._read, self._change, self._brush = read, change, brush

    def add(self, effect: Effect, name: str = "") -> StackedLayer:
        """Put a layer on top that is painted nowhere yet, and return it.

        Parameters
        ----------
        effect : Effect
        name : str
        """
        layer = Layer(effect, Local((), tuple(self._read().materials)), name=name)
        self._change(lambda design: design.with_layer(layer))
        return self._of(layer)

    def __len__(self) -> int:
        return len(self._read().layers)

    @overload
    def __getitem__(self, which: int | str) -> StackedLayer: ...

    @overload
    def __getitem__(self, which: slice) -> list[StackedLayer]: ...

    def __getitem__(self, which: int | str | slice) -> StackedLayer | list[StackedLayer]:
        layers = self._read().layers
        if isinstance(which, slice):
            return [self._of(layer) for layer in layers[which]]
        if isinstance(which, str):
            for layer in reversed(layers):
                if layer.name == which:
                    return self._of(layer)
            raise ValueError(unknown_name("layer", which, [la.name for la in layers if la.name]))
        return self._of(layers[which])

    def __delitem__(self, which: int | str) -> None:
        self[which].delete()

    def __iter__(self) -> Iterator[StackedLayer]:
        return (self._of(layer) for layer in self._read().layers)

    def _of(self, layer: Layer) -> StackedLayer:
        return StackedLayer(layer.key, self._read, self._change, self._brush)

    def __repr__(self) -> str:
        lines = [f"{i}: {layer}" for i, layer in enumerate(self._read().layers)]
        return "\n".join(lines) if lines else "no layers"
