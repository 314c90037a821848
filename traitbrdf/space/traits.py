"""Traits: words with which a designer describes and moves materials.

A trait is a smooth score on coordinates. The shipped ones grade `reflectance.descriptors` by how
common their values are in the library, and add the grades up. Straight traits are linear functions
of the coordinates (Matusik et al. 2003). The library's 10th percentile has 0 and its 90th has 1.

A move changes scores by given amounts along a curve and holds others (`traitbrdf.space.moves`). It
ends at the wall of the gamut box, or where no member of the library is near (`Density`).
"""

from __future__ import annotations

import functools
import math
import threading
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.arguments import number, numbers
from traitbrdf.formats.files import artifact, unknown_name
from traitbrdf.host import steady
from traitbrdf.reflectance.descriptors import descriptors
from traitbrdf.space.definitions import (
    Definition,
    Labelled,
    Statistics,
    as_labels,
    rank_correlations,
    stacked,
    straight,
    with_one_more,
)
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.explanation import Explanation
from traitbrdf.space.holding import COLOURS, GROUPS, LIGHT, held_costs
from traitbrdf.space.library import Library, default_embedding, default_library
from traitbrdf.space.moves import COLOURED, STEEP, STEP, WALLED, Flow, Moved, Task
from traitbrdf.space.scores import (
    Around,
    Box,
    Density,
    Grades,
    Ground,
    Optics,
    Readings,
    Scoring,
    unlikely,
)

Float64 = NDArray[np.float64]

Method = Literal["flow", "linear"]

RELATED = 0.5
"""Rank correlation in the library from which two traits are related, and move together."""

PLAUSIBLE = 0.002
"""The share of the library that is less plausible than any point of a photoreal move."""

_EXTREMES = (1.0, 99.0)  # percentiles of the library's scores that no photoreal move passes
_BETWEEN = 0.05  # weight of differences between families in the metric of moves; within them 1
_RIDGE = 1e-3  # of the mean variance, added to the covariance so that it can be inverted
_NEAR = 2.5e-3  # error of a score within which it counts as reached
_FAR = 20.0  # scores: no move is longer
_PERCENT = np.linspace(0.0, 1.0, 101)
_KNOWN = 32  # moves whose curve is kept, so that a drag goes on from there
_PARTS = ("names", "weights", "normals", "typical", "meanings", "synonyms")  # of definitions

_HOLE = 0.12  # log f by which the middle of a highlight may be darker than its brightest ring


