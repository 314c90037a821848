"""Measurements behind ``traitbrdf bench``: errors and times side by side, in one run.

Every figure is a `Record`. Errors are mean relative L1 (mean|I - I_ref| / mean I_ref over covered
pixels and channels, linear radiance); answers are checked before they are timed.
"""

from __future__ import annotations

import concurrent.futures
import itertools
import math
import multiprocessing
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf import models, reference
from traitbrdf.brdf import Reflectance, TabulatedBRDF
from traitbrdf.directions import to_local
from traitbrdf.editing import QUALITIES, EditSession
from traitbrdf.embedding import Library, default_library
from traitbrdf.lights import EnvironmentMap, texel_moments
from traitbrdf.measured import MeasuredBRDF
from traitbrdf.scene import Camera, Scene
from traitbrdf.shapes import teapot
from traitbrdf.traits import default_traits
from traitbrdf.transport import Transport, training_tables

Float64 = NDArray[np.float64]
Say = Callable[[str], None]

HELD_OUT = 10
"""Every tenth library member is kept out of the bases that are measured."""


@dataclass(frozen=True)
class Record:
    """One figure. `target` and `met` are None where none is set; `error` belongs to a time."""

    name: str
    value: float
    unit: str
    target: float | None = None
    met: bool | None = None
    error: float | None = None
    how: str = ""

    @classmethod
    def at_least(cls, name: str, value: float, unit: str, target: float, **more: Any) -> Record:
        return cls(name, value, unit, target, bool(value >= target), **more)

    @classmethod
    def at_most(cls, name: str, value: float, unit: str, target: float, **more: Any) -> Record:
        return cls(name, value, unit, target, bool(value <= target), **more)

    def line(self) -> str:
        """One line of a table."""
        goal = "" if self.target is None else f"  (target {self.target:g}, "
        goal += "" if self.target is None else ("met)" if self.met else "MISSED)")
        error = "" if self.error is None else f"  at frame error {100 * self.error:.3f} %"
        return f"{self.name:44s} {self.value:10.4g} {self.unit:6s}{error}{goal}  [{self.how}]"

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def maps(data: Path | None, quick: bool) -> list[tuple[str, EnvironmentMap]]:
    """The maps of ``data/envmaps``; without that folder the procedural sky, plain and turned."""
    files = sorted((data / "envmaps").glob("*.exr")) if data else []
    if not files:
        sky = EnvironmentMap.sky()
        return [("sky", sky)] if quick else [("sky", sky), ("sky turned", sky.rotated(2.0))]
    return [(f.stem, EnvironmentMap.read(f)) for f in (files[:1] if quick else files)]


def training_library(library: Library) -> NDArray[np.float32]:
    """Channels (cells, n) of the members that are not held out."""
    kept = [z for i, z in enumerate(library.coordinates) if i % HELD_OUT]
    return np.concatenate([library.embedding.decode_values(z) for z in kept], axis=1)


