"""Painted strokes: polylines on the image, and how much of them lies on each region.

Arrays only; this module knows neither scenes nor BRDFs. Image coordinates are pixels: x counts
columns from the left, y rows from the top; the centre of the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Stroke:
    """One stroke of a trait brush.

    Parameters
    ----------
    points : sequence of (x, y), at least one
        The polyline in image pixels; may leave the image.
    trait : str
    amount : float
        Change of the trait's score; 1 is from typically low to typically high.
    radius : float
        Of the brush, in pixels. The brush is full in its inner half and fades to its rim.
    hold : traits or groups that shall stay; None is the colour, unless a colour is painted

    Raises
    ------
    ValueError, TypeError
        On no points, or numbers that are not finite, or a radius that is not positive.
    """

    points: Sequence[tuple[float, float]]
    trait: str
    amount: float
    radius: float = 24.0
    hold: Iterable[str] | None = None

    def __post_init__(self) -> None:
        try:
            line = np.asarray(self.points, np.float64)
        except (TypeError, ValueError):
            raise TypeError(f"points: expected (x, y) pairs, got {self.points!r}") from None
        if line.ndim != 2 or line.shape[1] != 2 or len(line) == 0:
            raise ValueError(f"points: expected at least one (x, y), got shape {line.shape}")
        if not np.isfinite(line).all():
            raise ValueError("points: expected finite coordinates")
        if not isinstance(self.trait, str):
            raise TypeError(f"trait: expected a name, got {self.trait!r}")
        for name in ("amount", "radius"):
            value = getattr(self, name)
            if not isinstance(value, (int, float, np.floating, np.integer)):
                raise TypeError(f"{name}: expected a number, got {value!r}")
            if not math.isfinite(value):
                raise ValueError(f"{name}: expected a finite number, got {value!r}")
        if self.radius <= 0.0:
            raise ValueError(f"radius: expected a positive number of pixels, got {self.radius!r}")
        points = tuple((float(x), float(y)) for x, y in line)
        object.__setattr__(self, "points", points)
        if self.hold is not None:
            hold = (self.hold,) if isinstance(self.hold, str) else tuple(self.hold)
            object.__setattr__(self, "hold", hold)

    def coverage(self, height: int, width: int) -> Float32:
        """How much the brush covers each pixel of an image, (height, width) in [0, 1].

        A function of the distance to the polyline alone: cutting a segment in two changes
        nothing.
        """
        result = np.zeros((height, width), np.float32)
        line = np.asarray(self.points)
        reach = self.radius
        x0, y0 = np.floor(line.min(axis=0) - reach).astype(int)
        x1, y1 = np.ceil(line.max(axis=0) + reach).astype(int) + 1
        x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, width), min(y1, height)
        if x0 >= x1 or y0 >= y1:
            return result
        x = np.arange(x0, x1) + 0.5
        y = (np.arange(y0, y1) + 0.5)[:, None]
        squared = np.full((y1 - y0, x1 - x0), np.inf)
        ends = line[1:] if len(line) > 1 else line
        for (ax, ay), (bx, by) in zip(line, ends, strict=False):
            dx, dy = bx - ax, by - ay
            length = dx * dx + dy * dy
            t = ((x - ax) * dx + (y - ay) * dy) / length if length > 0.0 else 0.0
            t = np.clip(t, 0.0, 1.0)
            away = (x - ax - t * dx) ** 2 + (y - ay - t * dy) ** 2
            np.minimum(squared, away, out=squared)
        fade = np.clip(2.0 - 2.0 * np.sqrt(squared) / reach, 0.0, 1.0)
        result[y0:y1, x0:x1] = fade * fade * (3.0 - 2.0 * fade)
        return result


def region_weights(
    coverage: Float32, region: NDArray[np.integer], count: int
) -> NDArray[np.float64]:
    """Share (count,) of the stroke's part on the object that lies on each region.

    Parameters
    ----------
    coverage : (H, W), from `Stroke.coverage`
    region : (H, W) integers, the region seen by each pixel; negative where there is none
    count : number of regions

    Returns
    -------
    (count,) weights that sum to 1, or all 0 where the stroke misses the object.
    """
    on = region >= 0
    totals = np.bincount(region[on], weights=coverage[on], minlength=count)[:count]
    whole = totals.sum()
    return np.asarray(totals / whole if whole > 0.0 else totals, np.float64)
