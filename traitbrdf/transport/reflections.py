"""Reflections: how bright the map is around the mirror direction of each fragment.

Highlights change from pixel to pixel; what is left of a frame once they are taken away is smooth.
Frames at nodes use them as the drift of universal kriging (Cressie, "Statistics for Spatial Data",
1993, section 3.4): at the nodes, the radiance of a table is regressed on them; the rest alone is
interpolated. Both are linear in the table.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse
import torch
from numpy.typing import NDArray

from traitbrdf.directions import direction_to_latlong, reflect
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.scene import Scene

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]

ROWS = (256, 64, 20)
"""Rows of the maps that are looked up: the last is as blurred as a satin surface's reflection."""

_RIDGE = 0.1
"""Weight of small coefficients in the regression: a share of the largest column's squares."""


def reflections(scene: Scene, levels: Sequence[torch.Tensor] | None = None) -> Float32:
    """Return the brightness (P, 3, D) of the map in each fragment's mirror direction.

    It is 0 where the direction is hidden. One half of the columns are maps blurred to different
    widths; the other half are the same times (1 - cos theta)^5, as a Fresnel term grows.

    Parameters
    ----------
    scene : Scene
    levels : sequence of tensors or None
        What `blurred` made of the scene's map, if it did before.
    """
    middle = scene.offsets[:-1] + np.diff(scene.offsets) // 2
    normals, views = scene.normals[middle], scene.views[middle]
    toward = np.asarray(reflect(views, normals))
    # a shading normal may bend the mirror direction a little off unit length
    toward /= np.maximum(np.linalg.norm(toward, axis=-1, keepdims=True), 1e-12)
    seen = scene.visible(middle, toward).astype(np.float32)
    u, v = direction_to_latlong(scene.environment.to_map(toward))
    cosine = np.einsum("pk,pk->p", normals, views).clip(0.0, 1.0)
    fresnel = torch.from_numpy(((1.0 - cosine) ** 5).astype(np.float32))
    columns = []
    for level in blurred(scene.environment) if levels is None else levels:
        wide = level.shape[-1]
        # the map's ends meet: a margin of one texel on either side
        around = torch.cat([level[..., -1:], level, level[..., :1]], dim=-1)
        x = (u * wide + 1.0) / (wide + 2) * 2.0 - 1.0
        at = torch.from_numpy(np.stack([x, v * 2.0 - 1.0], axis=-1).astype(np.float32))
        found = torch.nn.functional.grid_sample(
            around[None], at[None, None], padding_mode="border", align_corners=False
        )
        columns.append(found[0, :, 0].T * torch.from_numpy(seen)[:, None])
    plain = torch.stack(columns, dim=2)
    return torch.cat([plain, plain * fresnel[:, None, None]], dim=2).numpy()


def blurred(environment: EnvironmentMap) -> list[torch.Tensor]:
    """Return a map (3, rows, columns) at several sizes, by means over solid angle.

    Parameters
    ----------
    environment : EnvironmentMap
    """
    image = torch.from_numpy(environment.image.copy()).permute(2, 0, 1)
    rows = image.shape[1]
    middle = torch.arange(rows, dtype=torch.float32) + 0.5
    area = torch.sin(middle * (math.pi / rows))[None, :, None]
    levels = []
    for most in ROWS:
        few = min(most, rows)
        size = (few, min(2 * few, image.shape[2]))
        mean = torch.nn.functional.adaptive_avg_pool2d(image * area, size)
        levels.append(mean / torch.nn.functional.adaptive_avg_pool2d(area, (few, 1)))
    return levels


class Regression(NamedTuple):
    """The normal equations by which radiance at nodes is regressed on reflections, by colour.

    Those of several parts add up.

    Attributes
    ----------
    gram : (3, D, D) float32
    moments : (3, D, n) float32
        Takes the radiance of the nodes to the right-hand side.
    """

    gram: Float32
    moments: Float32

    @classmethod
    def of(cls, columns: Float32, near: Int64, weights: Float32) -> Regression:
        """Return the equations of coefficients with which interpolation errs least.

        What the others say of a node is taken from its radiance and from its columns before one is
        regressed on the other.

        Parameters
        ----------
        columns : (n, 3, D) float32
            Reflections at the nodes.
        near : (n, k) int64
            Nodes that each is interpolated from if it is left out.
        weights : (n, k) float32
        """
        count, _, width = columns.shape
        gram = np.zeros((3, width, width), np.float32)
        moments = np.zeros((3, width, count), np.float32)
        if near.size:
            starts = np.arange(0, near.size + 1, near.shape[1])
            values = weights.ravel().astype(np.float64)
            others = scipy.sparse.csr_array((values, near.ravel(), starts), shape=(count, count))
            rest = scipy.sparse.eye_array(count, format="csr") - others
            for c in range(3):
                design = rest @ columns[:, c].astype(np.float64)
                gram[c], moments[c] = design.T @ design, (rest.T @ design).T
        return cls(gram, moments)

    def slopes(self, shown: Float32) -> Float32:
        """Return the coefficients (3, D) of reflections for the radiance (n, 3) of the nodes."""
        return slopes_of(self.gram, np.einsum("cdn,nc->cd", self.moments, shown))


def slopes_of(gram: Float32, moments: Float32) -> Float32:
    """Return the coefficients (3, D) of reflections.

    Parameters
    ----------
    gram : (3, D, D) float32
    moments : (3, D) float32
        Right-hand side: `Regression.moments` times the radiance of the nodes.
    """
    ridge = _RIDGE * np.maximum(gram.diagonal(axis1=1, axis2=2).max(axis=1), 1e-30)
    whole = gram + ridge[:, None, None] * np.eye(gram.shape[1])
    found: Float32 = np.linalg.solve(whole, moments[..., None])[..., 0].astype(np.float32)
    return found
