"""Parameters of closed forms by name, those of nested models included.

A parameter has a path from the outermost model: `base.alpha` is the field `alpha` of the field
`base`, `parts.1.k_d` that of the second part of a sum. What follows the last dots is enough
wherever it means one parameter only.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from traitbrdf.formats.files import unknown_name
from traitbrdf.reflectance import models
from traitbrdf.reflectance.models import (
    ClassicPhong,
    ClassicTorranceSparrow,
    Model,
    Parameter,
    Scaled,
)

Value: TypeAlias = float | tuple[float, ...]
"""A number, or three of a colour."""

CLOSED_FORMS: dict[str, type[Model]] = {
    name: kind
    for name, kind in vars(models).items()
    if isinstance(kind, type) and issubclass(kind, Model) and dataclasses.is_dataclass(kind)
}
"""The closed forms of `traitbrdf.reflectance.models`, by name."""

STARTS: dict[str, type[Model]] = {
    "phong": ClassicPhong,
    "torrance-sparrow": ClassicTorranceSparrow,
    **{
        name: kind
        for name, kind in CLOSED_FORMS.items()
        if all(f.default is not dataclasses.MISSING for f in dataclasses.fields(kind))  # type: ignore[arg-type]
    },
}
"""Closed forms with defaults for all their fields, by name; the classic editor's two first."""

_WEIGHT = Parameter(
    "weight", 0.0, float(np.finfo(np.float32).max), 1.0, "factor on the model", rgb=True
)


class Setting(NamedTuple):
    """A parameter that can be set, with all that a user interface needs for its control.

    Attributes
    ----------
    name : the shortest name that means this parameter and no other
    path : where it stands: fields and places from the outermost model, with dots between
    parameter : its range, default, meaning and unit
    value : at present, a number, or three of a colour
    """

    name: str
    path: str
    parameter: Parameter
    value: Value


def is_closed_form(model: object) -> bool:
    """Return whether a model and all its parts are of `traitbrdf.reflectance.models`.

    Parameters
    ----------
    model : anything
        The `repr` of a closed form is Python source.
    """
    if type(model) not in CLOSED_FORMS.values():
        return False
    inner = [getattr(model, f.name) for f in dataclasses.fields(model)]  # type: ignore[arg-type]
    inner += [one for value in inner if isinstance(value, tuple) for one in value]
    return all(is_closed_form(one) for one in inner if callable(getattr(one, "eval", None)))


def start(name: str) -> Model:
    """Return the closed form of a name, with its defaults.

    Parameters
    ----------
    name : str
        A class of `traitbrdf.reflectance.models`, "phong" or "torrance-sparrow".

    Raises
    ------
    ValueError
        On an unknown name, naming near ones.
    """
    if name not in STARTS:
        raise ValueError(unknown_name("model", name, tuple(STARTS)))
    return STARTS[name]()


def settable_parameters(model: Model | str) -> tuple[Setting, ...]:
    """Return the parameters of a model that can be set, those of its parts included.

    Parameters
    ----------
    model : Model or str
        A closed form, or the name of one (see `start`), which stands for its defaults.

    Raises
    ------
    ValueError, TypeError
        On an unknown name, or something else.

    Examples
    --------
    >>> [setting.name for setting in settable_parameters(models.Coated(models.GGX(), 0.2))]
    ['alpha', 'eta', 'base.alpha', 'base.eta', 'k', 'k_s']
    """
    if isinstance(model, str):
        model = start(model)
    if not isinstance(model, Model):
        raise TypeError(f"model: expected a closed form or its name, got {model!r}")
    found = _found(model)
    return tuple(
        Setting(_shortest(path, tuple(found)), path, parameter, value)
        for path, (parameter, value) in found.items()
    )


def with_parameters(model: Model, values: Mapping[str, Value]) -> Model:
    """Return a model with other values of some of its parameters.

    Parameters
    ----------
    model : Model
    values : mapping of name to value
        Names are those of `settable_parameters`, or whole paths.

    Raises
    ------
    ValueError
        On names that mean none or several parameters, values out of their range, mirrors that
        reflect more light than arrives, and forms of the classic editor that may do so.
    """
    found = _found(model)
    chosen: dict[str, Value] = {}
    for name, value in values.items():
        path = _resolved(name, model, tuple(found))
        if path in chosen:
            raise ValueError(f"{name}: expected each parameter once, got it twice")
        chosen[path] = found[path][0].check(value)
    made = _rebuilt(model, "", chosen)
    if np.max(made.mirror) > 1.0:
        raise ValueError(f"parameters: expected a mirror of at most 1, got {made.mirror.tolist()}")
    bound = float(np.max(made.albedo_bound))
    if isinstance(made, (ClassicPhong, ClassicTorranceSparrow)) and bound > 1.0 + 1e-12:
        scale = math.floor(1e4 * made.scale / bound) / 1e4
        raise ValueError(
            "parameters: expected scale * (diffuse + specular) of at most 1 in every channel, got "
            f"{bound:.4g}: scale by {1.0 / bound:.4g} (scale={scale:g}) or less"
        )
    return made


