"""Measured properties of trait moves: ``traitbrdf bench traits``.

A designer relies on these laws: a move never jumps; two moves in a row equal their sum; a move back
undoes a move; colours and lightness stay where they are held; and a move reaches the amount asked
for. All of them are measured on decoded tables, over all cells. So the errors of the few cells that
moves themselves use are included.
"""

from __future__ import annotations

import concurrent.futures
import functools
import json
import math
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from traitbrdf import pictures as gallery
from traitbrdf.bench.metrics import highlight_hole
from traitbrdf.bench.people import rated
from traitbrdf.bench.records import Record, Say
from traitbrdf.formats.display import decode_srgb, exposure_of, tone_map
from traitbrdf.reflectance.brdf import ALBEDO_ANGLES, albedo_operator
from traitbrdf.reflectance.descriptors import READINGS, cielab, describe_columns, hue, reading_rows
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.space.holding import COLOURS, LIGHT
from traitbrdf.space.library import default_library
from traitbrdf.space.traits import RELATED, Method, TraitSpace, default_traits

Int64 = NDArray[np.int64]
Float64 = NDArray[np.float64]

STARTS = ("oak-varnished", "red-rubber", "blue-plastic", "gold-polished", "satin-olive-leather-47")
"""Members from which all traits are moved, in addition to random ones: wood, rubber, plastic,
metal, leather."""

AMOUNTS = np.linspace(-1.0, 1.0, 41)
"""Amounts of a sweep."""

JUMP = 8.0
"""Least colour difference of a jump, CIE 1976 (as are all colour differences here)."""

TURN = 5.0
"""Degrees by which a held hue may turn."""

HAS_HUE = (8.0, 6.0)
"""Least chroma, before and after a move, at which the hue of a colour counts."""

LIGHTER = 5.0
"""L* by which a held lightness may change."""

FALL = 1e-3
"""Amount by which a score may fall while the move raises it."""

REACHED = 0.9
"""Least share of the requested amount at which a move counts as complete."""

PICTURE = 32
"""Pixels of the side of a rendered sphere."""

_SURFACES = ("albedo 10", "albedo", "albedo 60", "body")
_AT_10, _AT_30, _AT_60, _BODY = range(4)
_SEEN = [READINGS.index(name) for name in _SURFACES]
_HUES = [_AT_30, _AT_60, _BODY]

