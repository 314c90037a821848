"""Real-time frames: light transport as a linear operator from table cells to pixels, compressed.

For one scene the radiance of a fragment (what one part shows in one pixel) is linear in the BRDF
table, I = W rho (Ben-Artzi et al. 2006, section 3). `Operator` computes the rows of W, shadows
included.

*Basis.* Through one part of one scene, the BRDFs of interest span few dimensions. Take the rows W_S
of a subset S of the fragments, and training tables X. The SVD of the column-normalised
W_S X = U Sigma Y^T gives the combinations M = X Y Sigma^-1 of training tables whose images W M span
the frames. Q are the leading left singular vectors of W M Sigma. The three colours of a map light a
shape much alike, so one Q serves them all: 96 columns have less than three times the error of 64,
and a frame reads them once. The frame is Q (C rho), with a C for each colour.

*Fit.* The orthogonal choice C = Q^T W needs every row of W. Weighted least squares on some five
times more rows than Q has columns comes within a third of its error, if half of the fragments are
drawn by their leverage scores in Q and half evenly, each weighted by its chance (Drineas, Mahoney &
Muthukrishnan 2006). A uniform draw has up to ten times the error on tables outside the training
set. (Projecting rho on an orthonormal basis of cell space instead errs by tens of percent.)

*Error.* Some fragments, the probes, are drawn evenly from all that are shown. They keep their exact
rows, built at twice the resolution, shadows too; comparing with them gives every frame its measured
error. (Probes from outside the fit alone would overstate the error of small parts, most of whose
fragments are in the fit.)

References
----------
A. Ben-Artzi, R. Overbeck, R. Ramamoorthi, "Real-time BRDF editing in complex lighting", ACM
Transactions on Graphics 25(3), 2006.
P. Drineas, M. Mahoney, S. Muthukrishnan, "Sampling algorithms for l2 regression and applications",
SODA 2006: rows drawn by leverage.
M. Hasan, F. Pellacini, K. Bala, "Matrix row-column sampling for the many-light problem", ACM
Transactions on Graphics 26(3), 2007: a few rows of a transport matrix represent all.
"""

from __future__ import annotations

import concurrent.futures
import copy
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf.reflectance.brdf import HalfDiffGrid
from traitbrdf.scene.scene import Scene
from traitbrdf.transport.basis import (
    TOP,
    Basis,
    PartFrame,
    Training,
    damping_of,
    extended,
    fit_rows,
    is_grey,
    leading,
    per_colour,
)
from traitbrdf.transport.operator import SHARPEST
from traitbrdf.transport.operator import Operator as Operator
from traitbrdf.transport.visibility import Progress as Progress

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

_PATIENCE = 0.05  # seconds of waiting for rays between two reports


@dataclass
class _Part:
    """One part's share of its group's basis.

    Attributes
    ----------
    group : int, index of the basis
    span : slice of the group's fragments
    pixels : (P,) tensor, flat pixel index of each fragment; none occurs twice
    mirror : (P, 3) tensor, radiance that a perfect mirror shows
    probes : (C, m) tensor, fragments of the part that keep exact rows, for each colour
    exact : slice, where these rows are among the group's
    """

    group: int
    span: slice
    pixels: torch.Tensor
    mirror: torch.Tensor
    probes: torch.Tensor
    exact: slice


