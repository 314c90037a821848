"""Traits: directions in the embedding that mean something to a designer.

A trait is a smooth score on coordinates. The shipped ones grade physical descriptors
(`traitbrdf.descriptors`) by how common their values are among the members of the library, and add
them up; they are had of the coordinates by the few cells that they read. Straight traits are the
normal of a linear support vector machine between members that have the trait and members that do
not, or the difference of their means (Matusik et al. 2003). Scores are
scaled so that the 10th percentile of the library has 0 and the 90th has 1.

A move changes scores by given amounts along a path, exactly, and holds others. Among all ways to do
so it takes the one that is most like what real materials do (shortest by a covariance of the
library) and that changes other traits least. It ends where the library ends: at the wall of the
box, or where no member is near (`Density`).
"""

from __future__ import annotations

import functools
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from traitbrdf.descriptors import (
    DESCRIPTORS,
    LUMINANCE,
    PROFILE,
    READINGS,
    describe_columns,
    descriptors,
)
from traitbrdf.embedding import (
    FLOOR,
    BRDFEmbedding,
    Library,
    default_embedding,
    default_library,
)
from traitbrdf.formats import artifact, unknown_name

if TYPE_CHECKING:
    from traitbrdf.brdf import TabulatedBRDF
    from traitbrdf.lights import EnvironmentMap

Float64 = NDArray[np.float64]

KEEPS_BODY = frozenset(
    ("shiny", "glossy", "matte", "strength", "sharpness", "hard", "soft", "rough", "greasy")
)
"""Traits of the highlight: their moves keep the body below it as far as that is possible."""

COLOURFUL = frozenset(("red", "green", "blue", "tint", "gold", "silver", "dusty", "acrylic"))
"""Traits that are of colour: moves of others keep the hues of body and lobe as far as they can."""

GROUPS = {"colour": ("red", "green", "blue"), "color": ("red", "green", "blue")}
"""Names that stand for several traits where traits are held; with them goes the hue of the body
and of the lobe."""

RELATED = 0.5
"""Rank correlation in the library from which two traits are related: they move together."""

PLAUSIBLE = 0.01
"""The share of the library that is less plausible than any point that a move may reach."""

_EXTREMES = (1.0, 99.0)  # percentiles of the library that no photoreal move goes beyond
_BETWEEN = 0.05  # what differences between families count in the metric of moves
_RIDGE = 1e-3  # of the mean variance: keeps the metric regular where the library is flat
_STEP = 0.5  # in scores: how far a move goes before it looks again
_EXACT = 1e-5  # how near a score is brought
_NEAR = 2e-3  # how near is near enough where a score has a kink
_APART = 10.0  # what a change of unrelated scores costs, beside the metric
_BODY = 30.0  # what a change of the body costs, where it is kept
_HUE = 10.0  # what a unit of a* or b* costs, where colour is held
_HOLE = 0.05  # log f by which the middle of a highlight may be darker than what is around it
_TURN = 1.5  # degrees that hues may turn then


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
        """log density at z (k,) and its gradient."""
        away = np.matmul(self.whiten, (z - self.means)[:, :, None])[:, :, 0]
        each = self.logs - 0.5 * np.sum(away * away, axis=1)
        top = float(each.max())
        share = np.exp(each - top)
        total = float(share.sum())
        pull = np.matmul(away[:, None, :], self.whiten)[:, 0]
        return top + math.log(total), -(share @ pull) / total


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
        used = np.array([_ORDER[name] for name in self.names])
        flat = np.ascontiguousarray(descriptors.reshape(-1, descriptors.shape[-1]))
        found = _interpolated(flat, used, self.at, self.grade)
        return np.asarray(found).reshape(*descriptors.shape[:-1], len(used))


_ORDER = {name: i for i, name in enumerate(DESCRIPTORS)}


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


_FIRST = READINGS.index("profile 0")
_HIGHLIGHT = sum(theta <= 30.0 for theta in PROFILE)
"""Readings of the highlight, within which decoding leaves no hole (`traitbrdf.profiles`)."""


class Readings(NamedTuple):
    """What `descriptors.READINGS` need of an embedding: few cells.

    Parameters
    ----------
    rows, mean : (3, cells, k) and (cells,), log(f + FLOOR) of a channel: rows @ z + mean
    weights : (readings, cells)
    """

    rows: Float64
    mean: Float64
    weights: Float64

    def at(self, z: Float64) -> Float64:
        """Readings (..., readings, 3) at z (..., k), as decoding mends them."""
        points = np.ascontiguousarray(z, np.float64).reshape(-1, z.shape[-1])
        found = [self.near(point, False).readings for point in points]
        return np.reshape(found, (*z.shape[:-1], len(self.weights), 3))

    def near(self, z: Float64, sloped: bool = True) -> Near:
        """All that a move asks of a point z (k,)."""
        return Near(*_near(z, self.rows, self.mean, self.weights, sloped))


class Near(NamedTuple):
    """Readings (readings, 3) at a point and their slopes (readings, 3, k); by how much (log f) the
    middle of the highlight is darker there than what is around it, before decoding mends it, and
    its slope (k,)."""

    readings: Float64
    slopes: Float64
    hole: float
    inward: Float64


