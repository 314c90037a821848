"""Pictures of materials side by side: spheres under one light, labelled, as one sheet."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from traitbrdf.brdf import HalfDiffGrid, TabulatedBRDF
from traitbrdf.formats import exposure_of, tone_map
from traitbrdf.lights import EnvironmentMap
from traitbrdf.quadrature import Operator
from traitbrdf.scene import Scene
from traitbrdf.shapes import sphere

Float32 = NDArray[np.float32]

_PAPER = 209  # sRGB byte of what is around the spheres
_LINE = 15  # pixels of a line of text


def spheres(
    tables: Sequence[TabulatedBRDF], environment: EnvironmentMap | None = None, size: int = 96
) -> Float32:
    """Linear radiance (n, size, size, 3) of a sphere of each table, 0 around it.

    Parameters
    ----------
    tables : n tables of one folded grid
    environment : None is the procedural sky

    Raises
    ------
    ValueError
        If there are none, or their grids differ.
    """
    if not tables or any(table.grid != tables[0].grid for table in tables):
        raise ValueError(f"tables: expected one or more of one grid, got {len(tables)}")
    operator = _operator(_sky() if environment is None else environment, tables[0].grid, size)
    flat = np.concatenate([t.values.reshape(-1, 3).astype(np.float32) for t in tables], axis=1)
    images = own_colours(operator.part_images(0, flat))
    whole = np.zeros((len(tables), size * size, 3), np.float32)
    whole[:, operator.scene.pixels] = np.maximum(images.swapaxes(0, 1), 0.0)
    return whole.reshape(len(tables), size, size, 3)


def own_colours(images: Float32) -> Float32:
    """(m, B, 3) of images (m, 3, 3 B): each colour of the light under its own channel."""
    each = images.reshape(*images.shape[:2], images.shape[2] // 3, 3)
    return np.ascontiguousarray(np.einsum("mcbc->mbc", each))


@functools.lru_cache(maxsize=1)
def _sky() -> EnvironmentMap:
    return EnvironmentMap.sky()


@functools.lru_cache(maxsize=2)
def _operator(environment: EnvironmentMap, grid: HalfDiffGrid, size: int) -> Operator:
    return Operator(Scene(sphere(), environment, size=size), grid)


def sheet(
    rows: Mapping[str, Sequence[TabulatedBRDF]],
    columns: Sequence[str] = (),
    environment: EnvironmentMap | None = None,
    size: int = 96,
) -> NDArray[np.uint8]:
    """A sheet (H, W, 3) of sRGB bytes: a row of spheres for each label, all exposed alike.

    Parameters
    ----------
    rows : tables of one grid by the label of their row
    columns : labels above the columns
    environment, size : as for `spheres`
    """
    tables = [table for row in rows.values() for table in row]
    images = spheres(tables, environment, size)
    lit = images.max(axis=-1) > 0.0
    exposure = exposure_of(images[lit][None]) if lit.any() else 1.0
    shown = tone_map(images, exposure)
    shown[~lit] = _PAPER
    wide = max(len(row) for row in rows.values())
    margin = 8 + 7 * max(len(label) for label in rows)
    top = _LINE if columns else 0
    paper = Image.new("RGB", (margin + wide * size, top + len(rows) * size), (_PAPER,) * 3)
    draw = ImageDraw.Draw(paper)
    for j, label in enumerate(columns):
        draw.text((margin + (j + 0.5) * size, 1), label, fill=(0, 0, 0), anchor="ma")
    at = 0
    for i, (label, row) in enumerate(rows.items()):
        draw.text((4, top + (i + 0.5) * size), label, fill=(0, 0, 0), anchor="lm")
        for j in range(len(row)):
            paper.paste(Image.fromarray(shown[at]), (margin + j * size, top + i * size))
            at += 1
    return np.asarray(paper)
