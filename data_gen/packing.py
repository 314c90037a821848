"""From the recipe to the arrays that the package ships."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.families import materials
from data_gen.labels import labels, trait_values
from data_gen.tables import Progress, Tables
from traitbrdf.descriptors import descriptors
from traitbrdf.embedding import GRID, BRDFEmbedding, channel_logs
from traitbrdf.traits import TraitSpace

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
    """Tabulate the recipe, fit the embedding and the traits; all arrays of the artifact.

    Parameters
    ----------
    count, seed : as for `data_gen.families.materials`
    components : as for `BRDFEmbedding`
    progress : called with (stage, fraction); may raise to stop
    folder : where tables are kept while they are needed, and after an interruption: 0.24 MB a
        material; None is a temporary one
    workers : as for `Tables.make`

    Notes
    -----
    Memory does not grow with `count`, but for a kilobyte a material.
    """
    embedding = BRDFEmbedding(components)  # bad numbers end here, before any work
    if folder is None:
        with tempfile.TemporaryDirectory(prefix="traitbrdf-") as temporary:
            return build(count, seed, components, progress, Path(temporary), workers)
    report = progress or (lambda stage, fraction: None)
    tables = Tables(folder, count, seed, GRID)
    tables.make(workers, progress)
    report("embedding", 0.0)
    # coordinates of the embedding as it ships, with its rounded components
    embedding = BRDFEmbedding.from_arrays(embedding.fit(tables).arrays())
    encoded, rows = [], []
    for table in tables:
        encoded.append(embedding.least_squares(channel_logs(table)[None])[0])
        rows.append(descriptors(table))
    coordinates = np.stack(encoded).astype(np.float32)
    embedding.low_ = coordinates.min(axis=0).astype(np.float64)
    embedding.high_ = coordinates.max(axis=0).astype(np.float64)
    report("embedding", 1.0)
    marks = {name: labels(values) for name, values in trait_values(rows).items()}
    space = TraitSpace.fit(
        coordinates, marks, embedding.low_, embedding.high_, tables.families, embedding.body_rows()
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
        "descriptor_names": np.array(list(rows[0])),
        "descriptors": np.array([list(row.values()) for row in rows], np.float32),
        "labels": np.stack([marks[name] for name in space.names]),
    }
