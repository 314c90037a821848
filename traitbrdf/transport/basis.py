"""The basis images that frames are combined from, and the tables that they are fitted to.

For a fixed view and light, radiance is linear in the BRDF (Ben-Artzi, Overbeck & Ramamoorthi 2006,
section 3), so all frames lie in the span of the images of a training set.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf.reflectance.brdf import HalfDiffGrid
from traitbrdf.reflectance.models import (
    GGX,
    AshikhminShirley,
    BoundedPhong,
    BoundedTorranceSparrow,
    Lambert,
    Model,
    NormalizedPhong,
    OrenNayar,
    Sheen,
    TorranceSparrowSimplified,
)
from traitbrdf.scene.lights import Light, PointLight
from traitbrdf.scene.scene import Scene
from traitbrdf.transport.operator import Operator as Operator
from traitbrdf.transport.visibility import Progress as Progress

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

_PIECE = 4096
"""Fragments whose basis images are converted to float32 at a time."""

TOP = {torch.float32: 1.0, torch.bfloat16: 1.0, torch.float16: 2.0**14}
"""The types that basis images are kept in, and the largest value that each column is scaled to."""


@dataclass
class Basis:
    """The compressed operator of a group of parts: W is about Q C.

    Attributes
    ----------
    parts : range
        Indices into ``scene.parts``.
    basis : (P, r) tensor of a type in `TOP`
        Q: r basis images, shared by all colours.
    damping : (P,) tensor
        Weight of each fragment in the fit.
    cells : (n,) tensor
        Cells of the grid that the group sees.
    rows : (C, r + m, n) tensor
        The projection C of each colour, and the exact rows of m probes below it. The number of
        colours is 3, or 1 where all light is grey.
    place : (n,) tensor or None
        Where the cells are among those of the scene; None if they are all of these.
    """

    parts: range
    basis: torch.Tensor
    damping: torch.Tensor
    cells: torch.Tensor
    rows: torch.Tensor
    place: torch.Tensor | None = None

    @property
    def rank(self) -> int:
        """Number of basis images."""
        return self.basis.shape[-1]

    @property
    def projection(self) -> torch.Tensor:
        """Matrices (C, r, n) that take a table to its coefficients."""
        return self.rows[:, : self.rank]

    @property
    def probes(self) -> torch.Tensor:
        """Exact rows (C, m, n) of the probes."""
        return self.rows[:, self.rank :]

    def at_cells(self, table: torch.Tensor) -> torch.Tensor:
        """Return the values (3, n) of a table (len(Transport.cells), 3) at the group's cells."""
        return (table if self.place is None else table[self.place]).T.contiguous()

    def images(self, fragments: slice, coefficients: torch.Tensor) -> torch.Tensor:
        """Return Q at some of its fragments times coefficients (3, r): (P, 3) float32."""
        chosen = self.basis[fragments]
        if chosen.dtype == torch.float32:
            return chosen @ coefficients.T
        # sums in half precision would lose what cancels; a piece at a time fits the cache
        pieces = torch.split(chosen, _PIECE)
        return torch.cat([piece.float() @ coefficients.T for piece in pieces])

    def stored(self, dtype: torch.dtype) -> Basis:
        """Return the same basis with Q in another type.

        Each column is scaled to fill the range of the type; the projection takes up the scales.
        """
        basis = self.basis.float()
        if dtype == torch.float32:
            return replace(self, basis=basis)
        size = basis.abs().amax(dim=0) if len(basis) else basis.new_ones(self.rank)
        scale = torch.where(size > 0.0, TOP[dtype] / size.clamp_min(1e-30), 1.0)
        rows = self.rows.clone()
        rows[:, : self.rank] /= scale[:, None]
        return replace(self, basis=(basis * scale).to(dtype), rows=rows)


@dataclass(frozen=True)
class PartFrame:
    """One part shaded with one table, and its measured error.

    Attributes
    ----------
    radiance : (P, 3) tensor, linear radiance of the part's fragments
    deviation : float, mean |I - I_exact| over the part's probes
    level : float, mean I_exact over the part's probes
    since : (int, tensor) or None
        The `serial` of an earlier frame, and the fragments in which this one differs from it.
    serial : int, tells this frame from all others
    """

    radiance: torch.Tensor
    deviation: float
    level: float
    since: tuple[int, torch.Tensor] | None = None
    serial: int = field(default_factory=itertools.count().__next__)

    @property
    def error(self) -> float:
        """Mean relative L1 of the part; the deviation itself where the level is 0."""
        return self.deviation / self.level if self.level > 0.0 else self.deviation


