"""The image that frames of parts are drawn into."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf.transport.basis import PartFrame
from traitbrdf.transport.transport import Transport

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]


class Canvas:
    """A frame on the device; only the pixels of changed parts are drawn again.

    A pixel at a border is the sum of the backdrop and its parts. It is summed anew, in the order of
    the parts, each time it is drawn, so that the image depends on the parts' frames alone.

    Parameters
    ----------
    transport : Transport

    Attributes
    ----------
    pixels : (H * W, 3) float32 tensor
        Linear radiance.
    drawn : list of PartFrame
        What it shows of each part.
    changed : list of int
        Parts that the last `draw` drew.
    """

    def __init__(self, transport: Transport) -> None:
        scene = transport.scene
        self._transport = transport
        sizes = [0 if part is None else len(part.pixels) for part in transport.parts]
        black = [
            PartFrame(torch.zeros(n, 3, dtype=torch.float32, device=transport.device), 0.0, 0.0)
            for n in sizes
        ]
        self._backdrop = transport.compose(black).reshape(-1, 3)
        several = np.bincount(scene.pixels, minlength=len(scene.uncovered)) > 1
        # the share of the pixel that shows the backdrop is a part of the sum as well
        self._mixed = (several | (scene.uncovered > 0.0))[scene.pixels]
        self._patches: dict[int | None, tuple[torch.Tensor, list[Any]]] = {}
        self._mixed_parts: dict[int, torch.Tensor] = {}
        self.drawn: list[PartFrame] = []
        self._free: list[_Page] = []
        self.pixels = self._backdrop
        self.changed: list[int] = []

    def draw(self, frames: list[PartFrame]) -> None:
        """Draw the parts' frames; those that are shown already are left alone.

        Parameters
        ----------
        frames : list of PartFrame, one for each part
        """
        drawn, self.drawn = self.drawn, []  # after an interruption all is drawn again
        if drawn:
            pairs = zip(frames, drawn, strict=True)
            self.changed = [i for i, (new, old) in enumerate(pairs) if new is not old]
            if len(self.changed) == 1:
                ((i,), old) = self.changed, drawn[self.changed[0]]
                since = frames[i].since
                if since is not None and since[0] == old.serial:
                    self._touch(i, since[1], frames)
                    self.drawn = frames
                    return
            self.redraw(self.changed, frames)
        else:
            self.changed = list(range(len(frames)))
            self.pixels = self._transport.compose(frames).reshape(-1, 3)
        self.drawn = frames

    def redraw(self, changed: list[int], frames: list[PartFrame]) -> None:
        """Draw the pixels of some parts.

        Parameters
        ----------
        changed : list of int
            Their indices.
        frames : list of PartFrame, one for each part
        """
        for i in changed:
            part = self._transport.parts[i]
            if part is not None:
                self.pixels.index_copy_(0, part.pixels, frames[i].radiance)
        if changed:
            pixels, places = self._patch(changed[0] if len(changed) == 1 else None)
            sums = self._backdrop[pixels]
            for i, fragments, place in places:
                sums.index_add_(0, place, frames[i].radiance[fragments])
            self.pixels.index_copy_(0, pixels, sums)

    def _touch(self, part: int, fragments: torch.Tensor, frames: list[PartFrame]) -> None:
        """Draw the pixels of some fragments of a part."""
        known = self._transport.parts[part]
        if known is None or not len(fragments):
            return
        pixels = known.pixels[fragments]
        mixed = self._mixed_here(part)[fragments]
        plain = ~mixed
        self.pixels.index_copy_(0, pixels[plain], frames[part].radiance[fragments[plain]])
        if bool(mixed.any()):
            pixels, places = self._patch(part)
            sums = self._backdrop[pixels]
            for i, others, place in places:
                sums.index_add_(0, place, frames[i].radiance[others])
            self.pixels.index_copy_(0, pixels, sums)

    def _mixed_here(self, part: int) -> torch.Tensor:
        """Return which fragments of a part share their pixel."""
        if part not in self._mixed_parts:
            span = self._transport.scene.part_slice(part)
            self._mixed_parts[part] = torch.from_numpy(self._mixed[span]).to(self._transport.device)
        return self._mixed_parts[part]

    def _patch(self, part: int | None) -> tuple[torch.Tensor, list[Any]]:
        """Find the border pixels that show a part (None: any part).

        Returns the pixels and, for each part, its fragments on them and their places there.
        """
        if part not in self._patches:
            scene = self._transport.scene
            chosen = self._mixed.copy()
            if part is not None:
                chosen &= scene.pixel_part == part
            pixels = np.unique(scene.pixels[chosen])
            places = []
            for i in range(len(scene.parts)):
                span = scene.part_slice(i)
                fragments = np.flatnonzero(np.isin(scene.pixels[span], pixels))
                if len(fragments):
                    place = np.searchsorted(pixels, scene.pixels[span][fragments])
                    places.append((i, self._tensor(fragments), self._tensor(place)))
            self._patches[part] = self._tensor(pixels), places
        return self._patches[part]

    def _tensor(self, index: Int64) -> torch.Tensor:
        return torch.from_numpy(index).to(self._transport.device)

    def image(self) -> Float32:
        """Return a copy (H, W, 3) of the frame."""
        scene = self._transport.scene
        page = self._free.pop() if self._free else _Page((scene.height, scene.width, 3))
        copy = np.asarray(page)
        # views of the array keep it alive: once it is gone, nobody looks at its memory
        weakref.finalize(copy, _give_back, self._free, page).atexit = False
        copy[...] = self.pixels.cpu().numpy().reshape(copy.shape)
        return copy


class _Page:
    """Memory of a frame.

    Allocating pages costs ten times the copy, so memory of frames that nobody holds is reused.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._memory = np.empty(shape, np.float32)
        self.__array_interface__ = self._memory.__array_interface__


def _give_back(free: list[_Page], page: _Page) -> None:
    if len(free) < 3:
        free.append(page)
