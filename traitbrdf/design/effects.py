"""Effects: what a layer of a design does to the material below it.

An effect is a frozen dataclass. Its `repr` is the Python expression that makes it, its fields are
what a design file stores, and `apply` turns one material into another. A new kind of effect is one
class in this file, named in `__all__`: painting, layers, undo, history and files then know it.
"""

from __future__ import annotations

import keyword
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.arguments import numbers
from traitbrdf.reflectance.brdf import (
    SUFFIXES,
    HalfDiffGrid,
    Reflectance,
    TabulatedBRDF,
    checked_reflectance,
)
from traitbrdf.reflectance.parameters import CLOSED_FORMS, is_closed_form
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.library import Library
from traitbrdf.space.logmap import log_map
from traitbrdf.space.material import Material
from traitbrdf.space.moves import Moved
from traitbrdf.space.traits import TraitSpace

__all__ = ["Assign", "Move", "Tint"]

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Palette:
    """What a design is painted with.

    Attributes
    ----------
    library : Library, whose members effects name
    traits : TraitSpace, of the library's embedding
    """

    library: Library
    traits: TraitSpace

    @property
    def embedding(self) -> BRDFEmbedding:
        """The embedding that all coordinates refer to."""
        return self.library.embedding


class Applied(NamedTuple):
    """What an effect made of a material.

    Attributes
    ----------
    material : Material
    moved : how far a move of traits came; None for other effects, and if it is not known
    refused : whether the effect could do nothing, so that `Effect.check` raises
    """

    material: Material
    moved: Moved | None = None
    refused: bool = False


def table_name(brdf: Reflectance) -> str:
    """Return the name of a table or measured BRDF."""
    return str(getattr(brdf, "name", "")) or type(brdf).__name__


Named: TypeAlias = Callable[[Reflectance], str]


class Effect:
    """Base of all effects."""

    anywhere: ClassVar[bool] = True
    """Whether the outcome may lie anywhere in the gamut, so that a part that was prepared for one
    material has to be prepared for all of them."""

    def apply(self, material: Material, weight: float, palette: Palette) -> Applied:
        """Apply the effect to a material.

        Parameters
        ----------
        material : Material, of the part below the layer
        weight : in [0, 1]
            Opacity of the layer times its mask: 0 leaves the material, 1 is the whole effect.
        palette : Palette

        Raises
        ------
        ValueError
            On names that the palette lacks.
        """
        raise NotImplementedError

    def check(self, material: Material, applied: Applied, palette: Palette) -> None:
        """Raise ValueError where the effect cannot do anything to a material at all.

        Called with what `apply` came to when a layer is added. `apply` itself leaves such a
        material as it is, since layers below may change later.
        """

    def call(self, target: str, named: Named = table_name) -> str:
        """Return the call of `EditSession` that adds the effect to a target, as Python source.

        Parameters
        ----------
        target : Python source of a part, of parts, or of a mapping of part to weight
        named : says which name of `EditSession.tables` a table has
        """
        return f"edit.apply({target}, {self.source(named)})"

    def source(self, named: Named = table_name) -> str:
        """Return the Python expression that makes the effect; `named` is as for `call`."""
        return f"tb.{type(self).__name__}({self._arguments(named)})"

    def __repr__(self) -> str:
        return self.source()

    def _arguments(self, named: Named) -> str:
        # trailing fields that have their default value go without saying
        said = list(fields(self))  # type: ignore[arg-type]
        while said and getattr(self, said[-1].name) == said[-1].default:
            said.pop()
        return ", ".join(repr(getattr(self, f.name)) for f in said)

    def state(self, palette: Palette) -> dict[str, Any]:
        """Return the fields that a design file stores, by name.

        Parameters
        ----------
        palette : Palette, of the design
        """
        return {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]

    @classmethod
    def restored(cls, state: Mapping[str, Any], palette: Palette) -> Self:
        """Make an effect from its `state`.

        Parameters
        ----------
        state : mapping of field to value
        palette : Palette, of the design
        """
        return cls(**state)