Each = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""`map`, or the `map` of a pool of processes."""


# -- visible properties ---------------------------------------------------------------------------


def read_tables(z: Float64) -> Float64:
    """Return the readings (n, readings, 3) of the decoded tables of coordinates `z` (n, k).

    They are those of `traitbrdf.reflectance.descriptors.READINGS`.
    """
    embedding = default_library().embedding
    rows = reading_rows(embedding.grid_)
    # points repeat once a move has stopped: decode each only once
    points, where = np.unique(z, axis=0, return_inverse=True)
    found = [rows @ embedding.decode_values(point).astype(np.float64) for point in points]
    return np.array(found)[where.reshape(-1)]


def colours(readings: Float64) -> Float64:
    """Return CIELAB (..., 4, 3) of `readings` (..., readings, 3).

    The four colours are all reflected light at 10, 30 and 60 degrees, and the body (pi f, so that a
    white body has 1).
    """
    rgb = readings[..., _SEEN, :].copy()
    rgb[..., _BODY, :] *= math.pi
    return cielab(rgb)


def scores_read(space: TraitSpace, z: Float64, readings: Float64) -> Float64:
    """Return the scores (..., t) of tables.

    Parameters
    ----------
    space : TraitSpace
    z : (..., k) array
        Coordinates, which only linear traits use.
    readings : (..., readings, 3) array
        Of the tables.
    """
    raw = z @ space.normals.T
    if space.optics is not None:
        raw = raw + space.optics.grades.of(describe_columns(readings)) @ space.weights.T
    scores: Float64 = (raw - space.typical[:, 0]) / (space.typical[:, 1] - space.typical[:, 0])
    return scores


def difference(before: Float64, after: Float64) -> Float64:
    """Return the greatest colour difference (...) from `before` to `after`, CIELAB (..., 4, 3)."""
    found: Float64 = np.linalg.norm(after - before, axis=-1).max(axis=-1)
    return found


def starting(count: int, seed: int = 0) -> list[str]:
    """Return the names of `count` members: first `STARTS`, then random others, drawn by `seed`."""
    library, rng = default_library(), np.random.default_rng(seed)
    others = [name for name in library.names if name not in STARTS]
    more = rng.permutation(len(others))[: max(count - len(STARTS), 0)]
    return [*STARTS[:count], *(others[i] for i in more)]


def _point(name: str) -> Float64:
    """Return the coordinates (k,) of a member, clipped to the box: the start of its moves."""
    library = default_library()
    return library.embedding.clip(library.coordinates[library.index(name)])


# -- sweeps: continuity and monotony --------------------------------------------------------------


class Sweep(NamedTuple):
    """A trait moved through `AMOUNTS` from one member, and its visible effects.

    Attributes
    ----------
    start, trait : str
    z : (41, k) array
        Coordinates.
    lab : (41, 4, 3) array
        `colours`.
    score, own : (41,) arrays
        Score of the trait, read off whole tables, and off the few cells that moves use.
    """

    start: str
    trait: str
    z: Float64
    lab: Float64
    score: Float64
    own: Float64

    @property
    def steps(self) -> Float64:
        """Colour differences (40,) of neighbours."""
        return difference(self.lab[:-1], self.lab[1:])

    @property
    def fall(self) -> float:
        """The largest fall of the score in one step; 0 if it never falls."""
        return max(0.0, -float(np.diff(self.score).min()))

    @property
    def own_fall(self) -> float:
        """The largest fall in one step of the score that moves use."""
        return max(0.0, -float(np.diff(self.own).min()))


def sweep(
    start: str, trait: str, method: Method = "flow", space: TraitSpace | None = None
) -> Sweep:
    """Move a trait from a member of the library by all of `AMOUNTS`.

    Flows hold what they hold by default; linear moves hold nothing.

    Parameters
    ----------
    start, trait : str
    method : "flow" or "linear"
    space : TraitSpace or None
        None is the default space.
    """
    space = default_traits() if space is None else space
    z = _point(start)
    if method == "linear":
        points = np.array(
            [space.reach(z, {trait: float(amount)}, (), method="linear").z for amount in AMOUNTS]
        )
    else:
        half = len(AMOUNTS) // 2
        down = space.path(z, {trait: float(AMOUNTS[0])}, steps=half)
        points = np.concatenate(
            [down[:0:-1], space.path(z, {trait: float(AMOUNTS[-1])}, steps=half)]
        )
    readings = read_tables(points)
    i = space.index(trait)
    score, own = scores_read(space, points, readings)[:, i], space.scores(points)[:, i]
    return Sweep(start, trait, points, colours(readings), score, own)


def sweeps(start: str, traits: Sequence[str], method: Method = "flow") -> list[Sweep]:
    """Return the `sweep` of each of `traits` from the member `start`, by `method`."""
    return [sweep(start, trait, method) for trait in traits]


def jumps(steps: Float64) -> NDArray[np.bool_]:
    """Return which steps of a sweep are jumps, as booleans (n,).

    A jump is larger than `JUMP`, five times the sweep's median, and twice either neighbour. A fast
    but continuous change takes several steps; a jump takes one.

    Parameters
    ----------
    steps : (n,) array
        Colour differences.
    """
    around = np.concatenate([[0.0], steps, [0.0]])
    beside = np.maximum(around[:-2], around[2:])
    least = np.maximum(np.maximum(JUMP, 5.0 * np.median(steps)), 2.0 * beside)
    return np.asarray(steps > least, bool)


def rendered_steps(points: Float64, environment: EnvironmentMap, size: int = PICTURE) -> Float64:
    """Return the mean colour difference (n - 1,) of rendered pictures of neighbours.

    The pictures show spheres with one exposure, tone-mapped; the mean is over the pixels of the
    sphere.

    Parameters
    ----------
    points : (n, k) array
        Coordinates.
    environment : EnvironmentMap
    size : int
        Pixels on a side.
    """
    embedding = default_library().embedding
    unique, where = np.unique(points, axis=0, return_inverse=True)
    tables = [embedding.decode(point) for point in unique]
    images = gallery.spheres(tables, environment, size)
    lit = images.max(axis=(0, -1)) > 0.0
    seen = images[:, lit]
    shown = cielab(_LINEAR[tone_map(seen, exposure_of(seen))])[where.reshape(-1)]
    found: Float64 = np.linalg.norm(np.diff(shown, axis=0), axis=-1).mean(axis=-1)
    return found


_BYTES = np.arange(256) / 255.0

_LINEAR = decode_srgb(_BYTES)
"""Linear values (256,) of sRGB bytes: IEC 61966-2-1."""


@functools.lru_cache(maxsize=2)
def _map(path: Path | None) -> EnvironmentMap:
    # the same object each time, because `pictures.spheres` caches by its identity
    return EnvironmentMap.sky() if path is None else EnvironmentMap.read(path)


def _rendered(job: tuple[Path | None, Float64]) -> Float64:
    path, points = job
    return rendered_steps(points, _map(path))


# -- moves in a row -------------------------------------------------------------------------------


class Composed(NamedTuple):
    """Colour differences of moves that should agree, without those that stopped or met a wall.

    Attributes
    ----------
    added : (m,) array
        Between a move by a and then by b, and one by a + b.
    undone : (n,) array
        Between a start, and a move by a and then by -a.
    tried : int
        How many of each were tried.
    """

    added: Float64
    undone: Float64
    tried: int


def composed(seed: int, count: int) -> Composed:
    """Make `count` pairs of random moves a and b, from .1 to .5, of one sign, by `seed`."""
    library, space, rng = default_library(), default_traits(), np.random.default_rng(seed)
    added: list[float] = []
    undone: list[float] = []
    for _ in range(count):
        z = library.embedding.clip(library.coordinates[rng.integers(len(library))])
        trait = str(rng.choice(space.names))
        a, b = (float(rng.choice([-1.0, 1.0])) * rng.uniform(0.1, 0.5, 2)).tolist()
        first = space.reach(z, {trait: a})
        if not first.complete:
            continue
        second, whole = space.reach(first.z, {trait: b}), space.reach(z, {trait: a + b})
        back = space.reach(first.z, {trait: -a})
        lab = colours(read_tables(np.array([z, second.z, whole.z, back.z])))
        if second.complete and whole.complete and not (second.walled or whole.walled):
            added.append(float(difference(lab[1], lab[2])))
        if back.complete and not (first.walled or back.walled):
            undone.append(float(difference(lab[0], lab[3])))
    return Composed(np.array(added), np.array(undone), count)


# -- single moves ---------------------------------------------------------------------------------


class Made(NamedTuple):
    """Moves of one trait each, and the changes they made.

    Attributes
    ----------
    trait : (m,) array
        Index in `TraitSpace.names`.
    amount : (m,) array
    z : (m, 2, k) array
        Coordinates before and after.
    lab : (m, 2, 4, 3) array
        `colours` before and after.
    scores : (m, 2, t) array
        Scores before and after, read off whole tables.
    held : (m, h) array
        Indices of the traits that were held.
    stopped : tuple of m str
        The reason why a move stopped; "" if it reached its amount.
    """

    trait: Int64
    amount: Float64
    z: Float64
    lab: Float64
    scores: Float64
    held: Int64
    stopped: tuple[str, ...]

    @property
    def complete(self) -> NDArray[np.bool_]:
        """Whether each move reached its amount (m,), by its own report."""
        return np.array([not why for why in self.stopped], bool)

    @property
    def share(self) -> Float64:
        """Share (m,) of the amount that was reached, by the scores of `TraitSpace`."""
        return self._share(default_traits().scores(self.z))

    @property
    def shown(self) -> Float64:
        """Share (m,) of the amount that was reached, by scores read off whole tables."""
        return self._share(self.scores)

    def _share(self, scores: Float64) -> Float64:
        change = scores[:, 1] - scores[:, 0]
        found: Float64 = change[np.arange(len(change)), self.trait] / self.amount
        return found

    @property
    def turned(self) -> Float64:
        """The most degrees (m,) by which a hue turned; NaN if no colour has a hue.

        Counts all light at 30 and 60 degrees and the body, each if its chroma exceeds `HAS_HUE`.
        """
        (was, before), (now, after) = (
            np.moveaxis(hue(self.lab[:, i][:, _HUES]), -1, 0) for i in range(2)
        )
        away = np.abs((now - was + 180.0) % 360.0 - 180.0)
        coloured = (before >= HAS_HUE[0]) & (after >= HAS_HUE[1])
        found: Float64 = np.where(coloured, away, -1.0).max(axis=1)
        return np.where(found < 0.0, np.nan, found)

    @property
    def lighter(self) -> Float64:
        """Change (m,) of L* of all light at 30 degrees."""
        found: Float64 = self.lab[:, 1, _AT_30, 0] - self.lab[:, 0, _AT_30, 0]
        return found

    def among(self, names: Iterable[str]) -> Made:
        """Return the moves of the traits `names`."""
        space = default_traits()
        kept = np.isin(self.trait, [space.index(name) for name in names])
        return Made(
            self.trait[kept],
            self.amount[kept],
            self.z[kept],
            self.lab[kept],
            self.scores[kept],
            self.held[kept],
            tuple(self.stopped[i] for i in np.flatnonzero(kept)),
        )


def made(
    start: str,
    traits: Sequence[str],
    amounts: Sequence[float],
    method: Method = "flow",
    within: bool = False,
    held: int = 0,
) -> Made:
    """Move each trait by each amount from one member.

    Parameters
    ----------
    start : str
        A member of the library.
    traits : sequence of str
    amounts : sequence of float
    method : "flow" or "linear"
        Flows hold what they hold by default, linear moves nothing.
    within : bool
        Whether to leave out moves beyond the library's range (`TraitSpace.limits`).
    held : int
        Number of random traits to hold, unrelated to the moved one, and nothing else; 0 is the
        default of the method.
    """
    library, space = default_library(), default_traits()
    z = _point(start)
    at_start = space.scores(z)
    rng = np.random.default_rng(library.index(start))
    points, trait, amount, kept, stopped = [z], [], [], [], []
    for name in traits:
        i = space.index(name)
        apart = np.flatnonzero(np.abs(space.related[i]) < RELATED)
        for change in amounts:
            low, high = space.limits[i]
            if within and not low <= at_start[i] + change <= high:
                continue
            some = rng.permutation(apart)[:held]
            hold = [space.names[j] for j in some] if held else () if method == "linear" else None
            found = space.reach(z, {name: change}, hold, method=method)
            points.append(found.z)
            trait.append(i)
            amount.append(change)
            kept.append(some)
            stopped.append(found.stopped)
    every = np.array(points)
    readings = read_tables(every)
    lab, scores = colours(readings), scores_read(space, every, readings)

    def both(values: Float64) -> Float64:
        return np.stack([np.broadcast_to(values[:1], values[1:].shape), values[1:]], axis=1)

    return Made(
        np.array(trait, np.int64),
        np.array(amount),
        both(every),
        both(lab),
        both(scores),
        np.array(kept, np.int64).reshape(len(trait), held),
        tuple(stopped),
    )


def joined(parts: Iterable[Made]) -> Made:
    """Join several `Made`, which are `parts`, into one."""
    every = list(parts)
    return Made(
        np.concatenate([part.trait for part in every]),
        np.concatenate([part.amount for part in every]),
        np.concatenate([part.z for part in every]),
        np.concatenate([part.lab for part in every]),
        np.concatenate([part.scores for part in every]),
        np.concatenate([part.held for part in every]),
        tuple(why for part in every for why in part.stopped),
    )


def unrelated_change(moves: Made) -> Float64:
    """Return the mean |change| (m,) of scores unrelated to the moved traits of `moves`."""
    space = default_traits()
    apart = np.abs(space.related[moves.trait]) < RELATED
    change = np.abs(moves.scores[:, 1] - moves.scores[:, 0])
    found: Float64 = np.sum(change * apart, axis=1) / np.maximum(apart.sum(axis=1), 1)
    return found


def held_change(moves: Made, shown: bool = True) -> Float64:
    """Return the |change| (m, h) in `moves` of the scores of held traits.

    They are read off whole tables if `shown`, else off the few cells that moves use.
    """
    scores = moves.scores if shown else default_traits().scores(moves.z)
    change = np.abs(scores[:, 1] - scores[:, 0])
    return np.take_along_axis(change, moves.held, axis=1)


# -- physics --------------------------------------------------------------------------------------


class Physics(NamedTuple):
    """The `least` f in 1/sr, greatest `albedo`, and deepest `hole` in a highlight (0 to 1)."""

    least: float
    albedo: float
    hole: float


def composites(seed: int, count: int) -> Physics:
    """Check `count` random edits, by `seed`, of two traits by up to 3, with default holds."""
    library, space, rng = default_library(), default_traits(), np.random.default_rng((2, seed))
    embedding = library.embedding
    rows = albedo_operator(embedding.grid_, ALBEDO_ANGLES)
    least, albedo, hole = math.inf, 0.0, 0.0
    for _ in range(count):
        z = library.coordinates[rng.integers(len(library))]
        pair = rng.choice(space.names, 2, replace=False)
        amounts = dict(zip(pair.tolist(), rng.uniform(-3.0, 3.0, 2).tolist(), strict=True))
        values = embedding.decode_values(space.reach(z, amounts).z)
        least = min(least, float(values.min()))
        albedo = max(albedo, float((rows @ values).max()))
        hole = max(hole, highlight_hole(embedding.grid_, values))
    return Physics(least, albedo, hole)


# -- times ----------------------------------------------------------------------------------------


def move_times(count: int, seed: int = 3) -> tuple[Float64, Float64]:
    """Return milliseconds of `count` moves, and of further steps (5 count,) of a drag, by `seed`.

    The moves are of +0.5, not made before, with default holds. Then each goes on to .52, .54, ...
    .6, as when a slider is dragged.
    """
    library, rng = default_library(), np.random.default_rng(seed)
    space = TraitSpace.from_arrays(
        default_traits().arrays() | {"low": default_traits().low, "high": default_traits().high}
    )  # a new space, which has cached none of the timed moves
    space.reach(library.coordinates[0], {space.names[0]: 0.1})
    first: list[float] = []
    further: list[float] = []
    for _ in range(count):
        z = library.coordinates[rng.integers(len(library))]
        trait = str(rng.choice(space.names))
        for n in range(6):
            start = time.perf_counter()
            space.reach(z, {trait: 0.5 + 0.02 * n})
            (further if n else first).append(1e3 * (time.perf_counter() - start))
    return np.array(first), np.array(further)


_FIRST = """
import json, os, time
start = time.perf_counter()
import traitbrdf as tb
z = tb.default_library().coordinates[0]
imported = time.perf_counter() - start
compiled = sum(len(files) for _, _, files in os.walk(os.environ["NUMBA_CACHE_DIR"]))
start = time.perf_counter()
tb.default_traits().reach(z, {"shiny": 0.5})
first = time.perf_counter() - start
print(json.dumps([imported, compiled, first]))
"""


def first_move() -> tuple[float, int, float]:
    """Return seconds of the import, the number of files it compiled, and seconds of the first move.

    Measured in a new process with an empty cache of compiled code.
    """
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-c", _FIRST], capture_output=True, text=True, check=True,
            env={**os.environ, "NUMBA_CACHE_DIR": folder},
        )  # fmt: skip
    imported, compiled, first = json.loads(done.stdout.splitlines()[-1])
    return float(imported), int(compiled), float(first)


# -- the bench ------------------------------------------------------------------------------------


class _Size(NamedTuple):
    """Numbers of starts and moves to measure."""

    starts: int  # members from which sweeps start
    drawn: int  # of these, rendered too
    composed: int  # pairs of moves in a row
    colours: int  # members whose colours are checked
    reach: int  # members from which all traits move by half a unit
    held: int  # of these, with three traits held
    composites: int
    times: int
    compared: int  # members for linear moves


_QUICK = _Size(1, 1, 25, 2, 3, 2, 25, 20, 1)
_WHOLE = _Size(25, 3, 1000, 100, 500, 100, 10_000, 400, 10)
_DONE = "complete by the few cells that moves read"
_PART = 25  # moves in one job of a process


def trait_laws(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Measure traits: agreement with people, and the laws that moves keep.

    Parameters
    ----------
    data, quick, say
        As for `traitbrdf.bench.run.Bench`.
    """
    size = _QUICK if quick else _WHOLE
    if quick:
        say("  skipped when quick: people's ratings, and the time to compile a first move")
    elif data is not None and (data / "ratings").is_dir():
        yield from rated(data)
    yield from _times(size, quick)
    if quick:  # faster than starting processes
        yield from _laws(data, size, map, say)
        return
    # one thread per process, because threads of several processes would wait for each other
    alone = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    before = {name: os.environ.get(name) for name in alone}
    os.environ.update(alone)
    try:
        with concurrent.futures.ProcessPoolExecutor(
            os.cpu_count(), mp_context=multiprocessing.get_context("spawn")
        ) as pool:
            yield from _laws(data, size, pool.map, say)
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _laws(data: Path | None, size: _Size, each: Each, say: Say) -> Iterator[Record]:
    names = default_traits().names
    plain = [name for name in names if name not in COLOURS]
    chosen = starting(size.starts)
    every = _flat(each(functools.partial(sweeps, traits=names), chosen))
    swept = [one for one in every if one.trait in plain]
    yield from _continuity("", [one.steps for one in swept], swept, "of all light and body", say)
    yield from _pictures(data, size, swept, each, say)
    yield from _rows(size, each)
    yield from _colours(size, plain, each, say)
    yield from _reach(size, each, say)
    for one in every:
        if one.own_fall > FALL:
            say(
                f"  {one.start}, {one.trait}: the score falls by {one.own_fall:.4f}, "
                f"on tables {one.fall:.4f}"
            )
    how = f"scores never fall by more than {FALL:g}: {len(AMOUNTS)} amounts from -1 to 1, "
    on_tables = np.mean([one.fall <= FALL for one in every])
    how += f"{len(names)} traits, {len(chosen)} starts; read off whole tables {on_tables:.3f}"
    share = float(np.mean([one.own_fall <= FALL for one in every]))
    yield Record.at_least("monotone sweeps, share", share, "", 0.99, how=how)
    yield from _composites(size, each)
    yield from _compared(size, swept, plain, each)


