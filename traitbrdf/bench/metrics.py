"""Errors of BRDFs and of pictures."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from traitbrdf import reference
from traitbrdf.bench.datasets import MEASURED_WITHIN, channels
from traitbrdf.pictures import own_colours
from traitbrdf.reflectance.brdf import (
    HalfDiffGrid,
    TabulatedBRDF,
)
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import sphere
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.highlights import HIGHLIGHT
from traitbrdf.space.logmap import FLOOR
from traitbrdf.transport.operator import Operator

Float64 = NDArray[np.float64]


def spheres_compared(
    tables: Sequence[TabulatedBRDF],
    shown: Sequence[TabulatedBRDF],
    environments: Sequence[EnvironmentMap],
    size: int,
) -> tuple[Float64, Float64, Float64]:
    """Compare spheres of tables with spheres of their approximations.

    Parameters
    ----------
    tables, shown : sequences of TabulatedBRDF
        The true tables and their approximations, all on one folded grid.
    environments : sequence of EnvironmentMap
    size : int
        Pixels on a side.

    Returns
    -------
    linear : (maps, tables) array
        PSNR of linear radiance in dB; the peak is the brightest value of the image.
    exposed : (maps, tables) array
        PSNR in dB of the exposed and clipped picture; the peak is 1, and nine tenths of the pixels
        are below 0.8.
    error : (maps, tables) array
        Mean relative L1.
    """
    linear, exposed, error = np.empty((3, len(environments), len(tables)))
    for m, environment in enumerate(environments):
        operator = Operator(Scene(sphere(), environment, size=size), tables[0].grid)
        images = own_colours(operator.part_images(0, channels([*tables, *shown])))
        for i, (true, found) in enumerate(zip(*np.split(images.swapaxes(0, 1), 2), strict=True)):
            linear[m, i] = decibels(float(true.max()), float(np.mean((true - found) ** 2)))
            scale = 0.8 / np.quantile(true.max(axis=1), 0.9)
            clipped = np.clip([true * scale, found * scale], 0.0, 1.0)
            exposed[m, i] = decibels(1.0, float(np.mean((clipped[0] - clipped[1]) ** 2)))
            error[m, i] = reference.relative_error(found, true)
    return linear, exposed, error


def decibels(peak: float, square: float) -> float:
    """Return the PSNR in dB of a mean squared difference `square`, relative to `peak`."""
    return 10.0 * math.log10(peak**2 / max(square, 1e-20))


def highlight_hole(grid: HalfDiffGrid, values: NDArray[Any]) -> float:
    """Return the depth, in [0, 1], of the deepest valley in a highlight.

    The depth is the amount by which f in the valley is lower than the lower of its rims along
    theta_h, relative to that rim. The highlight is theta_h up to 30 degrees, as far around its
    brightest node as f exceeds a tenth of it, in profiles of theta_d up to 60 degrees, with both
    directions within 75 degrees of the normal.

    Parameters
    ----------
    grid : HalfDiffGrid
    values : (cells, 3) array
        f_r in 1/sr.
    """
    kept = (grid.theta_d <= math.radians(60.0)).repeat(grid.n_phi_d)
    nodes = grid.theta_h <= HIGHLIGHT
    f = values.reshape(grid.n_theta_h, -1, 3)[nodes][:, kept]
    seen = grid.lower_cosine.reshape(grid.n_theta_h, -1)[nodes][:, kept] > math.cos(MEASURED_WITHIN)
    f = np.where(seen[..., None], f, 0.0)
    bright = f > 0.1 * f.max(axis=0)
    node = np.arange(len(f))[:, None, None]
    top = f.argmax(axis=0)
    first = np.where(~bright & (node < top), node, -1).max(axis=0)
    last = np.where(~bright & (node > top), node, len(f)).min(axis=0)
    lobe = np.where((node > first) & (node < last), f, 0.0)
    before = np.maximum.accumulate(lobe, axis=0)
    after = np.maximum.accumulate(lobe[::-1], axis=0)[::-1]
    rim = np.minimum(before, after)
    return float(np.max(np.where(lobe > 0.0, 1.0 - lobe / np.maximum(rim, 1e-30), 0.0)))


def log_error(
    embedding: BRDFEmbedding, angles: tuple[Float64, Float64, Float64], rgb: Float64
) -> Float64:
    """Return |d log(f + 1e-3)| (n, 3) of samples that are encoded and decoded again.

    Parameters
    ----------
    embedding : BRDFEmbedding
    angles : theta_h, theta_d, phi_d, each (n,)
        Radians.
    rgb : (n, 3) array
        f_r in 1/sr.
    """
    index, weight = embedding.grid_.stencil(*angles)
    table = embedding.decode_values(embedding.encode_samples(*angles, rgb))
    shown = np.einsum("nk,nkc->nc", weight, table[index])
    error: Float64 = np.abs(np.log(shown + FLOOR) - np.log(np.maximum(rgb, 0.0) + FLOOR))
    return error


def milliseconds(call: Callable[[], object], repeats: int) -> float:
    """Return the median time of `repeats` calls of `call`, after one warm-up call."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))