@numba.njit(cache=True, nogil=True)
def _near(z: Any, rows: Any, mean: Any, weights: Any, sloped: Any) -> Any:
    """`Near` of a point; slopes are 0 if they are not wanted."""
    count, cells = weights.shape
    value, slopes = np.zeros((count, 3)), np.zeros((count, 3, len(z)))
    raised = np.empty((3, cells))
    for c in range(3):
        for n in range(cells):
            log = mean[n]
            for k in range(len(z)):
                log += rows[c, n, k] * z[k]
            raised[c, n] = math.exp(min(log, 30.0))
    for i in range(count):
        for n in range(cells):
            weight = weights[i, n]
            if weight != 0.0:
                for c in range(3):
                    value[i, c] += weight * max(raised[c, n] - FLOOR, 0.0)
                    if sloped:
                        for k in range(len(z)):
                            slopes[i, c, k] += weight * raised[c, n] * rows[c, n, k]
    top, most = _FIRST, -1.0
    for i in range(_FIRST, count):
        light = 0.0
        for c in range(3):
            light += LUMINANCE[c] * value[i, c]
        if light > most:
            top, most = i, light
    middle = 0.0
    for c in range(3):
        middle += LUMINANCE[c] * value[_FIRST, c]
    hole = math.log((most + FLOOR) / (middle + FLOOR))
    inward = np.zeros(len(z))
    for c in range(3):
        inward += LUMINANCE[c] * (slopes[top, c] / (most + FLOOR))
        inward -= LUMINANCE[c] * (slopes[_FIRST, c] / (middle + FLOOR))
    # no hole in the highlight: as high as what follows, of which it then has the slope too
    for i in range(_FIRST + _HIGHLIGHT - 2, _FIRST - 1, -1):
        for c in range(3):
            if value[i, c] < value[i + 1, c]:
                value[i, c] = value[i + 1, c]
                slopes[i, c] = slopes[i + 1, c]
    brightest = np.argmax(value[0])
    whole = value[0, brightest]
    if whole > 1.0:  # no more light than there was
        by = slopes[0, brightest] / whole
        for i in range(count):
            for c in range(3):
                slopes[i, c] = (slopes[i, c] - value[i, c] * by) / whole
                value[i, c] /= whole
    return value, slopes, hole, inward


class Optics(NamedTuple):
    """What lets scores be read off descriptors: where they are read, and how they are graded."""

    readings: Readings
    grades: Grades


@dataclass(frozen=True)
class Move:
    """What a move came to.

    Attributes
    ----------
    z : (k,) array
    asked, reached : by trait, the change asked for and the change made
    held : by held trait, how much it changed nevertheless
    plausibility : as `TraitSpace.plausibility` of `z`
    stopped : "" if all was reached, else why not
    """

    z: Float64
    asked: Mapping[str, float]
    reached: Mapping[str, float]
    held: Mapping[str, float]
    plausibility: float
    stopped: str = ""

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


