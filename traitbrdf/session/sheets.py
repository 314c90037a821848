"""Sheets: frames of several designs side by side, to compare and to pick from."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from traitbrdf.design.document import Design
from traitbrdf.formats.display import exposure_of, tone_map

Float32 = NDArray[np.float32]

_LINE = 16  # pixels of a label


@dataclass(frozen=True, eq=False)
class Sheet:
    """Frames side by side; a notebook shows them.

    Attributes
    ----------
    images : tuple of (H, W, 3) float32 linear radiance
    labels : tuple of str, one for each
    designs : tuple of Design, one for each
    columns : int
        Of the picture.
    choose : callable
        Makes a design that of the session.
    exposures : "one" or "each"
        Whether all are shown with the exposure of the first, or each with its own.
    """

    images: tuple[Float32, ...]
    labels: tuple[str, ...]
    designs: tuple[Design, ...]
    choose: Callable[[Design], None]
    columns: int = 0
    exposures: str = "one"

    def __len__(self) -> int:
        return len(self.images)

    def take(self, index: int) -> None:
        """Make one of the designs that of the session; undoable.

        Parameters
        ----------
        index : int
            Which, 0 is the first.

        Raises
        ------
        ValueError
            If there is no such design.
        """
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(self):
            raise ValueError(f"index: expected 0 to {len(self) - 1}, got {index!r}")
        self.choose(self.designs[index])

    def picture(self, height: int | None = None) -> NDArray[np.uint8]:
        """Return all of them as one labelled picture (H, W, 3) of sRGB bytes.

        Parameters
        ----------
        height : int or None
            Of each frame in pixels; None leaves them as they are.
        """
        tall, wide = self.images[0].shape[:2]
        if height is not None:
            tall, wide = height, max(1, round(wide * height / tall))
        columns = self.columns or len(self)
        rows = math.ceil(len(self) / columns)
        paper = Image.new("RGB", (columns * wide, rows * (tall + _LINE)), (255, 255, 255))
        draw = ImageDraw.Draw(paper)
        exposure = exposure_of(self.images[0])
        for i, (image, label) in enumerate(zip(self.images, self.labels, strict=True)):
            y, x = divmod(i, columns)
            shown = tone_map(image, exposure if self.exposures == "one" else exposure_of(image))
            tile = Image.fromarray(shown)
            if height is not None:
                tile = tile.resize((wide, tall), Image.Resampling.LANCZOS)
            paper.paste(tile, (x * wide, y * (tall + _LINE)))
            place = ((x + 0.5) * wide, y * (tall + _LINE) + tall + 1)
            draw.text(place, label, fill=(0, 0, 0), anchor="ma")
        return np.asarray(paper)

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        Image.fromarray(self.picture(256)).save(file, "png")
        return file.getvalue()
