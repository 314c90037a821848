"""Pictures: materials side by side on spheres, and maps of the angles that a scene shows."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from traitbrdf.formats.display import exposure_of, tone_map
from traitbrdf.reflectance.brdf import HalfDiffGrid, TabulatedBRDF
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import sphere
from traitbrdf.transport.operator import Operator

if TYPE_CHECKING:
    from traitbrdf.transport.angles import AnglesSeen

Float32 = NDArray[np.float32]
_PAPER = 209  # sRGB byte of the background
_LINE = 15  # height of a line of text in pixels


def spheres(
    tables: Sequence[TabulatedBRDF], environment: EnvironmentMap | None = None, size: int = 96
) -> Float32:
    """Render a sphere of each table, in linear radiance (n, size, size, 3), 0 around it.

    Parameters
    ----------
    tables : sequence of n TabulatedBRDF
        All on one folded grid.
    environment : EnvironmentMap or None
        None is the procedural sky.
    size : int
        Pixels on a side.

    Raises
    ------
    ValueError
        If there are no tables, or their grids differ.
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
    """Return the colour (m, B, 3) of `images` (m, 3, 3 B) lit by each colour of the light.

    `images` holds every channel of the table under every colour of the light; the result keeps the
    pairs of equal channels.

    Parameters
    ----------
    images : (m, 3, 3 B) array
        Axes: pixels, colours of the light, and the channels of B tables.
    """
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
    """Draw a sheet (H, W, 3) of sRGB bytes: a row of spheres for each label, with one exposure.

    Parameters
    ----------
    rows : mapping of str to sequence of TabulatedBRDF
        The tables of each row, all on one grid, by the row's label.
    columns : sequence of str
        Labels above the columns.
    environment, size
        As for `spheres`.
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


def angle_map(seen: AnglesSeen, height: int = 360) -> NDArray[np.uint8]:
    """Draw a picture (H, W, 3) of sRGB bytes of the BRDF angles that a scene shows.

    An angle is the brighter, over four decades, the more light the scene reflects by it; white
    angles do not occur.

    Parameters
    ----------
    seen : traitbrdf.transport.angles.AnglesSeen
    height : int
        Pixels of the map's side.
    """
    grid = seen.grid
    theta_h, theta_d = np.degrees(grid.theta_h), np.degrees(grid.theta_d)
    decades = np.log10(np.maximum(seen.density, 1e-30))
    level = np.clip(1.0 + decades / 4.0, 0.0, 1.0)[..., None]
    ink = 255.0 * np.clip(level * [2.2, 1.5, 1.1] - [0.0, 0.35, 0.6], 0.0, 1.0)
    colour = np.where(level > 0.0, ink, 255.0).astype(np.uint8)
    # both axes in degrees, theta_h upwards
    degrees = (np.arange(height) + 0.5) * 90.0 / height
    up = np.abs(theta_h[None, :] - degrees[::-1, None]).argmin(axis=1)
    along = np.abs(theta_d[None, :] - degrees[:, None]).argmin(axis=1)
    left, top, below = 64, 2 * _LINE, 3 * _LINE
    paper = Image.new("RGB", (left + height + 24, top + height + below), (255, 255, 255))
    paper.paste(Image.fromarray(colour[up][:, along]), (left, top))
    draw = ImageDraw.Draw(paper)
    draw.rectangle((left - 1, top - 1, left + height, top + height), outline=(0, 0, 0))
    for angle in range(0, 91, 15):
        at = round(angle * height / 90.0)
        draw.text((left + at, top + height + 4), str(angle), fill=(0, 0, 0), anchor="ma")
        draw.text((left - 6, top + height - at), str(angle), fill=(0, 0, 0), anchor="rm")
    draw.text((left + height // 2, top + height + 24), "theta_d", fill=(0, 0, 0), anchor="ma")
    draw.text((4, top + height // 2), "theta_h", fill=(0, 0, 0), anchor="lm")
    most = seen.within(0.9)
    caption = f"{100.0 * seen.cells:.0f} % of the angles show; 90 % of the light: theta_h below "
    caption += f"{most[0]:.0f}, theta_d below {most[1]:.0f}"
    draw.text((4, 4), caption, fill=(0, 0, 0))
    return np.asarray(paper)
