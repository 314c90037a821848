"""Scores of traits and their slopes, computed from coordinates.

A few cells of a table are decoded to readings: RGB values of f or of albedos. Formulas turn
readings into physical descriptors (`traitbrdf.reflectance.descriptors`), grades say how common a
descriptor's value is in the library, and a score is a weighted sum of grades.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.compiled import CACHED
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
_TINGED = 0.15  # distance of log RGB from grey below which a colour counts as grey
THIN = 0.1  # scales log density so that it is comparable with log f in `Around.walls`
_SMOOTH = 0.12  # kernel width of smoothed distributions, in shares of a descriptor's range
_POWER = 48  # p-norm that stands for the greatest albedo: smooth, and at most 5 % above it
_SMALL = 1e-5  # step of forward differences along a coordinate, in standard deviations

# Compiled functions are loops over given arrays that Python calls one by one: one that calls others
# would be compiled together with all of them, which takes longer. They keep Python's lock, since
# they run for microseconds, and getting the lock back can take longer than that.
compiled = numba.njit(cache=CACHED, error_model="numpy", fastmath={"contract", "reassoc"})


def _plain(array: Any) -> Any:
    """Copy to a writable array in C order: numba compiles code anew for each other layout."""
    return np.array(array, np.int64 if array.dtype.kind == "i" else np.float64, order="C")


class Density(NamedTuple):
    """Density of the library's members: a mixture of Gaussians, one for each family and one of all.

    Parameters
    ----------
    means : (c, k) float64
    whiten : (c, k, k) float64
        Lower triangular factors: ``whiten[i] @ (z - means[i])`` has unit covariance.
    logs : (c,) float64
        Log of a component's weight over its volume.
    known : (101,) float64
        Log densities of the library's percentiles 0 to 100.
    """

    means: Float64
    whiten: Float64
    logs: Float64
    known: Float64

    @classmethod
    def fit(cls, z: Float64, families: Sequence[str]) -> Density:
        """Fit a Gaussian to each family, and one to all members.

        Parameters
        ----------
        z : (n, k) float64
            Coordinates of the members.
        families : n str
        """
        kinds = np.asarray(families)
        k = z.shape[1]
        names = np.unique(kinds)
        within = np.zeros((k, k))
        for kind in names:
            within += np.cov(z[kinds == kind].T, ddof=0) * np.sum(kinds == kind) / len(z)
        groups = [(0.95 / len(names), z[kinds == kind]) for kind in names] + [(0.05, z)]
        means, whiten, logs = [], [], []
        for weight, members in groups:
            # a family's covariance is shrunk towards the mean one: 60 members do not determine 24
            # axes
            cov = 0.6 * np.cov(members.T, ddof=0) + 0.4 * within + 1e-2 * np.eye(k)
            factor = np.linalg.inv(np.linalg.cholesky(cov))
            means.append(members.mean(axis=0))
            whiten.append(factor)
            logs.append(math.log(weight) + float(np.sum(np.log(np.diag(factor)))))
        found = cls(np.array(means), np.array(whiten), np.array(logs), np.zeros(101))
        own = np.array([found.log(point) for point in z])
        return found._replace(known=np.percentile(own, np.arange(101.0)))

    def log(self, z: Float64) -> float:
        """Return the log density at a point, up to a constant.

        Parameters
        ----------
        z : (k,) float64
        """
        return self.slope(z)[0]

    def slope(self, z: Float64) -> tuple[float, Float64]:
        """Return the log density at a point and its gradient.

        Parameters
        ----------
        z : (k,) float64

        Returns
        -------
        float
            Up to a constant.
        (k,) float64
        """
        uphill = np.zeros(len(z))
        pulls, each = np.empty(self.means.shape), np.empty(len(self.means))
        found = _log_density(_plain(z), self.means, self.whiten, self.logs, pulls, each, uphill)
        return float(found), uphill


@compiled
def _log_density(
    z: Any, means: Any, whiten: Any, logs: Any, pulls: Any, each: Any, uphill: Any
) -> Any:
    """Return the log density at z (k,), and add its gradient to `uphill` (k,).

    `pulls` (c, k) and `each` (c,) are work arrays.
    """
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
        if share > 1e-20:  # smaller shares are lost in rounding
            for i in range(k):
                for j in range(i + 1):
                    uphill[j] -= share * pulls[c, i] * whiten[c, i, j]
    return top + math.log(total)


class Grades(NamedTuple):
    """Grades of descriptors: how common a value is in the library, in standard deviations.

    Parameters
    ----------
    names : d str
        Descriptors.
    at, grade : (d, m) float64
        Values and their grades, both ascending along each row. Grades are linear between them, and
        extrapolated linearly beyond the ends.
    """

    names: tuple[str, ...]
    at: Float64
    grade: Float64

    @classmethod
    def fit(cls, values: Mapping[str, ArrayLike], knots: int = 129) -> Grades:
        """Compute normal scores of smoothed distributions.

        The distributions are kernel estimates (Silverman 1986, chapter 2). Many members share a
        value (no tint at all, for example): without smoothing the grade would have a step there,
        and moves of a trait would jump.

        Parameters
        ----------
        values : mapping of (n,) array_like
            By descriptor, its value for each member of the library.
        knots : int
            Number of values at which grades are kept.
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
        """Grade descriptors.

        Parameters
        ----------
        descriptors : (..., n) float64
            Values of all of `traitbrdf.reflectance.descriptors.DESCRIPTORS`, in their order.

        Returns
        -------
        (..., d) float64
        """
        used = _places(self.names)
        flat = np.ascontiguousarray(descriptors.reshape(-1, descriptors.shape[-1]), np.float64)
        found = np.empty((len(flat), len(used)))
        _interpolate(flat, used, self.at, self.grade, found)
        return found.reshape(*descriptors.shape[:-1], len(used))


