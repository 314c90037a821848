"""The document: materials of parts, a stack of layers, undo and redo.

A `Design` is a value: every change makes a new one, which shares what did not change. A `Document`
steps through designs. Nothing that was painted is baked in: what parts are made of is computed from
the materials at the bottom and the layers above, and a stack that changed above some layer is
computed from there on.
"""

from __future__ import annotations

import functools
from collections import Counter, OrderedDict
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeAlias

from traitbrdf.design.effects import Applied, Assign, Effect, Palette, table_name
from traitbrdf.design.layers import Layer
from traitbrdf.design.masks import Framing, Local
from traitbrdf.formats.files import unknown_name
from traitbrdf.reflectance.brdf import Reflectance
from traitbrdf.space.material import Material

_REMEMBERED = 512
"""Outcomes of effects that are kept: what is undone and done again is not computed again."""


@dataclass(frozen=True)
class Recorded:
    """A call of an older design file, whose layers were baked into its materials.

    Attributes
    ----------
    call : Python source, as it was under `framing`
    anywhere : the same for any other framing; "" where it does not depend on that
    framing : Framing
    """

    call: str
    anywhere: str
    framing: Framing

    def under(self, framing: Framing) -> str:
        """Return the call under a framing."""
        return self.anywhere if self.anywhere and framing != self.framing else self.call


@dataclass(frozen=True, repr=False)
class Design:
    """Materials of the parts and a stack of layers, as one immutable value.

    Attributes
    ----------
    materials : mapping of part to Material, below all layers
    layers : tuple of Layer, the lowest first
    recorded : tuple of Recorded
        Calls that led to `materials`, where a design file of format 1 or 2 holds them.
    """

    materials: Mapping[str, Material]
    layers: tuple[Layer, ...] = ()
    recorded: tuple[Recorded, ...] = field(default=(), compare=False)

    def __repr__(self) -> str:
        return f"<Design of {len(self.materials)} parts, {len(self.layers)} layers>"

    def place(self, key: int) -> int:
        """Return the index of the layer of a key; ValueError if it is not in the stack."""
        for i, layer in enumerate(self.layers):
            if layer.key == key:
                return i
        raise ValueError("layer: expected a layer of this design, got one that is not in it")

    def with_layer(self, layer: Layer) -> Design:
        """Return the design with a layer on top."""
        self.check_mask(layer)
        return replace(self, layers=(*self.layers, layer))

    def with_layer_above(self, key: int, layer: Layer) -> Design:
        """Return the design with a further layer right above the one of a key."""
        i = self.place(key) + 1
        self.check_mask(layer)
        return replace(self, layers=(*self.layers[:i], layer, *self.layers[i:]))

    def with_settings(self, key: int, **settings: Any) -> Design:
        """Return the design with other settings of one layer (`Layer`'s attributes)."""
        i = self.place(key)
        changed = replace(self.layers[i], **settings)
        self.check_mask(changed)
        return replace(self, layers=(*self.layers[:i], changed, *self.layers[i + 1 :]))

    def without(self, key: int) -> Design:
        """Return the design without one layer."""
        i = self.place(key)
        return replace(self, layers=(*self.layers[:i], *self.layers[i + 1 :]))

    def with_order(self, key: int, index: int) -> Design:
        """Return the design with one layer at another index of the stack."""
        i = self.place(key)
        rest = [*self.layers[:i], *self.layers[i + 1 :]]
        count = len(self.layers)
        if isinstance(index, bool) or not isinstance(index, int) or not -count <= index < count:
            raise ValueError(f"index: expected a place in a stack of {count}, got {index!r}")
        rest.insert(index % count, self.layers[i])
        return replace(self, layers=tuple(rest))

    def check_parts(self, names: Iterable[str]) -> None:
        """Raise ValueError on a part that the design has not, naming near ones."""
        for name in names:
            if name not in self.materials:
                raise ValueError(unknown_name("part", name, tuple(self.materials)))

    def check_mask(self, layer: Layer) -> None:
        """Raise ValueError if a layer's mask names parts that the design has not."""
        mask = layer.mask
        self.check_parts(mask.parts)
        if isinstance(mask, Local) and mask.whole != tuple(self.materials):
            raise ValueError(f"mask: expected one of {[*self.materials]}, got {[*mask.whole]}")

    def touched(self) -> set[str]:
        """Return the parts that layers may lead anywhere in the gamut."""
        return set().union(*(layer.anywhere for layer in self.layers))

    def tables(self) -> dict[str, Reflectance]:
        """Return the tables and measured BRDFs that layers assign, by a name for each."""
        found: dict[str, Reflectance] = {}
        for table, name in self._named():
            found[name] = table
        return found

    def _named(self) -> list[tuple[Reflectance, str]]:
        named: list[tuple[Reflectance, str]] = []
        counts: Counter[str] = Counter()
        for layer in self.layers:
            table = layer.effect.table if isinstance(layer.effect, Assign) else None
            if table is None or any(table is other for other, _ in named):
                continue
            name = table_name(table)
            counts[name] += 1
            named.append((table, name if counts[name] == 1 else f"{name} ({counts[name]})"))
        return named

    def history(self, framing: Framing, idle: Container[int] = ()) -> list[str]:
        """Return the Python statements that make the design on a fresh session, in order.

        Parameters
        ----------
        framing : Framing
            Strokes that were painted under another one are told as the parts that they touched.
        idle : keys of layers
            Those whose effect can do nothing at present. They are told by calls that do not
            refuse such an effect.
        """
        names = self._named()

        def named(table: Reflectance) -> str:
            return next((name for other, name in names if other is table), table_name(table))

        said = [one.under(framing) for one in self.recorded]
        for layer in self.layers:
            said += layer.calls(framing, named, layer.key in idle)
        return said