@steady
class TraitSpace:
    """Scores and moves of the traits of one embedding.

    Parameters
    ----------
    traits : t Definition
        Of graded descriptors (d,) and coordinates (k,).
    box : Box
        The gamut box (k,): no move leaves it.
    statistics : Statistics
        How coordinates and scores vary in the library.
    optics : Optics, optional
        How graded descriptors are computed from coordinates; left out if all traits are straight.
    body : (rows, k) array_like, optional
        Linear functions of the coordinates that describe the body below the highlight: what
        holding "body" keeps.

    Attributes
    ----------
    traits : tuple of Definition
    names : tuple of str
    normals, typical, weights : (t, k), (t, 2) and (t, d) float64
        The parts of `traits`, stacked.
    box : Box
    low, high : (k,) float64
        The ends of `box`.
    covariance, related, limits, density
        The parts of `statistics`.
    optics : Optics or None
    body : (rows, k) float64

    Raises
    ------
    ValueError
        On wrong shapes, a name or synonym given twice, or a 10th percentile that is not below the
        90th.
    """

    def __init__(
        self,
        traits: Sequence[Definition],
        box: Box,
        statistics: Statistics,
        optics: Optics | None = None,
        body: ArrayLike | None = None,
    ) -> None:
        self.traits = tuple(traits)
        self.names = tuple(trait.name for trait in self.traits)
        self.box = Box(*(np.asarray(end, np.float64) for end in box))
        self.low, self.high = self.box
        self.optics = optics
        t, k = len(self.names), len(self.low)
        d = len(optics.grades.names) if optics else 0
        self.normals = stacked(self.traits, "normal", k)
        self.typical = stacked(self.traits, "typical", 2)
        self.weights = stacked(self.traits, "weights", d)
        known = statistics
        unlimited = np.tile([-math.inf, math.inf], (t, 1))
        self.covariance = np.asarray(known.covariance, np.float64)
        self.related = np.asarray(np.ones((t, t)) if known.related is None else known.related,
                                  np.float64)  # fmt: skip
        self.limits = np.asarray(unlimited if known.limits is None else known.limits, np.float64)
        self.density = known.density
        expected = {"covariance": (k, k), "high": (k,), "related": (t, t), "limits": (t, 2)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                got = getattr(self, name).shape
                raise ValueError(f"{name}: expected shape {shape}, got {got}")
        self._span = self.typical[:, 1] - self.typical[:, 0]
        if not np.all(self._span > 0.0):
            raise ValueError("typical: expected the 90th percentile above the 10th for each trait")
        self.body = np.zeros((0, k)) if body is None else np.asarray(body, np.float64)
        if self.body.ndim != 2 or self.body.shape[1] != k or not np.isfinite(self.body).all():
            raise ValueError(f"body: expected shape (rows, {k}), got {self.body.shape}")
        self._synonyms = {other: one.name for one in self.traits for other in one.synonyms}
        self._places = {name: i for i, name in enumerate(self.names)}
        self._places |= {other: self._places[name] for other, name in self._synonyms.items()}
        every = [*self.names, *(other for one in self.traits for other in one.synonyms)]
        if len(self._places) < len(every):
            twice = sorted({name for name in every if every.count(name) > 1})
            raise ValueError(f"traits: expected each name once, got {twice} more than once")
        self._flows: OrderedDict[Any, tuple[Flow, float]] = OrderedDict()
        self._lock = threading.Lock()
        metric = self.covariance + _RIDGE * np.trace(self.covariance) / k * np.eye(k)
        span = self._span[:, None]
        scoring = Scoring(self.weights / span, self.normals / span, self.typical[:, 0] / self._span)
        self._ground = Ground.of(scoring, np.linalg.inv(metric), self.box, optics, self.density)

    @classmethod
    def fit(
        cls,
        coordinates: ArrayLike,
        traits: Sequence[Labelled],
        box: Box,
        families: Sequence[str] | None = None,
        optics: Optics | None = None,
        body: ArrayLike | None = None,
    ) -> TraitSpace:
        """Fit traits to labelled members of a library.

        A trait with weights of graded descriptors reads these. Any other is straight: the normal of
        the plane that separates its labels (`traitbrdf.space.definitions.straight`).

        Parameters
        ----------
        coordinates : (n, k) array_like
            Coordinates of the members.
        traits : t Labelled
        box : Box
            The gamut box (k,).
        families : n str, optional
            Kinds of material. With them, moves follow how members differ from others of their kind,
            and only a little how kinds differ, so that a shinier plastic remains a plastic; and
            `Density` is fitted, so that moves stay near the library.
        optics, body
            As for `TraitSpace`.

        Raises
        ------
        ValueError
            If a trait's labels are of one class only, or shapes do not match.
        """
        z = np.asarray(coordinates, np.float64)
        unscaled = []
        for name, labels, given, meaning, synonyms in traits:
            d = len(optics.grades.names) if optics else 0
            weights = np.zeros(d) if given is None else np.asarray(given, np.float64)
            known = as_labels(labels, len(z), name)
            read = bool(np.any(weights != 0.0))
            normal = np.zeros(z.shape[1]) if read else straight(z, known, name)
            unscaled.append(
                Definition(name, weights, normal, np.array([0.0, 1.0]), meaning, synonyms)
            )
        covariance, density = np.cov(z.T), None
        if families is not None:
            kinds = np.asarray(families)
            if kinds.shape != (len(z),):
                raise ValueError(f"families: expected ({len(z)},) names, got {kinds.shape}")
            centred = z.copy()
            for kind in np.unique(kinds):
                centred[kinds == kind] -= z[kinds == kind].mean(axis=0)
            covariance = np.cov(centred.T) + _BETWEEN * covariance
            density = Density.fit(z, list(families))
        statistics = Statistics(covariance, density=density)
        raw = cls(unscaled, box, statistics, optics, body)._raw(z)
        typical = np.percentile(raw, [10.0, 90.0], axis=0).T
        limits = np.percentile(raw, _EXTREMES, axis=0).T - typical[:, :1]
        limits /= np.maximum(typical[:, 1:] - typical[:, :1], 1e-300)
        scaled = [replace(one, typical=ends) for one, ends in zip(unscaled, typical, strict=True)]
        statistics = replace(statistics, related=rank_correlations(raw), limits=limits)
        return cls(scaled, box, statistics, optics, body)

    def __repr__(self) -> str:
        return f"TraitSpace({', '.join(self.names)})"

    def index(self, name: str) -> int:
        """Return where a trait stands in `names`.

        Parameters
        ----------
        name : str
            The trait's name or an everyday one.

        Raises
        ------
        ValueError
            If it is unknown; the message names the nearest ones.
        """
        if name not in self._places:
            raise ValueError(unknown_name("trait", name, (*self.names, *self._synonyms)))
        return self._places[name]

    def meaning(self, name: str) -> str:
        """Return one line that explains a trait.

        Parameters
        ----------
        name : str
            The trait's name or an everyday one.

        Raises
        ------
        ValueError
            If it is unknown.
        """
        trait = self.traits[self.index(name)]
        return trait.meaning or trait.name

    # -- scores ---------------------------------------------------------------------------------

    def score(self, z: ArrayLike) -> dict[str, float]:
        """Return every trait's score at a point.

        Parameters
        ----------
        z : (k,) array_like

        Returns
        -------
        dict of float
            By trait; 0 is typically low (the library's 10th percentile), 1 typically high (its
            90th).

        Raises
        ------
        ValueError
            If `z` is not k finite numbers.
        """
        return dict(zip(self.names, self.scores(self._point(z)).tolist(), strict=True))

    def scores(self, z: ArrayLike) -> Float64:
        """Return all scores at points.

        Parameters
        ----------
        z : (..., k) array_like

        Returns
        -------
        (..., t) float64, in the order of `names`
        """
        return (self._raw(np.asarray(z, np.float64)) - self.typical[:, 0]) / self._span

    def grades(self, z: ArrayLike) -> Float64:
        """Return graded descriptors at points.

        Parameters
        ----------
        z : (..., k) array_like

        Returns
        -------
        (..., d) float64
            How common each descriptor's value is in the library, in standard deviations;
            `optics.grades.names` are the descriptors.

        Raises
        ------
        ValueError
            If this space reads no descriptors.
        """
        self._reads()
        return self._ground.grades(np.asarray(z, np.float64))

    def _reads(self) -> None:
        """Raise ValueError if this space reads no descriptors."""
        if self.optics is None:
            raise ValueError(
                "space: expected one that reads descriptors, got straight traits alone"
            )

    def _raw(self, z: Float64) -> Float64:
        """Return raw scores (..., t) at points (..., k)."""
        raw: Float64 = z @ self.normals.T
        if self.optics is not None:
            raw = raw + self.grades(z) @ self.weights.T
        return raw

    def colours(self, z: ArrayLike) -> Float64:
        """Return the colours that a person sees at a point, as CIELAB.

        Parameters
        ----------
        z : (k,) array_like

        Returns
        -------
        (5, 3) array
            L*, a* and b* of each of `traitbrdf.space.scores.SURFACES`.

        Raises
        ------
        ValueError
            If this space reads no descriptors, or `z` is not k finite numbers.
        """
        self._reads()
        return self._ground.seen(self._point(z))

    def plausibility(self, z: ArrayLike) -> float:
        """Return the share of the library that lies in less likely places than a point.

        Likelihood is that of a mixture of Gaussians over the families (`Density`).

        Parameters
        ----------
        z : (k,) array_like

        Returns
        -------
        float in [0, 1]
            0 if the point is less likely than any member, or outside the gamut box.

        Raises
        ------
        ValueError
            If `z` is not k finite numbers.
        """
        point = self._point(z)
        outside = ((point < self.low - 1e-9) | (point > self.high + 1e-9)).any()
        return 0.0 if outside else self._common(point)

    def _common(self, z: Float64) -> float:
        """Return the `plausibility` of a point (k,) in the box."""
        if self.density is None:
            return 1.0
        return float(np.interp(self.density.log(z), self.density.known, _PERCENT))

    def explain(
        self, before: ArrayLike, after: ArrayLike, embedding: BRDFEmbedding | None = None
    ) -> Explanation:
        """Explain how two points differ, in words, numbers and a picture.

        Descriptors are measured on the decoded tables.

        Parameters
        ----------
        before, after : (k,) array_like
        embedding : BRDFEmbedding, optional
            Whose coordinates they are; the default one if left out.

        Raises
        ------
        ValueError
            If a point is not k finite numbers.

        Examples
        --------
        >>> from traitbrdf import default_library, default_traits
        >>> library, space = default_library(), default_traits()
        >>> z = library.coordinates[library.index("blue-plastic")]
        >>> told = space.explain(z, space.move(z, {"shiny": 0.5}))
        >>> [round(score, 2) for score in told.traits["shiny"]]
        [0.42, 0.92]
        """
        embedding = default_embedding() if embedding is None else embedding
        points = [self._point(before), self._point(after)]
        one, two = (embedding.decode(point) for point in points)
        first, second = (self.score(point) for point in points)
        was, now = descriptors(one), descriptors(two)
        return Explanation(
            {name: (first[name], second[name]) for name in self.names},
            {name: (was[name], now[name]) for name in was},
            (self.plausibility(points[0]), self.plausibility(points[1])),
            (one, two),
        )

    # -- moves ----------------------------------------------------------------------------------

    def holds(self, amounts: Mapping[str, float]) -> tuple[str, ...]:
        """Return what a move holds by default.

        This is "colour", unless the move changes a colour itself (`COLOURS`), and "lightness",
        unless it changes that (`LIGHT`).

        Parameters
        ----------
        amounts : mapping of float
            By trait, the change asked for.

        Raises
        ------
        ValueError
            On an unknown trait.
        """
        moved = {self.names[self.index(name)] for name in amounts}
        colour = () if moved & COLOURS else ("colour",)
        return colour if moved & LIGHT else (*colour, "lightness")

    def move(
        self,
        z: ArrayLike,
        amounts: Mapping[str, float],
        hold: Iterable[str] | None = None,
        photoreal: bool = True,
        method: Method = "flow",
    ) -> Float64:
        """Return coordinates whose scores differ from those of `z` by `amounts`.

        Parameters
        ----------
        z : (k,) array_like
        amounts : mapping of float
            By trait, how much its score shall change; 1 leads from typically low to typically high.
        hold : iterable of str, optional
            What shall stay. Names of traits hold their scores; "colour" holds the colour of all
            reflected light and of the body as a person sees it, "lightness" how light that is, and
            "body" the look of what lies below the highlight. Left out, it is what `holds` returns;
            () holds nothing.
        photoreal : bool
            Whether to stay where materials of the library are near.
        method : "flow" or "linear"
            "linear" moves along one straight vector as Matusik et al. 2003 do: the slope of the
            scores at `z` in the library's Mahalanobis distance. It holds traits only, and stops at
            the box only.

        Returns
        -------
        (k,) float64 inside the gamut box
            If the move cannot be made in full, the furthest point (`reach` says how far it is, and
            why). If all amounts are 0, `z` unchanged.

        Raises
        ------
        ValueError
            On an unknown trait, one named twice, an amount that is not finite, a trait both moved
            and held, or held traits that forbid the move altogether.
        TypeError
            On an amount that is no number.

        Examples
        --------
        >>> from traitbrdf import default_library, default_traits
        >>> library, space = default_library(), default_traits()
        >>> z = library.coordinates[library.index("oak-varnished")]
        >>> shinier = space.move(z, {"shiny": 0.5})
        >>> round(space.score(shinier)["shiny"] - space.score(z)["shiny"], 3)
        0.5
        """
        return self.moved(z, amounts, hold, photoreal, method).z

    def moved(
        self,
        z: ArrayLike,
        amounts: Mapping[str, float],
        hold: Iterable[str] | None = None,
        photoreal: bool = True,
        method: Method = "flow",
    ) -> Moved:
        """Make a move, with the errors of `move`, and return all about its outcome.

        Parameters
        ----------
        Other parameters as for `move`
        """
        found = self.reach(z, amounts, hold, photoreal, method)
        if found.stopped.startswith("held"):
            raise ValueError(
                f"cannot move {sorted(amounts)} while holding "
                f"{sorted(self.holds(amounts) if hold is None else _names(hold))}: these scores "
                f"depend on each other; hold fewer traits"
            )
        return found

    def reach(
        self,
        z: ArrayLike,
        amounts: Mapping[str, float],
        hold: Iterable[str] | None = None,
        photoreal: bool = True,
        method: Method = "flow",
    ) -> Moved:
        """Make a move, and return how far it came.

        Parameters
        ----------
        Other parameters as for `move`

        Returns
        -------
        Moved
            Where held traits forbid the move, `Moved.z` is the start and `Moved.stopped` says so.

        Raises
        ------
        ValueError, TypeError
            As `move`, but not for held traits that forbid the move.
        """
        start = self._point(z)
        moved, held, hold = self._checked(amounts, hold)
        if method not in ("flow", "linear"):
            raise ValueError(f"method: expected 'flow' or 'linear', got {method!r}")
        if all(value == 0.0 for value in moved.values()):
            return self._said(start.copy(), np.zeros(len(self.names)), moved, held)
        if method == "linear":
            end = self._straight(start, moved, held)
            change = self._ground.look(end)[0] - self._ground.look(start)[0]
            move = self._said(end, change, moved, held)
            missed = any(abs(move.asked[n] - move.reached[n]) > _NEAR for n in move.asked)
            return replace(move, stopped="a straight way ends elsewhere" if missed else "")
        whole = max(abs(value) for value in moved.values())
        with self._lock:
            inside = np.minimum(np.maximum(start, self.low), self.high)
            flow, room = self._flow(inside, moved, held, hold, photoreal)
            found = flow.to(whole)
            # a start outside the box has other scores than the point of the box where the move
            # begins
            outside = (inside != start).any()
            change = found.score - (self._ground.look(start)[0] if outside else flow.score)
            move = self._said(found.z, change, moved, held, found.walled)
            off = max(abs(move.asked[name] - move.reached[name]) for name in move.asked)
            if off <= _NEAR:
                return move
            return replace(move, stopped=self._reason(flow, whole, room, move, hold, photoreal))

    def path(
        self,
        z: ArrayLike,
        amounts: Mapping[str, float],
        hold: Iterable[str] | None = None,
        steps: int = 20,
        photoreal: bool = True,
    ) -> Float64:
        """Return the whole curve of a move, from `z` to where `move` ends.

        Parameters
        ----------
        steps : int
            Number of equal shares of the amounts, at least 1.
        Other parameters as for `move`

        Returns
        -------
        (steps + 1, k) float64

        Raises
        ------
        ValueError, TypeError
            As `move`, and on a number of steps that is not positive.

        Examples
        --------
        >>> from traitbrdf import default_library, default_traits
        >>> library, space = default_library(), default_traits()
        >>> z = library.coordinates[library.index("red-rubber")]
        >>> curve = space.path(z, {"shiny": 0.4}, steps=4)
        >>> (space.scores(curve)[:, space.index("shiny")] - space.score(z)["shiny"]).round(2)
        array([0. , 0.1, 0.2, 0.3, 0.4])
        """
        if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 1:
            raise ValueError(f"steps: expected a positive integer, got {steps!r}")
        shares = np.linspace(0.0, 1.0, int(steps) + 1)
        last = self.moved(z, amounts, hold, photoreal).z  # first, since it raises all errors
        points = [
            self.reach(z, {name: s * float(value) for name, value in amounts.items()}, hold,
                       photoreal).z
            for s in shares[:-1]
        ]  # fmt: skip
        return np.array([*points, last])

    def _checked(
        self, amounts: Mapping[str, float], hold: Iterable[str] | None
    ) -> tuple[dict[int, float], list[int], tuple[str, ...]]:
        """Return moved traits and their amounts, held traits, and all that is held."""
        moved: dict[int, float] = {}
        if not isinstance(amounts, Mapping):
            raise TypeError(f"amounts: expected numbers by trait, got {amounts!r}")
        for name, value in amounts.items():
            if (i := self.index(name)) in moved:
                raise ValueError(f"amounts: expected each trait once, got {self.names[i]!r} twice")
            moved[i] = _amount(name, value)
        hold = self.holds(amounts) if hold is None else _names(hold)
        stay = {name for h in hold for name in self.held(h)}
        clash = [self.names[i] for i in moved if self.names[i] in stay]
        if clash:
            raise ValueError(f"hold: {clash[0]!r} cannot be moved and held at once")
        held = list(dict.fromkeys(self.index(name) for name in hold if name not in GROUPS))
        return moved, held, hold

    def _flow(
        self,
        inside: Float64,
        moved: Mapping[int, float],
        held: list[int],
        hold: tuple[str, ...],
        photoreal: bool,
    ) -> tuple[Flow, float]:
        """Return the flow of a move from a point of the box, and how far its scores may go.

        A flow that was used lately is reused.
        """
        whole = max(abs(value) for value in moved.values())
        rates = {i: value / whole for i, value in moved.items()}
        key = (inside.tobytes(), tuple(rates.items()), tuple(held), hold, photoreal)
        if key in self._flows:
            self._flows.move_to_end(key)
        else:
            around = self._ground.around(inside)
            room = self._room(around.score, rates) if photoreal else _FAR
            task = self._task(around, rates, held, hold, photoreal)
            self._flows[key] = Flow(self._ground, task, inside, room, around), room
            if len(self._flows) > _KNOWN:
                self._flows.popitem(last=False)
        return self._flows[key]

    def _room(self, score: Float64, rates: Mapping[int, float]) -> float:
        """Return how far a move may go until a score (t,) passes the library's limits."""
        room = _FAR
        for i, rate in rates.items():
            if abs(rate) > 1e-9:
                limit = self.limits[i, 1 if rate > 0.0 else 0]
                room = min(room, max(0.0, (limit - score[i]) / rate))
        return float(room)

    def _task(
        self,
        around: Around,
        rates: Mapping[int, float],
        held: list[int],
        hold: tuple[str, ...],
        photoreal: bool,
    ) -> Task:
        """Describe a move from a point of the box."""
        known = np.abs(self.related[list(rates)])
        apart = np.setdiff1d(np.flatnonzero((known < RELATED).all(axis=0)), [*rates, *held])
        limits = np.full(3, math.inf)
        if photoreal:
            if self.optics is not None:
                limits[:2] = _HOLE, 0.0
            if self.density is not None:
                rare = float(np.interp(PLAUSIBLE, _PERCENT, self.density.known))
                limits[2] = unlikely(rare)
            # a start beyond a limit may stay as far beyond it
            limits = np.maximum(limits, around.walls)
        return Task(
            moved=np.array([*rates], np.int64),
            rates=np.array([*rates.values()]),
            held=np.array(held, np.int64),
            apart=apart.astype(np.int64),
            costs=held_costs([self.names[i] for i in rates], hold if self.optics else None),
            body=self.body if "body" in hold else self.body[:0],
            limits=limits,
        )

    def _reason(
        self,
        flow: Flow,
        whole: float,
        room: float,
        move: Moved,
        hold: tuple[str, ...],
        photoreal: bool,
    ) -> str:
        """Say why a move did not reach all that was asked for."""
        way = max(abs(value) for value in move.reached.values())
        many = len(move.asked) > 1 or any(name not in GROUPS for name in hold)
        if many and way < 1e-2 * min(whole, 1.0) and flow.why(0.0) & STEEP:
            return "held traits forbid it"
        if room < whole and way >= room - _NEAR:
            return "no material of the library goes further"
        why = flow.why(max(min(whole, flow.end) - 0.5 * STEP, 0.0))
        if why & WALLED:
            return f"the gamut{' of plausible materials' if photoreal else ''} ends here"
        if why & COLOURED:
            return "colour and lightness that stay leave no more"
        return "more would be a leap: the trait hardly depends on anything here"

    def _straight(self, start: Float64, moved: Mapping[int, float], held: list[int]) -> Float64:
        """Return the end (k,) of a straight move.

        It follows the slopes of the scores at the start, in the metric of moves.
        """
        inside = np.clip(start, self.low, self.high)
        slopes = self._ground.slopes(inside)[[*moved, *held]]
        along = np.linalg.solve(self._ground.stiffness, slopes.T)
        asked = np.array([*moved.values(), *([0.0] * len(held))])
        step = along @ np.linalg.lstsq(slopes @ along, asked, rcond=1e-9)[0]
        return np.asarray(np.clip(inside + step, self.low, self.high))

    def _said(
        self,
        z: Float64,
        change: Float64,
        moved: Mapping[int, float],
        held: list[int],
        walled: bool = False,
    ) -> Moved:
        """Describe a move to z (k,) that changes all scores by `change` (t,)."""
        made = change.tolist()
        return Moved(
            z,
            {self.names[i]: value for i, value in moved.items()},
            {self.names[i]: made[i] for i in moved},
            {self.names[i]: made[i] for i in held},
            self._common(np.minimum(np.maximum(z, self.low), self.high)),
            walled=walled,
        )

    def held(self, hold: str) -> tuple[str, ...]:
        """Return the traits that cannot be moved while something is held.

        Parameters
        ----------
        hold : str
            A trait, or one of `GROUPS`.

        Returns
        -------
        tuple of str

        Raises
        ------
        ValueError
            On an unknown name.
        """
        if hold in GROUPS:
            return ("red", "green", "blue") if hold in ("colour", "color") else ()
        return (self.names[self.index(hold)],)

    def _point(self, z: ArrayLike) -> Float64:
        value = numbers(z, "z").astype(np.float64)
        if value.shape != self.low.shape or not np.isfinite(value).all():
            raise ValueError(
                f"z: expected {len(self.low)} finite coordinates, got shape {value.shape}"
            )
        return value

    # -- traits of one's own ---------------------------------------------------------------------

    def with_trait(self, trait: Definition, library: Library | None = None) -> TraitSpace:
        """Return this space with one trait more; a trait of the same name is replaced.

        Moves of other traits stay as they are, to the bit.

        Parameters
        ----------
        trait : Definition
            A `traitbrdf.Trait`, for example.
        library : Library, optional
            Whose members say how traits are related, and how far they go; None is the default.

        Raises
        ------
        ValueError
            If the name is an everyday name of another trait, or shapes do not match.
        """
        if trait.name in self._synonyms:
            raise ValueError(
                f"name: {trait.name!r} is an everyday name of {self._synonyms[trait.name]!r}; "
                "expected another"
            )
        kept = [i for i, one in enumerate(self.traits) if one.name != trait.name]
        trait = replace(trait, meaning=trait.meaning or trait.name)
        traits = [*(self.traits[i] for i in kept), trait]
        statistics = Statistics(self.covariance, density=self.density)
        new = TraitSpace(traits, self.box, statistics, self.optics, self.body)
        z = (library or default_library()).coordinates
        related = with_one_more(self.related[np.ix_(kept, kept)], new._raw(z))
        limits = np.vstack([self.limits[kept], np.percentile(new.scores(z)[:, -1], _EXTREMES)])
        statistics = replace(statistics, related=related, limits=limits)
        return TraitSpace(traits, self.box, statistics, self.optics, self.body)

    # -- files ----------------------------------------------------------------------------------

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the state as plain arrays.

        The gamut box is not among them, since it belongs to the embedding.
        """
        state: dict[str, NDArray[Any]] = {
            "trait_names": np.array(self.names),
            "trait_normals": self.normals,
            "trait_typical": self.typical,
            "covariance": self.covariance,
            "body": self.body,
            "trait_weights": self.weights,
            "trait_related": self.related,
            "trait_limits": self.limits,
            "trait_meanings": np.array([trait.meaning for trait in self.traits]),
            "trait_synonyms": np.array(["|".join(trait.synonyms) for trait in self.traits]),
        }
        if self.optics is not None:
            state |= {f"reading_{k}": v for k, v in self.optics.readings._asdict().items()}
            state |= {f"grade_{k}": np.array(v) for k, v in self.optics.grades._asdict().items()}
        if self.density is not None:
            state |= {f"density_{k}": v for k, v in self.density._asdict().items()}
        return state

    @classmethod
    def from_arrays(cls, state: Mapping[str, NDArray[Any]]) -> TraitSpace:
        """Make a space from its arrays, the inverse of `arrays`.

        Parameters
        ----------
        state : mapping of arrays
            Those of `arrays`, and the box `low`, `high` of the embedding's arrays.
        """

        def group(kind: str, names: Iterable[str]) -> list[Any]:
            some = [np.asarray(state[f"{kind}_{name}"]) for name in names]
            return [v.astype(np.int64 if v.dtype.kind == "i" else np.float64) for v in some]

        optics = density = None
        if "reading_rows" in state:
            grade_names = tuple(str(name) for name in state["grade_names"])
            optics = Optics(
                Readings(*group("reading", Readings._fields)),
                Grades(grade_names, *group("grade", ("at", "grade"))),
            )
        if "density_means" in state:
            density = Density(*group("density", Density._fields))
        traits = [
            Definition(
                str(name), weights, normal, typical, str(meaning),
                tuple(str(others).split("|")) if str(others) else (),
            )
            for name, weights, normal, typical, meaning, others in zip(
                *(state[f"trait_{part}"] for part in _PARTS), strict=True
            )
        ]  # fmt: skip
        statistics = Statistics(
            state["covariance"], state["trait_related"], state["trait_limits"], density
        )
        return cls(traits, Box(state["low"], state["high"]), statistics, optics, state["body"])


def _names(hold: Iterable[str]) -> tuple[str, ...]:
    if not isinstance(hold, Iterable):
        raise TypeError(f"hold: expected names of traits, got {hold!r}")
    return (hold,) if isinstance(hold, str) else tuple(hold)


def _amount(name: str, value: float) -> float:
    return number(value, f"amount of {name!r}")


@functools.lru_cache(maxsize=1)
def default_traits() -> TraitSpace:
    """Load the traits that the package ships, once.

    They belong to `traitbrdf.default_embedding`.
    """
    return TraitSpace.from_arrays(artifact())
