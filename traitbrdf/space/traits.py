"""Traits: directions in the embedding that mean something to a designer.

A trait is a smooth score on coordinates. The shipped ones grade physical descriptors
(`traitbrdf.reflectance.descriptors`) by how common their values are among the members of the
library, and add them up; they are had of the coordinates by the few cells that they read. Straight
traits are the normal of a linear support vector machine between members that have the trait and
members that do not, or the difference of their means (Matusik et al. 2003). Scores are scaled so
that the 10th percentile of the library has 0 and the 90th has 1.

A move changes scores by given amounts along a path, exactly, and holds others
(`traitbrdf.space.moves`). It ends where the library ends: at the wall of the box, or
where no member is near (`Density`).
"""

from __future__ import annotations

import functools
import math
import threading
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.formats.files import artifact, unknown_name
from traitbrdf.reflectance.descriptors import descriptors
from traitbrdf.space.definitions import Definition, Labelled, Statistics, as_labels, straight
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.explanation import Explanation
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

COLOURS = frozenset(("red", "green", "blue", "gold"))
"""Traits that are colours: their moves hold none unless told to."""

LIGHT = frozenset(("bright", "diffuse", "specular", "silver", "gold", "dusty", "ceramic"))
"""Traits that are about how light a thing is: their moves hold no lightness unless told to.

"bright" is lightness itself; "diffuse" and "specular" are amounts of reflected light; silver, gold
and ceramic are light, and dust is paler than what it lies on.
"""

PALING = frozenset(("dusty", "acrylic", "tint", "silver"))
"""Traits that say how saturated a thing is: where their moves hold colour, they hold its hue."""

STEERED = MappingProxyType({"gold": (75.0, 0.06, 0.42), "silver": (80.0, 0.0, 0.0)})
"""Traits that lead towards a colour: its L*, and its a* and b* for an L* + 16 of one. Gold's are
near those of its reflectance at normal incidence (Johnson & Christy 1972: 91, 0.02, 0.31), and
those of darker, warmer alloys."""

KEEPS_BODY = frozenset(("shiny", "glossy", "strength", "sharpness", "hard", "greasy", "plastic"))
"""Traits of the highlight: their moves keep the body below it as far as that is possible."""

GROUPS = ("colour", "color", "lightness", "body")
"""What can be held beside traits: the colour of all reflected light and of the body, how light
that is, and the look of the body below the highlight."""

Method = Literal["flow", "linear"]

RELATED = 0.5
"""Rank correlation in the library from which two traits are related: they move together."""

PLAUSIBLE = 0.002
"""The share of the library that is less plausible than any point that a move may reach."""

_EXTREMES = (1.0, 99.0)  # percentiles of the library that no photoreal move goes beyond
_BETWEEN = 0.05  # what differences between families count in the metric of moves
_RIDGE = 1e-3  # of the mean variance: keeps the metric regular where the library is flat
_NEAR = 2.5e-3  # of a score: what is as near as that is reached
_FAR = 20.0  # units: no move is longer
_PERCENT = np.linspace(0.0, 1.0, 101)
_KNOWN = 32  # moves whose way is kept, to go on from
_PARTS = ("names", "weights", "normals", "typical", "meanings", "synonyms")  # of definitions

# what it costs, beside the metric of moves, that what is held changes
_HUE = 3.0  # a degree
_CHROMA = 0.3  # a unit of a* or b*
_LIGHTNESS = 0.2  # a unit of L*
_LOBE = 300.0  # log RGB of the lobe
_HOLE = 0.12  # log f by which the middle of a highlight may be darker than what is around it