class Folded(NamedTuple):
    """What layers up to some height come to.

    Attributes
    ----------
    materials : of every part
    applied : what the last of these layers came to, by part
    """

    materials: Mapping[str, Material]
    applied: Mapping[str, Applied]


Outcome: TypeAlias = Callable[[Effect, float, Material], Applied]


@dataclass(frozen=True, eq=False)
class Varying:
    """How the material of one part varies with the weights of local layers.

    Attributes
    ----------
    part : str
        Its name.
    start : Material, below the lowest of the layers
    layers : tuple of Layer
        The lowest local layer and those above it, as far as they touch the part and count.
    outcome : what an effect makes of a material at a weight
    """

    part: str
    start: Material
    layers: tuple[Layer, ...]
    outcome: Outcome

    @functools.cached_property
    def local(self) -> tuple[Layer, ...]:
        """The layers whose weight differs from point to point."""
        return tuple(layer for layer in self.layers if layer.local)

    def material(self, amounts: Sequence[float]) -> Material:
        """Return the material where the local layers have certain amounts.

        Parameters
        ----------
        amounts : sequence of float in [0, 1]
            Opacity times mask of each layer of `local`.
        """
        given, found = iter(amounts), self.start
        for layer in self.layers:
            amount = next(given) if layer.local else layer.weight(self.part)
            if amount > 0.0:
                found = self.outcome(layer.effect, float(amount), found).material
        return found


