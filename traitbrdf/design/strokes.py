"""Painted strokes: polylines on the image, and how much of them lies on each region.

Arrays only; this module knows neither scenes nor BRDFs. Image coordinates are pixels: x counts
columns from the left, y rows from the top; the centre of the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import scipy.sparse
import scipy.sparse.csgraph
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
_FURTHEST = 1e9  # pixels: beyond, squares of distances would lose the brush


@dataclass(frozen=True)
class Stroke:
    """One stroke of a brush.

    Parameters
    ----------
    points : sequence of (x, y), at least one
        The polyline in image pixels; may leave the image.
    trait : str or None
        None is a stroke that `EditSession.paint` is given an effect for.
    amount : float
        Change of the trait's score; 1 is from typically low to typically high.
    radius : float
        Of the brush, in pixels. The brush is full in its inner half and fades to its rim.
    hold : what shall stay, as for `EditSession.move`; None is what the trait holds by itself

    Raises
    ------
    ValueError, TypeError
        On no points, or numbers that are not finite, or a radius that is not positive.

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
        for name in ("amount", "radius"):
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
        points = tuple((float(x), float(y)) for x, y in line)
        object.__setattr__(self, "points", points)
        if self.hold is not None:
            try:
                hold = (self.hold,) if isinstance(self.hold, str) else tuple(self.hold)
            except TypeError:
                raise TypeError(f"hold: expected names of traits, got {self.hold!r}") from None
            object.__setattr__(self, "hold", hold)

    def coverage(self, height: int, width: int) -> Float32:
        """How much the brush covers each pixel of an image, (height, width) in [0, 1].

        A function of the distance to the polyline alone: cutting a segment in two changes
        nothing.
        """
        result = np.zeros((height, width), np.float32)
        squared, (y0, y1, x0, x1) = self._distances(height, width)
        squared = squared[y0:y1, x0:x1]
        # beyond the rim all is the same: do not divide by a tiny radius there
        away = np.minimum(np.sqrt(squared), self.radius)
        fade = np.clip(2.0 - 2.0 * away / self.radius, 0.0, 1.0)
        result[y0:y1, x0:x1] = fade * fade * (3.0 - 2.0 * fade)
        return result

    def extended(
        self, points: Sequence[tuple[float, float]], amount: float | None = None
    ) -> Stroke:
        """This stroke with more points, and another amount unless that is None.

        What this one has measured on an image is handed on, so that a stroke can grow while it is
        painted without being measured anew.

        Raises
        ------
        As for a new stroke.
        """
        amount = self.amount if amount is None else amount
        longer = Stroke((*self.points, *points), self.trait, amount, self.radius, self.hold)
        known = self.__dict__.pop("_measured", None)
        if known is not None:
            object.__setattr__(longer, "_measured", known)
        return longer

    def _distances(self, height: int, width: int) -> tuple[NDArray[np.float64], tuple[int, ...]]:
        """Squared distances (height, width) from the polyline, right where they are within reach,
        and the rows and columns outside of which nothing is.
        """
        known = self.__dict__.pop("_measured", None)
        if known is not None and known[0].shape == (height, width):
            squared, box, done = known
        else:
            squared, box, done = np.full((height, width), np.inf), (height, 0, width, 0), 0
        line = np.asarray(self.points)
        ends = line[1:] if len(line) > 1 else line
        begun = max(done - 1, 0)  # a dab alone is a segment to itself, which its line covers
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
    on = (region >= 0) & (coverage > 0.0)
    totals = np.bincount(region[on], weights=coverage[on], minlength=count)[:count]
    whole = totals.sum()
    return np.asarray(totals / whole if whole > 0.0 else totals, np.float64)


def follow(inside: NDArray[np.bool_]) -> tuple[list[tuple[float, float]], float]:
    """A stroke that runs along a region and stays within it.

    The longest of the shortest paths through the region's largest piece, drawn towards its
    middle line, and the greatest brush radius that touches nothing outside.

    Parameters
    ----------
    inside : (H, W) mask with at least one pixel

    Returns
    -------
    points : list of (x, y)
    radius : pixels
    """
    if not inside.any():
        raise ValueError("inside: expected a region of at least one pixel, got none")
    # a border of zeros: the rim of the image bounds the region as well
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
    distance, before = scipy.sparse.csgraph.dijkstra(
        graph, directed=False, indices=source, return_predecessors=True
    )
    return np.where(np.isfinite(distance), distance, -1.0), before


def _clear_radius(points: list[tuple[float, float]], inside: NDArray[np.bool_]) -> float:
    """The greatest radius at which a stroke covers no pixel outside; at least a third pixel."""
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
