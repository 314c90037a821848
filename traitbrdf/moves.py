"""Where moves of traits lead: numerics of a path through the embedding, compiled.

A move changes some scores by given amounts, exactly, and holds others. Among all ways to do so it
takes the one that is most like what real materials do (shortest by a covariance of the library)
and that changes other scores least, and keeps to where the library is. It goes in strides; in each,
Newton's method brings the scores to where they shall be: a quadratic programme in the box, of which
the rows are slopes of scores (Nocedal & Wright 2006, chapters 16 and 18).

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
    above,
    formulas,
    opponents,
)
from traitbrdf.embedding import FLOOR

Float64 = NDArray[np.float64]

STRIDE = 0.5  # in scores: how far a move goes before it looks again
_NUDGES = (0.15, 0.4, 0.7)  # shares of the way to a kind of material
_TRIED = 4  # kinds of material
_TURNS = 14  # of Newton's method in a stride
_EXACT = 1e-5  # how near a score is brought
_NEAR = 2e-3  # how near is near enough where a score has a kink
_APART = 10.0  # what a change of unrelated scores costs, beside the metric
_BODY = 30.0  # what a change of the body costs, where it is kept
_HUE = 10.0  # what a unit of a* or b* costs, where colour is held
_TURN = 1.0  # degrees that hues may turn then
_DEPENDENT = 1e-11  # of slopes: what differs by less is one and the same
_ABSURD = 25.0  # standard deviations of a coordinate: no step is that long
_SMALL = 1e-5  # a step along a coordinate that shows slopes


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
        found = _log_density(np.ascontiguousarray(z, np.float64), *self[:3])
        return float(found[0]), np.asarray(found[1])


@numba.njit(cache=True, nogil=True)
def _log_density(z: Any, means: Any, whiten: Any, logs: Any) -> Any:
    """log density at z (k,), and its gradient (k,)."""
    count, k = means.shape
    each, pulls = np.empty(count), np.zeros((count, k))
    for c in range(count):
        square = 0.0
        for i in range(k):
            away = 0.0
            for j in range(i + 1):
                away += whiten[c, i, j] * (z[j] - means[c, j])
            square += away * away
            for j in range(i + 1):
                pulls[c, j] += away * whiten[c, i, j]
        each[c] = logs[c] - 0.5 * square
    top = each.max()
    total, slope = 0.0, np.zeros(k)
    for c in range(count):
        share = math.exp(each[c] - top)
        total += share
        slope -= share * pulls[c]
    return top + math.log(total), slope / total


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
    def fit(cls, values: Mapping[str, ArrayLike], knots: int = 65) -> Grades:
        from scipy.interpolate import PchipInterpolator
        from scipy.special import ndtri

        share = np.linspace(0.02, 0.98, 17)
        at, grade = [], []
        for column in values.values():
            x = np.quantile(np.asarray(column, np.float64), share)
            # many members share a value (no tint at all): their grades are one
            gap = 0.03 * max(float(x[-2] - x[1]), 1e-6)
            place = np.unique(np.floor((x - x[0]) / gap), return_inverse=True)[1]
            count = np.bincount(place)
            kept = np.bincount(place, x) / count
            level = np.bincount(place, ndtri(share)) / count
            if len(kept) == 1:
                kept, level = np.append(kept, kept + gap), np.append(level, level + 0.1)
            even = np.linspace(kept[0], kept[-1], knots)
            between = np.interp(np.linspace(0, 1, knots), np.linspace(0, 1, len(kept)), kept)
            fine = 0.5 * (even + between)
            at.append(fine)
            grade.append(PchipInterpolator(kept, level)(fine))
        return cls(tuple(values), np.array(at), np.array(grade))

    def of(self, descriptors: Float64) -> Float64:
        """Grades (..., d) of all of `descriptors.DESCRIPTORS` (..., n), in their order."""
        used = _places(self.names)
        flat = np.ascontiguousarray(descriptors.reshape(-1, descriptors.shape[-1]))
        found = _interpolated(flat, used, self.at, self.grade)
        return np.asarray(found).reshape(*descriptors.shape[:-1], len(used))


_ORDER = {name: i for i, name in enumerate(DESCRIPTORS)}


def _places(names: Sequence[str]) -> NDArray[np.int64]:
    """Where descriptors stand among all."""
    return np.array([_ORDER[name] for name in names], np.int64)


@numba.njit(cache=True, nogil=True)
def _interpolated(values: Any, used: Any, at: Any, grade: Any) -> Any:
    """Columns `used` of values (m, n), each along its own knots, and straight on beyond them."""
    out = np.empty((len(values), len(used)))
    last = at.shape[1] - 1
    for j in range(len(used)):
        x, y = at[j], grade[j]
        end = max(last // 8, 1)
        below = (y[end] - y[0]) / (x[end] - x[0])
        above = (y[last] - y[last - end]) / (x[last] - x[last - end])
        for m in range(len(values)):
            v = values[m, used[j]]
            if v <= x[0]:
                out[m, j] = y[0] + below * (v - x[0])
            elif v >= x[last]:
                out[m, j] = y[last] + above * (v - x[last])
            else:
                i = min(max(np.searchsorted(x, v, side="right") - 1, 0), last - 1)
                out[m, j] = y[i] + (y[i + 1] - y[i]) * (v - x[i]) / (x[i + 1] - x[i])
    return out


class Readings(NamedTuple):
    """What `descriptors.READINGS` need of an embedding: few cells.

    Parameters
    ----------
    rows, mean : (3, cells, k) and (cells,), log(f + FLOOR) of a channel: rows @ z + mean
    weights : (readings, cells)
    columns : (n, c) int64, the cells from the middle to the rim of the highlight, for each theta_d
        that the profile has
    outer : (m, c) int64, cells of the profile beyond
    energy : (angles, cells), directional albedos at angles from 0 to 80 degrees
    """

    rows: Float64
    mean: Float64
    weights: Float64
    columns: NDArray[np.int64]
    outer: NDArray[np.int64]
    energy: Float64

    def at(self, z: Float64) -> Float64:
        """Readings (..., readings, 3) at z (..., k), as decoding mends them."""
        points = np.ascontiguousarray(z, np.float64).reshape(-1, z.shape[-1])
        found = [_near(point, *self, False)[0] for point in points]
        return np.reshape(found, (*z.shape[:-1], len(self.weights), 3))


@numba.njit(cache=True, nogil=True)
def _near(
    z: Any, rows: Any, mean: Any, weights: Any, columns: Any, outer: Any, energy: Any, sloped: Any
) -> Any:
    """Readings (readings, 3) at a point and their slopes (readings, 3, k), 0 if they are not
    wanted; what decoding mends there (2,) and its slopes (2, k): by how much (log f) the middle of
    the highlight is darker than what is around it, and the log of the greatest albedo."""
    count, cells = weights.shape
    value, slopes = np.zeros((count, 3)), np.zeros((count, 3, len(z)))
    mended, steep = np.zeros(2), np.zeros((2, len(z)))
    raised, source = np.empty((3, cells)), np.empty((3, cells), np.int64)
    for c in range(3):
        for n in range(cells):
            log = mean[n]
            for k in range(len(z)):
                log += rows[c, n, k] * z[k]
            raised[c, n] = math.exp(min(log, 30.0))
            source[c, n] = n
    mended[0], steep[0] = _hole(columns, outer, raised, rows, sloped)
    # no hole in the highlight: as high as what follows, of which it then has the slope too
    for c in range(3):
        for j in range(columns.shape[1]):
            for i in range(len(columns) - 2, -1, -1):
                n, after = columns[i, j], columns[i + 1, j]
                if raised[c, n] < raised[c, after]:
                    raised[c, n], source[c, n] = raised[c, after], source[c, after]
    for i in range(count):
        for n in range(cells):
            weight = weights[i, n]
            if weight != 0.0:
                for c in range(3):
                    value[i, c] += weight * max(raised[c, n] - FLOOR, 0.0)
                    if sloped:
                        by, s = weight * raised[c, n], source[c, n]
                        for k in range(len(z)):
                            slopes[i, c, k] += by * rows[c, s, k]
    whole, angle, colour = 1e-9, 0, 0
    for i in range(len(energy)):
        for c in range(3):
            albedo = 0.0
            for n in range(cells):
                albedo += energy[i, n] * max(raised[c, n] - FLOOR, 0.0)
            if albedo > whole:
                whole, angle, colour = albedo, i, c
    mended[1] = math.log(whole)
    if sloped and len(energy):
        for n in range(cells):
            by = energy[angle, n] * raised[colour, n] / whole
            if by != 0.0:
                for k in range(len(z)):
                    steep[1, k] += by * rows[colour, source[colour, n], k]
    if whole > 1.0:  # no more light than there was
        for i in range(count):
            for c in range(3):
                for k in range(len(z)):
                    slopes[i, c, k] = (slopes[i, c, k] - value[i, c] * steep[1, k]) / whole
                value[i, c] /= whole
    return value, slopes, mended, steep


@numba.njit(cache=True, nogil=True)
def _hole(columns: Any, outer: Any, raised: Any, rows: Any, sloped: Any) -> Any:
    """By how much (log f) the middle of the profile is darker than its brightest, and the slope
    (k,)."""
    middle = most = _light_of(columns[0], raised)
    brightest = columns[0]
    for nodes in (columns, outer):
        for i in range(len(nodes)):
            light = _light_of(nodes[i], raised)
            if light > most:
                most, brightest = light, nodes[i]
    inward = np.zeros(rows.shape[2])
    if sloped:
        for at, by in ((brightest, 1.0 / most), (columns[0], -1.0 / middle)):
            for n in at:
                for c in range(3):
                    for k in range(len(inward)):
                        inward[k] += by * LUMINANCE[c] * raised[c, n] * rows[c, n, k]
    return math.log(most / middle), inward


@numba.njit(cache=True, nogil=True)
def _light_of(cells: Any, raised: Any) -> Any:
    light = 0.0
    for n in cells:
        for c in range(3):
            light += LUMINANCE[c] * raised[c, n]
    return light


PALE = 5.0  # C*ab: paler colours have no hue to speak of
_DARK = 0.003  # f of a body or lobe that has half a hue

_BODY_AT, _PEAK_AT = READINGS.index("body"), READINGS.index("profile 0")


def colours(readings: Float64) -> Float64:
    """a* and b* (2, 2) of body and lobe, of readings (1, readings, 3); what is not seen is grey."""
    found, seen = _colours(readings)
    return np.asarray(found[0] * np.minimum(2.0 * seen[0], 1.0)[:, None])


@numba.njit(cache=True, nogil=True)
def _colours(readings: Any) -> Any:
    """a* and b* (m, 2, 2) of body and lobe, this scaled to white, of readings (m, readings, 3), and
    how much there is of both (m, 2): 0 nothing to see a hue of, 1 enough."""
    found, seen = np.empty((len(readings), 2, 2)), np.empty((len(readings), 2))
    rgb, light = np.empty((2, 3)), np.empty(2)
    for m in range(len(readings)):
        for c in range(3):
            rgb[0, c] = max(readings[m, _BODY_AT, c], 0.0) + 1e-6
            rgb[1, c] = above(max(readings[m, _PEAK_AT, c], 0.0), rgb[0, c], 1e-3) + 1e-6
        for i in range(2):
            light[i] = 0.0
            for c in range(3):
                light[i] += LUMINANCE[c] * rgb[i, c]
            whole = max(rgb[1, 0], rgb[1, 1], rgb[1, 2]) if i else 1.0 / math.pi
            for c in range(3):
                rgb[i, c] /= whole
            found[m, i] = opponents(rgb[i])
        seen[m, 0] = light[0] / (light[0] + _DARK)
        # never quite nothing, so that slopes tell what colour a lobe will have once it is seen
        seen[m, 1] = light[1] / (light[1] + _DARK + 0.5 * light[0])
    return found, seen


@numba.njit(cache=True, nogil=True)
def _turned(kept: Any, found: Any, seen: Any) -> Any:
    """Of `_colours` (2, 2) what shall stay 0 (4,): a* and b* across the kept hues (2, 2), and along
    them for what is pale."""
    out = np.empty(4)
    for i in range(2):
        chroma = math.hypot(kept[i, 0], kept[i, 1])
        x, y = (kept[i, 0] / chroma, kept[i, 1] / chroma) if chroma > 0.0 else (1.0, 0.0)
        ahead = found[i, 0] * x + found[i, 1] * y - chroma
        pale = min(max(1.0 - chroma / (2.0 * PALE), 0.0), 1.0)
        # a colour that fades stops short of turning into its opposite
        faded = min(ahead + 0.6 * chroma, 0.0)
        out[i] = seen[i] * (found[i, 1] * x - found[i, 0] * y)
        out[2 + i] = seen[i] * (pale * ahead + faded)
    return out


@numba.njit(cache=True, nogil=True)
def _off(kept: Any, found: Any, seen: Any) -> Any:
    """By how many degrees hues of `_colours` (2, 2) are off, as far as there are hues."""
    worst = 0.0
    for i in range(2):
        now, then = complex(found[i, 0], found[i, 1]), complex(kept[i, 0], kept[i, 1])
        sure = min(min(abs(now), abs(then)) / PALE, 1.0) * min(2.0 * seen[i], 1.0)
        turn = then * now.conjugate()
        worst = max(worst, sure * abs(math.degrees(math.atan2(turn.imag, turn.real))))
    return worst


class Optics(NamedTuple):
    """What lets scores be read off descriptors: where they are read, and how they are graded."""

    readings: Readings
    grades: Grades


class Ground(NamedTuple):
    """What scores and their slopes are had of, as arrays.

    Parameters
    ----------
    read : whether scores are read off descriptors; if not, readings and grades are not looked at
    rows, mean, cells, columns, outer, energy : as `Readings`
    used : (d,) places of the graded descriptors among all
    at, grade : as `Grades`
    weights, normals : (t, d) and (t, k), raw scores: weights @ grades + normals @ z
    zero, span : (t,), raw scores of score 0, and between scores 0 and 1
    stiffness : (k, k) metric of moves
    low, high : (k,)
    means, whiten, logs : as `Density`; without one, there are none
    kinds : (c, t) scores at the means of the c families
    """

    read: bool
    rows: Float64
    mean: Float64
    cells: Float64
    columns: NDArray[np.int64]
    outer: NDArray[np.int64]
    energy: Float64
    used: NDArray[np.int64]
    at: Float64
    grade: Float64
    weights: Float64
    normals: Float64
    zero: Float64
    span: Float64
    stiffness: Float64
    low: Float64
    high: Float64
    means: Float64
    whiten: Float64
    logs: Float64
    kinds: Float64

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
        k = len(low)
        none, no_cells = np.zeros((0, 0)), np.zeros((0, 0), np.int64)
        readings, grades = optics or (
            Readings(np.zeros((3, 0, k)), np.zeros(0), none, no_cells, no_cells, none),
            Grades((), none, none),
        )
        where = density or Density(np.zeros((0, k)), np.zeros((0, k, k)), np.zeros(0), np.zeros(0))
        some = [
            *readings, _places(grades.names), grades.at,
            grades.grade, weights, normals, zero, span, stiffness, low, high, where.means,
            where.whiten, where.logs, np.zeros((0, len(span))),
        ]  # fmt: skip
        # of one layout: each other one would be compiled anew
        found: list[Any] = [np.array(array, order="C") for array in some]
        ground = cls(optics is not None, *found)
        families = [np.clip(mean, low, high) for mean in where.means[:-1]]
        if not families:
            return ground
        return ground._replace(kinds=np.array([ground.look(z)[0] for z in families]))

    def look(self, z: Float64) -> tuple[Float64, Float64, Float64]:
        """Scores (t,) at z (k,), readings (1, readings, 3) and what decoding mends (2,), as
        `_near`; zeros where nothing is read."""
        score, readings, mended = _look(self, np.ascontiguousarray(z, np.float64))
        return score, readings, mended


@numba.njit(cache=True, nogil=True)
def _read(ground: Any, z: Any, sloped: Any) -> Any:
    return _near(
        z,
        ground.rows,
        ground.mean,
        ground.cells,
        ground.columns,
        ground.outer,
        ground.energy,
        sloped,
    )


@numba.njit(cache=True, nogil=True)
def _look(ground: Any, z: Any) -> Any:
    score, readings = _dots(ground.normals, z), np.zeros((1, len(READINGS), 3))
    mended = np.zeros(2)
    if ground.read:
        near = _read(ground, z, False)
        readings, mended = np.expand_dims(near[0], 0), near[2]
        grades = _interpolated(formulas(readings), ground.used, ground.at, ground.grade)
        for i in range(len(score)):
            for j in range(grades.shape[1]):
                score[i] += ground.weights[i, j] * grades[0, j]
    for i in range(len(score)):
        score[i] = (score[i] - ground.zero[i]) / ground.span[i]
    return score, readings, mended


@numba.njit(cache=True, nogil=True)
def _dots(rows: Any, z: Any) -> Any:
    """rows (n, k) @ z (k,)."""
    out = np.zeros(len(rows))
    for i in range(len(rows)):
        for k in range(len(z)):
            out[i] += rows[i, k] * z[k]
    return out


class Task(NamedTuple):
    """One move: scores to bring to where they shall be, and what shall stay.

    Parameters
    ----------
    fixed : scores that are moved or held
    rates : how they change along the move
    start : what they were
    soft, soft_start : scores that had better stay, and what they were
    body, body_at : linear functions of the coordinates that stay, and what they were
    kept, kept_at : those that had better stay
    hued, hues : whether hues stay, and a* and b* (2, 2) of body and lobe
    strictly_hued : whether no move may turn them
    least : log density, `-inf` if it does not matter
    mended : (2,) the most that decoding may mend, as `_near`
    back : how much of what had better stay is drawn back to where it was
    strict : whether a stride is given up early
    """

    fixed: NDArray[np.int64]
    rates: Float64
    start: Float64
    soft: NDArray[np.int64]
    soft_start: Float64
    body: Float64
    body_at: Float64
    kept: Float64
    kept_at: Float64
    hued: bool
    hues: Float64
    strictly_hued: bool
    least: float
    mended: Float64
    back: float = 1.0
    strict: bool = True

    def relaxed(self) -> list[Task]:
        """This task with what it keeps held, drawn back, and left to itself."""
        free = self._replace(back=0.0, strict=False)
        if not len(self.kept):
            return [self, free]
        held = self._replace(
            body=np.vstack([self.body, self.kept]),
            body_at=np.append(self.body_at, self.kept_at),
            kept=self.kept[:0],
            kept_at=self.kept_at[:0],
        )
        return [held, self, free]


def follow(ground: Ground, task: Task, z: Float64, end: float) -> tuple[Float64, float]:
    """Along a move from z (k,) as far as `end` of its rates; where it came to, and how far.

    First all that had better stay does; where that ends, less and less of it. Where no path leads
    on at all (slopes are none where there is no lobe yet), it starts anew a little nearer to kinds
    of material that have more of what is asked.
    """
    at, way = np.clip(z, ground.low, ground.high), 0.0
    relaxed = task.relaxed()
    for more in relaxed:
        at, way = _path(ground, more, at, way, end)
    anew = relaxed[-1]._replace(strictly_hued=task.hued)  # of those kinds all but the colour
    for share in _NUDGES:
        if way >= end:
            break
        for kind in _kinds(ground, task, at):
            goal = _next_mark(way, 0.5 * STRIDE, end)
            nearer = np.clip(at + share * (kind - at), ground.low, ground.high)
            fits, found = _towards(ground, anew, nearer, goal, goal == end)
            if fits:
                at, way = _path(ground, anew, found, goal, end)
                break
    return at, float(way)


def _kinds(ground: Ground, task: Task, z: Float64) -> Float64:
    """The kinds of material (n, k) with the most of what is asked for the least way from z."""
    moved = task.rates != 0.0
    have = ground.kinds[:, task.fixed[moved]] - ground.look(z)[0][task.fixed[moved]]
    away = ground.means[: len(have)] - z
    far = np.sqrt(np.einsum("nk,kl,nl->n", away, ground.stiffness, away))
    gain = have @ task.rates[moved] / np.maximum(far, 1e-9)
    best = np.argsort(-gain, kind="stable")[:_TRIED]
    nearest: Float64 = ground.means[best[gain[best] > 0.0]]
    return nearest


def possible(ground: Ground, task: Task, z: Float64) -> bool:
    """Whether a small step from z (k,) would be, were there no gamut."""
    missing, rows, stiff = _linear(ground, task, z, STRIDE)
    far = np.full(len(z), np.inf)
    return bool(_step(stiff, rows, missing, -far, far, z, np.zeros(len(z)))[0])


def compromise(ground: Ground, task: Task, z: Float64, way: float) -> Float64:
    """Where all that cannot be had together gives way alike."""
    missing, rows, stiff = _linear(ground, task, z, way)
    step = np.linalg.solve(1e-2 * stiff + rows.T @ rows, rows.T @ missing)
    clipped: Float64 = np.clip(z + step, ground.low, ground.high)
    return clipped


def _linear(ground: Ground, task: Task, z: Float64, way: float) -> tuple[Float64, Float64, Float64]:
    """What is missing (m,) of the way from z, rows (m, k), and the stiffness (k, k)."""
    score, readings, _ = ground.look(z)
    missing = _missing(task, z, way, score, readings)[0]
    slopes, hues, stiff, _ = _around(ground, task, z)
    rows, _ = _rows(task, z, score, readings, slopes, hues)
    return missing[:-3], rows[:-3], stiff


def _path(ground: Ground, task: Task, at: Float64, way: float, end: float) -> tuple[Float64, float]:
    """`follow` of one task alone, from where scores have changed by `way` of the rates."""
    stride, least = (STRIDE, 0.2 * STRIDE) if task.strict else (0.5 * STRIDE, 0.05 * STRIDE)
    while way < end and stride > least:
        goal = _next_mark(way, stride, end)
        fits, z = _towards(ground, task, at, goal, goal == end)
        if fits:
            at, way, stride = z, goal, min(2.0 * stride, STRIDE)
        else:
            stride *= 0.25 if task.strict else 0.5
    if 0.0 < way < end:  # a step on the way is not as exact as the last
        fits, z = _towards(ground, task, at, way, True)
        at = z if fits else at
    return at, way


def _next_mark(way: float, stride: float, end: float) -> float:
    """Where a stride ends: at marks, so that moves by more and by less share their way."""
    return min(stride * (math.floor(way / stride + 1e-9) + 1.0), end)


@numba.njit(cache=True, nogil=True)
def _towards(ground: Any, task: Any, start: Any, way: Any, last: Any) -> Any:
    """From a point to where scores have changed by `way` of the rates, exactly in the `last` step;
    whether that can be, and where.

    All that is called stands once: each call is compiled in its place.
    """
    z = start.copy()
    before, first = math.inf, math.inf
    sloped = thinned = False
    at_wall = np.zeros(2, np.bool_)
    from_here, step, uphill = z.copy(), np.zeros(len(z)), np.zeros(len(z))
    none = np.zeros((0, 0))
    slopes, hues, stiff, steep = none, none, none, none
    for turn in range(_TURNS):
        score, readings, mended = _look(ground, z)
        missing, miss, off = _missing(task, z, way, score, readings)
        thin = 0.0
        if task.least > -math.inf:
            found, uphill = _log_density(z, ground.means, ground.whiten, ground.logs)
            thin = task.least - found
        broken = max(mended[0] - task.mended[0], mended[1] - task.mended[1])
        enough = _EXACT if last and turn < _TURNS - 3 else _NEAR
        if miss <= enough and thin <= 1e-3 and broken <= 0.03 and off <= _TURN and turn > 0:
            return True, z
        merit = miss + max(broken, 0.0) + 0.1 * max(thin, 0.0)
        if turn == 5 and merit > 0.5 * first:
            return False, z  # it leads nowhere
        first = merit if turn == 0 else first
        if merit > 1.2 * before and turn > 1:  # too far: half of it
            sloped = False
            for k in range(len(z)):
                step[k] *= 0.5
        else:
            # slopes are kept as long as they lead there
            if not sloped or merit > 0.3 * before:
                slopes, hues, stiff, steep = _around(ground, task, z)
                sloped = True
            before = merit
            rows, pull = _rows(task, z, score, readings, slopes, hues)
            if miss <= _NEAR and turn > 3:  # all that is left is to be exact
                pull[:] = 0.0
            count = len(task.fixed) + len(task.body)
            # what a step has run into stays a wall in those that follow
            thinned = thinned or thin > 0.0
            if thinned:
                missing[count], rows[count] = thin, uphill
                count += 1
            for i in range(2):
                at_wall[i] |= mended[i] > task.mended[i]
                if at_wall[i]:
                    missing[count], rows[count] = task.mended[i] - mended[i], steep[i]
                    count += 1
            fits, step = _step(
                stiff, rows[:count], missing[:count], ground.low, ground.high, z, pull
            )
            if not fits:
                return False, z
            from_here = z
        z = np.empty(len(from_here))
        for k in range(len(z)):
            z[k] = min(max(from_here[k] + step[k], ground.low[k]), ground.high[k])
    return False, z


@numba.njit(cache=True, nogil=True)
def _around(ground: Any, task: Any, z: Any) -> Any:
    """At z (k,): gradients of scores (t, k) and of hues (4, k), the stiffness (k, k) of what had
    better stay, and the gradients of what decoding mends (2, k)."""
    k, t = len(z), len(ground.normals)
    slopes = ground.normals.copy()
    steps, steep = np.zeros((k + 1, len(READINGS), 3)), np.zeros((2, k))
    if ground.read:
        readings, by_z, _, steep = _read(ground, z, True)
        for i in range(len(readings)):
            for c in range(3):
                # formulas of a few numbers: cheaper once more than their slopes
                steps[0, i, c] = readings[i, c]
                for n in range(k):
                    steps[n + 1, i, c] = readings[i, c] + _SMALL * by_z[i, c, n]
        grades = _interpolated(formulas(steps), ground.used, ground.at, ground.grade)
        for i in range(t):
            for n in range(k):
                for j in range(grades.shape[1]):
                    change = grades[n + 1, j] - grades[0, j]
                    slopes[i, n] += ground.weights[i, j] * change / _SMALL
    for i in range(t):
        for n in range(k):
            slopes[i, n] /= ground.span[i]
    hues = np.zeros((4, k))
    if task.hued:
        found, seen = _colours(steps)
        here = _turned(task.hues, found[0], seen[0])
        for n in range(k):
            there = _turned(task.hues, found[n + 1], seen[n + 1])
            for i in range(4):
                hues[i, n] = (there[i] - here[i]) / _SMALL
    stiff = ground.stiffness.copy()
    for i in task.soft:
        _stiffen(stiff, slopes[i], _APART)
    for i in range(len(task.kept)):
        _stiffen(stiff, task.kept[i], _BODY)
    for i in range(len(hues)):
        _stiffen(stiff, hues[i], _HUE)
    return slopes, hues, stiff, steep


@numba.njit(cache=True, nogil=True)
def _stiffen(stiff: Any, row: Any, by: Any) -> Any:
    for i in range(len(row)):
        if row[i] != 0.0:
            for j in range(len(row)):
                stiff[i, j] += by * row[i] * row[j]


@numba.njit(cache=True, nogil=True)
def _missing(task: Any, z: Any, way: Any, score: Any, readings: Any) -> Any:
    """What is missing (m + 3,) of what is fixed, the most of it, and by how many degrees hues are
    off; the last three are left for walls."""
    count, most, off = len(task.fixed), 0.0, 0.0
    missing = np.zeros(count + len(task.body) + 3)
    for i in range(count):
        missing[i] = task.start[i] + task.rates[i] * way - score[task.fixed[i]]
    body = _dots(task.body, z)
    for i in range(len(body)):
        missing[count + i] = task.body_at[i] - body[i]
    for value in missing:
        most = max(most, abs(value))
    if task.hued and task.strictly_hued:
        found, seen = _colours(readings)
        off = _off(task.hues, found[0], seen[0])
    return missing, most, off


@numba.njit(cache=True, nogil=True)
def _rows(task: Any, z: Any, score: Any, readings: Any, slopes: Any, hues: Any) -> Any:
    """The rows (m + 3, k) of what is fixed, and the pull (k,) of what had better stay."""
    count, k = len(task.fixed), len(z)
    rows, pull = np.zeros((count + len(task.body) + 3, k)), np.zeros(k)
    for i in range(count):
        rows[i] = slopes[task.fixed[i]]
    for i in range(len(task.body)):
        rows[count + i] = task.body[i]
    for i in range(len(task.soft)):
        away = task.soft_start[i] - score[task.soft[i]]
        _add(pull, slopes[task.soft[i]], task.back * _APART * away)
    kept = _dots(task.kept, z)
    for i in range(len(kept)):
        _add(pull, task.kept[i], task.back * _BODY * (task.kept_at[i] - kept[i]))
    if task.hued:
        found, seen = _colours(readings)
        turned = _turned(task.hues, found[0], seen[0])
        for i in range(len(turned)):
            _add(pull, hues[i], -_HUE * turned[i])
    return rows, pull


@numba.njit(cache=True, nogil=True)
def _add(total: Any, row: Any, by: Any) -> Any:
    for k in range(len(row)):
        total[k] += by * row[k]


@numba.njit(cache=True, nogil=True)
def _step(stiff: Any, rows: Any, wanted: Any, low: Any, high: Any, z: Any, pull: Any) -> Any:
    """The step (k,) from z that makes step @ stiff @ step / 2 - pull @ step least, with rows @ step
    = wanted and within low and high; whether there is one, and the step.

    Coordinates that would leave the box stay at its wall.
    """
    k, m = len(stiff), len(rows)
    step, free = np.zeros(k), np.ones(k, np.bool_)
    size = 1e-12
    for value in wanted:
        size = max(size, abs(value))
    for _ in range(k):
        at = np.flatnonzero(free)
        n = len(at)
        inner, both, rest = np.empty((n, n)), np.empty((n, m + 1)), np.empty(m)
        for i in range(m):
            rest[i] = wanted[i]
            for j in range(k):
                if not free[j]:
                    rest[i] -= rows[i, j] * step[j]
        for i in range(n):
            both[i, m] = pull[at[i]]
            for j in range(k):
                if not free[j]:
                    both[i, m] -= stiff[at[i], j] * step[j]
            for j in range(n):
                inner[i, j] = stiff[at[i], at[j]]
            for j in range(m):
                both[i, j] = rows[j, at[i]]
        _solve(inner, both, 0.0)
        gram, forces = np.zeros((m, m)), np.empty((m, 1))
        for i in range(m):
            forces[i, 0] = rest[i]
            for a in range(n):
                row = rows[i, at[a]]
                forces[i, 0] -= row * both[a, m]
                for j in range(m):
                    gram[i, j] += row * both[a, j]
        _solve(gram, forces, _DEPENDENT)
        for a in range(n):
            part = both[a, m]
            for j in range(m):
                part += both[a, j] * forces[j, 0]
            if not abs(part) <= _ABSURD:
                return False, step
            step[at[a]] = part
            for i in range(m):
                rest[i] -= rows[i, at[a]] * part
        for value in rest:
            if abs(value) > 0.3 * size:
                return False, step
        inside = True
        for a in range(n):
            i = at[a]
            least, most = low[i] - z[i], high[i] - z[i]
            if step[i] < least - 1e-12 or step[i] > most + 1e-12:
                step[i] = min(max(step[i], least), most)
                free[i] = inside = False
        if inside:
            return True, step
        if n == 1:
            return False, step
    return False, step


@numba.njit(cache=True, nogil=True)
def _solve(a: Any, b: Any, ridge: Any) -> Any:
    """b (n, m) becomes the solution x of a @ x = b, by Cholesky's factors of a (n, n), symmetric;
    the ridge, of its greatest diagonal value, lets rows depend on each other."""
    n, m = b.shape
    most = 0.0
    for i in range(n):
        most = max(most, a[i, i])
    least = max(ridge, 1e-14) * most + 1e-300
    for i in range(n):
        for j in range(i + 1):
            part = a[i, j]
            for k in range(j):
                part -= a[i, k] * a[j, k]
            if i == j:
                a[i, i] = math.sqrt(max(part + ridge * most, least))
            else:
                a[i, j] = part / a[j, j]
        for k in range(m):
            for j in range(i):
                b[i, k] -= a[i, j] * b[j, k]
            b[i, k] /= a[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(m):
            b[i, k] /= a[i, i]
            for j in range(i):
                b[j, k] -= a[i, j] * b[i, k]