def _flat(parts: Iterable[list[Sweep]]) -> list[Sweep]:
    return [one for part in parts for one in part]


def _continuity(
    where: str, steps: Sequence[Float64], swept: Sequence[Sweep], of: str, say: Say
) -> Iterator[Record]:
    """Yield jumps and the greatest step of sweeps, given their steps (40,)."""
    count, greatest = 0, 0.0
    for one, step in zip(swept, steps, strict=True):
        jumped = np.flatnonzero(jumps(step))
        count += bool(len(jumped))
        greatest = max(greatest, float(step.max()))
        for i in jumped:
            say(
                f"  jump{where}: {one.start}, {one.trait} {AMOUNTS[i]:+.2f} to "
                f"{AMOUNTS[i + 1]:+.2f}: {step[i]:.1f}"
            )
    starts, traits = len({one.start for one in swept}), len({one.trait for one in swept})
    how = f"colour difference {of}, steps of 0.05 from -1 to 1, {traits} traits, {starts} starts"
    a_jump = f"; a jump is more than {JUMP:g}, 5 times the median and twice both neighbours"
    yield Record.at_most(
        f"sweeps with a jump, share{where}", count / len(swept), "", 0.01, how=how + a_jump
    )
    worst = max(range(len(steps)), key=lambda i: float(steps[i].max()))
    how += f"; of {swept[worst].trait} from {swept[worst].start}"
    yield Record.at_most(f"greatest step{where}", greatest, "dE", 20.0, how=how)