@dataclass(frozen=True, init=False, repr=False)
class Move(Effect):
    """Change traits: ``tb.Move(shiny=0.6)``.

    Parameters
    ----------
    amounts : mapping of trait to amount
        For traits whose names are no Python identifiers; others may be keywords.
    hold : what shall stay: traits, "colour", "lightness", "body"; () is nothing
        None is what `TraitSpace.holds` says: colour, unless a trait is a colour itself, and
        lightness, unless one is about that.
    photoreal : whether to stay where materials of the library are near
    **more : float
        For each trait, how much its score shall change (1: from typically low to typically high).

    Raises
    ------
    ValueError, TypeError
        On no trait, a trait named twice, or amounts that are not finite numbers.

    Examples
    --------
    >>> Move({"high-gloss": 0.25}, shiny=0.5, hold="body")
    tb.Move({'high-gloss': 0.25, 'shiny': 0.5}, hold=('body',))
    """

    amounts: tuple[tuple[str, float], ...]
    hold: tuple[str, ...] | None
    photoreal: bool

    def __init__(
        self,
        amounts: Mapping[str, float] | None = None,
        /,
        *,
        hold: Iterable[str] | None = None,
        photoreal: bool = True,
        **more: float,
    ) -> None:
        given = dict(amounts or {})
        twice = given.keys() & more.keys()
        if twice:
            raise ValueError(f"amounts: expected each trait once, got {min(twice)!r} twice")
        given |= more
        if not given:
            raise ValueError("amounts: expected at least one trait, as in shiny=0.6; got none")
        checked = tuple((name, _amount(name, value)) for name, value in given.items())
        if hold is not None:
            hold = names_of(hold, "hold")
        object.__setattr__(self, "amounts", checked)
        object.__setattr__(self, "hold", hold)
        object.__setattr__(self, "photoreal", bool(photoreal))

    def apply(self, material: Material, weight: float, palette: Palette) -> Applied:
        """Follow the flow of the traits for a share `weight` of the amounts; see `Effect.apply`."""
        found = palette.traits.reach(material.z, self._scaled(weight), self.hold, self.photoreal)
        refused = found.stopped.startswith("held")
        if refused or np.array_equal(found.z, material.z):
            return Applied(material, found, refused)
        return Applied(replace(material, z=found.z, table=None, model=None), found)

    def check(self, material: Material, applied: Applied, palette: Palette) -> None:
        """Raise ValueError where held traits forbid the move."""
        if applied.refused and applied.moved is not None:
            palette.traits.moved(material.z, applied.moved.asked, self.hold, self.photoreal)

    def _scaled(self, weight: float) -> dict[str, float]:
        return {name: value * weight for name, value in self.amounts}

    def call(self, target: str, named: Named = table_name) -> str:
        """Return the call of `EditSession.move`, as Python source; see `Effect.call`."""
        return f"edit.move({target}, {self._arguments(named)})"

    def _arguments(self, named: Named) -> str:
        amounts = dict(self.amounts)
        plain = all(n.isidentifier() and not keyword.iskeyword(n) for n in amounts)
        if plain and not amounts.keys() & _KEYWORDS:
            said = ", ".join(f"{name}={value!r}" for name, value in amounts.items())
        else:
            said = repr(amounts)
        held = "" if self.hold is None else f", hold={self.hold!r}"
        return f"{said}{held}{'' if self.photoreal else ', photoreal=False'}"

    @classmethod
    def restored(cls, state: Mapping[str, Any], palette: Palette) -> Self:
        """Make a move from its `state`."""
        return cls(dict(state["amounts"]), hold=state["hold"], photoreal=state["photoreal"])


_KEYWORDS = {"hold", "photoreal", "part", "self"}
"""Keywords of calls, which cannot name a trait there as well."""


Assignable: TypeAlias = "str | Reflectance | ArrayLike"
"""What can be assigned: a library name, a table, model or measured BRDF, or coordinates (k,)."""


