"""A comparison of embeddings on real materials: mappings, weights, colour and dimensions.

Every candidate is a linear space of mapped tables, or several of them side by side (charts of a
curved manifold), fitted to the same library. Measured materials that are not in the library are
encoded by the same robust fit, and judged by the same errors: median |d log(f + 1e-3)| within 75
degrees of the normal, and the look of a sphere made of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from sklearn.cluster import KMeans
from sklearn.utils.extmath import randomized_svd

from data_gen.labels import TRAITS, labels
from data_gen.tables import Progress, table_of
from traitbrdf.bench.datasets import MeasuredSet, measured_sets
from traitbrdf.bench.embedding import RENDERED_UNDER
from traitbrdf.bench.metrics import decibels
from traitbrdf.bench.people import spearman
from traitbrdf.formats.display import encode_srgb
from traitbrdf.pictures import own_colours
from traitbrdf.recipes.materials import materials
from traitbrdf.reflectance.brdf import HalfDiffGrid, TabulatedBRDF
from traitbrdf.reflectance.descriptors import DESCRIPTORS
from traitbrdf.reflectance.measured import MeasuredBRDF
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import sphere
from traitbrdf.space.definitions import straight
from traitbrdf.space.embedding import GRID
from traitbrdf.space.library import default_library
from traitbrdf.space.logmap import FLOOR, OPPONENT
from traitbrdf.space.traits import RELATED, default_traits
from traitbrdf.transport.operator import Operator

Float64: TypeAlias = NDArray[np.float64]
Float32: TypeAlias = NDArray[np.float32]

HELD_OUT = 17
"""Every 17th member of the library is encoded, and not fitted to."""


@dataclass(frozen=True)
class Candidate:
    """An embedding to be compared.

    Parameters
    ----------
    mapping : "log", "log-relative", "cube root" or "log1p twice"
    colour : "apart", "channel" or "together"
        The mean of the channels and two differences; one basis for each channel; or one vector of
        all three.
    components : tuple of int
        Their number for each basis; two numbers if apart.
    weight : "cosine" or "even"
        Of the cells above the horizon: the square root of the lower cosine, or 1.
    grid : HalfDiffGrid
    charts : int
        Number of spaces side by side, each fitted to a cluster of materials. A material's chart
        counts as a coordinate.
    """

    mapping: str = "log"
    colour: str = "apart"
    components: tuple[int, ...] = (16, 4)
    weight: str = "cosine"
    grid: HalfDiffGrid = GRID
    charts: int = 1

    @property
    def numbers(self) -> int:
        """k, the number of coordinates of a material."""
        if self.colour == "apart":
            return self.components[0] + 2 * self.components[1] + (self.charts > 1)
        return self.components[0] * (3 if self.colour == "channel" else 1) + (self.charts > 1)


CANDIDATES: tuple[Candidate, ...] = (
    Candidate(),
    Candidate(components=(14, 5)),
    Candidate(components=(18, 3)),
    Candidate(components=(15, 4), charts=4),
    Candidate(components=(9, 3), charts=4),
    Candidate(colour="channel", components=(8,)),
    Candidate(colour="together", components=(24,)),
    Candidate(weight="even"),
    Candidate("log-relative"),
    Candidate("cube root"),
    Candidate("log1p twice"),
    Candidate(grid=HalfDiffGrid(60, 16, 7)),
    *(Candidate(components=(m, n)) for m, n in ((2, 1), (4, 2), (6, 3), (8, 4), (20, 8))),
    *(Candidate("log-relative", "channel", (m,)) for m in (1, 2, 3, 5, 8, 12)),
)
"""The default first; the last ones show errors against k beside plain log-relative PCA (Nielsen et
al. 2015).
"""


_Map: TypeAlias = Callable[[Any, Any, Any], Any]

_MAPPINGS: dict[str, tuple[_Map, _Map]] = {
    "log": (lambda f, w, b: np.log(f + FLOOR), lambda y, w, b: np.exp(y) - FLOOR),
    # Nielsen et al. 2015, equation 1: w is the cosine, b = median w + FLOOR
    "log-relative": (
        lambda f, w, b: np.log((f * w + FLOOR) / b),
        lambda y, w, b: (np.exp(y) * b - FLOOR) / w,
    ),
    "cube root": (lambda f, w, b: np.cbrt(f), lambda y, w, b: y**3),
    "log1p twice": (
        lambda f, w, b: np.log1p(np.log1p(f)),
        lambda y, w, b: np.expm1(np.expm1(np.clip(y, 0.0, 3.3))),
    ),
}
"""Functions y of f, and f of y; w and b are values for each cell."""


class Space:
    """A candidate, fitted to tables (n, 3, cells) of f."""

    def __init__(self, candidate: Candidate, tables: Float32) -> None:
        self.grid = candidate.grid
        self._forward, self._back = _MAPPINGS[candidate.mapping]
        cosine: Float64 = np.maximum(self.grid.lower_cosine, 0.0).ravel()
        weight = cosine**0.5 if candidate.weight == "cosine" else np.where(cosine > 0.0, 1.0, 0.0)
        self._w: Float64 = np.maximum(cosine, 1e-3)
        self._b = np.median(tables.reshape(-1, self.grid.size), axis=0) * self._w + FLOOR
        mapped = self._forward(tables, self._w, self._b).astype(np.float32)
        mean = mapped.mean(axis=(0, 1))
        mapped -= mean
        self._mean = np.repeat(mean[None].astype(np.float64), 3, axis=0)
        size = self.grid.size
        if candidate.colour == "together":
            self._mean += mapped.mean(axis=0)
            rows = (mapped - mapped.mean(axis=0)).reshape(len(mapped), -1)
            basis = _loadings(rows, np.tile(weight, 3), candidate.components[0])
            self._design = basis.reshape(-1, 3, size)
        elif candidate.colour == "channel":
            basis = _loadings(mapped.reshape(-1, size), weight, candidate.components[0])
            self._design = np.einsum("dc,bx->dbcx", np.eye(3), basis).reshape(-1, 3, size)
        else:
            turned = np.einsum("ac,ncx->nax", OPPONENT, mapped)
            grey = _loadings(turned[:, 0], weight, candidate.components[0])
            colour = _loadings(turned[:, 1:].reshape(-1, size), weight, candidate.components[1])
            parts = zip(OPPONENT, (grey, colour, colour), strict=True)
            self._design = np.concatenate([t[None, :, None] * b[:, None] for t, b in parts])

    def encode(self, known: MeasuredSet) -> Iterator[tuple[float, Float64, Float64]]:
        """Encode every material of a set.

        Parameters
        ----------
        known : MeasuredSet

        Yields
        ------
        left : float
            Mean absolute error of the mapped values.
        (3, n) float64
            Log(f + FLOOR) at the measured angles.
        (3, cells) float64
            f.
        """
        index, corner = self.grid.stencil(*known.angles)

        def at(cells: Float64) -> Float64:
            return np.asarray(np.einsum("nk,...nk->...n", corner, cells[..., index]))

        design, mean, w, b = (at(v) for v in (self._design, self._mean, self._w, self._b))
        flat = design.reshape(len(design), -1)
        for rgb in known.materials.values():
            target = self._forward(np.maximum(rgb.T, 0.0), w, b) - mean
            z = _robust(flat, target.ravel())
            left = float(np.mean(np.abs(z @ flat - target.ravel())))
            shown = np.maximum(self._back(np.tensordot(z, design, 1) + mean, w, b), 0.0)
            whole = np.tensordot(z, self._design, 1) + self._mean
            f = np.maximum(self._back(np.minimum(whole, 30.0), self._w, self._b), 0.0)
            yield left, np.log(shown + FLOOR), f


class Charts:
    """A candidate's spaces, fitted to tables (n, 3, cells) of f: clusters of what is alike."""

    def __init__(self, candidate: Candidate, tables: Float32) -> None:
        whole = [np.ones(len(tables), bool)]
        if candidate.charts > 1:
            grey = np.log(tables + FLOOR).mean(axis=1)
            scores, _, _ = randomized_svd(grey - grey.mean(axis=0), 8, random_state=0)
            cluster = KMeans(candidate.charts, n_init=4, random_state=0).fit(scores)
            whole = [cluster.labels_ == c for c in range(candidate.charts)]
        self.spaces = [Space(candidate, tables[some]) for some in whole]

    def encode(self, known: MeasuredSet) -> list[tuple[Float64, Float64]]:
        """Of every material |d log(f + FLOOR)| (3, n) and f (3, cells), by its best chart."""
        found = []
        for rgb, fits in zip(
            known.materials.values(), zip(*(s.encode(known) for s in self.spaces), strict=True),
            strict=True,
        ):  # fmt: skip
            _, logs, f = min(fits, key=lambda fit: fit[0])
            found.append((np.abs(logs - np.log(np.maximum(rgb.T, 0.0) + FLOOR)), f))
        return found