def _pictures(
    data: Path | None, size: _Size, swept: Sequence[Sweep], each: Each, say: Say
) -> Iterator[Record]:
    """Measure the continuity of rendered spheres."""
    files = [data / "envmaps" / f"{name}.exr" for name in ("studio", "forest")] if data else []
    known: list[Path | None] = [file for file in files if file.is_file()]
    starts = list(dict.fromkeys(one.start for one in swept))[: size.drawn]
    drawn = [one for one in swept if one.start in starts]
    if size is _QUICK:  # a picture takes as long as twenty tables
        drawn = drawn[::5]
    for path in known or [None]:
        name = "sky" if path is None else path.stem
        steps = list(each(_rendered, [(path, one.z) for one in drawn]))
        of = f"in pictures of a sphere, mean over its pixels, {PICTURE}x{PICTURE}, tone-mapped"
        yield from _continuity(f", {name}", steps, drawn, of, say)
        if size is _QUICK:
            return


def _rows(size: _Size, each: Each) -> Iterator[Record]:
    """Measure moves in a row."""
    parts = [*each(functools.partial(composed, count=_PART), _seeds(size.composed))]
    tried = sum(part.tried for part in parts)
    for what, how, found in (
        ("a, then b, against a + b", "", np.concatenate([part.added for part in parts])),
        ("a, then -a, against the start", "", np.concatenate([part.undone for part in parts])),
    ):
        how = f"colour difference of all light and body, a and b 0.1 to 0.5, {len(found)} of "
        how += f"{tried} random moves, those that nothing stopped"
        median, high = np.percentile(found, [50.0, 95.0])
        yield Record.at_most(f"{what}, median", float(median), "dE", 1.0, how=how)
        yield Record.at_most(f"{what}, 95th", float(high), "dE", 3.0, how=how)


