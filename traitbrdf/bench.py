"""Measurements behind ``traitbrdf bench``: errors and times side by side, in one run.

Every figure is a `Record`. Errors are mean relative L1 (mean|I - I_ref| / mean I_ref over covered
pixels and channels, linear radiance) against the reference, shadows included; answers are checked
before they are timed.
"""

from __future__ import annotations

import concurrent.futures
import importlib
import itertools
import math
import multiprocessing
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf import editing, models, peers, reference
from traitbrdf.brdf import (
    ALBEDO_ANGLES,
    HalfDiffGrid,
    Reflectance,
    TabulatedBRDF,
    albedo_operator,
)
from traitbrdf.directions import from_half_diff_angles, shading_frame, to_local
from traitbrdf.editing import EXACT_ABOVE, EditSession, trusted_error
from traitbrdf.embedding import FLOOR, BRDFEmbedding, Library, default_library
from traitbrdf.gallery import own_colours
from traitbrdf.lights import EnvironmentMap, texel_moments
from traitbrdf.measured import MeasuredBRDF
from traitbrdf.profiles import HIGHLIGHT
from traitbrdf.promises import QUALITIES, TRUSTED
from traitbrdf.scene import Camera, Scene
from traitbrdf.shapes import sphere, teapot
from traitbrdf.traits import default_traits
from traitbrdf.transport import Operator, Training, Transport, training_tables

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Say = Callable[[str], None]

HELD_OUT = 10
"""Every tenth library member is kept out of the bases that are measured."""

BENCH_CAMERA = Camera.orbit(-55.0, 30.0, zoom=1.24)
"""The teapot over 40 % of a square frame, without the ground."""

WIDE_CAMERA = Camera.orbit(-55.0, 30.0, zoom=1.65)
"""The same over 40 % of a frame of 16:9; its foot is cut off."""

PEER_MATERIALS = ("blue-plastic", "gold-polished", "red-rubber")
"""Members of the library whose edits are timed beside Mitsuba's: glossy, sharp, and dull."""

_SEEDS = 16  # over so many frames the error of a number of samples is averaged
_MANY = 16384  # samples a pixel that count as converged

LEFT_OUT = ("polished-metal", "car-paint", "rubber", "silk", "velvet", "dusty")
"""Families that are left out of training in turn."""


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
    def at_most(cls, name: str, value: float, unit: str, target: float, **more: Any) -> Record:
        return cls(name, value, unit, target, bool(value <= target), **more)

    @classmethod
    def at_least(cls, name: str, value: float, unit: str, target: float, **more: Any) -> Record:
        return cls(name, value, unit, target, bool(value >= target), **more)

    def line(self) -> str:
        """One line of a table."""
        goal = "" if self.target is None else f"  (target {self.target:g}, "
        goal += "" if self.target is None else ("met)" if self.met else "MISSED)")
        error = "" if self.error is None else f"  at frame error {100 * self.error:.3f} %"
        return f"{self.name:44s} {self.value:10.4g} {self.unit:6s}{error}{goal}  [{self.how}]"

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


# -- what is measured on --------------------------------------------------------------------------


def maps(data: Path | None, quick: bool) -> list[tuple[str, EnvironmentMap]]:
    """The maps of ``data/envmaps``; without that folder the procedural sky, plain and turned."""
    files = sorted((data / "envmaps").glob("*.exr")) if data else []
    if not files:
        sky = EnvironmentMap.sky()
        return [("sky", sky)] if quick else [("sky", sky), ("sky turned", sky.rotated(2.0))]
    return [(f.stem, EnvironmentMap.read(f)) for f in (files[:1] if quick else files)]


def training_set(library: Library, quick: bool) -> Training:
    """What a session trains its bases with, but for every tenth member; a third of it if quick."""
    members = editing.trained_members(library)
    kept = [library.coordinates[i] for i in members if i % HELD_OUT]
    channels = [library.embedding.decode_values(z) for z in (kept[::3] if quick else kept)]
    whole = training_tables(np.concatenate(channels, axis=1), library.embedding.grid_)
    if not quick:
        return whole
    return Training(np.ascontiguousarray(whole.tables[:, ::3]), whole.weight[::3])


def fresh_recipes(count: int, seed: int = 1) -> list[TabulatedBRDF]:
    """Materials of all families that the library was not made of: its recipe with another seed.

    Empty where the recipe (the folder data_gen of the repository) is not at hand.
    """
    try:
        # by name: the package does without it
        recipes = importlib.import_module("data_gen.families")
    except ImportError:
        return []
    grid = default_library().embedding.grid_
    # the curated materials come first and are the same for every seed
    drawn = zip(
        recipes.materials(seed, count + 100), recipes.materials(seed + 1, count + 100), strict=True
    )
    new = [material for material, other in drawn if material.model != other.model][:count]
    return [TabulatedBRDF.from_model(m.model, grid, f"{m.family} {m.name}") for m in new]


def unseen(data: Path | None, quick: bool = False, seed: int = 0) -> dict[str, list[TabulatedBRDF]]:
    """Some 200 tables (20 if quick) that no basis was fitted to, by kind.

    Held-out library members; new members of every family; trait moves of held-out members, two
    traits at a time, amounts to +-2; closed forms at the parameters of the literature; and the
    measured materials of ``data/rgl``. Where new members cannot be made, there are more moves.
    """
    library, space = default_library(), default_traits()
    embedding, grid = library.embedding, library.embedding.grid_
    rng = np.random.default_rng(seed)
    held = [i for i in range(len(library)) if i % HELD_OUT == 0]
    members = [library[library.names[i]] for i in rng.permutation(held)[: 4 if quick else 24]]
    recipes = fresh_recipes(4 if quick else 104)
    moves = []
    count = (8 if quick else 160) - len(recipes)
    for i in itertools.islice(itertools.cycle(rng.permutation(held)), count):
        pair = rng.choice(space.names, 2, replace=False)
        amounts = {str(name): float(rng.uniform(-2.0, 2.0)) for name in pair}
        z = library.coordinates[i]
        for name, amount in amounts.items():
            z = space.move(z, {name: amount})
        moves.append(embedding.decode(z))
    closed: list[models.Model] = [models.Lambert(1.0)]
    closed += [models.NormalizedPhong(0.5, s) for s in (5000.0, 100.0, 10.0)]
    closed += [models.TorranceSparrowSimplified(0.5, s) for s in (0.01, 0.1, 0.2)]
    closed += [models.BoundedPhong(0.5, s) for s in (10.0, 100.0, 5000.0)]
    closed += [models.BoundedTorranceSparrow(0.5, s) for s in (0.01, 0.1, 0.2)]
    closed += [models.AshikhminShirley(0.2, 0.05, n, n) for n in (10.0, 1000.0)]
    closed += [models.GGX(a, 1.5) for a in (0.03, 0.3)]
    files = sorted((data / "rgl").glob("*.bsdf")) if data else []
    if quick:
        closed, files = closed[:5], files[:2]
    kinds = {
        "held-out library": members,
        "new recipes": recipes,
        "manifold moves": moves,
        "models": [TabulatedBRDF.from_model(m, grid, repr(m)) for m in closed],
        "measured (RGL)": [TabulatedBRDF.from_model(MeasuredBRDF.read(f), grid) for f in files],
    }
    return {kind: tables for kind, tables in kinds.items() if tables}


def channels(tables: Sequence[TabulatedBRDF]) -> Float32:
    """(cells, 3 B) of B tables, each colour channel a column."""
    flat = [table.values.reshape(-1, 3).astype(np.float32) for table in tables]
    return np.concatenate(flat, axis=1)


# -- the oracle -----------------------------------------------------------------------------------

_BRDFS: list[Reflectance] = []
"""What a process of the oracle computes: it is sent once."""


def _take_brdfs(brdfs: Sequence[Reflectance]) -> None:
    _BRDFS[:] = brdfs


def _reference_job(job: tuple[Scene, Int64, float]) -> tuple[Float64, Float64]:
    scene, index, tolerance = job
    return _fragments(scene, index, _BRDFS, tolerance)


