"""Agreement of trait scores with people's ratings."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from traitbrdf.bench.datasets import measured_sets
from traitbrdf.bench.records import Record
from traitbrdf.space.learning import Trait, suggest
from traitbrdf.space.library import default_library
from traitbrdf.space.traits import TraitSpace, default_traits

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

RATINGS = MappingProxyType(
    {
        "glossy": ("glossy", 0.92), "strength": ("refstrng", 0.92), "sharpness": ("refsharp", 0.90),
        "matte": ("matte", 0.89), "metallic": ("metallic", 0.88), "hard": ("hard", 0.77),
        "rough": ("rough", 0.69), "rubber": ("rubber", 0.71), "soft": ("soft", 0.67),
        "fabric": ("fabric", 0.60), "bright": ("bright", 0.29), "plastic": ("plastic", 0.23),
        "ceramic": ("ceramic", 0.23), "tint": ("reftint", 0.38),
    }
)  # fmt: skip
"""Rated traits: the column of the ratings, and the correlation of earlier definitions of the
traits, to two digits."""


# -- ratings --------------------------------------------------------------------------------------


def rated_materials(data: Path) -> tuple[list[str], Float64, dict[str, Float64]]:
    """Return names, encoded coordinates (n, k) and mean ratings (n,) by column of rated materials.

    Parameters
    ----------
    data : Path
        Folder with ratings/ and merl_slices/.
    """
    with (data / "ratings" / "serrano2016_merl_half.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    known = measured_sets(data)[0]
    embedding = default_library().embedding
    names = [row["material"] for row in rows]
    z = [embedding.encode_samples(*known.angles, known.materials[name]) for name in names]
    columns = [column for column in rows[0] if column != "material"]
    return names, np.array(z), {c: np.array([float(row[c]) for row in rows]) for c in columns}


def spearman(a: Float64, b: Float64) -> float:
    """Return the rank correlation of `a` (n,) and `b` (n,); ties share their rank."""
    return float(spearmanr(a, b).statistic)


def rated(data: Path) -> Iterator[Record]:
    """Measure the agreement with people, and how much of it a few labels can teach.

    Parameters
    ----------
    data : Path
        Folder with ratings/ and merl_slices/.
    """
    names, z, ratings = rated_materials(data)
    space, rng = default_traits(), np.random.default_rng(0)
    scores = space.scores(z)
    grades = space.grades(z)
    for name, (column, before) in RATINGS.items():
        mine, theirs = scores[:, space.index(name)], ratings[column]
        found = spearman(mine, theirs)
        drawn = rng.integers(len(names), size=(1000, len(names)))
        low, high = np.percentile([spearman(mine[i], theirs[i]) for i in drawn], [2.5, 97.5])
        fitted = np.mean([_cross_validated(grades, theirs, rng) for _ in range(10)])
        how = f"Spearman, {len(names)} encoded MERL slices; the target is the figure of earlier "
        how += f"definitions; 95 % by bootstrap {low:.2f} to {high:.2f}; a fit to half of the "
        how += f"ratings reaches {fitted:.2f} on the other half"
        met = round(found, 2) >= before
        yield Record(f"people, {name}", found, "", target=before, met=met, how=how)
    theirs = ratings["glossy"]
    labels = np.digitize(theirs, np.quantile(theirs, [1 / 3, 2 / 3])) - 1
    plain = [_relearnt(space, z, labels, theirs, _drawn_labels(labels, rng)) for _ in range(20)]
    how = "Spearman with the ratings of the others, 12 labels by thirds of the ratings"
    random = float(np.mean(plain))
    yield Record.at_least(
        "glossy from 12 labels", random, "", 0.85, how=f"{how}, mean of 20 random choices"
    )
    guided = []
    for _ in range(20):
        chosen = [int(i) for i in _drawn_labels(labels, rng)[:2]]
        while len(chosen) < 12:
            rest = [i for i in range(len(z)) if i not in chosen]
            chosen.append(rest[suggest(z[chosen], z[rest], space)])
        guided.append(_relearnt(space, z, labels, theirs, np.array(chosen)))
    how += ", two random ones and ten suggested, mean of 20"
    yield Record.at_least(
        "glossy from suggested labels", float(np.mean(guided)), "", random, how=how
    )


def _cross_validated(grades: Float64, ratings: Float64, rng: np.random.Generator) -> float:
    """Return Spearman's correlation on half of the materials of a ridge fit to the other half."""
    order = rng.permutation(len(ratings))
    fit, test = order[: len(order) // 2], order[len(order) // 2 :]
    centre = grades[fit].mean(axis=0)
    x, y = grades[fit] - centre, ratings[fit] - ratings[fit].mean()
    weights = np.linalg.solve(x.T @ x + 5.0 * np.eye(x.shape[1]), x.T @ y)
    return spearman(grades[test] @ weights, ratings[test])


def _drawn_labels(labels: Int64, rng: np.random.Generator) -> Int64:
    """Draw twelve materials; the first two have opposite labels."""
    while True:
        chosen = rng.permutation(len(labels))[:12]
        if labels[chosen[0]] * labels[chosen[1]] < 0:
            return chosen


def _relearnt(
    space: TraitSpace, z: Float64, labels: Int64, ratings: Float64, chosen: Int64
) -> float:
    trait = Trait.from_labels("my gloss", z[chosen], labels[chosen], space)
    others = np.setdiff1d(np.arange(len(z)), chosen)
    return spearman(space.grades(z[others]) @ trait.weights, ratings[others])