def _seeds(count: int) -> range:
    """Return a seed for each job of `count` moves in all."""
    return range(math.ceil(count / _PART))


def _colours(size: _Size, plain: Sequence[str], each: Each, say: Say) -> Iterator[Record]:
    """Measure how well hue and lightness are kept where they are held."""
    chosen = starting(size.colours, 4)
    moves = joined(each(functools.partial(made, traits=plain, amounts=(-0.5, 0.5)), chosen))
    held = [name for name in plain if name not in LIGHT]
    for name in plain:
        one = moves.among([name])
        said = f"  {name}: hue kept in {_percent(_kept_hue(one))}"
        if name in held:
            said += f", lightness in {_percent(_kept_light(one))}"
        say(said)
    turned = moves.turned[np.isfinite(moves.turned)]
    how = f"moves of +-0.5, {len(plain)} traits that are no colours, {len(chosen)} starts; of "
    how += f"{len(turned)} moves that have a hue, within {TURN:g} degrees: all light (30 and 60 "
    how += f"degrees) and body, from chroma {HAS_HUE[0]:g}; 99th percentile "
    how += f"{np.percentile(turned, 99.0):.1f}, most {turned.max():.0f} degrees"
    yield Record.at_least("hue kept, share", _kept_hue(moves), "", 0.98, how=how)
    still = moves.among(held)
    low, high = np.percentile(still.lighter, [10.0, 90.0])
    how = f"the same, all light at 30 degrees within {LIGHTER:g} L*, {len(held)} traits that are "
    how += f"not about that; 10th and 90th percentile {low:+.1f} and {high:+.1f} L*"
    yield Record.at_least("lightness kept, share", _kept_light(still), "", 0.9, how=how)