@dataclass(frozen=True)
class Explanation:
    """What makes two materials differ, in numbers, words and a picture.

    Attributes
    ----------
    traits : by trait, its score before and after
    descriptors : by descriptor (`traitbrdf.descriptors.DESCRIPTORS`), its value before and after
    plausibility : before and after
    tables : the materials themselves
    """

    traits: Mapping[str, tuple[float, float]]
    descriptors: Mapping[str, tuple[float, float]]
    plausibility: tuple[float, float]
    tables: tuple[TabulatedBRDF, TabulatedBRDF]

    def __str__(self) -> str:
        change = {name: after - before for name, (before, after) in self.traits.items()}
        most = sorted(change, key=lambda name: -abs(change[name]))
        said = [f"{name} {change[name]:+.2f}" for name in most if abs(change[name]) >= 0.05]
        lines = ["traits: " + (", ".join(said[:8]) or "none changed by 0.05")]
        d = self.descriptors
        degrees = [math.degrees(math.exp(value)) for value in d["width"]]
        for what, (before, after), unit in (
            ("gloss at 60 degrees", d["gloss_60"], " GU"),
            ("half width of the lobe", (degrees[0], degrees[1]), " degrees"),
            ("specular albedo", d["specular"], ""),
            ("diffuse albedo", d["diffuse"], ""),
        ):
            lines.append(f"{what}: {before:.3g} to {after:.3g}{unit}")
        for kind in ("diffuse", "specular"):
            hues, chromas = d[f"{kind}_hue"], d[f"{kind}_chroma"]
            if max(chromas) >= _PALE:
                lines.append(
                    f"{kind} hue: {hues[0]:.0f} to {hues[1]:.0f} degrees, "
                    f"chroma {chromas[0]:.0f} to {chromas[1]:.0f}"
                )
        before, after = self.plausibility
        lines.append(f"plausibility: {before:.2f} to {after:.2f}")
        return "\n".join(lines)

    def picture(
        self, environment: EnvironmentMap | None = None, size: int = 192
    ) -> NDArray[np.uint8]:
        """Spheres of both side by side (H, W, 3), sRGB bytes; None is the procedural sky."""
        from traitbrdf.gallery import sheet  # torch comes with it

        return sheet({"": self.tables}, ("before", "after"), environment, size)

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        Image.fromarray(self.picture()).save(file, "png")
        return file.getvalue()


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
        names: Sequence[str],
        normals: ArrayLike,
        typical: ArrayLike,
        covariance: ArrayLike,
        low: ArrayLike,
        high: ArrayLike,
        body: ArrayLike | None = None,
        optics: Optics | None = None,
        weights: ArrayLike | None = None,
        related: ArrayLike | None = None,
        density: Density | None = None,
        about: Mapping[str, tuple[str, tuple[str, ...]]] | None = None,
        limits: ArrayLike | None = None,
    ) -> None:
        self.names = tuple(names)
        self.normals = np.asarray(normals, np.float64)
        self.typical = np.asarray(typical, np.float64)
        self.covariance = np.asarray(covariance, np.float64)
        self.low, self.high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        t, k = len(self.names), len(self.low)
        self.optics = optics
        d = len(optics.grades.names) if optics else 0
        self.weights = np.zeros((t, d)) if weights is None else np.asarray(weights, np.float64)
        self.related = np.ones((t, t)) if related is None else np.asarray(related, np.float64)
        self.density = density
        self.about = dict(about or {})
        unlimited = np.tile([-math.inf, math.inf], (t, 1))
        self.limits = unlimited if limits is None else np.asarray(limits, np.float64)
        expected = {
            "normals": (t, k), "typical": (t, 2), "covariance": (k, k), "high": (k,),
            "weights": (t, d), "related": (t, t), "limits": (t, 2),
        }  # fmt: skip
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
        self._synonyms = {
            other: name for name, (_, others) in self.about.items() for other in others
        }
        metric = self.covariance + _RIDGE * np.trace(self.covariance) / k * np.eye(k)
        self._stiffness = np.linalg.inv(metric)

    @classmethod
    def fit(
        cls,
        coordinates: ArrayLike,
        labels: Mapping[str, ArrayLike],
        low: ArrayLike,
        high: ArrayLike,
        families: Sequence[str] | None = None,
        body: ArrayLike | None = None,
        optics: Optics | None = None,
        weights: ArrayLike | None = None,
        about: Mapping[str, tuple[str, tuple[str, ...]]] | None = None,
    ) -> TraitSpace:
        """Traits from labelled members, and from graded descriptors where there are weights.

        Parameters
        ----------
        coordinates : (n, k) array_like
        labels : for each trait (n,) values: 1 has it, -1 has it not, 0 unclear
        low, high : (k,) gamut box
        families : (n,) names or None
            Kinds of material. Moves then follow how members differ from others of their kind,
            and only a little how kinds differ: a shinier plastic is a plastic still, and no metal.
            They are also what `Density` is made of; None leaves it out.
        body, optics, weights, about : as for `TraitSpace`
            A trait whose weights are not all zero is read off descriptors, others are straight.

        Raises
        ------
        ValueError
            If a trait's labels are of one class only, or of a wrong shape.
        """
        z = np.asarray(coordinates, np.float64)
        normals = np.array([straight(z, given, name) for name, given in labels.items()])
        if weights is not None:
            normals[np.any(np.asarray(weights) != 0.0, axis=1)] = 0.0
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
        unscaled = np.tile([0.0, 1.0], (len(normals), 1))
        space = cls(
            list(labels), normals, unscaled, covariance, low, high, body, optics, weights,
            None, density, about,
        )  # fmt: skip
        raw = space._raw(z)
        typical = np.percentile(raw, [10.0, 90.0], axis=0).T
        limits = np.percentile(raw, _EXTREMES, axis=0).T - typical[:, :1]
        limits /= np.maximum(typical[:, 1:] - typical[:, :1], 1e-300)
        return cls(
            list(labels), normals, typical, covariance, low, high, body, optics, weights,
            _rank_correlations(raw), density, about, limits,
        )  # fmt: skip

    def __repr__(self) -> str:
        return f"TraitSpace({', '.join(self.names)})"

    def index(self, name: str) -> int:
        """Where a trait stands in `names`, by its name or an everyday one.

        Raises
        ------
        ValueError
            On an unknown one, naming near ones.
        """
        known = self._synonyms.get(name, name)
        if known not in self.names:
            raise ValueError(unknown_name("trait", name, (*self.names, *self._synonyms)))
        return self.names.index(known)

    def meaning(self, name: str) -> str:
        """One line that says what a trait means."""
        known = self.names[self.index(name)]
        return self.about[known][0] if known in self.about else known

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
        if self.optics is None:
            raise ValueError(
                "space: expected one that reads descriptors, got straight traits alone"
            )
        readings = self.optics.readings.at(np.asarray(z, np.float64))
        return self.optics.grades.of(describe_columns(readings))

    def _raw(self, z: Float64) -> Float64:
        raw: Float64 = z @ self.normals.T
        if self.optics is not None:
            raw = raw + self._graded(describe_columns(self.optics.readings.at(z)))
        return raw

    def _graded(self, columns: Float64) -> Float64:
        """What descriptors (..., n) add to raw scores (..., t)."""
        assert self.optics is not None
        added: Float64 = self.optics.grades.of(columns) @ self.weights.T
        return added

    def _read(self, z: Float64) -> tuple[Float64, Float64, float]:
        """Scores (t,) at z (k,), descriptors (n,) and `Near.hole`, 0 and none without optics."""
        raw, columns, hole = self.normals @ z, np.zeros(0), 0.0
        if self.optics is not None:
            near = self.optics.readings.near(z, False)
            columns, hole = describe_columns(near.readings), near.hole
            raw = raw + self._graded(columns)
        return (raw - self.typical[:, 0]) / self._span, columns, hole

    def _sloped(self, z: Float64) -> tuple[Float64, Float64, Float64, float, Float64]:
        """Scores (t,) at z (k,), their gradients (t, k), descriptors (k + 1, n) at z and one small
        step (`_SMALL`) along each coordinate, and `Near.hole` and `Near.inward`."""
        raw, slopes, columns = self.normals @ z, self.normals, np.zeros((len(z) + 1, 0))
        hole, inward = 0.0, np.zeros(len(z))
        if self.optics is not None:
            readings, by_z, hole, inward = self.optics.readings.near(z)
            # formulas of a few numbers: cheaper once more than their slopes
            steps = readings + _SMALL * np.moveaxis(by_z, -1, 0)
            columns = describe_columns(np.concatenate([readings[None], steps]))
            added = self._graded(columns)
            raw = raw + added[0]
            slopes = slopes + (added[1:] - added[0]).T / _SMALL
        score = (raw - self.typical[:, 0]) / self._span
        return score, slopes / self._span[:, None], columns, hole, inward

    def plausibility(self, z: ArrayLike) -> float:
        """The share of the library that lies in less likely places than z (k,): 0 is unheard of.

        By a mixture of Gaussians over the families (`Density`). A point outside the box has 0.
        """
        point = self._point(z)
        outside = np.any((point < self.low - 1e-9) | (point > self.high + 1e-9))
        if self.density is None or outside:
            return 0.0 if outside else 1.0
        share = np.interp(self.density.log(point), self.density.known, np.linspace(0.0, 1.0, 101))
        return float(share)

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
        >>> z = library.coordinates[library.index("red-rubber")]
        >>> told = space.explain(z, space.move(z, {"shiny": 0.5}))
        >>> [round(score, 2) for score in told.traits["shiny"]]
        [0.11, 0.61]
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

    def move(
        self,
        z: ArrayLike,
        amounts: Mapping[str, float],
        hold: Iterable[str] = (),
        photoreal: bool = True,
    ) -> Float64:
        """Coordinates (k,) whose scores differ from those of `z` by `amounts`.

        Parameters
        ----------
        z : (k,) array_like
        amounts : for each trait to move by how much; 1 is from typically low to typically high
        hold : traits whose scores shall stay; "colour" for red, green and blue together, and the
            hues of body and lobe; "body" for the look of what lies below the highlight
        photoreal : whether to stay where materials of the library are near

        Returns
        -------
        (k,) array inside the gamut box. Where the gamut ends before the change is complete, it is
        the furthest point reached (`reach` says how far that is, and why). Amounts of 0 return `z`
        as it is.

        Examples
        --------
        >>> from traitbrdf import default_library, default_traits
        >>> library, space = default_library(), default_traits()
        >>> z = library.coordinates[library.index("red-rubber")]
        >>> shinier = space.move(z, {"shiny": 0.5}, hold=("colour",))
        >>> round(space.score(shinier)["shiny"] - space.score(z)["shiny"], 4)
        0.5

        Raises
        ------
        ValueError
            On an unknown trait, an amount that is not finite, a trait both moved and held, or
            held traits that forbid the move altogether; the message says what can be reached.
        """
        return self.moved(z, amounts, hold, photoreal).z

    def moved(
        self,
        z: ArrayLike,
        amounts: Mapping[str, float],
        hold: Iterable[str] = (),
        photoreal: bool = True,
    ) -> Move:
        """`move`, with the same errors, and all that is to be said of it."""
        found = self.reach(z, amounts, hold, photoreal)
        if found.stopped.startswith("held"):
            raise ValueError(
                f"cannot move {sorted(amounts)} while holding {sorted(_names(hold))}: these scores "
                f"depend on each other; hold fewer traits. Nearest: {found}"
            )
        return found

    def reach(
        self,
        z: ArrayLike,
        amounts: Mapping[str, float],
        hold: Iterable[str] = (),
        photoreal: bool = True,
    ) -> Move:
        """`move`, and how far it came.

        Parameters, errors : as for `move`, but where held traits forbid the move, what comes
        nearest is returned: all scores give way alike.
        """
        start = self._point(z)
        moved = {self.index(name): _amount(name, value) for name, value in amounts.items()}
        hold = _names(hold)
        held = self._held(hold)
        clash = [self.names[i] for i in moved if i in held]
        if clash:
            raise ValueError(f"hold: {clash[0]!r} cannot be moved and held at once")
        if all(value == 0.0 for value in moved.values()):
            return self._said(start, start.copy(), moved, held, "")
        task = self._task(start, moved, held, hold, photoreal)
        whole = max(abs(value) for value in moved.values())
        at, way = np.clip(start, self.low, self.high), 0.0
        room = self._room(at, moved) if photoreal else whole
        end = min(whole, room)
        # first all that had better stay does; where that ends, less and less of it
        for more in task.relaxed():
            stride, least = (_STEP, 0.2 * _STEP) if more.strict else (0.5 * _STEP, 0.05 * _STEP)
            while way < end and stride > least:
                goal = min(way + stride, end)
                step = more.towards(at, goal, goal == end)
                if step is None:
                    stride *= 0.25 if more.strict else 0.5
                else:
                    at, way, stride = step, goal, min(2.0 * stride, _STEP)
            if 0.0 < way < end:  # a step on the way is not as exact as the last
                exact = more.towards(at, way, True)
                at = at if exact is None else exact
        stopped = ""
        if way < whole:
            kind = "gamut of plausible materials" if photoreal else "gamut"
            stopped = f"the {kind} ends here"
            if way >= end:
                stopped = "no material of the library goes further"
            elif way < 1e-3 * min(whole, 1.0) and not task.possible(at):
                stopped = "held traits forbid it"
                at = task.compromise(at, min(_STEP, whole))
        return self._said(start, at, moved, held, stopped)

    def _room(self, z: Float64, moved: Mapping[int, float]) -> float:
        """How far a move may go until a score leaves what the library has."""
        whole = max(abs(value) for value in moved.values())
        score, room = self.scores(z), math.inf
        for i, value in moved.items():
            rate = value / whole
            if abs(rate) > 1e-9:
                limit = self.limits[i, 1 if value > 0.0 else 0]
                room = min(room, max(0.0, (limit - score[i]) / rate))
        return float(room)

    def _task(
        self,
        start: Float64,
        moved: Mapping[int, float],
        held: list[int],
        hold: tuple[str, ...],
        photoreal: bool,
    ) -> _Task:
        whole = max(abs(value) for value in moved.values())
        fixed = [*moved, *held]
        rates = np.array([*(value / whole for value in moved.values()), *([0.0] * len(held))])
        known = np.abs(self.related[list(moved)])
        apart = np.flatnonzero((known < RELATED).all(axis=0))
        soft = np.setdiff1d(apart, fixed)
        inside = np.clip(start, self.low, self.high)
        hard_body = self.body if "body" in hold else self.body[:0]
        keeps = "body" not in hold and any(self.names[i] in KEEPS_BODY for i in moved)
        kept = self.body if keeps else self.body[:0]
        least = -math.inf
        if photoreal and self.density is not None:
            limit = float(np.interp(PLAUSIBLE, np.linspace(0.0, 1.0, 101), self.density.known))
            # members at the rim may stay as unlikely as they are
            least = min(limit, self.density.log(inside))
        coloured = any(self.names[i] in COLOURFUL for i in moved)
        strictly = "colour" in hold or "color" in hold
        score, columns, pit = self._read(inside)
        hole = max(_HOLE, pit) if photoreal and self.optics is not None else math.inf
        hues = None
        if self.optics is not None and (strictly or not coloured):
            hues = _Hues(_chroma(columns)[0])
        return _Task(
            self, fixed, rates, score[fixed], soft, score[soft],
            hard_body, hard_body @ inside, kept, kept @ inside,
            hues, least, strictly_hued=strictly, hole=hole,
        )  # fmt: skip

    def _said(
        self, start: Float64, z: Float64, moved: Mapping[int, float], held: list[int], stopped: str
    ) -> Move:
        change = self.scores(z) - self.scores(start)
        return Move(
            z,
            {self.names[i]: value for i, value in moved.items()},
            {self.names[i]: float(change[i]) for i in moved},
            {self.names[i]: float(change[i]) for i in held},
            self.plausibility(np.clip(z, self.low, self.high)),
            stopped,
        )

    def members(self, hold: str) -> list[int]:
        """The traits, by their place, that a name stands for where it is held."""
        return [] if hold == "body" else [self.index(name) for name in GROUPS.get(hold, (hold,))]

    def _held(self, hold: tuple[str, ...]) -> list[int]:
        return list(dict.fromkeys(i for name in hold for i in self.members(name)))

    def _point(self, z: ArrayLike) -> Float64:
        value = np.asarray(z, np.float64)
        if value.shape != self.low.shape or not np.isfinite(value).all():
            raise ValueError(
                f"z: expected {len(self.low)} finite coordinates, got shape {value.shape}"
            )
        return value

    # -- traits of one's own ---------------------------------------------------------------------

    def with_trait(self, trait: Trait, library: Library | None = None) -> TraitSpace:
        """This space and one trait more, or another one in the place of one of the same name.

        Parameters
        ----------
        trait : Trait
        library : whose members say how traits are related; None is the default one
        """
        kept = [i for i, name in enumerate(self.names) if name != trait.name]
        names = [*(self.names[i] for i in kept), trait.name]
        if trait.name in self._synonyms:
            raise ValueError(
                f"name: {trait.name!r} is an everyday name of {self._synonyms[trait.name]!r}; "
                "expected another"
            )
        about = {**self.about, trait.name: (trait.meaning or trait.name, ())}
        new = TraitSpace(
            names, np.vstack([self.normals[kept], trait.normal]),
            np.vstack([self.typical[kept], trait.typical]), self.covariance, self.low, self.high,
            self.body, self.optics, np.vstack([self.weights[kept], trait.weights]),
            None, self.density, about,
        )  # fmt: skip
        coordinates = (default_library() if library is None else library).coordinates
        new.related = _rank_correlations(new._raw(coordinates))
        new.limits = np.percentile(new.scores(coordinates), _EXTREMES, axis=0).T
        return new

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
            "trait_meanings": np.array([self.about.get(n, ("",))[0] for n in self.names]),
            "trait_synonyms": np.array(
                ["|".join(self.about[n][1]) if n in self.about else "" for n in self.names]
            ),
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

        def group(kind: str, names: Iterable[str]) -> list[Float64]:
            return [np.asarray(state[f"{kind}_{name}"], np.float64) for name in names]

        optics = density = None
        if "reading_rows" in state:
            grade_names = tuple(str(name) for name in state["grade_names"])
            optics = Optics(
                Readings(*group("reading", Readings._fields)),
                Grades(grade_names, *group("grade", ("at", "grade"))),
            )
        if "density_means" in state:
            density = Density(*group("density", Density._fields))
        names = [str(n) for n in state["trait_names"]]
        about = {
            name: (str(meaning), tuple(str(others).split("|")) if str(others) else ())
            for name, meaning, others in zip(
                names, state["trait_meanings"], state["trait_synonyms"], strict=True
            )
            if str(meaning)
        }
        return cls(
            names, state["trait_normals"], state["trait_typical"], state["covariance"],
            state["low"], state["high"], state["body"], optics, state["trait_weights"],
            state["trait_related"], density, about, state["trait_limits"],
        )  # fmt: skip


