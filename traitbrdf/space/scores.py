"""What scores are read off, and how they change from place to place."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.reflectance.descriptors import (
    DESCRIPTORS,
    LUMINANCE,
    READINGS,
    WHITE,
    cielab,
    formulas,
)
from traitbrdf.space.logmap import FLOOR, OPPONENT

Float64 = NDArray[np.float64]
_TINGED = 0.15  # log RGB: less is grey
THIN = 0.1  # of log density, beside what decoding mends
_SMOOTH = 0.12  # of a descriptor's range: over which its distribution is smoothed
_POWER = 48  # of the norm that stands for the greatest albedo: smooth, and 5 % above at most
_SMALL = 1e-5  # a step along a coordinate that shows slopes

# What is compiled are loops over arrays that are given, called from Python one by one: a compiled
# function that calls others is compiled together with all of them, and takes as much longer. The
# lock of Python is kept meanwhile: they take microseconds, and getting it back can take more.
compiled = numba.njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})


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


@compiled
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


@compiled
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


@compiled
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

BODY_OF = SURFACES.index("body")
_PEAK_AT = READINGS.index("profile 0")
_SEEN_AT = np.array([READINGS.index(name) for name in SURFACES])

# the body is read as f, not as an albedo
_WHOLE = np.array([[1.0], [1.0], [1.0], [math.pi], [math.pi]])

# rows of what `_colour_rows` gives: slopes of L*, a* and b* of each surface; of each, what changes
# its hue, what gives a hue to what is grey, and what changes its chroma beside lightness; what
# changes the hue of the lobe; what changes L* of the body otherwise than that of all light
TURN, HUES, GREYS, CHROMAS, LOBES, BESIDE, COLOURS = 0, 15, 20, 30, 40, 43, 44


@compiled
def _colour_rows(readings: Any, by_z: Any, lab: Any, rows: Any) -> Any:
    """Fill in CIELAB (5, 3) of `SURFACES` and how it changes, functions (COLOURS, k) of a
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
            rows[TURN + 3 * i, n] = by_light
            rows[TURN + 3 * i + 1, n] = by_a
            rows[TURN + 3 * i + 2, n] = by_b
            rows[HUES + i, n] = degrees * (a * by_b - b * by_a)
            rows[GREYS + 2 * i, n] = grey * by_a
            rows[GREYS + 2 * i + 1, n] = grey * by_b
            # a colour that grows lighter keeps its ratio of a* to L* + 16
            rows[CHROMAS + 2 * i, n] = by_a - a / (light + 16.0) * by_light
            rows[CHROMAS + 2 * i + 1, n] = by_b - b / (light + 16.0) * by_light
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
        rows[LOBES, n] = (x * by_y - y * by_x) / size
        rows[LOBES + 1, n] = grey * by_x
        rows[LOBES + 2, n] = grey * by_y
        rows[BESIDE, n] = rows[3 * BODY_OF, n] - rows[3, n]


@compiled
def _around_readings(readings: Any, by_z: Any, steps: Any) -> Any:
    """Fill in readings (k + 1, readings, 3) a small step along each coordinate away, the first of
    none, by their slopes (readings, 3, k)."""
    for i in range(len(readings)):
        for c in range(3):
            steps[0, i, c] = readings[i, c]
            for n in range(by_z.shape[2]):
                steps[n + 1, i, c] = readings[i, c] + _SMALL * by_z[i, c, n]


@compiled
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
    colours : (COLOURS, k), how colours change, as `_colour_rows`
    walls, steep : (3,) and (3, k), what may not grow beyond a limit, and its slopes: what decoding
        mends, as `_Cells.near`, and how `unlikely` the point is
    """

    score: Float64
    slopes: Float64
    lab: Float64
    colours: Float64
    walls: Float64
    steep: Float64


def unlikely(log: Any) -> Any:
    """How unlikely a point is of which the log density, or its slope, is known, on the scale of
    `Around.walls`."""
    return -THIN * log


class Box(NamedTuple):
    """The gamut box: the range of the library's coordinates.

    Parameters
    ----------
    low, high : (k,)
    """

    low: Float64
    high: Float64


class Scoring(NamedTuple):
    """How scores add up: weights @ grades + normals @ z - zero.

    Parameters
    ----------
    weights : (t, d)
    normals : (t, k)
    zero : (t,)
    """

    weights: Float64
    normals: Float64
    zero: Float64


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
        scoring: Scoring,
        stiffness: Float64,
        box: Box,
        optics: Optics | None = None,
        density: Density | None = None,
    ) -> Ground:
        """Gather, as arrays of one layout, what scores are computed from."""
        none = np.zeros((0, 0))
        names, at, grade = optics.grades if optics else ((), none, none)
        return cls(
            _Cells.of(optics.readings) if optics else None,
            _places(names),
            _plain(at),
            _plain(grade),
            _plain(scoring.weights),
            _plain(scoring.normals),
            scoring.zero,
            _plain(stiffness),
            box.low,
            box.high,
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
        lab, colours = np.zeros((len(_SEEN_AT), 3)), np.zeros((COLOURS, k))
        walls, steep = np.zeros(3), np.zeros((3, k))
        if self.density is not None:
            likely, uphill = self.density.slope(point)
            walls[2] = unlikely(likely)
            steep[2] = unlikely(uphill)
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
