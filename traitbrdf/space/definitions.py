"""Definitions of traits, what they are fitted to, and what a library says about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.space.scores import Density

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Definition:
    """A trait as a weighted sum of graded descriptors and coordinates.

    The raw score at coordinates z is ``weights @ grades(z) + normal @ z``. Scores are raw scores
    scaled so that `typical` becomes 0 and 1.

    Attributes
    ----------
    name : str
    weights : (d,) float64
        Weights of the space's graded descriptors.
    normal : (k,) float64
        Gradient of the straight part; zeros if the trait reads descriptors alone.
    typical : (2,) float64
        Raw scores of the library's 10th and 90th percentile, ascending.
    meaning : str
        One line that explains the trait.
    synonyms : tuple of str
        Everyday names that stand for the trait.
    """

    name: str
    weights: Float64
    normal: Float64
    typical: Float64
    meaning: str = ""
    synonyms: tuple[str, ...] = ()


class Labelled(NamedTuple):
    """A trait and the labels of library members, to which `TraitSpace.fit` fits a `Definition`.

    Parameters
    ----------
    name : str
    labels : (n,) array_like
        1 has the trait, -1 does not have it, 0 is unclear.
    weights : (d,) array_like or None
        Weights of graded descriptors. If all are zero or left out, the trait is straight: the
        normal of the plane that separates the labels.
    meaning : str
        One line that explains the trait.
    synonyms : tuple of str
        Everyday names that stand for the trait.
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
        Covariance of the coordinates: moves are short in its Mahalanobis distance.
    related : (t, t) array_like or None
        Rank correlations of the scores; None takes all traits for related.
    limits : (t, 2) array_like or None
        Scores of the 1st and 99th percentile, which photoreal moves do not pass; None sets no
        limits.
    density : Density or None
        Where the members are; with None moves may go anywhere in the gamut box.
    """

    covariance: ArrayLike
    related: ArrayLike | None = None
    limits: ArrayLike | None = None
    density: Density | None = None


def straight(z: Float64, labels: ArrayLike, name: str, means: bool = False) -> Float64:
    """Fit the direction between members with a trait and members without it.

    It is the normal of a linear support vector machine, or the difference of class means (both in
    Matusik et al. 2003, section 5).

    Parameters
    ----------
    z : (n, k) float64
        Coordinates of the members.
    labels : (n,) array_like of -1, 0 and 1
    name : str
        The trait's name, for error messages.
    means : bool
        Whether to take the difference of class means.

    Returns
    -------
    (k,) float64

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
    """Return labels as an array, after checking them.

    Parameters
    ----------
    labels : (count,) array_like of -1, 0 and 1
    count : int
    name : str
        The trait's name, for error messages.

    Returns
    -------
    (count,) array

    Raises
    ------
    ValueError
        If labels are of one class only, of a wrong shape, or others than -1, 0 and 1.
    """
    label = np.asarray(labels)
    if label.shape != (count,) or not np.isin(label, (-1, 0, 1)).all():
        raise ValueError(
            f"labels of {name!r}: expected ({count},) values of -1, 0 or 1, "
            f"got shape {label.shape}: {label!r}"
        )
    if not ((label == 1).any() and (label == -1).any()):
        raise ValueError(f"labels of {name!r}: expected materials with and without it")
    return label


def stacked(traits: Sequence[Definition], part: str, size: int) -> Float64:
    """Stack one part of several definitions.

    Parameters
    ----------
    traits : t Definition
    part : "weights", "normal" or "typical"
    size : int
        Its expected length.

    Returns
    -------
    (t, size) float64

    Raises
    ------
    ValueError
        On another length; the message names the trait.
    """
    rows = [np.asarray(getattr(trait, part), np.float64) for trait in traits]
    for trait, row in zip(traits, rows, strict=True):
        if row.shape != (size,):
            raise ValueError(f"{part} of {trait.name!r}: expected shape ({size},), got {row.shape}")
    return np.array(rows, np.float64).reshape(len(rows), size)


def rank_correlations(values: Float64) -> Float64:
    """Return Spearman's rank correlations of columns; ties share ranks.

    Parameters
    ----------
    values : (n, t) float64

    Returns
    -------
    (t, t) float64
    """
    # scipy.stats takes a while to load, and is needed here alone
    from scipy.stats import rankdata

    return np.atleast_2d(np.corrcoef(rankdata(values, axis=0).T))


def with_one_more(related: Float64, raw: Float64) -> Float64:
    """Return the correlations of traits and one more, which moves of the others do not spare.

    Parameters
    ----------
    related : (t, t) float64
        Rank correlations of the traits that are known already.
    raw : (n, t + 1) float64
        Raw scores of the members of a library, the new trait last.

    Returns
    -------
    (t + 1, t + 1) float64
        The new trait's row holds its rank correlations. Its column is 1, as if all traits were
        related to it: moves spare what is not related, and those of the others shall stay as they
        are.
    """
    found = np.ones((len(related) + 1, len(related) + 1))
    found[:-1, :-1] = related
    found[-1] = rank_correlations(raw)[-1]
    return found
