"""Real-time frames: light transport as a linear operator from table cells to pixels, compressed.

For one scene the radiance of a pixel is linear in the BRDF table, I = W rho. A row of W collects,
for every piece of light, the eight cells that `TabulatedBRDF.eval` would interpolate between.

*Rows* (`Operator`). The map is walked as a tree (`lights.LightTree`): a node of light stands for
its texels where it looks small from the mirror peak, measured in half-vector space; a texel that
looks large is cut further. A node's irradiance is exact (vector moments), and its own extent is
carried into theta_h to second order (two samples one standard deviation apart), so the error
falls with the fourth power of the node size while the number of nodes grows with its inverse
square.

*Basis* (`Transport`). Seen through one part of one scene, the BRDFs of interest span few
dimensions. From the rows W_S of a subset S of pixels and training tables X, the SVD of the
column-normalised W_S X = U Sigma Y^T gives the combinations M = X Y Sigma^-1 of training tables
whose images W M span the frames; Q = orth(W M) is computed over all pixels, chunk by chunk.
Frame = Q (C rho). The orthogonal choice C = Q^T W needs every row a second time; weighted least
squares on some six times more rows than Q has columns comes within a tenth of its error, if the
pixels with the greatest leverage in Q are among them and the rest is drawn at random (a uniform
draw errs up to ten times as much on tables outside the training set). (Projecting rho on an
orthonormal basis of cell space instead errs by tens of percent.)

*Error*. Some pixels, drawn evenly from all that are shown, keep their exact rows, built at twice
the resolution: comparing them gives every frame its measured error. (Drawing them from outside the
fit alone would overstate the error of small parts, of which the fit holds most pixels.)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf.brdf import HalfDiffGrid
from traitbrdf.directions import half_diff_angles, reflect, to_local
from traitbrdf.lights import LightTree
from traitbrdf.models import (
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
from traitbrdf.scene import Scene

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Progress = Callable[[str, float], None]
"""Called with what is being done and the fraction done; may raise to cancel."""

_ROWS_AT_ONCE = 512


class Operator:
    """Rows of W: what every cell of a table contributes to a pixel.

    Parameters
    ----------
    scene : Scene
    grid : HalfDiffGrid of the "folded" layout
    resolution : float
        1 is the default; 2 halves the size of the light nodes (four times as many).
    """

    def __init__(self, scene: Scene, grid: HalfDiffGrid, resolution: float = 1.0) -> None:
        if grid.layout != "folded":
            raise ValueError(f"grid: expected the 'folded' layout, got {grid.layout!r}")
        if not (math.isfinite(resolution) and resolution > 0.0):
            raise ValueError(f"resolution: expected a positive number, got {resolution!r}")
        self.scene = scene
        self.grid = grid
        self.resolution = resolution
        self._tree = LightTree.build(scene.environment)
        self._nodes = _pack(self._tree)
        to_map = scene.environment.to_map
        self._normals = np.ascontiguousarray(to_map(scene.normals))
        self._views = np.ascontiguousarray(to_map(scene.views))

    def rows(self, index: NDArray[np.int64], resolution: float | None = None) -> Float32:
        """(m, 3, grid.size) rows of the covered pixels `index` (m,), one for each colour."""
        out = np.empty((len(index), 3, self.grid.size), np.float32)
        scale = 1.0 / (self.resolution if resolution is None else resolution)
        tree = self._tree
        _fill_rows(
            out, self._normals[index], self._views[index],
            self._nodes, tree.child, tree.rectangle,
            self.scene.environment.image, *self.grid.shape,
            0.4 * scale, scale**2 / 500.0, 0.02 * scale, 0.08 * scale,
        )  # fmt: skip
        self._add_lights(out, index)
        return out

    def images(self, index: NDArray[np.int64], tables: torch.Tensor) -> torch.Tensor:
        """(3, m, T) radiance of the pixels `index` under tables (3, grid.size, T), in chunks."""
        parts = [
            torch.bmm(torch.from_numpy(self.rows(chunk)).permute(1, 0, 2), tables)
            for chunk in _chunks(index)
        ]
        return torch.cat([tables.new_zeros((3, 0, tables.shape[-1])), *parts], dim=1)

    def _add_lights(self, out: Float32, index: NDArray[np.int64]) -> None:
        scene = self.scene
        normals = scene.normals[index]
        wo = to_local(scene.views[index], normals)
        for light in scene.lights:
            toward, irradiance = light.arriving(scene.positions[index])
            wi = to_local(toward, normals)
            cos = np.maximum(wi[:, 2], 0.0)
            cells, corner = self.grid.stencil(*half_diff_angles(wi, wo))
            weight = irradiance * cos[:, None]
            at = np.arange(len(index))
            for k in range(8):
                for c in range(3):
                    out[at, c, cells[:, k]] += (corner[:, k] * weight[:, c]).astype(np.float32)


@dataclass
class _Draft:
    """A part while its basis is being made."""

    pixels: NDArray[np.int64]
    basis: torch.Tensor  # (3, P, r), orthonormal where pixels are damped
    damping: torch.Tensor  # (3, P, 1)
    fit: NDArray[np.int64]
    weight: Float64
    rows: Float32
    probes: NDArray[np.int64]
    exact: Float32


@dataclass
class _PartBasis:
    """One part's compressed operator."""

    pixels: torch.Tensor  # (P,) flat pixel indices
    basis: torch.Tensor  # Q^T (3, r, P): this way round a product with a vector is fastest
    projection: torch.Tensor  # C (3, r, cells)
    probe_rows: torch.Tensor  # (3, m, cells)
    probe_basis: torch.Tensor  # (3, m, r)
    mirror: torch.Tensor  # (P, 3) what a perfect mirror shows