class _Slopes(NamedTuple):
    """Around a point: gradients of scores (t, k), of colours (4, k) and of the hole (k,), and the
    stiffness (k, k) of what had better stay."""

    scores: Float64
    hues: Float64
    stiff: Float64
    inward: Float64


class _Hues(NamedTuple):
    """The hues that a move keeps, of body and lobe; what has none keeps its chroma.

    Parameters
    ----------
    kept : (2, 2) a* and b* of the body and of the lobe
    """

    kept: Float64

    def turned(self, colours: Float64, sure: Float64) -> Float64:
        """Of `_chroma` what shall stay 0 (..., 4): a* and b* across the kept hue, and along it for
        what is pale."""
        chroma = np.hypot(self.kept[:, 0], self.kept[:, 1])
        along = self.kept / np.maximum(chroma, 1e-9)[:, None]
        beside = colours[..., 1] * along[:, 0] - colours[..., 0] * along[:, 1]
        ahead = np.sum(colours * along, axis=-1) - chroma
        pale = np.clip(1.0 - chroma / (2.0 * _PALE), 0.0, 1.0)
        # a colour that fades stops short of turning into its opposite
        faded = np.minimum(ahead + 0.6 * chroma, 0.0)
        return np.concatenate([sure * beside, sure * (pale * ahead + faded)], axis=-1)

    def off(self, colours: Float64, sure: Float64) -> float:
        """Of `_chroma`, by how many degrees hues are off, as far as there are hues."""
        now, then = (c[..., 0] + 1j * c[..., 1] for c in (colours, self.kept))
        seen = np.minimum(np.minimum(np.abs(now), np.abs(then)) / _PALE, 1.0)
        return float((np.degrees(np.abs(np.angle(then * now.conj()))) * seen * sure).max())


