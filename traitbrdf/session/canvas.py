"""The image that frames of parts are drawn into."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf.transport.transport import PartFrame, Transport

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]


class Canvas:
    """The frame on the device, of which only the pixels of changed parts are drawn again.

    A pixel at a border is the sum of the backdrop and its parts, in the order of the parts, each
    time it is drawn: so the image depends on nothing but the parts' frames.
    """

    def __init__(self, transport: Transport) -> None:
        scene = transport.scene
        self._transport = transport
        sizes = [0 if part is None else len(part.pixels) for part in transport.parts]
        black = [PartFrame(torch.zeros(n, 3, device=transport.device), 0.0, 0.0) for n in sizes]
        self._backdrop = transport.compose(black).reshape(-1, 3)
        several = np.bincount(scene.pixels, minlength=len(scene.uncovered)) > 1
        # the share of the pixel that shows the backdrop is a part of the sum as well
        self._mixed = (several | (scene.uncovered > 0.0))[scene.pixels]
        self._patches: dict[int | None, tuple[torch.Tensor, list[Any]]] = {}
        self.drawn: list[PartFrame] = []
        self._free: list[_Page] = []
        self.pixels = self._backdrop
        self.changed: list[int] = []

    def draw(self, frames: list[PartFrame]) -> None:
        """Bring the image up to the parts' frames; `changed` are those that were drawn."""
        drawn, self.drawn = self.drawn, []  # what is cut off half way is drawn as a whole again
        if drawn:
            pairs = zip(frames, drawn, strict=True)
            self.changed = [i for i, (new, old) in enumerate(pairs) if new is not old]
            self.redraw(self.changed, frames)
        else:
            self.changed = list(range(len(frames)))
            self.pixels = self._transport.compose(frames).reshape(-1, 3)
        self.drawn = frames

    def redraw(self, changed: list[int], frames: list[PartFrame]) -> None:
        """Draw the pixels of the parts `changed`."""
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

    def _patch(self, part: int | None) -> tuple[torch.Tensor, list[Any]]:
        """Pixels that are sums and show `part` (None: any), and what falls on which of them."""
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
        """A copy (H, W, 3) of the frame."""
        scene = self._transport.scene
        page = self._free.pop() if self._free else _Page((scene.height, scene.width, 3))
        copy = np.asarray(page)
        # whatever views of it there are hold the array itself: once that is gone, all are
        weakref.finalize(copy, _give_back, self._free, page).atexit = False
        copy[...] = self.pixels.cpu().numpy().reshape(copy.shape)
        return copy


class _Page:
    """Memory of a frame. New pages cost ten times the copy: those of a frame that nobody holds any
    more are used again."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._memory = np.empty(shape, np.float32)
        self.__array_interface__ = self._memory.__array_interface__


def _give_back(free: list[_Page], page: _Page) -> None:
    if len(free) < 3:
        free.append(page)
