"""Pictures of library materials, to choose by: small lit spheres, drawn once."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from traitbrdf.formats.display import Display, exposure_of
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import sphere
from traitbrdf.space.library import Library
from traitbrdf.transport.operator import Operator

SIDE = 40
"""Pixels on a side of a sphere."""
_GREY = 30  # of 255, around the spheres
_WHITE = 0.5  # reflectance that the exposure is made for


class Shelf:
    """Spheres of the members of a library under a sky, with one exposure for all.

    Parameters
    ----------
    library : Library
    """

    def __init__(self, library: Library) -> None:
        self.library = library
        self._known: dict[str, NDArray[np.uint8]] = {}
        self._operator: Operator | None = None
        self._display = Display(1.0)

    def missing(self, names: list[str]) -> list[str]:
        """Return the names whose spheres are not drawn yet."""
        return [name for name in names if name not in self._known]

    def draw(self, names: list[str]) -> None:
        """Draw spheres; a few at a time, since each takes some hundredths of a second."""
        if not names:
            return
        if self._operator is None:
            scene = Scene(sphere(), EnvironmentMap.sky(), size=SIDE, subsamples=1)
            self._operator = Operator(scene, self.library.embedding.grid_)
            grey = np.full((self.library.embedding.grid_.size, 1), _WHITE / np.pi, np.float32)
            self._display = Display(exposure_of(self._operator.part_images(0, grey)[None, ..., 0]))
        tables = [self.library[name] for name in names]
        columns = np.concatenate([one.values.reshape(-1, 3) for one in tables], axis=1)
        images = self._operator.part_images(0, np.ascontiguousarray(columns, np.float32))
        mirror = self._operator.mirror(np.arange(len(images)))
        scene = self._operator.scene
        for i, (name, table) in enumerate(zip(names, tables, strict=True)):
            # light of a colour meets the table's of the same colour
            shown = np.stack([images[:, c, 3 * i + c] for c in range(3)], axis=1)
            shown = shown + mirror * np.asarray(table.mirror, np.float32)
            picture = np.full((SIDE * SIDE, 3), _GREY, np.uint8)
            picture[scene.pixels] = self._display(shown[None].astype(np.float32))[0]
            self._known[name] = picture.reshape(SIDE, SIDE, 3)

    def strip(self, names: list[str]) -> bytes:
        """Return the spheres of names side by side as JPEG; those not drawn are grey."""
        none = np.full((SIDE, SIDE, 3), _GREY, np.uint8)
        row = np.concatenate([self._known.get(name, none) for name in names], axis=1)
        out = io.BytesIO()
        Image.fromarray(row).save(out, "JPEG", quality=88, subsampling=0)
        return out.getvalue()