class Spheres:
    """Pictures of a sphere under some maps, of f (3, cells) on any grid."""

    def __init__(self, environments: Sequence[EnvironmentMap], size: int = 64) -> None:
        self.scenes = [Scene(sphere(), environment, size=size) for environment in environments]
        self._operators: dict[HalfDiffGrid, list[Operator]] = {}

    def images(self, grid: HalfDiffGrid, materials: Sequence[Float64]) -> list[Float64]:
        """(B, P, 3) radiance of B materials, a map each."""
        if grid not in self._operators:
            self._operators = {grid: [Operator(scene, grid) for scene in self.scenes]}
        columns = np.concatenate([f.T for f in materials], axis=1).astype(np.float32)
        found = []
        for operator in self._operators[grid]:
            images = own_colours(operator.part_images(0, columns))
            found.append(images.swapaxes(0, 1).astype(np.float64))
        return found

    def compare(self, true: Sequence[Float64], shown: Sequence[Float64]) -> dict[str, float]:
        """Mean linear PSNR (peak: the brightest of the image) and mean FLIP of the pictures."""
        psnr, flips = [], []
        for scene, every, found in zip(self.scenes, true, shown, strict=True):
            for image, other in zip(every, found, strict=True):
                square = float(np.mean((image - other) ** 2))
                psnr.append(decibels(float(image.max()), square))
                scale = 0.8 / np.quantile(image.max(axis=1), 0.9)
                pair = [np.zeros((scene.height * scene.width, 3)) for _ in range(2)]
                for picture, values in zip(pair, (image, other), strict=True):
                    picture[scene.pixels] = encode_srgb(values * scale) / 255.0
                flips.append(_flip(*(p.reshape(scene.height, scene.width, 3) for p in pair)))
        return {"PSNR, dB": float(np.mean(psnr)), "FLIP": float(np.mean(flips))}