@dataclass(frozen=True)
class PartFrame:
    """One part's shading of one table, and its measured error."""

    radiance: torch.Tensor  # (P, 3)
    deviation: float  # mean |I - I_exact| over the part's probes
    level: float  # mean I_exact over the part's probes

    @property
    def error(self) -> float:
        """Mean relative L1 of the part, 0 where it is black."""
        return self.deviation / self.level if self.level > 0.0 else self.deviation


@dataclass(frozen=True)
class Training:
    """Scalar tables (cells, T) float32 that a basis is fitted to, and what each counts (T,)."""

    tables: Float32
    weight: Float64


def training_tables(library: Float32, grid: HalfDiffGrid, seed: int = 0) -> Training:
    """What a frame has to be able to show.

    The library's channels; every model family at log-spaced parameters; and copies of both under
    smooth random fields in log f ("curve moves"), which count a tenth: measured materials are
    no library members, and these keep their error from growing tenfold.

    Parameters
    ----------
    library : (grid.size, n) float32, channels of library members
    grid : HalfDiffGrid
    seed : draws the fields
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
    weight[library.shape[1]] = 30.0  # Lambert, the first of the families, lies in every basis
    return Training(np.concatenate([plain, varied], axis=1), weight)


def _smooth_fields(grid: HalfDiffGrid, count: int, rng: np.random.Generator) -> Float32:
    """(cells, count) random sums of low cosines over the table, of amplitude about 1."""
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


class Transport:
    """The compressed operator of a scene: `shade` turns a table into a part's pixels.

    Parameters
    ----------
    scene : Scene
    grid : HalfDiffGrid
        The grid of the tables to be shown.
    training : Training
        What the basis is fitted to: see `training_tables`.
    rank : int
        Basis images for each part and colour.
    resolution : float
        As for `Operator`.
    seed : int
        Chooses the subset and the probe pixels.
    device : torch device of the frames
    progress : called with (stage, fraction)
    """

    TRAINING_ROWS = 320
    """Pixels of a part (S) on which the training tables are compared."""
    FIT_FACTOR = 6
    """Rows of the least-squares fit for each basis image."""
    PROBES = 48
    """Pixels of a part that are kept exact, to measure errors."""

    def __init__(
        self,
        scene: Scene,
        grid: HalfDiffGrid,
        training: Training,
        rank: int = 64,
        resolution: float = 1.0,
        seed: int = 0,
        device: str | torch.device = "cpu",
        progress: Progress | None = None,
    ) -> None:
        shape = training.tables.shape
        if shape != (grid.size, len(training.weight)) or not len(training.weight):
            raise ValueError(
                f"training: expected shape ({grid.size}, tables) with a weight for each table, "
                f"got {shape} and {len(training.weight)} weights"
            )
        if not isinstance(rank, int) or rank < 1:
            raise ValueError(f"rank: expected a positive integer, got {rank!r}")
        self.scene = scene
        self.grid = grid
        self.rank = rank
        self.device = torch.device(device)
        self.operator = Operator(scene, grid, resolution)
        report = progress or (lambda stage, fraction: None)
        rng = np.random.default_rng(seed)
        self._backdrop = torch.from_numpy(scene.backdrop()).reshape(-1, 3).to(self.device)
        tables = torch.from_numpy(np.ascontiguousarray(training.tables))
        importance = torch.from_numpy(training.weight)
        drafts: list[_Draft | None] = []
        done, total = 0, max(len(scene.pixels), 1)
        for part in range(len(scene.parts)):
            where = scene.part_slice(part)
            pixels = np.arange(where.start, where.stop)
            if len(pixels) == 0:
                drafts.append(None)
                continue
            probes = np.sort(rng.permutation(pixels)[: self.PROBES])
            subset = np.sort(rng.permutation(pixels)[: self.TRAINING_ROWS])
            mix = self._combinations(
                torch.from_numpy(self.operator.rows(subset)), tables, importance
            )
            images = []
            for chunk in _chunks(pixels):
                images.append(self.operator.images(chunk, mix))
                done += len(chunk)
                report("basis images", done / total)
            whole = torch.cat(images, dim=1)
            damping = _damping(whole, len(subset))
            basis = _orthonormal(whole * damping)
            fit, weight = self._fit_pixels(basis, pixels, rng)
            rows = self.operator.rows(fit)
            exact = self.operator.rows(probes, 2.0 * resolution)
            drafts.append(_Draft(pixels, basis, damping, fit, weight, rows, probes, exact))
        # cells that none of these pixels sees are neither decoded nor stored
        seen = np.zeros(grid.size, bool)
        for draft in drafts:
            if draft is not None:
                seen |= (draft.rows != 0.0).any(axis=(0, 1))
                seen |= (draft.exact != 0.0).any(axis=(0, 1))
        self.cells = np.flatnonzero(seen)
        """(n,) flat indices of the table cells that the scene can see."""
        self.parts: list[_PartBasis | None] = []
        for i, draft in enumerate(drafts):
            self.parts.append(None if draft is None else self._compress(draft))
            drafts[i] = None
            report("least squares", (i + 1) / len(drafts))

    def _fit_pixels(
        self,
        basis: torch.Tensor,
        pixels: NDArray[np.int64],
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.int64], Float64]:
        """Pixels and weights of the least-squares fit: a third by leverage, the rest by chance."""
        count = min(self.FIT_FACTOR * basis.shape[-1], len(pixels))
        leverage = (basis.double() ** 2).sum(dim=(0, 2)).numpy()
        order = np.argsort(-leverage, kind="stable")
        leading, others = order[: count // 3], order[count // 3 :]
        drawn = rng.choice(others, count - len(leading), replace=False)
        chosen = np.concatenate([leading, drawn])
        # each drawn pixel speaks for its share of the pixels that were not taken for leverage
        share = math.sqrt(len(others) / max(len(drawn), 1))
        weight = np.concatenate([np.ones(len(leading)), np.full(len(drawn), share)])
        ascending = np.argsort(chosen)
        return pixels[chosen[ascending]], weight[ascending]

    def _combinations(
        self, rows: torch.Tensor, tables: torch.Tensor, importance: torch.Tensor
    ) -> torch.Tensor:
        """M = X Y Sigma^-1 (3, cells, r) for the rows (m, 3, cells) of the subset."""
        combinations = []
        for c in range(3):
            images = (rows[:, c] @ tables).double()
            scale = images.mean(dim=0)
            lit = scale > 0.0
            weight = torch.where(lit, importance / torch.where(lit, scale, 1.0), 0.0)
            images = images * weight
            # eigenvectors of the small Gram matrix: an SVD crawls where singular values underflow
            squares, u = _eigh(images @ images.T)
            rank = min(self.rank, len(squares))
            squares, u = squares.flip(0)[:rank], u.flip(1)[:, :rank]
            keep = squares > 1e-13 * squares[0].clamp_min(1e-30)
            inverse = torch.where(keep, 1.0 / torch.where(keep, squares, 1.0), 0.0)
            mix = weight[:, None] * (images.T @ u) * inverse
            combinations.append(tables @ mix.float())
        return torch.stack(combinations)

    def _compress(self, draft: _Draft) -> _PartBasis:
        pixels, basis, scene = draft.pixels, draft.basis, self.scene
        seen = torch.from_numpy(self.cells)
        weight = torch.from_numpy(draft.weight)[:, None]
        at = torch.from_numpy(draft.fit - pixels[0])
        sampled = basis[:, at].double() * weight
        damped = (draft.damping[:, at] * weight).transpose(1, 2)
        shown = basis / draft.damping
        gram = sampled.transpose(1, 2) @ sampled
        squares, vectors = _eigh(gram)
        keep = squares > 1e-9 * squares[:, -1:].clamp_min(1e-30)
        scale = torch.where(keep, 1.0 / torch.where(keep, squares, 1.0), 0.0)
        inverse = (vectors * scale[:, None, :]) @ vectors.transpose(1, 2)
        solve = (inverse @ sampled.transpose(1, 2) * damped).float()
        rows = torch.from_numpy(draft.rows)[:, :, seen].permute(1, 0, 2)
        mirror = scene.environment.radiance(reflect(scene.views[pixels], scene.normals[pixels]))
        move = self.device
        return _PartBasis(
            pixels=torch.from_numpy(scene.pixels[pixels]).to(move),
            basis=shown.transpose(1, 2).contiguous().to(move),
            projection=torch.bmm(solve, rows).to(move),
            probe_rows=(
                torch.from_numpy(draft.exact)[:, :, seen].permute(1, 0, 2).contiguous().to(move)
            ),
            probe_basis=shown[:, torch.from_numpy(draft.probes - pixels[0])].contiguous().to(move),
            mirror=torch.from_numpy(np.ascontiguousarray(mirror)).to(move),
        )

    @property
    def bytes(self) -> int:
        """Size of everything that a frame reads."""
        return sum(
            t.numel() * t.element_size()
            for p in self.parts
            if p is not None
            for t in (p.basis, p.projection, p.probe_rows, p.probe_basis)
        )

    def shade(
        self, part: int, table: torch.Tensor, mirror: torch.Tensor | None = None
    ) -> PartFrame:
        """Linear radiance of one part's pixels, and its error measured on the probes.

        Parameters
        ----------
        part : index into ``scene.parts``
        table : (len(cells), 3) float32
            f_r at the cells that the scene sees.
        mirror : (3,) weight of a perfect mirror
        """
        if table.shape != (len(self.cells), 3):
            raise ValueError(f"table: expected ({len(self.cells)}, 3), got {tuple(table.shape)}")
        known = self.parts[part]
        if known is None:
            empty = torch.zeros((0, 3), device=self.device)
            return PartFrame(empty, 0.0, 0.0)
        columns = table.T.contiguous()
        # colour by colour: a batched product of matrices with vectors is four times slower
        coefficients = _per_colour(known.projection, columns)
        exact = _per_colour(known.probe_rows, columns)
        shown = _per_colour(known.probe_basis, coefficients).clamp_min(0.0)
        deviation = float((shown - exact).abs().mean())
        level = float(exact.mean())
        pixels = _per_colour(known.basis.transpose(1, 2), coefficients).T.clamp_min(0.0)
        if mirror is not None and bool((mirror > 0.0).any()):
            pixels = pixels + mirror * known.mirror
        return PartFrame(pixels, deviation, level)

    def shade_exactly(
        self, part: int, table: Float32, mirror: torch.Tensor | None = None
    ) -> PartFrame:
        """The same by the uncompressed operator: slow, for tables outside the basis.

        `table` is (grid.size, 3).
        """
        if table.shape != (self.grid.size, 3):
            raise ValueError(f"table: expected ({self.grid.size}, 3), got {table.shape}")
        scene = self.scene
        pixels = np.arange(len(scene.pixels))[scene.part_slice(part)]
        columns = torch.from_numpy(np.ascontiguousarray(table.T[:, :, None]))
        radiance = self.operator.images(pixels, columns)[..., 0].T.to(self.device)
        known = self.parts[part]
        if known is not None and mirror is not None:
            radiance = radiance + mirror * known.mirror
        return PartFrame(radiance, 0.0, float(radiance.mean()) if len(pixels) else 0.0)

    def compose(self, frames: list[PartFrame]) -> torch.Tensor:
        """The frame (H, W, 3): the parts over the backdrop."""
        image = self._backdrop.clone()
        for part, frame in zip(self.parts, frames, strict=True):
            if part is not None:
                image.index_copy_(0, part.pixels, frame.radiance)
        return image.reshape(self.scene.height, self.scene.width, 3)

    def frame_error(self, frames: list[PartFrame]) -> float:
        """Mean relative L1 over the covered pixels, from the parts' probes."""
        size = [0 if p is None else len(p.pixels) for p in self.parts]
        deviation = sum(n * f.deviation for n, f in zip(size, frames, strict=True))
        level = sum(n * f.level for n, f in zip(size, frames, strict=True))
        return deviation / level if level > 0.0 else deviation


