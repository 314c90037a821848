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
whose images W M span the frames; Q = orth(W M) is computed over all pixels, chunk by chunk, and
C = Q_S^+ W_S by least squares on the subset, which holds several times more rows than Q has
columns. Frame = Q (C rho). (Projecting rho on an orthonormal basis of cell space instead errs by
tens of percent.)

*Error*. Some more pixels, in neither the fit nor S, keep their exact rows, built at twice the
resolution: comparing them gives every frame its measured error.
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
            tree.moment, tree.direction, tree.spread, tree.radius, tree.child, tree.rectangle,
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
        return torch.cat(parts, dim=1)

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
class _PartBasis:
    """One part's compressed operator."""

    pixels: torch.Tensor  # (P,) flat pixel indices
    basis: torch.Tensor  # Q (3, P, r)
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


class Transport:
    """The compressed operator of a scene: `shade` turns a table into a part's pixels.

    Parameters
    ----------
    scene : Scene
    grid : HalfDiffGrid
        The grid of the tables to be shown.
    training : (grid.size, T) float32
        Scalar tables (single colour channels) whose images the basis is fitted to.
    rank : int
        Basis images for each part and colour.
    resolution : float
        As for `Operator`.
    seed : int
        Chooses the subset and the probe pixels.
    device : torch device of the frames
    progress : called with (stage, fraction)
    """

    SUBSET_FACTOR = 5
    PROBES = 48

    def __init__(
        self,
        scene: Scene,
        grid: HalfDiffGrid,
        training: Float32,
        rank: int = 48,
        resolution: float = 1.0,
        seed: int = 0,
        device: str | torch.device = "cpu",
        progress: Progress | None = None,
    ) -> None:
        if training.ndim != 2 or training.shape[0] != grid.size:
            raise ValueError(
                f"training: expected shape ({grid.size}, tables), got {training.shape}"
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
        picks = [self._pick(part, rng) for part in range(len(scene.parts))]
        # cells that no pixel of the subset or the probes sees are neither decoded nor stored
        seen = np.zeros(grid.size, bool)
        samples: list[tuple[Float32, Float32]] = []
        for part, (subset, probes) in enumerate(picks):
            report("sampling", part / len(picks))
            rows = self.operator.rows(subset)
            exact = self.operator.rows(probes, 2.0 * resolution)
            seen |= (rows != 0.0).any(axis=(0, 1)) | (exact != 0.0).any(axis=(0, 1))
            samples.append((rows, exact))
        self.cells = np.flatnonzero(seen)
        """(n,) flat indices of the table cells that the scene can see."""
        tables = torch.from_numpy(np.ascontiguousarray(training))
        self.parts: list[_PartBasis | None] = []
        done, total = 0, max(len(scene.pixels), 1)
        for part, (subset, probes) in enumerate(picks):
            pixels = np.arange(len(scene.pixels))[scene.part_slice(part)]
            if len(pixels) == 0:
                self.parts.append(None)
                continue
            rows, exact = samples[part]
            samples[part] = (rows[:0], exact[:0])
            wanted = self._combinations(torch.from_numpy(rows), tables)
            images = []
            for chunk in _chunks(pixels):
                images.append(self.operator.images(chunk, wanted))
                done += len(chunk)
                report("basis", done / total)
            basis = torch.linalg.qr(torch.cat(images, dim=1)).Q
            self.parts.append(self._compress(basis, pixels, subset, probes, rows, exact))

    def _pick(
        self, part: int, rng: np.random.Generator
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Disjoint pixels of a part: the subset S, and the probes."""
        where = self.scene.part_slice(part)
        pixels = rng.permutation(np.arange(where.start, where.stop))
        probes = min(self.PROBES, len(pixels) // 4)
        subset = pixels[probes : probes + self.SUBSET_FACTOR * self.rank]
        return np.sort(subset), np.sort(pixels[:probes]) if probes else np.sort(subset)

    def _combinations(self, rows: torch.Tensor, tables: torch.Tensor) -> torch.Tensor:
        """M = X Y Sigma^-1 (3, cells, r) for the rows (m, 3, cells) of the subset."""
        combinations = []
        for c in range(3):
            images = (rows[:, c] @ tables).double()
            scale = images.mean(dim=0)
            lit = scale > 0.0
            weight = torch.where(lit, 1.0 / torch.where(lit, scale, 1.0), 0.0)
            images = images * weight
            _, sigma, yt = torch.linalg.svd(images, full_matrices=False)
            rank = min(self.rank, len(sigma))
            keep = sigma[:rank] > 1e-7 * sigma[0].clamp_min(1e-30)
            inverse = torch.where(keep, 1.0 / torch.where(keep, sigma[:rank], 1.0), 0.0)
            mix = weight[:, None] * yt[:rank].T * inverse
            combinations.append((tables.double() @ mix).float())
        return torch.stack(combinations)

    def _compress(
        self,
        basis: torch.Tensor,
        pixels: NDArray[np.int64],
        subset: NDArray[np.int64],
        probes: NDArray[np.int64],
        rows: Float32,
        exact: Float32,
    ) -> _PartBasis:
        first = int(pixels[0])
        seen = torch.from_numpy(self.cells)
        sampled = basis[:, torch.from_numpy(subset - first)].double()
        rows_seen = torch.from_numpy(rows)[:, :, seen].permute(1, 0, 2)
        projection = (torch.linalg.pinv(sampled, rtol=1e-6) @ rows_seen.double()).float()
        scene = self.scene
        mirror = scene.environment.radiance(reflect(scene.views[pixels], scene.normals[pixels]))
        move = self.device
        return _PartBasis(
            pixels=torch.from_numpy(scene.pixels[pixels]).to(move),
            basis=basis.contiguous().to(move),
            projection=projection.contiguous().to(move),
            probe_rows=torch.from_numpy(exact)[:, :, seen].permute(1, 0, 2).contiguous().to(move),
            probe_basis=basis[:, torch.from_numpy(probes - first)].contiguous().to(move),
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

    def shade(self, part: int, table: torch.Tensor, mirror: torch.Tensor | None = None) -> PartFrame:
        """Linear radiance of one part's pixels, and its error measured on the probes.

        Parameters
        ----------
        part : index into ``scene.parts``
        table : (len(cells), 3) float32
            f_r at the cells that the scene sees.
        mirror : (3,) weight of a perfect mirror
        """
        known = self.parts[part]
        if known is None:
            empty = torch.zeros((0, 3), device=self.device)
            return PartFrame(empty, 0.0, 0.0)
        columns = table.T.unsqueeze(-1).contiguous()  # (3, cells, 1)
        coefficients = torch.bmm(known.projection, columns)  # (3, r, 1)
        radiance = torch.bmm(known.basis, coefficients)[..., 0]
        exact = torch.bmm(known.probe_rows, columns)[..., 0]
        shown = torch.bmm(known.probe_basis, coefficients)[..., 0].clamp_min(0.0)
        deviation = float((shown - exact).abs().mean())
        level = float(exact.mean())
        pixels = radiance.T.clamp_min(0.0)
        if mirror is not None and bool((mirror > 0.0).any()):
            pixels = pixels + mirror * known.mirror
        return PartFrame(pixels, deviation, level)

    def shade_exactly(self, part: int, table: Float32, mirror: Float32 | None = None) -> PartFrame:
        """The same by the uncompressed operator: slow, for tables outside the basis.

        `table` is (grid.size, 3).
        """
        scene = self.scene
        pixels = np.arange(len(scene.pixels))[scene.part_slice(part)]
        columns = torch.from_numpy(np.ascontiguousarray(table.T[:, :, None]))
        radiance = self.operator.images(pixels, columns)[..., 0].T.to(self.device)
        known = self.parts[part]
        if known is not None and mirror is not None:
            radiance = radiance + torch.from_numpy(mirror).to(self.device) * known.mirror
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
def _coarse_irradiance(n: Any, moment: Any, direction: Any, radius: Any, child: Any, stack: Any) -> Any:
    """Irradiance (summed over colours) to some percent: what bright nodes are measured against."""
    total = 0.0
    top = 0
    stack[0] = 0
    while top >= 0:
        i = stack[top]
        top -= 1
        cos_i = n[0] * direction[i, 0] + n[1] * direction[i, 1] + n[2] * direction[i, 2]
        r = radius[i]
        if r > 0.2 and (child[i, 0] >= 0 or child[i, 1] >= 0):
            for s in range(2):
                if child[i, s] >= 0:
                    top += 1
                    stack[top] = child[i, s]
        elif cos_i > 0.0:
            for c in range(3):
                total += max(
                    0.0,
                    n[0] * moment[i, c, 0] + n[1] * moment[i, c, 1] + n[2] * moment[i, c, 2],
                )
    return max(total, 1e-30)


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def _fill_row(
    row: Any, n: Any, v: Any,
    moment: Any, direction: Any, spread: Any, radius: Any, child: Any, rectangle: Any, image: Any,
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
    total = _coarse_irradiance(n, moment, direction, radius, child, stack)
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
            cx, cy, cz = direction[i, 0], direction[i, 1], direction[i, 2]
            cos_i = n[0] * cx + n[1] * cy + n[2] * cz
            e0 = n[0] * moment[i, 0, 0] + n[1] * moment[i, 0, 1] + n[2] * moment[i, 0, 2]
            e1 = n[0] * moment[i, 1, 0] + n[1] * moment[i, 1, 1] + n[2] * moment[i, 1, 2]
            e2 = n[0] * moment[i, 2, 0] + n[1] * moment[i, 2, 1] + n[2] * moment[i, 2, 2]
            r = radius[i]
            variance = spread[i] * spread[i]
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
    moment: Any, direction: Any, spread: Any, radius: Any, child: Any, rectangle: Any, image: Any,
    n_h: Any, n_d: Any, n_p: Any, relative: Any, brightest: Any, horizon: Any, widest: Any,
) -> None:  # fmt: skip
    for p in numba.prange(len(normals)):
        stack = np.empty(256, np.int32)
        cells = np.empty((256, 5), np.float64)
        out[p] = 0.0
        _fill_row(
            out[p], normals[p], views[p], moment, direction, spread, radius, child, rectangle,
            image, n_h, n_d, n_p, relative, brightest, horizon, widest, stack, cells,
        )  # fmt: skip