def _kept_hue(moves: Made) -> float:
    turned = moves.turned[np.isfinite(moves.turned)]
    return float(np.mean(turned <= TURN)) if len(turned) else 1.0


def _kept_light(moves: Made) -> float:
    return float(np.mean(np.abs(moves.lighter) <= LIGHTER))


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _reach(size: _Size, each: Each, say: Say) -> Iterator[Record]:
    """Measure how much of half a unit is reached, and how other traits change."""
    space, library = default_traits(), default_library()
    names, rng = space.names, np.random.default_rng(0)
    chosen = [library.names[i] for i in rng.choice(len(library), size.reach, replace=False)]
    half = functools.partial(made, traits=names, amounts=(0.5,), within=True)
    moves = joined(each(half, chosen))
    shares = {}
    for name in names:
        one = moves.among([name])
        if not len(one.trait):
            continue
        shares[name] = float(np.mean(one.share >= REACHED))
        why = Counter(r for r, s in zip(one.stopped, one.share, strict=True) if s < REACHED)
        said = "; ".join(f"{reason or _DONE}: {count}" for reason, count in why.most_common())
        say(
            f"  {name}: {_percent(shares[name])} of {len(one.trait)}"
            + (f" ({said})" if why else "")
        )
    short = [why for why, share in zip(moves.stopped, moves.share, strict=True) if share < REACHED]
    how = f"+0.5 of {len(shares)} traits from {len(chosen)} members, where the library has more of "
    how += f"it: {len(moves.share)} moves; of {len(short)} others "
    how += ", ".join(
        f"{_percent(count / len(short))} {why or _DONE}"
        for why, count in Counter(short).most_common()
    )
    shown = [float(np.mean(moves.among([name]).shown >= REACHED)) for name in shares]
    how += f"; read off whole tables {_percent(float(np.mean(shown)))} and {_percent(min(shown))}"
    mean = float(np.mean(list(shares.values())))
    yield Record.at_least("moves that reach 90 %, mean of traits", mean, "", 0.8, how=how)
    least = min(shares, key=lambda name: shares[name])
    yield Record.at_least(
        "moves that reach 90 %, least of a trait", shares[least], "", 0.6, how=f"{least}; {how}"
    )
    drift = float(np.mean(unrelated_change(moves)[moves.complete]))
    how = f"traits of rank correlation below {RELATED:g} with the moved one; mean |change| of a "
    how += f"score, {moves.complete.sum()} complete moves"
    yield Record.at_most("unrelated traits, not held", drift, "", 0.15, how=how)
    moves = joined(each(functools.partial(half, held=3), chosen[: size.held]))
    refused = np.array([why.startswith("held") for why in moves.stopped])
    change = held_change(moves)[~refused]
    own = held_change(moves, shown=False)[~refused]
    how = "three unrelated traits at a time; greatest |change| of a score, 99th percentile "
    how += f"{np.percentile(own, 99.0):.4f}; read off whole tables {change.max():.3f} and "
    how += f"{np.percentile(change, 99.0):.3f}; {refused.sum()} of "
    how += f"{len(refused)} moves are refused, because what is held forbids them"
    yield Record.at_most("unrelated traits, held", float(own.max()), "", 0.02, how=how)


