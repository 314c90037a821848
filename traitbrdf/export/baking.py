"""Local layers as textures: a target's parameters at every texel.

Where n local layers overlap, the material varies along n amounts. It is fitted at knots, at the
corners of the cells of a grid over these amounts that texels lie in, and the parameters are
interpolated between them.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from traitbrdf.design.document import Varying
from traitbrdf.export.fitting import Fit, Target, error_of, fit
from traitbrdf.export.lobes import FittingPixels
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.material import Material
from traitbrdf.transport.visibility import Progress

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Look = TypeVar("Look")

_LEVELS = {1: 9, 2: 5}  # knots along each of so many layers; of more, 4
_CHECKED = 24  # texels at which the error is measured


@dataclass(frozen=True)
class Baked(Generic[Look]):
    """A part's parameters at its texels.

    Attributes
    ----------
    values : (T, p) float64, as `as_values` gives them
    like : a look, for the order of the values
    error : float
        Mean |I - I_table| over mean I_table of spheres of the materials of random texels.
    """

    values: Float64
    like: Look
    error: float


class Fitter(Generic[Look]):
    """Fits materials of one embedding to one target.

    Parameters
    ----------
    target : Target
    embedding : BRDFEmbedding
    pixels : FittingPixels, on its grid
    """

    def __init__(
        self, target: Target[Look], embedding: BRDFEmbedding, pixels: FittingPixels
    ) -> None:
        self.target, self.embedding, self.pixels = target, embedding, pixels
        self._known: dict[tuple[Material, bool], Fit[Look]] = {}

    def material(
        self, material: Material, near: Sequence[Float64] = (), further: bool = True
    ) -> Fit[Look]:
        """Fit one material.

        Parameters
        ----------
        material : Material
        near : vectors of looks that are probably near
        further : bool
            As for `traitbrdf.export.fitting.fit`.
        """
        key = material, further
        if key not in self._known:
            self._known[key] = fit(self.target, self.pixels, self._seen(material), near, further)
        return self._known[key]

    def bake(self, varying: Varying, amounts: Float32, progress: Progress) -> Baked[Look]:
        """Fit a material that varies.

        Parameters
        ----------
        varying : Varying
        amounts : (n, T) float32
            Opacity times mask of each of its local layers, at texels.
        progress : called with (stage, fraction done); may raise to cancel
        """
        knots, weights = _at_knots(amounts)
        fits: dict[tuple[int, ...], Fit[Look]] = {}
        for done, name in enumerate(sorted(weights, key=lambda one: (sum(one), one))):
            progress(f"fitting {varying.part}", done / len(weights))
            material = varying.material([float(knots[i, at]) for i, at in enumerate(name)])
            # an index of a film cannot be a texture
            fits[name] = self.material(material, _beside(fits, name), further=False)
        like = next(iter(fits.values())).look
        values = np.zeros((amounts.shape[1], len(as_values(like))))
        for name, (rows, part_of) in weights.items():
            values[rows] += part_of[:, None] * as_values(fits[name].look)
        return Baked(values, like, self._error(varying, amounts, values, like))

    def _seen(self, material: Material) -> Float64:
        values = material.values(self.embedding)
        return self.pixels.of_table(values, np.asarray(material.mirror, np.float64))

    def _error(self, varying: Varying, amounts: Float32, values: Float64, like: Look) -> float:
        rng = np.random.default_rng(0)
        painted = np.flatnonzero(amounts.max(axis=0) > 0.0)
        if not len(painted):
            painted = np.arange(amounts.shape[1])
        chosen = rng.choice(painted, min(_CHECKED, len(painted)), replace=False)
        errors = []
        for texel in chosen:
            material = varying.material([float(a) for a in amounts[:, texel]])
            look = of_values(like, values[texel])
            errors.append(error_of(self.target, look, self.pixels, self._seen(material)))
        return float(np.mean(errors))


def painted_tables(
    varying: Varying, amounts: Float32
) -> tuple[list[Material], dict[str, NDArray[Any]]]:
    """Return the materials at the knots of a part that varies, and how texels blend them.

    Parameters
    ----------
    varying : Varying
    amounts : (n, T) float32
        As for `Fitter.bake`.

    Returns
    -------
    materials : list of Material
    paint : dict of arrays
        ``cell`` (T,), ``share`` (n, T), and ``corners`` (cells, 2^n), the materials at the corners
        of each cell; bit i of a corner says which end along axis i.
    """
    knots = _knots(amounts)
    cell, share = _cells(amounts, knots)
    cells, which = np.unique(cell, axis=1, return_inverse=True)
    ends = np.array([[c >> i & 1 for i in range(len(amounts))] for c in range(1 << len(amounts))])
    keys = cells.T[:, None, :] + ends
    unique, place = np.unique(keys.reshape(-1, len(amounts)), axis=0, return_inverse=True)
    materials = [
        varying.material([float(knots[i, at]) for i, at in enumerate(one)]) for one in unique
    ]
    corners = place.reshape(len(keys), len(ends))
    return materials, {"cell": which.ravel(), "share": share, "corners": corners}


def _knots(amounts: Float32) -> Float64:
    """Return the amounts (n, levels) of knots along each layer."""
    levels = _LEVELS.get(len(amounts), 4)
    peak = np.maximum(amounts.max(axis=1), 1e-6).astype(np.float64)
    # materials change fastest within the first of a layer
    knots: Float64 = peak[:, None] * (np.arange(levels) / (levels - 1)) ** 2
    return knots


def _at_knots(
    amounts: Float32,
) -> tuple[Float64, dict[tuple[int, ...], tuple[Int64, Float64]]]:
    """Return the knots, and for those that texels need these texels and their weights."""
    knots = _knots(amounts)
    cell, share = _cells(amounts, knots)
    weights: dict[tuple[int, ...], tuple[Int64, Float64]] = {}
    for corner in itertools.product((0, 1), repeat=len(amounts)):
        end = np.array(corner)[:, None]
        part = np.where(end == 1, share, 1.0 - share).prod(axis=0)
        texel = np.flatnonzero(part > 0.0)
        keys, which = np.unique(cell[:, texel] + end, axis=1, return_inverse=True)
        order = np.argsort(which.ravel(), kind="stable")
        for key, rows in zip(
            keys.T, np.split(texel[order], np.cumsum(np.bincount(which.ravel()))[:-1]), strict=True
        ):
            name = tuple(int(at) for at in key)
            known, before = weights.get(name, (np.zeros(0, np.int64), np.zeros(0)))
            weights[name] = np.append(known, rows), np.append(before, part[rows])
    return knots, weights


def _cells(amounts: Float32, knots: Float64) -> tuple[Int64, Float64]:
    """Return the cell (n, T) that each amount lies in, and how far in it (n, T)."""
    cell = np.empty(amounts.shape, np.int64)
    share = np.empty(amounts.shape)
    for i, (given, at) in enumerate(zip(amounts.astype(np.float64), knots, strict=True)):
        cell[i] = np.clip(np.searchsorted(at, given, side="right") - 1, 0, len(at) - 2)
        low, high = at[cell[i]], at[cell[i] + 1]
        share[i] = np.clip((given - low) / (high - low), 0.0, 1.0)
    return cell, share


def _beside(fits: dict[tuple[int, ...], Fit[Any]], name: tuple[int, ...]) -> list[Float64]:
    """Return the vectors of the fits at neighbouring knots."""
    found = []
    for i, at in enumerate(name):
        known = fits.get((*name[:i], at - 1, *name[i + 1 :]))
        if known is not None:
            found.append(known.vector)
    return found


def as_values(look: Any) -> Float64:
    """Return the numbers (p,) of a look, a dataclass of numbers and colours."""
    return np.concatenate([np.atleast_1d(value) for value in astuple(look)])


def of_values(like: Look, values: Float64) -> Look:
    """Return a look of numbers (p,) in the order of another's."""
    found: dict[str, Any] = {}
    for name, at in columns(like).items():
        some = values[at].tolist()
        found[name] = tuple(some) if isinstance(getattr(like, name), tuple) else some[0]
    return type(like)(**found)


def columns(like: object) -> dict[str, slice]:
    """Return where each field of a look stands among `as_values`."""
    found, at = {}, 0
    for field in fields(like):  # type: ignore[arg-type]
        given = getattr(like, field.name)
        count = len(given) if isinstance(given, tuple) else 1
        found[field.name] = slice(at, at + count)
        at += count
    return found
