"""From the recipe to the arrays that the package ships."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from data_gen.labels import TRAITS, grading, labels
from data_gen.tables import Progress, Tables
from traitbrdf.recipes.materials import materials
from traitbrdf.reflectance.brdf import ALBEDO_ANGLES, albedo_operator
from traitbrdf.reflectance.descriptors import PROFILE, READINGS, describe, read, reading_rows
from traitbrdf.space.definitions import Labelled
from traitbrdf.space.embedding import GRID, BRDFEmbedding
from traitbrdf.space.highlights import HIGHLIGHT
from traitbrdf.space.logmap import channel_logs
from traitbrdf.space.scores import Box, Grades, Optics, Readings
from traitbrdf.space.traits import TraitSpace

COUNT = 2040
SEED = 0
COMPONENTS = (16, 4)


def build(
    count: int = COUNT,
    seed: int = SEED,
    components: tuple[int, int] = COMPONENTS,
    progress: Progress | None = None,
    folder: Path | None = None,
    workers: int | str = 0,
) -> dict[str, NDArray[Any]]:
    """Tabulate the recipe, fit the embedding and the traits, and return all arrays of the artifact.

    Parameters
    ----------
    count, seed : int
        As for `traitbrdf.recipes.materials.materials`.
    components : (int, int)
        As for `BRDFEmbedding`.
    progress : callable, optional
        Called with (stage, fraction); it may raise to stop.
    folder : Path, optional
        Where tables are kept while they are needed, and after an interruption: 0.24 MB for each
        material; a temporary one if left out.
    workers : int or str
        As for `Tables.make`.

    Notes
    -----
    Memory grows by a kilobyte for each material only.
    """
    embedding = BRDFEmbedding(components)  # raises on bad numbers, before any work
    if folder is None:
        with tempfile.TemporaryDirectory(prefix="traitbrdf-") as temporary:
            return build(count, seed, components, progress, Path(temporary), workers)
    report = progress or (lambda stage, fraction: None)
    tables = Tables(folder, count, seed, GRID)
    tables.make(workers, progress)
    report("embedding", 0.0)
    # coordinates of the embedding as it ships, with its rounded components
    embedding = BRDFEmbedding.from_arrays(embedding.fit(tables).arrays())
    encoded, readings = [], []
    for table in tables:
        encoded.append(embedding.least_squares(channel_logs(table)[None])[0])
        readings.append(read(table))
    coordinates = np.stack(encoded).astype(np.float32)
    embedding.low_ = coordinates.min(axis=0).astype(np.float64)
    embedding.high_ = coordinates.max(axis=0).astype(np.float64)
    report("embedding", 1.0)
    described = describe(np.stack(readings))
    names, weights = grading()
    grades = Grades.fit({name: described[name] for name in names})
    values = weights @ grades.of(np.stack(list(described.values()), axis=1)).T
    marked = [
        Labelled(name, labels(value), row, trait.meaning, trait.synonyms)
        for (name, trait), value, row in zip(TRAITS.items(), values, weights, strict=True)
    ]
    space = TraitSpace.fit(
        coordinates,
        marked,
        Box(embedding.low_, embedding.high_),
        tables.families,
        Optics(few_cells(embedding, coordinates), grades),
        embedding.body_rows(),
    )
    report("traits", 1.0)
    return {
        **embedding.arrays(),
        **space.arrays(),
        "names": np.array(tables.names),
        "families": np.array(tables.families),
        "parameters": np.array([json.dumps(m.parameters) for m in materials(seed, count)]),
        "seed": np.array(seed, np.int64),
        "coordinates": coordinates,
        "descriptor_names": np.array(list(described)),
        "descriptors": np.stack(list(described.values()), axis=1).astype(np.float32),
        "labels": np.stack([trait.labels for trait in marked]),
    }


ENERGY = (0, 9, 15)
"""Indices of `brdf.ALBEDO_ANGLES` at which moves watch the albedo: 0, 48 and 80 degrees."""


def few_cells(embedding: BRDFEmbedding, coordinates: NDArray[Any]) -> Readings:
    """Choose few cells from which readings can be computed.

    Readings that take many cells (albedos, the flux into a gloss meter) are replaced by weighted
    sums of few that give the same on the members. Cells and weights are found by non-negative least
    squares of relative errors (Lawson & Hanson 1974, chapter 23), so that no reading can be
    negative.

    Parameters
    ----------
    embedding : BRDFEmbedding
    coordinates : (n, k) array
        Coordinates of the members.
    """
    grid = embedding.grid_
    albedos = albedo_operator(grid, np.asarray(ALBEDO_ANGLES)[list(ENERGY)]).toarray()
    rows = np.vstack([reading_rows(grid).toarray(), albedos])
    some = coordinates[:: max(len(coordinates) // 700, 1)]
    members = np.clip(some, embedding.low_, embedding.high_)
    tables = np.stack([embedding.decode_values(z).mean(axis=1) for z in members])
    rng = np.random.default_rng(0)
    for i in range(len(rows)):
        used = np.flatnonzero(rows[i])
        if len(used) > 40:
            relative = tables[:, used] / np.maximum(tables @ rows[i], 1e-6)[:, None]
            weighty = np.argsort(rows[i, used] * relative.mean(axis=0))
            others = rng.choice(weighty[:-40], min(60, len(used) - 40), replace=False)
            chosen = np.sort(np.append(weighty[-40:], others))
            found, _ = nnls(relative[:, chosen], np.ones(len(relative)))
            rows[i] = 0.0
            rows[i, used[chosen]] = found
    # all cells from the middle of the highlight to its rim, since decoding corrects them
    count = len(READINGS)
    per = grid.n_theta_d * grid.n_phi_d
    first = READINGS.index("profile 0")
    profile = np.array([np.flatnonzero(row) for row in rows[first : first + len(PROFILE)]])
    columns = np.flatnonzero(grid.theta_h <= HIGHLIGHT)[:, None] * per + profile[0] % per
    kept = np.union1d(np.flatnonzero(rows.any(axis=0)), columns)
    log_rows, mean = embedding.log_rows(kept)
    inner = np.searchsorted(kept, columns)
    return Readings(log_rows, mean, rows[:count, kept], inner, rows[count:, kept])
