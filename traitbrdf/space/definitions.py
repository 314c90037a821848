"""Definitions of traits, what they are fitted to, and what a library says about them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.space.scores import Density

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Definition:
    """What makes a trait: what its score adds up.

    Attributes
    ----------
    name : str
    weights : (d,) of the space's graded descriptors
    normal : (k,), the straight part
    typical : (2,) raw scores of the library's 10th and 90th percentile
    meaning : str
    synonyms : tuple of str
    """

    name: str
    weights: Float64
    normal: Float64
    typical: Float64
    meaning: str = ""
    synonyms: tuple[str, ...] = ()


class Labelled(NamedTuple):
    """A trait as labelled members of a library show it, of which a fit makes a `Definition`.

    Parameters
    ----------
    name : str
    labels : (n,) array_like
    weights : (d,) array_like or None
    meaning : str
    synonyms : tuple of str
    """

    name: str
    labels: ArrayLike
    weights: ArrayLike | None = None
    meaning: str = ""
    synonyms: tuple[str, ...] = ()


@dataclass(frozen=True)
class Statistics:
    """How coordinates and scores vary among the members of a library.

    Attributes
    ----------
    covariance : (k, k) array_like
    related : (t, t) array_like or None
    limits : (t, 2) array_like or None
    density : Density or None
    """

    covariance: ArrayLike
    related: ArrayLike | None = None
    limits: ArrayLike | None = None
    density: Density | None = None


def straight(z: Float64, labels: ArrayLike, name: str, means: bool = False) -> Float64:
    """Trait vector (k,) between labelled members: the normal of a linear support vector machine,
    or the difference of class means (both in Matusik et al. 2003, section 5).

    Raises
    ------
    ValueError
        If labels are of one class only, of a wrong shape, or others than -1, 0 and 1.
    """
    label = as_labels(labels, len(z), name)
    if means:
        return np.asarray(z[label == 1].mean(axis=0) - z[label == -1].mean(axis=0))
    from sklearn.svm import LinearSVC  # slow to import, and needed only here

    scale = np.maximum(z.std(axis=0), 1e-9)
    clear = label != 0
    machine = LinearSVC(C=0.1, dual=False).fit(z[clear] / scale, label[clear])
    return np.asarray(machine.coef_[0] / scale, np.float64)


def as_labels(labels: ArrayLike, count: int, name: str) -> NDArray[Any]:
    """Labels (count,) of -1, 0 and 1, of both classes."""
    label = np.asarray(labels)
    if label.shape != (count,) or not np.isin(label, (-1, 0, 1)).all():
        raise ValueError(
            f"labels of {name!r}: expected ({count},) values of -1, 0 or 1, "
            f"got shape {label.shape}: {label!r}"
        )
    if not ((label == 1).any() and (label == -1).any()):
        raise ValueError(f"labels of {name!r}: expected materials with and without it")
    return label
