"""Fit of materials to the models of other programs, by rendered error."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from traitbrdf.export.lobes import FittingPixels, Pixels
from traitbrdf.formats.display import exposure_of

Float64 = NDArray[np.float64]
Look = TypeVar("Look")

_ROUGH = (0.06, 0.15, 0.32, 0.6)  # roughness that fits start from
_HELD_OUT = 2  # lights that a fit does not see, and that its error is measured under
_FIRST, _LAST = 12, 60  # evaluations: of all starts, and of the best
_FAR = 0.03  # error from which further starts are tried
_BETTER = 0.7  # share of the cost that makes them worth it


class Target(Protocol[Look]):
    """A model of another program.

    Its looks are vectors (n,) in [0, 1] to the optimiser.
    """

    size: int

    def look(self, vector: Float64) -> Look:
        """Return the parameters of a vector (n,)."""

    def image(self, look: Look, pixels: Pixels) -> Float64:
        """Return the radiance (m, 3) of pixels."""

    def starts(self, colour: Float64, roughness: float) -> Iterable[Float64]:
        """Return vectors to start from: a surface of a colour (3,) and a roughness."""

    def further(self, vector: Float64) -> Iterable[Float64]:
        """Return vectors to try if the best of `starts` has come to this vector, and is far off."""

    def cost(self, vector: Float64) -> Float64:
        """Return residuals (r,) of what is asked beside the picture, such as no needless coat."""


@dataclass(frozen=True)
class Fit(Generic[Look]):
    """A material in a target's own parameters.

    Attributes
    ----------
    look : the parameters
    vector : (n,) float64, the same to the optimiser
    error : float
        Mean |I - I_table| over mean I_table, of pixels of a sphere under lights that the fit did
        not see. The contract's metric.
    """

    look: Look
    vector: Float64
    error: float


def fit(
    target: Target[Look],
    pixels: FittingPixels,
    seen: Float64,
    near: Iterable[Float64] = (),
    further: bool = True,
) -> Fit[Look]:
    """Fit a target's model to the pixels that a table shows.

    The difference is that of cube roots of the exposed radiance, so that dark pixels count as eyes
    count them.

    Parameters
    ----------
    target : Target
    pixels : FittingPixels
    seen : (m, 3) float64
        Their radiance under the table.
    near : vectors (n,) of looks that are probably near; a few steps from them are then enough
    further : bool
        Whether to try what the target has for materials that its usual looks are far from.

    Returns
    -------
    Fit
    """
    held = _held_out(pixels)
    exposure = np.ones(len(seen))
    for i in np.unique(pixels.light):
        exposure[pixels.light == i] = exposure_of(seen[pixels.light == i])
    wanted = _shown(seen, exposure)[~held]

    def residual(vector: Float64) -> Float64:
        image = target.image(target.look(vector), pixels)
        off = (_shown(image, exposure)[~held] - wanted).ravel()
        return np.concatenate([off / np.sqrt(len(off)), target.cost(vector)])

    def solve(start: Float64, most: int) -> tuple[float, Float64]:
        found = scipy.optimize.least_squares(
            residual, np.clip(start, 1e-4, 1.0 - 1e-4), bounds=(0.0, 1.0), max_nfev=most, ftol=1e-5
        )
        return float(found.cost), found.x

    first = [solve(start, _FIRST) for start in near]
    if not first:
        flat = target.image(target.look(next(iter(target.starts(np.ones(3), 1.0)))), pixels)
        colour = np.clip(seen.mean(axis=0) / max(float(flat.mean()), 1e-12), 0.0, 1.0)
        first = [solve(start, _FIRST) for rough in _ROUGH for start in target.starts(colour, rough)]
        first.sort(key=lambda one: one[0])
        first = [solve(vector, _LAST) for _, vector in first[:2]]
    cost, vector = min(first, key=lambda one: one[0])
    error = error_of(target, target.look(vector), pixels, seen)
    if further and error > _FAR:
        others = sorted((solve(s, _FIRST) for s in target.further(vector)), key=lambda one: one[0])
        others = [solve(other, _LAST) for _, other in others[:2]]
        best = min(others, default=(cost, vector), key=lambda one: one[0])
        if best[0] < _BETTER * cost:
            vector = best[1]
            error = error_of(target, target.look(vector), pixels, seen)
    return Fit(target.look(vector), vector, error)


def error_of(target: Target[Look], look: Look, pixels: FittingPixels, seen: Float64) -> float:
    """Return mean |I - I_table| over mean I_table at the pixels that fits do not see.

    Parameters
    ----------
    target : Target
    look : its parameters
    pixels : FittingPixels
    seen : (m, 3) float64
        Radiance under the table.
    """
    held = _held_out(pixels)
    off = np.abs(target.image(look, pixels) - seen)[held].mean()
    return float(off / max(float(seen[held].mean()), 1e-12))


def _held_out(pixels: FittingPixels) -> NDArray[np.bool_]:
    return np.asarray(pixels.light > pixels.light.max() - _HELD_OUT)


def _shown(image: Float64, exposure: Float64) -> Float64:
    x = np.maximum(image * exposure[:, None], 0.0)
    return np.asarray(np.cbrt(x + 0.002))
