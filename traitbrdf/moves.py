"""Where moves of traits lead: a flow through the embedding.

A move is the solution of dz/dt = v(z). The velocity v is the one that costs least: it is as short
as can be in a covariance of the library, changes moved scores as fast as asked for, held ones not
at all, and what had better stay, unrelated scores and the colours that a person sees, as little as
can be. That is a quadratic programme in the box (Nocedal & Wright 2006, chapter 16), solved at each
point alike: so a way is continuous, has no memory, and can be gone back.

`Density`, `Grades` and `Readings` say where the library is and what scores are read off; `Ground`
is all of it, as arrays, and `Task` one move.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.descriptors import (
    DESCRIPTORS,
    LUMINANCE,
    READINGS,
    WHITE,
    cielab,
    formulas,
)
from traitbrdf.embedding import FLOOR, OPPONENT

Float64 = NDArray[np.float64]

STEP = 0.05  # in scores: how far a move goes before it looks again
_APART = 2.0  # what a change of unrelated scores costs, beside the metric
_BODY = 30.0  # what a change of the body costs, where it is kept
_STEER = 0.1  # what it costs to miss a unit of a* or b* of the colour that a move leads to
_KEEN = 4.0  # shares of what is missing that are made up for in a unit
_TURNING = 105.0  # colour difference for a unit: no faster
_TINGED = 0.15  # log RGB: less is grey
_HELD = 1e6  # what a change of a held score costs
_WANTED = 3000.0  # what it costs that a moved score stays behind
_FULL = 0.7  # of the way asked for: from here on all of it is made
_WALL = 1e5  # what it costs to go through a wall
_BACK = 0.05  # the most that a step goes back to a wall that the last one went through
_THIN = 0.1  # of log density, beside what decoding mends
_MENDS = 4  # how often scores are put right after a step
_EXACT = 2e-4  # how near a score is brought
_OVER = 0.02  # log f by which a step may go through a wall
_TRUST = 0.01  # how far a step's scores may be from what the field says
_ASTRAY = 2e-3  # how far held scores may be from where they were
_FALLS = 5e-4  # by which a moved score may fall in a part of a step
_LOST = 0.02  # what is further off is no error of a step
_SMOOTH = 0.12  # of a descriptor's range: over which its distribution is smoothed
_POWER = 48  # of the norm that stands for the greatest albedo: smooth, and 5 % above at most
_LONG = 0.4  # standard deviations: no part of a step is longer
_PARTS = 16.0  # shorter than that part of a step it is never made
_LOOKS = 48  # at the field, in a step
_FASTEST = 20.0  # standard deviations for a unit
_SHOWN = 130.0  # of the CIE 1976 colour difference for a unit
_HARDLY = 1e-9  # less than this is no way at all
_STUCK = 0.02  # of the way asked for: what makes less has ended
_PATIENCE = 3  # steps that come to nothing before a move ends
_SMALL = 1e-5  # a step along a coordinate that shows slopes


# What is compiled are loops over arrays that are given, called from Python one by one: a compiled
# function that calls others is compiled together with all of them, and takes as much longer. The
# lock of Python is kept meanwhile: they take microseconds, and getting it back can take more.
_compiled = numba.njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})


def _plain(array: Any) -> Any:
    """A copy that can be written to, of one layout: for each other one, code is compiled anew."""
    return np.array(array, np.int64 if array.dtype.kind == "i" else np.float64, order="C")


class Density(NamedTuple):
    """Where the library is: a mixture of Gaussians, one for each family and a wide one.

    Parameters
    ----------
    means : (c, k)
    whiten : (c, k, k), lower factors: whiten[i] @ (z - means[i]) has unit covariance
    logs : (c,) log of weight over volume
    known : (101,) log densities of the library's percentiles 0 to 100
    """

    means: Float64
    whiten: Float64
    logs: Float64
    known: Float64

    @classmethod
    def fit(cls, z: Float64, families: Sequence[str]) -> Density:
        kinds = np.asarray(families)
        k = z.shape[1]
        names = np.unique(kinds)
        within = np.zeros((k, k))
        for kind in names:
            within += np.cov(z[kinds == kind].T, ddof=0) * np.sum(kinds == kind) / len(z)
        groups = [(0.95 / len(names), z[kinds == kind]) for kind in names] + [(0.05, z)]
        means, whiten, logs = [], [], []
        for weight, members in groups:
            # a family's own shape, drawn towards that of all: 60 members say little of 24 axes
            cov = 0.6 * np.cov(members.T, ddof=0) + 0.4 * within + 1e-2 * np.eye(k)
            factor = np.linalg.inv(np.linalg.cholesky(cov))
            means.append(members.mean(axis=0))
            whiten.append(factor)
            logs.append(math.log(weight) + float(np.sum(np.log(np.diag(factor)))))
        found = cls(np.array(means), np.array(whiten), np.array(logs), np.zeros(101))
        own = np.array([found.log(point) for point in z])
        return found._replace(known=np.percentile(own, np.arange(101.0)))

    def log(self, z: Float64) -> float:
        """log density at z (k,), to a constant."""
        return self.slope(z)[0]

    def slope(self, z: Float64) -> tuple[float, Float64]:
        """log density at z (k,) and its gradient (k,)."""
        uphill = np.zeros(len(z))
        pulls, each = np.empty(self.means.shape), np.empty(len(self.means))
        found = _log_density(_plain(z), self.means, self.whiten, self.logs, pulls, each, uphill)
        return float(found), uphill


@_compiled
def _log_density(
    z: Any, means: Any, whiten: Any, logs: Any, pulls: Any, each: Any, uphill: Any
) -> Any:
    """log density at z (k,); its gradient is added to `uphill` (k,). `pulls` (c, k) and `each` (c,)
    are room to reckon in."""
    count, k = means.shape
    top = -math.inf
    for c in range(count):
        square = 0.0
        for i in range(k):
            away = 0.0
            for j in range(i + 1):
                away += whiten[c, i, j] * (z[j] - means[c, j])
            pulls[c, i] = away
            square += away * away
        each[c] = logs[c] - 0.5 * square
        top = max(top, each[c])
    total = 0.0
    for c in range(count):
        each[c] = math.exp(each[c] - top)
        total += each[c]
    for c in range(count):
        share = each[c] / total
        if share > 1e-20:  # less than that is lost in rounding
            for i in range(k):
                for j in range(i + 1):
                    uphill[j] -= share * pulls[c, i] * whiten[c, i, j]
    return top + math.log(total)


class Grades(NamedTuple):
    """How common a descriptor's value is in the library, as a number of standard deviations.

    Parameters
    ----------
    names : descriptors
    at, grade : (d, m) values and their grades, both ascending; straight on beyond the ends
    """

    names: tuple[str, ...]
    at: Float64
    grade: Float64

    @classmethod
    def fit(cls, values: Mapping[str, ArrayLike], knots: int = 129) -> Grades:
        """Normal scores of smoothed distributions (kernel estimates, Silverman 1986, chapter 2).

        Smoothed, since many members share a value (no tint at all): as steep as a step there, a
        trait would leap.
        """
        from scipy.special import ndtr, ndtri

        at, grade = [], []
        for column in values.values():
            x = np.asarray(column, np.float64)
            low, high = np.quantile(x, [0.02, 0.98])
            wide = _SMOOTH * max(float(high - low), 1e-6)
            fine = np.linspace(low - wide, high + wide, knots)
            at.append(fine)
            grade.append(ndtri(np.mean(ndtr((fine[:, None] - x) / wide), axis=1)))
        return cls(tuple(values), np.array(at), np.array(grade))

    def of(self, descriptors: Float64) -> Float64:
        """Grades (..., d) of all of `descriptors.DESCRIPTORS` (..., n), in their order."""
        used = _places(self.names)
        flat = np.ascontiguousarray(descriptors.reshape(-1, descriptors.shape[-1]), np.float64)
        found = np.empty((len(flat), len(used)))
        _interpolate(flat, used, self.at, self.grade, found)
        return found.reshape(*descriptors.shape[:-1], len(used))


_ORDER = {name: i for i, name in enumerate(DESCRIPTORS)}


def _places(names: Sequence[str]) -> NDArray[np.int64]:
    """Where descriptors stand among all."""
    return np.array([_ORDER[name] for name in names], np.int64)


@_compiled
def _interpolate(values: Any, used: Any, at: Any, grade: Any, out: Any) -> Any:
    """Columns `used` of values (m, n), each along its own knots, and straight on beyond them."""
    last = at.shape[1] - 1
    end = max(last // 8, 1)
    for j in range(len(used)):
        below = (grade[j, end] - grade[j, 0]) / (at[j, end] - at[j, 0])
        above = (grade[j, last] - grade[j, last - end]) / (at[j, last] - at[j, last - end])
        for m in range(len(values)):
            v = values[m, used[j]]
            i, steep = 0, below
            if v >= at[j, last]:
                i, steep = last, above
            elif v > at[j, 0]:
                after = last  # the knot at or before v, by halving
                while after - i > 1:
                    middle = (i + after) // 2
                    if v < at[j, middle]:
                        after = middle
                    else:
                        i = middle
                steep = (grade[j, after] - grade[j, i]) / (at[j, after] - at[j, i])
            out[m, j] = grade[j, i] + steep * (v - at[j, i])


class Readings(NamedTuple):
    """What `descriptors.READINGS` need of an embedding: few cells.

    Parameters
    ----------
    rows, mean : (3, cells, k) and (cells,), log(f + FLOOR) of a channel: rows @ z + mean
    weights : (readings, cells)
    columns : (n, c) int64, the cells from the middle to the rim of the highlight, for each theta_d
        that the profile has
    energy : (angles, cells), directional albedos at angles from 0 to 80 degrees
    """

    rows: Float64
    mean: Float64
    weights: Float64
    columns: NDArray[np.int64]
    energy: Float64


class _Cells(NamedTuple):
    """`Readings` without the zeros, and the albedos after them as readings more.

    Parameters
    ----------
    rows, mean, columns : as `Readings`
    turned : (3, k, cells) of `OPPONENT` axes in the place of channels, where most are zeros
    spans : (3, 2), the coordinates that each axis depends on: from and to
    starts : (readings + angles + 1,) where the cells of each begin in the others
    which, weights : (n,) each, cells and what they weigh
    angles : int64
    """

    rows: Float64
    mean: Float64
    columns: NDArray[np.int64]
    turned: Float64
    spans: NDArray[np.int64]
    starts: NDArray[np.int64]
    which: NDArray[np.int64]
    weights: Float64
    angles: int

    @classmethod
    def of(cls, readings: Readings) -> _Cells:
        dense = np.concatenate([readings.weights, readings.energy])
        of, which = np.nonzero(dense)
        starts = np.searchsorted(of, np.arange(len(dense) + 1))
        turned = np.einsum("ac,cnk->akn", OPPONENT, readings.rows)
        some = [np.flatnonzero(np.any(np.abs(axis) > 1e-12, axis=1)) for axis in turned]
        spans = np.array([(found[0], found[-1] + 1) if len(found) else (0, 0) for found in some])
        return cls(
            _plain(readings.rows),
            _plain(readings.mean),
            _plain(readings.columns),
            _plain(turned),
            spans,
            starts, which, dense[of, which],
            len(readings.energy),
        )  # fmt: skip

    def near(self, z: Float64, sloped: bool) -> tuple[Float64, Float64, Float64, Float64]:
        """Readings (readings, 3) at a point (k,) and their slopes (readings, 3, k); what decoding
        mends there (2,) and its slopes (2, k): by how much (log f) the middle of the highlight is
        darker than what is around it, and the log of the greatest albedo. No slopes are zeros."""
        count, k = len(self.starts) - 1, len(z)
        value, slopes = np.zeros((count, 3)), np.zeros((count if sloped else 0, 3, k))
        mended, steep = np.zeros(2), np.zeros((2, k))
        raised = np.empty((3, len(self.mean)))
        source = np.empty(raised.shape, np.int64)
        _near(z, self, raised, source, value, slopes, mended, steep)
        return value[: count - self.angles], slopes[: count - self.angles], mended, steep


@_compiled
def _near(
    z: Any,
    cells: Any,
    raised: Any,
    source: Any,
    value: Any,
    slopes: Any,
    mended: Any,
    steep: Any,
) -> Any:
    """Add up what `_Cells.near` gives, of readings and albedos; slopes if there is room for them.
    `raised` and `source` (3, cells) become f + FLOOR, and the cells of which it is."""
    rows, columns = cells.rows, cells.columns
    k, count, first = len(z), len(value), len(value) - cells.angles
    three = value.shape[1]  # no constant: loops that are unrolled take longer to compile
    for a in range(three):
        for n in range(len(cells.mean)):
            raised[a, n] = 0.0
        for j in range(cells.spans[a, 0], cells.spans[a, 1]):
            for n in range(len(cells.mean)):
                raised[a, n] += z[j] * cells.turned[a, j, n]
    for n in range(len(cells.mean)):
        x, y, w = raised[0, n], raised[1, n], raised[2, n]
        for c in range(three):
            raised[c, n] = (
                cells.mean[n] + OPPONENT[0, c] * x + OPPONENT[1, c] * y + OPPONENT[2, c] * w
            )
    for c in range(three):
        for n in range(len(cells.mean)):
            source[c, n] = n
            # exp as 64th power of its series: a library's is called for each cell alone, which
            # was most of the work
            t = min(raised[c, n], 30.0) * (1 / 64)
            e = 1.0 + t * (1 / 11 + t * (1 / 132 + t * (1 / 1716)))
            e = 1.0 + t * (1 / 8 + t * (1 / 72 + t * (1 / 720) * e))
            e = 1.0 + t * (1 / 5 + t * (1 / 30 + t * (1 / 210) * e))
            e = 1.0 + t * (1.0 + t * (1 / 2 + t * (1 / 6 + t * (1 / 24) * e)))
            e *= e
            e *= e
            e *= e
            e *= e
            e *= e
            raised[c, n] = e * e
    # the middle of the profile is darker than its brightest by
    brightest, most, middle = 0, 0.0, 0.0
    for i in range(len(columns)):
        light = 0.0
        for j in range(columns.shape[1]):
            for c in range(three):
                light += LUMINANCE[c] * raised[c, columns[i, j]]
        if i == 0:
            middle = light
        if light > most:
            brightest, most = i, light
    mended[0] = math.log(most / middle)
    if len(slopes) > 0 and brightest > 0:
        for j in range(columns.shape[1]):
            for c in range(three):
                bright, dark = columns[brightest, j], columns[0, j]
                up = LUMINANCE[c] * raised[c, bright] / most
                down = LUMINANCE[c] * raised[c, dark] / middle
                for m in range(k):
                    steep[0, m] += up * rows[c, bright, m] - down * rows[c, dark, m]
    # no hole in the highlight: as high as what follows, of which it then has the slope too
    for c in range(three):
        for j in range(columns.shape[1]):
            for i in range(len(columns) - 2, -1, -1):
                n, after = columns[i, j], columns[i + 1, j]
                if raised[c, n] < raised[c, after]:
                    raised[c, n], source[c, n] = raised[c, after], source[c, after]
    for i in range(count):
        for p in range(cells.starts[i], cells.starts[i + 1]):
            n, weight = cells.which[p], cells.weights[p]
            for c in range(3):
                value[i, c] += weight * max(raised[c, n] - FLOOR, 0.0)
                if len(slopes) > 0:
                    by, s = weight * raised[c, n], source[c, n]
                    for m in range(k):
                        slopes[i, c, m] += by * rows[c, s, m]
    whole, angle, colour, norm = 1e-9, first, 0, 0.0
    for i in range(first, count):
        for c in range(three):
            if value[i, c] > whole:
                whole, angle, colour = value[i, c], i, c
    for i in range(first, count):
        for c in range(three):
            norm += (value[i, c] / whole) ** _POWER
    mended[1] = math.log(whole) + math.log(max(norm, 1.0)) / _POWER
    if len(slopes) > 0:
        for i in range(first, count):
            for c in range(three):
                part = (value[i, c] / whole) ** _POWER / norm
                if part > 1e-3:
                    for m in range(k):
                        steep[1, m] += part / max(value[i, c], 1e-9) * slopes[i, c, m]
    if whole > 1.0:  # no more light than there was
        for i in range(first):
            for c in range(three):
                value[i, c] /= whole
                if len(slopes) > 0:
                    for m in range(k):
                        top = slopes[angle, colour, m]
                        slopes[i, c, m] = (slopes[i, c, m] - value[i, c] * top) / whole


PALE = 5.0  # C*ab: paler colours have no hue to speak of

SURFACES = ("albedo 10", "albedo", "albedo 60", "body", "side")
"""Readings whose colour a person sees: all reflected light from three angles, the body, and the
body lit from the side."""

_BODY_OF = SURFACES.index("body")
_PEAK_AT = READINGS.index("profile 0")
_SEEN_AT = np.array([READINGS.index(name) for name in SURFACES])
# the body is read as f, not as an albedo
_WHOLE = np.array([[1.0], [1.0], [1.0], [math.pi], [math.pi]])

# rows of what `_colour_rows` gives: slopes of L*, a* and b* of each surface; of each, what changes
# its hue, what gives a hue to what is grey, and what changes its chroma beside lightness; what
# changes the hue of the lobe; what changes L* of the body otherwise than that of all light
_TURN, _HUES, _GREYS, _CHROMAS, _LOBES, _BESIDE, _COLOURS = 0, 15, 20, 30, 40, 43, 44


@_compiled
def _colour_rows(readings: Any, by_z: Any, lab: Any, rows: Any) -> Any:
    """Fill in CIELAB (5, 3) of `SURFACES` and how it changes, functions (_COLOURS, k) of a
    velocity, of readings (readings, 3) and their slopes (readings, 3, k)."""
    k, three = by_z.shape[2], by_z.shape[1]
    f, by = np.empty(lab.shape[1]), np.empty(lab.shape[1])
    for i in range(len(_SEEN_AT)):
        at, whole = _SEEN_AT[i], _WHOLE[i, 0]
        for j in range(three):
            x = 1e-9
            for c in range(three):
                x += WHITE[j, c] * whole * max(readings[at, c], 0.0)
            cube = x > (6 / 29) ** 3
            f[j] = x ** (1 / 3) if cube else x * (29 / 6) ** 2 / 3 + 4 / 29
            by[j] = whole * (f[j] / (3.0 * x) if cube else (29 / 6) ** 2 / 3)
        light, a, b = 116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])
        lab[i, 0], lab[i, 1], lab[i, 2] = light, a, b
        chroma = a * a + b * b + PALE * PALE
        degrees = 180.0 / math.pi / chroma  # fewer where there is hardly a hue
        grey = 180.0 / math.pi * PALE * PALE / (chroma * math.sqrt(chroma))
        for n in range(k):
            red, green, blue = by_z[at, 0, n], by_z[at, 1, n], by_z[at, 2, n]
            x = by[0] * (WHITE[0, 0] * red + WHITE[0, 1] * green + WHITE[0, 2] * blue)
            y = by[1] * (WHITE[1, 0] * red + WHITE[1, 1] * green + WHITE[1, 2] * blue)
            z = by[2] * (WHITE[2, 0] * red + WHITE[2, 1] * green + WHITE[2, 2] * blue)
            by_light, by_a, by_b = 116.0 * y, 500.0 * (x - y), 200.0 * (y - z)
            rows[_TURN + 3 * i, n] = by_light
            rows[_TURN + 3 * i + 1, n] = by_a
            rows[_TURN + 3 * i + 2, n] = by_b
            rows[_HUES + i, n] = degrees * (a * by_b - b * by_a)
            rows[_GREYS + 2 * i, n] = grey * by_a
            rows[_GREYS + 2 * i + 1, n] = grey * by_b
            # a colour that grows lighter keeps its ratio of a* to L* + 16
            rows[_CHROMAS + 2 * i, n] = by_a - a / (light + 16.0) * by_light
            rows[_CHROMAS + 2 * i + 1, n] = by_b - b / (light + 16.0) * by_light
    # a lobe may take on the hue of all light, or lose it, but gets no other. Hues are logarithms
    # of red over blue and of green over both
    x = y = along_x = along_y = 0.0
    for c in range(three):
        log = math.log(max(readings[_SEEN_AT[1], c], 0.0) + 1e-2)
        x += OPPONENT[1, c] * log
        y += OPPONENT[2, c] * log
        by[c] = 1.0 / (max(readings[_PEAK_AT, c], 0.0) + 1e-2)
        along_x -= OPPONENT[1, c] * math.log(by[c])
        along_y -= OPPONENT[2, c] * math.log(by[c])
    size = math.sqrt(x * x + y * y + _TINGED * _TINGED)
    along = (along_x * x + along_y * y) / size
    grey = max(_TINGED / size, 1.0 / (1.0 + math.exp(min(along / 0.02, 50.0))))
    for n in range(k):
        by_x = by_y = 0.0
        for c in range(three):
            by_x += OPPONENT[1, c] * by_z[_PEAK_AT, c, n] * by[c]
            by_y += OPPONENT[2, c] * by_z[_PEAK_AT, c, n] * by[c]
        rows[_LOBES, n] = (x * by_y - y * by_x) / size
        rows[_LOBES + 1, n] = grey * by_x
        rows[_LOBES + 2, n] = grey * by_y
        rows[_BESIDE, n] = rows[3 * _BODY_OF, n] - rows[3, n]


@_compiled
def _around_readings(readings: Any, by_z: Any, steps: Any) -> Any:
    """Fill in readings (k + 1, readings, 3) a small step along each coordinate away, the first of
    none, by their slopes (readings, 3, k)."""
    for i in range(len(readings)):
        for c in range(3):
            steps[0, i, c] = readings[i, c]
            for n in range(by_z.shape[2]):
                steps[n + 1, i, c] = readings[i, c] + _SMALL * by_z[i, c, n]


@_compiled
def _weigh(graded: Any, weights: Any, normals: Any, zero: Any, z: Any, score: Any, by: Any) -> Any:
    """Fill in scores (t,) of graded descriptors (m, d), and if there are those a small step along
    each coordinate away, slopes (t, k)."""
    for t in range(len(score)):
        here = -zero[t]
        for n in range(len(z)):
            here += normals[t, n] * z[n]
        raw = 0.0
        for d in range(weights.shape[1]):
            raw += weights[t, d] * graded[0, d]
        score[t] = here + raw
        for n in range(len(graded) - 1):
            there = 0.0
            for d in range(weights.shape[1]):
                there += weights[t, d] * graded[n + 1, d]
            by[t, n] = normals[t, n] + (there - raw) / _SMALL


class Optics(NamedTuple):
    """What lets scores be read off descriptors: where they are read, and how they are graded."""

    readings: Readings
    grades: Grades


class Around(NamedTuple):
    """What moves need to know of a point.

    Parameters
    ----------
    score, slopes : (t,) and (t, k)
    lab : (5, 3) CIELAB of `SURFACES`
    colours : (_COLOURS, k), how colours change, as `_colour_rows`
    walls, steep : (3,) and (3, k), what may not grow beyond a limit, and its slopes: what decoding
        mends, as `_Cells.near`, and how `unlikely` the point is
    """

    score: Float64
    slopes: Float64
    lab: Float64
    colours: Float64
    walls: Float64
    steep: Float64


def unlikely(log: float) -> float:
    """How unlikely a point is of which the log density is known, on the scale of `Around.walls`."""
    return -_THIN * log


class Ground(NamedTuple):
    """What scores and their slopes are had of.

    Parameters
    ----------
    cells : None if scores are not read off descriptors
    used : (d,) places of the graded descriptors among all
    at, grade : as of `Grades`
    weights, normals, zero : (t, d), (t, k) and (t,), scores: weights @ grades + normals @ z - zero
    stiffness : (k, k) metric of moves
    low, high : (k,)
    density : None if it is not known where the library is
    """

    cells: _Cells | None
    used: NDArray[np.int64]
    at: Float64
    grade: Float64
    weights: Float64
    normals: Float64
    zero: Float64
    stiffness: Float64
    low: Float64
    high: Float64
    density: Density | None

    @classmethod
    def of(
        cls,
        optics: Optics | None,
        weights: Float64,
        normals: Float64,
        zero: Float64,
        span: Float64,
        stiffness: Float64,
        low: Float64,
        high: Float64,
        density: Density | None,
    ) -> Ground:
        """`weights` and `normals` give raw scores, `zero` (t,) is that of score 0, and `span` (t,)
        what lies between scores 0 and 1."""
        none = np.zeros((0, 0))
        names, at, grade = optics.grades if optics else ((), none, none)
        return cls(
            _Cells.of(optics.readings) if optics else None,
            _places(names),
            _plain(at),
            _plain(grade),
            _plain(weights / span[:, None]),
            _plain(normals / span[:, None]),
            zero / span,
            _plain(stiffness),
            low,
            high,
            density and Density(*map(_plain, density)),
        )

    def seen(self, z: Float64) -> Float64:
        """CIELAB (5, 3) of `SURFACES` at z (k,)."""
        return cielab(self.look(z)[1][_SEEN_AT] * _WHOLE)

    def slopes(self, z: Float64) -> Float64:
        """Slopes (t, k) of all scores at z (k,)."""
        return self.around(z).slopes

    def look(self, z: Float64) -> tuple[Float64, Float64, Float64]:
        """Scores (t,) at z (k,), readings (readings, 3) and what decoding mends (2,), as
        `_Cells.near`; zeros where nothing is read."""
        if self.cells is None:
            return self.normals @ z - self.zero, np.zeros((len(READINGS), 3)), np.zeros(2)
        point = _plain(z)
        readings, _, mended, _ = self.cells.near(point, False)
        score = np.empty(len(self.zero))
        graded = self._graded(readings[None])
        _weigh(graded, self.weights, self.normals, self.zero, point, score, self.normals[:0])
        return score, readings, mended

    def around(self, z: Float64) -> Around:
        """What there is to know at z (k,)."""
        k, point = len(z), _plain(z)
        lab, colours = np.zeros((len(_SEEN_AT), 3)), np.zeros((_COLOURS, k))
        walls, steep = np.zeros(3), np.zeros((3, k))
        if self.density is not None:
            likely, uphill = self.density.slope(point)
            walls[2] = unlikely(likely)
            np.multiply(uphill, -_THIN, out=steep[2])
        if self.cells is None:
            score = self.normals @ point - self.zero
            return Around(score, self.normals, lab, colours, walls, steep)
        readings, by_z, walls[:2], steep[:2] = self.cells.near(point, True)
        # formulas of a few numbers: cheaper once more than their slopes
        steps = np.empty((k + 1, len(READINGS), 3))
        _around_readings(readings, by_z, steps)
        score, slopes = np.empty(len(self.zero)), np.empty((len(self.zero), k))
        graded = self._graded(steps)
        _weigh(graded, self.weights, self.normals, self.zero, point, score, slopes)
        _colour_rows(readings, by_z, lab, colours)
        return Around(score, slopes, lab, colours, walls, steep)

    def grades(self, z: Float64) -> Float64:
        """Grades (..., d) of what is read at z (..., k), as decoding mends it."""
        if self.cells is None:
            return np.zeros((*z.shape[:-1], 0))
        points = _plain(z).reshape(-1, z.shape[-1])
        readings = np.zeros((len(points), len(READINGS), 3))
        for i, point in enumerate(points):
            readings[i] = self.cells.near(point, False)[0]
        return self._graded(readings).reshape(*z.shape[:-1], len(self.used))

    def _graded(self, readings: Float64) -> Float64:
        """Grades (m, d) of readings (m, readings, 3)."""
        described = np.empty((len(readings), len(DESCRIPTORS)))
        formulas(readings, described)
        found = np.empty((len(readings), len(self.used)))
        _interpolate(described, self.used, self.at, self.grade, found)
        return found


class Task(NamedTuple):
    """One move: what changes, what stays, and what had better stay.

    Parameters
    ----------
    moved : (n,) scores that change
    rates : (n,) how fast, for each unit of the way
    held : scores that stay
    apart : scores that had better stay
    hue, chroma, light : (5,) each
        What it costs that the colours of `SURFACES` change: a degree of hue, a unit of a* or b*
        beside what lightness brings with it, a unit of L*.
    steered : whether the move leads towards a colour, and `steer` (3,), its L*, and its a* and b*
        for an L* + 16 of one
    lobe : what it costs that the lobe gets a hue that all light has not, for log RGB
    together : what it costs that L* of the body changes otherwise than that of all light
    body : linear functions of the coordinates that say how the body looks, which stay
    limits : (3,) the most that may be mended, and how unlikely a point may be, as
        `Around.walls`; `inf` if it does not matter
    """

    moved: NDArray[np.int64]
    rates: Float64
    held: NDArray[np.int64]
    apart: NDArray[np.int64]
    hue: Float64
    chroma: Float64
    light: Float64
    steered: bool
    steer: Float64
    lobe: float
    together: float
    body: Float64
    limits: Float64

    def colour_costs(self, coloured: bool) -> Float64:
        """What changes (_COLOURS,) of `_colour_rows` cost; if not `coloured`, hues may change."""
        costs = np.zeros(_COLOURS)
        turn = costs[_TURN:_HUES].reshape(-1, 3)
        turn[:, 0] = self.light
        if self.steered:
            turn[:, 1:] = _STEER
            turn[:_BODY_OF, 0] += _STEER
        if coloured:
            costs[_HUES:_GREYS] = self.hue
            costs[_GREYS:_CHROMAS] = self.hue.repeat(2)
            costs[_CHROMAS:_LOBES] = self.chroma.repeat(2)
            costs[_LOBES:_BESIDE] = self.lobe
        costs[_BESIDE] = self.together
        return costs

    def score_costs(self, count: int) -> Float64:
        """What it costs that scores (count,) change, or that moved ones change otherwise."""
        costs = np.zeros(count)
        costs[self.apart] = _APART
        costs[self.held] = _HELD
        costs[self.moved] = _WANTED
        return costs

    def drawn(self, lab: Float64, turn: Float64) -> Float64:
        """What draws (k,) colours (5, 3), of which slopes (15, k) are known, to the one that a
        steered move leads to: by a share of what is missing, and no faster than can be followed."""
        missing = self.steer * (lab[:, :1] + 16.0) - lab
        missing[:, 0] = np.where(np.arange(len(lab)) < _BODY_OF, self.steer[0] - lab[:, 0], 0.0)
        far = np.sqrt(np.sum(missing * missing, axis=1, keepdims=True))
        fast = _STEER * _KEEN / (1.0 + _KEEN * far / _TURNING)
        return np.asarray(self.rates[0] * ((fast * missing).ravel() @ turn))


@_compiled
def _stiffen(form: Any, scores: Any, by_score: Any, colours: Any, by_colour: Any) -> Any:
    """Add squares of functions (n, k), each by what it costs (n,), to a quadratic form (k, k)."""
    k = len(form)
    for which in range(2):
        rows, by = (scores, by_score) if which == 0 else (colours, by_colour)
        for r in range(len(rows)):
            if by[r] != 0.0:
                for i in range(k):
                    some = by[r] * rows[r, i]
                    for j in range(k):
                        form[i, j] += some * rows[r, j]


@_compiled
def _least(stiff: Any, pull: Any, low: Any, high: Any, x: Any) -> Any:
    """x (k,) within low and high becomes what makes x @ stiff @ x / 2 - pull @ x least.

    Coordinates that would leave the box stay at its wall, and are not freed again.
    """
    n = k = len(pull)
    a, b, at = np.empty((k, k)), np.empty(k), np.empty(k, np.int64)
    for i in range(k):
        at[i], x[i] = i, 0.0
    while n > 0:
        for i in range(n):
            b[i] = pull[at[i]]
            if n < k:
                for j in range(k):
                    b[i] -= stiff[at[i], j] * x[j]
        # Cholesky, with the diagonal of the factor inverted
        for i in range(n):
            for j in range(i + 1):
                part = stiff[at[i], at[j]]
                for m in range(j):
                    part -= a[i, m] * a[j, m]
                if i == j:
                    a[i, i] = 1.0 / math.sqrt(max(part, 1e-30))
                else:
                    a[i, j] = part * a[j, j]
            for j in range(i):
                b[i] -= a[i, j] * b[j]
            b[i] *= a[i, i]
        for i in range(n - 1, -1, -1):
            b[i] *= a[i, i]
            for j in range(i):
                b[j] -= a[i, j] * b[i]
        free = 0
        for i in range(n):
            j = at[i]
            x[j] = min(max(b[i], low[j]), high[j])
            if x[j] == b[i]:
                at[free] = j
                free += 1
        if free == n:
            break
        n = free
        for i in range(n):
            x[at[i]] = 0.0


class _Aim(NamedTuple):
    """What a velocity is to do: slopes (n, k) of moved scores, and how fast (n,) they shall
    change."""

    slopes: Float64
    rates: Float64


class _Walls(NamedTuple):
    """What a velocity must not pass: the box low, high (k,), and slopes (3, k) of what may not grow
    by more than gaps (3,)."""

    low: Float64
    high: Float64
    slopes: Float64
    gaps: Float64


@_compiled
def _speed(form: Any, pull: Any, aim: Any, walls: Any, z: Any, h: Any, turn: Any, out: Any) -> Any:
    """Fill in the velocity (k,) at z (k,) that costs least by a form (k, k), of which a step of h
    stays within the walls.

    A moved score that does not change as fast as asked for costs `_WANTED`: so it has a greatest
    speed, and fades where nothing leads on. If there are slopes `turn` (15, k) of colours, it is
    made as fast as asked for where that is near, and no faster than can be followed.
    """
    k, count, three = len(z), len(aim.rates), len(walls.gaps)
    low, high, drawn, rates = np.empty(k), np.empty(k), np.empty(k), np.empty(count)
    stiff, at_wall = np.empty((k, k)), np.empty(len(walls.gaps))
    for i in range(three):
        at_wall[i] = 0.0
    for n in range(k):
        low[n] = min((walls.low[n] - z[n]) / h, 0.0)
        high[n] = max((walls.high[n] - z[n]) / h, 0.0)
    for i in range(count):
        rates[i] = aim.rates[i]
    turns = 6 if len(turn) > 0 else 3
    again = 0
    while again < turns:
        for n in range(k):
            drawn[n] = pull[n]
            for i in range(count):
                drawn[n] += _WANTED * rates[i] * aim.slopes[i, n]
            for m in range(k):
                stiff[n, m] = form[n, m]
        for i in range(three):
            if at_wall[i] > 0.0:
                back = _WALL * max(walls.gaps[i], -_BACK) / h
                for n in range(k):
                    drawn[n] += back * walls.slopes[i, n]
                    some = _WALL * walls.slopes[i, n]
                    for m in range(k):
                        stiff[n, m] += some * walls.slopes[i, m]
        _least(stiff, drawn, low, high, out)
        more = False
        for i in range(three):
            if at_wall[i] == 0.0 and walls.gaps[i] < math.inf:
                ahead = 0.0
                for n in range(k):
                    ahead += walls.slopes[i, n] * out[n]
                if ahead * h > max(walls.gaps[i], 0.0) + 1e-12:
                    at_wall[i], more = 1.0, True
        again += 1
        if more and again % 3 != 0:
            continue
        if again > 3:
            break
        again = 3
        for i in range(count):
            if aim.rates[i] != 0.0:
                made = 0.0
                for n in range(k):
                    made += aim.slopes[i, n] * out[n]
                rates[i] = aim.rates[i] / min(max(made / aim.rates[i], _FULL), 1.0)
    shown = length = 0.0
    for i in range(len(turn) // 3):
        square = 0.0
        for j in range(three):
            change = 0.0
            for n in range(k):
                change += turn[3 * i + j, n] * out[n]
            square += change * change
        shown = max(shown, square)
    if len(turn) > 0:
        for n in range(k):
            length += out[n] * out[n]
        over = max(shown / (_SHOWN * _SHOWN), length / (_FASTEST * _FASTEST))
        slow = (1.0 + over**12) ** (-1.0 / 24.0)  # hardly any below the greatest speed
        for n in range(k):
            out[n] *= slow


STEEP, WALLED, COLOURED = 1, 2, 4
"""Why a move makes less way than asked for: flags of `Flow.why`."""


class Part(NamedTuple):
    """A part of a step: how much of the step is done at its end, the point (k,) and where moved
    scores (n,) should be there; the form (k, k) and slopes (t, k) of scores at its middle."""

    done: float
    z: Float64
    planned: Float64
    form: Float64
    slopes: Float64


class Knot(NamedTuple):
    """Where a move is: the point (k,), where moved scores (n,) should be, all scores (t,),
    whether it has met a wall, how fast (k,) it went last, and in what parts it came there."""

    z: Float64
    planned: Float64
    score: Float64
    walled: bool
    speed: Float64 | None = None
    parts: tuple[Part, ...] = ()


class Flow:
    """A move from one point, found as far as it was asked for and kept: going on costs what is
    new.

    Every way is gone in the same steps from the same point, so that what lies at 0.5 does not
    depend on whether 0.48 was looked at before.

    Parameters
    ----------
    ground, task : as everywhere here
    z : (k,) the start, within the box
    end : how far the move may go
    around : what there is to know at the start, or None
    """

    def __init__(
        self, ground: Ground, task: Task, z: Float64, end: float, around: Around | None = None
    ) -> None:
        self.ground, self.task, self.end = ground, task, end
        around = around or ground.around(z)
        self._kept = around.score[task.held]
        self._knots = [Knot(z, around.score[task.moved], around.score, False)]
        self._base = ground.stiffness + _BODY * task.body.T @ task.body
        self._by_score = task.score_costs(len(around.score))
        self._by_colour = task.colour_costs(True)
        self._nowhere = np.zeros(len(z))
        self._idle = 0
        self._start = around

    @property
    def score(self) -> Float64:
        """All scores (t,) at the start."""
        return self._knots[0].score

    def to(self, way: float) -> Knot:
        """Where the move is after some way, or where it ends before."""
        while len(self._knots) * STEP <= min(way, self.end) + _HARDLY:
            self._go_on()
        way = min(way, self.end)
        last = len(self._knots) - 1
        done = last if way > last * STEP else int(way / STEP + _HARDLY)
        rest = way - done * STEP
        if rest <= _HARDLY:
            return self._knots[done]
        if (done + 1) * STEP > self.end + _HARDLY:
            return self._advance(done, rest)
        if done == last:
            self._go_on()
        return self._between(done, rest)

    def _go_on(self) -> None:
        """Go a step further."""
        knot, rates = self._knots[-1], self.task.rates
        found = self._advance(len(self._knots) - 1, STEP)
        made = float((found.planned - knot.planned) @ rates / (rates @ rates))
        # at a kink a step may come to nothing, and the next one lead on
        self._idle = self._idle + 1 if made < _STUCK * STEP else 0
        if self._idle == _PATIENCE:
            self.end = min(self.end, len(self._knots) * STEP)
        self._knots.append(found)

    def _between(self, place: int, h: float) -> Knot:
        """Where the move is between a knot and the next: straight between ends of the parts of that
        step, and scores are put right."""
        knot, after = self._knots[place], self._knots[place + 1]
        walled = knot.walled or after.walled
        before, z, planned = 0.0, knot.z, knot.planned
        for part in after.parts:
            if h < part.done:
                share = (h - before) / (part.done - before)
                aim = planned + share * (part.planned - planned)
                point = z + share * (part.z - z)
                far = share * _most(part.z - z)
                score = self.ground.look(point)[0]
                point, score = self._put_right(point, score, aim, part.form, part.slopes, far)
                return Knot(point, aim, score, walled)
            before, z, planned = part.done, part.z, part.planned
        return after  # no further

    def why(self, way: float) -> int:
        """Why it makes less than all of its way there: `STEEP`, `WALLED` and `COLOURED`, added."""
        z = self.to(way).z
        around, task, shares = self.ground.around(z), self.task, []
        for coloured, walled in ((False, False), (True, False), (True, True)):
            by = task.colour_costs(coloured)
            speed = self._velocity(around, z, STEP, self._cost(around, by), walled, False)
            made = around.slopes[task.moved] @ speed
            shares.append(float(made @ task.rates / (task.rates @ task.rates)))
        free, coloured_share, share = shares
        why = STEEP if free < _FULL else 0
        if coloured_share < min(_FULL, free - 0.9 * _FULL):
            why |= COLOURED
        if share < min(_FULL, 0.9 * coloured_share):
            why |= WALLED
        return why

    def _cost(self, around: Around, by_colour: Float64) -> Float64:
        """The quadratic form (k, k) of what a velocity costs: how unlike the library's own
        differences it is, and how fast it changes what had better stay."""
        form = self._base.copy()
        _stiffen(form, around.slopes, self._by_score, around.colours, by_colour)
        return form

    def _velocity(
        self,
        around: Around,
        z: Float64,
        h: float,
        form: Float64,
        walled: bool = True,
        shown: bool = True,
    ) -> Float64:
        """The field (k,) of the move at z (k,), of which a step of h shall stay within the walls;
        what it is `shown` as, or what makes it fall short."""
        task, ground = self.task, self.ground
        low, high, gaps = ground.low, ground.high, task.limits - around.walls
        if not walled:
            low, high, gaps = low - math.inf, high + math.inf, gaps + math.inf
        turn = around.colours[_TURN:_HUES]
        aim = _Aim(around.slopes[task.moved], task.rates)
        drawn = task.drawn(around.lab, turn) if task.steered else self._nowhere
        speed = np.empty(len(z))
        _speed(
            form, drawn, aim, _Walls(low, high, around.steep, gaps), z, h,
            turn if shown else turn[:0], speed,
        )  # fmt: skip
        return speed

    def _advance(self, place: int, h: float) -> Knot:
        """A step of h from a knot.

        The midpoint rule (Hairer, Norsett & Wanner 1993, II.1), in parts where it is fast, or where
        scores come out other than the field says; then what is off in them is put right along the
        field's own directions. The middle is guessed by the velocity of the part before, which
        saves half of the looks at the field; where that misleads, by the velocity here.
        """
        ground, task, some_held = self.ground, self.task, len(self.task.held) > 0
        z, planned, have, walled, first, _ = self._knots[place]
        done, step, wary, guessed, at = 0.0, h, h, first is not None, z
        parts: list[Part] = []
        if first is not None:
            step = min(h, _LONG / max(math.sqrt(first @ first), 1e-30))
            at = self._inside(z, first, 0.5 * step)
        for _ in range(_LOOKS):
            around = self._start if at is self._knots[0].z else ground.around(at)
            form = self._cost(around, self._by_colour)
            speed = self._velocity(around, at, step, form)
            if first is None:
                length = math.sqrt(speed @ speed)
                first, step = speed, min(h - done, wary, _LONG / max(length, 1e-30))
                at = self._inside(z, first, 0.5 * step)
                continue
            slopes = around.slopes[task.moved]
            made = step * (slopes @ speed)
            aim, after = planned + made, self._inside(z, speed, step)
            if task.steered:  # the colour may draw it on faster than asked for
                whole = planned + step * task.rates
                aim = np.where(task.rates > 0.0, np.minimum(aim, whole), np.maximum(aim, whole))
            score, _, mended = ground.look(after)
            change = score - have
            wrong = _most(change[task.moved] - made)
            if some_held:
                wrong = max(wrong, _most(change[task.held]))
            over = max((mended - task.limits[:2]).tolist())
            if (wrong > _TRUST or over > _OVER) and (guessed or step > h / _PARTS):
                if guessed:
                    first, at, guessed = None, z, False
                else:
                    step *= 0.5
                    at = self._inside(z, first, 0.5 * step)
                continue
            # what is too far off to be put right: it goes on from there
            lost = np.abs(aim - score[task.moved]) > _LOST
            aim = np.where(lost, score[task.moved], aim)
            far = step * _most(speed)
            after, score = self._put_right(after, score, aim, form, around.slopes, far)
            ahead = (score - have)[task.moved] @ task.rates
            astray = some_held and _most(self._kept - score[task.held]) > _ASTRAY
            if astray or ahead < -_FALLS:
                if guessed:
                    first, at, guessed = None, z, False
                    continue
                if step <= h / _PARTS:
                    break  # no further: what is held would not stay, or scores would fall
                step *= 0.5
                at = self._inside(z, first, 0.5 * step)
                continue
            walled = walled or bool(
                over > -_OVER
                or around.walls[2] > task.limits[2] - _THIN
                or ((after <= ground.low) | (after >= ground.high)).any()
            )
            z, planned, have, first, guessed = after, aim, score, speed, True
            done += step
            parts.append(Part(done, z, planned, form, around.slopes))
            if h - done <= _HARDLY:
                break
            # where a part had to be short the next one will be, too
            wary = 2.0 * step
            length = math.sqrt(first @ first)
            step = min(h - done, wary, _LONG / max(length, 1e-30))
            at = self._inside(z, first, 0.5 * step)
        return Knot(z, planned, have, walled, first if guessed else None, tuple(parts))

    def _put_right(
        self,
        z: Float64,
        score: Float64,
        aim: Float64,
        form: Float64,
        slopes: Float64,
        far: float,
    ) -> tuple[Float64, Float64]:
        """A point near z (k,) of scores (t,) where moved scores are at their aim (n,) and held
        ones where they were, and its scores.

        Along the cheapest way by a form (k, k), with slopes (t, k) of scores, and in no coordinate
        by more than half as far as the part of a step goes: where slopes are faint it would leap.
        """
        ground, task = self.ground, self.task
        off = self._off(aim, score)
        for _ in range(_MENDS):
            if off < _EXACT:
                break
            pull = _WANTED * (aim - score[task.moved]) @ slopes[task.moved]
            if len(task.held):
                pull += _HELD * (self._kept - score[task.held]) @ slopes[task.held]
            put = np.empty(len(z))
            _least(form, pull, ground.low - z, ground.high - z, put)
            put *= min(1.0, 0.5 * far / max(_most(put), 1e-30))
            nearer = self._inside(z, put, 1.0)
            found = ground.look(nearer)[0]
            left = self._off(aim, found)
            if left > off:
                break
            z, score, off = nearer, found, left
        return z, score

    def _off(self, aim: Float64, score: Float64) -> float:
        """How far moved scores (t,) are off their aim (n,), or held ones off where they were."""
        task = self.task
        off = _most(aim - score[task.moved])
        return max(off, _most(self._kept - score[task.held])) if len(task.held) else off

    def _inside(self, z: Float64, speed: Float64, h: float) -> Float64:
        """z + h * speed, no further than the box."""
        out = h * speed
        out += z
        np.maximum(out, self.ground.low, out=out)
        return np.minimum(out, self.ground.high, out=out)


def _most(values: Float64) -> float:
    """The greatest amount of a few numbers, 0 of none."""
    return max(map(abs, values.tolist()), default=0.0)