_SMALL = 1e-5
_PALE = 5.0  # C*ab: paler colours have no hue to speak of
_DARK = 0.006  # albedo of a body or lobe that has none either


def _chroma(columns: Float64) -> tuple[Float64, Float64]:
    """a* and b* (..., 2, 2) of body and lobe, of descriptors (..., n), and how much there is of
    both (..., 2): 0 nothing to see a hue of, 1 enough."""
    colours, sure = _colours(np.atleast_2d(columns))
    return (colours[0], sure[0]) if columns.ndim == 1 else (colours, sure)


_HUES = np.array([_ORDER["diffuse_hue"], _ORDER["specular_hue"]])
_CHROMAS = np.array([_ORDER["diffuse_chroma"], _ORDER["specular_chroma"]])
_DIFFUSE, _CONTRAST = _ORDER["diffuse"], _ORDER["highlight"]


@numba.njit(cache=True, nogil=True)
def _colours(columns: Any) -> Any:
    colours, sure = np.empty((len(columns), 2, 2)), np.empty((len(columns), 2))
    for m in range(len(columns)):
        row = columns[m]
        # contrast: difference of the cube roots of radiance factors, of which the body's is diffuse
        body = row[_DIFFUSE]
        lobe = (row[_CONTRAST] + np.cbrt(body)) ** 3 - body
        sure[m, 0] = min(max(body / _DARK - 1.0, 0.0), 1.0)
        sure[m, 1] = min(max(lobe / (_DARK + 0.5 * body) - 1.0, 0.0), 1.0)
        for i in range(2):
            angle, chroma = math.radians(row[_HUES[i]]), row[_CHROMAS[i]]
            colours[m, i, 0], colours[m, i, 1] = chroma * math.cos(angle), chroma * math.sin(angle)
    return colours, sure


