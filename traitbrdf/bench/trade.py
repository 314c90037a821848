"""Speed against accuracy, measured: ``traitbrdf bench promises`` and ``bench trade``.

The promises `error=` and `fps=` are checked against the oracle, on scenes and materials that no
rule was tuned on. The trade varies every knob of speed and accuracy, alone and together.
"""

from __future__ import annotations

import importlib
import itertools
import json
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf import reference
from traitbrdf.bench.datasets import channels, maps, unseen
from traitbrdf.bench.metrics import milliseconds
from traitbrdf.bench.oracle import Oracle
from traitbrdf.bench.records import Record, Say
from traitbrdf.bench.transport import BENCH_CAMERA, WIDE_CAMERA
from traitbrdf.formats.files import atomic_path
from traitbrdf.pictures import own_colours
from traitbrdf.reflectance.brdf import HalfDiffGrid, TabulatedBRDF
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import Mesh, Shape, sphere
from traitbrdf.scene.teapot import teapot
from traitbrdf.session.budget import LADDER, QUALITIES
from traitbrdf.session.editing import EditSession
from traitbrdf.session.preparation import promised, training_of
from traitbrdf.space.embedding import GRID
from traitbrdf.space.library import default_library
from traitbrdf.transport.operator import Operator
from traitbrdf.transport.transport import Transport

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

ERRORS = (0.1, 0.03, 0.01, 0.003)
"""Values of `error=` that are tested."""

KEPT = 0.95
"""Target share of cases in which the requested error is met."""


# -- scenes ---------------------------------------------------------------------------------------


def surface_mesh(points: Float64, normals: Float64, name: str) -> Mesh:
    """Return a grid of points as a mesh of one part; triangles without area are dropped.

    Parameters
    ----------
    points, normals : (m, n, 3) arrays
    name : str
        Name of the part.
    """
    m, n, _ = points.shape
    at = np.arange(m * n).reshape(m, n)
    a, b, c, d = at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    flat = points.reshape(-1, 3)
    edges = flat[faces[:, 1:]] - flat[faces[:, :1]]
    faces = faces[np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=-1) > 1e-9]
    return Mesh(flat, faces, normals.reshape(-1, 3), np.zeros(len(faces), np.int64), (name,))