def unseen(data: Path | None, seed: int = 0) -> dict[str, list[TabulatedBRDF]]:
    """Tables that no basis was fitted to, by kind.

    Held-out library members; trait moves of them, two traits at a time, amounts to +-2; models
    at the parameters of the literature; and the measured materials of ``data/rgl``.
    """
    library, space = default_library(), default_traits()
    embedding, grid = library.embedding, library.embedding.grid_
    rng = np.random.default_rng(seed)
    held = [i for i in range(len(library)) if i % HELD_OUT == 0]
    members = [library[library.names[i]] for i in held]
    moves = []
    for i in np.repeat(rng.permutation(held), 3):
        pair = rng.choice(space.names, 2, replace=False)
        amounts = {str(name): float(rng.uniform(-2.0, 2.0)) for name in pair}
        z = library.coordinates[i]
        for name, amount in amounts.items():
            z = space.move(z, {name: amount})
        moves.append(embedding.decode(z))
    closed: list[models.Model] = [models.Lambert(1.0)]
    closed += [models.NormalizedPhong(0.5, s) for s in (10.0, 100.0, 5000.0)]
    closed += [models.BoundedPhong(0.5, s) for s in (10.0, 100.0, 5000.0)]
    closed += [models.TorranceSparrowSimplified(0.5, s) for s in (0.01, 0.1, 0.2)]
    closed += [models.BoundedTorranceSparrow(0.5, s) for s in (0.01, 0.1, 0.2)]
    closed += [models.AshikhminShirley(0.2, 0.05, n, n) for n in (10.0, 1000.0)]
    closed += [models.GGX(a, 1.5) for a in (0.006, 0.03, 0.1, 0.3, 0.8)]
    closed += [models.GGX(a, 0.3, 3.3) for a in (0.006, 0.04, 0.25)]
    closed += [models.OrenNayar(0.6, sigma) for sigma in (0.2, 0.6)]
    closed += [models.Sheen(0.4, alpha) for alpha in (0.4, 0.8)]
    closed += [models.AshikhminShirley(0.0, 0.8, n, n) for n in (30.0, 300.0, 8000.0)]
    files = sorted((data / "rgl").glob("*.bsdf")) if data else []
    return {
        "held-out library": members,
        "manifold moves": moves,
        "models": [TabulatedBRDF.from_model(m, grid, repr(m)) for m in closed],
        "measured (RGL)": [TabulatedBRDF.from_model(MeasuredBRDF.read(f), grid) for f in files],
    }


def _reference_job(job: tuple[Any, ...]) -> tuple[Float64, Float64]:
    scene, index, brdfs, tolerance = job
    return reference.fragments(scene, index, brdfs, tolerance)