class _Task(NamedTuple):
    """One move: scores to bring to where they shall be, and what shall stay."""

    space: TraitSpace
    fixed: list[int]  # scores that are moved or held
    rates: Float64  # how they change along the move
    start: Float64  # what they were
    soft: NDArray[np.int64]  # scores that had better stay
    soft_start: Float64
    body: Float64  # rows that stay
    body_at: Float64
    kept: Float64  # rows that had better stay
    kept_at: Float64
    hues: _Hues | None
    least: float  # log density
    back: float = 1.0  # how much of what had better stay is drawn back to where it was
    strict: bool = False
    strictly_hued: bool = False
    hole: float = math.inf  # the darkest middle of a highlight, in log f

    def relaxed(self) -> list[_Task]:
        """This task with what it keeps held, drawn back, and left to itself."""
        if len(self.kept):
            rows = np.vstack([self.body, self.kept])
            held = self._replace(
                body=rows, body_at=np.append(self.body_at, self.kept_at), kept=self.kept[:0]
            )
            return [held._replace(strict=True), self._replace(strict=True), self._replace(back=0.0)]
        return [self._replace(strict=True), self._replace(back=0.0)]

    def towards(self, z: Float64, way: float, last: bool) -> Float64 | None:
        """From z to where scores have changed by `way` of the rates, exactly in the `last` step;
        None if that cannot be."""
        space = self.space
        wanted = self.start + self.rates * way
        before, first, near = math.inf, math.inf, None
        thinned = pitted = False
        from_here = step = np.zeros(len(z))
        for turn in range(8 if self.strict else 10):
            # slopes are kept as long as they lead there
            if near is None:
                score, columns, pit, near = self._slopes(z)
            else:
                score, columns, pit = space._read(z)
            missing, rows, stiff, pull, off = self._rows(z, wanted, score, columns, near)
            miss, thin = float(np.abs(missing).max(initial=0.0)), 0.0
            if self.least > -math.inf:
                assert space.density is not None
                found, uphill = space.density.slope(z)
                thin = self.least - found
            hole = pit - self.hole
            enough = _EXACT if last and turn < (6 if self.strict else 8) else _NEAR
            fits = thin <= 1e-3 and hole <= 0.03 and off <= _TURN
            if miss <= enough and fits and turn > 0:
                return z
            merit = miss + max(hole, 0.0) + 0.1 * max(thin, 0.0)
            if turn == 5 and merit > 0.5 * first:
                return None  # it leads nowhere
            first = merit if turn == 0 else first
            if merit > 1.2 * before and turn > 1:  # too far: half of it
                step, near = 0.5 * step, None
                z = np.clip(from_here + step, space.low, space.high)
                continue
            if merit > 0.3 * before and turn:
                _, _, _, near = self._slopes(z)
                missing, rows, stiff, pull, off = self._rows(z, wanted, score, columns, near)
            before = merit
            # what a step has run into stays a wall in those that follow
            thinned, pitted = thinned or thin > 0.0, pitted or hole > 0.0
            if thinned:
                missing, rows = np.append(missing, thin), np.vstack([rows, uphill])
            if pitted:
                missing, rows = np.append(missing, -hole), np.vstack([rows, near.inward])
            found_step = _step(stiff, rows, missing, space.low - z, space.high - z, pull)
            if found_step is None:
                return None
            from_here, step = z, found_step
            z = np.clip(z + step, space.low, space.high)
        return None

    def _rows(
        self, z: Float64, wanted: Float64, score: Float64, columns: Float64, near: _Slopes
    ) -> tuple[Float64, Float64, Float64, Float64, float]:
        """What is missing of what is fixed and its rows, the stiffness and pull of what had
        better stay, and how far hues are off."""
        missing = np.concatenate([wanted - score[self.fixed], self.body_at - self.body @ z])
        rows = np.concatenate([near.scores[self.fixed], self.body])
        pull = self.back * _APART * near.scores[self.soft].T @ (self.soft_start - score[self.soft])
        if len(self.kept):
            pull = pull + self.back * _BODY * self.kept.T @ (self.kept_at - self.kept @ z)
        off = 0.0
        if self.hues is not None:
            seen = _chroma(columns)
            pull = pull - _HUE * near.hues.T @ self.hues.turned(*seen)
            off = self.hues.off(*seen) if self.strictly_hued else 0.0
        return missing, rows, near.stiff, pull, off

    def _slopes(self, z: Float64) -> tuple[Float64, Float64, float, _Slopes]:
        """Scores, descriptors and the hole at z, and how they change with it."""
        score, slopes, columns, hole, inward = self.space._sloped(z)
        apart = slopes[self.soft]
        stiff = self.space._stiffness + _APART * apart.T @ apart + _BODY * self.kept.T @ self.kept
        hues = np.zeros((0, len(z)))
        if self.hues is not None:
            turned = self.hues.turned(*_chroma(columns))
            hues = (turned[1:] - turned[0]).T / _SMALL
            stiff = stiff + _HUE * hues.T @ hues
        return score, columns[0], hole, _Slopes(slopes, hues, stiff, inward)

    def _here(self, z: Float64, way: float) -> tuple[Float64, Float64, Float64, Float64, float]:
        """`_rows` of the way from z."""
        score, columns, _, near = self._slopes(z)
        return self._rows(z, self.start + self.rates * way, score, columns, near)

    def possible(self, z: Float64) -> bool:
        """Whether a small step would be, were there no gamut."""
        missing, rows, stiff, pull, _ = self._here(z, _STEP)
        far = np.full(len(z), np.inf)
        return _step(stiff, rows, missing, -far, far, 0.0 * pull) is not None

    def compromise(self, z: Float64, way: float) -> Float64:
        """Where all that cannot be had together gives way alike."""
        space = self.space
        missing, rows, stiff, _, _ = self._here(z, way)
        step = np.linalg.solve(1e-2 * stiff + rows.T @ rows, rows.T @ missing)
        clipped: Float64 = np.clip(z + step, space.low, space.high)
        return clipped