@dataclass(frozen=True, repr=False)
class Assign(Effect):
    """Replace the material: ``tb.Assign("gold-polished")``.

    Parameters
    ----------
    material : a library name, a `TabulatedBRDF`, a model or measured BRDF, or coordinates (k,)
    known : (Library, Material) or None
        What `material` means with a library, if that is known already.

    Raises
    ------
    TypeError
        On something that is no material.

    Notes
    -----
    A weight below 1 is a mixture: the surface is covered by this material to that share, so f goes
    straight from the one below to this one, and so does every frame. (A way that is straight in
    log f leads through dark materials that are neither.)
    """

    anywhere: ClassVar[bool] = False
    material: Any
    known: tuple[Library, Material] | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        given = self.material
        if isinstance(given, (list, tuple, np.ndarray)):
            point = numbers(given, "material").astype(np.float64)
            object.__setattr__(self, "material", _plain(point))
        elif not isinstance(given, str) or Path(given).suffix.lower() in SUFFIXES:
            checked_reflectance(given, "material")

    def apply(self, material: Material, weight: float, palette: Palette) -> Applied:
        """Go a share `weight` of the way to the new material; see `Effect.apply`."""
        new = self.resolved(palette)
        return Applied(mixed(material, new, weight, palette.embedding))

    def resolved(self, palette: Palette) -> Material:
        """Return the material to assign; a table is encoded once.

        Parameters
        ----------
        palette : Palette
        """
        known = self.known
        if known is None or known[0] is not palette.library:
            known = palette.library, self._found(palette)
            object.__setattr__(self, "known", known)
        return known[1]

    def _found(self, palette: Palette) -> Material:
        if isinstance(self.material, str):
            return Material.of_library(self.material, palette.library)
        if isinstance(self.material, tuple):
            z = palette.embedding.clip(self.material)
            return Material(z, np.zeros(3), name="coordinates")
        return Material.of_reflectance(self.material, palette.embedding)

    @property
    def table(self) -> Reflectance | None:
        """The table or measured BRDF, which no Python source can state; None for all else."""
        given = self.material
        if isinstance(given, (str, tuple)) or is_closed_form(given):
            return None
        return given  # type: ignore[no-any-return]

    def call(self, target: str, named: Named = table_name) -> str:
        """Return the call of `EditSession.assign`, as Python source; see `Effect.call`."""
        return f"edit.assign({target}, {self._arguments(named)})"

    def _arguments(self, named: Named) -> str:
        given = self.material
        if isinstance(given, tuple):
            return repr(_listed(given))
        if isinstance(given, str):
            return repr(given)
        if self.table is None:
            return _MODEL_NAMES.sub(r"tb.models.\g<0>", repr(given))
        return f"tables[{named(given)!r}]"

    def state(self, palette: Palette) -> dict[str, Any]:
        """Return what was given, if a file can hold it, and the material that it means."""
        given = self.material if self.table is None else None
        return {"material": given, "known": self.resolved(palette)}

    @classmethod
    def restored(cls, state: Mapping[str, Any], palette: Palette) -> Self:
        """Make an assignment from its `state`."""
        given, known = state["material"], state["known"]
        if not isinstance(known, Material):
            raise TypeError(f"known: expected a material, got {known!r}")
        if given is None:
            grid = palette.embedding.grid_
            if known.table is None:
                raise ValueError("known: expected a material that keeps its table, got none")
            given = TabulatedBRDF(
                grid, known.table.reshape(*grid.shape, 3), known.mirror, known.name
            )
        return cls(given, (palette.library, known))


MODELS = frozenset(CLOSED_FORMS.values())
"""Closed forms, whose `repr` is Python source (with `tb.models.` before each name)."""
_MODEL_NAMES = re.compile(rf"\b({'|'.join(sorted(kind.__name__ for kind in MODELS))})(?=\()")


@dataclass(frozen=True, repr=False)
class Tint(Effect):
    """Multiply a colour: ``tb.Tint((1, 0.2, 0.1))`` makes a white body red.

    Parameters
    ----------
    rgb : (3,) array_like or float
        Linear Rec.709 factors, finite and at least 0.
    of : "body", "reflections" or "all"
        The body scatters light in all directions; reflections are what highlights and grazing
        light add to it. A metal has hardly any body.

    Raises
    ------
    ValueError, TypeError
        On factors that are not finite numbers of at least 0, or another `of`.

    Notes
    -----
    f splits into body min(f, b) and reflections f - min(f, b). The level b of the body is read at
    angles where neither highlight nor grazing light matters. If the result reflects more light
    than arrives, all of it is divided by its albedo; a perfect mirror beside f is only darkened.
    """

    rgb: tuple[float, float, float]
    of: str = "body"

    def __post_init__(self) -> None:
        try:
            factors = np.broadcast_to(np.asarray(self.rgb, np.float64), 3)
        except (TypeError, ValueError):
            raise TypeError(f"rgb: expected one or three numbers, got {self.rgb!r}") from None
        if not (np.isfinite(factors).all() and factors.min() >= 0.0):
            raise ValueError(f"rgb: expected finite factors of at least 0, got {self.rgb!r}")
        if self.of not in ("body", "reflections", "all"):
            raise ValueError(f"of: expected 'body', 'reflections' or 'all', got {self.of!r}")
        object.__setattr__(self, "rgb", tuple(factors.tolist()))

    def apply(self, material: Material, weight: float, palette: Palette) -> Applied:
        """Multiply by factors that go straight from 1 to `rgb` with the weight."""
        factors = 1.0 + weight * (np.array(self.rgb) - 1.0)
        if np.all(factors == 1.0):
            return Applied(material)
        embedding = palette.embedding
        grid, values = embedding.grid_, material.values(embedding)
        body = body_of(values, grid)
        tinted = {"body": body, "reflections": values - body, "all": values}[self.of]
        tinted = np.asarray(values + (factors - 1.0) * tinted, np.float32)
        # coordinates follow as far as the manifold goes, so that scores know the colour; what is
        # left stands beside them
        logs = np.ascontiguousarray(log_map(tinted).T)[None]
        before, after = material.least_squares(embedding), embedding.least_squares(logs)[0]
        z = embedding.clip(material.z + after - before)
        table = TabulatedBRDF(grid, np.maximum(tinted, 0.0).reshape(*grid.shape, 3))
        mirror = (
            material.mirror if self.of == "body" else np.minimum(material.mirror * factors, 1.0)
        )
        offset = embedding.residual(table, z)
        return Applied(Material(z, mirror, offset, None, material.name))