@dataclass(frozen=True)
class Training:
    """What the bases of a transport are fitted to.

    Attributes
    ----------
    tables : (cells, T) float32 scalar tables, in 1/sr
    weight : (T,) float64, how much each table counts
    fixed : tables (cells, 3) float32 by index into ``scene.parts``
        Parts that keep their material. A group of nothing else is prepared for these tables alone,
        which takes a fraction of the time; `Transport.freed` prepares it for all others.
    combined : bool
        Whether the tables are those of a `UniversalBasis`: then the first of them have the images
        that a basis is made of. Otherwise they are combined anew for each scene.
    """

    tables: Float32
    weight: Float64
    fixed: Mapping[int, Float32] = field(default_factory=dict)
    combined: bool = False


def training_tables(library: Float32, grid: HalfDiffGrid, seed: int = 0) -> Training:
    """Collect the tables that frames have to be able to show.

    They are the library's channels; every model family at log-spaced parameters; and copies of both
    with smooth random fields added to log f, which count a tenth. Measured materials are not
    members of the library: without the copies their error would be ten times as large.

    Parameters
    ----------
    library : (grid.size, n) float32
        Channels of the library's members, in 1/sr.
    grid : HalfDiffGrid
    seed : int
        Draws the fields.
    """
    families: list[Model] = [Lambert(0.5)]
    families += [OrenNayar(0.5, sigma) for sigma in (0.3, 0.9)]
    families += [Sheen(0.5, alpha) for alpha in (0.3, 0.55, 1.0)]
    for s in np.geomspace(2.0, 2e4, 17):
        families += [BoundedPhong(0.5, float(s)), NormalizedPhong(0.5, float(s))]
    for s in np.geomspace(0.007, 0.6, 17):
        families += [
            BoundedTorranceSparrow(0.5, float(s)),
            TorranceSparrowSimplified(0.5, float(s)),
        ]
    for alpha in np.geomspace(0.005, 1.0, 17):
        families += [GGX(float(alpha), eta, k) for eta, k in ((1.5, 0.0), (0.2, 3.0), (2.5, 4.0))]
    for n in np.geomspace(3.0, 2e4, 12):
        families += [AshikhminShirley(0.0, r, float(n), float(n)) for r in (0.05, 0.9)]
    wi, wo = grid.node_directions()
    known = [library] + [m.eval(wi, wo)[..., 1].reshape(-1, 1) for m in families]
    plain = np.concatenate(known, axis=1).astype(np.float32)
    rng = np.random.default_rng(seed)
    chosen = rng.choice(plain.shape[1], 300)
    fields = _smooth_fields(grid, len(chosen), rng)
    varied = plain[:, chosen] * np.exp(fields)
    weight = np.concatenate([np.ones(plain.shape[1]), np.full(len(chosen), 0.1)])
    weight[library.shape[1]] = 30.0  # every basis must show Lambert, the first of the families
    return Training(np.concatenate([plain, varied], axis=1), weight)


def _smooth_fields(grid: HalfDiffGrid, count: int, rng: np.random.Generator) -> Float32:
    """Draw fields (cells, count) over the table: sums of low cosines, of amplitude about 1."""
    u = np.sqrt(grid.theta_h / (math.pi / 2))
    v = grid.theta_d / (math.pi / 2)
    waves = [
        np.einsum("i,j,l->ijl", np.cos(math.pi * a * u), np.cos(math.pi * b * v),
                  np.cos(2 * c * grid.phi_d)).ravel() / (1.0 + a + 1.5 * b + 2.0 * c)
        for a in range(5) for b in range(4) for c in range(3)
    ]  # fmt: skip
    stack = np.stack(waves, axis=1).astype(np.float32)
    mix = rng.normal(size=(stack.shape[1], count)).astype(np.float32)
    return 0.5 * (stack @ mix)


