"""Where moves of traits lead: a flow through the embedding.

A move is the solution of dz/dt = v(z), where t counts the change of the scores. The velocity v
minimises a quadratic cost: its length in the library's Mahalanobis distance, the failure of moved
scores to change as fast as asked, any change of held scores, and, with smaller weights, changes of
unrelated scores and of the colours that a person sees. With the gamut box and the other limits this
is a quadratic programme (Nocedal & Wright 2006, chapter 16). It is solved anew at each point from
that point alone, so the curve is continuous, does not depend on earlier moves, and can be followed
back.

`Ground` computes scores and limits at a point, and `Task` describes one move.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from traitbrdf.space.holding import HeldCosts
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

# A move's length is measured in scores: the trait that moves most changes by 1 for each unit. A
# velocity is in standard deviations of the coordinates for each unit. Costs are weights of squared
# rates, beside the squared Mahalanobis length of the velocity, whose weight is 1.
STEP = 0.05  # units between two knots of the curve
_APART = 2.0  # cost of an unrelated score's change, for a score
_BODY = 30.0  # cost of the body's change where it is held, for log f
_STEER = 0.1  # cost of missing the colour that a move leads to, for a unit of L*, a* or b*
_KEEN = 4.0  # share of the missing colour that is made up for in each unit
_TURNING = 105.0  # CIE 1976 colour difference for each unit: colours are drawn no faster
_HELD = 1e6  # cost of a held score's change, for a score
_WANTED = 3000.0  # cost of missing a moved score's rate, for a score
_FULL = 0.7  # share of the asked rate from which rates are raised until all of it is made
_WALL = 1e5  # cost of passing a wall, for a unit of `Around.walls`
_BACK = 0.05  # greatest return, in a step, to a wall that the last one passed (`Around.walls`)
_MENDS = 4  # Newton steps that correct scores after a part of a step
_EXACT = 2e-4  # error of a score at which they end
_OVER = 0.02  # log f or log albedo by which a part of a step may pass a wall
_TRUST = 0.01  # error of a score against the velocity's prediction that halves a part of a step
_ASTRAY = 2e-3  # error of a held score that halves a part of a step
_FALLS = 5e-4  # decrease of moved scores that halves a part of a step
_LOST = 0.02  # error of a moved score above which it is accepted rather than corrected
_LONG = 0.4  # standard deviations: greatest length of a part of a step
_PARTS = 16.0  # parts into which a step is divided at most by halving
_LOOKS = 48  # evaluations of the velocity in a step, at most
_FASTEST = 20.0  # standard deviations for each unit: greatest speed
_SHOWN = 130.0  # CIE 1976 colour difference for each unit: greatest speed of a surface's colour
_HARDLY = 1e-9  # units: shorter distances count as zero
_STUCK = 0.02  # share of a step: one that makes less counts as idle
_PATIENCE = 3  # idle steps in a row at which a move ends


class Task(NamedTuple):
    """One move: what changes, what is held, and what changes as little as possible.

    Costs are weights of squared rates of change in the quadratic programme.

    Parameters
    ----------
    moved : (n,) int64
        Scores that change, as indices of traits.
    rates : (n,) float64
        Their change for each unit of the move, in [-1, 1].
    held : int64 array
        Scores that are held.
    apart : int64 array
        Unrelated scores, whose changes have a cost.
    costs : HeldCosts
        Costs of changes of colour and lightness, and the colour that a steered move leads to.
    body : (rows, k) float64
        Linear functions of the coordinates that describe the body; they are kept.
    limits : (3,) float64
        Upper bounds of `Around.walls`; ``inf`` for none.
    """

    moved: NDArray[np.int64]
    rates: Float64
    held: NDArray[np.int64]
    apart: NDArray[np.int64]
    costs: HeldCosts
    body: Float64
    limits: Float64

    def colour_costs(self, coloured: bool) -> Float64:
        """Return the cost of each colour change.

        Parameters
        ----------
        coloured : bool
            Whether changes of hue and chroma have a cost.

        Returns
        -------
        (COLOURS,) float64, as `Around.colours` is ordered
        """
        found = np.zeros(COLOURS)
        turn = found[TURN:HUES].reshape(-1, 3)
        turn[:, 0] = self.costs.light
        if self.costs.steered:
            turn[:, 1:] = _STEER
            turn[:BODY_OF, 0] += _STEER
        if coloured:
            found[HUES:GREYS] = self.costs.hue
            found[GREYS:CHROMAS] = self.costs.hue.repeat(2)
            found[CHROMAS:LOBES] = self.costs.chroma.repeat(2)
            found[LOBES:BESIDE] = self.costs.lobe
        found[BESIDE] = self.costs.together
        return found

    def score_costs(self, count: int) -> Float64:
        """Return the cost of each score's change; for moved scores, of missing the asked rate.

        Parameters
        ----------
        count : int
            Number of traits t.

        Returns
        -------
        (t,) float64
        """
        costs = np.zeros(count)
        costs[self.apart] = _APART
        costs[self.held] = _HELD
        costs[self.moved] = _WANTED
        return costs

    def drawn(self, lab: Float64, turn: Float64) -> Float64:
        """Return the linear term that draws colours towards the one that a steered move leads to.

        Colours approach it by a share of the difference for each unit, at a limited speed.

        Parameters
        ----------
        lab : (5, 3) float64
            CIELAB of `SURFACES`.
        turn : (15, k) float64
            Its slopes.

        Returns
        -------
        (k,) float64
        """
        missing = self.costs.steer * (lab[:, :1] + 16.0) - lab
        missing[:, 0] = np.where(
            np.arange(len(lab)) < BODY_OF, self.costs.steer[0] - lab[:, 0], 0.0
        )
        far = np.sqrt(np.sum(missing * missing, axis=1, keepdims=True))
        fast = _STEER * _KEEN / (1.0 + _KEEN * far / _TURNING)
        return np.asarray(self.rates[0] * ((fast * missing).ravel() @ turn))


@compiled
def _stiffen(form: Any, scores: Any, by_score: Any, colours: Any, by_colour: Any) -> Any:
    """Add squares of linear functions (n, k), times their costs, to a quadratic form (k, k)."""
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
    """Minimise x @ stiff @ x / 2 - pull @ x within a box, by an active-set method.

    The result is written to x (k,). Coordinates that would leave the box are fixed at its wall, and
    are not freed again.
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
    """Slopes (n, k) of moved scores, and the rates (n,) at which they shall change."""

    slopes: Float64
    rates: Float64


