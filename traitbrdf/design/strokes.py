"""Painted strokes: polylines on the image, and how much of each region they cover.

This module works on arrays only; it knows neither scenes nor BRDFs (`traitbrdf.scene.trails` puts
strokes on surfaces). Image coordinates are pixels: x
counts columns from the left, y rows from the top, and the centre of the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import scipy.sparse

Float32 = NDArray[np.float32]
_FURTHEST = 1e9  # pixels; squares of larger distances would not resolve the brush


@dataclass(frozen=True)
class Stroke:
    """One stroke of a brush.

    Parameters
    ----------
    points : sequence of (x, y), at least one
        The polyline in image pixels; it may leave the image.
    trait : str or None
        The trait to move; None is a stroke for which `EditSession.paint` is given an effect.
    amount : float
        Change of the trait's score; 1 leads from a typically low to a typically high score.
    radius : float
        Radius of the brush, positive.
    hold : iterable of str, or None
        What the edit holds constant, as for `EditSession.move`; None is the default of the trait.
    hardness : float
        Share of the radius, in [0, 1], within which the brush has full strength; beyond it the
        brush fades to zero at its rim.
    flow : float
        How much paint comes out, in (0, 1], of a stroke that is painted locally.
    pressure : sequence of float, or None
        Pressure of the pen at each point, in [0, 1], by which the flow is multiplied; None is 1.
    units : "pixels" or "world"
        Of the radius: pixels of the image, or units of the world (strokes painted locally alone).

    Raises
    ------
    TypeError
        On values of another type.
    ValueError
        On no points, numbers that are not finite, or a radius that is not positive.

    Examples
    --------
    >>> stroke = Stroke([(2.5, 4.5), (7.5, 4.5)], trait="shiny", amount=0.5, radius=2.0)
    >>> cover = stroke.coverage(10, 10)
    >>> float(cover[4, 5]), float(cover[9, 5])
    (1.0, 0.0)
    """

    points: Sequence[tuple[float, float]]
    trait: str | None = None
    amount: float = 0.0
    radius: float = 24.0
    hold: Iterable[str] | None = None
    hardness: float = 0.5
    flow: float = 1.0
    pressure: Sequence[float] | None = None
    units: str = "pixels"

    def __post_init__(self) -> None:
        try:
            line = np.asarray(self.points, np.float64)
        except (TypeError, ValueError):
            raise TypeError(f"points: expected (x, y) pairs, got {self.points!r}") from None
        if line.ndim != 2 or line.shape[1] != 2 or len(line) == 0:
            raise ValueError(f"points: expected at least one (x, y), got shape {line.shape}")
        if not np.all(np.abs(line) <= _FURTHEST):
            raise ValueError(f"points: expected finite coordinates of at most {_FURTHEST:g} pixels")
        if self.trait is not None and not isinstance(self.trait, str):
            raise TypeError(f"trait: expected a name, got {self.trait!r}")
        for name in ("amount", "radius", "hardness", "flow"):
            value = getattr(self, name)
            if not isinstance(value, (int, float, np.floating, np.integer)):
                raise TypeError(f"{name}: expected a number, got {value!r}")
            if not math.isfinite(value):
                raise ValueError(f"{name}: expected a finite number, got {value!r}")
        if not 0.0 < self.radius <= _FURTHEST:
            raise ValueError(
                f"radius: expected a positive number of pixels up to {_FURTHEST:g}, "
                f"got {self.radius!r}"
            )
        if not 0.0 <= self.hardness <= 1.0:
            raise ValueError(f"hardness: expected 0 to 1, got {self.hardness!r}")
        if not 0.0 < self.flow <= 1.0:
            raise ValueError(f"flow: expected above 0, up to 1, got {self.flow!r}")
        if self.units not in ("pixels", "world"):
            raise ValueError(f"units: expected 'pixels' or 'world', got {self.units!r}")
        points = tuple((float(x), float(y)) for x, y in line)
        object.__setattr__(self, "points", points)
        if self.pressure is not None:
            object.__setattr__(self, "pressure", _pressures(self.pressure, len(points)))
        if self.hold is not None:
            try:
                hold = (self.hold,) if isinstance(self.hold, str) else tuple(self.hold)
            except TypeError:
                raise TypeError(f"hold: expected names of traits, got {self.hold!r}") from None
            object.__setattr__(self, "hold", hold)

    def coverage(self, height: int, width: int) -> Float32:
        """Return how much the brush covers each pixel of an image, (height, width) in [0, 1].

        It is a function of the distance to the polyline alone, so splitting a segment changes
        nothing.

        Parameters
        ----------
        height, width : int
            Pixels of the image.
        """
        result = np.zeros((height, width), np.float32)
        squared, (y0, y1, x0, x1) = self._distances(height, width)
        squared = squared[y0:y1, x0:x1]
        # clipped at the rim, so that a tiny radius cannot cause an overflow
        away = np.minimum(np.sqrt(squared), self.radius)
        fade = np.clip((1.0 - away / self.radius) / max(1.0 - self.hardness, 1e-3), 0.0, 1.0)
        result[y0:y1, x0:x1] = fade * fade * (3.0 - 2.0 * fade)
        return result

    def extended(
        self,
        points: Sequence[tuple[float, float]],
        amount: float | None = None,
        pressure: Sequence[float] | None = None,
    ) -> Stroke:
        """Return this stroke with more points.

        The new stroke reuses the distances that this one has computed, so that a stroke can grow
        while it is painted.

        Parameters
        ----------
        points : sequence of (x, y)
            Points to append.
        amount : float or None
            The new amount; None keeps it.
        pressure : sequence of float, or None
            Pressure at the points to append, if this stroke has pressures.

        Raises
        ------
        TypeError, ValueError
            As for a new stroke.
        """
        amount = self.amount if amount is None else amount
        pressed = None if self.pressure is None else (*self.pressure, *(pressure or ()))
        longer = replace(self, points=(*self.points, *points), amount=amount, pressure=pressed)
        known = self.__dict__.pop("_measured", None)
        if known is not None:
            object.__setattr__(longer, "_measured", known)
        return longer

    def _distances(self, height: int, width: int) -> tuple[NDArray[np.float64], tuple[int, ...]]:
        """Return squared distances (height, width) from the polyline, and the box of valid ones.

        The box is the range of rows and columns that the brush can reach.
        """
        known = self.__dict__.pop("_measured", None)
        if known is not None and known[0].shape == (height, width):
            squared, box, done = known
        else:
            squared, box, done = np.full((height, width), np.inf), (height, 0, width, 0), 0
        line = np.asarray(self.points)
        ends = line[1:] if len(line) > 1 else line
        begun = max(done - 1, 0)  # a single point is a segment from itself to itself
        for (ax, ay), (bx, by) in zip(line[begun:], ends[begun:], strict=False):
            x0 = min(max(math.floor(min(ax, bx) - self.radius), 0), width)
            x1 = min(max(math.ceil(max(ax, bx) + self.radius) + 1, x0), width)
            y0 = min(max(math.floor(min(ay, by) - self.radius), 0), height)
            y1 = min(max(math.ceil(max(ay, by) + self.radius) + 1, y0), height)
            if x0 >= x1 or y0 >= y1:
                continue
            box = (min(box[0], y0), max(box[1], y1), min(box[2], x0), max(box[3], x1))
            x = np.arange(x0, x1) + 0.5
            y = (np.arange(y0, y1) + 0.5)[:, None]
            dx, dy = bx - ax, by - ay
            length = dx * dx + dy * dy
            t = ((x - ax) * dx + (y - ay) * dy) / length if length > 0.0 else 0.0
            t = np.clip(t, 0.0, 1.0)
            away = (x - ax - t * dx) ** 2 + (y - ay - t * dy) ** 2
            near = squared[y0:y1, x0:x1]
            np.minimum(near, away, out=near)
        object.__setattr__(self, "_measured", (squared, box, len(line)))
        return squared, box


def _pressures(given: object, count: int) -> tuple[float, ...]:
    """Return the pressures of a stroke of some points; errors are raised as `Stroke` does."""
    try:
        pressed = np.asarray(given, np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"pressure: expected numbers, got {given!r}") from None
    if pressed.shape != (count,):
        raise ValueError(f"pressure: expected one for each of {count} points, got {pressed.shape}")
    if not ((pressed >= 0.0) & (pressed <= 1.0)).all():
        raise ValueError(f"pressure: expected 0 to 1, got {given!r}")
    return tuple(pressed.tolist())


def region_weights(
    coverage: Float32, region: NDArray[np.integer], count: int
) -> NDArray[np.float64]:
    """Return the share (count,) of the stroke's coverage of the object that lies on each region.

    Parameters
    ----------
    coverage : (H, W) array
        From `Stroke.coverage`.
    region : (H, W) int array
        Index of the region that each pixel shows; negative for none.
    count : int
        Number of regions.

    Returns
    -------
    (count,) float64
        Weights that sum to 1, or all 0 if the stroke misses the object.
    """
    on = (region >= 0) & (coverage > 0.0)
    totals = np.bincount(region[on], weights=coverage[on], minlength=count)[:count]
    whole = totals.sum()
    return np.asarray(totals / whole if whole > 0.0 else totals, np.float64)


def follow(inside: NDArray[np.bool_]) -> tuple[list[tuple[float, float]], float]:
    """Return a stroke that runs along a region and stays inside it.

    It is the longest of the shortest paths through the largest piece of the region, with costs that
    draw it to the middle; its radius is the greatest that covers nothing outside.

    Parameters
    ----------
    inside : (H, W) bool array
        Mask with at least one pixel.

    Returns
    -------
    points : list of (x, y)
    radius : float
        Pixels.

    Raises
    ------
    ValueError
        If the mask is empty.
    """
    if not inside.any():
        raise ValueError("inside: expected a region of at least one pixel, got none")
    # these take a tenth of a second to import, and sessions do not need them
    import scipy.ndimage
    import scipy.sparse

    # padded with zeros, because the edge of the image bounds the region as well
    depth = scipy.ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1]
    pieces, _ = scipy.ndimage.label(depth >= 0.4 * depth.max())
    largest = int(np.argmax(np.bincount(pieces.ravel())[1:])) + 1
    row, column = np.nonzero(pieces == largest)
    node = np.full(inside.shape, -1)
    node[row, column] = np.arange(len(row))
    links = []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        y, x = row + dy, column + dx
        fits = (y < inside.shape[0]) & (x >= 0) & (x < inside.shape[1])
        to = np.full(len(row), -1)
        to[fits] = node[y[fits], x[fits]]
        ok = to >= 0
        cost = math.hypot(dx, dy) / depth[row[ok], column[ok]] ** 2
        links.append((np.flatnonzero(ok), to[ok], cost))
    start, end, cost = (np.concatenate(part) for part in zip(*links, strict=True))
    graph = scipy.sparse.csr_array((cost, (start, end)), shape=(len(row), len(row)))
    deepest = int(np.argmax(depth[row, column]))
    first = int(np.argmax(_reachable(graph, deepest)[0]))
    distance, before = _reachable(graph, first)
    path = [int(np.argmax(distance))]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    kept = path[:: max(1, len(path) // 24)]
    if kept[-1] != path[-1]:
        kept.append(path[-1])
    points = [(float(column[i]) + 0.5, float(row[i]) + 0.5) for i in kept]
    return points, _clear_radius(points, inside)


def _reachable(
    graph: scipy.sparse.csr_array, source: int
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    import scipy.sparse.csgraph  # imported late, as in `follow`

    distance, before = scipy.sparse.csgraph.dijkstra(
        graph, directed=False, indices=source, return_predecessors=True
    )
    return np.where(np.isfinite(distance), distance, -1.0), before


def _clear_radius(points: list[tuple[float, float]], inside: NDArray[np.bool_]) -> float:
    """Return the greatest radius at which a stroke covers no pixel outside; at least 1/3 pixel."""
    radius = float(max(inside.shape))
    y, x = np.nonzero(~inside)
    outside = np.stack([x + 0.5, y + 0.5], axis=1)
    if len(outside):
        line = np.asarray(points)
        for a, b in zip(line, line[1:] if len(line) > 1 else line, strict=False):
            along = b - a
            length = float(along @ along)
            t = np.clip((outside - a) @ along / length, 0.0, 1.0) if length > 0.0 else 0.0
            away = outside - a - np.multiply.outer(t, along)
            radius = min(radius, float(np.sqrt((away**2).sum(axis=1).min())))
    else:
        radius *= 0.25
    return max(0.99 * radius, 1.0 / 3.0)
