"""Speed against accuracy: how many basis images a promised error or speed needs.

A preparation yields more basis images than most views need. Leaving images out makes frames faster
and, for some materials, less exact. This module measures by how much, in this scene and on this
machine, on materials that the basis was not fitted to. It then takes the fewest images that meet
the error asked for, or the most that meet the speed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf.arguments import number
from traitbrdf.transport.transport import Transport

Float64 = NDArray[np.float64]

QUALITIES: dict[str, tuple[int, float]] = {
    "preview": (40, 0.7),
    "interactive": (96, 1.0),
    "accurate": (144, 1.5),
    "reference": (40, 3.0),
}
"""Basis images and resolution of the light for each quality. "reference" does not use its basis:
every frame is exact, and takes seconds."""

TRUSTED = 0.7
"""The basis is used where its measured error is at most this share of the error asked for. The
margin is for noise: the error is measured at some dozens of probes."""

LADDER = (8, 12, 16, 24, 32, 48, 64, 80, 96, 120, 144)
"""Numbers of basis images to try."""

CASES = 0.95
"""The share of materials whose frames have to meet the error asked for."""

ROUNDING = 0.01
"""The basis may be stored in float16 if the error asked for is at least this; rounding alone errs
by some 0.03 %."""

WORTH = 0.9
"""float16 is taken if a frame needs less than this share of its time in float32. It reads half as
much memory, but has to be widened."""

RESERVE = 0.75
"""The share of a frame's time that shading may take. The rest is for the edit, and a reserve for
times at which the machine is slower."""


@dataclass(frozen=True)
class Promise:
    """What was asked of a session, what was picked for it, and what was measured then.

    Attributes
    ----------
    quality : str
        What the scene was prepared with.
    error, fps : float or None
        What was asked for.
    basis_images, of : int
        Basis images in use, and how many were prepared.
    dtype : str
        Number type in which they are stored.
    resolution : float
        Of the light tree's cuts and of the shadow rays (`traitbrdf.transport.operator.Operator`).
    grid, dimensions : (3,) tuple of int, int
        Nodes of the tables and coordinates of the embedding. All are used: fewer cost more error
        than they save time (``traitbrdf bench --trade``).
    error_95 : float
        Error, measured at the probes, that 95 % of `materials` stay below.
    materials : int
        Materials that were measured; the basis was fitted to none of them.
    seconds : float
        Median time of a frame of the whole object after an edit.
    kept : bool
        Whether the measurements meet what was asked for.
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
        """Return the attributes by name."""
        return dict(vars(self))


def quality_for(error: float | None) -> str:
    """Return the least quality that usually meets an error; None stands for no error asked for.

    Parameters
    ----------
    error : float or None
        Mean relative L1.
    """
    if error is None:
        return "interactive"
    error = number(error, "error")
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
    """Return the transport with as many basis images as a promise needs, and the promise.

    Parameters
    ----------
    transport : Transport
        With all basis images.
    tables : (len(transport.cells), 3, T) float32 tensor
        Materials that the basis was not fitted to.
    borne : (parts,) float64
        Error allowed for each part, as a multiple of the error asked for.
    frame : callable
        Makes a frame from an edit; it is timed.
    quality : str
        What the scene was prepared with.
    dimensions : int
        Coordinates of a material.
    error, fps : float or None
        What was asked for; at most one of them.
    """
    most = transport.rank_used
    ranks = [rank for rank in LADDER if rank < most] + [most]
    deviation, level = transport.probed(tables, ranks)
    # the worst part of each material counts: a part that misses is rendered without the basis
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
    """Return the median time of five frames, after one to warm up.

    Parameters
    ----------
    frame : callable
        Makes a frame by a transport.
    transport : Transport
    """
    frame(transport)
    times = []
    for _ in range(5):
        start = time.perf_counter()
        frame(transport)
        times.append(time.perf_counter() - start)
    return float(np.median(times))
