"""Traits: directions in the embedding that mean something to a designer.

Arrays only; this module knows no BRDF. A trait is a linear score on coordinates, the normal of a
linear support vector machine between members of the library that have it and members that do not
(Matusik et al. 2003, who label members yes, no or unclear). Scores are scaled so that the 10th
percentile of the library has 0 and the 90th has 1.

A move changes scores by given amounts, holds others, and takes among all ways to do so the one
that is shortest measured by a covariance of the library: the one most like what real materials do.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.formats import artifact, unknown_name

Float64 = NDArray[np.float64]

KEEPS_BODY = ("shiny", "matte", "rough")
"""Traits of the highlight: their moves keep the body below it as long as that is possible."""

GROUPS = {"colour": ("red", "green", "blue"), "color": ("red", "green", "blue")}
"""Names that stand for several traits where traits are held."""

_BETWEEN = 0.05  # what differences between families count in the metric of moves

_RIDGE = 1e-3  # of the mean variance: keeps the metric regular where the library is flat


class TraitSpace:
    """Scores and moves of the traits of one embedding.

    Parameters
    ----------
    names : t trait names
    normals : (t, k) array
        Gradient of each raw score.
    typical : (t, 2) array
        Raw scores of the library's 10th and 90th percentile.
    covariance : (k, k) array
        How coordinates vary together: the metric in which moves are short.
    low, high : (k,) arrays, the gamut box
    body : (rows, k) array or None
        Linear functions of the coordinates that say how the body below the highlight looks; what
        "body" stands for where it is held, and what `KEEPS_BODY` traits keep while they can.
    """

    def __init__(
        self,
        names: Sequence[str],
        normals: ArrayLike,
        typical: ArrayLike,
        covariance: ArrayLike,
        low: ArrayLike,
        high: ArrayLike,
        body: ArrayLike | None = None,
    ) -> None:
        self.names = tuple(names)
        self.normals = np.asarray(normals, np.float64)
        self.typical = np.asarray(typical, np.float64)
        self.covariance = np.asarray(covariance, np.float64)
        self.low, self.high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        t, k = len(self.names), len(self.low)
        expected = {"normals": (t, k), "typical": (t, 2), "covariance": (k, k), "high": (k,)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                got = getattr(self, name).shape
                raise ValueError(f"{name}: expected shape {shape}, got {got}")
        span = self.typical[:, 1] - self.typical[:, 0]
        if not np.all(span > 0.0):
            raise ValueError("typical: expected the 90th percentile above the 10th for each trait")
        self.body = np.zeros((0, k)) if body is None else np.asarray(body, np.float64)
        if self.body.ndim != 2 or self.body.shape[1] != k or not np.isfinite(self.body).all():
            raise ValueError(f"body: expected shape (rows, {k}), got {self.body.shape}")
        self._gradient = self.normals / span[:, None]
        self._offset = -self.typical[:, 0] / span
        ridge = _RIDGE * np.trace(self.covariance) / k
        self._metric = self.covariance + ridge * np.eye(k)

    @classmethod
    def fit(
        cls,
        coordinates: ArrayLike,
        labels: Mapping[str, ArrayLike],
        low: ArrayLike,
        high: ArrayLike,
        families: Sequence[str] | None = None,
        body: ArrayLike | None = None,
    ) -> TraitSpace:
        """Trait vectors from labelled members.

        Parameters
        ----------
        coordinates : (n, k) array_like
        labels : for each trait (n,) values: 1 has it, -1 has it not, 0 unclear
        low, high : (k,) gamut box
        families : (n,) names or None
            Kinds of material. Moves then follow how members differ from others of their kind,
            and only a little how kinds differ: a shinier plastic is a plastic still, and no metal.
        body : (rows, k) or None, as for `TraitSpace`

        Raises
        ------
        ValueError
            If a trait's labels are of one class only, or of a wrong shape.
        """
        from sklearn.svm import SVC  # slow to import, and needed only here

        z = np.asarray(coordinates, np.float64)
        scale = np.maximum(z.std(axis=0), 1e-9)
        normals, typical = [], []
        for name, given in labels.items():
            label = np.asarray(given)
            if label.shape != (len(z),) or not np.isin(label, (-1, 0, 1)).all():
                raise ValueError(
                    f"labels of {name!r}: expected ({len(z)},) values of -1, 0 or 1, "
                    f"got shape {label.shape}"
                )
            clear = label != 0
            if len(np.unique(label[clear])) < 2:
                raise ValueError(f"labels of {name!r}: expected members with and without it")
            machine = SVC(kernel="linear", C=0.1).fit(z[clear] / scale, label[clear])
            normal = machine.coef_[0] / scale
            normals.append(normal)
            typical.append(np.percentile(z @ normal, [10.0, 90.0]))
        covariance = np.cov(z.T)
        if families is not None:
            kinds = np.asarray(families)
            if kinds.shape != (len(z),):
                raise ValueError(f"families: expected ({len(z)},) names, got {kinds.shape}")
            centred = z.copy()
            for kind in np.unique(kinds):
                centred[kinds == kind] -= z[kinds == kind].mean(axis=0)
            covariance = np.cov(centred.T) + _BETWEEN * covariance
        return cls(list(labels), normals, typical, covariance, low, high, body)

    def __repr__(self) -> str:
        return f"TraitSpace({', '.join(self.names)})"

    def index(self, name: str) -> int:
        """Where a trait stands in `names`; an unknown one raises ValueError naming near ones."""
        if name not in self.names:
            raise ValueError(unknown_name("trait", name, self.names))
        return self.names.index(name)

    def score(self, z: ArrayLike) -> dict[str, float]:
        """Every trait's score at coordinates (k,): 0 is typically low, 1 typically high."""
        values = self._gradient @ self._point(z) + self._offset
        return dict(zip(self.names, values.tolist(), strict=True))

    def move(self, z: ArrayLike, amounts: Mapping[str, float], hold: Iterable[str] = ()) -> Float64:
        """Coordinates (k,) whose scores differ from those of `z` by `amounts`.

        Parameters
        ----------
        z : (k,) array_like
        amounts : for each trait to move by how much; 1 is from typically low to typically high
        hold : traits whose scores shall stay; "colour" for red, green and blue together; "body"
            for the look of what lies below the highlight

        Returns
        -------
        (k,) array inside the gamut box. Where the box ends before the change is complete, the
        coordinates that can still move go on; where none can, the answer is the furthest point
        reached (its `score` says how far that is). Amounts of 0 return `z` as it is.

        Examples
        --------
        >>> from traitbrdf import default_library, default_traits
        >>> library, space = default_library(), default_traits()
        >>> z = library.coordinates[library.index("red-rubber")]
        >>> shinier = space.move(z, {"shiny": 0.5}, hold=("colour",))
        >>> round(space.score(shinier)["shiny"] - space.score(z)["shiny"], 6)
        0.5

        Raises
        ------
        ValueError
            On an unknown trait, an amount that is not finite, a trait both moved and held, or
            held traits that forbid the move altogether.
        """
        start = self._point(z)
        hold = (hold,) if isinstance(hold, str) else tuple(hold)
        moved = {self.index(name): _amount(name, value) for name, value in amounts.items()}
        held = self._held(hold)
        clash = [self.names[i] for i in moved if i in held]
        if clash:
            raise ValueError(f"hold: {clash[0]!r} cannot be moved and held at once")
        if all(value == 0.0 for value in moved.values()):
            return start.copy()
        targets = np.array(list(moved.values()))
        fixed = self._gradient[held]
        if "body" in hold:
            fixed = np.concatenate([fixed, self.body])
        a = np.concatenate([self._gradient[list(moved)], fixed])
        # the direction and how far to go along it, lest tiny or huge amounts lose all digits
        left = float(np.abs(targets).max())
        wanted = np.concatenate([targets / left, np.zeros(len(fixed))])
        if not _possible(self._metric, a, wanted):
            raise ValueError(
                f"cannot move {sorted(amounts)} while holding {sorted(hold)}: these scores depend "
                "on each other; hold fewer traits"
            )
        z = np.clip(start, self.low, self.high)
        if "body" not in hold and any(self.names[i] in KEEPS_BODY for i in moved):
            kept = np.concatenate([a, self.body])
            z, left = self._walk(z, left, kept, np.append(wanted, np.zeros(len(self.body))))
        return self._walk(z, left, a, wanted)[0]

    def _walk(self, z: Float64, left: float, a: Float64, wanted: Float64) -> tuple[Float64, float]:
        """Go `left` times the change `wanted`, along the shortest step of the coordinates that are
        not at a wall of the box; returns where that ends and what is left then."""
        free = np.ones(len(z), bool)
        while left > 0.0 and free.any():
            metric, rows = self._metric[np.ix_(free, free)], a[:, free]
            if not _possible(metric, rows, wanted):
                break  # the free coordinates alone cannot do what is asked
            step = np.zeros_like(z)
            step[free] = _step(metric, rows, wanted)
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                room = np.where(step > 0.0, (self.high - z) / step, (self.low - z) / step)
            room = np.where(step == 0.0, np.inf, np.maximum(room, 0.0))
            way = min(left, float(room.min()))
            z = np.clip(z + way * step, self.low, self.high)
            left -= way
            free &= room > way
        return z, left

    def _held(self, hold: tuple[str, ...]) -> list[int]:
        held: list[int] = []
        for name in hold:
            if name == "body":
                continue
            for member in GROUPS.get(name, (name,)):
                if self.index(member) not in held:
                    held.append(self.index(member))
        return held

    def _point(self, z: ArrayLike) -> Float64:
        value = np.asarray(z, np.float64)
        if value.shape != self.low.shape or not np.isfinite(value).all():
            raise ValueError(
                f"z: expected {len(self.low)} finite coordinates, got shape {value.shape}"
            )
        return value

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The state as plain arrays; the box belongs to the embedding."""
        return {
            "trait_names": np.array(self.names),
            "trait_normals": self.normals,
            "trait_typical": self.typical,
            "covariance": self.covariance,
            "body": self.body,
        }

    @classmethod
    def from_arrays(cls, state: Mapping[str, NDArray[Any]]) -> TraitSpace:
        """The inverse of `arrays`, with the box `low`, `high` of the embedding's arrays."""
        return cls(
            [str(n) for n in state["trait_names"]],
            state["trait_normals"],
            state["trait_typical"],
            state["covariance"],
            state["low"],
            state["high"],
            state["body"],
        )


def _step(metric: Float64, a: Float64, wanted: Float64) -> Float64:
    """The step of least metric length with a @ step = wanted (least squares where impossible)."""
    spread = metric @ a.T
    solution, *_ = np.linalg.lstsq(a @ spread, wanted, rcond=1e-9)
    return np.asarray(spread @ solution)


def _possible(metric: Float64, a: Float64, wanted: Float64) -> bool:
    """Whether a step with a @ step = wanted exists."""
    short = np.abs(a @ _step(metric, a, wanted) - wanted).max()
    return bool(short <= 1e-6 * np.abs(wanted).max())


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