def _fragments(
    scene: Scene, index: Int64, brdfs: Sequence[Reflectance], tolerance: float
) -> tuple[Float64, Float64]:
    """`reference.fragments`, NaN where the tolerance is not reached."""
    try:
        return reference.fragments(scene, index, brdfs, tolerance)
    except reference.IntegrationError:
        if len(index) == 1:
            unknown = np.full((1, len(brdfs), 3), np.nan)
            return unknown, unknown
    halves = [_fragments(scene, half, brdfs, tolerance) for half in np.array_split(index, 2)]
    values, errors = (np.concatenate(each) for each in zip(*halves, strict=True))
    return values, errors


class Oracle:
    """`reference.fragments` for the same BRDFs again and again, on all cores.

    Where it refuses (next to grazing views some lobes need too many cells) there is NaN.

    Parameters
    ----------
    brdfs : B reflectances
    tolerance : of each sample, relative to its largest channel
    cores : processes; one of them is this one, without any other
    """

    def __init__(
        self, brdfs: Sequence[Reflectance], tolerance: float = 1e-3, cores: int | None = None
    ) -> None:
        self.brdfs = list(brdfs)
        self.tolerance = tolerance
        self.cores = (os.cpu_count() or 1) if cores is None else cores
        self._pool: concurrent.futures.ProcessPoolExecutor | None = None

    def __enter__(self) -> Oracle:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def __call__(self, scene: Scene, index: Int64) -> tuple[Float64, Float64]:
        """Radiance (m, B, 3) of fragments `index` (m,), and its own error."""
        if self.cores == 1 or len(index) < 32:
            return _fragments(scene, index, self.brdfs, self.tolerance)
        if self._pool is None:
            self._pool = concurrent.futures.ProcessPoolExecutor(
                self.cores,
                mp_context=multiprocessing.get_context("spawn"),
                initializer=_take_brdfs,
                initargs=(self.brdfs,),
            )
        # every n-th, so that parts and borders are shared out
        jobs = max(4 * self.cores, len(index) // 16)
        parts = [np.arange(k, len(index), jobs) for k in range(jobs)]
        done = list(
            self._pool.map(_reference_job, [(scene, index[p], self.tolerance) for p in parts])
        )
        back = np.argsort(np.concatenate(parts))
        values, errors = (np.concatenate(each)[back] for each in zip(*done, strict=True))
        return values, errors


def reference_values(
    scene: Scene, index: Int64, brdfs: Sequence[Reflectance], tolerance: float
) -> tuple[Float64, Float64]:
    """The oracle at fragments `index` (m,) for B BRDFs: (m, B, 3) and its own error; all cores.

    NaN where it refuses.
    """
    with Oracle(brdfs, tolerance) as oracle:
        return oracle(scene, index)


def _drawn(
    oracle: Oracle, scene: Scene, among: Int64, count: int, rng: np.random.Generator
) -> tuple[Int64, Float64, Float64]:
    """Random fragments of `among` (m,), what the oracle says of them, and its own error.

    Those that it refuses are replaced by others.
    """
    order = rng.permutation(among)
    index = np.sort(order[: count + count // 20])
    values, errors = oracle(scene, index)
    known = np.flatnonzero(np.isfinite(values).all(axis=(1, 2)))[:count]
    return index[known], values[known], errors[known]


def _errors(shown: NDArray[Any], true: Float64) -> Float64:
    """(B,) mean relative L1 of radiance (m, B, 3)."""
    return np.array(
        [reference.relative_error(shown[:, b], true[:, b]) for b in range(true.shape[1])]
    )


# -- transport ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Shown:
    """Fragments (m,) under B tables: by the basis, and as a session would show them."""

    basis: Float32  # (m, B, 3)
    final: Float32  # (m, B, 3)
    measured: Float64  # (parts, B) measured error of each part's basis frame
    refused: NDArray[np.bool_]  # (parts, B) where a session does not trust the basis


def _shown(transport: Transport, tables: Sequence[TabulatedBRDF], index: Int64) -> _Shown:
    """What is shown of tables that are assigned one after the other, to a session that learns
    nothing from them: by the basis where its measured error is small, exactly elsewhere."""
    scene = transport.scene
    whole = np.empty((len(scene.pixels), len(tables), 3), np.float32)
    measured = np.zeros((len(scene.parts), len(tables)))
    for b, table in enumerate(tables):
        cells = torch.from_numpy(
            np.ascontiguousarray(table.values.reshape(-1, 3)[transport.cells], np.float32)
        )
        for part in range(len(scene.parts)):
            frame = transport.shade(part, cells)
            whole[scene.part_slice(part), b] = frame.radiance.numpy()
            measured[part, b] = frame.error
    trusted = np.array([trusted_error(scene, part) for part in range(len(scene.parts))])
    refused = measured > trusted[:, None]
    basis = whole[index]
    final = basis.copy()
    for part in range(len(scene.parts)):
        span = scene.part_slice(part)
        mine = np.flatnonzero((index >= span.start) & (index < span.stop))
        wrong = np.flatnonzero(refused[part])
        for some in np.array_split(wrong, math.ceil(len(wrong) / 16)) if len(wrong) else []:
            own = channels([tables[b] for b in some])
            images = transport.operator.part_images(part, own, interpolate=False)
            exact = own_colours(images[index[mine] - span.start])
            final[mine[:, None], some] = exact
    return _Shown(basis, final, measured, refused)


def _bench_scene(environment: EnvironmentMap, size: int | tuple[int, int], **more: Any) -> Scene:
    return Scene(teapot(), environment, camera=BENCH_CAMERA, size=size, ground=True, **more)


def _how_much(transport: Transport) -> str:
    """Pixels, r and bytes of a frame."""
    scene = transport.scene
    covered = int(np.count_nonzero(scene.uncovered < 1.0))
    return (
        f"{scene.width}x{scene.height}, {covered} covered pixels "
        f"({100 * (1.0 - scene.uncovered.mean()):.0f} %, the object {100 * scene.coverage:.1f} %), "
        f"r = {transport.rank}, {transport.bytes / 1e6:.0f} MB"
    )


def transport_error(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Transport error on unseen BRDFs: compressed frames against the oracle, same tables."""
    size, count = (48, 16) if quick else (512, 120)
    library = default_library()
    grid = library.embedding.grid_
    training = training_set(library, quick)
    kinds = unseen(data, quick)
    tables = list(itertools.chain.from_iterable(kinds.values()))
    kind_of = np.array([name for name, members in kinds.items() for _ in members])
    lambert = next(i for i, t in enumerate(tables) if t.name.startswith("Lambert"))
    rank, resolution = QUALITIES["interactive"]
    alone, shown, psnrs, own, exact, stated = [], [], [], [], [], []
    used = 0
    rng = np.random.default_rng(1)
    with Oracle(tables) as oracle:
        for name, environment in maps(data, quick):
            scene = _bench_scene(environment, size)
            transport = Transport(scene, grid, training, rank=rank, resolution=resolution)
            index, true, oracles = _drawn(oracle, scene, np.arange(len(scene.pixels)), count, rng)
            used += len(index)
            seen = _shown(transport, tables, index)
            alone.append(_errors(seen.basis, true))
            shown.append(_errors(seen.final, true))
            psnrs.append(
                [
                    reference.tone_mapped_psnr(seen.final[None, :, b], true[None, :, b])
                    for b in range(len(tables))
                ]
            )
            own.append(oracles.mean() / true.mean())
            area = np.bincount(scene.pixel_part, minlength=len(scene.parts)) / len(scene.pixels)
            exact.append(area @ seen.refused)
            stated.append(area @ seen.measured)
            say(
                f"  {name:10s} {_spread(shown[-1])}  Lambert {100 * shown[-1][lambert]:.4f} %  "
                f"PSNR 5th percentile {np.quantile(psnrs[-1], 0.05):.1f} dB; the basis alone "
                f"{_spread(alone[-1])}, of which {100 * exact[-1].mean():.1f} % were refused"
            )
    final, basis, picture = np.stack(shown), np.stack(alone), np.array(psnrs)
    refused = float(np.mean(exact))
    how = (
        f"teapot on the ground with shadows, {size}x{size}, {used / len(final):.0f} fragments a "
        f"map, {len(final)} maps, {len(tables)} BRDFs ("
        + ", ".join(f"{len(members)} {kind}" for kind, members in kinds.items())
        + f"), r = {rank}, {transport.bytes / 1e6:.0f} MB; oracle's own error "
        f"{100 * np.mean(own):.3f} %"
    )
    for kind in kinds:
        mine = kind_of == kind
        say(
            f"  {kind:17s} {_spread(final[:, mine])}; the basis alone {_spread(basis[:, mine])}, "
            f"of which {100 * np.mean(np.array(exact)[:, mine]):.1f} % were refused"
        )
    worst = np.unravel_index(np.argmax(final), final.shape)
    say(f"  worst: {tables[worst[1]].name} under map {worst[0] + 1}")
    ratio = np.array(stated) / np.maximum(basis, 1e-12)
    say(
        f"  stated / true error of the basis: median {np.median(ratio):.2f}, 5th to 95th "
        f"percentile {np.quantile(ratio, 0.05):.2f} to {np.quantile(ratio, 0.95):.2f}"
    )
    percent = 100.0 * final
    as_shown = f"basis where trusted, else exact ({100 * refused:.1f} % of the fragments); {how}"
    yield Record.at_most(
        "transport error, median", float(np.median(percent)), "%", 0.3, how=as_shown
    )
    yield Record.at_most(
        "transport error, 95th percentile", float(np.quantile(percent, 0.95)), "%", 1.0,
        how=as_shown,
    )  # fmt: skip
    yield Record.at_most("transport error, maximum", float(percent.max()), "%", 5.0, how=as_shown)
    yield Record.at_least(
        "tone-mapped PSNR, 5th percentile", float(np.quantile(picture, 0.05)), "dB", 45.0,
        how=as_shown,
    )  # fmt: skip
    yield Record("tone-mapped PSNR, median", float(np.median(picture)), "dB", how=as_shown)
    for name, value in (
        ("median", np.median(basis)),
        ("95th percentile", np.quantile(basis, 0.95)),
        ("maximum", basis.max()),
    ):
        yield Record(f"basis alone, {name}", 100.0 * float(value), "%", how=how)
    yield Record.at_most(
        "transport error, Lambert, worst map", 100.0 * float(basis[:, lambert].max()), "%", 0.1,
        how=how,
    )  # fmt: skip


def _spread(errors: Float64) -> str:
    percent = 100.0 * np.asarray(errors)
    return (
        f"median {np.median(percent):.3f} %  95th {np.quantile(percent, 0.95):.2f} %  "
        f"max {percent.max():.2f} %"
    )


def family_error(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Families left out of training: are their frames' errors noticed, and what is shown then?"""
    size, count, members = (40, 24, 4) if quick else (512, 240, 12)
    library = default_library()
    grid = library.embedding.grid_
    families = LEFT_OUT[:1] if quick else LEFT_OUT
    own = {
        family: [library[n] for n, f in zip(library.names, library.families, strict=True)
                 if f == family][:members]
        for family in families
    }  # fmt: skip
    tables = list(itertools.chain.from_iterable(own.values()))
    rank, resolution = QUALITIES["interactive"]
    truly, found, after = [], [], []
    rng = np.random.default_rng(5)
    with Oracle(tables) as oracle:
        for name, environment in maps(data, quick)[:: 1 if data is None else 5]:
            scene = _bench_scene(environment, size)
            # the whole shape is made of the material: its frame is what a person looks at
            parts = len(scene.shape.parts)
            own_fragments = np.arange(scene.part_slice(parts - 1).stop)
            area = np.bincount(scene.pixel_part[own_fragments], minlength=parts)
            area = area / area.sum()
            index, true, _ = _drawn(oracle, scene, own_fragments, count, rng)
            start = 0
            for family, mine in own.items():
                others = [
                    library.embedding.decode_values(z)
                    for z, f in zip(library.coordinates, library.families, strict=True)
                    if f != family
                ][:: 6 if quick else 1]
                # no closed forms either: many of them are what the family is made of
                channels = np.concatenate(others, axis=1)
                training = Training(channels, np.ones(channels.shape[1]))
                transport = Transport(scene, grid, training, rank=rank, resolution=resolution)
                seen = _shown(transport, mine, index)
                target = true[:, start : start + len(mine)]
                start += len(mine)
                truly.append(_errors(seen.basis, target))
                after.append(_errors(seen.final, target))
                found.append(area @ seen.measured[:parts] > TRUSTED * EXACT_ABOVE)
                wrong = truly[-1] > EXACT_ABOVE
                say(
                    f"  {name:10s} {family:15s} basis {_spread(truly[-1])}; {wrong.sum()} above "
                    f"1 %, {found[-1][wrong].sum()} of them noticed; then {_spread(after[-1])}"
                )
    wrong = np.concatenate(truly) > EXACT_ABOVE
    refused, shown = np.concatenate(found), np.concatenate(after)
    how = (
        f"{', '.join(families)} left out in turn, and all closed forms; teapot on the ground with "
        f"shadows, {size}x{size}, r = {rank}; a case is a BRDF on the whole shape under a map, "
        f"{len(wrong)} of them, {count} fragments each"
    )
    yield Record("left out: cases with an error above 1 %", float(wrong.sum()), "", how=how)
    if wrong.any():
        yield Record.at_least(
            "left out: of these noticed", 100.0 * float(refused[wrong].mean()), "%", 100.0, how=how
        )
        noticed = wrong & refused
        if noticed.any():
            yield Record(
                "left out: error of these as shown, median",
                100.0 * float(np.median(shown[noticed])), "%", how=how,
            )  # fmt: skip
            yield Record.at_most(
                "left out: error of these as shown, maximum",
                100.0 * float(shown[noticed].max()), "%", 1.0, how=how,
            )  # fmt: skip
    yield Record(
        "left out: error of all as shown, 95th percentile",
        100.0 * float(np.quantile(shown, 0.95)), "%", how=how,
    )  # fmt: skip


# -- shadows --------------------------------------------------------------------------------------


def shadow_error(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Shadows: the operator in the shade against the oracle, and a small sun's shadow by rays."""
    size, count = (64, 16) if quick else (128, 150)
    library = default_library()
    grid = library.embedding.grid_
    tables = [library[name] for name in library.names[1 :: 80 if quick else 20]]
    grey = np.full((grid.size, 1), 1.0 / math.pi, np.float32)
    _, resolution = QUALITIES["interactive"]
    rng = np.random.default_rng(6)
    errors = []
    with Oracle(tables) as oracle:
        for name, environment in [
            *maps(data, quick),
            ("sky, 64 rows", EnvironmentMap.sky(rows=64)),
        ]:
            scene = _bench_scene(environment, size)
            ground = scene.parts.index("ground")
            span = scene.part_slice(ground)
            operator = Operator(scene, grid, resolution)
            lit = operator.part_images(ground, grey)[:, 1, 0]
            free = Operator(scene.changed(shadows=False), grid, resolution)
            unhidden = free.part_images(ground, grey)[:, 1, 0]
            dark = np.flatnonzero(lit < 0.9 * unhidden)
            index, true, _ = _drawn(oracle, scene, dark + span.start, count, rng)
            images = operator.part_images(ground, channels(tables))[index - span.start]
            errors.append(_errors(own_colours(images), true))
            say(f"  {name:12s} {_spread(errors[-1])}")
    percent = 100.0 * np.stack(errors)
    how = (
        f"teapot on the ground, {size}x{size}, {count} ground fragments that lose a tenth of "
        f"their light or more, {len(tables)} library tables, {len(errors)} maps, uncompressed"
    )
    yield Record.at_most("error in the shade, median", float(np.median(percent)), "%", 1.0, how=how)
    yield Record("error in the shade, maximum", float(percent.max()), "%", how=how)
    right = total = 0
    # of a size at which a shadow has no penumbra to speak of
    suns = [(0.28, 0.33, 512), (0.2, 0.6, 256), (0.35, 0.9, 256), (0.15, 0.1, 512)]
    for v, u, rows in suns[: 1 if quick else None]:
        row, column = int(v * rows), int(u * 2 * rows)
        image = np.full((rows, 2 * rows, 3), 1e-3)
        image[row, column] = 1e4
        scene = _bench_scene(EnvironmentMap(image), size)
        agree, fragments = _sharp_shadows(scene, (row, column), Operator(scene, grid, resolution))
        say(f"  sun in one texel of {rows} x {2 * rows}: {agree} of {fragments} fragments right")
        right, total = right + agree, total + fragments
    yield Record.at_least(
        "a one-texel sun: lit or dark as a ray says", 100.0 * right / total, "%", 100.0,
        how=f"{total} fragments of all parts, {size}x{size}, interpolated as in frames",
    )  # fmt: skip


def _sharp_shadows(scene: Scene, texel: tuple[int, int], operator: Operator) -> tuple[int, int]:
    """How many fragments are lit by a map's one bright texel as a ray towards it says, and of
    how many: those of one sample that do not graze its light."""
    moment = texel_moments(scene.environment)[texel]
    omega = float(np.linalg.norm(moment))
    toward = moment / omega
    grey = np.full((operator.grid.size, 1), 1.0 / math.pi, np.float32)
    full = float(scene.environment.image[texel][1]) * omega / math.pi
    right = total = 0
    for part in range(len(scene.parts)):
        span = scene.part_slice(part)
        index = np.arange(span.start, span.stop)[~scene.bordering[span]]
        sample = scene.offsets[index]
        cos = scene.normals[sample] @ toward
        keep = cos > 0.15
        index, sample, cos = index[keep], sample[keep], cos[keep]
        free = scene.visible(sample, np.broadcast_to(toward, (len(sample), 3)))
        shown = operator.part_images(part, grey)[index - span.start, 1, 0] / (full * cos)
        right += int(np.count_nonzero((shown > 0.5) == free))
        total += len(index)
    return right, total


# -- tables ---------------------------------------------------------------------------------------


def table_error(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Table error: what tabulating a closed form costs, apart from all transport."""
    size, count = (48, 4) if quick else (128, 100)
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
    scene = _bench_scene(environment, size, shadows=False)
    tables = [TabulatedBRDF.from_model(m, grid) for m in closed]
    with Oracle([*closed, *tables]) as oracle:
        _, values, _ = _drawn(
            oracle, scene, np.arange(len(scene.pixels)), count, np.random.default_rng(2)
        )
    true, shown = np.split(values, 2, axis=1)
    error = _errors(shown, true)
    for model, e in zip(closed, error, strict=True):
        say(f"  {getattr(model, 'name', '') or model!r}: {100 * e:.2f} %")
    how = f"{len(closed)} closed forms and measured BRDFs, grid {grid.shape}, map {name}"
    yield Record("table error, median", 100.0 * float(np.median(error)), "%", how=how)
    yield Record("table error, maximum", 100.0 * float(np.max(error)), "%", how=how)


def embedding_error(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Embedding error: measured materials that the library knows nothing of, rendered ones, what
    random coordinates look like, and decoding times."""
    library = default_library()
    embedding = library.embedding
    grid, k = embedding.grid_, embedding.size
    for known in measured_sets(data) if data else ():
        named = known.materials.items()
        errors = {name: log_error(embedding, known.angles, rgb) for name, rgb in named}
        medians = {name: float(np.median(error)) for name, error in errors.items()}
        middle = float(np.median(list(medians.values())))
        how = f"median |d log f| within 75 degrees, {len(errors)} materials, {k} numbers each"
        if known.name == "MERL":
            peak = known.angles[0] < math.radians(10.0)
            high = [float(np.median(error[peak])) for error in errors.values()]
            worse, worst = np.quantile(list(medians.values()), 0.9), np.quantile(high, 0.9)
            for part, value, limit in (
                ("MERL, median", middle, 0.07),
                ("MERL, 90th", worse, 0.13),
                ("MERL highlights, median", np.median(high), 0.15),
                ("MERL highlights, 90th", worst, 0.35),
            ):
                yield Record.at_most(part, float(value), "", limit, how=how)
        else:
            for name, median in medians.items():
                say(f"  {name}: {median:.3f}")
            yield Record.at_most(f"{known.name}, median", middle, "", 0.12, how=how)
            yield Record(f"{known.name}, maximum", max(medians.values()), "", how=how)
    yield from _rendered_error(embedding, data, quick, say)
    yield from _gamut(embedding, 100 if quick else 10_000)
    z = library.coordinates[library.index("blue-plastic")]
    rng = np.random.default_rng(0)
    cells = np.sort(rng.choice(grid.size, min(16_000, grid.size), replace=False))
    full, fine = embedding.decode(z), HalfDiffGrid.merl()
    exact = embedding.decode_tensor(torch.from_numpy(z.astype(np.float64)), None, cells).numpy()
    away = np.abs(embedding.decode_values(z, None, cells) - exact)
    yield Record.at_most(
        "decoding the cells of a scene",
        milliseconds(lambda: embedding.decode_values(z, None, cells), 5 if quick else 60),
        "ms",
        1.0,
        error=float(away.sum() / exact.sum()),
        how=f"{len(cells)} cells, energy checked; error: by float64",
    )
    cosine = embedding.weight_.reshape(*grid.shape, 1) ** 2
    away = np.abs(embedding.decode(z, fine).regrid(grid).values - full.values) * cosine
    yield Record.at_most(
        "decoding a full table",
        milliseconds(lambda: embedding.decode(z, fine), 1 if quick else 9),
        "ms",
        100.0,
        error=float(away.sum() / (full.values * cosine).sum()),
        how=f"grid {fine.shape}; error: there and back, by the lower cosine",
    )


def _rendered_error(
    embedding: BRDFEmbedding, data: Path | None, quick: bool, say: Say
) -> Iterator[Record]:
    """A sphere of materials that were encoded, beside the sphere of the materials themselves."""
    every = dict(maps(data, quick))
    three = {name: every[name] for name in RENDERED_UNDER if name in every} or every
    size = 32 if quick else 96
    grid, k = embedding.grid_, embedding.size
    files = sorted((data / "rgl").glob("*.bsdf")) if data else []
    sets = {
        "RGL": [TabulatedBRDF.from_model(MeasuredBRDF.read(f), grid, f.stem) for f in files],
        # two of every family: members that the library would have under another seed
        "held-out library": fresh_recipes(4 if quick else 68, seed=2),
    }
    for kind, tables in sets.items():
        if not tables:
            continue
        start = time.perf_counter()
        shown = [embedding.decode(embedding.encode(table)) for table in tables]
        seconds = (time.perf_counter() - start) / len(tables)
        linear, exposed, error = spheres_compared(tables, shown, list(three.values()), size)
        worst = int(np.argmax(error.mean(axis=0)))
        say(f"  {kind}, rendered: worst {tables[worst].name}")
        how = (
            f"{len(tables)} materials, {k} numbers each, on a sphere of {size}x{size} under "
            f"{', '.join(three)}; encoded in {seconds:.2f} s each"
        )
        middle = 100.0 * float(np.median(error))
        if kind == "RGL":
            peak, mean = f"peak: the brightest of the image; {how}", float(np.mean(linear))
            yield Record.at_least(f"{kind}, rendered, mean PSNR", mean, "dB", 42.0, how=peak)
            yield Record(f"{kind}, rendered L1, median", middle, "%", how=how)
        else:
            yield Record.at_most(f"{kind}, rendered L1, median", middle, "%", 1.0, how=how)
        picture = f"exposed and clipped, peak 1; {how}"
        mean = float(np.mean(exposed))
        yield Record(f"{kind}, rendered as a picture, mean PSNR", mean, "dB", how=picture)


def spheres_compared(
    tables: Sequence[TabulatedBRDF],
    shown: Sequence[TabulatedBRDF],
    environments: Sequence[EnvironmentMap],
    size: int,
) -> tuple[Float64, Float64, Float64]:
    """A sphere of each table beside one of what is shown of it, (maps, tables) each: linear PSNR
    in dB (peak: the brightest of the image), that of the exposed and clipped picture (peak 1; nine
    tenths of the pixels are below 0.8), and mean relative L1."""
    linear, exposed, error = np.empty((3, len(environments), len(tables)))
    for m, environment in enumerate(environments):
        operator = Operator(Scene(sphere(), environment, size=size), tables[0].grid)
        images = own_colours(operator.part_images(0, channels([*tables, *shown])))
        for i, (true, found) in enumerate(zip(*np.split(images.swapaxes(0, 1), 2), strict=True)):
            linear[m, i] = decibels(float(true.max()), float(np.mean((true - found) ** 2)))
            scale = 0.8 / np.quantile(true.max(axis=1), 0.9)
            clipped = np.clip([true * scale, found * scale], 0.0, 1.0)
            exposed[m, i] = decibels(1.0, float(np.mean((clipped[0] - clipped[1]) ** 2)))
            error[m, i] = reference.relative_error(found, true)
    return linear, exposed, error


def decibels(peak: float, square: float) -> float:
    """PSNR of a mean squared difference."""
    return 10.0 * math.log10(peak**2 / max(square, 1e-20))


def _gamut(embedding: BRDFEmbedding, count: int) -> Iterator[Record]:
    """Random coordinates of the gamut box: passive, and without holes in their highlights."""
    rng = np.random.default_rng(0)
    grid = embedding.grid_
    rows = albedo_operator(grid, ALBEDO_ANGLES)
    least, albedo, hole = math.inf, 0.0, []
    for _ in range(count):
        values = embedding.decode_values(rng.uniform(embedding.low_, embedding.high_))
        least = min(least, float(values.min()))
        albedo = max(albedo, float((rows @ values).max()))
        hole.append(highlight_hole(grid, values))
    how = f"{count} random points of the box, {grid.size} cells each"
    yield Record.at_least("random coordinates, least f", least, "1/sr", 0.0, how=how)
    yield Record.at_most("random coordinates, greatest albedo", albedo, "", 1.001, how=how)
    deepest = 100.0 * float(np.max(hole))
    yield Record.at_most("random coordinates, deepest hole", deepest, "%", 2.0, how=how)


def highlight_hole(grid: HalfDiffGrid, values: NDArray[Any]) -> float:
    """The deepest valley in a highlight of f (cells, 3): what f is lower by there, relative to the
    lower one of its rims along theta_h.

    The highlight: theta_h to 30 degrees, as far around its brightest node as f exceeds a tenth of
    it; profiles of theta_d to 60 degrees, both directions within 75 degrees of the normal.
    """
    kept = (grid.theta_d <= math.radians(60.0)).repeat(grid.n_phi_d)
    nodes = grid.theta_h <= HIGHLIGHT
    f = values.reshape(grid.n_theta_h, -1, 3)[nodes][:, kept]
    seen = grid.lower_cosine.reshape(grid.n_theta_h, -1)[nodes][:, kept] > math.cos(MEASURED_WITHIN)
    f = np.where(seen[..., None], f, 0.0)
    bright = f > 0.1 * f.max(axis=0)
    node = np.arange(len(f))[:, None, None]
    top = f.argmax(axis=0)
    first = np.where(~bright & (node < top), node, -1).max(axis=0)
    last = np.where(~bright & (node > top), node, len(f)).min(axis=0)
    lobe = np.where((node > first) & (node < last), f, 0.0)
    before = np.maximum.accumulate(lobe, axis=0)
    after = np.maximum.accumulate(lobe[::-1], axis=0)[::-1]
    rim = np.minimum(before, after)
    return float(np.max(np.where(lobe > 0.0, 1.0 - lobe / np.maximum(rim, 1e-30), 0.0)))


RENDERED_UNDER = ("forest", "studio", "sunset")
"""Maps of a forest, of lamps indoors, of a low sun."""

MEASURED_WITHIN = math.radians(75.0)
"""Beyond this angle measurements are extrapolated or unreliable."""


@dataclass(frozen=True)
class MeasuredSet:
    """Measured materials by name, each (n, 3) in 1/sr (negative: invalid) at the same angles (n,),
    in radians."""

    name: str
    angles: tuple[Float64, Float64, Float64]
    materials: dict[str, Float64]


def measured_sets(data: Path, n_theta_d: int = 24, n_phi_d: int = 9) -> list[MeasuredSet]:
    """MERL slices (phi_d 90 degrees) and RGL materials (all angles), within `MEASURED_WITHIN`."""
    theta_h = (np.arange(90) / 90) ** 2 * math.pi / 2
    h, d = np.meshgrid(theta_h, np.arange(90) / 90 * math.pi / 2, indexing="ij")
    trusted = np.cos(h) * np.cos(d) > math.cos(MEASURED_WITHIN)
    with np.load(data / "merl_slices" / "merl_phi_d_90.npz") as file:
        slices = {
            str(name): values[trusted].astype(np.float64)
            for name, values in zip(file["names"], file["values"], strict=True)
        }
    angles = h[trusted], d[trusted], np.full(trusted.sum(), math.pi / 2)
    theta_d = (np.arange(n_theta_d) + 0.5) / n_theta_d * math.pi / 2
    phi_d = (np.arange(n_phi_d) + 0.5) / n_phi_d * math.pi / 2
    th, td, pd = (a.ravel() for a in np.meshgrid(theta_h, theta_d, phi_d, indexing="ij"))
    wi, wo = from_half_diff_angles(th, td, pd)
    trusted = np.minimum(wi[:, 2], wo[:, 2]) > math.cos(MEASURED_WITHIN)
    whole = {
        path.stem: np.maximum(MeasuredBRDF.read(path).eval(wi[trusted], wo[trusted]), 0.0)
        for path in sorted((data / "rgl").glob("*.bsdf"))
    }
    everywhere = th[trusted], td[trusted], pd[trusted]
    return [MeasuredSet("MERL", angles, slices), MeasuredSet("RGL", everywhere, whole)]


def log_error(
    embedding: BRDFEmbedding, angles: tuple[Float64, Float64, Float64], rgb: Float64
) -> Float64:
    """|d log(f + 1e-3)| (n, 3) of samples that were encoded and decoded again."""
    index, weight = embedding.grid_.stencil(*angles)
    table = embedding.decode_values(embedding.encode_samples(*angles, rgb))
    shown = np.einsum("nk,nkc->nc", weight, table[index])
    error: Float64 = np.abs(np.log(shown + FLOOR) - np.log(np.maximum(rgb, 0.0) + FLOOR))
    return error


def milliseconds(call: Callable[[], object], repeats: int) -> float:
    """Median time of a call, after one that does not count."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


# -- edits ----------------------------------------------------------------------------------------


def edit_speed(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Edits to finished frames, beside the plain sum over environment texels."""
    size, repeats, checked = (64, 8, 4) if quick else (512, 40, 48)
    name, environment = maps(data, True)[0]
    session = EditSession(_bench_scene(environment, size), cache=False)
    yield from _edits(session, repeats, checked, 6.0, 3.0, say)
    scene = session.scene
    index = np.flatnonzero(~scene.bordering & (scene.pixel_part < len(scene.shape.parts)))
    index = np.sort(np.random.default_rng(3).choice(index, checked, replace=False))
    brdf = session.brdf("body")
    yield from _plain_sums(scene, index, brdf, name, say, {"NumPy": texel_sum})
    if quick:
        return
    del session
    wide = Scene(teapot(), environment, camera=WIDE_CAMERA, size=(1080, 1920), ground=True)
    session = EditSession(wide, cache=False)
    yield from _edits(session, repeats, checked, 33.0, None, say)


def _edits(
    session: EditSession,
    repeats: int,
    checked: int,
    whole: float,
    part: float | None,
    say: Say,
) -> Iterator[Record]:
    """Edit times of a session to be prepared; `whole` and `part` are targets in ms."""
    scene, space = session.scene, session.traits
    named = f"{scene.width}x{scene.height}"
    start = time.perf_counter()
    transport = session.prepare()
    prepared = time.perf_counter() - start
    session.assign(scene.shape.parts, "blue-plastic")
    session.render()
    how = f"{_how_much(transport)}, {torch.get_num_threads()} threads"
    say(f"  {how}")
    rng = np.random.default_rng(3)
    home = session.material("body").z
    objects = list(scene.shape.parts)

    def nearby() -> Float64:
        """Coordinates a small random move away: some tenth of a trait unit."""
        step = rng.normal(size=len(home))
        return np.asarray(home + 0.05 * step * (session.embedding.high_ - session.embedding.low_)
                          / np.sqrt(len(home)))  # fmt: skip

    def whole_object() -> None:
        session.assign(objects, nearby())

    def every_part() -> None:
        for name in objects:
            session.assign(name, nearby())

    def moved(name: str) -> Callable[[], None]:
        # never the same twice: what was shown lately need not be shaded again
        amounts = ((-1) ** k * (0.05 + 1e-4 * k) for k in itertools.count())
        return lambda: session.move(name, hold=("colour",), shiny=next(amounts))

    assert "shiny" in space.names
    edits: list[tuple[str, Callable[[], None], float | None]] = [
        ("edit of the whole object", whole_object, whole),
        ("edit of all parts, each its own", every_part, None),
        ("edit of the body", moved("body"), None),
        ("edit of the handle", moved("handle"), part),
    ]
    records = []
    for label, edit, target in edits:
        session.assign(objects, "blue-plastic")
        # what the basis has to learn first is learnt by now
        for _ in range(3):
            edit()
            session.render()
        before = session.report()
        times = []
        for _ in range(repeats):
            start = time.perf_counter()
            edit()
            session.render()
            times.append(time.perf_counter() - start)
        report = session.report()
        exact = report["exact_frames"] - before["exact_frames"]
        error = _frame_error(session, checked, rng)
        tiers = sorted({entry["tier"] for entry in report["parts"].values()})
        value = 1e3 * float(np.median(times))
        said = (
            f"{how}; slowest {1e3 * max(times):.1f} ms, {exact} parts exact in {repeats} edits, "
            f"tiers {' and '.join(tiers)}, stated error {100 * report['frame_error']:.3f} %"
        )
        more: dict[str, Any] = {"error": error, "how": said}
        title = f"{label} to frame, {named}, median"
        records.append(
            Record(title, value, "ms", **more)
            if target is None
            else Record.at_most(title, value, "ms", target, **more)
        )
    yield from records
    yield Record(f"preparation, {named}", prepared, "s", error=records[0].error, how=how)


def _frame_error(session: EditSession, count: int, rng: np.random.Generator) -> float:
    """Error of the session's frame against the oracle, on some covered pixels."""
    scene = session.scene
    pixels = np.unique(scene.pixels[rng.choice(len(scene.pixels), count, replace=False)])
    index = np.flatnonzero(np.isin(scene.pixels, pixels))
    materials = [session.material(name) for name in scene.parts]
    distinct = list(dict.fromkeys(materials))
    brdfs = [session.brdf(scene.parts[materials.index(material)]) for material in distinct]
    true, _ = reference_values(scene, index, brdfs, 1e-3)
    own = np.array([distinct.index(material) for material in materials])[scene.pixel_part[index]]
    expected = np.zeros((len(pixels), 3))
    at = np.searchsorted(pixels, scene.pixels[index])
    np.add.at(expected, at, true[np.arange(len(index)), own])
    backdrop = (scene.backdrop().reshape(-1, 3) * scene.uncovered[:, None])[pixels]
    shown = session.render().reshape(-1, 3)[pixels] - backdrop
    known = np.isfinite(expected).all(axis=1)
    return reference.relative_error(shown[known], expected[known])


def texel_sum(scene: Scene, index: Int64, brdf: TabulatedBRDF) -> Float64:
    """Radiance (m, 3) by one look-up for each texel, at its centre: the plain way, no shadows.

    `index` names fragments of one sample each.
    """
    environment = scene.environment
    moment = texel_moments(environment).reshape(-1, 3)
    omega = np.linalg.norm(moment, axis=-1, keepdims=True)
    toward = moment / omega
    energy = environment.image.reshape(-1, 3) * omega
    result = np.zeros((len(index), 3))
    for i, p in enumerate(scene.offsets[index]):
        normal = environment.to_map(scene.normals[p])
        view = environment.to_map(scene.views[p])
        above = toward @ normal > 0.0
        wi = to_local(toward[above], np.broadcast_to(normal, toward[above].shape))
        wo = to_local(view, normal)
        f = brdf.eval(wi, np.broadcast_to(wo, wi.shape))
        result[i] = np.sum(f * energy[above] * wi[:, 2:], axis=0)
    return result


def texel_sum_torch(scene: Scene, index: Int64, brdf: TabulatedBRDF) -> Float64:
    """What `texel_sum` does, in torch and float32; for a table on a folded grid."""
    grid, environment = brdf.grid, scene.environment
    if grid.layout != "folded":
        raise ValueError(f"brdf: expected a table on a folded grid, got {brdf!r}")
    n_h, n_d, n_p = grid.shape
    table = torch.from_numpy(np.ascontiguousarray(brdf.values.reshape(-1, 3), np.float32))
    nodes = torch.from_numpy(grid.theta_h.astype(np.float32))
    moment = texel_moments(environment).reshape(-1, 3)
    omega = np.linalg.norm(moment, axis=-1, keepdims=True)
    toward = torch.from_numpy((moment / omega).astype(np.float32))
    energy = torch.from_numpy((environment.image.reshape(-1, 3) * omega).astype(np.float32))

    def bracket(x: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
        low = x.long().clamp_(0, count - 2)
        return low, (x - low).clamp_(0.0, 1.0)

    first = scene.offsets[index]
    normals = np.asarray(environment.to_map(scene.normals[first]), np.float64)
    views = to_local(environment.to_map(scene.views[first]), normals)
    frames = np.stack([*shading_frame(normals), normals], axis=-1)
    result = torch.zeros(len(index), 3, dtype=torch.float64)
    for start in range(0, len(index), 8):
        some = slice(start, start + 8)
        local = toward @ torch.from_numpy(frames[some].astype(np.float32))
        which, texel = torch.nonzero(local[..., 2] > 0.0, as_tuple=True)
        wi = local[which, texel]
        wo = torch.from_numpy(views[some].astype(np.float32))[which]
        x, y, z = wi.unbind(1)
        total = wi + wo
        length = total.norm(dim=1)
        h_x, h_y, h_z = (total / length[:, None]).unbind(1)
        slant = torch.hypot(h_x, h_y)
        c, s = h_x / slant.clamp_min(1e-30), h_y / slant.clamp_min(1e-30)
        theta_h = torch.atan2(slant, h_z)
        theta_d = torch.atan2((wi - wo).norm(dim=1), length)
        phi_d = torch.atan2(c * y - s * x, h_z * (c * x + s * y) - slant * z).abs()
        phi_d = torch.minimum(phi_d, math.pi - phi_d)
        a, _ = bracket((theta_h * (2.0 / math.pi)).sqrt() * (n_h - 1), n_h)
        f_a = ((theta_h - nodes[a]) / (nodes[a + 1] - nodes[a])).clamp_(0.0, 1.0)
        b, f_b = bracket(theta_d * (2.0 / math.pi * (n_d - 1)), n_d)
        e, f_e = bracket(phi_d * (2.0 / math.pi * (n_p - 1)), n_p)
        cell = (a * n_d + b) * n_p + e
        corners = [
            (cell + (da * n_d + db) * n_p + de, w_a * w_b * w_e)
            for da, w_a in ((0, 1.0 - f_a), (1, f_a))
            for db, w_b in ((0, 1.0 - f_b), (1, f_b))
            for de, w_e in ((0, 1.0 - f_e), (1, f_e))
        ]
        f = torch.nn.functional.embedding_bag(
            torch.stack([at for at, _ in corners], dim=1),
            table,
            per_sample_weights=torch.stack([weight for _, weight in corners], dim=1),
            mode="sum",
        )
        result[some].index_add_(0, which, (f * energy[texel] * z[:, None]).double())
    return result.numpy()


def _plain_sums(
    scene: Scene,
    index: Int64,
    brdf: TabulatedBRDF,
    map_name: str,
    say: Say,
    sums: Mapping[str, Callable[[Scene, Int64, TabulatedBRDF], Float64]],
) -> Iterator[Record]:
    """Plain sums over texels, by what computes them: a frame's time, scaled from `index` (m,)."""
    bare = scene.changed(shadows=False)
    true, _ = reference_values(bare, index, [brdf], 1e-3)
    first: Float64 | None = None
    for label, call in sums.items():
        # what is set up at a first call does not count
        call(bare, index[:8], brdf)
        start = time.perf_counter()
        plain = call(bare, index, brdf)
        seconds = (time.perf_counter() - start) / len(index) * len(scene.pixels)
        if first is None:
            first = plain
        apart = reference.relative_error(plain, first)
        if apart > 1e-3:
            raise ArithmeticError(f"the sum in {label} is {100 * apart:.2f} % off the first one")
        if plain is not first:
            say(f"  the sum in {label} is within {100 * apart:.4f} % of the first one")
        yield Record(
            f"plain sum over texels{'' if label == 'NumPy' else f' in {label}'}, a frame",
            1e3 * seconds, "ms",
            error=reference.relative_error(plain, true[:, 0]),
            how=f"{label}, without shadows, {len(index)} fragments, scaled to {len(scene.pixels)}; "
            f"map {map_name}, {torch.get_num_threads()} threads",
        )  # fmt: skip


# -- beside another renderer ----------------------------------------------------------------------


@dataclass(frozen=True)
class _Edited:
    """Edits of the whole object on our side, the last one to a member of the library."""

    seconds: Float64
    frame: Float32  # (H * W, 3) of the last
    brdf: TabulatedBRDF
    how: str


def peer_speed(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """An edit to its frame beside Mitsuba 3 at its best settings, at equal error, in one run."""
    peer = peers.load()
    size, count, repeats = (64, 40, 6) if quick else (512, 300, 30)
    aims = (0.02,) if quick else (0.05, 0.01)
    map_name, environment = maps(data, True)[0]
    start = time.perf_counter()
    editing._training(default_library(), 0)
    training = time.perf_counter() - start
    # compiled code is loaded (or compiled) at its first use
    EditSession(Scene(teapot(), EnvironmentMap.sky(rows=32), size=16), cache=False).render()
    # no ground: theirs would hide the lower half of the map from the object
    session = EditSession(Scene(teapot(), environment, camera=BENCH_CAMERA, size=size), cache=False)
    scene = session.scene
    start = time.perf_counter()
    transport = session.prepare()
    our_start = training + time.perf_counter() - start
    rng = np.random.default_rng(3)
    edited = {name: _edit_whole(session, name, repeats, rng) for name in PEER_MATERIALS}
    tables = [mine.brdf for mine in edited.values()]

    index = np.flatnonzero(~scene.bordering)
    first = scene.offsets[index]
    index = index[np.sum(scene.normals[first] * scene.views[first], axis=-1) > 0.15]
    with Oracle(tables) as oracle:
        index, true, own = _drawn(oracle, scene, index, count, rng)
    pixels = scene.pixels[index]
    where = (
        f"teapot with shadows, {size}x{size}, map {map_name}, errors on {len(index)} interior "
        f"pixels, the oracle's own {100 * own.mean() / true.mean():.3f} %, "
        f"{torch.get_num_threads()} threads"
    )
    say(f"  {where}")

    start = time.perf_counter()
    material = peer.material(tables[0], *peers.fit_lobe(tables[0]))
    theirs = peers.their_scene(peer.mi, scene, material)
    covered = np.unique(scene.pixels)
    peers.traced(peer, theirs, scene, covered, 1, 0)
    their_start = time.perf_counter() - start
    versus = (
        f"Mitsuba {peer.mi.__version__} {peers.VARIANT}, multijitter, MIS compensation, a lobe "
        f"fitted to the table, each texel {peers.FINER}x{peers.FINER} of theirs, only the "
        f"{len(covered)} covered pixels, through their centres"
    )
    say(f"  {versus}")

    ratios: dict[float, list[float]] = {aim: [] for aim in aims}
    ahead: dict[float, list[float]] = {aim: [] for aim in aims}
    converged = []
    for b, (name, mine) in enumerate(edited.items()):
        our_error = reference.relative_error(mine.frame[pixels], true[:, b])
        ours = float(np.median(mine.seconds))
        yield Record(
            f"ours, {name}, edit to frame", 1e3 * ours, "ms", error=our_error,
            how=f"{_how_much(transport)}, {mine.how}",
        )  # fmt: skip
        rival = _Rival(peer, theirs, material, scene, pixels, mine.brdf, true[:, b])
        converged.append(rival.converged())
        if converged[-1] > 0.02:
            raise ArithmeticError(
                f"{name}: Mitsuba converges to {100 * converged[-1]:.1f} % off the reference"
            )
        say(f"  {name}: lobe of roughness {rival.lobe[0]:.3g}, {100 * rival.lobe[1]:.0f} % even")
        seconds, error = rival.frame(1)
        yield Record(
            f"Mitsuba, {name}, one sample a pixel", 1e3 * seconds, "ms", error=error, how=versus
        )
        for aim in aims:
            samples, expected = rival.samples_for(aim)
            seconds, error = rival.frame(samples)
            yield Record(
                f"Mitsuba, {name}, frame at {100 * aim:g} %", seconds, "s", error=error,
                how=f"{samples} samples a pixel, by which {_SEEDS} seeds err by "
                f"{100 * expected:.3f} %; {versus}",
            )  # fmt: skip
            ratios[aim].append(seconds / ours)
            ahead[aim].append(
                max(1.0, math.floor((our_start - their_start) / (seconds - ours)) + 1.0)
            )
            yield Record(
                f"faster than Mitsuba, {name}, at {100 * aim:g} %", ratios[aim][-1], "x",
                error=our_error, how=where,
            )  # fmt: skip
    for aim in aims:
        least = min(ratios[aim])
        title = f"faster than Mitsuba, least, at {100 * aim:g} %"
        how = f"of {', '.join(PEER_MATERIALS)}; {where}"
        yield (
            Record.at_least(title, least, "x", 1000.0, how=how)
            if aim == 0.01
            else Record(title, least, "x", how=how)
        )
        yield Record(
            f"edits until we are ahead, most, at {100 * aim:g} %", max(ahead[aim]), "", how=how
        )
    yield Record(
        "preparation, ours", our_start, "s",
        how=f"{_how_much(transport)}; {training:.1f} s of it for the training set, once a process",
    )  # fmt: skip
    yield Record(
        "preparation, Mitsuba", their_start, "s",
        how=f"scene and kernels, these compiled or from its own cache on disk; {versus}",
    )  # fmt: skip
    yield Record(
        "Mitsuba, converged, against our reference", 100.0 * max(converged), "%",
        how=f"4 times {_MANY} samples a pixel, their noise included, worst of "
        f"{', '.join(PEER_MATERIALS)}; {where}",
    )  # fmt: skip
    few = index[:: max(1, len(index) // (4 if quick else 48))]
    sums = {"NumPy": texel_sum, "torch": texel_sum_torch}
    yield from _plain_sums(scene, few, tables[0], map_name, say, sums)


def _edit_whole(session: EditSession, name: str, repeats: int, rng: np.random.Generator) -> _Edited:
    """Edits of the whole object near a library member, the last one to itself."""
    objects = list(session.scene.shape.parts)
    session.assign(objects, name)
    home = session.material(objects[0]).z
    span = session.embedding.high_ - session.embedding.low_

    def nearby() -> Float64:
        return np.asarray(home + 0.05 * rng.normal(size=len(home)) * span / np.sqrt(len(home)))

    # what the basis has to learn first is learnt by now
    for _ in range(3):
        session.assign(objects, nearby())
        session.render()
    before = session.report()["exact_frames"]
    wanted: list[str | Float64] = [*(nearby() for _ in range(repeats - 1)), name]
    seconds = []
    for material in wanted:
        start = time.perf_counter()
        session.assign(objects, material)
        frame = session.render()
        seconds.append(time.perf_counter() - start)
    report = session.report()
    exact = report["exact_frames"] - before
    how = (
        f"median of {repeats} edits of the whole object, slowest {1e3 * max(seconds):.1f} ms, "
        f"{exact} parts exact in them; the error is the last one's"
    )
    return _Edited(np.array(seconds), frame.reshape(-1, 3), session.brdf(objects[0]), how)


class _Rival:
    """Mitsuba on one table: its frames, timed, and their errors at interior `pixels` (m,)."""

    def __init__(
        self,
        peer: peers.Peer,
        theirs: Any,
        material: Any,
        scene: Scene,
        pixels: Int64,
        table: TabulatedBRDF,
        true: Float64,
    ) -> None:
        self.peer, self.theirs, self.material = peer, theirs, material
        self.scene, self.pixels, self.true = scene, pixels, true
        self.table, self.lobe = table, peers.fit_lobe(table)
        self.covered = np.unique(scene.pixels)
        self._seeds = itertools.count(1)

    def frame(self, samples: int) -> tuple[float, float]:
        """Seconds from an edit to its frame, and that frame's error."""
        self._trace(self.pixels[:16], samples)  # the first of so many samples is compiled
        start = time.perf_counter()
        self.material.assign(self.table, *self.lobe)
        image = self._trace(self.covered, samples)
        seconds = time.perf_counter() - start
        return seconds, self._error(image[np.searchsorted(self.covered, self.pixels)])

    def converged(self) -> float:
        """The error that many samples leave; their noise is still in it."""
        self.material.assign(self.table, *self.lobe)
        runs = [self._trace(self.pixels, peers.rounded(self.peer, _MANY)) for _ in range(4)]
        return self._error(np.mean(runs, axis=0))

    def samples_for(self, aim: float) -> tuple[int, float]:
        """Samples a pixel by which frames err by `aim` on average, and by how much they do."""
        self.material.assign(self.table, *self.lobe)
        few, many = 1, 4
        more, less = self._expected(few), self._expected(many)
        while less > aim:
            few, many, more = many, 4 * many, less
            if many > _MANY:
                raise ArithmeticError(
                    f"{self.table!r}: Mitsuba errs by {100 * less:.2f} % with {few} samples a pixel"
                )
            less = self._expected(many)
        share = math.log(more / aim) / math.log(more / less)
        found: list[tuple[int, float]] = []
        wanted = few * (many / few) ** share
        for _ in range(2):
            samples = peers.rounded(self.peer, round(wanted))
            found.append((samples, self._expected(samples)))
            wanted = samples * (found[-1][1] / aim) ** 2
        return min(found, key=lambda pair: abs(pair[1] - aim))

    def _expected(self, samples: int) -> float:
        """The mean error of frames with several seeds."""
        samples = peers.rounded(self.peer, samples)
        return float(
            np.mean([self._error(self._trace(self.pixels, samples)) for _ in range(_SEEDS)])
        )

    def _trace(self, pixels: Int64, samples: int) -> Float64:
        return peers.traced(self.peer, self.theirs, self.scene, pixels, samples, next(self._seeds))

    def _error(self, shown: Float64) -> float:
        return reference.relative_error(shown, self.true)


# -- preparation ----------------------------------------------------------------------------------


def preparation(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Preparation of a scene, in a fresh process: time, memory, the cache, and first images."""
    size = 64 if quick else 512
    name, environment = maps(data, True)[0]
    context = multiprocessing.get_context("spawn")
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        concurrent.futures.ProcessPoolExecutor(1, mp_context=context) as pool,
    ):
        found = pool.submit(_prepare_afresh, environment, size, folder).result()
    how = f"{found['how']}, map {name}, in a fresh process"
    say(
        f"  {how}; {found['rays']} shadow rays, error of the first frame by its own measurement "
        f"{100 * found['error']:.3f} %"
    )
    yield Record("training set", found["training"], "s", how="once a process")
    yield Record.at_most(
        "preparation", found["prepare"], "s", 15.0, error=found["error"],
        how=f"{how}, the training set at hand",
    )  # fmt: skip
    if found["peak"] is not None:
        yield Record.at_most("peak memory of a preparation", found["peak"], "GB", 1.5, how=how)
    yield Record("preparation from the cache on disk", found["cached"], "s", how=how)
    for change in ("view", "light"):
        seconds, error, width, height = found[change]
        yield Record.at_most(
            f"first image after a change of {change}", seconds, "s", 0.5, error=error,
            how=f"look() and draft(), {width}x{height} enlarged to {size}x{size}; the error is "
            "its own measurement",
        )  # fmt: skip


def _prepare_afresh(environment: EnvironmentMap, size: int, folder: str) -> dict[str, Any]:
    """What `preparation` reports, measured in a process that did nothing before."""
    os.environ["TRAITBRDF_CACHE"] = folder
    os.environ["TRAITBRDF_CACHE_BYTES"] = str(editing.CACHE_BYTES)
    library = default_library()
    start = time.perf_counter()
    editing._training(library, 0)
    training = time.perf_counter() - start
    # compiled code is loaded (or compiled) at its first use
    warm = EditSession(_bench_scene(EnvironmentMap.sky(rows=32), 16), cache=False)
    warm.render()
    warm.draft()
    scene = _bench_scene(environment, size)
    session = EditSession(scene)
    start = time.perf_counter()
    transport = session.prepare()
    prepared = time.perf_counter() - start
    peak = _peak_memory()
    for thread in threading.enumerate():
        if thread.name == "traitbrdf-cache":
            thread.join()
    again = EditSession(_bench_scene(environment, size))
    start = time.perf_counter()
    again.prepare()
    cached = time.perf_counter() - start
    again.assign(scene.shape.parts, "blue-plastic")
    again.render()
    report = again.report()
    if report["prepared_from"] != "cache":
        raise RuntimeError("the preparation was not found in the cache on disk")
    found: dict[str, Any] = {
        "training": training,
        "prepare": prepared,
        "peak": peak,
        "cached": cached,
        "rays": scene.rays_cast,
        "error": report["frame_error"],
        "how": _how_much(transport),
    }
    turned = Camera.orbit(-20.0, 25.0, zoom=BENCH_CAMERA.zoom)
    for change, settings in (("view", {"camera": turned}), ("light", {"rotation": 1.0})):
        start = time.perf_counter()
        again.look(**settings)
        image, error = again.draft()
        seconds = time.perf_counter() - start
        small = min(editing.DRAFT_SIZE, size)
        assert image.shape == (size, size, 3)
        found[change] = (seconds, error, small, small)
    return found


def _peak_memory() -> float | None:
    """Most memory that this process ever had, in GB; None where the system does not tell.

    Not by getrusage where it can be helped: Linux hands a parent's peak on to its children.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) * 1024 / 1e9
    try:
        resource = importlib.import_module("resource")  # there is none on Windows
    except ImportError:
        return None
    peak = float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return peak * (1.0 if sys.platform == "darwin" else 1024.0) / 1e9


Bench: TypeAlias = Callable[[Path | None, bool, Say], Iterator[Record]]
"""Measures on the data of a folder, quickly or not, and says what it does meanwhile."""

BENCHES: dict[str, Bench] = {
    "transport": transport_error,
    "families": family_error,
    "shadows": shadow_error,
    "table": table_error,
    "embedding": embedding_error,
    "edit": edit_speed,
    "prepare": preparation,
    "peers": peer_speed,
}

ON_REQUEST = frozenset({"peers", "promises", "trade"})
"""What runs only where it is named: it takes long, or needs what the package does without.
`traitbrdf.trade` and `traitbrdf.trait_laws` have those that are not among `BENCHES`."""


def default_data() -> Path | None:
    """The folder of maps and measured materials: $TRAITBRDF_SHARED, or ../shared/data."""
    for place in (os.environ.get("TRAITBRDF_SHARED"), "../shared/data"):
        if place and (Path(place) / "envmaps").is_dir():
            return Path(place)
    return None


def run(
    names: list[str],
    data: Path | None,
    quick: bool,
    say: Say,
    benches: Mapping[str, Bench] = MappingProxyType(BENCHES),
) -> list[Record]:
    """Run benches by name (where none is named, all but those `ON_REQUEST`); `say` gets every line
    as it is known."""
    records = []
    for name in names or [name for name in benches if name not in ON_REQUEST]:
        call = benches[name]
        said = getattr(call, "func", call).__doc__ or name
        say(f"{name}: {said.splitlines()[0]}")
        start = time.perf_counter()
        for record in call(data, quick, say):
            if not math.isfinite(record.value):
                raise ArithmeticError(f"{record.name}: not a finite number")
            records.append(record)
            say(record.line())
        say(f"  ({time.perf_counter() - start:.0f} s)")
    return records