def _per_colour(matrices: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """(3, a, b) times (3, b), colour by colour."""
    return torch.stack([torch.mv(matrices[c], vectors[c]) for c in range(3)])


def _eigh(symmetric: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Eigenvalues, ascending, and eigenvectors, on one thread.

    Several threads would meet at thousands of barriers, and where other work shares the cores each
    of them costs a time slice: seconds for what one thread does in milliseconds.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        values, vectors = torch.linalg.eigh(symmetric)
    finally:
        torch.set_num_threads(threads)
    return values, vectors


def _damping(images: torch.Tensor, subset: int) -> torch.Tensor:
    """Factors (3, P, 1), 1 but for pixels that stand far above all those of the subset.

    At grazing views, or where one pixel of thousands mirrors the sun, unbounded lobes make a
    pixel's images exceed the subset's a thousandfold. It would then fill the basis alone.
    """
    energy = (images**2).sum(dim=-1, keepdim=True)
    usual = images.shape[-1] / subset  # the images are orthonormal on the subset
    return (30.0 * usual / energy.clamp_min(1e-30)).sqrt().clamp_max(1.0)


def _orthonormal(images: torch.Tensor) -> torch.Tensor:
    """An orthonormal basis (3, P, r) of the columns of images (3, P, r), by their Gram matrix.

    The columns are nearly orthonormal to begin with; directions that vanish become zero columns.
    """
    basis = images
    for _ in range(2):  # the second pass removes what float32 left of the first
        gram = torch.stack([(b.T @ b).double() for b in basis])
        values, vectors = _eigh(gram)
        keep = values > 1e-6 * values[:, -1:].clamp_min(1e-30)
        scale = torch.where(keep, torch.where(keep, values, 1.0).rsqrt(), 0.0)
        basis = torch.bmm(basis, (vectors * scale[:, None, :]).float())
    return basis


def _pack(tree: LightTree) -> Float32:
    """(n, 16) float32: all that the walk reads of a node, in one line of cache."""
    nodes = np.zeros((len(tree.radius), 16), np.float32)
    nodes[:, :3] = tree.direction
    nodes[:, 3] = tree.radius
    nodes[:, 4] = tree.spread**2
    nodes[:, 5:14] = tree.moment.reshape(-1, 9)
    return nodes


def _chunks(index: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    return [index[i : i + _ROWS_AT_ONCE] for i in range(0, len(index), _ROWS_AT_ONCE)]


# The walk below is the one loop that torch cannot express: a tree descent for each pixel. Numba
# compiles it; everything that runs while a user paints is torch, on any device.


@numba.njit(cache=True, inline="always")
def _arctan(y: Any, x: Any) -> Any:
    """atan2 in the first quadrant, to 2e-6 of the angle (Abramowitz & Stegun 4.4.49)."""
    t = min(x, y) / max(max(x, y), 1e-300)
    s = t * t
    a = -0.0040540580
    for c in (
        0.0218612288, -0.0559098861, 0.0964200441, -0.1390853351, 0.1994653599, -0.3332985605,
        0.9999993329,
    ):  # fmt: skip
        a = a * s + c
    a *= t
    return a if y <= x else 0.5 * math.pi - a


@numba.njit(cache=True, inline="always")
def _push_quarters(cells: Any, top: Any, t0: Any, t1: Any, f0: Any, f1: Any, texel: Any) -> Any:
    """Put the quarters of a piece of a texel on the stack `cells`; returns its new top."""
    tm, fm = 0.5 * (t0 + t1), 0.5 * (f0 + f1)
    for a in range(4):
        top += 1
        cells[top, 0] = t0 if a < 2 else tm
        cells[top, 1] = tm if a < 2 else t1
        cells[top, 2] = f0 if a % 2 == 0 else fm
        cells[top, 3] = fm if a % 2 == 0 else f1
        cells[top, 4] = texel
    return top


@numba.njit(cache=True, error_model="numpy")
def _coarse_irradiance(n: Any, nodes: Any, child: Any, stack: Any) -> Any:
    """Irradiance (summed over colours) to some percent: what bright nodes are measured against."""
    total = 0.0
    top = 0
    stack[0] = 0
    while top >= 0:
        i = stack[top]
        top -= 1
        cos_i = n[0] * nodes[i, 0] + n[1] * nodes[i, 1] + n[2] * nodes[i, 2]
        r = nodes[i, 3]
        if r > 0.2 and (child[i, 0] >= 0 or child[i, 1] >= 0):
            for s in range(2):
                if child[i, s] >= 0:
                    top += 1
                    stack[top] = child[i, s]
        elif cos_i > 0.0:
            for c in range(3):
                total += max(
                    0.0,
                    n[0] * nodes[i, 5 + 3 * c]
                    + n[1] * nodes[i, 6 + 3 * c]
                    + n[2] * nodes[i, 7 + 3 * c],
                )
    return max(total, 1e-30)


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def _fill_row(
    row: Any, n: Any, v: Any,
    nodes: Any, child: Any, rectangle: Any, image: Any,
    n_h: Any, n_d: Any, n_p: Any, relative: Any, brightest: Any, horizon: Any, widest: Any,
    stack: Any, cells: Any,
) -> None:  # fmt: skip
    """Add one pixel's weights to `row` (3, cells).

    A node is used whole where its reach in half-vector space is at most `relative` times its
    distance from the mirror peak, it carries at most the share `brightest` of the irradiance or
    is accordingly smaller, it is no wider than `widest`, and, if the horizon cuts it, `horizon`.
    """
    half_pi = 0.5 * math.pi
    t_step, f_step = math.pi / image.shape[0], 2.0 * math.pi / image.shape[1]
    total = _coarse_irradiance(n, nodes, child, stack)
    top = 0
    stack[0] = 0
    piece = -1
    while top >= 0 or piece >= 0:
        in_texel = piece >= 0
        t0 = t1 = f0 = f1 = 0.0
        if in_texel:
            t0, t1, f0, f1 = cells[piece, 0], cells[piece, 1], cells[piece, 2], cells[piece, 3]
            i = int(cells[piece, 4])
            piece -= 1
            tm, fm = 0.5 * (t0 + t1), 0.5 * (f0 + f1)
            st = math.sin(tm)
            cx, cy, cz = -st * math.sin(fm), math.cos(tm), st * math.cos(fm)
            cos_i = n[0] * cx + n[1] * cy + n[2] * cz
            e = 2.0 * st * math.sin(0.5 * (t1 - t0)) * (f1 - f0) * cos_i
            at_row, at_column = rectangle[i, 0], rectangle[i, 2]
            e0 = image[at_row, at_column, 0] * e
            e1 = image[at_row, at_column, 1] * e
            e2 = image[at_row, at_column, 2] * e
            r = 0.5 * math.sqrt((t1 - t0) ** 2 + (st * (f1 - f0)) ** 2)
            variance = r * r / 6.0
        else:
            i = stack[top]
            top -= 1
            cx, cy, cz = nodes[i, 0], nodes[i, 1], nodes[i, 2]
            cos_i = n[0] * cx + n[1] * cy + n[2] * cz
            e0 = n[0] * nodes[i, 5] + n[1] * nodes[i, 6] + n[2] * nodes[i, 7]
            e1 = n[0] * nodes[i, 8] + n[1] * nodes[i, 9] + n[2] * nodes[i, 10]
            e2 = n[0] * nodes[i, 11] + n[1] * nodes[i, 12] + n[2] * nodes[i, 13]
            r = nodes[i, 3]
            variance = nodes[i, 4]
        # the centroid may lie in a corner: everything is within 2 r of it
        if cos_i < -2.0 * r:
            continue
        hx, hy, hz = cx + v[0], cy + v[1], cz + v[2]
        length = math.sqrt(hx * hx + hy * hy + hz * hz)
        scale = 1.0 / max(length, 1e-6)
        hx *= scale
        hy *= scale
        hz *= scale
        px, py, pz = hy * n[2] - hz * n[1], hz * n[0] - hx * n[2], hx * n[1] - hy * n[0]
        sin_h = math.sqrt(px * px + py * py + pz * pz)
        cos_h = hx * n[0] + hy * n[1] + hz * n[2]
        reach = r / max(length, 0.1)
        allowed = relative * (max(sin_h - reach, 0.0) + 1e-3)
        share = (e0 + e1 + e2) / total
        if share > brightest:
            allowed *= max(0.25, math.sqrt(brightest / share))
        if reach > allowed or r > widest or (abs(cos_i) < 2.0 * r and r > horizon):
            if in_texel:
                if piece + 4 < cells.shape[0] and r > 1e-5:
                    piece = _push_quarters(cells, piece, t0, t1, f0, f1, i)
                    continue
            elif rectangle[i, 1] - rectangle[i, 0] == 1 and rectangle[i, 3] - rectangle[i, 2] == 1:
                piece = _push_quarters(
                    cells, piece,
                    rectangle[i, 0] * t_step, rectangle[i, 1] * t_step,
                    rectangle[i, 2] * f_step, rectangle[i, 3] * f_step, i,
                )  # fmt: skip
                continue
            else:
                for s in range(2):
                    if child[i, s] >= 0:
                        top += 1
                        stack[top] = child[i, s]
                continue
        e0, e1, e2 = max(e0, 0.0), max(e1, 0.0), max(e2, 0.0)
        if cos_i <= 0.0 or e0 + e1 + e2 <= 0.0:
            continue
        dx, dy, dz = cx - v[0], cy - v[1], cz - v[2]
        theta_d = _arctan(math.sqrt(dx * dx + dy * dy + dz * dz), length)
        theta_h = _arctan(sin_h, max(cos_h, 0.0))
        across = abs(cx * px + cy * py + cz * pz)
        along = abs(0.5 * length * cos_h - cos_i)
        phi_d = _arctan(across, along)
        y = theta_d / half_pi * (n_d - 1)
        b0 = min(int(y), n_d - 2)
        fb = y - b0
        z = phi_d / half_pi * (n_p - 1)
        c0 = min(int(z), n_p - 2)
        fc = z - c0
        # in the plane of incidence h moves half as far as wi, across it 1 / (2 cos theta_d) as far
        stretch = 4.0 / max(length * length, 0.01)
        ss = across * across / max(across * across + along * along, 1e-300)
        outward = 0.25 * variance * ((1.0 - ss) + ss * stretch)
        sideways = 0.25 * variance * (ss + (1.0 - ss) * stretch)
        theta_m = math.sqrt(theta_h * theta_h + sideways)
        delta = math.sqrt(outward)
        for side in range(2):
            th = abs(theta_m - delta) if side == 0 else theta_m + delta
            th = min(th, half_pi)
            a0 = min(int(math.sqrt(th / half_pi) * (n_h - 1)), n_h - 2)
            low = (a0 / (n_h - 1)) ** 2 * half_pi
            high = ((a0 + 1) / (n_h - 1)) ** 2 * half_pi
            fa = min(max((th - low) / (high - low), 0.0), 1.0)
            base = (a0 * n_d + b0) * n_p + c0
            for a in range(2):
                wa = 0.5 * (fa if a else 1.0 - fa)
                for b in range(2):
                    wb = wa * (fb if b else 1.0 - fb)
                    for c in range(2):
                        w = wb * (fc if c else 1.0 - fc)
                        k = base + (a * n_d + b) * n_p + c
                        row[0, k] += w * e0
                        row[1, k] += w * e1
                        row[2, k] += w * e2


@numba.njit(parallel=True, cache=True, error_model="numpy")
def _fill_rows(
    out: Any, normals: Any, views: Any,
    nodes: Any, child: Any, rectangle: Any, image: Any,
    n_h: Any, n_d: Any, n_p: Any, relative: Any, brightest: Any, horizon: Any, widest: Any,
) -> None:  # fmt: skip
    for p in numba.prange(len(normals)):
        stack = np.empty(256, np.int32)
        cells = np.empty((256, 5), np.float64)
        out[p] = 0.0
        _fill_row(
            out[p], normals[p], views[p], nodes, child, rectangle,
            image, n_h, n_d, n_p, relative, brightest, horizon, widest, stack, cells,
        )  # fmt: skip
