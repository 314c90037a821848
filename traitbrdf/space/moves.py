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
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from traitbrdf.space.scores import (
    BESIDE,
    BODY_OF,
    CHROMAS,
    COLOURS,
    GREYS,
    HUES,
    LOBES,
    THIN,
    TURN,
    Around,
    Ground,
    compiled,
)

Float64 = NDArray[np.float64]
STEP = 0.05  # in scores: how far a move goes before it looks again
_APART = 2.0  # what a change of unrelated scores costs, beside the metric
_BODY = 30.0  # what a change of the body costs, where it is kept
_STEER = 0.1  # what it costs to miss a unit of a* or b* of the colour that a move leads to
_KEEN = 4.0  # shares of what is missing that are made up for in a unit
_TURNING = 105.0  # colour difference for a unit: no faster
_HELD = 1e6  # what a change of a held score costs
_WANTED = 3000.0  # what it costs that a moved score stays behind
_FULL = 0.7  # of the way asked for: from here on all of it is made
_WALL = 1e5  # what it costs to go through a wall
_BACK = 0.05  # the most that a step goes back to a wall that the last one went through
_MENDS = 4  # how often scores are put right after a step
_EXACT = 2e-4  # how near a score is brought
_OVER = 0.02  # log f by which a step may go through a wall
_TRUST = 0.01  # how far a step's scores may be from what the field says
_ASTRAY = 2e-3  # how far held scores may be from where they were
_FALLS = 5e-4  # by which a moved score may fall in a part of a step
_LOST = 0.02  # what is further off is no error of a step
_LONG = 0.4  # standard deviations: no part of a step is longer
_PARTS = 16.0  # shorter than that part of a step it is never made
_LOOKS = 48  # at the field, in a step
_FASTEST = 20.0  # standard deviations for a unit
_SHOWN = 130.0  # of the CIE 1976 colour difference for a unit
_HARDLY = 1e-9  # less than this is no way at all
_STUCK = 0.02  # of the way asked for: what makes less has ended
_PATIENCE = 3  # steps that come to nothing before a move ends


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
        """What changes (COLOURS,) of `_colour_rows` cost; if not `coloured`, hues may change."""
        costs = np.zeros(COLOURS)
        turn = costs[TURN:HUES].reshape(-1, 3)
        turn[:, 0] = self.light
        if self.steered:
            turn[:, 1:] = _STEER
            turn[:BODY_OF, 0] += _STEER
        if coloured:
            costs[HUES:GREYS] = self.hue
            costs[GREYS:CHROMAS] = self.hue.repeat(2)
            costs[CHROMAS:LOBES] = self.chroma.repeat(2)
            costs[LOBES:BESIDE] = self.lobe
        costs[BESIDE] = self.together
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
        missing[:, 0] = np.where(np.arange(len(lab)) < BODY_OF, self.steer[0] - lab[:, 0], 0.0)
        far = np.sqrt(np.sum(missing * missing, axis=1, keepdims=True))
        fast = _STEER * _KEEN / (1.0 + _KEEN * far / _TURNING)
        return np.asarray(self.rates[0] * ((fast * missing).ravel() @ turn))


@compiled
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


@compiled
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


@compiled
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


@dataclass(frozen=True)
class Moved:
    """What a move came to.

    Attributes
    ----------
    z : (k,) array
    asked, reached : by trait, the change asked for and the change made
    held : by held trait, how much it changed nevertheless
    plausibility : as `TraitSpace.plausibility` of `z`
    stopped : "" if all was reached, else why not
    walled : whether it slid along a wall of the gamut, so that the way back may lead elsewhere
    """

    z: Float64
    asked: Mapping[str, float]
    reached: Mapping[str, float]
    held: Mapping[str, float]
    plausibility: float
    stopped: str = ""
    walled: bool = False

    @property
    def complete(self) -> bool:
        """Whether all that was asked for was reached."""
        return not self.stopped

    def __str__(self) -> str:
        made = ", ".join(
            f"{name} {self.reached[name]:+.2f} of {asked:+.2f}"
            for name, asked in self.asked.items()
        )
        return f"{made}; {self.stopped or 'complete'}; plausibility {self.plausibility:.2f}"


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
        turn = around.colours[TURN:HUES]
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
                or around.walls[2] > task.limits[2] - THIN
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