class _Walls(NamedTuple):
    """Limits of a velocity: the box, and quantities that must not grow beyond a limit.

    Parameters
    ----------
    low, high : (k,) float64
    slopes : (3, k) float64
        Slopes of `Around.walls`.
    gaps : (3,) float64
        How much these may still grow.
    """

    low: Float64
    high: Float64
    slopes: Float64
    gaps: Float64


@compiled
def _speed(form: Any, pull: Any, aim: Any, walls: Any, z: Any, h: Any, turn: Any, out: Any) -> Any:
    """Write to `out` (k,) the velocity at z (k,) that costs least by a form (k, k).

    A step of h stays within the walls. Missing the rate of a moved score costs `_WANTED`: so the
    speed is limited, and the velocity fades where no direction changes the score. If there are
    slopes `turn` (15, k) of colours, rates that are nearly met are met in full, and the speed is
    limited to what an eye can follow.
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
        slow = (1.0 + over**12) ** (-1.0 / 24.0)  # close to 1 below the greatest speed
        for n in range(k):
            out[n] *= slow


STEEP, WALLED, COLOURED = 1, 2, 4
"""Reasons why a move makes less way than asked for: flags that `Flow.why` adds up."""


@dataclass(frozen=True)
class Moved:
    """The outcome of a move.

    Attributes
    ----------
    z : (k,) float64
        Coordinates at its end.
    asked, reached : mapping of float
        By moved trait, the change of its score that was asked for, and the change made.
    held : mapping of float
        By held trait, the remaining change of its score.
    plausibility : float
        `TraitSpace.plausibility` of `z`, in [0, 1].
    stopped : str
        "" if all was reached, else the reason why not.
    walled : bool
        Whether the move slid along a wall of the gamut, so that the way back may lead elsewhere.
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
    """A part of a step of the integration.

    Attributes
    ----------
    done : float
        How far its end is from the start of the step, in scores.
    z : (k,) float64
        Coordinates at its end.
    planned : (n,) float64
        Scores that moved traits should have there.
    form : (k, k) float64
        The quadratic form at its middle.
    slopes : (t, k) float64
        Slopes of all scores at its middle.
    """

    done: float
    z: Float64
    planned: Float64
    form: Float64
    slopes: Float64


class Knot(NamedTuple):
    """A point of the computed curve.

    Attributes
    ----------
    z : (k,) float64
    planned : (n,) float64
        Scores that moved traits should have there.
    score : (t,) float64
        Scores of all traits.
    walled : bool
        Whether a wall was met so far.
    speed : (k,) float64 or None
        The last velocity, a first guess for the next step.
    parts : tuple of Part
        The parts of the step that ends here.
    """

    z: Float64
    planned: Float64
    score: Float64
    walled: bool
    speed: Float64 | None = None
    parts: tuple[Part, ...] = ()