def _composites(size: _Size, each: Each) -> Iterator[Record]:
    seeds = _seeds(size.composites)
    found = list(each(functools.partial(composites, count=_PART), seeds))
    cells = default_library().embedding.grid_.size
    how = f"{len(seeds) * _PART} random edits of two traits by up to 3, {cells} cells each"
    least, albedo = min(one.least for one in found), max(one.albedo for one in found)
    hole = max(one.hole for one in found)
    yield Record.at_least("composite edits, least f", least, "1/sr", 0.0, how=how)
    yield Record.at_most("composite edits, greatest albedo", albedo, "", 1.001, how=how)
    yield Record.at_most("composite edits, deepest hole", 100.0 * hole, "%", 2.0, how=how)


def _times(size: _Size, quick: bool) -> Iterator[Record]:
    first, further = move_times(size.times)
    how = f"{len(first)} moves of +0.5 that were not made before, with default holds; 95th "
    how += f"percentile {np.percentile(first, 95.0):.1f} ms"
    yield Record.at_most("a move, median", float(np.median(first)), "ms", 5.0, how=how)
    how = f"{len(further)} further steps of 0.02 of the same; 95th percentile "
    how += f"{np.percentile(further, 95.0):.2f} ms"
    yield Record.at_most(
        "a drag's next step, median", float(np.median(further)), "ms", 0.5, how=how
    )
    if not quick:  # takes as long as all the rest
        imported, compiled, seconds = first_move()
        if compiled:
            raise RuntimeError(f"the import compiles {compiled} files")
        how = "the first move in a fresh process with an empty cache of compiled code; the import "
        how += f"compiles nothing and takes {imported:.1f} s"
        yield Record.at_most("first move, compiled", seconds, "s", 10.0, how=how)


