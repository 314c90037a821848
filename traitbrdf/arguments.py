"""Arguments as callers give them: errors name the argument, what was expected, and what came."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray


def number(value: object, name: str) -> float:
    """Return a finite real number as a float; text, complex numbers and bools are none.

    Parameters
    ----------
    value : object
    name : str, of the argument

    Raises
    ------
    TypeError, ValueError
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(
        value, (int, float, np.integer, np.floating)
    ):
        raise TypeError(f"{name}: expected a number, got {told(value)}")
    if not math.isfinite(value):
        raise ValueError(f"{name}: expected a finite number, got {value!r}")
    return float(value)


def whole(value: object, name: str, least: int) -> int:
    """Return a whole number, of NumPy's types too, as an int.

    Parameters
    ----------
    value : object
    name : str, of the argument
    least : int

    Raises
    ------
    ValueError
    """
    if (
        isinstance(value, (bool, np.bool_))
        or not isinstance(value, (int, np.integer))
        or value < least
    ):
        raise ValueError(f"{name}: expected a whole number of at least {least}, got {told(value)}")
    return int(value)


def numbers(value: Any, name: str) -> NDArray[Any]:
    """Return real numbers as an array of their own type.

    Parameters
    ----------
    value : array_like
    name : str, of the argument

    Raises
    ------
    TypeError
        On text, complex numbers, objects and lists of different lengths.
    """
    try:
        array = np.asarray(value)
    except (ValueError, TypeError):
        raise TypeError(f"{name}: expected real numbers, got {told(value)}") from None
    if array.dtype.kind not in "fiub":
        raise TypeError(f"{name}: expected real numbers, got {told(value)}")
    return array


def told(value: object) -> str:
    """Return what came, in one short line."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype}"
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:77]}..."