class TraitSpace:
    """Scores and moves of the traits of one embedding.

    Parameters
    ----------
    names : t trait names
    normals : (t, k) array
        Gradient of each raw score, or of its straight part.
    typical : (t, 2) array
        Raw scores of the library's 10th and 90th percentile.
    covariance : (k, k) array
        How coordinates vary together: the metric in which moves are short.
    low, high : (k,) arrays, the gamut box
    body : (rows, k) array or None
        Linear functions of the coordinates that say how the body below the highlight looks; what
        "body" stands for where it is held, and what `KEEPS_BODY` traits keep while they can.
    optics : Optics or None
        How grades of descriptors are had of coordinates.
    weights : (t, d) array or None, what a trait's score adds of the graded descriptors
    related : (t, t) array or None
        Rank correlations of the scores in the library; None takes all for related.
    density : Density or None, where the library is; None lets moves go as far as the box
    about : for each trait its meaning, and everyday names for it
    limits : (t, 2) array or None
        Scores that hardly any material of the library is below or above, beyond which no move
        leads that shall be photoreal.
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
        self.normals = _rows(self.traits, "normal", k)
        self.typical = _rows(self.traits, "typical", 2)
        self.weights = _rows(self.traits, "weights", d)
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
        """Traits from labelled members, and from graded descriptors where there are weights.

        Parameters
        ----------
        coordinates : (n, k) array_like
        traits : sequence of Labelled
        box : Box
        families : (n,) names or None
            Kinds of material. Moves then follow how members differ from others of their kind,
            and only a little how kinds differ: a shinier plastic is a plastic still, and no metal.
            They are also what `Density` is made of; None leaves it out.
        optics, body : as for `TraitSpace`
            A trait whose weights are not all zero is read off descriptors, others are straight.

        Raises
        ------
        ValueError
            If a trait's labels are of one class only, or of a wrong shape.
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
        statistics = replace(statistics, related=_rank_correlations(raw), limits=limits)
        return cls(scaled, box, statistics, optics, body)

    def __repr__(self) -> str:
        return f"TraitSpace({', '.join(self.names)})"

    def index(self, name: str) -> int:
        """Where a trait stands in `names`, by its name or an everyday one.

        Raises
        ------
        ValueError
            On an unknown one, naming near ones.
        """
        if name not in self._places:
            raise ValueError(unknown_name("trait", name, (*self.names, *self._synonyms)))
        return self._places[name]

    def meaning(self, name: str) -> str:
        """One line that says what a trait means."""
        trait = self.traits[self.index(name)]
        return trait.meaning or trait.name

    # -- scores ---------------------------------------------------------------------------------

    def score(self, z: ArrayLike) -> dict[str, float]:
        """Every trait's score at coordinates (k,): 0 is typically low, 1 typically high."""
        return dict(zip(self.names, self.scores(self._point(z)).tolist(), strict=True))

    def scores(self, z: ArrayLike) -> Float64:
        """Scores (..., t) at coordinates (..., k), in the order of `names`."""
        return (self._raw(np.asarray(z, np.float64)) - self.typical[:, 0]) / self._span

    def grades(self, z: ArrayLike) -> Float64:
        """Graded descriptors (..., d) at coordinates (..., k): how common in the library what is
        read there is, in standard deviations; `optics.grades.names` are their names."""
        self._reads()
        return self._ground.grades(np.asarray(z, np.float64))

    def _reads(self) -> None:
        """Raise ValueError unless descriptors are read."""
        if self.optics is None:
            raise ValueError(
                "space: expected one that reads descriptors, got straight traits alone"
            )

    def _raw(self, z: Float64) -> Float64:
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
        """The share of the library that lies in less likely places than z (k,): 0 is unheard of.

        By a mixture of Gaussians over the families (`Density`). A point outside the box has 0.
        """
        point = self._point(z)
        outside = ((point < self.low - 1e-9) | (point > self.high + 1e-9)).any()
        return 0.0 if outside else self._common(point)

    def _common(self, z: Float64) -> float:
        """`plausibility` of a point (k,) in the box."""
        if self.density is None:
            return 1.0
        return float(np.interp(self.density.log(z), self.density.known, _PERCENT))

    def explain(
        self, before: ArrayLike, after: ArrayLike, embedding: BRDFEmbedding | None = None
    ) -> Explanation:
        """What changed from one point (k,) to another, in words, numbers and a picture.

        Descriptors are read off the decoded tables.

        Parameters
        ----------
        embedding : whose coordinates they are; None is the default one

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
        """What a move holds unless told otherwise: "colour", but where it moves a colour itself
        (`COLOURS`), and "lightness", but where it is about that (`LIGHT`)."""
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
        """Coordinates (k,) whose scores differ from those of `z` by `amounts`.

        Parameters
        ----------
        z : (k,) array_like
        amounts : for each trait to move by how much; 1 is from typically low to typically high
        hold : what shall stay; None is what `holds` says, () is nothing
            Names of traits, whose scores stay; "colour", that of all reflected light and of the
            body as a person sees it; "lightness" of all reflected light; "body", the look of what
            lies below the highlight.
        photoreal : whether to stay where materials of the library are near
        method : "flow", or "linear", the straight vectors of Matusik et al. 2003
            "linear" goes along one direction, the trait's slope at `z` in the metric of the
            library, holds traits alone, and knows no walls but the box.

        Returns
        -------
        (k,) array inside the gamut box. Where less than all is reached, it is the furthest point
        (`reach` says how far that is, and why). Amounts of 0 return `z` as it is.

        Examples
        --------
        >>> from traitbrdf import default_library, default_traits
        >>> library, space = default_library(), default_traits()
        >>> z = library.coordinates[library.index("oak-varnished")]
        >>> shinier = space.move(z, {"shiny": 0.5})
        >>> round(space.score(shinier)["shiny"] - space.score(z)["shiny"], 3)
        0.5

        Raises
        ------
        ValueError
            On an unknown trait, one named twice, an amount that is not finite, a trait both moved
            and held, or held traits that forbid the move altogether.
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
        """`move`, with the same errors, and all that is to be said of it."""
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
        """`move`, and how far it came.

        Parameters, errors : as for `move`, but where held traits forbid the move, it stays where
        it is and `Moved.stopped` says so.
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
            # a start outside of the box has another score than where its way begins
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
        """The whole curve (steps + 1, k) of a move, from `z` to where `move` ends, at equal shares
        of the amounts.

        Other parameters, errors : as for `move`

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
        last = self.moved(z, amounts, hold, photoreal).z  # and all errors
        points = [
            self.reach(z, {name: s * float(value) for name, value in amounts.items()}, hold,
                       photoreal).z
            for s in shares[:-1]
        ]  # fmt: skip
        return np.array([*points, last])

    def _checked(
        self, amounts: Mapping[str, float], hold: Iterable[str] | None
    ) -> tuple[dict[int, float], list[int], tuple[str, ...]]:
        """The traits that move and by how much, those that are held, and all that is held."""
        moved: dict[int, float] = {}
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
        """The flow of a move from a point of the box, as far as it is known, and how far its scores
        may go."""
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
        """How far a move may go until a score (t,) leaves what the library has."""
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
        """The move from a point of the box."""
        known = np.abs(self.related[list(rates)])
        apart = np.setdiff1d(np.flatnonzero((known < RELATED).all(axis=0)), [*rates, *held])
        limits = np.full(3, math.inf)
        if photoreal:
            if self.optics is not None:
                limits[:2] = _HOLE, 0.0
            if self.density is not None:
                rare = float(np.interp(PLAUSIBLE, _PERCENT, self.density.known))
                limits[2] = unlikely(rare)
            # members at the rim may stay as unlikely as they are
            limits = np.maximum(limits, around.walls)
        names = {self.names[i] for i in rates}
        colour = float(self.optics is not None and ("colour" in hold or "color" in hold))
        bodily = float(self.optics is not None and "body" not in hold and bool(names & KEEPS_BODY))
        light = float(self.optics is not None and "lightness" in hold)
        paling = bool(names & PALING)
        steered = [name for name in names if name in STEERED] if len(names) == 1 else []
        # by surface: light at 10, 30 and 60 degrees, the body, and the body lit from the side
        hue = colour * _HUE * np.array([1.0, 1.0, 1.0, 1.0, 0.3])
        chroma = colour * (0.0 if paling else _CHROMA) * np.array([1.0, 1.0, 1.0, 0.1, 1.0])
        chroma += bodily * _CHROMA * np.array([0.0, 0.0, 0.0, 0.3, 0.0])
        lightness = light * _LIGHTNESS * np.array([1.0, 1.0, 1.0, 0.0, 0.3])
        lightness += bodily * _LIGHTNESS * np.array([0.0, 0.0, 0.0, 3.0, 0.0])
        return Task(
            moved=np.array([*rates], np.int64),
            rates=np.array([*rates.values()]),
            held=np.array(held, np.int64),
            apart=apart.astype(np.int64),
            hue=hue,
            chroma=chroma,
            light=lightness,
            steered=bool(steered),
            steer=np.array(STEERED[steered[0]] if steered else (0.0, 0.0, 0.0)),
            lobe=colour * _LOBE,
            together=_LIGHTNESS * float("bright" in names),
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
        """Why a move did not reach all that was asked for."""
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
        """The end (k,) of a straight move: along slopes at the start, in the metric of moves."""
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
        """What came of a move to z (k,), by which all scores (t,) change."""
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
        """The traits (by name) that cannot be moved while a name is held.

        Raises
        ------
        ValueError
            On an unknown name.
        """
        if hold in GROUPS:
            return ("red", "green", "blue") if hold in ("colour", "color") else ()
        return (self.names[self.index(hold)],)

    def _point(self, z: ArrayLike) -> Float64:
        value = np.asarray(z, np.float64)
        if value.shape != self.low.shape or not np.isfinite(value).all():
            raise ValueError(
                f"z: expected {len(self.low)} finite coordinates, got shape {value.shape}"
            )
        return value

    # -- traits of one's own ---------------------------------------------------------------------

    def with_trait(self, trait: Definition, library: Library | None = None) -> TraitSpace:
        """This space and one trait more, or another one in the place of one of the same name.

        Parameters
        ----------
        trait : Definition, as `traitbrdf.Trait`
        library : whose members say how traits are related; None is the default one
        """
        if trait.name in self._synonyms:
            raise ValueError(
                f"name: {trait.name!r} is an everyday name of {self._synonyms[trait.name]!r}; "
                "expected another"
            )
        traits = [one for one in self.traits if one.name != trait.name]
        traits.append(replace(trait, meaning=trait.meaning or trait.name))
        statistics = Statistics(self.covariance, density=self.density)
        new = TraitSpace(traits, self.box, statistics, self.optics, self.body)
        coordinates = (default_library() if library is None else library).coordinates
        statistics = replace(
            statistics,
            related=_rank_correlations(new._raw(coordinates)),
            limits=np.percentile(new.scores(coordinates), _EXTREMES, axis=0).T,
        )
        return TraitSpace(traits, self.box, statistics, self.optics, self.body)

    # -- files ----------------------------------------------------------------------------------

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The state as plain arrays; the box belongs to the embedding."""
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
        """The inverse of `arrays`, with the box `low`, `high` of the embedding's arrays."""

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


def _rows(traits: Sequence[Definition], part: str, size: int) -> Float64:
    """Stack a part (size,) of definitions (t,) to an array (t, size)."""
    rows = [np.asarray(getattr(trait, part), np.float64) for trait in traits]
    for trait, row in zip(traits, rows, strict=True):
        if row.shape != (size,):
            raise ValueError(f"{part} of {trait.name!r}: expected shape ({size},), got {row.shape}")
    return np.array(rows, np.float64).reshape(len(rows), size)


def _rank_correlations(raw: Float64) -> Float64:
    """Spearman's (t, t) of columns (n, t), ties shared."""
    # statistics take a while to load, and are needed here alone
    from scipy.stats import rankdata

    return np.atleast_2d(np.corrcoef(rankdata(raw, axis=0).T))


def _names(hold: Iterable[str]) -> tuple[str, ...]:
    return (hold,) if isinstance(hold, str) else tuple(hold)


def _amount(name: str, value: float) -> float:
    try:
        amount = float(value)
    except (TypeError, ValueError):
        raise TypeError(f"amount of {name!r}: expected a number, got {value!r}") from None
    if not math.isfinite(amount):
        raise ValueError(f"amount of {name!r}: expected a finite number, got {value!r}")
    return amount


@functools.lru_cache(maxsize=1)
def default_traits() -> TraitSpace:
    """The traits that the package ships, for `traitbrdf.default_embedding`."""
    return TraitSpace.from_arrays(artifact())