class Transport:
    """The compressed operator of a scene: `shade` turns a table into the radiance of a part.

    Parameters
    ----------
    scene : Scene
    grid : HalfDiffGrid
        The grid of the tables to be shown.
    training : Training
        Tables that the bases are fitted to (see `training_tables`), and parts that keep their
        material.
    rank : int
        Most basis images of a group of parts.
    resolution : float
        As for `Operator`.
    seed : int
        Chooses the subset, the rows of the fit and the probes.
    device : str or torch.device
        Where frames are computed.
    progress : called with (stage, fraction done); may raise to cancel

    Raises
    ------
    ValueError
        If the rank, the training tables or the tables of fixed parts do not fit.
    """

    TRAINING_ROWS = 320
    """Fragments in S, the subset of a group on which training tables are combined."""
    TABLES = 5 / 6
    """Combinations of training tables for each basis image; each has images in three colours."""
    FIT_FACTOR = 8
    """Rows of the least-squares fit for each basis image."""
    PROBES = 20
    """Fragments of a part that keep exact rows, for each colour, to measure errors."""
    ENOUGH = 1e-6
    """Basis images whose singular value is less than this share of the largest are left out."""

    def __init__(
        self,
        scene: Scene,
        grid: HalfDiffGrid,
        training: Training,
        rank: int = 96,
        resolution: float = 1.0,
        seed: int = 0,
        device: str | torch.device = "cpu",
        progress: Progress | None = None,
    ) -> None:
        if not isinstance(rank, int) or rank < 1:
            raise ValueError(f"rank: expected a positive integer, got {rank!r}")
        for part, table in training.fixed.items():
            if not 0 <= part < len(scene.parts) or table.shape != (grid.size, 3):
                raise ValueError(
                    f"fixed: expected tables ({grid.size}, 3) of {len(scene.parts)} parts, got "
                    f"{table.shape} for part {part}"
                )
        self._begin(scene, grid, rank, resolution, device)
        self._compress_groups(training, {}, seed, progress)

    def freed(
        self, training: Training, seed: int = 0, progress: Progress | None = None
    ) -> Transport:
        """Return a transport that can show any material on the fixed parts, too.

        It shares the bases of groups without fixed parts. This transport does not change.

        Parameters
        ----------
        training : Training
            Its `fixed` is ignored.
        seed : int
            As for this transport.
        progress : called with (stage, fraction done); may raise to cancel
        """
        other = Transport.__new__(Transport)
        other._begin(self.scene, self.grid, self.rank, self.resolution, self.device)
        if self._operator is not None:  # its own operator, since this one may be in use
            tree = self._operator.tree
            other._operator = Operator(self.scene, self.grid, self.resolution, tree)
        known = {
            g: replace(basis)
            for g, basis in enumerate(self.bases)
            if not self.fixed.intersection(basis.parts)
        }
        for part in range(len(self.parts)):
            if part not in self.fixed:
                other.parts[part] = self.parts[part]
        other._compress_groups(replace(training, fixed={}), known, seed, progress)
        return other

    def truncated(self, rank: int) -> Transport:
        """Return a faster, less exact transport: at most the first `rank` images of each basis.

        This transport does not change.
        """
        other = copy.copy(self)
        other.rank = min(rank, self.rank)
        other.parts, other._projected = list(self.parts), ()
        other.bases = [
            replace(
                basis,
                basis=basis.basis[:, :rank].contiguous(),
                rows=torch.cat([basis.projection[:, :rank], basis.probes], dim=1),
            )
            for basis in self.bases
        ]
        return other

    def stored(self, dtype: torch.dtype) -> Transport:
        """Return a transport whose basis images are float32, float16 or bfloat16.

        The 16-bit types take half the memory. Frames measure the errors of rounding like all other
        errors; sums stay in float32. This transport does not change.

        Raises
        ------
        ValueError
            If `dtype` is another type.
        """
        if dtype not in TOP:
            raise ValueError(f"dtype: expected float32, float16 or bfloat16, got {dtype}")
        other = copy.copy(self)
        other.dtype = dtype
        other.parts, other._projected = list(self.parts), ()
        other.bases = [basis.stored(dtype) for basis in self.bases]
        return other

    @property
    def rank_used(self) -> int:
        """Largest number of images of any basis."""
        return max((basis.rank for basis in self.bases), default=0)

    def probed(self, tables: torch.Tensor, ranks: Sequence[int]) -> tuple[Float64, Float64]:
        """Measure the errors of `truncated` transports on the probes.

        Parameters
        ----------
        tables : (len(cells), 3, T) float32
            Tables, each shown on all parts.
        ranks : numbers of basis images

        Returns
        -------
        deviation : (len(ranks), parts, T) mean |I - I_exact| of each part's probes
        level : (parts, T) their mean I_exact; both are 0 for parts that were prepared for one
            material alone
        """
        count = tables.shape[2]
        deviation = torch.zeros(
            (len(ranks), len(self.parts), count), dtype=torch.float32, device=self.device
        )
        level = torch.zeros((len(self.parts), count), dtype=torch.float32, device=self.device)
        for basis in self.bases:
            if self.fixed.intersection(basis.parts):
                continue
            seen = tables if basis.place is None else tables[basis.place]
            for c in range(3):
                own = c if len(basis.rows) == 3 else 0
                found = basis.rows[own] @ seen[:, c]
                for index in basis.parts:
                    part = self.parts[index]
                    if part is None:
                        continue
                    exact = found[basis.rank :][part.exact]
                    images = basis.basis[part.span][part.probes[own]].float()
                    level[index] += exact.mean(dim=0) / 3.0
                    for i, rank in enumerate(ranks):
                        shown = (images[:, :rank] @ found[: min(rank, basis.rank)]).clamp_min(0.0)
                        deviation[i, index] += (shown - exact).abs().mean(dim=0) / 3.0
        return deviation.double().cpu().numpy(), level.double().cpu().numpy()

    def _compress_groups(
        self,
        training: Training,
        known: Mapping[int, Basis],
        seed: int,
        progress: Progress | None,
    ) -> None:
        """Compute the bases of all groups but those that are `known`, by group."""
        shape = training.tables.shape
        if shape != (self.grid.size, len(training.weight)) or not len(training.weight):
            raise ValueError(
                f"training: expected shape ({self.grid.size}, tables) with a weight for each "
                f"table, got {shape} and {len(training.weight)} weights"
            )
        report = progress or (lambda stage, fraction: None)
        tables = torch.from_numpy(np.ascontiguousarray(training.tables))
        importance = torch.from_numpy(training.weight)
        groups, fixed = self._groups(), training.fixed
        # the next part's rays are cast while others are shaded
        cancelled, operator = threading.Event(), self.operator

        def cast(part: int) -> None:
            def check(stage: str, fraction: float) -> None:
                if cancelled.is_set():
                    raise concurrent.futures.CancelledError

            operator.prepare(part, check)

        with concurrent.futures.ThreadPoolExecutor(1) as pool:
            try:
                casting = {
                    part: pool.submit(cast, part)
                    for g, group in enumerate(groups)
                    if g not in known
                    for part in group
                }
                for g, group in enumerate(groups):
                    basis = known.get(g)
                    if basis is None:
                        rng = np.random.default_rng([seed, g])
                        if fixed.keys() >= set(group):
                            self.fixed |= set(group)
                            some = np.concatenate([fixed[part] for part in group], axis=1)
                            mix = np.unique(some, axis=1)
                            need = np.ones(mix.shape[1])
                        else:
                            if training.combined:
                                mix = np.ascontiguousarray(training.tables[:, : self._tables])
                                need = training.weight[: self._tables]
                            else:
                                mix, need = self._combinations(group, tables, importance, rng)
                        basis = self._compress(group, mix, need, rng, casting, report)
                    self.bases.append(basis)
            finally:
                cancelled.set()
        self._join_cells()

    def _groups(self) -> list[range]:
        """Return the groups of parts that share a basis: the parts of the shape, and the ground.

        The parts of a shape often have one material, and mostly look alike.
        """
        count = len(self.scene.shape.parts)
        groups = [range(count), range(count, len(self.scene.parts))]
        return [group for group in groups if len(self._fragments(group))]

    def _fragments(self, group: range) -> range:
        """Return the fragments of a group of parts."""
        spans = [self.scene.part_slice(part) for part in group]
        return range(spans[0].start, spans[-1].stop) if spans else range(0)

    def _begin(
        self,
        scene: Scene,
        grid: HalfDiffGrid,
        rank: int,
        resolution: float,
        device: str | torch.device,
    ) -> None:
        """Set the attributes of a transport without bases."""
        self.scene = scene
        self.grid = grid
        self.rank = rank
        self.resolution = resolution
        self.device = torch.device(device)
        self.grey = is_grey(scene)
        """Whether all light is grey, so that one channel of the basis serves all three."""
        self.dtype = torch.float32
        """Type of the basis images; see `stored`."""
        self.fixed: frozenset[int] = frozenset()
        """Parts that were prepared for one material alone."""
        self.bases: list[Basis] = []
        self.parts: list[_Part | None] = [None] * len(scene.parts)
        self._projected: tuple[Any, ...] = ()
        self._operator: Operator | None = None
        self._probe_operator: Operator | None = None
        backdrop = scene.backdrop().reshape(-1, 3) * scene.uncovered[:, None]
        self._backdrop = torch.from_numpy(np.ascontiguousarray(backdrop)).to(self.device)

    @property
    def _tables(self) -> int:
        """Most tables whose images a basis is made of."""
        return self.rank if self.grey else math.ceil(self.TABLES * self.rank)

    @property
    def operator(self) -> Operator:
        """The uncompressed operator."""
        if self._operator is None:
            self._operator = Operator(self.scene, self.grid, self.resolution)
        return self._operator

    @property
    def _exact(self) -> Operator:
        """The operator of the probes, at twice the resolution and for the narrowest peaks."""
        if self._probe_operator is None:
            tree = self.operator.tree
            self._probe_operator = Operator(
                self.scene, self.grid, 2.0 * self.resolution, tree, SHARPEST
            )
        return self._probe_operator

    def _compress(
        self,
        group: range,
        mix: Float32,
        need: Float64,
        rng: np.random.Generator,
        casting: Mapping[int, concurrent.futures.Future[None]],
        report: Progress,
    ) -> Basis:
        """Compute the basis of a group of parts.

        Parameters
        ----------
        group : range of parts
        mix : (cells, R) tables whose images span the frames
        need : (R,) weights of these images
        rng : draws the probes and the rows of the fit
        casting : the task that casts each part's rays
        report : called with (stage, fraction done)
        """
        scene, operator = self.scene, self.operator
        fragments = self._fragments(group)
        colours = 1 if self.grey else 3
        whole = np.zeros((len(fragments), 3, mix.shape[1]), np.float32)
        for part in group:
            span = scene.part_slice(part)

            def told(stage: str, fraction: float, span: slice = span) -> None:
                done = span.start + fraction * (span.stop - span.start)
                report(stage, done / max(len(scene.pixels), 1))

            while concurrent.futures.wait([casting[part]], _PATIENCE).not_done:
                told("shadows", 0.0)
            casting[part].result()
            at = slice(span.start - fragments.start, span.stop - fragments.start)
            operator.part_images(part, mix, told, out=whole[at])
        operator.settle()  # from here on, memory is scarce
        images = torch.from_numpy(whole)[:, :colours]
        images *= torch.from_numpy(need).float()
        damping = damping_of(images)
        images *= damping[:, None, None]

        def fitting() -> None:
            report("fitting", fragments.stop / max(len(scene.pixels), 1))

        basis = leading(images, self.rank, self.ENOUGH, fitting)
        del whole, images
        exact: list[Float32] = []
        for part in group:
            span = scene.part_slice(part)
            size = span.stop - span.start
            if size == 0:
                continue
            count = min(self.PROBES, size)
            probes = np.stack([np.sort(rng.permutation(size)[:count]) for _ in range(colours)])
            known = sum(len(rows[0]) for rows in exact)
            fitting()
            exact.append(self._probe_rows(probes + span.start))
            mirror = operator.mirror(np.arange(span.start, span.stop))
            self.parts[part] = _Part(
                len(self.bases),
                slice(span.start - fragments.start, span.stop - fragments.start),
                torch.from_numpy(scene.pixels[span]).to(self.device),
                torch.from_numpy(mirror).to(self.device),
                torch.from_numpy(probes).to(self.device),
                slice(known, known + count),
            )
        return self._assemble(group, basis, damping, np.concatenate(exact, axis=1), rng, fitting)

    def _subset(self, group: range, rng: np.random.Generator) -> Int64:
        """Draw the fragments S from all parts, from small ones more than their share."""
        spans = [self.scene.part_slice(part) for part in group]
        sizes = np.array([span.stop - span.start for span in spans])
        share = np.sqrt(sizes) / np.sqrt(sizes).sum()
        chosen = [
            span.start + rng.permutation(size)[: math.ceil(self.TRAINING_ROWS * part)]
            for span, size, part in zip(spans, sizes, share, strict=True)
        ]
        return np.sort(np.concatenate(chosen))

    def exact_rows(self, fragments: Int64) -> Float32:
        """Compute rows of W as exactly as those of the probes: (m, 3, grid.size) float32.

        Parameters
        ----------
        fragments : (m,) int64
            Distinct fragments of the scene.
        """
        return self._exact.rows(fragments)

    def _probe_rows(self, probes: Int64) -> Float32:
        """Compute the exact rows (C, m, cells) of fragments (C, m), each in one colour."""
        distinct, where = np.unique(probes, return_inverse=True)
        rows = self.exact_rows(distinct)
        return np.stack([rows[at, c] for c, at in enumerate(where.reshape(probes.shape))])

    def _combinations(
        self,
        group: range,
        tables: torch.Tensor,
        importance: torch.Tensor,
        rng: np.random.Generator,
    ) -> tuple[Float32, Float64]:
        """Compute M = X Y Sigma^-1 (cells, R) and Sigma (R,) from the rows of a group's subset.

        One M serves the three colours, whose images differ; so R is less than the rank.
        """
        # an operator of its own: results must not depend on which rays other threads have cast
        scout = Operator(self.scene, self.grid, self.resolution, self.operator.tree)
        rows = scout.rows(self._subset(group, rng))
        colours = 1 if self.grey else 3
        stacked = torch.from_numpy(rows[:, :colours].reshape(-1, rows.shape[-1]))
        images = (stacked @ tables).double()
        scale = images.mean(dim=0)
        lit = scale > 0.0
        weight = torch.where(lit, importance / torch.where(lit, scale, 1.0), 0.0)
        images = images * weight
        # eigenvectors of the small Gram matrix: an SVD is slow where singular values underflow
        squares, u = torch.linalg.eigh(images @ images.T)
        count = min(self._tables, len(squares))
        enough = squares.flip(0) > (0.1 * self.ENOUGH) ** 2 * squares[-1]
        count = max(1, min(count, int(enough.sum())))
        squares, u = squares.flip(0)[:count], u.flip(1)[:, :count]
        keep = squares > 1e-13 * squares[0].clamp_min(1e-30)
        inverse = torch.where(keep, 1.0 / torch.where(keep, squares, 1.0), 0.0)
        mix = weight[:, None] * (images.T @ u) * inverse
        need = torch.where(keep, squares, 0.0).sqrt().numpy()
        return (tables @ mix.float()).numpy(), need

    def _assemble(
        self,
        group: range,
        basis: torch.Tensor,
        damping: torch.Tensor,
        exact: Float32,
        rng: np.random.Generator,
        report: Callable[[], None] = lambda: None,
    ) -> Basis:
        """Fit the group's C by weighted least squares, and collect all that a frame reads."""
        fragments = self._fragments(group)
        count = self.FIT_FACTOR * max(basis.shape[-1], 8)
        chosen, importance = fit_rows(basis, count, rng)
        weight = torch.from_numpy(importance)
        at = torch.from_numpy(chosen)
        sampled = basis[at].double() * weight[:, None]
        squares, vectors = torch.linalg.eigh(sampled.T @ sampled)
        keep = squares > 1e-9 * squares[-1].clamp_min(1e-30)
        scale = torch.where(keep, 1.0 / torch.where(keep, squares, 1.0), 0.0)
        inverse = (vectors * scale) @ vectors.T
        solve = (inverse @ sampled.T * (damping[at] * weight)).float()
        rows = torch.zeros(
            (len(exact), solve.shape[0] + exact.shape[1], self.grid.size), dtype=torch.float32
        )
        rows[:, solve.shape[0] :] = torch.from_numpy(exact)
        seen = (rows != 0.0).any(dim=0).any(dim=0)
        for i in range(0, len(chosen), 64):
            some = slice(i, i + 64)
            report()
            # from the operator that made the images: the fit would amplify any difference
            shown = torch.from_numpy(self.operator.rows_as_shown(chosen[some] + fragments.start))
            for c in range(len(exact)):
                rows[c, : solve.shape[0]] += solve[:, some] @ shown[:, c]
            seen |= (shown != 0.0).any(dim=0).any(dim=0)
        cells = torch.nonzero(seen)[:, 0]
        return Basis(
            parts=group,
            basis=basis.div_(damping[:, None]).to(self.device),
            damping=damping.to(self.device),
            cells=cells.to(self.device),
            rows=rows[:, :, cells].to(self.device),
        )

    def _join_cells(self) -> None:
        """Collect the cells that any part sees; the others are neither decoded nor stored."""
        seen = torch.zeros(self.grid.size, dtype=torch.bool, device=self.device)
        for basis in self.bases:
            seen[basis.cells] = True
        self.cells = torch.nonzero(seen)[:, 0].cpu().numpy()
        """(n,) flat indices of the table cells that the scene can see."""
        place = torch.cumsum(seen, dim=0) - 1
        for basis in self.bases:
            basis.place = place[basis.cells]
            if len(basis.cells) > 0.8 * len(self.cells):
                # some more zeros in the rows are cheaper than a look-up
                wide = torch.zeros(
                    (*basis.rows.shape[:2], len(self.cells)),
                    dtype=torch.float32,
                    device=self.device,
                )
                wide[:, :, basis.place] = basis.rows
                basis.rows, basis.place = wide, None
                basis.cells = torch.nonzero(seen)[:, 0]
        self._projected = ()

    def trained(self, part: int, radiance: torch.Tensor) -> Transport:
        """Return a transport that `train` has extended; this one may be in use meanwhile.

        Parameters
        ----------
        part, radiance
            As for `train`.
        """
        other = copy.copy(self)
        other.parts, other.bases = list(self.parts), [replace(basis) for basis in self.bases]
        other.train(part, radiance)
        return other

    def adopt(self, other: Transport) -> None:
        """Take over the bases of a transport that `trained` made of this one."""
        self.bases, self.cells, self._projected = other.bases, other.cells, ()

    def train(self, part: int, radiance: torch.Tensor) -> None:
        """Extend a part's basis by an image, so that it shows tables like that of the image.

        Parameters
        ----------
        part : int
            Index into ``scene.parts``.
        radiance : (P, 3) tensor
            Radiance of the part's fragments under some table, as `shade_exactly` returns it
            without a mirror.

        Raises
        ------
        ValueError
            If the radiance has another shape.
        """
        span = self.scene.part_slice(part)
        if radiance.shape != (span.stop - span.start, 3):
            raise ValueError(
                f"radiance: expected ({span.stop - span.start}, 3), got {tuple(radiance.shape)}"
            )
        mine = self.parts[part]
        if mine is None:
            return
        known = self.bases[mine.group]
        damping = known.damping.cpu()
        basis = known.basis.cpu().float() * damping[:, None]
        if self.dtype != torch.float32:  # `stored` scaled its columns
            basis /= basis.norm(dim=0).clamp_min(1e-30)
        fresh = torch.zeros((len(basis), 3), dtype=torch.float32)
        fresh[mine.span] = radiance.cpu() * damping[mine.span, None]
        basis = extended(basis, fresh)
        exact = np.zeros((*known.probes.shape[:2], self.grid.size), np.float32)
        cells = known.cells.cpu().numpy()
        exact[:, :, cells] = known.probes.cpu().numpy()
        rng = np.random.default_rng(basis.shape[-1])
        trained = self._assemble(known.parts, basis, damping, exact, rng)
        self.bases[mine.group] = trained.stored(self.dtype)
        self._join_cells()

    # -- files ----------------------------------------------------------------------------------

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all that was prepared as arrays; `restored` makes an equal transport of them."""
        known: dict[str, NDArray[Any]] = {
            "rank": np.array(self.rank),
            "resolution": np.array(self.resolution),
            "fixed": np.isin(np.arange(len(self.parts)), list(self.fixed)),
        }
        for i, basis in enumerate(self.bases):
            for name in ("basis", "damping", "cells", "rows"):
                known[f"{name}_{i}"] = getattr(basis, name).cpu().numpy()
        for i, part in enumerate(self.parts):
            if part is not None:
                for name in ("pixels", "mirror", "probes"):
                    known[f"{name}_{i}"] = getattr(part, name).cpu().numpy()
        return known

    @classmethod
    def restored(
        cls,
        scene: Scene,
        grid: HalfDiffGrid,
        arrays: Mapping[str, NDArray[Any]],
        device: str | torch.device = "cpu",
        operator: Operator | None = None,
    ) -> Transport:
        """Return the transport of `arrays`.

        Parameters
        ----------
        scene, grid : those that the transport was prepared for
        arrays : what `arrays` returned
        device : str or torch.device
            Where frames are computed.
        operator : Operator or None
            The uncompressed operator of the same scene, grid and resolution, if there is one:
            rays that it has cast are not cast again.

        Raises
        ------
        ValueError
            If an array is missing or of a wrong shape or type.
        """
        self = cls.__new__(cls)
        rank, resolution = (np.asarray(arrays.get(name)) for name in ("rank", "resolution"))
        if rank.shape != () or rank.dtype.kind != "i" or resolution.dtype.kind != "f":
            raise ValueError("arrays: expected a rank and a resolution")
        self._begin(scene, grid, int(rank), float(resolution), device)
        self._operator = operator
        colours = 1 if self.grey else 3

        def taken(name: str, kind: str, shape: tuple[int, ...]) -> NDArray[Any]:
            """Return an array after checking its shape, in which -1 is any size."""
            value = np.asarray(arrays.get(name))
            fits = len(value.shape) == len(shape) and all(
                want in (-1, got) for want, got in zip(shape, value.shape, strict=False)
            )
            if not fits or value.dtype.kind != kind:
                raise ValueError(
                    f"arrays: expected {name} of shape {shape}, got {value.shape} {value.dtype}"
                )
            return value

        def indices(name: str, shape: tuple[int, ...], limit: int) -> NDArray[Any]:
            value = taken(name, "i", shape)
            if value.size and not (value.min() >= 0 and value.max() < limit):
                raise ValueError(f"arrays: expected {name} from 0 to {limit - 1}")
            return value

        self.fixed = frozenset(np.flatnonzero(taken("fixed", "b", (len(scene.parts),))).tolist())
        for g, group in enumerate(self._groups()):
            fragments = self._fragments(group)
            basis = taken(f"basis_{g}", "f", (len(fragments), -1))
            damping = taken(f"damping_{g}", "f", (len(fragments),))
            cells = indices(f"cells_{g}", (-1,), grid.size)
            known = 0
            for i in group:
                span = scene.part_slice(i)
                size = span.stop - span.start
                if size == 0:
                    continue
                pixels = taken(f"pixels_{i}", "i", (size,))
                if not np.array_equal(pixels, scene.pixels[span]):
                    raise ValueError("arrays: expected those of this scene, got other pixels")
                probes = indices(f"probes_{i}", (colours, -1), size)
                mirror = taken(f"mirror_{i}", "f", (size, 3))
                self.parts[i] = _Part(
                    g,
                    slice(span.start - fragments.start, span.stop - fragments.start),
                    torch.from_numpy(pixels).to(self.device),
                    torch.from_numpy(mirror).to(self.device),
                    torch.from_numpy(probes).to(self.device),
                    slice(known, known + probes.shape[1]),
                )
                known += probes.shape[1]
            rows = taken(f"rows_{g}", "f", (colours, basis.shape[1] + known, len(cells)))
            kept = (basis, damping, cells, rows)
            self.bases.append(Basis(group, *(torch.from_numpy(a).to(self.device) for a in kept)))
        self._join_cells()
        return self

    @property
    def bytes(self) -> int:
        """Size in bytes of all that a frame reads."""
        return sum(t.numel() * t.element_size() for b in self.bases for t in (b.basis, b.rows))

    # -- frames ---------------------------------------------------------------------------------

    def radiance(self, part: int, table: torch.Tensor) -> torch.Tensor:
        """Return the radiance (P, 3) of a part, linear in `table` and not clamped, for gradients.

        Parameters
        ----------
        part : int
            Index into ``scene.parts``.
        table : (len(cells), 3) float32
            f_r in 1/sr at the cells that the scene sees.

        Raises
        ------
        ValueError
            If the table has another shape.
        """
        self._check_table(table)
        known = self.parts[part]
        if known is None:
            return torch.zeros((0, 3), dtype=torch.float32, device=self.device)
        basis = self.bases[known.group]
        coefficients = per_colour(basis.projection, basis.at_cells(table))
        return basis.images(known.span, coefficients)

    def _project(
        self, part: _Part, table: torch.Tensor, alone: bool
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return a table's coefficients (3, r) and the exact radiance (3, m) of a part's probes.

        One product computes them for all parts of the group. The last product is kept, since parts
        of one material are shaded one after the other. If a part is shaded `alone`, only its own
        rows are read.
        """
        basis = self.bases[part.group]
        key = (part.group, table._version)
        if self._projected and self._projected[0] is table and self._projected[1] == key:
            known: torch.Tensor = self._projected[2]
        elif alone:
            columns = basis.at_cells(table)
            exact = per_colour(basis.probes[:, part.exact], columns)
            return per_colour(basis.projection, columns), exact
        else:
            known = per_colour(basis.rows, basis.at_cells(table))
            self._projected = (table, key, known)
        return known[:, : basis.rank], known[:, basis.rank :][:, part.exact]

    def shade(
        self,
        part: int,
        table: torch.Tensor,
        mirror: torch.Tensor | None = None,
        alone: bool = False,
    ) -> PartFrame:
        """Compute the linear radiance of one part, and its error measured on the probes.

        Parameters
        ----------
        part : int
            Index into ``scene.parts``.
        table : (len(cells), 3) float32
            f_r in 1/sr at the cells that the scene sees.
        mirror : (3,) tensor or None
            Weight of a perfect mirror.
        alone : bool
            Whether no other part is shaded with this table next; less memory is read then.

        Raises
        ------
        ValueError
            If the table has another shape.
        """
        self._check_table(table)
        known = self.parts[part]
        if known is None:
            empty = torch.zeros((0, 3), dtype=torch.float32, device=self.device)
            return PartFrame(empty, 0.0, 0.0)
        basis = self.bases[known.group]
        coefficients, exact = self._project(known, table, alone)
        pixels = basis.images(known.span, coefficients).clamp_min_(0.0)
        found = torch.gather(pixels, 0, known.probes.T.expand(-1, 3)).T
        deviation = float((found - exact).abs().mean())
        level = float(exact.mean())
        if mirror is not None and bool((mirror > 0.0).any()):
            pixels = pixels + mirror * known.mirror
        return PartFrame(pixels, deviation, level)

    def _check_table(self, table: torch.Tensor) -> None:
        """Raise ValueError unless a table has a value for each cell and colour."""
        if table.shape != (len(self.cells), 3):
            raise ValueError(f"table: expected ({len(self.cells)}, 3), got {tuple(table.shape)}")

    def shade_exactly(
        self,
        part: int,
        table: Float32,
        mirror: torch.Tensor | None = None,
        progress: Progress | None = None,
    ) -> PartFrame:
        """Compute the same by the uncompressed operator: slow, for tables outside the basis.

        Parameters
        ----------
        part : int
            Index into ``scene.parts``.
        table : (grid.size, 3) float32
            f_r in 1/sr.
        mirror : (3,) tensor or None
            Weight of a perfect mirror.
        progress : called with (stage, fraction done); may raise to cancel

        Raises
        ------
        ValueError
            If the table has another shape.
        """
        if table.shape != (self.grid.size, 3):
            raise ValueError(f"table: expected ({self.grid.size}, 3), got {table.shape}")
        images = self.operator.part_images(part, table, progress, interpolate=False)
        radiance = torch.from_numpy(np.einsum("pcc->pc", images).copy()).to(self.device)
        known = self.parts[part]
        if known is None:
            return PartFrame(radiance, 0.0, 0.0)
        seen = torch.from_numpy(table[self.cells]).to(self.device)
        basis = self.bases[known.group]
        exact = per_colour(basis.probes[:, known.exact], basis.at_cells(seen))
        found = torch.gather(radiance.T, 1, known.probes.expand(3, -1))
        if mirror is not None:
            radiance = radiance + mirror * known.mirror
        return PartFrame(radiance, float((found - exact).abs().mean()), float(exact.mean()))

    def compose(self, frames: list[PartFrame]) -> torch.Tensor:
        """Combine one frame for each part, and the backdrop, to the frame (H, W, 3)."""
        image = self._backdrop.clone()
        for part, frame in zip(self.parts, frames, strict=True):
            if part is not None:
                image.index_add_(0, part.pixels, frame.radiance)
        return image.reshape(self.scene.height, self.scene.width, 3)

    def frame_error(self, frames: list[PartFrame]) -> float:
        """Return the mean relative L1 over the covered pixels, from the parts' probes."""
        size = [0 if p is None else len(p.pixels) for p in self.parts]
        deviation = sum(n * f.deviation for n, f in zip(size, frames, strict=True))
        level = sum(n * f.level for n, f in zip(size, frames, strict=True))
        return deviation / level if level > 0.0 else deviation
