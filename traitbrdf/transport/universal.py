"""A basis that is fitted to no scene: tables and coefficients that serve any view and light.

A transport fits its basis to one scene, which takes half a minute. This basis is fitted once, to
fragments of many views under many lights, none of which is the user's. Then for any scene the
radiance of a fragment under a table rho is about (w M) (C rho): w M are its images under R fixed
tables, C rho the coefficients of rho, the same for all fragments, scenes and colours.

Matrix row-column sampling (Hasan, Pellacini & Bala 2007) chooses rows within one scene; here the
rows are drawn from other scenes. The combinations M come from the SVD of the rows' training images,
and C is the least-squares fit of all rows in their span, as in `traitbrdf.transport.transport`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf.reflectance.brdf import HalfDiffGrid
from traitbrdf.reflectance.models import GGX, Lambert
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import Shape, sphere
from traitbrdf.scene.teapot import teapot
from traitbrdf.transport.basis import Training
from traitbrdf.transport.operator import Operator
from traitbrdf.transport.visibility import Progress

Float32 = NDArray[np.float32]

VIEWS = 12
"""Views whose fragments the basis is fitted to."""

FRAGMENTS = 100
"""Fragments of each view."""

RANK = 96
"""Tables of the basis."""

_TYPICAL = (GGX(0.01, 0.2, 3.0), GGX(0.1, 0.2, 3.0), Lambert(0.5))
_SIZE = 64  # pixels of a view on a side
_RIDGE = 1e-7  # of the largest diagonal element, in the fit
_ENOUGH = 1e-13  # tables whose squared singular value is a smaller share of the largest are noise


@dataclass(frozen=True)
class UniversalBasis:
    """Fixed tables and coefficients.

    Attributes
    ----------
    grid : HalfDiffGrid of the tables
    tables : (cells, R) float32
        M, in 1/sr; combinations of BRDFs, so that they may be negative.
    projection : (R, cells) float32
        C: takes a channel of a table to its coefficients.
    need : (R,) float32
        How much each table counts in frames: the singular values.
    typical : (R, 3) float32
        Coefficients of a mirror-like, a glossy and a diffuse table.
    """

    grid: HalfDiffGrid
    tables: Float32
    projection: Float32
    need: Float32
    typical: Float32

    @classmethod
    def fit(
        cls,
        grid: HalfDiffGrid,
        training: Training,
        rank: int = RANK,
        seed: int = 0,
        progress: Progress | None = None,
    ) -> UniversalBasis:
        """Fit a basis to fragments of made-up views and lights.

        Parameters
        ----------
        grid : HalfDiffGrid of the tables
        training : Training
            Tables that frames have to be able to show.
        rank : int
            At most so many tables.
        seed : int
            Draws views, lights and fragments.
        progress : called with (stage, fraction done); may raise to cancel
        """
        report = progress or (lambda stage, fraction: None)
        rng = np.random.default_rng(seed)
        rows = []
        for i, scene in enumerate(_views(rng)):
            report("universal basis", 0.7 * i / VIEWS)
            count = len(scene.pixels)
            chosen = np.sort(rng.permutation(count)[:FRAGMENTS])
            found = Operator(scene, grid).rows(chosen)
            # one colour of each: what differs between colours differs between fragments, too
            found = found[np.arange(len(found)), rng.integers(0, 3, len(found))]
            rows.append(found[found.any(axis=1)])
        stacked = torch.from_numpy(np.concatenate(rows))
        tables = torch.from_numpy(np.ascontiguousarray(training.tables))
        importance = torch.from_numpy(training.weight)
        report("universal basis", 0.7)
        images = (stacked @ tables).double()
        # rows of dim fragments count as much as those of bright ones
        bright = images.mean(dim=1, keepdim=True).clamp_min(1e-30)
        stacked /= bright.float()
        images /= bright
        weight = importance / images.mean(dim=0).clamp_min(1e-30)
        images *= weight
        report("universal basis", 0.8)
        squares, u = torch.linalg.eigh(images @ images.T)
        report("universal basis", 0.9)
        squares, u = squares.flip(0), u.flip(1)
        rank = min(rank, int((squares > _ENOUGH * squares[0]).sum()))
        squares, u = squares[:rank], u[:, :rank]
        mix = weight[:, None] * (images.T @ u) / squares
        found_tables = tables @ mix.float()
        shown = (stacked @ found_tables).double()
        gram = shown.T @ shown
        ridge = _RIDGE * gram.diagonal().max() * torch.eye(rank, dtype=torch.float64)
        projection = torch.linalg.solve(gram + ridge, shown.T).float() @ stacked
        wi, wo = grid.node_directions()
        some = [model.eval(wi, wo)[..., 1].ravel() for model in _TYPICAL]
        typical = projection @ torch.from_numpy(np.stack(some, axis=1).astype(np.float32))
        need = squares.sqrt().float().numpy()
        return cls(grid, found_tables.numpy(), projection.numpy(), need, typical.numpy())


def _views(rng: np.random.Generator) -> Iterator[Scene]:
    """Draw views: teapot and sphere in turn, on the ground, from all around."""
    shapes: list[Shape] = [teapot(), sphere()]
    for i in range(VIEWS):
        camera = Camera.orbit(float(rng.uniform(-180.0, 180.0)), float(rng.uniform(-10.0, 60.0)))
        yield Scene(shapes[i % 2], light(rng), camera=camera, size=_SIZE, ground=True, subsamples=1)


def light(rng: np.random.Generator, rows: int = 128) -> EnvironmentMap:
    """Draw a map (rows, 2 rows): a sky over a floor, and lamps of all sizes.

    Parameters
    ----------
    rng : numpy.random.Generator
    rows : int
    """
    theta = (np.arange(rows) + 0.5) * math.pi / rows
    phi = (np.arange(2 * rows) + 0.5) * math.pi / rows
    y = np.cos(theta)[:, None]
    x, z = np.sin(theta)[:, None] * np.cos(phi), np.sin(theta)[:, None] * np.sin(phi)
    above, horizon, below = rng.uniform(0.05, 1.0, (3, 3))
    sky = np.where(y[..., None] > 0.0, above, below) * np.abs(y[..., None]) ** 0.5
    image = sky + horizon * np.exp(-((y[..., None] / 0.3) ** 2)) + np.zeros((rows, 2 * rows, 1))
    for _ in range(int(rng.integers(1, 7))):
        centre = rng.normal((0.0, 1.0, 0.0), 1.0)
        centre /= np.linalg.norm(centre)
        size = float(np.exp(rng.uniform(math.log(0.01), math.log(0.6))))
        away = 1.0 - (x * centre[0] + y * centre[1] + z * centre[2])
        lamp = np.exp(-away / (0.5 * size**2))
        if rng.random() < 0.5:  # with an edge
            lamp = (lamp > math.exp(-1.0)).astype(float)
        power = float(np.exp(rng.uniform(math.log(0.3), math.log(10.0)))) / size**1.5
        image = image + power * lamp[..., None] * rng.uniform(0.4, 1.0, 3)
    return EnvironmentMap(image.astype(np.float32))