class Flow:
    """The curve of a move from one point, integrated as far as it was asked for, and kept.

    Steps do not depend on how far was asked, so the point at 0.5 is the same whether 0.48 was asked
    for before or not, and going further costs only the new steps.

    Parameters
    ----------
    ground : Ground
    task : Task
    z : (k,) float64
        The start, within the box.
    end : float
        How far the move may go, in scores.
    around : Around, optional
        `Ground.around` of `z`, if it is known.
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
        """Scores (t,) of all traits at the start."""
        return self._knots[0].score

    def to(self, way: float) -> Knot:
        """Integrate to a distance, and return the point there, or the end if that comes earlier.

        Parameters
        ----------
        way : float
            In scores, at least 0.
        """
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
        """Integrate one step more."""
        knot, rates = self._knots[-1], self.task.rates
        found = self._advance(len(self._knots) - 1, STEP)
        made = float((found.planned - knot.planned) @ rates / (rates @ rates))
        # at a kink one step may be idle, and the next one go on
        self._idle = self._idle + 1 if made < _STUCK * STEP else 0
        if self._idle == _PATIENCE:
            self.end = min(self.end, len(self._knots) * STEP)
        self._knots.append(found)

    def _between(self, place: int, h: float) -> Knot:
        """Interpolate between a knot and the next.

        The curve is a polyline through the ends of the step's parts; then scores are corrected.
        """
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
        return after  # the step ended early

    def why(self, way: float) -> int:
        """Find why the move makes less way than asked for.

        Parameters
        ----------
        way : float
            Where, in scores.

        Returns
        -------
        int
            The sum of `STEEP` (scores depend too little on coordinates), `WALLED` (the gamut ends)
            and `COLOURED` (colour and lightness are held) where they apply.
        """
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
        """Return the quadratic form (k, k) of the cost of a velocity.

        It adds up the Mahalanobis distance and the squared changes that have a cost.
        """
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
        """Return the velocity (k,) at z (k,), of which a step of h stays within the walls.

        Without `shown` it is the plain minimum, by which `why` finds reasons.
        """
        task, ground = self.task, self.ground
        low, high, gaps = ground.low, ground.high, task.limits - around.walls
        if not walled:
            low, high, gaps = low - math.inf, high + math.inf, gaps + math.inf
        turn = around.colours[TURN:HUES]
        aim = _Aim(around.slopes[task.moved], task.rates)
        drawn = task.drawn(around.lab, turn) if task.costs.steered else self._nowhere
        speed = np.empty(len(z))
        _speed(
            form, drawn, aim, _Walls(low, high, around.steep, gaps), z, h,
            turn if shown else turn[:0], speed,
        )  # fmt: skip
        return speed

    def _advance(self, place: int, h: float) -> Knot:
        """Integrate a step of h from a knot.

        The midpoint rule (Hairer, Norsett & Wanner 1993, II.1), in parts where the velocity is high
        or scores differ from what it predicts; then the scores' remaining errors are corrected. The
        midpoint is predicted with the velocity of the previous part, which halves the number of
        evaluations; where that fails, with the velocity here.
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
            if task.costs.steered:  # the drawn colour may change scores faster than asked for
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
            # scores too far off to be corrected: the curve goes on from where they are
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
                    break  # the move ends: held scores would change, or moved ones go back
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
            # where one part had to be short, so will the next
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
        """Correct the scores of a point near the curve.

        Newton steps bring moved scores to their aim (n,) and held ones to their start, along the
        cheapest way by a form (k, k), with slopes (t, k) of scores. No coordinate changes by more
        than half as far as the part of a step goes: where slopes are faint the correction would
        jump. Returns the point (k,) and its scores (t,).
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
        """Return the greatest error of moved scores against their aim, and of held ones."""
        task = self.task
        off = _most(aim - score[task.moved])
        return max(off, _most(self._kept - score[task.held])) if len(task.held) else off

    def _inside(self, z: Float64, speed: Float64, h: float) -> Float64:
        """Return z + h * speed, clipped to the box."""
        out = h * speed
        out += z
        np.maximum(out, self.ground.low, out=out)
        return np.minimum(out, self.ground.high, out=out)


def _most(values: Float64) -> float:
    """Return the greatest absolute value, 0 if there is none."""
    return max(map(abs, values.tolist()), default=0.0)