def body_of(values: Float32, grid: HalfDiffGrid) -> Float32:
    """Return the share (cells, 3) of a table that its body scatters: min(f, b).

    The level b is read where neither highlight nor grazing light matters; see `Tint`.

    Parameters
    ----------
    values : (cells, 3) float32, f in 1/sr
    grid : HalfDiffGrid
    """
    theta_h, theta_d, _ = grid.node_angles()
    plain = (np.abs(theta_h - _PLAIN_H) < 0.2) & (theta_d < _PLAIN_D)
    level = _BODY * np.median(values[plain.ravel()], axis=0)
    return np.asarray(np.minimum(values, level), np.float32)


_PLAIN_H, _PLAIN_D = math.radians(55.0), math.radians(40.0)
"""Around these angles neither highlight nor grazing light matters."""

_BODY = 1.35
"""The body's level at normal incidence, relative to those angles, where a coat transmits less."""


def mixed(old: Material, new: Material, weight: float, embedding: BRDFEmbedding) -> Material:
    """Return the mixture of two materials, of which the new one covers a share in [0, 1].

    f and mirrors are interpolated; 0 and 1 return the ends. Coordinates follow as far as the
    manifold goes.

    Parameters
    ----------
    old, new : Material
    weight : float
    embedding : BRDFEmbedding
    """
    if weight <= 0.0 or old == new:
        return old
    if weight >= 1.0:
        return new
    ends = old.values(embedding), new.values(embedding)
    values = np.asarray(ends[0] + np.float32(weight) * (ends[1] - ends[0]), np.float32)
    grid = embedding.grid_
    # least squares are relative to those of the ends, where they need not be what is known of them
    far, near = (one.z - one.least_squares(embedding) for one in (new, old))
    logs = np.ascontiguousarray(log_map(values).T)[None]
    z = embedding.clip(embedding.least_squares(logs)[0] + near + weight * (far - near))
    table = TabulatedBRDF(grid, values.reshape(*grid.shape, 3))
    mirror = old.mirror + weight * (new.mirror - old.mirror)
    return Material(z, mirror, embedding.residual(table, z), None, new.name)


def names_of(names: Iterable[str], what: str) -> tuple[str, ...]:
    """Return one name, or several, as a tuple; TypeError on anything else."""
    try:
        found = (names,) if isinstance(names, str) else tuple(names)
    except TypeError:
        raise TypeError(f"{what}: expected names, got {names!r}") from None
    if not all(isinstance(name, str) for name in found):
        raise TypeError(f"{what}: expected names, got {names!r}")
    return found


def _amount(name: object, value: float) -> float:
    if not isinstance(name, str):
        raise TypeError(f"amounts: expected names of traits, got {name!r}")
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"amount of {name!r}: expected a number, got {value!r}")
    if not math.isfinite(value):
        raise ValueError(f"amount of {name!r}: expected a finite number, got {value!r}")
    return float(value)


def _plain(point: NDArray[np.float64]) -> Any:
    """Nested tuples of an array of any shape: wrong shapes are told of by the embedding."""
    return tuple(_plain(row) for row in point) if point.ndim else float(point)


def _listed(point: Any) -> Any:
    return [_listed(row) for row in point] if isinstance(point, tuple) else point


KINDS: dict[str, type[Effect]] = {name: globals()[name] for name in __all__}
"""Effects by name, as files name them."""
