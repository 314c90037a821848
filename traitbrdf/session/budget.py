"""Speed against accuracy: what of a prepared scene a promised error or speed needs.

A preparation yields more basis images than most looks need. Every image that is left out makes
frames faster and, for some materials, less exact. How much so is measured here, in this scene and
on this machine, on materials that the basis was not fitted to; then the fewest images are taken
with which the error that was asked for is met, or the most with which the speed is.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf.transport.transport import Transport

Float64 = NDArray[np.float64]

QUALITIES: dict[str, tuple[int, float]] = {
    "preview": (40, 0.7),
    "interactive": (96, 1.0),
    "accurate": (144, 1.5),
    "reference": (40, 3.0),
}
"""Basis images and resolution of the light for each quality. "reference" shows nothing by its
basis: every frame is exact, and takes seconds."""

TRUSTED = 0.7
"""The basis is used where its measured error is at most this share of the error asked for: some
dozens of probes are a noisy measurement."""

LADDER = (8, 12, 16, 24, 32, 48, 64, 80, 96, 120, 144)
"""Numbers of basis images that are tried."""

CASES = 0.95
"""The share of materials whose frames shall have the error asked for."""

ROUNDING = 0.01
"""Least error asked for at which float16 may keep the basis: its own is some 0.03 %."""

WORTH = 0.9
"""The share of a frame's time in float32 that float16 has to stay below to be taken: it halves
what is read of memory, and has to be widened."""

RESERVE = 0.75
"""The share of a frame's time that shading may take: the rest is for the edit, and for hours in
which a machine is slower."""


@dataclass(frozen=True)
class Promise:
    """What was asked of a session, what was picked for it, and what that measured.

    Attributes
    ----------
    quality : what the scene was prepared with
    error, fps : what was asked for; None: nothing
    basis_images, of : how many are used, of how many that were prepared
    dtype : what they are kept in
    resolution : of the light's pieces and of the shadow rays (`quadrature.Operator`)
    grid, dimensions : nodes of the tables and coordinates of the embedding, which are all used:
        fewer of them cost more error than they save time (``traitbrdf bench --trade``)
    error_95 : the error that frames of 95 % of `materials` stay below, by the probes
    materials : how many it was measured on, none of which the basis was fitted to
    seconds : a frame of the whole object from an edited material, median
    kept : whether the measurements are what was asked for
    """

    quality: str
    error: float | None
    fps: float | None
    basis_images: int
    of: int
    dtype: str
    resolution: float
    grid: tuple[int, int, int]
    dimensions: int
    error_95: float
    materials: int
    seconds: float
    kept: bool

    def as_dict(self) -> dict[str, Any]:
        return dict(vars(self))


def quality_for(error: float | None) -> str:
    """The quality whose preparation an error needs, mostly."""
    if error is None:
        return "interactive"
    return "preview" if error >= 0.04 else "interactive" if error >= 0.008 else "accurate"


def keep(
    transport: Transport,
    tables: torch.Tensor,
    borne: Float64,
    frame: Callable[[Transport], object],
    quality: str,
    dimensions: int,
    error: float | None = None,
    fps: float | None = None,
) -> tuple[Transport, Promise]:
    """The transport with as many basis images as a promise needs.

    Parameters
    ----------
    transport : of all basis images
    tables : (len(transport.cells), 3, T) float32, materials that it was not fitted to
    borne : (parts,) the share of the error asked for that each part may have by its measurement
    frame : makes a frame from an edit, for its time
    quality, dimensions : what the scene was prepared with, and how many coordinates a material has
    error, fps : what was asked for; at most one of them
    """
    most = transport.rank_used
    ranks = [rank for rank in LADDER if rank < most] + [most]
    deviation, level = transport.probed(tables, ranks)
    # of each material the part that is worst off: one that misses is rendered without the basis
    worst = (deviation / np.maximum(level, 1e-30) / borne[:, None]).max(axis=1)
    size = np.array([0 if part is None else len(part.pixels) for part in transport.parts])
    whole = (size @ deviation) / np.maximum(size @ level, 1e-30)
    needed, errors = (np.percentile(v, 100.0 * CASES, axis=1) for v in (worst, whole))
    # the fewest images first where an error is asked for, else the most that are fast enough
    good = np.flatnonzero(needed <= error) if error is not None else np.arange(0)
    chosen = int(good[0]) if len(good) else len(ranks) - 1
    while True:
        used = transport if ranks[chosen] == most else transport.truncated(ranks[chosen])
        seconds = median_seconds(frame, used)
        if error is None or error >= ROUNDING:
            half = used.stored(torch.float16)
            faster = median_seconds(frame, half)
            if faster < WORTH * seconds:
                used, seconds = half, faster
        if fps is None or seconds <= RESERVE / fps or chosen == 0:
            break
        chosen -= 1
    kept = (error is None or len(good) > 0) and (fps is None or seconds <= RESERVE / fps)
    promise = Promise(
        quality, error, fps, ranks[chosen], most, str(used.dtype).removeprefix("torch."),
        used.resolution, used.grid.shape, dimensions, float(errors[chosen]), tables.shape[2],
        seconds, kept,
    )  # fmt: skip
    return used, promise


def median_seconds(frame: Callable[[Transport], object], transport: Transport) -> float:
    """Of five frames, after one that does not count."""
    frame(transport)
    times = []
    for _ in range(5):
        start = time.perf_counter()
        frame(transport)
        times.append(time.perf_counter() - start)
    return float(np.median(times))