def _flip(reference: Float64, image: Float64) -> float:
    """Mean FLIP of the pixels of two sRGB pictures (Andersson et al. 2020)."""
    import flip_evaluator  # an optional extra

    pair = (np.ascontiguousarray(p, np.float32) for p in (reference, image))
    return float(flip_evaluator.evaluate(*pair, "LDR", applyMagma=False)[1])


def _loadings(rows: Any, weight: Float64, count: int) -> Float64:
    """Components (count, cells) of rows (n, cells), for scores of unit variance."""
    left, _, _ = randomized_svd(rows * weight.astype(np.float32), count, random_state=0)
    scores = left * math.sqrt(len(rows))
    return np.asarray(np.linalg.solve(scores.T @ scores, scores.T @ rows), np.float64)


def _robust(design: Float64, target: Float64) -> Float64:
    """Coordinates with nearly the least sum of absolute deviations, under a weak prior."""
    weight, prior = np.ones(len(target)), 1e-5 * len(target) * np.eye(len(design))
    scale = 0.03 * max(float(np.std(target)), 1e-6)
    z: Float64 = np.zeros(len(design))
    for _ in range(15):
        weighted = design * weight
        z = np.asarray(np.linalg.solve(weighted @ design.T + prior, weighted @ target), np.float64)
        weight = scale / np.maximum(np.abs(target - z @ design), scale)
    return z


# -- what is judged -------------------------------------------------------------------------------


def members(count: int, seed: int, grid: HalfDiffGrid) -> tuple[list[str], Float32]:
    """Names and tables (count, 3, cells) of the recipe's first members."""
    found = list(materials(seed, count))
    tables = [table_of(m, grid).values.reshape(-1, 3).T for m in found]
    return [m.name for m in found], np.stack(tables).astype(np.float32)


