"""Drafts: frames at a small size before a view or a light is prepared."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from traitbrdf.reflectance.brdf import HalfDiffGrid
from traitbrdf.scene.scene import Scene
from traitbrdf.transport.lighttree import LightTree
from traitbrdf.transport.operator import Operator as Operator
from traitbrdf.transport.visibility import Progress as Progress

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


class Draft:
    """A scene's frames at a small size, straight from the operator: for what is not prepared.

    Parameters
    ----------
    scene : Scene at its full size
    grid : HalfDiffGrid of the tables
    size : int
        Pixels along the longer side; the scene's own where that is smaller.
    resolution : float
        As for `Operator`: coarse light makes a first image in a fraction of a second.
    tree : LightTree of the scene's map, if it is at hand
    seed : chooses the probes
    """

    PROBES = 24

    def __init__(
        self,
        scene: Scene,
        grid: HalfDiffGrid,
        size: int = 128,
        resolution: float = 0.12,
        tree: LightTree | None = None,
        seed: int = 0,
    ) -> None:
        scale = min(1.0, size / max(scene.height, scene.width))
        shape = (max(1, round(scene.height * scale)), max(1, round(scene.width * scale)))
        # what is enlarged is blurred anyway
        self.scene = scene.changed(size=shape, subsamples=1) if scale < 1.0 else scene
        self.operator = Operator(self.scene, grid, resolution, tree)
        count = len(self.scene.pixels)
        rng = np.random.default_rng(seed)
        self._probes = np.sort(rng.permutation(count)[: self.PROBES])
        exact = Operator(self.scene, grid, 1.0, self.operator.tree)
        self._rows = exact.rows(self._probes)

    def render(
        self, tables: Sequence[Float32], mirrors: Sequence[Float64] | None = None
    ) -> tuple[Float32, float]:
        """The small frame (h, w, 3) for one table (grid.size, 3) a part, and its measured error."""
        scene = self.scene
        radiance = np.zeros((len(scene.pixels), 3), np.float32)
        exact = np.zeros((len(self._probes), 3))
        for part, table in enumerate(tables):
            span = scene.part_slice(part)
            images = self.operator.part_images(part, table)
            radiance[span] = np.einsum("pcc->pc", images)
            mine = (self._probes >= span.start) & (self._probes < span.stop)
            exact[mine] = np.einsum("mck,kc->mc", self._rows[mine], table)
        level = float(exact.mean()) if exact.size else 0.0
        deviation = np.abs(radiance[self._probes] - exact).mean() if exact.size else 0.0
        if mirrors is not None and any(np.any(m) for m in mirrors):
            weight = np.stack([np.asarray(m) for m in mirrors])[scene.pixel_part]
            radiance += weight * self.operator.mirror(np.arange(len(scene.pixels)))
        image = scene.backdrop().reshape(-1, 3) * scene.uncovered[:, None]
        np.add.at(image, scene.pixels, radiance)
        frame = image.reshape(scene.height, scene.width, 3).astype(np.float32)
        return frame, float(deviation / level) if level > 0.0 else float(deviation)
