"""Drafts: small frames that are shown before a view or a light is prepared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from traitbrdf.reflectance.brdf import HalfDiffGrid
from traitbrdf.scene.scene import Scene
from traitbrdf.transport.blends import Blend, has_mirrors, mirror_weights
from traitbrdf.transport.lighttree import LightTree
from traitbrdf.transport.operator import Operator as Operator
from traitbrdf.transport.visibility import Progress as Progress

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


class Draft:
    """Small frames of a scene, computed by the uncompressed operator without preparation.

    Parameters
    ----------
    scene : Scene at its full size
    grid : HalfDiffGrid of the tables
    size : int
        Pixels along the longer side, or the scene's own number if that is smaller.
    resolution : float
        As for `Operator`; coarse light gives a first image in a fraction of a second.
    tree : LightTree or None
        The tree of the scene's map, if it was built before.
    seed : int
        Chooses the probes.
    """

    PROBES = 24
    """Fragments that are computed exactly, to measure the error."""

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
        # one sample a pixel will do: the frame is enlarged, and so blurred, anyway
        self.scene = scene.changed(size=shape, subsamples=1) if scale < 1.0 else scene
        self.operator = Operator(self.scene, grid, resolution, tree)
        count = len(self.scene.pixels)
        rng = np.random.default_rng(seed)
        self._probes = np.sort(rng.permutation(count)[: self.PROBES])
        exact = Operator(self.scene, grid, 1.0, self.operator.tree)
        self._rows = exact.rows(self._probes)

    def render(
        self,
        tables: Sequence[Float32],
        mirrors: Sequence[Float64] | None = None,
        blends: Mapping[int, Blend] | None = None,
    ) -> tuple[Float32, float]:
        """Render the small frame.

        Parameters
        ----------
        tables : (grid.size, 3) float32 of each part, f_r in 1/sr
        mirrors : (3,) of each part, weights of a perfect mirror, or None
        blends : mapping of part to Blend, or None
            Fragments of the small scene that have other materials.

        Returns
        -------
        frame : (h, w, 3) float32 linear radiance, backdrop included
        error : float
            Mean relative L1 without mirrors, measured on the probes.
        """
        scene = self.scene
        radiance = np.zeros((len(scene.pixels), 3), np.float32)
        exact = np.zeros((len(self._probes), 3))
        for part, table in enumerate(tables):
            span = scene.part_slice(part)
            blend = None if blends is None else blends.get(part)
            several = [table, *(() if blend is None else blend.tables)]
            images = self.operator.part_images(part, np.concatenate(several, axis=1))
            shown = np.einsum("pckc->pkc", images.reshape(len(images), 3, len(several), 3))
            radiance[span] = shown[:, 0]
            if blend is not None:
                radiance[span][blend.at] = blend.sums(shown[blend.at, 1:])
            mine = (self._probes >= span.start) & (self._probes < span.stop)
            exact[mine] = np.einsum("mck,kc->mc", self._rows[mine], table)
            if blend is not None:  # of other materials than the rows were told
                other = np.isin(self._probes - span.start, blend.at) & mine
                exact[other] = radiance[self._probes[other]]
        level = float(exact.mean()) if exact.size else 0.0
        deviation = np.abs(radiance[self._probes] - exact).mean() if exact.size else 0.0
        if mirrors is not None and has_mirrors(mirrors, blends):
            weight = mirror_weights(scene, mirrors, blends)
            radiance += weight * self.operator.mirror(np.arange(len(scene.pixels)))
        image = scene.backdrop().reshape(-1, 3) * scene.uncovered[:, None]
        np.add.at(image, scene.pixels, radiance)
        frame = image.reshape(scene.height, scene.width, 3).astype(np.float32)
        return frame, float(deviation / level) if level > 0.0 else float(deviation)