def reference_values(
    scene: Scene, index: NDArray[np.int64], brdfs: Sequence[Reflectance], tolerance: float
) -> tuple[Float64, Float64]:
    """The oracle at fragments `index` (m,) for B BRDFs: (m, B, 3) and its own error; all cores."""
    jobs = [
        (scene, part, brdfs, tolerance) for part in np.array_split(index, max(len(index) // 8, 1))
    ]
    cores = os.cpu_count() or 1
    if cores == 1 or len(jobs) < 4:
        done = [_reference_job(job) for job in jobs]
    else:
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(cores, mp_context=context) as pool:
            done = list(pool.map(_reference_job, jobs))
    return np.concatenate([d[0] for d in done]), np.concatenate([d[1] for d in done])


def _shade_tables(
    transport: Transport, tables: list[TabulatedBRDF], index: NDArray[np.int64]
) -> tuple[NDArray[np.float32], list[float]]:
    """(B, m, 3) compressed radiance of fragments `index` under B tables, and the stated errors."""
    scene = transport.scene
    result, stated = [], []
    for table in tables:
        cells = torch.from_numpy(
            np.ascontiguousarray(table.values.reshape(-1, 3)[transport.cells], np.float32)
        )
        frames = [transport.shade(p, cells) for p in range(len(scene.parts))]
        radiance = torch.cat([f.radiance for f in frames])
        result.append(radiance.numpy()[index])
        stated.append(transport.frame_error(frames))
    return np.stack(result), stated


def transport_error(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Transport error on unseen BRDFs: compressed frames against the oracle, same tables."""
    size, count = (48, 16) if quick else (128, 300)
    library = default_library()
    training = training_tables(training_library(library), library.embedding.grid_)
    kinds = unseen(data)
    if quick:
        kinds = {name: tables[:4] for name, tables in kinds.items()}
    tables = list(itertools.chain.from_iterable(kinds.values()))
    kind_of = np.array([name for name, members in kinds.items() for _ in members])
    lambert = next(i for i, t in enumerate(tables) if t.name.startswith("Lambert"))
    rank, resolution = QUALITIES["interactive"]
    errors, psnrs, lamberts, stated, honest = [], [], [], [], []
    rng = np.random.default_rng(1)
    for name, environment in maps(data, quick):
        scene = Scene(teapot(), environment, camera=BENCH_CAMERA, size=size, ground=True)
        transport = Transport(
            scene, library.embedding.grid_, training, rank=rank, resolution=resolution
        )
        index = np.sort(rng.choice(len(scene.pixels), count, replace=False))
        true, own = reference_values(scene, index, tables, 1e-3)
        true = np.moveaxis(true, 1, 0)
        shown, told = _shade_tables(transport, tables, index)
        error = np.array([reference.relative_error(s, t) for s, t in zip(shown, true, strict=True)])
        psnr = [
            reference.tone_mapped_psnr(s[None], t[None]) for s, t in zip(shown, true, strict=True)
        ]
        errors.append(error)
        psnrs.append(psnr)
        lamberts.append(error[lambert])
        stated.append(own.mean() / true.mean())
        honest.append(np.median(np.array(told) / np.maximum(error, 1e-6)))
        say(
            f"  {name:10s} median {100 * np.median(error):.3f} %  95th "
            f"{100 * np.quantile(error, 0.95):.2f} %  max {100 * error.max():.2f} %  Lambert "
            f"{100 * error[lambert]:.4f} %  PSNR 5th percentile {np.quantile(psnr, 0.05):.1f} dB"
        )
    whole, picture = np.stack(errors), np.array(psnrs)
    how = (
        f"teapot {size}x{size} on the ground, shadows, {count} fragments a map, {len(errors)} "
        f"maps, {len(tables)} BRDFs, r = {rank}, basis alone; oracle's own error "
        f"{100 * np.mean(stated):.3f} %"
    )
    for kind in kinds:
        of_kind = whole[:, kind_of == kind]
        if of_kind.size:
            say(
                f"  {kind:17s} median {100 * np.median(of_kind):.3f} %  95th "
                f"{100 * np.quantile(of_kind, 0.95):.2f} %  max {100 * of_kind.max():.2f} %"
            )
    percent = 100.0 * whole
    yield Record.at_most("transport error, median", float(np.median(percent)), "%", 0.3, how=how)
    yield Record.at_most(
        "transport error, 95th percentile", float(np.quantile(percent, 0.95)), "%", 1.0, how=how
    )
    yield Record.at_most("transport error, maximum", float(percent.max()), "%", 5.0, how=how)
    yield Record("tone-mapped PSNR, median", float(np.median(picture)), "dB", how=how)
    yield Record.at_least(
        "tone-mapped PSNR, 5th percentile", float(np.quantile(picture, 0.05)), "dB", 45.0, how=how
    )
    yield Record("transport error, Lambert, worst map", 100.0 * float(max(lamberts)), "%", how=how)
    yield Record("stated error over true error, median", float(np.median(honest)), "1", how=how)


def table_error(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Table error: what tabulating a closed form costs, apart from all transport."""
    size, count = (48, 12) if quick else (128, 100)
    grid = default_library().embedding.grid_
    closed: list[Any] = [
        models.Lambert(0.5),
        models.BoundedPhong(0.5, 10.0),
        models.BoundedPhong(0.5, 5000.0),
        models.BoundedTorranceSparrow(0.5, 0.01),
        models.BoundedTorranceSparrow(0.5, 0.1),
        models.GGX(0.03, 1.5),
        models.GGX(0.3, 0.2, 3.0),
        models.AshikhminShirley(0.2, 0.05, 1000.0, 1000.0),
    ]
    files = sorted((data / "rgl").glob("*.bsdf")) if data else []
    if not quick:
        closed += [MeasuredBRDF.read(f) for f in files]
    name, environment = maps(data, True)[0]
    scene = Scene(teapot(), environment, camera=BENCH_CAMERA, size=size, shadows=False)
    index = np.sort(np.random.default_rng(2).choice(len(scene.pixels), count, replace=False))
    true, _ = reference_values(scene, index, closed, 1e-3)
    tables = [TabulatedBRDF.from_model(m, grid) for m in closed]
    shown, _ = reference_values(scene, index, tables, 1e-3)
    error = [reference.relative_error(shown[:, i], true[:, i]) for i in range(len(closed))]
    for model, e in zip(closed, error, strict=True):
        say(f"  {getattr(model, 'name', '') or model!r}: {100 * e:.2f} %")
    how = f"{len(closed)} closed forms and measured BRDFs, grid {grid.shape}, map {name}"
    yield Record("table error, median", 100.0 * float(np.median(error)), "%", how=how)
    yield Record("table error, maximum", 100.0 * float(np.max(error)), "%", how=how)


BENCH_CAMERA = Camera.orbit(-55.0, 30.0, zoom=1.24)
"""The teapot over at least 40 % of the frame."""


def _bench_scene(data: Path | None, quick: bool, size: int | tuple[int, int]) -> tuple[str, Scene]:
    name, environment = maps(data, True)[0]
    camera = BENCH_CAMERA if isinstance(size, int) else replace(BENCH_CAMERA, zoom=2.2)
    return name, Scene(teapot(), environment, camera=camera, size=size, ground=True)


def _size_of(session: EditSession) -> str:
    """What a time was taken on: pixels, coverage, r, bytes, threads."""
    scene, transport = session.scene, session.prepare()
    return (
        f"{scene.width}x{scene.height}, object over {100 * scene.coverage:.0f} %, "
        f"{len(scene.pixels)} fragments with the ground, "
        f"r = {max(b.rank for b in transport.bases)}, {transport.bytes / 1e6:.0f} MB, "
        f"{torch.get_num_threads()} threads"
    )


def _edit_times(session: EditSession, parts: Sequence[str], repeats: int) -> float:
    """Median milliseconds from new coordinates of `parts` to the finished frame."""
    rng = np.random.default_rng(5)
    start_at = session.material(parts[0]).z
    times = []
    for _ in range(repeats):
        z = start_at + rng.normal(0.0, 0.02, start_at.shape)
        start = time.perf_counter()
        session.assign(list(parts), z)
        session.render()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def edit_speed(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """New coordinates to a finished frame, beside the plain sum over environment texels."""
    repeats = 8 if quick else 40
    name, scene = _bench_scene(data, quick, 128 if quick else 512)
    session = EditSession(scene, cache=False)
    shape = scene.shape.parts
    session.assign(shape, "blue-plastic")
    session.render()
    rng = np.random.default_rng(3)
    # check the answer before timing it: both ways against the oracle, on the same fragments
    own = np.flatnonzero((scene.pixel_part < len(shape)) & (scene.weights == 1.0))
    index = np.sort(rng.choice(own, 12 if quick else 64, replace=False))
    brdf = session.brdf("body")
    true, _ = reference_values(scene, index, [brdf], 1e-3)
    frame = session.render().reshape(-1, 3)[scene.pixels[index]]
    ours = reference.relative_error(frame, true[:, 0])
    start = time.perf_counter()
    plain = texel_sum(scene, index, brdf)
    texels = (time.perf_counter() - start) / len(index) * len(scene.pixels)
    how = f"{_size_of(session)}, map {name}"
    for label, parts, target in (
        ("whole object", shape, 6.0), ("handle", ("handle",), 3.0), ("body", ("body",), None),
    ):  # fmt: skip
        value = _edit_times(session, parts, repeats)
        if target is None:
            yield Record(f"edit of the {label} to frame, median", value, "ms", error=ours, how=how)
        else:
            yield Record.at_most(
                f"edit of the {label} to frame, median", value, "ms", target, error=ours, how=how
            )
    shadows_off, _ = reference_values(scene.changed(shadows=False), index, [brdf], 1e-3)
    yield Record(
        "plain sum over texels, a frame", 1e3 * texels, "ms",
        error=reference.relative_error(plain, shadows_off[:, 0]),
        how=f"NumPy, no shadows, {len(index)} pixels, scaled to {len(scene.pixels)}",
    )  # fmt: skip
    if not quick:
        _, large = _bench_scene(data, quick, (1080, 1920))
        session = EditSession(large, cache=False)
        session.assign(shape, "blue-plastic")
        start = time.perf_counter()
        session.prepare()
        prepared = time.perf_counter() - start
        session.render()
        error = session.report()["frame_error"]
        how = f"{_size_of(session)}, map {name}, error by probes"
        yield Record.at_most(
            "edit of the whole object to frame, 1080p", _edit_times(session, shape, 15), "ms",
            33.0, error=error, how=how,
        )  # fmt: skip
        yield Record("preparation, 1080p", prepared, "s", error=error, how=how)


def preparation(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Preparing a scene, the first image of a new view or light, and the memory it takes."""
    name, scene = _bench_scene(data, quick, 128 if quick else 512)
    start = time.perf_counter()
    session = EditSession(scene, cache=False)
    session.assign(scene.shape.parts, "blue-plastic")
    first = _bench_scene(data, quick, 48)[1]  # compiles, and makes the training set
    EditSession(first, cache=False).render()
    say(f"  training set and compiled code ready after {time.perf_counter() - start:.1f} s")
    start = time.perf_counter()
    session.prepare()
    prepared = time.perf_counter() - start
    session.render()
    error = session.report()["frame_error"]
    how = f"{_size_of(session)}, map {name}, error by probes"
    yield Record.at_most("preparation", prepared, "s", 15.0, error=error, how=how)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e9 if _IN_BYTES else 1e6)
    yield Record.at_most("peak memory so far", peak, "GB", 1.5, how=how)
    turned = replace(scene.camera, azimuth=scene.camera.azimuth + 20.0)
    session.draft()
    for label, change in (("view", {"camera": turned}), ("light", {"rotation": 1.0})):
        start = time.perf_counter()
        session.look(**change)  # type: ignore[arg-type]
        image, drafted = session.draft()
        seconds = time.perf_counter() - start
        say(f"  draft of {image.shape[1]}x{image.shape[0]} from 128 pixels, {label} changed")
        yield Record.at_most(
            f"first image after a change of {label}", seconds, "s", 0.5, error=drafted, how=how
        )


def texel_sum(scene: Scene, index: NDArray[np.int64], brdf: TabulatedBRDF) -> Float64:
    """Radiance (m, 3) by one look-up for each texel, at its centre: the plain way, no shadows."""
    environment = scene.environment
    moment = texel_moments(environment).reshape(-1, 3)
    omega = np.linalg.norm(moment, axis=-1, keepdims=True)
    toward = moment / omega
    energy = environment.image.reshape(-1, 3) * omega
    result = np.zeros((len(index), 3))
    for i, p in enumerate(index):
        sample = scene.offsets[p]  # of a fragment of one sample
        normal = environment.to_map(scene.normals[sample])
        view = environment.to_map(scene.views[sample])
        above = toward @ normal > 0.0
        wi = to_local(toward[above], np.broadcast_to(normal, toward[above].shape))
        wo = to_local(view, normal)
        f = brdf.eval(wi, np.broadcast_to(wo, wi.shape))
        result[i] = np.sum(f * energy[above] * wi[:, 2:], axis=0)
    return result


_IN_BYTES = sys.platform == "darwin"

BENCHES: dict[str, Callable[[Path | None, bool, Say], Iterator[Record]]] = {
    "transport": transport_error,
    "table": table_error,
    "edit": edit_speed,
    "prepare": preparation,
}


def default_data() -> Path | None:
    """The folder of maps and measured materials: $TRAITBRDF_SHARED, or ../shared/data."""
    for place in (os.environ.get("TRAITBRDF_SHARED"), "../shared/data"):
        if place and (Path(place) / "envmaps").is_dir():
            return Path(place)
    return None


def run(names: list[str], data: Path | None, quick: bool, say: Say) -> list[Record]:
    """Run benches by name (all where none is named); `say` gets every line as it is known."""
    records = []
    for name in names or list(BENCHES):
        say(f"{name}: {(BENCHES[name].__doc__ or '').splitlines()[0]}")
        start = time.perf_counter()
        for record in BENCHES[name](data, quick, say):
            if not math.isfinite(record.value):
                raise ArithmeticError(f"{record.name}: not a finite number")
            records.append(record)
            say(record.line())
        say(f"  ({time.perf_counter() - start:.0f} s)")
    return records