def per_colour(matrices: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Multiply matrices (C, a, b) with vectors (3, b) by colour; one (C = 1) serves all three."""
    if len(matrices) == 1:
        return (matrices[0] @ vectors.T).T
    # a batched product of matrices with vectors is four times slower
    return torch.stack([torch.mv(matrices[c], vectors[c]) for c in range(3)])


def damping_of(images: torch.Tensor) -> torch.Tensor:
    """Return factors (P,) that damp pixels far brighter than the others; 1 elsewhere.

    At grazing views, or where one pixel of thousands mirrors the sun, unbounded lobes can make a
    pixel a thousand times brighter than all others. It alone would then determine the basis.

    Parameters
    ----------
    images : (P, C, R) tensor
        R images of P pixels in C colours.
    """
    size = torch.linalg.vector_norm(images, dim=(1, 2))
    usual = size.mean()
    for _ in range(8):  # a mean that the brightest pixels hardly move
        usual = size.minimum(10.0 * usual).mean()
    return torch.where(size > 10.0 * usual, 10.0 * usual / size.clamp_min(1e-30), 1.0)


def leading(
    images: torch.Tensor, rank: int, enough: float, report: Callable[[], None] = lambda: None
) -> torch.Tensor:
    """Return the leading left singular vectors (P, r) of images, all columns together.

    Parameters
    ----------
    images : (P, C, R) tensor
    rank : int
        At most so many vectors.
    enough : float
        Vectors whose singular value is less than this share of the largest are left out.
    report : callable
        Is called now and then; may raise to cancel.
    """
    size, count = len(images), images.shape[1] * images.shape[2]
    gram = torch.zeros((count, count), dtype=torch.float64)
    pieces = [slice(start, start + 8192) for start in range(0, size, 8192)]
    for piece in pieces:  # singular values span eight decades: float32 would lose four of them
        columns = images[piece].reshape(-1, count).double()
        gram += columns.T @ columns
        report()
    squares, vectors = torch.linalg.eigh(gram)
    squares, vectors = squares.flip(0)[:rank], vectors.flip(1)[:, :rank]
    kept = max(1, int((squares > enough**2 * squares[0].clamp_min(1e-30)).sum()))
    turn = vectors[:, :kept] * squares[:kept].clamp_min(1e-30).rsqrt()
    basis = torch.empty((size, kept), dtype=torch.float32)
    for piece in pieces:
        columns = images[piece].reshape(-1, count).double()
        basis[piece] = (columns @ turn).float()
        report()
    return basis


def fit_rows(
    basis: torch.Tensor, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Float64]:
    """Draw fragments and weights of a least-squares fit, half by leverage scores and half evenly.

    Parameters
    ----------
    basis : (P, r) tensor, nearly orthonormal
    count : int
        Number of draws; some fragments are drawn more than once.
    rng : numpy.random.Generator
    """
    size = len(basis)
    if count >= size:
        return np.arange(size), np.ones(size)
    pieces = torch.split(basis, 8192)
    leverage = torch.cat([(piece.double() ** 2).sum(dim=1) for piece in pieces]).numpy()
    leverage = np.nan_to_num(leverage, nan=0.0, posinf=0.0)  # of a view where all is dark
    chance = 0.5 * leverage / max(leverage.sum(), 1e-30) + 0.5 / size
    chance /= chance.sum()
    chosen, times = np.unique(rng.choice(size, count, p=chance), return_counts=True)
    # a fragment stands for 1 / (expected number of draws) fragments
    return chosen, np.sqrt(times / (count * chance[chosen]))


def extended(basis: torch.Tensor, images: torch.Tensor) -> torch.Tensor:
    """Return an orthonormal basis (P, r) with further columns, so that it spans images (P, 3)."""
    known, fresh = basis.double(), images.double()
    fresh = fresh / fresh.norm(dim=0).clamp_min(1e-30)
    for _ in range(2):  # the second pass removes what rounding left of the first
        fresh = fresh - known @ (known.T @ fresh)
    squares, vectors = torch.linalg.eigh(fresh.T @ fresh)
    keep = squares > 1e-10  # grey light, or an image within the span, adds fewer columns
    fresh = (fresh @ vectors[:, keep]) * squares[keep].rsqrt()
    return torch.cat([basis, fresh.float()], dim=1)


def is_grey(scene: Scene) -> bool:
    """Return whether all light of a scene is grey."""
    image = scene.environment.image
    colours = [np.asarray(c) for light in scene.lights for c in [_colour(light)]]
    same = bool((image[..., 1:] == image[..., :1]).all())
    return same and all(bool((c == c[0]).all()) for c in colours)


def _colour(light: Light) -> tuple[float, float, float]:
    """Return what sets a light's colour: its intensity or its irradiance."""
    return light.intensity if isinstance(light, PointLight) else light.irradiance