def _compared(
    size: _Size, swept: Sequence[Sweep], plain: Sequence[str], each: Each
) -> Iterator[Record]:
    """Measure the same laws for the linear vectors of Matusik et al. 2003, which hold no colour."""
    chosen = starting(size.compared)
    if size is _QUICK:
        plain = plain[::3]
    straight = _flat(each(functools.partial(sweeps, traits=plain, method="linear"), chosen))
    kinds: dict[Method, list[Sweep]] = {
        "flow": [one for one in swept if one.start in chosen and one.trait in plain],
        "linear": straight,
    }  # fmt: skip
    rows: dict[str, list[float]] = {}
    for method, found in kinds.items():
        half = functools.partial(made, traits=plain, method=method)
        both = joined(each(functools.partial(half, amounts=(-0.5, 0.5)), chosen))
        more = joined(each(functools.partial(half, amounts=(0.5,), within=True), chosen))
        rows["flows" if method == "flow" else "straight vectors"] = [
            float(np.mean([jumps(one.steps).any() for one in found])),
            max(float(one.steps.max()) for one in found),
            float(np.mean([one.own_fall <= FALL for one in found])),
            _kept_hue(both),
            _kept_light(both.among(name for name in plain if name not in LIGHT)),
            float(np.mean(more.share >= REACHED)),
        ]
    how = f"{len(plain)} traits that are no colours, {len(chosen)} starts; straight vectors "
    how += "(Matusik et al. 2003) along the slope at the start, which hold nothing"
    titles = (
        ("sweeps with a jump, share", ""), ("greatest step", "dE"), ("monotone sweeps, share", ""),
        ("hue kept, share", ""), ("lightness kept, share", ""), ("moves that reach 90 %", ""),
    )  # fmt: skip
    for i, (title, unit) in enumerate(titles):
        for kind, values in rows.items():
            yield Record(f"{title}, {kind}", values[i], unit, how=how)
