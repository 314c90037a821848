"""Convert linear radiance to display values: exposure, tone curve, sRGB."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray


def encode_srgb(linear: ArrayLike) -> NDArray[np.uint8]:
    """Encode linear Rec.709 values as 8-bit sRGB (IEC 61966-2-1), clipped to [0, 1].

    Parameters
    ----------
    linear : (..., 3) array_like
        1 is display white; infinities are clipped.

    Returns
    -------
    (..., 3) uint8

    Raises
    ------
    ValueError
        On another last axis, numbers that are not real, or NaN.
    """
    values = np.asarray(linear)
    if values.dtype.kind not in "fiu":
        raise ValueError(f"linear: expected real numbers, got {values.dtype}")
    if values.ndim == 0 or values.shape[-1] != 3:
        raise ValueError(f"linear: expected shape (..., 3), got {values.shape}")
    x = np.clip(values.astype(np.float64), 0.0, 1.0)
    if np.isnan(x).any():
        raise ValueError(f"linear: expected numbers, got {int(np.isnan(x).sum())} NaN")
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1.0 / 2.4) - 0.055)
    return np.asarray(255.0 * encoded + 0.5).astype(np.uint8)


def decode_srgb(encoded: ArrayLike) -> NDArray[np.float64]:
    """Return the linear Rec.709 values of sRGB ones.

    Parameters
    ----------
    encoded : array_like
        In [0, 1]; 8-bit values divided by 255.

    Returns
    -------
    float64 array of the same shape
    """
    x = np.asarray(encoded, np.float64)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def exposure_of(linear: ArrayLike) -> float:
    """Return the exposure that maps the 90th percentile of an image to a bright value.

    Parameters
    ----------
    linear : (..., 3) array_like
        Linear radiance.

    Returns
    -------
    float
        0.8 over the 90th percentile of the greatest channel; 1 for a black image.
    """
    bright = float(np.quantile(np.asarray(linear, np.float64).max(axis=-1), 0.9))
    return 0.8 / bright if bright > 0.0 else 1.0


def tone_map(linear: ArrayLike, exposure: float = 1.0) -> NDArray[np.uint8]:
    """Map linear radiance to 8-bit sRGB with a filmic tone curve.

    The curve is Narkowicz's fit (2015) of the ACES reference rendering.

    Parameters
    ----------
    linear : (..., 3) array_like
        Linear radiance.
    exposure : float
        Positive factor that scales the radiance first.

    Returns
    -------
    (..., 3) uint8

    Raises
    ------
    ValueError
        On another last axis, NaN, or an exposure that is not positive and finite.
    """
    if not (math.isfinite(exposure) and exposure > 0.0):
        raise ValueError(f"exposure: expected a positive number, got {exposure!r}")
    x = np.clip(np.asarray(linear, np.float64) * exposure, 0.0, 1e6)
    return encode_srgb(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14))


class Display:
    """Apply `tone_map` at one exposure from a look-up table: faster, and within one level of it.

    Parameters
    ----------
    exposure : float
        As for `tone_map`.
    """

    _STEPS = 4096
    _WHITE = 16.0  # the curve is flat beyond

    def __init__(self, exposure: float) -> None:
        self.exposure = exposure
        levels = np.arange(int(self._WHITE * self._STEPS)) / self._STEPS
        grey = tone_map(np.repeat(levels[:, None], 3, axis=1) / exposure, exposure)
        self._table = np.ascontiguousarray(grey[:, 0])

    def __call__(self, linear: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return 8-bit sRGB (..., 3) of `linear` radiance (..., 3), not negative and not NaN."""
        scaled = linear * np.float32(self.exposure * self._STEPS)
        np.minimum(scaled, np.float32(len(self._table) - 1), out=scaled)
        return self._table[scaled.astype(np.uint16)]
