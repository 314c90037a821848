"""RGB indices of refraction of metals, from published spectra of n and k.

The Fresnel reflectance of a spectrum is weighted by the CIE 1931 observer under D65 and converted
to linear Rec.709, where white is 1 in all channels. Each channel's n + ik is the one whose Fresnel
curve is nearest to that reflectance over the angles. (A single wavelength per channel would be too
saturated, because a channel covers some 100 nm.)
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from traitbrdf.reflectance.models import fresnel_conductor

RGB: TypeAlias = tuple[float, float, float]
Float64: TypeAlias = NDArray[np.float64]
_EV_NM = 1239.84
_JOHNSON_CHRISTY = _EV_NM / np.array(
    [1.64, 1.76, 1.88, 2.01, 2.14, 2.26, 2.38, 2.50, 2.63, 2.75, 2.88, 3.00, 3.12, 3.25]
)
_THREE = np.array([650.0, 550.0, 450.0])

SPECTRA: Mapping[str, tuple[Float64, tuple[float, ...], tuple[float, ...]]] = MappingProxyType(
    {
        "gold": (
            _JOHNSON_CHRISTY,
            (0.14, 0.13, 0.14, 0.21, 0.29, 0.43, 0.62, 1.04, 1.31, 1.38, 1.45, 1.46, 1.47, 1.46),
            (4.542, 4.103, 3.697, 3.272, 2.863, 2.455, 2.081, 1.833, 1.849, 1.914, 1.948, 1.958,
             1.952, 1.933),
        ),
        "silver": (
            _JOHNSON_CHRISTY,
            (0.03, 0.04, 0.05, 0.06, 0.05, 0.06, 0.05, 0.05, 0.05, 0.04, 0.04, 0.05, 0.05, 0.05),
            (5.242, 4.838, 4.483, 4.152, 3.858, 3.586, 3.324, 3.093, 2.869, 2.657, 2.462, 2.275,
             2.070, 1.864),
        ),
        "copper": (
            _JOHNSON_CHRISTY,
            (0.24, 0.21, 0.22, 0.30, 0.70, 1.02, 1.18, 1.22, 1.25, 1.24, 1.25, 1.28, 1.32, 1.33),
            (4.665, 4.205, 3.747, 3.205, 2.704, 2.577, 2.608, 2.564, 2.483, 2.397, 2.305, 2.207,
             2.116, 2.045),
        ),
        "aluminium": (_THREE, (1.3456, 0.96521, 0.61722), (7.4746, 6.3995, 5.3031)),
        "brass": (_THREE, (0.444, 0.527, 1.094), (3.695, 2.765, 1.829)),
        "iron": (_THREE, (2.9114, 2.9497, 2.5845), (3.0893, 2.9318, 2.7670)),
        "lead": (_THREE, (1.91, 1.83, 1.44), (3.51, 3.40, 3.18)),
        "platinum": (_THREE, (2.3757, 2.0847, 1.8453), (4.2655, 3.7153, 3.1365)),
        "titanium": (_THREE, (2.7407, 2.5418, 2.2670), (3.8143, 3.4345, 3.0385)),
        "nickel": (
            np.array([650.0, 550.0, 400.0]), (2.013, 1.772, 1.610), (3.806, 3.252, 2.360)
        ),
        "chrome": (
            np.array([642.0, 529.0, 464.0]), (3.11847, 3.02492, 2.44207), (3.3190, 3.3322, 3.2034)
        ),
    }
)  # fmt: skip
"""Wavelengths in nm, n and k. Gold, silver and copper: Johnson & Christy, "Optical Constants of the
Noble Metals", Phys. Rev. B 6 (1972), table I, from 1.64 to 3.25 eV. The others are smooth in the
visible range and given at three wavelengths: Rakic (1995, 1998), Johnson & Christy (1974) and
others, as collected by refractiveindex.info; chrome as in the table that renderers commonly use."""

_D65 = (
    np.arange(380.0, 730.0, 20.0),
    np.array([50.0, 82.8, 93.4, 104.9, 117.8, 115.9, 109.4, 104.8, 104.4, 100.0, 95.8, 90.0, 87.7,
               83.7, 80.2, 78.3, 71.6, 61.6]),
)  # fmt: skip
"""CIE standard illuminant D65, relative, every 20 nm."""

_REC709 = np.array(
    [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.9692660, 1.8760108, 0.0415560],
        [0.0556434, -0.2040259, 1.0572252],
    ]
)

_COSINES = np.array([1.0, 0.8, 0.6, 0.4, 0.25, 0.12])
"""Cosines of incidence at which Fresnel curves are compared."""


@functools.lru_cache(maxsize=1)
def _channels() -> tuple[Float64, Float64]:
    """Return wavelengths (n,) and their weights for R, G and B (3, n); rows sum to 1.

    The observer is the multi-lobe fit of Wyman, Sloan & Shirley, "Simple Analytic Approximations to
    the CIE XYZ Color Matching Functions", JCGT 2 (2013), table 1.
    """
    nm = np.arange(380.0, 721.0, 5.0)

    def lobe(height: float, middle: float, below: float, above: float) -> Float64:
        width = np.where(nm < middle, below, above)
        return np.asarray(height * np.exp(-0.5 * ((nm - middle) / width) ** 2))

    xyz = np.stack(
        [
            lobe(1.056, 599.8, 37.9, 31.0) + lobe(0.362, 442.0, 16.0, 26.7)
            - lobe(0.065, 501.1, 20.4, 26.2),
            lobe(0.821, 568.8, 46.9, 40.5) + lobe(0.286, 530.9, 16.3, 31.1),
            lobe(1.217, 437.0, 11.8, 36.0) + lobe(0.681, 459.0, 26.0, 13.8),
        ]
    )  # fmt: skip
    rgb = _REC709 @ (xyz * np.interp(nm, *_D65))
    return nm, rgb / rgb.sum(axis=1, keepdims=True)


def reflectance(name: str, cosine: Float64) -> Float64:
    """Return the linear Rec.709 Fresnel reflectance (..., 3) in [0, 1] of a metal.

    Parameters
    ----------
    name : str
        One of `SPECTRA`.
    cosine : (...) array
        Cosines of incidence.
    """
    nm, share = _channels()
    wavelength, n, k = SPECTRA[name]
    order = np.argsort(wavelength)
    eta, extinction = (np.interp(nm, wavelength[order], np.array(v)[order]) for v in (n, k))
    spectrum = fresnel_conductor(np.asarray(cosine)[..., None], eta, extinction)
    # a channel of a saturated colour would exceed the reflectance at every wavelength
    return np.clip(spectrum @ share.T, 0.0, spectrum.max(axis=-1, keepdims=True))


@functools.cache
def indices(name: str) -> tuple[RGB, RGB]:
    """Return n and k (R, G, B), to four decimals, that fit the spectrum's Fresnel curves best.

    Parameters
    ----------
    name : str
        One of `SPECTRA`.
    """
    wanted = reflectance(name, _COSINES)
    wavelength, n, k = SPECTRA[name]
    found = []
    for curve, middle in zip(wanted.T, (610.0, 550.0, 465.0), strict=True):
        nearest = int(np.argmin(np.abs(wavelength - middle)))

        def away(point: Float64, curve: Float64 = curve) -> Float64:
            shown = fresnel_conductor(_COSINES, math.exp(point[0]), math.exp(point[1]))
            return np.asarray(shown - curve)

        # a tenth inside the ranges of the models, because members of the library vary by that
        low, high = np.log([[0.06, 0.06], [4.5, 14.0]])
        start = np.clip(np.log([n[nearest], k[nearest]]), low + 1e-6, high - 1e-6)
        # converge to 1e-8: the rest depends on the processor, and rounding removes it
        fit = scipy.optimize.least_squares(
            away, start, "3-point", (low, high), xtol=1e-14, ftol=1e-15, gtol=1e-14
        )
        found.append(np.exp(fit.x))
    r, g, b = np.round(found, 4).tolist()
    return (r[0], g[0], b[0]), (r[1], g[1], b[1])