class Document:
    """The present design, what it comes to, and the way back and forth.

    Parameters
    ----------
    design : Design
    palette : Palette, that effects are applied with
    known : for each layer, what came of it on each part that it touches, if that is known
        A file keeps what its layers came to, so that it opens as it was saved.

    Attributes
    ----------
    design : Design, the present one
    """

    def __init__(
        self,
        design: Design,
        palette: Palette,
        known: Iterable[Mapping[str, Applied]] = (),
    ) -> None:
        self._palette = palette
        self._outcomes: OrderedDict[Any, tuple[Effect, Applied]] = OrderedDict()
        self._varying: dict[str, Varying] = {}
        self._states = [Folded(dict(design.materials), {})]
        self._folded = replace(design, layers=())
        self._past: list[Design] = []
        self._future: list[Design] = []
        for layer, applied in zip(design.layers, known, strict=False):
            for part, one in applied.items():
                self._remember(layer.effect, layer.weight(part), self.materials[part], one)
            materials = {part: one.material for part, one in applied.items()}
            self._states.append(Folded({**self.materials, **materials}, applied))
            self._folded = self._folded.with_layer(layer)
        self._fold(design)
        self.design = design

    def copy(self) -> Document:
        """Return a document of the present design, which has no past and no future."""
        return Document(self.design, self._palette, self.outcomes)

    @property
    def materials(self) -> Mapping[str, Material]:
        """What every part is made of, all layers counted."""
        return self._states[-1].materials

    @property
    def applied(self) -> Mapping[str, Applied]:
        """What the top layer came to, by part."""
        return self._states[-1].applied

    @property
    def outcomes(self) -> list[Mapping[str, Applied]]:
        """For each layer, what came of it on the parts that it touches, as `known` has it."""
        return [state.applied for state in self._states[1:]]

    @property
    def palette(self) -> Palette:
        """What effects are applied with; layers are applied anew unless it has only grown."""
        return self._palette

    @palette.setter
    def palette(self, palette: Palette) -> None:
        old = self._palette, self._states, self._folded, self._outcomes
        self._palette = palette
        traits = {id(trait) for trait in palette.traits.traits}
        grown = palette.library is old[0].library and all(
            id(trait) in traits for trait in old[0].traits.traits
        )
        if grown:  # moves of the other traits stay as they are
            return
        self._outcomes, self._states = OrderedDict(), self._states[:1]
        self._varying = {}
        self._folded = replace(self._folded, layers=())
        try:
            self._fold(self.design)
        except Exception:
            self._palette, self._states, self._folded, self._outcomes = old
            raise

    def add(self, layer: Layer, check: bool = False) -> None:
        """Put a layer on top.

        Parameters
        ----------
        layer : Layer
        check : bool
            Whether to raise ValueError where its effect cannot do anything at all.
        """
        new = self.design.with_layer(layer)
        for part in layer.mask.parts if check else ():
            below = self.materials[part]
            full = layer.strength if layer.local else layer.weight(part)
            found = self._outcome(layer.effect, full, below)
            layer.effect.check(below, found, self._palette)
        self.change(new)

    def history(self, framing: Framing) -> list[str]:
        """Return the Python statements that make the design on a fresh session, in order.

        Parameters
        ----------
        framing : Framing
            Strokes that were painted under another one are told as the parts that they touched.
        """
        idle = {
            layer.key
            for layer, applied in zip(self.design.layers, self.outcomes, strict=True)
            # one that is hidden or faint could be refused when it is added, before that is set
            if layer.strength < 1.0 or any(one.refused for one in applied.values())
        }
        return self.design.history(framing, idle)

    def change(self, design: Design) -> None:
        """Replace the design, undoably; on errors of its effects nothing is changed."""
        if design.materials.keys() != self.design.materials.keys():
            raise ValueError(
                f"design: expected parts {list(self.design.materials)}, "
                f"got {list(design.materials)}"
            )
        self._fold(design)
        self._past.append(self.design)
        self._future.clear()
        self.design = design

    def undo(self) -> bool:
        """Take the last change back; False if there is none."""
        return self._step(self._past, self._future)

    def redo(self) -> bool:
        """Make the last undone change again; False if there is none."""
        return self._step(self._future, self._past)

    def _step(self, source: list[Design], target: list[Design]) -> bool:
        if not source:
            return False
        self._fold(source[-1])
        target.append(self.design)
        self.design = source.pop()
        return True

    @property
    def undoable(self) -> bool:
        """Whether there is a change to undo."""
        return bool(self._past)

    @property
    def redoable(self) -> bool:
        """Whether there is an undone change to make again."""
        return bool(self._future)

    def _fold(self, design: Design) -> None:
        """Bring `_states` up to a design, from the lowest layer that changed."""
        old, states = self._folded, self._states
        kept = min(len(design.layers), len(old.layers))
        if design.materials != old.materials:
            kept, states = 0, [Folded(dict(design.materials), {})]
        elif design.layers[:kept] != old.layers[:kept]:
            pairs = zip(design.layers, old.layers, strict=False)
            kept = next(i for i, (one, other) in enumerate(pairs) if one != other)
        states = states[: kept + 1]
        for layer in design.layers[kept:]:
            design.check_mask(layer)
            below = states[-1].materials
            applied = {}
            for part in layer.mask.parts:
                applied[part] = self._apply(layer, part, below[part])
            changed = {part: one.material for part, one in applied.items()}
            states.append(Folded({**below, **changed}, applied))
        self._states, self._folded = states, design

    def _apply(self, layer: Layer, part: str, material: Material) -> Applied:
        # hidden layers as well: what is wrong with their effects is told now
        found = self._outcome(layer.effect, layer.weight(part), material)
        return found if layer.visible else Applied(material)

    def _outcome(self, effect: Effect, weight: float, material: Material) -> Applied:
        """Apply an effect, unless what comes of that is known."""
        key = id(effect), weight, material
        if key in self._outcomes:
            self._outcomes.move_to_end(key)
        else:
            self._remember(effect, weight, material, effect.apply(material, weight, self._palette))
        return self._outcomes[key][1]

    def _remember(self, effect: Effect, weight: float, material: Material, found: Applied) -> None:
        # the effect stands beside its outcome: while it lives, no other has its id
        self._outcomes[id(effect), weight, material] = effect, found
        if len(self._outcomes) > _REMEMBERED:
            self._outcomes.popitem(last=False)

    def varying(self, part: str) -> Varying | None:
        """Return how the material of a part varies over its surface; None if it does not.

        Parameters
        ----------
        part : str
            Its name.
        """
        layers = [
            (place, layer)
            for place, layer in enumerate(self.design.layers)
            if layer.strength > 0.0 and part in layer.mask.parts
        ]
        lowest = next((place for place, layer in layers if layer.local), None)
        if lowest is None:
            return None
        above = tuple(layer for place, layer in layers if place >= lowest)
        known = self._varying.get(part)
        start = self._states[lowest].materials[part]
        if known is None or (known.start, known.layers) != (start, above):
            known = self._varying[part] = Varying(part, start, above, self._outcome)
        return known
