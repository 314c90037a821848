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
    """A trait of one's own, learnt from labels or ratings of some materials.

    Bayesian linear regression finds weights of the space's graded descriptors. With few labels
    these say more than coordinates, since people label what they see. The straight part is zero.

    Attributes
    ----------
    name, weights, normal, typical, meaning, synonyms
        As for `traitbrdf.space.definitions.Definition`.
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
        """Learn a trait from a handful of labels.

        Parameters
        ----------
        name : str
        materials : n materials
            (n, k) coordinates, or a sequence of library names, tables and (k,) coordinates.
        labels : (n,) array_like
            1 has the trait, -1 does not have it, 0 is unclear.
        space : TraitSpace, optional
            Where descriptors are graded; the shipped one if left out.
        library : Library, optional
            Whose members say how descriptors vary; the shipped one if left out.
        meaning : str
            One line that explains the trait.

        Raises
        ------
        ValueError
            If no material has the trait, or none lacks it; on values other than -1, 0 and 1, shapes
            that do not match, or a material labelled both ways.
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
        """Learn a trait from ratings.

        Parameters
        ----------
        ratings : (n,) array_like
            Any finite numbers; a higher one means more of the trait.
        Other parameters as for `from_labels`

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
        """Learn weights of graded descriptors from targets (n,) at points (n, k)."""
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
    """Choose the candidate whose label would say most about a trait.

    This is the one where the prediction of the trait is least certain.

    Parameters
    ----------
    labelled : materials that are labelled already, as for `Trait.from_labels`; may be empty
    candidates : materials to choose from, at least one
    space : TraitSpace, optional
        The shipped one if left out.
    library : Library, optional
        The shipped one if left out.

    Returns
    -------
    int
        Index among the candidates.

    Raises
    ------
    ValueError
        If there is no candidate, or a name is unknown.
    """
    space = default_traits() if space is None else space
    known = space.grades((default_library() if library is None else library).coordinates)
    some = _as_points(labelled, library) if len(labelled) else np.zeros((0, len(space.low)))  # type: ignore[arg-type]
    if not len(candidates):  # type: ignore[arg-type]
        raise ValueError("candidates: expected at least one material, got none")
    precision, _ = _posterior(space.grades(some), known)
    rows = space.grades(_as_points(candidates, library))
    return int(np.argmax(np.einsum("nd,nd->n", rows, np.linalg.solve(precision, rows.T).T)))


_NOISE = 2.0  # variance of a label where the trait has variance 1: people disagree


def _posterior(grades: Float64, known: Float64) -> tuple[Float64, Float64]:
    """Return the posterior of a trait's weights, given graded descriptors of materials.

    The prior follows the library: a trait is the likelier to depend on a combination of
    descriptors, the more members differ in it.

    Parameters
    ----------
    grades : (n, d) graded descriptors of the materials
    known : (m, d) graded descriptors of the library

    Returns
    -------
    precision : (d, d)
    pull : (d, n)
        Turns targets into the right-hand side of the normal equations.
    """
    cov = np.cov(known.T)
    scale, axes = np.linalg.eigh(cov)
    # prior covariance of the weights: scores have unit variance, mostly along the widest axes
    prior = axes * np.maximum(scale, 1e-6) @ axes.T / np.sum(scale**2)
    centred = grades - known.mean(axis=0)
    return np.linalg.inv(prior) + centred.T @ centred / _NOISE, centred.T / _NOISE


def _as_points(materials: Materials, library: Library | None) -> Float64:
    """Return coordinates (n, k) of materials given by name, table or coordinates."""
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