def study(
    candidates: Sequence[Candidate],
    count: int,
    data: Path | None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Iterator[tuple[Candidate, dict[str, float]]]:
    """Compare candidates: medians over materials of the median error over their cells.

    Parameters
    ----------
    candidates : sequence of Candidate
    count : int
        Members of the library.
    data : Path or None
        Folder of measured materials; held-out members alone without it.
    seed : int
        Of the recipe.
    progress : callable, optional
        Called with (stage, fraction); it may raise to stop.

    Yields
    ------
    Candidate
    dict of float
        "held out", "MERL", "MERL, 90th", "MERL, peak" (theta_h below 10 degrees), "RGL", "PSNR, dB"
        and "FLIP" (of the RGL materials on a sphere under three maps): those for which there is
        data.
    """
    report = progress or (lambda stage, fraction: None)
    sets = [] if data is None else measured_sets(data, 16, 6)
    measured: list[TabulatedBRDF] = []
    spheres = Spheres([])
    if data is not None:
        files = sorted((data / "rgl").glob("*.bsdf"))
        measured = [TabulatedBRDF.from_model(MeasuredBRDF.read(path), GRID) for path in files]
        under = [data / "envmaps" / f"{name}.exr" for name in RENDERED_UNDER]
        spheres = Spheres([EnvironmentMap.read(path) for path in under])
    tables: dict[HalfDiffGrid, tuple[list[str], Float32]] = {}
    for done, candidate in enumerate(candidates):
        grid = candidate.grid
        if grid not in tables:
            tables = {grid: members(count, seed, grid)}
            own = [t.regrid(grid).values.reshape(-1, 3).T.astype(np.float64) for t in measured]
            true = spheres.images(grid, own) if own else []
        names, known = tables[grid]
        held = np.arange(count) % HELD_OUT == HELD_OUT - 1
        charts = Charts(candidate, known[~held])
        th, td, pd = (a[grid.above_horizon] for a in grid.node_angles())
        seen = grid.above_horizon.ravel()
        apart = {
            names[i]: known[i][:, seen].T.astype(np.float64) for i in np.flatnonzero(held)[:60]
        }
        result = {}
        for one in [MeasuredSet("held out", (th, td, pd), apart), *sets]:
            encoded = charts.encode(one)
            errors = [error for error, _ in encoded]
            medians = [float(np.median(e)) for e in errors]
            result[one.name] = float(np.median(medians))
            if one.name == "MERL":
                peak = one.angles[0] < math.radians(10.0)
                result["MERL, 90th"] = float(np.quantile(medians, 0.9))
                result["MERL, peak"] = float(np.median([np.median(e[:, peak]) for e in errors]))
            if one.name == "RGL":
                result |= spheres.compare(true, spheres.images(grid, [f for _, f in encoded]))
        report("comparing", (done + 1) / len(candidates))
        yield candidate, result


_COLUMNS = ("mapping", "colour", "components", "k", "weight", "grid", "charts")


def table(rows: Sequence[tuple[Candidate, dict[str, float]]]) -> str:
    """Format the comparison as a Markdown table.

    Parameters
    ----------
    rows : sequence of (Candidate, dict of float)
        Candidates and their errors by name, as `study` yields them.
    """
    names = list(rows[0][1])
    lines = [
        "| mapping | colour | components | k | weight | grid | charts | "
        + " | ".join(names)
        + " |",
        "|" + "---|" * len([*_COLUMNS, *names]),
    ]
    for candidate, result in rows:
        parts = (
            candidate.mapping, candidate.colour, "+".join(map(str, candidate.components)),
            str(candidate.numbers), candidate.weight, "x".join(map(str, candidate.grid.shape)),
            str(candidate.charts),
            *(f"{result[name]:.{1 if 'dB' in name else 3}f}" for name in names),
        )  # fmt: skip
        lines.append("| " + " | ".join(parts) + " |")
    return "\n".join(lines)


def trait_table() -> str:
    """Describe every shipped trait, and how well scores rank members, in a Markdown table.

    Accuracy is the rank correlation with the grades of the members' own tables: of the normal of a
    linear support vector machine and of the difference of class means, on every fifth member after
    a fit to the others' labels, and of the shipped scores, of which only the grades' scale is
    fitted.
    """
    library, space = default_library(), default_traits()
    assert space.optics is not None
    columns = [library.descriptors[name] for name in DESCRIPTORS]
    values = space.optics.grades.of(np.stack(columns, axis=1)) @ space.weights.T
    z, scores = library.coordinates, space.scores(library.coordinates)
    test = np.arange(len(z)) % 5 == 0
    lines = [
        "| trait | means | also | reads | machine | class means | read off | goes with |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for i, (name, trait) in enumerate(TRAITS.items()):
        value = values[:, i]
        marks = labels(value)[~test]
        found = [spearman(z[test] @ straight(z[~test], marks, name, m), value[test])
                 for m in (False, True)]  # fmt: skip
        found.append(spearman(scores[test, i], value[test]))
        reads = ", ".join(f"{w:+g} {d}" for d, w in trait.weights.items())
        near = [
            f"{space.names[j]} {space.related[i, j]:+.2f}"
            for j in np.argsort(-np.abs(space.related[i]))
            if j != i and abs(space.related[i, j]) >= RELATED
        ]
        near = near[:5] + ([f"and {len(near) - 5} more"] if len(near) > 5 else [])
        cells = [name, trait.meaning, ", ".join(trait.synonyms), reads]
        cells += [f"{value:.3f}" for value in found]
        lines.append(f"| {' | '.join(cells)} | {', '.join(near)} |")
    return "\n".join(lines)