def _step(
    stiff: Float64,
    rows: Float64,
    wanted: Float64,
    least: Float64,
    most: Float64,
    pull: Float64,
) -> Float64 | None:
    """The step (k,) that makes step @ stiff @ step / 2 - pull @ step least, with rows @ step =
    wanted and least <= step <= most; None if there is none."""
    step = np.zeros(len(stiff))
    free = np.ones(len(stiff), bool)
    size = max(float(np.abs(wanted).max(initial=0.0)), 1e-12)
    for _ in range(len(stiff)):
        some, stuck = rows[:, free], step[~free]
        drawn = pull[free] - stiff[np.ix_(free, ~free)] @ stuck
        both = np.linalg.solve(stiff[np.ix_(free, free)], np.column_stack([some.T, drawn]))
        spread, drift = both[:, :-1], both[:, -1]
        rest = wanted - rows[:, ~free] @ stuck - some @ drift
        part = drift + spread @ np.linalg.lstsq(some @ spread, rest, rcond=1e-10)[0]
        wrong = np.abs(some @ part + rows[:, ~free] @ stuck - wanted).max(initial=0.0)
        if wrong > 0.3 * size or np.abs(part).max() > _ABSURD:
            return None
        step[free] = part
        out = free & ((step < least - 1e-12) | (step > most + 1e-12))
        if not out.any():
            return step
        step[out] = np.clip(step[out], least[out], most[out])
        free &= ~out
        if not free.any():
            return None
    return None


_ABSURD = 25.0  # standard deviations of a coordinate: no step is that long


def straight(z: Float64, labels: ArrayLike, name: str, means: bool = False) -> Float64:
    """Trait vector (k,) between labelled members: the normal of a linear support vector machine,
    or the difference of class means (both in Matusik et al. 2003, section 5).

    Raises
    ------
    ValueError
        If labels are of one class only, of a wrong shape, or others than -1, 0 and 1.
    """
    label = _as_labels(labels, len(z), name)
    if means:
        return np.asarray(z[label == 1].mean(axis=0) - z[label == -1].mean(axis=0))
    from sklearn.svm import LinearSVC  # slow to import, and needed only here

    scale = np.maximum(z.std(axis=0), 1e-9)
    clear = label != 0
    machine = LinearSVC(C=0.1, dual=False).fit(z[clear] / scale, label[clear])
    return np.asarray(machine.coef_[0] / scale, np.float64)


def _as_labels(labels: ArrayLike, count: int, name: str) -> NDArray[Any]:
    """Labels (count,) of -1, 0 and 1, of both classes."""
    label = np.asarray(labels)
    if label.shape != (count,) or not np.isin(label, (-1, 0, 1)).all():
        raise ValueError(
            f"labels of {name!r}: expected ({count},) values of -1, 0 or 1, "
            f"got shape {label.shape}: {label!r}"
        )
    if not ((label == 1).any() and (label == -1).any()):
        raise ValueError(f"labels of {name!r}: expected materials with and without it")
    return label


def _rank_correlations(raw: Float64) -> Float64:
    """Spearman's (t, t) of columns (n, t)."""
    ranks = np.argsort(np.argsort(raw, axis=0, kind="stable"), axis=0, kind="stable")
    return np.atleast_2d(np.corrcoef(ranks.T))


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


