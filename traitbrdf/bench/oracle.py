"""Reference values, computed by several processes."""

from __future__ import annotations

import concurrent.futures
import math
import multiprocessing
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf import reference
from traitbrdf.bench.datasets import channels
from traitbrdf.pictures import own_colours
from traitbrdf.reflectance.brdf import (
    Reflectance,
    TabulatedBRDF,
)
from traitbrdf.scene.scene import Scene
from traitbrdf.session.preparation import trusted_error
from traitbrdf.transport.transport import Transport

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

# -- the oracle -----------------------------------------------------------------------------------
_BRDFS: list[Reflectance] = []
"""The BRDFs of a worker process, which receives them once."""


def _take_brdfs(brdfs: Sequence[Reflectance]) -> None:
    _BRDFS[:] = brdfs


def _reference_job(job: tuple[Scene, Int64, float]) -> tuple[Float64, Float64]:
    scene, index, tolerance = job
    return _fragments(scene, index, _BRDFS, tolerance)


def _fragments(
    scene: Scene, index: Int64, brdfs: Sequence[Reflectance], tolerance: float
) -> tuple[Float64, Float64]:
    """Return `reference.fragments`, with NaN where the tolerance is not reached."""
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
    """Compute `reference.fragments` for the same BRDFs repeatedly, on all cores.

    The result is NaN where the reference fails: next to grazing views some lobes need too many
    cells.

    Parameters
    ----------
    brdfs : sequence of Reflectance
    tolerance : float
        Error allowed per sample, relative to its largest channel.
    cores : int or None
        Number of processes; None for one per core, 1 to compute in this process.
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
        """Return the radiance (m, B, 3) of a scene's fragments, and its estimated error.

        Parameters
        ----------
        scene : Scene
        index : (m,) int array
            Fragments.
        """
        if self.cores == 1 or len(index) < 32:
            return _fragments(scene, index, self.brdfs, self.tolerance)
        if self._pool is None:
            self._pool = concurrent.futures.ProcessPoolExecutor(
                self.cores,
                mp_context=multiprocessing.get_context("spawn"),
                initializer=_take_brdfs,
                initargs=(self.brdfs,),
            )
        # every n-th fragment, so that parts and borders are spread over the jobs
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
    """Return the oracle's radiance (m, B, 3) of fragments for B BRDFs, and its estimated error.

    NaN where the reference fails.

    Parameters
    ----------
    scene : Scene
    index : (m,) int array
        Fragments.
    brdfs : sequence of Reflectance
    tolerance : float
        As for `Oracle`.
    """
    with Oracle(brdfs, tolerance) as oracle:
        return oracle(scene, index)


def draw_fragments(
    oracle: Oracle, scene: Scene, among: Int64, count: int, rng: np.random.Generator
) -> tuple[Int64, Float64, Float64]:
    """Return random fragments, their reference values, and the errors of these.

    Fragments at which the reference fails are replaced by others.

    Parameters
    ----------
    oracle : Oracle
    scene : Scene
    among : (m,) int array
        Fragments to choose from.
    count : int
    rng : numpy.random.Generator
    """
    order = rng.permutation(among)
    index = np.sort(order[: count + count // 20])
    values, errors = oracle(scene, index)
    known = np.flatnonzero(np.isfinite(values).all(axis=(1, 2)))[:count]
    return index[known], values[known], errors[known]


def relative_errors(shown: NDArray[Any], true: Float64) -> Float64:
    """Return the mean relative L1 (B,) of radiance `shown` against `true`, both (m, B, 3)."""
    return np.array(
        [reference.relative_error(shown[:, b], true[:, b]) for b in range(true.shape[1])]
    )


# -- transport ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Shown:
    """Radiance of fragments (m,) under B tables: from the basis, and as a session shows it."""

    basis: Float32  # (m, B, 3)
    final: Float32  # (m, B, 3)
    measured: Float64  # (parts, B) measured error of each part's basis frame
    refused: NDArray[np.bool_]  # (parts, B) whether a session would render the part exactly


def shown_errors(transport: Transport, tables: Sequence[TabulatedBRDF], index: Int64) -> _Shown:
    """Return what a session shows of tables that are assigned one after the other.

    It uses the basis where the measured error is small, and exact shading elsewhere. The session
    learns nothing from the tables.

    Parameters
    ----------
    transport : Transport
    tables : sequence of TabulatedBRDF
    index : (m,) int array
        Fragments.
    """
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
