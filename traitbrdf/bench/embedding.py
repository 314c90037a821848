"""Errors of tables and of the embedding."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from traitbrdf.bench.datasets import fresh_recipes, maps, measured_sets
from traitbrdf.bench.metrics import highlight_hole, log_error, milliseconds, spheres_compared
from traitbrdf.bench.oracle import Oracle, draw_fragments, relative_errors
from traitbrdf.bench.records import Record, Say
from traitbrdf.bench.transport import bench_scene
from traitbrdf.reflectance import models
from traitbrdf.reflectance.brdf import (
    ALBEDO_ANGLES,
    HalfDiffGrid,
    TabulatedBRDF,
    albedo_operator,
)
from traitbrdf.reflectance.measured import MeasuredBRDF
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.library import default_library

# -- tables ---------------------------------------------------------------------------------------


def table_error(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Measure table error: the error of tabulating an analytic BRDF, apart from all transport.

    Parameters
    ----------
    data, quick, say
        As for `traitbrdf.bench.run.Bench`.
    """
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
    scene = bench_scene(environment, size, shadows=False)
    tables = [TabulatedBRDF.from_model(m, grid) for m in closed]
    with Oracle([*closed, *tables]) as oracle:
        _, values, _ = draw_fragments(
            oracle, scene, np.arange(len(scene.pixels)), count, np.random.default_rng(2)
        )
    true, shown = np.split(values, 2, axis=1)
    error = relative_errors(shown, true)
    for model, e in zip(closed, error, strict=True):
        say(f"  {getattr(model, 'name', '') or model!r}: {100 * e:.2f} %")
    how = f"{len(closed)} closed forms and measured BRDFs, grid {grid.shape}, map {name}"
    yield Record("table error, median", 100.0 * float(np.median(error)), "%", how=how)
    yield Record("table error, maximum", 100.0 * float(np.max(error)), "%", how=how)


def embedding_error(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Measure embedding error: measured materials, rendered ones, random coordinates, decode times.

    The library has not been fitted to any of the materials.

    Parameters
    ----------
    data, quick, say
        As for `traitbrdf.bench.run.Bench`.
    """
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
    """Compare spheres of encoded materials with spheres of the materials themselves."""
    every = dict(maps(data, quick))
    three = {name: every[name] for name in RENDERED_UNDER if name in every} or every
    size = 32 if quick else 96
    grid, k = embedding.grid_, embedding.size
    files = sorted((data / "rgl").glob("*.bsdf")) if data else []
    sets = {
        "RGL": [TabulatedBRDF.from_model(MeasuredBRDF.read(f), grid, f.stem) for f in files],
        # two of every family, as the library would have them with another seed
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


def _gamut(embedding: BRDFEmbedding, count: int) -> Iterator[Record]:
    """Check random coordinates of the gamut box: passive, and no holes in their highlights."""
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


RENDERED_UNDER = ("forest", "studio", "sunset")
"""Maps of a forest, of lamps indoors and of a low sun."""
