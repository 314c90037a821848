"""The effect that sets parameters of closed forms, as the controls of a classic editor do."""

from __future__ import annotations

import functools
import keyword
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from traitbrdf.design.effects import KINDS, Applied, Effect, Named, Palette, mixed, table_name
from traitbrdf.reflectance.brdf import TabulatedBRDF
from traitbrdf.reflectance.models import Model
from traitbrdf.reflectance.parameters import Value, between, same_form, start, with_parameters
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.logmap import channel_logs
from traitbrdf.space.material import Material

__all__ = ["Parameters"]


@dataclass(frozen=True, init=False, repr=False)
class Parameters(Effect):
    """Set parameters of a closed form: ``tb.Parameters(alpha=0.1)``.

    Parameters
    ----------
    model : str, optional
        What the material becomes, with its defaults: a class of `traitbrdf.reflectance.models`,
        or a form of the classic editor, "phong" or "torrance-sparrow". Left out, the material
        has to be a closed form already, which keeps its other parameters.
    values : mapping of name to value, optional
        For names that are no Python identifiers, such as "base.alpha"; without a model it may be
        the first argument. `traitbrdf.reflectance.parameters.settable_parameters` lists names,
        ranges and units.
    **more : float or (3,) array_like
        A value for each named parameter.

    Raises
    ------
    ValueError, TypeError
        On no parameter, one named twice, values that are not finite numbers, an unknown model, and
        whatever the named model does not accept. `check` says what the material below lacks.

    Notes
    -----
    The result is that model, sampled: nothing is lost by changing its parameters again. A weight
    below 1 goes straight from the old values to the new ones (logarithmically where
    `Parameter.log` says so), or, where the material below is of another form, is a mixture as
    `Assign` makes it. Coordinates follow as far as the manifold goes.

    Examples
    --------
    >>> Parameters("GGX", alpha=0.2)
    tb.Parameters('GGX', alpha=0.2)
    >>> Parameters({"base.k_d": (0.8, 0.1, 0.1)})
    tb.Parameters({'base.k_d': (0.8, 0.1, 0.1)})
    """

    model: str | None
    values: tuple[tuple[str, Value], ...]

    def __init__(
        self,
        model: str | Mapping[str, Any] | None = None,
        values: Mapping[str, Any] | None = None,
        **more: Any,
    ) -> None:
        if isinstance(model, Mapping) and values is None:
            model, values = None, model
        if model is not None and not isinstance(model, str):
            raise TypeError(f"model: expected the name of a closed form, got {model!r}")
        if not isinstance(values, (Mapping, type(None))):
            raise TypeError(f"values: expected a mapping of name to value, got {values!r}")
        given = dict(values or {})
        twice = given.keys() & more.keys()
        if twice:
            raise ValueError(f"values: expected each parameter once, got {min(twice)!r} twice")
        given |= more
        if model is None and not given:
            raise ValueError("values: expected at least one parameter, as in alpha=0.1; got none")
        checked = tuple((name, _value(name, value)) for name, value in given.items())
        object.__setattr__(self, "model", model)
        object.__setattr__(self, "values", checked)
        if model is not None:
            self._target(None)

    def _target(self, model: Model | None) -> Model:
        """Return what a material that is made of `model` becomes."""
        begin = model if self.model is None else start(self.model)
        if begin is None:
            raise ValueError(
                f"{self.values[0][0]}: expected a material that is a closed form, such as "
                "tb.Assign(tb.models.GGX()) makes, got another; or name a form: "
                "tb.Parameters('GGX', ...)"
            )
        return with_parameters(begin, dict(self.values))

    def apply(self, material: Material, weight: float, palette: Palette) -> Applied:
        """Set a share `weight` of the change of parameters; see `Effect.apply`."""
        if weight <= 0.0:
            return Applied(material)
        old, embedding = material.model, palette.embedding
        try:
            new = self._target(old)
        except ValueError:
            return Applied(material, refused=True)
        if old is None or not same_form(old, new):
            whole = _material(new, embedding)
            return Applied(mixed(material, whole, weight, embedding))
        if old == new:
            return Applied(material)
        now = between(old, new, weight)
        sampled = _sampled(now, embedding)
        # coordinates of an assigned model are found by more work, and may be others
        apart = material.z - _sampled(old, embedding).z
        z = embedding.clip(sampled.z + (1.0 - weight) * apart)
        return Applied(_shown(now, sampled, z, material.name, embedding))

    def check(self, material: Material, applied: Applied, palette: Palette) -> None:
        """Raise ValueError where the material has no such parameters, or not such values."""
        if applied.refused:
            self._target(material.model)

    def call(self, target: str, named: Named = table_name) -> str:
        """Return the call of `EditSession.set_parameters`, as Python source; see `Effect.call`."""
        return f"edit.set_parameters({target}, {self._arguments(named)})"

    def _arguments(self, named: Named = table_name) -> str:
        values = dict(self.values)
        said = [] if self.model is None else [repr(self.model)]
        plain = all(n.isidentifier() and not keyword.iskeyword(n) for n in values)
        if plain and not values.keys() & {"model", "values", "self"}:
            said += [f"{name}={value!r}" for name, value in values.items()]
        else:
            said.append(repr(values))
        return ", ".join(said)

    @classmethod
    def restored(cls, state: Mapping[str, Any], palette: Palette) -> Self:
        """Make the effect from its `state`."""
        return cls(state["model"], dict(state["values"]))


class _Sampled(NamedTuple):
    """A closed form on the embedding's grid, and coordinates near its table, in the gamut."""

    table: TabulatedBRDF
    values: NDArray[np.float32]
    z: NDArray[np.float64]


@functools.lru_cache(maxsize=64)
def _sampled(model: Model, embedding: BRDFEmbedding) -> _Sampled:
    table = TabulatedBRDF.from_model(model, embedding.grid_, type(model).__name__)
    values = np.ascontiguousarray(table.values.reshape(-1, 3), np.float32)
    logs = np.ascontiguousarray(channel_logs(table))[None]
    return _Sampled(table, values, embedding.clip(embedding.least_squares(logs)[0]))


@functools.lru_cache(maxsize=64)
def _material(model: Model, embedding: BRDFEmbedding) -> Material:
    sampled = _sampled(model, embedding)
    return _shown(model, sampled, sampled.z, type(model).__name__, embedding)


def _shown(
    model: Model, sampled: _Sampled, z: NDArray[np.float64], name: str, embedding: BRDFEmbedding
) -> Material:
    offset = embedding.residual(sampled.table, z)
    return Material(z, sampled.table.mirror, offset, sampled.values, name, model)


def _value(name: object, value: Any) -> Value:
    if not isinstance(name, str):
        raise TypeError(f"values: expected names of parameters, got {name!r}")
    try:
        array = np.asarray(value)
    except ValueError:  # a ragged sequence
        array = np.asarray(None)
    if array.dtype.kind not in "iuf" or array.shape not in ((), (3,)):
        raise TypeError(f"{name}: expected a number or three numbers, got {value!r}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers, got {value!r}")
    return tuple(float(one) for one in array) if array.ndim else float(array)


KINDS[Parameters.__name__] = Parameters
