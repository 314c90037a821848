"""Traits of one's own, learnt from labels or ratings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.space.library import Library, default_library

if TYPE_CHECKING:
    from traitbrdf.reflectance.brdf import TabulatedBRDF
from traitbrdf.space.definitions import Definition, as_labels
from traitbrdf.space.traits import TraitSpace, default_traits

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Trait(Definition):
    """A trait of one's own: what labels or ratings of some materials say.

    Learnt are weights of the graded descriptors of the space, which say more than coordinates
    where there are few labels: "like these, not like those" is said of what is seen. The straight
    part is zeros.
    """

    @classmethod
    def from_labels(
        cls,
        name: str,
        materials: Materials,
        labels: ArrayLike,
        space: TraitSpace | None = None,
        library: Library | None = None,
        meaning: str = "",
    ) -> Trait:
        """A trait from a handful of labels.

        Parameters
        ----------
        name : str
        materials : (n, k) coordinates, or n library names, tables, or (k,) coordinates
        labels : (n,) 1 has it, -1 has it not, 0 unclear
        space, library : None are the shipped ones

        Raises
        ------
        ValueError
            If there is no material with the trait, or none without it; on other values than -1, 0
            and 1, shapes that do not match, or materials labelled both ways.
        """
        z = _as_points(materials, library)
        given = as_labels(labels, len(z), name)
        for i, point in enumerate(z):
            same = np.all(np.abs(z - point) < 1e-9, axis=1)
            if given[i] * given[same].min() < 0 or given[i] * given[same].max() < 0:
                raise ValueError(
                    f"labels of {name!r}: materials {np.flatnonzero(same).tolist()} are the same, "
                    "but labelled both ways"
                )
        return cls._learnt(name, z, given.astype(np.float64), space, library, meaning)

    @classmethod
    def from_ratings(
        cls,
        name: str,
        materials: Materials,
        ratings: ArrayLike,
        space: TraitSpace | None = None,
        library: Library | None = None,
        meaning: str = "",
    ) -> Trait:
        """A trait from ratings (n,), any finite numbers of which more is more of it.

        Other parameters as for `from_labels`.

        Raises
        ------
        ValueError
            If ratings are not finite, all the same, or not as many as materials.
        """
        z = _as_points(materials, library)
        given = np.asarray(ratings, np.float64)
        if given.shape != (len(z),) or not np.isfinite(given).all():
            raise ValueError(
                f"ratings of {name!r}: expected ({len(z)},) finite numbers, got {given!r}"
            )
        if not given.std() > 1e-9 * max(float(np.abs(given).max()), 1e-300):
            raise ValueError(f"ratings of {name!r}: expected different ones, got all the same")
        return cls._learnt(name, z, given, space, library, meaning)

    @classmethod
    def _learnt(
        cls,
        name: str,
        z: Float64,
        target: Float64,
        space: TraitSpace | None,
        library: Library | None,
        meaning: str,
    ) -> Trait:
        space = default_traits() if space is None else space
        library = default_library() if library is None else library
        grades = space.grades(z)
        known = space.grades(library.coordinates)
        centre = target.mean()
        scaled = (target - centre) / target.std()
        precision, pull = _posterior(grades, known)
        weights = np.linalg.solve(precision, pull @ scaled)
        raw = known @ weights
        low, high = np.percentile(raw, [10.0, 90.0])
        if not high > low:
            raise ValueError(f"{name!r}: what was given does not depend on how materials look")
        return cls(name, weights, np.zeros(z.shape[1]), np.array([low, high]), meaning)


Materials = ArrayLike | Sequence["str | TabulatedBRDF | ArrayLike"]


def suggest(
    labelled: Materials,
    candidates: Materials,
    space: TraitSpace | None = None,
    library: Library | None = None,
) -> int:
    """Which of the candidates says most of a trait, if it is labelled next.

    The one of whose score a linear model knows least, given what is labelled already (the variance
    of Bayesian linear regression; labels themselves do not matter).

    Parameters
    ----------
    labelled, candidates : as for `Trait.from_labels`; `labelled` may be empty

    Returns
    -------
    int, the index among the candidates
    """
    space = default_traits() if space is None else space
    known = space.grades((default_library() if library is None else library).coordinates)
    some = _as_points(labelled, library) if len(labelled) else np.zeros((0, len(space.low)))  # type: ignore[arg-type]
    if not len(candidates):  # type: ignore[arg-type]
        raise ValueError("candidates: expected at least one material, got none")
    precision, _ = _posterior(space.grades(some), known)
    rows = space.grades(_as_points(candidates, library))
    return int(np.argmax(np.einsum("nd,nd->n", rows, np.linalg.solve(precision, rows.T).T)))


_NOISE = 2.0  # variance of a label, twice that of the trait: people disagree


def _posterior(grades: Float64, known: Float64) -> tuple[Float64, Float64]:
    """Precision (d, d) of a trait's weights given materials (n, d), and what turns targets into
    its pull (d, n). A trait is as likely to follow what members differ in as they differ in it."""
    cov = np.cov(known.T)
    scale, axes = np.linalg.eigh(cov)
    # prior covariance of weights, so that scores vary by one and mostly along the widest axes
    prior = axes * np.maximum(scale, 1e-6) @ axes.T / np.sum(scale**2)
    centred = grades - known.mean(axis=0)
    return np.linalg.inv(prior) + centred.T @ centred / _NOISE, centred.T / _NOISE


def _as_points(materials: Materials, library: Library | None) -> Float64:
    """(n, k) coordinates of materials by name, table or coordinates."""
    library = default_library() if library is None else library
    found = []
    for material in materials:  # type: ignore[union-attr]
        if isinstance(material, str):
            found.append(library.coordinates[library.index(material)])
        elif callable(getattr(material, "eval", None)):
            found.append(library.embedding.encode(material))  # type: ignore[arg-type]
        else:
            found.append(library.embedding.as_coordinates(material))  # type: ignore[arg-type]
    if not found:
        raise ValueError("materials: expected at least one, got none")
    return np.array(found)