_ORDER = {name: i for i, name in enumerate(DESCRIPTORS)}


def _places(names: Sequence[str]) -> NDArray[np.int64]:
    """Return the index of each descriptor among `DESCRIPTORS`."""
    return np.array([_ORDER[name] for name in names], np.int64)


@compiled
def _interpolate(values: Any, used: Any, at: Any, grade: Any, out: Any) -> Any:
    """Interpolate columns `used` of values (m, n), each along its own knots, into `out` (m, d)."""
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
    """How readings (`traitbrdf.reflectance.descriptors.READINGS`) are computed from few cells.

    Parameters
    ----------
    rows : (3, cells, k) float64
    mean : (cells,) float64
        log(f + FLOOR) of a channel is ``rows[channel] @ z + mean``.
    weights : (readings, cells) float64
        Each reading is a weighted sum of f.
    columns : (n, c) int64
        Cells from the middle to the rim of the highlight, for each of c values of theta_d.
    energy : (angles, cells) float64
        Weights of directional albedos at angles from 0 to 80 degrees.
    """

    rows: Float64
    mean: Float64
    weights: Float64
    columns: NDArray[np.int64]
    energy: Float64


class _Cells(NamedTuple):
    """`Readings` in sparse form, with the albedos as further readings.

    Parameters
    ----------
    rows, mean, columns : as for `Readings`
    turned : (3, k, cells) float64
        `rows` on `OPPONENT` axes instead of channels, where most entries are zero.
    spans : (3, 2) int64
        The first coordinate that each axis depends on, and the one after the last.
    starts : (readings + angles + 1,) int64
        Where the cells of each reading begin in `which` and `weights`.
    which, weights : (n,) int64 and float64
        Cells and their weights.
    angles : int
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
        """Compute readings and constraints at a point z (k,).

        Returns
        -------
        readings : (readings, 3)
        slopes : (readings, 3, k); no rows if not `sloped`
        mended : (2,)
            What decoding will correct: by how much the middle of the highlight is darker than its
            brightest ring (log f), and the log of the greatest albedo.
        steep : (2, k)
            Slopes of `mended`; zeros if not `sloped`.
        """
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
    """Compute what `_Cells.near` returns, and slopes if `slopes` has rows.

    `raised` (3, cells) becomes f + FLOOR, and `source` (3, cells) the cell whose slope it has.
    """
    rows, columns = cells.rows, cells.columns
    k, count, first = len(z), len(value), len(value) - cells.angles
    three = value.shape[1]  # not a constant: unrolled loops take longer to compile
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
            # exp as the 64th power of its series: one call of the library's exp for each cell
            # took most of the time
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
    # by how much the middle of the highlight is darker than its brightest ring
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
    # fill holes in the highlight: a cell takes the value, and the slope, of a brighter later one
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
    if whole > 1.0:  # decoding divides f by an albedo above 1
        for i in range(first):
            for c in range(three):
                value[i, c] /= whole
                if len(slopes) > 0:
                    for m in range(k):
                        top = slopes[angle, colour, m]
                        slopes[i, c, m] = (slopes[i, c, m] - value[i, c] * top) / whole


PALE = 5.0  # CIELAB chroma below which a hue is hardly visible

SURFACES = ("albedo 10", "albedo", "albedo 60", "body", "side")
"""Readings whose colour a person sees: all light reflected at 10, 30 and 60 degrees, the body (what
lies below the highlight), and the body lit from the side.
"""

BODY_OF = SURFACES.index("body")
_PEAK_AT = READINGS.index("profile 0")
_SEEN_AT = np.array([READINGS.index(name) for name in SURFACES])

# factors that turn readings into albedos: the body is read as f
_WHOLE = np.array([[1.0], [1.0], [1.0], [math.pi], [math.pi]])

# where rows of `_colour_rows` begin: gradients of L*, a* and b* of each surface; of its hue in
# degrees, of the hue that a grey surface gains, and of its chroma apart from lightness; of the hue
# of the lobe; of L* of the body minus that of all light. COLOURS is their number.
TURN, HUES, GREYS, CHROMAS, LOBES, BESIDE, COLOURS = 0, 15, 20, 30, 40, 43, 44


@compiled
def _colour_rows(readings: Any, by_z: Any, lab: Any, rows: Any) -> Any:
    """Fill in how colours change with the coordinates.

    `lab` (5, 3) becomes CIELAB of `SURFACES`, and `rows` (COLOURS, k) gradients of the quantities
    that `TURN` to `BESIDE` index. Inputs are readings (readings, 3) and their slopes `by_z`
    (readings, 3, k).
    """
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
        degrees = 180.0 / math.pi / chroma  # fades where chroma is low
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
            # a colour that only grows lighter keeps the ratio of a* to L* + 16
            rows[CHROMAS + 2 * i, n] = by_a - a / (light + 16.0) * by_light
            rows[CHROMAS + 2 * i + 1, n] = by_b - b / (light + 16.0) * by_light
    # a lobe may take on the hue of all light, or lose it, but no other hue. Hues here are the
    # logarithms of red over blue and of green over both
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
    """Fill in readings (k + 1, readings, 3) here and at a small step along each coordinate.

    They are extrapolated with slopes (readings, 3, k).
    """
    for i in range(len(readings)):
        for c in range(3):
            steps[0, i, c] = readings[i, c]
            for n in range(by_z.shape[2]):
                steps[n + 1, i, c] = readings[i, c] + _SMALL * by_z[i, c, n]


@compiled
def _weigh(graded: Any, weights: Any, normals: Any, zero: Any, z: Any, score: Any, by: Any) -> Any:
    """Fill in scores (t,) and their slopes (t, k).

    `graded` (m, d) are graded descriptors here and, if slopes are wanted, at a small step along
    each coordinate (m = k + 1); slopes are forward differences.
    """
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
    """How scores are computed from descriptors.

    Parameters
    ----------
    readings : Readings
        The cells that descriptors need.
    grades : Grades
    """

    readings: Readings
    grades: Grades


class Around(NamedTuple):
    """Scores, colours and constraints at a point, with their slopes.

    Parameters
    ----------
    score, slopes : (t,) and (t, k) float64
    lab : (5, 3) float64
        CIELAB of `SURFACES`.
    colours : (COLOURS, k) float64
        Gradients of colours, as `_colour_rows` orders them.
    walls, steep : (3,) and (3, k) float64
        Values that a move must keep below limits, and their slopes: the depth of a hole in the
        highlight (log f), the log of the greatest albedo, and how `unlikely` the point is.
    """

    score: Float64
    slopes: Float64
    lab: Float64
    colours: Float64
    walls: Float64
    steep: Float64


def unlikely(log: Any) -> Any:
    """Scale a log density, or its slope, to what `Around.walls` holds.

    Parameters
    ----------
    log : float or array

    Returns
    -------
    float or array
        The greater, the less likely.
    """
    return -THIN * log


class Box(NamedTuple):
    """The gamut box: the range of the library's coordinates.

    Parameters
    ----------
    low, high : (k,) float64
    """

    low: Float64
    high: Float64


class Scoring(NamedTuple):
    """Coefficients of all scores: ``weights @ grades + normals @ z - zero``.

    Parameters
    ----------
    weights : (t, d) float64
    normals : (t, k) float64
    zero : (t,) float64
    """

    weights: Float64
    normals: Float64
    zero: Float64


class Ground(NamedTuple):
    """Everything from which scores, colours and constraints are computed, as arrays.

    Parameters
    ----------
    cells : _Cells or None
        None if scores do not read descriptors.
    used : (d,) int64
        Index of each graded descriptor among `DESCRIPTORS`.
    at, grade : (d, m) float64
        As for `Grades`.
    weights, normals, zero : (t, d), (t, k) and (t,) float64
        As for `Scoring`.
    stiffness : (k, k) float64
        Inverse covariance: the metric in which moves are short (Mahalanobis distance).
    low, high : (k,) float64
        The gamut box.
    density : Density or None
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
        """Collect the arrays, each in one layout.

        Parameters
        ----------
        scoring : Scoring
        stiffness : (k, k) float64
            Metric of moves, an inverse covariance.
        box : Box
        optics : Optics, optional
            Left out if no score reads descriptors.
        density : Density, optional
        """
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
        """Return CIELAB of `SURFACES` at a point.

        Parameters
        ----------
        z : (k,) float64

        Returns
        -------
        (5, 3) float64
        """
        return cielab(self.look(z)[1][_SEEN_AT] * _WHOLE)

    def slopes(self, z: Float64) -> Float64:
        """Return the slopes of all scores at a point.

        Parameters
        ----------
        z : (k,) float64

        Returns
        -------
        (t, k) float64
        """
        return self.around(z).slopes

    def look(self, z: Float64) -> tuple[Float64, Float64, Float64]:
        """Return scores, readings and constraints at a point, without slopes.

        Parameters
        ----------
        z : (k,) float64

        Returns
        -------
        score : (t,)
        readings : (readings, 3); zeros if no descriptors are read
        mended : (2,)
            The first two of `Around.walls`.
        """
        if self.cells is None:
            return self.normals @ z - self.zero, np.zeros((len(READINGS), 3)), np.zeros(2)
        point = _plain(z)
        readings, _, mended, _ = self.cells.near(point, False)
        score = np.empty(len(self.zero))
        graded = self._graded(readings[None])
        _weigh(graded, self.weights, self.normals, self.zero, point, score, self.normals[:0])
        return score, readings, mended

    def around(self, z: Float64) -> Around:
        """Return scores, colours and constraints at a point, with their slopes.

        Parameters
        ----------
        z : (k,) float64
        """
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
        # evaluating the formulas k + 1 times is cheaper than their analytic slopes
        steps = np.empty((k + 1, len(READINGS), 3))
        _around_readings(readings, by_z, steps)
        score, slopes = np.empty(len(self.zero)), np.empty((len(self.zero), k))
        graded = self._graded(steps)
        _weigh(graded, self.weights, self.normals, self.zero, point, score, slopes)
        _colour_rows(readings, by_z, lab, colours)
        return Around(score, slopes, lab, colours, walls, steep)

    def grades(self, z: Float64) -> Float64:
        """Return graded descriptors at points.

        Parameters
        ----------
        z : (..., k) float64

        Returns
        -------
        (..., d) float64, in standard deviations
        """
        if self.cells is None:
            return np.zeros((*z.shape[:-1], 0))
        points = _plain(z).reshape(-1, z.shape[-1])
        readings = np.zeros((len(points), len(READINGS), 3))
        for i, point in enumerate(points):
            readings[i] = self.cells.near(point, False)[0]
        return self._graded(readings).reshape(*z.shape[:-1], len(self.used))

    def _graded(self, readings: Float64) -> Float64:
        """Return graded descriptors (m, d) of readings (m, readings, 3)."""
        described = np.empty((len(readings), len(DESCRIPTORS)))
        formulas(readings, described)
        found = np.empty((len(readings), len(self.used)))
        _interpolate(described, self.used, self.at, self.grade, found)
        return found