def knot(along: int = 400, around: int = 40) -> Mesh:
    """Return a tube along a trefoil knot, which shades itself everywhere.

    Parameters
    ----------
    along, around : int
        Numbers of quads along the tube and around it.
    """
    t = np.linspace(0.0, 2.0 * math.pi, along + 1)
    r = 2.0 + np.cos(3.0 * t)
    line = np.stack([r * np.cos(2.0 * t), np.sin(3.0 * t), r * np.sin(2.0 * t)], axis=-1)
    tangent = np.gradient(line, axis=0)
    tangent[[0, -1]] = line[1] - line[-2]
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    side = np.cross(tangent, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    up = np.cross(side, tangent)
    a = np.linspace(0.0, 2.0 * math.pi, around + 1)[None, :, None]
    normals = np.cos(a) * side[:, None] - np.sin(a) * up[:, None]
    return surface_mesh(line[:, None] + 0.55 * normals, normals, "knot")


def vase(along: int = 120, around: int = 120) -> Mesh:
    """Return a body of revolution with a narrow neck: long highlights, and shade below the lip.

    Parameters
    ----------
    along, around : int
        Numbers of quads along the axis and around it.
    """
    t = np.linspace(0.0, 1.0, along + 1)[:, None]
    height, radius = 3.0 * t, 0.55 + 0.4 * np.sin(2.0 * math.pi * (t + 0.03)) + 0.15 * t**8
    rise, grow = np.gradient(height, axis=0), np.gradient(radius, axis=0)
    a = np.linspace(0.0, 2.0 * math.pi, around + 1)[None]
    points = np.stack([radius * np.sin(a), height + 0.0 * a, radius * np.cos(a)], axis=-1)
    normals = np.stack([rise * np.sin(a), -grow + 0.0 * a, rise * np.cos(a)], axis=-1)
    return surface_mesh(points, normals / np.linalg.norm(normals, axis=-1, keepdims=True), "vase")


class _Stage(NamedTuple):
    """A shape under a map; `tuned` says whether rules were tuned on it."""

    name: str
    shape: Shape
    environment: EnvironmentMap
    camera: Camera
    tuned: bool

    def scene(self, size: int | tuple[int, int]) -> Scene:
        """Return the scene at a size in pixels."""
        return Scene(self.shape, self.environment, camera=self.camera, size=size)


def _stages(data: Path | None, quick: bool) -> list[_Stage]:
    """Return every shape under maps of its own; rules were tuned on the first half only."""
    found = dict(maps(data, False))
    names = list(found)
    plan = [("teapot", 0), ("teapot", 3), ("sphere", 2), ("sphere", 4),
            ("knot", 5), ("knot", 1), ("vase", 6), ("vase", 7)]  # fmt: skip
    shapes: dict[str, Shape] = {
        "teapot": teapot(), "sphere": sphere(), "knot": knot(), "vase": vase()
    }  # fmt: skip
    turn = (-55.0, 20.0, 100.0, 0.0, 35.0, -120.0, 10.0, 160.0)
    stages = []
    for i, (shape, place) in enumerate(plan):
        name = names[place % len(names)]
        camera = Camera.orbit(turn[i], 15.0 + 4.0 * i, zoom=1.15)
        stages.append(
            _Stage(f"{shape} under {name}", shapes[shape], found[name], camera, i < len(plan) // 2)
        )
    return [stages[0], stages[4]] if quick else stages


def _materials(data: Path | None, quick: bool, each: int) -> list[TabulatedBRDF]:
    """Return tables of all kinds that neither the bases nor the promises were fitted to."""
    kinds = unseen(data, quick)
    kinds.pop("held-out library")  # sessions train on the whole library
    rng = np.random.default_rng(7)
    some = []
    for kind, tables in kinds.items():
        # of the models only those that conserve energy, as users' materials do
        fit = [t for t in tables if kind != "models" or t.max_albedo() <= 1.02]
        some += [fit[i] for i in np.sort(rng.permutation(len(fit))[:each])]
    return some


class _Checked(NamedTuple):
    """Pixels of a scene, and their reference values for each table."""

    pixels: Int64
    true: Float64  # (pixels, tables, 3), without the backdrop


def _checked(oracle: Oracle, scene: Scene, count: int, seed: int) -> _Checked:
    """Draw random covered pixels, without those at which the reference fails."""
    rng = np.random.default_rng(seed)
    pixels = np.sort(rng.permutation(np.unique(scene.pixels))[:count])
    index = np.flatnonzero(np.isin(scene.pixels, pixels))
    values, _ = oracle(scene, index)
    whole = np.zeros((len(pixels), *values.shape[1:]))
    np.add.at(whole, np.searchsorted(pixels, scene.pixels[index]), values)
    known = np.isfinite(whole).all(axis=(1, 2))
    return _Checked(pixels[known], whole[known])


def _shown(session: EditSession, pixels: Int64) -> Float64:
    """Return the session's frame at pixels, (n, 3), without the backdrop."""
    scene = session.scene
    behind = scene.backdrop().reshape(-1, 3)[pixels] * scene.uncovered[pixels, None]
    return np.asarray(session.render().reshape(-1, 3)[pixels] - behind, np.float64)


def _edit_times(session: EditSession, count: int, seed: int = 3) -> list[float]:
    """Return seconds from edits of the whole object to their frames, from the basis or exact."""
    library = default_library()
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(library), count + 2, replace=False)
    times = []
    for z in library.coordinates[chosen]:
        start = time.perf_counter()
        session.assign(session.scene.shape.parts, z)
        session.render()
        times.append(time.perf_counter() - start)
    return times[2:]


# -- promises -------------------------------------------------------------------------------------


def promises_kept(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Check `error=` and `fps=` on scenes and materials that no rule was tuned on.

    Parameters
    ----------
    data, quick, say
        As for `traitbrdf.bench.run.Bench`.
    """
    size, each, count = (24, 2, 24) if quick else (96, 3, 30)
    tables = _materials(data, quick, each)
    asked = ERRORS[:2] if quick else ERRORS
    errors: dict[float, list[Float64]] = {e: [] for e in asked}
    times: dict[float, list[float]] = {e: [] for e in asked}
    exact: dict[float, list[float]] = {e: [] for e in asked}
    stages = _stages(data, quick)
    with Oracle(tables, 1e-3) as oracle:
        for stage in stages:
            scene = stage.scene(size)
            checked = _checked(oracle, scene, count, 5)
            for error in asked:
                start = time.perf_counter()
                session = EditSession(scene, error=error, cache=False)
                session.prepare()
                prepared = time.perf_counter() - start
                found, tiers = [], []
                for b, table in enumerate(tables):
                    session.assign(scene.shape.parts, table)
                    shown = _shown(session, checked.pixels)
                    found.append(reference.relative_error(shown, checked.true[:, b]))
                    tiers += [p["tier"] == "exact" for p in session.report()["parts"].values()]
                spent = _edit_times(session, 4 if quick else 16)
                promise = session.report()["promise"]
                errors[error].append(np.array(found))
                times[error].append(float(np.median(spent)))
                exact[error].append(float(np.mean(tiers)))
                say(
                    f"  {stage.name:26s} error={error:<6g} {promise['quality']:11s} "
                    f"{promise['basis_images']:3d} of {promise['of']:3d} images, "
                    f"{'kept' if promise['kept'] else 'not kept':8s}  met "
                    f"{100 * np.mean(errors[error][-1] <= error):5.1f} %  "
                    f"median {100 * np.median(found):.2f} %, 95th "
                    f"{100 * np.quantile(found, 0.95):.2f} %, exact {100 * np.mean(tiers):3.0f} %  "
                    f"{1e3 * times[error][-1]:.1f} ms, prepared {prepared:.0f} s"
                )
    fresh = np.array([not stage.tuned for stage in stages])
    whole = {e: np.stack(found) for e, found in errors.items()}
    for error in asked:
        unseen = float(np.mean(whole[error][fresh] <= error))
        how = (
            f"{whole[error].size} cases: {len(stages)} scenes of {size}x{size}, {len(tables)} "
            f"BRDFs; of maps and shapes never tuned on {100 * unseen:.1f} %; "
            f"exact frames {100 * np.mean(exact[error]):.0f} %"
        )
        yield Record.at_least(
            f"error={error:g}: cases that meet it", float(np.mean(whole[error] <= error)), "", KEPT,
            how=how,
        )  # fmt: skip
        yield Record(
            f"error={error:g}: edit to frame, median", 1e3 * float(np.median(times[error])), "ms",
            error=float(np.median(whole[error])), how=f"{size}x{size}, whole object",
        )  # fmt: skip
    ladder = [float(np.median(times[e])) for e in asked]
    steps = [later / earlier for earlier, later in itertools.pairwise(ladder)]
    yield Record.at_least(
        "the more error the faster: least step", min(steps), "x", 1.0,
        how=f"median times from error={asked[0]:g} to {asked[-1]:g}",
    )  # fmt: skip
    yield from _speeds(data, quick, say, tables)


def _speeds(
    data: Path | None, quick: bool, say: Say, tables: Sequence[TabulatedBRDF]
) -> Iterator[Record]:
    """Measure `fps=` at two sizes: the speed reached, and its error."""
    _, environment = maps(data, True)[0]
    sizes: list[tuple[tuple[int, int], Camera]] = [
        ((512, 512), BENCH_CAMERA),
        ((1080, 1920), WIDE_CAMERA),
    ]
    if quick:
        sizes = [((48, 48), BENCH_CAMERA)]
    some = list(tables[:: max(len(tables) // 8, 1)])
    for size, camera in sizes:
        scene = Scene(teapot(), environment, camera=camera, size=size, ground=True)
        objects = scene.part_slice(len(scene.shape.parts) - 1).stop
        with Oracle(some, 1e-3) as oracle:
            checked, _ = _inside(oracle, scene, slice(objects), 16 if quick else 60, 9)
        whole = None
        for fps in (60.0, 30.0):
            session = EditSession(scene, fps=fps, cache=False)
            if whole is None:
                session.prepare()
                whole = session.view.prepared
            else:  # another part of the same preparation
                session.view.prepared = promised(whole, session.library, session.settings)
            promise = session.report()["promise"]
            times = _edit_times(session, 6 if quick else 60)
            found = []
            for b, table in enumerate(some):
                session.assign(scene.shape.parts, table)
                shown = _shown(session, checked.pixels)
                found.append(reference.relative_error(shown, checked.true[:, b]))
            reached = 1.0 / float(np.median(times))
            how = (
                f"{size[1]}x{size[0]}, {promise['basis_images']} of {promise['of']} images, slow "
                f"tenth {1.0 / np.quantile(times, 0.9):.0f} fps; error median of {len(some)} "
                f"unseen BRDFs, greatest {100 * max(found):.2f} %"
            )
            say(f"  fps={fps:g} {how}")
            yield Record.at_least(
                f"fps={fps:g} at {size[1]}x{size[0]}: whole object", reached, "fps", fps,
                error=float(np.median(found)), how=how,
            )  # fmt: skip


def _inside(
    oracle: Oracle, scene: Scene, among: slice, count: int, seed: int
) -> tuple[_Checked, Int64]:
    """Draw pixels that show one fragment alone, of those `among`; also return the fragments."""
    index = np.flatnonzero(~scene.bordering[among])
    index = np.sort(np.random.default_rng(seed).permutation(index)[:count])
    values, _ = oracle(scene, index)
    known = np.isfinite(values).all(axis=(1, 2))
    return _Checked(scene.pixels[index[known]], values[known]), index[known]


# -- the trade ------------------------------------------------------------------------------------


class TradePoint(NamedTuple):
    """One combination of knobs: the cost of a frame, and its error.

    Parameters
    ----------
    images : int
        Basis images.
    dtype : str
        Number type of the basis.
    resolution : float
        Resolution of the light's nodes, relative to the default.
    milliseconds, megabytes : float
        Time and memory of a frame.
    error, error_95 : float
        Median and 95th percentile of the frame error over unseen materials and scenes.
    prepared : float
        Seconds of preparation.
    """

    images: int
    dtype: str
    resolution: float
    milliseconds: float
    megabytes: float
    error: float
    error_95: float
    prepared: float

    @property
    def label(self) -> str:
        """The combination in words."""
        return f"{self.images} images, {self.dtype}, resolution {self.resolution:g}"


class _Measured(NamedTuple):
    """A scene, its reference values, and its transport at each resolution."""

    scene: Scene
    checked: _Checked
    fragments: Int64  # the checked ones
    transports: dict[float, tuple[Transport, float]]

    @property
    def usual(self) -> Transport:
        return self.transports[QUALITIES["interactive"][1]][0]


def _frame(transport: Transport, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a frame of one table (cells seen, 3) on all parts."""
    table = torch.from_numpy(values).to(transport.device)
    parts = [transport.shade(i, table) for i in range(len(transport.scene.parts))]
    return transport.compose(parts).cpu().numpy()


def _frame_errors(
    transport: Transport, checked: _Checked, tables: Sequence[TabulatedBRDF]
) -> list[float]:
    """Return the mean relative L1 of each table's frame at the checked pixels."""
    scene = transport.scene
    behind = scene.backdrop().reshape(-1, 3) * scene.uncovered[:, None]
    found = []
    for b, table in enumerate(tables):
        values = np.ascontiguousarray(table.values.reshape(-1, 3)[transport.cells], np.float32)
        shown = (_frame(transport, values).reshape(-1, 3) - behind)[checked.pixels]
        found.append(reference.relative_error(shown, checked.true[:, b]))
    return found


def _frame_milliseconds(transport: Transport, repeats: int) -> float:
    """Return the median time from coordinates to a frame."""
    library = default_library()
    turn = itertools.cycle(library.coordinates[:: len(library) // 16])
    return milliseconds(
        lambda: _frame(
            transport, library.embedding.decode_values(next(turn), cells=transport.cells)
        ),
        repeats,
    )


def _operator_errors(
    scene: Scene,
    index: Int64,
    true: Float64,
    tables: Sequence[TabulatedBRDF],
    **settings: Any,
) -> tuple[float, float, float]:
    """Return the error of the uncompressed operator at fragments, and its time.

    The three numbers are the median and 95th percentile of the errors, and milliseconds per
    fragment, rays included.
    """
    grid = default_library().embedding.grid_
    columns = channels(tables)
    operator = Operator(scene, grid, **settings)
    operator.images(index[:2], columns)  # a warm-up call: compiled code is loaded once
    start = time.perf_counter()
    shown = own_colours(operator.images(index, columns))
    seconds = time.perf_counter() - start
    errors = [reference.relative_error(shown[:, b], true[:, b]) for b in range(len(tables))]
    return (*_spread(errors), 1e3 * seconds / len(index))


def _spread(errors: Sequence[float]) -> tuple[float, float]:
    """Return median and 95th percentile."""
    return float(np.median(errors)), float(np.quantile(errors, 0.95))


def coarser(environment: EnvironmentMap, factor: int) -> EnvironmentMap:
    """Return a map of fewer texels, each the mean of those it covers, weighted by solid angle.

    So the light stays the same, from wider texels.

    Parameters
    ----------
    environment : EnvironmentMap
    factor : int
        Divisor of the numbers of rows and columns.

    Raises
    ------
    ValueError
        On another factor.
    """
    rows, columns, _ = environment.image.shape
    if factor < 1 or rows % factor or columns % factor:
        raise ValueError(f"factor: expected a divisor of {rows} and {columns}, got {factor!r}")
    weight = environment.solid_angles[:, None, None]
    shape = (rows // factor, factor, columns // factor, factor, 3)
    light = (environment.image.astype(np.float64) * weight).reshape(shape).sum(axis=(1, 3))
    whole = np.broadcast_to(weight, environment.image.shape).reshape(shape).sum(axis=(1, 3))
    return EnvironmentMap(light / whole, environment.rotation)


def bandwidth(seconds: float = 0.5) -> float:
    """Measure the memory bandwidth of this machine in bytes per second, with all threads of torch.

    It is the best of several sums over an array that exceeds all caches.

    Parameters
    ----------
    seconds : float
        Duration of the measurement.
    """
    values = torch.ones(1 << 26)
    best, end = 0.0, time.perf_counter() + seconds
    while time.perf_counter() < end:
        start = time.perf_counter()
        values.sum()
        best = max(best, values.nbytes / (time.perf_counter() - start))
    return best


def pareto(points: Sequence[TradePoint]) -> list[TradePoint]:
    """Return the Pareto front in time, memory and error, the fastest point first.

    Parameters
    ----------
    points : sequence of TradePoint
    """

    def beaten(p: TradePoint) -> bool:
        mine = (p.milliseconds, p.megabytes, p.error)
        for q in points:
            other = (q.milliseconds, q.megabytes, q.error)
            if other != mine and all(b <= a for a, b in zip(mine, other, strict=True)):
                return True
        return False

    return sorted((p for p in points if not beaten(p)), key=lambda p: p.milliseconds)


def _outline(points: Sequence[TradePoint]) -> list[TradePoint]:
    """Return the Pareto front in time and error alone, the fastest point first."""
    found: list[TradePoint] = []
    for p in sorted(points, key=lambda p: (p.milliseconds, p.error)):
        if not found or p.error < found[-1].error:
            found.append(p)
    return found


def knee(points: Sequence[TradePoint]) -> TradePoint:
    """Return the knee of the Pareto front in time and error: beyond it, more time gains little.

    With both as logarithms, it is the point furthest below the line from the fastest to the most
    accurate point.

    Parameters
    ----------
    points : sequence of TradePoint
    """
    front = _outline(points)
    x = np.log([p.milliseconds for p in front])
    y = np.log([max(p.error, 1e-6) for p in front])
    width, height = max(x[-1] - x[0], 1e-9), max(y.max() - y.min(), 1e-9)
    below = y[0] + (y[-1] - y[0]) * (x - x[0]) / width - y
    return front[int(np.argmax(below / height))]


def trade(data: Path | None, quick: bool, say: Say, out: Path | None = None) -> Iterator[Record]:
    """Measure every knob of speed against accuracy, alone and together, on real maps.

    Parameters
    ----------
    data, quick, say
        As for `traitbrdf.bench.run.Bench`.
    out : Path or None
        Folder for trade.json and trade.png.
    """
    size, each, count, repeats = (24, 2, 24, 3) if quick else (256, 5, 48, 15)
    ranks = (8, 24, 40) if quick else LADDER
    resolutions = (0.7, 1.0) if quick else (0.5, 1.0, 2.0)
    tables = _materials(data, quick, each)
    stages = _stages(data, True)[: 1 if quick else 2]
    settings: list[tuple[str, str, float | None, float, float]] = []
    scenes = []
    training = training_of(default_library(), 0)
    with Oracle(tables, 1e-3) as oracle:
        for stage in stages:
            scene = stage.scene(size)
            checked, index = _inside(oracle, scene, slice(None), count, 11)
            transports = {}
            for resolution in resolutions:
                start = time.perf_counter()
                built = Transport(scene, GRID, training, max(ranks), resolution)
                transports[resolution] = built, time.perf_counter() - start
                say(
                    f"  {stage.name}, resolution {resolution:g}: prepared in "
                    f"{transports[resolution][1]:.0f} s"
                )
            scenes.append(_Measured(scene, checked, index, transports))

    def knob(name: str, setting: str, ms: float | None, mb: float, errors: list[float]) -> None:
        median, high = _spread(errors)
        settings.append((name, setting, ms, median, high))
        took = "" if ms is None else f"{ms:8.2f} ms"
        size_of = "" if math.isnan(mb) else f"{mb:7.1f} MB"
        say(
            f"  {name:22s} {setting:14s} {took:11s} {size_of:10s} error {100 * median:6.3f} %, "
            f"95th {100 * high:6.3f} %"
        )

    say("  -- alone; time of a frame, or of a fragment for knobs that change the preparation")
    points = []
    for resolution in resolutions:
        for rank in ranks:
            for dtype in (torch.float32, torch.float16, torch.bfloat16):
                errors: list[float] = []
                times, sizes, spent = [], [], []
                for one in scenes:
                    whole, seconds = one.transports[resolution]
                    used = whole.truncated(rank).stored(dtype)
                    errors += _frame_errors(used, one.checked, tables)
                    times.append(_frame_milliseconds(used, repeats))
                    sizes.append(used.bytes / 1e6)
                    spent.append(seconds)
                ms, mb = float(np.mean(times)), float(np.mean(sizes))
                kind = str(dtype).removeprefix("torch.")
                points.append(
                    TradePoint(
                        rank, kind, resolution, ms, mb, *_spread(errors), float(np.mean(spent))
                    )
                )
                usual = QUALITIES["interactive"]
                if resolution == usual[1] and dtype == torch.float32:
                    knob("basis images", str(rank), ms, mb, errors)
                elif resolution == usual[1] and rank == max(ranks):
                    knob("number type", kind, ms, mb, errors)
    for name, values_of in (
        ("nodes of light", {"resolution": (0.35, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)}),
        ("visibility rays", {"shadows": (0.25, 0.5, 1.0, 2.0)}),
    ):
        [(key, chosen)] = values_of.items()
        for value in chosen[:: 2 if quick else 1]:
            given: dict[str, float] = {"resolution": 1.0, "shadows": 1.0, key: value}
            found = [
                _operator_errors(s.scene, s.fragments, s.checked.true, tables, **given)
                for s in scenes
            ]
            settings.append((name, f"x {value:g}", *np.mean(found, axis=0)[[2, 0, 1]].tolist()))
            _say_setting(settings[-1], say, "a fragment")
    for factor in (1, 2, 4, 8):
        found = []
        for one in scenes:
            rows = one.scene.environment.image.shape[0]
            changed = one.scene.changed(environment=coarser(one.scene.environment, factor))
            found.append(_operator_errors(changed, one.fragments, one.checked.true, tables))
        label = f"{rows // factor} rows"
        settings.append(("map", label, *np.mean(found, axis=0)[[2, 0, 1]].tolist()))
        _say_setting(settings[-1], say, "a fragment")
    for shape in (GRID.shape, (60, 16, 7), (45, 12, 5), (30, 8, 4)):
        coarse = [t.regrid(HalfDiffGrid(*shape)).regrid(GRID) for t in tables]
        errors = []
        for one in scenes:
            errors += _frame_errors(one.usual, one.checked, coarse)
        knob("table grid", "x".join(map(str, shape)), None, 12e-6 * math.prod(shape), errors)
    embedding = default_library().embedding
    grey, coloured = embedding.n_components
    codes = [embedding.encode(t) for t in tables]
    for share in (1.0, 0.75, 0.5, 0.25):
        kept = np.zeros(grey + 2 * coloured, bool)
        for start, length in ((0, grey), (grey, coloured), (grey + coloured, coloured)):
            kept[start : start + math.ceil(share * length)] = True
        fewer = [embedding.decode(np.where(kept, z, 0.0)) for z in codes]
        errors = []
        for one in scenes:
            errors += _frame_errors(one.usual, one.checked, fewer)
        knob("embedding", f"{int(kept.sum())} numbers", None, math.nan, errors)
    say("  -- together: the Pareto front in time, memory and error")
    front = pareto(points)
    best = knee(front)
    rate = bandwidth()
    for point in front:
        moved = _bytes_moved(scenes, point)
        limit = 1e3 * moved / rate
        mark = "  <- knee" if point is best else ""
        say(
            f"  {point.milliseconds:7.2f} ms {point.megabytes:7.1f} MB  error "
            f"{100 * point.error:6.3f} %, 95th {100 * point.error_95:6.3f} %  {point.label}; "
            f"bandwidth alone {limit:.2f} ms{mark}"
        )
    if out is not None:
        _write(out, points, front, best, settings, rate)
        say(f"  wrote all of it to {out / 'trade.json'} and {out / 'trade.png'}")
    how = (
        f"{len(scenes)} scenes of {size}x{size}, {len(tables)} unseen BRDFs, {len(points)} "
        f"settings of images, number type and resolution, {torch.get_num_threads()} threads; "
    )
    moved = _bytes_moved(scenes, best)
    yield Record(
        "knee of the trade, a frame", best.milliseconds, "ms", error=best.error,
        how=how + f"{best.label}, {best.megabytes:.0f} MB, 95th percentile "
        f"{100 * best.error_95:.2f} %",
    )  # fmt: skip
    yield Record(
        "the same, by memory bandwidth alone", 1e3 * moved / rate, "ms", error=best.error,
        how=f"{moved / 1e6:.0f} MB over {rate / 1e9:.1f} GB/s, measured",
    )  # fmt: skip
    for point, name in ((front[0], "fastest"), (min(points, key=lambda p: p.error), "most exact")):
        yield Record(
            f"{name} of the trade, a frame", point.milliseconds, "ms", error=point.error,
            how=f"{point.label}, {point.megabytes:.0f} MB",
        )  # fmt: skip
    top = {p.dtype: p for p in points if p.images == max(ranks) and p.resolution == 1.0}
    for kind in ("float16", "bfloat16"):
        yield Record(
            f"{kind} instead of float32, a frame", top[kind].milliseconds, "ms",
            error=top[kind].error,
            how=f"{top['float32'].milliseconds:.2f} ms at {100 * top['float32'].error:.3f} % in "
            f"float32; {top[kind].megabytes:.0f} MB instead of {top['float32'].megabytes:.0f}",
        )  # fmt: skip


def _say_setting(setting: tuple[str, str, float | None, float, float], say: Say, of: str) -> None:
    name, value, ms, median, high = setting
    say(
        f"  {name:22s} {value:14s} {ms:8.3f} ms {of}, error {100 * median:6.3f} %, 95th "
        f"{100 * high:6.3f} %"
    )


def _bytes_moved(scenes: Sequence[_Measured], point: TradePoint) -> float:
    """Return the bytes that a frame must read and write: basis, projection, radiance and image."""
    shown = [12 * (2 * len(s.scene.pixels) + len(s.scene.uncovered)) for s in scenes]
    return 1e6 * point.megabytes + float(np.mean(shown))


def _write(
    out: Path,
    points: Sequence[TradePoint],
    front: Sequence[TradePoint],
    best: TradePoint,
    settings: Sequence[tuple[str, str, float | None, float, float]],
    rate: float,
) -> None:
    """Write ``trade.json`` and ``trade.png``."""
    out.mkdir(parents=True, exist_ok=True)
    found = {
        "together": [{**p._asdict(), "pareto": p in front, "knee": p is best} for p in points],
        "alone": [
            dict(zip(("knob", "setting", "milliseconds", "error", "error_95"), s, strict=True))
            for s in settings
        ],
        "bandwidth_bytes_a_second": rate,
    }
    with atomic_path(out / "trade.json") as temporary:
        temporary.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    with atomic_path(out / "trade.png") as temporary:
        _plot(temporary, points, front, best, settings)


def _plot(
    path: Path,
    points: Sequence[TradePoint],
    front: Sequence[TradePoint],
    best: TradePoint,
    settings: Sequence[tuple[str, str, float | None, float, float]],
) -> None:
    """Plot error over time of all settings, and the cost and effect of each knob alone."""
    try:
        figure = importlib.import_module("matplotlib.figure")
        ticker = importlib.import_module("matplotlib.ticker")
    except ImportError as error:
        raise RuntimeError("the plot needs matplotlib: pip install traitbrdf[plots]") from error
    page = figure.Figure(figsize=(11, 4.6), layout="constrained")
    left, right = page.subplots(1, 2)
    for kind, mark in (("float32", "o"), ("float16", "s"), ("bfloat16", "^")):
        some = [p for p in points if p.dtype == kind]
        left.scatter(
            [p.milliseconds for p in some], [100 * p.error for p in some],
            s=[10 + 12 * p.resolution for p in some], marker=mark, alpha=0.6, label=kind,
        )  # fmt: skip
    line = _outline(front)
    left.plot([p.milliseconds for p in line], [100 * p.error for p in line], "k-", lw=0.8)
    left.annotate(
        f"knee: {best.label}", (best.milliseconds, 100 * best.error), (0.35, 0.85),
        textcoords="axes fraction", arrowprops={"arrowstyle": "->"}, fontsize=8,
    )  # fmt: skip
    left.set(xscale="log", yscale="log", xlabel="edit to frame, ms", ylabel="frame error, %")
    left.set_title("all settings; the line is the Pareto front", fontsize=10)
    left.legend(fontsize=8)
    names = list(dict.fromkeys(s[0] for s in settings))
    for name in names:
        own = [s for s in settings if s[0] == name]
        at = np.linspace(0.0, 1.0, len(own)) if len(own) > 1 else np.zeros(1)
        right.plot(at, [100 * s[3] for s in own], ".-", lw=0.8, label=name)
        for x, s in ((at[0], own[0]), (at[-1], own[-1])):
            right.annotate(s[1], (x, 100 * s[3]), fontsize=6, ha="left" if x == 0.0 else "right")
    right.set(yscale="log", ylabel="frame error, %", xlabel="each knob from end to end", xticks=[])
    right.set_title("one knob at a time", fontsize=10)
    for axis in (left.xaxis, left.yaxis, right.yaxis):
        axis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(ticker.NullFormatter())
    right.legend(fontsize=7)
    page.savefig(path, dpi=110, format="png")