def same_form(first: Model, second: Model) -> bool:
    """Return whether two models differ in nothing but the values of parameters.

    Parameters
    ----------
    first, second : Model
    """
    if type(first) is not type(second):
        return False
    inner, other = _inner(first), _inner(second)
    return inner.keys() == other.keys() and all(same_form(inner[n], other[n]) for n in inner)


def between(old: Model, new: Model, weight: float) -> Model:
    """Return the model a share of the way between two of the same form.

    Parameters go straight, on a logarithmic scale where their `Parameter.log` says so. Where a
    factor (the weight of `Scaled`, the scale of a classic form) and what it scales would together
    exceed the albedo bounds of both ends, the factor is lowered.

    Parameters
    ----------
    old, new : Model
        Of the same form.
    weight : float
        In [0, 1]; 0 and 1 return the ends.

    Raises
    ------
    ValueError
        On models of different forms.
    """
    if not same_form(old, new):
        raise ValueError(f"new: expected a model of the form of {old!r}, got {new!r}")
    if weight <= 0.0 or old == new:
        return old
    return new if weight >= 1.0 else _between(old, new, weight)


def _between(old: Model, new: Model, weight: float) -> Model:
    if old == new:
        return new
    before, after = (
        {path: value for path, (_, value) in _found(one).items() if "." not in path}
        for one in (old, new)
    )
    values = {p.name: _step(p, before[p.name], after[p.name], weight) for p in _own(new)}
    inner, ends = _inner(old), _inner(new)
    parts = {path: _between(inner[path], ends[path], weight) for path in inner}
    made = _replaced(new, values, parts)
    factor = "weight" if isinstance(made, Scaled) else "scale"
    if not hasattr(made, factor):
        return made
    most, bound = np.maximum(old.albedo_bound, new.albedo_bound), made.albedo_bound
    if np.all(bound <= most) or not np.isfinite(bound).all():
        return made
    share = np.minimum(1.0, most / np.maximum(bound, 1e-300))
    lowered = getattr(made, factor) * (share if factor == "weight" else float(share.min()))
    return _replaced(made, {factor: lowered}, {})


def _step(parameter: Parameter, old: Value, new: Value, weight: float) -> Any:
    if old == new:
        return new
    first, last = np.asarray(old, np.float64), np.asarray(new, np.float64)
    if parameter.log:
        value = np.exp(np.log(first) + weight * (np.log(last) - np.log(first)))
    else:
        value = first + weight * (last - first)
    value = np.clip(value, np.minimum(first, last), np.maximum(first, last))
    return tuple(value.tolist()) if value.ndim else float(value)


def _own(model: Model) -> tuple[Parameter, ...]:
    return (_WEIGHT,) if isinstance(model, Scaled) else model.parameters


def _inner(model: Model) -> dict[str, Model]:
    """Return the models that a model is made of, by path."""
    found = {}
    for f in dataclasses.fields(model):  # type: ignore[arg-type]
        value = getattr(model, f.name)
        if isinstance(value, Model):
            found[f.name] = value
        elif isinstance(value, tuple):
            parts = enumerate(value)
            found |= {f"{f.name}.{i}": one for i, one in parts if isinstance(one, Model)}
    return found


@functools.lru_cache(maxsize=64)
def _found(model: Model) -> Mapping[str, tuple[Parameter, Value]]:
    found = {p.name: (p, getattr(model, p.name)) for p in _own(model)}
    for place, part in _inner(model).items():
        found |= {f"{place}.{path}": one for path, one in _found(part).items()}
    return found


def _rebuilt(model: Model, prefix: str, chosen: Mapping[str, Value]) -> Model:
    values = {p.name: chosen[prefix + p.name] for p in _own(model) if prefix + p.name in chosen}
    parts = {
        place: _rebuilt(part, f"{prefix}{place}.", chosen) for place, part in _inner(model).items()
    }
    return _replaced(model, values, parts)


def _replaced(model: Model, values: Mapping[str, Any], parts: Mapping[str, Model]) -> Model:
    """Return a model with other values of its own parameters and other parts, given by path."""
    fields: dict[str, Any] = dict(values)
    for path, part in parts.items():
        name, _, place = path.partition(".")
        if place:
            several = list(fields.get(name, getattr(model, name)))
            several[int(place)] = part
            fields[name] = tuple(several)
        else:
            fields[name] = part
    made: Model = dataclasses.replace(model, **fields)  # type: ignore[type-var]
    return made


def _resolved(name: str, model: Model, paths: tuple[str, ...]) -> str:
    found = [path for path in paths if path.endswith(f".{name}")]
    if name in paths or len(found) == 1:
        return name if name in paths else found[0]
    kind = f"parameter of {type(model).__name__}"
    if found:
        raise ValueError(f"{kind} {name!r}: expected one of {', '.join(map(repr, found))}")
    raise ValueError(unknown_name(kind, name, tuple(_shortest(path, paths) for path in paths)))


def _shortest(path: str, paths: tuple[str, ...]) -> str:
    words = path.split(".")
    for count in range(1, len(words)):
        name = ".".join(words[-count:])
        meant = [one for one in paths if one == name or one.endswith(f".{name}")]
        if len(meant) == 1:
            return name
    return path