@dataclass(frozen=True)
class Trait:
    """A trait of one's own: what labels or ratings of some materials say.

    Learnt are weights of the graded descriptors of the space, which say more than coordinates
    where there are few labels: "like these, not like those" is said of what is seen.

    Attributes
    ----------
    name, meaning : str
    weights : (d,) of the space's graded descriptors
    normal : (k,), the straight part: zeros where it is learnt
    typical : (2,) raw scores of the library's 10th and 90th percentile
    """

    name: str
    weights: Float64
    normal: Float64
    typical: Float64
    meaning: str = ""

    @classmethod
    def from_labels(
        cls,
        name: str,
        materials: Materials,
        labels: ArrayLike,
        space: TraitSpace | None = None,
        library: Library | None = None,
        meaning: str = "",
    ) -> Trait:
        """A trait from a handful of labels.

        Parameters
        ----------
        name : str
        materials : (n, k) coordinates, or n library names, tables, or (k,) coordinates
        labels : (n,) 1 has it, -1 has it not, 0 unclear
        space, library : None are the shipped ones

        Raises
        ------
        ValueError
            If there is no material with the trait, or none without it; on other values than -1, 0
            and 1, shapes that do not match, or materials labelled both ways.
        """
        z = _as_points(materials, library)
        given = _as_labels(labels, len(z), name)
        for i, point in enumerate(z):
            same = np.all(np.abs(z - point) < 1e-9, axis=1)
            if given[i] * given[same].min() < 0 or given[i] * given[same].max() < 0:
                raise ValueError(
                    f"labels of {name!r}: materials {np.flatnonzero(same).tolist()} are the same, "
                    "but labelled both ways"
                )
        return cls._learnt(name, z, given.astype(np.float64), space, library, meaning)

    @classmethod
    def from_ratings(
        cls,
        name: str,
        materials: Materials,
        ratings: ArrayLike,
        space: TraitSpace | None = None,
        library: Library | None = None,
        meaning: str = "",
    ) -> Trait:
        """A trait from ratings (n,), any finite numbers of which more is more of it.

        Other parameters as for `from_labels`.

        Raises
        ------
        ValueError
            If ratings are not finite, all the same, or not as many as materials.
        """
        z = _as_points(materials, library)
        given = np.asarray(ratings, np.float64)
        if given.shape != (len(z),) or not np.isfinite(given).all():
            raise ValueError(
                f"ratings of {name!r}: expected ({len(z)},) finite numbers, got {given!r}"
            )
        if not given.std() > 1e-9 * max(float(np.abs(given).max()), 1e-300):
            raise ValueError(f"ratings of {name!r}: expected different ones, got all the same")
        return cls._learnt(name, z, given, space, library, meaning)

    @classmethod
    def _learnt(
        cls,
        name: str,
        z: Float64,
        target: Float64,
        space: TraitSpace | None,
        library: Library | None,
        meaning: str,
    ) -> Trait:
        space = default_traits() if space is None else space
        library = default_library() if library is None else library
        grades = space.grades(z)
        known = space.grades(library.coordinates)
        centre = target.mean()
        scaled = (target - centre) / target.std()
        precision, pull = _posterior(grades, known)
        weights = np.linalg.solve(precision, pull @ scaled)
        raw = known @ weights
        low, high = np.percentile(raw, [10.0, 90.0])
        if not high > low:
            raise ValueError(f"{name!r}: what was given does not depend on how materials look")
        return cls(name, weights, np.zeros(z.shape[1]), np.array([low, high]), meaning)


Materials = ArrayLike | Sequence["str | TabulatedBRDF | ArrayLike"]


def suggest(
    labelled: Materials,
    candidates: Materials,
    space: TraitSpace | None = None,
    library: Library | None = None,
) -> int:
    """Which of the candidates says most of a trait, if it is labelled next.

    The one of whose score a linear model knows least, given what is labelled already (the variance
    of Bayesian linear regression; labels themselves do not matter).

    Parameters
    ----------
    labelled, candidates : as for `Trait.from_labels`; `labelled` may be empty

    Returns
    -------
    int, the index among the candidates
    """
    space = default_traits() if space is None else space
    known = space.grades((default_library() if library is None else library).coordinates)
    some = _as_points(labelled, library) if len(labelled) else np.zeros((0, len(space.low)))  # type: ignore[arg-type]
    if not len(candidates):  # type: ignore[arg-type]
        raise ValueError("candidates: expected at least one material, got none")
    precision, _ = _posterior(space.grades(some), known)
    rows = space.grades(_as_points(candidates, library))
    return int(np.argmax(np.einsum("nd,nd->n", rows, np.linalg.solve(precision, rows.T).T)))


_NOISE = 1.0  # variance of a label, as large as of the trait itself: people disagree


def _posterior(grades: Float64, known: Float64) -> tuple[Float64, Float64]:
    """Precision (d, d) of a trait's weights given materials (n, d), and what turns targets into
    its pull (d, n). A trait is as likely to follow what members differ in as they differ in it."""
    cov = np.cov(known.T)
    scale, axes = np.linalg.eigh(cov)
    # prior covariance of weights, so that scores vary by one and mostly along the widest axes
    prior = axes * np.maximum(scale, 1e-6) @ axes.T / np.sum(scale**2)
    centred = grades - known.mean(axis=0)
    return np.linalg.inv(prior) + centred.T @ centred / _NOISE, centred.T / _NOISE


def _as_points(materials: Materials, library: Library | None) -> Float64:
    """(n, k) coordinates of materials by name, table or coordinates."""
    library = default_library() if library is None else library
    found = []
    for material in materials:  # type: ignore[union-attr]
        if isinstance(material, str):
            found.append(library.coordinates[library.index(material)])
        elif callable(getattr(material, "eval", None)):
            found.append(library.embedding.encode(material))  # type: ignore[arg-type]
        else:
            found.append(library.embedding.as_coordinates(material))  # type: ignore[arg-type]
    if not found:
        raise ValueError("materials: expected at least one, got none")
    return np.array(found)


@functools.lru_cache(maxsize=1)
def default_traits() -> TraitSpace:
    """The traits that the package ships, for `traitbrdf.default_embedding`."""
    return TraitSpace.from_arrays(artifact())
